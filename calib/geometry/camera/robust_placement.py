"""Placement of camera and board: the best of three closed-form solutions S, X of B_i = S A_i X for given A_i, B_i.

* Shah (2013): rotations by the Kronecker product's first singular pair, then translations;
* Li, Wang & Wu (2010): rotations and translations at once, S⁻¹ B_i = A_i X as one homogeneous linear system;
* Park & Martin (1994): AX = XB of the motions between images for X, then S as the mean over the images.

The best solution is that with the smallest median misfit. Each method is repeated without the images with the largest
misfits (`ROUNDS`).
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from calib.geometry.first_guess import average_pose, by_orientations, misfit
from calib.transforms import invert, orthonormal, pose

# Number of rounds; each keeps this share of the images, those with the smallest misfits (our choice).
ROUNDS = 3
CONSISTENT_SHARE = 0.7
# Smallest number of images from which another placement is computed (our choice).
MIN_POSES = 5
# Largest rotation between two images that Park and Martin's method uses [rad]: at π its logarithm has two signs.
MAX_TURN = np.pi - 0.1

ClosedForm = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True, eq=False)
class Placement:
    """Placement of camera and board from m poses, by one closed-form method.

    Attributes:
        method: name of the closed-form method.
        station, tool: S and X (4, 4), with B_i = S A_i X.
        misfit: (m,) distance between B_i and S A_i X at the target, rotations multiplied by a lever [m].
    """

    method: str
    station: np.ndarray
    tool: np.ndarray
    misfit: np.ndarray

    @property
    def error(self) -> float:
        """Median of the misfit over the poses [m]."""
        return float(np.median(self.misfit))


def place_robustly(arm: np.ndarray, targets: np.ndarray, lever: float) -> Placement:
    """Return the placement of the closed-form method with the smallest median misfit.

    Args:
        arm: (m, 4, 4) poses A_i of the tip in the base.
        targets: (m, 4, 4) poses B_i of the target in the station's frame.
        lever: length by which rotations [rad] are multiplied in the misfit [m].
    """
    methods: dict[str, ClosedForm] = {"Shah": by_orientations, "Li": by_li, "Park-Martin": by_park_martin}
    best: Placement | None = None
    for name, method in methods.items():
        consistent = np.ones(len(arm), dtype=bool)
        for _ in range(ROUNDS):
            try:
                station, tool = method(arm[consistent], targets[consistent])
            except np.linalg.LinAlgError:
                break
            misfits = misfit(arm, targets, station, tool, lever)
            placement = Placement(name, station, tool, misfits)
            if best is None or placement.error < best.error:
                best = placement
            max_misfit = np.quantile(misfits, CONSISTENT_SHARE)
            consistent = misfits <= max_misfit
            if consistent.sum() < MIN_POSES:
                break
    if best is None:
        raise np.linalg.LinAlgError("no closed form yields a placement of the target")
    return best


def by_li(arm: np.ndarray, targets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return S and X (4, 4) with B_i = S A_i X by the method of Li, Wang & Wu (2010).

    With Z = S⁻¹, Z B_i = A_i X gives 12 linear equations per pose in the 24 entries of X and Z.

    Args:
        arm: (m, 4, 4) poses A_i of the tip in the base.
        targets: (m, 4, 4) poses B_i of the target in the station's frame.
    """
    m = len(arm)
    eye = np.eye(3)
    R_a = arm[:, :3, :3]
    t_a = arm[:, :3, 3]
    R_b = targets[:, :3, :3]
    t_b = targets[:, :3, 3]
    rows = np.zeros((m, 12, 24))
    # row-major vec: R_A R_X - R_Z R_B = 0;  R_A t_X + t_A - R_Z t_B - t_Z = 0
    by_R_x = np.einsum("mij,kl->mikjl", R_a, eye)
    by_R_z = np.einsum("ij,mlk->mikjl", eye, R_b)
    t_by_R_z = np.einsum("ij,mk->mijk", eye, t_b)
    rows[:, :9, :9] = by_R_x.reshape(m, 9, 9)
    rows[:, :9, 9:18] = -by_R_z.reshape(m, 9, 9)
    rows[:, 9:, 9:18] = -t_by_R_z.reshape(m, 3, 9)
    rows[:, 9:, 18:21] = R_a
    rows[:, 9:, 21:] = -eye
    target = np.zeros((m, 12))
    target[:, 9:] = -t_a
    matrix = rows.reshape(-1, 24)
    solution, *_ = np.linalg.lstsq(matrix, target.ravel(), rcond=1e-10)
    R_x = orthonormal(solution[:9].reshape(3, 3))
    R_z = orthonormal(solution[9:18].reshape(3, 3))
    # The solved matrices are not exactly rotations; with the nearest rotations the translations are solved again.
    rotated = rows[:, 9:, 9:18] @ R_z.ravel()
    translations = target[:, 9:] - rotated
    translation_rows = rows[:, 9:, 18:].reshape(-1, 6)
    shift, *_ = np.linalg.lstsq(translation_rows, translations.ravel(), rcond=1e-10)
    Z = pose(R_z, shift[3:])
    return invert(Z), pose(R_x, shift[:3])


def by_park_martin(arm: np.ndarray, targets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return S and X (4, 4) with B_i = S A_i X by the method of Park & Martin (1994) on motions between images.

    With M = A_i⁻¹ A_j and N = B_i⁻¹ B_j, M X = X N. Rotation vectors then satisfy log R_M = R_X log R_N, which gives
    R_X; the translation of X follows from linear equations, and S is the mean over the images.

    Args:
        arm: (m, 4, 4) poses A_i of the tip in the base.
        targets: (m, 4, 4) poses B_i of the target in the station's frame.

    Raises:
        LinAlgError: if fewer than three motions turn by less than `MAX_TURN`.
    """
    rotation_vectors = Rotation.from_matrix(arm[:, :3, :3]).as_rotvec()
    first = np.argsort(rotation_vectors[:, 0])
    offset = max(1, len(first) // 2)
    second = np.roll(first, offset)
    arm_motion = invert(arm[first]) @ arm[second]
    target_motion = invert(targets[first]) @ targets[second]
    arm_turn = Rotation.from_matrix(arm_motion[:, :3, :3]).as_rotvec()
    target_turn = Rotation.from_matrix(target_motion[:, :3, :3]).as_rotvec()
    # the logarithm of half a turn has two signs
    small_arm_turn = np.linalg.norm(arm_turn, axis=1) < MAX_TURN
    small_target_turn = np.linalg.norm(target_turn, axis=1) < MAX_TURN
    small = small_arm_turn & small_target_turn
    if small.sum() < 3:
        raise np.linalg.LinAlgError("too few motions")
    R_x = orthonormal(arm_turn[small].T @ target_turn[small])
    rows = arm_motion[:, :3, :3] - np.eye(3)
    rotated = np.einsum("ij,mj->mi", R_x, target_motion[:, :3, 3])
    target = rotated - arm_motion[:, :3, 3]
    t_x, *_ = np.linalg.lstsq(rows.reshape(-1, 3), target.ravel(), rcond=1e-9)
    tool = pose(R_x, t_x)
    stations = targets @ invert(arm @ tool)
    return average_pose(stations), tool
