"""Inverse kinematics of deflected arms: what it promises, robot by robot."""

from dataclasses import replace

import numpy as np
import pytest
from differences import check

from calib.geometry import inverse
from calib.geometry.inverse import Goal
from calib.robot.kinematics import gravity_torques
from calib.robot.library import load
from calib.simulation.virtual_cells import lwr4plus_cell, perturbed_cell, rigid

ROBOTS = ("ur5", "lwr4plus", "tx40", "rv2sq", "panda")


def arm(robot: str, dof: int = 6) -> Goal:
    """Return a made-up real arm of the library with hidden deflections, stiffness included where masses are known."""
    cell = lwr4plus_cell() if robot == "lwr4plus" else perturbed_cell(load(robot), 3, hidden=1.0)
    chain = cell.truth.chain
    known = cell.nominal.inertias is not None
    torques = (lambda q: gravity_torques(cell.nominal, q)) if known else (lambda q: np.zeros_like(q))
    return Goal(cell.truth, dof, chain.lower, chain.upper, torques)


def joints(goal: Goal, count: int, seed: int, share: float = 0.8) -> np.ndarray:
    """Draw joints in the middle of the limits, clear of singularities."""
    lower, upper = goal.cell.chain.sampling_limits()
    middle, half = 0.5 * (lower + upper), 0.5 * share * (upper - lower)
    q = np.random.default_rng(seed).uniform(middle - half, middle + half, (4 * count, len(middle)))
    return q[inverse.conditions(goal, q) > 0.05][:count]


@pytest.mark.parametrize("robot", ROBOTS)
def test_poses_of_deflected_arm_are_found(robot):
    """Poses of the deflected arm are found again."""
    goal = arm(robot)
    q = joints(goal, 200, 1)
    targets = inverse.seen_at(goal, q).poses()
    start = q + np.random.default_rng(2).normal(0.0, 0.01, q.shape)
    found = inverse.reach(goal, targets, start)
    assert len(q) == 200
    assert np.abs(inverse.differences(goal, found, targets)).max() < 1e-9
    if q.shape[1] == 6:
        assert np.abs(found - q).max() < 1e-6


@pytest.mark.parametrize("dof", [6, 5, 3])
def test_jacobian_is_slope_of_differences(dof):
    """Of a rigid arm exactly: what it leaves out are the deflections' own slopes."""
    goal = replace(arm("panda", dof), cell=rigid(lwr4plus_cell()).truth)
    q = joints(goal, 5, 4)
    targets = inverse.seen_at(goal, q).poses()
    for one, target, claimed in zip(q, targets, inverse.differences_jacobian(goal, inverse.seen_at(goal, q))):
        check(lambda x, target=target: -inverse.differences(goal, x[None], target[None])[0], claimed, one)


def test_turned_tool_meets_a_free_turn():
    """A turned tool meets a target that leaves the turn free."""
    goal = arm("ur5", 5)
    q = joints(goal, 50, 5)
    targets = inverse.seen_at(goal, q).poses()
    turned = targets @ np.diag([-1.0, -1.0, 1.0, 1.0])  # half a turn about its own z
    assert np.abs(inverse.differences(goal, q, turned)).max() < 1e-9
    start = q + 0.01
    found = inverse.reach(goal, turned, start)
    assert np.abs(inverse.differences(goal, found, turned)).max() < 1e-9
    assert np.abs(found - start).max() < 0.2  # the half turn was not made


@pytest.mark.parametrize(("robot", "dof"), [("lwr4plus", 6), ("ur5", 3), ("ur5", 5)])
def test_redundant_joints_stay_near_start(robot, dof):
    """First-order optimality: what is left of q - q_start lies in the rows of the Jacobian."""
    goal = arm(robot, dof)
    q = joints(goal, 50, 6, 0.6)
    targets = inverse.seen_at(goal, q).poses()
    start = q + np.random.default_rng(7).normal(0.0, 0.02, q.shape)
    found = inverse.nearest(goal, targets, start, inverse.reach(goal, targets, start))
    assert np.abs(inverse.differences(goal, found, targets)).max() < 1e-8
    away = found - start
    for jacobian, change in zip(inverse.differences_jacobian(goal, inverse.seen_at(goal, found)), away):
        across = change - np.linalg.pinv(jacobian) @ (jacobian @ change)
        assert np.linalg.norm(across) < 0.02 * np.linalg.norm(change)


def test_joint_at_limit_is_held():
    """A joint at its limit is held, and the others do what they can."""
    goal = arm("lwr4plus")
    q = joints(goal, 40, 8)
    targets = inverse.seen_at(goal, q).poses()
    few = np.flatnonzero(q[:, 3] > np.quantile(q[:, 3], 0.5))
    limit = np.array(goal.upper, dtype=float)
    limit[3] = np.quantile(q[:, 3], 0.5)
    held = replace(goal, upper=limit)
    found = inverse.reach(held, targets, q)
    assert (found <= limit).all() and (found >= goal.lower).all()
    left = np.linalg.norm(inverse.differences(held, found, targets)[:, :3], axis=1)
    before = np.linalg.norm(inverse.differences(held, np.minimum(q, limit), targets)[:, :3], axis=1)
    assert (left[few] < before[few]).all()
    assert np.delete(left, few).max() < 1e-9


def test_no_joint_runs_away_near_singularity():
    """Near a singularity no joint runs away."""
    goal = arm("ur5")
    q = joints(goal, 30, 9)
    q[:, 4] = 1e-4  # wrist: axes 4 and 6 parallel
    targets = inverse.seen_at(goal, q).poses()
    tilt = np.eye(4)
    tilt[:3, :3] += 2e-3 * np.array([[0, 0, 1], [0, 0, 0], [-1, 0, 0]])
    wanted = targets @ tilt
    free = inverse.reach(goal, wanted, q)
    held = inverse.held_back(goal, wanted, q, 0.2)
    assert np.abs(free - q).max() > 0.5
    assert np.abs(held - q).max() <= 0.2
    left = inverse.differences(goal, held, wanted)
    assert np.linalg.norm(left[:, :3], axis=1).max() < 1e-3 and np.linalg.norm(left[:, 3:], axis=1).max() < 3e-3
