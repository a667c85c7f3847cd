"""Search for rows paired with the joint values of other rows, and for files with rows of two targets.

Both hypotheses are tested by the least error of the arm over all placements of base and tool. Predicted positions are y
= B (R p + t) + b, with R, t the tip's pose at the joint values, B, b the base's placement and p the target's position
on the tool. They are linear in B ⊗ p, B and b: 13 numbers per axis of y.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from calib.column_changes import Change
from calib.data.poses.measurements import PoseMeasurements, Poses, Positions, take
from calib.errors import CalibError
from calib.geometry.accuracy import errors
from calib.geometry.checks import row_lags
from calib.geometry.first_guess import install
from calib.geometry.fit import polish_frames
from calib.geometry.installation import Installation
from calib.geometry.weighing import Settings
from calib.records import evenly
from calib.robot.kinematics import forward
from calib.transforms import from_quaternion

# shifts in rows between measurements and joint values that are tried, as by a lost point or a header line
SHIFTS = (1, -1, 2, -2)
# smallest number of shifted rows with joint values: hardly a row of another pose fits within millimetres by chance
MIN_SHIFTED = 1
# largest rms error of the shifted rows, over that of the rows in place: the errors of a nominal arm at different poses
# (our choice)
MAX_TIMES_IN_PLACE = 3.0
# smallest ratio of the rms errors without a repeated reading, and with a shift there (our choice)
MIN_SLIP = 3.0
# smallest share of the shifted rows whose joint values are available, not held out (our choice)
MIN_PAIRED = 0.5
# number of first rows of a shift that are tried at once, before the rows between the best ones (our choice)
MAX_CUTS = 120
# smallest number of rows in which two targets are searched (our choice)
MIN_MIXED = 24
# squared error that a row may add, over the mean of all rows, where it fits as well as they do (our choice)
TIED = 9.0
# [m] rms error below which it is rounding: sums of squares of positions of some metres have 1e-15 m² of it
POSITION_ROUNDING = 1e-7
# largest number of iterations of the assignment of rows to targets; a few are needed
MAX_ROUNDS = 50
# size of a combination of columns, relative to the largest, below which it is rounding: some 1e6 roundings of double
# precision, for products of many rows (our choice)
COLUMN_ROUNDING = 1e-10
# the same of sums of products of orthonormal columns, as their eigenvalues: a combination of 1e-5 of the largest size,
# whose square is that far above rounding (our choice)
PRODUCT_ROUNDING = 1e-10
# a robust fit, since orientations with angles beyond the range of a convention were lost, and a few rows are gross
ROBUST = Settings(loss="cauchy", limit=40, passes=4)
Blocks = Sequence[PoseMeasurements]


def least_error(nominal: Installation, blocks: Blocks) -> np.ndarray:
    """Return the least mean squared error [m²] (1,) over all placements of base and tool; 0 for too few positions.

    Args:
        nominal: the nominal arm.
        blocks: measured positions; with a block of another kind, 0 is returned.
    """
    squares = 0.0
    count = 0
    for block in blocks:
        if nominal.known.terms or not isinstance(block, Positions):
            return np.zeros(1)
        columns = _columns(nominal, block)
        for tool in np.unique(block.tool):
            rows = block.tool == tool
            residual = _unexplained(columns[rows], block.position[rows])
            squares += float((residual**2).sum())
        count += len(block)
    return np.array([squares / max(count, 1)])


def _columns(nominal: Installation, block: Positions) -> np.ndarray:
    """Return the columns (m, 13) of the linear position model: the nine entries of R, the three of t, and 1.

    Args:
        nominal: the nominal arm, which provides the tip's pose R, t in each row.
        block: measured positions of m rows.
    """
    tip = forward(nominal.chain, block.q)
    rotation = tip[:, :3, :3].reshape(-1, 9)
    return np.column_stack([rotation, tip[:, :3, 3], np.ones(len(tip))])


def _unexplained(columns: np.ndarray, position: np.ndarray) -> np.ndarray:
    """Return the residual (m, 3) of the linear least-squares fit of positions by columns.

    Args:
        columns: (m, 13) columns of the linear position model, computed by `_columns`.
        position: (m, 3) measured positions [m].
    """
    return position - columns @ np.linalg.lstsq(columns, position)[0]


def row_shifts(nominal: Installation, blocks: Blocks, max_left: float) -> list[Change]:
    """Return possible changes to the blocks: from some row on, measurements are paired with joint values of other rows.

    The other rows are a fixed number of rows further down or up: any number for poses, up to two for positions.

    Args:
        nominal: the nominal arm.
        blocks: the measurements; row numbers missing in a block are rows that were held out.
        max_left: largest mean squared error with such a shift, as a share of that without it.
    """
    changes = []
    for number, block in enumerate(blocks):
        if not isinstance(block, Positions) or nominal.known.terms:
            continue
        values: dict[str, object] = {"file": block.file, "what": "joints", "remedy": "calib join --by geometry"}
        if nominal.chain.is_free_flyer:
            values |= {"what": "the robot's poses", "remedy": None}
        for shift, first in _shifts(nominal, block):
            direction = "down" if shift > 0 else "up"
            values = values | {"first": first, "by": abs(shift), "way": direction}
            values["rows"] = "row" if abs(shift) == 1 else "rows"
            make = partial(_shifted_block, number, first, shift)
            changes.append(Change("rows-shifted", make, (), values, max_left))
    return changes


def _shifts(nominal: Installation, block: Positions) -> Iterator[tuple[int, int]]:
    """Yield likely shifts, each with the row from which on it explains the measurements best.

    Args:
        nominal: the nominal arm.
        block: measured positions, or poses.
    """
    candidates: list[tuple[int, int]] = []
    if isinstance(block, Poses) and len(np.unique(block.tool)) == 1 and len(np.unique(block.rows)) == len(block):
        arm, measured = (
            _by_row(forward(nominal.chain, block.q), block),
            _by_row(from_quaternion(block.position, block.quaternion), block),
        )
        lag = row_lags.last_lag(arm, measured)
        if lag:
            candidates.append((lag, int(block.rows.min()) + row_lags.first_of_lag(arm, measured, lag)))
    # of poses, too: angles choose no lag of the last few rows
    columns = _independent(_columns(nominal, block))
    for shift in SHIFTS:
        cut = _best_cut(columns, block, shift)
        if cut is not None and cut.may_be_slip:
            candidates.append((shift, cut.first))
    for shift, first in candidates:
        if _better_than_in_place(nominal, block, first, shift):
            yield shift, first


class _Cut(NamedTuple):
    """Row from which on a shift explains positions best, and mean squared errors [m²] with it and in place."""

    first: int
    after: float
    in_place: float

    @property
    def may_be_slip(self) -> bool:
        """Whether a slip is possible: at best, rows that lose their joint values have none of the error in place."""
        least = MIN_PAIRED * MIN_SLIP**2 * self.after
        return self.in_place >= least or self.in_place <= POSITION_ROUNDING**2


def _better_than_in_place(nominal: Installation, block: Positions, first: int, shift: int) -> bool:
    """Return whether rows fit far better shifted than in place, and about as well as the rows before them.

    Rows in place are compared without those that a shift leaves without joint values: to leave out a gross last row is
    no shift.

    Args:
        nominal: the nominal arm.
        block: measured positions.
        first: row number from which on the joint values are shifted.
        shift: number of rows; negative: rows further up.
    """
    shifted = _shifted(block, first, shift)
    in_place = take(block, np.flatnonzero(np.isin(block.rows, shifted.rows)))
    before = float(least_error(nominal, [in_place])[0])
    after = float(least_error(nominal, [shifted])[0])
    # as few rows as the model has columns are fitted exactly in any order
    if POSITION_ROUNDING**2 < before < MIN_SLIP**2 * after:
        return False
    is_shifted = shifted.rows >= first
    if not is_shifted.any():
        # beside a row that is missing, a shift may leave all others without joint values
        return False
    if is_shifted.all():
        return True
    try:
        placed = polish_frames(install(nominal.chain, [shifted]), [shifted], ROBUST).cell
    except CalibError:
        # too few rows to place an instrument
        return False
    squares = errors(placed, [shifted]).main ** 2
    return bool(squares[is_shifted].mean() < MAX_TIMES_IN_PLACE**2 * squares[~is_shifted].mean())


def slips(nominal: Installation, block: Positions, row: int) -> bool:
    """Return whether readings from a row on, which repeats the one before, belong to the joint values one row up.

    They do where the least error with these is far below that with all rows in place but the two equal readings.

    Args:
        nominal: the nominal arm.
        block: measured positions.
        row: number of the second row with the same reading.
    """
    if nominal.known.terms or row not in _first_rows(block, -1):
        return False
    without = take(block, np.flatnonzero((block.rows != row) & (block.rows != row - 1)))
    before = float(least_error(nominal, [without])[0])
    after = float(least_error(nominal, [_shifted(block, row, -1)])[0])
    return before > MIN_SLIP**2 * after


def _by_row(poses: np.ndarray, block: Positions) -> np.ndarray:
    """Return poses (m, 4, 4) of a block's rows by their numbers in the file; NaN for absent numbers."""
    first = int(block.rows.min())
    result = np.full((int(block.rows.max()) - first + 1, 4, 4), np.nan)
    result[block.rows - first] = poses
    return result


def _best_cut(columns: np.ndarray, block: Positions, shift: int) -> _Cut | None:
    """Return the row from which on a shift by `shift` rows explains the positions best; None where rows are too few.

    Args:
        columns: (m, r) independent columns of the linear position model.
        block: measured positions.
        shift: number of rows by which the joint values are shifted down; negative for up.
    """
    numbers = _first_rows(block, shift)
    if len(numbers) < MIN_SHIFTED or len(_shifted(block, 0, shift)) < MIN_PAIRED * len(block):
        return None

    cut_errors = _CutErrors.of(columns, block, shift)
    coarse = numbers[evenly(len(numbers), MAX_CUTS)]
    best = coarse[np.argmin(cut_errors.at(coarse))]
    around = numbers[np.abs(numbers - best) < max(len(numbers) // MAX_CUTS, 1)]
    best = int(around[np.argmin(cut_errors.at(around))])
    later = numbers[numbers >= best]
    squares = cut_errors.at(later)
    in_place = cut_errors.at(np.array([block.rows.max() + 1]))
    return _Cut(_last_as_good(squares, later, len(block)), float(squares[0]), float(in_place[0]))


def _first_rows(block: Positions, shift: int) -> np.ndarray:
    """Return the row numbers from which on a shift would concern at least `MIN_SHIFTED` rows with joint values."""
    numbers = np.unique(block.rows)
    return numbers[: max(len(numbers) - MIN_SHIFTED - abs(shift) + 1, 0)]


def _last_as_good(squares: np.ndarray, numbers: np.ndarray, count: int) -> int:
    """Return the last of successive rows from which on a shift explains the positions as well as from the first one.

    Where a row is repeated, or lost, the rows beside it fit with both joint values: as few rows as possible are
    accused.

    Args:
        squares: (k,) mean squared errors [m²] with the shift from each row on.
        numbers: (k,) their row numbers, the best one first.
        count: number of rows.
    """
    least = max(float(squares[0]), POSITION_ROUNDING**2)
    is_worse = count * squares >= (count + TIED) * least
    if not is_worse.any():
        return int(numbers[-1])
    return int(numbers[np.argmax(is_worse) - 1])


@dataclass(frozen=True, eq=False)
class _CutErrors:
    """Errors of a block whose joint values are shifted from some row on, for every such row from the same sums.

    The rows of a target contribute products of their columns, with their own joint values before the cut and with the
    shifted ones behind it. The least squares of all cuts follow from sums of these products.

    Attributes:
        gap: number of rows behind the cut that have no joint values.
        targets: for each target, its rows in order.
    """

    gap: int
    targets: tuple[_TargetRows, ...]

    @classmethod
    def of(cls, columns: np.ndarray, block: Positions, shift: int) -> _CutErrors:
        """Return the errors of a block with joint values shifted by `shift` rows, as of `_shifted`.

        Args:
            columns: (m, r) independent columns of the linear position model.
            block: measured positions.
            shift: number of rows; negative: rows further up.
        """
        centred = block.position - block.position.mean(axis=0)
        unshifted = _partners(block.rows, block.rows)
        shifted = _partners(block.rows, block.rows + shift)
        order = np.argsort(block.rows, kind="stable")
        targets = []
        for tool in np.unique(block.tool):
            rows = order[block.tool[order] == tool]
            before = np.hstack([columns[unshifted[rows]], centred[rows]])
            behind = np.hstack([columns[shifted[rows]], centred[rows]])
            is_paired = shifted[rows] >= 0
            behind[~is_paired] = 0.0
            targets.append(_TargetRows(block.rows[rows], before, behind, is_paired))
        return cls(max(-shift, 0), tuple(targets))

    def at(self, first: np.ndarray) -> np.ndarray:
        """Return the mean squared error [m²] with the joint values shifted from each row number `first` (k,) on.

        Without any row, the error is 0.

        Args:
            first: rising row numbers.
        """
        squares = np.zeros(len(first))
        count = np.zeros(len(first))
        for target in self.targets:
            cut = np.searchsorted(target.numbers, first)
            start = np.searchsorted(target.numbers, first + self.gap)
            behind = _sums_before(target.behind, np.append(start, len(target.numbers)))
            sums = _sums_before(target.before, cut) + behind[-1] - behind[:-1]
            squares += _unexplained_squares(sums)
            paired_before = np.concatenate([[0], np.cumsum(target.is_paired)])
            count += cut + paired_before[-1] - paired_before[start]
        return squares / np.maximum(count, 1)


class _TargetRows(NamedTuple):
    """Rows of one target by their numbers (m,): columns of the model and positions (m, w), before and behind a cut.

    `is_paired` (m,) tells which rows have joint values behind the cut.
    """

    numbers: np.ndarray
    before: np.ndarray
    behind: np.ndarray
    is_paired: np.ndarray


def _independent(columns: np.ndarray) -> np.ndarray:
    """Return orthonormal columns (m, r) that span the given columns (m, w)."""
    basis, sizes, _ = np.linalg.svd(columns, full_matrices=False)
    return basis[:, sizes > COLUMN_ROUNDING * sizes[0]]


def _sums_before(columns: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """Return the sums of products (k, w, w) of the rows of columns (m, w) before each of the rising `ends` (k,)."""
    edges = np.concatenate([[0], ends])
    products = []
    for start, end in pairwise(edges):
        part = columns[start:end]
        products.append(part.T @ part)
    return np.cumsum(products, axis=0)


def _unexplained_squares(sums: np.ndarray) -> np.ndarray:
    """Return the least sum of squares (k,) of positions, the last three columns, as combinations of all others.

    Args:
        sums: (k, w, w) sums of products of the columns.
    """
    cross = sums[:, :-3, -3:]
    inverse = np.linalg.pinv(sums[:, :-3, :-3], PRODUCT_ROUNDING, hermitian=True)
    explained = np.einsum("kij,kij->k", cross, inverse @ cross)
    total = np.trace(sums[:, -3:, -3:], axis1=1, axis2=2)
    return np.maximum(total - explained, 0.0)


def _partners(rows: np.ndarray, numbers: np.ndarray) -> np.ndarray:
    """Return the index of the first row of each number in `numbers` (k,); -1 for absent numbers.

    Args:
        rows: (m,) row numbers in the file.
        numbers: row numbers to find.
    """
    present, index = np.unique(rows, return_index=True)
    position = np.minimum(np.searchsorted(present, numbers), len(present) - 1)
    return np.where(present[position] == numbers, index[position], -1)


def _shifted_block(number: int, first: int, shift: int, blocks: Blocks) -> Blocks:
    """Return the blocks with the joint values of block `number` shifted as by `_shifted`.

    Args:
        number: index of the block.
        first: row number in the file from which on joint values are shifted.
        shift: number of rows by which they are shifted.
        blocks: the measurements.
    """
    block = blocks[number]
    assert isinstance(block, Positions)
    return [*blocks[:number], _shifted(block, first, shift), *blocks[number + 1 :]]


def _shifted(block: Positions, first: int, shift: int) -> Positions:
    """Return a block whose rows from number `first` on have the joint values of the row `shift` rows further down.

    Args:
        block: measured positions.
        first: row number in the file.
        shift: number of rows; negative: rows further up.
    """
    source = np.where(block.rows >= first, block.rows + shift, block.rows)
    partner = _partners(block.rows, source)
    # further up, the first rows have the joint values of none
    is_unpaired = (block.rows >= first) & (source < first) & (block.rows.min() < first)
    present = np.flatnonzero((partner >= 0) & ~is_unpaired)
    return replace(take(block, present), q=block.q[partner[present]])


@dataclass(frozen=True, eq=False)
class Mixture:
    """Rows of one block, assigned to two targets.

    Attributes:
        second: (m,) whether a row is assigned to the second target.
        distance: distance between the two targets [m].
        squares: sum of squared residuals after the fit with two targets [m²].
    """

    second: np.ndarray
    distance: float
    squares: float


def two_targets(nominal: Installation, blocks: Blocks, max_left: float) -> list[Change]:
    """Return possible changes to the blocks: the rows of one block were measured on two targets.

    Args:
        nominal: the nominal arm.
        blocks: the measurements.
        max_left: largest mean squared error with two targets, as a share of that with one.
    """
    changes = []
    for number, block in enumerate(blocks):
        if not isinstance(block, Positions) or nominal.known.terms:
            continue
        if len(block) < MIN_MIXED or len(block.tool_names) > 1:
            continue
        mixture = _sorted_by_target(_columns(nominal, block), block.position)
        if not 0 < mixture.second.sum() < len(block):
            continue
        first_rows = block.rows[~mixture.second]
        second_rows = block.rows[mixture.second]
        values = {
            "apart": mixture.distance,
            "file": block.file,
            "rows": [str(row) for row in first_rows],
            "others": [str(row) for row in second_rows],
        }
        make = partial(_divided, number, frozenset(second_rows.tolist()))
        changes.append(Change("two-targets", make, (), values, max_left))
    return changes


def _divided(number: int, second: frozenset[int], blocks: Blocks) -> Blocks:
    """Return the blocks with the rows `second` of the block with index `number` assigned to a second target."""
    block = blocks[number]
    tool = np.isin(block.rows, list(second)).astype(int)
    name = block.tool_names[0]
    divided = replace(block, tool=tool, tool_names=(name, f"{name} (second)"))
    return [*blocks[:number], divided, *blocks[number + 1 :]]


def _sorted_by_target(columns: np.ndarray, position: np.ndarray) -> Mixture:
    """Return the rows assigned to two targets: assign each row to the target that fits it better, fit again, repeat.

    The iteration ends when no assignment changes. The first assignment is by the sign of the residuals, in the tip's
    frame, along their first principal axis.

    Args:
        columns: (m, 13) columns of the linear position model, computed by `_columns`.
        position: (m, 3) measured positions [m].
    """
    rotations = columns[:, :9].reshape(-1, 3, 3)
    base_transposed = np.linalg.lstsq(columns, position)[0][9:12]
    residual_in_base = _unexplained(columns, position) @ base_transposed.T
    residual_in_tip = np.einsum("mji,mj->mi", rotations, residual_in_base)
    centred = residual_in_tip - residual_in_tip.mean(axis=0)
    axis = np.linalg.svd(centred, full_matrices=False)[2][0]
    by_axis = _settled(columns, position, residual_in_tip @ axis > 0.0)
    alternating = _settled(columns, position, np.arange(len(columns)) % 2 == 0)
    return alternating if alternating.squares < by_axis.squares else by_axis


def _settled(columns: np.ndarray, position: np.ndarray, second: np.ndarray) -> Mixture:
    """Return the rows assigned to two targets, iterated from a first assignment `second` (m,) until none changes.

    Args:
        columns: (m, 13) columns of the linear position model, computed by `_columns`.
        position: (m, 3) measured positions [m].
        second: whether a row is assigned to the second target.
    """
    distance = 0.0
    squares = np.inf
    for _ in range(MAX_ROUNDS):
        matrix = np.column_stack([columns, second[:, None] * columns[:, :9]])
        solution = np.linalg.lstsq(matrix, position)[0]
        residual = position - columns @ solution[:13]
        difference = columns[:, :9] @ solution[13:]
        # B ⊗ (p_2 - p_1), B a rotation
        distance = float(np.linalg.norm(solution[13:]) / np.sqrt(3.0))
        first_squares = np.sum(residual**2, axis=1)
        second_squares = np.sum((residual - difference) ** 2, axis=1)
        squares = float(np.sum(np.where(second, second_squares, first_squares)))
        fits_second = second_squares < first_squares
        if np.array_equal(fits_second, second) or fits_second.all() or not fits_second.any():
            break
        second = fits_second
    return Mixture(second, distance, squares)
