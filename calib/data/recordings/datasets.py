"""LeRobot data sets and other Parquet files as tables: a data set's folder, or one ``.parquet`` file of it.

A column of lists (``observation.state``, ``action``, ``observation.effort``) becomes one column per number, named as
``meta/info.json`` names them (``observation.state.shoulder_pan.pos``), or numbered where it states no names. Positions
are ``observation.state``, references ``action``; a gripper's columns are left out by their names. Torques or currents
are read where the data set has them (``observation.effort``, ``.torque``, ``.current``); most have positions only.
Episodes follow each other, `BREAK` s apart, since each begins at 0 s; one alone is read by its file, or by a cut in
time. LeRobot writes positions in degrees or in percent of each joint's range, and does not say which.

Source: huggingface/lerobot, src/lerobot/datasets: versions 2.0 (``data/chunk-000/episode_000000.parquet``) to 3.0
(``data/chunk-000/file-000.parquet``). Read by pyarrow (Apache-2.0), which is imported when a file is read.
"""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from calib.data.csv_table import Table
from calib.data.joint_columns import words_of
from calib.data.recordings.log_columns import QUANTITIES
from calib.errors import MeasurementError, refuse_data, refused_as
from calib.records import frozen
from calib.workers.extras import needing

INFO = Path("meta") / "info.json"
# Time between two episodes [s] (our choice): longer than any gap that is bridged.
BREAK = 1.0
# Column of the number of each row's episode.
EPISODE = "episode_index"
# Columns of LeRobot that are no measurements.
COUNTERS = (EPISODE, "frame_index", "index", "task_index", "next.done", "next.reward")
# Letters of a cell that a message quotes.
TEXT = 20
EFFORT_WORDS = frozenset(word for word, series in QUANTITIES.items() if series in ("torque", "current"))
# Columns whose numbers are positions of joints, where their names do not say what they are.
POSITIONS = ("observation.state", "action")


def is_dataset(path: Path) -> bool:
    """Return whether `path` is the folder of a LeRobot data set, or a Parquet file."""
    return (path / INFO).is_file() or path.suffix.lower() == ".parquet"


def is_dataset_without_meta(path: Path) -> bool:
    """Return whether `path` is a folder with a data set's Parquet files and without ``meta/info.json``."""
    return path.is_dir() and not (path / INFO).is_file() and any(path.rglob("*.parquet"))


def dataset_table(path: Path) -> Table:
    """Return a LeRobot data set or a Parquet file as a table.

    Args:
        path: the data set's folder, or a file.

    Raises:
        UsageError: pyarrow is not installed.
        MeasurementError: a file that cannot be read, or without columns of numbers.
    """
    root = _root(path)
    files = [path]
    if path.is_dir():
        root = path
        files = sorted((path / "data").rglob("*.parquet"))
        if not files:
            refuse_data(path, "has no file data/**/*.parquet: was the data set downloaded without its data?")
    names = _stated_names(root)
    columns: dict[str, list[np.ndarray]] = {}
    for file in files:
        for name, values in _columns(file, names).items():
            columns.setdefault(name, []).append(values)
    arrays = {}
    for name, parts in columns.items():
        arrays[name] = np.concatenate(parts)
    lengths = set(map(len, arrays.values()))
    if len(lengths) != 1:
        refuse_data(path, "has no columns of numbers, or files with different columns")
    notes = ["read as a Parquet file"]
    if root:
        notes = ["read as a LeRobot data set"]
    count = lengths.pop()
    if not count:
        refuse_data(path, "has no rows: was the recording stopped before its first sample, or the copy not finished?")
    notes += _with_episodes(arrays)
    header = [name for name in arrays if name not in COUNTERS]
    if EPISODE in arrays and np.ptp(arrays[EPISODE]) > 0:
        header.append(EPISODE)
    cells = tuple(frozen(arrays[name]) for name in header)
    rows = frozen(np.arange(1, count + 1), int)
    return Table(str(path), tuple(header), ("",) * len(header), cells, rows, tuple(notes))


def _root(path: Path) -> Path | None:
    """Return the folder of the data set that a file belongs to; None for a file of its own."""
    for folder in path.resolve().parents:
        if (folder / INFO).is_file():
            return folder
    return None


def _stated_names(root: Path | None) -> dict[str, list[str]]:
    """Return the names of each list's numbers, from ``meta/info.json``; empty without that file."""
    if root is None:
        return {}
    with refused_as(MeasurementError, (OSError, ValueError), "cannot be read ({}): is the copy complete?", root / INFO):
        info = json.loads((root / INFO).read_text(encoding="utf-8"))
    names = {}
    for feature, entry in info.get("features", {}).items():
        names[feature] = _flat(entry.get("names"))
    return names


def _flat(names: object) -> list[str]:
    """Return names as a flat list: LeRobot writes a list, a list of lists, or a table of lists."""
    if isinstance(names, str):
        return [names]
    if isinstance(names, dict):
        names = list(names.values())
    result: list[str] = []
    if isinstance(names, list):
        for name in names:
            result += _flat(name)
    return result


def _columns(file: Path, names: dict[str, list[str]]) -> dict[str, np.ndarray]:
    """Return the columns of numbers in a Parquet file, those of lists split.

    Args:
        file: the file.
        names: names of the numbers in each list.
    """
    with needing("pyarrow"):
        import pyarrow
        from pyarrow import parquet
    with refused_as(MeasurementError, (OSError, pyarrow.ArrowException), "cannot be read as Parquet ({})", file):
        table = parquet.read_table(file)
    result: dict[str, np.ndarray] = {}
    for name in table.column_names:
        column = table.column(name)
        kind = column.type
        if pyarrow.types.is_integer(kind) or pyarrow.types.is_floating(kind):
            result[name] = np.asarray(column.to_numpy(), dtype=float)
        elif pyarrow.types.is_list(kind) or pyarrow.types.is_fixed_size_list(kind):
            if not (pyarrow.types.is_floating(kind.value_type) or pyarrow.types.is_integer(kind.value_type)):
                continue
            rows = column.to_pylist()
            widths = {len(row) for row in rows if row is not None}
            if len(widths) == 1 and None not in rows:
                matrix = np.array(rows, dtype=float)
                headings = _headings(name, names.get(name, []), matrix.shape[1])
                result.update(zip(headings, matrix.T))
            elif rows and _is_measured(name):
                _refuse_uneven(file, name, rows)
        elif pyarrow.types.is_string(kind) and len(column) and _is_measured(name):
            text = str(column[0])[:TEXT]
            refuse_data(file, f"is text ('{text} …'), not lists of numbers: write it again as numbers", name)
    return result


def _is_measured(name: str) -> bool:
    """Return whether a column is the state or an effort, without which a data set is no recording."""
    return name == POSITIONS[0] or bool(EFFORT_WORDS.intersection(words_of(name)))


def _refuse_uneven(file: Path, name: str, rows: Sequence[Sequence[float] | None]) -> None:
    """Raise MeasurementError for lists of which some are empty, or shorter than others.

    Args:
        file: the file.
        name: the column.
        rows: its lists.
    """
    widths = np.array([-1 if row is None else len(row) for row in rows])
    width = int(widths.max())
    uneven = np.flatnonzero(widths < width)
    if not len(uneven):
        refuse_data(file, "is null in every row: was it recorded?", name)
    first = int(uneven[0])
    content = "null" if widths[first] < 0 else f"a list of {widths[first]} numbers"
    message = f"is {content}, {len(uneven)} of {len(rows)} rows are not lists of {width} numbers: leave these rows out"
    refuse_data(file, message, name, first + 1)


def _headings(name: str, parts: Sequence[str], count: int) -> list[str]:
    """Return the heading of each number of a list, with the word ``pos`` where none tells the quantity.

    The word is left out in lists of another quantity: LeRobot's robots name their motors by it (``elbow_flex.pos``).

    Args:
        name: name of the list.
        parts: names of its numbers; another count than `count`: they are numbered.
        count: number of its numbers.
    """
    if len(parts) != count:
        parts = list(map(str, range(count)))
    headings = []
    for part in parts:
        if QUANTITIES.keys() & set(words_of(name)):
            part = part.removesuffix(".pos")
        heading = f"{name}.{part}"
        if name in POSITIONS and not QUANTITIES.keys() & set(words_of(part)):
            heading += ".pos"
        headings.append(heading)
    return headings


def _with_episodes(arrays: dict[str, np.ndarray]) -> list[str]:
    """Let episodes follow each other in the column of times, and return a note on several.

    Args:
        arrays: the columns; ``timestamp`` is replaced.
    """
    if "timestamp" not in arrays or EPISODE not in arrays:
        return []
    t = arrays["timestamp"].copy()
    edges = np.flatnonzero(np.diff(arrays[EPISODE])) + 1
    for first in edges:
        t[first:] += t[first - 1] + BREAK - t[first]
    arrays["timestamp"] = t
    if not len(edges):
        return []
    starts = ", ".join(f"{t[first]:.4g}" for first in edges[:5])
    return [f"{len(edges) + 1} episodes, one behind the other with {BREAK:g} s between; they begin at 0, {starts} s …"]
