"""Do the recorded joints turn the way the arm's do? Looked for with the nominal arm, base and tool placement free."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.data.poses.measurements import PoseMeasurements, Positions, take
from calib.errors import CalibError
from calib.geometry.accuracy import errors
from calib.geometry.first_guess import install
from calib.geometry.fit import polish_frames
from calib.geometry.installation import Installation
from calib.geometry.weighing import Settings
from calib.robot.kinematics import forward

SHORT = Settings(limit=20, passes=1)  # where base and tool settle at all they do so sooner


@dataclass(frozen=True)
class ReversedJoints:
    """Joints, from 0, with whose signs reversed the nominal arm explains more; what it leaves then and before [m]."""

    joints: tuple[int, ...]
    rms: float
    before: float


def reversed_joints(
    nominal: Installation, blocks: Sequence[PoseMeasurements], torques: Sequence[np.ndarray | None]
) -> ReversedJoints | None:
    """Return the joints whose reversal lets the nominal arm explain most; None where none does.

    One joint after the other, each time the one that helps most.

    Args:
        nominal: the arm as it was.
        blocks: the rows.
        torques: gravity torques (m, n) per block [N m], for deflections known from an earlier fit.
    """
    max_rows = 200  # rows of a block (our choice)
    chosen = [np.unique(np.linspace(0, len(block) - 1, max_rows).astype(int)) for block in blocks]
    few = [take(block, rows) for block, rows in zip(blocks, chosen)]
    pulled = [None if torque is None else torque[rows] for torque, rows in zip(torques, chosen)]
    signs = np.ones(nominal.chain.n)
    before = rms = _rms(nominal, few, pulled, signs)
    max_left = 0.8  # the error falls below this share with every further joint that is reversed (our choice)
    while (signs > 0.0).any():
        tried = {}
        for joint in np.flatnonzero(signs > 0.0).tolist():
            other = signs.copy()
            other[joint] = -1.0
            if _least(nominal, few, other) < max_left * rms:
                tried[joint] = _rms(nominal, few, pulled, other)
        best = min(tried, key=lambda joint: tried[joint], default=-1)
        if best < 0 or not tried[best] < max_left * rms:
            break
        signs[best], rms = -1.0, tried[best]
    found = tuple(np.flatnonzero(signs < 0.0).tolist())
    return ReversedJoints(found, rms, before) if found else None


def _least(nominal: Installation, blocks: Sequence[PoseMeasurements], signs: np.ndarray) -> float:
    """Return what no placement of base and tool can leave less than [m]; 0 where that is not known without a search.

    Positions y = B (R p + t) + b, with R, t the tip's by the joints and B, b, p the placements, are linear in B ⊗ p, B
    and b: 13 numbers per axis of y, free of each other and of other axes here.
    """
    squares, count = 0.0, 0
    for block in blocks:
        if nominal.known.terms or not isinstance(block, Positions):
            return 0.0
        tip = forward(nominal.chain, block.q * signs)
        columns = np.column_stack([tip[:, :3, :3].reshape(-1, 9), tip[:, :3, 3], np.ones(len(tip))])
        for tool in np.unique(block.tool):
            rows = block.tool == tool
            W, y = columns[rows], block.position[rows]
            squares += float(((y - W @ np.linalg.lstsq(W, y)[0]) ** 2).sum())
        count += len(block)
    return float(np.sqrt(squares / count))


def _rms(
    nominal: Installation, blocks: Sequence[PoseMeasurements], torques: Sequence[np.ndarray | None], signs: np.ndarray
) -> float:
    """Return what the nominal arm leaves [m], base and tool placed anew, with joints turning as `signs` (n,) say."""
    turned = [replace(block, q=block.q * signs) for block in blocks]
    try:
        placed = polish_frames(install(nominal.chain, turned, nominal.known), turned, SHORT, torques).cell
    except CalibError:
        return np.inf
    return float(np.sqrt(np.mean(errors(placed, turned, torques).main ** 2)))
