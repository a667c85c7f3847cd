"""Claims of the filters: Kalman's own on a linear system, six that agree, sigma that covers, failures with names."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
import small_arm

from calib.dynamics.torque_rows import POWER
from calib.errors import Diverged, UsageError
from calib.identification.methods.method import EstimateStatus
from calib.identification.registry import METHODS
from calib.identification.survey.kalman import Belief, Filter, believe, corrected, linearly_predicted, points, predicted

KINDS = [Filter(rule, root) for rule, root in product(("ekf", "ukf", "cdkf"), (False, True))]
NAMES = [("sr" if one.root else "") + one.rule for one in KINDS]


@pytest.mark.parametrize("kind", KINDS, ids=NAMES)
def test_linear_system_gives_kalman_filter(kind):
    """Mean and covariance of three steps against the textbook's recursion."""
    rng = np.random.default_rng(0)
    slopes, noise = np.eye(4) + 0.2 * rng.normal(size=(4, 4)), 0.1 * rng.normal(size=(4, 2))
    belief, std = believe(rng.normal(size=4), np.array([1.0, 0.5, 2.0, 0.3]), kind), np.array([0.2, 0.4])
    mean, spread = belief.mean, belief.covariance
    for seen in rng.normal(size=(3, 2)):
        mean, spread = slopes @ mean, slopes @ spread @ slopes.T + noise @ noise.T
        gain = spread[:, :2] @ np.linalg.inv(spread[:2, :2] + np.diag(std**2))
        mean, spread = mean + gain @ (seen - mean[:2]), spread - gain @ spread[:2]
        if kind.rule == "ekf":
            belief = linearly_predicted(belief, slopes @ belief.mean, slopes, noise, kind)
        else:
            belief = predicted(points(belief, kind) @ slopes.T, noise, kind)
        belief, size = corrected(belief, seen, 2, std)
        assert size > 0.0
        assert np.allclose(belief.mean, mean, atol=1e-9) and np.allclose(belief.covariance, spread, atol=1e-9)


@pytest.mark.parametrize("rule", ["ukf", "cdkf"])
def test_sigma_points_know_of_curvature(rule):
    """The mean of x² is σ² + m²; a linearised filter says m²."""
    kind = Filter(rule, True)
    spread = points(believe(np.array([1.0, 0.0]), np.array([0.5, 1.0]), kind), kind)
    after = predicted(np.column_stack([spread[:, 0] ** 2, spread[:, 1]]), np.zeros((2, 1)), kind)
    assert after.mean[0] == pytest.approx(1.25) and after.covariance[0, 0] == pytest.approx(
        4 * 0.25 + 2 * 0.5**4, rel=0.02
    )


def test_a_covariance_that_is_none_is_told():
    with pytest.raises(Diverged, match="positive definite"):
        _ = Belief(np.zeros(2), np.diag([1.0, -1.0]), False).deviations


@pytest.mark.slow
def test_six_filters_agree_within_sigma():
    """Six filters make one estimate, whose sigma covers its error."""
    away, others = [], []
    for seed in range(3):
        problem = small_arm.problem(seed, 0.0, 0.1, rate=2000.0)
        found = [METHODS[name].estimate(problem) for name in (NAMES if seed == 0 else ["srekf"])]
        assert all(one.found and one.simulations == 1 for one in found)
        first = found[0].estimate
        away.append((found[-1].estimate.values - small_arm.truth()) / found[-1].estimate.sigma)
        others += [np.abs(one.estimate.values - first.values).max() / first.sigma.max() for one in found[1:]]
        others += [np.abs(one.estimate.sigma / first.sigma - 1.0).max() for one in found[1:]]
    assert max(others) < 0.1
    assert 0.5 < np.sqrt(np.mean(np.square(away))) < 1.6


@pytest.mark.slow
def test_filter_recovers_from_a_wrong_start():
    """A filter recovers from a start that is off."""
    problem = small_arm.problem(0, 0.0, 0.1, rate=2000.0)
    plain = METHODS["srukf"].estimate(problem)
    off = METHODS["srukf"].estimate(replace(problem, start=1.15 * small_arm.truth()))
    assert np.abs((off.estimate.values - plain.estimate.values) / plain.estimate.sigma).max() < 1.0


@pytest.mark.slow
def test_unfollowable_motion_is_a_status():
    """What a filter cannot follow is a status."""
    problem = small_arm.problem(0)
    found = METHODS["ukf"].estimate(replace(problem, start=-small_arm.truth()))
    assert found.status in (EstimateStatus.CANNOT_BE_SIMULATED, EstimateStatus.DIVERGED) and found.failure is not None
    exact = tuple(replace(one, settings=(0.0,)) if one.shape == "sign" else one for one in problem.model.terms)
    found = METHODS["ekf"].estimate(replace(problem, model=replace(problem.model, terms=exact)))
    assert found.status is EstimateStatus.CANNOT_BE_SIMULATED and "without smoothing" in str(found.failure)


def test_a_filter_wants_motor_torques():
    problem = small_arm.problem(0)
    with pytest.raises(UsageError, match="motor torques"):
        METHODS["ekf"].estimate(replace(problem, model=replace(problem.model, torque_rows=POWER)))
