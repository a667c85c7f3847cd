"""Columns of a moving platform's ten standard parameters: its wrench and its energy."""

import numpy as np

from calib.dynamics.bodies import PAIRS
from calib.parallel.mechanism.velocities import cross


def wrench_regressor(pose: np.ndarray, twist: np.ndarray, change: np.ndarray, gravity: np.ndarray) -> np.ndarray:
    """Return the regressor (N, 6, 10) of force and moment at the platform's origin, in the base's axes.

    Args:
        pose: (N, 4, 4) of the platform.
        twist: (N, 6) velocity of the platform's origin and angular velocity.
        change: (N, 6) derivative of the twist.
        gravity: (3,) gravity in the base's axes [m/s²].
    """
    R = pose[:, :3, :3]
    # acceleration, angular velocity and its derivative in the platform's axes
    a = np.einsum("nji,nj->ni", R, change[:, :3] - gravity)
    w = np.einsum("nji,nj->ni", R, twist[:, 3:])
    b = np.einsum("nji,nj->ni", R, change[:, 3:])
    regressor = np.zeros((len(R), 6, 10))
    spin = _skew(w)
    regressor[:, :3, 9] = a
    regressor[:, :3, 6:9] = _skew(b) + spin @ spin
    regressor[:, 3:, 6:9] = -_skew(a)
    gyroscopic = spin @ _inertia_columns(w)
    regressor[:, 3:, :6] = _inertia_columns(b) + gyroscopic
    force = R @ regressor[:, :3]
    moment = R @ regressor[:, 3:]
    return np.concatenate([force, moment], axis=1)


def energy_columns(pose: np.ndarray, twist: np.ndarray, gravity: np.ndarray) -> np.ndarray:
    """Return kinetic plus potential energy (N, 10) of a body per unit of each standard parameter.

    The arguments are those of `wrench_regressor`.
    """
    R = pose[:, :3, :3]
    u = np.einsum("nji,nj->ni", R, twist[:, :3])
    w = np.einsum("nji,nj->ni", R, twist[:, 3:])
    result = np.empty((len(R), 10))
    momentum = _inertia_columns(w)
    result[:, :6] = 0.5 * np.einsum("ni,nik->nk", w, momentum)
    down = np.einsum("nji,j->ni", R, gravity)
    # u · (w × s) = s · (u × w)
    result[:, 6:9] = cross(u, w) - down
    height = pose[:, :3, 3] @ gravity
    result[:, 9] = 0.5 * np.sum(u**2, axis=1) - height
    return result


def _skew(x: np.ndarray) -> np.ndarray:
    """Return the matrices (N, 3, 3) of the cross products x × of vectors (N, 3)."""
    result = np.zeros((len(x), 3, 3))
    result[:, [2, 0, 1], [1, 2, 0]] = x
    result[:, [1, 2, 0], [2, 0, 1]] = -x
    return result


def _inertia_columns(w: np.ndarray) -> np.ndarray:
    """Return I w as columns (N, 3, 6) of XX XY XZ YY YZ ZZ."""
    result = np.zeros((len(w), 3, 6))
    for k, (i, j) in enumerate(PAIRS):
        result[:, i, k] += w[:, j]
        if i != j:
            result[:, j, k] += w[:, i]
    return result
