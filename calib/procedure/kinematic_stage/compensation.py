"""Nominal targets turned into the joint commands that put the real tool there.

Frames are a matter of convention, since an arm that is measured from outside tells neither its base nor its flange from
the placement of the instrument and of the target:

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
from calib.data.poses.pose_lists import Targets
from calib.errors import UsageError
from calib.geometry import installation, inverse
from calib.geometry.installation import Installation, see
from calib.geometry.inverse import Goal
from calib.geometry.observation import pose_sigmas
from calib.geometry.parameters import layout
from calib.geometry.uncertainty.error_model import Discrepancy, ErrorModel, outside
from calib.procedure.kinematic_stage.folder import IN_SESSION, VALIDATED, FitFolder, ValidationFolder
from calib.procedure.kinematic_stage.tables import read_covariance
from calib.robot.calibrated import Deflection
from calib.robot.chain import Chain
from calib.transforms import from_xyz_rpy, invert, pose, rotation_vector

TOLERANCE = (1e-6, 1e-5)  # position [m] and orientation [rad] that a command may leave; our choice, as what follows
MAX_CORRECTION = 0.2  # correction of one joint [rad or m] beyond which the arm is held back: it is near a singularity
SINGULAR = 0.02  # singular values of the Jacobian, smallest over largest
ASTRAY = 0.01  # further from a target than this no singularity is to blame [m]
LIMIT_TOLERANCE = 1e-9  # [rad or m]
STARTS = 24  # random starts for each target without joints


@dataclass(frozen=True, eq=False)
class Fitted:
    """What a fit's folder says of the arm in its cell.

    Attributes:
        cell: the calibrated installation, deflections included.
        nominal: the nominal one, placed to fit the same measurements best; without stations where that is not known.
        free, covariance: of the fit's parameters, see `read_covariance`.
        unseen: rms error of the calibrated arm on poses that were not fitted [m]; None where there were none.
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


@dataclass(frozen=True, eq=False)
class Commands:
    """What to send for m targets.

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
            included, and the radius within which 95 % of such errors are to be; None where the fit does not say.
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
    expected: np.ndarray | None
    beyond: np.ndarray
    dof: int
    notes: tuple[str, ...]
    own: np.ndarray | None = None


def read(folder: str | Path) -> Fitted:
    """Read the folder of a fit (or of a session that has one).

    Raises:
        UsageError: where it is none, or lacks something.
    """
    session, fit = Path(folder), FitFolder(Path(folder))
    inside, proof = FitFolder(session / IN_SESSION), ValidationFolder(session / VALIDATED)
    fit = inside if inside.robot.is_file() and not fit.robot.is_file() else fit
    if not fit.robot.is_file():
        raise UsageError(f"{fit.path} holds no robot.toml; give the folder that `calib fit --out` has written")
    cell, nominal = installation.read_arms(fit.path)
    free, covariance = read_covariance(fit.path, cell)
    own = fit.metrics()
    judged = proof.metrics() if proof.judged.is_file() else own
    rms = [1e-3 * one.calibrated.main.rms for one in (own.fit, *judged.validation.values()) if one.calibrated.main]
    unseen, fitted = max(rms[1:], default=None), rms[0] if rms else None
    learnt, known = fit.learnt_joints(cell.chain.joints), None if own.findings is None else own.findings.discrepancy
    return Fitted(fit.path, cell, nominal, free, covariance, unseen, fitted, learnt, known)


def placements(fitted: Fitted, frame: str = "base", tool: str = "flange") -> tuple[Installation, Installation]:
    """Return the nominal and the calibrated arm with one station and one tool each, seen from one frame.

    Args:
        fitted: see `read`.
        frame, tool: as the module says.

    Raises:
        UsageError: for a frame or tool that the fit does not have.
    """
    cell, nominal = fitted.cell, fitted.nominal
    where = _tool(cell, tool)
    if frame == "base":
        stations, behind = (np.eye(4), np.eye(4)), np.eye(4)
    else:
        k = _station(fitted, frame)
        t = cell.tool_names.index(tool) if tool in cell.tool_names else 0
        stations = nominal.stations[k], cell.stations[k]
        behind = nominal.tools[t] @ invert(cell.tools[t])  # the nominal robot's flange need not be the calibrated one's
        if frame == "nominal":
            stations = np.eye(4), invert(stations[0]) @ stations[1]
    tools = behind @ where, where
    arms = replace(nominal, deflection=Deflection()), cell
    one, two = (
        replace(arm, stations=s[None], tools=t[None], station_names=(frame,), tool_names=(tool,))
        for arm, s, t in zip(arms, stations, tools)
    )
    return one, two


def _is_placed(fitted: Fitted) -> bool:
    """Say whether it is known where the nominal robot stood."""
    return bool(len(fitted.nominal.stations)) and set(fitted.cell.station_names) <= set(fitted.nominal.station_names)


def _station(fitted: Fitted, frame: str) -> int:
    names = fitted.cell.station_names
    if frame not in ("nominal", *names):
        raise UsageError(f"frame {frame}: expected base, nominal, or a station of the fit ({', '.join(names)})")
    if not _is_placed(fitted):
        raise UsageError(
            f"{fitted.folder} does not say where the nominal robot stood (it was fitted from an earlier fit's folder, "
            "by an earlier version, or without an instrument): frame 'base' is left"
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


def compensate(
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
    """Return the joint commands that put the real tool on the targets.

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
        raise UsageError(
            f"tolerance {1e3 * tolerance[0]:g} mm, {1e3 * tolerance[1]:g} mrad: expected two sizes above 0"
        )
    say = progress or (lambda words: None)
    one, two = placements(fitted, frame, tool)
    count, notes = _dof(targets, one.chain, dof)
    lower, upper = one.chain.lower, one.chain.upper
    if (
        start is not None
        and not ((np.asarray(start) >= lower - LIMIT_TOLERANCE) & (np.asarray(start) <= upper + LIMIT_TOLERANCE)).all()
    ):
        raise UsageError(f"start {list(start)}: beyond the joints' limits {lower.tolist()} to {upper.tolist()}")
    before = Goal(one, count, lower, upper)
    after = Goal(two, count, lower, upper, torques_of(fitted))
    say("the nominal robot at the targets")
    wanted, q0 = _wanted(before, targets, start, seed)
    say("the calibrated robot")
    q = inverse.reach(after, wanted, q0)
    q = inverse.nearest(after, wanted, np.clip(q0, lower, upper), q)
    far = np.flatnonzero(np.abs(q - q0).max(axis=1, initial=0.0) > MAX_CORRECTION)
    q[far] = inverse.held_back(after, wanted[far], q0[far], MAX_CORRECTION)
    left = _sizes(inverse.differences(after, q, wanted))
    reached = _within(left, tolerance) & ((q0 >= lower - LIMIT_TOLERANCE) & (q0 <= upper + LIMIT_TOLERANCE)).all(axis=1)
    singular = inverse.conditions(after, q0) < SINGULAR
    reason = tuple("" if good else _why(one.chain, *row) for good, *row in zip(reached, q0, q, left, singular))
    say("sigmas")
    sigma, expected = _predicted_sigmas(fitted, q, frame, tool, after)
    beyond = np.zeros(q.shape, bool) if fitted.learnt is None else outside(q, fitted.learnt)
    reason = tuple(why or _extrapolates(one.chain, row) for why, row in zip(reason, np.atleast_2d(beyond)))
    missed = _sizes(inverse.differences(after, np.clip(q0, lower, upper), wanted))
    if count == 3:
        sigma[:, 1] = np.nan
    words = (_frame_words(fitted, frame), _tool_words(tool), *notes, *_turn_words(fitted, count))
    own = None
    if frame == "base" and _is_placed(fitted):
        placed, real = placements(fitted, "nominal", tool)
        held = np.clip(q0, lower, upper)
        goal = Goal(real, count, lower, upper, torques_of(fitted))
        own = _sizes(inverse.differences(goal, held, see(placed, held).poses()))
    return Commands(targets, fitted, q, q0, reached, reason, left, missed, sigma, expected, beyond, count, words, own)


def _dof(targets: Targets, chain: Chain, asked: int | None) -> tuple[int, tuple[str, ...]]:
    """Return how much of a pose counts, and what to say of it."""
    given = 3 if targets.q is None and targets.rotation is None else 6
    given = 3 if targets.position is not None and targets.rotation is None else given
    able = 6 if chain.n >= 6 else 5 if chain.n == 5 else 3
    if asked not in (None, *inverse.DOF):
        raise UsageError(f"dof {asked}: expected 6, 5 (free to turn about the tool's z), or 3")
    if asked is not None and asked > given:
        raise UsageError(f"{targets.file}: has positions without an orientation: dof {asked} needs qx qy qz qw")
    dof = asked or min(given, able)
    what = {6: "position and orientation", 5: "position and the direction of the tool's z axis", 3: "position only"}
    why = f", all that {chain.n} joints can do" if asked is None and able < given else ""
    return dof, (f"what counts: {what[dof]}{why}",)


def torques_of(fitted: Fitted) -> Callable[[np.ndarray], np.ndarray] | None:
    """Return gravity torques as the fit took them, of the nominal arm; None where no deflection needs them."""
    if not any(term.basis == "torque" for term in fitted.cell.deflection.terms):
        return None
    from calib.dynamics.gravity import gravity_torques

    chain = fitted.nominal.chain
    return lambda q: gravity_torques(chain, q)


def _wanted(goal: Goal, targets: Targets, start: Sequence[float] | None, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the targets' poses (m, 4, 4) and the nominal robot's joints (m, n) there."""
    if targets.position is None:
        assert targets.q is not None
        return see(goal.cell, targets.q).poses(), np.array(targets.q)
    wanted = pose(targets.rotation, targets.position)
    if targets.q is not None:
        found = inverse.reach(goal, wanted, targets.q)
        return wanted, inverse.nearest(goal, wanted, np.clip(targets.q, goal.lower, goal.upper), found)
    lower, upper = goal.cell.chain.sampling_limits()
    middle = 0.5 * (lower + upper) if start is None else np.asarray(start, dtype=float)
    others = np.random.default_rng(seed).uniform(lower, upper, (STARTS, len(lower)))
    return wanted, _sought(goal, wanted, middle, others)


def _sought(goal: Goal, wanted: np.ndarray, start: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return the nominal robot's joints (m, n): of several tries those nearest to `start`, by the largest change."""
    best, cost = np.tile(start, (len(wanted), 1)), np.full(len(wanted), np.inf)
    for first in (start, *others):
        q = inverse.reach(goal, wanted, np.tile(first, (len(wanted), 1)))
        met = _within(_sizes(inverse.differences(goal, q, wanted)), TOLERANCE)
        far = np.where(met, np.abs(q - start).max(axis=1), np.inf)
        better = far < cost
        best[better], cost[better] = q[better], far[better]
    return best


def _sizes(difference: np.ndarray) -> np.ndarray:
    """Return lengths (m, 2) of position and orientation differences; NaN where no orientation counts."""
    position = np.linalg.norm(difference[:, :3], axis=1)
    turn = np.linalg.norm(difference[:, 3:], axis=1) if difference.shape[1] > 3 else np.full(len(position), np.nan)
    return np.stack([position, turn], axis=1)


def _within(sizes: np.ndarray, tolerance: tuple[float, float]) -> np.ndarray:
    return (sizes[:, 0] <= tolerance[0]) & ~(sizes[:, 1] > tolerance[1])


def _why(chain: Chain, nominal: np.ndarray, q: np.ndarray, left: np.ndarray, singular: bool) -> str:
    """Say why a target is not reached, from what is left there (2,) [m, rad]."""
    rest = f"{1e3 * left[0]:.3g} mm" + ("" if np.isnan(left[1]) else f" and {1e3 * left[1]:.3g} mrad")
    for name, value, low, high in zip(chain.joint_names, nominal, chain.lower, chain.upper):
        if not low - LIMIT_TOLERANCE <= value <= high + LIMIT_TOLERANCE:
            return f"the target itself is outside the limits {low:.4g} to {high:.4g} of {name} ({value:.4g})"
    at = [name for name, v, j in zip(chain.joint_names, q, chain.joints) if v <= j.lower or v >= j.upper]
    if at:
        return f"{', '.join(at)} at a limit: {rest} left"
    if singular and left[0] < ASTRAY:
        return f"near a singularity: joints would move more than {MAX_CORRECTION:g} rad or cannot follow: {rest} left"
    return f"out of reach: {rest} left at the nearest pose found"


def _extrapolates(chain: Chain, beyond: np.ndarray) -> str:
    """Say which joints (n,) of a command stand outside the range that was measured."""
    names = ", ".join(name for name, out in zip(chain.joint_names, beyond) if out)
    return f"extrapolated: {names} outside the range that was measured" if names else ""


def _predicted_sigmas(
    fitted: Fitted, q: np.ndarray, frame: str, tool: str, goal: Goal
) -> tuple[np.ndarray, np.ndarray | None]:
    """Return the tool's sigmas (m, 2) by the parameters, and what to expect of it (m, 2), see `Commands`.

    Where the fit did not place the tool, it counts as known.
    """
    cell, free, covariance = fitted.cell, fitted.free, fitted.covariance
    number = cell.tool_names.index(tool) if tool in cell.tool_names else 0
    if tool not in cell.tool_names:
        keep = ~np.isin(free, layout(cell).tool_index)
        free, covariance = free[keep], covariance[np.ix_(keep, keep)]
        cell = replace(cell, tools=np.repeat(goal.cell.tools, len(cell.tools), axis=0))
    torque = None if goal.torques is None else goal.torques(q)
    station = -1 if frame == "base" else _station(fitted, frame)
    own = pose_sigmas(cell, q, free, covariance, torque, station, number)
    if fitted.learnt is None or fitted.discrepancy is None:
        return own, None
    errors = ErrorModel(cell, free, covariance, fitted.learnt, fitted.discrepancy)
    sigma = errors.position_sigma(q, torque, station, number)
    return own, np.column_stack([sigma, fitted.discrepancy.radius * sigma])


def _frame_words(fitted: Fitted, frame: str) -> str:
    """Say in which frame targets were taken to be, and how far its alternative is."""
    if frame not in ("base", "nominal"):
        return f"targets are in the instrument's frame, station '{frame}'"
    words = {
        "base": "targets are in the calibrated robot's base, as robot.toml has it (frame 'base')",
        "nominal": "targets are in the nominal robot's base where it fits the measurements best (frame 'nominal')",
    }[frame]
    if not _is_placed(fitted):
        return words
    between = invert(fitted.nominal.stations[0]) @ fitted.cell.stations[0]
    other = {"base": "the nominal robot's best base", "nominal": "the calibrated robot's base"}[frame]
    shift, turn = np.linalg.norm(between[:3, 3]), np.linalg.norm(rotation_vector(between[:3, :3]))
    return f"{words}; {other} stands {1e3 * shift:.2f} mm and {1e3 * turn:.2f} mrad from it"


def _turn_words(fitted: Fitted, dof: int) -> tuple[str, ...]:
    """Say where orientations count and were never measured."""
    table = layout(fitted.cell)
    measured = {table.names[k] for k in fitted.free if k in set(table.tool_index)}
    if dof == 3 or any(name.rsplit(".", 1)[-1] in ("rx", "ry", "rz") for name in measured):
        return ()
    return ("the fit saw no orientations: how the flange is turned behind the last joint axis stays nominal",)


def _tool_words(tool: str) -> str:
    """Say which tool stands at the targets."""
    if tool == "flange":
        return "what stands there is the flange (tool 'flange')"
    return f"what stands there is the tool '{tool}'"


SHOWN = 20  # targets that a message lists
COLUMNS = (
    "left [mm]", "left [mrad]", "before [mm]", "before [mrad]", "sigma [mm]", "sigma [mrad]", "unseen_rms [mm]",
    "expected [mm]", "interval95 [mm]", "extrapolated",
)  # fmt: skip


def _header(names: Sequence[str]) -> list[str]:
    return ["row", *names, "status", *COLUMNS, "reason"]


def write(commands: Commands, out: Path, partial: bool = False) -> Path:
    """Write COMMANDS.csv, see `calib.data.poses.pose_lists`.

    Raises:
        UsageError: where targets are not reached and `partial` does not allow that; nothing is written.
    """
    fitted, targets = commands.fitted, commands.targets
    lost = np.flatnonzero(~commands.reached)
    if len(lost) and (not partial or len(lost) == len(commands.q)):
        shown = [f"  target {k + 1}: {commands.reason[k]}" for k in lost[:SHOWN]]
        shown += [f"  and {len(lost) - SHOWN} more"] if len(lost) > SHOWN else []
        advice = "" if len(lost) == len(commands.q) else "\npartial (--partial) writes the others, these rows empty"
        head = f"{targets.file}: {len(lost)} of {len(commands.q)} targets are not reached; nothing was written"
        raise UsageError("\n".join([head, *shown]) + advice)
    names = targets.columns or fitted.cell.chain.joint_names
    factors = np.array(targets.factors or [1.0] * len(names))
    unseen = None if fitted.unseen is None else 1e3 * fitted.unseen
    rows = []
    for k, good in enumerate(commands.reached):
        q = (commands.q[k] / factors).tolist() if good else [None] * len(names)
        numbers = np.concatenate([commands.left[k], commands.before[k], commands.sigma[k]])
        cells = [None if np.isnan(value) else 1e3 * float(value) for value in numbers]
        there = (None, None) if commands.expected is None else (1e3 * commands.expected[k]).tolist()
        known = None if fitted.learnt is None else int(commands.beyond[k].any())
        status = "reached" if good else "not reached"
        rows.append((k + 1, *q, status, *cells, unseen, *there, known, commands.reason[k]))
    return files.write_table(out, _header(names), rows)


def lines(commands: Commands) -> list[str]:
    """Return what a person should know of the commands."""
    good, targets = commands.reached, commands.targets
    result = [*commands.notes, *targets.notes]
    result += [f"ignored columns of {targets.file}: {', '.join(targets.ignored)}"] if targets.ignored else []
    result += [f"not reached: target {k + 1}: {commands.reason[k]}" for k in np.flatnonzero(~good)[:SHOWN]]
    result += [f"not reached: {int((~good).sum()) - SHOWN} more"] if (~good).sum() > SHOWN else []
    errors = (commands.before, commands.left, commands.sigma)
    before, left, sigma = (_pair(np.sqrt(np.mean(each[good] ** 2, axis=0))) for each in errors)
    apart = ""
    if commands.own is not None:
        own = _pair(np.sqrt(np.mean(commands.own[good] ** 2, axis=0)))
        apart = f" ({own} are the arm's own, the rest is where its base stands: --frame nominal leaves that out)"
    result += [
        f"by the calibrated model, rms over {int(good.sum())} targets: {before} without compensation{apart}, "
        f"{left} with it; sigma of the model {sigma}"
    ]
    result += [_expectation(commands), *_extrapolation(commands)]
    most = np.abs(commands.q - commands.nominal)[good].max(initial=0.0)
    return [*result, f"joints move by {1e3 * most:.3g} mrad (mm) at most"]


def _expectation(commands: Commands) -> str:
    """Say what to expect of the real arm at these targets, by the error model where there is one."""
    good, fitted = commands.reached, commands.fitted
    apart = "" if fitted.unseen is None else f"; {1e3 * fitted.unseen:.3g} mm rms were found on poses not fitted"
    if commands.expected is not None:
        rms = np.sqrt(np.mean(commands.expected[good, 0] ** 2))
        within = commands.expected[good, 1].max()
        return (
            f"what to expect of the real arm at these targets: {1e3 * rms:.3g} mm rms, at the worst one 95 % within "
            f"{1e3 * within:.3g} mm{apart}"
        )
    if fitted.unseen is not None and not commands.beyond[good].any():
        return f"what to expect of the real arm: {1e3 * fitted.unseen:.3g} mm rms, as on poses not fitted"
    known = "" if fitted.fitted is None else f" ({1e3 * fitted.fitted:.3g} mm rms on the fitted ones)"
    why = f"the fit had no unseen poses{known}" if fitted.unseen is None else "targets outside the range measured"
    return f"{why}: nothing says what to expect of the real arm{apart}"


def _extrapolation(commands: Commands) -> list[str]:
    """Say how many targets extrapolate, and which joints."""
    out = commands.beyond & commands.reached[:, None]
    if not out.any():
        return []
    names = ", ".join(commands.fitted.cell.chain.joint_names[j] for j in np.unique(np.nonzero(out)[1]).tolist())
    return [
        f"EXTRAPOLATED: {int(out.any(axis=1).sum())} of {int(commands.reached.sum())} targets have joints outside the "
        f"range that was measured ({names}): no measurement proves the arm there; measure poses like them"
    ]


def _pair(values: np.ndarray) -> str:
    turn = "" if np.isnan(values[1]) else f" and {1e3 * values[1]:.3g} mrad"
    return f"{1e3 * values[0]:.3g} mm{turn}"
