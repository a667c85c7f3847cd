"""Files of rows over time (a tracker's stream, a controller's log): read in pieces, and what cannot be used counted.

A row is left out where a cell that is needed is no number or beyond what it can be, where all are zero (a tracker that
saw nothing), where its cells are too few or too many, and where its time is not after all times before. A clock that
goes back and runs on from there was restarted: refused, since half of the rows would be left out. Of the rest only as
many are held as the resolution asks for, and `HELD` at most, so that memory is bounded.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime
from itertools import islice, pairwise
from pathlib import Path

import numpy as np

from calib.apps.joining.joined import CLOCKS, column_of
from calib.data.csv_table import Table, opened, plain_rows, split_units
from calib.data.signals.resampling import GAP
from calib.errors import MeasurementError, counted, listing, refuse_data, refused_as, require
from calib.units import TIMES

PIECE = 50_000  # rows read at once (our choice)
HELD = 500_000  # rows held, at most: beyond them every second one (our choice)
SLOWEST = 0.2  # time between two rows of a stream, at most [s] (our choice)
MIN_ROWS = 200  # of a stream (our choice)
RESTART = 1.0  # by which a clock that was restarted goes back, at least [s] (our choice)
DAMAGED, LATE = "damaged, empty or not seen", "with a time not after the row before"


@dataclass(frozen=True, eq=False)
class Stream:
    """Rows of a file over time that can be used.

    Attributes:
        file: its path.
        t: (m,) times, rising [s].
        values: (m, k) [SI].
        rows: (m,) their numbers in the file, from 1.
        step: time between two of them [s].
        read: number of rows in the file.
        dropped: reason → number of rows left out.
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
        """Time between two rows from which on nothing is known between them [s]."""
        return max(GAP, 5.0 * self.step)

    def lines(self) -> list[str]:
        """Return what is to be said of the file's rows."""
        intervals = np.diff(self.t)
        reasons = [f"{count} {reason}" for reason, count in self.dropped.items() if count]
        lines = [f"{Path(self.file).name}: {self.read} rows, {self.t[-1] - self.t[0]:.4g} s"]
        if reasons:
            lines[0] += f"; left out: {', '.join(reasons)}"
        if gaps := int((intervals > self.gap).sum()):
            lines.append(
                f"{Path(self.file).name}: {counted(gaps, 'gap')} not bridged, the longest {intervals.max():.3g} s"
            )
        return lines


@dataclass(frozen=True)
class Kind:
    """What is read from a file, besides its times.

    Attributes:
        names: table → its columns that are needed.
        values: table of numbers → (m, k) [SI].
        sound: values → which rows (m,) can be.
        refuse: table, values; raises where most of them cannot be, with the likely cause.
        resolution: time between the rows that are held, about [s].
    """

    names: Callable[[Table], Sequence[str]]
    values: Callable[[Table], np.ndarray]
    sound: Callable[[np.ndarray], np.ndarray]
    refuse: Callable[[Table, np.ndarray], None]
    resolution: float


def read_stream(path: Path, kind: Kind) -> Stream:
    """Return the rows of the file at `path` that can be used.

    Raises:
        MeasurementError: for a file without times, one that was measured at stops, one whose clock was restarted, and
            one of which most rows cannot be used.
    """
    parts, dropped, last, stride, read = list[tuple[np.ndarray, ...]](), Counter[str](), -np.inf, 0, 0
    jumps, latest = list[tuple[int, float, float]](), np.nan
    for table in _pieces(path):
        t, values, sound = _piece(table, kind)
        before = np.maximum.accumulate(np.concatenate([[last], np.where(sound, t, -np.inf)]))
        ahead = sound & (t > before[:-1])
        dropped.update({DAMAGED: int((~sound).sum()), LATE: int((sound & ~ahead).sum())})
        last, read = before[-1], read + len(t)
        times = np.concatenate([[latest], t[sound]])
        jump_rows = np.flatnonzero(np.abs(np.diff(times)) > RESTART)
        jumps += zip(table.rows[sound][jump_rows].tolist(), times[jump_rows].tolist(), times[jump_rows + 1].tolist())
        latest = times[-1]
        if not stride and ahead.sum() > 1:
            stride = max(int(kind.resolution / _step(t[ahead], table) + 0.01), 1)
        thinned = ahead & ((table.rows - 1) % max(stride, 1) == 0)
        parts.append((t[thinned], values[thinned], table.rows[thinned]))
        if sum(len(part[0]) for part in parts) > HELD:
            stride *= 2
            parts = [tuple(times[(part[2] - 1) % stride == 0] for times in part) for part in parts]
    _refuse_restart(path, [*jumps, (read + 1, np.nan, -np.inf)])
    if read - sum(dropped.values()) < max(MIN_ROWS, read / 2):
        reasons = ", ".join(f"{count} {reason}" for reason, count in dropped.items() if count)
        message = f"only {read - sum(dropped.values())} of {read} rows can be used{reasons and f' ({reasons})'}"
        refuse_data(path, f"{message}: is it a stream, and one recording?")
    t, values, rows = (np.concatenate(columns) for columns in zip(*(part for part in parts if len(part[0]))))
    return Stream(str(path), t, values, rows, float(np.median(np.diff(t))), read, dropped)


def _refuse_restart(path: Path, jumps: Sequence[tuple[int, float, float]]) -> None:
    """Refuse a file whose times go back and do not return: those of a copied block of rows do.

    Args:
        jumps: row, time before it and its own [s] of each jump by more than `RESTART`; the file's end as the last one.
    """
    for (row, before, after), (end, _, then) in pairwise(jumps):
        if after < before and then < before - RESTART and end - row >= MIN_ROWS:
            message = f"its times go back from {before:.3f} to {after:.3f} s and run on from there: the clock restarted"
            refuse_data(path, f"{message}. Split the file there, and join each part on its own", row=row)


def _piece(table: Table, kind: Kind) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return times (m,) [s] and values (m, k) [SI] of a table, and which rows (m,) can be."""
    clock, names = _clock(table), kind.names(table)
    t = table.cells[table.index(clock)] * table.factor(table.index(clock), TIMES, "")
    sound_rows = np.ones(len(t), dtype=bool)
    for cells in (t, *(table.cells[table.index(name)] for name in names)):
        sound_rows &= np.isfinite(cells)
    sound_rows[1:-1] &= ~((t[1:-1] > t[2:]) & (t[2:] > t[:-2]))  # one time too late, not all that follow
    sound_values = kind.values(table.where(sound_rows))
    sound = kind.sound(sound_values)
    if len(sound_values) and sound.mean() < 0.5:
        kind.refuse(table.where(sound_rows), sound_values)
    values = np.full((len(t), sound_values.shape[1]), np.nan)
    values[sound_rows] = sound_values
    sound_rows[sound_rows] = sound
    return t, values, sound_rows


def _clock(table: Table) -> str:
    found_columns = f"found {listing(table.header)}. What was measured at stops is joined by name, time or row"
    message = f"has no column of times ({', '.join(CLOCKS)}); {found_columns}"
    require(clock := column_of(table, CLOCKS), message, MeasurementError, table.file)
    return clock


def _step(t: np.ndarray, table: Table) -> float:
    """Return the time between rows [s]; refuse a file that was measured at stops."""
    step = float(np.median(np.diff(t)))
    message = f"its rows are {step:.3g} s apart, a stream's {SLOWEST:g} s at most. Is t in ms ('t [ms]')?"
    if step > SLOWEST:
        refuse_data(table.file, f"{message} What was measured at stops is joined by name, time or row", _clock(table))
    return step


def _pieces(path: Path) -> Iterator[Table]:
    """Yield the table at `path` in pieces of at most `PIECE` rows; what is no number is NaN, and a date its seconds."""
    first_row = 0
    with (
        refused_as(MeasurementError, UnicodeDecodeError, "is no UTF-8 text ({}): is the copy complete?", path),
        opened(path, True) as (lines, separator, cells),
    ):
        names, units = split_units(cells)
        body = (line for line in lines if (text := line.strip()) and text[0] != "#")
        while block := list(islice(body, PIECE)):
            numbers = plain_rows(block, separator, len(names))
            if numbers is None:
                numbers = np.array([_row(line, separator, len(names)) for line in block])
            yield Table(str(path), names, units, tuple(numbers.T), np.arange(first_row, first_row + len(numbers)) + 1)
            first_row += len(numbers)
    require(first_row, "has a header but no data rows", MeasurementError, path)


def _row(line: str, separator: str, width: int) -> list[float]:
    """Return the numbers of a line; NaN for all of one that has other than `width` cells."""
    cells = line.split() if separator == " " else line.split(separator)
    return [_number(cell.strip(' "\r\n')) for cell in cells] if len(cells) == width else [np.nan] * width


def _number(cell: str) -> float:
    try:
        return float(cell)
    except ValueError:
        pass
    try:
        return datetime.fromisoformat(cell).timestamp()
    except (ValueError, OSError, OverflowError):
        return np.nan
