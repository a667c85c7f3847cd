"""What the commands write of a parallel robot: ``robot.toml`` first, so that the next command takes the folder.

identify: ``dynamics.json`` (values of all parameters, base expressions), ``estimate.csv``, ``covariance.csv``,
``metrics.json`` (errors by recording, parameters, elimination, notes), ``torques_1.csv`` and figures. fit:
``estimate.csv`` (changes of the loops' constants), ``covariance.csv``, ``metrics.json``. excite: ``motion.csv`` (time,
platform coordinates, and position, speed, torque of each actuator), ``trajectory.toml`` (the actuators' positions as
Fourier series, for `calib recall`) and ``metrics.json``. plan: the same without series.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from calib import files
from calib.dynamics.base import expressions
from calib.estimate_files import COVARIANCE, ESTIMATE, write_covariance, write_estimate
from calib.folders import METRICS, check_target, write_staged
from calib.identification.cases import Case
from calib.identification.model_file import MODEL
from calib.identification.prediction import predict
from calib.identification.scores import Score
from calib.procedure.excitation import coefficients
from calib.procedure.excitation.coefficients import PLANNED
from calib.robot.calibrated import ROBOT
from calib.robot.tables import dumps
from calib.rooms.parallel.design import ParallelDesign
from calib.rooms.parallel.identification import ParallelOutcome
from calib.rooms.parallel.loop_fit import ParallelFit
from calib.rooms.parallel.mechanism import parallel_files
from calib.rooms.parallel.plan import ParallelPlan, plan_metrics
from calib.rooms.parallel.robots import ParallelMechanism
from trajectories.setpoints import Setpoints

if TYPE_CHECKING:
    from matplotlib.figure import Figure

IDENTIFIED = (ROBOT, MODEL, ESTIMATE, COVARIANCE, METRICS, "torques_1.csv", "plot_*.png")
FITTED = (ROBOT, ESTIMATE, COVARIANCE, METRICS)
MOVED = (ROBOT, PLANNED, coefficients.NAME, METRICS)
EXACT = 1e-8  # by which the series of the actuators may leave the motion [rad or m]
RATE = 100.0  # of torques_1.csv [Hz]


def write_identified(outcome: ParallelOutcome, out: Path, plots: bool = True) -> Path:
    """Write the folder of an identification, all files or none."""
    check_identified(out, [outcome.robot.source])

    def write(folder: Path) -> None:
        _write_robot(outcome.robot, folder)
        found, estimate = outcome.found, outcome.found.fitted.estimate
        words = [line.split(" = ", 1)[1] for line in expressions(found.base)]
        essential = _essential(outcome)
        rows = zip(found.names, words, estimate.units, estimate.values, estimate.sigma, estimate.rsd)
        header = ("name", "expression", "unit", "value", "sigma", "rsd", "essential")
        listed = [[*map(_plain, row), _plain(essential.get(own))] for row, own in zip(rows, estimate.names)]
        write_estimate(folder, header, listed)
        write_covariance(folder / COVARIANCE, found.names, estimate.covariance)
        values = dict(zip(outcome.model.names, map(float, found.dynamics.values)))
        model = {
            "robot": ROBOT, "kind": outcome.model.torque_rows.name, "payloads": list(outcome.model.payloads),
            "v0": outcome.found.settings.v0[0], "values": values, "base": dict(zip(found.names, words)),
            "covariance": COVARIANCE,
        }  # fmt: skip
        files.write_json(folder / MODEL, model)
        files.write_json(folder / METRICS, metrics(outcome))
        case = (*outcome.unseen, *outcome.cases)[0]
        _write_torques(case, predict(found.dynamics, case), folder / "torques_1.csv")
        if plots:
            for name, figure in figures(outcome).items():
                figure.savefig(folder / f"plot_{name}.png", dpi=110)

    return write_staged(out, IDENTIFIED, write)


def write_fitted(fitted: ParallelFit, out: Path) -> Path:
    """Write the folder of a geometric calibration, all files or none."""
    check_fitted(out, [fitted.nominal.source, *fitted.files])

    def write(folder: Path) -> None:
        found, estimate = fitted.found, fitted.found.estimate
        source = f"calibrated from {fitted.nominal.source}"
        parallel_files.write(folder / ROBOT, found.known.robot, source, {"files": [str(x) for x in fitted.files]})
        rows = zip(estimate.names, estimate.units, estimate.values, estimate.sigma)
        write_estimate(folder, ("name", "unit", "value", "sigma"), [list(map(_plain, row)) for row in rows])
        write_covariance(folder / COVARIANCE, estimate.names, estimate.covariance)
        files.write_json(folder / METRICS, fitted.metrics())

    return write_staged(out, FITTED, write)


def write_designed(robot: ParallelMechanism, design: ParallelDesign, rate: float, out: Path) -> Path:
    """Write the folder of an exciting motion, one period at the controller's rate, all files or none."""
    check_moved(out, [robot.source])
    known = robot.known.robot
    t = np.arange(round(design.family.period * rate) + 1) / rate
    x, v, a = design.orders(t)
    motion, own = design.along(t), known.actuated
    parts = [t[:, None], x, motion.posture.q[:, own], motion.v[:, own]]
    header = ["t [s]", *known.freedom, *(f"q_{n}" for n in known.joint_names), *(f"v_{n}" for n in known.joint_names)]
    if design.robot.values is not None:
        parts.append(design.robot.torques(x, v, a))
        header += [f"tau_{n}" for n in known.joint_names]

    limits = design.bounds.lines()
    design.bounds.check(Setpoints(rate, motion.posture.q[:, own], motion.v[:, own], motion.a[:, own]))

    def write(folder: Path) -> None:
        _write_robot(robot, folder)
        files.write_numbers(folder / PLANNED, header, np.hstack(parts), notes=limits)
        series = coefficients.table(_actuators_series(design, rate), ROBOT, limits)
        files.write(folder / coefficients.NAME, dumps(series))
        files.write_json(folder / METRICS, design_metrics(robot, design))

    return write_staged(out, MOVED, write)


def write_planned(planned: ParallelPlan, out: Path) -> Path:
    """Write the folder of a planned motion at the controller's rate, all files or none."""
    check_moved(out, [planned.robot.source])
    robot, track = planned.robot.known.robot, planned.track
    parts = [track.times[:, None], planned.coordinates, track.q, track.v]
    header = ["t [s]", *robot.freedom, *(f"q_{n}" for n in robot.joint_names), *(f"v_{n}" for n in robot.joint_names)]
    if track.tau is not None:
        parts.append(track.tau)
        header += [f"tau_{n}" for n in robot.joint_names]

    planned.bounds.check(track)

    def write(folder: Path) -> None:
        _write_robot(planned.robot, folder)
        files.write_numbers(folder / PLANNED, header, np.hstack(parts), notes=planned.bounds.lines())
        files.write_json(folder / METRICS, plan_metrics(planned))

    return write_staged(out, MOVED, write)


def check_identified(out: Path, inputs: Sequence[str | Path | None] = ()) -> None:
    """Refuse, before any work is done, a folder that an identification cannot go into."""
    check_target(out, IDENTIFIED, (METRICS, MODEL), "identification", inputs)


def check_fitted(out: Path, inputs: Sequence[str | Path | None] = ()) -> None:
    """Refuse, before any work is done, a folder that a fit cannot go into."""
    check_target(out, FITTED, (METRICS, ROBOT), "fit", inputs)


def check_moved(out: Path, inputs: Sequence[str | Path | None] = ()) -> None:
    """Refuse, before any work is done, a folder that a motion cannot go into."""
    check_target(out, MOVED, (METRICS, PLANNED), "motion", inputs)


def design_metrics(robot: ParallelMechanism, design: ParallelDesign) -> dict[str, Any]:
    """Return the content of an excitation's ``metrics.json``."""
    return {
        "robot": robot.known.robot.name,
        "period": design.family.period,
        "parameters": list(design.base.names),
        "condition_number": {key: float(value) for key, value in design.condition.items()},
        "peak_torque": None if design.peak is None else design.peak.tolist(),
        "peak_acceleration": design.fastest.tolist(),
        "margins": [
            {"limit": one.name, "of": one.label, "margin": float(one.margin), "unit": one.unit}
            for one in design.proof.margins
        ],
        "limits": design.bounds.lines(),
    }


def metrics(outcome: ParallelOutcome) -> dict[str, Any]:
    """Return the content of an identification's ``metrics.json``."""
    found = outcome.found
    gone = found.elimination
    return {
        "robot": outcome.robot.known.robot.name,
        "rows": list(outcome.model.torque_rows.numbered(outcome.model.n)),
        "method": found.fitted.method,
        "verdict": {"level": outcome.verdict.level, "reason": outcome.verdict.reason},
        "identification": {name: _errors(one) for name, one in outcome.fit.items()},
        "validation": {name: _errors(one) for name, one in outcome.validation.items()},
        "parameters": {
            "standard": outcome.model.p,
            "base": found.base.b,
            "essential": found.base.b if gone is None else len(gone.kept),
        },
        "condition_number": {"raw": _plain(found.condition[0]), "normalised": _plain(found.condition[1])},
        "elimination": [] if gone is None else [{"name": one.name, "rsd": _plain(one.rsd)} for one in gone.steps],
        "notes": list(outcome.notes),
        "seed": found.settings.seed,
    }


def identified_lines(outcome: ParallelOutcome) -> list[str]:
    """Return what the command prints."""
    robot, found = outcome.robot.known.robot, outcome.found
    rows = outcome.model.torque_rows
    lines = [
        f"{robot.name}: {len(robot.legs)} legs, {robot.n} actuators, {robot.r} freedoms ({', '.join(robot.freedom)}); "
        f"rows: {rows.name}, {found.base.b} base parameters of {outcome.model.p}, by {found.fitted.method}"
    ]
    essential, estimate = _essential(outcome), found.fitted.estimate
    for name, own, unit, value, sigma, rsd in zip(
        found.names, estimate.names, estimate.units, estimate.values, estimate.sigma, estimate.rsd
    ):
        kept = "" if not essential or own in essential else "  not essential"
        lines.append(f"  {name:8} {value:12.5g} ± {sigma:.2g} {unit} ({rsd:.3g} %){kept}")
    for what, scores in (("learnt from", outcome.fit), ("unseen", outcome.validation)):
        lines += [
            f"{name} ({what}): {one.filtered.total:.3g} % of the {rows.name} rows" for name, one in scores.items()
        ]
    return [*lines, *outcome.notes]


def designed_lines(robot: ParallelMechanism, design: ParallelDesign) -> list[str]:
    """Return what the command prints."""
    c = design.condition
    lines = [
        f"{robot.known.robot.name}: {design.family.period:g} s, condition number {c['raw']:.4g}, with columns of unit "
        f"norm {c['normalised']:.4g}, of {len(design.base.names)} base parameters"
    ]
    if design.peak is not None:
        pairs = zip(robot.known.robot.joint_names, design.peak)
        lines.append("peak torques: " + ", ".join(f"{name} {peak:.3g}" for name, peak in pairs))
    worst = min(design.proof.margins, key=lambda one: one.share)
    label = worst.label
    for k, name in enumerate(robot.known.robot.freedom if worst.name in ("position", "acceleration") else ()):
        label = label.replace(f"joint {k + 1} ", f"platform {name} ")
    closest = f"closest limit: {worst.name} of {label}, {worst.margin:.3g} {worst.unit} left"
    return [*lines, closest, *design.bounds.lines()]


def _write_robot(robot: ParallelMechanism, folder: Path) -> None:
    parallel_files.write(folder / ROBOT, robot.known.robot, f"from {robot.source}")


def _actuators_series(design: ParallelDesign, rate: float) -> coefficients.Periodic:
    """Return the periodic motion of the actuators as Fourier series, long enough to be exact within `EXACT`."""
    known, period = design.robot.model.known, design.family.period
    count = 2048
    q = design.along(period / count * np.arange(count)).posture.q[:, known.robot.actuated]
    lines = np.fft.rfft(q, axis=0) / count
    above = np.cumsum(2.0 * np.abs(lines[::-1]), axis=0)[::-1].max(axis=1)
    harmonics = max(1, int((above[1:] > EXACT).sum()))
    own = tuple(
        np.concatenate([[c[0].real], -2.0 * c[1 : harmonics + 1].imag, 2.0 * c[1 : harmonics + 1].real])
        for c in lines.T
    )
    return coefficients.Periodic(known.robot.joint_names, period, rate, 1, "fourier", own)


def _essential(outcome: ParallelOutcome) -> dict[str, float]:
    """Return the essential parameters' values by their names; empty where none were asked for."""
    gone = outcome.found.elimination
    return {} if gone is None else dict(zip(gone.essential.estimate.names, gone.essential.estimate.values))


def _errors(one: Score) -> dict[str, Any]:
    parts: Sequence[tuple[str, Any]] = (("raw", one.raw), ("filtered", one.filtered))
    return {
        key: {
            "relative_error_percent": {"total": _plain(part.total), "rows": [_plain(x) for x in part.joints]},
            "rms": [_plain(x) for x in part.rms],
        }
        for key, part in parts
    }


def _write_torques(case: Case, predicted: np.ndarray, path: Path) -> None:
    step = max(1, round(case.motion.rate / RATE))
    labels = case.torque_rows.numbered(case.motion.n)
    header = ["t [s]", *(f"{what}_{label}" for what in ("measured", "predicted") for label in labels)]
    files.write_table(path, header, np.column_stack([case.motion.t, case.target, predicted])[::step].tolist())


def figures(outcome: ParallelOutcome) -> dict[str, Figure]:
    """Return measured and predicted rows of every recording, below the identification band, by name."""
    import matplotlib.pyplot as plt

    drawn = {}
    for number, case in enumerate((*outcome.cases, *outcome.unseen), 1):
        y, model = (case.motion.in_band(x) for x in (case.target, predict(outcome.found.dynamics, case)))
        labels = [f"{a} [{b}]" for a, b in zip(case.torque_rows.numbered(case.motion.n), _units(outcome, case))]
        figure, axes = plt.subplots(len(labels), 1, figsize=(8, 1.9 * len(labels) + 0.6), sharex=True, squeeze=False)
        for axis, label, one, two in zip(axes[:, 0], labels, y.T, model.T):
            axis.plot(case.motion.t, one, lw=1.0, label="measured")
            axis.plot(case.motion.t, two, lw=0.8, label="predicted")
            axis.plot(case.motion.t, one - two, lw=0.6, label="residual")
            axis.set_ylabel(label)
        axes[0, 0].set_title(case.name)
        axes[0, 0].legend(loc="upper right", ncols=3, fontsize=7)
        axes[-1, 0].set_xlabel("time [s]")
        figure.tight_layout()
        plt.close(figure)
        drawn[f"torque_{number}"] = figure
    return drawn


def _units(outcome: ParallelOutcome, case: Case) -> tuple[str, ...]:
    return case.torque_rows.units([joint.kind == "prismatic" for joint in outcome.robot.known.robot.joints])


def _plain(value: Any) -> Any:
    if isinstance(value, (float, np.floating)):
        return float(value) if np.isfinite(value) else None
    return value
