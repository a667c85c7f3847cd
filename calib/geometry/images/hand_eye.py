"""Where a camera and a board stand, from poses alone: three closed forms of B_i = S A_i X, and which of them is best.

* Shah (2013): rotations by the Kronecker product's first singular pair, then translations;
* Li, Wang & Wu (2010): rotations and translations at once, S⁻¹ B_i = A_i X as one homogeneous linear system;
* Park & Martin (1994): AX = XB of the motions between images for X, then S as the mean of what each image says.

For poses that hold nearly one orientation, which leaves rotations alone open, `place_pose` has a fourth: turns and
ways together. The best is the one with the smallest median misfit. Images that contradict the rest are left out, a few
times.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from calib.transforms import invert, orthonormal, pose

LEVER = 0.3  # what a turn counts as [m/rad] (our choice, as the next two)


@dataclass(frozen=True, eq=False)
class Placement:
    """What a closed form says of m poses.

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
        """The median misfit [m]."""
        return float(np.median(self.misfit))


def place_robustly(arm: np.ndarray, seen: np.ndarray, lever: float) -> Placement:
    """Return the best placement by any of the three methods.

    Args:
        arm: (m, 4, 4) poses A_i of the tip in the base.
        seen: (m, 4, 4) poses B_i of the target in the station's frame.
        lever: what a radian counts in the misfit [m].
    """
    methods: dict[str, Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]] = {
        "Shah": _by_orientations, "Li": _li, "Park-Martin": _park_martin,
    }  # fmt: skip
    best: Placement | None = None
    kept_share = 0.7
    rounds = 3  # of leaving the worst images out (our choice)
    for name, method in methods.items():
        keep = np.ones(len(arm), dtype=bool)
        for _ in range(rounds):
            try:
                station, tool = method(arm[keep], seen[keep])
            except np.linalg.LinAlgError:
                break
            found = Placement(name, station, tool, misfit(arm, seen, station, tool, lever))
            if best is None or found.error < best.error:
                best = found
            keep = found.misfit <= np.quantile(found.misfit, kept_share)
            if keep.sum() < 5:
                break
    if best is None:
        raise np.linalg.LinAlgError("no closed form places the target")
    return best


def misfit(arm: np.ndarray, seen: np.ndarray, station: np.ndarray, tool: np.ndarray, lever: float) -> np.ndarray:
    """Return the distances (m,) [m] of B_i from S A_i X at the target, a turn counting with its lever [m]."""
    predicted = station @ arm @ tool
    turn = Rotation.from_matrix(np.swapaxes(predicted[:, :3, :3], 1, 2) @ seen[:, :3, :3]).magnitude()
    return np.hypot(np.linalg.norm(predicted[:, :3, 3] - seen[:, :3, 3], axis=1), lever * turn)


def _li(arm: np.ndarray, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return S and X with B_i = S A_i X, from Z B_i = A_i X, Z = S⁻¹: 12 linear equations a pose in 24 unknowns."""
    m, eye = len(arm), np.eye(3)
    a, b = arm[:, :3, :3], seen[:, :3, :3]
    rows = np.zeros((m, 12, 24))
    # row-major vec: R_A R_X - R_Z R_B = 0;  R_A t_X + t_A - R_Z t_B - t_Z = 0
    rows[:, :9, :9] = np.einsum("mij,kl->mikjl", a, eye).reshape(m, 9, 9)
    rows[:, :9, 9:18] = -np.einsum("ij,mlk->mikjl", eye, b).reshape(m, 9, 9)
    rows[:, 9:, 9:18] = -np.einsum("ij,mk->mijk", eye, seen[:, :3, 3]).reshape(m, 3, 9)
    rows[:, 9:, 18:21], rows[:, 9:, 21:] = a, -eye
    target = np.concatenate([np.zeros((m, 9)), -arm[:, :3, 3]], axis=1)
    flat, wanted = rows.reshape(-1, 24), target.ravel()
    solution = np.linalg.lstsq(flat, wanted, rcond=1e-10)[0]
    x, z = (orthonormal(solution[k : k + 9].reshape(3, 3)) for k in (0, 9))
    # the translations again, with proper rotations
    rest = wanted.reshape(m, 12)[:, 9:] - rows[:, 9:, 9:18] @ z.ravel()
    shift = np.linalg.lstsq(rows[:, 9:, 18:].reshape(-1, 6), rest.ravel(), rcond=1e-10)[0]
    return invert(pose(z, shift[3:])), pose(x, shift[:3])


def _park_martin(arm: np.ndarray, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return S and X; with M = A_i⁻¹ A_j and N = B_i⁻¹ B_j, M X = X N: log R_M = R_X log R_N, then t_X linearly."""
    order = np.argsort(Rotation.from_matrix(arm[:, :3, :3]).as_rotvec()[:, 0])
    first, second = order, np.roll(order, max(1, len(order) // 2))
    m, n = invert(arm[first]) @ arm[second], invert(seen[first]) @ seen[second]
    turns = [Rotation.from_matrix(each[:, :3, :3]).as_rotvec() for each in (m, n)]
    small = (np.linalg.norm(turns[0], axis=1) < np.pi - 0.1) & (np.linalg.norm(turns[1], axis=1) < np.pi - 0.1)
    if small.sum() < 3:
        raise np.linalg.LinAlgError("too few motions")
    x = orthonormal(turns[0][small].T @ turns[1][small])
    matrix = (m[:, :3, :3] - np.eye(3)).reshape(-1, 3)
    target = (np.einsum("ij,mj->mi", x, n[:, :3, 3]) - m[:, :3, 3]).ravel()
    tool = pose(x, np.linalg.lstsq(matrix, target, rcond=1e-9)[0])
    return average_pose(seen @ invert(arm @ tool)), tool


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
    placed = [_by_orientations(arm, seen), _by_ways(arm, seen)]
    return min(placed, key=lambda each: float(np.median(misfit(arm, seen, *each, LEVER))))


def _by_orientations(arm: np.ndarray, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
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
