"""Motions one would take without designing any: rest-to-rest moves, and a spline, through random waypoints."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.interpolate import CubicSpline

from calib.toolkit.chains import Chain, forward
from calib.toolkit.simulations import Reference

# of the limits of position, velocity and torque
SHARE = 0.9
# instants s of a move at which the workspace and the torque limits are checked
CHECKED = np.linspace(0.0, 1.0, 60)
# samples of a spline from one check of the workspace and the torque limits to the next
CHECK_STEP = 20
# posture well inside the workspace
ELBOW = np.deg2rad([0.0, 60.0, 0.0, -60.0, 0.0, 0.0, 0.0])
# least distance of the tool from axis 1, and least height [m]
MIN_DISTANCE, MIN_HEIGHT = 0.3, -0.2
# factor by which a motion is made slower or smaller until it keeps the limits, and the number of trials
SLOWER, SMALLER, TRIALS = 1.02, 0.98, 200
Torque = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]


def trapezoidal(s: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return position, speed and acceleration over s = 0 … 1 of a trapezoidal profile in three equal parts."""
    starting = s < 1 / 3
    steady = ~starting & (s < 2 / 3)
    position = np.select([starting, steady], [2.25 * s**2, 1.5 * s - 0.25], 1 - 2.25 * (1 - s) ** 2)
    speed = np.minimum(1.5, np.minimum(4.5 * s, 4.5 * (1 - s)))
    acceleration = np.select([starting, steady], [4.5, 0.0], -4.5)
    return position, speed, acceleration


def moves(chain: Chain, torque: Torque, speed: float, seed: int, rate: float, seconds: float) -> Reference:
    """Return trapezoidal moves, straight in joint space, through random waypoints of the workspace.

    Every move is first as fast as 0.9 of the limits of velocity and torque allow, and then takes 0.9 / speed times as
    long: so `speed` is the share of the limits, the waypoints are the same for every share, and a log of given length
    holds fewer of them.

    Args:
        chain: the arm with its limits.
        torque: (q, v, a), each (N, n), to the torques' moduli (N, n) [N m or N].
        speed: share of the limits.
        seed: seed of the waypoints.
        rate: sampling rate [Hz].
        seconds: duration of all moves together [s].
    """
    rng = np.random.default_rng(seed)
    waypoints = [_random_pose(chain, rng)]
    durations: list[float] = []
    while sum(durations) < seconds:
        start = waypoints[-1]
        goal = _random_pose(chain, rng)
        if _in_workspace(chain, start + CHECKED[:, None] * (goal - start)):
            durations.append(SHARE / speed * _shortest_duration(chain, torque, start, goal))
            waypoints.append(goal)
    q = np.array(waypoints)
    ends = np.concatenate([[0.0], np.cumsum(durations)])
    t = np.arange(0.0, seconds, 1.0 / rate)
    # move of each sample
    k = np.searchsorted(ends, t, side="right") - 1
    duration = np.array(durations)[k][:, None]
    step = np.diff(q, axis=0)[k]
    s = (t - ends[k])[:, None] / duration
    return _straight_move(t, q[k], step, s, duration)


def _straight_move(
    t: np.ndarray, start: np.ndarray, step: np.ndarray, s: np.ndarray, duration: np.ndarray | float
) -> Reference:
    """Return samples of straight moves in joint space.

    Args:
        t: (N,) times [s].
        start: (N, n) or (n,) joint values at the start of the sample's move.
        step: (N, n) or (n,) joint values at its end minus those at its start.
        s: (N, 1) share of the move's duration.
        duration: (N, 1) or one number [s].
    """
    position, speed, acceleration = trapezoidal(s)
    q = start + step * position
    v = step * speed / duration
    a = step * acceleration / duration**2
    return Reference(t, q, v, a)


def waypoint_spline(
    chain: Chain, torque: Torque, seed: int, rate: float, period: float, count: int = 20
) -> tuple[Reference, float]:
    """Return one period of a closed cubic spline through random waypoints, evenly in time, at rest at both ends.

    The waypoints are drawn about an elbow posture and drawn towards it until 0.9 of the limits and the workspace hold.

    Args:
        chain: the arm with its limits.
        torque: (q, v, a), each (N, n), to the torques' moduli (N, n) [N m or N].
        seed: seed of the waypoints.
        rate: sampling rate [Hz].
        period: duration [s].
        count: number of waypoints.

    Returns:
        The motion, and the share of the joints' ranges that its waypoints are spread over.
    """
    rng = np.random.default_rng(seed)
    deviations = SHARE * rng.uniform(chain.lower - ELBOW, chain.upper - ELBOW, (count, chain.n))
    closed = np.vstack([deviations, deviations[:1]])
    knots = np.linspace(0.0, period, count + 1)
    t = np.arange(0.0, period, 1.0 / rate)
    for share in SMALLER ** np.arange(TRIALS):
        curve = CubicSpline(knots, ELBOW + share * closed, bc_type="clamped")
        motion = Reference(t, curve(t), curve(t, 1), curve(t, 2))
        if _keeps_limits(chain, torque, motion):
            return motion, float(share)
    raise RuntimeError("no spline about the elbow posture keeps the limits")


def _keeps_limits(chain: Chain, torque: Torque, motion: Reference) -> bool:
    """Return whether a motion keeps `SHARE` of the limits of position, velocity and torque, and the workspace."""
    velocity, effort = _limits(chain)
    if (motion.q < SHARE * chain.lower).any() or (motion.q > SHARE * chain.upper).any():
        return False
    if (np.abs(motion.v) > velocity).any():
        return False
    part = slice(None, None, CHECK_STEP)
    if not _in_workspace(chain, motion.q[part]):
        return False
    return bool((torque(motion.q[part], motion.v[part], motion.a[part]) <= effort).all())


def _limits(chain: Chain) -> tuple[np.ndarray, np.ndarray]:
    """Return `SHARE` of the velocity limits (n,) and of the torque limits (n,)."""
    velocity = np.array([joint.velocity for joint in chain.joints])
    effort = np.array([joint.effort for joint in chain.joints])
    return SHARE * velocity, SHARE * effort


def _random_pose(chain: Chain, rng: np.random.Generator) -> np.ndarray:
    while True:
        q = rng.uniform(SHARE * chain.lower, SHARE * chain.upper)
        if _in_workspace(chain, q[None]):
            return q


def _in_workspace(chain: Chain, q: np.ndarray) -> bool:
    """Return whether the tool stays away from axis 1 and above its least height at all poses (m, n)."""
    x, y, z = forward(chain, q)[:, :3, 3].T
    return bool((np.hypot(x, y) >= MIN_DISTANCE).all() and (z >= MIN_HEIGHT).all())


def _shortest_duration(chain: Chain, torque: Torque, start: np.ndarray, goal: np.ndarray) -> float:
    """Return the shortest duration [s] of a move, to 2 %."""
    velocity, effort = _limits(chain)
    step = goal - start
    duration = float((1.5 * np.abs(step) / velocity).max())
    while True:
        move = _straight_move(CHECKED * duration, start, step, CHECKED[:, None], duration)
        if (torque(move.q, move.v, move.a) <= effort).all():
            return duration
        duration *= SLOWER
