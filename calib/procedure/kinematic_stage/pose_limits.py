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

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from calib.errors import RobotError, UsageError
from calib.geometry.installation import Installation
from calib.geometry.observability import Target, TargetJacobian
from calib.robot.chain import sampling_limits
from calib.robot.tables import check_keys, load, number, placement, vector
from poses import constraints
from poses.space import PoseConstraint

MOTION = ("velocity", "acceleration", "jerk", "torque", "friction", "point", "frequency")  # `motion_limits` reads them
MARGIN, RADIUS = 0.01, 0.05  # [m], where the file does not tell (our choice)


@dataclass(frozen=True, eq=False)
class Limits:
    """Where poses may lie: joint limits (n,), smooth constraints, and what has no gradient.

    Attributes:
        collision: the `calib.robot.collision.Collision` behind `feasible`; None without one.
        clearance: the least distance it asks for [m].
    """

    lower: np.ndarray
    upper: np.ndarray
    constraints: tuple[PoseConstraint, ...] = ()
    feasible: Callable[[np.ndarray], np.ndarray] | None = None
    notes: tuple[str, ...] = field(default=())
    collision: Any = None
    clearance: float = MARGIN


def read_limits(
    path: Path | None, cell: Installation, source: Path | None = None, beside: tuple[str, ...] = MOTION
) -> Limits:
    """Read the constraints for an arm with its targets.

    Args:
        path: the file; None for the joint limits alone.
        cell: the arm, see `calib.geometry.observability.targets_of`.
        source: the robot's file, whose collision shapes are used where it is a URDF.
        beside: tables of the file that somebody else reads; one file may serve poses and motions.

    Raises:
        UsageError: for an unknown key or a value that a key cannot have.
    """
    lower, upper = sampling_limits(cell.chain)
    if path is None:
        return Limits(lower, upper)
    try:
        table, where = load(path), str(path)
        check_keys(table, ("joints", "target", "instrument", "collision", "obstacle", *beside), where)
        lower, upper = _joints(table.get("joints", {}), cell, where)
        found = (*_target(table.get("target", {}), cell, where), *_instrument(table, cell, where))
        if not {"collision", "obstacle"} & set(table):
            return Limits(lower, upper, found)
        model, margin, notes = _collision(table, cell, source, where)
    except RobotError as error:
        raise UsageError(str(error)) from error
    return Limits(lower, upper, found, partial(model.free, margin=margin), notes, model, margin)


def _joints(table: Mapping[str, Any], cell: Installation, where: str) -> tuple[np.ndarray, np.ndarray]:
    lower, upper = (side.copy() for side in sampling_limits(cell.chain))
    names = cell.chain.joint_names
    numbered = {f"q{j + 1}": j for j in range(len(names))} | {name: j for j, name in enumerate(names)}
    check_keys(table, tuple(numbered), f"{where}, joints")
    for name, span in table.items():
        j = numbered[name]
        low, high = _span(span, f"{where}, joints.{name}", "length" if cell.chain.joints[j].unit == "m" else "angle")
        lower[j], upper[j] = max(lower[j], low), min(upper[j], high)
        if not lower[j] < upper[j]:
            raise UsageError(f"{where}, joints.{name}: nothing is left between {lower[j]:g} and {upper[j]:g}")
    return lower, upper


def _span(value: Any, where: str, quantity: str) -> tuple[float, float]:
    low, high = vector(value, 2, where, quantity)
    if not low < high:
        raise UsageError(f"{where}: {low:g} is not below {high:g}")
    return float(low), float(high)


def _target(table: Mapping[str, Any], cell: Installation, where: str) -> list[PoseConstraint]:
    check_keys(table, ("height", "axis_distance", "reach", "facing"), f"{where}, target")
    target, slope, result = Target(cell), TargetJacobian(cell), []
    if "height" in table:
        value, place = table["height"], f"{where}, target.height"
        low, high = (
            _span(value, place, "length") if isinstance(value, list) else (number(value, place, "length"), np.inf)
        )
        result.append(constraints.height(target, low, high, slope))
    if "axis_distance" in table:
        least = number(table["axis_distance"], f"{where}, target.axis_distance", "length")
        result.append(constraints.axis_distance(target, least, slope))
    if "reach" in table:
        most = number(table["reach"], f"{where}, target.reach", "length")
        result.append(constraints.reach(target, most, jacobian=slope))
    return result


def _instrument(tables: Mapping[str, Any], cell: Installation, where: str) -> list[PoseConstraint]:
    if "instrument" not in tables:
        return []
    table, where = tables["instrument"], f"{where}, instrument"
    check_keys(table, ("xyz", "rpy", "matrix", "roll", "pitch", "sight"), where)
    stand = placement({key: table[key] for key in ("xyz", "rpy", "matrix") if key in table}, where)
    result = []
    if "roll" in table or "pitch" in table:
        roll = _span(table.get("roll", [-np.pi, np.pi]), f"{where}.roll", "angle")
        pitch = _span(table.get("pitch", [-np.pi / 2, np.pi / 2]), f"{where}.pitch", "angle")
        result.append(constraints.orientation(Target(cell), stand[:3, :3], roll, pitch))
    if "sight" in table:
        half = number(table["sight"], f"{where}.sight", "angle")
        facing = vector(tables.get("target", {}).get("facing", [0, 0, 1]), 3, f"{where}, target.facing")
        result.append(constraints.line_of_sight(Target(cell), stand[:3, 3], facing, half, TargetJacobian(cell)))
    return result


def _collision(
    tables: Mapping[str, Any], cell: Installation, source: Path | None, where: str
) -> tuple[Any, float, tuple[str, ...]]:
    from calib.robot import collision

    table = tables.get("collision", {})
    check_keys(table, ("margin", "radius", "floor"), f"{where}, collision")
    value = {key: number(table[key], f"{where}, collision.{key}", "length") for key in table}
    obstacles = [
        _obstacle(entry, f"{where}, [[obstacle]] {k + 1}") for k, entry in enumerate(tables.get("obstacle", []))
    ]
    margin, radius, floor = value.get("margin", MARGIN), value.get("radius", RADIUS), value.get("floor")
    chain, notes = cell.chain, ()
    if source is not None and source.suffix == ".urdf" and "<collision" in source.read_text(encoding="utf-8"):
        model = collision.from_urdf(source, chain.base, chain.tip, floor, obstacles)
        if model.missing:
            notes = (f"collision meshes not found, left out: {', '.join(model.missing[:3])}",)
    else:
        model = collision.from_chain(chain, radius, floor, obstacles)
        notes = (f"no collision shapes in the robot's file: capsules of radius {radius:g} m stand for its links",)
    return model, margin, notes


def _obstacle(entry: Mapping[str, Any], where: str) -> Any:
    from calib.robot.collision import Obstacle

    check_keys(entry, ("name", "kind", "size", "xyz", "rpy", "matrix"), where)
    for key in ("kind", "size"):
        if key not in entry:
            raise UsageError(f"{where}: '{key}' is missing")
    stand = placement({key: entry[key] for key in ("xyz", "rpy", "matrix") if key in entry}, where)
    size = tuple(number(length, f"{where}, size", "length") for length in entry["size"])
    return Obstacle(str(entry.get("name", "obstacle")), str(entry["kind"]), size, stand)
