"""Poses as a file has them: positions, and numbers of an orientation whose convention may be open.

`PoseList.readings` has the orientations in every convention that the names leave open.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from calib.data.poses.fit_options import EULER
from calib.data.poses.plausible import from_angles
from calib.errors import MeasurementError, counted, refuse_data
from calib.transforms import from_quaternion
from calib.units import ANGLES, LENGTHS

# Largest coordinate of a pose in metres; larger ones are millimetres: no arm reaches so far.
MAX_METRES = 20.0
# Largest angle in radians; larger ones are degrees.
MAX_RADIANS = 2.1 * np.pi
# Largest deviation of a quaternion's norm, or of R Rᵀ, from 1: rounding of a printed number.
MAX_DEFECT = 0.02
QUATERNION, MATRIX, ANGLE = "quaternion", "matrix", "angles"
NUMBERS = {4: QUATERNION, 9: MATRIX, 3: ANGLE}
ROBOT_WORDS = frozenset(
    [
        "robot",
        "rob",
        "gripper",
        "hand",
        "eef",
        "ee",
        "effector",
        "endeffector",
        "flange",
        "tool",
        "tcp",
        "tool0",
        "arm",
        "base",
        "world",
        "ur",
        "kuka",
        "fanuc",
        "link6",
    ]
)
# of boards that detectors find
BOARD_WORDS = frozenset(
    ["marker", "board", "target", "object", "obj", "tag", "aruco", "apriltag", "charuco", "pattern", "chessboard"]
)
BOARD_WORDS |= {"checkerboard", "grid", "optical"}
LENS_WORDS = frozenset(["cam", "camera", "optical", "sensor", "eye", "tracker", "vision"])
CAMERA_WORDS = BOARD_WORDS | LENS_WORDS | {"opt", "tracking"}
FIXED_WORDS = frozenset(["base", "world", "robot"])
_DIRECTION = re.compile(r"(?P<of>.+?)(?:2|_to_|_in_|_wrt_|_rel_to_|_from_)(?P<frame>.+)")


@dataclass(frozen=True, eq=False)
class PoseList:
    """Poses of one frame in another, m samples, as a file has them.

    Attributes:
        name: what the file calls them, such as ``robot``, ``target2cam``; may be empty.
        position: (m, 3) in the file's unit.
        turn: (m, 3), (m, 4) or (m, 9) numbers of the orientation.
        convention: one of `calib.data.poses.fit_options.EULER` for angles, ``x y z w`` or ``w x y z`` for quaternions;
            empty where the names leave it open.
        length_unit, angle_unit: units; empty where the file states none.
    """

    name: str
    position: np.ndarray
    turn: np.ndarray
    convention: str = ""
    length_unit: str = ""
    angle_unit: str = ""

    def __len__(self) -> int:
        return len(self.position)

    @property
    def title(self) -> str:
        """The name, for messages."""
        return self.name or "poses"

    @property
    def is_robot(self) -> bool | None:
        """Whether the name is that of the robot's poses; None where it says neither."""
        text = _direction(self.name)[0] or self.name
        parts = frozenset(re.split(r"[^a-z0-9]+", text.lower()))
        of_robot = len(parts & ROBOT_WORDS)
        of_camera = len(parts & CAMERA_WORDS)
        if of_robot == of_camera:
            return None
        return of_robot > of_camera

    @property
    def frames(self) -> tuple[frozenset[str], frozenset[str]]:
        """Words for the frame whose pose this is, and for the frame in which it is; empty where the name says none."""
        of, frame = _direction(self.name)
        return frozenset(re.findall(r"[a-z]+", of)), frozenset(re.findall(r"[a-z]+", frame))

    @property
    def kind(self) -> str:
        """Form of the orientation: quaternion, matrix or angles."""
        return NUMBERS[self.turn.shape[1]]

    def metres(self) -> tuple[np.ndarray, str]:
        """Return the positions (m, 3) [m], and a note on their unit if it was inferred from their size."""
        if self.length_unit:
            return self.position * LENGTHS[self.length_unit.lower()], ""
        largest = float(np.abs(self.position).max())
        if largest <= MAX_METRES:
            return self.position, ""
        note = f"{self.title}: up to {largest:.4g}, read as mm (no unit is stated)"
        return self.position * LENGTHS["mm"], note

    def readings(self, conventions: Sequence[str] = ()) -> Iterator[tuple[str, np.ndarray]]:
        """Yield orientations (m, 3, 3) in every convention that is open, each with its name.

        Args:
            conventions: conventions of angles that may be meant; empty: all.
        """
        if self.kind == MATRIX:
            matrices = self.turn.reshape(-1, 3, 3)
            yield "", matrices
            yield "column by column", matrices.transpose(0, 2, 1)
            return
        if self.kind == QUATERNION:
            orders = ("x y z w", "w x y z")
            if self.convention:
                orders = (self.convention, *(order for order in orders if order != self.convention))
            for order in orders:
                numbers = self.turn
                if order != "x y z w":
                    numbers = np.roll(numbers, -1, axis=1)
                yield order, Rotation.from_quat(numbers).as_matrix()
            return
        values = self.turn * self._angle_factor()
        if not conventions:
            conventions = EULER
            if self.convention:
                conventions = (self.convention,)
        for convention in conventions:
            yield convention, from_angles(values, convention).as_matrix()

    def _angle_factor(self) -> float:
        if self.angle_unit:
            return ANGLES[self.angle_unit.lower()]
        if np.abs(self.turn).max() > MAX_RADIANS:
            return ANGLES["deg"]
        return 1.0

    def check(self, file: str) -> None:
        """Raise MeasurementError for numbers that are no poses.

        Args:
            file: path of the file, for messages.
        """
        finite = np.isfinite(self.position).all(axis=1) & np.isfinite(self.turn).all(axis=1)
        if not finite.all():
            row = int(np.argmin(finite)) + 1
            refuse_data(
                file, f"'{self.title}' has a pose with an empty or infinite number: remove this sample", row=row
            )
        if self.kind == QUATERNION:
            defect = np.abs(np.linalg.norm(self.turn, axis=1) - 1.0)
            says = "the quaternion's norm differs from 1"
        elif self.kind == MATRIX:
            matrices = self.turn.reshape(-1, 3, 3)
            square = matrices @ matrices.transpose(0, 2, 1) - np.eye(3)
            defect = np.abs(square).max(axis=(1, 2))
            defect = np.where(np.linalg.det(matrices) < 0.0, 2.0, defect)
            says = "the rotation matrix is not orthonormal and right-handed: R Rᵀ differs from 1"
        else:
            return
        row = int(np.argmax(defect))
        if defect[row] > MAX_DEFECT:
            refuse_data(file, f"'{self.title}': {says} by {defect[row]:.2g}", row=row + 1)


@dataclass(frozen=True, eq=False)
class PosePairs:
    """Poses of a robot's tool and of a board or camera, measured together in m samples.

    Attributes:
        robot: poses of the tool in the base (or of the base in the tool).
        camera: poses of the board in the camera (or of the camera in the board).
        file: path of the file.
        rows: (m,) number of each sample, from 1.
        in_hand: whether the arm carries the camera, if the file says so.
        notes: remarks on how the file was read.
    """

    robot: PoseList
    camera: PoseList
    file: str
    rows: np.ndarray
    in_hand: bool | None = None
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.robot)


def paired(lists: Sequence[PoseList], file: str, rows: np.ndarray, in_hand: bool | None = None) -> PosePairs:
    """Return two lists of poses as pairs; which of them is the robot's is told by their names, else by their order.

    Args:
        lists: two lists of m poses each.
        file: path of the file, for messages.
        rows: (m,) number of each sample, from 1.
        in_hand: whether the arm carries the camera, if the file says so.

    Raises:
        MeasurementError: their lengths differ, or numbers are no poses.
    """
    first, second = lists
    if len(first) != len(second):
        counts = f"{counted(len(first), 'pose')} '{first.title}' and {counted(len(second), 'pose')} '{second.title}'"
        raise MeasurementError(f"has {counts}: every sample needs both", file)
    for poses in lists:
        poses.check(file)
    notes = ()
    if second.is_robot or first.is_robot is False:
        first, second = second, first
    elif not first.is_robot and second.is_robot is None:
        note = f"'{first.title}', first in the file, is taken for the robot's poses, '{second.title}' for the camera's"
        notes = (note,)
    return PosePairs(first, second, file, rows, in_hand, notes)


def poses_of(position: np.ndarray, turns: np.ndarray) -> np.ndarray:
    """Return poses (m, 4, 4) from positions (m, 3) and orientations (m, 3, 3)."""
    return from_quaternion(position, Rotation.from_matrix(turns).as_quat())


def _direction(name: str) -> tuple[str, str]:
    """Return the names of a frame and of its reference frame, from a name such as ``target2cam``; else empty ones."""
    text = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name).lower()
    match = _DIRECTION.fullmatch(re.sub(r"[^a-z0-9]+", "_", text))
    if match is None:
        return "", ""
    return match["of"], match["frame"]
