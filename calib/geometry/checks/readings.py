"""Readings that are none: one number at several postures (a lost beam, a placeholder), copies of another target."""

from collections.abc import Sequence
from itertools import combinations
from pathlib import Path

import numpy as np

from calib.data.poses.measurements import PoseMeasurements, Positions
from calib.errors import Finding, finding
from calib.geometry.installation import Installation
from calib.geometry.observation import positions, prepare

SAME = 1e-8  # [m]: readings that differ by no more are one number; instruments have noise (our choice)
MIN_APART = 1e-3  # [m] between predicted targets from which on one reading cannot be both (our choice)
MIN_COPIES = 3  # poses at which a target has the numbers of another (our choice)


def repeated_readings(nominal: Installation, blocks: Sequence[PoseMeasurements]) -> list[Finding]:
    """Return findings on rows with one reading at several postures, and on targets with the readings of another.

    Args:
        nominal: the arm as it was, placed.
        blocks: the rows.
    """
    result: list[Finding] = []
    for block in blocks:
        if isinstance(block, Positions) and len(block) > 1:
            copies = _copied_targets(block)
            result += [*copies, *_stale(nominal, block, {str(one.values["name"]) for one in copies})]
    return result


def _readings(block: Positions) -> np.ndarray:
    """Return the number of each row's reading (m,), the same for equal ones."""
    return np.unique(np.round(block.position / SAME), axis=0, return_inverse=True)[1].reshape(-1)


def _copied_targets(block: Positions) -> list[Finding]:
    """Return findings on targets that have the readings of another one in all poses that measured both."""
    reading, result = _readings(block), list[Finding]()
    copied: set[int] = set()
    for first, second in combinations(range(len(block.tool_names)), 2):
        at = [
            dict(zip(block.rows[block.tool == tool].tolist(), reading[block.tool == tool])) for tool in (first, second)
        ]
        common = sorted(at[0].keys() & at[1].keys())
        equal = [row for row in common if at[0][row] == at[1][row]]
        if len(equal) < MIN_COPIES or second in copied:
            continue
        copied.add(second)
        names = [block.tool_names[tool] for tool in (second, first)]
        rows = [] if len(equal) == len(common) else [str(row) for row in equal]
        values = {"name": names[0], "other": names[1], "count": len(equal), "of": len(common), "rows": rows}
        result.append(finding("target-copied", file=_name(block), share=len(equal) / len(common), **values))
    return result


def _stale(nominal: Installation, block: Positions, copied: set[str]) -> list[Finding]:
    """Return findings on the readings of a target that stay while the joints move it."""
    (prepared,) = prepare(nominal, [block])
    point, readings, result = positions(nominal, prepared).T, _readings(block), list[Finding]()
    for tool, name in enumerate(block.tool_names):
        rows = np.flatnonzero(block.tool == tool)
        if name in copied or len(rows) < 2:
            continue
        numbers, count = np.unique(readings[rows], return_counts=True)
        for number in numbers[count > 1]:
            of_reading = rows[readings[rows] == number]
            apart = float(np.linalg.norm(np.ptp(point[of_reading], axis=0)))
            if apart < MIN_APART:
                continue
            value = [f"{1e3 * axis:.6g}" for axis in block.position[of_reading[0]]]
            named = [str(row) for row in block.rows[of_reading]]
            values = {"name": name, "rows": named, "value": value, "apart": apart}
            result.append(finding("reading-repeated", file=_name(block), **values))
    return result


def _name(block: PoseMeasurements) -> str:
    return Path(block.file).name or "measurements"
