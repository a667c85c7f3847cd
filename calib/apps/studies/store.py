"""The store of a study: rows of trials in a SQLite file of the study's folder, at most one row per key.

rows.sqlite    all rows that commands have appended, even if a command was killed; readable while a command writes
study.lock     locked while a command works on the folder

A row's key is (digest of the condition, method, seed). Rows of conditions that are no longer in the study file are
kept, but not used. So are rows of a method that has changed since (`Method.version`), until the trial is run again.
"""

from __future__ import annotations

import math
import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import astuple
from pathlib import Path
from typing import get_type_hints

from calib import files
from calib.apps.studies.trial import COLUMNS, STATUSES, TrialRow
from calib.errors import CalibError, UsageError, refused_as, suggestion

ROWS, LOCK = "rows.sqlite", "study.lock"
# Version of the store, written to the header of the SQLite file (user_version); a new file has 0.
FORMAT = 2
# Format 1: the rows of a running command, and those of commands before (which took pyarrow to read).
FORMAT_1_JOURNAL, FORMAT_1_ROWS = "rows.csv", "rows.parquet"
FORMAT_1_START = b"calib-study-"

Cell = str | int | float

_SQL_TYPES = {str: "TEXT", int: "INTEGER", float: "REAL"}
_FIELD_TYPES = get_type_hints(TrialRow)
_COLUMN_LIST = ", ".join(COLUMNS)
_COLUMN_TYPES = ", ".join(f"{column} {_SQL_TYPES[_FIELD_TYPES[column]]}" for column in COLUMNS)
_PRIMARY_KEY = "PRIMARY KEY (digest, method, seed) ON CONFLICT REPLACE"
# Without row numbers SQLite stores a row within the index of its key: a quarter smaller.
_CREATE = f"CREATE TABLE rows ({_COLUMN_TYPES}, {_PRIMARY_KEY}) WITHOUT ROWID"
_INSERT = f"INSERT INTO rows VALUES ({', '.join('?' * len(COLUMNS))})"
_SELECT = f"SELECT {_COLUMN_LIST} FROM rows ORDER BY condition, digest, method, seed"


class RowStore:
    """The rows in a study's folder, locked for one process; created by `opened`.

    Attributes:
        folder: folder of the study.
        rows: key (digest of the condition, method, seed) to row.
    """

    def __init__(self, folder: Path, database: sqlite3.Connection) -> None:
        self.folder = folder
        self._database = database
        if _format(database) == 0:
            database.executescript(f"BEGIN; {_CREATE}; PRAGMA user_version = {FORMAT}; COMMIT")
        self.rows = {row.key: row for row in _read(database, folder / ROWS)}

    def holds(self, key: tuple[str, str, int]) -> bool:
        """Return whether the store contains a trial that was made with the method's current version.

        Args:
            key: digest of the condition, method, and seed of the trial.
        """
        return key in self.rows and self.rows[key].current

    def append(self, rows: Sequence[TrialRow]) -> None:
        """Append rows and write them to the disk before returning; rows whose trial is already stored are skipped.

        Raises:
            CalibError: the disk is full; earlier rows are kept, and none of these rows is.
        """
        fresh = [row for row in rows if not self.holds(row.key)]
        advice = f"{len(self.rows)} rows are kept: free disk space, then run the same command again"
        message = f"cannot write {self.folder / ROWS}: {{}}; {advice}"
        # The connection as a context: all rows are committed, or none.
        with refused_as(CalibError, sqlite3.OperationalError, message), self._database:
            self._database.executemany(_INSERT, map(_cells, fresh))
        self.rows.update((row.key, row) for row in fresh)


@contextmanager
def opened(folder: Path) -> Iterator[RowStore]:
    """Yield the row store of a folder, locked for this process.

    Raises:
        UsageError: another command works on the folder, or the store is of another version or damaged.
        CalibError: the folder cannot be written.
    """
    check_format(folder)
    files.check_writable(folder)
    folder.mkdir(parents=True, exist_ok=True)
    busy = f"{folder} is busy: {{}} runs a study in it; wait for it to end, or give another folder (--out)"
    with files.locked(folder / LOCK, busy), closing(_connected(folder / ROWS)) as database:
        yield RowStore(folder, database)


def read_rows(folder: Path) -> list[TrialRow]:
    """Return all rows in a folder, even while another command writes to it; an empty list without a store.

    Raises:
        UsageError: a store of another version, or a damaged one.
    """
    check_format(folder)
    if not (folder / ROWS).exists():
        return []
    with closing(_connected(folder / ROWS)) as database:
        # A command that was killed before its first row leaves an empty file.
        if _format(database):
            return _read(database, folder / ROWS)
        return []


def check_format(folder: Path) -> None:
    """Check that a folder does not contain only rows of format 1, which this version cannot read.

    Raises:
        UsageError: the folder does; the message explains what to do.
    """
    if (folder / ROWS).exists():
        return
    if (folder / FORMAT_1_ROWS).exists():
        raise _other_format(folder / FORMAT_1_ROWS, 1)
    journal = folder / FORMAT_1_JOURNAL
    if journal.is_file() and journal.read_bytes().startswith(FORMAT_1_START):
        raise _other_format(journal, 1)


def _other_format(path: Path, version: int) -> UsageError:
    return UsageError(
        f"{path} is of another version of this toolkit (format {version}, here {FORMAT}): run this study in "
        "another folder (--out), or with that version"
    )


def _connected(path: Path) -> sqlite3.Connection:
    """Return a connection to the SQLite file at `path`, which is new or of this version's format.

    Raises:
        UsageError: a file of another format, or a damaged one.
    """
    with refused_as(UsageError, sqlite3.DatabaseError, f"{path} is damaged: {{}}; run the study in another folder"):
        database = sqlite3.connect(path)
        version = _format(database)
    if version not in (0, FORMAT):
        database.close()
        raise _other_format(path, version)
    return database


def _format(database: sqlite3.Connection) -> int:
    return database.execute("PRAGMA user_version").fetchone()[0]


def _read(database: sqlite3.Connection, path: Path) -> list[TrialRow]:
    damage = (sqlite3.DatabaseError, ValueError, TypeError)
    with refused_as(UsageError, damage, f"{path} is damaged: {{}}; run the study in another folder (--out)"):
        rows = [_row(cells) for cells in database.execute(_SELECT)]
        for row in rows:
            if row.status not in STATUSES:
                raise ValueError(f"no trial ends with the status '{row.status}'{suggestion(row.status, STATUSES)}")
    return rows


def _cells(row: TrialRow) -> list[Cell | None]:
    """Return the values of a row for SQLite, with None (NULL) in place of NaN."""
    cells = list(astuple(row))
    for index, cell in enumerate(cells):
        if isinstance(cell, float) and math.isnan(cell):
            cells[index] = None
    return cells


def _row(cells: Sequence[Cell | None]) -> TrialRow:
    values: dict = dict(zip(COLUMNS, cells))
    for column, cell in values.items():
        if cell is None:
            values[column] = math.nan
    return TrialRow(**values)
