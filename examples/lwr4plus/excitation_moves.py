"""Baselines of the excitation study: rest-to-rest moves between random poses, at the limits that the designs keep."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from calib.robot.chain import Chain
from calib.robot.kinematics import forward
from trajectories.basis import SampledMotion

SHARE = 0.9  # of the limits of position, velocity and torque
INSIDE = np.linspace(0.0, 1.0, 60)


def minimum_jerk(s: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return place, speed and bend over s = 0 … 1; the speed peaks at 1.875."""
    return 10 * s**3 - 15 * s**4 + 6 * s**5, 30 * s**2 * (1 - s) ** 2, 60 * s - 180 * s**2 + 120 * s**3


def trapezoidal(s: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return place, speed and bend over s = 0 … 1, a third each of acceleration, cruise (1.5) and deceleration."""
    place = np.where(s < 1 / 3, 2.25 * s**2, np.where(s < 2 / 3, 1.5 * s - 0.25, 1 - 2.25 * (1 - s) ** 2))
    bend = np.where(s < 1 / 3, 4.5, np.where(s < 2 / 3, 0.0, -4.5))
    return place, np.minimum(1.5, np.minimum(4.5 * s, 4.5 * (1 - s))), bend


SHAPES = {"minimum jerk": minimum_jerk, "trapezoidal": trapezoidal}
Torque = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]


def moves(
    chain: Chain, torque: Torque, shape: str, seed: int, rate: float, period: float | None, count: int = 20
) -> SampledMotion:
    """Return moves through random waypoints of the workspace, straight in joint space, as fast as the limits allow.

    Args:
        torque: (q, v, a), each (N, n), to (N, n); moves are slowed down until it keeps to its limits.
        rate: of the samples [Hz]; period: where to cut [s]; None: at the end of `count` moves.
    """
    rng = np.random.default_rng(seed)
    velocity, effort = (
        SHARE * np.array([getattr(joint, key) for joint in chain.joints]) for key in ("velocity", "effort")
    )
    points, times = [_pose(chain, rng)], list[float]()
    while len(times) < count or (period is not None and sum(times) < period):
        goal = _pose(chain, rng)
        if not _clear(chain, points[-1] + INSIDE[:, None] * (goal - points[-1])):
            continue
        times.append(_fastest(torque, SHAPES[shape], points[-1], goal, velocity, effort))
        points.append(goal)
    ends, q = np.concatenate([[0.0], np.cumsum(times)]), np.array(points)
    t = np.arange(0.0, ends[-1] if period is None else period, 1.0 / rate)
    k = np.searchsorted(ends, t, side="right") - 1
    width, step = np.array(times)[k][:, None], np.diff(q, axis=0)[k]
    place, speed, bend = SHAPES[shape](((t - ends[k]) / width[:, 0])[:, None])
    return SampledMotion(t, q[k] + step * place, step * speed / width, step * bend / width**2, np.zeros(step.shape))


def _pose(chain: Chain, rng: np.random.Generator) -> np.ndarray:
    while True:
        q = rng.uniform(SHARE * chain.lower, SHARE * chain.upper)
        if _clear(chain, q[None]):
            return q


def _clear(chain: Chain, q: np.ndarray) -> bool:
    """Say whether the tool stays 0.3 m from axis 1 and above -0.2 m."""
    place = forward(chain, q)[:, :3, 3]
    return bool((np.hypot(place[:, 0], place[:, 1]) >= 0.3).all() and (place[:, 2] >= -0.2).all())


def _fastest(
    torque: Torque, shape: Callable, start: np.ndarray, goal: np.ndarray, velocity: np.ndarray, effort: np.ndarray
) -> float:
    """Return the shortest duration [s] of a move, to 2 %."""
    place, speed, bend = shape(INSIDE[:, None])
    step, width = goal - start, float((np.abs(goal - start) * shape(np.array([[0.5]]))[1].item() / velocity).max())
    while True:
        tau = torque(start + step * place, step * speed / width, step * bend / width**2)
        if (np.abs(tau) <= effort).all():
            return width
        width *= 1.02
