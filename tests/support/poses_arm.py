"""A 7R arm with the LWR4+ geometry for the tests: poses of the tool and its observation Jacobian, in plain numpy.

Khalil rows Rot_x(alpha) Trans_x(d) Rot_z(theta + q) Trans_z(r), nine frames; alpha8 = 0.3 keeps all 34 alive.
"""

import numpy as np
from scipy.linalg import qr

ALPHA = np.array([0.2, 0, np.pi / 2, -np.pi / 2, -np.pi / 2, np.pi / 2, np.pi / 2, -np.pi / 2, 0.3])
D = np.array([1.5, 0, 0, 0, 0, 0, 0, 0, 0.0015])
THETA = np.array([0.4, 0, 0, 0, 0, 0, 0, 0, 0.1])
R = np.array([-0.3, 0.31, 0, 0.40, 0, 0.39, 0, 0, 0.11])
JOINT = np.array([-1, 0, 1, 2, 3, 4, 5, 6, -1])
UPPER = np.radians([170, 120, 170, 120, 170, 90, 170])
LOWER = -UPPER
SIGMA = np.array([5e-5] * 3 + [2e-4] * 3)


def tool(q):
    """Return rotation (m, 3, 3) and position (m, 3) of the tool, and every element's axis and point (m, 36, 3)."""
    m = len(q)
    rotation, position = np.broadcast_to(np.eye(3), (m, 3, 3)).copy(), np.zeros((m, 3))
    axes, points = np.empty((m, 36, 3)), np.empty((m, 36, 3))
    for k in range(9):
        angle = THETA[k] + (q[:, JOINT[k]] if JOINT[k] >= 0 else 0.0)
        for e, (axis, turn, shift) in enumerate([(0, ALPHA[k], 0), (0, 0, D[k]), (2, angle, 0), (2, 0, R[k])]):
            axes[:, 4 * k + e], points[:, 4 * k + e] = rotation[:, :, axis], position
            position = position + shift * rotation[:, :, axis]
            rotation = rotation @ _turn(axis, np.broadcast_to(turn, m))
    return rotation, position, axes, points


def _turn(axis, angle):
    c, s = np.cos(angle), np.sin(angle)
    out = np.zeros((len(angle), 3, 3))
    i, j = (axis + 1) % 3, (axis + 2) % 3
    out[:, axis, axis], out[:, i, i], out[:, j, j], out[:, i, j], out[:, j, i] = 1, c, c, -s, s
    return out


def full_jacobian(q):
    """Return (m, 6, 36): whitened position and orientation rows against alpha, d, theta, r of every frame."""
    _, position, axes, points = tool(np.atleast_2d(q))
    out = np.zeros((len(position), 6, 36))
    for e in range(36):
        if e % 2 == 0:
            out[:, :3, e] = np.cross(axes[:, e], position - points[:, e])
            out[:, 3:, e] = axes[:, e]
        else:
            out[:, :3, e] = axes[:, e]
    return out / SIGMA[:, None]


def random_poses(count, seed):
    return np.random.default_rng(seed).uniform(LOWER, UPPER, (count, 7))


def _base(rows):
    W = full_jacobian(random_poses(200, 1))[:, rows].reshape(-1, 36)
    scale = np.linalg.norm(W, axis=0)
    scale = np.where(scale > 1e-9 * scale.max(), scale, np.inf)
    _, triangle, order = qr(W / scale, mode="economic", pivoting=True)
    size = np.abs(np.diag(triangle))
    return np.sort(order[: int((size > 1e-6 * size[0]).sum())])


BASE_POSE = _base(slice(0, 6))
BASE_POINT = _base(slice(0, 3))


def jacobian(q):
    return full_jacobian(q)[:, :, BASE_POSE]


def point_jacobian(q):
    return full_jacobian(q)[:, :3][:, :, BASE_POINT]
