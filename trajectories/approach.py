"""A smooth approach from any pose to the start of a motion, within velocity, acceleration and jerk limits.

Ruckig (Berscheid & Kröger 2021, an open relative of the Reflexxes library that Kolyubin, Shiriaev, Jubien 2019 used)
computes the fastest jerk-limited motion. All joints move in proportion, so the approach is a straight line in joint
space between its two ends. Ruckig is imported at the first call.
"""

import math
from typing import Any

import numpy as np

from .errors import BadInput, require
from .setpoints import Setpoints

KINDS: tuple[str, ...] = ("velocity", "acceleration", "jerk")


def straight_approach(
    start: np.ndarray, goal: np.ndarray, velocity: np.ndarray, acceleration: np.ndarray, jerk: np.ndarray, rate: float
) -> Setpoints:
    """Return the setpoints of the fastest straight approach from rest at `start` to rest at `goal`.

    The duration is rounded up to whole samples.

    Args:
        start, goal: (n,) joint values [rad or m].
        velocity, acceleration, jerk: (n,) largest absolute values [rad or m, per s, s², s³], finite and above zero.
        rate: sampling rate of the controller [Hz].

    Raises:
        BadInput: invalid poses, limits or rate (the message names the joint), or Ruckig found no approach.
    """
    start = np.asarray(start, dtype=float)
    goal = np.asarray(goal, dtype=float)
    bounds: dict[str, np.ndarray] = {}
    for kind, values in zip(KINDS, (velocity, acceleration, jerk)):
        bounds[kind] = np.asarray(values, dtype=float)
    _check(start, goal, bounds, rate)
    if np.array_equal(start, goal):
        still = np.zeros((1, len(start)))
        first_row = start[None, :].copy()
        return Setpoints(rate, first_row, still, still.copy())
    approach = _trajectory(start, goal, bounds)
    count = max(math.ceil(approach.duration * rate - 1e-9), 1)
    stretch = count / rate / approach.duration
    rows = []
    for t in np.arange(count + 1) / rate / stretch:
        row = approach.at_time(min(t, approach.duration))
        rows.append(row)
    q = np.array([row[0] for row in rows])
    v = np.array([row[1] for row in rows])
    a = np.array([row[2] for row in rows])
    q[[0, -1]] = (start, goal)
    v[[0, -1]] = 0.0
    return Setpoints(rate, q, v / stretch, a / stretch**2)


def _trajectory(start: np.ndarray, goal: np.ndarray, bounds: dict[str, np.ndarray]) -> Any:
    import ruckig

    request = ruckig.InputParameter(len(start))
    request.current_position = start.tolist()
    request.target_position = goal.tolist()
    request.max_velocity = bounds["velocity"].tolist()
    request.max_acceleration = bounds["acceleration"].tolist()
    request.max_jerk = bounds["jerk"].tolist()
    request.synchronization = ruckig.Synchronization.Phase
    result = ruckig.Trajectory(len(start))
    result_code = ruckig.Ruckig(len(start)).calculate(request, result)
    if result_code not in (ruckig.Result.Working, ruckig.Result.Finished):
        raise BadInput(f"no approach was found ({result_code}): check for tiny or huge limits")
    return result


def _check(start: np.ndarray, goal: np.ndarray, bounds: dict[str, np.ndarray], rate: float) -> None:
    if start.ndim != 1 or start.shape != goal.shape:
        raise BadInput(
            f"approach: start and goal need one value per joint, found shapes {start.shape} and {goal.shape}"
        )
    for name, values in (("start", start), ("goal", goal)):
        if not np.isfinite(values).all():
            raise BadInput(f"approach: joint {int(np.argmin(np.isfinite(values))) + 1} of the {name} is not a number")
    for kind, values in bounds.items():
        if values.shape != start.shape or not (np.isfinite(values) & (values > 0)).all():
            raise BadInput(f"approach: {kind} limits must be finite and above zero, one per joint; found {values}")
    require(np.isfinite(rate) and rate > 0, f"rate {rate:g} Hz: expected a number above zero")
