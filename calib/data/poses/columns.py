"""Which column of a measurement file holds what: our names, the robot's, and those of the options file."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

from calib.data.csv_table import Table
from calib.data.poses.fit_options import FileOptions
from calib.data.poses.measurements import KINDS
from calib.errors import MeasurementError, suggestion

SUFFIXES = ("", "_meas", "_measured")
POSITION = ("x", "y", "z")
QUATERNION = ("qx", "qy", "qz", "qw")
MATRIX = tuple(f"r{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3))
ANGLES = tuple(tuple(names.split()) for names in ("rx ry rz", "roll pitch yaw", "a b c", "w p r", "rpy_x rpy_y rpy_z"))
SIGMA = ("sigma_x", "sigma_y", "sigma_z")
SIGMA_ROTATION = ("sigma_rx", "sigma_ry", "sigma_rz")
BASE = ("base_x", "base_y", "base_z", "base_qx", "base_qy", "base_qz", "base_qw")
LABELS = ("distance", "pair", "bar", "socket", "plane", "tool")
OURS = (*POSITION, *QUATERNION, *MATRIX, *ANGLES[0], *SIGMA, *SIGMA_ROTATION, "sigma_distance", *BASE, *LABELS)
UNIT_GROUPS = ("joints", "position", "orientation", "distance", "sigma", "sigma_rotation")
LABEL_OF = {"distance": "pair", "bar": "bar", "sockets": "socket", "plane": "plane"}
_TARGET = re.compile(r"(sigma_)?[xyz]\d+")


@dataclass(frozen=True)
class Layout:
    """The file's names of the columns to read.

    Attributes:
        kind: one of `KINDS`.
        joints: n names, in the robot's order.
        positions: x y z of each target (reflector); one triple, or several where the columns are numbered.
        sigmas: the three sigmas of each target; () where not stated.
        orientation: four names (quaternion), nine (matrix), three (angles, whose meaning the options state), or none.
        sigma_rotation: three names or none.
        distance, sigma_distance, tool: one name or "".
        group: the columns whose labels together name a row's group.
        base: position and quaternion of a frame on the robot's base, seven names, or none.
        notes: what a user should be told of the choice.
    """

    kind: str
    joints: tuple[str, ...]
    positions: tuple[tuple[str, ...], ...] = ()
    sigmas: tuple[tuple[str, ...], ...] = ()
    orientation: tuple[str, ...] = ()
    sigma_rotation: tuple[str, ...] = ()
    distance: str = ""
    sigma_distance: str = ""
    tool: str = ""
    group: tuple[str, ...] = ()
    base: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    def ignored(self, table: Table) -> tuple[str, ...]:
        """Return the columns of `table` that are not read, in its order."""
        return tuple(name for name in table.header if name not in self.used)

    @property
    def used(self) -> frozenset[str]:
        """The file's names of all columns that are read."""
        used = {*self.joints, *self.orientation, *self.sigma_rotation, *self.group, *self.base}
        used |= {self.distance, self.sigma_distance, self.tool}
        used.update(name for names in (*self.positions, *self.sigmas) for name in names)
        return frozenset(used)


def find_layout(table: Table, options: FileOptions, joints: Sequence[str]) -> Layout:
    """Return which columns of `table` are to be read for a robot with these joints.

    Raises:
        MeasurementError: where a column is missing or mapped in vain, or the header allows several kinds, or several
            triples, and the options name none.
    """
    check_names(table, options, joints)
    found = _layout(table, options, joints)
    numbers = (*found.joints, *(name for names in found.positions for name in names), *found.orientation)
    twice = sorted({name for name in numbers if numbers.count(name) > 1})
    if twice:
        message = "is read twice, as two different columns: is one of them mapped to it by mistake? See [columns]"
        raise MeasurementError(message, table.file, column=twice[0])
    if found.kind == "pose":
        _check_one_source(table, options, found.positions[0], found.orientation)
    for name, theirs in options.columns.items():
        if theirs not in found.used:
            message = (
                f"is mapped to '{name}' by the options, yet nothing reads it in a file of kind '{found.kind}': take "
            )
            raise MeasurementError(f"{message}it out of [columns], or state another kind", table.file, column=theirs)
    return found


def _layout(table: Table, options: FileOptions, joints: Sequence[str]) -> Layout:
    columns = find_joints(table, options, joints)
    kind = _find_kind(table, options, columns)
    if kind in LABEL_OF:
        return _grouped_layout(table, options, kind, columns)
    positions, sigmas, notes = _find_targets(table, options)
    if not positions:
        table.index("x")
    tool, base = _find(table, options, "tool"), _family(table, options, BASE)
    if kind == "position":
        return Layout(kind, columns, positions, sigmas, tool=tool, base=base, notes=notes)
    orientation = _find_orientation(table, options, columns)
    if not orientation:
        message = "kind 'pose' needs qx qy qz qw, r11 to r33, or rx ry rz; the header has none of them"
        raise MeasurementError(message, table.file)
    if len(positions) > 1:
        message = "kind 'pose' allows one target per row, found numbered positions"
        raise MeasurementError(message, table.file, column=positions[1][0])
    if orientation[0] not in ("qx", "r11"):
        meaning = f" as {options.euler}" if len(orientation) == len(ANGLES[0]) else ""
        notes = (*notes, f"the orientation is read from {', '.join(orientation)}{meaning}")
    rotation = _family(table, options, SIGMA_ROTATION)
    return Layout(kind, columns, positions, sigmas, orientation, rotation, tool=tool, base=base, notes=notes)


def _check_one_source(table: Table, options: FileOptions, position: Sequence[str], orientation: Sequence[str]) -> None:
    """Refuse a plain position beside a measured orientation, or the reverse: the plain columns may be the command.

    Measured is what is named so, or what the options map though the file has the plain names, too.
    """
    plain = {len(QUATERNION): QUATERNION, len(MATRIX): MATRIX}.get(len(orientation))
    names = plain or tuple(re.sub(f"({'|'.join(SUFFIXES[1:])})$", "", name) for name in orientation)
    families = ((POSITION, position), (names, orientation))
    for (names, plain), (others, measured) in (families, families[::-1]):
        if plain != names or any(name in options.columns for name in names) or measured == others:
            continue
        if measured[0].endswith(SUFFIXES[1:]) or all(name in table for name in others):
            mapped = ", ".join(f'{name} = "{name}"' for name in names)
            alone = "" if names == POSITION else ', or read the positions alone (kind = "position")'
            message = (
                f"the header has {', '.join(names)} beside {', '.join(measured)}: were the former measured, too, or "
                f"are they what was commanded? If measured, map them in the options ([columns] {mapped}){alone}"
            )
            raise MeasurementError(message, table.file, column=names[0])


def _grouped_layout(table: Table, options: FileOptions, kind: str, joints: tuple[str, ...]) -> Layout:
    label = LABEL_OF[kind]
    measured = kind in ("distance", "bar")
    for name in (label, "distance") if measured else (label,):
        table.index(options.columns.get(name, name))
    own = _find(table, options, label)
    fixture = tuple(name for name in ("tool_position",) if kind == "sockets" and name in table)
    others = options.groups or fixture
    return Layout(
        kind,
        joints,
        distance=_find(table, options, "distance") if measured else "",
        sigma_distance=_find(table, options, "sigma_distance") if measured else "",
        tool=_find(table, options, "tool"),
        group=(*(name for name in others if name != own), own),
    )


def check_names(table: Table, options: FileOptions, joints: Sequence[str]) -> None:
    """Refuse options that name a column which neither we nor the file have."""
    ours = (*OURS, *joints, *(f"q{i + 1}" for i in range(len(joints))))
    for name, theirs in options.columns.items():
        if name not in ours and not _TARGET.fullmatch(name):
            message = f"the options map a column '{name}', which is none of ours{suggestion(name, ours)}"
            raise MeasurementError(f"{message}; ours are {', '.join(ours)}", table.file, column=theirs)
        table.index(theirs)
    for name in (*options.groups, *options.where):
        table.index(name)
    for name, unit in options.units.items():
        if name not in (*ours, *UNIT_GROUPS, *table.header) and not _TARGET.fullmatch(name):
            message = f"the options give a unit {unit} for '{name}', which is no column"
            raise MeasurementError(message + suggestion(name, (*ours, *UNIT_GROUPS)), table.file, column=name)


def find_joints(table: Table, options: FileOptions, joints: Sequence[str]) -> tuple[str, ...]:
    """Return the file's names of the joint columns in the robot's order.

    Accepted: the robot's joint names, ``q_<joint name>``, or ``q1`` to ``qn``; the first of these forms that occurs.
    """
    n = len(joints)
    numbered = tuple(f"q{i + 1}" for i in range(n))
    mapped = [options.columns.get(joint) or options.columns.get(q) for joint, q in zip(joints, numbered)]
    for form in (tuple(joints), tuple(f"q_{joint}" for joint in joints), numbered):
        found = tuple(theirs or (name if name in table else "") for name, theirs in zip(form, mapped))
        if all(found):
            _no_extra(table, found)
            return found
        if any(name in table for name in form):
            missing = next(name for name, there in zip(form, found) if not there)
            have = ", ".join(name for name in found if name)
            message = (
                f"missing{suggestion(missing, table.header)}: the robot has {n} joints, the header has only {have}"
            )
            raise MeasurementError(message, table.file, column=missing)
    message = f"no joint columns: expected q1 to q{n}, or {', '.join(joints)}; found {', '.join(table.header)}"
    raise MeasurementError(f"{message}. Map them in the options' [columns]", table.file)


def _find_orientation(table: Table, options: FileOptions, joints: Sequence[str]) -> tuple[str, ...]:
    """Return the names of a quaternion's four columns, a matrix's nine, three angles', or none.

    Raises:
        MeasurementError: for three angles whose meaning the options do not state.
    """
    found = _family(table, options, QUATERNION) or _family(table, options, MATRIX) or _angles(table, options, joints)
    if len(found) == len(ANGLES[0]) and not options.euler:
        message = (
            f"{', '.join(found)} look like an orientation. State in the options what they mean: euler = 'vector' "
            "(rotation vector, as Universal Robots have it), 'xyz fixed' (roll, pitch, yaw), 'zyx moving' (KUKA's A, "
            "B, C) ...; or kind = 'position' to leave them out"
        )
        raise MeasurementError(message, table.file, column=found[0])
    return found


def _angles(table: Table, options: FileOptions, joints: Sequence[str]) -> tuple[str, ...]:
    """Return the names of three angles, capital letters or not, that are no joints; () if there are none.

    Columns named by one small letter (a, b, c) are anything, unless the options state what angles mean.
    """
    if any(name in options.columns for name in ANGLES[0]):
        return _family(table, options, ANGLES[0])
    any_name = (name for name in table.header if name not in joints)
    known = {name.lower(): name for name in any_name if options.euler or len(name) > 1 or name.isupper()}
    forms = [[name + suffix for name in names] for names in ANGLES for suffix in SUFFIXES]
    complete = [tuple(known[name] for name in form) for form in forms if all(name in known for name in form)]
    if len(complete) > 1:
        one = ", ".join(f'{name} = "{theirs}"' for name, theirs in zip(ANGLES[0], complete[-1]))
        message = f"the header has {', '.join(complete[0])} and {', '.join(complete[1])}: which are to be read?"
        raise MeasurementError(f"{message} Map them in the options: [columns] {one}", table.file, column=complete[0][0])
    return complete[0] if complete else ()


def _no_extra(table: Table, found: Sequence[str]) -> None:
    if all(re.fullmatch(r"q\d+", name) for name in found):
        extra = [name for name in table.header if re.fullmatch(r"q\d+", name) and name not in found]
        if extra:
            message = f"the robot has {len(found)} joints, and this is one more: is it the right robot (chain)?"
            raise MeasurementError(message, table.file, column=extra[0])


def _find_kind(table: Table, options: FileOptions, joints: Sequence[str]) -> str:
    if options.kind:
        if options.kind not in KINDS:
            raise MeasurementError(f"kind '{options.kind}' is none of {', '.join(KINDS)}", table.file)
        return options.kind
    kinds = [kind for kind, label in LABEL_OF.items() if _find(table, options, label)]
    if any(kind in kinds for kind in ("distance", "bar")) and not _find(table, options, "distance"):
        kinds = [kind for kind in kinds if kind not in ("distance", "bar")]
    if _find_targets(table, options)[0]:
        kinds.append("pose" if _find_orientation(table, options, joints) else "position")
    if len(kinds) == 1:
        return kinds[0]
    if kinds:
        message = f"the header allows the kinds {', '.join(kinds)}: say which one in the options (kind = '{kinds[0]}')"
        raise MeasurementError(message, table.file)
    needed = "x y z (position), with qx qy qz qw (pose), distance with pair or bar, socket, or plane"
    message = f"nothing measured found: expected columns {needed}; the header has {', '.join(table.header)}"
    raise MeasurementError(f"{message}. Map other names in the options' [columns]", table.file)


def _find_targets(table: Table, options: FileOptions) -> tuple[tuple, tuple, tuple[str, ...]]:
    """Return positions, sigmas and notes: the unnumbered triple, else x1 y1 z1, x2 y2 z2, ..."""
    marks = sorted({int(name[1:]) for name in (*table.header, *options.columns) if re.fullmatch(r"[xyz]\d+", name)})
    plain = _family(table, options, POSITION)
    chosen = [""] if plain else [str(mark) for mark in marks]
    positions = tuple(_family(table, options, POSITION, mark) for mark in chosen)
    common = _family(table, options, SIGMA)
    sigmas = tuple(_family(table, options, SIGMA, mark) or common for mark in chosen)
    notes = ()
    if plain and plain[0] != "x":
        notes = (f"the position is read from {', '.join(plain)}",)
    if plain and marks:
        notes = (*notes, f"the numbered positions x{marks[0]}... are not read beside {', '.join(plain)}")
    return positions, sigmas if all(sigmas) else (), notes


def _family(table: Table, options: FileOptions, names: Sequence[str], mark: str = "") -> tuple[str, ...]:
    """Return the file's names of columns that go together (plain, ``_meas``, ``_measured``); () if none is there.

    Where the options map some of them, the others are those that the file has under one of these names.

    Raises:
        MeasurementError: where one is missing, or the file has them under several of these names.
    """
    ours = [name + mark for name in names]
    if any(name in options.columns for name in ours):
        return tuple(_mapped(table, options, name, ours) for name in ours)
    forms = [[name + suffix for name in ours] for suffix in SUFFIXES]
    complete = [form for form in forms if all(name in table for name in form)]
    if len(complete) > 1:
        first, second = (", ".join(form) for form in complete[:2])
        one = ", ".join(f'{name} = "{theirs}"' for name, theirs in zip(ours, complete[-1]))
        message = f"the header has {first} and {second}: which of them are to be read? Map them in the options"
        raise MeasurementError(f"{message}: [columns] {one}", table.file, column=complete[0][0])
    if complete:
        return tuple(complete[0])
    for form in forms:
        missing = [name for name in form if name not in table]
        if len(missing) < len(form):
            message = f"missing{suggestion(missing[0], table.header)}: {', '.join(ours)} go together"
            raise MeasurementError(message, table.file, column=missing[0])
    return ()


def _mapped(table: Table, options: FileOptions, name: str, together: Sequence[str]) -> str:
    """Return the file's name of one column of a family of which the options map some."""
    if name in options.columns:
        return options.columns[name]
    found = [name + suffix for suffix in SUFFIXES if name + suffix in table]
    if len(found) == 1:
        return found[0]
    what = f"{' and '.join(found)} could be it" if found else f"missing{suggestion(name, table.header)}"
    message = f"{what}: {', '.join(together)} go together, and [columns] maps some of them only; map it, too"
    raise MeasurementError(message, table.file, column=name)


def _find(table: Table, options: FileOptions, name: str) -> str:
    theirs = options.columns.get(name, name)
    return theirs if theirs in table else ""
