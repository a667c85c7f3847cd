"""The waypoints of a planned motion: joint values, or places of the tool by inverse kinematics.

A CSV, a row per waypoint, in order: the robot's joints, or the tip's place ``x y z`` in the robot's base frame, with
its orientation ``qx qy qz qw`` (or ``r11`` to ``r33``); without one only the position counts. Units stand in brackets,
plain headers are SI. With both, the place is met and the joints say in which configuration; without joints each is
reached from the configuration before it, the first one from --start, or near the middle of the joint limits.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from calib.data.csv_table import read_header
from calib.data.poses.pose_lists import Targets, read_poses, read_targets
from calib.errors import UsageError
from calib.geometry import inverse
from calib.geometry.installation import Installation
from calib.geometry.inverse import Goal
from calib.robot.chain import Chain, joint_kinds
from calib.transforms import pose

MAX_TRIES = 40  # random configurations from which a waypoint is sought (our choice)
MAX_ERROR = 1e-6  # [m and rad] that may be left


def read_waypoints(
    given: Path | Targets | np.ndarray,
    chain: Chain,
    lower: np.ndarray,
    upper: np.ndarray,
    start: Sequence[float] | None = None,
) -> np.ndarray:
    """Return waypoints (m, n) [rad or m].

    Args:
        given: the file; or in memory joint values (m, n) [rad or m], poses (m, 4, 4) [m], or targets.
        chain: whose tip stands at the places, the best geometry there is.
        lower, upper: (n,) joint limits to stay within.
        start: (n,) where the robot stands: the first place is reached near it; else near the middle of the limits.

    Raises:
        UsageError: for a place out of reach: which one, and how far.
    """
    if not isinstance(given, Path):
        targets = Targets.of(given)
    elif {"x", "x_target"} & set(read_header(given)[0]):
        targets = read_targets(given, chain.joint_names, kinds=joint_kinds(chain))
    else:
        targets = Targets.of(read_poses(given, chain.joint_names, kinds=joint_kinds(chain)))
    if targets.position is None and targets.q is not None:
        return read_poses(targets.q, chain.joint_names)
    goal = Goal(Installation(chain), 3 if targets.rotation is None else 6, lower, upper)
    wanted = pose(targets.rotation, targets.position)
    low, high = (np.where(np.isfinite(x), x, s * np.pi) for x, s in ((lower, -1.0), (upper, 1.0)))
    here = np.asarray(start, dtype=float) if start is not None else (low + high) / 2
    others = np.random.default_rng(0).uniform(low, high, (MAX_TRIES, chain.n))
    found = []
    for k in range(len(targets)):
        near = here if targets.q is None else np.array(targets.q[k])
        here = _reached(goal, wanted[k : k + 1], near, others, targets, k)
        found.append(here)
    return np.array(found)


def _reached(
    goal: Goal, target: np.ndarray, near: np.ndarray, others: np.ndarray, targets: Targets, k: int
) -> np.ndarray:
    """Return joint values (n,) at a target (1, 4, 4): from where the arm is, else of many tries the nearest to it."""
    q = inverse.nearest(goal, target, near[None], inverse.reach(goal, target, near[None]))
    left = inverse.differences(goal, q, target)
    if np.abs(left).max() <= MAX_ERROR:
        return q[0]
    many = np.repeat(target, len(others), axis=0)
    tried = inverse.reach(goal, many, others)
    left = inverse.differences(goal, tried, many)
    met = np.abs(left).max(axis=1) <= MAX_ERROR
    if not met.any():
        best = left[np.argmin(np.linalg.norm(left, axis=1))]
        turn = f" and {np.degrees(np.linalg.norm(best[3:])):.3g} deg" if goal.dof == 6 else ""
        raise UsageError(
            f"{targets.file}: waypoint {k + 1} is out of reach: of {len(others)} tries the nearest stays "
            f"{1e3 * np.linalg.norm(best[:3]):.3g} mm{turn} short within the joint limits; are x y z those of the tip "
            "in the robot's base frame, in metres?"
        )
    distance = np.where(met, np.abs(tried - near).max(axis=1), np.inf)
    chosen = tried[np.argmin(distance)][None]
    return inverse.nearest(goal, target, near[None], chosen)[0]
