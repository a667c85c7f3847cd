"""The constraints file of pose selection: where the arm may go while it is measured.

With no file, and wherever a file says nothing else, poses keep a share of each joint's range to its limits, distance
between the arm's own links, and the floor that the arm stands on: `Limits.checked` says what was kept, and
`Limits.unchecked` names what could not be, since nobody has stated it.

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
    facing = [0, 0, 1]               # the direction it faces, in its own frame (default z); a list of them for several
    [instrument]                     # camera or tracker
    xyz = [2.0, 0.0, 1.0]            # where it stands, and how: rpy (or matrix)
    rpy = [0, 0, "180 deg"]
    roll = ["-20 deg", "20 deg"]     # of the target, seen from the instrument's frame: R = Rz(yaw) Ry(pitch) Rx(roll)
    pitch = ["-20 deg", "20 deg"]
    sight = "40 deg"                 # half angle of the cone, around facing, in which the target sees the instrument
    range = [0.5, 20.0]              # least and largest distance of the target
    [camera]                         # in place of an instrument; places may be rough, a centimetre and some degrees do
    mounting = "in hand"             # the arm carries the camera; to hand: the board
    lens = "camera.yaml"             # beside the file; ROS camera_info
    board = "board.toml"
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
    [[obstacle]]                     # box (size: 3), sphere (1: radius) or cylinder (2: radius, length)
    name = "table"
    kind = "box"
    size = [1.0, 1.0, 0.1]
    xyz = [0.8, 0.0, -0.05]
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from calib.config import check_keys, parse, read_toml, strict
from calib.config_types import Checked, Expect, Name, Numeric, OneOf, OneOrMany, Real, number, shown  # fmt: skip
from calib.data.poses.pixels import IN_HAND
from calib.errors import RobotError, UsageError
from calib.geometry.installation import Installation
from calib.geometry.observability import Observation, Target, TargetJacobian
from calib.procedure.measuring.camera_view import CameraTable, CameraView, ImageObservation, camera_view
from calib.procedure.measuring.sight import SeenOnly, Sight, sight_of
from calib.robot.chain import sampling_limits
from calib.robot.formats.markup import text
from calib.robot.obstacles import Obstacle, Wall
from calib.robot.tables import placement
from calib.transforms import invert
from poses import constraints
from poses.space import PoseConstraint, SearchSpace

MOTION = ("velocity", "acceleration", "jerk", "torque", "friction", "point", "frequency")  # `motion_limits` reads them
MARGIN, JOINT_MARGIN = 0.01, 0.01  # [m], share of a joint's range: where the file does not tell (our choice)
DEFAULTS = ("self-collision", "floor", "joint-margin", "view")
CELL = ("instrument", "box", "obstacles")
NEAREST = (
    3  # distances that a pose's constraint holds: the smallest ones, so that where two change places both are there
)

Metres = Annotated[float, Real(quantity="length")]
Distance = Annotated[float, Real(least=0, quantity="length")]
Angle = Annotated[float, Real(quantity="angle")]
Point = Annotated[tuple[Metres, Metres, Metres], Expect("a list of 3 lengths")]
Turns = Annotated[tuple[Angle, Angle, Angle], Expect("a list of 3 angles")]
Rows = Annotated[tuple[tuple[float, float, float, float], ...], Expect("three or four rows of 4 numbers")]
Span = Annotated[tuple[Numeric, Numeric], Expect("a list of 2 numbers, lower and upper")]
Box = Annotated[tuple[Span, Span, Span], Expect("three lists of 2 numbers, x, y and z")]
Size = Annotated[tuple[Annotated[float, Real(above=0, quantity="length")], ...], Expect("lengths above 0")]


_ONE = {"type": "array", "items": {"type": "number"}, "minItems": 3, "maxItems": 3}
_PAIR = {"type": "array", "minItems": 2, "maxItems": 2, "items": {"type": ["number", "string"]}}


def _directions(value: Any) -> Any:
    """Make a single direction a list of one."""
    single = isinstance(value, list | tuple) and len(value) > 0 and not isinstance(value[0], list | tuple)
    return [value] if single else value


@strict
@dataclass(frozen=True)
class TargetTable:
    """[target], see the module."""

    height: Annotated[float | tuple[float, ...], OneOrMany(Real(quantity="length"))] | None = None
    axis_distance: Distance | None = None
    reach: Annotated[float, Real(above=0, quantity="length")] | None = None
    facing: Annotated[
        tuple[Annotated[tuple[float, float, float], Expect("a list of 3 numbers")], ...],
        Checked(_directions, {"anyOf": [_ONE, {"type": "array", "items": _ONE, "minItems": 1}]}),
    ] = ((0.0, 0.0, 1.0),)

    def __post_init__(self) -> None:
        if not self.facing or not all(map(np.any, self.facing)):
            raise ValueError("facing: [0, 0, 0] is no direction")
        if isinstance(self.height, tuple):
            _rising(self.height, "height")

    @property
    def heights(self) -> tuple[float | None, float | None]:
        """The least and the largest height of the target [m]."""
        return (self.height[0], self.height[1]) if isinstance(self.height, tuple) else (self.height, None)


@strict
@dataclass(frozen=True)
class PlacedTable:
    """What stands somewhere: xyz and rpy, or a matrix."""

    xyz: Point | None = None
    rpy: Turns | None = None
    matrix: Rows | None = None

    @property
    def stated(self) -> dict[str, Any]:
        """The keys that were stated."""
        return {key: value for key in ("xyz", "rpy", "matrix") if (value := getattr(self, key)) is not None}


@strict
@dataclass(frozen=True)
class InstrumentTable(PlacedTable):
    """[instrument], see the module."""

    roll: Span | None = None
    pitch: Span | None = None
    sight: Annotated[float, Real(above=0, quantity="angle")] | None = None
    range: Span | None = None

    def __post_init__(self) -> None:
        for key in ("sight", "range"):
            if getattr(self, key) is not None and self.xyz is None and self.matrix is None:
                raise ValueError(f"{key} needs the place of the instrument, xyz")


@strict
@dataclass(frozen=True)
class CollisionTable:
    """[collision], see the module."""

    margin: Distance = MARGIN
    radius: Annotated[float, Real(above=0, quantity="length")] | None = None
    floor: Metres | None = None
    box: Box | None = None


@strict
@dataclass(frozen=True, kw_only=True)
class ObstacleTable(PlacedTable):
    """[[obstacle]], see the module."""

    kind: Annotated[str, OneOf(("box", "sphere", "cylinder"))]
    size: Size
    name: Name = "obstacle"


def _span_or_margin(value: Any) -> Any:
    """Take a list of two numbers or texts with units, or one (the margin)."""
    pair = isinstance(value, list | tuple) and len(value) == 2
    parts = value if pair else (value,)
    if not all(isinstance(part, str | int | float) and not isinstance(part, bool) for part in parts):
        raise ValueError(f"expected a list of 2 numbers, lower and upper, found {shown(value)}")
    return tuple(parts) if pair else value


@strict
@dataclass(frozen=True)
class ConstraintsFile:
    """The constraints file."""

    joints: Mapping[
        str, Annotated[Any, Checked(_span_or_margin, {"anyOf": [_PAIR, {"type": ["number", "string"]}]})]
    ] = field(default_factory=dict)
    target: TargetTable = field(default_factory=TargetTable)
    instrument: InstrumentTable | None = None
    camera: CameraTable | None = None
    collision: CollisionTable | None = None
    obstacle: tuple[ObstacleTable, ...] = ()
    without: tuple[Annotated[str, OneOf((*CELL, *DEFAULTS))], ...] = ()


@dataclass(frozen=True, eq=False)
class Limits:
    """Where poses may lie: joint limits (n,), constraints of the target, collisions and lines of sight.

    Attributes:
        collision: a `calib.robot.collision.Collision` or `calib.robot.capsules.Capsules`; None without one.
        clearance: the least distance it asks for [m].
        sight: lines of sight; None where nothing is asked.
        camera: the view of a camera, where that is the instrument.
        checked: what is kept, in words.
        unchecked: what cannot be, since nobody has stated it, in words.
        notes: what else a user should know.
    """

    lower: np.ndarray
    upper: np.ndarray
    constraints: tuple[PoseConstraint, ...] = ()
    notes: tuple[str, ...] = field(default=())
    collision: Any = None
    clearance: float = MARGIN
    sight: Sight | None = None
    checked: tuple[str, ...] = ()
    unchecked: tuple[str, ...] = ()
    camera: CameraView | None = None

    def space(self, seen: Observation | ImageObservation, sight: bool = True) -> SearchSpace:
        """Return the continuous problem of choosing poses by what an instrument would see.

        Args:
            seen: all targets' rows.
            sight: False leaves the lines of sight out, to tell what they cost.
        """
        looked = self.sight.constraints() if self.sight is not None and sight else ()
        kept, rows = (*self.constraints, *looked), seen  # what is quick to tell, and excludes most, comes first
        if self.collision is not None and self.collision.pairs:
            slope = partial(_closing, self.collision)
            kept = (*kept, PoseConstraint("collision", partial(_shortfall, self.collision, self.clearance), slope))
        if self.sight is not None and sight and len(self.sight.targets) > 1 and isinstance(seen, Observation):
            rows = SeenOnly(seen, self.sight)
        return SearchSpace(rows, self.lower, self.upper, rows.product, kept)


def _shortfall(model: Any, clearance: float, q: np.ndarray) -> np.ndarray:
    return clearance - np.sort(model.distances(q), axis=1)[:, :NEAREST]


def _closing(model: Any, q: np.ndarray) -> np.ndarray:
    order = np.argsort(model.distances(q), axis=1)[:, :NEAREST]
    return -np.take_along_axis(model.gradients(q), order[:, :, None], axis=1)


def read_limits(
    path: Path | None, cell: Installation, source: Path | None = None, without: Sequence[str] = ()
) -> Limits:
    """Read the constraints for an arm with its targets.

    Args:
        path: the file; None for the defaults alone. Tables of motions (`MOTION`) may stand in it.
        cell: the arm, see `calib.geometry.observability.targets_of`.
        source: the robot's file, whose collision shapes are used where it is a URDF.
        without: names of `DEFAULTS` not to keep, and of `CELL` that are not there.

    Raises:
        UsageError: for an unknown key or a value that a key cannot have.
    """
    if unknown := sorted(set(without) - {*DEFAULTS, *CELL}):
        raise UsageError(f"without {unknown[0]}: there are {', '.join((*DEFAULTS, *CELL))}")
    table = {} if path is None else {key: value for key, value in read_toml(path).items() if key not in MOTION}
    stated = parse(ConstraintsFile, table, str(path or "constraints"))
    limits = limits_of(stated, cell, source, str(path or "constraints"), without)
    if stated.camera is None or path is None:
        return limits
    return _with_camera(limits, stated, cell, path, {*stated.without, *without})


def beside(path: Path) -> dict[str, Path]:
    """Return the files that a constraints file names, by name: a camera's lens and its board."""
    table = {key: value for key, value in read_toml(path).items() if key not in MOTION}
    camera = parse(ConstraintsFile, table, str(path)).camera
    return {} if camera is None else {name: path.parent / name for name in (camera.lens, camera.board)}


def _with_camera(limits: Limits, stated: ConstraintsFile, cell: Installation, path: Path, absent: set[str]) -> Limits:
    """Return limits that keep the board in the camera's view, past the arm's own links."""
    assert stated.camera is not None
    try:
        view = camera_view(stated.camera, cell.chain, str(path), path.parent)
    except RobotError as error:
        raise UsageError(str(error)) from error
    stand = invert(view.cell.stations[0])[:3, 3]
    if view.mounting == IN_HAND:
        stand = (invert(view.cell.stations[0]) @ [*(0.5 * np.array(view.board.extent)), 0.0, 1.0])[:3]
    arm = replace(view.cell, stations=np.eye(4)[None])
    model = None if "view" in absent else limits.collision
    sight = sight_of(arm, stand, [[0.0, 0.0, 1.0]], None, (0.0, np.inf), model)
    found = (view.constraint(), *(sight.targets[0] if sight is not None else ()))
    unchecked = tuple(each for each in limits.unchecked if not each.startswith("line of sight"))
    words = "the whole board in the camera's view, its range and its tilt"
    past = ("view past the arm",) if sight is not None else ()
    return replace(
        limits, constraints=(*limits.constraints, *found), camera=view, unchecked=unchecked,
        checked=(*limits.checked, words, *past),
    )  # fmt: skip


def limits_of(
    stated: ConstraintsFile,
    cell: Installation,
    source: Path | None = None,
    where: str = "constraints",
    without: Sequence[str] = (),
    seen: bool = True,
) -> Limits:
    """Return the limits that a constraints file states for an arm; see `read_limits`.

    Args:
        seen: False for motions, which nothing measures: no lines of sight.
    """
    absent = {*stated.without, *without}
    try:
        margin = 0.0 if "joint-margin" in absent else _joint_margin(stated.joints, where)
        lower, upper = _joints(stated.joints, cell, where, margin)
        model, checked, notes = _collision(stated, cell, source, where, absent)
        found = (*_target(stated.target, cell), *_orientation(stated, cell, where))
        sight = _sight(stated, cell, where, None if "view" in absent else model) if seen else None
    except RobotError as error:
        raise UsageError(str(error)) from error
    kept = (f"{100 * margin:g} % of each joint's range to its limits", *checked) if margin else checked
    if sight is not None:
        words = {"line of sight": "cone of acceptance"}
        kept = (*kept, *(words.get(part.name, part.name) for part in sight.targets[0]))
    clearance = (stated.collision or CollisionTable()).margin
    pairs = None if model is None or not model.pairs else model
    return Limits(lower, upper, found, notes, pairs, clearance, sight, kept, _unchecked(stated, absent, seen))


def _unchecked(stated: ConstraintsFile, absent: set[str], seen: bool) -> tuple[str, ...]:
    """Return in words what poses (motions where they are not `seen`) are not held against."""
    table, names = stated.instrument, []
    if "joint-margin" in absent:
        names.append("margin to the joint limits (switched off)")
    if "self-collision" in absent:
        names.append("self-collision (switched off)")
    if "floor" in absent and (stated.collision is None or stated.collision.floor is None):
        names.append("floor (switched off)")
    if not seen:
        pass
    elif table is None or not table.stated:
        names += [] if "instrument" in absent else ["line of sight (the instrument's place is not known)"]
    else:
        names += [] if table.sight is not None else ["cone of acceptance of the target (not known)"]
        names += [] if "view" not in absent else ["links in the line of sight (switched off)"]
    if stated.collision is None or stated.collision.box is None:
        names += [] if "box" in absent else ["walls of the cell (not known)"]
    if not stated.obstacle and "obstacles" not in absent:
        names.append("obstacles (not known)")
    return tuple(names)


def _joint_margin(spans: Mapping[str, Any], where: str) -> float:
    share = number(spans.get("margin", JOINT_MARGIN), f"{where}: joints.margin")
    if not 0.0 <= share < 0.5:
        raise UsageError(f"{where}: joints.margin: expected a share of the range from 0 to below 0.5, found {share:g}")
    return share


def _joints(spans: Mapping[str, Any], cell: Installation, where: str, margin: float) -> tuple[np.ndarray, np.ndarray]:
    lower, upper = (side.copy() for side in sampling_limits(cell.chain))
    limited = np.isfinite(cell.chain.lower) & np.isfinite(cell.chain.upper)
    free = np.where(limited, margin * (upper - lower), 0.0)
    lower, upper = lower + free, upper - free
    names = cell.chain.joint_names
    numbered = {f"q{j + 1}": j for j in range(len(names))} | {name: j for j, name in enumerate(names)}
    check_keys(spans, (*numbered, "margin"), f"{where}: joints")
    for name, span in spans.items():
        if name == "margin" and name not in numbered:
            continue
        j, place = numbered[name], f"{where}: joints.{name}"
        if not isinstance(span, tuple):
            raise UsageError(f"{place}: expected a list of 2 numbers, lower and upper, found {span}")
        low, high = _span(span, place, "length" if cell.chain.joints[j].unit == "m" else "angle")
        lower[j], upper[j] = max(lower[j], low), min(upper[j], high)
        if not lower[j] < upper[j]:
            raise UsageError(f"{place}: nothing is left between {lower[j]:g} and {upper[j]:g}")
    return lower, upper


def _span(value: tuple[Any, Any], where: str, quantity: str) -> tuple[float, float]:
    low, high = (number(side, where, quantity) for side in value)
    try:
        _rising((low, high), where)
    except ValueError as error:
        raise UsageError(str(error)) from None
    return low, high


def _rising(span: tuple[float, ...], where: str) -> None:
    if len(span) != 2:
        raise ValueError(f"{where}: expected a list of 2 numbers, lower and upper, found {len(span)}")
    if not span[0] < span[1]:
        raise ValueError(f"{where}: {span[0]:g} is not below {span[1]:g}")


def _target(stated: TargetTable, cell: Installation) -> list[PoseConstraint]:
    target, slope, result = Target(cell), TargetJacobian(cell), []
    low, high = stated.heights
    if low is not None:
        result.append(constraints.height(target, low, np.inf if high is None else high, slope))
    if stated.axis_distance is not None:
        result.append(constraints.axis_distance(target, stated.axis_distance, slope))
    if stated.reach is not None:
        result.append(constraints.reach(target, stated.reach, jacobian=slope))
    return result


def _orientation(stated: ConstraintsFile, cell: Installation, where: str) -> list[PoseConstraint]:
    table, where = stated.instrument, f"{where}: instrument"
    if table is None or (table.roll is None and table.pitch is None):
        return []
    stand = placement(table.stated, where)
    roll = _span(table.roll or (-np.pi, np.pi), f"{where}.roll", "angle")
    pitch = _span(table.pitch or (-np.pi / 2, np.pi / 2), f"{where}.pitch", "angle")
    return [constraints.orientation(Target(cell), stand[:3, :3], roll, pitch, TargetJacobian(cell))]


def _sight(stated: ConstraintsFile, cell: Installation, where: str, model: Any) -> Sight | None:
    """Return the lines of sight: cone and range where they are stated, and past the arm.

    An instrument with roll and pitch alone is a camera whose view these state.
    """
    table, facing = stated.instrument, stated.target.facing
    turned = table is not None and (table.roll is not None or table.pitch is not None)
    if table is None or (table.sight is None and table.range is None and (turned or not table.stated)):
        return None
    if len(facing) not in (1, len(cell.tools)):
        raise UsageError(f"{where}: target.facing: {len(facing)} directions for {len(cell.tools)} targets")
    span = (0.0, np.inf) if table.range is None else _span(table.range, f"{where}: instrument.range", "length")
    stand = placement(table.stated, f"{where}: instrument")[:3, 3]
    return sight_of(cell, stand, facing, table.sight, span, model)


def _collision(
    stated: ConstraintsFile, cell: Installation, source: Path | None, where: str, absent: set[str]
) -> tuple[Any, tuple[str, ...], tuple[str, ...]]:
    """Return the model of collisions, what it keeps in words, and notes."""
    table, chain = stated.collision or CollisionTable(), cell.chain
    floor = (None if "floor" in absent else chain.floor) if table.floor is None else table.floor
    obstacles = [
        Obstacle(one.name, one.kind, one.size, placement(one.stated, f"{where}: [[obstacle]] number {k}"))
        for k, one in enumerate(stated.obstacle, 1)
    ]
    walls, within = _walls(table.box, f"{where}: collision.box"), "self-collision" not in absent
    place = partial(_model, cell, source, table, obstacles, walls, within)
    try:
        model, shapes, notes = place(floor)
    except RobotError as error:
        if floor is None or table.floor is not None:
            raise UsageError(f"{where}: {error}") from error
        try:
            model, shapes, notes = place(None)
        except RobotError:
            raise UsageError(f"{where}: {error}") from error
        notes = (*notes, f"the floor is NOT kept: every posture is below {floor:g} m; state it under [collision]")
        floor = None
    if model.excluded:
        pairs = ", ".join(" with ".join(pair) for pair in model.excluded[:3])
        more = f" and {len(model.excluded) - 3} more" if len(model.excluded) > 3 else ""
        notes = (*notes, f"not watched, since no posture parts them: {pairs}{more}")
    kept = [*([f"self-collision ({shapes})"] if within else [])]
    kept += [] if floor is None else [f"floor at {floor:g} m"]
    kept += ["walls of the cell"] if walls else []
    kept += [f"obstacle {one.name}" for one in obstacles]
    if kept:
        kept[-1] += f", {1e3 * table.margin:g} mm off each"
    return model, tuple(kept), notes


def _model(
    cell: Installation,
    source: Path | None,
    table: CollisionTable,
    obstacles: Sequence[Obstacle],
    walls: Sequence[Wall],
    within: bool,
    floor: float | None,
) -> tuple[Any, str, tuple[str, ...]]:
    """Return the model of collisions, what stands for the links in words, and notes."""
    from calib.robot import capsules, collision

    chain, notes = cell.chain, ()
    around: dict[str, Any] = {"walls": walls, "targets": cell.tools[:, :3, 3], "margin": table.margin, "within": within}
    if source is not None and source.suffix == ".urdf" and "<collision" in text(source)[0]:
        try:
            model = collision.from_urdf(source, chain.base, chain.tip, floor, obstacles, **around)
            if model.missing:
                notes = (f"collision meshes not found, left out: {', '.join(model.missing[:3])}",)
            return model, "the URDF's collision shapes", notes
        except RobotError as error:
            if "no usable <collision> shape" not in str(error):
                raise
            notes = (f"{error.args[0].partition(';')[0]}: capsules stand for its links",)
    radius = capsules.usual_radius(chain) if table.radius is None else table.radius
    return capsules.from_chain(chain, radius, floor, obstacles, **around), f"capsules of radius {radius:g} m", notes


def _walls(box: tuple[Any, ...] | None, where: str) -> list[Wall]:
    found = []
    for k, span in enumerate(box or ()):
        normal = np.eye(3)[k]
        low, high = _span(span, f"{where}: {'xyz'[k]}", "length")
        found += [Wall(f"wall -{'xyz'[k]}", normal, low), Wall(f"wall +{'xyz'[k]}", -normal, -high)]
    return found
