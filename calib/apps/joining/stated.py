"""Tables as the options of `calib join` state them: the toolkit's names of columns, units, controller, angles."""

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from calib.apps.joining.joined import CLOCKS, NAMES
from calib.errors import UsageError, listing, refuse_option, require, suggestion
from calib.toolkit.chains import Chain
from calib.toolkit.pose_data import (
    OURS,
    POSITION,
    QUATERNION,
    SIGMA,
    SIGMA_ROTATION,
    TURN_NAMES,
    FileOptions,
    FitOptions,
    Joints,
    Layout,
    Sheet,
    Table,
    orientation,
    positions_by_shape,
    with_shape,
    with_silent_units,
)
from calib.toolkit.result_folders import joints_of

# family of columns under which the options may state a unit
FAMILIES = {
    **dict.fromkeys(POSITION.names, "position"),
    **dict.fromkeys(SIGMA.names, "sigma"),
    **dict.fromkeys(SIGMA_ROTATION.names, "sigma_rotation"),
    "distance": "distance",
}
JOINTS = "joints"
_SUFFIX = re.compile(r"(\d+|_meas|_measured)$")
_JOINT = re.compile(r"q(\d+|_.+)")
_NUMBERED = re.compile(r"q\d+|(sigma_)?[xyz]\d+")


def check_columns(options: FitOptions, tables: Sequence[Table], chain: Chain | None) -> None:
    """Raise UsageError for a column in the options that no table has, or a name that the toolkit does not know.

    Args:
        options: options of the join; those under [files] are for one of the tables.
        tables: the tables of joints and points.
        chain: the arm, whose joint names are known, too; None: any name is accepted.
    """
    for name, heading in options.columns.items():
        if not any(heading in table for table in tables):
            headers = "; ".join(f"{table.file} has {listing(table.header)}" for table in tables)
            refuse_option(options.source, f"columns.{name}: no file has a column '{heading}': {headers}")
    if chain is None:
        return
    names = (*OURS, *chain.joint_names, *NAMES, *CLOCKS)
    for settings in (options, *options.files.values()):
        for name in settings.columns:
            if name not in names and not _NUMBERED.fullmatch(name):
                message = f"columns: '{name}' is no column that this toolkit reads{suggestion(name, names)}"
                refuse_option(options.source, f"{message}; known are {', '.join(names)}")


def stated(
    table: Table, options: FileOptions, chain: Chain | None, *, holds_joints: bool = False, holds_points: bool = False
) -> Table:
    """Return a table whose header has the toolkit's names and the units that the options state.

    Joint values become those of the description where the options name a controller, and three angles of a stated
    convention become a quaternion; so the result is read without these options. Notes say what was read as what.

    Args:
        table: the table as read.
        options: how it is to be read: [columns], [units], controller and euler.
        chain: the arm; None: joints keep their columns.
        holds_joints, holds_points: whether the table contains the joint values, the points, or both.

    Raises:
        UsageError: a controller is stated without the arm.
        MeasurementError: header and options state different units.
    """
    joints: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    if holds_points:
        options, notes = with_point_columns(table, options)
    if holds_joints:
        joints = _joint_columns(table, options, chain)
    if holds_joints and chain is not None:
        sheet, joint_notes = with_silent_units(Sheet(table, options), Layout("", joints), joints_of(chain))
        options, notes = sheet.options, (*notes, *joint_notes)
    table = replace(table, notes=(*table.notes, *notes))
    if holds_joints and options.controller:
        table = _described(table, options, chain)
        joints = ()
    if holds_points:
        table = _turned(table, options)
    return _renamed(table, options, joints)


def with_point_columns(table: Table, options: FileOptions) -> tuple[FileOptions, tuple[str, ...]]:
    """Return the options with columns mapped that are a position by the shape of their names, and notes.

    A unit that such columns do not state is told from their numbers, as `calib fit` does.

    Args:
        table: the table of points.
        options: how it is read.
    """
    sheet = Sheet(table, options)
    if sheet.family(POSITION.names) or sheet.family(POSITION.names, "1"):
        return options, ()
    mapped = options.columns.values()
    shapes = positions_by_shape([name for name in table.header if name not in mapped])
    if len(shapes) != 1:
        return options, ()
    options = with_shape(options, shapes[0])
    columns = tuple(shapes[0].columns.values())
    sheet, notes = with_silent_units(Sheet(table, options), Layout("position", (), (columns,)), Joints(()))
    return sheet.options, notes


def _joint_columns(table: Table, options: FileOptions, chain: Chain | None) -> tuple[str, ...]:
    """Return the file's names of the columns of joint values; without an arm, those that are numbered or mapped.

    Raises:
        UsageError: without an arm, the unit of joints is stated, and no such column is there.
    """
    if chain is not None:
        return Sheet(table, options).find_joints(joints_of(chain))
    names = dict(zip(options.columns.values(), options.columns))
    joints = [heading for heading in table.header if _JOINT.fullmatch(names.get(heading, heading))]
    message = f"the options state the unit of joints, but which of {', '.join(table.header)} are joints is not known"
    require(joints or JOINTS not in options.units, f"{table.file}: {message}: give --robot", UsageError)
    return tuple(joints)


def _described(table: Table, options: FileOptions, chain: Chain | None) -> Table:
    """Return a table whose joint values are those of the description, under its joint names, instead of a controller's.

    Args:
        table: the table of joints.
        options: options that name the controller.
        chain: the arm.
    """
    if chain is None:
        raise UsageError(
            f"the options state controller = '{options.controller}', whose joints are converted to those of the "
            "robot's description: give --robot"
        )
    q, names = Sheet(table, options).joints(joints_of(chain))
    note = f"{Path(table.file).name}: {', '.join(names)} read as {options.controller} shows its joints"
    return _exchanged(table, names, chain.joint_names, list(q.T), note)


def _turned(table: Table, options: FileOptions) -> Table:
    """Return a table with a quaternion in place of three angles, where the options state what the angles mean."""
    if not options.euler:
        return table
    sheet = Sheet(table, options)
    headings = {name.lower(): name for name in table.header}
    for names in TURN_NAMES:
        columns = [options.columns.get(name, headings.get(name, "")) for name in names]
        if all(column in table for column in columns):
            quaternion = orientation(sheet, columns)
            note = f"{Path(table.file).name}: {', '.join(columns)} read as {options.euler}, written as a quaternion"
            return _exchanged(table, columns, QUATERNION.names, list(quaternion.T), note)
    return table


def _exchanged(table: Table, columns: Sequence[str], names: Sequence[str], cells: list, note: str) -> Table:
    """Return a table with columns in SI in place of others.

    Args:
        table: the table.
        columns: names of the columns that are replaced.
        names: names of the new columns.
        cells: their (m,) values.
        note: a remark for the user.
    """
    header = list(names)
    units = [""] * len(names)
    values = list(cells)
    for name, unit, column in zip(table.header, table.units, table.cells):
        if name not in columns:
            header.append(name)
            units.append(unit)
            values.append(column)
    return replace(table, header=tuple(header), units=tuple(units), cells=tuple(values), notes=(*table.notes, note))


def _renamed(table: Table, options: FileOptions, joints: Sequence[str]) -> Table:
    """Return a table with the toolkit's names and the stated units in its header.

    Args:
        table: the table.
        options: options with [columns] and [units].
        joints: names of the columns of joint values.
    """
    names = {heading: name for name, heading in options.columns.items() if heading in table}
    header, units, cells, notes = [], [], [], []
    for heading, header_unit, column in zip(table.header, table.units, table.cells):
        name = names.get(heading, heading)
        # of two columns with one name that which the options state is read
        if heading not in names and heading in names.values():
            notes.append(f"{Path(table.file).name}: column {heading} is not read, since the options state another")
            continue
        family = FAMILIES.get(_SUFFIX.sub("", name), "")
        if heading in joints:
            family = JOINTS
        unit = header_unit
        for key in (name, heading, family):
            stated_unit = options.units.get(key, "")
            if stated_unit and header_unit and stated_unit != header_unit:
                message = f"the header states [{header_unit}], the options state {stated_unit}: remove one of them"
                table.fail(message, heading)
            unit = unit or stated_unit
        header.append(name)
        units.append(unit)
        cells.append(column)
    if names:
        notes.insert(0, f"{Path(table.file).name}: {', '.join(names)} read as {', '.join(names.values())}")
    return replace(table, header=tuple(header), units=tuple(units), cells=tuple(cells), notes=(*table.notes, *notes))
