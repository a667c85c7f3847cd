"""Claims on the convex bound and on selection among candidates."""

from functools import cache
from itertools import combinations

import library_arm
import numpy as np
import pytest

from calib.poses.by_index import merits
from calib.poses.candidates import draw_candidates
from calib.poses.convex import bound, certificate
from calib.poses.design import Pool, best_addition, design_of, gains_of, with_added, with_removed
from calib.poses.errors import BadInput, NothingFeasible, NotIdentifiable, TooFewCandidates
from calib.poses.exchange import detmax, exchanged, greedy
from calib.poses.indices import index_of_singular_values, observability
from calib.poses.scaled_jacobians import prepared
from calib.poses.select import SearchSettings, random_baseline, select_poses

ARM = library_arm.jacobian(library_arm.random_poses(400, 0))


@cache
def of_the_arm():
    """Return 17 of its poses."""
    return select_poses(ARM, 17)


def log_det_of(jacobians):
    rows = jacobians.reshape(-1, jacobians.shape[-1])
    return np.linalg.slogdet(rows.T @ rows)[1]


@pytest.mark.parametrize(
    ("function", "m"),
    [
        pytest.param(library_arm.jacobian, 17, marks=pytest.mark.slow),
        (library_arm.point_jacobian, 17),
        pytest.param(library_arm.jacobian, 30, marks=pytest.mark.slow),
        pytest.param(library_arm.point_jacobian, 30, marks=pytest.mark.slow),
    ],
)
def test_sandwich(function, m):
    jacobians = function(library_arm.random_poses(600, 2))
    chosen = select_poses(jacobians, m, SearchSettings(seed=1))
    assert chosen.random_baseline < chosen.value
    p = jacobians.shape[2]
    assert log_det_of(jacobians[chosen.indices]) <= chosen.bound.log_upper
    ratio = np.exp(log_det_of(jacobians[chosen.indices]) / p) / chosen.bound.upper
    assert chosen.efficiency == pytest.approx(ratio, rel=1e-9)
    scarce = m * jacobians.shape[1] < 2 * p  # few equations: whole poses fall further behind the relaxed ones
    assert (0.85 if scarce else 0.93) < chosen.efficiency <= 1.0
    assert len(set(chosen.indices.tolist())) == m


@pytest.mark.slow
def test_bound_is_tight_and_feasible():
    """The bound is tight, and its weights are feasible."""
    for capped, most in ((True, 1.0), (False, 17.0)):
        result = bound(ARM, 17, capped=capped, tolerance=1e-4)
        assert result.gap <= 1e-4
        assert result.weights.sum() == pytest.approx(17, rel=1e-9)
        assert result.weights.min() >= 0 and result.weights.max() <= most * (1 + 1e-9)
        rows = ARM * np.sqrt(result.weights)[:, None, None]
        assert result.logdet == pytest.approx(log_det_of(rows), abs=1e-7)
    assert bound(ARM, 120, tolerance=1e-4).upper < 0.999 * bound(ARM, 120, capped=False, tolerance=1e-4).upper


@pytest.mark.slow
def test_any_weights_certify_a_valid_bound():
    """However bad the weights, no relaxed design may beat the bound they give, nor any real selection."""
    generator = np.random.default_rng(0)
    for m in (8, 17, 100):
        candidates = prepared(ARM, m)
        reached = bound(ARM, m, tolerance=1e-5).logdet
        for _ in range(20):
            weights = generator.dirichlet(np.full(len(ARM), generator.choice([0.02, 0.2, 5.0]))) * m
            assert certificate(candidates, weights, m) >= reached
            assert certificate(candidates, weights, m, capped=False) >= certificate(candidates, weights, m)


def test_rank_updates_are_the_determinant():
    candidates = prepared(ARM, 17)
    pool = Pool(candidates.z, candidates.known)
    design = design_of(pool, tuple(range(17)))
    changed = with_removed(pool, with_added(pool, design, 40), 3)
    fresh = design_of(pool, changed.members)
    assert changed.logdet == pytest.approx(fresh.logdet, abs=1e-9)
    np.testing.assert_allclose(changed.scores, fresh.scores, rtol=1e-8)
    np.testing.assert_allclose(changed.inverse, fresh.inverse, rtol=1e-7, atol=1e-10)
    outside = np.flatnonzero(~design.taken)
    gains = gains_of(pool, design, outside, 1.0)
    found, gain = best_addition(pool, design, first=2)
    assert found == outside[gains.argmax()] and gain == pytest.approx(gains.max())


@pytest.mark.slow
def test_detmax_finds_the_best_of_all_sets():
    for seed in range(6):
        jacobians = np.random.default_rng(seed).normal(size=(11, 2, 4))
        best = max(combinations(range(11), 4), key=lambda s: log_det_of(jacobians[list(s)]))
        assert tuple(select_poses(jacobians, 4, SearchSettings(seed=seed)).indices) == best


def test_exchange_ends_at_local_optimum():
    """The exchange ends where no single exchange helps."""
    candidates = prepared(ARM[:120], 10)
    pool = Pool(candidates.z, candidates.known)
    design = detmax(pool, exchanged(pool, greedy(pool, 10)))
    design = exchanged(pool, design)
    best = max(
        design_of(pool, (*(k for k in design.members if k != out), into)).logdet
        for out in design.members
        for into in np.flatnonzero(~design.taken)
    )
    assert best <= design.logdet + 1e-8


@pytest.mark.slow
@pytest.mark.parametrize(
    "index", [*(pytest.param(index, marks=pytest.mark.slow) for index in ("O2", "O3", "O4", "O5")), "cond"]
)
def test_other_indices_beat_d_optimal_sets(index):
    """Other indices improve on the D-optimal and on random sets."""
    start = observability(ARM[of_the_arm().indices], index)
    chosen = select_poses(ARM, 17, SearchSettings(index=index))
    assert chosen.value == pytest.approx(observability(ARM[chosen.indices], index))
    if index == "cond":
        assert chosen.value <= start and chosen.value < chosen.random_baseline
        assert (np.diff(chosen.history) <= 1e-9).all()
    else:
        assert chosen.value >= start and chosen.value > chosen.random_baseline


def spectra_of_all_sets(jacobians, m):
    """Return the singular values (sets, p) of every set of m poses."""
    sets = np.array(list(combinations(range(len(jacobians)), m)))
    stacked = jacobians[sets].reshape(len(sets), -1, jacobians.shape[-1])
    return np.linalg.svd(stacked, compute_uv=False)


@pytest.mark.parametrize(
    "index",
    [
        pytest.param("O2", marks=pytest.mark.slow),
        pytest.param("O3", marks=pytest.mark.slow),
        pytest.param("O4", marks=pytest.mark.slow),
        pytest.param("O5", marks=pytest.mark.slow),
        "cond",
    ],
)
def test_every_index_finds_the_best_set(index):
    """Without restarts half of these searches end at a local optimum; with few of them none does."""
    for seed in range(4):
        jacobians = np.random.default_rng(seed).normal(size=(13, 2, 6))
        values = index_of_singular_values(spectra_of_all_sets(jacobians, 5), index, 5)
        best = values.min() if index == "cond" else values.max()
        chosen = select_poses(jacobians, 5, SearchSettings(index=index, seed=seed, kicks=2))
        assert chosen.value == pytest.approx(best, rel=1e-9)
        assert chosen.value == pytest.approx(observability(jacobians[chosen.indices], index), rel=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("index", ["O3", "O4"])
def test_arm_optimum_is_reached(index):
    """7 of 18 poses of the LWR4+, against all 31,824 sets."""
    jacobians = ARM[:18]
    squares = jacobians.transpose(0, 2, 1) @ jacobians
    best = -np.inf
    everything = np.array(list(combinations(range(18), 7)))
    for members in np.array_split(everything, 16):
        best = max(best, merits(squares[members].sum(axis=1), index).max())
    chosen = select_poses(jacobians, 7, SearchSettings(index=index))
    assert chosen.value == pytest.approx(np.exp(best), rel=1e-6)


@pytest.mark.slow
def test_o1_selection_does_not_see_units():
    scale = 10.0 ** np.random.default_rng(1).uniform(-3, 3, ARM.shape[2])
    one, other = of_the_arm(), select_poses(ARM * scale, 17)
    assert (one.indices == other.indices).all()
    assert other.efficiency == pytest.approx(one.efficiency, rel=1e-5)


@pytest.mark.slow
def test_known_information_is_counted():
    """What is known before is taken into account."""
    before = ARM[:30]
    chosen = select_poses(ARM[30:], 6, existing=before)
    together = np.concatenate([ARM[30:][chosen.indices], before])
    assert chosen.value == pytest.approx(observability(together, "O1"))
    alone = select_poses(ARM[30:], 6).indices
    assert log_det_of(together) > log_det_of(np.concatenate([ARM[30:][alone], before]))
    assert chosen.random_baseline < chosen.value and chosen.efficiency <= 1
    assert select_poses(ARM, 1, existing=before).indices.shape == (1,)


def test_choosing_all_candidates_is_allowed():
    chosen = select_poses(ARM[:17], 17)
    assert (chosen.indices == np.arange(17)).all()
    assert chosen.efficiency == pytest.approx(1.0, abs=2e-3)


@pytest.mark.slow
def test_the_seed_repeats_every_bit():
    few = ARM[:150]
    one, two = select_poses(few, 17, SearchSettings(seed=5)), select_poses(few, 17, SearchSettings(seed=5))
    assert (one.indices == two.indices).all() and one.value == two.value
    assert (one.history == two.history).all() and one.random_baseline == two.random_baseline
    assert random_baseline(few, 17, seed=6) != one.random_baseline


@pytest.mark.slow
def test_interrupted_exchange_returns_best():
    """An interrupted exchange returns the best so far."""

    def stop(done, total, message):
        if done == 3:
            raise KeyboardInterrupt

    chosen = select_poses(ARM, 17, progress=stop)
    assert chosen.interrupted and chosen.value > chosen.random_baseline
    assert not of_the_arm().interrupted


def test_errors_say_what_and_why():
    with pytest.raises(TooFewCandidates, match="5 candidates for 17 poses") as caught:
        select_poses(ARM[:5], 17)
    assert caught.value.found == 5 and caught.value.wanted == 17
    with pytest.raises(NotIdentifiable, match="at least 6 poses"):
        select_poses(ARM, 5)
    with pytest.raises(NotIdentifiable, match="rank 34 for 35") as deficient:
        select_poses(np.concatenate([ARM, ARM[:, :, :1] + ARM[:, :, 1:2]], axis=2), 17)
    assert deficient.value.singular_values is not None and len(deficient.value.singular_values) == 35
    noise = 1e-17 * np.random.default_rng(0).normal(size=(*ARM.shape[:2], 1))
    with pytest.raises(NotIdentifiable, match=r"columns \[34\]"):
        select_poses(np.concatenate([ARM, noise], axis=2), 17)
    with pytest.raises(BadInput, match="pose 7"):
        select_poses(np.where(np.arange(400)[:, None, None] == 7, np.nan, ARM), 17)
    with pytest.raises(BadInput, match="give space"):
        select_poses(ARM, 17, SearchSettings(method="tabu"))


def test_candidates_keep_limits_predicate():
    """Candidates keep limits and predicate."""

    def upper_half(q):
        return q[:, 0] > 0

    q = draw_candidates(library_arm.LOWER, library_arm.UPPER, 500, upper_half, seed=3)
    assert q.shape == (500, 7) and upper_half(q).all()
    assert (q >= library_arm.LOWER).all() and (q <= library_arm.UPPER).all()
    assert (q == draw_candidates(library_arm.LOWER, library_arm.UPPER, 500, upper_half, seed=3)).all()
    assert (q != draw_candidates(library_arm.LOWER, library_arm.UPPER, 500, upper_half, seed=4)).any()
    spread = draw_candidates(np.zeros(2), np.ones(2), 1024)
    counts = np.histogram2d(*spread.T, bins=16, range=[[0, 1], [0, 1]])[0]
    assert counts.min() == counts.max() == 4  # a net: every box holds its share, which random points never do


def test_nothing_feasible_gives_the_share():
    with pytest.raises(NothingFeasible, match=r"0 of 4096 random poses are feasible \(0 %\)") as caught:
        draw_candidates(np.zeros(3), np.ones(3), 10, lambda q: np.zeros(len(q), bool), max_draws=4096)
    assert (caught.value.found, caught.value.draws) == (0, 4096)


@pytest.mark.parametrize(
    "spare", [pytest.param(1, marks=pytest.mark.slow), 2, 5, pytest.param(40, marks=pytest.mark.slow)]
)
def test_bound_is_tight_with_few_candidates(spare):
    """The bound is tight with few candidates to spare."""
    few = ARM[: 17 + spare]
    chosen = select_poses(few, 17)
    assert chosen.bound.gap < 1e-3 and chosen.efficiency <= 1 + 1e-12
    if spare <= 2:
        best = max(combinations(range(17 + spare), 17), key=lambda s: log_det_of(few[list(s)]))
        assert tuple(chosen.indices) == best


@pytest.mark.parametrize("index", ["cond", "O3"])
def test_all_candidates_can_be_chosen(index):
    """Where every candidate is chosen there is nothing to exchange."""
    chosen = select_poses(ARM[:20], 20, SearchSettings(index))
    assert chosen.indices.tolist() == list(range(20))
