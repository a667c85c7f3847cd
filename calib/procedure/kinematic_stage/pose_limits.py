"""The constraints file of pose selection: where the arm may go while it is measured.

TOML; every table is optional, a key that is none of these is refused. Lengths in m, angles in rad, or with a unit
(``"30 deg"``); all places in the arm's base frame::

    [joints]                         # narrower limits: lower and upper
    q1 = ["-90 deg", "90 deg"]
    [target]                         # the first target's position
    height = [0.2, 1.5]              # z; a single number is the least
    axis_distance = 0.3              # least distance from the base's z axis
    reach = 1.2                      # largest distance from the base's origin
    facing = [0, 0, 1]               # the direction it faces, in its own frame (default z)
    [instrument]                     # camera or tracker
    xyz = [2.0, 0.0, 1.0]            # where it stands, and how: rpy (or matrix)
    rpy = [0, 0, "180 deg"]
    roll = ["-20 deg", "20 deg"]     # of the target, seen from the instrument's frame: R = Rz(yaw) Ry(pitch) Rx(roll)
    pitch = ["-20 deg", "20 deg"]
    sight = "40 deg"                 # half angle of the cone, around facing, in which the target sees the instrument
    [collision]                      # by the URDF's collision shapes, or capsules where there are none
    margin = 0.02                    # least distance between parts
    radius = 0.06                    # of the capsules
    floor = 0.0                      # height of a floor
    [[obstacle]]                     # box (size: 3), sphere (1: radius) or cylinder (2: radius, length)
    name = "table"
    kind = "box"
    size = [1.0, 1.0, 0.1]
    xyz = [0.8, 0.0, -0.05]
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from calib.config import (
    Expect,
    Name,
    Numeric,
    OneOf,
    OneOrMany,
    Real,
    check_keys,
    number,
    parse,
    read_toml,
    strict,
)  # fmt: skip
from calib.errors import RobotError, UsageError
from calib.geometry.installation import Installation
from calib.geometry.observability import Observation, Target, TargetJacobian
from calib.robot.chain import sampling_limits
from calib.robot.formats.markup import text
from calib.robot.obstacles import Obstacle
from calib.robot.tables import placement
from poses import constraints
from poses.space import PoseConstraint, SearchSpace

MOTION = ("velocity", "acceleration", "jerk", "torque", "friction", "point", "frequency")  # `motion_limits` reads them
MARGIN, RADIUS = 0.01, 0.05  # [m], where the file does not tell (our choice)

Metres = Annotated[float, Real(quantity="length")]
Distance = Annotated[float, Real(least=0, quantity="length")]
Angle = Annotated[float, Real(quantity="angle")]
Point = Annotated[tuple[Metres, Metres, Metres], Expect("a list of 3 lengths")]
Turns = Annotated[tuple[Angle, Angle, Angle], Expect("a list of 3 angles")]
Rows = Annotated[tuple[tuple[float, float, float, float], ...], Expect("three or four rows of 4 numbers")]
Span = Annotated[tuple[Numeric, Numeric], Expect("a list of 2 numbers, lower and upper")]
Size = Annotated[tuple[Annotated[float, Real(above=0, quantity="length")], ...], Expect("lengths above 0")]


@strict
@dataclass(frozen=True)
class TargetTable:
    """[target], see the module."""

    height: Annotated[float | tuple[float, ...], OneOrMany(Real(quantity="length"))] | None = None
    axis_distance: Distance | None = None
    reach: Annotated[float, Real(above=0, quantity="length")] | None = None
    facing: Annotated[tuple[float, float, float], Expect("a list of 3 numbers")] = (0.0, 0.0, 1.0)

    def __post_init__(self) -> None:
        if not np.any(self.facing):
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

    def __post_init__(self) -> None:
        if self.sight is not None and self.xyz is None and self.matrix is None:
            raise ValueError("sight needs the place of the instrument, xyz")


@strict
@dataclass(frozen=True)
class CollisionTable:
    """[collision], see the module."""

    margin: Distance = MARGIN
    radius: Annotated[float, Real(above=0, quantity="length")] = RADIUS
    floor: Metres | None = None


@strict
@dataclass(frozen=True, kw_only=True)
class ObstacleTable(PlacedTable):
    """[[obstacle]], see the module."""

    kind: Annotated[str, OneOf(("box", "sphere", "cylinder"))]
    size: Size
    name: Name = "obstacle"


@strict
@dataclass(frozen=True)
class ConstraintsFile:
    """The constraints file."""

    joints: Mapping[str, Span] = field(default_factory=dict)
    target: TargetTable = field(default_factory=TargetTable)
    instrument: InstrumentTable | None = None
    collision: CollisionTable | None = None
    obstacle: tuple[ObstacleTable, ...] = ()


@dataclass(frozen=True, eq=False)
class Limits:
    """Where poses may lie: joint limits (n,), constraints of the target, and collisions.

    Attributes:
        collision: a `calib.robot.collision.Collision`; None without one.
        clearance: the least distance it asks for [m].
    """

    lower: np.ndarray
    upper: np.ndarray
    constraints: tuple[PoseConstraint, ...] = ()
    notes: tuple[str, ...] = field(default=())
    collision: Any = None
    clearance: float = MARGIN

    def space(self, seen: Observation) -> SearchSpace:
        """Return the continuous problem of choosing poses by what an instrument would see."""
        kept = self.constraints
        if self.collision is not None and self.collision.pairs:
            slope = partial(_closing, self.collision)
            kept = (*kept, PoseConstraint("collision", partial(_shortfall, self.collision, self.clearance), slope))
        return SearchSpace(seen, self.lower, self.upper, seen.product, kept)


def _shortfall(model: Any, clearance: float, q: np.ndarray) -> np.ndarray:
    return clearance - model.distances(q)


def _closing(model: Any, q: np.ndarray) -> np.ndarray:
    return -model.gradients(q)


def read_limits(path: Path | None, cell: Installation, source: Path | None = None) -> Limits:
    """Read the constraints for an arm with its targets.

    Args:
        path: the file; None for the joint limits alone. Tables of motions (`MOTION`) may stand in it.
        cell: the arm, see `calib.geometry.observability.targets_of`.
        source: the robot's file, whose collision shapes are used where it is a URDF.

    Raises:
        UsageError: for an unknown key or a value that a key cannot have.
    """
    if path is None:
        return limits_of(ConstraintsFile(), cell)
    table = {key: value for key, value in read_toml(path).items() if key not in MOTION}
    return limits_of(parse(ConstraintsFile, table, str(path)), cell, source, str(path))


def limits_of(
    stated: ConstraintsFile, cell: Installation, source: Path | None = None, where: str = "constraints"
) -> Limits:
    """Return the limits that a constraints file states for an arm; see `read_limits`."""
    try:
        lower, upper = _joints(stated.joints, cell, where)
        found = (*_target(stated.target, cell), *_instrument(stated, cell, where))
        if stated.collision is None and not stated.obstacle:
            return Limits(lower, upper, found)
        model, margin, notes = _collision(stated, cell, source, where)
    except RobotError as error:
        raise UsageError(str(error)) from error
    return Limits(lower, upper, found, notes, model, margin)


def _joints(spans: Mapping[str, Any], cell: Installation, where: str) -> tuple[np.ndarray, np.ndarray]:
    lower, upper = (side.copy() for side in sampling_limits(cell.chain))
    names = cell.chain.joint_names
    numbered = {f"q{j + 1}": j for j in range(len(names))} | {name: j for j, name in enumerate(names)}
    check_keys(spans, tuple(numbered), f"{where}: joints")
    for name, span in spans.items():
        j, place = numbered[name], f"{where}: joints.{name}"
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


def _instrument(stated: ConstraintsFile, cell: Installation, where: str) -> list[PoseConstraint]:
    table, where = stated.instrument, f"{where}: instrument"
    if table is None:
        return []
    stand, result = placement(table.stated, where), []
    if table.roll is not None or table.pitch is not None:
        roll = _span(table.roll or (-np.pi, np.pi), f"{where}.roll", "angle")
        pitch = _span(table.pitch or (-np.pi / 2, np.pi / 2), f"{where}.pitch", "angle")
        slope = TargetJacobian(cell)
        result.append(constraints.orientation(Target(cell), stand[:3, :3], roll, pitch, slope))
    if table.sight is not None:
        facing, seen = np.array(stated.target.facing), Target(cell)
        result.append(constraints.line_of_sight(seen, stand[:3, 3], facing, table.sight, TargetJacobian(cell)))
    return result


def _collision(
    stated: ConstraintsFile, cell: Installation, source: Path | None, where: str
) -> tuple[Any, float, tuple[str, ...]]:
    from calib.robot import capsules, collision

    table, chain, notes = stated.collision or CollisionTable(), cell.chain, ()
    obstacles = [
        Obstacle(one.name, one.kind, one.size, placement(one.stated, f"{where}: [[obstacle]] number {k}"))
        for k, one in enumerate(stated.obstacle, 1)
    ]
    try:
        if source is not None and source.suffix == ".urdf" and "<collision" in text(source)[0]:
            model = collision.from_urdf(source, chain.base, chain.tip, table.floor, obstacles, margin=table.margin)
            if model.missing:
                notes = (f"collision meshes not found, left out: {', '.join(model.missing[:3])}",)
        else:
            model = capsules.from_chain(chain, table.radius, table.floor, obstacles, margin=table.margin)
            words = f"capsules of radius {table.radius:g} m stand for its links"
            notes = (f"no collision shapes in the robot's file: {words}",)
    except RobotError as error:
        raise UsageError(f"{where}: {error}") from error
    if model.excluded:
        pairs = ", ".join(" with ".join(pair) for pair in model.excluded[:3])
        more = f" and {len(model.excluded) - 3} more" if len(model.excluded) > 3 else ""
        notes = (*notes, f"not watched, since no posture parts them: {pairs}{more}")
    return model, table.margin, notes
