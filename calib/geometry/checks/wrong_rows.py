"""Rows that are not what they are said to be: paired with joints of other rows, or measured on two targets.

Both are judged by what an arm with any placements leaves at least. Positions y = B (R p + t) + b, with R, t the tip's
by the joints and B, b, p the placements, are linear in B ⊗ p, B and b: 13 numbers per axis of y.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from calib.column_changes import Change
from calib.data.poses.measurements import PoseMeasurements, Positions, take
from calib.geometry.installation import Installation
from calib.records import evenly
from calib.robot.kinematics import forward

SHIFTS = (1, -1, 2, -2)  # rows between a measurement and its joints: a lost point, a line of the header
MIN_SHIFTED = 8  # rows that are shifted at least (our choice)
MIN_PAIRED = 0.5  # share of the rows whose shifted joints are there, not held out (our choice)
MAX_CUTS = 120  # first rows of a shift that are tried at once; then those between (our choice)
MIN_MIXED = 24  # rows in which two targets are looked for (our choice)
MAX_ROUNDS = 50  # of sorting rows by target; a few are needed
Blocks = Sequence[PoseMeasurements]


def least_error(nominal: Installation, blocks: Blocks) -> np.ndarray:
    """Return the least mean squared error [m²] (1,) that any base and tool placement can reach; 0 if not known."""
    squares, count = 0.0, 0
    for block in blocks:
        if nominal.known.terms or not isinstance(block, Positions):
            return np.zeros(1)
        columns = _columns(nominal, block)
        for tool in np.unique(block.tool):
            rows = block.tool == tool
            squares += float((_unexplained(columns[rows], block.position[rows]) ** 2).sum())
        count += len(block)
    return np.array([squares / count])


def _columns(nominal: Installation, block: Positions) -> np.ndarray:
    """Return the columns (m, 13) of R, t and 1 of a block's rows."""
    tip = forward(nominal.chain, block.q)
    return np.column_stack([tip[:, :3, :3].reshape(-1, 9), tip[:, :3, 3], np.ones(len(tip))])


def _unexplained(columns: np.ndarray, position: np.ndarray) -> np.ndarray:
    return position - columns @ np.linalg.lstsq(columns, position)[0]


def row_shifts(nominal: Installation, blocks: Blocks, max_left: float) -> list[Change]:
    """Return changes that pair measurements with the joints of rows further down or up, from the best row on.

    Args:
        nominal: the arm.
        blocks: the rows; row numbers that are missing were held out.
        max_left: share of the error that such a change may leave.
    """
    changes = []
    for number, block in enumerate(blocks):
        if not isinstance(block, Positions) or nominal.known.terms:
            continue
        for by in SHIFTS:
            first = _best_first(nominal, block, by)
            if first is not None:
                values = {"first": first, "by": abs(by), "way": "down" if by > 0 else "up", "file": block.file}
                changes.append(Change("rows-shifted", partial(_shifted_block, number, first, by), (), values, max_left))
    return changes


def _best_first(nominal: Installation, block: Positions, by: int) -> int | None:
    """Return the number of the row from which on a shift explains most; None for too few rows."""
    numbers = np.unique(block.rows)[: -MIN_SHIFTED - abs(by)]
    if len(numbers) < MIN_SHIFTED or len(_shifted(block, 0, by)) < MIN_PAIRED * len(block):
        return None

    def left(first: int) -> float:
        return float(least_error(nominal, [_shifted(block, first, by)])[0])

    some = numbers[evenly(len(numbers), MAX_CUTS)]
    best = int(min(some, key=left))
    around = numbers[np.abs(numbers - best) < max(len(numbers) // MAX_CUTS, 1)]
    return int(min(around, key=left))


def _shifted_block(number: int, first: int, by: int, blocks: Blocks) -> Blocks:
    """Return the blocks, one of them shifted."""
    block = blocks[number]
    assert isinstance(block, Positions)
    return [*blocks[:number], _shifted(block, first, by), *blocks[number + 1 :]]


def _shifted(block: Positions, first: int, by: int) -> Positions:
    """Return a block whose rows from number `first` on have the joints of the row `by` further down."""
    numbers, index = np.unique(block.rows, return_index=True)
    source = np.where(block.rows >= first, block.rows + by, block.rows)
    found = np.minimum(np.searchsorted(numbers, source), len(numbers) - 1)
    there = np.flatnonzero(numbers[found] == source)
    return replace(take(block, there), q=block.q[index[found[there]]])


@dataclass(frozen=True, eq=False)
class Mixture:
    """Rows of one block sorted by target.

    Attributes:
        second: (m,) whether a row was measured on the second target.
        apart: distance of the targets [m].
        squares: what remains [m²].
    """

    second: np.ndarray
    apart: float
    squares: float


def two_targets(nominal: Installation, blocks: Blocks, max_left: float) -> list[Change]:
    """Return changes that divide the rows of one block among two targets.

    Args:
        nominal: the arm.
        blocks: the rows.
        max_left: share of the error that such a change may leave.
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
        rows = [block.rows[mixture.second == which] for which in (False, True)]
        values = {"apart": mixture.apart, "file": block.file}
        values |= {name: [str(row) for row in each] for name, each in zip(("rows", "others"), rows)}
        make: Callable[[Blocks], Blocks] = partial(_divided, number, frozenset(rows[1].tolist()))
        changes.append(Change("two-targets", make, (), values, max_left))
    return changes


def _divided(number: int, second: frozenset[int], blocks: Blocks) -> Blocks:
    """Return the blocks, the rows `second` of one with a second target."""
    block = blocks[number]
    tool = np.isin(block.rows, list(second)).astype(int)
    names = (block.tool_names[0], f"{block.tool_names[0]} (second)")
    return [*blocks[:number], replace(block, tool=tool, tool_names=names), *blocks[number + 1 :]]


def _sorted_by_target(columns: np.ndarray, position: np.ndarray) -> Mixture:
    """Return rows sorted by target: each row to the target that it fits, and the fit again, until no row changes.

    It begins with the sign of the residuals, in the tip's frame, along their first principal axis.

    Args:
        columns: (m, 13) of R, t and 1.
        position: (m, 3) [m].
    """
    turns = columns[:, :9].reshape(-1, 3, 3)
    base = np.linalg.lstsq(columns, position)[0][9:12]  # Bᵀ
    in_tip = np.einsum("mji,mj->mi", turns, _unexplained(columns, position) @ base.T)
    axis = np.linalg.svd(in_tip - in_tip.mean(axis=0), full_matrices=False)[2][0]
    starts = [in_tip @ axis > 0.0, np.arange(len(columns)) % 2 == 0]
    return min((_settled(columns, position, start) for start in starts), key=lambda one: one.squares)


def _settled(columns: np.ndarray, position: np.ndarray, second: np.ndarray) -> Mixture:
    """Return the rows sorted by target from a first guess (m,)."""
    apart, squares = 0.0, np.inf
    for _ in range(MAX_ROUNDS):
        both = np.column_stack([columns, second[:, None] * columns[:, :9]])
        found = np.linalg.lstsq(both, position)[0]
        away = position - columns @ found[:13]
        step = columns[:, :9] @ found[13:]
        apart = float(np.linalg.norm(found[13:]) / np.sqrt(3.0))  # B ⊗ (p_2 - p_1), B a rotation
        sizes = np.sum(away**2, axis=1), np.sum((away - step) ** 2, axis=1)
        squares = float(np.sum(np.where(second, sizes[1], sizes[0])))
        fits = sizes[1] < sizes[0]
        if np.array_equal(fits, second) or fits.all() or not fits.any():
            break
        second = fits
    return Mixture(second, apart, squares)
