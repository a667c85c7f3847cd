"""Search for invalid readings: one value repeated at several postures, or the readings of one target in another.

A value is repeated where, for example, the instrument lost the target or wrote a placeholder. Such readings count as
not seen: `without_unseen` leaves them out of a fit. Where all later rows are paired with wrong joint values, the
reading was stored twice instead, and stays.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations
from pathlib import Path

import numpy as np

from calib.data.poses.measurements import Block, PoseMeasurements, Positions, take
from calib.errors import CalibError, Finding, finding
from calib.geometry.checks.wrong_rows import slips
from calib.geometry.first_guess import install
from calib.geometry.installation import Installation
from calib.geometry.observation import positions, prepare
from calib.robot.chain import Chain

# largest difference of readings [m] that are treated as equal; readings of an instrument have noise (our choice)
SAME = 1e-8
# distance between predicted targets [m] above which equal readings are impossible (our choice)
MIN_APART = 1e-3
# distance of two targets [m] below which one has the readings of the other, with the noise of a filter or of a
# conversion: no two targets are so close (our choice)
TOUCHING = 1e-4
# share of a target's rows above which repeated readings are no exceptions, and are left in (our choice)
MOST_ROWS = 0.5
# smallest distance of a single reading of zeros [m] from the nominal arm's prediction, and its smallest ratio to the
# median distance, at which it is a placeholder (our choice)
MIN_OFF = 0.05
MIN_TIMES_OFF = 10.0


@dataclass(frozen=True)
class Copies:
    """Rows in which two targets have the same reading.

    Attributes:
        first, second: indices of the two targets.
        rows: numbers of these rows in the file.
        common: number of rows with both targets.
    """

    first: int
    second: int
    rows: tuple[int, ...]
    common: int


@dataclass(frozen=True)
class Repeated:
    """Rows in which a target has the same reading, although the joints moved it.

    Attributes:
        tool: index of the target.
        index: indices of the rows in the block.
        apart: distance by which the joints moved the target [m]; of a single row, its distance from the prediction.
    """

    tool: int
    index: tuple[int, ...]
    apart: float


def repeated_readings(nominal: Installation, blocks: Sequence[PoseMeasurements]) -> list[Finding]:
    """Return findings on readings repeated at several postures, and on targets with the readings of another target.

    Args:
        nominal: the nominal arm, with stations and tools placed.
        blocks: the measurements.
    """
    findings: list[Finding] = []
    for block in blocks:
        if isinstance(block, Positions) and len(block) > 1:
            copies = _copies(block)
            copied = {entry.second for entry in copies}
            findings += map(partial(_says_copies, block), copies)
            for entry in _repeated(nominal, block):
                if entry.tool not in copied:
                    findings.append(_says_repeated(block, entry))
    return findings


def without_unseen(chain: Chain, block: Block, copies_accepted: bool = False) -> tuple[Block, list[Finding]]:
    """Return a block without readings that are placeholders, repeated or copied, and findings that name them.

    Args:
        chain: the nominal arm.
        block: measurements of any kind.
        copies_accepted: whether two targets with one reading are intended, and stay.
    """
    if not isinstance(block, Positions) or len(block) < 2:
        return block, []
    findings = []
    unseen = np.zeros(len(block), dtype=bool)
    if not copies_accepted:
        for entry in _copies(block):
            findings.append(_says_copies(block, entry))
            unseen |= np.isin(block.tool, _false_targets(block, entry)) & np.isin(block.rows, entry.rows)
    remainder = take(block, np.flatnonzero(~unseen))
    try:
        repeated = _repeated(install(chain, [remainder]), remainder)
    except CalibError:  # too few rows, or another robot's: the fit says so
        repeated = []
    index = np.flatnonzero(~unseen)
    for entry in repeated:
        if len(entry.index) <= MOST_ROWS * np.sum(remainder.tool == entry.tool):
            findings.append(_says_repeated(remainder, entry))
            unseen[index[list(entry.index)]] = True
    if not unseen.any():
        return block, []
    return _seen(block, ~unseen), findings  # ty: ignore[invalid-explicit-return]


def _seen(block: Positions, visible: np.ndarray) -> Positions:
    """Return the rows of a block that were seen, without targets that were seen in no row.

    Args:
        block: the measurements.
        visible: mask (m,) of its rows.
    """
    remainder = take(block, np.flatnonzero(visible))
    targets = np.unique(remainder.tool)
    names = tuple(map(block.tool_names.__getitem__, targets))
    return replace(remainder, tool=np.searchsorted(targets, remainder.tool), tool_names=names)


def _readings(block: Positions) -> np.ndarray:
    """Return a number (m,) for each row's reading, equal for equal readings.

    Args:
        block: measured positions or poses; equal readings have equal coordinates.
    """
    rounded = np.round(block.position / SAME)
    _, number = np.unique(rounded, axis=0, return_inverse=True)
    return number.reshape(-1)


def _copies(block: Positions) -> list[Copies]:
    """Return for each target the rows in which it is where an earlier one is; zeros are no reading.

    Args:
        block: measured positions of several targets.
    """
    is_zero = np.all(np.abs(block.position) < SAME, axis=1)
    # per target: its position by row number
    position_of_row = []
    for tool in range(len(block.tool_names)):
        rows = (block.tool == tool) & ~is_zero
        position_of_row.append(dict(zip(block.rows[rows].tolist(), block.position[rows])))
    result = []
    copied: set[int] = set()
    for first, second in combinations(range(len(block.tool_names)), 2):
        first_positions = position_of_row[first]
        second_positions = position_of_row[second]
        common = sorted(first_positions.keys() & second_positions.keys())
        equal = [row for row in common if np.linalg.norm(first_positions[row] - second_positions[row]) < TOUCHING]
        if equal and second not in copied:
            copied.add(second)
            result.append(Copies(first, second, tuple(equal), len(common)))
    return result


def _false_targets(block: Positions, copies: Copies) -> list[int]:
    """Return which of two targets with one reading were not seen there: by their distances to the other targets.

    A target that is a copy in every row was not seen. Elsewhere the distances to other targets in the same rows are
    compared with those in the rows without copies. Without other targets neither counts.

    Args:
        block: measured positions of several targets.
        copies: the two targets and their rows.
    """
    if len(copies.rows) == copies.common:
        return [copies.second]
    neighbours = [tool for tool in range(len(block.tool_names)) if tool not in (copies.first, copies.second)]
    first = [_distance_change(block, copies.first, neighbour, copies.rows) for neighbour in neighbours]
    second = [_distance_change(block, copies.second, neighbour, copies.rows) for neighbour in neighbours]
    if not neighbours or np.isnan(first + second).any() or sum(first) == sum(second):
        return [copies.first, copies.second]
    return [copies.second if sum(first) < sum(second) else copies.first]


def _distance_change(block: Positions, tool: int, neighbour: int, rows: Sequence[int]) -> float:
    """Return by how much the distance [m] of two targets in some rows differs from the median in the other rows.

    NaN without rows of both kinds.

    Args:
        block: measured positions of several targets.
        tool, other: indices of the two targets.
        rows: numbers of the rows in question.
    """
    position_of = []
    for target in (tool, neighbour):
        index = np.flatnonzero(block.tool == target)
        position_of.append(dict(zip(block.rows[index].tolist(), block.position[index])))
    distances: dict[bool, list[float]] = {True: [], False: []}
    for row in position_of[0].keys() & position_of[1].keys():
        distance = float(np.linalg.norm(position_of[0][row] - position_of[1][row]))
        distances[row in rows].append(distance)
    if not distances[True] or not distances[False]:
        return float("nan")
    return abs(float(np.median(distances[True]) - np.median(distances[False])))


def _repeated(nominal: Installation, block: Positions) -> list[Repeated]:
    """Return the readings that stay constant while the joints move the target, and single readings of zeros.

    A reading that was stored twice, behind which all rows are shifted, is left out.

    Args:
        nominal: the nominal arm, with stations and tools placed.
        block: measured positions.
    """
    (prepared,) = prepare(nominal, [block])
    predicted = positions(nominal, prepared).T
    off = np.linalg.norm(predicted - block.position, axis=1)
    is_zero = np.all(np.abs(block.position) < SAME, axis=1)
    readings = _readings(block)
    result = []
    for tool in range(len(block.tool_names)):
        rows = np.flatnonzero(block.tool == tool)
        if len(rows) < 2:
            continue
        numbers, counts = np.unique(readings[rows], return_counts=True)
        for number in numbers[counts > 1]:
            index = rows[readings[rows] == number]
            distance = float(np.linalg.norm(np.ptp(predicted[index], axis=0)))
            entry = Repeated(tool, tuple(index.tolist()), distance)
            if distance >= MIN_APART and not _stored_twice(nominal, block, entry):
                result.append(entry)
        zeros = rows[is_zero[rows]]
        if len(zeros) == 1 and off[zeros[0]] > max(MIN_OFF, MIN_TIMES_OFF * float(np.median(off[rows]))):
            result.append(Repeated(tool, tuple(zeros.tolist()), float(off[zeros[0]])))
    return result


def _stored_twice(nominal: Installation, block: Positions, repeated: Repeated) -> bool:
    """Return whether two successive rows repeat a good reading, and all later ones have the joint values of other rows.

    The search for shifted rows then names the second one.

    Args:
        nominal: the nominal arm.
        block: measured positions.
        repeated: the rows with the same reading.
    """
    rows = block.rows[list(repeated.index)]
    return len(rows) == 2 and rows[1] == rows[0] + 1 and slips(nominal, block, int(rows[1]))


def _says_copies(block: Positions, copies: Copies) -> Finding:
    rows = []
    if len(copies.rows) < copies.common:
        rows = list(map(str, copies.rows))
    values = {
        "name": block.tool_names[copies.second],
        "other": block.tool_names[copies.first],
        "count": len(copies.rows),
        "of": copies.common,
        "rows": rows,
    }
    return finding("target-copied", file=_name(block), **values)


def _says_repeated(block: Positions, repeated: Repeated) -> Finding:
    index = list(repeated.index)
    rows = list(map(str, block.rows[index].tolist()))
    reading_mm = [f"{1e3 * axis:.6g}" for axis in block.position[index[0]]]
    name = block.tool_names[repeated.tool]
    return finding("reading-repeated", file=_name(block), name=name, rows=rows, value=reading_mm, apart=repeated.apart)


def _name(block: PoseMeasurements) -> str:
    return Path(block.file).name or "measurements"
