"""The store of a study: rows of trials in a folder, appended as they arrive, each key once.

rows.csv       rows since the last command ended, one line each, flushed to the disk as trials end: a killed process
               loses at most the line it was writing, and that line is taken off when the store is opened again
rows.parquet   all rows before; made of both when a command ends, where pyarrow is there (extra ``study``): rows.csv is
               left with its header alone
study.lock     held while a command works on the folder

A row's key is (digest of the condition, method, seed): rows of conditions that a study file no longer states stay, and
are not counted; so do those of a method that has changed since (`Method.version`), until it is run again.
"""

from __future__ import annotations

import csv
import io
import math
import os
import socket
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import astuple
from pathlib import Path
from typing import IO, Any, get_type_hints

from calib import files
from calib.errors import CalibError, UsageError, refused_as, require, suggestion
from calib.rooms.studies.trial import COLUMNS, STATUSES, TrialRow

JOURNAL, WHOLE, LOCK = "rows.csv", "rows.parquet", "study.lock"
FORMAT = 1  # of the store: first cell of every header
_HEAD = (f"calib-study-{FORMAT}", *COLUMNS)
_TYPES = [get_type_hints(TrialRow)[name] for name in COLUMNS]


class RowStore:
    """Rows of a study's folder, locked for one process; made by `opened`.

    Attributes:
        folder: where they are.
        rows: key → row.
        dropped: lines that were half-written when an earlier command was killed.
    """

    def __init__(self, folder: Path) -> None:
        self.folder, self.dropped = folder, 0
        self.rows = {row.key: row for row in _read_whole(folder / WHOLE)}
        journal, good, self.dropped = _read_journal(folder / JOURNAL)
        self.rows.update((row.key, row) for row in journal)
        self._journal = _open_journal(folder / JOURNAL, good)

    def holds(self, key: tuple[str, str, int]) -> bool:
        """Return whether the store contains a trial of the method's current version."""
        return key in self.rows and self.rows[key].current

    def append(self, rows: Sequence[TrialRow]) -> None:
        """Append rows and write them to the disk before returning.

        Raises:
            CalibError: where the disk is full; rows of before are kept, none of these.
        """
        fresh = [row for row in rows if not self.holds(row.key)]
        text = io.StringIO()
        csv.writer(text, lineterminator="\n").writerows(("", *map(_cell, astuple(row))) for row in fresh)
        before = self._journal.tell()
        try:
            left = memoryview(text.getvalue().encode())
            while left:
                left = left[self._journal.write(left) :]  # a disk that fills up takes a part, then refuses
            os.fsync(self._journal.fileno())
        except OSError as error:
            raise self._taken_back(before, error) from error
        self.rows.update((row.key, row) for row in fresh)

    def _taken_back(self, size: int, error: OSError) -> CalibError:
        """Cut the journal to its intact `size` bytes; return the error to raise."""
        path = self.folder / JOURNAL
        self._journal.close()
        os.truncate(path, size)
        self._journal = open(path, "r+b", buffering=0)  # noqa: SIM115 (held as long as the store)
        self._journal.seek(size)
        return CalibError(
            f"cannot write {path}: {error.strerror or error}; {len(self.rows)} rows are kept: free disk space, then "
            "run the same command again"
        )

    def settle(self) -> Path:
        """Write all rows as Parquet if pyarrow is installed, and empty the journal; return the rows' file."""
        try:
            content = _parquet(self.rows.values())
        except ImportError:
            return self.folder / JOURNAL
        files.write(self.folder / WHOLE, content)
        self.close()
        self._journal = _open_journal(self.folder / JOURNAL, 0)  # keys keep what is in both from counting twice
        return self.folder / WHOLE

    def close(self) -> None:
        self._journal.close()


@contextmanager
def opened(folder: Path) -> Iterator[RowStore]:
    """Yield the store of a folder, locked for one command until the process ends.

    Raises:
        UsageError: while another command works on it; for a store of another version, or a damaged one.
        CalibError: for a folder that cannot be written.
    """
    import fcntl

    files.check_writable(folder)
    folder.mkdir(parents=True, exist_ok=True)
    handle = os.open(folder / LOCK, os.O_RDWR | os.O_CREAT, 0o644)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            holder = os.pread(handle, 200, 0).decode(errors="replace").strip() or "another command"
            raise UsageError(
                f"{folder} is busy: {holder} runs a study in it; wait for it to end, or give another folder (--out)"
            ) from None
        os.ftruncate(handle, 0)
        os.pwrite(handle, f"process {os.getpid()} on {socket.gethostname()}".encode(), 0)
        store = RowStore(folder)
        try:
            yield store
        finally:
            store.close()
    finally:
        os.close(handle)


def read_rows(folder: Path) -> list[TrialRow]:
    """Return all rows of a folder, even while another command writes to it."""
    journal = _read_journal(folder / JOURNAL)[0]  # first: what is emptied into the other meanwhile, is read there
    found = {row.key: row for row in (*_read_whole(folder / WHOLE), *journal)}
    return list(found.values())


def _open_journal(path: Path, size: int) -> IO[bytes]:
    """Return the journal, cut to `size` bytes and open for appending; with size 0 a new one with its header."""
    if size == 0:
        files.write(path, ",".join(_HEAD) + "\n")
    else:
        os.truncate(path, size)
    journal = open(path, "r+b", buffering=0)  # noqa: SIM115 (held as long as the store)
    journal.seek(0, os.SEEK_END)
    return journal


def _read_journal(path: Path) -> tuple[list[TrialRow], int, int]:
    """Return the rows, the number of intact bytes, and the number of half-written lines (0 or 1).

    Raises:
        UsageError: for a file of another version, or one that is damaged before its last line.
    """
    if not path.exists() or not (data := path.read_bytes()):
        return [], 0, 0
    good = data.rfind(b"\n") + 1
    lines = data[:good].decode(errors="replace").splitlines()
    if not lines:
        return [], 0, 1
    _check_columns(path, lines[0].split(","))
    rows = []
    for number, cells in enumerate(csv.reader(lines[1:]), 2):
        with refused_as(
            UsageError,
            ValueError,
            f"{path}: line {number} is damaged ({{}}); delete that line, and its trial is run again",
        ):
            rows.append(_row(cells[1:]))
    return rows, good, int(good < len(data))


def _row(cells: Sequence[str]) -> TrialRow:
    """Return the trial row that a line of the file contains.

    Raises:
        ValueError: for a line that is short, a number that is none, a status that no trial ends with.
    """
    if len(cells) != len(COLUMNS):
        raise ValueError(f"{len(cells)} cells, not {len(COLUMNS)}")
    row = TrialRow(*(_value(kind, cell) for kind, cell in zip(_TYPES, cells)))
    if row.status not in STATUSES:
        raise ValueError(f"status '{row.status}'{suggestion(row.status, STATUSES)}")
    return row


def _check_columns(path: Path, found: Sequence[str]) -> None:
    if tuple(found) == _HEAD:
        return
    other = found[0].removeprefix("calib-study-") if found[0].startswith("calib-study-") else ""
    require(other, f"{path} contains no rows of a study; give another folder (--out)", UsageError)
    missing = ", ".join(sorted(set(_HEAD[1:]) - set(found[1:]))[:5])
    lacks = f"; it lacks {missing}" if missing else ""
    raise UsageError(
        f"{path} is of another version of this toolkit (format {other}, here {FORMAT}{lacks}): run this study in "
        "another folder (--out), or with that version"
    )


def _cell(value: object) -> str:
    if isinstance(value, float):
        return "" if math.isnan(value) else repr(value)
    return str(value)


def _value(kind: type, cell: str) -> Any:
    return math.nan if kind is float and not cell else kind(cell)


def _parquet(rows: Iterable[TrialRow]) -> bytes:
    """Return rows as a Parquet file, sorted by their keys, so that the same rows give the same bytes."""
    import pyarrow
    from pyarrow import parquet

    table = sorted(rows, key=lambda row: (row.condition, row.key))
    kinds = {int: pyarrow.int64(), float: pyarrow.float64(), str: pyarrow.string()}
    arrays = [pyarrow.array([getattr(row, name) for row in table], kinds[kind]) for name, kind in zip(COLUMNS, _TYPES)]
    sink = pyarrow.BufferOutputStream()
    schema = pyarrow.schema(list(zip(COLUMNS, (one.type for one in arrays))), metadata={"store": _HEAD[0]})
    numbers: Any = [name for name, kind in zip(COLUMNS, _TYPES) if kind is float]  # byte by byte: a third smaller
    others: Any = [name for name in COLUMNS if name not in numbers]
    parquet.write_table(
        pyarrow.Table.from_arrays(arrays, schema=schema),
        sink,
        compression="zstd",
        compression_level=19,
        use_dictionary=others,
        use_byte_stream_split=numbers,
    )
    return sink.getvalue().to_pybytes()


def _read_whole(path: Path) -> list[TrialRow]:
    if not path.exists():
        return []
    with refused_as(UsageError, ImportError, f"{path} needs pyarrow: pip install 'armature-calib[study]'"):
        import pyarrow
        from pyarrow import parquet
    with refused_as(
        UsageError,
        (pyarrow.ArrowException, OSError),
        f"{path} is damaged: {{}}; delete it, and its trials are run again",
    ):
        table = parquet.read_table(path)
    store = (table.schema.metadata or {}).get(b"store", b"").decode()
    _check_columns(path, [store, *table.column_names])
    rows = [TrialRow(**row) for row in table.to_pylist()]
    if wrong := {row.status for row in rows} - set(STATUSES):
        raise UsageError(
            f"{path} is damaged: no trial ends with the status '{min(wrong)}'; delete it, and its trials are run again"
        )
    return rows
