"""Instruments: right where least squares is not, and the tests say when; all from triangles."""

import numpy as np
import pytest
import scipy.signal

from calib.errors import Unidentifiable
from calib.estimation.linear import ols
from calib.identification.closed_loop.instrumental_variables import (
    by_free_instruments,
    exogeneity,
    instrument,
    iv,
    projected,
    settled,
    strength,
)
from calib.identification.methods.constrained import within

TRUTH = np.array([2.0, -1.0, 0.5])


def planted(
    seed: int, feedback: float = 0.0, noise: float = 0.3, count: int = 400, miss: float = 0.05, alike: float = 0.0
):
    """Return Z, W, y: y's noise reaches the first two columns of W by `feedback`; Z misses the clean W by `miss`.

    `alike`: of the first column, in the third and off the second.
    """
    rng = np.random.default_rng(seed)
    clean = rng.normal(size=(count, 3))
    clean = clean + alike * clean[:, :1] * [0.0, -1.0, 1.0]
    error = noise * rng.normal(size=count)
    matrix = clean + 0.1 * rng.normal(size=(count, 3)) * (feedback != 0.0)
    matrix[:, :2] -= feedback * error[:, None]
    instruments = clean + miss * rng.normal(size=(count, 3))
    return instruments, matrix, clean @ TRUTH + error + (matrix - clean) @ TRUTH


def test_formula_is_two_stage_least_squares():
    """The estimate is the textbook formula with its covariance, and two-stage least squares."""
    z, w, y = planted(0, 1.0)
    found = iv(instrument(z, w, y)).estimate
    assert found.values == pytest.approx(np.linalg.solve(z.T @ w, z.T @ y), rel=1e-9)
    fitted = z @ np.linalg.lstsq(z, w)[0]
    assert found.values == pytest.approx(np.linalg.lstsq(fitted, y)[0], rel=1e-9)
    rho = y - w @ found.values
    bread = np.linalg.inv(z.T @ w)
    assert found.covariance == pytest.approx(rho @ rho / 397 * bread @ z.T @ z @ bread.T, rel=1e-8)
    assert found.dof == 397


def test_rows_are_weighted_on_both_sides():
    z, w, y = planted(1, 1.0)
    group, std = np.tile([0, 1], 200), np.array([1.0, 4.0])
    omega = 1 / std[group] ** 2
    found = iv(instrument(z, w, y, group), std).estimate.values
    assert found == pytest.approx(np.linalg.solve((z.T * omega) @ w, (z.T * omega) @ y), rel=1e-9)


def test_blocks_equal_the_whole():
    """Blocks equal the whole, and least squares is in the same triangles."""
    z, w, y = planted(2, 1.0)
    whole = instrument(z, w, y, names=["a", "b", "c"])
    half = instrument(z[:150], w[:150], y[:150], names=["a", "b", "c"])
    both = instrument(z[150:], w[150:], y[150:], before=half)
    assert iv(both).estimate.values == pytest.approx(iv(whole).estimate.values, rel=1e-11)
    assert iv(both).estimate.names == ("a", "b", "c")
    assert ols(both.least_squares()).estimate.values == pytest.approx(np.linalg.lstsq(w, y)[0], rel=1e-10)


def test_columns_as_instruments_give_ols():
    """Instruments equal to the columns give least squares."""
    _, w, y = planted(3)
    found, ordinary = iv(instrument(w, w, y)).estimate, ols(instrument(w, w, y).least_squares()).estimate
    assert found.values == pytest.approx(ordinary.values, rel=1e-10)
    assert found.covariance == pytest.approx(ordinary.covariance, rel=1e-9)


@pytest.mark.slow
def test_instruments_are_unbiased_unlike_ols():
    """Instruments are unbiased where least squares is not, and their covariance is true."""
    errors, sizes, naive = [], [], []
    for seed in range(300):
        problem = instrument(*planted(seed, 1.0))
        found = iv(problem).estimate
        errors.append(found.values - TRUTH)
        sizes.append(errors[-1] @ np.linalg.solve(found.covariance, errors[-1]))
        naive.append(ols(problem.least_squares()).estimate.values - TRUTH)
    standard = np.std(errors, axis=0) / np.sqrt(300)
    assert np.all(np.abs(np.mean(errors, axis=0)) < 4 * standard)
    assert np.abs(np.mean(naive, axis=0)[:2]).min() > 20 * standard.max()
    assert np.mean(sizes) == pytest.approx(3.0, abs=4 * np.sqrt(6 / 300) + 0.1)


def test_noise_in_columns_is_cured_too():
    """Noise in the columns themselves is cured, too."""
    naive, cured = [], []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        clean = rng.normal(size=(500, 3))
        y = clean @ TRUTH + 0.1 * rng.normal(size=500)
        problem = instrument(clean, clean + 0.5 * rng.normal(size=(500, 3)), y)
        cured.append(iv(problem).estimate.values - TRUTH)
        naive.append(ols(problem.least_squares()).estimate.values - TRUTH)
    assert np.abs(np.mean(naive, axis=0)[0]) > 0.3  # 2.0 shrinks by 1 / (1 + 0.25)
    assert np.abs(np.mean(cured, axis=0)).max() < 4 * np.std(cured) / np.sqrt(60)


@pytest.mark.slow
def test_durbin_wu_hausman_keeps_its_level():
    """The Durbin-Wu-Hausman test keeps its level where least squares is right."""
    verdicts = [exogeneity(instrument(*planted(seed, miss=0.3))) for seed in range(400)]
    assert np.mean([v.p < 0.05 for v in verdicts]) == pytest.approx(0.05, abs=0.035)
    assert verdicts[0].degrees[0] == 3


def test_durbin_wu_hausman_sees_the_feedback():
    assert np.mean([exogeneity(instrument(*planted(seed, 1.0))).biased() for seed in range(100)]) > 0.95


def test_augmented_regression_is_f_test():
    """The augmented regression is the F test written out."""
    z, w, y = planted(4, 0.3)
    v = w - z @ np.linalg.lstsq(z, w)[0]
    sums = [np.sum((y - m @ np.linalg.lstsq(m, y)[0]) ** 2) for m in (w, np.hstack([w, v]))]
    verdict = exogeneity(instrument(z, w, y))
    assert verdict.statistic == pytest.approx((sums[0] - sums[1]) / 3 / (sums[1] / 394), rel=1e-8)
    assert verdict.degrees == (3, 394)


def test_explained_columns_go_untested():
    """Columns that the instruments explain wholly are not tested."""
    z, w, y = planted(6, 1.0)
    w[:, 2] = z[:, 2]
    y = y + 0.0
    assert exogeneity(instrument(z, w, y)).degrees[0] == 2


@pytest.mark.slow
def test_autocorrelation_needs_inflation():
    """Autocorrelated noise needs the inflation to keep the level."""

    def rejected(tau):
        result = []
        for seed in range(150):
            rng = np.random.default_rng(seed)
            slow = scipy.signal.lfilter([1.0], [1.0, -0.9], rng.normal(size=(7, 900)))[:, 100:]
            w = slow[:3].T
            y = w @ TRUTH + slow[3]
            result.append(exogeneity(instrument(w + 0.5 * slow[4:].T, w, y), inflation=tau).p < 0.05)
        return np.mean(result)

    assert rejected(1.0) > 0.4
    assert rejected((1 + 0.81) / (1 - 0.81)) < 0.12  # columns and noise with the same correlation: Σ ρ_k²


def test_loop_rests_with_values_and_residual():
    """The outer loop rests when parameters and residual do, and only then."""
    z, w, y = planted(12)
    fit = iv(instrument(z, w, y))
    assert settled(fit, iv(instrument(z, w, y * 1.001)))
    assert not settled(fit, iv(instrument(z, w, y + 0.2 * w[:, 0])))  # a parameter moves by 10 %
    noisy = y + np.linalg.qr(np.column_stack([z, w, y]), mode="complete")[0][:, -1] * 5.0
    assert iv(instrument(z, w, noisy)).estimate.values == pytest.approx(fit.estimate.values)
    assert not settled(fit, iv(instrument(z, w, noisy)))  # the same parameters, another residual


def test_strength_of_instruments():
    """Strength of perfect, good and useless instruments."""
    z, w, y = planted(7, 1.0)
    same, good = strength(instrument(w, w, y)), strength(instrument(z, w, y))
    useless = strength(instrument(np.column_stack([z[:, :2], np.random.default_rng(7).normal(size=400)]), w, y))
    assert same.correlations == pytest.approx(np.ones(3))
    assert same.partial_r2 == pytest.approx(np.ones(3))
    assert not good.weak and good.correlations.min() > 0.85 and good.partial_r2.min() > 0.8
    assert useless.weak and useless.correlations[-1] < 0.15
    assert useless.partial_r2[2] < 0.05 < 0.25 < useless.partial_r2[:2].min()


def test_first_stage_equals_regressions():
    """First-stage values are those of the regressions written out."""
    z, w, y = planted(8, 1.0, miss=0.5)
    found = strength(instrument(z, w, y))
    fitted = z @ np.linalg.lstsq(z, w)[0]
    rest = w - fitted
    concentration = np.linalg.solve(rest.T @ rest, fitted.T @ fitted) * 397 / 3
    assert found.cragg_donald == pytest.approx(np.linalg.eigvals(concentration).real.min(), rel=1e-6)
    unit = (m / np.linalg.norm(m, axis=0) for m in (z, w))
    zu, wu = unit
    assert found.condition == pytest.approx(np.linalg.cond(zu.T @ wu), rel=1e-8)


def test_motionless_instrument_is_named():
    """An instrument without motion and dependent columns are named."""
    z, w, y = planted(9)
    still = z.copy()
    still[:, 1] = 0.0
    with pytest.raises(Unidentifiable, match="instrument of Fv2") as caught:
        iv(instrument(still, w, y, names=["Ia1", "Fv2", "Fc3"]))
    assert caught.value.names == ("instrument of Fv2",)
    twice = w.copy()
    twice[:, 2] = 2 * twice[:, 0]
    with pytest.raises(Unidentifiable) as caught:
        iv(instrument(z, twice, y, names=["Ia1", "Fv2", "Fc3"]))
    assert caught.value.names == ("Ia1", "Fc3")


def bounded(z: np.ndarray, w: np.ndarray, y: np.ndarray, bound: float) -> np.ndarray:
    """Return both forms (2, 3) of constrained IV with the third parameter at a bound: two-stage, and the slides'."""
    problem, normals = instrument(z, w, y), np.eye(3)[2:]
    found = within(projected(problem), normals, np.array([bound]), np.array([bound])).values
    return np.array([found, by_free_instruments(problem, np.ones(1), found, normals)])


def test_constrained_forms_match_formulas():
    """The slides' relation of free and constrained estimate is that of the free columns' instruments alone."""
    z, w, y = planted(10, 1.0)
    free = iv(instrument(z, w, y)).estimate.values
    fitted = z @ np.linalg.lstsq(z, w)[0]
    for instruments, found in zip((fitted, z), bounded(z, w, y, 0.4)):
        own = instruments[:, :2]
        moved = np.linalg.solve(own.T @ w[:, :2], own.T @ w[:, 2] * (free[2] - 0.4))
        assert found == pytest.approx(np.append(free[:2] + moved, 0.4), rel=1e-9)


@pytest.mark.slow
def test_forms_part_where_a_bound_is_wrong():
    """Weak instruments: 0.24 σ apart at the true bound, 2.4 σ with one 6 σ off, where the slides' form errs less."""
    apart, errors = [], []
    for seed in range(100):
        z, w, y = planted(seed, 1.0, miss=1.0, alike=1.0)
        sigma = iv(instrument(z, w, y)).estimate.sigma
        both = np.array([bounded(z, w, y, TRUTH[2] + off) for off in (0.0, 0.2)])
        apart.append((np.abs(both[:, 0] - both[:, 1]) / sigma)[:, :2])
        errors.append(both[1] - TRUTH)
    assert np.allclose(np.mean(apart, axis=(0, 2)), [0.24, 2.4], rtol=0.05)
    two_stage, slides = np.abs(np.mean(errors, axis=0))[:, :2]
    assert (two_stage > slides + 0.05).all()
