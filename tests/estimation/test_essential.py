"""Essential parameters: planted zeros go, strong ones stay, lists are obeyed, the F values are the textbook's."""

import numpy as np
import pytest
import scipy.stats

from calib.errors import CalibError
from calib.estimation.essential import Rule, eliminate, nested_test
from calib.estimation.linear import ols, wls
from calib.estimation.triangles import Triangles, collect

TRUTH = np.array([5.0, -2.0, 1.0, 3.0, -4.0, 0.0, 0.0, 0.0, 0.0, 0.0])
NAMES = [f"s{k}" for k in range(5)] + [f"z{k}" for k in range(5)]
STD = np.array([0.3, 3.0])


def planted(seed: int, truth: np.ndarray = TRUTH, count: int = 400) -> Triangles:
    rng = np.random.default_rng(seed)
    matrix = rng.normal(size=(count, len(truth)))
    matrix[:, -1] += 0.5 * matrix[:, 0]  # a zero that leans on a strong one
    group = np.tile([0, 1], count // 2)
    target = matrix @ truth + rng.normal(size=count) * STD[group]
    return collect(matrix, target, group, NAMES[: len(truth)])


@pytest.mark.parametrize("rule", list(Rule))
def test_planted_zeros_go_and_others_stay(rule):
    """Planted zeros go, and strong parameters stay."""
    found = [eliminate(planted(seed), rule) for seed in range(20)]
    assert all(set(range(5)) <= set(f.kept.tolist()) for f in found)
    surplus = np.mean([len(f.kept) - 5 for f in found])
    assert surplus < 1.0


@pytest.mark.parametrize("rule", list(Rule))
def test_where_all_are_strong_nothing_goes(rule):
    found = eliminate(planted(3, np.array([5.0, -2.0, 1.0, 3.0, -4.0])), rule)
    assert found.steps == ()
    assert found.kept.tolist() == [0, 1, 2, 3, 4]
    assert found.refused is not None
    assert np.array_equal(found.base.estimate.values, found.essential.estimate.values)


def test_rsd_rule_alone_drops_a_certain_one():
    """The RSD rule alone drops a certain parameter beside a more certain one; both rules together do not."""
    rng = np.random.default_rng(4)
    matrix = rng.normal(size=(2000, 2)) * [100.0, 1.0]
    target = matrix @ [10.0, 1.0] + rng.normal(size=2000)
    data = collect(matrix, target, names=["heavy", "light"])
    alone, both = eliminate(data, Rule.RSD), eliminate(data, Rule.BOTH)
    assert [step.name for step in alone.steps] == ["light"]
    assert alone.steps[0].f > 1000  # known to 2 %
    assert both.steps == () and both.refused is not None and both.refused.p < 1e-6


@pytest.mark.slow
def test_f_rule_keeps_zeros_at_stated_rate():
    """The F rule keeps each zero with its stated probability."""
    kept = np.zeros(5)
    for seed in range(200):
        found = eliminate(planted(seed), Rule.F, level=0.05, std=STD)
        kept += np.isin(np.arange(5, 10), found.kept)
    rate = kept.sum() / 1000
    assert 0.02 < rate < 0.09


def test_statistic_is_f_of_residual_sums():
    """The statistic is the F test of two residual sums."""
    data = planted(5)
    base = ols(data)
    gone, rest = [6, 8, 9], [0, 1, 2, 3, 4, 5, 7]
    before = data.residual_squares(base.estimate.values).sum()
    smaller = data.select(np.array(rest))
    after = smaller.residual_squares(ols(smaller).estimate.values).sum()
    expected = (after - before) / 3 / (before / 390)
    # the covariance of wls is stated, so a unit residual is planted
    f, p = nested_test(wls(data, np.full(2, base.estimate.residual_std)), gone)
    assert f == pytest.approx(expected, rel=1e-8)
    assert p == pytest.approx(scipy.stats.f.sf(expected, 3, 390), rel=1e-6)


def test_essential_estimate_has_base_weights():
    """The essential estimate is that of the remaining columns with the base weights."""
    data = planted(6)
    found = eliminate(data)
    direct = wls(data.select(found.kept), found.base.group_std)
    assert found.essential.estimate.names == tuple(NAMES[k] for k in found.kept)
    assert found.essential.estimate.values == pytest.approx(direct.estimate.values, rel=1e-5)


def test_every_step_is_written_down():
    found = eliminate(planted(7))
    assert {step.name for step in found.steps} | {NAMES[k] for k in found.kept} == set(NAMES)
    assert all(step.ratio >= 20 and step.p >= 0.05 and step.p_total >= 0.05 for step in found.steps)
    assert all(not step.listed for step in found.steps)
    assert found.steps[0].f == pytest.approx((100 / found.steps[0].rsd) ** 2, rel=1e-3)
    assert found.refused is not None and found.refused.name not in {step.name for step in found.steps}


def test_keep_and_drop_lists_are_obeyed():
    found = eliminate(planted(8), keep=["z1"], drop=["s2", "z4"])
    assert {step.name for step in found.steps if step.listed} == {"s2", "z4"}
    assert [step.listed for step in found.steps[:2]] == [True, True]
    assert "z1" in found.essential.estimate.names
    assert "s2" not in found.essential.estimate.names
    assert next(step for step in found.steps if step.name == "s2").p < 1e-6  # obeyed, and its price written down


def test_keeping_all_leaves_nothing_to_do():
    """Keeping all by name leaves nothing to do."""
    found = eliminate(planted(9), Rule.RSD, keep=NAMES)
    assert found.steps == () and found.refused is None


def test_inflation_drops_weak_parameters():
    """Inflation keeps fewer weak parameters."""
    weak = TRUTH.copy()
    weak[5:] = 0.05
    plain, inflated = (
        np.mean([len(eliminate(planted(s, weak), Rule.F, std=STD, inflation=tau).kept) for s in range(20)])
        for tau in (None, np.array([20.0, 20.0]))
    )
    assert plain > inflated + 2


def test_unknown_and_clashing_names_fail():
    """Unknown and contradicting names are refused."""
    with pytest.raises(CalibError, match="Ia9"):
        eliminate(planted(0), keep=["Ia9"])
    with pytest.raises(CalibError, match="s1 cannot be both kept and dropped"):
        eliminate(planted(0), keep=["s1"], drop=["s1"])
    with pytest.raises(CalibError, match="no model"):
        eliminate(planted(0), drop=NAMES)
