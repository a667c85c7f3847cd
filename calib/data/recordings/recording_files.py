"""Recordings from files: NumPy archives, CSV tables, ROS bags or LeRobot data sets, by their first bytes.

A CSV table has one column of stamps, one per joint and quantity (``q1 [deg]``, ``tau_elbow [Nm]``). A quantity's name
(`recording_options`) is before or after the joint's number or name, with or without a ``_`` (``q1``, ``q_1``,
``position_elbow``, ``elbow_position``, ``J1 pos``; ``q[1]`` has a number, not a unit); numbers start at 0 or 1. Other
names are told by their words (``/joint_states/elbow/position`` of PlotJuggler, ``A1 current [mA]``, ``Winkel A1``), and
said as a line ``columns = { … }``, which options files take. Rows without positions (of other topics) are left out;
quantities that are NaN in every row are not provided. Times without a unit that can be no seconds are read in the only
plausible one. Bags, data sets, and what ROS's tools print: ``calib formats logs``. Positions and torques in files of
their own: ``calib join``.
"""

import logging
import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from calib.controllers.axes import as_described, named_joints
from calib.controllers.table import motors_as_described
from calib.data.csv_table import Table, encoding_of, read_header, read_table
from calib.data.joint_columns import words_of
from calib.data.recordings import log_columns
from calib.data.recordings.archives import read_archive
from calib.data.recordings.checks import check_recording
from calib.data.recordings.datasets import EPISODE, INFO, dataset_table, is_dataset, is_dataset_without_meta
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
from calib.data.recordings.stamps import in_seconds, likely_unit
from calib.data.recordings.topics import of_one_topic
from calib.data.schema import Joints
from calib.errors import MeasurementError, UsageError, refuse_data
from calib.files import check_regular
from calib.records import FieldValues
from calib.units import TIMES

_LOG = logging.getLogger(__name__)
NO_JOINTS = Joints(())
# Largest number of files that are looked at for a missing quantity (our choice).
MAX_BESIDE = 50
# Name in a message of a file that is not known.
OTHER_FILE = "OTHER.csv"
# Letter of the heading of a column that is not looked at.
HIDDEN = "\0"
# Series of which a log needs one beside the positions.
EFFORTS = frozenset(("torque", "current", "tau_link", "tau_motor"))
QUANTITY_NOUNS = {"q": "positions", "torque": "torques"}
# What a note says of columns without any number.
ABSENT = "not provided, NaN or empty in every row"


def read_log(
    path: Path,
    joints: Joints | None,
    options: RecordingOptions,
    ends: Ends = (None, None),
    companions: Sequence[Path] = (),
) -> Recording:
    """Return the recording in a CSV table from ends[0] to ends[1] [s]; values are not checked.

    The speed is about 20 MB/s.

    Args:
        path: the file.
        joints: the robot's joints, in whose order columns are put; None: as in the file.
        options: options for reading the file.
        ends: begin and end of the part to read; None: no bound.
        companions: other recordings of the same command, which may have what this one lacks.
    """
    table = _log_table(path)
    robot_joints = joints or NO_JOINTS
    joint_names = robot_joints.names
    columns_of, column_notes = _find_columns(table, options, robot_joints)
    advice = _advice(table, columns_of, robot_joints, companions)
    renamed = one_effort({name: name for name in columns_of}, options, table.header, path, advice)
    columns_of = {name: columns_of[file_name] for name, file_name in renamed.items()}
    n = len(columns_of["q"])
    for name, columns in columns_of.items():
        if name != "t" and len(columns) != n:
            headings = ", ".join(_headings(table, columns))
            refuse_data(
                path, f"has {len(columns)} columns of {name} ({headings}), but {n} of q: one per joint is needed"
            )
        check_units(name, [table.units[column] for column in columns], joints, path)

    t, time_notes = _stamps(table, columns_of, options)
    table, t, row_notes = of_one_topic(table, columns_of, t)
    rows, notes = rows_used(t, ends, options.samples, path)
    table = table.where(rows)
    breaks = _episode_ends(table, t[rows])
    read_columns: set[int] = set()
    for columns in columns_of.values():
        read_columns.update(columns)
    headings = _headings(table, sorted(read_columns))
    table.check(headings, headings)

    kind = "current" if "current" in columns_of else "torque"
    series: FieldValues = {}
    for name, columns in columns_of.items():
        if name != "t":
            values = [_values(table, column, name, options) for column in columns]
            series["effort" if name == kind else name] = np.column_stack(values)

    if EPISODE in table:
        read_columns.add(table.index(EPISODE))
    unused = [column for column in range(len(table.header)) if column not in read_columns]
    notes = [*table.notes, *column_notes, *time_notes, *row_notes, *notes]
    if unused:
        notes.append(f"not read: {', '.join(log_columns.condensed(table.header, robot_joints, unused))}")
    by_words = any(note.startswith("read as columns") for note in column_notes)
    for name, columns in columns_of.items():
        if not by_words and stem_of(table.header[columns[0]])[0].startswith(MEASURED):
            notes.append(f"{name} is read from {', '.join(_headings(table, columns))}")
        units = dict.fromkeys(table.units[column] or "no unit" for column in columns)
        if len(units) > 1:
            notes.append(f"the columns of {name} have different units ({', '.join(units)}): is this intended?")
    if len(joint_names) != n:
        joint_names = tuple(_joint_names(table, columns_of["q"]))
    return Recording(
        t[rows],
        kind=kind,
        joint_names=named(joint_names, n),
        file=str(path),
        rows=table.rows,
        notes=tuple(notes),
        breaks=breaks,
        **series,
    )


def _episode_ends(table: Table, t: np.ndarray) -> tuple[float, ...]:
    """Return the times [s] of the last sample of each episode of a data set but the last; () for other tables.

    Args:
        table: the table.
        t: (N,) time stamps [s] of its rows.
    """
    if EPISODE not in table:
        return ()
    episode = table.numbers(EPISODE, None, gaps=True)
    ends = np.flatnonzero(np.diff(episode) != 0)
    return tuple(t[ends].tolist())


def read_positions(path: Path, joints: Joints, options: RecordingOptions) -> tuple[np.ndarray, np.ndarray]:
    """Return the time stamps (N,) [s] and reference positions (N, n) in a table: q_ref, or q if there is no q_ref.

    Args:
        path: the CSV table.
        joints: the robot's n joints, in whose order columns are put.
        options: options for reading the file.
    """
    table = _numbered_brackets(read_table(path, doubles=True))
    names = {key: name for key, name in options.names.items() if key in ("t", "q", "q_ref")}
    columns_of, _ = _find_columns(table, replace(options, names=names), joints)
    name = "q_ref" if "q_ref" in columns_of else "q"
    if name not in columns_of:
        expected = ", ".join((*SYNONYMS["q_ref"], *SYNONYMS["q"]))
        message = f"has no reference positions ({expected}, with the joints' numbers or names)"
        refuse_data(path, f"{message}; found: {', '.join(table.header)}")
    q = np.column_stack([_values(table, column, name, options) for column in columns_of[name]])
    t, _ = _stamps(table, columns_of, options)
    return t, q


def _numbered_brackets(table: Table) -> Table:
    """Return the table with headers such as ``q[1]`` (joint number in brackets) renamed to ``q1``."""
    header = []
    units = []
    for name, unit in zip(table.header, table.units):
        has_number = unit.isdigit()
        header.append(name + unit if has_number else name)
        units.append("" if has_number else unit)
    return replace(table, header=tuple(header), units=tuple(units))


def _find_columns(table: Table, options: RecordingOptions, joints: Joints) -> tuple[dict[str, list[int]], list[str]]:
    """Return the column indices of each series, in the robot's joint order, by the toolkit's name, and notes.

    Columns that are NaN in every row count as not provided.

    Args:
        table: the table.
        options: options for reading the file, which may name columns.
        joints: names of the robot's joints.
    """
    columns_of = _stated_columns(table, options, joints)
    header = list(table.header)
    notes: list[str] = []
    for name, synonyms in SYNONYMS.items():
        while name not in columns_of:
            provided = replace(table, header=tuple(header))
            columns = (
                _stamp_column(provided, synonyms) if name == "t" else _joint_columns(provided, synonyms, joints.names)
            )
            if not columns:
                break
            if name == "t" or not _all_nan(table, columns):
                columns_of[name] = columns
                break
            notes.append(_hide(header, columns))
    absent = [family for family in log_columns.families(header, joints) if _all_nan(table, family.columns)]
    notes += [_hide(header, family.columns) for family in absent if family.series]
    # columns that a series has by its own name have no other meaning
    assigned = {column for columns in columns_of.values() for column in columns}
    present = log_columns.families(header, joints)
    candidates = [family for family in present if assigned.isdisjoint(family.columns)]
    by_series, rivals = log_columns.chosen(candidates)
    by_words = {name: family for name, family in by_series.items() if name not in columns_of}
    columns_of |= {name: list(family.columns) for name, family in by_words.items()}
    for family in candidates:
        # names of joints alone: what the file's name says, else positions
        series = log_columns.series_of(words_of(Path(table.file).stem)) or "q"
        if family.plain and series not in columns_of:
            columns_of[series] = list(family.columns)
            by_words[series] = family
    if "t" not in columns_of:
        timed = log_columns.time_column(header)
        if timed is not None:
            columns_of["t"] = [timed[0]]
    if by_words or options.columns or options.names:
        notes.append(f"read as {log_columns.mapping_line(table.header, joints, columns_of)}")
        by_topic = [family.pattern for family in by_words.values() if family.pattern.startswith("/")]
        if any(log_columns.NUMBER in pattern for pattern in by_topic):
            notes.append(
                f"numbers are taken for {', '.join(joints.names)} in this order: is it the order of the message?"
            )
    if by_words and rivals:
        notes.append(f"also there, not read: {', '.join(rivals)}")
    return columns_of, notes


def _all_nan(table: Table, columns: Sequence[int]) -> bool:
    """Return whether columns contain no number in any row."""
    for column in columns:
        cells = table.cells[column]
        if cells.dtype != float or not np.isnan(cells).all():
            return False
    return True


def _hide(header: list[str], columns: Sequence[int]) -> str:
    """Replace the headings of columns that the logger did not provide by unique blanks; return a note on them."""
    headings = ", ".join(header[column] for column in columns)
    for column in columns:
        header[column] = HIDDEN * (column + 1)
    return f"{ABSENT}: {headings}"


def _stated_columns(table: Table, options: RecordingOptions, joints: Joints) -> dict[str, list[int]]:
    """Return the column indices of the series that the options name.

    Args:
        table: the table.
        options: options for reading the file.
        joints: names of the robot's joints.
    """
    columns_of: dict[str, list[int]] = {}
    of_series = {key: heading for key, heading in options.columns.items() if key in SYNONYMS}
    for name, heading in {**options.names, **of_series}.items():
        columns: list[int] = []
        if name == "t":
            columns = _stamp_column(table, [heading])
        elif "{" not in heading:
            columns = _joint_columns(table, [heading], joints.names)
        columns = columns or list(log_columns.columns_meant(heading, table.header, joints))
        if not columns:
            hint = log_columns.near_names(heading, table.header, joints)
            table.fail(f"no columns are named '{heading}' ({name}){hint}; found: {', '.join(table.header)}")
        columns_of[name] = columns
    of_joints = {key: heading for key, heading in options.columns.items() if key not in SYNONYMS}
    for name, by_joint in log_columns.joint_keys(of_joints, joints, table).items():
        columns_of[name] = [table.index(by_joint[joint]) for joint in range(len(by_joint))]
    return columns_of


def _log_table(path: Path) -> Table:
    """Return the table of a log: a CSV file, a Parquet file or a data set's folder."""
    if is_dataset(path):
        return dataset_table(path)
    return _numbered_brackets(read_table(path, doubles=True))


def _lacking(columns_of: Mapping[str, Sequence[int]]) -> list[str]:
    """Return which of positions (``q``) and efforts (``torque``) a log does not have.

    Args:
        columns_of: the columns of each series that were found.
    """
    lacking = [] if "q" in columns_of else ["q"]
    if EFFORTS.isdisjoint(columns_of):
        lacking.append("torque")
    return lacking


def _advice(table: Table, columns_of: dict[str, list[int]], joints: Joints, companions: Sequence[Path]) -> str:
    """Return advice for a table without positions or without torques: a line to paste, or to join two files.

    Args:
        table: the table.
        columns_of: the columns of each series that were found.
        joints: names of the robot's joints.
        companions: other recordings of the same command.
    """
    needed = _lacking(columns_of)
    if not needed:
        return ""
    read_columns: set[int] = set()
    for columns in columns_of.values():
        read_columns.update(columns)
    header = list(table.header)
    for column in read_columns:
        header[column] = HIDDEN * (column + 1)
    line = log_columns.paste(header, joints, needed)
    if line:
        return f". If these are meant, state them in the options (--options FILE), joints in this order: {line}"
    if not columns_of.keys() - {"t"}:
        return ""
    quantities = " and ".join(map(QUANTITY_NOUNS.__getitem__, needed))
    path = Path(table.file)
    for companion in companions:
        if companion != path and _supplies(companion, needed, joints) is not None:
            return (
                f". {companion} has {quantities}: if its times are of the same clock, join the two first: "
                f"calib join {path} {companion} --out log.csv"
            )
    return (
        f". Are the {quantities} in another file? If its times are of the same clock, join them first: "
        f"calib join {path} {_file_beside(table, columns_of, joints)} --out log.csv"
    )


def _file_beside(table: Table, columns_of: dict[str, list[int]], joints: Joints) -> str:
    """Return the first log in a table's folder that has what the table lacks, at the same times; ``OTHER.csv`` if none.

    Args:
        table: the table.
        columns_of: the columns of each series that were found.
        joints: names of the robot's joints.
    """
    path = Path(table.file)
    span = _span(table, columns_of)
    if span is None:
        return OTHER_FILE
    for candidate in sorted(path.parent.glob("*.csv"))[:MAX_BESIDE]:
        if candidate.name == path.name:
            continue
        times = _supplies(candidate, _lacking(columns_of), joints)
        if times is not None and times[0] < span[1] and span[0] < times[1]:
            return str(candidate)
    return OTHER_FILE


def _supplies(path: Path, needed: Sequence[str], joints: Joints) -> tuple[float, float] | None:
    """Return the first and last time [s] of a log that has the needed series and lacks others; None for another file.

    A log that has positions and torques is complete: it belongs to no other.

    Args:
        path: the file.
        needed: the toolkit's names of the series.
        joints: names of the robot's joints, all of which it must have.
    """
    with suppress(MeasurementError, UsageError, OSError):
        if not is_dataset(path):
            header, _ = read_header(path)
            quantities = set(map(log_columns.series_of, map(words_of, (*header, path.stem))))
            if not quantities & {*needed, *EFFORTS}:
                return None
        table = _log_table(path)
        columns_of, _ = _find_columns(table, RecordingOptions(), joints)
        lacking = _lacking(columns_of)
        if lacking and set(lacking).isdisjoint(needed):
            return _span(table, columns_of)
    return None


def _span(table: Table, columns_of: Mapping[str, Sequence[int]]) -> tuple[float, float] | None:
    """Return the first and last time stamp in a log [s]; None without stamps.

    Args:
        table: the table.
        columns_of: the columns of each series that were found.
    """
    if "t" not in columns_of or not len(table):
        return None
    (column,) = columns_of["t"]
    stamps = _values(table, column, "t", RecordingOptions())
    if not table.units[column]:
        stamps = stamps * TIMES[likely_unit(stamps) or "s"]
    return float(np.nanmin(stamps)), float(np.nanmax(stamps))


def _stamp_column(table: Table, names: Sequence[str]) -> list[int]:
    """Return a list with the index of the time stamps' column, the first of `names` in the table; [] if it has none."""
    header = [heading.lower() for heading in table.header]
    for name in names:
        if name.lower() in header:
            return [header.index(name.lower())]
    return []


def _joint_columns(table: Table, stems: Sequence[str], joints: Sequence[str]) -> list[int]:
    """Return the column indices of the first quantity in `stems` that the table has for all joints; else [].

    Args:
        table: the table.
        stems: accepted names of the quantity.
        joints: names of the robot's joints.
    """
    for stem in stems:
        columns = _of_joints(table, stem, joints) or _numbered(table, stem)
        if columns:
            return columns
    return []


def _of_joints(table: Table, stem: str, joints: Sequence[str]) -> list[int]:
    """Return the indices of the columns whose names consist of the quantity `stem` and a joint's name; else [].

    Args:
        table: the table.
        stem: name of the quantity.
        joints: names of the robot's joints, in the order of the result.
    """
    header, stem = [name.lower() for name in table.header], stem.lower()
    for pattern in (f"{stem}_{{}}", f"{stem}{{}}", f"{stem} {{}}", f"{{}}_{stem}", f"{{}}.{stem}", f"{stem}.{{}}"):
        columns = [pattern.format(joint.lower()) for joint in joints]
        if columns and all(column in header for column in columns):
            return [header.index(column) for column in columns]
    return []


def _numbered(table: Table, stem: str) -> list[int]:
    """Return the indices of the columns named by the quantity `stem` and a number, in order of the numbers.

    [] if there are none, or if they are not numbered from 0 or 1 without gaps.

    Args:
        table: the table.
        stem: name of the quantity.
    """
    numbered: dict[str, list[tuple[int, int]]] = {}
    for column, name in enumerate(table.header):
        column_stem, number = stem_of(name)
        if number is not None:
            numbered.setdefault(column_stem, []).append((number, column))
    plain_stem = stem_of(stem)[0]
    full_stem = plain_stems(tuple(numbered)).get(plain_stem)
    pairs = [] if full_stem is None else sorted(numbered[full_stem])
    numbers = [number for number, _ in pairs]
    if not numbers or numbers[0] > 1 or numbers != list(range(numbers[0], numbers[0] + len(numbers))):
        return []
    return [column for _, column in pairs]


def _headings(table: Table, columns: Sequence[int]) -> list[str]:
    return [table.header[column] for column in columns]


def _joint_names(table: Table, columns: Sequence[int]) -> list[str]:
    names = [name.split("_", 1)[-1] for name in _headings(table, columns)]
    return names if len(set(names)) == len(names) and all(names) else []


def _values(table: Table, column: int, series: str, options: RecordingOptions) -> np.ndarray:
    """Return a column in SI; NaN is kept, and refused later if it is within the cut.

    Args:
        table: the table.
        column: index of the column.
        series: the toolkit's name of the series, which determines the accepted units.
        options: options for reading the file, which may state a unit.
    """
    unit = options.units.get(series, "")
    if not unit and not table.units[column] and series != "t":
        unit = _unit_of_name(table.header[column], series)
    factor = table.factor(column, SCALES[series], unit)
    return (table.numbers(table.header[column], None, gaps=True) - table.zero(column, unit)) * factor


def _unit_of_name(name: str, series: str) -> str:
    """Return the unit in which a column's name ends (``i1_mA``, ``dq1_deg_s``); "" without one.

    Args:
        name: the column's name; units of one letter are not told from it.
        series: the toolkit's name of the series, which determines the accepted units.
    """
    terms = re.split(r"[\W_]+", name.lower())
    for unit in ("/".join(terms[-2:]), terms[-1]):
        if len(unit) > 1 and unit in SCALES[series]:
            return unit
    return ""


def _stamps(table: Table, columns_of: dict[str, list[int]], options: RecordingOptions) -> tuple[np.ndarray, list[str]]:
    """Return the times (N,) [s] since the first row, and notes on their unit.

    Args:
        table: the table.
        columns_of: the columns of each series.
        options: options for reading the file, which may state a unit or a rate.
    """
    if "t" not in columns_of:
        if options.rate:
            return np.arange(len(table)) / options.rate, []
        expected = ", ".join(SYNONYMS["t"])
        message = f"has no column of stamps ({expected}), and the options state no rate"
        table.fail(f"{message}; found: {', '.join(table.header)}")
    (column,) = columns_of["t"]
    t = _values(table, column, "t", options)
    if len(t) > 1 and np.all(t == t[0]):
        heading = table.header[column]
        if options.rate:
            return np.arange(len(t)) / options.rate, [f"'{heading}' stands still: times are from the option rate"]
        table.fail(
            f"all {len(t)} stamps are {t[0]:g}: the clock was not recorded. If the samples are even, state their rate "
            "in Hz in the options (--options): recording.rate = …",
            heading,
        )
    if table.units[column] or options.units.get("t"):
        return t - t[0], []
    named_column = log_columns.time_column([table.header[column]])
    if named_column is not None and named_column[1]:
        return (t - t[0]) * TIMES[named_column[1]], [
            f"its times are in {named_column[1]}, as '{table.header[column]}' says"
        ]
    return in_seconds(t)


Reader = Callable[[Path, Joints | None, RecordingOptions], Recording]


def read_recording(
    path: str | Path,
    joints: Joints | None = None,
    options: RecordingOptions | None = None,
    companions: Sequence[str | Path] = (),
) -> Recording:
    """Return the recording at `path` after all checks; the path may contain a cut in time (``log.npz@0:9.4``).

    Args:
        path: the file.
        joints: the robot's joints; columns are put in their order if the file names its joints. None: as in the file.
        options: options for reading the file; None: the defaults.
        companions: other recordings of the same command, with or without a cut; one of them may have the series that
            this file lacks, which the error then says.

    Raises:
        MeasurementError: an invalid file or value; the message contains row and column.
        UsageError: an invalid cut.
    """
    file, start, stop = parse_cut(str(path))
    files = [Path(parse_cut(str(companion))[0]) for companion in companions]
    options = options or RecordingOptions()
    for name, unit in options.units.items():
        check_units(name, [unit] * len(joints.names if joints else ()), joints, file)
    reader = _reader(Path(file), (start, stop), files)
    recording = _described(reader(Path(file), joints, options), options, joints)
    for note in recording.notes:
        if note.startswith("read as"):
            _LOG.info("%s: %s", Path(file).name, note)
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


def read_at_rest(path: Path, joints: Joints, options: RecordingOptions) -> tuple[Recording, bool]:
    """Return the rows of a table of joints and torques, and whether they have stamps; values are only checked for gaps.

    Rows without stamps are numbered by t; they may be standing poses.

    Args:
        path: the table.
        joints: the robot's joints.
        options: options for reading the file.

    Raises:
        MeasurementError: no joint or torque columns, or cells that are no numbers.
    """
    try:
        recording, stamped = read_log(path, joints, options), True
    except MeasurementError:
        recording, stamped = read_log(path, joints, replace(options, rate=1.0)), False
    return _described(recording, options, joints), stamped


def _described(recording: Recording, options: RecordingOptions, joints: Joints | None) -> Recording:
    """Return a recording converted from the controller's joint convention to that of the robot's description.

    Args:
        recording: the recording.
        options: options with the controller and its external axes; without one, the recording is returned unchanged.
        joints: the robot's joints; None: all are turning joints of the arm.
    """
    controller = options.controller
    if not controller:
        return recording
    named = None
    if joints is not None and len(joints.names) == recording.n:
        named = named_joints(joints.names, joints.kinds)
    changes: dict[str, object] = {}
    for name in ("q", "v", "q_link", "q_ref"):
        values = getattr(recording, name)
        if values is not None:
            changes[name] = as_described(controller, values, named, options.external)
    for name in ("effort", "tau_link", "tau_motor", "tau_ff"):
        values = getattr(recording, name)
        if values is not None:
            changes[name] = motors_as_described(controller, values)
    return replace(recording, **changes)


def _reader(path: Path, ends: Ends, companions: Sequence[Path]) -> Reader:
    """Return the function that reads a file, chosen by the file's first bytes or suffix; a folder is a ROS bag.

    Args:
        path: the file.
        ends: begin and end of the cut [s]; (None, None) without a cut.
        companions: other recordings of the same command.
    """
    table_reader = partial(read_log, ends=ends, companions=companions)
    try:
        if path.exists():
            check_regular(path)
        if is_dataset(path) and path.exists():
            return table_reader
        if is_dataset_without_meta(path):
            refuse_data(
                path,
                f"has Parquet files and no {INFO}: it is a LeRobot data set without its folder meta; copy that folder, "
                "too, or name one .parquet file",
            )
        if path.is_dir() or path.suffix in (".bag", ".mcap", ".db3"):
            from calib.data.recordings.bags import read_bag

            return read_bag
        with open(path, "rb") as file:
            head = file.read(1 << 16)
    except OSError as error:
        hint = "; write a cut as log.npz@0:9.4, in seconds" if "@" in path.name else ""
        raise MeasurementError(f"cannot be read: {error.strerror}{hint}", path) from error
    if head[:2] == b"PK" and path.suffix.lower() != ".xlsx":
        return partial(read_archive, ends=ends)
    if head and path.suffix == ".npz":
        refuse_data(path, "is not a NumPy archive despite its name: was it written by np.savez?")
    is_text = b"\0" not in head or encoding_of(head) == "utf-16"
    if not head or (not is_text and head[:2] != b"PK"):
        fault = "is neither a NumPy archive, a bag nor text" if head else "is empty"
        refuse_data(path, f"{fault}: expected .npz, .csv, .mcap, .bag or a ROS 2 bag's folder")
    if len(head) == 1 << 16 and b"\n" not in head and head[:2] != b"PK":
        refuse_data(path, "has a first line of more than 64 kB: it is not a table; was it saved as CSV?")
    return table_reader
