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
from calib.data.poses.measurements import PoseMeasurements
from calib.data.poses.pose_lists import Targets
from calib.errors import Finding, UsageError, finding
from calib.geometry import installation, inverse
from calib.geometry.error_model import Discrepancy, ErrorModel, outside
from calib.geometry.installation import Installation, see
from calib.geometry.inverse import Goal
from calib.geometry.observation import layout, pose_sigmas
from calib.procedure.findings import lines_of, sentence
from calib.procedure.kinematic_stage.folder import VALIDATED, ValidationFolder
from calib.procedure.kinematic_stage.tables import read_covariance
from calib.robot.calibrated import Deflection
from calib.robot.chain import Chain
from calib.toolkit.opened_results import open_result
from calib.transforms import from_xyz_rpy, invert, pose, rotation_vector

TOLERANCE = (1e-6, 1e-5)  # position [m] and orientation [rad] that a command may leave; our choice, as what follows
MAX_CORRECTION = 0.2  # correction of one joint [rad or m] beyond which the arm is held back: it is near a singularity
SINGULAR = 0.02  # singular values of the Jacobian, smallest over largest
ASTRAY = 0.01  # further from a target than this no singularity is to blame [m]
LIMIT_TOLERANCE = 1e-9  # [rad or m]
STARTS = 24  # random starts for each target without joints
COMPONENTS = {6: "position and orientation", 5: "position and the direction of the tool's z axis", 3: "position only"}


@dataclass(frozen=True, eq=False)
class Fitted:
    """Calibrated arm and its cell, read from the folder of a fit.

    Attributes:
        cell: the calibrated installation, deflections included.
        nominal: the nominal one, placed to fit the same measurements best; without stations if that is unknown.
        free, covariance: of the fit's parameters, see `read_covariance`.
        unseen: rms error of the calibrated arm on unseen poses [m]; None without such poses.
        fitted: rms error on the fitted poses [m].
        learnt: (k, n) poses that were fitted [rad or m], and `discrepancy`: what makes errors at others likely; None
            where the fit does not say.
    """

    folder: Path
    cell: Installation
    nominal: Installation
    free: np.ndarray
    covariance: np.ndarray
    unseen: float | None
    fitted: float | None
    learnt: np.ndarray | None = None
    discrepancy: Discrepancy | None = None

    @property
    def placed(self) -> bool:
        """Whether the fit contains the placement of the nominal robot."""
        return bool(len(self.nominal.stations)) and set(self.cell.station_names) <= set(self.nominal.station_names)


@dataclass(frozen=True, eq=False)
class Commands:
    """Joint commands for m targets.

    Attributes:
        targets, fitted: what was asked for, of which robot in its cell.
        q: (m, n) joint values [rad or m]; for a target that is not reached, as near as the arm came.
        nominal: (m, n) those of the nominal robot.
        reached: (m,).
        reason: (m,) why not; "" where reached.
        left, before: (m, 2) position [m] and orientation [rad] left at ``q``, and at ``nominal``; NaN for an
            orientation that does not count.
        sigma: (m, 2) of position [m] and orientation [rad] at ``q``, from the parameters' covariance.
        expected: (m, 2) standard deviation of the real tool's position error at ``q`` [m], all that the model leaves
            included, and the radius within which 95 % of such errors are to be; NaN where the fit does not say.
        beyond: (m, n) joints outside the range that was measured for the fit; none where that is not known.
        dof: 6, 5 or 3.
        notes: which frames were meant, and what is odd.
        own: (m, 2) of ``before`` what is the arm's own, its base placed where it fits the measurements best; None where
            ``before`` is that, or where nobody knows.
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
    """Read the folder of a fit, or of a session that contains a fit.

    Raises:
        UsageError: where it is none, or lacks something.
    """
    result = open_result(folder, "compensate")
    fit = result.fit("compensate")
    if fit is None:
        result.refuse("compensate")
    proof = ValidationFolder(Path(folder) / VALIDATED)
    cell, nominal = installation.read_arms(fit.path)
    free, covariance = read_covariance(fit.path, cell)
    metrics = fit.metrics()
    judged_metrics = proof.metrics() if proof.judged.is_file() else metrics
    accuracies = [metrics.fit.calibrated, *(errors.calibrated for errors in judged_metrics.validation.values())]
    rms = [1e-3 * accuracy.main.rms for accuracy in accuracies if accuracy.main]
    unseen = max(rms[1:], default=None)
    fitted = rms[0] if rms else None
    fitted_joints = fit.learnt_joints(cell.chain.joints)
    discrepancy = None
    if metrics.findings is not None:
        discrepancy = metrics.findings.discrepancy
    return Fitted(fit.path, cell, nominal, free, covariance, unseen, fitted, fitted_joints, discrepancy)


def placements(fitted: Fitted, frame: str = "base", tool: str = "flange") -> tuple[Installation, Installation]:
    """Return the nominal and the calibrated arm in the frame of the targets, each with a single station and tool.

    Args:
        fitted: see `read`.
        frame, tool: as the module says.

    Raises:
        UsageError: for a frame or tool that the fit does not have.
    """
    cell, nominal = fitted.cell, fitted.nominal
    tool_pose = _tool(cell, tool)
    if frame == "base":
        stations, behind = (np.eye(4), np.eye(4)), np.eye(4)
    else:
        k = _station(fitted, frame)
        t = cell.tool_names.index(tool) if tool in cell.tool_names else 0
        stations = nominal.stations[k], cell.stations[k]
        behind = nominal.tools[t] @ invert(cell.tools[t])  # the nominal robot's flange need not be the calibrated one's
        if frame == "nominal":
            stations = np.eye(4), invert(stations[0]) @ stations[1]
    tools = behind @ tool_pose, tool_pose
    arms = replace(nominal, deflection=Deflection()), cell
    nominal_arm, calibrated_arm = (
        replace(arm, stations=s[None], tools=t[None], station_names=(frame,), tool_names=(tool,))
        for arm, s, t in zip(arms, stations, tools)
    )
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

    The nominal robot says which configuration is meant; from there the calibrated one is led to the target, joints
    moving as little as they can. Where one would move by more than `MAX_CORRECTION`, the arm is near a singularity:
    it is held back, and what is left is said.

    Args:
        fitted: see `read`.
        targets: joints or poses.
        frame, tool: as the module says.
        dof: how much of a pose counts, see `calib.geometry.inverse.Goal`; None for all that the targets say and the arm
            can do.
        start: (n,) where a target without joints is sought from [rad or m]; None for the middle of the limits.
        tolerance: position [m] and orientation [rad] that a command may leave.
        seed: of further starts, where the first one fails.

    Raises:
        UsageError: for a tolerance that is none, and a start beyond the limits.
    """
    if not (np.isfinite(tolerance).all() and min(tolerance) > 0.0):
        text = f"{1e3 * tolerance[0]:g} mm, {1e3 * tolerance[1]:g} mrad"
        raise UsageError(f"tolerance {text}: expected two numbers above 0")
    say = progress or (lambda message: None)
    nominal_cell, calibrated_cell = placements(fitted, frame, tool)
    count, note = _dof(targets, nominal_cell.chain, dof)
    lower, upper = nominal_cell.chain.lower, nominal_cell.chain.upper
    before, after = Goal(nominal_cell, count, lower, upper), Goal(calibrated_cell, count, lower, upper)
    if start is not None and not _inside(before, np.asarray(start)):
        raise UsageError(f"start {list(start)}: outside the joints' limits {lower.tolist()} to {upper.tolist()}")
    say("the nominal robot at the targets")
    poses, q0 = _reference(before, targets, start, seed)
    say("the calibrated robot")
    start_q, q = np.clip(q0, lower, upper), _followed(after, poses, q0)
    residual, missed = (_sizes(inverse.differences(after, joint_values, poses)) for joint_values in (q, start_q))
    reached = _within(residual, tolerance) & _inside(before, q0)
    singular = inverse.conditions(after, q0) < SINGULAR
    extrapolated = np.zeros(q.shape, bool) if fitted.learnt is None else np.atleast_2d(outside(q, fitted.learnt))
    reason = tuple(_reason(nominal_cell.chain, *row) for row in zip(reached, extrapolated, q0, q, residual, singular))
    say("sigmas")
    sigma, expected = _predicted_sigmas(fitted, q, frame, tool, after)
    notes = (_frame_note(fitted, frame), finding("at-targets", tool=tool), note, *_turn_note(fitted, count))
    arm_error = None
    if frame == "base" and fitted.placed:
        placed, real = placements(fitted, "nominal", tool)
        arm_error = _sizes(inverse.differences(replace(after, cell=real), start_q, see(placed, start_q).poses()))
    return Commands(
        targets,
        fitted,
        q,
        q0,
        reached,
        reason,
        residual,
        missed,
        sigma,
        expected,
        extrapolated,
        count,
        tuple(lines_of(notes)),
        arm_error,
    )


def _inside(goal: Goal, q: np.ndarray) -> np.ndarray:
    return np.all((q >= goal.lower - LIMIT_TOLERANCE) & (q <= goal.upper + LIMIT_TOLERANCE), axis=-1)


def _followed(goal: Goal, poses: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Return joint values (m, n) near `start` that reach the poses; near a singularity they stay close to `start`."""
    q = inverse.nearest(goal, poses, np.clip(start, goal.lower, goal.upper), inverse.reach(goal, poses, start))
    excessive = np.flatnonzero(np.abs(q - start).max(axis=1, initial=0.0) > MAX_CORRECTION)
    q[excessive] = inverse.held_back(goal, poses[excessive], start[excessive], MAX_CORRECTION)
    return q


def _dof(targets: Targets, chain: Chain, requested: int | None) -> tuple[int, Finding]:
    """Return the number of pose components (6, 5 or 3) that targets determine, and the finding on it."""
    oriented = targets.rotation is not None or (targets.q is not None and targets.position is None)
    available = 6 if oriented else 3
    able = 3
    if chain.n >= 5:
        able = min(chain.n, 6)
    if requested not in (None, *inverse.DOF):
        raise UsageError(f"dof {requested}: expected 6, 5 (free to turn about the tool's z), or 3")
    if requested is not None and requested > available:
        columns = "qx, qy, qz, qw"
        raise UsageError(f"{targets.file}: the targets have no orientation; dof {requested} needs columns {columns}")
    dof = requested or min(available, able)
    joints = chain.n if requested is None and able < available else None
    return dof, finding("what-counts", what=COMPONENTS[dof], joints=joints)


def _reference(goal: Goal, targets: Targets, start: Sequence[float] | None, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the targets' poses (m, 4, 4) and the nominal robot's joint positions (m, n) at them."""
    if targets.position is None:
        assert targets.q is not None
        return see(goal.cell, targets.q).poses(), np.array(targets.q)
    poses = pose(targets.rotation, targets.position)
    if targets.q is not None:
        reached = inverse.reach(goal, poses, targets.q)
        return poses, inverse.nearest(goal, poses, np.clip(targets.q, goal.lower, goal.upper), reached)
    lower, upper = goal.cell.chain.sampling_limits()
    middle = 0.5 * (lower + upper) if start is None else np.asarray(start, dtype=float)
    starts = np.random.default_rng(seed).uniform(lower, upper, (STARTS, len(lower)))
    return poses, _sought(goal, poses, middle, starts)


def _sought(goal: Goal, poses: np.ndarray, start: np.ndarray, starts: np.ndarray) -> np.ndarray:
    """Return the nominal robot's joint positions (m, n): of several solutions, the one nearest to `start`."""
    best, cost = np.tile(start, (len(poses), 1)), np.full(len(poses), np.inf)
    for first in (start, *starts):
        q = inverse.reach(goal, poses, np.tile(first, (len(poses), 1)))
        met = _within(_sizes(inverse.differences(goal, q, poses)), TOLERANCE)
        travel = np.where(met, np.abs(q - start).max(axis=1), np.inf)
        better = travel < cost
        best[better], cost[better] = q[better], travel[better]
    return best


def _sizes(difference: np.ndarray) -> np.ndarray:
    """Return the lengths (m, 2) of position [m] and orientation [rad] differences; NaN without orientations."""
    position = np.linalg.norm(difference[:, :3], axis=1)
    turn = np.linalg.norm(difference[:, 3:], axis=1) if difference.shape[1] > 3 else np.full(len(position), np.nan)
    return np.stack([position, turn], axis=1)


def _within(sizes: np.ndarray, tolerance: tuple[float, float]) -> np.ndarray:
    return (sizes[:, 0] <= tolerance[0]) & ~(sizes[:, 1] > tolerance[1])


def _reason(
    chain: Chain,
    good: bool,
    extrapolated: np.ndarray,
    nominal: np.ndarray,
    q: np.ndarray,
    residual: np.ndarray,
    singular: bool,
) -> str:
    """Return why a target is not reached, or which of its joint values are outside the measured range; else ""."""
    if good:
        names = [name for name, out in zip(chain.joint_names, extrapolated) if out]
        return sentence(finding("command-extrapolates", joints=names)) if names else ""
    figures = {"left": residual[0], "turn": None if np.isnan(residual[1]) else residual[1]}
    for name, value, low, high in zip(chain.joint_names, nominal, chain.lower, chain.upper):
        if not low - LIMIT_TOLERANCE <= value <= high + LIMIT_TOLERANCE:
            return sentence(finding("target-outside-limits", joint=name, value=value, low=low, high=high))
    if at := [name for name, v, j in zip(chain.joint_names, q, chain.joints) if v <= j.lower or v >= j.upper]:
        return sentence(finding("at-limit", joints=at, **figures))
    code = "near-singularity" if singular and residual[0] < ASTRAY else "out-of-reach"
    return sentence(finding(code, most=MAX_CORRECTION, **figures))


def _predicted_sigmas(
    fitted: Fitted, q: np.ndarray, frame: str, tool: str, goal: Goal
) -> tuple[np.ndarray, np.ndarray]:
    """Return the tool's sigmas (m, 2) due to the parameters, and the tool's expected errors (m, 2), see `Commands`.

    Where the fit did not place the tool, it counts as known.
    """
    cell, free, covariance = fitted.cell, fitted.free, fitted.covariance
    number = cell.tool_names.index(tool) if tool in cell.tool_names else 0
    if tool not in cell.tool_names:
        keep = ~np.isin(free, layout(cell).index("tool"))
        free, covariance = free[keep], covariance[np.ix_(keep, keep)]
        cell = replace(cell, tools=np.repeat(goal.cell.tools, len(cell.tools), axis=0))
    poses = PoseMeasurements(q, cell.chain.joint_names, torque=None if goal.torques is None else goal.torques(q))
    station = -1 if frame == "base" else _station(fitted, frame)
    parameter_sigma = pose_sigmas(cell, poses, free, covariance, station, number)
    parameter_sigma[:, 1] = np.nan if goal.dof == 3 else parameter_sigma[:, 1]
    if fitted.learnt is None or fitted.discrepancy is None:
        return parameter_sigma, np.full((len(q), 2), np.nan)
    errors = ErrorModel(cell, free, covariance, fitted.learnt, fitted.discrepancy)
    sigma = errors.position_sigma(poses, station, number)
    return parameter_sigma, np.column_stack([sigma, fitted.discrepancy.radius * sigma])


def _frame_note(fitted: Fitted, frame: str) -> Finding:
    """Return the note on the frame of the targets, with the distance to the alternative frame."""
    if frame not in ("base", "nominal"):
        return finding("targets-in-station", station=frame)
    shift = turn = None
    if fitted.placed:
        between = invert(fitted.nominal.stations[0]) @ fitted.cell.stations[0]
        shift, turn = np.linalg.norm(between[:3, 3]), np.linalg.norm(rotation_vector(between[:3, :3]))
    return finding("targets-in-base" if frame == "base" else "targets-in-nominal-base", shift=shift, turn=turn)


def _turn_note(fitted: Fitted, dof: int) -> list[Finding]:
    """Return a finding if targets have orientations, but no orientation was measured."""
    table = layout(fitted.cell)
    measured = {table.names[k] for k in np.intersect1d(fitted.free, table.index("tool"))}
    if dof == 3 or any(name.rsplit(".", 1)[-1] in ("rx", "ry", "rz") for name in measured):
        return []
    return [finding("no-orientations-measured")]


SHOWN = 20  # targets that a message lists
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


def _unreached(commands: Commands) -> list[str]:
    """Return one line for each target that is not reached, with the reason; at most `SHOWN` lines."""
    lost = np.flatnonzero(~commands.reached)
    result = [f"target {k + 1}: {commands.reason[k]}" for k in lost[:SHOWN]]
    if len(lost) > SHOWN:
        result.append(f"{len(lost) - SHOWN} more")
    return result


def write(commands: Commands, out: Path, partial: bool = False) -> Path:
    """Write COMMANDS.csv, see `calib.data.poses.pose_lists`.

    Raises:
        UsageError: where targets are not reached and `partial` does not allow that; nothing is written.
    """
    fitted, targets = commands.fitted, commands.targets
    lost, count = int(np.sum(~commands.reached)), len(commands.q)
    if lost and (not partial or lost == count):
        advice = "" if lost == count else "\nwith partial (--partial), all other rows are written and these stay empty"
        head = f"{targets.file}: {lost} of {count} targets are not reached; nothing was written"
        raise UsageError("\n  ".join([head, *_unreached(commands)]) + advice)
    names = targets.columns or fitted.cell.chain.joint_names
    q = np.where(commands.reached[:, None], commands.q / (targets.factors or 1.0), np.nan)
    unseen = np.full(count, np.nan if fitted.unseen is None else fitted.unseen)
    extrapolated = np.full(count, np.nan) if fitted.learnt is None else commands.beyond.any(axis=1)
    sizes = 1e3 * np.column_stack([commands.left, commands.before, commands.sigma, unseen, commands.expected])
    statuses = np.where(commands.reached, "reached", "not reached").tolist()
    columns = zip(q, statuses, sizes, extrapolated.astype(float), commands.reason)
    rows = [
        (k, *joints, status, *cells, outside_range, reason)
        for k, (joints, status, cells, outside_range, reason) in enumerate(columns, 1)
    ]
    return files.write_table(out, ["row", *names, "status", *COLUMNS, "reason"], rows)


def lines(commands: Commands) -> list[str]:
    """Return the lines for the user: frames, targets that are not reached, errors before and after."""
    good, targets, fitted = commands.reached, commands.targets, commands.fitted
    result = [*commands.notes, *targets.notes]
    if targets.ignored:
        result.append(f"ignored columns of {targets.file}: {', '.join(targets.ignored)}")
    result += [f"not reached: {reason}" for reason in _unreached(commands)]
    before = _rms_pair(commands.before[good])
    residual = _rms_pair(commands.left[good])
    sigma = _rms_pair(commands.sigma[good])
    arm_error = None if commands.own is None else _rms_pair(commands.own[good])
    findings = [
        finding("compensated", count=int(good.sum()), before=before, own=arm_error, left=residual, sigma=sigma),
        _expectation(commands),
    ]
    out = commands.beyond & good[:, None]
    if out.any():
        names = [fitted.cell.chain.joint_names[j] for j in np.unique(np.nonzero(out)[1])]
        count = int(out.any(axis=1).sum())
        findings.append(finding("commands-extrapolate", count=count, of=int(good.sum()), joints=names))
    largest_move = np.abs(commands.q - commands.nominal)[good].max(initial=0.0)
    return [*result, *lines_of([*findings, finding("joints-move", most=largest_move)])]


def _expectation(commands: Commands) -> Finding:
    """Return the finding on the expected error of the real arm at these targets, by the error model if available."""
    good, unseen = commands.reached, commands.fitted.unseen
    if not np.isnan(commands.expected).all():
        rms, within = np.sqrt(np.mean(commands.expected[good, 0] ** 2)), commands.expected[good, 1].max()
        return finding("expected-at-targets", rms=rms, within=within, unseen=unseen)
    if unseen is None:
        return finding("nothing-unseen", fitted=commands.fitted.fitted)
    code = "expected-beyond-range" if commands.beyond[good].any() else "expected-as-unseen"
    return finding(code, unseen=unseen)


def _rms_pair(errors: np.ndarray) -> str:
    """Return the rms of errors (m, 2) in position [m] and orientation [rad], for the user."""
    values = np.sqrt(np.mean(errors**2, axis=0))
    turn = "" if np.isnan(values[1]) else f" and {1e3 * values[1]:.3g} mrad"
    return f"{1e3 * values[0]:.3g} mm{turn}"
