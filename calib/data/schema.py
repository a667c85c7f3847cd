"""Declarations of table columns (names, dimension, bounds), and the error about a cell outside the bounds.

Poses, targets, waypoints and recordings are read by these declarations. `refuse` raises the error about an impossible
value. Its message contains the value, advice, and the number of further rows with such a value (by column, if there are
several columns); the error also has file, row and column.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from calib.errors import MeasurementError, counted, listing, refuse_option
from calib.records import frozen
from calib.units import DEG

# least number of rows of each of two conventions (our choice)
MIN_RUN = 3


@dataclass(frozen=True)
class Bounds:
    """Bounds on measured values; all of them are our choice.

    Attributes:
        max_turn: largest angle of a revolute joint without limits [rad].
        max_length: largest distance of a tool from its instrument, and largest travel of a prismatic joint [m].
        min_sigma: smallest standard deviation of an instrument [m or rad].
        min_travel: a joint that moves less counts as not moved [rad or m].
        limit_slack: allowed encoder error beyond a joint limit [rad or m].
        max_norm_error: largest rounding error of a quaternion or a matrix, which is corrected.
    """

    max_turn: float = 2.1 * math.pi
    max_length: float = 50.0
    min_sigma: float = 1e-10
    min_travel: float = 1e-6
    limit_slack: float = 1e-3
    max_norm_error: float = 1e-3


BOUNDS = Bounds()


@dataclass(frozen=True, eq=False)
class Joints:
    """Joints of a robot, as needed to check measurements and recordings.

    Attributes:
        names: n joint names in the robot's order.
        kinds: URDF joint types (``revolute``, ``continuous``, ``prismatic``).
        lower, upper: (n,) position limits [rad or m]; NaN or infinite if unknown.
        effort: (n,) effort limits [N·m or N]; NaN or infinite if unknown.
    """

    names: tuple[str, ...]
    kinds: tuple[str, ...] | list[str] = ()
    lower: np.ndarray = None  # ty: ignore[invalid-assignment]  # set below
    upper: np.ndarray = None  # ty: ignore[invalid-assignment]  # set below
    effort: np.ndarray = None  # ty: ignore[invalid-assignment]  # set below

    @staticmethod
    def of(joints: Joints | Sequence[str]) -> Joints:
        """Return `joints` itself, or, for names only, revolute joints without limits."""
        return joints if isinstance(joints, Joints) else Joints(tuple(joints))

    def __post_init__(self) -> None:
        n = len(self.names)
        object.__setattr__(self, "names", tuple(self.names))
        object.__setattr__(self, "kinds", tuple(self.kinds) or ("revolute",) * n)
        for name in ("lower", "upper", "effort"):
            value = getattr(self, name)
            values = frozen(np.full(n, np.nan) if value is None else value)
            object.__setattr__(self, name, values)
            if values.shape != (n,):
                refuse_option(name, f"expected {n} values, one per joint, found {values.shape}")


class Rows(Protocol):
    """Protocol of objects whose rows an error may name: a table, a recording or a block of measurements.

    Attributes:
        file: path of the file.
        rows: (m,) number of each row in the file, from 1.
    """

    @property
    def file(self) -> str: ...

    @property
    def rows(self) -> np.ndarray: ...


def refuse(source: Rows, bad: np.ndarray, columns: Sequence[str], says: Callable[[int, int], str]) -> None:
    """Raise MeasurementError if any row is marked in `bad`, (m,) or (m, k).

    Args:
        source: file and row numbers.
        bad: which rows, or cells, are impossible.
        columns: the file's names of the k columns.
        says: function of row and column (from 0) that returns the message for the first bad cell.

    Raises:
        MeasurementError: with file, row and column of the first bad cell, and the number of further bad rows (by
            column, if there are several columns).
    """
    if not np.any(bad):
        return
    bad = np.reshape(bad, (len(bad), -1))
    row, column = (int(index) for index in np.argwhere(bad)[0])
    message = says(row, column) + more_rows(source, bad, columns)
    raise MeasurementError(message, source.file, int(source.rows[row]), columns[column])


def more_rows(source: Rows, bad: np.ndarray, columns: Sequence[str]) -> str:
    """Return as text the number of marked rows after the first, with counts by column; empty if there are none.

    If only a part of the file's rows was read, the text states how many were read.

    Args:
        source: file and row numbers.
        bad: (m, k) marked cells.
        columns: the file's names of the k columns.
    """
    count = int(bad.any(axis=1).sum()) - 1
    if not count:
        return ""
    all_read = np.ptp(source.rows) + 1 == len(bad)
    extent = "" if all_read else f" of the {len(bad)} read"
    by_column = ""
    if bad.shape[1] > 1:
        counts = zip(columns, bad.sum(axis=0))
        by_column = "; of all, " + listing(f"{bad_rows} in {name}" for name, bad_rows in counts if bad_rows)
    return f" (and in {counted(count, 'more row')}{extent}{by_column})"


def two_conventions(source: Rows, in_other_unit: np.ndarray, other_unit: str, unit: str) -> str:
    """Return as text that a run of rows is in another unit than the others; "" where that is not so.

    Args:
        source: file and row numbers.
        in_other_unit: (m,) whether a row is impossible in `unit`.
        other_unit: the unit in which these rows probably are.
        unit: the unit of the other rows.
    """
    rows = np.flatnonzero(in_other_unit)
    count = len(rows)
    if min(count, len(in_other_unit) - count) < MIN_RUN or rows[-1] - rows[0] >= count:
        return ""
    run = f"rows {source.rows[rows[0]]} to {source.rows[rows[-1]]}"
    return f"{run} look like {other_unit}, the others like {unit}: two conventions in one file; split it"


@dataclass(frozen=True)
class Column:
    """One column of a table, or a family of columns (x, y, z).

    Attributes:
        names: the toolkit's names, in order.
        dimension: angle, length, joint, or "" for a plain number.
        family: name under which options state a unit for all columns of the family.
        most: largest absolute value [SI].
        likely: the unit in which values larger than `most` probably are.
        positive: advice for a value that is not above zero; "" if values may have any sign.
    """

    names: tuple[str, ...]
    dimension: str = ""
    family: str = ""
    most: float = math.inf
    likely: str = ""
    positive: str = ""

    def check(self, values: np.ndarray, source: Rows, columns: Sequence[str]) -> np.ndarray:
        """Return a column's values (m, k) [SI] (NaN for an empty cell); refuse values outside the bounds.

        Args:
            values: the column's values, in SI.
            source: file and row numbers, for messages.
            columns: the file's names of the k columns.
        """
        unit = {"angle": " rad", "length": " m"}.get(self.dimension, "")

        def other_unit(row: int, k: int) -> str:
            too_large = np.asarray((np.abs(values) > self.most).any(axis=1))
            split = two_conventions(source, too_large, self.likely, unit.strip())
            if split:
                return f"found {values[row, k]:g}{unit}; {split}"
            header = f"{columns[k]} [{self.likely}]"
            return f"found {values[row, k]:g}{unit}; if it is in {self.likely}, name the column '{header}'"

        refuse(source, np.abs(values) > self.most, columns, other_unit)
        if self.positive:
            low, high = BOUNDS.min_sigma, BOUNDS.max_length
            advice = f"expected {low:g} to {high:g}, in SI: is the unit right?"
            refuse(source, values <= 0.0, columns, lambda row, k: f"found {values[row, k]:g}: {self.positive}")
            unlikely = (values < low) | (values > high)
            refuse(source, unlikely, columns, lambda row, k: f"found {values[row, k]:g}: {advice}")
        return values


def joint_unit(kind: str) -> tuple[str, str, float]:
    """Return a joint type's SI unit, the unit that is often used by mistake, and the factor of the latter to SI.

    Args:
        kind: URDF type of the joint.
    """
    return ("m", "mm", 1e-3) if kind == "prismatic" else ("rad", "deg", DEG)


def max_travel(kinds: Sequence[str]) -> np.ndarray:
    """Return the largest plausible joint values (n,) [rad or m] for joints of the given types without known limits.

    Args:
        kinds: URDF type of each joint.
    """
    travel_of = {"prismatic": BOUNDS.max_length, "continuous": math.inf}
    return np.array([travel_of.get(kind, BOUNDS.max_turn) for kind in kinds])


def check_travel(
    q: np.ndarray,
    most: np.ndarray,
    source: Rows,
    columns: Sequence[str],
    joints: Sequence[str],
    kinds: Sequence[str],
    advice: Callable[[int, str], str],
) -> None:
    """Raise MeasurementError for joint values q (m, n) [rad or m] whose absolute value exceeds `most` (n,).

    Args:
        q: the joint values.
        most: largest plausible value of each joint.
        source: file and row numbers, for messages.
        columns: names of the columns.
        joints, kinds: names and types of the joints.
        advice: function of a joint's index and the unit in which its values probably are; returns the advice.
    """

    def says(row: int, j: int) -> str:
        unit, mistaken_unit, _ = joint_unit(kinds[j])
        fault = "cannot be the travel" if kinds[j] == "prismatic" else "is more than a turn"
        return f"{q[row, j]:g} {unit} {fault} of {joints[j]}: {advice(j, mistaken_unit)}"

    refuse(source, np.abs(q) > most, columns, says)
