"""A body fixed to the platform: its wrench and its energy as linear functions of its ten standard parameters.

    F = m a + ω̇ × s + ω × (ω × s),   n = I ω̇ + ω × I ω + s × a     about the origin of the body's frame, a less gravity

moved to the platform's origin, in the base's axes (Newton and Euler; eq. 2 of Briot, Gautier & Krut 2013).
"""

from __future__ import annotations

import numpy as np

from calib.transforms import pose as assembled

_PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


def wrench_regressor(
    pose: np.ndarray, twist: np.ndarray, change: np.ndarray, gravity: np.ndarray, placement: np.ndarray | None = None
) -> np.ndarray:
    """Return the regressor (N, 6, 10) of force and moment at the platform's origin, in the base's axes.

    Args:
        pose: (N, 4, 4) of the platform.
        twist, change: (N, 6) velocity of its origin and angular velocity, and their derivatives.
        gravity: (3,) [m/s²].
        placement: (4, 4) frame of the body's parameters in the platform's; None: the same.
    """
    R, lever = _frame(pose, placement)
    turn, turning = twist[:, 3:], change[:, 3:]
    linear = change[:, :3] - gravity + _cross(turning, lever) + _cross(turn, _cross(turn, lever))
    a, w, b = (np.einsum("nji,nj->ni", R, x) for x in (linear, turn, turning))
    own = np.zeros((len(R), 6, 10))
    spin = _skew(w)
    own[:, :3, 9] = a
    own[:, :3, 6:9] = _skew(b) + spin @ spin
    own[:, 3:, 6:9] = -_skew(a)
    inertia = _inertia_columns(b) + spin @ _inertia_columns(w)
    own[:, 3:, :6] = inertia
    force = R @ own[:, :3]
    return np.concatenate([force, R @ own[:, 3:] + _skew(lever) @ force], axis=1)


def energy_columns(
    pose: np.ndarray, twist: np.ndarray, gravity: np.ndarray, placement: np.ndarray | None = None
) -> np.ndarray:
    """Return kinetic and potential energy (N, 10) per unit of each standard parameter; arguments as above."""
    R, lever = _frame(pose, placement)
    turn = twist[:, 3:]
    u, w = (np.einsum("nji,nj->ni", R, x) for x in (twist[:, :3] + _cross(turn, lever), turn))
    result = np.empty((len(R), 10))
    result[:, :6] = 0.5 * np.einsum("ni,nik->nk", w, _inertia_columns(w))
    down = np.einsum("nji,j->ni", R, gravity)
    result[:, 6:9] = _cross(u, w) - down  # u · (w × s) = s · (u × w)
    result[:, 9] = 0.5 * np.sum(u**2, axis=1) - (pose[:, :3, 3] + lever) @ gravity
    return result


def _frame(pose: np.ndarray, placement: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """Return the body's rotation (N, 3, 3), and the lever (N, 3) to its origin, in the base's axes."""
    placement = assembled() if placement is None else placement
    return pose[:, :3, :3] @ placement[:3, :3], pose[:, :3, :3] @ placement[:3, 3]


def _skew(x: np.ndarray) -> np.ndarray:
    result = np.zeros((len(x), 3, 3))
    result[:, [2, 0, 1], [1, 2, 0]] = x
    result[:, [1, 2, 0], [2, 0, 1]] = -x
    return result


def _inertia_columns(w: np.ndarray) -> np.ndarray:
    """Return I w as columns (N, 3, 6) of XX XY XZ YY YZ ZZ."""
    result = np.zeros((len(w), 3, 6))
    for k, (i, j) in enumerate(_PAIRS):
        result[:, i, k] += w[:, j]
        if i != j:
            result[:, j, k] += w[:, i]
    return result


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[:, [1, 2, 0]] * b[:, [2, 0, 1]] - a[:, [2, 0, 1]] * b[:, [1, 2, 0]]
