"""Claims on the searches that leave the candidates, on a planar arm with closed-form derivatives."""

import pickle
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace

import numpy as np
import planar
import pytest
from differences import check

from calib.poses import pose_constraints
from calib.poses.continuous.local import improved, merit_of
from calib.poses.continuous.tabu import TabuRule
from calib.poses.errors import BadInput
from calib.poses.indices import merit
from calib.poses.select import SearchSettings, select_poses
from calib.poses.space import PoseConstraint, SearchSpace, central_difference, is_feasible
from calib.poses.whole_space import bound_over_space

SPACE = SearchSpace(planar.jacobian, planar.LOWER, planar.UPPER, planar.product)
LOW = PoseConstraint("height", planar.height, planar.height_gradient)
Q = np.random.default_rng(0).uniform(planar.LOWER, planar.UPPER, (200, 3))
QUICK = TabuRule(candidates=30, patience=0.5, evaluations=20)


def turned():
    c, s = np.cos(0.7), np.sin(0.7)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]]) @ np.array([[1, 0, 0], [0, c, -s], [0, s, c]])


def outside_the_wedge(q):
    return np.abs(q[:, 0]) > 0.3


@pytest.mark.parametrize("index", ["O1", "O2", "O3", "O4", "O5", "cond"])
def test_smoothed_merits_are_pessimistic(index):
    """Smoothed merits are pessimistic, converge and have exact gradients."""
    W = planar.jacobian(Q[:6]).reshape(-1, 6)
    sharp = merit(W, index)[0]
    soft = np.array([merit(W, index, a)[0] for a in (4.0, 16.0, 64.0)])
    assert (soft <= sharp + 1e-12).all() and (np.diff(soft) >= -1e-12).all()
    assert sharp - soft[-1] <= 3 * np.log(6) / 64
    check(lambda w: merit(w.reshape(W.shape), index, 16.0)[0], merit(W, index, 16.0)[1].ravel(), W.ravel())


@pytest.mark.parametrize("index", ["O1", "O2", "O3", "O4", "O5", "cond"])
@pytest.mark.parametrize("exact", [True, False])
def test_gradient_is_central_difference(index, exact):
    """The gradient in joint values is the central difference."""
    space = SPACE if exact else replace(SPACE, jacobian_product=None)
    q, existing = Q[:6], planar.jacobian(Q[10:12])
    slope = merit_of(space, q, index, existing)[1]
    for k in np.ndindex(q.shape):
        step = np.zeros_like(q)
        step[k] = 1e-6
        difference = (
            merit_of(space, q + step, index, existing)[0] - merit_of(space, q - step, index, existing)[0]
        ) / 2e-6
        assert slope[k] == pytest.approx(difference, rel=1e-5, abs=1e-7)


@pytest.mark.parametrize(
    "constraint",
    [
        LOW,
        pose_constraints.height(planar.tool, -0.3, 0.9, planar.tool_jacobian),
        pose_constraints.axis_distance(planar.tool, 0.2, planar.tool_jacobian),
        pose_constraints.reach(planar.tool, 0.9, (0.1, 0, 0.2), planar.tool_jacobian),
        pose_constraints.orientation(planar.tool, turned(), (-2.0, 2.5), (-1.0, 1.2), planar.tool_jacobian),
        pose_constraints.line_of_sight(planar.tool, (2, 1, 1), (1, 0, 0.2), 0.6, planar.tool_jacobian),
    ],
    ids=lambda c: c.name,
)
def test_constraint_gradients(constraint):
    assert constraint.gradient is not None
    expected = central_difference(constraint.function, Q).transpose(0, 2, 1)
    np.testing.assert_allclose(constraint.gradient(Q), expected, atol=1e-8, rtol=1e-6)
    verdicts = (constraint.function(Q) <= 0).all(1)
    assert verdicts.any() and not verdicts.all()
    pickle.loads(pickle.dumps(constraint))


def test_line_of_sight_is_a_cone():
    seen = pose_constraints.line_of_sight(planar.tool, (5, 0.1, 0), (1, 0, 0), 0.5)
    turned = np.array([[0, 0, 0.4], [0, 0, 0.6]])
    assert (seen.function(turned)[:, 0] <= 0).tolist() == [True, False]


def test_orientation_limits_roll_and_pitch():
    level = pose_constraints.orientation(planar.tool, np.eye(3), (-0.1, 0.1), (-0.5, 0.5))
    poses = np.array([[0, 0, 0.4], [0, 0, 0.6], [0, 0, -0.6]])  # these turn about −y: pitch −0.4, −0.6, 0.6
    values = level.function(poses)
    assert ((values <= 0).all(1)).tolist() == [True, False, False]
    np.testing.assert_allclose(values[:, 3], [-0.9, -1.1, 0.1], atol=1e-12)


@pytest.mark.parametrize("bound", [(), (LOW,), (replace(LOW, gradient=None),)], ids=["box", "exact", "differences"])
def test_local_search_stays_feasible(bound):
    """The local search improves and stays feasible."""
    space = replace(SPACE, constraints=bound)
    start = (0.3 * Q)[is_feasible(space, 0.3 * Q)][:5]  # clustered: much to win
    run = improved(space, start)
    assert run.merit > merit_of(space, start, "O1")[0] + 0.05
    assert is_feasible(space, run.q, 1e-6).all()
    if not bound:  # stationary: no gradient left but against a limit
        slope = merit_of(space, run.q, "O1")[1]
        inside = (run.q > planar.LOWER + 1e-6) & (run.q < planar.UPPER - 1e-6)
        assert np.abs(slope[inside]).max() < 1e-2


def test_predicate_holds_against_gradient():
    """A predicate is kept where the gradient leads into it."""
    space = replace(SPACE, feasible=outside_the_wedge)
    start = Q[is_feasible(space, Q)][:6]
    run = improved(space, start)
    assert is_feasible(space, run.q, 1e-6).all()
    assert run.merit > merit_of(space, start, "O1")[0]


@pytest.mark.parametrize(
    "method",
    [
        "polish",
        "local",
        pytest.param("multistart", marks=pytest.mark.slow),
        "mlsl",
        pytest.param("tabu", marks=pytest.mark.slow),
    ],
)
def test_methods_repeat_and_beat_random(method):
    """Methods keep constraints, repeat by seed and beat random sets."""
    space = replace(SPACE, constraints=(LOW,), feasible=outside_the_wedge)
    runs = [
        select_poses(
            None, 6, SearchSettings(method=method, count=300, seed=4, starts=3, evaluations=60, rule=QUICK), space=space
        )
        for _ in range(2)
    ]
    assert (runs[0].q == runs[1].q).all() and runs[0].value == runs[1].value
    assert is_feasible(space, runs[0].q, 1e-6).all() and runs[0].q.shape == (6, 3)
    assert runs[0].value > runs[0].random_baseline
    assert runs[0].indices is None
    assert runs[0].history[-1] == runs[0].value and (np.diff(runs[0].history) >= -1e-9).all()


def test_leaving_candidates_beats_staying():
    """Leaving the candidates beats staying among few."""
    kept = select_poses(planar.jacobian(Q[:12]), 5, q=Q[:12])
    moved = select_poses(None, 5, q=Q[:12], settings=SearchSettings(method="polish"), space=SPACE)
    assert kept.value < moved.value
    assert kept.efficiency <= 1 and moved.efficiency <= 1
    assert moved.value**2 * 5 > kept.bound.upper  # above what any five of the candidates can reach


def test_more_starts_are_no_worse():
    """More starts are no worse than the first, and time ends them."""
    one = select_poses(None, 5, q=Q[:40], settings=SearchSettings(method="local"), space=SPACE)
    more = select_poses(None, 5, q=Q[:40], settings=SearchSettings(method="multistart", starts=4), space=SPACE)
    none = select_poses(
        None, 5, q=Q[:40], settings=SearchSettings(method="multistart", starts=4, seconds=0.0), space=SPACE
    )
    assert one.value <= more.value and none.evaluations < one.evaluations < more.evaluations


@pytest.mark.parametrize("bound", [(), (LOW,)], ids=["box", "constrained"])
def test_bound_holds_over_the_whole_space(bound):
    """The bound over the whole space holds the searches between chance and itself."""
    space = replace(SPACE, constraints=bound)
    few = Q[is_feasible(space, Q)][:12]
    ceiling = bound_over_space(space, few, 6)
    best = select_poses(None, 6, q=few, settings=SearchSettings(method="multistart", starts=4), space=space)
    assert best.random_baseline < best.value
    assert 0.9 * ceiling.upper < best.value**2 * 6 <= ceiling.upper
    assert ceiling.climbs == 32 and ceiling.excess < 0.01 and is_feasible(space, ceiling.support).all()
    assert bound_over_space(space, few, 6, climbs=0).upper < best.value**2 * 6  # the candidates' bound does not hold


@pytest.mark.slow
def test_multistart_processes_agree():
    """Multistart on other processes gives the same poses."""
    here = select_poses(None, 5, SearchSettings(method="multistart", starts=3), q=Q, space=SPACE)
    with ProcessPoolExecutor(2) as pool:
        there = select_poses(None, 5, SearchSettings(method="multistart", starts=3), q=Q, space=SPACE, map=pool.map)
    assert (here.q == there.q).all()


def test_interrupted_search_returns_the_best():
    """An interrupted local search returns the best so far."""
    calls = [0]

    def jacobian(q):
        calls[0] += 1
        if calls[0] == 12:
            raise KeyboardInterrupt
        return planar.jacobian(q)

    start = Q[:5]
    run = improved(replace(SPACE, jacobian=jacobian), start)
    assert run.interrupted and run.merit > merit_of(SPACE, start, "O1")[0]


def test_rows_of_other_instrument_count():
    """Existing rows of another instrument count."""
    position = planar.jacobian(Q[50:60])[:, :1]
    chosen = select_poses(None, 3, SearchSettings(method="tabu", rule=QUICK), q=Q, space=SPACE, existing=position)
    assert chosen.q.shape == (3, 3) and chosen.value > chosen.random_baseline


def test_limits_must_be_limits():
    with pytest.raises(BadInput, match="joint 1"):
        SearchSpace(planar.jacobian, np.zeros(3), np.array([1.0, 0.0, 1.0]))
