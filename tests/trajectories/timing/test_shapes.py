"""Tool lines are straight to a micrometre with the posture kept; the outer loop shortens and keeps the waypoints."""

import numpy as np
import pytest
from planned import CHAIN, WAYPOINTS, limits, lwr

from calib.robot.chain import random_joints
from calib.robot.kinematics import forward, tip_jacobian
from calib.robot.library import load
from calib.trajectories.errors import BadInput, NothingFeasible
from calib.trajectories.timing.lines import line
from calib.trajectories.timing.path import extremes, spline
from calib.trajectories.timing.shape import build, count, shorten
from calib.trajectories.timing.time_scaling import time_optimal


def kinematics(chain):
    return (lambda q: forward(chain, q)), (lambda q: tip_jacobian(chain, q))


@pytest.mark.parametrize("chain", [CHAIN, load("ur5")], ids=["redundant", "six joints"])
def test_tool_runs_straight(chain):
    """The tool runs straight and turns about one axis."""
    start = np.array([0.3, 0.8, 0.2, -1.4, 0.3, 0.7, 0.1])[: chain.n]
    goal = forward(chain, start[None])[0].copy()
    goal[:3, 3] += [0.1, -0.15, 0.05]
    goal[:3, :3] = goal[:3, :3] @ forward(chain, start[None] + 0.05)[0, :3, :3].T @ goal[:3, :3]
    found = line(*kinematics(chain), start, goal)
    poses = forward(chain, found.path(np.linspace(0, found.path.length, 333)))
    way = goal[:3, 3] - poses[0, :3, 3]
    off = (poses[:, :3, 3] - poses[0, :3, 3]) @ (np.eye(3) - np.outer(way, way) / (way @ way))
    assert np.linalg.norm(off, axis=1).max() < 2e-6
    np.testing.assert_allclose(poses[-1], goal, atol=1e-8)
    assert found.deviation.max() <= 1e-6
    np.testing.assert_allclose(found.path(np.zeros(1))[0], start, atol=1e-12)


@pytest.mark.slow
def test_redundancy_stays_near_the_start():
    """Of all postures with the tool at the end of the line none near by is nearer to the start."""
    start = WAYPOINTS[0] + 0.2
    goal = forward(CHAIN, start[None])[0].copy()
    goal[:3, 3] += [0.05, 0.1, -0.1]
    end = line(*kinematics(CHAIN), start, goal).path
    q = end(np.array([end.length]))
    J = kinematics(CHAIN)[1](q)[0]
    null = np.linalg.svd(J)[2][-1]
    assert abs(null @ (q[0] - start)) < 1e-8


@pytest.mark.slow
def test_line_out_of_reach_says_where():
    """A line out of reach says where and by how much."""
    goal = forward(CHAIN, WAYPOINTS[:1])[0].copy()
    goal[:3, 3] += [2.0, 0, 0]
    with pytest.raises(NothingFeasible, match=r"at \d+% of it the arm stays .* mm"):
        line(*kinematics(CHAIN), WAYPOINTS[0], goal)
    with pytest.raises(BadInput, match="no length"):
        line(*kinematics(CHAIN), WAYPOINTS[0], forward(CHAIN, WAYPOINTS[:1])[0])


@pytest.mark.slow
def test_a_line_is_timed_like_any_path():
    goal = forward(CHAIN, WAYPOINTS[:1])[0].copy()
    goal[:3, 3] += [0.0, 0.3, -0.1]
    found = time_optimal(line(*kinematics(CHAIN), WAYPOINTS[0], goal).path, limits(), lwr(), rate=1000.0)
    assert min(margin.min() for margin in found.margins.values()) >= 0
    assert found.active_share > 0.95


@pytest.mark.slow
def test_outer_loop_passes_the_waypoints():
    """The outer loop shortens and passes the waypoints."""
    bounds, waypoints = limits(), 0.7 * random_joints(CHAIN, 4, 2)

    def timer(path):
        return time_optimal(path, bounds, lwr(), grid=120).duration

    found = shorten(waypoints, timer, evaluations=60, stray=0.3)
    assert found.after < 0.98 * found.before
    assert timer(found.path) == pytest.approx(found.after)
    np.testing.assert_allclose(found.path(found.path.knots[::2]), waypoints, atol=1e-12)
    assert len(found.phi) == count(waypoints, 0.3) == 2 + 3 * 7
    np.testing.assert_allclose(extremes(build(WAYPOINTS, np.zeros(1)))[1], extremes(spline(WAYPOINTS))[1], atol=1e-12)


def test_untimed_paths_are_stepped_over():
    """Paths without a timing are stepped over."""

    def timer(path):
        if path.length > spline(WAYPOINTS).length:
            raise NothingFeasible("no", "torque", 1.0, "N m")
        return path.length

    found = shorten(WAYPOINTS, timer, evaluations=40)
    assert found.refused > 0 and found.after < found.before
