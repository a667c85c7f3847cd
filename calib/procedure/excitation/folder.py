"""The folders of designed and planned motions: samples at the controller's rate, ROS messages, metrics and pictures.

Each folder is written completely under another name, then moved to its place.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from calib import files
from calib.errors import counted
from calib.folders import METRICS, check_target, write_staged
from calib.procedure.excitation import coefficients, prediction
from calib.procedure.excitation.coefficients import Periodic
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

DESIGN = (METRICS, coefficients.SAMPLES, coefficients.NAME)
PLAN = (METRICS, coefficients.PLANNED, "trajectory.yaml", "trajectory.json")
"""Files that identify the folder of an earlier run."""
REHEARSAL = "rehearsal.csv"
FIGURES = tuple(f"plot_{name}.png" for name in ("motion", "path", "history", "front", "profile", "outlook"))
ALL = (
    *DESIGN,
    *PLAN[1:],
    coefficients.ARM,
    coefficients.RUN,
    prediction.NAME,
    "front.csv",
    "approach.csv",
    REHEARSAL,
    *FIGURES,
)
"""Files of an earlier run that a new one replaces."""
KINDS = ("position", "velocity", "acceleration", "torque")  # of limits, as `motion_units` has them
MESSAGES = 100.0  # points per second of the ROS message, whose controllers interpolate (our choice)


def check_design_target(out: Path, inputs: Sequence[str | Path | None] = ()) -> None:
    """Raise an error if a folder contains other results or input files, so that no designed motion can be written."""
    check_target(out, ALL, DESIGN, "excitation", inputs)


def check_plan_target(out: Path, inputs: Sequence[str | Path | None] = ()) -> None:
    """Raise an error if a folder contains other results or input files, so that no planned motion can be written."""
    check_target(out, ALL, PLAN, "plan", inputs)


def write_design(designed: Designed, out: Path, draw: Callable[[Designed, Path], None] | None = None) -> Path:
    """Write the folder of a designed motion; `draw` adds figures.

    Raises:
        UsageError: where the disk refuses; what stood there stays.
    """

    def write(folder: Path) -> None:
        period, played = one_period(designed), designed.playback
        chain, bounds = designed.inputs.chain, designed.inputs.limits.bounds
        _write_setpoints(period, bounds, folder / coefficients.SAMPLES)
        settings, family = designed.settings, designed.family
        motion = Periodic(
            chain.joint_names,
            tuple(joint.kind for joint in chain.joints),
            designed.period,
            settings.rate,
            settings.repeat,
            settings.family,
            tuple(family.coefficients(designed.found.x)),
            getattr(family, "degree", 5),
        )
        files.write(folder / coefficients.NAME, dumps(coefficients.table(motion, chain.name, bounds.lines())))
        if played.approach is not None or played.repeat > 1:
            _write_setpoints(played.run, bounds, folder / coefficients.RUN)
        _write_arm(chain, designed.inputs.source, folder)
        _write_besides(played, bounds, folder)
        _write_messages(played.run, bounds, folder, max(1, round(period.rate / MESSAGES)))
        if draw is not None:
            draw(designed, folder)
        if designed.front is not None and len(designed.front.values):
            front = designed.front
            rows = [[*map(float, row), bool(front.best[k]), k == front.designed] for k, row in enumerate(front.values)]
            files.write_table(folder / "front.csv", [*front.names, "not dominated", "designed"], rows)
        if designed.outlook is not None:
            prediction.write(designed.predicted, folder)
        files.write_json(folder / METRICS, design_metrics(designed))

    return write_staged(out, ALL, write)


def write_plan(planned: Planned, out: Path, draw: Callable[[Planned, Path], None] | None = None) -> Path:
    """Write the folder of a planned motion; `draw` adds figures.

    Raises:
        UsageError: where the disk refuses; what stood there stays.
    """

    def write(folder: Path) -> None:
        _write_setpoints(planned.track, planned.bounds, folder / coefficients.PLANNED)
        _write_arm(planned.chain, planned.source, folder)
        _write_messages(planned.track, planned.bounds, folder)
        _write_besides(planned, planned.bounds, folder)
        if draw is not None:
            draw(planned, folder)
        files.write_json(folder / METRICS, plan_metrics(planned))

    return write_staged(out, ALL, write)


def _write_arm(chain: Chain, source: str, folder: Path) -> None:
    """Write the robot that a motion was made for, and which description it came from."""
    description.write(folder / coefficients.ARM, chain, {"provenance": {"robot": source}})


def _write_setpoints(track: Setpoints, bounds: MotionBounds, path: Path) -> Path:
    """Write t, q, v, a and, if known, tau, one row per controller sample; comments state the limits."""
    bounds.check(track)
    parts = {"q": track.q, "v": track.v, "a": track.a} | ({} if track.tau is None else {"tau": track.tau})
    header = ["t [s]", *(name for letter in parts for name in headings(letter, bounds.joints))]
    return files.write_numbers(path, header, np.column_stack([track.times, *parts.values()]), notes=bounds.lines())


def _write_besides(played: Playback | Planned, bounds: MotionBounds, folder: Path) -> None:
    """Write ``approach.csv`` and ``rehearsal.csv`` if the motion has an approach and a rehearsal."""
    for name, track in (("approach.csv", played.approach), (REHEARSAL, played.rehearsal)):
        if track is not None:
            _write_setpoints(track, bounds, folder / name)


def _write_messages(track: Setpoints, bounds: MotionBounds, folder: Path, every: int = 1) -> None:
    """Write ``trajectory.json`` and ``trajectory.yaml`` (trajectory_msgs/JointTrajectory), every `every`-th sample."""
    bounds.check(track)
    message = joint_trajectory(track, [joint.name for joint in bounds.joints], every)
    files.write(folder / "trajectory.json", to_json(message))  # which has no place for remarks
    files.write(folder / "trajectory.yaml", files.remarks(bounds.lines()) + to_yaml(message))


def one_period(designed: Designed, rate: float | None = None) -> Setpoints:
    """Return the setpoints of one period at `rate` [Hz] (default: the controller's), both ends included, no torques."""
    count = max(round(designed.period * (rate or designed.settings.rate)), 1)
    times = np.arange(count + 1) * (designed.period / count)
    motion = dense_motion(designed.family, designed.found.x, times, designed.found.factor)
    return Setpoints(count / designed.period, motion.q, motion.v, motion.a)


def design_metrics(designed: Designed) -> dict[str, Any]:
    """Return the content of ``metrics.json`` of a designed motion."""
    found, given, settings, family = designed.found, designed.inputs, designed.settings, designed.family
    played = designed.playback
    return plain(
        {
            "condition_number": designed.condition.table(),
            "objective": found.merit,
            "feasible": designed.proof.feasible,
            "margins": {name: plain(one) | {"at": one.label} for name, one in designed.proof.worst.items()},
            "seconds": found.seconds,
            "evaluations": found.evaluations,
            "feasible_evaluations": found.feasible,
            "history": found.history,
            "goals": {name: {"goal": goal, "weight": w, "reached": value} for name, goal, w, value in designed.goals},
            "setting": {
                "robot": given.chain.name,
                "family": settings.family,
                "period": designed.period,
                "harmonics": getattr(family, "harmonics", getattr(family, "counts", ())),
                "columns": given.columns.aimed_names,
                "samples": designed.problem.samples,
                "samples_reported": INSTANTS,
                "instants_verified": designed.proof.instants,
                "rate": settings.rate,
                "interrupted": found.interrupted,
                "held": designed.locked,
            },
            "existing": None if given.prior is None else {"names": given.prior.names, "seconds": given.prior.seconds},
            "playback": {
                "repeat": played.repeat,
                "seconds": played.run.duration,
                "approach": _seconds(played.approach),
                "rehearsal": _seconds(played.rehearsal),
            },
            "prediction": designed.outlook,
            "limits": given.limits.bounds.lines(),
            "notes": designed.notes,
        }
    )


def _seconds(track: Setpoints | None) -> float | None:
    return None if track is None else track.duration


def _pair(raw: float | None, normalised: float | None) -> str:
    return "no finite one" if raw is None or normalised is None else f"{raw:.4g} raw, {normalised:.4g} normalised"


def design_lines(designed: Designed) -> list[str]:
    """Return the lines that `calib excite` prints: condition number, goals, margins, limits, notes."""
    found, cond = designed.found, designed.condition
    columns, prior = len(designed.inputs.columns.aimed_names), designed.inputs.prior
    together = (
        []
        if prior is None
        else [
            f"together with {', '.join(prior.names)}, "
            f"which alone has {_pair(cond.raw_before, cond.normalised_before)}; "
            f"this motion alone has {_pair(cond.raw_alone, cond.normalised_alone)}"
        ]
    )
    result = [
        *(["interrupted: this is the best motion so far"] if found.interrupted else []),
        f"condition number of {columns} columns: {cond.raw:.4g} raw, {cond.normalised:.4g} normalised "
        f"({designed.settings.family}, period {designed.period:g} s)",
        *together,
        *(f"goal {name}: {value:.4g} (asked: {goal:.4g})" for name, goal, _, value in designed.goals),
        f"{found.evaluations} evaluations, {found.feasible:.0%} of them feasible, {found.seconds:.1f} s",
        f"all limits are respected, at {designed.proof.instants} instants and between them; smallest margins: "
        + "; ".join(
            f"{name} {one.margin:.3g} {one.unit} ({one.label}, {one.time:.2f} s)"
            for name, one in designed.proof.worst.items()
        ),
    ]
    played = designed.playback
    parts = ["the approach"] if played.approach is not None else []
    parts.append(counted(played.repeat, "period"))
    result.append(f"to run: {' and '.join(parts)}, {played.run.duration:.1f} s")
    result += [] if designed.outlook is None else prediction.lines(designed.outlook, designed.predicted)
    return [*result, *designed.inputs.limits.bounds.lines(), *(f"note: {note}" for note in designed.notes)]


def plan_metrics(planned: Planned) -> dict[str, Any]:
    """Return the content of ``metrics.json`` of a planned motion."""
    shaped, deviation = planned.shaped, planned.deviation
    return plain(
        {
            "feasible": True,
            "duration": planned.track.duration,
            "margins": _margins(planned),
            "active_share": planned.active_share,
            "active_within": ACTIVE,
            "iterations": sum(one.iterations for one in planned.timings),
            "tightened": max(one.tightened for one in planned.timings),
            "history": [one.history for one in planned.timings],
            "segments": [one.duration for one in planned.timings],
            "rate": planned.track.rate,
            "samples": len(planned.track),
            "samples_verified": _verified(planned),
            "line_deviation": None if deviation is None else dict(zip(("position", "orientation"), deviation.tolist())),
            "shortened": None
            if shaped is None
            else {
                "before": shaped.before,
                "after": shaped.after,
                "evaluations": shaped.evaluations,
                "refused": shaped.refused,
                "parameters": shaped.phi,
            },
            "torque_sigma": planned.sigma,
            "torque_limits": planned.limits.torque,
            "approach": _seconds(planned.approach),
            "limits": planned.bounds.lines(),
            "notes": planned.notes,
        }
    )


def plan_lines(planned: Planned) -> list[str]:
    """Return the lines that `calib plan` prints: duration, margins, limits, notes."""
    words = [
        f"{planned.track.duration:.3f} s at {planned.track.rate:g} Hz; closer than {ACTIVE:.0%} to a limit for "
        f"{planned.active_share:.1%} of the time; all limits are respected at "
        f"{_verified(planned)} instants",
        "smallest margins:",
    ]
    for name, one in _margins(planned).items():
        words.append(f"  {name:12} {one.margin:.4g} {one.unit} ({one.at})")
    if planned.sigma is not None:
        free = ", ".join(f"{x:.3g}" for x in planned.sigma)
        words.append(f"torque limits are reduced for the model's uncertainty; one sigma of each joint: {free} N m")
    if planned.shaped is not None:
        words.append(f"path shape optimised: {planned.shaped.before:.3f} s before, {planned.shaped.after:.3f} s after")
    if planned.deviation is not None:
        words.append(f"largest deviation of the tool from its straight lines: {1e6 * planned.deviation[0]:.2g} µm")
    return [*words, *planned.bounds.lines(), *(f"note: {note}" for note in planned.notes)]


@dataclass(frozen=True)
class _PlanMargin:
    """Margin to a limit: of the joint closest to the limit, and of each joint as a share of the limit."""

    margin: float
    unit: str
    at: str
    share: float
    joints: list[float]


def _verified(planned: Planned) -> int:
    return sum(len(one.sampled.s) for one in planned.timings)


def _margins(planned: Planned) -> dict[str, _PlanMargin]:
    """Return the smallest margin to each limit, by name."""
    used = {name: np.concatenate([one.used[name] for one in planned.timings]) for name in planned.timings[0].used}
    left = {name: 1.0 - shares.max(axis=0) for name, shares in used.items()}  # shares of the limits
    result = {}
    for name, joints in (({} if planned.margins is None else {"position": planned.margins}) | left).items():
        j = int(np.argmin(joints))
        joint, size = planned.chain.joints[j], planned.upper - planned.lower
        share = joints[j] / size[j] if name == "position" else joints[j]
        margin = joints[j] if name == "position" else joints[j] * getattr(planned.limits, name)[j]
        unit = motion_units([joint.kind])[KINDS.index(name)]
        result[name] = _PlanMargin(float(margin), unit, joint.name, float(share), joints.tolist())
    return result
