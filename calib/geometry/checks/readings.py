"""Search for invalid readings: one value repeated at several postures, or the readings of one target in another.

A value is repeated where, for example, the instrument lost the target or wrote a placeholder.
"""

from collections.abc import Sequence
from itertools import combinations
from pathlib import Path

import numpy as np

from calib.data.poses.measurements import PoseMeasurements, Positions
from calib.errors import Finding, finding
from calib.geometry.installation import Installation
from calib.geometry.observation import positions, prepare

# largest difference of readings [m] that are treated as equal; readings of an instrument have noise (our choice)
SAME = 1e-8
# distance between predicted targets [m] above which equal readings are impossible (our choice)
MIN_APART = 1e-3
# smallest number of poses at which a copied target has the readings of another (our choice)
MIN_COPIES = 3


def repeated_readings(nominal: Installation, blocks: Sequence[PoseMeasurements]) -> list[Finding]:
    """Return findings on readings repeated at several postures, and on targets with the readings of another target.

    Args:
        nominal: the nominal arm, with stations and tools placed.
        blocks: the measurements.
    """
    findings: list[Finding] = []
    for block in blocks:
        if isinstance(block, Positions) and len(block) > 1:
            copies = _copied_targets(block)
            names = {str(copy.values["name"]) for copy in copies}
            findings += copies
            findings += _stale(nominal, block, names)
    return findings


def _readings(block: Positions) -> np.ndarray:
    """Return a number (m,) for each row's reading, equal for equal readings.

    Args:
        block: measured positions or poses; equal readings have equal coordinates.
    """
    rounded = np.round(block.position / SAME)
    _, number = np.unique(rounded, axis=0, return_inverse=True)
    return number.reshape(-1)


def _copied_targets(block: Positions) -> list[Finding]:
    """Return findings on targets whose readings equal those of another target at all poses where both were measured.

    Args:
        block: measured positions of several targets.
    """
    readings = _readings(block)
    # per target: its readings by row number
    reading_of_row = []
    for tool in range(len(block.tool_names)):
        rows = block.tool == tool
        reading_of_row.append(dict(zip(block.rows[rows].tolist(), readings[rows])))
    findings = list[Finding]()
    copied: set[int] = set()
    for first, second in combinations(range(len(block.tool_names)), 2):
        first_readings = reading_of_row[first]
        second_readings = reading_of_row[second]
        common = sorted(first_readings.keys() & second_readings.keys())
        equal = [row for row in common if first_readings[row] == second_readings[row]]
        if len(equal) < MIN_COPIES or second in copied:
            continue
        copied.add(second)
        rows = []
        if len(equal) < len(common):
            rows = [str(row) for row in equal]
        values = {
            "name": block.tool_names[second],
            "other": block.tool_names[first],
            "count": len(equal),
            "of": len(common),
            "rows": rows,
        }
        findings.append(finding("target-copied", file=_name(block), share=len(equal) / len(common), **values))
    return findings


def _stale(nominal: Installation, block: Positions, copied: set[str]) -> list[Finding]:
    """Return findings on readings that stay constant while the joints move the target.

    Args:
        nominal: the nominal arm, with stations and tools placed.
        block: measured positions.
        copied: names of targets whose readings are copies of another target's; they are skipped.
    """
    (prepared,) = prepare(nominal, [block])
    predicted = positions(nominal, prepared).T
    readings = _readings(block)
    findings = list[Finding]()
    for tool, name in enumerate(block.tool_names):
        rows = np.flatnonzero(block.tool == tool)
        if name in copied or len(rows) < 2:
            continue
        numbers, counts = np.unique(readings[rows], return_counts=True)
        for number in numbers[counts > 1]:
            rows_of_reading = rows[readings[rows] == number]
            distance = float(np.linalg.norm(np.ptp(predicted[rows_of_reading], axis=0)))
            if distance < MIN_APART:
                continue
            reading = block.position[rows_of_reading[0]]
            numbers_of_rows = [str(row) for row in block.rows[rows_of_reading]]
            reading_mm = [f"{1e3 * axis:.6g}" for axis in reading]
            values = {"name": name, "rows": numbers_of_rows, "value": reading_mm, "apart": distance}
            findings.append(finding("reading-repeated", file=_name(block), **values))
    return findings


def _name(block: PoseMeasurements) -> str:
    return Path(block.file).name or "measurements"
