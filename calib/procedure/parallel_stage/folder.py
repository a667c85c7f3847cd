"""What the commands write of a parallel robot: ``robot.toml`` first, so that the next command takes the folder.

identify: ``dynamics.json`` (values of all parameters, base expressions), ``estimate.csv``, ``covariance.csv``,
``metrics.json`` (errors by recording, parameters, elimination, notes), ``torques_1.csv`` and figures. fit:
``estimate.csv`` (changes of the loops' constants), ``covariance.csv``, ``metrics.json``. excite: ``motion.csv`` (time,
platform coordinates, and position, speed, torque of each actuator) and ``metrics.json``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from calib import files
from calib.data.signals.motion import in_band
from calib.dynamics.base import expressions
from calib.estimate_files import COVARIANCE, ESTIMATE, write_covariance, write_estimate
from calib.folders import METRICS, check_target, write_staged
from calib.identification.cases import Case
from calib.identification.model_file import MODEL
from calib.identification.prediction import predict
from calib.identification.scores import Score
from calib.mechanism import parallel_files
from calib.procedure.excitation.coefficients import PLANNED
from calib.procedure.excitation.parallel import ParallelDesign
from calib.procedure.parallel_stage.fit import ParallelFit
from calib.procedure.parallel_stage.identify import ParallelOutcome
from calib.procedure.parallel_stage.robots import FoundRobot
from calib.robot.calibrated import ROBOT

IDENTIFIED = (ROBOT, MODEL, ESTIMATE, COVARIANCE, METRICS, "torques_1.csv", "plot_*.png")
FITTED = (ROBOT, ESTIMATE, COVARIANCE, METRICS)
DESIGNED = (ROBOT, PLANNED, METRICS)
RATE = 100.0  # of torques_1.csv [Hz]


def write_identified(outcome: ParallelOutcome, out: Path, plots: bool = True) -> Path:
    """Write the folder of an identification, all files or none."""
    check_target(out, IDENTIFIED, (METRICS, MODEL), "identification", [outcome.robot.source])

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
        table = {"robot": ROBOT, "kind": outcome.model.torque_rows.name, "payloads": list(outcome.model.payloads)}
        base = dict(zip(found.names, words))
        files.write_json(folder / MODEL, table | {"values": values, "base": base, "covariance": COVARIANCE})
        files.write_json(folder / METRICS, metrics(outcome))
        case = (*outcome.unseen, *outcome.cases)[0]
        _write_torques(case, predict(found.dynamics, case), folder / "torques_1.csv")
        if plots:
            _draw(outcome, folder)

    return write_staged(out, IDENTIFIED, write)


def write_fitted(fitted: ParallelFit, out: Path) -> Path:
    """Write the folder of a geometric calibration, all files or none."""
    check_target(out, FITTED, (METRICS, ROBOT), "fit", [fitted.nominal.source, *fitted.files])

    def write(folder: Path) -> None:
        found, estimate = fitted.found, fitted.found.estimate
        source = f"calibrated from {fitted.nominal.source}"
        parallel_files.write(folder / ROBOT, found.known.robot, source, {"files": [str(x) for x in fitted.files]})
        rows = zip(estimate.names, estimate.units, estimate.values, estimate.sigma)
        write_estimate(folder, ("name", "unit", "value", "sigma"), [list(map(_plain, row)) for row in rows])
        write_covariance(folder / COVARIANCE, estimate.names, estimate.covariance)
        files.write_json(folder / METRICS, fitted.metrics())

    return write_staged(out, FITTED, write)


def write_designed(robot: FoundRobot, design: ParallelDesign, rate: float, out: Path) -> Path:
    """Write the folder of an exciting motion, one period at the controller's rate, all files or none."""
    check_target(out, DESIGNED, (METRICS, PLANNED), "excitation", [robot.source])
    known = robot.known.robot
    t = np.arange(round(design.family.period * rate) + 1) / rate
    x, v, a = design.orders(t)
    motion, own = design.along(t), known.actuated
    parts = [t[:, None], x, motion.posture.q[:, own], motion.v[:, own]]
    header = ["t [s]", *known.freedom, *(f"q_{n}" for n in known.joint_names), *(f"v_{n}" for n in known.joint_names)]
    if design.robot.values is not None:
        parts.append(design.robot.torques(x, v, a))
        header += [f"tau_{n}" for n in known.joint_names]

    def write(folder: Path) -> None:
        _write_robot(robot, folder)
        files.write_table(folder / PLANNED, header, np.hstack(parts).tolist())
        files.write_json(folder / METRICS, design_metrics(robot, design))

    return write_staged(out, DESIGNED, write)


def design_metrics(robot: FoundRobot, design: ParallelDesign) -> dict[str, Any]:
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
    }


def metrics(outcome: ParallelOutcome) -> dict[str, Any]:
    """Return the content of an identification's ``metrics.json``."""
    found = outcome.found
    gone = found.elimination
    return {
        "robot": outcome.robot.known.robot.name,
        "rows": list(outcome.model.torque_rows.numbered(outcome.model.n)),
        "method": found.fitted.method,
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


def designed_lines(robot: FoundRobot, design: ParallelDesign) -> list[str]:
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
    for k, name in enumerate(robot.known.robot.freedom if worst.name != "torque" else ()):
        label = label.replace(f"joint {k + 1} ", f"platform {name} ")
    return [*lines, f"closest limit: {worst.name} of {label}, {worst.margin:.3g} {worst.unit} left"]


def _write_robot(robot: FoundRobot, folder: Path) -> None:
    parallel_files.write(folder / ROBOT, robot.known.robot, f"from {robot.source}")


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


def _draw(outcome: ParallelOutcome, folder: Path) -> None:
    """Draw measured and predicted rows of every recording, below the identification band."""
    import matplotlib.pyplot as plt

    for number, case in enumerate((*outcome.cases, *outcome.unseen), 1):
        predicted: Callable[[np.ndarray], np.ndarray] = lambda x, own=case: in_band(own.motion, x)  # noqa: E731
        y, model = predicted(case.target), predicted(predict(outcome.found.dynamics, case))
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
        figure.savefig(folder / f"plot_torque_{number}.png", dpi=110)
        plt.close(figure)


def _units(outcome: ParallelOutcome, case: Case) -> tuple[str, ...]:
    return case.torque_rows.units([joint.kind == "prismatic" for joint in outcome.robot.known.robot.joints])


def _plain(value: Any) -> Any:
    if isinstance(value, (float, np.floating)):
        return float(value) if np.isfinite(value) else None
    return value
