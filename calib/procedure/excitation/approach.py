"""The way from where a robot stands to where a motion starts: calm, jerk-limited, and held against the limits file."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from calib.errors import UsageError
from calib.procedure.excitation.limits import MotionLimits
from calib.robot.chain import Chain
from trajectories.approach import straight_approach
from trajectories.basis import SampledMotion
from trajectories.constraints import BoxLimit, MotionConstraint
from trajectories.places import Clearance
from trajectories.setpoints import Setpoints

ACCELERATION, JERK = 2.0, 20.0  # of an approach, per s and s² times the velocity limit, where nothing else is said
LEISURE = 1.0  # [rad/s or m/s] an approach is no faster than this (our choice)


def approach_to(
    start: Sequence[float], goal: np.ndarray, rate: float, known: MotionLimits, chain: Chain
) -> tuple[Setpoints, tuple[str, ...]]:
    """Return the way from a pose to the start of a motion, a straight line in joint space, and what a user should know.

    Velocity, acceleration and jerk come from the limits file, else from the robot and our own choice.

    Args:
        start: (n,) where the robot stands [rad or m]; goal: (n,).

    Raises:
        UsageError: for a start beyond the joint limits, or a way too near to something.
    """
    here = np.asarray(start, dtype=float)
    boxes = {one.order: one for one in known.constraints if isinstance(one, BoxLimit)}
    check_start(here, chain, known)
    sizes = {order: box.upper for order, box in boxes.items()}
    free = np.full(chain.n, np.inf)
    velocity = np.minimum(sizes.get(1, free), LEISURE)
    acceleration, jerk = (
        np.where(np.isfinite(sizes.get(order, free)), sizes.get(order, free), factor * velocity)
        for order, factor in ((2, ACCELERATION), (3, JERK))
    )
    found = straight_approach(here, goal, velocity, acceleration, jerk, rate)
    notes = [_place(one, found) for one in known.constraints if not isinstance(one, BoxLimit)]
    return found, tuple(note for note in notes if note)


def check_start(start: np.ndarray, chain: Chain, known: MotionLimits) -> None:
    """Refuse a pose (n,) that the robot cannot be in."""
    limits = known.positions
    if start.shape != (chain.n,):
        raise UsageError(f"--start: expected {chain.n} joint values, found {start.size}")
    for name, value, lower, upper in zip(chain.joint_names, start, limits.lower, limits.upper):
        if not lower <= value <= upper:
            raise UsageError(f"--start: {name} at {value:g} is beyond its limits {lower:.4g} to {upper:.4g}")


def _place(limit: MotionConstraint, track: Setpoints) -> str:
    """Return a note where an approach leaves the workspace, which a robot may; refuse one that comes too near."""
    rows = np.unique(np.linspace(0, len(track) - 1, 500).astype(int))
    parts = (track.times, track.q, track.v, track.a, np.zeros(track.q.shape))
    values = limit.values(SampledMotion(*(x[rows] for x in parts)))
    if values.max() <= 0:
        return ""
    k, column = (int(i) for i in np.unravel_index(np.argmax(values), values.shape))
    words = (
        f"on the straight way from --start, {limit.name} ({limit.labels[column]}) is broken by "
        f"{values[k, column]:.3g} {limit.unit} at t = {track.times[rows[k]]:.3g} s"
    )
    if isinstance(limit, Clearance):
        raise UsageError(f"{words}: move the robot to another pose before, or reach the start of the motion by hand")
    return f"{words}: watch the approach, or start from another pose"
