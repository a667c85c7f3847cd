"""Recordings from files: NumPy archives, CSV tables or ROS bags, recognised by their first bytes.

A CSV table has one column of stamps, one per joint and quantity (``q1 [deg]``, ``tau_elbow [Nm]``). A quantity's name
(`recording_options`) is before or after the joint's number or name, with or without a ``_`` (``q1``, ``q_1``,
``position_elbow``, ``elbow_position``, ``J1 pos``; ``q[1]`` has a number, not a unit); numbers start at 0 or 1. What
bags hold: ``calib formats logs``.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from calib.data.csv_table import Table, read_table
from calib.data.recordings.archives import read_archive
from calib.data.recordings.checks import check_recording
from calib.data.recordings.recording import Ends, Recording, earlier, in_pieces, named, parse_cut, rows_used
from calib.data.recordings.recording_options import (
    MEASURED,
    SCALES,
    SYNONYMS,
    RecordingOptions,
    check_units,
    one_effort,
    plain_stems,
    stem_of,
)
from calib.data.schema import AS_DESCRIBED, MOTORS_AS_DESCRIBED, Joints
from calib.errors import MeasurementError, refuse_data, suggestion
from calib.extensions import Point
from calib.files import check_regular

READ_BAG: "Point[Reader]" = Point("read_bag", "a ROS bag's recording")


def read_log(path: Path, joints: Joints | None, options: RecordingOptions, ends: Ends = (None, None)) -> Recording:
    """Return the recording in a CSV table from ends[0] to ends[1] [s]; only shapes are checked; about 20 MB/s."""
    table = _numbered_brackets(read_table(path, doubles=True))
    found = _find(table, options, joints.names if joints else ())
    chosen = one_effort({ours: ours for ours in found}, options, table.header, path)
    found = {ours: found[theirs] for ours, theirs in chosen.items()}
    n = len(found["q"])
    for ours, columns in found.items():
        if ours != "t" and len(columns) != n:
            refuse_data(path, f"{len(columns)} columns of {ours} ({', '.join(_called(table, columns))}) for {n} of q")
        check_units(ours, [table.units[place] for place in columns], joints, path)
    t = _stamps(table, found, options)
    used, spread = rows_used(t, ends, options.samples, path)
    table = table.where(used)
    taken = {place for columns in found.values() for place in columns}
    table.check(names := _called(table, sorted(taken)), names)
    kind = "current" if "current" in found else "torque"
    series: dict[str, Any] = {
        "effort" if ours == kind else ours: np.column_stack([_values(table, c, ours, options) for c in columns])
        for ours, columns in found.items()
        if ours not in ("t", "q")
    }
    unused = [name for place, name in enumerate(table.header) if place not in taken]
    notes = [*table.notes, *spread, *([f"not read: {', '.join(unused)}"] if unused else [])]
    for ours, columns in found.items():
        if stem_of(table.header[columns[0]])[0].startswith(MEASURED):
            notes.append(f"{ours} is read from {', '.join(_called(table, columns))}")
        if len(units := dict.fromkeys(table.units[place] or "no unit" for place in columns)) > 1:
            notes.append(f"the columns of {ours} have different units ({', '.join(units)}): is this intended?")
    names = joints.names if joints is not None and len(joints.names) == n else _joint_names(table, found["q"])
    return Recording(
        t[used],
        np.column_stack([_values(table, place, "q", options) for place in found["q"]]),
        kind=kind,
        joint_names=named(names, n),
        file=str(path),
        rows=table.rows,
        notes=tuple(notes),
        **series,
    )


def read_positions(path: Path, joints: Joints, options: RecordingOptions) -> tuple[np.ndarray, np.ndarray]:
    """Return the stamps (N,) [s] and reference positions (N, n) of a table: q_ref, or q without it."""
    table = _numbered_brackets(read_table(path, doubles=True))
    here = replace(options, names={key: name for key, name in options.names.items() if key in ("t", "q", "q_ref")})
    found = _find(table, here, joints.names)
    ours = "q_ref" if "q_ref" in found else "q"
    if ours not in found:
        expected = ", ".join((*SYNONYMS["q_ref"], *SYNONYMS["q"]))
        message = f"has no reference positions ({expected}, with the joints' numbers or names)"
        refuse_data(path, f"{message}; found: {', '.join(table.header)}")
    q = np.column_stack([_values(table, place, ours, options) for place in found[ours]])
    return _stamps(table, found, options), q


def _numbered_brackets(table: Table) -> Table:
    """Return the table with headings like ``q[1]`` (joint number in brackets) renamed to ``q1``."""
    if not any(unit.isdigit() for unit in table.units):
        return table
    header = tuple(name + unit if unit.isdigit() else name for name, unit in zip(table.header, table.units))
    units = tuple("" if unit.isdigit() else unit for unit in table.units)
    return Table(table.file, header, units, table.cells, table.rows, table.notes)


def _find(table: Table, options: RecordingOptions, joints: Sequence[str]) -> dict[str, list[int]]:
    """Return the column indices of each series, in the robot's order, by the toolkit's name."""
    found = {}
    for ours, synonyms in SYNONYMS.items():
        stems = (options.names[ours],) if ours in options.names else synonyms
        ways = (_alone,) if ours == "t" else (partial(_of_joints, joints=joints), _numbered)
        if places := next((places for stem in stems for way in ways if (places := way(table, stem))), None):
            found[ours] = places
        elif ours in options.names:
            message = f"no column begins with '{options.names[ours]}'{suggestion(options.names[ours], table.header)}"
            table.fail(f"{message}; found: {', '.join(table.header)}")
    return found


def _alone(table: Table, stem: str) -> list[int]:
    """Return the index of the one column with this name; [] if absent."""
    header = [name.lower() for name in table.header]
    return [header.index(stem.lower())] if stem.lower() in header else []


def _of_joints(table: Table, stem: str, joints: Sequence[str]) -> list[int]:
    """Return the indices of the columns of one quantity that are named after the joints."""
    header, stem = [name.lower() for name in table.header], stem.lower()
    for pattern in (f"{stem}_{{}}", f"{stem}{{}}", f"{stem} {{}}", f"{{}}_{stem}", f"{{}}.{stem}", f"{stem}.{{}}"):
        columns = [pattern.format(joint.lower()) for joint in joints]
        if columns and all(column in header for column in columns):
            return [header.index(column) for column in columns]
    return []


def _numbered(table: Table, stem: str) -> list[int]:
    """Return the indices of the numbered columns of one quantity; [] unless numbered from 0 or 1 without gaps."""
    found: dict[str, list[tuple[int, int]]] = {}
    for place, name in enumerate(table.header):
        own, number = stem_of(name)
        if number is not None:
            found.setdefault(own, []).append((number, place))
    places = sorted(found.get(plain_stems(tuple(found)).get(stem_of(stem)[0], ""), []))
    numbers = [number for number, _ in places]
    if not numbers or numbers[0] > 1 or numbers != list(range(numbers[0], numbers[0] + len(numbers))):
        return []
    return [place for _, place in places]


def _called(table: Table, places: Sequence[int]) -> list[str]:
    return [table.header[place] for place in places]


def _joint_names(table: Table, places: Sequence[int]) -> list[str]:
    names = [name.split("_", 1)[-1] for name in _called(table, places)]
    return names if len(set(names)) == len(names) and all(names) else []


def _values(table: Table, place: int, ours: str, options: RecordingOptions) -> np.ndarray:
    """Return a column in SI; NaN is kept and refused later, if it is within the cut."""
    return table.numbers(table.header[place], None, gaps=True) * table.factor(
        place, SCALES[ours], options.units.get(ours, "")
    )


def _stamps(table: Table, found: dict[str, list[int]], options: RecordingOptions) -> np.ndarray:
    if "t" in found:
        t = _values(table, found["t"][0], "t", options)
        return t - t[0]
    if options.rate:
        return np.arange(len(table)) / options.rate
    expected = ", ".join(SYNONYMS["t"])
    message = f"has no column of stamps ({expected}), and the options state no rate; found: {', '.join(table.header)}"
    table.fail(message)


Reader = Callable[[Path, Joints | None, RecordingOptions], Recording]


def read_recording(
    path: str | Path, joints: Joints | None = None, options: RecordingOptions | None = None
) -> Recording:
    """Return the checked recording at `path`, which may be cut in time (``log.npz@0:9.4``).

    Args:
        joints: the robot's; columns are put in their order if the file names its joints.

    Raises:
        MeasurementError: where the file cannot be what it should be; with row and column.
        UsageError: for an invalid cut.
    """
    file, start, stop = parse_cut(str(path))
    options = options or RecordingOptions()
    for name, unit in options.units.items():
        check_units(name, [unit] * len(joints.names if joints else ()), joints, file)
    recording = _described(_reader(Path(file), (start, stop))(Path(file), joints, options), options.controller)
    if (start, stop) != (None, None):
        recording = recording.cut(start, stop)
    recording = in_pieces(recording, options.samples)
    if joints is not None and recording.n != len(joints.names):
        message = (
            f"has {recording.n} joints ({', '.join(recording.joint_names)}), the robot has {len(joints.names)} "
            f"({', '.join(joints.names)}): is this another robot's recording?"
        )
        refuse_data(recording.file, message)
    return check_recording(earlier(recording, options.lag), joints)


def _described(recording: Recording, controller: str) -> Recording:
    """Return a recording of the description's joints from one of joints as a controller shows them."""
    if not controller:
        return recording
    parts = {
        AS_DESCRIBED: ("q", "v", "q_link", "q_ref"),
        MOTORS_AS_DESCRIBED: ("effort", "tau_link", "tau_motor", "tau_ff"),
    }
    series = {name: (how, getattr(recording, name)) for how, names in parts.items() for name in names}
    changed = {name: how.one()(controller, own) for name, (how, own) in series.items() if own is not None}
    return replace(recording, **changed)


def _reader(path: Path, ends: Ends) -> Reader:
    """Return the reader for a path, chosen by the file's first bytes or suffix; a folder is a bag."""
    try:
        if path.exists():
            check_regular(path)
        if path.is_dir() or path.suffix in (".bag", ".mcap", ".db3"):
            return READ_BAG.one()
        with open(path, "rb") as file:
            head = file.read(1 << 16)
    except OSError as error:
        hint = "; write a cut as log.npz@0:9.4, in seconds" if "@" in path.name else ""
        raise MeasurementError(f"cannot be read: {error.strerror}{hint}", path) from error
    if head[:2] == b"PK":
        return partial(read_archive, ends=ends)
    if head and path.suffix == ".npz":
        refuse_data(path, "is not a NumPy archive despite its name: was it written by np.savez?")
    if not head or b"\0" in head:
        found = "is empty" if not head else "is neither a NumPy archive, a bag nor text"
        refuse_data(path, f"{found}: expected .npz, .csv, .mcap, .bag or a ROS 2 bag's folder")
    if len(head) == 1 << 16 and b"\n" not in head:
        refuse_data(path, "has a first line of more than 64 kB: not a table")
    return partial(read_log, ends=ends)
