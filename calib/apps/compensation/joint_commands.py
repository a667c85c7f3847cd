"""Joint commands that bring the tool of the real (calibrated) robot to nominal targets.

Frames are a convention: measurements from outside cannot separate the arm's base from the placement of the instrument,
nor its flange from the placement of the target:

    --frame base      targets stand in the base of the calibrated robot, as its robot.toml has it: base link and flange
                      stay where the nominal description has them (elements that are not identifiable stay nominal)
    --frame nominal   targets stand in the base of the nominal robot, placed in the cell where it fits the measurements
                      best: commands change least on the whole
    --frame NAME      targets stand in the frame of that instrument placement (a station of the fit)

    --tool flange     targets are poses of the flange (the tip)
    --tool NAME       of a target that was measured, as the fit has placed it in the flange
    --tool x,y,z[,roll,pitch,yaw]   of a tool so placed in the flange [m, rad]

Joint targets mean the pose that the nominal robot would have at these joints: with base and flange shared with the
calibrated robot for ``base``; for the other two with its own best placement of base and target.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from calib import files
from calib.errors import Finding, UsageError, finding
from calib.toolkit.chains import Chain, Deflection
from calib.toolkit.installations import (
    DOF,
    Discrepancy,
    ErrorModel,
    Goal,
    Installation,
    conditions,
    differences,
    held_back,
    layout,
    nearest,
    outside,
    payload_load,
    pose_sigmas,
    reach,
    read_arms,
    see,
)
from calib.toolkit.pose_data import PoseMeasurements, Targets
from calib.toolkit.result_folders import VALIDATED, ValidationFolder, lines_of, open_result, read_covariance, sentence
from calib.transforms import from_xyz_rpy, invert, pose, rotation_vector

# Thresholds are our choice.
# largest errors of a command that reaches its target, of position [m] and orientation [rad]
TOLERANCE = (1e-6, 1e-5)
# largest correction of one joint [rad or m]; a larger one is limited, since the arm is near a singularity
MAX_CORRECTION = 0.2
# ratio of smallest to largest singular value of the Jacobian below which a pose is near a singularity
SINGULAR = 0.02
# largest distance from a target [m] that is explained by a singularity
ASTRAY = 0.01
# amount by which joint values may exceed a limit, for rounding errors [rad or m]
LIMIT_TOLERANCE = 1e-9
# number of random starts for each target given without joint values
STARTS = 24
COMPONENTS = {6: "position and orientation", 5: "position and the direction of the tool's z axis", 3: "position only"}
# largest number of targets in a message
MAX_LISTED = 20
# columns of COMMANDS.csv after the status
COLUMNS = (
    "left [mm]",
    "left [mrad]",
    "before [mm]",
    "before [mrad]",
    "sigma [mm]",
    "sigma [mrad]",
    "unseen_rms [mm]",
    "expected [mm]",
    "interval95 [mm]",
    "extrapolated",
)


@dataclass(frozen=True, eq=False)
class Fitted:
    """Calibrated arm and its cell, read from the folder of a fit.

    Attributes:
        folder: the fit's folder.
        cell: the calibrated arm with stations and tools, deflections included.
        nominal: the nominal arm with the stations and tools that fit the measurements best; no stations if these are
            unknown.
        free, covariance: indices of the fitted parameters in the cell's parameter vector, and the covariance of small
            steps along them.
        unseen: rms error of the calibrated arm at held-out poses [m]; None without such poses.
        fitted: rms error at the fitted poses [m]; None where the fit does not contain it.
        fitted_q: (k, n) joint values of the fitted poses [rad or m]; None where the fit does not contain them.
        discrepancy: model of the variance of position errors at other poses; None where the fit does not contain one.
        load: (4,) first moments [kg m] and mass [kg] of a payload, in the last body's frame; None without one.
    """

    folder: Path
    cell: Installation
    nominal: Installation
    free: np.ndarray
    covariance: np.ndarray
    unseen: float | None
    fitted: float | None
    fitted_q: np.ndarray | None = None
    discrepancy: Discrepancy | None = None
    load: np.ndarray | None = None

    def carrying(self, payload: float | Sequence[float] | None) -> "Fitted":
        """Return the arm with a payload at the tip; unchanged for None.

        Args:
            payload: mass [kg], or mass and centre of mass x, y, z in the tip's frame [m].

        Raises:
            UsageError: a payload of other numbers.
        """
        if payload is None:
            return self
        return replace(self, load=payload_load(self.cell.chain, payload))

    @property
    def placed(self) -> bool:
        """Whether the fit contains the poses of all stations relative to the nominal robot."""
        stations = self.nominal.station_names
        return bool(len(self.nominal.stations)) and set(self.cell.station_names) <= set(stations)


@dataclass(frozen=True, eq=False)
class Commands:
    """Joint commands for m targets.

    Attributes:
        targets: the targets.
        fitted: the calibrated robot in its cell.
        q: (m, n) joint values [rad or m]; where a target is not reached, those of the nearest pose that was found.
        nominal: (m, n) joint values of the nominal robot at the targets [rad or m].
        reached: (m,) True where a target is reached.
        reason: (m,) why a target is not reached; empty where it is.
        left, before: (m, 2) position [m] and orientation [rad] errors that the calibrated model predicts at the joint
            values ``q``, and at ``nominal``; NaN where the orientation is not constrained.
        sigma: (m, 2) σ of position [m] and orientation [rad] at ``q``, from the parameters' covariance.
        expected: (m, 2) expected position error of the real tool at ``q`` [m]: its standard deviation, model
            discrepancy included, and the radius that contains 95 % of such errors; NaN where the fit has no error
            model.
        beyond: (m, n) True for joint values outside the range of the fitted poses; all False if the range is unknown.
        dof: number of constrained pose components: 6, 5 or 3.
        notes: remarks on the frames, and warnings.
        own: (m, 2) part of ``before`` due to the arm alone, with the nominal base placed where it fits the measurements
            best; None where ``before`` is already computed so, or where this placement is unknown.
    """

    targets: Targets
    fitted: Fitted
    q: np.ndarray
    nominal: np.ndarray
    reached: np.ndarray
    reason: tuple[str, ...]
    left: np.ndarray
    before: np.ndarray
    sigma: np.ndarray
    expected: np.ndarray
    beyond: np.ndarray
    dof: int
    notes: tuple[str, ...]
    own: np.ndarray | None = None


def read(folder: str | Path) -> Fitted:
    """Return the calibrated arm and its cell from the folder of a fit, or of a session that contains a fit.

    Raises:
        UsageError: the folder has no fit, or an incomplete one.
    """
    result = open_result(folder, "compensate")
    fit = result.fit
    if fit is None:
        result.refuse("compensate")
    cell, nominal = read_arms(fit.path)
    free, covariance = read_covariance(fit.path, cell)

    metrics = fit.metrics()
    validation_metrics = metrics
    validation = ValidationFolder(Path(folder) / VALIDATED)
    if validation.judged.is_file():
        validation_metrics = validation.metrics()
    unseen_rms = []
    for errors in validation_metrics.validation.values():
        accuracy = errors.calibrated.main
        if accuracy:
            unseen_rms.append(1e-3 * accuracy.rms)
    unseen = max(unseen_rms, default=None)
    fit_accuracy = metrics.fit.calibrated.main
    fitted = 1e-3 * fit_accuracy.rms if fit_accuracy else None
    fitted_q = fit.learnt_joints(cell.chain.joints)
    discrepancy = None
    if metrics.findings is not None:
        discrepancy = metrics.findings.discrepancy
    return Fitted(fit.path, cell, nominal, free, covariance, unseen, fitted, fitted_q, discrepancy)


def placements(fitted: Fitted, frame: str = "base", tool: str = "flange") -> tuple[Installation, Installation]:
    """Return the nominal and the calibrated arm relative to the targets' frame, each with one station and one tool.

    Args:
        fitted: the calibrated arm and its cell.
        frame: frame of the targets: ``base`` (of the calibrated robot), ``nominal``, or the name of a station.
        tool: what is at the targets: ``flange``, a tool of the fit, or ``x,y,z[,roll,pitch,yaw]`` in the flange [m,
            rad].

    Raises:
        UsageError: a frame or tool that the fit does not have.
    """
    cell, nominal = fitted.cell, fitted.nominal
    if fitted.load is not None:
        cell = replace(cell, deflection=cell.deflection.carrying(fitted.load))
    tool_pose = _tool(cell, tool)
    # the nominal robot's flange need not be the calibrated one's
    T_flange_flange = np.eye(4)
    station = nominal_station = np.eye(4)
    if frame != "base":
        k = _station(fitted, frame)
        nominal_station, station = nominal.stations[k], cell.stations[k]
        t = cell.tool_names.index(tool) if tool in cell.tool_names else 0
        T_flange_flange = nominal.tools[t] @ invert(cell.tools[t])
        if frame == "nominal":
            nominal_station, station = np.eye(4), invert(nominal_station) @ station
    names = {"station_names": (frame,), "tool_names": (tool,)}
    rigid = replace(nominal, deflection=Deflection())
    nominal_arm = replace(rigid, stations=nominal_station[None], tools=(T_flange_flange @ tool_pose)[None], **names)
    calibrated_arm = replace(cell, stations=station[None], tools=tool_pose[None], **names)
    return nominal_arm, calibrated_arm


def _station(fitted: Fitted, frame: str) -> int:
    names = fitted.cell.station_names
    if frame not in ("nominal", *names):
        raise UsageError(f"frame {frame}: expected base, nominal, or a station of the fit ({', '.join(names)})")
    if not fitted.placed:
        raise UsageError(
            f"{fitted.folder} does not state the nominal robot's placement (it was fitted by an earlier version, or "
            "without an instrument): use frame 'base', or fit again"
        )
    return 0 if frame == "nominal" else names.index(frame)


def _tool(cell: Installation, tool: str) -> np.ndarray:
    if tool == "flange":
        return np.eye(4)
    if tool in cell.tool_names:
        return cell.tools[cell.tool_names.index(tool)]
    try:
        values = [float(part) for part in tool.split(",")]
    except ValueError:
        values = []
    if len(values) not in (3, 6) or not np.isfinite(values).all():
        names = ", ".join(cell.tool_names)
        raise UsageError(f"tool {tool}: expected flange, a tool of the fit ({names}), or x,y,z[,roll,pitch,yaw]")
    return from_xyz_rpy(values[:3], values[3:] or [0.0, 0.0, 0.0])


def computed(
    fitted: Fitted,
    targets: Targets,
    *,
    frame: str = "base",
    tool: str = "flange",
    dof: int | None = None,
    start: Sequence[float] | None = None,
    tolerance: tuple[float, float] = TOLERANCE,
    seed: int = 0,
    progress: Callable[[str], None] | None = None,
) -> Commands:
    """Return the joint commands that bring the real tool to the targets.

    The nominal robot's joint values determine the configuration. From them, the joint values of the calibrated robot
    are found with the smallest joint motion. Where a joint would move by more than `MAX_CORRECTION`, the arm is near a
    singularity: the joint's motion is limited, and the remaining error is reported.

    Args:
        fitted: the calibrated arm and its cell.
        targets: joint values or poses.
        frame, tool: frame of the targets, and tool at them, as for `placements`.
        dof: number of constrained pose components: 6; 5, free to turn about the tool's z axis; 3, position only; None
            for all that the targets
            contain and the arm can reach.
        start: (n,) joint values near which targets without joint values are sought [rad or m]; None for the middle of
            the limits.
        tolerance: largest accepted residual of position [m] and orientation [rad].
        seed: seed of further starts, where the search from the first one fails.
        progress: called with a short text as the computation proceeds; None for no report.

    Raises:
        UsageError: an invalid tolerance, or a start beyond the limits.
    """
    if not (np.isfinite(tolerance).all() and min(tolerance) > 0.0):
        text = f"{1e3 * tolerance[0]:g} mm, {1e3 * tolerance[1]:g} mrad"
        raise UsageError(f"tolerance {text}: expected two numbers above 0")
    say = progress or (lambda message: None)
    nominal_cell, calibrated_cell = placements(fitted, frame, tool)
    chain = nominal_cell.chain
    count, dof_note = _dof(targets, chain, dof)
    nominal_goal = Goal(nominal_cell, count, chain.lower, chain.upper)
    goal = Goal(calibrated_cell, count, chain.lower, chain.upper)
    if start is not None and not _inside(nominal_goal, np.asarray(start)):
        limits = f"{chain.lower.tolist()} to {chain.upper.tolist()}"
        raise UsageError(f"start {list(start)}: outside the joints' limits {limits} [rad, m]: state values within them")

    say("the nominal robot at the targets")
    poses, nominal_q = _reference(nominal_goal, targets, start, seed)
    say("the calibrated robot")
    q = _followed(goal, poses, nominal_q)
    residual = _sizes(differences(goal, q, poses))
    start_q = np.clip(nominal_q, chain.lower, chain.upper)
    nominal_residual = _sizes(differences(goal, start_q, poses))
    reached = _within(residual, tolerance) & _inside(nominal_goal, nominal_q)
    singular = conditions(goal, nominal_q) < SINGULAR
    extrapolated = np.zeros(q.shape, bool)
    if fitted.fitted_q is not None:
        extrapolated = np.atleast_2d(outside(q, fitted.fitted_q))
    rows = zip(reached, extrapolated, nominal_q, q, residual, singular)
    reasons = [_reason(chain, *row) for row in rows]

    say("sigmas")
    sigma, expected = _predicted_sigmas(fitted, q, frame, tool, goal)
    notes = [_frame_note(fitted, frame), finding("at-targets", tool=tool), dof_note, *_turn_note(fitted, count)]
    if fitted.load is not None and not fitted.cell.deflection.by_torque:
        notes.append(finding("load-not-modelled", mass=float(fitted.load[3])))
    arm_error = None
    if frame == "base" and fitted.placed:
        # the arm's own error, its base placed where it fits the measurements best
        placed_nominal, placed_cell = placements(fitted, "nominal", tool)
        nominal_poses = see(placed_nominal, start_q).poses()
        arm_error = _sizes(differences(replace(goal, cell=placed_cell), start_q, nominal_poses))
    return Commands(
        targets=targets,
        fitted=fitted,
        q=q,
        nominal=nominal_q,
        reached=reached,
        reason=tuple(reasons),
        left=residual,
        before=nominal_residual,
        sigma=sigma,
        expected=expected,
        beyond=extrapolated,
        dof=count,
        notes=tuple(lines_of(notes)),
        own=arm_error,
    )


def _inside(goal: Goal, q: np.ndarray) -> np.ndarray:
    above = q >= goal.lower - LIMIT_TOLERANCE
    below = q <= goal.upper + LIMIT_TOLERANCE
    return np.all(above & below, axis=-1)


def _followed(goal: Goal, poses: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Return joint values (m, n) near `start` (m, n) that reach the poses (m, 4, 4).

    Near a singularity, the motion away from `start` is limited, and the poses may not be reached.

    Args:
        goal: the arm with tool and joint limits, and the constrained pose components.
        poses: target poses.
        start: joint values [rad or m], one row per pose.
    """
    clipped = np.clip(start, goal.lower, goal.upper)
    q = nearest(goal, poses, clipped, reach(goal, poses, start))
    largest_correction = np.abs(q - start).max(axis=1, initial=0.0)
    excessive = np.flatnonzero(largest_correction > MAX_CORRECTION)
    q[excessive] = held_back(goal, poses[excessive], start[excessive], MAX_CORRECTION)
    return q


def _dof(targets: Targets, chain: Chain, requested: int | None) -> tuple[int, Finding]:
    """Return the number of constrained pose components (6, 5 or 3), and a finding that states it.

    Args:
        targets: the targets.
        chain: the arm.
        requested: number that the user requested; None: all components that the targets contain and the arm can reach.

    Raises:
        UsageError: another number, or more components than the targets contain.
    """
    joints_only = targets.q is not None and targets.position is None
    oriented = targets.rotation is not None or joints_only
    available = 6 if oriented else 3
    able = 3
    if chain.n >= 5:
        able = min(chain.n, 6)
    if requested not in (None, *DOF):
        raise UsageError(f"dof {requested}: expected 6, 5 (free to turn about the tool's z), or 3")
    if requested is not None and requested > available:
        columns = "qx, qy, qz, qw"
        raise UsageError(f"{targets.file}: the targets have no orientation; dof {requested} needs columns {columns}")
    dof = requested or min(available, able)
    # said where the arm's joints are what limits it
    joints = None
    if requested is None and able < available:
        joints = chain.n
    return dof, finding("what-counts", what=COMPONENTS[dof], joints=joints)


def _reference(goal: Goal, targets: Targets, start: Sequence[float] | None, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the poses (m, 4, 4) of the targets, and the nominal robot's joint values (m, n) there [rad or m].

    Args:
        goal: the nominal arm with tool and joint limits.
        targets: joint values or poses.
        start: (n,) joint values near which targets without joint values are sought; None: the middle of the limits.
        seed: seed of further starts.
    """
    if targets.position is None:
        assert targets.q is not None
        return see(goal.cell, targets.q).poses(), np.array(targets.q)
    poses = pose(targets.rotation, targets.position)
    if targets.q is not None:
        reached = reach(goal, poses, targets.q)
        clipped = np.clip(targets.q, goal.lower, goal.upper)
        return poses, nearest(goal, poses, clipped, reached)
    lower, upper = goal.cell.chain.sampling_limits()
    if start is None:
        middle = 0.5 * (lower + upper)
    else:
        middle = np.asarray(start, dtype=float)
    random_starts = np.random.default_rng(seed).uniform(lower, upper, (STARTS, len(lower)))
    return poses, _sought(goal, poses, middle, random_starts)


def _sought(goal: Goal, poses: np.ndarray, start: np.ndarray, starts: np.ndarray) -> np.ndarray:
    """Return the nominal robot's joint values (m, n) at the poses.

    Of several solutions, the nearest to `start` is returned.

    Args:
        goal: the nominal arm with tool and joint limits.
        poses: (m, 4, 4) target poses.
        start: (n,) joint values [rad or m] from which the search begins first.
        starts: (k, n) further joint values from which it begins.
    """
    best = np.tile(start, (len(poses), 1))
    cost = np.full(len(poses), np.inf)
    for first in (start, *starts):
        q = reach(goal, poses, np.tile(first, (len(poses), 1)))
        residual = _sizes(differences(goal, q, poses))
        travel = np.abs(q - start).max(axis=1)
        travel = np.where(_within(residual, TOLERANCE), travel, np.inf)
        better = travel < cost
        best[better] = q[better]
        cost[better] = travel[better]
    return best


def _sizes(difference: np.ndarray) -> np.ndarray:
    """Return position [m] and orientation [rad] errors (m, 2), the norms of pose differences (m, 3 or 6).

    The orientation error is NaN where the differences have positions only.
    """
    position = np.linalg.norm(difference[:, :3], axis=1)
    turn = np.full(len(position), np.nan)
    if difference.shape[1] > 3:
        turn = np.linalg.norm(difference[:, 3:], axis=1)
    return np.stack([position, turn], axis=1)


def _within(sizes: np.ndarray, tolerance: tuple[float, float]) -> np.ndarray:
    """Return whether each row of errors is within the tolerance, (m,) bool.

    Args:
        sizes: (m, 2) position [m] and orientation [rad] errors; an orientation error of NaN is within any tolerance.
        tolerance: largest position [m] and orientation [rad] error.
    """
    position, turn = sizes.T
    return (position <= tolerance[0]) & ~(turn > tolerance[1])


def _reason(
    chain: Chain,
    reached: bool,
    extrapolated: np.ndarray,
    nominal: np.ndarray,
    q: np.ndarray,
    residual: np.ndarray,
    singular: bool,
) -> str:
    """Return why a target is not reached; for a reached target, the joints beyond the measured range, else empty.

    Args:
        chain: the nominal arm.
        reached: whether the target is reached.
        extrapolated: (n,) True for joints outside the range of the fitted poses.
        nominal: (n,) joint values of the nominal robot at the target [rad or m].
        q: (n,) joint command [rad or m].
        residual: (2,) position [m] and orientation [rad] errors of the command.
        singular: whether the command was limited near a singularity.
    """
    if reached:
        names = [name for name, out in zip(chain.joint_names, extrapolated) if out]
        if not names:
            return ""
        return sentence(finding("command-extrapolates", joints=names))
    for joint, value in zip(chain.joints, nominal):
        if not joint.lower - LIMIT_TOLERANCE <= value <= joint.upper + LIMIT_TOLERANCE:
            limits = {"low": joint.lower, "high": joint.upper}
            return sentence(finding("target-outside-limits", joint=joint.name, value=value, **limits))
    position_error, turn_error = residual
    figures = {"left": position_error, "turn": None if np.isnan(turn_error) else turn_error}
    at_limit = [joint.name for joint, value in zip(chain.joints, q) if value <= joint.lower or value >= joint.upper]
    if at_limit:
        return sentence(finding("at-limit", joints=at_limit, **figures))
    code = "out-of-reach"
    if singular and position_error < ASTRAY:
        code = "near-singularity"
    return sentence(finding(code, most=MAX_CORRECTION, **figures))


def _predicted_sigmas(
    fitted: Fitted, q: np.ndarray, frame: str, tool: str, goal: Goal
) -> tuple[np.ndarray, np.ndarray]:
    """Return the tool's sigmas (m, 2) due to the parameters' covariance, and expected errors (m, 2), as in `Commands`.

    A tool whose placement was not fitted counts as exactly known.

    Args:
        fitted: the calibrated arm and its cell.
        q: (m, n) joint commands [rad or m].
        frame, tool: frame of the targets, and tool at them, as for `placements`.
        goal: the calibrated arm with the tool, and the constrained pose components.
    """
    cell, free, covariance = fitted.cell, fitted.free, fitted.covariance
    if tool in cell.tool_names:
        tool_index = cell.tool_names.index(tool)
    else:
        tool_index = 0
        arm_columns = ~np.isin(free, layout(cell).index("tool"))
        free, covariance = free[arm_columns], covariance[np.ix_(arm_columns, arm_columns)]
        cell = replace(cell, tools=np.repeat(goal.cell.tools, len(cell.tools), axis=0))
    station = -1 if frame == "base" else _station(fitted, frame)
    torque = None if goal.torques is None else goal.torques(q)
    load = None if fitted.load is None else np.tile(fitted.load, (len(q), 1))
    poses = PoseMeasurements(q, cell.chain.joint_names, torque=torque, load=load)
    parameter_sigma = pose_sigmas(cell, poses, free, covariance, station, tool_index)
    if goal.dof == 3:
        parameter_sigma[:, 1] = np.nan
    if fitted.fitted_q is None or fitted.discrepancy is None:
        return parameter_sigma, np.full((len(q), 2), np.nan)
    errors = ErrorModel(cell, free, covariance, fitted.fitted_q, fitted.discrepancy)
    sigma = errors.position_sigma(poses, station, tool_index)
    return parameter_sigma, np.column_stack([sigma, fitted.discrepancy.radius * sigma])


def _frame_note(fitted: Fitted, frame: str) -> Finding:
    """Return the finding that names the targets' frame.

    It includes the distance between the frames ``base`` and ``nominal``.

    Args:
        fitted: the calibrated arm and its cell.
        frame: ``base``, ``nominal``, or the name of a station.
    """
    if frame not in ("base", "nominal"):
        return finding("targets-in-station", station=frame)
    shift = turn = None
    if fitted.placed:
        between = invert(fitted.nominal.stations[0]) @ fitted.cell.stations[0]
        shift = np.linalg.norm(between[:3, 3])
        turn = np.linalg.norm(rotation_vector(between[:3, :3]))
    code = "targets-in-base" if frame == "base" else "targets-in-nominal-base"
    return finding(code, shift=shift, turn=turn)


def _turn_note(fitted: Fitted, dof: int) -> list[Finding]:
    """Return a finding if orientations are constrained although none was measured for the fit; else an empty list.

    Args:
        fitted: the calibrated arm and its cell.
        dof: number of constrained pose components.
    """
    table = layout(fitted.cell)
    measured = np.intersect1d(fitted.free, table.index("tool"))
    axes = {table.names[k].rsplit(".", 1)[-1] for k in measured}
    if dof == 3 or axes & {"rx", "ry", "rz"}:
        return []
    return [finding("no-orientations-measured")]


def _unreached(commands: Commands) -> list[str]:
    """Return one line for each target that the joint commands do not reach, with the reason.

    At most `MAX_LISTED` lines are returned.
    """
    lost = np.flatnonzero(~commands.reached)
    result = [f"target {k + 1}: {commands.reason[k]}" for k in lost[:MAX_LISTED]]
    if len(lost) > MAX_LISTED:
        result.append(f"{len(lost) - MAX_LISTED} more")
    return result


def write(commands: Commands, out: Path, partial: bool = False) -> Path:
    """Write the commands as CSV (format of `calib.data.poses.pose_lists`) and return its path.

    Args:
        out: the CSV file.
        partial: also write the commands if some targets are not reached.

    Raises:
        UsageError: no target is reached, or, without `partial`, some are not; nothing is written.
    """
    fitted, targets = commands.fitted, commands.targets
    count = len(commands.q)
    lost = int(np.sum(~commands.reached))
    if lost and (not partial or lost == count):
        head = f"{targets.file}: {lost} of {count} targets are not reached; nothing was written"
        message = "\n  ".join([head, *_unreached(commands)])
        if lost != count:
            message += "\nwith partial (--partial), all other rows are written, and those above stay empty"
        raise UsageError(message)

    q = commands.q / (targets.factors or 1.0)
    q[~commands.reached] = np.nan
    unseen = np.full(count, np.nan if fitted.unseen is None else fitted.unseen)
    errors_mm = 1e3 * np.column_stack([commands.left, commands.before, commands.sigma, unseen, commands.expected])
    extrapolated = np.full(count, np.nan)
    if fitted.fitted_q is not None:
        extrapolated = commands.beyond.any(axis=1).astype(float)
    rows = []
    for k in range(count):
        status = "reached" if commands.reached[k] else "not reached"
        rows.append([k + 1, *q[k], status, *errors_mm[k], extrapolated[k], commands.reason[k]])
    names = targets.columns or fitted.cell.chain.joint_names
    return files.write_table(out, ["row", *names, "status", *COLUMNS, "reason"], rows)


def lines(commands: Commands) -> list[str]:
    """Return the console lines on joint commands.

    They are notes on frames, targets that are not reached, and errors before and after compensation.

    Args:
        commands: the joint commands.
    """
    reached, targets, fitted = commands.reached, commands.targets, commands.fitted
    result = [*commands.notes, *targets.notes]
    if targets.ignored:
        result.append(f"ignored columns of {targets.file}: {', '.join(targets.ignored)}")
    result += [f"not reached: {reason}" for reason in _unreached(commands)]

    count = int(reached.sum())
    arm_error = None
    if commands.own is not None:
        arm_error = _rms_pair(commands.own[reached])
    compensated = finding(
        "compensated",
        count=count,
        before=_rms_pair(commands.before[reached]),
        own=arm_error,
        left=_rms_pair(commands.left[reached]),
        sigma=_rms_pair(commands.sigma[reached]),
    )
    findings = [compensated, _expectation(commands)]
    out = commands.beyond & reached[:, None]
    if out.any():
        joints = np.flatnonzero(out.any(axis=0))
        names = [fitted.cell.chain.joint_names[j] for j in joints]
        out_count = int(out.any(axis=1).sum())
        findings.append(finding("commands-extrapolate", count=out_count, of=count, joints=names))
    moves = np.abs(commands.q - commands.nominal)[reached]
    findings.append(finding("joints-move", most=moves.max(initial=0.0)))
    return [*result, *lines_of(findings)]


def _expectation(commands: Commands) -> Finding:
    """Return the finding on the position error to be expected of the real arm at the targets of joint commands.

    The error is that of the error model, or, without a model, the rms error at held-out poses.
    """
    reached, unseen = commands.reached, commands.fitted.unseen
    if not np.isnan(commands.expected).all():
        sigma, radius = commands.expected[reached].T
        rms = np.sqrt(np.mean(sigma**2))
        return finding("expected-at-targets", rms=rms, within=radius.max(), unseen=unseen)
    if unseen is None:
        return finding("nothing-unseen", fitted=commands.fitted.fitted)
    code = "expected-as-unseen"
    if commands.beyond[reached].any():
        code = "expected-beyond-range"
    return finding(code, unseen=unseen)


def _rms_pair(errors: np.ndarray) -> str:
    """Return the rms over m targets of position [m] and orientation [rad] errors (m, 2) as text."""
    position, turn = np.sqrt(np.mean(errors**2, axis=0))
    text = f"{1e3 * position:.3g} mm"
    if not np.isnan(turn):
        text += f" and {1e3 * turn:.3g} mrad"
    return text
