"""Limits on the arm's poses during measurement, from the constraints file, the cell and the defaults.

By default, poses keep a margin to the joint limits, a distance between the arm's links, and a distance from the floor
on which the arm stands. `Limits.checked` lists the checked limits. `Limits.unchecked` lists the limits that were not
checked because the user did not state them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from calib.config import Tables, check_keys, read
from calib.config_types import number
from calib.errors import RobotError, UsageError, listing, one_of, refused_as, require
from calib.geometry.installation import Installation
from calib.geometry.observability import Observation, TargetJacobian, TargetPose
from calib.poses import pose_constraints
from calib.poses.space import PoseConstraint, SearchSpace
from calib.procedure.measuring import constraints_file
from calib.procedure.measuring.camera_view import camera_view
from calib.procedure.measuring.constraints_file import CameraTable, CollisionTable, ConstraintsFile, InstrumentTable
from calib.procedure.measuring.moveit import limit_tables
from calib.procedure.measuring.sight import SeenOnly, Sight, sight_of
from calib.records import FieldValues
from calib.robot.beside import links_of
from calib.robot.chain import Chain
from calib.robot.description import MAX_TURN, remarks
from calib.robot.formats.urdf_tree import is_urdf, text
from calib.robot.formats.urdf_tree import read as read_tree
from calib.robot.obstacles import Obstacle, Wall, signed_distance
from calib.robot.tables import load as load_table
from calib.robot.tables import placement
from calib.workers.extras import installed, lacking

if TYPE_CHECKING:
    from calib.robot.collision import DistanceModel

# times the arm's reach: no cell is that large (our choice)
MAX_REACHES = 100.0
# of the reach is where a link's body ends (our choice)
BODY = 1.2
# smallest distances that the collision constraint holds: if two exchange their ranks, both are included
DISTANCES = 3
# names that a message lists
LISTED_NAMES = 4
LISTED_MESHES = 3
# name of a line-of-sight constraint -> name of the limit
SIGHT_NAMES = {"line of sight": "cone of acceptance"}


@dataclass(frozen=True, eq=False)
class Limits:
    """Limits of poses: joint limits, constraints on the target, collisions and lines of sight.

    Attributes:
        lower, upper: (n,) joint limits [rad or m].
        constraints: constraints on the target's position and orientation.
        notes: remarks for the user.
        collision: a `calib.robot.collision.Collision` or `calib.robot.capsules.Capsules`; None: not checked.
        clearance: smallest allowed distance between links, and from obstacles [m].
        sight: lines of sight from an instrument to the targets; None: no conditions on them.
        checked: names of the checked limits.
        unchecked: names of the limits that are not checked because the user did not state them.
        camera: view of the measuring camera (`calib.procedure.measuring.camera_view.CameraView`); None: no camera.
        views: constraints under which the camera sees the board.
    """

    lower: np.ndarray
    upper: np.ndarray
    constraints: tuple[PoseConstraint, ...] = ()
    notes: tuple[str, ...] = field(default=())
    collision: DistanceModel | None = None
    clearance: float = constraints_file.MARGIN
    sight: Sight | None = None
    checked: tuple[str, ...] = ()
    unchecked: tuple[str, ...] = ()
    camera: Any = None
    views: tuple[PoseConstraint, ...] = ()

    def space(self, observation: Observation, sight: bool = True) -> SearchSpace:
        """Return the search space of pose selection: observation Jacobian, joint limits and constraints.

        Args:
            observation: observation Jacobian with the rows of all targets.
            sight: whether line-of-sight and view constraints apply; without them, the accuracy that they cost can be
                computed.
        """
        # constraints that are quick to compute, and exclude most, come first
        constraints = [*self.constraints]
        if sight:
            constraints += self.views
            if self.sight is not None:
                constraints += self.sight.constraints()
        if self.collision is not None and self.collision.pairs:
            shortfall = partial(_shortfall, self.collision, self.clearance)
            gradient = partial(_shortfall_gradient, self.collision)
            constraints.append(PoseConstraint("collision", shortfall, gradient))
        rows: Observation | SeenOnly = observation
        targets = () if self.sight is None else self.sight.targets
        if self.sight is not None and sight and len(targets) > 1 and observation.product is not None:
            # rows of several targets count where these are seen
            rows = SeenOnly(observation, self.sight)
        return SearchSpace(rows, self.lower, self.upper, rows.product, tuple(constraints))


def _shortfall(model: DistanceModel, clearance: float, q: np.ndarray) -> np.ndarray:
    return clearance - np.sort(model.distances(q), axis=1)[:, :DISTANCES]


def _shortfall_gradient(model: DistanceModel, q: np.ndarray) -> np.ndarray:
    order = np.argsort(model.distances(q), axis=1)[:, :DISTANCES]
    return -np.take_along_axis(model.gradients(q), order[:, :, None], axis=1)


def read_limits(
    tables: Tables | None, cell: Installation, source: Path | None = None, without: Sequence[str] = ()
) -> Limits:
    """Return the pose limits of an arm with its targets, read from a constraints file.

    Args:
        tables: path of the file, or its content as tables; tables for motions (`MOTION`) are ignored; None: only
            defaults apply.
        cell: the arm with its targets, as `calib.geometry.observability.targets_of` returns it.
        source: the robot's file; if it is a URDF, its collision shapes are used; None: no file.
        without: defaults that do not apply (self-collision, floor, joint-margin, view), and objects that the cell does
            not have (instrument, box, obstacles).

    Raises:
        UsageError: for an unknown key or an invalid value.
    """
    names = (*constraints_file.DEFAULTS, *constraints_file.CELL)
    unknown = sorted(set(without) - {*names})
    if unknown:
        raise UsageError(f"without {unknown[0]}: expected one of {', '.join(names)}")
    content, name = tables_of(tables, cell.chain, source, "constraints")
    settings, where = read(ConstraintsFile, content, name, constraints_file.MOTION)
    limits = limits_of(settings, cell, source, where, without)
    if settings.camera is None:
        return limits
    folder = Path()
    if isinstance(tables, Path):
        folder = tables.parent
    return _with_camera(limits, settings.camera, cell, where, folder, {*settings.without, *without})


def tables_of(tables: Tables | None, chain: Chain, source: Path | None, name: str) -> tuple[Tables | None, str]:
    """Return the limits as a file or tables, and the name of their source for messages.

    MoveIt's files are converted to tables.

    Args:
        tables: a file, a folder, or tables; None: no limits, returned as None.
        chain: the arm.
        source: the arm's file; None: no file.
        name: name in messages for tables that are not from MoveIt.
    """
    if isinstance(tables, str | Path):
        content = limit_tables(Path(tables), chain, source)
        if content is not None:
            return content, str(tables)
    return tables, name


def _with_camera(
    limits: Limits, camera: CameraTable, cell: Installation, where: str, folder: Path, absent: set[str]
) -> Limits:
    """Return the limits with the camera's view of the board added.

    If the placement or the files of camera or board are unknown, the view is instead listed as unchecked.

    Args:
        limits: the other limits.
        camera: table ``[camera]`` of the constraints file.
        cell: the arm with its targets.
        where: name of the constraints file for messages.
        folder: folder with the lens file and the board file.
        absent: names of defaults and objects that do not apply, such as ``view``.
    """
    unchecked = tuple(name for name in limits.unchecked if not name.startswith("line of sight"))
    if camera.unknown:
        name = f"{constraints_file.VIEW_UNCHECKED} (not known: {', '.join(camera.unknown)})"
        return replace(limits, unchecked=(*unchecked, name))
    with refused_as(UsageError, RobotError, "{}"):
        view = camera_view(camera, cell.chain, where, folder)
    arm = replace(view.cell, stations=np.eye(4)[None])
    model = limits.collision
    if "view" in absent:
        model = None
    sight = sight_of(arm, view.stand, [[0.0, 0.0, 1.0]], None, (0.0, np.inf), model)
    views = [view.constraint()]
    checked = [*limits.checked, "the whole board in the camera's view, its range and its tilt"]
    if sight is not None:
        views += sight.targets[0]
        checked.append("view past the arm")
    return replace(limits, views=tuple(views), camera=view, unchecked=unchecked, checked=tuple(checked))


def limits_of(
    settings: ConstraintsFile,
    cell: Installation,
    source: Path | None = None,
    where: str = "constraints",
    without: Sequence[str] = (),
    measured: bool = True,
) -> Limits:
    """Return the pose limits of an arm from the parsed content of a constraints file.

    Args:
        settings: content of the constraints file.
        cell: the arm with its targets.
        source: the robot's file; if it is a URDF, its collision shapes are used; None: no file.
        where: name of the constraints file for messages.
        without: defaults that do not apply (self-collision, floor, joint-margin, view), and objects that the cell does
            not have (instrument, box, obstacles).
        measured: True for poses at which an instrument measures; False for motions, which need no line of sight.

    Raises:
        UsageError: for an invalid value.
    """
    absent = {*settings.without, *without}
    collision = settings.collision or CollisionTable()
    with refused_as(UsageError, RobotError, "{}"):
        margin = 0.0
        if "joint-margin" not in absent:
            margin = _joint_margin(settings.joints, where)
        lower, upper, joint_notes = _joints(settings.joints, cell, where, margin)
        model, checks, collision_notes, not_checked = _collision(settings, cell, source, where, absent)
        constraints_of_target = (*_target(settings, cell), *_orientation(settings, cell, where))
        sight = None
        if measured:
            sight = _sight(settings, cell, where, None if "view" in absent else model)
    checked = [*checks]
    if margin:
        checked.insert(0, f"{100 * margin:g} % of each joint's range to its limits")
    if sight is not None:
        checked += [SIGHT_NAMES.get(part.name, part.name) for part in sight.targets[0]]
    if model is not None and not model.pairs:
        model = None
    return Limits(
        lower=lower,
        upper=upper,
        constraints=constraints_of_target,
        notes=(*collision_notes, *joint_notes, *remarks(cell.chain)),
        collision=model,
        clearance=collision.margin,
        sight=sight,
        checked=tuple(checked),
        unchecked=(*_unchecked(settings, absent, measured), *not_checked),
    )


def _unchecked(settings: ConstraintsFile, absent: set[str], measured: bool) -> tuple[str, ...]:
    """Return the names of the limits that are not checked.

    Args:
        settings: content of the constraints file.
        absent: defaults and objects that do not apply, such as ``floor`` or ``instrument``.
        measured: True for poses at which an instrument measures; False for motions.
    """
    instrument = settings.instrument or InstrumentTable()
    collision = settings.collision or CollisionTable()
    placed = bool(instrument.stated)
    no_instrument = not placed and "instrument" not in absent
    missing = {
        "margin to the joint limits (switched off)": "joint-margin" in absent,
        "self-collision (switched off)": "self-collision" in absent,
        "floor (switched off)": "floor" in absent and collision.floor is None,
        "line of sight (the instrument's position is not known)": measured and no_instrument,
        "cone of acceptance of the target (not known)": measured and placed and instrument.sight is None,
        "links in the line of sight (switched off)": measured and placed and "view" in absent,
        "walls of the cell (not known)": collision.box is None and "box" not in absent,
        "obstacles (not known)": not settings.obstacle and "obstacles" not in absent,
    }
    return tuple(name for name, is_missing in missing.items() if is_missing)


def _joint_margin(spans: Mapping[str, object], where: str) -> float:
    share = number(spans.get("margin", constraints_file.JOINT_MARGIN), f"{where}: joints.margin")
    if not 0.0 <= share < 0.5:
        raise UsageError(f"{where}: joints.margin: expected a share of the range from 0 to below 0.5, found {share:g}")
    return share


def _joints(
    spans: Mapping[str, object], cell: Installation, where: str, margin: float
) -> tuple[np.ndarray, np.ndarray, tuple[str, ...]]:
    """Return lower and upper joint limits (n,) [rad or m], and notes for the user on ranges in the file without effect
    or in the wrong unit.

    Args:
        spans: table ``[joints]``: joint name -> range.
        cell: the arm.
        where: name of the constraints file for messages.
        margin: share of each joint's range that stays free at either end.
    """
    chain = cell.chain
    lower, upper = (limit.copy() for limit in chain.sampling_limits())
    limited = np.isfinite(chain.lower) & np.isfinite(chain.upper)
    free = np.where(limited, margin * (upper - lower), 0.0)
    lower, upper = lower + free, upper - free
    index = {f"q{j + 1}": j for j in range(chain.n)}
    index |= {name: j for j, name in enumerate(chain.joint_names)}
    check_keys(spans, (*index, "margin"), f"{where}: joints")
    notes = []
    for name, span in spans.items():
        if name == "margin" and name not in index:
            continue
        j = index[name]
        key = f"{where}: joints.{name}"
        if not isinstance(span, tuple):
            raise UsageError(f"{key}: expected a list of 2 numbers, lower and upper, found {span}")
        revolute = chain.joints[j].unit != "m"
        low, high = _span(span, key, "angle" if revolute else "length")
        # a range in degrees that was written without its unit
        in_degrees = revolute and max(-low, high) > MAX_TURN
        if in_degrees:
            notes.append(f'{key}: {low:g} to {high:g} rad; if in degrees, write ["{low:g} deg", "{high:g} deg"]')
        joint_low, joint_high = chain.lower[j], chain.upper[j]
        wider = low <= joint_low and high >= joint_high and (low, high) != (joint_low, joint_high)
        if wider and not in_degrees:
            notes.append(f"{key}: {low:g} to {high:g} has no effect: the joint has {joint_low:g} to {joint_high:g}")
        lower[j] = max(lower[j], low)
        upper[j] = min(upper[j], high)
        require(lower[j] < upper[j], f"{key}: the range {lower[j]:g} to {upper[j]:g} is empty", UsageError)
    return lower, upper, tuple(notes)


def _span(value: tuple[object, object], where: str, quantity: str) -> tuple[float, float]:
    lower, upper = value
    low = number(lower, where, quantity)
    high = number(upper, where, quantity)
    with refused_as(UsageError, ValueError, "{}"):
        constraints_file.rising((low, high), where)
    return low, high


def _target(settings: ConstraintsFile, cell: Installation) -> list[PoseConstraint]:
    table = settings.target
    target = TargetPose(cell)
    jacobian = TargetJacobian(cell)
    result = []
    low, high = table.heights
    if low is not None:
        result.append(pose_constraints.height(target, low, np.inf if high is None else high, jacobian))
    if table.axis_distance is not None:
        result.append(pose_constraints.axis_distance(target, table.axis_distance, jacobian))
    if table.reach is not None:
        result.append(pose_constraints.reach(target, table.reach, jacobian=jacobian))
    return result


def _orientation(settings: ConstraintsFile, cell: Installation, where: str) -> list[PoseConstraint]:
    table, where = settings.instrument, f"{where}: instrument"
    if table is None or (table.roll is None and table.pitch is None):
        return []
    stand = placement(table.stated, where)
    roll = _span(table.roll or (-np.pi, np.pi), f"{where}.roll", "angle")
    pitch = _span(table.pitch or (-np.pi / 2, np.pi / 2), f"{where}.pitch", "angle")
    return [pose_constraints.orientation(TargetPose(cell), stand[:3, :3], roll, pitch, TargetJacobian(cell))]


def _sight(settings: ConstraintsFile, cell: Installation, where: str, model: DistanceModel | None) -> Sight | None:
    """Return the lines of sight: acceptance cone and range if stated, and no link of the arm in between.

    None if the file states no instrument or no condition on its lines of sight. An instrument for which only roll and
    pitch are stated is a camera; the two ranges limit the target's orientation in its image.

    Args:
        settings: content of the constraints file.
        cell: the arm with its targets.
        where: name of the constraints file for messages.
        model: collision model of the arm's links; None: links in between are not checked.
    """
    table, facing = settings.instrument, settings.target.facing
    if table is None:
        return None
    is_camera = table.roll is not None or table.pitch is not None
    conditions = table.sight is not None or table.range is not None
    if not conditions and (is_camera or not table.stated):
        return None
    if len(facing) not in (1, len(cell.tools)):
        raise UsageError(f"{where}: target.facing: {len(facing)} directions for {len(cell.tools)} targets")
    span = (0.0, np.inf)
    if table.range is not None:
        span = _span(table.range, f"{where}: instrument.range", "length")
    stand = placement(table.stated, f"{where}: instrument")[:3, 3]
    return sight_of(cell, stand, facing, table.sight, span, model)


def _collision(
    settings: ConstraintsFile, cell: Installation, source: Path | None, where: str, absent: set[str]
) -> tuple[DistanceModel, tuple[str, ...], tuple[str, ...], tuple[str, ...]]:
    """Return the collision model, the names of the checked collisions, notes, and the names of unchecked collisions.

    Args:
        settings: content of the constraints file.
        cell: the arm with its targets.
        source: the robot's file, with collision shapes if it is a URDF; None: no file.
        where: name of the constraints file for messages.
        absent: names of defaults and objects that do not apply.
    """
    table = settings.collision or CollisionTable()
    floor = table.floor
    if floor is None and "floor" not in absent:
        floor = cell.chain.floor
    obstacles = []
    for k, obstacle in enumerate(settings.obstacle, 1):
        T_base_obstacle = placement(obstacle.stated, f"{where}: [[obstacle]] number {k}")
        obstacles.append(Obstacle(obstacle.name, obstacle.kind, obstacle.size, T_base_obstacle))
    walls = _walls(table.box, f"{where}: collision.box")
    self_collision = "self-collision" not in absent
    unreachable, distance_notes = _never_act(table, obstacles, walls, cell, where)
    model_with = partial(_model, cell, source, table, obstacles, walls, self_collision)
    with refused_as(UsageError, RobotError, f"{where}: {{}}"):
        try:
            model, shapes, notes, unchecked = model_with(floor)
        except RobotError:
            if floor is None or table.floor is not None:
                raise
            # the default floor does not hold for an arm that hangs or stands elsewhere
            model, shapes, notes, unchecked = model_with(None)
            notes = (*notes, f"floor NOT checked: all postures reach below {floor:g} m; set its height in [collision]")
            floor = None
    if model.excluded:
        pairs = listing((" with ".join(pair) for pair in model.excluded), LISTED_NAMES)
        unchecked = (*unchecked, f"collision of {pairs} (their shapes touch in nearly all postures)")

    checked = []
    if self_collision:
        checked.append(f"self-collision ({shapes})")
    if floor is not None and "floor" not in unreachable:
        checked.append(f"floor at {floor:g} m")
    if any(wall.name not in unreachable for wall in walls):
        checked.append("walls of the cell")
    checked += [f"obstacle {obstacle.name}" for obstacle in obstacles if obstacle.name not in unreachable]
    if checked:
        checked[-1] += f", {1e3 * table.margin:g} mm clearance each"
    return model, tuple(checked), (*notes, *distance_notes), unchecked if self_collision else ()


def _never_act(
    table: CollisionTable, obstacles: Sequence[Obstacle], walls: Sequence[Wall], cell: Installation, where: str
) -> tuple[set[str], tuple[str, ...]]:
    """Return the names of walls and obstacles that the arm cannot reach, and one note on each.

    Args:
        table: table ``[collision]`` of the constraints file.
        obstacles: the obstacles.
        walls: floor and walls.
        cell: the arm with its targets.
        where: name of the constraints file for messages.

    Raises:
        UsageError: for a wall or obstacle further away than `MAX_REACHES` times the arm's reach, and for a link radius
            above the reach.
    """
    strokes = [max(-joint.lower, joint.upper) for joint in cell.chain.joints if joint.unit == "m"]
    reach = cell.reach + sum(strokes)
    if table.radius is not None and table.radius > reach:
        raise UsageError(
            f"{where}: collision.radius: links of radius {table.radius:g} m in an arm of {reach:.3g} m reach; "
            "is it in mm?"
        )
    base = np.zeros((1, 3))
    distances = {}
    if table.floor is not None:
        distances["floor"] = -table.floor
    for wall in walls:
        distances[wall.name] = -wall.offset
    for obstacle in obstacles:
        distances[obstacle.name] = float(signed_distance(obstacle, base)[0][0])
    unreachable = {name: distance for name, distance in distances.items() if distance > BODY * reach + table.margin}
    notes = []
    for name, distance in unreachable.items():
        note = (
            f"{name}: {distance:.3g} m from the base, but the arm reaches {reach:.3g} m, so it has no effect; "
            "is it in mm?"
        )
        require(distance <= MAX_REACHES * reach, f"{where}: {note} Give lengths in m", UsageError)
        notes.append(note)
    return set(unreachable), tuple(notes)


def _model(
    cell: Installation,
    source: Path | None,
    table: CollisionTable,
    obstacles: Sequence[Obstacle],
    walls: Sequence[Wall],
    self_collision: bool,
    floor: float | None,
) -> tuple[DistanceModel, str, tuple[str, ...], tuple[str, ...]]:
    """Return the collision model, a text on the link shapes, notes, and the links that the model does not contain.

    Args:
        cell: the arm with its targets.
        source: the robot's file, with collision shapes if it is a URDF; None: no file.
        table: table ``[collision]`` of the constraints file.
        obstacles: the obstacles.
        walls: floor and walls.
        self_collision: whether collisions between links are checked.
        floor: height of the floor in the arm's base frame [m]; None: no floor.
    """
    from calib.robot import capsules, collision
    from calib.robot.beside import links_beside

    chain = cell.chain
    notes: tuple[str, ...] = ()
    links = links_of(chain, source) if table.ignored else ()
    for pair in table.ignored:
        for name in pair:
            one_of(name, links, "collision.ignored: link", RobotError)
    posture = _posture(table.posture, chain, source)
    posture_name = "the stated posture" if posture else "zero of their joints"
    common: FieldValues = {
        "walls": walls,
        "targets": cell.tools[:, :3, 3],
        "margin": table.margin,
        "within": self_collision,
        "ignored": {frozenset(pair) for pair in table.ignored},
    }
    has_shapes = source is not None and is_urdf(source) and "<collision" in text(source)[0]
    if has_shapes and not installed("pinocchio"):
        notes = (f"capsules are used as link shapes, not those of the URDF; {lacking('pinocchio')}",)
    elif source is not None and has_shapes:
        try:
            model = collision.from_urdf(source, chain.base, chain.tip, floor, obstacles, posture=posture, **common)
            if model.missing:
                meshes = ", ".join(model.missing[:LISTED_MESHES])
                notes = (f"collision meshes not found, their shapes are not checked: {meshes}",)
            links_outside = links_beside(text(source)[0], str(source), chain)
            bare = [link.name for link in links_outside if link.name not in model.links]
            unchecked: tuple[str, ...] = ()
            if bare:
                unchecked = (f"{listing(bare, LISTED_NAMES)} (not in the arm, without collision shapes)",)
            return model, f"the URDF's collision shapes, links outside the arm at {posture_name}", notes, unchecked
        except RobotError as error:
            if "no usable <collision> shape" not in str(error):
                raise
            notes = (f"{error.args[0].partition(';')[0]}: capsules are used as link shapes",)

    radius = table.radius
    if radius is None:
        radius = capsules.usual_radius(chain)
    urdf = _description(source, chain)
    unchecked = ()
    beside = ()
    if urdf is not None:
        beside = links_beside(text(urdf)[0], str(urdf), chain, posture)
    elif chain.links:
        unchecked = ("links outside the arm (the URDF is not at hand)",)
    model = capsules.from_chain(chain, radius, floor, obstacles, beside=beside, **common)
    shapes = f"capsules of radius {radius:g} m"
    if beside:
        names = listing((link.name for link in beside), LISTED_NAMES)
        shapes += f"; outside the arm, at {posture_name}: {names}"
    return model, shapes, notes, unchecked


def _posture(values: Mapping[str, object], chain: Chain, source: Path | None) -> dict[str, float]:
    """Return the joint values [rad or m] of joints outside the arm: joint name -> value.

    Args:
        values: joint name -> value in the constraints file; joints that it does not name are at zero.
        chain: the arm.
        source: the robot's file; None: no file.

    Raises:
        RobotError: for a joint of the arm, or a joint that is not in the robot's URDF.
    """
    if not values:
        return {}
    urdf = _description(source, chain)
    if urdf is None:
        raise RobotError("collision.posture: the links outside the arm are not known; give the URDF as the robot")
    joints = read_tree(text(urdf)[0], str(urdf)).joints
    actuated = [joint.name for joint in joints.values() if joint.actuated]
    outside_joints = [name for name in actuated if name not in chain.joint_names]
    posture: dict[str, float] = {}
    for name, value in values.items():
        one_of(name, outside_joints, "collision.posture: joint outside the arm", RobotError)
        quantity = "length" if joints[name].kind == "prismatic" else "angle"
        posture[name] = number(value, f"collision.posture: {name}", quantity)
    return posture


def _description(source: Path | None, chain: Chain) -> Path | None:
    """Return the path of the arm's URDF; None if it is not found.

    It is the source itself, or the URDF from which a fit's ``robot.toml`` was made. The URDF of a fit is searched at
    the path stored in ``robot.toml`` and in the session's folder.

    Args:
        source: the robot's file; None: no file.
        chain: the arm, whose links the URDF must contain.
    """
    if source is None or is_urdf(source):
        return source
    if source.suffix != ".toml" or not source.is_file():
        return None
    robot = load_table(source).get("provenance", {}).get("robot", "")
    if not robot:
        return None
    for path in (Path(robot), source.parent.parent / "1-robot" / Path(robot).name):
        if not path.is_file() or not is_urdf(path):
            continue
        if {chain.base, chain.tip} <= set(links_of(chain, path)):
            return path
    return None


def _walls(box: tuple[tuple[object, object], ...] | None, where: str) -> list[Wall]:
    """Return the two walls perpendicular to each axis of a box; an empty list without a box.

    Args:
        box: ranges along x, y and z in the arm's base frame [m]; None: no box.
        where: name of the box for messages.
    """
    walls = []
    for axis, normal, span in zip("xyz", np.eye(3), box or ()):
        low, high = _span(span, f"{where}: {axis}", "length")
        walls += [Wall(f"wall -{axis}", normal, low), Wall(f"wall +{axis}", -normal, -high)]
    return walls
