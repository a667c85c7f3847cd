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
from calib.trajectories.timing.lines import line
from calib.trajectories.timing.path import Path as JointPath
from calib.trajectories.timing.path import check_within, checked, spline
from calib.trajectories.timing.path_limits import TimingLimits
from calib.trajectories.timing.profile import track
from calib.trajectories.timing.shape import Shaped, shorten
from calib.trajectories.timing.time_scaling import Timing, time_optimal
from calib.transforms import pose

Progress = Callable[[str], None]

# random configurations from which a waypoint is sought (our choice)
MAX_TRIES = 40
# [m and rad] largest distance of the tool from a waypoint
MAX_ERROR = 1e-6
# grid of the outer loop
COARSE_GRID = 150
# points of a path at which workspace and clearance are checked
CHECKED_POINTS = 500


def read_waypoints(
    waypoints: Path | Targets | np.ndarray,
    chain: Chain,
    lower: np.ndarray,
    upper: np.ndarray,
    start: Sequence[float] | None = None,
) -> np.ndarray:
    """Return waypoints as joint values (m, n) [rad or m], from a file or from arrays.

    Args:
        waypoints: the file; or in memory joint values (m, n) [rad or m], poses (m, 4, 4) [m], or targets.
        chain: arm with the best known geometry, whose tip is to reach the waypoints.
        lower, upper: (n,) joint limits of the solution.
        start: (n,) joint values of the robot before the motion, near which the first waypoint is solved; None: near the
            middle of the joint limits.

    Raises:
        UsageError: for a waypoint that cannot be reached; the message states its number and the distance.
    """
    if not isinstance(waypoints, Path):
        targets = Targets.of(waypoints)
    else:
        joints = Joints(chain.joint_names, joint_kinds(chain))
        header = read_header(waypoints)[0]
        if {"x", "x_target"} & set(header):
            targets = read_targets(waypoints, joints)
        else:
            targets = Targets.of(read_poses(waypoints, joints))
    if targets.position is None and targets.q is not None:
        return read_poses(targets.q, chain.joint_names)

    dof = 3 if targets.rotation is None else 6
    goal = Goal(Installation(chain), dof, lower, upper)
    target_poses = pose(targets.rotation, targets.position)
    low = np.where(np.isfinite(lower), lower, -np.pi)
    high = np.where(np.isfinite(upper), upper, np.pi)
    configurations = np.random.default_rng(0).uniform(low, high, (MAX_TRIES, chain.n))
    # each waypoint is reached from the configuration before it, unless its own is stated
    q = (low + high) / 2
    if start is not None:
        q = np.asarray(start, dtype=float)
    result = []
    for k in range(len(targets)):
        start_q = q if targets.q is None else np.array(targets.q[k])
        q = _reached(goal, target_poses[k : k + 1], start_q, configurations, targets, k)
        result.append(q)
    return np.array(result)


def _reached(
    goal: Goal, target: np.ndarray, start_q: np.ndarray, configurations: np.ndarray, targets: Targets, k: int
) -> np.ndarray:
    """Return joint values (n,) at which the tip reaches a waypoint.

    They are solved from the joint values `start_q` and, if this fails, from many random configurations.

    Args:
        goal: the inverse-kinematics problem.
        target: (1, 4, 4) pose of the waypoint.
        start_q: (n,) joint values at which the solution starts.
        configurations: (N, n) random joint values.
        targets, k: all waypoints and the index of this waypoint, for the message.

    Raises:
        UsageError: if the waypoint cannot be reached.
    """
    present = start_q[None]
    q = inverse.nearest(goal, target, present, inverse.reach(goal, target, present))
    if np.abs(inverse.differences(goal, q, target)).max() <= MAX_ERROR:
        return q[0]
    repeated_target = np.repeat(target, len(configurations), axis=0)
    tries = inverse.reach(goal, repeated_target, configurations)
    differences = inverse.differences(goal, tries, repeated_target)
    reached = np.abs(differences).max(axis=1) <= MAX_ERROR
    if not reached.any():
        nearest = differences[np.argmin(np.linalg.norm(differences, axis=1))]
        angle = ""
        if goal.dof == 6:
            angle = f" and {np.degrees(np.linalg.norm(nearest[3:])):.3g} deg"
        raise UsageError(
            f"{targets.file}: waypoint {k + 1} is out of reach: the nearest of {len(configurations)} tries is "
            f"{1e3 * np.linalg.norm(nearest[:3]):.3g} mm{angle} off, within the joint limits. Are x y z those of the "
            "tip in the robot's base frame, in metres?"
        )
    distance = np.where(reached, np.abs(tries - start_q).max(axis=1), np.inf)
    closest = tries[np.argmin(distance)][None]
    return inverse.nearest(goal, target, present, closest)[0]


PerJoint = Annotated[tuple[float, ...], Expect("a list of numbers, one per joint")]


@strict
@dataclass(frozen=True)
class _DrivesFile:
    """The file of ``calib plan --drives``: table ``[drives]`` with Ia, Fv, Fc, off per joint (SI, joint side)."""

    drives: Mapping[str, PerJoint] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Planned:
    """A planned motion.

    Attributes:
        chain: the robot.
        bounds: limits of velocity and acceleration, and the files that state them.
        limits: limits for the timing, with the torque margins subtracted.
        lower, upper: (n,) joint limits.
        timings: one per path: a single path through all waypoints, or one path per straight line of the tool.
        track: the motion at the controller's rate.
        margins: (n,) smallest distance to the joint limits [rad or m]; None for straight lines of the tool.
        deviation: (2,) largest deviation of the tool from its lines [m, rad]; None for joint paths.
        shaped: result of the optimisation of the path's shape; None if not requested.
        approach, rehearsal: setpoints of the approach and the rehearsal; None if not requested.
        sigma: (n,) largest standard deviation of each joint's predicted torque [N m or N]. Below the torque limits, the
            number of standard deviations in the limits file (default 2) stays free. None if the model states no
            covariance.
        notes: remarks for the user.
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
        """Share of the time during which the motion is close to one of its limits."""
        seconds = [timing.duration for timing in self.timings]
        shares = [timing.active_share for timing in self.timings]
        return float(np.average(shares, weights=seconds))


def _silent(stage: str) -> None:
    """Ignore a progress text, `stage`."""


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
    """Return the fastest motion of a robot through waypoints, within its limits.

    Args:
        robot: name of a library robot, file (URDF, or MDH table in TOML), folder of a fit, or a robot in memory.
        waypoints: CSV file of joint values or tool poses; or in memory joint values (m, n) [rad or m], poses (m, 4, 4)
            [m], or targets.
        settings: payloads, straight lines, rate, start, and optimisation of the path's shape.
        model: folder of an identification, whose geometry and torques are used; the limits are those of the robot;
            None: masses of the robot's description.
        limits: limits file (`calib formats limits`), or its content as tables; None: limits of the robot's description.
        drives: TOML file with a table ``[drives]`` of Ia, Fv, Fc, off per joint, or its tables; None: unknown.
        base, tip: first and last link of the arm in a URDF; None: its root, and its flange.
        progress: called with a text on each step; None: silent.

    Raises:
        UsageError: for waypoints that cannot be reached, and limits that cannot be respected.
    """
    show = progress or _silent
    _check_request(settings, model)
    waypoint_file = waypoints if isinstance(waypoints, Path) else None
    calibrated, source = load_rigid(robot, waypoint_file, base, tip)
    chain = calibrated.chain
    motion_limits = read_motion_limits(limits, chain, source, stated_path=True, predicted=model is not None)
    dynamics, notes, uncertainty = _dynamics(chain, model, settings.payloads, drives, motion_limits)
    lower, upper = motion_limits.positions.lower, motion_limits.positions.upper
    bounds = motion_limits.bounds
    torque_share = 1.0 - (motion_limits.margin or 0.0)
    timing_limits = TimingLimits(bounds.velocity, bounds.acceleration, bounds.torque * torque_share)
    # an identified model has the best geometry
    arm = chain if model is None else read_dynamics(model)[0]
    points = read_waypoints(waypoints, arm, lower, upper, settings.start)

    show("the path")
    paths, deviation = _paths(arm, points, settings.lines)
    for path in paths:
        check_within(path, lower, upper, points)
    shaped = None
    if settings.shorten:
        shaped = _shortened(points, settings, motion_limits, timing_limits, dynamics, show)
        paths = [shaped.path]
    margins = np.min([check_within(path, lower, upper) for path in paths], axis=0)
    for path in paths:
        _check_constraints(path, motion_limits)

    show("timing")
    timed = partial(time_optimal, law=dynamics, rate=settings.rate)
    timings = tuple(timed(path, timing_limits) for path in paths)
    sigma = None
    if uncertainty is not None and motion_limits.deviations > 0:
        # timed anew with margins for the uncertainty of the torques along the first timing
        sigma = np.max([uncertainty.sigma(timing.sampled) for timing in timings], axis=0)
        timing_limits = _guarded(timing_limits, motion_limits.deviations * sigma, chain)
        timings = tuple(timed(path, timing_limits) for path in paths)
    torque = None if dynamics is None else dynamics.torque
    motion = joined([track(timing.path, timing.profile, settings.rate, torque) for timing in timings])
    bounds.check(motion)
    approach, approach_notes = approach_to(settings.start, motion.q[0], settings.rate, motion_limits, chain)
    rehearsal = None
    if settings.slower != 1:
        rehearsal = slowed(motion, settings.slower)
    return Planned(
        chain=chain,
        bounds=bounds,
        limits=timing_limits,
        lower=lower,
        upper=upper,
        timings=timings,
        track=motion,
        notes=(*motion_limits.notes, *notes, *approach_notes),
        margins=margins,
        deviation=deviation,
        shaped=shaped,
        approach=approach,
        rehearsal=rehearsal,
        sigma=sigma,
        source=calibrated.source or str(source),
    )


def _check_request(settings: PlanSettings, model: Path | None) -> None:
    """Raise a UsageError if settings contradict each other, or need an identified model that is not given.

    Args:
        settings: settings of the plan.
        model: folder of an identification; None: no model.
    """
    if settings.shorten and settings.lines:
        raise UsageError(
            "--shorten cannot be combined with --line: straight lines leave no path to change; leave one out"
        )
    if settings.payloads and model is None:
        raise UsageError(f"payloads {', '.join(settings.payloads)}: need an identified model; name it (--model)")


def _shortened(
    points: np.ndarray,
    settings: PlanSettings,
    motion_limits: MotionLimits,
    timing_limits: TimingLimits,
    dynamics: PathDynamics | None,
    show: Progress,
) -> Shaped:
    """Return the path through the waypoints whose shape allows the shortest duration within all limits.

    Args:
        points: (m, n) waypoints [rad or m].
        settings: number of timings, and largest deviation of the path from the spline.
        motion_limits: joint limits, workspace and clearance.
        timing_limits: limits of velocity, acceleration and torque.
        dynamics: the robot's dynamics; None: no torque limits.
        show: called with a text on the progress.
    """
    positions = motion_limits.positions

    def duration(path: JointPath) -> float:
        check_within(path, positions.lower, positions.upper)
        _check_constraints(path, motion_limits)
        return time_optimal(path, timing_limits, dynamics, grid=COARSE_GRID).duration

    def report(timing_count: int, best: float) -> None:
        show(f"shaping the path: {best:.4f} s after {timing_count} timings")

    return shorten(points, duration, settings.shorten, settings.stray, report)


def _read_drives(tables: Tables | None, chain: Chain) -> dict[str, np.ndarray]:
    """Return drive parameters (n,) by name, from the table ``[drives]`` with Ia, Fv, Fc, off (SI, joint side).

    Args:
        tables: TOML file, or its tables; None: no parameters are stated, and the result is empty.
        chain: the arm with n joints.
    """
    content, where = read(_DrivesFile, tables, "drives")
    check_keys(content.drives, DRIVES, f"{where}: drives")
    drives = {}
    for key, values in content.drives.items():
        drives[key] = np.array(numbers(values, chain.n, f"{where}: drives.{key}"))
    return drives


def _check_constraints(path: JointPath, limits: MotionLimits) -> None:
    """Check that no point of a path violates the workspace or clearance in the limits file.

    Raises:
        UsageError: for a violation; the message states the constraint, the position on the path, and the excess.
    """
    s = np.linspace(0, path.length, CHECKED_POINTS)
    zero = np.zeros((len(s), path.n))
    for _, violation, k in limits.broken(SampledMotion(s, path(s), zero, zero, zero)):
        raise UsageError(f"{violation}, after {s[k] / path.length:.0%} of the path; move or add waypoints")


def _dynamics(
    chain: Chain, folder: Path | None, payloads: Sequence[str], tables: Tables | None, limits: MotionLimits
) -> tuple[PathDynamics | None, tuple[str, ...], Uncertainty | None]:
    """Return dynamics, notes and uncertainty of an identified model, or of the robot's inertias and stated drives.

    The dynamics are None if the robot's description has no inertias. The uncertainty is None without an identified
    covariance.

    Args:
        chain: the arm.
        folder: folder of an identification; None: the inertias of the robot's description are used.
        payloads: labels of attached payloads.
        tables: file or tables with drive parameters; None: none.
        limits: limits of the motion, which may state friction.
    """
    if folder is not None:
        require(tables is None, "model and drives both state drive parameters; leave one of them out", UsageError)
        dynamics, uncertainty = _identified(chain, folder, payloads)
        notes: tuple[str, ...] = ()
        if not uncertainty:
            notes = ("the model states no covariance: torques have no margin for it",)
        return dynamics, notes, uncertainty
    with refused_as(UsageError, RobotError, "{}"):
        drives = _read_drives(tables, chain)
        if limits.friction is not None and not drives:
            drives = {"Fv": limits.friction[0], "Fc": limits.friction[1]}
        if chain.inertias is None:
            return None, (), None
        check_bodies(chain, limits.torque)
        drive_values = np.column_stack([drives.get(key, np.zeros(chain.n)) for key in DRIVES])
    linear = [joint.kind == "prismatic" for joint in chain.joints]
    terms = standard([" ".join(DRIVES)] * chain.n, linear=linear)
    values = np.concatenate([standard_parameters(chain), drive_values.ravel()])
    dynamics = of_standard(IdentificationModel(bodies_of(chain), terms), values)
    missing = []
    if "Ia" not in drives:
        missing.append("motor inertia")
    if "Fc" not in drives:
        missing.append("friction")
    if not missing:
        return dynamics, (), None
    note = f"{' and '.join(missing)} unknown (no model, no drives): planned without; the real robot needs more torque"
    return dynamics, (note,), None


def _identified(chain: Chain, folder: Path, payloads: Sequence[str]) -> tuple[PathDynamics, Uncertainty | None]:
    """Return the dynamics of an identified model with payloads, and its uncertainty (None without a covariance).

    Args:
        chain: the arm.
        folder: folder of the identification.
        payloads: labels of the attached payloads.

    Raises:
        UsageError: for an unknown payload, or an identification of another arm.
    """
    refuse_currents(folder, "a motion plan")
    refuse_other_arm(folder, chain)
    _, dynamics = read_dynamics(folder)
    model = dynamics.model
    if model.torque_rows.projection is not None:
        # of power, say: its parameters predict the motors' torques as well
        model = replace(model, torque_rows=MOTOR)
    bodies = zip(model.bodies.labels, model.bodies.coordinates)
    identified = [label for label, coordinate in bodies if coordinate < 0]
    unknown = sorted(set(payloads) - set(identified))
    if unknown:
        raise UsageError(
            f"{folder}: no payload '{unknown[0]}' was identified; it has {', '.join(identified) or 'none'}"
        )
    if not model.torque_rows.has_bodies:
        # `of_standard` says why that cannot be
        return of_standard(model, dynamics.values), None
    values = np.array(dynamics.values)
    values[: model.inertial] *= model.carried_columns(payloads)
    return of_standard(model, values), read_uncertainty(folder, Dynamics(model, values), payloads)


def _guarded(limits: TimingLimits, margin: np.ndarray, chain: Chain) -> TimingLimits:
    """Return the limits with each torque limit reduced by a margin.

    Args:
        limits: limits of velocity, acceleration and torque.
        margin: (n,) margins [N m or N].
        chain: the arm, whose joints the message names.

    Raises:
        UsageError: for a margin that reaches the torque limit.
    """
    if (margin >= limits.torque).any():
        j = int(np.argmax(margin / limits.torque))
        raise UsageError(
            f"{chain.joint_names[j]}: the margin for torque uncertainty, {margin[j]:.3g}, reaches the torque limit, "
            f"{limits.torque[j]:.3g}; identify with a richer motion, or lower torque.deviations in the limits file"
        )
    return replace(limits, torque=limits.torque - margin)


def _paths(chain: Chain, points: np.ndarray, straight: bool) -> tuple[list[JointPath], np.ndarray | None]:
    """Return the paths through waypoints, and the largest deviation (2,) [m, rad] of straight lines.

    Args:
        chain: the arm.
        points: (m, n) waypoints [rad or m].
        straight: whether the tool moves on straight lines, one path each; otherwise there is one spline in joint space,
            and the deviation is None.
    """
    if not straight:
        return [spline(points)], None
    start = checked(points)[0]
    tool_lines = []
    for goal in forward(chain, points[1:]):
        tool_line = line(partial(forward, chain), partial(tip_jacobian, chain), start, goal)
        tool_lines.append(tool_line)
        end = np.array([tool_line.path.length])
        start = tool_line.path(end)[0]
    deviation = np.max([tool_line.deviation for tool_line in tool_lines], axis=0)
    return [tool_line.path for tool_line in tool_lines], deviation
