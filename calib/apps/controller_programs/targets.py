"""Targets in a controller's program: read with their places in the text, and written back, all else byte for byte.

Joint targets and poses of the tool are recognised by the patterns of ``controllers.toml``, not in comments. Relative
moves, targets that a program computes, and targets with some axes left out are not touched.

Which axes slide or are external, and the joints' names, are those of the robot, of the program's own line
``Joints: rail (E1, mm), joint1, …`` (`calib program` writes it), or stated: ``--external "rail [mm]"``. An axis with
mm behind its number slides, and so does the third of four.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import zip_longest
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from calib.errors import MeasurementError, UsageError, counted, listing
from calib.toolkit.chains import (
    Axes,
    Controller,
    NamedJoint,
    PlainJoint,
    axes_of,
    check_pulses,
    controller_of,
    named_axis,
)
from calib.transforms import pose as pose_of
from calib.units import ANGLES, LENGTHS

NUMBER = r"([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)"
# one letter for each byte, whatever the program is in
ENCODING = "latin-1"
# letters before a target in which its number stands (our choice)
NEAR = 200
# external axes that are not there are written as this number or more (RAPID: 9E9)
ABSENT = 1e9
# our own line with the joints of a program, and one joint of it
JOINTS_LINE = re.compile(r"Joints: (.+?)\.(?=\s|$)")
OWN_JOINT = re.compile(r"(.+?)(?: \((?:(E\d), )?(mm|m|deg|rad)\))?")


@dataclass(frozen=True)
class Target:
    """One target in a program.

    Attributes:
        line: line number in the file, from 1.
        spans: begin and end of each number of the target in the text.
        values: the numbers, in the controller's units.
        kind: ``joints`` or ``pose``.
        number: number of the pose, if the text before the target contains one; else 0.
        external: how many of the numbers, the last ones, are of external axes.
    """

    line: int
    spans: tuple[tuple[int, int], ...]
    values: tuple[float, ...]
    kind: str
    number: int = 0
    external: int = 0

    @property
    def arm(self) -> int:
        """Number of the arm's axes."""
        return len(self.values) - self.external

    def of_axes(self, axes: Axes) -> "Target | None":
        """Return the target with the numbers of these axes only, in a program's order; None if some are missing.

        Further axes may stand in it where they are 0 or not there.
        """
        joined = list(zip(self.spans, self.values))
        arm, further = joined[: self.arm], joined[self.arm :]
        external = _connected(further)
        count, external_count = len(axes.arm), len(axes.external)
        surplus = arm[count:]
        if len(arm) < count or len(external) < external_count or any(value for _, value in surplus):
            return None
        chosen = [*arm[:count], *external[:external_count]]
        spans, values = zip(*chosen)
        return replace(self, spans=spans, values=values, external=external_count)


def _connected(entries: Sequence[tuple[tuple[int, int], float]]) -> list[tuple[tuple[int, int], float]]:
    """Return the external axes, spans with numbers, that a controller has."""
    return [entry for entry in entries if abs(entry[1]) < ABSENT]


@dataclass(frozen=True)
class Program:
    """The text of a program with its targets.

    Attributes:
        path: the program's file.
        controller: the controller for which it is written.
        text: the file's bytes decoded as Latin-1.
        targets: the targets, in the order of the text.
        axes: the robot's joints as axes of the joint targets.
        pulses: pulses per degree or millimetre of each axis, where the numbers are pulses.
        notes: remarks on axes.
    """

    path: Path
    controller: Controller
    text: str
    targets: tuple[Target, ...]
    axes: Axes = field(default_factory=lambda: Axes((), ()))
    pulses: tuple[float, ...] = ()
    notes: tuple[str, ...] = ()

    def of(self, kind: str) -> list[int]:
        """Return the indices of the targets of one kind (``joints`` or ``pose``)."""
        return [k for k, target in enumerate(self.targets) if target.kind == kind]

    @property
    def moves(self) -> int:
        """Number of motion statements outside comments."""
        return len(_matches(self.text, self.controller.moves, self.controller.comment))

    @property
    def unread(self) -> str:
        """Warning on lines with motion statements but no target, with the first line numbers.

        Empty if there are no such lines.
        """
        target_lines = {target.line for target in self.targets}
        move_lines = _lines_of_moves(self.text, self.controller)
        lines = [line for line in move_lines if line not in target_lines]
        if self.moves <= len(self.targets) or not lines:
            return ""
        location = f"line {listing(lines, 3)}"
        reason = "relative moves, and targets that are computed, named or incomplete, are not read"
        return f"warning: {self.moves} moves, {len(self.targets)} targets: {reason} ({location})"

    def joints(self) -> np.ndarray:
        """Return the joint targets (m, n) [rad or m], in the joint convention and order of the robot's description."""
        values = self._values("joints")
        if self.controller.pulses:
            values = values / np.array(self.pulses)
        return self.axes.described(self.controller, values)

    def shown(self, q: np.ndarray) -> np.ndarray:
        """Return the numbers (m, n) of joint targets q (m, n) [rad or m], in the program's order and units."""
        values = self.axes.shown(self.controller, q)
        if self.controller.pulses:
            values = values * np.array(self.pulses)
        return values

    def poses(self) -> np.ndarray:
        """Return the pose targets (m, 4, 4) [m]."""
        return pose_of_values(self.controller, self._values("pose"))

    def _values(self, kind: str) -> np.ndarray:
        """Return the numbers of the targets of one kind, one row per target [the controller's units]."""
        return np.array([target.values for target in self.targets if target.kind == kind])

    def rewritten(self, values: Sequence[np.ndarray | None]) -> bytes:
        """Return the program's bytes with the numbers of its targets replaced.

        Args:
            values: new numbers for each target [the controller's units]; None leaves a target unchanged.
        """
        text = self.text
        changes: dict[tuple[int, int], str] = {}
        for target, new_values in zip(self.targets, values, strict=True):
            if new_values is None:
                continue
            for (begin, end), old_value, value in zip(target.spans, target.values, new_values):
                # a number that stays the same stays as it is written
                if value != old_value:
                    fraction = text[begin:end].partition(".")[2]
                    changes[begin, end] = number(value, max(self.controller.decimals, len(fraction)))
        parts = []
        position = 0
        for (begin, end), written in sorted(changes.items()):
            parts += [text[position:begin], written]
            position = end
        parts.append(text[position:])
        return "".join(parts).encode(ENCODING)


def number(value: float, decimals: int) -> str:
    """Return `value` as text with `decimals` decimals, and without a minus sign before zero."""
    written = f"{value:.{decimals}f}"
    if float(written) == 0.0:
        return written.removeprefix("-")
    return written


def formatted(values: np.ndarray, decimals: int) -> list[list[str]]:
    """Return values (m, n) as texts with fixed decimals."""
    return [[number(value, decimals) for value in row] for row in values]


def pose_values(controller: Controller, poses: np.ndarray) -> np.ndarray:
    """Return poses (m, 4, 4) [m] as the numbers (m, 6 or 7) that a controller's programs contain."""
    rotation = Rotation.from_matrix(poses[:, :3, :3])
    if controller.turn == "wxyz":
        angles = rotation.as_quat(canonical=True)[:, [3, 0, 1, 2]]
    elif controller.turn == "vector":
        angles = rotation.as_rotvec()
    else:
        order, degrees = _order(controller.turn)
        angles = rotation.as_euler(order, degrees)
    position = poses[:, :3, 3] / controller.metres
    return np.concatenate([position, angles], axis=1)


def pose_of_values(controller: Controller, values: np.ndarray) -> np.ndarray:
    """Return the poses (m, 4, 4) [m] that a controller's programs contain as rows of numbers.

    Args:
        controller: the controller.
        values: (m, 6 or 7) numbers [the controller's units]: position, then angles or quaternion.
    """
    rotation = _rotation(controller.turn, values[:, 3:])
    position = values[:, :3] * controller.metres
    return pose_of(rotation, position)


def _rotation(turn: str, values: np.ndarray) -> Rotation:
    if turn == "wxyz":
        return Rotation.from_quat(values[:, [1, 2, 3, 0]])
    if turn == "vector":
        return Rotation.from_rotvec(values)
    order, degrees = _order(turn)
    return Rotation.from_euler(order, values, degrees)


def _order(turn: str) -> tuple[str, bool]:
    """Return the rotation sequence of a pose's angles in SciPy's notation, and whether the angles are in degrees.

    Args:
        turn: the sequence as the table of controllers writes it: axes, ``moving`` or ``fixed``, and the unit.
    """
    axes, axes_kind, *unit = turn.split()
    # SciPy's capitals are axes that turn with the body
    order = axes.upper() if axes_kind == "moving" else axes
    return order, unit != ["rad"]


def is_program(path: Path) -> bool:
    """Return whether the name of the file `path` has the suffix of a controller's program."""
    try:
        return bool(controller_of(path))
    except UsageError:
        return False


def text_of(path: Path) -> str:
    """Return the text of the controller's file at `path`, decoded so that each byte is one character.

    Raises:
        MeasurementError: the file cannot be read.
    """
    try:
        return path.read_bytes().decode(ENCODING)
    except OSError as error:
        raise MeasurementError(f"cannot be read: {error.strerror or error}", path) from error


def read_program(
    path: Path,
    controller: str = "",
    joints: Sequence[NamedJoint] | None = None,
    external: Sequence[str] = (),
    pulses: Sequence[float] = (),
) -> Program:
    """Return the program in a file, with its targets.

    Args:
        path: the program's file.
        controller: the controller's name in ``controllers.toml``; empty: determined by the suffix.
        joints: the robot's joints; None: as the program and `external` say.
        external: names of the external axes, with their units (``rail [mm]``) where `joints` is None.
        pulses: pulses per degree or millimetre of each axis, for programs with pulses.

    Raises:
        MeasurementError: the file cannot be read, or has no targets.
        UsageError: joints that the controller does not have, or external axes whose unit is not stated.
    """
    kind = controller_of(path, controller)
    text = text_of(path)
    joint_targets = _targets_of_kind(text, "joints", kind)
    axes, notes = Axes((), ()), ()
    if joint_targets:
        if joints is None:
            axes, notes = _axes_in(path, text, kind, joint_targets, external)
        else:
            axes = axes_of(kind, joints, external)
        check_pulses(kind, axes, pulses)
    targets = []
    for target in joint_targets:
        complete = target.of_axes(axes)
        if complete is not None:
            targets.append(complete)
    targets += _targets_of_kind(text, "pose", kind)
    if not targets and joint_targets:
        counts = f"{joint_targets[0].arm} axes and {joint_targets[0].external} external ones"
        expected = f"{len(axes.arm)} and {len(axes.external)} external ones ({', '.join(_names(axes))})"
        message = f"its joint targets have {counts}, but the robot has {expected}: is it for another robot?"
        raise UsageError(f"{path}: {message}")
    if not targets:
        moves = listing(_lines_of_moves(text, kind), 3)
        moves_message = f"its moves are in line {moves}" if moves else "nor any moves"
        message = f"has no complete targets in the form that {kind.title} writes; {moves_message}"
        raise MeasurementError(message, path)
    targets.sort(key=lambda target: target.spans[0])
    return Program(path, kind, text, tuple(targets), axes, tuple(pulses), notes)


def _names(axes: Axes) -> list[str]:
    return [axes.joints[index].name for index in axes.order]


def _axes_in(
    path: Path, text: str, controller: Controller, targets: Sequence[Target], external: Sequence[str]
) -> tuple[Axes, tuple[str, ...]]:
    """Return the axes of a program's joint targets, and remarks on them.

    Args:
        path, text: the program.
        controller: its controller.
        targets: its joint targets, with all axes that they have.
        external: names of the external axes, with their units.

    Raises:
        UsageError: external axes whose unit is not stated.
    """
    line = JOINTS_LINE.search(_unwrapped(text, controller))
    if line is not None and not external:
        axes = _axes_of_line(controller, line[1])
        if any(target.of_axes(axes) for target in targets):
            return axes, ()
    fullest = max(targets, key=lambda target: target.arm)
    count = fullest.arm
    units = [_unit_behind(text, span) for span in fullest.spans[:count]]
    if count == 4 and not any(units):
        units[2] = "mm"
    notes = ()
    if count == 4 and units[2] == "mm":
        notes = ("four axes: the third slides, in mm, as a SCARA's",)
    joints = []
    for number_, unit in enumerate(units, 1):
        joints.append(_joint(f"q{number_}", unit))
    statements = [named_axis(entry) for entry in external]
    external_units = _external_units(path, text, targets, statements)
    for k, unit in enumerate(external_units):
        name = statements[k][0] if k < len(statements) else f"E{k + 1}"
        joints.append(_joint(name, unit))
    arm = tuple(range(count))
    return Axes(tuple(joints), arm, tuple(range(count, len(joints)))), notes


def _axes_of_line(controller: Controller, text: str) -> Axes:
    """Return the axes that our own line of joints names, in the description's order."""
    joints, arm, external = [], [], {}
    for entry in re.split(r", (?![a-z]+\))", text):
        match = OWN_JOINT.fullmatch(entry)
        assert match is not None
        if match[2]:
            external[match[2]] = len(joints)
        else:
            arm.append(len(joints))
        joints.append(_joint(match[1], match[3] or controller.unit))
    ordered = tuple(external[label] for label in sorted(external))
    return Axes(tuple(joints), tuple(arm), ordered)


def _joint(name: str, unit: str) -> PlainJoint:
    if unit in LENGTHS:
        return PlainJoint(name, "prismatic")
    return PlainJoint(name)


def _unwrapped(text: str, controller: Controller) -> str:
    """Return a program's text with consecutive lines of comment joined into one."""
    if not controller.comment:
        return text
    mark = re.escape(controller.comment)
    return re.sub(rf"[ \t]*;?[ \t]*\r?\n[ \t]*(?:\d+:)?[ \t]*{mark}[ \t]*", " ", text)


def _unit_behind(text: str, span: tuple[int, int]) -> str:
    """Return the unit that stands behind a number, ``mm`` or ``deg``; empty where none does."""
    match = re.match(r"\s*(mm|deg)\b", text[span[1] : span[1] + NEAR])
    if match is None:
        return ""
    return match[1]


def _external_units(
    path: Path, text: str, targets: Sequence[Target], statements: Sequence[tuple[str, str]]
) -> list[str]:
    """Return the units of a program's external axes, of those that are stated or not always 0.

    Args:
        path, text: the program.
        targets: its joint targets, with all axes that they have.
        stated: name and unit of each external axis, as the user states them; empty: none.

    Raises:
        UsageError: an axis whose unit is neither in the program nor stated.
    """
    written: list[str] = []
    used = 0
    for target in targets:
        further = list(zip(target.spans[target.arm :], target.values[target.arm :]))
        for number_, (span, value) in enumerate(_connected(further), 1):
            unit = _unit_behind(text, span)
            if number_ > len(written):
                written.append(unit)
            if value or unit:
                used = max(used, number_)
    entries = list(statements) or [(f"E{number_}", "") for number_ in range(1, used + 1)]
    count = len(entries)
    result = []
    for (name, stated_unit), unit in zip_longest(entries, written[:count], fillvalue=""):  # ty: ignore[invalid-assignment]
        unit = stated_unit or unit
        if unit not in (*ANGLES, *LENGTHS):
            raise UsageError(
                f"{path}: it moves {counted(count, 'external axis', 'external axes')}, and does not say whether {name} "
                f"is in mm or deg: state it, --external '{name} [mm]' or '{name} [deg]'"
            )
        result.append(unit)
    return result


def _matches(text: str, pattern: str, comment: str) -> list[re.Match[str]]:
    """Return the matches of a regular expression outside comments; an empty list for an empty expression.

    Args:
        text: the text to be searched.
        pattern: the expression; in it, NUM is a number.
        comment: characters that begin a comment; empty for a language without comments.
    """
    if not pattern:
        return []
    matches = re.finditer(pattern.replace("NUM", NUMBER), text)
    if not comment:
        return list(matches)
    outside_comments = []
    for match in matches:
        line_start = text.rfind("\n", 0, match.start()) + 1
        if comment not in text[line_start : match.start()]:
            outside_comments.append(match)
    return outside_comments


def _lines_of_moves(text: str, controller: Controller) -> list[int]:
    """Return the line numbers, from 1, of the motion statements in the text of a controller's program."""
    matches = _matches(text, controller.moves, controller.comment)
    return [_line_at(text, match.end()) for match in matches]


def _line_at(text: str, position: int) -> int:
    """Return the line number, from 1, of a position in a text."""
    return text.count("\n", 0, position) + 1


def _targets_of_kind(text: str, kind: str, controller: Controller) -> list[Target]:
    pattern = controller.joints if kind == "joints" else controller.pose
    targets = []
    matches = _matches(text, pattern, controller.comment)
    for k, match in enumerate(matches):
        groups = range(1, len(match.groups()) + 1)
        spans = [match.span(group) for group in groups if match[group] is not None]
        pose_number = _pose_number(text, match, controller)
        external: list[tuple[int, int]] = []
        if kind == "joints":
            following = matches[k + 1 : k + 2]
            end = len(text)
            if following:
                end = following[0].start()
            external = _external_spans(text, match, end, pose_number, controller)
        spans += external
        values = tuple(float(text[begin:end]) for begin, end in spans)
        line = _line_at(text, match.start())
        targets.append(Target(line, tuple(spans), values, kind, pose_number, len(external)))
    return targets


def _external_spans(
    text: str, match: re.Match[str], end: int, pose_number: int, controller: Controller
) -> list[tuple[int, int]]:
    """Return where the numbers of a joint target's external axes stand in the text.

    Args:
        text: the program.
        match: match of the arm's axes.
        end: where the next target begins.
        pose_number: the target's number.
        controller: the controller.
    """
    if not controller.extra:
        return []
    ranges = [(match.end(), end)]
    if controller.beside:
        headings = re.finditer(controller.beside.replace("{number}", str(pose_number)), text)
        ranges = [(heading.end(), len(text)) for heading in headings]
    number_pattern = re.compile(controller.extra.replace("NUM", NUMBER))
    spans = []
    for position, last in ranges:
        while number := number_pattern.match(text, position, last):
            spans.append(number.span(1))
            position = number.end()
    return spans


def _pose_number(text: str, match: re.Match[str], controller: Controller) -> int:
    """Return the pose number in the text shortly before a target; 0 where there is none.

    Args:
        text: the program.
        match: match of the target.
        controller: the controller, which defines how poses are numbered.
    """
    if not controller.numbered:
        return 0
    before = text[max(match.start() - NEAR, 0) : match.start(1)]
    numbered = re.search(rf"(?:{controller.numbered})$", before)
    if numbered is None:
        return 0
    digits = [group for group in numbered.groups() if group]
    return int(digits[0])
