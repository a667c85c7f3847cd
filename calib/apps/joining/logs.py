"""Join two logs of one motion, such as positions and torques in files of their own, to one recording by time.

The rows are those of the file with positions; the other file's columns are interpolated linearly at their times. Rows
at whose times the other file has no sample within five of its steps are left out and counted. Where both files name
their columns alike, the quantity comes from the files' names (``position.csv``, ``current_mA.csv``: a unit there counts
where the header states none).
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import numpy as np

from calib.apps.joining.joined import CLOCKS, Joined, column_of
from calib.errors import UsageError, listing, refuse_data
from calib.toolkit.pose_data import Table
from calib.toolkit.recordings import at_times, likely_unit, series_of, time_column, words_of
from calib.units import CURRENTS, EFFORTS, POSITIONS, TIMES, VELOCITIES

# smallest share of the shorter log that both logs cover (our choice)
MIN_OVERLAP = 0.5
# columns of a file that a note names
MAX_LISTED = 8
UNITS = {"q": POSITIONS, "v": VELOCITIES, "torque": EFFORTS, "current": CURRENTS}
# words of a file's name that are units
UNIT_WORDS = {"deg": "deg", "rad": "rad", "ma": "mA", "amps": "A", "nm": "Nm", "nmm": "Nmm", "rpm": "rpm"}


@dataclass(frozen=True, eq=False)
class Log:
    """A table with its times.

    Attributes:
        table: the table.
        clock: name of the column of times; empty without one.
        t: (N,) times [s]; empty without a column of times.
        quantity: series of the toolkit that the file's name tells; empty if it tells none.
        unit: unit in the file's name; empty without one.
    """

    table: Table
    clock: str
    t: np.ndarray
    quantity: str
    unit: str

    @property
    def names(self) -> list[str]:
        """Names of the columns of numbers, without the times."""
        names = []
        for name, cells in zip(self.table.header, self.table.cells):
            if name != self.clock and cells.dtype == float:
                names.append(name)
        return names

    @property
    def values(self) -> np.ndarray:
        """Cells (N, k) of the columns `names`, NaN where they are empty."""
        return np.column_stack([self.table.numbers(name, None, gaps=True) for name in self.names])

    @property
    def has_positions(self) -> bool:
        """Whether the file's name or one of its columns tells positions."""
        if self.quantity:
            return self.quantity == "q"
        return "q" in quantities(self.names)


@dataclass(frozen=True, eq=False)
class JoinedLogs(Joined):
    """Two logs in one table, which is a recording."""

    @property
    def rows(self) -> str:
        """What the rows are, for messages."""
        return "samples of a recording (for calib identify)"


def is_log(table: Table) -> bool:
    """Return whether a table without points has times, or columns of a quantity of joints."""
    return bool(clock_of(table)) or bool(quantities(table.header) - {""})


def quantities(names: Sequence[str]) -> set[str]:
    """Return the toolkit's series that names of columns tell; "" for a name that tells none."""
    return {series_of(words_of(name)) for name in names}


def clock_of(table: Table) -> str:
    """Return the name of a table's column of times; empty without one."""
    name = column_of(table, CLOCKS)
    timed = time_column(table.header)
    if not name and timed is not None:
        name = table.header[timed[0]]
    return name


def log_of(table: Table) -> Log:
    """Return a table as a log, with its times in seconds of their own clock."""
    clock = clock_of(table)
    stem = words_of(Path(table.file).stem)
    quantity = series_of(stem)
    unit = ""
    for text in words_of(Path(table.file).stem.lower()):
        if UNIT_WORDS.get(text, "").lower() in UNITS.get(quantity, {}):
            unit = UNIT_WORDS[text]
    t = np.zeros(0)
    if clock:
        t = seconds(table, clock)
    return Log(table, clock, t, quantity, unit)


def seconds(table: Table, name: str) -> np.ndarray:
    """Return the column `name` of a table as times (m,) [s].

    The column contains numbers in the unit of the header or of its name, or, if they state none, in the only plausible
    one; or ISO 8601 dates and times.
    """
    column = table.index(name)
    if table.cells[column].dtype != float:
        try:
            return np.array([datetime.fromisoformat(text).timestamp() for text in table.texts(name)])
        except ValueError as error:
            table.fail(f"{error}: expected seconds, or a date and time as 2026-11-27T08:15:30.250", name)
    times = table.numbers(name, None)
    if table.units[column]:
        return times * table.factor(column, TIMES, "")
    timed = time_column([name])
    unit = ""
    if timed is not None:
        unit = timed[1]
    return times * TIMES[unit or likely_unit(times) or "s"]


def join_logs(first: Table, second: Table, by: str = "") -> JoinedLogs:
    """Return two logs of one motion as one table with the times and columns of both.

    Args:
        first, second: the tables, in any order.
        by: ``time``, or ``row`` for files without times of one clock; empty: by time.

    Raises:
        UsageError: another `by`.
        MeasurementError: files without times, times that do not overlap, or columns of equal names.
    """
    if by not in ("", "time", "row"):
        raise UsageError(f"two logs are joined by time or by row, not by {by}: {second.file} has no measured points")
    logs = [log_of(first), log_of(second)]
    if logs[1].has_positions and not logs[0].has_positions:
        logs.reverse()
    base, added = logs
    if by == "row" or not (base.clock and added.clock):
        values, rows, notes = _by_row(base, added)
    else:
        values, rows, notes = _by_time(base, added)
    names = _names(base, added)
    header = list(names)
    units = _units(base) + _units(added)
    cells = [*base.values[rows].T, *values.T]
    if len(base.t):
        header.insert(0, "t")
        units.insert(0, "s")
        # as texts: times since 1970 have more digits than other numbers are written with
        times = [f"{time:.9f}" for time in base.t[rows]]
        cells.insert(0, np.array(times, dtype=object))
    table = Table(added.table.file, tuple(header), tuple(units), tuple(cells), base.table.rows[rows])
    notes += _mapping(base, names[: len(base.names)]) + _mapping(added, names[len(base.names) :])
    return JoinedLogs(table, np.flatnonzero(rows), (*first.notes, *second.notes, *notes))


def _by_row(base: Log, added: Log) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Return the other log's values (m, k), the rows of the base log that are used (N,), and notes; row by row."""
    count, other_count = len(base.table), len(added.table)
    if count != other_count:
        message = f"has {other_count} rows, {base.table.file} has {count}"
        refuse_data(added.table.file, f"{message}, and not both have a column of times (t, time): add one of one clock")
    return added.values, np.ones(count, bool), [f"{count} rows, joined by row: are they of the same instants?"]


def _by_time(base: Log, added: Log) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Return the other log's values (m, k) at the base log's times, the rows that are used (N,), and notes."""
    start, stop = max(base.t[0], added.t[0]), min(base.t[-1], added.t[-1])
    shorter = min(np.ptp(base.t), np.ptp(added.t))
    if not stop - start >= MIN_OVERLAP * shorter:
        message = f"its times are {added.t[0]:.10g} to {added.t[-1]:.10g} s, those of {base.table.file} are "
        message += f"{base.t[0]:.10g} to {base.t[-1]:.10g} s: are both of one clock?"
        if len(base.table) == len(added.table):
            message += " If the rows belong together one by one, join them by row (--by row)"
        else:
            message += " If both logs began at the same instant, let both times begin at 0"
        refuse_data(added.table.file, message, added.clock)
    order = np.argsort(added.t, kind="stable")
    values = at_times(added.t[order], added.values[order], base.t)
    rows = np.asarray(np.isfinite(values).any(axis=1))
    shift = float(np.median(_nearest(added.t[order], base.t[rows])))
    notes = [
        f"{len(base.table)} rows of {base.table.file}, joined by time with {len(added.table)} rows of "
        f"{added.table.file}, interpolated (nearest stamps {1e3 * shift:.3g} ms apart, median)"
    ]
    if not rows.all():
        notes.append(f"{int((~rows).sum())} rows without a sample of {added.table.file} near their times are left out")
    return values[rows], rows, notes


def _nearest(t: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Return the distance of each of `times` (m,) to the nearest of the times t (N,), increasing [s]."""
    after = np.clip(np.searchsorted(t, times), 1, len(t) - 1)
    return np.minimum(np.abs(t[after] - times), np.abs(times - t[after - 1]))


def _names(base: Log, added: Log) -> list[str]:
    """Return the names of both logs' columns in one table; equal ones are told apart by the files' quantities."""
    common = [name for name in base.names if name in added.names]
    if not common:
        return [name.lstrip("- ") for name in (*base.names, *added.names)]
    for log, rival in ((base, added), (added, base)):
        if not log.quantity or log.quantity == rival.quantity:
            message = f"has columns named as those of {rival.table.file}: {listing(common)}"
            refuse_data(
                log.table.file,
                f"{message}. Name each file by its quantity (position.csv, velocity.csv, torque.csv, current.csv), or "
                "its columns",
            )
    names = []
    for log in (base, added):
        for name in log.names:
            if name in common:
                name = _with_quantity(name, log.quantity)
            names.append(name)
    return names


def _with_quantity(name: str, quantity: str) -> str:
    """Return a column's name with a quantity before it, in place of a letter for joints (``q1`` of torques)."""
    number = re.fullmatch(r"[A-Za-z]+_?(\d+)", name)
    if number and series_of(words_of(name)):
        return f"{quantity}_{number[1]}"
    return f"{quantity}_{name}"


def _units(log: Log) -> list[str]:
    """Return the unit of each of a log's columns: from the header, else from the file's name."""
    units = []
    for name in log.names:
        unit = log.table.units[log.table.index(name)]
        units.append(unit or log.unit)
    return units


def _mapping(log: Log, names: Sequence[str]) -> list[str]:
    """Return a note on the columns of a log, by the names that they have in the joined table."""
    entries = []
    for name, new in zip(log.names, names):
        if name.lstrip("- ") == new:
            entries.append(new)
        else:
            entries.append(f"{name} as {new}")
    note = f"columns {listing(entries, MAX_LISTED)}"
    if log.clock:
        note = f"times from '{log.clock}', {note}"
    if log.unit:
        note += f" [{log.unit}, from the file's name]"
    return [f"{log.table.file}: {note}"]
