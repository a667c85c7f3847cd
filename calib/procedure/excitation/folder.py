"""Folders of designed and planned motions: samples at the controller's rate, ROS messages, metrics and figures.

Each folder is written completely into a temporary folder, then moved to its final path.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calib import files
from calib.errors import counted
from calib.folders import METRICS, check_target, figure_files, write_staged
from calib.procedure.excitation import coefficients, prediction, stored_front
from calib.procedure.excitation.design import INSTANTS, Designed
from calib.procedure.excitation.limits import MotionBounds
from calib.procedure.excitation.planning import Planned
from calib.procedure.excitation.playback import Playback
from calib.records import plain
from calib.robot import description
from calib.robot.chain import Chain
from calib.robot.tables import dumps
from calib.trajectories.design.verify import dense_motion
from calib.trajectories.messages import joint_trajectory, to_json, to_yaml
from calib.trajectories.setpoints import Setpoints
from calib.trajectories.timing.time_scaling import ACTIVE
from calib.units import headings, motion_units

# files that identify the folder of an earlier run
DESIGN = (METRICS, coefficients.SAMPLES, coefficients.NAME)
PLAN = (METRICS, coefficients.PLANNED, "trajectory.yaml", "trajectory.json")
APPROACH = "approach.csv"
REHEARSAL = "rehearsal.csv"
PAGE = "report.html"
FIGURES = (PAGE, *figure_files("motion", "path", "history", "front", "profile", "outlook"))
# files and folders of an earlier run that a new one replaces
FRONT = (stored_front.TABLE, stored_front.FOLDER)
ALL = (*DESIGN, *PLAN[1:], coefficients.ARM, coefficients.RUN, prediction.NAME, *FRONT, APPROACH, REHEARSAL, *FIGURES)
# of limits, as `motion_units` has them
KINDS = ("position", "velocity", "acceleration", "torque")
# points per second of the ROS message, whose controllers interpolate (our choice)
MESSAGES = 100.0


def check_design_target(out: Path, inputs: Sequence[str | Path | None] = ()) -> None:
    """Check that a designed motion can be written into a folder.

    Args:
        out: the folder.
        inputs: files that the command reads; None entries are ignored.

    Raises:
        UsageError: if the folder contains other results or input files.
    """
    check_target(out, ALL, DESIGN, "excitation", inputs)


def check_plan_target(out: Path, inputs: Sequence[str | Path | None] = ()) -> None:
    """Check that a planned motion can be written into a folder.

    Args:
        out: the folder.
        inputs: files that the command reads; None entries are ignored.

    Raises:
        UsageError: if the folder contains other results or input files.
    """
    check_target(out, ALL, PLAN, "plan", inputs)


def write_design(designed: Designed, out: Path, draw: Callable[[Designed, Path], None] | None = None) -> Path:
    """Write the folder of a designed motion and return its path.

    Args:
        designed: the motion.
        out: path of the folder.
        draw: function that writes figures into the folder; None: no figures.

    Raises:
        UsageError: if a file cannot be written; the earlier content of the folder is kept.
    """

    def write(folder: Path) -> None:
        playback = designed.playback
        chain, bounds = designed.inputs.chain, designed.inputs.limits.bounds
        period = one_period(designed)
        _write_setpoints(period, bounds, folder / coefficients.SAMPLES)
        table = coefficients.table(designed.periodic(designed.found), chain.name, bounds.lines())
        files.write(folder / coefficients.NAME, dumps(table))
        if playback.approach is not None or playback.repeat > 1:
            _write_setpoints(playback.run, bounds, folder / coefficients.RUN)
        _write_arm(chain, designed.inputs.source, folder)
        _write_approach_and_rehearsal(playback, bounds, folder)
        _write_messages(playback.run, bounds, folder, max(1, round(period.rate / MESSAGES)))
        if draw is not None:
            draw(designed, folder)
        if designed.stored_front is not None:
            stored_front.write(designed.stored_front, chain.name, bounds.lines(), folder)
        if designed.outlook is not None:
            prediction.write(designed.predicted, folder)
        files.write_json(folder / METRICS, design_metrics(designed))

    return write_staged(out, ALL, write)


def write_plan(planned: Planned, out: Path, draw: Callable[[Planned, Path], None] | None = None) -> Path:
    """Write the folder of a planned motion and return its path.

    Args:
        planned: the motion.
        out: path of the folder.
        draw: function that writes figures into the folder; None: no figures.

    Raises:
        UsageError: if a file cannot be written; the earlier content of the folder is kept.
    """

    def write(folder: Path) -> None:
        _write_setpoints(planned.track, planned.bounds, folder / coefficients.PLANNED)
        _write_arm(planned.chain, planned.source, folder)
        _write_messages(planned.track, planned.bounds, folder)
        _write_approach_and_rehearsal(planned, planned.bounds, folder)
        if draw is not None:
            draw(planned, folder)
        files.write_json(folder / METRICS, plan_metrics(planned))

    return write_staged(out, ALL, write)


def _write_arm(chain: Chain, source: str, folder: Path) -> None:
    """Write a description of the robot for which a motion was made, with the name of the original description.

    Args:
        chain: the robot.
        source: name of the original description.
        folder: folder to write into.
    """
    description.write(folder / coefficients.ARM, chain, {"provenance": {"robot": source}})


def _write_setpoints(track: Setpoints, bounds: MotionBounds, path: Path) -> Path:
    """Write time, position, velocity, acceleration and, if known, torque, one row per controller sample.

    Comments at the head of the file state the limits.

    Args:
        track: the setpoints.
        bounds: limits of the motion.
        path: the CSV file.
    """
    bounds.check(track)
    columns = {"q": track.q, "v": track.v, "a": track.a}
    if track.tau is not None:
        columns["tau"] = track.tau
    header = ["t [s]"]
    for letter in columns:
        header += headings(letter, bounds.joints)
    table = np.column_stack([track.times, *columns.values()])
    return files.write_numbers(path, header, table, notes=bounds.lines())


def _write_approach_and_rehearsal(motion: Playback | Planned, bounds: MotionBounds, folder: Path) -> None:
    """Write the setpoints of approach and rehearsal, if the motion has them.

    Args:
        motion: the motion.
        bounds: its limits, for the comments in the files.
        folder: folder for ``approach.csv`` and ``rehearsal.csv``.
    """
    if motion.approach is not None:
        _write_setpoints(motion.approach, bounds, folder / APPROACH)
    if motion.rehearsal is not None:
        _write_setpoints(motion.rehearsal, bounds, folder / REHEARSAL)


def _write_messages(track: Setpoints, bounds: MotionBounds, folder: Path, step: int = 1) -> None:
    """Write a motion as trajectory_msgs/JointTrajectory: ``trajectory.json`` and ``trajectory.yaml``.

    Args:
        track: the setpoints.
        bounds: limits of the motion, for the comments in the files.
        folder: folder to write into.
        step: number of samples from one point of the message to the next.
    """
    bounds.check(track)
    message = joint_trajectory(track, [joint.name for joint in bounds.joints], step)
    # JSON has no remarks
    files.write(folder / "trajectory.json", to_json(message))
    files.write(folder / "trajectory.yaml", files.remarks(bounds.lines()) + to_yaml(message))


def one_period(designed: Designed, rate: float | None = None) -> Setpoints:
    """Return the setpoints of one period with both ends included, without torques.

    Args:
        designed: the motion.
        rate: sampling rate [Hz]; None: the controller's rate.
    """
    count = max(round(designed.period * (rate or designed.settings.rate)), 1)
    times = np.arange(count + 1) * (designed.period / count)
    motion = dense_motion(designed.family, designed.found.x, times, designed.found.factor)
    return Setpoints(count / designed.period, motion.q, motion.v, motion.a)


def design_metrics(designed: Designed) -> dict[str, object]:
    """Return the content of ``metrics.json`` for a designed motion."""
    motion, inputs, settings = designed.found, designed.inputs, designed.settings
    family, playback, proof = designed.family, designed.playback, designed.proof
    margins = {}
    for name, margin in proof.worst.items():
        margins[name] = plain(margin) | {"at": margin.label}
    goals = {}
    for name, goal, weight, value in designed.goals:
        goals[name] = {"goal": goal, "weight": weight, "reached": value}
    existing = None
    if inputs.prior is not None:
        existing = {"names": inputs.prior.names, "seconds": inputs.prior.seconds}
    setting = {
        "robot": inputs.chain.name,
        "family": settings.family,
        "period": designed.period,
        "harmonics": getattr(family, "harmonics", getattr(family, "counts", ())),
        "columns": inputs.columns.aimed_names,
        "samples": designed.problem.samples,
        "samples_reported": INSTANTS,
        "instants_verified": proof.instants,
        "rate": settings.rate,
        "interrupted": motion.interrupted,
        "held": designed.locked,
    }
    seconds = {
        "repeat": playback.repeat,
        "seconds": playback.run.duration,
        "approach": _seconds(playback.approach),
        "rehearsal": _seconds(playback.rehearsal),
    }
    return plain(
        {
            "condition_number": designed.condition.table(),
            "objective": motion.merit,
            "feasible": proof.feasible,
            "margins": margins,
            "seconds": motion.seconds,
            "evaluations": motion.evaluations,
            "feasible_evaluations": motion.feasible,
            "history": motion.history,
            "goals": goals,
            "setting": setting,
            "existing": existing,
            "playback": seconds,
            "prediction": designed.outlook,
            "limits": inputs.limits.bounds.lines(),
            "notes": designed.notes,
        }
    )


def _seconds(track: Setpoints | None) -> float | None:
    if track is None:
        return None
    return track.duration


def _condition_text(raw: float | None, normalised: float | None) -> str:
    if raw is None or normalised is None:
        return "no finite one"
    return f"{raw:.4g} raw, {normalised:.4g} normalised"


def design_lines(designed: Designed) -> list[str]:
    """Return the lines that `calib excite` prints: condition numbers, reached goals, margins, limits, and notes.

    Args:
        designed: the motion.
    """
    motion, condition, proof, playback = designed.found, designed.condition, designed.proof, designed.playback
    column_count = len(designed.inputs.columns.aimed_names)
    prior = designed.inputs.prior
    lines = []
    if motion.interrupted:
        lines.append("interrupted: this is the best motion so far")
    lines.append(
        f"condition number of {column_count} columns: {condition.raw:.4g} raw, {condition.normalised:.4g} normalised "
        f"({designed.settings.family}, period {designed.period:g} s)"
    )
    if prior is not None:
        before = _condition_text(condition.raw_before, condition.normalised_before)
        this_motion = _condition_text(condition.raw_alone, condition.normalised_alone)
        lines.append(
            f"together with {', '.join(prior.names)}, which alone has {before}; this motion alone has {this_motion}"
        )
    for name, goal, _, value in designed.goals:
        lines.append(f"goal {name}: {value:.4g} (asked: {goal:.4g})")
    if motion.evaluations:
        shares = f"{motion.feasible:.0%} of them feasible"
        lines.append(f"{motion.evaluations} evaluations, {shares}, {motion.seconds:.1f} s")
    if designed.front is not None:
        front = designed.front
        lines.append(f"motion {front.designed + 1} of the {len(front.values)} of the front ({stored_front.TABLE})")
    margins = []
    for name, margin in proof.worst.items():
        margins.append(f"{name} {margin.margin:.3g} {margin.unit} ({margin.label}, {margin.time:.2f} s)")
    lines.append(
        f"all limits are respected, at {proof.instants} instants and between them; smallest margins: "
        + "; ".join(margins)
    )
    parts = [counted(playback.repeat, "period")]
    if playback.approach is not None:
        parts.insert(0, "the approach")
    lines.append(f"to run: {' and '.join(parts)}, {playback.run.duration:.1f} s")
    if designed.outlook is not None:
        lines += prediction.lines(designed.outlook, designed.predicted)
    lines += designed.inputs.limits.bounds.lines()
    return [*lines, *(f"note: {note}" for note in designed.notes)]


def plan_metrics(planned: Planned) -> dict[str, object]:
    """Return the content of ``metrics.json`` for a planned motion."""
    timings, shaped = planned.timings, planned.shaped
    line_deviation = None
    if planned.deviation is not None:
        line_deviation = dict(zip(("position", "orientation"), planned.deviation.tolist()))
    shortened = None
    if shaped is not None:
        shortened = {
            "before": shaped.before,
            "after": shaped.after,
            "evaluations": shaped.evaluations,
            "refused": shaped.refused,
            "parameters": shaped.phi,
        }
    segments = [timing.duration for timing in timings]
    histories = [timing.history for timing in timings]
    iterations = sum(timing.iterations for timing in timings)
    tightened = max(timing.tightened for timing in timings)
    return plain(
        {
            "feasible": True,
            "duration": planned.track.duration,
            "margins": _margins(planned),
            "active_share": planned.active_share,
            "active_within": ACTIVE,
            "iterations": iterations,
            "tightened": tightened,
            "history": histories,
            "segments": segments,
            "rate": planned.track.rate,
            "samples": len(planned.track),
            "samples_verified": _verified(planned),
            "line_deviation": line_deviation,
            "shortened": shortened,
            "torque_sigma": planned.sigma,
            "torque_limits": planned.limits.torque,
            "approach": _seconds(planned.approach),
            "limits": planned.bounds.lines(),
            "notes": planned.notes,
        }
    )


def plan_lines(planned: Planned) -> list[str]:
    """Return the lines that `calib plan` prints: duration, margins, limits, and notes.

    Args:
        planned: the motion.
    """
    lines = [
        f"{planned.track.duration:.3f} s at {planned.track.rate:g} Hz; closer than {ACTIVE:.0%} to a limit for "
        f"{planned.active_share:.1%} of the time; all limits are respected at "
        f"{_verified(planned)} instants",
        "smallest margins:",
    ]
    for name, smallest in _margins(planned).items():
        lines.append(f"  {name:12} {smallest.margin:.4g} {smallest.unit} ({smallest.at})")
    if planned.sigma is not None:
        sigmas = ", ".join(f"{sigma:.3g}" for sigma in planned.sigma)
        lines.append(f"torque limits are reduced for the model's uncertainty; one sigma of each joint: {sigmas} N m")
    if planned.shaped is not None:
        lines.append(f"path shape optimised: {planned.shaped.before:.3f} s before, {planned.shaped.after:.3f} s after")
    if planned.deviation is not None:
        lines.append(f"largest deviation of the tool from its straight lines: {1e6 * planned.deviation[0]:.2g} µm")
    lines += planned.bounds.lines()
    return [*lines, *(f"note: {note}" for note in planned.notes)]


@dataclass(frozen=True)
class _PlanMargin:
    """Smallest margin of a planned motion to a limit.

    Attributes:
        margin, unit: margin of the joint closest to the limit.
        at: name of this joint.
        share: margin as a share of the limit.
        joints: (n,) margins of all joints.
    """

    margin: float
    unit: str
    at: str
    share: float
    joints: list[float]


def _verified(planned: Planned) -> int:
    return sum(len(timing.sampled.s) for timing in planned.timings)


def _margins(planned: Planned) -> dict[str, _PlanMargin]:
    """Return the smallest margin of a planned motion to each limit: name of the limit -> margin."""
    result = {}
    if planned.margins is not None:
        j = int(np.argmin(planned.margins))
        size = planned.upper - planned.lower
        result["position"] = _margin(planned, "position", planned.margins, planned.margins[j] / size[j], 1.0)
    for name in planned.timings[0].used:
        shares = np.concatenate([timing.used[name] for timing in planned.timings])
        # as shares of the limits
        margins = 1.0 - shares.max(axis=0)
        j = int(np.argmin(margins))
        result[name] = _margin(planned, name, margins, margins[j], getattr(planned.limits, name)[j])
    return result


def _margin(planned: Planned, name: str, margins: np.ndarray, share: float, unit_size: float) -> _PlanMargin:
    """Return the smallest margin among the joints to one limit.

    Args:
        planned: the motion.
        name: quantity that is limited, such as ``velocity``.
        margins: (n,) margins of the joints.
        share: smallest margin as a share of the limit.
        unit_size: factor that converts the margins to the unit of the limit.
    """
    j = int(np.argmin(margins))
    joint = planned.chain.joints[j]
    unit = motion_units([joint.kind])[KINDS.index(name)]
    return _PlanMargin(float(margins[j] * unit_size), unit, joint.name, float(share), margins.tolist())
