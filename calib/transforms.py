"""Rigid transforms as (..., 4, 4) arrays; rotations are computed by scipy if possible.

A pose T maps coordinates in its own frame to coordinates in its reference frame: [p_ref; 1] = T @ [p; 1]. Quaternions
have the order x, y, z, w. Roll-pitch-yaw has the convention of URDF: R = Rz(yaw) Ry(pitch) Rx(roll).
"""

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation


def pose(rotation: ArrayLike | Rotation | None = None, position: ArrayLike | None = None) -> np.ndarray:
    """Return poses (..., 4, 4) from rotations (..., 3, 3) and positions (..., 3) [m].

    None stands for the identity rotation, or for the origin.
    """
    matrix = rotation.as_matrix() if isinstance(rotation, Rotation) else rotation
    matrix = np.eye(3) if matrix is None else np.asarray(matrix, dtype=float)
    point = np.zeros(3) if position is None else np.asarray(position, dtype=float)
    shape = np.broadcast_shapes(matrix.shape[:-2], point.shape[:-1])
    result = np.zeros((*shape, 4, 4))
    result[..., :3, :3] = matrix
    result[..., :3, 3] = point
    result[..., 3, 3] = 1.0
    return result


def invert(poses: np.ndarray) -> np.ndarray:
    """Return the inverses of rigid poses (..., 4, 4)."""
    transposed = np.swapaxes(poses[..., :3, :3], -1, -2)
    return pose(transposed, -np.einsum("...ij,...j->...i", transposed, poses[..., :3, 3]))


def from_xyz_rpy(xyz: ArrayLike, rpy: ArrayLike) -> np.ndarray:
    """Return poses (..., 4, 4) from URDF's xyz [m] and roll-pitch-yaw [rad]."""
    return pose(Rotation.from_euler("xyz", rpy).as_matrix(), xyz)


def to_xyz_rpy(poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return xyz [m] and roll-pitch-yaw [rad] of one pose (4, 4).

    `from_xyz_rpy` reproduces the pose, also near pitch ±90°, where yaw is not determined: roll is taken from Rz(-yaw) R
    instead of from R, so that it compensates any value of yaw.
    """
    rotation = poses[:3, :3]
    yaw = np.arctan2(rotation[1, 0], rotation[0, 0])
    pitch = np.arctan2(-rotation[2, 0], np.hypot(rotation[0, 0], rotation[1, 0]))
    across = np.cos(yaw) * rotation[1] - np.sin(yaw) * rotation[0]
    return poses[:3, 3].copy(), np.array([np.arctan2(-across[2], across[1]), pitch, yaw])


def from_quaternion(xyz: ArrayLike, xyzw: ArrayLike) -> np.ndarray:
    """Return poses (..., 4, 4) from positions (..., 3) [m] and unit quaternions (..., 4), x y z w."""
    return pose(Rotation.from_quat(xyzw).as_matrix(), xyz)


def to_quaternion(poses: np.ndarray) -> np.ndarray:
    """Return quaternions (..., 4), x y z w with w >= 0."""
    return Rotation.from_matrix(poses[..., :3, :3]).as_quat(canonical=True)


def rotation_vector(matrices: np.ndarray) -> np.ndarray:
    """Return the rotation vectors (..., 3) [rad] of rotation matrices (..., 3, 3)."""
    return Rotation.from_matrix(matrices).as_rotvec()


def displace(placement: np.ndarray, step: ArrayLike) -> np.ndarray:
    """Return ``placement · Trans(step[:3]) · Exp(step[3:])``: a placement (4, 4) displaced by six numbers [m, rad]."""
    step = np.asarray(step, dtype=float)
    return placement @ pose(Rotation.from_rotvec(step[3:]).as_matrix(), step[:3])


def orthonormal(matrix: np.ndarray) -> np.ndarray:
    """Return the rotation nearest to each matrix (..., 3, 3) in the Frobenius norm (by SVD)."""
    u, _, vt = np.linalg.svd(matrix)
    signs = np.ones((*matrix.shape[:-2], 3))
    signs[..., 2] = np.sign(np.linalg.det(u @ vt))
    return (u * signs[..., None, :]) @ vt
