"""Placement of camera and board from poses: the best of three closed-form solutions of B_i = S A_i X.

* Shah (2013): rotations by the Kronecker product's first singular pair, then translations;
* Li, Wang & Wu (2010): rotations and translations at once, S⁻¹ B_i = A_i X as one homogeneous linear system;
* Park & Martin (1994): AX = XB of the motions between images for X, then S as the mean over the images.

The best solution has the smallest median misfit. Images that contradict the others are removed, a few times over.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from calib.geometry.first_guess import average_pose, by_orientations, misfit
from calib.transforms import invert, orthonormal, pose

# of leaving the worst images out, the share that stays, and the poses that a placement needs (our choice)
ROUNDS, CONSISTENT_SHARE, MIN_POSES = 3, 0.7, 5
# of a motion that Park and Martin's method uses [rad]
MAX_TURN = np.pi - 0.1


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
    methods: dict[str, Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]] = {
        "Shah": by_orientations,
        "Li": by_li,
        "Park-Martin": by_park_martin,
    }
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
            consistent = misfits <= np.quantile(misfits, CONSISTENT_SHARE)
            if consistent.sum() < MIN_POSES:
                break
    if best is None:
        raise np.linalg.LinAlgError("no closed form yields a placement of the target")
    return best


def by_li(arm: np.ndarray, targets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return S and X (4, 4) with B_i = S A_i X: Z B_i = A_i X, Z = S⁻¹, 12 linear equations per pose in 24 unknowns."""
    m = len(arm)
    eye = np.eye(3)
    R_a, t_a = arm[:, :3, :3], arm[:, :3, 3]
    R_b, t_b = targets[:, :3, :3], targets[:, :3, 3]
    rows = np.zeros((m, 12, 24))
    # row-major vec: R_A R_X - R_Z R_B = 0;  R_A t_X + t_A - R_Z t_B - t_Z = 0
    rows[:, :9, :9] = np.einsum("mij,kl->mikjl", R_a, eye).reshape(m, 9, 9)
    rows[:, :9, 9:18] = -np.einsum("ij,mlk->mikjl", eye, R_b).reshape(m, 9, 9)
    rows[:, 9:, 9:18] = -np.einsum("ij,mk->mijk", eye, t_b).reshape(m, 3, 9)
    rows[:, 9:, 18:21] = R_a
    rows[:, 9:, 21:] = -eye
    target = np.concatenate([np.zeros((m, 9)), -t_a], axis=1)
    solution, *_ = np.linalg.lstsq(rows.reshape(-1, 24), target.ravel(), rcond=1e-10)
    R_x = orthonormal(solution[:9].reshape(3, 3))
    R_z = orthonormal(solution[9:18].reshape(3, 3))
    # the translations again, with proper rotations
    translations = target[:, 9:] - rows[:, 9:, 9:18] @ R_z.ravel()
    translation_rows = rows[:, 9:, 18:].reshape(-1, 6)
    shift, *_ = np.linalg.lstsq(translation_rows, translations.ravel(), rcond=1e-10)
    return invert(pose(R_z, shift[3:])), pose(R_x, shift[:3])


def by_park_martin(arm: np.ndarray, targets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return S and X (4, 4) by AX = XB: with M = A_i⁻¹ A_j, N = B_i⁻¹ B_j, M X = X N gives log R_M = R_X log R_N, then
    t_X.
    """
    order = np.argsort(Rotation.from_matrix(arm[:, :3, :3]).as_rotvec()[:, 0])
    first, second = order, np.roll(order, max(1, len(order) // 2))
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
    matrix = (arm_motion[:, :3, :3] - np.eye(3)).reshape(-1, 3)
    turned = np.einsum("ij,mj->mi", R_x, target_motion[:, :3, 3])
    target = (turned - arm_motion[:, :3, 3]).ravel()
    t_x, *_ = np.linalg.lstsq(matrix, target, rcond=1e-9)
    tool = pose(R_x, t_x)
    return average_pose(targets @ invert(arm @ tool)), tool
