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

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

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
from calib.trajectories.places import Clearance, Workspace
from calib.trajectories.setpoints import Setpoints
from calib.units import motion_units

# [rad or m, s, N m or N] a number above is no limit of a joint; direct drives of fast robots reach 1300 (our choice)
MAX = {"velocity": 100.0, "acceleration": 3000.0, "torque": 1e5, "effort": 1e5}
EXAMPLES = {"velocity": '[velocity] all = "90 deg/s"', "acceleration": "[acceleration] all = 5.0"}
MAX_EXCESS = 0.01  # of a limit, by which a written sample may be beyond it: rounding to whole samples
DEFAULT_NOISE = 0.01  # of the torque limits: what no parameter explains, where nothing is stated (our choice)
DEFAULT_RISE = 2.0  # [1/s] default acceleration limit over the speed limit: full speed in half a second (our choice)
DEFAULT_ORIGIN = f"default, {DEFAULT_RISE:g}/s times the speed limit, since none is stated"
PLACE = "in the limits file (--limits, or [dynamics] limits in session.toml)"


@dataclass(frozen=True, eq=False)
class MotionBounds:
    """Limits (n,) of a motion's speed, acceleration and torque magnitudes; infinite: not limited.

    Attributes:
        robot: its file or name, for messages; joints: n of them.
        velocity, acceleration: [rad/s or m/s, and per s].
        torque: [N m or N], where a model predicts torques; else infinite.
        origin: where they are stated, by ``velocity``, ``acceleration`` and ``torque``.
        place: where a user can state what is missing, {} for an example.

    Raises:
        UsageError: naming the joints that nothing limits, and what to state.
    """

    robot: str
    joints: tuple[Joint, ...]
    velocity: np.ndarray
    acceleration: np.ndarray
    torque: np.ndarray
    origin: Mapping[str, str]
    place: str = f"{PLACE}, such as {{}}"

    def __post_init__(self) -> None:
        sizes = {"effort": self.torque, "velocity": self.velocity, "acceleration": self.acceleration}
        for what, kinds in (("velocity", ("velocity",)), ("acceleration", ("acceleration", "effort"))):
            free = np.all([sizes[kind] > MAX[kind] for kind in kinds], axis=0)
            if not free.any():
                continue
            names = self._named(joint for joint, one in zip(self.joints, free) if one)
            written = [words for joint, one in zip(self.joints, free) if one for words in joint.unstated]
            written += [f"{kind} {x:g}" for kind in kinds for x in sizes[kind][free] if np.isfinite(x)]
            wrong = [words for words in dict.fromkeys(written) if words.split()[0] in kinds]
            found = f" ({', '.join(wrong)} is no limit)" if wrong else ""
            speed = what == "velocity"
            other = "" if speed else "; efforts count where masses are known or a model is named (--model)"
            raise UsageError(
                f"{self.robot}: no limit for the {'speed' if speed else what} of {names}{found}; without it no motion "
                f"is written; state it {self.place.format(EXAMPLES[what])}{other}"
            )

    def _named(self, joints: Iterable[Joint]) -> str:
        names = [joint.name for joint in joints]
        return "all joints" if len(names) == len(self.joints) else ", ".join(names)

    def lines(self) -> list[str]:
        """Return the limits as text lines for file headers: velocity, acceleration, torque."""
        result = []
        for order, kind in enumerate(("velocity", "acceleration", "torque"), 1):
            by_size: dict[str, list[Joint]] = {}
            for joint, size in zip(self.joints, getattr(self, kind)):
                words = f"{size:.4g} {motion_units([joint.kind])[order]}" if size <= MAX[kind] else "none"
                by_size.setdefault(words, []).append(joint)
            sizes = "; ".join(f"{words} {self._named(joints)}" for words, joints in by_size.items())
            result.append(f"{kind} limits: " + ("none" if [*by_size] == ["none"] else f"{sizes} ({self.origin[kind]})"))
        return result

    def check(self, track: Setpoints) -> None:
        """Raise an error if a track exceeds its limits of speed or acceleration, or those of any real joint.

        Light links and high torque limits allow accelerations that no robot has.

        Raises:
            UsageError: naming the joint.
        """
        for kind, values in (("velocity", track.v), ("acceleration", track.a)):
            peak, limit = np.abs(values).max(axis=0), np.minimum(getattr(self, kind), MAX[kind])
            j = int(np.argmax(peak / limit))
            if not peak[j] <= (1.0 + MAX_EXCESS) * limit[j]:
                raise UsageError(
                    f"{self.robot}: the {kind} of {self.joints[j].name} reaches {peak[j]:.4g} in this motion, above "
                    f"{limit[j]:.4g}, so the motion is not written; state a limit {self.place.format(EXAMPLES[kind])}"
                )


MARGINS = ("margin", "deviations")  # keys of [torque] that are no joint's
STATED_IN = {
    "position": "[joints]",
    "velocity": "[velocity]",
    "acceleration": "[acceleration]",
    "jerk": "[jerk]",
    "torque": "[torque] (a joint's, or margin)",
    "workspace": "[target] (height, axis_distance) and [[point]]",
    "clearance": "[collision] (margin, radius, floor) and [[obstacle]]",
}
"""Tables of the limits file by the name of the constraint."""


@strict
@dataclass(frozen=True)
class PointTable:
    """Entry ``[[point]]`` of the limits file, see the module."""

    name: Name
    joint: Annotated[int, Whole()] = 0
    xyz: Point = (0.0, 0.0, 0.0)


@strict
@dataclass(frozen=True)
class FrictionTable:
    """Table ``[friction]`` of the limits file, see the module."""

    Fv: Annotated[tuple[NotNegative, ...], Spread()] | None = None
    Fc: Annotated[tuple[NotNegative, ...], Spread()] | None = None


@strict
@dataclass(frozen=True)
class FrequencyTable:
    """Table ``[frequency]`` of the limits file, see the module."""

    resonance: Annotated[float, Real(above=0, quantity="frequency")] | None = None


@strict
@dataclass(frozen=True)
class LimitsFile(ConstraintsFile):
    """The content of a limits file; values per joint are in the unit of the joint."""

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
        constraints: all but torque.
        bounds: of speed, acceleration and torque, each joint's.
        torque: (n,) limits [N m or N], also without a model that predicts torques; infinite: not limited.
        margin, deviations: of the torque limit; `margin` None where the file does not say.
        friction: (2, n) Fv and Fc; None where the file does not say.
        resonance: [rad/s] or None.
        notes: what a user should know.
        noise: (n,) standard deviation of the torques' errors [N m or N]; None where the file does not say.
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
        """The joint position limits; infinite: not limited."""
        free = np.full(len(self.torque), np.inf)
        boxes = (one for one in self.constraints if isinstance(one, BoxLimit) and one.order == 0)
        return next(boxes, BoxLimit(0, -free, free))

    def narrowed(self, ranges: Sequence[tuple[np.ndarray, np.ndarray]]) -> "MotionLimits":
        """Return the limits with those of a motion: least and largest q, v and a (n,), of joints that move."""
        free = (np.where(low < high, [low, high], [[-np.inf], [np.inf]]) for low, high in ranges)
        return replace(self, constraints=(*self.constraints, *(BoxLimit(k, *both) for k, both in enumerate(free))))

    def broken(self, motion: SampledMotion) -> Iterator[tuple[MotionConstraint, str, int]]:
        """Yield (constraint, message, index of the worst of N states) for each violated constraint on positions."""
        for limit in self.constraints:
            if isinstance(limit, BoxLimit):
                continue
            values = limit.values(motion)
            k, column = (int(i) for i in np.unravel_index(np.argmax(values), values.shape))
            if values[k, column] > 0:
                words = f"{limit.name} ({limit.labels[column]}) is violated by {values[k, column]:.3g} {limit.unit}"
                yield limit, words, k


def read_motion_limits(
    given: Tables | None, chain: Chain, source: Path | None = None, given_way: bool = False, predicted: bool = False
) -> MotionLimits:
    """Return the limits of a motion from the limits file and the robot; defaults are those of pose selection.

    Args:
        given: the file, or its tables; None for the robot's own limits and the defaults alone.
        source: the robot's file, for its collision shapes.
        given_way: the motion goes where its user says: what is not stated is not kept, since capsules and a floor that
            we think of should not forbid a way that somebody knows.
        predicted: torques are, by an identified model, so that their limits count; so they do where the chain's masses
            are known.

    Raises:
        UsageError: for an unknown key or a value that a key cannot have, and where nothing limits speeds, or
            accelerations and torques (`MotionBounds`).
    """
    stated, where = read(LimitsFile, *tables_of(given, chain, source, "limits"))
    torque_table = stated.torque
    without = ()
    if given_way:
        without = ("joint-margin", "floor") if stated.collision or stated.obstacle else DEFAULTS
    found = limits_of(stated, targets_of(chain), source, where, without, seen=False)
    speeds, efforts = (np.array([getattr(j, key) for j in chain.joints]) for key in ("velocity", "effort"))
    velocity = _per_joint(stated.velocity, f"{where}: velocity", chain, speeds, ("angular speed", "speed"))
    acceleration = _per_joint(stated.acceleration, f"{where}: acceleration", chain)
    jerk = _per_joint(stated.jerk, f"{where}: jerk", chain)
    amounts = {key: value for key, value in torque_table.items() if key not in MARGINS}
    torque = _per_joint(amounts, f"{where}: torque", chain, efforts, ("torque", "force"))
    counted = torque if predicted or chain.inertias is not None else np.full(chain.n, np.inf)
    sizes = velocity, acceleration, counted
    bounds = _bounds(chain, str(source or chain.name), stated, where, sizes, default=not given_way)
    margin = number(torque_table["margin"], f"{where}: torque.margin") if "margin" in torque_table else None
    if margin is not None and not 0.0 <= margin < 1.0:
        raise UsageError(f"{where}: torque.margin: expected a share of the limit, from 0 to below 1, found {margin:g}")
    deviations = number(torque_table.get("deviations", 2.0), f"{where}: torque.deviations")
    if not 0.0 <= deviations < np.inf:
        raise UsageError(f"{where}: torque.deviations: expected 0 or more, found {deviations:g}")
    noise = None
    if stated.noise:
        noise = _per_joint(stated.noise, f"{where}: noise", chain, None, ("torque", "force"))
        noise = np.where(np.isfinite(noise), noise, DEFAULT_NOISE * torque)
        require((noise > 0.0).all(), f"{where}: noise: expected standard deviations above 0", UsageError)
    points = _points(stated.point, chain, where)
    friction = _friction(stated.friction, chain, where)
    linear = [joint.kind == "prismatic" for joint in chain.joints]
    boxes = box_limits(found.lower, found.upper, velocity, bounds.acceleration, jerk, linear=linear)
    constraints: list[MotionConstraint] = [*boxes]
    constraints += _places(stated, found, points)
    notes = list(found.notes)
    if found.collision is None:
        notes.append(
            "collisions and floor are NOT checked: state [collision], with floor = … at least, in a limits file"
        )
    else:
        names = tuple(f"{one} - {two}" for one, two in found.collision.pairs)
        constraints.append(Clearance(found.collision.distances, found.collision.gradients, names, found.clearance))
        sets = (("kept", found.checked), ("NOT checked", found.unchecked))
        notes += [f"{words}: {', '.join(names)}" for words, names in sets if names]
    return MotionLimits(
        tuple(constraints),
        bounds,
        torque,
        margin,
        deviations,
        friction,
        stated.frequency.resonance,
        tuple(notes),
        noise,
    )


def located(error: NothingFeasible) -> NothingFeasible:
    """Return the error, with the table of the limits file that states the violated limit added to its message."""
    if error.constraint not in STATED_IN:
        return error
    place = f"the limit is that of {STATED_IN[error.constraint]} {PLACE}"
    return NothingFeasible(f"{error}; {place}", error.constraint, error.excess, error.unit)


def check_bodies(chain: Chain, torque: np.ndarray) -> None:
    """Raise an error if torques are limited but the robot's masses or inertias are physically inconsistent.

    Raises:
        UsageError: naming them.
    """
    if np.isfinite(torque).any() and (wrong := impossible_bodies(chain)):
        raise UsageError(
            f"robot '{chain.name}': {'; '.join(wrong)}: torques predicted with them are wrong; correct the "
            "masses in the robot's file, or name an identified model (--model)"
        )


def _bounds(
    chain: Chain, robot: str, stated: LimitsFile, path: str, sizes: Sequence[np.ndarray], default: bool
) -> MotionBounds:
    """Return the bounds of speed, acceleration and torque; an acceleration without limit gets a default limit.

    Args:
        sizes: (n,) largest velocities, accelerations, torques.
    """
    velocity, acceleration, torque = sizes
    tables = {"velocity": stated.velocity, "torque": stated.torque}
    origin = {kind: f"robot description, {path}" if table else "robot description" for kind, table in tables.items()}
    origin["acceleration"] = path
    free = (acceleration > MAX["acceleration"]) & (torque > MAX["torque"])
    if default and free.any():
        origin["acceleration"] = DEFAULT_ORIGIN if np.isinf(acceleration).all() else f"{path}, or {DEFAULT_ORIGIN}"
        acceleration = np.where(free, DEFAULT_RISE * velocity, acceleration)
    return MotionBounds(robot, chain.joints, velocity, acceleration, torque, origin)


@dataclass(frozen=True, eq=False)
class Points:
    """Named points of links: q (N, n) -> (N, k, 3) [m] in the base frame."""

    chain: Chain
    joints: tuple[int, ...]
    places: np.ndarray

    def __call__(self, q: np.ndarray) -> np.ndarray:
        return self._places(q, sweep(self.chain, q).poses())

    def product(self, q: np.ndarray, G: np.ndarray) -> np.ndarray:
        """Return the gradient (N, n) of Σ G · points with respect to q."""
        walked = sweep(self.chain, q)
        points, result = self._places(q, walked.poses()), np.zeros(q.shape)
        for k, joint in enumerate(self.joints):
            behind = int(self.chain.moving[joint - 1]) + 1 if joint else None
            slope = joint_jacobian(self.chain, walked, np.ascontiguousarray(points[:, k].T), behind)
            result += np.einsum("min,mi->mn", slope[:, :3], G[:, k])
        return result

    def _places(self, q: np.ndarray, tip: np.ndarray) -> np.ndarray:
        frames = joint_frames(self.chain, q) if any(self.joints) else tip[None]
        carriers = [frames[j - 1] if j else tip for j in self.joints]
        return np.stack([f[:, :3, :3] @ p + f[:, :3, 3] for f, p in zip(carriers, self.places)], axis=1)


@dataclass(frozen=True, eq=False)
class _PoseLimit:
    """A constraint of pose selection, applied to the postures of a motion."""

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


def _places(stated: LimitsFile, found: Limits, points: Points) -> list[MotionConstraint]:
    """Return the constraints: workspace of the tip and of named points, and all other constraints of poses."""
    radius, (lowest, highest) = stated.target.axis_distance, stated.target.heights
    result: list[MotionConstraint] = []
    if radius is not None or lowest is not None:
        names = ("tool", *(one.name for one in stated.point))
        result.append(Workspace(points, points.product, names, radius, lowest, highest))
    others = [one for one in found.constraints if one.name not in ("height", "distance from the axis")]
    still = np.zeros((1, len(found.lower)))
    for one in others:
        k = np.asarray(one.function(still)).shape[1]
        labels = tuple(f"{one.name} {j + 1}" for j in range(k))
        result.append(_PoseLimit(one, one.name, labels, np.ones(k), np.arange(k)))
    return result


def _per_joint(
    stated: Mapping[str, Any],
    where: str,
    chain: Chain,
    default: np.ndarray | None = None,
    quantities: tuple[str, str] = ("", ""),
) -> np.ndarray:
    """Return limits (n,) from a table with the keys joint name, q1 …, ``all``, ``share``; infinite if not stated.

    Args:
        quantities: of a revolute joint's limit, and of a prismatic one's.
    """
    numbered = {f"q{j + 1}": j for j in range(chain.n)} | {name: j for j, name in enumerate(chain.joint_names)}
    check_keys(stated, ("all", "share", *(MARGINS if where.endswith("torque") else ()), *numbered), where)
    bounds = np.full(chain.n, np.inf) if default is None else default.copy()
    for name in [name for name in stated if name != "share"]:
        for j in range(chain.n) if name == "all" else [numbered[name]]:
            value = number(stated[name], f"{where}.{name}", quantities[chain.joints[j].kind != "revolute"])
            bounds[j] = value if default is None else min(value, bounds[j])
    share = number(stated.get("share", 1.0), f"{where}.share")
    if not 0 < share <= 1:
        raise UsageError(f"{where}.share: expected a share of the limits above 0 and up to 1, found {share:g}")
    return bounds * share


def _points(stated: Sequence[PointTable], chain: Chain, where: str) -> Points:
    for k, one in enumerate(stated, 1):
        if one.joint > chain.n:
            raise UsageError(f"{where}: [[point]] number {k}.joint: expected a joint from 1 to {chain.n} (0: the tip)")
    return Points(chain, (0, *(one.joint for one in stated)), np.array([(0.0, 0.0, 0.0), *(one.xyz for one in stated)]))


def _friction(stated: FrictionTable | None, chain: Chain, where: str) -> np.ndarray | None:
    if stated is None:
        return None
    result = []
    for key in ("Fv", "Fc"):
        values = getattr(stated, key) or (0.0,) * chain.n
        if len(values) not in (1, chain.n):
            raise UsageError(f"{where}: friction.{key}: {len(values)} values for {chain.n} joints")
        result.append(np.broadcast_to(np.array(values), (chain.n,)))
    return np.array(result)
