"""Where an instrument and a target stand, from poses alone: closed forms of B_i = S A_i X.

Rotations by Shah (2013), the Kronecker product's first singular pair, then translations; or, for poses that hold nearly
one orientation, which leaves rotations alone open, turns and ways together.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from calib.transforms import orthonormal, pose

LEVER = 0.3  # what a turn counts as [m/rad] (our choice, as the next two)


def misfit(arm: np.ndarray, seen: np.ndarray, station: np.ndarray, tool: np.ndarray, lever: float) -> np.ndarray:
    """Return the distances (m,) [m] of B_i from S A_i X at the target, a turn counting with its lever [m]."""
    predicted = station @ arm @ tool
    turn = Rotation.from_matrix(np.swapaxes(predicted[:, :3, :3], 1, 2) @ seen[:, :3, :3]).magnitude()
    return np.hypot(np.linalg.norm(predicted[:, :3, 3] - seen[:, :3, 3], axis=1), lever * turn)


def average_pose(poses: np.ndarray) -> np.ndarray:
    """Return the mean (4, 4) of poses (m, 4, 4): chordal mean of the rotations, median of the positions."""
    return pose(orthonormal(poses[:, :3, :3].mean(axis=0)), np.median(poses[:, :3, 3], axis=0))


def place_pose(arm: np.ndarray, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Solve B_i = S A_i X for S and X: by orientations (Shah 2013), or by turns and ways together; the better one.

    Args:
        arm: (m, 4, 4) poses A_i of the tip in the base.
        seen: (m, 4, 4) poses B_i of the target in the station's frame.

    Returns:
        station (4, 4) and tool (4, 4).
    """
    placed = [by_orientations(arm, seen), _by_ways(arm, seen)]
    return min(placed, key=lambda each: float(np.median(misfit(arm, seen, *each, LEVER))))


def by_orientations(arm: np.ndarray, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return S and X by Shah: good where the poses turn about two axes by much more than they are off."""
    a, b = arm[:, :3, :3], seen[:, :3, :3]
    # vec(R_S R_A R_X) = vec(R_B): the sum of R_B ⊗ R_A has vec(R_S) and vec(R_X) as its first singular pair
    kernel = np.einsum("mij,mkl->ikjl", b, a).reshape(9, 9)
    u, _, vt = np.linalg.svd(kernel)
    station_rotation, tool_transposed = u[:, 0].reshape(3, 3), vt[0].reshape(3, 3)
    station_rotation = orthonormal(station_rotation * np.sign(np.linalg.det(station_rotation)))
    tool_rotation = orthonormal(tool_transposed * np.sign(np.linalg.det(tool_transposed))).T
    station, offset = _translations(arm, seen[:, :3, 3], station_rotation)
    return pose(station_rotation, station), pose(tool_rotation, offset)


def _by_ways(arm: np.ndarray, seen: np.ndarray, rounds: int = 5) -> tuple[np.ndarray, np.ndarray]:
    """Return S and X from what turns and ways from the mean have in common: good for a line driven in one orientation.

    log(R_B,i R̄_Bᵀ) = R_S log(R_A,i R̄_Aᵀ), the chordal means being turned alike, and
    y_i - ȳ = R_S (a_i - ā + (R_i - R̄) t): R_S by Kabsch on both, turns at a lever of `LEVER`, and t by its linear
    solution, in turns.

    `rounds`: rounds of rotation and offset.
    """
    (a, turns), (b, seen_turns) = (chordal_turns(poses[:, :3, :3]) for poses in (arm, seen))
    station, offset, rotation = np.zeros(3), np.zeros(3), np.eye(3)
    for _ in range(rounds):
        ways = arm[:, :3, 3] + arm[:, :3, :3] @ offset
        one = np.concatenate([ways - ways.mean(axis=0), LEVER * turns])
        two = np.concatenate([seen[:, :3, 3] - seen[:, :3, 3].mean(axis=0), LEVER * seen_turns])
        rotation = Rotation.align_vectors(two, one)[0].as_matrix()
        station, offset = _translations(arm, seen[:, :3, 3], rotation)
    return pose(rotation, station), pose((rotation @ a).T @ b, offset)


def chordal_turns(rotations: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the chordal mean (3, 3) of rotations (m, 3, 3), and the rotation vectors (m, 3) that lead away from it."""
    mean = orthonormal(rotations.mean(axis=0))
    return mean, Rotation.from_matrix(rotations @ mean.T).as_rotvec()


def _translations(arm: np.ndarray, position: np.ndarray, rotation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return p_S (3,) and t (3,) of  y_i - R_S a_i = R_S R_i t + p_S; 0 for what of t hardly any turn tells."""
    turned, target = rotation @ arm[:, :3, :3], position - arm[:, :3, 3] @ rotation.T
    away = turned - turned.mean(axis=0)
    u, size, vt = np.linalg.svd(away.reshape(-1, 3), full_matrices=False)
    min_turn = 0.01  # rms turn [rad] below which it tells no offset of the target
    told = size > min_turn * np.sqrt(len(arm))
    offset = vt[told].T @ ((u[:, told].T @ (target - target.mean(axis=0)).reshape(-1)) / size[told])
    return (target - turned @ offset).mean(axis=0), offset
