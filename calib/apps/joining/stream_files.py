"""Files of rows over time (a tracker's stream, a controller's log), read in pieces; unusable rows are counted.

A row is unusable where a required cell is not a number or out of range, where all cells are zero (the tracker lost its
target), where the number of cells is wrong, and where its time is not later than all times before. If the times jump
back and continue from there, the clock was restarted: the file is refused, since half of its rows would be unusable. Of
the usable rows only as many are kept as the requested resolution needs, and at most `HELD`, so that memory is bounded.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime
from itertools import islice, pairwise
from pathlib import Path

import numpy as np

from calib.apps.joining.joined import CLOCKS, column_of
from calib.apps.joining.mapping import JoinOptions, with_options
from calib.errors import MeasurementError, counted, listing, refuse_data, refused_as
from calib.toolkit.pose_data import Table, opened, plain_rows, split_units
from calib.toolkit.recordings import GAP
from calib.units import TIMES

# Thresholds are our choice.
# number of rows that are read at once
PIECE = 50_000
# largest number of rows in memory; beyond it, every second row is dropped
HELD = 500_000
# largest time between two rows of a stream [s]
SLOWEST = 0.2
# smallest number of usable rows of a stream
MIN_ROWS = 200
# smallest jump back of a clock that was restarted [s]
RESTART = 1.0
# reasons for which rows are ignored, for messages
DAMAGED, LATE = "damaged, empty or not seen", "with a time not after that of the row before"


@dataclass(frozen=True, eq=False)
class Stream:
    """The usable rows of a file over time.

    Attributes:
        file: the file's path.
        t: (m,) times, increasing [s].
        values: (m, k) values [SI].
        rows: (m,) row numbers in the file, from 1.
        step: median time between two rows [s].
        read: number of rows in the file.
        dropped: reason to number of rows that were left out for it.
    """

    file: str
    t: np.ndarray
    values: np.ndarray
    rows: np.ndarray
    step: float
    read: int
    dropped: Counter[str]

    @property
    def gap(self) -> float:
        """Longest time between two rows across which values are interpolated [s]."""
        return max(GAP, 5.0 * self.step)

    def lines(self) -> list[str]:
        """Return the remarks on the file's rows: their number, those left out, and gaps."""
        name = Path(self.file).name
        summary = f"{name}: {self.read} rows, {self.t[-1] - self.t[0]:.4g} s"
        reasons = _reasons(self.dropped)
        if reasons:
            summary += f"; left out: {reasons}"
        lines = [summary]
        intervals = np.diff(self.t)
        gaps = int((intervals > self.gap).sum())
        if gaps:
            lines.append(f"{name}: {counted(gaps, 'gap')} not bridged, the longest {intervals.max():.3g} s")
        return lines


@dataclass(frozen=True)
class Kind:
    """How the values of a file's rows are read and checked.

    Attributes:
        names: function from a table to the names of its required columns.
        values: function from a table of numbers to values (m, k) [SI].
        sound: function from values to whether each row is physically possible, (m,) bool.
        refuse: function of (table, values) that raises MeasurementError, with the likely cause, where most rows are
            impossible.
        resolution: approximate time between the rows that are kept [s].
    """

    names: Callable[[Table], Sequence[str]]
    values: Callable[[Table], np.ndarray]
    sound: Callable[[np.ndarray], np.ndarray]
    refuse: Callable[[Table, np.ndarray], None]
    resolution: float


@dataclass(frozen=True)
class _Jump:
    """A jump of a file's clock by more than `RESTART`.

    Attributes:
        row: number of the row after the jump.
        before, after: times of the rows before and after the jump [s].
    """

    row: int
    before: float
    after: float


@dataclass(frozen=True, eq=False)
class _Part:
    """Times (m,) [s], values (m, k) and row numbers (m,) of the rows that are kept from one piece of a file."""

    t: np.ndarray
    values: np.ndarray
    rows: np.ndarray

    def every(self, stride: int) -> _Part:
        """Return every `stride`-th row of the file: those with the numbers 1, 1 + `stride`, 1 + 2 `stride`, …."""
        multiple = (self.rows - 1) % stride == 0
        return _Part(self.t[multiple], self.values[multiple], self.rows[multiple])


def _reasons(dropped: Counter[str]) -> str:
    """Return as text how many rows were left out for each reason; empty if no row was left out.

    Args:
        dropped: reason to number of rows.
    """
    return ", ".join(f"{count} {reason}" for reason, count in dropped.items() if count)


def read_stream(path: Path, kind: Kind, options: JoinOptions | None = None) -> Stream:
    """Return the usable rows of the file at `path`; `kind` describes how they are read.

    Args:
        path: the file.
        kind: how its values are read and checked.
        options: names and units of columns; None: as the header says.

    Raises:
        MeasurementError: a file without times, a file measured at stops rather than as a stream, a clock that was
            restarted, or a file with mostly unusable rows.
    """
    dropped = Counter[str]()
    jumps = list[_Jump]()
    parts = list[_Part]()
    # every so many rows are held; 0 until the time between two is known
    stride = 0
    read = 0
    largest, latest = -np.inf, np.nan
    for table in _pieces(path):
        t, values, sound = _piece(with_options(table, options or JoinOptions()), kind)
        read += len(t)

        # a row is late unless its time is after all times before
        sound_times = np.where(sound, t, -np.inf)
        before = np.maximum.accumulate(np.concatenate([[largest], sound_times]))
        ahead = sound & (t > before[:-1])
        largest = before[-1]
        dropped[DAMAGED] += int((~sound).sum())
        dropped[LATE] += int((sound & ~ahead).sum())

        times = np.concatenate([[latest], t[sound]])
        latest = times[-1]
        for k in np.flatnonzero(np.abs(np.diff(times)) > RESTART):
            row = int(table.rows[sound][k])
            jumps.append(_Jump(row, float(times[k]), float(times[k + 1])))

        if not stride and ahead.sum() > 1:
            step = _step(t[ahead], table)
            stride = max(int(kind.resolution / step + 0.01), 1)
        thinned = ahead & ((table.rows - 1) % max(stride, 1) == 0)
        parts.append(_Part(t[thinned], values[thinned], table.rows[thinned]))
        if sum(len(part.t) for part in parts) > HELD:
            stride *= 2
            parts = [part.every(stride) for part in parts]

    _refuse_restart(path, [*jumps, _Jump(read + 1, np.nan, -np.inf)])
    usable = read - sum(dropped.values())
    if usable < max(MIN_ROWS, read / 2):
        message = f"only {usable} of {read} rows can be used"
        reasons = _reasons(dropped)
        if reasons:
            message += f" ({reasons})"
        refuse_data(path, f"{message}: is it a stream, recorded without interruption?")
    parts = [part for part in parts if len(part.t)]
    t = np.concatenate([part.t for part in parts])
    values = np.concatenate([part.values for part in parts])
    rows = np.concatenate([part.rows for part in parts])
    step = float(np.median(np.diff(t)))
    return Stream(str(path), t, values, rows, step, read, dropped)


def _refuse_restart(path: Path, jumps: Sequence[_Jump]) -> None:
    """Raise MeasurementError where a file's times jump back for good.

    A copied block of rows is no restart: after it, the times jump forward again.

    Args:
        path: the file.
        jumps: each jump by more than `RESTART`; the file's end as the last one.
    """
    for jump, following in pairwise(jumps):
        returns = following.after >= jump.before - RESTART
        if jump.after < jump.before and not returns and following.row - jump.row >= MIN_ROWS:
            times = f"{jump.before:.3f} to {jump.after:.3f} s"
            message = f"its times go back from {times} and run on from there: the clock restarted"
            refuse_data(path, f"{message}. Split the file there, and join each part on its own", row=jump.row)


def _piece(table: Table, kind: Kind) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return times (m,) [s] and values (m, k) [SI] of a table, and whether each row is possible, (m,) bool.

    Args:
        table: a piece of a file.
        kind: how its values are read.
    """
    clock = table.index(_clock(table))
    t = table.cells[clock] * table.factor(clock, TIMES, "")
    sound = np.isfinite(t)
    for name in kind.names(table):
        sound &= np.isfinite(table.cells[table.index(name)])
    # one time too late, not all that follow
    too_late = (t[1:-1] > t[2:]) & (t[2:] > t[:-2])
    sound[1:-1] &= ~too_late
    finite_rows = table.where(sound)
    finite_values = kind.values(finite_rows)
    possible = kind.sound(finite_values)
    if len(finite_values) and possible.mean() < 0.5:
        kind.refuse(finite_rows, finite_values)
    values = np.full((len(t), finite_values.shape[1]), np.nan)
    values[sound] = finite_values
    sound[sound] = possible
    return t, values, sound


def _clock(table: Table) -> str:
    """Return the name of the table's column of times."""
    clock = column_of(table, CLOCKS)
    if not clock:
        columns = f"found {listing(table.header)}. What was measured at stops is joined by name, time or row"
        refuse_data(table.file, f"has no column of times ({', '.join(CLOCKS)}); {columns}")
    return clock


def _step(t: np.ndarray, table: Table) -> float:
    """Return the median time between rows [s]; raise MeasurementError for a file measured at stops.

    Args:
        t: (m,) times of the rows [s].
        table: the file's table, which the message names.
    """
    step = float(np.median(np.diff(t)))
    if step > SLOWEST:
        message = f"its rows are {step:.3g} s apart, a stream's {SLOWEST:g} s at most. Is t in ms ('t [ms]')?"
        refuse_data(table.file, f"{message} What was measured at stops is joined by name, time or row", _clock(table))
    return step


def _pieces(path: Path) -> Iterator[Table]:
    """Yield the table at `path` in pieces of at most `PIECE` rows.

    A cell with a date becomes seconds; a cell that is not a number becomes NaN.
    """
    first_row = 1
    with (
        refused_as(MeasurementError, UnicodeDecodeError, "is no UTF-8 text ({}): is the copy complete?", path),
        opened(path, True) as (lines, separator, cells),
    ):
        names, units = split_units(cells)
        body = _data_lines(lines)
        while block := list(islice(body, PIECE)):
            numbers = plain_rows(block, separator, len(names))
            if numbers is None:
                numbers = np.array([_row(line, separator, len(names)) for line in block])
            rows = np.arange(first_row, first_row + len(numbers))
            yield Table(str(path), names, units, tuple(numbers.T), rows)
            first_row += len(numbers)
    if first_row == 1:
        refuse_data(path, "has a header but no data rows")


def _data_lines(lines: Iterable[str]) -> Iterator[str]:
    """Yield the lines that are neither empty nor comments."""
    for line in lines:
        text = line.strip()
        if text and text[0] != "#":
            yield line


def _row(line: str, separator: str, width: int) -> list[float]:
    """Return the numbers of a line; all NaN if it does not have `width` cells.

    Args:
        line: the line.
        separator: character between cells; a blank is any white space.
        width: expected number of cells.
    """
    cells = line.split() if separator == " " else line.split(separator)
    if len(cells) != width:
        return [np.nan] * width
    return [_number(cell.strip(' "\r\n')) for cell in cells]


def _number(cell: str) -> float:
    """Return the number in a cell, or a date and time as seconds since 1970; NaN for anything else."""
    try:
        return float(cell)
    except ValueError:
        pass
    try:
        return datetime.fromisoformat(cell).timestamp()
    except (ValueError, OSError, OverflowError):
        return np.nan
