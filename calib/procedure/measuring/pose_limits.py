"""Limits on the arm's poses during measurement, from the constraints file, the cell and the defaults.

With no file, and wherever it says nothing else, poses keep a share of each joint's range to its limits, distance
between the arm's own links, and the floor that the arm stands on: `Limits.checked` says what was kept, and
`Limits.unchecked` names what could not be, since nobody has stated it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from calib.config import Tables, check_keys, read
from calib.config_types import number
from calib.errors import RobotError, UsageError, listing, one_of, refused_as, require
from calib.geometry.installation import Installation
from calib.geometry.observability import Observation, Target, TargetJacobian
from calib.procedure.measuring import constraints_file
from calib.procedure.measuring.camera_view import camera_view
from calib.procedure.measuring.constraints_file import CameraTable, CollisionTable, ConstraintsFile, InstrumentTable
from calib.procedure.measuring.moveit import limit_tables
from calib.procedure.measuring.sight import SeenOnly, Sight, sight_of
from calib.robot.beside import links_of
from calib.robot.capsules import Obstacle, Wall, signed_distance
from calib.robot.chain import Chain
from calib.robot.description import MAX_TURN, remarks
from calib.robot.formats.urdf_tree import is_urdf, text
from calib.robot.formats.urdf_tree import read as read_tree
from calib.robot.tables import load as load_table
from calib.robot.tables import placement
from poses import constraints
from poses.space import PoseConstraint, SearchSpace

MAX_REACHES = 100.0  # times the arm's reach: no cell is that large (our choice)
BODY = 1.2  # of the reach is where a link's body ends (our choice)
DISTANCES = 3  # distances that a constraint holds: the smallest ones, so that two that change places both are there


@dataclass(frozen=True, eq=False)
class Limits:
    """Limits of poses: joint limits (n,), constraints of the target, collisions and lines of sight.

    Attributes:
        collision: a `calib.robot.collision.Collision` or `calib.robot.capsules.Capsules`; None without one.
        clearance: the least distance it asks for [m].
        sight: lines of sight; None where nothing is asked.
        camera: the view of a camera (`calib.procedure.measuring.camera_view.CameraView`), where that is the instrument.
        views: what it takes to be seen by it.
        checked: names of the checked limits.
        unchecked: names of the limits that are not checked, since nobody has stated them.
        notes: what else a user should know.
    """

    lower: np.ndarray
    upper: np.ndarray
    constraints: tuple[PoseConstraint, ...] = ()
    notes: tuple[str, ...] = field(default=())
    collision: Any = None
    clearance: float = constraints_file.MARGIN
    sight: Sight | None = None
    checked: tuple[str, ...] = ()
    unchecked: tuple[str, ...] = ()
    camera: Any = None
    views: tuple[PoseConstraint, ...] = ()

    def space(self, seen: Observation, sight: bool = True) -> SearchSpace:
        """Return the search space of pose selection: the observation Jacobian, joint limits and constraints.

        Args:
            seen: all targets' rows.
            sight: False leaves out what it takes to be seen, to tell what that costs.
        """
        looked = (*self.views, *(self.sight.constraints() if self.sight is not None else ())) if sight else ()
        kept, rows = (*self.constraints, *looked), seen  # what is quick to tell, and excludes most, comes first
        if self.collision is not None and self.collision.pairs:
            slope = partial(_closing, self.collision)
            kept = (*kept, PoseConstraint("collision", partial(_shortfall, self.collision, self.clearance), slope))
        if self.sight is not None and sight and len(self.sight.targets) > 1 and seen.product is not None:
            rows = SeenOnly(seen, self.sight)
        return SearchSpace(rows, self.lower, self.upper, rows.product, kept)


def _shortfall(model: Any, clearance: float, q: np.ndarray) -> np.ndarray:
    return clearance - np.sort(model.distances(q), axis=1)[:, :DISTANCES]


def _closing(model: Any, q: np.ndarray) -> np.ndarray:
    order = np.argsort(model.distances(q), axis=1)[:, :DISTANCES]
    return -np.take_along_axis(model.gradients(q), order[:, :, None], axis=1)


def read_limits(
    given: Tables | None, cell: Installation, source: Path | None = None, without: Sequence[str] = ()
) -> Limits:
    """Read the constraints for an arm with its targets.

    Args:
        given: the file, or its tables; None for the defaults alone. Tables of motions (`MOTION`) may stand in it.
        cell: the arm, see `calib.geometry.observability.targets_of`.
        source: the robot's file, whose collision shapes are used where it is a URDF.
        without: names of `DEFAULTS` not to keep, and of `CELL` that are not there.

    Raises:
        UsageError: for an unknown key or a value that a key cannot have.
    """
    known = (*constraints_file.DEFAULTS, *constraints_file.CELL)
    if unknown := sorted(set(without) - {*known}):
        raise UsageError(f"without {unknown[0]}: expected one of {', '.join(known)}")
    stated, where = read(ConstraintsFile, *tables_of(given, cell.chain, source, "constraints"), constraints_file.MOTION)
    limits = limits_of(stated, cell, source, where, without)
    if stated.camera is None:
        return limits
    folder = given.parent if isinstance(given, Path) else Path()
    return _with_camera(limits, stated.camera, cell, where, folder, {*stated.without, *without})


def tables_of(given: Tables | None, chain: Chain, source: Path | None, name: str) -> tuple[Tables | None, str]:
    """Return limits as a file or tables, from MoveIt's files where they are such, and their name.

    Args:
        given: a file, a folder, or tables, which are named by `name`.
        chain, source: the arm, and its file.
    """
    if isinstance(given, str | Path):
        found = limit_tables(Path(given), chain, source)
        if found is not None:
            return found, str(given)
    return given, name


def _with_camera(
    limits: Limits, stated: CameraTable, cell: Installation, where: str, folder: Path, absent: set[str]
) -> Limits:
    """Return the limits with the camera's view of the board added, if camera and board are known."""
    unchecked = tuple(each for each in limits.unchecked if not each.startswith("line of sight"))
    if stated.unknown:
        words = f"{constraints_file.VIEW_UNCHECKED} (not known: {', '.join(stated.unknown)})"
        return replace(limits, unchecked=(*unchecked, words))
    with refused_as(UsageError, RobotError, "{}"):
        view = camera_view(stated, cell.chain, where, folder)
    arm = replace(view.cell, stations=np.eye(4)[None])
    model = None if "view" in absent else limits.collision
    sight = sight_of(arm, view.stand, [[0.0, 0.0, 1.0]], None, (0.0, np.inf), model)
    found = (view.constraint(), *(sight.targets[0] if sight is not None else ()))
    words = "the whole board in the camera's view, its range and its tilt"
    past = ("view past the arm",) if sight is not None else ()
    return replace(limits, views=found, camera=view, unchecked=unchecked, checked=(*limits.checked, words, *past))


def limits_of(
    stated: ConstraintsFile,
    cell: Installation,
    source: Path | None = None,
    where: str = "constraints",
    without: Sequence[str] = (),
    seen: bool = True,
) -> Limits:
    """Return the pose limits of an arm from the content of a constraints file; see `read_limits`.

    Args:
        seen: False for motions, which nothing measures: no lines of sight.
    """
    absent = {*stated.without, *without}
    with refused_as(UsageError, RobotError, "{}"):
        margin = 0.0 if "joint-margin" in absent else _joint_margin(stated.joints, where)
        lower, upper, wide = _joints(stated.joints, cell, where, margin)
        model, checked, notes, missed = _collision(stated, cell, source, where, absent)
        found = (*_target(stated, cell), *_orientation(stated, cell, where))
        sight = _sight(stated, cell, where, None if "view" in absent else model) if seen else None
    kept = (f"{100 * margin:g} % of each joint's range to its limits", *checked) if margin else checked
    if sight is not None:
        words = {"line of sight": "cone of acceptance"}
        kept = (*kept, *(words.get(part.name, part.name) for part in sight.targets[0]))
    clearance = (stated.collision or CollisionTable()).margin
    pairs = None if model is None or not model.pairs else model
    notes = (*notes, *wide, *remarks(cell.chain))
    unchecked = (*_unchecked(stated, absent, seen), *missed)
    return Limits(lower, upper, found, notes, pairs, clearance, sight, kept, unchecked)


def _unchecked(stated: ConstraintsFile, absent: set[str], seen: bool) -> tuple[str, ...]:
    """Return the names of the limits that are not checked, for poses (if `seen`) or for motions."""
    table, collision = stated.instrument or InstrumentTable(), stated.collision or CollisionTable()
    placed = bool(table.stated)
    missing = {
        "margin to the joint limits (switched off)": "joint-margin" in absent,
        "self-collision (switched off)": "self-collision" in absent,
        "floor (switched off)": "floor" in absent and collision.floor is None,
        "line of sight (the instrument's position is not known)": seen and not placed and "instrument" not in absent,
        "cone of acceptance of the target (not known)": seen and placed and table.sight is None,
        "links in the line of sight (switched off)": seen and placed and "view" in absent,
        "walls of the cell (not known)": collision.box is None and "box" not in absent,
        "obstacles (not known)": not stated.obstacle and "obstacles" not in absent,
    }
    return tuple(words for words, holds in missing.items() if holds)


def _joint_margin(spans: Mapping[str, Any], where: str) -> float:
    share = number(spans.get("margin", constraints_file.JOINT_MARGIN), f"{where}: joints.margin")
    if not 0.0 <= share < 0.5:
        raise UsageError(f"{where}: joints.margin: expected a share of the range from 0 to below 0.5, found {share:g}")
    return share


def _joints(
    spans: Mapping[str, Any], cell: Installation, where: str, margin: float
) -> tuple[np.ndarray, np.ndarray, tuple[str, ...]]:
    """Return lower and upper joint limits (n,), and notes on given ranges that have no effect."""
    notes = []
    lower, upper = (side.copy() for side in cell.chain.sampling_limits())
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
        turns, own = cell.chain.joints[j].unit != "m", (cell.chain.lower[j], cell.chain.upper[j])
        if far := turns and max(-low, high) > MAX_TURN:
            notes.append(f'{place}: {low:g} to {high:g} rad; if in degrees, write ["{low:g} deg", "{high:g} deg"]')
        if low <= own[0] and high >= own[1] and not far and (low, high) != own:
            notes.append(f"{place}: {low:g} to {high:g} has no effect: the joint has {own[0]:g} to {own[1]:g}")
        lower[j], upper[j] = max(lower[j], low), min(upper[j], high)
        require(lower[j] < upper[j], f"{place}: the range {lower[j]:g} to {upper[j]:g} is empty", UsageError)
    return lower, upper, tuple(notes)


def _span(value: tuple[Any, Any], where: str, quantity: str) -> tuple[float, float]:
    low, high = (number(side, where, quantity) for side in value)
    with refused_as(UsageError, ValueError, "{}"):
        constraints_file.rising((low, high), where)
    return low, high


def _target(stated: ConstraintsFile, cell: Installation) -> list[PoseConstraint]:
    table, target, slope, result = stated.target, Target(cell), TargetJacobian(cell), []
    low, high = table.heights
    if low is not None:
        result.append(constraints.height(target, low, np.inf if high is None else high, slope))
    if table.axis_distance is not None:
        result.append(constraints.axis_distance(target, table.axis_distance, slope))
    if table.reach is not None:
        result.append(constraints.reach(target, table.reach, jacobian=slope))
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
    """Return the lines of sight: cone and range if given, and no link of the arm in between.

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
) -> tuple[Any, tuple[str, ...], tuple[str, ...], tuple[str, ...]]:
    """Return the collision model, the names of its checks, notes, and what it does not check."""
    table, chain = stated.collision or CollisionTable(), cell.chain
    floor = (None if "floor" in absent else chain.floor) if table.floor is None else table.floor
    obstacles = [
        Obstacle(one.name, one.kind, one.size, placement(one.stated, f"{where}: [[obstacle]] number {k}"))
        for k, one in enumerate(stated.obstacle, 1)
    ]
    walls, within = _walls(table.box, f"{where}: collision.box"), "self-collision" not in absent
    idle, far = _never_act(table, obstacles, walls, cell, where)
    place = partial(_model, cell, source, table, obstacles, walls, within)
    with refused_as(UsageError, RobotError, f"{where}: {{}}"):
        try:
            model, shapes, notes, missed = place(floor)
        except RobotError:
            if floor is None or table.floor is not None:
                raise
            model, shapes, notes, missed = place(None)
            notes = (*notes, f"floor NOT checked: all postures reach below {floor:g} m; set its height in [collision]")
            floor = None
    if model.excluded:
        pairs = listing((" with ".join(pair) for pair in model.excluded), 4)
        missed = (*missed, f"collision of {pairs} (their shapes touch in nearly all postures)")
    kept = [*([f"self-collision ({shapes})"] if within else [])]
    kept += [] if floor is None or "floor" in idle else [f"floor at {floor:g} m"]
    kept += ["walls of the cell"] if not {wall.name for wall in walls} <= idle else []
    kept += [f"obstacle {one.name}" for one in obstacles if one.name not in idle]
    notes = (*notes, *far)
    if kept:
        kept[-1] += f", {1e3 * table.margin:g} mm clearance each"
    return model, tuple(kept), notes, missed if within else ()


def _never_act(
    table: CollisionTable, obstacles: Sequence[Obstacle], walls: Sequence[Wall], cell: Installation, where: str
) -> tuple[set[str], tuple[str, ...]]:
    """Return the names of walls and obstacles that the arm cannot reach, and a note on each.

    Raises:
        UsageError: for what stands `MAX_REACHES` times as far, and for links thicker than the arm is long.
    """
    slides = sum(max(-joint.lower, joint.upper) for joint in cell.chain.joints if joint.unit == "m")
    reach = cell.reach + slides
    if table.radius is not None and table.radius > reach:
        words = f"links of radius {table.radius:g} m in an arm of {reach:.3g} m reach; is it in mm?"
        raise UsageError(f"{where}: collision.radius: {words}")
    base = np.zeros((1, 3))
    away = {} if table.floor is None else {"floor": -table.floor}
    away |= {wall.name: -wall.offset for wall in walls}
    away |= {one.name: float(signed_distance(one, base)[0][0]) for one in obstacles}
    beyond = {name: distance for name, distance in away.items() if distance > BODY * reach + table.margin}
    words = [
        f"{name}: {distance:.3g} m from the base, but the arm reaches {reach:.3g} m, so it has no effect; is it in mm?"
        for name, distance in beyond.items()
    ]
    for said, distance in zip(words, beyond.values()):
        require(distance <= MAX_REACHES * reach, f"{where}: {said} Give lengths in m", UsageError)
    return set(beyond), tuple(words)


def _model(
    cell: Installation,
    source: Path | None,
    table: CollisionTable,
    obstacles: Sequence[Obstacle],
    walls: Sequence[Wall],
    within: bool,
    floor: float | None,
) -> tuple[Any, str, tuple[str, ...], tuple[str, ...]]:
    """Return the collision model, the name of its link shapes, notes, and links that it does not hold."""
    from calib.robot import capsules, collision
    from calib.robot.beside import links_beside

    chain, notes = cell.chain, ()
    known = links_of(chain, source) if table.ignored else ()
    for name in (name for pair in table.ignored for name in pair):
        one_of(name, known, "collision.ignored: link", RobotError)
    posture = _posture(table.posture, chain, source)
    stands = "the stated posture" if posture else "zero of their joints"
    around: dict[str, Any] = {
        "walls": walls,
        "targets": cell.tools[:, :3, 3],
        "margin": table.margin,
        "within": within,
        "ignored": {frozenset(pair) for pair in table.ignored},
    }
    if source is not None and is_urdf(source) and "<collision" in text(source)[0]:
        try:
            model = collision.from_urdf(source, chain.base, chain.tip, floor, obstacles, posture=posture, **around)
            if model.missing:
                notes = (f"collision meshes not found, their shapes are not checked: {', '.join(model.missing[:3])}",)
            bare = [
                one.name for one in links_beside(text(source)[0], str(source), chain) if one.name not in model.links
            ]
            missed = (f"{listing(bare, 4)} (not in the arm, without collision shapes)",) if bare else ()
            return model, f"the URDF's collision shapes, links outside the arm at {stands}", notes, missed
        except RobotError as error:
            if "no usable <collision> shape" not in str(error):
                raise
            notes = (f"{error.args[0].partition(';')[0]}: capsules are used as link shapes",)
    radius = capsules.usual_radius(chain) if table.radius is None else table.radius
    described = _description(source, chain)
    if described is None:
        beside, missed = (), ("links outside the arm (the URDF is not at hand)",) if chain.links else ()
    else:
        beside, missed = links_beside(text(described)[0], str(described), chain, posture), ()
    model = capsules.from_chain(chain, radius, floor, obstacles, beside=beside, **around)
    words = f"capsules of radius {radius:g} m"
    if beside:
        names = listing((one.name for one in beside), 4)
        words += f"; outside the arm, at {stands}: {names}"
    return model, words, notes, missed


def _posture(stated: Mapping[str, Any], chain: Chain, source: Path | None) -> dict[str, float]:
    """Return the values [rad or m] of joints outside the arm.

    Raises:
        RobotError: for a joint of the arm, or one that its URDF does not have.
    """
    if not stated:
        return {}
    described = _description(source, chain)
    if described is None:
        raise RobotError("collision.posture: the links outside the arm are not known; give the URDF as the robot")
    joints = read_tree(text(described)[0], str(described)).joints
    result: dict[str, float] = {}
    for name, value in stated.items():
        others = [joint.name for joint in joints.values() if joint.actuated and joint.name not in chain.joint_names]
        one_of(name, others, "collision.posture: joint outside the arm", RobotError)
        quantity = "length" if joints[name].kind == "prismatic" else "angle"
        result[name] = number(value, f"collision.posture: {name}", quantity)
    return result


def _description(source: Path | None, chain: Chain) -> Path | None:
    """Return the URDF that an arm's file is, or that a fit's ``robot.toml`` was made from; None where it is not found.

    It is sought where the fit found it, and beside a session's fit.
    """
    if source is None or is_urdf(source):
        return source
    if source.suffix != ".toml" or not source.is_file():
        return None
    named = load_table(source).get("provenance", {}).get("robot", "")
    places = [Path(named), source.parent.parent / "1-robot" / Path(named).name] if named else []
    for place in places:
        if place.is_file() and is_urdf(place) and {chain.base, chain.tip} <= set(links_of(chain, place)):
            return place
    return None


def _walls(box: tuple[Any, ...] | None, where: str) -> list[Wall]:
    found = []
    for k, span in enumerate(box or ()):
        normal = np.eye(3)[k]
        low, high = _span(span, f"{where}: {'xyz'[k]}", "length")
        found += [Wall(f"wall -{'xyz'[k]}", normal, low), Wall(f"wall +{'xyz'[k]}", -normal, -high)]
    return found
