"""Motions one would take without designing any: rest-to-rest moves, and a spline, through random waypoints."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.interpolate import CubicSpline

from calib.toolkit.chains import Chain, forward
from calib.toolkit.simulations import Reference

SHARE = 0.9  # of the limits of position, velocity and torque
INSIDE = np.linspace(0.0, 1.0, 60)
ELBOW = np.deg2rad([0.0, 60.0, 0.0, -60.0, 0.0, 0.0, 0.0])  # well inside the workspace
Torque = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]


def trapezoidal(s: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return position, speed and acceleration over s = 0 … 1 of a trapezoidal profile in three equal parts."""
    place = np.where(s < 1 / 3, 2.25 * s**2, np.where(s < 2 / 3, 1.5 * s - 0.25, 1 - 2.25 * (1 - s) ** 2))
    bend = np.where(s < 1 / 3, 4.5, np.where(s < 2 / 3, 0.0, -4.5))
    return place, np.minimum(1.5, np.minimum(4.5 * s, 4.5 * (1 - s))), bend


def moves(chain: Chain, torque: Torque, speed: float, seed: int, rate: float, seconds: float) -> Reference:
    """Return trapezoidal moves, straight in joint space, through random waypoints of the workspace.

    Every move is first as fast as 0.9 of the limits of velocity and torque allow, and then takes 0.9 / speed times as
    long: so `speed` is the share of the limits, the waypoints are the same for every share, and a log of given length
    holds fewer of them.

    Args:
        torque: (q, v, a), each (N, n), to the torques' moduli (N, n).
        rate, seconds: of the samples [Hz], and of the whole [s].
    """
    rng = np.random.default_rng(seed)
    points, times = [_pose(chain, rng)], list[float]()
    while sum(times) < seconds:
        goal = _pose(chain, rng)
        if _clear(chain, points[-1] + INSIDE[:, None] * (goal - points[-1])):
            times.append(SHARE / speed * _fastest(chain, torque, points[-1], goal))
            points.append(goal)
    ends, q = np.concatenate([[0.0], np.cumsum(times)]), np.array(points)
    t = np.arange(0.0, seconds, 1.0 / rate)
    k = np.searchsorted(ends, t, side="right") - 1
    width, step = np.array(times)[k][:, None], np.diff(q, axis=0)[k]
    place, pace, bend = trapezoidal(((t - ends[k]) / width[:, 0])[:, None])
    return Reference(t, q[k] + step * place, step * pace / width, step * bend / width**2)


def waypoint_spline(
    chain: Chain, torque: Torque, seed: int, rate: float, period: float, count: int = 20
) -> tuple[Reference, float]:
    """Return one period of a closed cubic spline through random waypoints, evenly in time, at rest at both ends.

    The waypoints are drawn about an elbow posture and drawn towards it until 0.9 of the limits and the workspace hold.

    Returns:
        The motion, and the share of the joints' ranges that its waypoints are spread over.
    """
    rng = np.random.default_rng(seed)
    spread = SHARE * rng.uniform(chain.lower - ELBOW, chain.upper - ELBOW, (count, chain.n))
    knots, t = np.linspace(0.0, period, count + 1), np.arange(0.0, period, 1.0 / rate)
    velocity, effort = _limits(chain)
    for share in 0.98 ** np.arange(200):
        curve = CubicSpline(knots, ELBOW + share * np.vstack([spread, spread[:1]]), bc_type="clamped")
        q, v, a = (curve(t, order) for order in range(3))
        few = slice(None, None, 20)
        inside = ((q >= SHARE * chain.lower) & (q <= SHARE * chain.upper)).all() and (np.abs(v) <= velocity).all()
        if inside and _clear(chain, q[few]) and (torque(q[few], v[few], a[few]) <= effort).all():
            return Reference(t, q, v, a), float(share)
    raise RuntimeError("no spline about the elbow posture keeps the limits")


def _limits(chain: Chain) -> tuple[np.ndarray, np.ndarray]:
    return tuple(SHARE * np.array([getattr(joint, key) for joint in chain.joints]) for key in ("velocity", "effort"))  # type: ignore[return-value]


def _pose(chain: Chain, rng: np.random.Generator) -> np.ndarray:
    while True:
        q = rng.uniform(SHARE * chain.lower, SHARE * chain.upper)
        if _clear(chain, q[None]):
            return q


def _clear(chain: Chain, q: np.ndarray) -> bool:
    """Return whether the tool stays 0.3 m from axis 1 and above -0.2 m."""
    place = forward(chain, q)[:, :3, 3]
    return bool((np.hypot(place[:, 0], place[:, 1]) >= 0.3).all() and (place[:, 2] >= -0.2).all())


def _fastest(chain: Chain, torque: Torque, start: np.ndarray, goal: np.ndarray) -> float:
    """Return the shortest duration [s] of a move, to 2 %."""
    velocity, effort = _limits(chain)
    place, pace, bend = trapezoidal(INSIDE[:, None])
    step, width = goal - start, float((1.5 * np.abs(goal - start) / velocity).max())
    while (torque(start + step * place, step * pace / width, step * bend / width**2) > effort).any():
        width *= 1.02
    return width
