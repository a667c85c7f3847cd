"""Files of rows over time (a tracker's stream, a controller's log): read in pieces, and what cannot be used counted.

A row is left out where a cell that is needed is no number or beyond what it can be, where all are zero (a tracker that
saw nothing), where its cells are too few or too many, and where its time is not after all times before. Of the rest
only as many are held as the resolution asks for, so that memory grows with time, not with the rate.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime
from itertools import islice
from pathlib import Path

import numpy as np

from calib.data.csv_table import Table, opened, plain_rows, split_units
from calib.errors import MeasurementError, listing, refuse_data, refused_as, require
from calib.rooms.instruments.joined import CLOCKS, column_of
from calib.units import TIMES

PIECE = 50_000  # rows read at once (our choice)
SLOWEST = 0.2  # time between two rows of a stream, at most [s] (our choice)
MIN_ROWS = 200  # of a stream (our choice)
BRIDGED = 0.05  # the longest time without a row that is no gap [s], or five rows (our choice)


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
        return max(BRIDGED, 5.0 * self.step)

    def lines(self) -> list[str]:
        """Return what is to be said of the file's rows."""
        apart = np.diff(self.t)
        reasons = [f"{count} {why}" for why, count in self.dropped.items() if count]
        found = [f"{Path(self.file).name}: {self.read} rows, {self.t[-1] - self.t[0]:.4g} s"]
        if reasons:
            found[0] += f"; left out: {', '.join(reasons)}"
        if gaps := int((apart > self.gap).sum()):
            found.append(f"{Path(self.file).name}: {gaps} gaps, the longest {apart.max():.3g} s, are not bridged")
        return found


@dataclass(frozen=True)
class Kind:
    """What is read from a file, besides its times.

    Attributes:
        names: table → its columns that are needed.
        values: table of sound cells → (m, k) [SI]; raises where a column as a whole cannot be what it says.
        sound: values → which rows (m,) can be.
        resolution: time between the rows that are held, about [s].
    """

    names: Callable[[Table], Sequence[str]]
    values: Callable[[Table, bool], np.ndarray]
    sound: Callable[[np.ndarray], np.ndarray]
    resolution: float


def read_stream(path: Path, kind: Kind) -> Stream:
    """Return the rows of the file at `path` that can be used.

    Raises:
        MeasurementError: for a file without times, one that was measured at stops, and one of which most rows cannot
            be used.
    """
    parts, dropped, last, every, read = list[tuple[np.ndarray, ...]](), Counter[str](), -np.inf, 0, 0
    for table in _pieces(path):
        clock = column_of(table, CLOCKS)
        found = f"found {listing(table.header)}. What was measured at stops is joined by name, time or row"
        require(clock, f"has no column of times ({', '.join(CLOCKS)}); {found}", MeasurementError, path)
        place, names = table.index(clock), kind.names(table)
        t = table.cells[place] * table.factor(place, TIMES, "")
        whole = np.isfinite(np.column_stack([t, *(table.cells[table.index(name)] for name in names)])).all(axis=1)
        whole[1:-1] &= ~((t[1:-1] > t[2:]) & (t[2:] > t[:-2]))  # one time too late, not all that follow
        values = np.full((len(t), 0), np.nan)
        if whole.any():
            sound = kind.sound(own := kind.values(table.where(whole), False))
            if sound.mean() < 0.5:
                kind.values(table.where(whole), True)
            values = np.full((len(t), own.shape[1]), np.nan)
            values[whole] = own
            whole[whole] = sound
        before = np.maximum.accumulate(np.concatenate([[last], np.where(whole, t, -np.inf)]))
        ahead = whole & (t > before[:-1])
        dropped["damaged, empty or not seen"] += int((~whole).sum())
        dropped["with a time not after the row before"] += int((whole & ~ahead).sum())
        last, read = before[-1], read + len(t)
        if not every and ahead.sum() > 1:
            step = float(np.median(np.diff(t[ahead])))
            words = f"its rows are {step:.3g} s apart, a stream's {SLOWEST:g} s at most. Is t in ms ('t [ms]')?"
            words += " What was measured at stops is joined by name, time or row"
            require(step <= SLOWEST, words, MeasurementError, path, None, clock)
            every = max(int(kind.resolution / step + 0.01), 1)
        held = ahead & ((table.rows - 1) % max(every, 1) == 0)
        parts.append((t[held], values[held], table.rows[held]))
    used = read - sum(dropped.values())
    said = ", ".join(f"{count} {why}" for why, count in dropped.items() if count)
    if used < max(MIN_ROWS, read / 2):
        refuse_data(path, f"only {used} of {read} rows can be used ({said}): is it a stream, and one recording?")
    t, values, rows = (np.concatenate(each) for each in zip(*(part for part in parts if len(part[0]))))
    return Stream(str(path), t, values, rows, float(np.median(np.diff(t))), read, dropped)


def _pieces(path: Path) -> Iterator[Table]:
    """Yield the table at `path` in pieces of at most `PIECE` rows; what is no number is NaN, and a date its seconds."""
    done = 0
    with (
        refused_as(MeasurementError, UnicodeDecodeError, "is no UTF-8 text ({}): is the copy complete?", path),
        opened(path, True) as (lines, separator, cells),
    ):
        names, units = split_units(cells)
        body = (line for line in lines if (text := line.strip()) and text[0] != "#")
        while block := list(islice(body, PIECE)):
            found = plain_rows(block, separator, len(names))
            if found is None:
                found = np.array([_row(line, separator, len(names)) for line in block])
            yield Table(str(path), names, units, tuple(found.T), np.arange(done, done + len(found)) + 1)
            done += len(found)
    require(done, "has a header but no data rows", MeasurementError, path)


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
