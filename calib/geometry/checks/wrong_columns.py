"""Do joints and axes count as the arm's do? The nominal arm, base and tool placement free, explains changed columns."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from calib.column_changes import Change, Explanation, best_changes, coupling, couplings, exchange, reversal
from calib.data.poses.measurements import PoseMeasurements, Poses, Positions, take
from calib.errors import CalibError
from calib.geometry.accuracy import errors
from calib.geometry.first_guess import install
from calib.geometry.fit import polish_frames
from calib.geometry.installation import Installation
from calib.geometry.weighing import Settings
from calib.robot.kinematics import forward

SHORT = Settings(limit=20, passes=1)  # where base and tool settle at all they do so sooner
FLIP = np.array([1.0, -1.0, 1.0])
Blocks = Sequence[PoseMeasurements]


def wrong_columns(
    nominal: Installation, blocks: Blocks, torques: Sequence[np.ndarray | None], mirrored: bool = False
) -> Explanation | None:
    """Return the changes of columns that let the nominal arm explain most, errors in m²; None where none counts.

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
    """Return blocks seen in a frame of the other hand: y turned; a rotation R becomes F R F."""
    found = []
    for block in blocks:
        if isinstance(block, Positions):
            block = replace(block, position=np.asarray(block.position) * FLIP)
        if isinstance(block, Poses):
            block = replace(block, quaternion=np.asarray(block.quaternion) * [-1.0, 1.0, -1.0, 1.0])
        found.append(block)
    return found


def _least(nominal: Installation, blocks: Blocks) -> np.ndarray:
    """Return what no placement of base and tool can leave less than [m²]; 0 where that is not known without a search.

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
    """Return the mean square that the nominal arm leaves [m²], base and tool placed anew."""
    try:
        placed = polish_frames(install(nominal.chain, blocks, nominal.known), blocks, SHORT, torques).cell
    except CalibError:
        return np.array([np.inf])
    return np.array([np.mean(errors(placed, blocks, torques).main ** 2)])
