"""The constraints file of pose selection: where the arm may go while it is measured.

With no file, and wherever a file says nothing else, poses keep a share of each joint's range to its limits, distance
between the arm's own links, and the floor that the arm stands on.

TOML; every table is optional, a key that is none of these is refused. Lengths in m, angles in rad, or with a unit
(``"30 deg"``); all places in the arm's base frame::

    without = ["instrument"]         # what the cell does not have (instrument, box, obstacles), and defaults that are
                                     # not to be kept (self-collision, floor, joint-margin, view)
    [joints]                         # narrower limits: lower and upper
    q1 = ["-90 deg", "90 deg"]
    margin = 0.01                    # share of each joint's own range that stays free at either end
    [target]                         # the first target's position
    height = [0.2, 1.5]              # z; a single number is the least
    axis_distance = 0.3              # least distance from the base's z axis
    reach = 1.2                      # largest distance from the base's origin
    facing = [0, 0, 1]               # the direction it faces, in its own frame (default z), "-x" …; a list of several
    [instrument]                     # camera or tracker
    xyz = [2.0, 0.0, 1.0]            # where it stands
    rpy = [0, 0, "180 deg"]          # how it is turned: roll, pitch, yaw
    # matrix = [[1, 0, 0, 2], …]     # in place of xyz and rpy: three or four rows of 4 numbers
    roll = ["-20 deg", "20 deg"]     # of the target, seen from the instrument's frame: R = Rz(yaw) Ry(pitch) Rx(roll)
    pitch = ["-20 deg", "20 deg"]    # the same of its pitch
    sight = "40 deg"                 # half angle of the cone, around facing, in which the target sees the instrument
    range = [0.5, 20.0]              # least and largest distance of the target
    [camera]                         # in place of an instrument; places may be rough, a centimetre and some degrees do
    # what is "unknown" of the first five keys is said; the poses are then not held against the camera's view
    mounting = "in hand"             # the arm carries the camera; to hand: the board
    lens = "camera.yaml"             # beside the file; ROS camera_info
    board = "board.toml"             # as calib board writes it
    carried = {xyz = [0.04, 0.0, 0.06], rpy = [0, 0, 0]}       # what the arm carries, in the tip's frame
    stands = {xyz = [0.5, 0.1, 0.0], rpy = ["180 deg", 0, 0]}  # the other, in the base; cameras look along z
    tilt = "50 deg"                  # largest angle between the line of sight and the board's normal
    range = [0.3, 1.2]               # least and largest distance of the board's middle
    margin = 10                      # pixels that the board keeps to the image's edge
    [collision]                      # by the URDF's collision shapes, or capsules where there are none
    margin = 0.01                    # least distance between parts
    radius = 0.06                    # of the capsules; by default 5 % of the stretched arm, 0.05 or more
    floor = 0.0                      # height of the floor; by default of what the arm stands on
    box = [[-1, 1], [-1, 1], [0, 2]] # x, y and z that no part of the arm leaves
    ignored = [["base", "tool0"]]     # pairs of links that are not compared, as an SRDF's disable_collisions
    posture = {}                     # {left_elbow = "90 deg"}: where joints outside the arm stand; others at zero
    [[obstacle]]                     # any number of these
    name = "table"                   # for messages
    kind = "box"                     # box, sphere or cylinder
    size = [1.0, 1.0, 0.1]           # of a box its three edges; of a sphere the radius; of a cylinder radius and length
    xyz = [0.8, 0.0, -0.05]          # its centre
    rpy = [0, 0, 0]                  # how it is turned: roll, pitch, yaw
    # matrix = [[1, 0, 0, 2], …]     # in place of xyz and rpy: three or four rows of 4 numbers
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from calib.config import read, strict
from calib.config_types import Checked, Expect, Name, Numeric, OneOf, OneOrMany, Real, shown
from calib.data.poses import IN_HAND, TO_HAND
from calib.errors import require

# tables that `calib.procedure.excitation.limits` reads
MOTION = ("velocity", "acceleration", "jerk", "torque", "friction", "point", "frequency")
# [m] distance between parts, and share of a joint's range that stays free: where the file does not tell (our choice)
MARGIN = 0.01
JOINT_MARGIN = 0.01
DEFAULTS = ("self-collision", "floor", "joint-margin", "view")
UNKNOWN = "unknown"
VIEW_UNCHECKED = "the camera's view of the board"
CELL = ("instrument", "box", "obstacles")

Metres = Annotated[float, Real(quantity="length")]
Distance = Annotated[float, Real(least=0, quantity="length")]
Angle = Annotated[float, Real(quantity="angle")]
Point = Annotated[tuple[Metres, Metres, Metres], Expect("a list of 3 lengths")]
Turns = Annotated[tuple[Angle, Angle, Angle], Expect("a list of 3 angles")]
Rows = Annotated[tuple[tuple[float, float, float, float], ...], Expect("three or four rows of 4 numbers")]
Span = Annotated[tuple[Numeric, Numeric], Expect("a list of 2 numbers, lower and upper")]
Box = Annotated[tuple[Span, Span, Span], Expect("three lists of 2 numbers, x, y and z")]
Size = Annotated[tuple[Annotated[float, Real(above=0, quantity="length")], ...], Expect("lengths above 0")]


# names of the axes of a frame, as directions
AXES: dict[str, list[float]] = {}
for _index, _axis in enumerate("xyz"):
    for _sign in ("", "+", "-"):
        _direction = [0.0, 0.0, 0.0]
        _direction[_index] = -1.0 if _sign == "-" else 1.0
        AXES[_sign + _axis] = _direction

# JSON schemas
_DIRECTION = {"type": "array", "items": {"type": "number"}, "minItems": 3, "maxItems": 3}
_DIRECTIONS = {"anyOf": [{"enum": [*AXES]}, _DIRECTION, {"type": "array", "items": _DIRECTION, "minItems": 1}]}
_PAIR = {"type": "array", "minItems": 2, "maxItems": 2, "items": {"type": ["number", "string"]}}
_SPAN_OR_MARGIN = {"anyOf": [_PAIR, {"type": ["number", "string"]}]}


def _directions(value: object) -> object:
    """Return a list of directions; a single direction or an axis name becomes a list of one direction.

    Args:
        value: a direction (3 numbers), the name of an axis such as ``-x``, or a list of these.
    """
    if isinstance(value, str):
        value = AXES.get(value, value)
    if isinstance(value, list | tuple) and len(value) > 0 and not isinstance(value[0], list | tuple):
        return [value]
    return value


@strict
@dataclass(frozen=True)
class TargetTable:
    """Table ``[target]`` of the constraints file; the module's docstring explains the keys."""

    height: Annotated[float | tuple[float, ...], OneOrMany(Real(quantity="length"))] | None = None
    axis_distance: Distance | None = None
    reach: Annotated[float, Real(above=0, quantity="length")] | None = None
    facing: Annotated[
        tuple[Annotated[tuple[float, float, float], Expect("a list of 3 numbers")], ...],
        Checked(_directions, _DIRECTIONS),
    ] = ((0.0, 0.0, 1.0),)

    def __post_init__(self) -> None:
        if not self.facing or not all(map(np.any, self.facing)):
            raise ValueError("facing: [0, 0, 0] is not a direction; state one such as [0, 0, 1]")
        if isinstance(self.height, tuple):
            rising(self.height, "height")

    @property
    def heights(self) -> tuple[float | None, float | None]:
        """Smallest and largest allowed height of the target [m]; None: not limited."""
        if isinstance(self.height, tuple):
            return self.height[0], self.height[1]
        return self.height, None


@strict
@dataclass(frozen=True)
class PlacedTable:
    """A table that states a placement: position xyz [m] and angles rpy [rad], or a matrix."""

    xyz: Point | None = None
    rpy: Turns | None = None
    matrix: Rows | None = None

    @property
    def stated(self) -> dict[str, object]:
        """The placement keys (xyz, rpy, matrix) to which the file gives a value, with these values."""
        placement = {"xyz": self.xyz, "rpy": self.rpy, "matrix": self.matrix}
        return {key: value for key, value in placement.items() if value is not None}


@strict
@dataclass(frozen=True)
class InstrumentTable(PlacedTable):
    """Table ``[instrument]`` of the constraints file; the module's docstring explains the keys."""

    roll: Span | None = None
    pitch: Span | None = None
    sight: Annotated[float, Real(above=0, quantity="angle")] | None = None
    range: Span | None = None

    def __post_init__(self) -> None:
        for key in ("sight", "range"):
            if getattr(self, key) is not None and self.xyz is None and self.matrix is None:
                raise ValueError(f"{key} needs the position of the instrument, xyz")


@strict
@dataclass(frozen=True)
class CollisionTable:
    """Table ``[collision]`` of the constraints file; the module's docstring explains the keys."""

    margin: Distance = MARGIN
    radius: Annotated[float, Real(above=0, quantity="length")] | None = None
    floor: Metres | None = None
    box: Box | None = None
    ignored: tuple[Annotated[tuple[Name, Name], Expect("pairs of links")], ...] = ()
    posture: Mapping[str, Numeric] = field(default_factory=dict)


@strict
@dataclass(frozen=True, kw_only=True)
class ObstacleTable(PlacedTable):
    """Entry ``[[obstacle]]`` of the constraints file; the module's docstring explains the keys."""

    kind: Annotated[str, OneOf(("box", "sphere", "cylinder"))]
    size: Size
    name: Name = "obstacle"


def _span_or_margin(value: object) -> object:
    """Return the value unchanged if it is a range (two numbers or texts with units) or a single number.

    Raises:
        ValueError: for any other value.
    """
    parts: tuple[object, ...] = (value,)
    pair = False
    if isinstance(value, list | tuple) and len(value) == 2:
        pair = True
        parts = tuple(value)
    for part in parts:
        if isinstance(part, bool) or not isinstance(part, str | int | float):
            raise ValueError(f"expected a list of 2 numbers, lower and upper, found {shown(value)}")
    return parts if pair else value


def _place_or_unknown(value: object) -> object:
    if value != UNKNOWN and not isinstance(value, Mapping):
        raise ValueError(f'expected a table with xyz and rpy, or "{UNKNOWN}", found {shown(value)}')
    return value


Place = Annotated[Any, Checked(_place_or_unknown, {"anyOf": [{"type": "object"}, {"const": UNKNOWN}]})]


@strict
@dataclass(frozen=True, kw_only=True)
class CameraTable:
    """Table ``[camera]`` of the constraints file; the module's docstring explains the keys.

    If the value of a key is ``unknown``, the camera's view of the board is not checked.
    """

    mounting: Annotated[str, OneOf((IN_HAND, TO_HAND, UNKNOWN))]
    lens: Name
    board: Name
    carried: Place
    stands: Place
    tilt: Annotated[float, Real(above=0, quantity="angle")] = float(np.radians(50.0))
    range: Annotated[tuple[Distance, Distance], Expect("two distances, least and largest")] = (0.2, 3.0)
    margin: Annotated[float, Real(least=0)] = 10.0

    @property
    def unknown(self) -> tuple[str, ...]:
        """Keys whose value is ``unknown``, of those needed to check the camera's view."""
        names = ("mounting", "lens", "board", "carried", "stands")
        return tuple(name for name in names if getattr(self, name) == UNKNOWN)


@strict
@dataclass(frozen=True)
class ConstraintsFile:
    """The tables and keys of a constraints file."""

    joints: Mapping[str, Annotated[Any, Checked(_span_or_margin, _SPAN_OR_MARGIN)]] = field(default_factory=dict)
    target: TargetTable = field(default_factory=TargetTable)
    instrument: InstrumentTable | None = None
    camera: CameraTable | None = None
    collision: CollisionTable | None = None
    obstacle: tuple[ObstacleTable, ...] = ()
    without: tuple[Annotated[str, OneOf((*CELL, *DEFAULTS))], ...] = ()


def beside(path: Path) -> dict[str, Path]:
    """Return the lens file and the board file that a constraints file names: file name -> path.

    The paths are in the folder of the constraints file; empty without a table ``[camera]``.
    """
    camera = read(ConstraintsFile, path, "", MOTION)[0].camera
    if camera is None:
        return {}
    return {name: path.parent / name for name in (camera.lens, camera.board) if name != UNKNOWN}


def rising(span: tuple[float, ...], where: str) -> None:
    """Raise a ValueError unless a range consists of two numbers with the lower one first.

    Args:
        span: the range.
        where: name of the key for the message.
    """
    require(len(span) == 2, f"{where}: expected a list of 2 numbers, lower and upper, found {len(span)}", ValueError)
    require(span[0] < span[1], f"{where}: {span[0]:g} is not below {span[1]:g}", ValueError)
