"""Targets in a controller's program: read with their places in the text, and written back, all else byte for byte.

Joint targets and poses of the tool are recognised by the patterns of ``controllers.toml``, not in comments. Relative
moves, targets that a program computes, and targets with some axes left out are not touched.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from calib.errors import MeasurementError, UsageError, listing
from calib.toolkit.chains import Controller, controller_of
from calib.transforms import pose as pose_of
from calib.units import ANGLES

NUMBER = r"([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)"
# one letter for each byte, whatever the program is in
ENCODING = "latin-1"
# letters before a target in which its number stands (our choice)
NEAR = 200


@dataclass(frozen=True)
class Target:
    """One target in a program.

    Attributes:
        line: line number in the file, from 1.
        spans: begin and end of each number of the target in the text.
        values: the numbers, in the controller's units.
        kind: ``joints`` or ``pose``.
        number: number of the pose, if the text before the target contains one; else 0.
    """

    line: int
    spans: tuple[tuple[int, int], ...]
    values: tuple[float, ...]
    kind: str
    number: int = 0


@dataclass(frozen=True)
class Program:
    """The text of a program with its targets.

    Attributes:
        path: the program's file.
        controller: the controller for which it is written.
        text: the file's bytes decoded as Latin-1.
        targets: the targets, in the order of the text.
    """

    path: Path
    controller: Controller
    text: str
    targets: tuple[Target, ...]

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
        """Return the joint targets (m, n) [rad], in the joint convention of the robot's description."""
        values = self._values("joints")
        return self.controller.described(values * ANGLES[self.controller.unit])

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
        parts = []
        position = 0
        for target, new_values in zip(self.targets, values, strict=True):
            if new_values is None:
                continue
            for (begin, end), old_value, value in zip(target.spans, target.values, new_values):
                written = text[begin:end]
                # a number that stays the same stays as it is written
                if value != old_value:
                    fraction = text[begin:end].partition(".")[2]
                    written = number(value, max(self.controller.decimals, len(fraction)))
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


def read_program(path: Path, controller: str = "") -> Program:
    """Return the program in a file, with its targets.

    Args:
        path: the program's file.
        controller: the controller's name in ``controllers.toml``; empty: determined by the suffix.

    Raises:
        MeasurementError: the file cannot be read, or has no targets.
    """
    kind = controller_of(path, controller)
    text = text_of(path)
    targets = _targets_of_kind(text, "joints", kind) + _targets_of_kind(text, "pose", kind)
    if not targets:
        moves = listing(_lines_of_moves(text, kind), 3)
        moves_message = f"its moves are in line {moves}" if moves else "nor any moves"
        message = f"has no complete targets in the form that {kind.title} writes; {moves_message}"
        raise MeasurementError(message, path)
    targets.sort(key=lambda target: target.spans[0])
    return Program(path, kind, text, tuple(targets))


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
    for match in _matches(text, pattern, controller.comment):
        groups = range(1, len(match.groups()) + 1)
        spans = tuple(match.span(group) for group in groups)
        values = tuple(float(group) for group in match.groups())
        pose_number = _pose_number(text, match, controller)
        targets.append(Target(_line_at(text, match.start()), spans, values, kind, pose_number))
    return targets


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
