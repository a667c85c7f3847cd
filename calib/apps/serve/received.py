"""Uploaded files that are no measurement yet: joint values and points apart, and tables whose columns are asked for.

They wait in ``3-measured/received/KIND``, which the session does not read:

files/         the files as they were sent
options.toml   what was stated of their columns on the page, by file
joined/        two files joined, as the page shows them until they are taken as the measurement, and the files' names
used/          files from which a measurement was made
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

from calib import files
from calib.apps.controller_programs.program import joints_table
from calib.apps.controller_programs.targets import is_program
from calib.apps.joining.joined import Joined
from calib.apps.joining.joining import join
from calib.apps.joining.stated import stated, with_point_columns
from calib.errors import CalibError, UsageError, counted, listing, require
from calib.folders import SESSION
from calib.toolkit.chains import CalibratedChain, Chain, toml_table, toml_text
from calib.toolkit.pose_data import (
    POSITION,
    FileOptions,
    FitOptions,
    Layout,
    Sheet,
    Table,
    check_joints,
    parse_fit_options,
    read_fit_options,
    read_measurements,
    read_table,
    with_silent_units,
)
from calib.toolkit.result_folders import joints_of
from calib.toolkit.sessions import BROUGHT, POSES, UNSEEN, Session, chain_of, open_session

FOLDER, FILES, USED, JOINED, OPTIONS = "received", "files", "used", "joined", "options.toml"
# joined table, and names of the files of which it was made
RESULT, SOURCES = "measured.csv", "files.txt"
JOINTS, POINTS, MEASURED, UNCLEAR = "joints", "points", "measured", "unclear"
# lists of planned poses, by kind of measurement
PLANS = {"measured": POSES, "validation": UNSEEN}
# rows of a result that the page shows
SHOWN = 3


@dataclass(frozen=True)
class Received:
    """An uploaded file and what it was recognised as.

    Attributes:
        name: the file's name.
        role: `JOINTS`, `POINTS`, `MEASURED` (both in one table), or `UNCLEAR`.
        message: what was read, or why the file cannot be read.
        header: names of its columns; empty where it is no table.
    """

    name: str
    role: str
    message: str
    header: tuple[str, ...] = ()


@dataclass(frozen=True)
class Pairing:
    """Choice of what is joined.

    Attributes:
        joints, points: names of the received files; of two logs, that with positions and that with efforts.
        by: how rows are matched; empty: the first way for which both have columns.
    """

    joints: str
    points: str
    by: str = ""


@dataclass(frozen=True)
class Preview:
    """A joined table that can be taken as the measurement: notes on what was paired and how, size, and first rows."""

    notes: tuple[str, ...]
    rows: int
    header: tuple[str, ...]
    first: tuple[tuple[str, ...], ...]


def place(session: Session, kind: str, part: str = "") -> Path:
    """Return the folder of received files of a kind (a key of `BROUGHT`), or a part of it."""
    return session.path(BROUGHT[kind][0]) / FOLDER / kind / part


def waiting(session: Session, kind: str) -> list[Path]:
    """Return the received files of a kind from which no measurement was made yet."""
    return sorted(path for path in place(session, kind, FILES).glob("*") if path.is_file())


def received(session: Session, kind: str) -> list[Received]:
    """Return the received files of a kind that wait, with what each was recognised as."""
    result = []
    for path in waiting(session, kind):
        sources = (path, place(session, kind, OPTIONS), session.path(SESSION), session.robot_file)
        versions = tuple(_version(source) for source in sources)
        result.append(_recognised(session.folder, kind, path, versions))
    return result


def _version(path: Path) -> tuple[int, int]:
    """Return time of change and size of a file; zeros if there is none."""
    if not path.exists():
        return 0, 0
    status = path.stat()
    return status.st_mtime_ns, status.st_size


@lru_cache(maxsize=256)
def _recognised(folder: Path, kind: str, path: Path, versions: tuple[tuple[int, int], ...]) -> Received:
    """Return what a file was recognised as.

    Args:
        folder: the session's folder.
        kind: the kind under which the file came.
        path: the file.
        versions: of all files on which the answer depends.
    """
    session = open_session(folder)
    chain = chain_of(session)
    options = _options(session, kind, path)
    if is_program(path):
        try:
            table = joints_table(path)
        except CalibError as error:
            return Received(path.name, UNCLEAR, _message(error, path))
        return Received(path.name, JOINTS, f"{len(table)} poses: {listing(table.header)}")
    try:
        blocks = read_measurements(path, joints_of(chain), options)
        content = ", ".join(f"{len(block)} rows of kind {block.kind}" for block in blocks)
        return Received(path.name, MEASURED, content, read_table(path).header)
    except (CalibError, OSError) as error:
        message = _message(error, path)
    try:
        table = read_table(path)
    except (CalibError, OSError):
        return Received(path.name, UNCLEAR, message)
    return _part(table, options, chain, path.name, message)


def _part(table: Table, options: FileOptions, chain: Chain, name: str, message: str) -> Received:
    """Return what a table without a whole measurement was recognised as.

    Args:
        table: the table.
        options: how it is read.
        chain: the arm.
        name: name of the file.
        message: why it is no whole measurement.
    """
    sheet = Sheet(table, options)
    problems = {}
    contents = {}
    try:
        columns = sheet.find_joints(joints_of(chain))
        sheet, _ = with_silent_units(sheet, Layout("", columns), joints_of(chain))
        contents[JOINTS] = f"{len(table)} rows of joint values: {listing(columns)}"
        q, _ = sheet.joints(joints_of(chain))
        check_joints(q, sheet, columns, joints_of(chain))
    except CalibError as error:
        problems[JOINTS] = _message(error, Path(table.file))
    try:
        point_options, _ = with_point_columns(table, options)
        sheet = Sheet(table, point_options)
        columns = sheet.family(POSITION.names) or sheet.family(POSITION.names, "1")
        if columns:
            contents[POINTS] = f"{len(table)} points: {listing(columns)}"
            sheet.numbers(columns, POSITION, gaps=True)
    except CalibError as error:
        problems[POINTS] = _message(error, Path(table.file))

    if len(contents) == 1:
        role = next(iter(contents))
        if role in problems:
            return Received(name, UNCLEAR, problems[role], table.header)
        return Received(name, role, contents[role], table.header)
    if not contents:
        missing = f"neither joint values ({listing(chain.joint_names)}, or q1 to q{chain.n}) nor points (x, y, z)"
        problem = problems.get(POINTS, "")
        message = (
            f"has {missing}; its columns are {', '.join(table.header)}: say below which of them is what. {problem}"
        )
    return Received(name, UNCLEAR, message, table.header)


def _message(error: Exception, path: Path) -> str:
    """Return an error's message with the file's name in place of its path."""
    return str(error).replace(f"{path}: ", "").replace(str(path), path.name)


def _options(session: Session, kind: str, path: Path) -> FileOptions:
    """Return how a received file is read: as stated on the page, else as the session's options say."""
    options = stated_options(session, kind)
    if path.name in options.files:
        return options.files[path.name]
    return read_fit_options(session.named(session.settings.fit.options)).for_file(path)


def stated_options(session: Session, kind: str) -> FitOptions:
    """Return what was stated on the page of the columns of received files."""
    path = place(session, kind, OPTIONS)
    return read_fit_options(path if path.exists() else None)


def state_columns(session: Session, kind: str, name: str, answers: Mapping[str, str]) -> None:
    """Store what the page's form says of a received file's columns.

    Args:
        session: the session.
        kind: kind of the file.
        name: name of the file.
        answers: ``columns.NAME`` and ``units.NAME``, ``controller``, ``euler``, as texts; empty: not stated.

    Raises:
        UsageError: an answer that the options do not take.
    """
    keys: dict[str, object] = {}
    headings = dict.fromkeys(read_table(file_of(session, kind, name)).header)
    for key, text in answers.items():
        if not text:
            continue
        section, _, entry = key.partition(".")
        require(section != "columns" or text in headings, f"{name}: has no column '{text}'", UsageError)
        if entry and section in ("columns", "units"):
            keys[section] = {**dict(keys.get(section, {})), entry: text}  # ty: ignore[no-matching-overload]
        elif key in ("controller", "euler"):
            keys[key] = text
    parse_fit_options({"files": {name: keys}}, name)
    path = place(session, kind, OPTIONS)
    tables = {}
    if path.exists():
        tables = toml_table(path).get("files", {})
    text = toml_text({"files": {**tables, name: keys}})
    path.parent.mkdir(parents=True, exist_ok=True)
    files.write(path, text)
    discard_joined(session, kind)


def stated_answers(session: Session, kind: str) -> dict[str, dict[str, str]]:
    """Return what was stated on the page of received files, as `state_columns` takes it, by the files' names."""
    answers = {}
    for name, options in stated_options(session, kind).files.items():
        columns = {f"columns.{key}": heading for key, heading in options.columns.items()}
        units = {f"units.{key}": unit for key, unit in options.units.items()}
        answers[name] = {**columns, **units, "controller": options.controller, "euler": options.euler}
    return answers


def discard_joined(session: Session, kind: str) -> None:
    """Remove the joined table of a kind, since what it was made of has changed."""
    (place(session, kind, JOINED) / RESULT).unlink(missing_ok=True)


def planned_poses(session: Session, kind: str) -> Path | None:
    """Return the list of planned poses whose joint values points alone are taken with; None if there is none."""
    plan = session.path(f"2-poses/{PLANS.get(kind, '')}")
    if session.settings.poses.plan and plan.is_file():
        return plan
    return None


def join_received(session: Session, kind: str, pairing: Pairing) -> list[str]:
    """Join received joint values and points, store the table for the page, and return notes on what was paired.

    Raises:
        CalibError: the files cannot be joined; the message says what to try.
    """
    joints, points = file_of(session, kind, pairing.joints), file_of(session, kind, pairing.points)
    robot = CalibratedChain(chain_of(session))
    joined = join(joints, points, by=pairing.by, robot=robot, options=stated_options(session, kind))
    source = f"joint values of {joints.name}, points of {points.name}"
    joined = replace(joined, notes=(source, *joined.notes))
    store_joined(session, kind, joined, [joints, points])
    return [*joined.notes, f"{counted(len(joined.poses), 'measured pose')}"]


def store_joined(session: Session, kind: str, joined: Joined, sources: list[Path]) -> None:
    """Store a joined table for the page, with the names of the files of which it was made."""
    target = place(session, kind, JOINED)
    target.mkdir(parents=True, exist_ok=True)
    names = [path.name for path in sources]
    files.write(target / SOURCES, "\n".join(names))
    joined.write(target / RESULT)


def sources_of_joined(session: Session, kind: str) -> list[Path]:
    """Return the received files of which the joined table was made.

    Raises:
        UsageError: nothing is joined.
    """
    folder = place(session, kind, JOINED)
    joined = (folder / RESULT).exists() and (folder / SOURCES).exists()
    require(joined, "nothing is joined, or it was taken already: join the received files first", UsageError)
    names = (folder / SOURCES).read_text(encoding="utf-8").splitlines()
    return [file_of(session, kind, name) for name in names]


def file_of(session: Session, kind: str, name: str) -> Path:
    """Return the path of a received file that waits.

    Raises:
        UsageError: there is no such file.
    """
    for path in waiting(session, kind):
        if path.name == name:
            return path
    raise UsageError(f"{name or 'no name'}: no such file was received, or it was used already")


def preview(session: Session, kind: str) -> Preview | None:
    """Return the joined table of a kind as the page shows it; None if nothing is joined."""
    path = place(session, kind, JOINED) / RESULT
    if not path.exists():
        return None
    lines = path.read_text(encoding="utf-8").splitlines()
    notes = tuple(line.removeprefix("# ") for line in lines if line.startswith("#"))
    header, *rows = [tuple(line.split(",")) for line in lines if not line.startswith("#")]
    return Preview(notes, len(rows), header, tuple(rows[:SHOWN]))


def take_joined(session: Session, kind: str, name: str = RESULT) -> Path:
    """Make the joined table the measurement, or the recording, of a session's step, and return its path.

    Args:
        session: the session.
        kind: kind of the files.
        name: name under which the session reads it.

    Raises:
        UsageError: nothing is joined.
    """
    sources = sources_of_joined(session, kind)
    target = _free(session, kind, name)
    (place(session, kind, JOINED) / RESULT).replace(target)
    _put_away(session, kind, sources)
    return target


def take_measured(session: Session, kind: str) -> list[Path]:
    """Make received tables that hold joint values and measurements the measurement of a session's step.

    Tables whose columns were stated on the page are written with the toolkit's names; others are moved as they are.

    Returns:
        Paths of the new files.
    """
    targets = []
    for part in received(session, kind):
        if part.role != MEASURED:
            continue
        path = place(session, kind, FILES) / part.name
        options = stated_options(session, kind).files.get(part.name)
        target = _named(session, kind, part.name)
        if options is None:
            target.parent.mkdir(exist_ok=True)
            path.replace(target)
        else:
            table = stated(read_table(path), options, chain_of(session), holds_joints=True, holds_points=True)
            Joined(table, table.rows - 1, table.notes).write(target)
            _put_away(session, kind, [path])
        targets.append(target)
    return targets


def take_points(session: Session, kind: str, name: str) -> Path:
    """Make received points without joint values the measurement; the session joins them with its planned poses.

    Returns:
        Path of the new file.
    """
    path = file_of(session, kind, name)
    table = stated(read_table(path), _options(session, kind, path), None, holds_points=True)
    target = _named(session, kind, name)
    Joined(table, table.rows - 1, table.notes).write(target)
    _put_away(session, kind, [path])
    return target


def _named(session: Session, kind: str, name: str) -> Path:
    """Return the path of a measurement in the session, from a received file's name."""
    folder, prefix = BROUGHT[kind]
    stored_name = name
    if not name.lower().endswith(".csv"):
        stored_name = f"{name}.csv"
    if prefix and not name.lower().startswith(prefix):
        stored_name = f"{prefix}_{stored_name}"
    return session.path(folder) / stored_name


def _free(session: Session, kind: str, name: str) -> Path:
    """Return a path of a measurement in the session at which no file is."""
    target = first = _named(session, kind, name)
    number = 2
    while target.exists():
        target = first.with_stem(f"{first.stem}_{number}")
        number += 1
    return target


def _put_away(session: Session, kind: str, paths: list[Path]) -> None:
    """Move received files to those from which a measurement was made."""
    used_folder = place(session, kind, USED)
    used_folder.mkdir(exist_ok=True)
    for path in paths:
        path.replace(used_folder / f"{len(list(used_folder.iterdir())) + 1}_{path.name}")
    discard_joined(session, kind)
