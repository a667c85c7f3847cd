"""The limits file of excitation: where the arm may go, how fast, and with which torques.

TOML; every table is optional. ``without``, ``[joints]``, ``[target]`` (height, axis_distance, reach, of the tip),
``[collision]`` and ``[[obstacle]]`` are those of pose selection (`calib.procedure.measuring.constraints_file`), and so
is what is kept where nothing is stated: self-collision, the floor, a margin to the joint limits. A plan through stated
waypoints keeps what is stated only. Besides, per joint or ``all``::

    [velocity]                       # moduli; default the robot's own
    q1 = "90 deg/s"
    share = 0.9                      # of the limits, those of the robot included
    [acceleration]                   # default: where no torque limit counts, 2/s times the speed limit; none of plans
    all = 8.0
    [jerk]                           # moduli; default: no limit
    all = 100.0
    [torque]                         # default the robot's effort limits
    margin = 0.1                     # a share of the limits that stays free
    deviations = 2.0                 # standard deviations of the predicted torque, where the model has a covariance
    [friction]                       # where there is no identified model
    Fv = [14.4, 15.3, 6.55, 11.0, 4.29, 2.26, 1.6]  # viscous, per joint [N m s/rad]
    Fc = [11.9, 11.5, 8.98, 8.35, 8.31, 4.72, 6.04]  # Coulomb, per joint [N m]
    [noise]                          # standard deviation of a torque's error that no parameter explains [N m or N],
                                     # where there is no identified model; weighs the rows; default 1 % of the limit
    q1 = 2.5
    [[point]]                        # a named point, which keeps [target]'s height and axis_distance
    name = "elbow"                   # for messages
    joint = 4                        # of the link behind this joint, or 0: of the tip
    xyz = [0.0, 0.0, 0.0]            # in the frame behind the joint
    [frequency]
    resonance = "5 Hz"               # the smallest resonance: all frequencies of the motion stay below
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

import numpy as np

from calib.config import Tables, check_keys, read, strict
from calib.config_types import Name, NotNegative, Numeric, Real, Spread, Whole, number
from calib.errors import UsageError, require
from calib.geometry.observability import targets_of
from calib.poses.space import PoseConstraint
from calib.procedure.measuring.constraints_file import DEFAULTS, ConstraintsFile, Point
from calib.procedure.measuring.pose_limits import Limits, limits_of, tables_of
from calib.robot.chain import Chain, Joint
from calib.robot.description import impossible_bodies
from calib.robot.kinematics import joint_frames, joint_jacobian, sweep
from calib.trajectories.basis import SampledMotion
from calib.trajectories.constraints import BoxLimit, MotionConstraint, box_limits
from calib.trajectories.errors import NothingFeasible
from calib.trajectories.setpoints import Setpoints
from calib.trajectories.workspace_limits import Clearance, Workspace
from calib.units import motion_units

# [rad or m, s, N m or N] a number above is no limit of a joint; direct drives of fast robots reach 1300 (our choice)
MAX = {"velocity": 100.0, "acceleration": 3000.0, "torque": 1e5, "effort": 1e5}
EXAMPLES = {"velocity": '[velocity] all = "90 deg/s"', "acceleration": "[acceleration] all = 5.0"}
# of a limit, by which a written sample may exceed it: rounding to whole samples
MAX_EXCESS = 0.01
# of the torque limits: error that no parameter explains, where nothing is stated (our choice)
DEFAULT_NOISE = 0.01
# [1/s] default acceleration limit over the speed limit: full speed in half a second (our choice)
DEFAULT_RISE = 2.0
DEFAULT_ORIGIN = f"default, {DEFAULT_RISE:g}/s times the speed limit, since none is stated"
# standard deviations of the predicted torque that are kept from its limit by default (our choice)
DEFAULT_DEVIATIONS = 2.0
PLACE = "in the limits file (--limits, or [dynamics] limits in session.toml)"
# keys of [torque] that are no joint's
MARGINS = ("margin", "deviations")
# tables of the limits file by the name of the constraint
STATED_IN = {
    "position": "[joints]",
    "velocity": "[velocity]",
    "acceleration": "[acceleration]",
    "jerk": "[jerk]",
    "torque": "[torque] (a joint's, or margin)",
    "workspace": "[target] (height, axis_distance) and [[point]]",
    "clearance": "[collision] (margin, radius, floor) and [[obstacle]]",
}
# constraints of pose selection that `trajectories.workspace_limits.Workspace` keeps
OF_WORKSPACE = ("height", "distance from the axis")


@dataclass(frozen=True, eq=False)
class MotionBounds:
    """Limits (n,) on the magnitudes of a motion's velocity, acceleration and torque; infinite: not limited.

    Attributes:
        robot: the robot's file or name, for messages.
        joints: the n joints.
        velocity, acceleration: [rad/s or m/s], [rad/s² or m/s²].
        torque: [N m or N] if a model predicts torques; otherwise infinite.
        origin: ``velocity``, ``acceleration`` or ``torque`` -> name of the file that states the limits.
        place: text for messages on where a user can state missing limits, with {} for an example.

    Raises:
        UsageError: if joints have no limit; the message names the joints, and the limits to state.
    """

    robot: str
    joints: tuple[Joint, ...]
    velocity: np.ndarray
    acceleration: np.ndarray
    torque: np.ndarray
    origin: Mapping[str, str]
    place: str = f"{PLACE}, such as {{}}"

    def __post_init__(self) -> None:
        self._require("velocity", {"velocity": self.velocity}, "speed", "")
        self._require(
            "acceleration",
            {"acceleration": self.acceleration, "effort": self.torque},
            "acceleration",
            "; limits of effort are used only where masses are known or a model is named (--model)",
        )

    def _require(self, example: str, limits: Mapping[str, np.ndarray], quantity: str, hint: str) -> None:
        """Check that each joint has at least one of the given limits.

        Args:
            example: kind of limit of which the message shows an example.
            limits: kind of limit -> values (n,).
            quantity: name of the limited quantity for the message.
            hint: text at the end of the message.

        Raises:
            UsageError: if a joint has none of the limits; the message names the joints, and the limits to state.
        """
        unlimited = np.all([sizes > MAX[kind] for kind, sizes in limits.items()], axis=0)
        if not unlimited.any():
            return
        joints = [joint for joint, is_unlimited in zip(self.joints, unlimited) if is_unlimited]
        # numbers that are stated, and too large for a limit
        numbers: list[str] = []
        for joint in joints:
            numbers += joint.unstated
        for kind, sizes in limits.items():
            numbers += [f"{kind} {size:g}" for size in sizes[unlimited] if np.isfinite(size)]
        wrong = [number for number in dict.fromkeys(numbers) if number.split()[0] in limits]
        remark = f" ({', '.join(wrong)} is not a limit)" if wrong else ""
        raise UsageError(
            f"{self.robot}: no limit for the {quantity} of {self._named(joints)}{remark}; without it no motion "
            f"is written; state it {self.place.format(EXAMPLES[example])}{hint}"
        )

    def _named(self, joints: Sequence[Joint]) -> str:
        """Return the names of joints as text; ``all joints`` if these are all joints of the robot."""
        if len(joints) == len(self.joints):
            return "all joints"
        return ", ".join(joint.name for joint in joints)

    def lines(self) -> list[str]:
        """Return lines of text for file headers that state the limits of velocity, acceleration and torque."""
        lines = []
        limits = {"velocity": self.velocity, "acceleration": self.acceleration, "torque": self.torque}
        for order, (kind, sizes) in enumerate(limits.items(), 1):
            joints_by_size: dict[str, list[Joint]] = {}
            for joint, size in zip(self.joints, sizes):
                text = "none"
                if size <= MAX[kind]:
                    text = f"{size:.4g} {motion_units([joint.kind])[order]}"
                joints_by_size.setdefault(text, []).append(joint)
            if [*joints_by_size] == ["none"]:
                lines.append(f"{kind} limits: none")
                continue
            parts = [f"{text} {self._named(joints)}" for text, joints in joints_by_size.items()]
            lines.append(f"{kind} limits: {'; '.join(parts)} ({self.origin[kind]})")
        return lines

    def check(self, track: Setpoints) -> None:
        """Check that setpoints respect the limits of velocity and acceleration, and `MAX`.

        `MAX` is a value that no real joint reaches. It matters if light links and high torque limits would allow
        accelerations that no robot reaches.

        Args:
            track: the setpoints.

        Raises:
            UsageError: for a violated limit; the message names the joint and the limit.
        """
        self._check("velocity", np.abs(track.v).max(axis=0), self.velocity)
        self._check("acceleration", np.abs(track.a).max(axis=0), self.acceleration)

    def _check(self, kind: str, peak: np.ndarray, limit: np.ndarray) -> None:
        """Raise a UsageError if the velocity or acceleration of a joint exceeds its limit.

        Args:
            kind: ``velocity`` or ``acceleration``.
            peak: (n,) largest values of the motion.
            limit: (n,) limits.
        """
        limit = np.minimum(limit, MAX[kind])
        j = int(np.argmax(peak / limit))
        if not peak[j] <= (1.0 + MAX_EXCESS) * limit[j]:
            raise UsageError(
                f"{self.robot}: the {kind} of {self.joints[j].name} reaches {peak[j]:.4g} in this motion, above "
                f"{limit[j]:.4g}, so the motion is not written; state a limit {self.place.format(EXAMPLES[kind])}"
            )


@strict
@dataclass(frozen=True)
class PointTable:
    """Entry ``[[point]]`` of the limits file; the module's docstring explains the keys."""

    name: Name
    joint: Annotated[int, Whole()] = 0
    xyz: Point = (0.0, 0.0, 0.0)


@strict
@dataclass(frozen=True)
class FrictionTable:
    """Table ``[friction]`` of the limits file; the module's docstring explains the keys."""

    Fv: Annotated[tuple[NotNegative, ...], Spread()] | None = None
    Fc: Annotated[tuple[NotNegative, ...], Spread()] | None = None


@strict
@dataclass(frozen=True)
class FrequencyTable:
    """Table ``[frequency]`` of the limits file; the module's docstring explains the keys."""

    resonance: Annotated[float, Real(above=0, quantity="frequency")] | None = None


@strict
@dataclass(frozen=True)
class LimitsFile(ConstraintsFile):
    """The content of a limits file; values per joint are in the joint's units (rad or m, s, N m or N)."""

    velocity: Mapping[str, Numeric] = field(default_factory=dict)
    acceleration: Mapping[str, Numeric] = field(default_factory=dict)
    jerk: Mapping[str, Numeric] = field(default_factory=dict)
    torque: Mapping[str, Numeric] = field(default_factory=dict)
    friction: FrictionTable | None = None
    noise: Mapping[str, Numeric] = field(default_factory=dict)
    point: tuple[PointTable, ...] = ()
    frequency: FrequencyTable = field(default_factory=FrequencyTable)


@dataclass(frozen=True, eq=False)
class MotionLimits:
    """Limits of a motion: constraints, bounds and torque limits of each joint, and friction if stated.

    Attributes:
        constraints: all constraints except those on torques.
        bounds: limits of each joint's velocity, acceleration and torque.
        torque: (n,) torque limits [N m or N], even if no model predicts torques; infinite: not limited.
        margin: share of the torque limits that stays free; None if the file does not state it.
        deviations: number of standard deviations of the predicted torque that stay free.
        friction: (2, n) viscous Fv and Coulomb Fc; None if the file does not state them.
        resonance: smallest resonance frequency [rad/s]; None if the file does not state it.
        notes: remarks for the user.
        noise: (n,) standard deviation of the torque errors [N m or N]; None if the file does not state it.
    """

    constraints: tuple[MotionConstraint, ...]
    bounds: MotionBounds
    torque: np.ndarray
    margin: float | None
    deviations: float
    friction: np.ndarray | None
    resonance: float | None
    notes: tuple[str, ...]
    noise: np.ndarray | None = None

    @property
    def positions(self) -> BoxLimit:
        """Limits of the joint positions [rad or m]; infinite: not limited."""
        for constraint in self.constraints:
            if isinstance(constraint, BoxLimit) and constraint.order == 0:
                return constraint
        unlimited = np.full(len(self.torque), np.inf)
        return BoxLimit(0, -unlimited, unlimited)

    def narrowed(self, ranges: Sequence[tuple[np.ndarray, np.ndarray]]) -> "MotionLimits":
        """Return the limits, with position, velocity and acceleration also limited to the range of another motion.

        Joints that do not move in the other motion are not limited further.

        Args:
            ranges: smallest and largest values (n,) of q, v and a in the other motion.
        """
        boxes = []
        for order, (low, high) in enumerate(ranges):
            lower, upper = np.where(low < high, [low, high], [[-np.inf], [np.inf]])
            boxes.append(BoxLimit(order, lower, upper))
        return replace(self, constraints=(*self.constraints, *boxes))

    def broken(self, motion: SampledMotion) -> Iterator[tuple[MotionConstraint, str, int]]:
        """Yield each violated constraint with a message and the index of the worst of N sampled states.

        Joint limits are not checked.

        Args:
            motion: N sampled states of the motion.
        """
        for limit in self.constraints:
            if isinstance(limit, BoxLimit):
                continue
            values = limit.values(motion)
            state, column = (int(index) for index in np.unravel_index(np.argmax(values), values.shape))
            excess = values[state, column]
            if excess > 0:
                message = f"{limit.name} ({limit.labels[column]}) is violated by {excess:.3g} {limit.unit}"
                yield limit, message, state


def read_motion_limits(
    tables: Tables | None, chain: Chain, source: Path | None = None, stated_path: bool = False, predicted: bool = False
) -> MotionLimits:
    """Return the limits of a motion from the limits file and the robot; defaults are those of pose selection.

    Args:
        tables: the limits file, or its content as tables; None: only the robot's limits and the defaults.
        chain: the arm.
        source: the robot's file, from which collision shapes are read; None: no file.
        stated_path: whether the user states the path. Then only stated limits are used, since default capsules and a
            default floor should not forbid a path that the user knows to be free.
        predicted: whether an identified model predicts torques, so that torque limits apply; they also apply if the
            masses in the robot's description are known.

    Raises:
        UsageError: for an unknown key or an invalid value, and if a joint has no velocity limit, or neither an
            acceleration nor a torque limit (`MotionBounds`).
    """
    settings, where = read(LimitsFile, *tables_of(tables, chain, source, "limits"))
    without = ()
    if stated_path:
        without = ("joint-margin", "floor") if settings.collision or settings.obstacle else DEFAULTS
    pose_limits = limits_of(settings, targets_of(chain), source, where, without, measured=False)

    speeds = np.array([joint.velocity for joint in chain.joints])
    efforts = np.array([joint.effort for joint in chain.joints])
    velocity = _per_joint(settings.velocity, f"{where}: velocity", chain, speeds, ("angular speed", "speed"))
    acceleration = _per_joint(settings.acceleration, f"{where}: acceleration", chain)
    jerk = _per_joint(settings.jerk, f"{where}: jerk", chain)
    joint_torques = {key: value for key, value in settings.torque.items() if key not in MARGINS}
    torque = _per_joint(joint_torques, f"{where}: torque", chain, efforts, ("torque", "force"))
    # without masses no torque is predicted that a limit could hold against
    counted_torque = torque
    if not predicted and chain.inertias is None:
        counted_torque = np.full(chain.n, np.inf)
    sizes = velocity, acceleration, counted_torque
    bounds = _bounds(chain, str(source or chain.name), settings, where, sizes, default=not stated_path)

    margin, deviations = _torque_margins(settings.torque, where)
    noise = None
    if settings.noise:
        noise = _torque_noise(settings.noise, chain, torque, where)
    points = _points(settings.point, chain, where)
    friction = _friction(settings.friction, chain, where)
    linear = [joint.kind == "prismatic" for joint in chain.joints]
    boxes = box_limits(pose_limits.lower, pose_limits.upper, velocity, bounds.acceleration, jerk, linear=linear)
    clearances, collision_notes = _clearances(pose_limits)
    return MotionLimits(
        constraints=(*boxes, *_position_constraints(settings, pose_limits, points), *clearances),
        bounds=bounds,
        torque=torque,
        margin=margin,
        deviations=deviations,
        friction=friction,
        resonance=settings.frequency.resonance,
        notes=(*pose_limits.notes, *collision_notes),
        noise=noise,
    )


def _torque_margins(table: Mapping[str, Numeric], where: str) -> tuple[float | None, float]:
    """Return the share of the torque limits that stays free (None if not stated), and the number of σ that stay free.

    Args:
        table: torque table of the limits file.
        where: name of the limits file for messages.

    Raises:
        UsageError: for values out of range.
    """
    margin = None
    if "margin" in table:
        margin = number(table["margin"], f"{where}: torque.margin")
    if margin is not None and not 0.0 <= margin < 1.0:
        raise UsageError(f"{where}: torque.margin: expected a share of the limit, from 0 to below 1, found {margin:g}")
    deviations = number(table.get("deviations", DEFAULT_DEVIATIONS), f"{where}: torque.deviations")
    if not 0.0 <= deviations < np.inf:
        raise UsageError(f"{where}: torque.deviations: expected 0 or more, found {deviations:g}")
    return margin, deviations


def _torque_noise(table: Mapping[str, Numeric], chain: Chain, torque: np.ndarray, where: str) -> np.ndarray:
    """Return the standard deviations (n,) of the torque errors [N m or N]; by default a share of the largest torques.

    Args:
        table: noise table of the limits file.
        chain: the arm.
        torque: (n,) torque limits [N m or N].
        where: name of the limits file for messages.

    Raises:
        UsageError: for values that are not above 0.
    """
    noise = _per_joint(table, f"{where}: noise", chain, None, ("torque", "force"))
    noise = np.where(np.isfinite(noise), noise, DEFAULT_NOISE * torque)
    require((noise > 0.0).all(), f"{where}: noise: expected standard deviations above 0", UsageError)
    return noise


def _clearances(limits: Limits) -> tuple[list[MotionConstraint], list[str]]:
    """Return the constraint on the distances of bodies, and notes on what is checked.

    Args:
        limits: limits of the poses, with their collision model.
    """
    collision = limits.collision
    if collision is None:
        return [], [
            "collisions and floor are NOT checked: state [collision], with floor = … at least, in a limits file"
        ]
    pairs = tuple(f"{link} - {obstacle}" for link, obstacle in collision.pairs)
    notes = []
    if limits.checked:
        notes.append(f"respected: {', '.join(limits.checked)}")
    if limits.unchecked:
        notes.append(f"NOT checked: {', '.join(limits.unchecked)}")
    return [Clearance(collision.distances, collision.gradients, pairs, limits.clearance)], notes


def located(error: NothingFeasible) -> NothingFeasible:
    """Return the error with a longer message, which names the table of the limits file with the violated limit."""
    if error.constraint not in STATED_IN:
        return error
    advice = f"the limit is that of {STATED_IN[error.constraint]} {PLACE}"
    return NothingFeasible(f"{error}; {advice}", error.constraint, error.excess, error.unit)


def check_bodies(chain: Chain, torque: np.ndarray) -> None:
    """Check that masses and inertias in the robot's description are physically consistent, if torques are limited.

    Args:
        chain: the arm.
        torque: (n,) torque limits [N m or N]; infinite: not limited.

    Raises:
        UsageError: for inconsistent bodies; the message names them.
    """
    if not np.isfinite(torque).any():
        return
    wrong = impossible_bodies(chain)
    if wrong:
        raise UsageError(
            f"robot '{chain.name}': {'; '.join(wrong)}: torques predicted with them are wrong; correct the "
            "masses in the robot's file, or name an identified model (--model)"
        )


def _bounds(
    chain: Chain, robot: str, settings: LimitsFile, path: str, sizes: Sequence[np.ndarray], default: bool
) -> MotionBounds:
    """Return the bounds of velocity, acceleration and torque.

    Args:
        chain: the arm.
        robot: the robot's name for messages.
        settings: content of the limits file.
        path: name of the limits file for messages.
        sizes: largest velocities, accelerations and torques, each (n,).
        default: whether joints without a limit of acceleration and torque get a default limit of acceleration.
    """
    velocity, acceleration, torque = sizes
    origin = {"acceleration": path}
    for kind, table in (("velocity", settings.velocity), ("torque", settings.torque)):
        origin[kind] = f"robot description, {path}" if table else "robot description"
    unlimited = (acceleration > MAX["acceleration"]) & (torque > MAX["torque"])
    if default and unlimited.any():
        origin["acceleration"] = f"{path}, or {DEFAULT_ORIGIN}"
        if np.isinf(acceleration).all():
            origin["acceleration"] = DEFAULT_ORIGIN
        acceleration = np.where(unlimited, DEFAULT_RISE * velocity, acceleration)
    return MotionBounds(robot, chain.joints, velocity, acceleration, torque, origin)


@dataclass(frozen=True, eq=False)
class Points:
    """Named points of links: function of joint values q (N, n) with positions (N, k, 3) [m] in the base frame.

    Attributes:
        chain: the arm.
        joints: for each of k points, the number (from 1) of the joint behind which it is fixed; 0: fixed to the tip.
        places: (k, 3) coordinates of the points in the frames behind these joints [m].
    """

    chain: Chain
    joints: tuple[int, ...]
    places: np.ndarray

    def __call__(self, q: np.ndarray) -> np.ndarray:
        return self._positions(q, sweep(self.chain, q).poses())

    def product(self, q: np.ndarray, G: np.ndarray) -> np.ndarray:
        """Return the gradient (N, n) of Σ G · points with respect to q (N, n), for weights G (N, k, 3)."""
        kinematics = sweep(self.chain, q)
        points = self._positions(q, kinematics.poses())
        gradient = np.zeros(q.shape)
        for k, joint in enumerate(self.joints):
            element = None
            if joint:
                element = int(self.chain.moving[joint - 1]) + 1
            point = np.ascontiguousarray(points[:, k].T)
            jacobian = joint_jacobian(self.chain, kinematics, point, element)
            gradient += np.einsum("min,mi->mn", jacobian[:, :3], G[:, k])
        return gradient

    def _positions(self, q: np.ndarray, tip: np.ndarray) -> np.ndarray:
        frames = tip[None]
        if any(self.joints):
            frames = joint_frames(self.chain, q)
        points = []
        for joint, position in zip(self.joints, self.places):
            frame = frames[joint - 1] if joint else tip
            points.append(frame[:, :3, :3] @ position + frame[:, :3, 3])
        return np.stack(points, axis=1)


@dataclass(frozen=True, eq=False)
class _PoseLimit:
    """A constraint of pose selection that is applied to each sampled posture of a motion.

    Attributes:
        of: the constraint, with k values per posture.
        name: its name in messages.
        labels: (k,) names of the values.
        scale: (k,) numbers [unit] by which values are divided to compare different constraints.
        groups: (k,) group number of each value; the optimiser gets one smooth function per group.
        unit: unit of the values.
    """

    of: PoseConstraint
    name: str
    labels: tuple[str, ...]
    scale: np.ndarray
    groups: np.ndarray
    unit: str = ""

    def values(self, motion: SampledMotion) -> np.ndarray:
        return np.asarray(self.of.function(motion.q), dtype=float)

    def slopes(self, motion: SampledMotion, weights: np.ndarray) -> np.ndarray:
        from calib.poses.space import constraint_gradient

        result = np.zeros((4, *motion.q.shape))
        result[0] = np.einsum("mk,mkn->mn", weights, constraint_gradient(self.of, motion.q))
        return result


def _position_constraints(settings: LimitsFile, pose_limits: Limits, points: Points) -> list[MotionConstraint]:
    """Return constraints on the workspace of tip and named points, and all other constraints of pose selection.

    Args:
        settings: content of the limits file.
        pose_limits: limits of pose selection.
        points: the named points.
    """
    constraints: list[MotionConstraint] = []
    radius = settings.target.axis_distance
    lowest, highest = settings.target.heights
    if radius is not None or lowest is not None:
        names = ("tool", *(point.name for point in settings.point))
        constraints.append(Workspace(points, points.product, names, radius, lowest, highest))
    posture = np.zeros((1, len(pose_limits.lower)))
    for constraint in pose_limits.constraints:
        if constraint.name in OF_WORKSPACE:
            continue
        count = np.asarray(constraint.function(posture)).shape[1]
        labels = tuple(f"{constraint.name} {j + 1}" for j in range(count))
        constraints.append(_PoseLimit(constraint, constraint.name, labels, np.ones(count), np.arange(count)))
    return constraints


def _per_joint(
    values: Mapping[str, object],
    where: str,
    chain: Chain,
    default: np.ndarray | None = None,
    quantities: tuple[str, str] = ("", ""),
) -> np.ndarray:
    """Return limits (n,) from a table with the keys joint name, q1 …, ``all``, ``share``; infinite if not stated.

    Args:
        values: the table.
        where: name of the table for messages.
        chain: the arm.
        default: (n,) limits of joints that the table does not name; None: infinite.
        quantities: physical quantity of a revolute joint's limit, and of a prismatic joint's limit.

    Raises:
        UsageError: for an unknown key or an invalid value.
    """
    index = {f"q{j + 1}": j for j in range(chain.n)}
    index |= {name: j for j, name in enumerate(chain.joint_names)}
    further_keys = MARGINS if where.endswith("torque") else ()
    check_keys(values, ("all", "share", *further_keys, *index), where)
    bounds = np.full(chain.n, np.inf)
    if default is not None:
        bounds = default.copy()
    for name, written in values.items():
        if name == "share":
            continue
        joints = range(chain.n) if name == "all" else [index[name]]
        for j in joints:
            quantity = quantities[chain.joints[j].kind != "revolute"]
            limit = number(written, f"{where}.{name}", quantity)
            # a file narrows the robot's own limits only
            bounds[j] = limit if default is None else min(limit, bounds[j])
    share = number(values.get("share", 1.0), f"{where}.share")
    if not 0 < share <= 1:
        raise UsageError(f"{where}.share: expected a share of the limits above 0 and up to 1, found {share:g}")
    return bounds * share


def _points(tables: Sequence[PointTable], chain: Chain, where: str) -> Points:
    for k, point in enumerate(tables, 1):
        if point.joint > chain.n:
            raise UsageError(f"{where}: [[point]] number {k}.joint: expected a joint from 1 to {chain.n} (0: the tip)")
    joints = (0, *(point.joint for point in tables))
    positions = [(0.0, 0.0, 0.0), *(point.xyz for point in tables)]
    return Points(chain, joints, np.array(positions))


def _friction(table: FrictionTable | None, chain: Chain, where: str) -> np.ndarray | None:
    if table is None:
        return None
    result = []
    for key, coefficients in (("Fv", table.Fv), ("Fc", table.Fc)):
        joint_values = coefficients or (0.0,) * chain.n
        if len(joint_values) not in (1, chain.n):
            raise UsageError(
                f"{where}: friction.{key}: {len(joint_values)} values for {chain.n} joints: state one per joint"
            )
        result.append(np.broadcast_to(np.array(joint_values), (chain.n,)))
    return np.array(result)
