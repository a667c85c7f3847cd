"""Columns of a measurement file: which quantity each column contains, by the column's name and the options."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NoReturn

import numpy as np

from calib.controllers.axes import as_described, named_joints
from calib.data.csv_table import Table
from calib.data.joint_columns import (
    described,
    joint_series,
    mapping_line,
    position_series,
    proposed_line,
    series_named_in_cells,
)
from calib.data.poses import IGNORED, MEASURED
from calib.data.poses.fit_options import CONVENTIONS, FileOptions
from calib.data.poses.measurements import KINDS
from calib.data.poses.name_shapes import (
    Shape,
    matrices_by_shape,
    numbered_quaternions,
    orientations_by_shape,
    positions_by_shape,
    with_shape,
)
from calib.data.schema import BOUNDS, Column, Joints
from calib.errors import MeasurementError, listing, one_of, suggestion
from calib.units import ANGLES as ANGLE_UNITS
from calib.units import COUNT_WORDS, EFFORTS, encoder_counts

SUFFIXES = ("", "_meas", "_measured")
POSITION = Column(("x", "y", "z"), "length", "position", BOUNDS.max_length, "mm")
QUATERNION = Column(("qx", "qy", "qz", "qw"))
MATRIX = Column(tuple(f"r{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3)))
ANGLES = tuple(tuple(names.split()) for names in ("rx ry rz", "roll pitch yaw", "a b c", "w p r", "rpy_x rpy_y rpy_z"))
TURNS = Column(ANGLES[0], "angle", "orientation", BOUNDS.max_turn, "deg")
SIGMA = Column(
    ("sigma_x", "sigma_y", "sigma_z"),
    "length",
    "sigma",
    positive="a sigma must be above 0; where it was rounded to 0, set sigma.floor in the options",
)
SIGMA_ROTATION = Column(
    ("sigma_rx", "sigma_ry", "sigma_rz"), "angle", "sigma_rotation", positive="a sigma must be above 0"
)
DISTANCE = Column(("distance",), "length", "distance", BOUNDS.max_length, "mm", positive="a distance must be above 0")
SIGMA_DISTANCE = Column(("sigma_distance",), "length", "sigma", positive=SIGMA.positive)
LATE = Column(("late_x", "late_y", "late_z"), "speed", "late")
TIME = Column(("time",), "time", "time")
TORQUE = Column((), "torque", "torque")
PAYLOAD = Column(("payload",), "mass", "payload")
LABELS = ("distance", "pair", "bar", "socket", "plane", "tool")
UNIT_GROUPS = ("joints", "position", "orientation", "distance", "sigma", "sigma_rotation", "torque")
BASE_TIME = "base_time"
_OF_FRAME = (POSITION, QUATERNION, MATRIX, TURNS, SIGMA, SIGMA_ROTATION)
_FAMILIES = (*_OF_FRAME, SIGMA_DISTANCE, LATE)
OURS = (
    *(name for column in _FAMILIES for name in column.names),
    *(f"base_{name}" for column in _OF_FRAME for name in column.names),
    BASE_TIME,
    *LABELS,
    *PAYLOAD.names,
)
LABEL_OF = {"distance": "pair", "bar": "bar", "sockets": "socket", "plane": "plane"}
_TARGET = re.compile(r"(sigma_)?[xyz]\d+")
_NUMBERED_JOINT = re.compile(r"q\d+")


class Undecided(MeasurementError):
    """Raised where a table can be read in several ways, and its names do not tell which is meant.

    Attributes:
        table: the table.
        choices: options for reading it, by the line of an options file that states them.
    """

    def __init__(self, table: Table, message: str, choices: Mapping[str, FileOptions], column: str | None = None):
        self.table, self.choices = table, choices
        super().__init__(message, table.file, None, column)


@dataclass(frozen=True)
class Sheet:
    """A table and the options for reading it.

    Attributes:
        table: the table as read from the file.
        options: names and units that the header does not contain.
        suffixes: suffixes that a family of columns (``x y z``) may have, such as ``_meas``.
    """

    table: Table
    options: FileOptions = field(default_factory=FileOptions)
    suffixes: tuple[str, ...] = SUFFIXES

    def fail(self, message: str, column: str | None = None) -> NoReturn:
        """Raise MeasurementError about the file; with `column`, about that column.

        Args:
            message: text of the error; the file's name is prepended.
            column: the file's name of the column; None: the whole file.
        """
        self.table.fail(message, column)

    def find(self, name: str) -> str:
        """Return the file's column that contains the toolkit's column `name`; "" if the file has no such column."""
        heading = self.options.columns.get(name, name)
        return heading if heading in self.table else ""

    def unit(self, column: str, family: str) -> str:
        """Return the unit of a column from the header or the options; "" if neither contains one.

        Args:
            column: the file's name of the column.
            family: family of columns under which the options may have the unit.
        """
        header_unit = self.table.units[self.table.index(column)]
        unit = self._unit_of_options(column, family)
        if encoder_counts(unit) and header_unit.lower() in COUNT_WORDS:
            return unit
        return header_unit or unit

    def _unit_of_options(self, column: str, family: str) -> str:
        units = self.options.units
        names = [name for name, heading in self.options.columns.items() if heading == column]
        for name in (*names[:1], column, family):
            if name in units:
                return units[name]
        return ""

    def numbers(self, names: Sequence[str], column: Column, gaps: bool = False) -> np.ndarray:
        """Return columns (m, k) in SI, checked against the bounds of `column`.

        Args:
            names: the file's names of the columns.
            column: dimension, unit and bounds of the columns.
            gaps: whether an empty cell becomes NaN; otherwise it is refused.
        """
        values = []
        for name in names:
            unit = self._unit_of_options(name, column.family)
            values.append(self.table.numbers(name, column.dimension, unit, gaps))
        return column.check(np.stack(values, axis=1), self.table, names)

    def joints(self, joints: Joints | Sequence[str]) -> tuple[np.ndarray, tuple[str, ...]]:
        """Return joint values (m, n) [rad or m], and the file's names of the joint columns.

        Args:
            joints: the robot's n joints, or only their names (then taken as revolute), in the robot's order.
        """
        robot = Joints.of(joints)
        names = self.find_joints(joints)
        q = self.numbers(names, Column(robot.names, "joint", "joints"))
        if self.options.controller:
            named = named_joints(robot.names, robot.kinds)
            q = as_described(self.options.controller, q, named, self.options.external)
        return q, names

    def check_names(self, joints: Sequence[str]) -> None:
        """Raise MeasurementError if the options map a column name that the toolkit does not know.

        Args:
            joints: names of the robot's joints, which the options may map, too.
        """
        numbers = range(1, len(joints) + 1)
        names = (*OURS, *joints, *(f"q{number}" for number in numbers), *(f"tau{number}" for number in numbers))
        for name, heading in self.options.columns.items():
            if name not in names and not _TARGET.fullmatch(name):
                near = suggestion(name, names)
                message = f"the options map a column '{name}', which this toolkit does not know{near}"
                self.fail(f"{message}; known are {', '.join(names)}", heading)
            self.table.index(heading)
        for name in (*self.options.groups, *self.options.where):
            self.table.index(name)
        for name, unit in self.options.units.items():
            if name not in (*names, *UNIT_GROUPS, *self.table.header) and not _TARGET.fullmatch(name):
                message = f"the options state unit {unit} for '{name}', which is not a column: correct [units]"
                self.fail(message + suggestion(name, (*names, *UNIT_GROUPS)), name)

    def find_joints(self, joints: Joints | Sequence[str]) -> tuple[str, ...]:
        """Return the file's names of the joint columns, in the robot's order.

        Accepted are the robot's joint names, ``q_<joint name>``, or ``q1`` to ``qn``; the first of these forms that
        occurs in the file is used. Without them: the only series of `calib.data.joint_columns` that may be positions.

        Args:
            joints: names of the robot's joints, or the joints with their types.
        """
        robot = Joints.of(joints)
        joints = robot.names
        n, table, mapping = len(joints), self.table, self.options.columns
        message, missing = "", []
        numbered = tuple(f"q{i + 1}" for i in range(n))
        mapped = [mapping.get(joint) or mapping.get(q) for joint, q in zip(joints, numbered)]
        for form in (tuple(joints), tuple(f"q_{joint}" for joint in joints), numbered):
            columns: list[str] = []
            missing = []
            for name, heading in zip(form, mapped):
                if heading or name in table:
                    columns.append(heading or name)
                else:
                    missing.append(name)
            if not missing:
                self._refuse_more_joints(columns, n)
                return tuple(columns)
            if any(name in table for name in form):
                near = suggestion(missing[0], table.header)
                message = f"missing{near}: the robot has {n} joints, the header has only {', '.join(columns)}"
                break
        return self._joints_by_words(robot, message, missing[0] if message else None)

    def has_our_names(self, columns: Sequence[str], joints: Sequence[str], mapped: bool = True) -> bool:
        """Return whether joint columns have names of the robot's joints or of this toolkit, or the options map them.

        Args:
            columns: the file's names of the joint columns.
            joints: names of the robot's joints.
            mapped: whether columns that the options map count.
        """
        by_options = self.options.columns.values() if mapped else ()
        for number, (column, joint) in enumerate(zip(columns, joints), 1):
            if column not in (joint, f"q_{joint}", f"q{number}", *by_options):
                return False
        return True

    def _joints_by_words(self, robot: Joints, message: str, column: str | None) -> tuple[str, ...]:
        """Return the columns of the only series of joint columns in the header that may be positions.

        Args:
            robot: the robot's joints.
            message: what is wrong with columns that have the names of this toolkit; "" without such columns.
            column: the name of the missing column, for the message.

        Raises:
            MeasurementError: no series; the message ends with a line for the options, where it can.
        Undecided: several series.
        """
        table, n = self.table, len(robot.names)
        series = series_named_in_cells(table, robot.names) or joint_series(table.header, robot.names, robot.kinds)
        positions = position_series(series)
        if len(positions) == 1:
            return positions[0].columns
        if len(positions) > 1:
            choices = {}
            for entry in positions:
                columns = {**_of_joints(entry.columns), **self.options.columns}
                choices[mapping_line(entry)] = replace(self.options, columns=columns)
            names = " or ".join(map(described, positions))
            lines = " or ".join(list(choices)[:2])
            message = f"joints may be {names}: choose by one line in the options: {lines}"
            raise Undecided(table, message, choices)
        if not message:
            expected = f"expected q1 to q{n}, or {', '.join(robot.names)}"
            message = f"no joint columns: {expected}; found {', '.join(table.header)}"
        line = proposed_line(table.header, series, n)
        self.fail(f"{message}. If they have other names, map them by one line in the options, as in {line}", column)

    def _refuse_more_joints(self, columns: Sequence[str], n: int) -> None:
        """Raise MeasurementError for a table with more numbered joint columns than the robot has joints.

        Args:
            columns: the file's names of the joint columns that were found.
            n: number of the robot's joints.
        """
        if not all(_NUMBERED_JOINT.fullmatch(name) for name in columns):
            return
        for name in self.table.header:
            if _NUMBERED_JOINT.fullmatch(name) and name not in columns:
                self.fail(f"the robot has only {n} joints: is this the right robot (chain)?", name)

    def family(self, names: Sequence[str], mark: str = "") -> tuple[str, ...]:
        """Return the file's names of a family of columns, such as ``x y z``, all with one suffix; () if all are absent.

        If the options map only some columns of the family, the others are looked up by their plain or suffixed name.

        Args:
            names: the toolkit's names of the columns.
            mark: number appended to the names, for one of several reflectors; "" for none.

        Raises:
            MeasurementError: some columns of the family are missing, or the file has the family with several suffixes.
        """
        marked = [name + mark for name in names]
        if any(name in self.options.columns for name in marked):
            return tuple(self._mapped(name, marked) for name in marked)
        complete: list[tuple[str, ...]] = []
        partial: list[tuple[str, ...]] = []
        for suffix in self.suffixes:
            form = tuple(name + suffix for name in marked)
            count = sum(name in self.table for name in form)
            if count == len(form):
                complete.append(form)
            elif count:
                partial.append(form)
        if complete:
            return self.only_family(complete, marked)
        if partial:
            missing = [name for name in partial[0] if name not in self.table]
            near = suggestion(missing[0], self.table.header)
            self.fail(f"missing{near}: {', '.join(partial[0])} go together", missing[0])
        return ()

    def only_family(self, families: Sequence[tuple[str, ...]], names: Sequence[str]) -> tuple[str, ...]:
        """Return the only family of columns that was found in the file, () if none was.

        Args:
            families: the file's names of the columns of each family that was found.
            names: the toolkit's names of a family's columns, for messages.

        Raises:
            MeasurementError: several families were found.
        """
        if len(families) > 1:
            first, second = (", ".join(family) for family in families[:2])
            mapping = ", ".join(f'{name} = "{heading}"' for name, heading in zip(names, families[-1]))
            message = f"the header has {first} and {second}; map the columns to be read in the options"
            self.fail(f"{message}: [columns] {mapping}", families[0][0])
        return families[0] if families else ()

    def _mapped(self, name: str, together: Sequence[str]) -> str:
        """Return the file's name of the column `name` in a family that the options map only in part.

        Args:
            name: the toolkit's name of the column.
            together: the toolkit's names of all columns of the family.
        """
        if name in self.options.columns:
            return self.options.columns[name]
        candidates = [name + suffix for suffix in self.suffixes if name + suffix in self.table]
        if len(candidates) == 1:
            return candidates[0]
        if candidates:
            fault = " and ".join(candidates) + " could be meant"
        else:
            fault = f"missing{suggestion(name, self.table.header)}"
        self.fail(f"{fault}: {', '.join(together)} belong together; map this one in [columns], too", name)


@dataclass(frozen=True)
class Layout:
    """The file's columns that are read, by the quantity that they contain.

    Attributes:
        kind: kind of measurement, one of `KINDS`.
        joints: n names, in the robot's order.
        positions: names of x y z of each target (reflector); several triples if the columns are numbered.
        sigmas: names of the three sigmas of each target; () without sigmas.
        orientation: four names (quaternion), nine (matrix), three (angles as the options define), or none.
        sigma_rotation: three names, or none.
        distance: name of the distance column and, if present, of its sigma; () without a distance.
        tool: name of the column with tool labels; "" without one.
        group: names of the columns whose labels together identify a row's group.
        base: three names for the position of a frame on the robot's base, then those of its orientation; or none.
        base_sigma, base_sigma_rotation: three names each for the sigmas of the base frame, or none.
        late: four names for the target's velocity and the time, or none.
        torques: n names of the joints' torques at rest, or none.
        torque_fault: why columns of torques are not read, and what to do; None without such columns.
        payload: name of the column with the mass that the tip carries; "" without one.
        notes: remarks for the user on how the columns were chosen.
    """

    kind: str
    joints: tuple[str, ...]
    positions: tuple[tuple[str, ...], ...] = ()
    sigmas: tuple[tuple[str, ...], ...] = ()
    orientation: tuple[str, ...] = ()
    sigma_rotation: tuple[str, ...] = ()
    distance: tuple[str, ...] = ()
    tool: str = ""
    group: tuple[str, ...] = ()
    base: tuple[str, ...] = ()
    base_sigma: tuple[str, ...] = ()
    base_sigma_rotation: tuple[str, ...] = ()
    late: tuple[str, ...] = ()
    torques: tuple[str, ...] = ()
    torque_fault: tuple[str, str] | None = None
    payload: str = ""
    notes: tuple[str, ...] = ()

    @property
    def used(self) -> frozenset[str]:
        """The file's names of all columns that are read."""
        families = (*self.positions, *self.sigmas, self.orientation, self.sigma_rotation, self.distance, self.group)
        return frozenset().union(
            *families, self.joints, *self.of_base, self.late, self.torques, (self.tool, self.payload)
        )

    @property
    def of_base(self) -> tuple[tuple[str, ...], ...]:
        """Names of the columns on the base frame, by family; empty tuples without a base frame."""
        return self.base, self.base_sigma, self.base_sigma_rotation


def find_layout(sheet: Sheet, joints: Joints | Sequence[str]) -> Layout:
    """Return which columns of a table are read, for a robot with joints of the given names.

    Args:
        sheet: the table with its options.
        joints: the robot's joints, or their names.

    Raises:
        MeasurementError: a column is missing, or the options map it to one that the file does not have; the header
            allows several kinds or position triples, and the options select none.
    """
    robot = Joints.of(joints)
    sheet.check_names(robot.names)
    torques, torque_fault = _find_torques(sheet, robot)
    payload = sheet.find("payload")
    layout = replace(_layout(sheet, robot), torques=torques, torque_fault=torque_fault, payload=payload)
    if not sheet.has_our_names(layout.joints, robot.names):
        note = f"the joints are read from {', '.join(layout.joints)}"
        layout = replace(layout, notes=(note, *layout.notes))
    numbers = list(layout.joints)
    for names in layout.positions:
        numbers += names
    numbers += layout.orientation
    doubled = sorted({name for name in numbers if numbers.count(name) > 1})
    if doubled:
        sheet.fail("is read as two different columns: correct [columns] in the options", doubled[0])
    if layout.kind == "pose":
        _check_one_source(sheet, layout.positions[0], layout.orientation)
    for name, heading in sheet.options.columns.items():
        if heading not in layout.used:
            sheet.fail(
                f"is mapped to '{name}' by the options, but not read in a file of kind '{layout.kind}': remove it "
                "from [columns], or state another kind",
                heading,
            )
    return layout


def _find_torques(sheet: Sheet, robot: Joints) -> tuple[tuple[str, ...], tuple[str, str] | None]:
    """Return the names of the joints' torques, ``tau1`` … or ``tau_<joint name>``, or why they are not read.

    Args:
        sheet: the table with its options.
        robot: the robot's joints.
    """
    numbered = [f"tau{number}" for number in range(1, len(robot.names) + 1)]
    first_fault = None
    for form in (numbered, [f"tau_{name}" for name in robot.names]):
        columns, fault = _torques_by_names(sheet, robot, form)
        if columns:
            return columns, None
        first_fault = first_fault or fault
    return (), first_fault


def _torques_by_names(
    sheet: Sheet, robot: Joints, names: Sequence[str]
) -> tuple[tuple[str, ...], tuple[str, str] | None]:
    """Return the columns of the joints' torques by their names, or why they are not read; neither without any.

    Columns in a unit of currents are none: gravity at rest is compared with torques.

    Args:
        sheet: the table with its options.
        robot: the robot's joints.
        names: name of the torque of each joint.
    """
    columns = [sheet.find(name) for name in names]
    present = tuple(filter(None, columns))
    if not present:
        return (), None
    missing = [name for name, column in zip(robot.names, columns) if not column]
    if missing:
        reason = f"those of {listing(missing)} are missing, and gravity is found by the torques of all joints"
        return (), (reason, "record them, or add empty columns for joints without a sensor")
    units = {sheet.unit(column, "torque") for column in present}
    if not {unit.lower() for unit in units} <= {"", *EFFORTS}:
        return (), (f"their columns are in {listing(sorted(units))}", "torques at rest are read in N m or N mm")
    return present, None


def _layout(sheet: Sheet, robot: Joints) -> Layout:
    columns = sheet.find_joints(robot)
    kind = _find_kind(sheet, columns)
    if kind in LABEL_OF:
        return _grouped_layout(sheet, kind, columns)
    positions, sigmas, notes = _find_targets(sheet)
    if not positions:
        sheet.table.index("x")
    tool = sheet.find("tool")
    late = sheet.family(LATE.names)
    if late:
        late = (*late, *TIME.names)
    layout = Layout(kind, columns, positions, sigmas, tool=tool, late=late, notes=notes)
    layout = _with_base(sheet, layout)
    if kind == "position":
        return layout
    orientation = _find_orientation(sheet, columns)
    if not orientation:
        sheet.fail("kind 'pose' needs qx qy qz qw, r11 to r33, or rx ry rz; the header has none of them")
    if len(positions) > 1:
        sheet.fail(
            "kind 'pose' allows one target per row, but positions are numbered: use kind 'position'", positions[1][0]
        )
    if orientation[0] not in ("qx", "r11"):
        meaning = f" as {sheet.options.euler}" if len(orientation) == 3 else ""
        notes = (*notes, f"the orientation is read from {', '.join(orientation)}{meaning}")
    rotation = sheet.family(SIGMA_ROTATION.names)
    return replace(layout, orientation=orientation, sigma_rotation=rotation, notes=notes)


def with_shapes(sheet: Sheet, robot: Joints) -> Sheet:
    """Return the sheet with the columns mapped that are a position or an orientation by the shape of their names.

    Args:
        sheet: the table with its options.
        robot: the robot's joints.

    Raises:
        Undecided: a quaternion whose components are numbered; several positions or orientations have such names.
    """
    _refuse_base_alone(sheet)
    joints = sheet.find_joints(robot)
    if any(map(sheet.find, LABEL_OF.values())):
        return sheet
    unread = {*joints, *sheet.options.columns.values()}
    names = [name for name in sheet.table.header if name not in unread]
    # X1 Y1 Z1, X2 …: several targets
    capitals = {name.lower(): name for name in names if _TARGET.fullmatch(name.lower()) and name.isupper()}
    if len(capitals) > 3:
        sheet = replace(sheet, options=replace(sheet.options, columns={**capitals, **sheet.options.columns}))
    targets, *_ = _find_targets(sheet)
    matrices = matrices_by_shape(sheet.table, names)
    if not targets:
        poses = [shape for shape in matrices if len(shape.columns) > len(MATRIX.names)]
        sheet = _with_only_shape(sheet, poses or positions_by_shape(names))
        targets, *_ = _find_targets(sheet)
    if len(targets) != 1 or sheet.options.kind not in ("", "pose"):
        return sheet
    if sheet.family(QUATERNION.names) or sheet.family(MATRIX.names) or _angles(sheet, joints):
        return sheet
    shapes = matrices or orientations_by_shape(names)
    if shapes:
        return _with_only_shape(sheet, shapes)
    for pair in numbered_quaternions(names):
        columns = ", ".join(pair[0].columns.values())
        choices = {_mapping(shape.columns): with_shape(sheet.options, shape) for shape in pair}
        lines = " or ".join(choices)
        message = f"{columns} look like a quaternion: is w first or last? One line in the options says it: {lines}"
        raise Undecided(sheet.table, message, choices)
    return sheet


def _with_only_shape(sheet: Sheet, shapes: Sequence[Shape]) -> Sheet:
    """Return the sheet with the columns of the only shape mapped; unchanged without a shape.

    Args:
        sheet: the table with its options.
        shapes: columns that by their names are the quantity.

    Raises:
        Undecided: there are several.
    """
    if len(shapes) > 1:
        choices = {_mapping(shape.columns): with_shape(sheet.options, shape) for shape in shapes}
        first, second = (", ".join(shape.columns.values()) for shape in shapes[:2])
        line, other_line = list(choices)[:2]
        message = f"{first} or {second} may be meant: choose by one line in the options: {line} or {other_line}"
        raise Undecided(sheet.table, message, choices)
    if not shapes:
        return sheet
    return replace(sheet, options=with_shape(sheet.options, shapes[0]))


def unread_rivals(sheet: Sheet, layout: Layout, robot: Joints) -> tuple[str, ...]:
    """Return notes on columns that are not read and may be joints or a position as well as those that are read.

    Args:
        sheet: the table with its options.
        layout: the columns that are read.
        robot: the robot's joints.
    """
    unread = [name for name in sheet.table.header if name not in layout.used]
    series = position_series(joint_series(unread, robot.names, robot.kinds))
    mappings = [_of_joints(entry.columns) for entry in series if not entry.is_commanded]
    if len(layout.positions) == 1:
        shapes = positions_by_shape(unread)
        mappings += [dict(shape.columns) for shape in shapes if not shape.is_commanded]
    notes = []
    for columns in mappings:
        names = listing(columns.values(), 3)
        line = _mapping(columns)
        notes.append(f"{names} are not read; if they are meant (another arm's?), state it in the options: {line}")
    return tuple(notes)


def _of_joints(columns: Sequence[str]) -> dict[str, str]:
    """Return the names q1 … of joints → the file's names of their columns."""
    return {f"q{number}": column for number, column in enumerate(columns, 1)}


def _mapping(columns: Mapping[str, str]) -> str:
    """Return the line of an options file that maps columns."""
    entries = [f'{name} = "{heading}"' for name, heading in columns.items()]
    return f"columns = {{ {', '.join(entries)} }}"


def _of_base(column: Column) -> list[str]:
    return [f"base_{name}" for name in column.names]


def _refuse_base_alone(sheet: Sheet) -> None:
    """Raise MeasurementError for a file with base frames and without any target.

    Args:
        sheet: the table with its options.
    """
    base = _of_base(POSITION)
    is_base = any(sheet.find(name) for name in base)
    if not is_base or any(sheet.find(label) for label in LABEL_OF.values()):
        return
    if not _find_targets(sheet)[0]:
        sheet.fail(
            f"contains base frames ({', '.join(base)} …) and no target: a base frame is of use in the row of the "
            "target that was measured with it; put both into the same rows"
        )


def _with_base(sheet: Sheet, layout: Layout) -> Layout:
    """Return a layout with the columns of the base frame, if the file has them and the options do not ignore them.

    Args:
        sheet: the table with its options.
        layout: the columns that are read so far.

    Raises:
        MeasurementError: a base frame that is incomplete, or missing although the options require it.
    """
    if sheet.options.base_frame == IGNORED:
        return layout
    position = sheet.family(_of_base(POSITION))
    orientation = sheet.family(_of_base(QUATERNION)) or sheet.family(_of_base(MATRIX))
    if not orientation:
        orientation = sheet.family(_of_base(TURNS))
        if orientation and not sheet.options.euler:
            sheet.fail("state in the options what these angles mean: euler = 'xyz fixed', 'vector' …", orientation[0])
    if not position and not orientation:
        if sheet.options.base_frame == MEASURED:
            sheet.fail(
                "has no base frame: columns base_x, base_y, base_z, base_qx, base_qy, base_qz, base_qw are needed in "
                "the target's rows, not in a file apart; where it was not measured: reference = false in session.toml, "
                "or base_frame = 'ignored' in the options"
            )
        return layout
    if not position or not orientation:
        needed = "base_x, base_y, base_z, and base_qx to base_qw, base_r11 to base_r33, or base_rx, base_ry, base_rz"
        sheet.fail(f"the base frame is incomplete: it needs {needed}", (position or orientation)[0])
    return replace(
        layout,
        base=(*position, *orientation),
        base_sigma=sheet.family(_of_base(SIGMA)),
        base_sigma_rotation=sheet.family(_of_base(SIGMA_ROTATION)),
    )


def _check_one_source(sheet: Sheet, position: Sequence[str], orientation: Sequence[str]) -> None:
    """Raise MeasurementError if position and orientation have columns of different origin: one measured, one plain.

    The plain columns may be commanded values. Columns count as measured if their name has such a suffix, or if the
    options map them although the file has plain names too.

    Args:
        sheet: the table with its options.
        position, orientation: the file's names of the position's and the orientation's columns.
    """
    rotation_names = {4: QUATERNION.names, 9: MATRIX.names}.get(len(orientation))
    if rotation_names is None:
        suffix = re.compile(f"({'|'.join(SUFFIXES[1:])})$")
        rotation_names = tuple(suffix.sub("", name) for name in orientation)
    families = ((POSITION.names, position), (rotation_names, orientation))
    for (names, columns), (partner_names, partner) in (families, families[::-1]):
        is_mapped = any(name in sheet.options.columns for name in names)
        if columns != names or is_mapped or partner == partner_names:
            continue
        if partner[0].endswith(SUFFIXES[1:]) or all(name in sheet.table for name in partner_names):
            mapping = ", ".join(f'{name} = "{name}"' for name in names)
            advice = "" if names == POSITION.names else ', or read the positions alone (kind = "position")'
            sheet.fail(
                f"the header has {', '.join(names)} next to {', '.join(partner)}: were the former measured or "
                f"commanded? If measured, map them in the options ([columns] {mapping}){advice}",
                names[0],
            )


def _grouped_layout(sheet: Sheet, kind: str, joints: tuple[str, ...]) -> Layout:
    label = LABEL_OF[kind]
    sheet.table.index(sheet.options.columns.get(label, label))
    distance: tuple[str, ...] = ()
    if kind in ("distance", "bar"):
        sheet.table.index(sheet.options.columns.get("distance", "distance"))
        distance = tuple(filter(None, (sheet.find("distance"), sheet.find("sigma_distance"))))
    groups = sheet.options.groups
    if not groups and kind == "sockets" and "tool_position" in sheet.table:
        groups = ("tool_position",)
    label_column = sheet.find(label)
    group = (*(name for name in groups if name != label_column), label_column)
    return Layout(kind, joints, distance=distance, tool=sheet.find("tool"), group=group)


def _find_orientation(sheet: Sheet, joints: Sequence[str]) -> tuple[str, ...]:
    """Return the names of the orientation's columns: four (quaternion), nine (matrix), three (angles), or ().

    Args:
        sheet: the table with its options.
        joints: names of the joint columns, which are not angles of an orientation.

    Raises:
        Undecided: three angles whose convention the options do not define.
    """
    columns = sheet.family(QUATERNION.names) or sheet.family(MATRIX.names) or _angles(sheet, joints)
    if len(columns) == 3 and not sheet.options.euler:
        message = (
            f"{', '.join(columns)} look like an orientation. State their meaning by one line in the options: euler = "
            "'vector' (rotation vector, as in Universal Robots), 'xyz fixed' (roll, pitch, yaw), 'zyx moving' (KUKA's "
            "A, B, C) ...; or ignore them by kind = 'position'"
        )
        choices = {f"euler = '{euler}'": replace(sheet.options, euler=euler) for euler in CONVENTIONS}
        raise Undecided(sheet.table, message, choices, columns[0])
    return columns


def _angles(sheet: Sheet, joints: Sequence[str]) -> tuple[str, ...]:
    """Return the names of three angle columns, in upper or lower case, that are not joints; () without such columns.

    Names of one small letter (a, b, c) count as angles only if the header states a unit of angles, or the options the
    convention.

    Args:
        sheet: the table with its options.
        joints: names of the joint columns, which are not angles of an orientation.
    """
    standard_names = ANGLES[0]
    if any(name in sheet.options.columns for name in standard_names):
        return sheet.family(standard_names)
    headings: dict[str, str] = {}
    for name, unit in zip(sheet.table.header, sheet.table.units):
        may_be_angle = sheet.options.euler or len(name) > 1 or name.isupper() or unit.lower() in ANGLE_UNITS
        if name not in joints and may_be_angle:
            headings[name.lower()] = name
    complete: list[tuple[str, ...]] = []
    for names in ANGLES:
        for suffix in SUFFIXES:
            form = [name + suffix for name in names]
            if all(name in headings for name in form):
                complete.append(tuple(headings[name] for name in form))
    return sheet.only_family(complete, standard_names)


def _find_kind(sheet: Sheet, joints: Sequence[str]) -> str:
    if sheet.options.kind:
        return one_of(sheet.options.kind, KINDS, "kind", MeasurementError, sheet.table.file)
    kinds = [kind for kind, label in LABEL_OF.items() if sheet.find(label)]
    if not sheet.find("distance"):
        kinds = [kind for kind in kinds if kind not in ("distance", "bar")]
    if _find_targets(sheet)[0]:
        kinds.append("pose" if _find_orientation(sheet, joints) else "position")
    if len(kinds) > 1:
        choices = ", ".join(kinds)
        sheet.fail(f"the header allows the kinds {choices}; state one in the options (kind = '{kinds[0]}')")
    if not kinds:
        needed = "x y z (position), with qx qy qz qw (pose), distance with pair or bar, socket, or plane"
        message = f"no measurements found: expected columns {needed}; the header has {', '.join(sheet.table.header)}"
        sheet.fail(f"{message}. Map other names in the options' [columns]")
    return kinds[0]


def _find_targets(sheet: Sheet) -> tuple[tuple, tuple, tuple[str, ...]]:
    """Return names of positions and sigmas of each target, and notes.

    The targets are the one without a number (x y z) if there is one, otherwise x1 y1 z1, x2 y2 z2, ….

    Args:
        sheet: the table with its options.
    """
    all_names = (*sheet.table.header, *sheet.options.columns)
    marks = sorted({int(name[1:]) for name in all_names if re.fullmatch(r"[xyz]\d+", name)})
    plain = sheet.family(POSITION.names)
    chosen = [""] if plain else [str(mark) for mark in marks]
    common_sigma = sheet.family(SIGMA.names)
    positions = tuple(sheet.family(POSITION.names, mark) for mark in chosen)
    sigmas = tuple(sheet.family(SIGMA.names, mark) or common_sigma for mark in chosen)
    notes = ()
    if plain and plain[0] != "x":
        notes = (f"the position is read from {', '.join(plain)}",)
    if plain and marks:
        notes = (*notes, f"the numbered positions x{marks[0]}... are not read, since {', '.join(plain)} are")
    return positions, sigmas if all(sigmas) else (), notes
