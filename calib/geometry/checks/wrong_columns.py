"""Checks for changed columns (joint signs, exchanged joints, mirrored axes) and for a scale factor on all lengths.

The nominal arm, base and tool placement free, explains rows as measured and with each change; what an arm's own errors
leave is small against either.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from calib.column_changes import Change, Explanation, best_changes, coupling, couplings, exchange, reversal
from calib.data.poses.measurements import PoseMeasurements, Poses, Positions, take
from calib.errors import CalibError
from calib.geometry.accuracy import errors
from calib.geometry.first_guess import install
from calib.geometry.fit import polish_frames
from calib.geometry.installation import Installation
from calib.geometry.observation import observe, prepare
from calib.geometry.parameters import layout
from calib.geometry.result import GeometricFit
from calib.geometry.weighing import Settings
from calib.robot.chain import element_length
from calib.robot.kinematics import forward

Torques = Sequence[np.ndarray | None] | None


@dataclass(frozen=True)
class Scale:
    """One factor on all measured lengths, fitted together with base and tool placement of the nominal arm.

    Attributes:
        factor: measured over the arm's.
        sigma: of the factor.
        explained: share of the squares of the nominal arm's errors that it takes away.
    """

    factor: float
    sigma: float
    explained: float


def scale_of(nominal: Installation, blocks: Sequence[PoseMeasurements], torques: Torques = None) -> Scale | None:
    """Return the scale factor of the instrument's lengths with its sigma; None without positions.

    Args:
        nominal: the arm with base and tool placement fitted for it.
        blocks: of any kinds; those that measure positions count.
    """
    frames, rows, columns = layout(nominal).frame_index, [], []
    for block in prepare(nominal, blocks, torques):
        if not isinstance(block.measured, Positions):
            continue
        part = next(part for part in observe(nominal, block, frames) if part.label == "position")
        seen = np.asarray(block.measured.position)[part.index]
        rows.append(part.value.ravel())
        columns.append(
            np.column_stack([part.jacobian.reshape(len(frames), -1).T, (seen - seen.mean(axis=0)).T.ravel()])
        )
    if not rows:
        return None
    value, matrix = np.concatenate(rows), np.concatenate(columns)
    size = np.maximum(np.linalg.norm(matrix, axis=0), 1e-12)
    return _scale(value, matrix / size, float(size[-1]))


def _scale(value: np.ndarray, matrix: np.ndarray, size: float) -> Scale | None:
    """Return the scale s of y - p = (1 - 1/s) y, fitted by the last column together with all others."""
    others, last = matrix[:, :-1], matrix[:, -1]
    left, own = (x - others @ np.linalg.lstsq(others, x, rcond=1e-9)[0] for x in (value, last))
    power, count = float(own @ own), len(value) - matrix.shape[1]
    if count < 1 or power < 1e-12:
        return None
    slope = float(own @ left) / power
    squares = float(left @ left)
    rest = max(squares - slope**2 * power, 0.0)
    return Scale(
        1.0 / (1.0 - slope / size), float(np.sqrt(rest / count / power)) / size, 1.0 - rest / max(squares, 1e-300)
    )


def length_factor(fit: GeometricFit) -> Scale | None:
    """Return the common factor between fitted and nominal lengths of an arm; None for fewer than two fitted lengths.

    Its sigma follows from the measurements; the explained share of the lengths' change shows whether it is one factor.
    """
    chain, split, candidates = fit.start.chain, fit.split, fit.candidates
    if split is None or candidates is None:
        return None
    arm = len(chain.elements)
    own = np.array([element_length(chain, int(k)) if k < arm else 0.0 for k in candidates])
    total = own[split.kept] + split.coefficients @ own[split.dropped]  # with those that are merged into them
    place = {int(k): number for number, k in enumerate(fit.free)}
    used = [(place[int(k)], int(k), size) for k, size in zip(candidates[split.kept], total) if int(k) in place]
    min_length = 0.01  # [m]: lengths below say nothing of a factor
    used = [one for one in used if one[1] < arm and chain.elements[one[1]].axis[0] == "t" and abs(one[2]) > min_length]
    if len(used) < 2:
        return None
    index, elements, lengths = (np.array(each) for each in zip(*used))
    grown = fit.cell.chain.values[elements] - chain.values[elements]
    weight = np.linalg.pinv(fit.estimate.covariance[np.ix_(index, index)], hermitian=True)
    power, common = float(lengths @ weight @ lengths), float(lengths @ weight @ grown)
    if not power > 0.0:
        return None
    share = common**2 / power / max(float(grown @ weight @ grown), 1e-300)
    return Scale(1.0 + common / power, power**-0.5, share)


SHORT = Settings(limit=20, passes=1)  # where base and tool settle at all they do so sooner
FLIP = np.array([1.0, -1.0, 1.0])
Blocks = Sequence[PoseMeasurements]


def wrong_columns(
    nominal: Installation, blocks: Blocks, torques: Sequence[np.ndarray | None], mirrored: bool = False
) -> Explanation | None:
    """Return the change of columns with the smallest error of the nominal arm [m²]; None without a significant one.

    Args:
        nominal: the arm as it was.
        blocks: the rows.
        torques: gravity torques (m, n) per block [N m], for deflections known from an earlier fit.
        mirrored: whether an instrument with left-handed axes is tried, too.
    """
    n, max_rows = nominal.chain.n, 200  # rows of a block (our choice)
    chosen = [np.unique(np.linspace(0, len(block) - 1, max_rows).astype(int)) for block in blocks]
    few = [take(block, rows) for block, rows in zip(blocks, chosen)]
    pulled = [None if torque is None else torque[rows] for torque, rows in zip(torques, chosen)]
    surely = 1.0 / 3.0  # share of the error that may be left where no second change goes with it (our choice)
    table = [Change("joint-sign", _of_joints(reversal(n, j)), (j,), max_left=0.8) for j in range(n)]
    table += [
        Change("joint-coupled", _of_joints(coupling(n, j, k, way)), (j, k), {"way": "+" if way > 0 else "-"}, surely)
        for j, k, way in couplings(n)
    ]
    pairs = combinations(range(n), 2)
    table += [Change("joints-exchanged", _of_joints(exchange(n, *pair)), pair, max_left=surely) for pair in pairs]
    if mirrored and any(isinstance(block, Positions) for block in blocks):
        table.append(Change("left-handed", _mirrored, max_left=surely))
    return best_changes(
        few, table, lambda changed: _left(nominal, changed, pulled), lambda changed: _least(nominal, changed), n
    )


def _of_joints(matrix: np.ndarray) -> Callable[[Blocks], Blocks]:
    return lambda blocks: [replace(block, q=block.q @ matrix.T) for block in blocks]


def _mirrored(blocks: Blocks) -> Blocks:
    """Return blocks in a frame of opposite handedness: y changes its sign, a rotation R becomes F R F."""
    found = []
    for block in blocks:
        if isinstance(block, Positions):
            block = replace(block, position=np.asarray(block.position) * FLIP)
        if isinstance(block, Poses):
            block = replace(block, quaternion=np.asarray(block.quaternion) * [-1.0, 1.0, -1.0, 1.0])
        found.append(block)
    return found


def _least(nominal: Installation, blocks: Blocks) -> np.ndarray:
    """Return a lower bound of the mean squared error over all base and tool placements [m²]; 0 without a closed form.

    Positions y = B (R p + t) + b, with R, t the tip's by the joints and B, b, p the placements, are linear in B ⊗ p, B
    and b: 13 numbers per axis of y, free of each other and of other axes here.
    """
    squares, count = 0.0, 0
    for block in blocks:
        if nominal.known.terms or not isinstance(block, Positions):
            return np.zeros(1)
        tip = forward(nominal.chain, block.q)
        columns = np.column_stack([tip[:, :3, :3].reshape(-1, 9), tip[:, :3, 3], np.ones(len(tip))])
        for tool in np.unique(block.tool):
            rows = block.tool == tool
            W, y = columns[rows], block.position[rows]
            squares += float(((y - W @ np.linalg.lstsq(W, y)[0]) ** 2).sum())
        count += len(block)
    return np.array([squares / count])


def _left(nominal: Installation, blocks: Blocks, torques: Sequence[np.ndarray | None]) -> np.ndarray:
    """Return the mean squared error of the nominal arm [m²] after fitting base and tool placement."""
    try:
        placed = polish_frames(install(nominal.chain, blocks, nominal.known), blocks, SHORT, torques).cell
    except CalibError:
        return np.array([np.inf])
    return np.array([np.mean(errors(placed, blocks, torques).main ** 2)])
