"""Planning a motion: a path through waypoints, which `trajectories` times with the best dynamic model available.

Waypoints are joint values, or places of the tool by inverse kinematics: a CSV, a row per waypoint, in order, with the
robot's joints, or the tip's place ``x y z`` in the robot's base frame and its orientation ``qx qy qz qw`` (or ``r11``
to ``r33``); without one only the position counts. Units stand in brackets, plain headers are SI. With both, the place
is met and the joints say in which configuration; without joints each is reached from the configuration before it, the
first one from --start, or near the middle of the joint limits.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np

from calib.config import Tables, check_keys, read, strict
from calib.config_types import Expect, numbers
from calib.data.csv_table import read_header
from calib.data.poses.pose_lists import Targets, read_poses, read_targets
from calib.data.schema import Joints
from calib.dynamics.bodies import bodies_of, standard_parameters
from calib.dynamics.drives import standard
from calib.dynamics.idim import IdentificationModel
from calib.dynamics.path_dynamics import PathDynamics, of_standard
from calib.dynamics.torque_rows import MOTOR
from calib.errors import RobotError, UsageError, refused_as, require
from calib.geometry import inverse
from calib.geometry.installation import Installation
from calib.geometry.inverse import Goal
from calib.identification.model_file import read_dynamics, refuse_currents, refuse_other_arm
from calib.identification.prediction import Dynamics
from calib.identification.uncertainty.torque_errors import Uncertainty, read_uncertainty
from calib.procedure.excitation.limits import MotionBounds, MotionLimits, check_bodies, read_motion_limits
from calib.procedure.excitation.playback import approach_to
from calib.procedure.excitation.settings import DEFAULT_PLAN, DRIVES, PlanSettings
from calib.procedure.kinematic_stage.inputs import load_rigid
from calib.robot.calibrated import CalibratedChain
from calib.robot.chain import Chain, joint_kinds
from calib.robot.kinematics import forward, tip_jacobian
from calib.trajectories.basis import SampledMotion
from calib.trajectories.setpoints import Setpoints, joined, slowed
from calib.trajectories.timing.limits import TimingLimits
from calib.trajectories.timing.lines import line
from calib.trajectories.timing.path import Path as JointPath
from calib.trajectories.timing.path import check_within, checked, spline
from calib.trajectories.timing.profile import track
from calib.trajectories.timing.shape import Shaped, shorten
from calib.trajectories.timing.time_scaling import Timing, time_optimal
from calib.transforms import pose

MAX_TRIES = 40  # random configurations from which a waypoint is sought (our choice)
MAX_ERROR = 1e-6  # [m and rad] that may be left


def read_waypoints(
    given: Path | Targets | np.ndarray,
    chain: Chain,
    lower: np.ndarray,
    upper: np.ndarray,
    start: Sequence[float] | None = None,
) -> np.ndarray:
    """Return waypoints as joint values (m, n) [rad or m], from a file or from arrays.

    Args:
        given: the file; or in memory joint values (m, n) [rad or m], poses (m, 4, 4) [m], or targets.
        chain: whose tip stands at the places, the best geometry there is.
        lower, upper: (n,) joint limits to stay within.
        start: (n,) where the robot stands: the first place is reached near it; else near the middle of the limits.

    Raises:
        UsageError: for a waypoint out of reach, with its number and the distance.
    """
    if not isinstance(given, Path):
        targets = Targets.of(given)
    elif {"x", "x_target"} & set(read_header(given)[0]):
        targets = read_targets(given, Joints(chain.joint_names, joint_kinds(chain)))
    else:
        targets = Targets.of(read_poses(given, Joints(chain.joint_names, joint_kinds(chain))))
    if targets.position is None and targets.q is not None:
        return read_poses(targets.q, chain.joint_names)
    goal = Goal(Installation(chain), 3 if targets.rotation is None else 6, lower, upper)
    places = pose(targets.rotation, targets.position)
    low, high = (np.where(np.isfinite(x), x, s * np.pi) for x, s in ((lower, -1.0), (upper, 1.0)))
    here = np.asarray(start, dtype=float) if start is not None else (low + high) / 2
    others = np.random.default_rng(0).uniform(low, high, (MAX_TRIES, chain.n))
    found = []
    for k in range(len(targets)):
        near = here if targets.q is None else np.array(targets.q[k])
        here = _reached(goal, places[k : k + 1], near, others, targets, k)
        found.append(here)
    return np.array(found)


def _reached(
    goal: Goal, target: np.ndarray, near: np.ndarray, others: np.ndarray, targets: Targets, k: int
) -> np.ndarray:
    """Return joint values (n,) at a target (1, 4, 4), solved from the present pose or else by many tries."""
    q = inverse.nearest(goal, target, near[None], inverse.reach(goal, target, near[None]))
    left = inverse.differences(goal, q, target)
    if np.abs(left).max() <= MAX_ERROR:
        return q[0]
    many = np.repeat(target, len(others), axis=0)
    tried = inverse.reach(goal, many, others)
    left = inverse.differences(goal, tried, many)
    met = np.abs(left).max(axis=1) <= MAX_ERROR
    if not met.any():
        best = left[np.argmin(np.linalg.norm(left, axis=1))]
        turn = f" and {np.degrees(np.linalg.norm(best[3:])):.3g} deg" if goal.dof == 6 else ""
        raise UsageError(
            f"{targets.file}: waypoint {k + 1} is out of reach: the nearest of {len(others)} tries is "
            f"{1e3 * np.linalg.norm(best[:3]):.3g} mm{turn} off, within the joint limits. Are x y z those of the tip "
            "in the robot's base frame, in metres?"
        )
    distance = np.where(met, np.abs(tried - near).max(axis=1), np.inf)
    chosen = tried[np.argmin(distance)][None]
    return inverse.nearest(goal, target, near[None], chosen)[0]


PerJoint = Annotated[tuple[float, ...], Expect("a list of numbers, one per joint")]


@strict
@dataclass(frozen=True)
class _DrivesFile:
    """The file of ``calib plan --drives``: [drives] with any of Ia, Fv, Fc, off per joint (SI, joint side)."""

    drives: Mapping[str, PerJoint] = field(default_factory=dict)


COARSE_GRID = 150  # grid of the outer loop
Progress = Callable[[str], None]


@dataclass(frozen=True, eq=False)
class Planned:
    """A planned motion.

    Attributes:
        chain: the robot.
        bounds: what limits its speed and acceleration, and where that is stated.
        limits, lower, upper: what the motion keeps, margins of torque taken off.
        timings: one per path: a single one through all waypoints, or one per tool line.
        track: the motion at the controller's rate.
        margins: (n,) to the joint limits [rad or m]; None if the path is not a joint path.
        deviation: (2,) of the tool from its lines [m, rad]; None for joint paths.
        shaped: what the outer loop found; None without one.
        approach, rehearsal: tracks; None where not asked for.
        sigma: (n,) largest standard deviation of each predicted torque; `limits.torque` leaves as many of them free as
            the limits file says (default 2); None where the model states none.
        notes: what a user should know.
        source: the robot's description, as named by the user; empty if unknown.
    """

    chain: Chain
    bounds: MotionBounds
    limits: TimingLimits
    lower: np.ndarray
    upper: np.ndarray
    timings: tuple[Timing, ...]
    track: Setpoints
    notes: tuple[str, ...]
    margins: np.ndarray | None = None
    deviation: np.ndarray | None = None
    shaped: Shaped | None = None
    approach: Setpoints | None = None
    rehearsal: Setpoints | None = None
    sigma: np.ndarray | None = None
    source: str = ""

    @property
    def active_share(self) -> float:
        """Share of the time during which the motion is close to a limit."""
        seconds = [one.duration for one in self.timings]
        return float(np.average([one.active_share for one in self.timings], weights=seconds))


def plan(
    robot: str | Path | CalibratedChain,
    waypoints: Path | Targets | np.ndarray,
    settings: PlanSettings = DEFAULT_PLAN,
    *,
    model: Path | None = None,
    limits: Tables | None = None,
    drives: Tables | None = None,
    base: str | None = None,
    tip: str | None = None,
    progress: Progress | None = None,
) -> Planned:
    """Plan the fastest motion of a robot through the waypoints of a file.

    Args:
        robot, base, tip: see `calib.robot.library`.
        waypoints: see `calib.procedure.excitation.planning`.
        settings: see `calib.procedure.excitation.settings`.
        model: folder of an identification; its geometry is planned with, the limits are the robot's.
        limits: see `calib.procedure.excitation.limits`; drives: see `_read_drives`.
        progress: called with words.

    Raises:
        UsageError: for waypoints that cannot be reached, and limits that cannot be kept.
    """
    say = progress or (lambda words: None)
    words = "--shorten cannot be combined with --line: straight lines leave no path to change; leave one out"
    require(not (settings.shorten and settings.lines), words, UsageError)
    if settings.payloads and model is None:
        raise UsageError(f"payloads {', '.join(settings.payloads)}: need an identified model; name it (--model)")
    found, source = load_rigid(robot, waypoints if isinstance(waypoints, Path) else None, base, tip)
    chain = found.chain
    known = read_motion_limits(limits, chain, source, given_way=True, predicted=model is not None)
    law, notes, uncertain = _law(chain, model, settings.payloads, drives, known)
    lower, upper, free = known.positions.lower, known.positions.upper, 1.0 - (known.margin or 0.0)
    bounds = TimingLimits(known.bounds.velocity, known.bounds.acceleration, known.bounds.torque * free)
    arm = chain if model is None else read_dynamics(model)[0]
    points = read_waypoints(waypoints, arm, lower, upper, settings.start)
    say("the path")
    paths, deviation = _paths(arm, points, settings.lines)
    for path in paths:
        check_within(path, lower, upper, points)
    shaped = None
    if settings.shorten:
        timer = partial(_duration, limits=bounds, law=law, lower=lower, upper=upper, known=known)
        report = lambda done, best: say(f"shaping the path: {best:.4f} s after {done} timings")  # noqa: E731
        shaped = shorten(points, timer, settings.shorten, settings.stray, report)
        paths = [shaped.path]
    margins = np.min([check_within(path, lower, upper) for path in paths], axis=0)
    for path in paths:
        _check_places(path, known)
    say("timing")
    timed = partial(time_optimal, law=law, rate=settings.rate)
    timings, sigma = tuple(timed(path, bounds) for path in paths), None
    if uncertain is not None and known.deviations > 0:
        sigma = np.max([uncertain.sigma(one.sampled) for one in timings], axis=0)
        bounds = _guarded(bounds, known.deviations * sigma, chain)
        timings = tuple(timed(path, bounds) for path in paths)
    torque = None if law is None else law.torque
    motion = joined([track(one.path, one.profile, settings.rate, torque) for one in timings])
    known.bounds.check(motion)
    lead, remarks = approach_to(settings.start, motion.q[0], settings.rate, known, chain)
    return Planned(
        chain,
        known.bounds,
        bounds,
        lower,
        upper,
        timings,
        motion,
        (*known.notes, *notes, *remarks),
        margins,
        deviation,
        shaped,
        lead,
        slowed(motion, settings.slower) if settings.slower != 1 else None,
        sigma,
        found.source or str(source),
    )


def _read_drives(given: Tables | None, chain: Chain) -> dict[str, np.ndarray]:
    """Read drive parameters (n,) from TOML: ``[drives]`` with Ia, Fv, Fc, off as needed (SI, joint side)."""
    stated, where = read(_DrivesFile, given, "drives")
    check_keys(stated.drives, DRIVES, f"{where}: drives")
    return {key: np.array(numbers(value, chain.n, f"{where}: drives.{key}")) for key, value in stated.drives.items()}


def _check_places(path: JointPath, known: MotionLimits) -> None:
    """Raise an error if one of 500 points of a path violates the workspace or clearance of the limits file.

    Raises:
        UsageError: with the violated constraint, the place, and the excess.
    """
    s = np.linspace(0, path.length, 500)
    still = np.zeros((len(s), path.n))
    for _, words, k in known.broken(SampledMotion(s, path(s), still, still, still)):
        raise UsageError(f"{words}, after {s[k] / path.length:.0%} of the path; move or add waypoints")


def _law(
    chain: Chain, folder: Path | None, payloads: Sequence[str], drives: Tables | None, known: MotionLimits
) -> tuple[PathDynamics | None, tuple[str, ...], Uncertainty | None]:
    """Return the dynamics: identified model, or the robot's inertias and given drives; None without both."""
    if folder is not None:
        require(drives is None, "model and drives both state drive parameters; leave one of them out", UsageError)
        law, unsure = _identified(chain, folder, payloads)
        return law, () if unsure else ("the model states no covariance: torques have no margin for it",), unsure
    with refused_as(UsageError, RobotError, "{}"):
        stated = _read_drives(drives, chain)
        if known.friction is not None and not stated:
            stated = {"Fv": known.friction[0], "Fc": known.friction[1]}
        if chain.inertias is None:
            return None, (), None
        check_bodies(chain, known.torque)
        values = np.column_stack([stated.get(key, np.zeros(chain.n)) for key in DRIVES])
    linear = [joint.kind == "prismatic" for joint in chain.joints]
    model = IdentificationModel(bodies_of(chain), standard([" ".join(DRIVES)] * chain.n, linear=linear))
    missing = [what for what, key in (("motor inertia", "Ia"), ("friction", "Fc")) if key not in stated]
    note = f"{' and '.join(missing)} unknown (no model, no drives): planned without; the real robot needs more torque"
    law = of_standard(model, np.concatenate([standard_parameters(chain), values.ravel()]))
    return law, (note,) if missing else (), None


def _identified(chain: Chain, folder: Path, payloads: Sequence[str]) -> tuple[PathDynamics, Uncertainty | None]:
    """Return the dynamics of an identified model with the given payloads, and its uncertainty or None."""
    refuse_currents(folder, "a motion plan")
    refuse_other_arm(folder, chain)
    dynamics = read_dynamics(folder)[1]
    model = dynamics.model
    if model.torque_rows.projection is not None:  # of power, say: its parameters predict the motors' torques as well
        model = replace(model, torque_rows=MOTOR)
    known = [label for label, coordinate in zip(model.bodies.labels, model.bodies.coordinates) if coordinate < 0]
    if unknown := sorted(set(payloads) - set(known)):
        raise UsageError(f"{folder}: no payload '{unknown[0]}' was identified; it has {', '.join(known) or 'none'}")
    if not model.torque_rows.has_bodies:
        return of_standard(model, dynamics.values), None  # which says why that cannot be
    values = np.array(dynamics.values)
    values[: model.inertial] *= model.carried_columns(payloads)
    return of_standard(model, values), read_uncertainty(folder, Dynamics(model, values), payloads)


def _guarded(bounds: TimingLimits, margin: np.ndarray, chain: Chain) -> TimingLimits:
    """Return the limits with each torque limit reduced by a margin (n,)."""
    if (margin >= bounds.torque).any():
        j = int(np.argmax(margin / bounds.torque))
        raise UsageError(
            f"{chain.joint_names[j]}: the margin for torque uncertainty, {margin[j]:.3g}, reaches the torque limit, "
            f"{bounds.torque[j]:.3g}; identify with a richer motion, or lower torque.deviations in the limits file"
        )
    return replace(bounds, torque=bounds.torque - margin)


def _paths(chain: Chain, points: np.ndarray, lines: bool) -> tuple[list[JointPath], np.ndarray | None]:
    if not lines:
        return [spline(points)], None
    start, found = checked(points)[0], []
    for goal in forward(chain, points[1:]):
        found.append(line(partial(forward, chain), partial(tip_jacobian, chain), start, goal))
        start = found[-1].path(np.array([found[-1].path.length]))[0]
    return [one.path for one in found], np.max([one.deviation for one in found], axis=0)


def _duration(
    path: JointPath, limits: TimingLimits, law: PathDynamics | None, lower, upper, known: MotionLimits
) -> float:
    check_within(path, lower, upper)
    _check_places(path, known)
    return time_optimal(path, limits, law, grid=COARSE_GRID).duration
