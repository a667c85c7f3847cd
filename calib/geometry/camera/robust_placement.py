"""Placement of camera and board from poses: the best of three closed-form solutions of B_i = S A_i X.

* Shah (2013): rotations by the Kronecker product's first singular pair, then translations;
* Li, Wang & Wu (2010): rotations and translations at once, S⁻¹ B_i = A_i X as one homogeneous linear system;
* Park & Martin (1994): AX = XB of the motions between images for X, then S as the mean of what each image says.

The best is the one with the smallest median misfit. Images that contradict the rest are left out, a few times.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from calib.geometry.first_guess import average_pose, by_orientations, misfit
from calib.transforms import invert, orthonormal, pose


@dataclass(frozen=True, eq=False)
class Placement:
    """Placement of camera and board from m poses, by one closed-form method.

    Attributes:
        method: its name.
        station, tool: S and X (4, 4).
        misfit: (m,) distance between B_i and S A_i X at the target, a turn counting with its lever [m].
    """

    method: str
    station: np.ndarray
    tool: np.ndarray
    misfit: np.ndarray

    @property
    def error(self) -> float:
        """Median misfit [m]."""
        return float(np.median(self.misfit))


def place_robustly(arm: np.ndarray, targets: np.ndarray, lever: float) -> Placement:
    """Return the placement of the closed-form method with the smallest median misfit.

    Args:
        arm: (m, 4, 4) poses A_i of the tip in the base.
        targets: (m, 4, 4) poses B_i of the target in the station's frame.
        lever: what a radian counts in the misfit [m].
    """
    methods: dict[str, Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]] = {
        "Shah": by_orientations,
        "Li": by_li,
        "Park-Martin": by_park_martin,
    }
    best: Placement | None = None
    kept_share = 0.7
    rounds = 3  # of leaving the worst images out (our choice)
    for name, method in methods.items():
        keep = np.ones(len(arm), dtype=bool)
        for _ in range(rounds):
            try:
                station, tool = method(arm[keep], targets[keep])
            except np.linalg.LinAlgError:
                break
            placement = Placement(name, station, tool, misfit(arm, targets, station, tool, lever))
            if best is None or placement.error < best.error:
                best = placement
            keep = placement.misfit <= np.quantile(placement.misfit, kept_share)
            if keep.sum() < 5:
                break
    if best is None:
        raise np.linalg.LinAlgError("no closed form yields a placement of the target")
    return best


def by_li(arm: np.ndarray, targets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return S and X with B_i = S A_i X, from Z B_i = A_i X, Z = S⁻¹: 12 linear equations a pose in 24 unknowns."""
    m, eye = len(arm), np.eye(3)
    a, b = arm[:, :3, :3], targets[:, :3, :3]
    rows = np.zeros((m, 12, 24))
    # row-major vec: R_A R_X - R_Z R_B = 0;  R_A t_X + t_A - R_Z t_B - t_Z = 0
    rows[:, :9, :9] = np.einsum("mij,kl->mikjl", a, eye).reshape(m, 9, 9)
    rows[:, :9, 9:18] = -np.einsum("ij,mlk->mikjl", eye, b).reshape(m, 9, 9)
    rows[:, 9:, 9:18] = -np.einsum("ij,mk->mijk", eye, targets[:, :3, 3]).reshape(m, 3, 9)
    rows[:, 9:, 18:21], rows[:, 9:, 21:] = a, -eye
    target = np.concatenate([np.zeros((m, 9)), -arm[:, :3, 3]], axis=1)
    flat, constants = rows.reshape(-1, 24), target.ravel()
    solution = np.linalg.lstsq(flat, constants, rcond=1e-10)[0]
    x, z = (orthonormal(solution[k : k + 9].reshape(3, 3)) for k in (0, 9))
    # the translations again, with proper rotations
    translations = constants.reshape(m, 12)[:, 9:] - rows[:, 9:, 9:18] @ z.ravel()
    shift = np.linalg.lstsq(rows[:, 9:, 18:].reshape(-1, 6), translations.ravel(), rcond=1e-10)[0]
    return invert(pose(z, shift[3:])), pose(x, shift[:3])


def by_park_martin(arm: np.ndarray, targets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return S and X; with M = A_i⁻¹ A_j and N = B_i⁻¹ B_j, M X = X N: log R_M = R_X log R_N, then t_X linearly."""
    order = np.argsort(Rotation.from_matrix(arm[:, :3, :3]).as_rotvec()[:, 0])
    first, second = order, np.roll(order, max(1, len(order) // 2))
    m, n = invert(arm[first]) @ arm[second], invert(targets[first]) @ targets[second]
    turns = [Rotation.from_matrix(motions[:, :3, :3]).as_rotvec() for motions in (m, n)]
    small = (np.linalg.norm(turns[0], axis=1) < np.pi - 0.1) & (np.linalg.norm(turns[1], axis=1) < np.pi - 0.1)
    if small.sum() < 3:
        raise np.linalg.LinAlgError("too few motions")
    x = orthonormal(turns[0][small].T @ turns[1][small])
    matrix = (m[:, :3, :3] - np.eye(3)).reshape(-1, 3)
    target = (np.einsum("ij,mj->mi", x, n[:, :3, 3]) - m[:, :3, 3]).ravel()
    tool = pose(x, np.linalg.lstsq(matrix, target, rcond=1e-9)[0])
    return average_pose(targets @ invert(arm @ tool)), tool
