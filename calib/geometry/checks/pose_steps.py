"""A step of the set-up halfway through a set of poses: the likelihood ratio over all rows after which it may be.

Poses of the target in the instrument's frame are B_i = S A_i X E_i with the arm's poses A_i and small errors E_i. The
twist e_i of S⁻¹ B_i against A_i X is linear in small changes of both placements,

    e_i = ξ + Ad((A_i X)⁻¹) η,

with X exp(ξ) and S exp(η). A step of the tool adds a second ξ from some row on, a step of the station a second η. An
error of the arm that is linear in its pose has a prior and is fitted in any case. A step is named if Fisher's test,
corrected for the number of steps tried (Bonferroni), finds that it explains the rows, and if nothing else does so: no
drift, no step over rows in the order of a coordinate, and no step over rows in random orders (Pitman's test of 1937),
which needs no distribution of the errors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from calib.geometry.first_guess import LEVER, Placements, average_pose
from calib.transforms import invert, pose

# Fewest rows before and after a step.
MIN_PART = 5
# Numbers of a twist, and of both placements.
TWIST = 6
PLACED = 12
# Largest probability of such a gain by noise, all steps considered; small, since an arm's errors are not white (our
# choice, judged on simulated sets without a step).
MAX_CHANCE = 1e-4
# Largest squares with the step, as a share of those without it (our choice).
MAX_LEFT = 0.85
# Smallest likelihood ratio, as -2 log, of the step to one over rows in the order of a coordinate, which an error of the
# arm resembles (our choice: a chance of 1e-4 at 3 degrees of freedom).
MIN_RATIO = 20.0
# Number of random orders of the rows, in none of which a step may gain more (Pitman 1937).
PERMUTATIONS = 300
# Prior standard deviations of an arm's error that is linear in its pose: displacement [m] and rotation [rad] over all
# coordinates (our choice: those of arms of ordinary accuracy).
ARM_SHIFT = 3e-3
ARM_TURN = 5e-3
# Rounding of a gain, as a share of it.
ROUNDING = 1e-9
# Largest number of Gauss-Newton steps.
ITERATIONS = 6
# Largest rms rotation per axis [rad] of poses whose errors are linear in the placements.
MAX_TURN = 0.1
# Smallest standard deviation of poses [m, rad].
MIN_NOISE = 1e-7
# Smallest sum of whitened squares: rows without any error have it.
MIN_SQUARES = 1e-12
SUBJECTS = ("tool", "station")


@dataclass(frozen=True)
class Step:
    """A step of a placement.

    Attributes:
        cut: index of the first row after it.
        part: "tool" or "station".
        misfit: rms misfit of the rows with the step [m], angles included.
        angle, angle_sigma: size of its rotation and the standard deviation [rad].
        shift, shift_sigma: size of its displacement and the standard deviation [m].
    """

    cut: int
    part: str
    misfit: float
    angle: float
    angle_sigma: float
    shift: float
    shift_sigma: float


@dataclass(frozen=True, eq=False)
class Twists:
    """Whitened errors of poses, and their derivatives.

    Attributes:
        error: (m, 6) twists, displacement before rotation.
        tool, station: (m, 6, 6) derivatives by the placements' twists.
    """

    error: np.ndarray
    tool: np.ndarray
    station: np.ndarray

    def columns(self, part: str, after: np.ndarray) -> np.ndarray:
        """Return the columns (6 m, 6) of a part's step at the rows of a mask (m,)."""
        return (self.derivative(part) * after[:, None, None]).reshape(-1, TWIST)

    def derivative(self, part: str) -> np.ndarray:
        """Return the derivatives (m, 6, 6) by a part's twist."""
        return {"tool": self.tool, "station": self.station}[part]

    def both(self) -> np.ndarray:
        """Return the columns (6 m, 12) of both placements."""
        everywhere = np.ones(len(self.error))
        return np.hstack([self.columns("tool", everywhere), self.columns("station", everywhere)])


class Search:
    """Gains of steps: by how much they reduce the squares that placements and the arm's errors leave.

    Attributes:
        cost: squares without a step, the prior of the arm's errors included.
        dof: degrees of freedom of the rows.
    """

    def __init__(self, twists: Twists, arm_errors: np.ndarray) -> None:
        """Prepare the sums over rows.

        Args:
            twists: m errors at the best placements of all rows.
            arm_errors: (m, 6, k) columns of k unknowns of the arm, each with a standard deviation of 1.
        """
        m, _, unknowns = arm_errors.shape
        placed = twists.both()
        prior = np.hstack([np.zeros((unknowns, placed.shape[1])), np.eye(unknowns)])
        matrix = np.vstack([np.hstack([placed, arm_errors.reshape(-1, unknowns)]), prior])
        error = np.concatenate([twists.error.ravel(), np.zeros(unknowns)])
        base = np.linalg.qr(matrix)[0]
        error = error - base @ (base.T @ error)
        of_rows = base[: m * TWIST].reshape(m, TWIST, -1)
        residual = error[: m * TWIST].reshape(m, TWIST)
        self.cost = float(np.sum(error**2))
        self.dof = m * TWIST - float(np.sum(of_rows**2))
        self._sums = {}
        for part in SUBJECTS:
            columns = twists.derivative(part)
            score = np.einsum("mij,mi->mj", columns, residual)
            square = np.einsum("mij,mik->mjk", columns, columns)
            shared = np.einsum("mij,mik->mjk", columns, of_rows)
            self._sums[part] = score, square, shared

    def best_gain(self, order: np.ndarray) -> tuple[float, str, int]:
        """Return the largest gain of a step over rows in some order, its part and its place there.

        Args:
            order: (m,) indices of the rows.
        """
        cuts = np.arange(MIN_PART, len(order) - MIN_PART + 1)
        best = (-1.0, "", 0)
        for part, sums in self._sums.items():
            behind = [np.cumsum(terms[order[::-1]], axis=0)[::-1][cuts] for terms in sums]
            gains = _gains(*behind)
            largest = int(np.argmax(gains))
            best = max(best, (float(gains[largest]), part, int(cuts[largest])))
        return best

    def gain_of_drift(self) -> float:
        """Return the largest gain of a placement that drifts from the first row to the last."""
        gains = []
        for score, square, shared in self._sums.values():
            ramp = np.linspace(-0.5, 0.5, len(score))
            sums = np.tensordot(ramp, score, 1), np.tensordot(ramp**2, square, 1), np.tensordot(ramp, shared, 1)
            gains += _gains(*(terms[None] for terms in sums)).tolist()
        return max(gains)


def _gains(score: np.ndarray, square: np.ndarray, shared: np.ndarray) -> np.ndarray:
    """Return the reductions gᵀ S⁻¹ g (c,) of the squares by c changes, with S = Σ HᵀH - Σ HᵀQ (Σ HᵀQ)ᵀ.

    Args:
        score: (c, 6) g.
        square: (c, 6, 6) Σ HᵀH.
        shared: (c, 6, k) Σ HᵀQ, with Q orthonormal columns of what is fitted in any case.
    """
    matrix = square - shared @ shared.transpose(0, 2, 1)
    rounding = ROUNDING * np.trace(square, axis1=1, axis2=2)
    matrix = matrix + rounding[:, None, None] * np.eye(TWIST)
    solution = np.linalg.solve(matrix, score[:, :, None])
    return np.einsum("ck,ck->c", score, solution[:, :, 0])


def small_step(arm: np.ndarray, measured: np.ndarray, start: Placements) -> Step | None:
    """Return the most likely step of a placement; None if noise, a drift or an error of the arm explains as much.

    Args:
        arm: (m, 4, 4) A_i.
        measured: (m, 4, 4) B_i.
        start: placements S and X of all rows.
    """
    # slow to load
    from scipy.stats import f

    m = len(arm)
    placements = start
    scale = np.ones(TWIST)
    for _ in range(ITERATIONS):
        raw = _twists(arm, measured, *placements, scale)
        change = np.linalg.lstsq(raw.both(), raw.error.ravel())[0]
        placements = (placements[0] @ _motion(change[TWIST:]), placements[1] @ _motion(change[:TWIST]))
        scale = _scale(_twists(arm, measured, *placements, np.ones(TWIST)).error)
    if scale[-1] > MAX_TURN:
        return None
    search = Search(_twists(arm, measured, *placements, scale), _arm_errors(arm, scale))
    rows = np.arange(m)
    gain, part, cut = search.best_gain(rows)
    remaining = max(search.cost - gain, MIN_SQUARES)
    dof = max(search.dof - TWIST, 1.0)
    chance = float(f.sf(gain / TWIST / (remaining / dof), TWIST, dof))
    hypotheses = len(SUBJECTS) * (m - 2 * MIN_PART + 1)
    if chance * hypotheses > MAX_CHANCE or remaining > MAX_LEFT * search.cost:
        return None
    if search.gain_of_drift() > gain:
        return None
    for order in _other_orders(arm):
        ratio = (search.cost - search.best_gain(order)[0]) / remaining
        if dof * np.log(ratio) < MIN_RATIO:
            return None
    random = np.random.default_rng(0)
    for _ in range(PERMUTATIONS):
        if search.best_gain(random.permutation(m))[0] > (1.0 + ROUNDING) * gain:
            return None
    return _estimated(arm, measured, cut, part, placements)


def _arm_errors(arm: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """Return the columns (m, 6, 36) of an arm's error that is linear in its pose, each of plausible size.

    Args:
        arm: (m, 4, 4) A_i.
        scale: (6,) standard deviations of displacements [m] and rotations [rad].
    """
    coordinates = _coordinates(arm)
    coordinates = coordinates - coordinates.mean(axis=0)
    coordinates /= np.maximum(coordinates.std(axis=0), MIN_NOISE)
    sizes = np.repeat([ARM_SHIFT, ARM_TURN], 3) / scale / np.sqrt(TWIST)
    return np.einsum("jk,mi->mjki", np.diag(sizes), coordinates).reshape(len(arm), TWIST, TWIST**2)


def step_at(arm: np.ndarray, measured: np.ndarray, cut: int, first: Placements) -> Step:
    """Return the step before a row, of the placement that explains the rows better.

    Args:
        arm: (m, 4, 4) A_i.
        measured: (m, 4, 4) B_i.
        cut: index of the first row after the step.
        first: placements S and X of the rows before it.
    """
    steps = [_estimated(arm, measured, cut, part, first) for part in SUBJECTS]
    return min(steps, key=lambda step: step.misfit)


def _estimated(arm: np.ndarray, measured: np.ndarray, cut: int, part: str, first: Placements) -> Step:
    """Return the step of a placement before a row, by Gauss-Newton.

    Args:
        arm: (m, 4, 4) A_i.
        measured: (m, 4, 4) B_i.
        cut: index of the first row after the step.
        part: the placement.
        first: placements S and X near those of the rows before it.
    """
    station, tool = first
    stations = np.stack([station, station])
    tools = np.stack([tool, tool])
    if part == "tool":
        tools[1] = average_pose(invert(station @ arm[cut:]) @ measured[cut:])
    else:
        stations[1] = average_pose(measured[cut:] @ invert(arm[cut:] @ tool))
    after = (np.arange(len(arm)) >= cut).astype(int)
    scale = np.ones(TWIST)
    for _ in range(ITERATIONS):
        twists = _twists(arm, measured, stations[after], tools[after], scale)
        change = np.linalg.lstsq(_parted_columns(twists, part, after), twists.error.ravel())[0]
        early, late, common = map(_motion, np.split(change, 3))
        if part == "tool":
            tools = tools @ np.stack([early, late])
            stations = stations @ common
        else:
            stations = stations @ np.stack([early, late])
            tools = tools @ common
        scale = _scale(twists.error * scale)
    twists = _twists(arm, measured, stations[after], tools[after], scale)
    matrix = _parted_columns(twists, part, after)
    squares = float(np.sum(twists.error**2))
    dof = len(matrix) - matrix.shape[1]
    covariance = np.linalg.pinv(matrix.T @ matrix, hermitian=True) * (squares / dof)
    difference = np.hstack([-np.eye(TWIST), np.eye(TWIST)])
    covariance = difference @ covariance[:PLACED, :PLACED] @ difference.T
    jump = invert(tools[0]) @ tools[1]
    if part == "station":
        jump = stations[0] @ invert(stations[1])
        adjoint = np.linalg.inv(_adjoints(stations[:1])[0])
        covariance = adjoint @ covariance @ adjoint.T
    turn = Rotation.from_matrix(jump[:3, :3]).as_rotvec()
    shift = jump[:3, 3]
    size = twists.error * scale
    rms = np.sqrt(np.mean(np.sum(size[:, :3] ** 2, axis=1) + LEVER**2 * np.sum(size[:, 3:] ** 2, axis=1)))
    return Step(
        cut=cut,
        part=part,
        misfit=float(rms),
        angle=float(np.linalg.norm(turn)),
        angle_sigma=_sigma_along(turn, covariance[3:, 3:]),
        shift=float(np.linalg.norm(shift)),
        shift_sigma=_sigma_along(shift, covariance[:3, :3]),
    )


def _parted_columns(twists: Twists, part: str, after: np.ndarray) -> np.ndarray:
    """Return the columns (6 m, 18) of a part before and after a step, and of the other part.

    Args:
        twists: errors of m rows.
        part: the part that has the step.
        after: (m,) 1 at the rows after the step, else 0.
    """
    constant = SUBJECTS[part == "tool"]
    columns = (
        twists.columns(part, 1 - after),
        twists.columns(part, after),
        twists.columns(constant, np.ones(len(after))),
    )
    return np.hstack(columns)


def _sigma_along(vector: np.ndarray, covariance: np.ndarray) -> float:
    """Return the standard deviation of the length of a vector (3,) with this covariance (3, 3)."""
    along = vector / max(float(np.linalg.norm(vector)), 1e-15)
    return float(np.sqrt(along @ covariance @ along))


def _other_orders(arm: np.ndarray) -> Sequence[np.ndarray]:
    """Return the orders (m,) of an arm's poses (m, 4, 4) by their coordinates and by their rotations."""
    return list(np.argsort(_coordinates(arm), axis=0).T)


def _coordinates(arm: np.ndarray) -> np.ndarray:
    """Return positions and rotation vectors from the mean (m, 6) of poses (m, 4, 4)."""
    mean = average_pose(arm)[:3, :3]
    turns = Rotation.from_matrix(arm[:, :3, :3] @ mean.T).as_rotvec()
    return np.hstack([arm[:, :3, 3], turns])


def _twists(arm: np.ndarray, measured: np.ndarray, station: np.ndarray, tool: np.ndarray, scale: np.ndarray) -> Twists:
    """Return the twists from predicted to measured poses, divided by the standard deviations `scale` (6,).

    Args:
        arm, measured: (m, 4, 4) A_i and B_i.
        station, tool: (4, 4) or (m, 4, 4) S and X.
        scale: standard deviations of displacements [m] and rotations [rad].
    """
    reached = arm @ tool
    difference = invert(station @ reached) @ measured
    turn = Rotation.from_matrix(difference[:, :3, :3]).as_rotvec()
    error = np.hstack([difference[:, :3, 3], turn])
    by_tool = np.tile(np.eye(TWIST), (len(arm), 1, 1))
    by_station = _adjoints(reached)
    return Twists(error / scale, by_tool / scale[:, None], by_station / scale[:, None])


def _adjoints(poses: np.ndarray) -> np.ndarray:
    """Return the adjoints (m, 6, 6) of the inverses of poses (m, 4, 4), for twists with the displacement first."""
    transposed = np.swapaxes(poses[:, :3, :3], 1, 2)
    x, y, z = poses[:, :3, 3].T
    zero = np.zeros_like(x)
    cross = np.array([[zero, -z, y], [z, zero, -x], [-y, x, zero]]).transpose(2, 0, 1)
    result = np.zeros((len(poses), TWIST, TWIST))
    result[:, :3, :3] = transposed
    result[:, 3:, 3:] = transposed
    result[:, :3, 3:] = -transposed @ cross
    return result


def _motion(twist: np.ndarray) -> np.ndarray:
    """Return the motion (4, 4) of a small twist (6,), displacement before rotation."""
    return pose(Rotation.from_rotvec(twist[3:]).as_matrix(), twist[:3])


def _scale(error: np.ndarray) -> np.ndarray:
    """Return the rms displacements [m] and rotations [rad] per axis (6,) of twists (m, 6)."""
    rms = np.sqrt([np.mean(error[:, :3] ** 2), np.mean(error[:, 3:] ** 2)])
    return np.repeat(np.maximum(rms, MIN_NOISE), 3)
