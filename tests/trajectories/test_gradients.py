"""Every objective, every constraint and their assembly: exact gradients, against differences."""

from dataclasses import replace

import library_arm as arm
import numpy as np
import pytest
from differences import check

from calib.trajectories.constraints import BoxLimit, TorqueLimit, smoothed
from calib.trajectories.design.objectives import (  # fmt: skip
    Duration,
    Excitation,
    FrictionCoverage,
    TorqueSlack,
    condition_numbers,
    information,
)
from calib.trajectories.design.problem import AttainmentGoal, ExcitationProblem, evaluate, exact_values
from calib.trajectories.errors import BadInput, NotExciting
from calib.trajectories.fourier import fourier_family
from calib.trajectories.workspace_limits import Clearance, Workspace

BASE, CHI, CHAIN = arm.lwr(0.3)
LIMITS = np.array([joint.effort for joint in CHAIN.joints])
FAMILY = fourier_family(4, 6.0, 7)
PAST = np.random.default_rng(5).normal(size=(80, 64))
OBJECTIVES = [
    Excitation("cond", "raw"),
    Excitation("cond", "normalised"),
    Excitation("cond", "normalised", sharpness=6.0),
    Excitation("cond", np.linspace(0.5, 2.0, 64), sharpness=10.0),
    Excitation("logdet", "raw", sigmas=np.linspace(0.2, 2.0, 7)),
    Excitation("logdet", "normalised", existing=PAST.T @ PAST),
    Excitation("cond", "normalised", sigmas=np.where(np.arange(7) == 4, np.inf, 1.0), columns=np.arange(3, 40)),
    Excitation("smallest", "raw"),
    Excitation("smallest", "normalised", sharpness=8.0, existing=PAST.T @ PAST),
    Excitation("trace", existing=PAST.T @ PAST),
    Excitation("trace", sigmas=np.linspace(0.2, 2.0, 7), columns=np.arange(3, 40), task=PAST.T[3:40] @ PAST[:, 3:40]),
    TorqueSlack((5, 6), CHI, LIMITS, BASE.torque_gradient),
    FrictionCoverage(np.full(7, 0.2), np.full(7, 1.0), wanted=0.4),
    Duration(),
]


def problem(objective, constraints=(), stretch=(1.0, 1.0)) -> ExcitationProblem:
    return ExcitationProblem(
        FAMILY, BASE.regressor, BASE.regressor_gradient, ((objective, 1.0),), constraints, samples=60, stretch=stretch
    )


def drawn(extra: int = 0, seed: int = 1) -> np.ndarray:
    rng = np.random.default_rng(seed)
    x = FAMILY.random(rng, np.array([0.2, 0.7, -0.3, 1.0, 0.4, -0.8, 0.1]), np.full(7, 0.9))
    return np.concatenate([x, np.full(extra, 1.2)])


def along(f, y: np.ndarray, count: int = 6):
    """Return f on a random subspace through y, and the subspace (p, count): a full difference would take long."""
    directions = np.random.default_rng(2).normal(size=(len(y), count)) / np.sqrt(len(y))
    return (lambda s: f(y + directions @ s)), directions


@pytest.mark.parametrize("objective", OBJECTIVES, ids=lambda o: f"{o.name} {getattr(o, 'sharpness', '')}")
def test_objectives(objective):
    spot = problem(objective, stretch=(0.5, 2.0))
    basis, y = spot.basis(), drawn(1)
    sharp = (getattr(objective, "sharpness", 1.0), 10.0)
    f, directions = along(lambda z: evaluate(spot, basis, z, sharp).total, y)
    slope = evaluate(spot, basis, y, sharp).slopes[0] @ directions
    scale = max(1.0, np.abs(slope).max())
    check(lambda s: f(s) / scale, slope / scale, np.zeros(6), tolerance=2e-6)


def test_several_objectives_and_goals():
    several = OBJECTIVES[0], OBJECTIVES[2], OBJECTIVES[4], OBJECTIVES[5], OBJECTIVES[9], OBJECTIVES[10]
    summed = replace(problem(several[0]), objectives=tuple((one, 0.3 + k) for k, one in enumerate(several)))
    goals = replace(summed, goals=tuple(AttainmentGoal(one, 1.0) for one in several))
    basis, y = summed.basis(), drawn()
    f, directions = along(lambda z: evaluate(summed, basis, z, (8.0, 10.0)).total, y)
    slope = evaluate(summed, basis, y, (8.0, 10.0)).slopes[0] @ directions
    check(lambda s: f(s) / 100.0, slope / 100.0, np.zeros(6), tolerance=2e-6)
    f, directions = along(lambda z: evaluate(goals, basis, z, (8.0, 10.0)).values, y)
    slope = evaluate(goals, basis, y, (8.0, 10.0)).slopes @ directions
    check(lambda s: f(s) / 100.0, slope / 100.0, np.zeros(6), tolerance=2e-6)
    found = evaluate(goals, basis, y, (8.0, 10.0))
    assert found.exact == pytest.approx(exact_values(goals, found.motion, found.regressor), rel=1e-9)


def constraints():
    covariance = np.diag((0.05 * np.abs(CHI) + 0.01) ** 2)
    points, product = arm.tool(CHAIN)
    bounds = np.linspace(1.0, 2.0, 7)
    return [
        BoxLimit(0, -bounds, bounds),
        BoxLimit(1, -bounds, np.where(np.arange(7) == 3, np.inf, bounds)),
        BoxLimit(2, -bounds, bounds),
        BoxLimit(3, -bounds, bounds),
        TorqueLimit(BASE.regressor, BASE.regressor_gradient, CHI, LIMITS, margin=0.1),
        TorqueLimit(BASE.regressor, BASE.regressor_gradient, CHI, LIMITS, torque_product=BASE.torque_gradient),
        TorqueLimit(BASE.regressor, BASE.regressor_gradient, CHI, LIMITS, covariance),
        Workspace(points, product, radius=0.3, lowest=-0.2, highest=0.9),
        Clearance(lambda q: q[:, :2] ** 2 + 1, lambda q: 2 * q[:, :2, None] * np.eye(2, 7), ("a", "b")),
    ]


@pytest.mark.parametrize("constraint", constraints(), ids=lambda c: c.name)
def test_constraints(constraint):
    spot = problem(Duration(), (constraint,), stretch=(0.5, 2.0))
    basis, y, sharp = spot.basis(), drawn(1), (1.0, 20.0)
    f, directions = along(lambda z: evaluate(spot, basis, z, sharp).constraints, y)
    check(f, evaluate(spot, basis, y, sharp).rows @ directions, np.zeros(6), tolerance=1e-6)


def test_extra_times_serve_constraints_only():
    """Extra times count for constraints alone."""
    spot = problem(OBJECTIVES[0], (constraints()[0], constraints()[4]), stretch=(0.5, 2.0))
    closer = replace(spot, extra=np.array([0.37, 1.21, 1.22]), tightening=np.array([0.003, 0.1]))
    y, sharp = drawn(1), (8.0, 20.0)
    one, two = (evaluate(each, each.basis(), y, sharp) for each in (spot, closer))
    assert one.total == pytest.approx(two.total, rel=1e-12) and len(two.motion) == len(one.motion) + 3
    np.testing.assert_allclose(one.slopes, two.slopes, rtol=1e-9, atol=1e-12)
    f, directions = along(lambda z: evaluate(closer, closer.basis(), z, sharp).constraints, y)
    check(f, two.rows @ directions, np.zeros(6), tolerance=1e-6)
    assert (two.constraints[-1] > one.constraints[-1] + 0.09).all()


@pytest.mark.parametrize("constraint", constraints(), ids=lambda c: c.name)
def test_smoothed_constraint_lies_above(constraint):
    """The smoothed constraint lies above the largest value."""
    motion = FAMILY.basis(np.linspace(0, 6, 60, endpoint=False)).motion(drawn())
    largest = (constraint.values(motion) / constraint.scale).max(axis=0)
    for sharpness in (20.0, 400.0):
        _, c, excess, *_ = smoothed(constraint, motion, sharpness)
        groups = [largest[constraint.groups == r].max() for r in range(len(c))]
        assert (c >= np.array(groups) - 1e-12).all()
        assert (c <= np.array(groups) + np.log(120 * len(largest)) / sharpness).all()
        assert excess == pytest.approx(largest.max())


def test_condition_numbers_agree_with_numpy():
    """Condition numbers agree with NumPy, and the smoothed ones bound them."""
    motion = FAMILY.basis(np.linspace(0, 6, 60, endpoint=False)).motion(drawn())
    Y = BASE.regressor(motion.q, motion.v, motion.a)
    W = Y.transpose(1, 0, 2).reshape(-1, 64)
    found = condition_numbers(Y)
    assert found["raw"] == pytest.approx(np.linalg.cond(W), rel=1e-9)
    assert found["normalised"] == pytest.approx(np.linalg.cond(W / np.linalg.norm(W, axis=0)), rel=1e-9)
    for scaling in ("raw", "normalised"):
        assert Excitation("cond", scaling).evaluate(motion, Y).value == pytest.approx(found[scaling], rel=1e-6)
        smooth = Excitation("cond", scaling, sharpness=10.0).evaluate(motion, Y).value
        assert found[scaling] <= smooth <= found[scaling] * 64**0.1
    existing = information(np.concatenate([W, W]))
    stacked = np.concatenate([W, W, W])
    assert condition_numbers(Y, existing=existing)["raw"] == pytest.approx(np.linalg.cond(stacked), rel=1e-6)


def test_slack_is_what_paper_minimises():
    """The slack is what the paper minimises, up to the stated smoothing."""
    motion = FAMILY.basis(np.linspace(0, 6, 60, endpoint=False)).motion(drawn())
    Y = BASE.regressor(motion.q, motion.v, motion.a)
    exact = np.mean(1 - np.abs((Y @ CHI)[:, 5:]) / LIMITS[5:])
    slack = TorqueSlack((5, 6), CHI, LIMITS, BASE.torque_gradient).evaluate(motion, Y).value
    assert exact <= slack <= exact + 1e-3


def test_coverage_is_zero_where_visited():
    """Coverage is zero where every range is visited enough."""
    coverage = FrictionCoverage(np.array([0.4]), np.array([0.8]), wanted=0.1)
    motion = fourier_family(1, 6.0, 1, rest=False).basis(np.linspace(0, 6, 600, endpoint=False))
    fast = motion.motion(np.array([0.0, 1.0, 0.0]) * 6 / 2 / np.pi)
    slow = motion.motion(np.array([0.0, 0.3, 0.0]) * 6 / 2 / np.pi)
    assert coverage.evaluate(fast, np.zeros(0)).value == 0.0
    assert (coverage.shares(fast) > 0.1).all()
    assert coverage.evaluate(slow, np.zeros(0)).value > 0.3  # never fast: half of the four ranges empty


@pytest.mark.parametrize(
    ("make", "error", "words"),
    [
        (lambda: BoxLimit(0, np.array([1.0]), np.array([0.0])), BadInput, "lower 1 is not below upper 0"),
        (lambda: BoxLimit(1, np.array([0.1]), np.array([0.5])), BadInput, "include zero"),
        (lambda: TorqueLimit(BASE.regressor, BASE.regressor_gradient, CHI * np.nan, LIMITS), BadInput, "not finite"),
        (lambda: TorqueLimit(BASE.regressor, BASE.regressor_gradient, CHI, 0 * LIMITS), BadInput, "above zero"),
        (lambda: Excitation("det"), BadInput, "not one of cond"),  # type: ignore[arg-type]
        (lambda: Excitation().of_information(np.diag([1.0, 0.0])), NotExciting, "column 1"),
    ],
)
def test_refusals(make, error, words):
    with pytest.raises(error, match=words):
        make()
