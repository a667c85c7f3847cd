"""The folder of an identification: written whole, beside its place, then moved there."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from calib import files
from calib.dynamics.base import expressions
from calib.errors import UsageError
from calib.estimate_files import COVARIANCE, ESTIMATE, write_covariance, write_estimate
from calib.folders import METRICS, REPORT, check_target, write_staged
from calib.identification.cases import Case
from calib.identification.gains import DriveGains
from calib.identification.methods.registry import METHODS
from calib.identification.model_file import MODEL, read_dynamics, to_table
from calib.identification.parameter_constraints import Held
from calib.identification.possible import information
from calib.identification.prediction import Dynamics
from calib.identification.scores import PredictionErrors, Score
from calib.identification.uncertainty.torque_errors import TorqueDiscrepancy, TorqueErrorModel, TorqueIntervals
from calib.identification.uncertainty.torque_uncertainty import read_uncertainty
from calib.procedure.dynamic_stage import geometry_tables
from calib.procedure.dynamic_stage.identify import IdentificationOutcome
from calib.procedure.dynamic_stage.inputs import IdentificationInputs
from calib.procedure.dynamic_stage.loop_tables import INSTRUMENTAL, loop_table, write_instrumental
from calib.procedure.dynamic_stage.metrics import TorqueCoverage
from calib.procedure.dynamic_stage.tracking import tracking_table
from calib.procedure.dynamic_stage.validation import Assessment, ModelFindings
from calib.procedure.dynamic_stage.verdict import Resting
from calib.records import read_record
from calib.robot import calibrated
from calib.simulation.loop.controllers import Controller
from calib.units import per_ampere

T = TypeVar("T")
OURS = (
    calibrated.ROBOT, MODEL, ESTIMATE, COVARIANCE, information.INFORMATION, INSTRUMENTAL,
    METRICS, "drive_gains.csv",
    "torques_1.csv", calibrated.COVARIANCE, geometry_tables.EFFECTS, geometry_tables.SENSITIVITY,
    geometry_tables.GEOMETRIES, "plot_torque_[0-9]*.png",
    *(f"plot_{name}.png" for name in ("residuals", "friction", "geometries", "geometry_effects")),
)  # fmt: skip
"""Files of an earlier identification that a new one replaces."""
UNSEEN = 1  # schema of the report on unseen motion
POINTS = 400  # samples per curve of the certificate (our choice)
TORQUE_RATE = 100.0  # of torques_1.csv [Hz]
OFF = 1e-9  # σ of a friction term below which it is the ridge's floor, not a measurement [N m] (our choice)
HEADER = ("name", "expression", "unit", "value", "sigma", "rsd", "essential", "sigma_torque", "sigma_geometry")


@dataclass(frozen=True)
class StoredController:
    """A controller as JSON holds it, see `calib.simulation.loop.controllers.Controller`."""

    kp: tuple[float, ...]
    kd: tuple[float, ...]
    ki: tuple[float, ...]
    share: tuple[float, ...]
    limit: tuple[float | None, ...]
    windup: tuple[float | None, ...]
    delay: int = 0
    cutoff: float | None = None

    @classmethod
    def of(cls, controller: Controller | None) -> StoredController | None:
        """Return what is to be stored; None without a controller, or with torques or a model of its own."""
        if controller is None or controller.ahead is not None or controller.model is not None:
            return None
        gains = (tuple(_finite(x) for x in row) for row in controller.rows)
        return cls(*gains, controller.delay, controller.cutoff)  # type: ignore[arg-type]

    def controller(self) -> Controller:
        """Return the controller."""
        rows = (self.kp, self.kd, self.ki, self.share, self.limit, self.windup)
        gains = (np.array([np.inf if x is None else x for x in row]) for row in rows)
        return Controller(*gains, delay=self.delay, cutoff=self.cutoff)


@dataclass(frozen=True)
class StoredFindings:
    """`ModelFindings` as JSON holds them."""

    rests: Resting
    notes: tuple[str, ...]
    controller: StoredController | None = None
    errors: TorqueDiscrepancy | None = None


@dataclass(frozen=True)
class IdentificationMetrics:
    """What ``metrics.json`` holds of the verdict; `findings` from version 0.2 on."""

    verdict: str
    reason: str
    warnings: tuple[str, ...]
    findings: StoredFindings | None = None


@dataclass(frozen=True)
class StoredVerdict:
    """What ``report.json`` of unseen motion says of the verdict."""

    verdict: str
    reason: str
    warnings: tuple[str, ...]


@dataclass(frozen=True)
class IdentificationFolder:
    """The folder that an identification leaves: where its files are, and what they say."""

    path: Path

    @property
    def robot(self) -> Path:
        """The robot it was identified on."""
        return self.path / calibrated.ROBOT

    @property
    def model(self) -> Path:
        """The model."""
        return self.path / MODEL

    @property
    def numbers(self) -> Path:
        """Numbers, verdict and findings."""
        return self.path / METRICS

    @property
    def tables(self) -> tuple[Path, Path]:
        """The estimate, and its covariance."""
        return self.path / ESTIMATE, self.path / COVARIANCE

    @property
    def unseen(self) -> UnseenFolder:
        """What the model comes to on motion it has not seen."""
        return UnseenFolder(self.path / "unseen")

    def dynamics(self) -> Dynamics:
        """Read the model."""
        return read_dynamics(self.path)[1]

    def metrics(self) -> IdentificationMetrics:
        """Read the verdict and the findings."""
        return _read(IdentificationMetrics, self.numbers)

    def findings(self) -> ModelFindings:
        """Read what is known of the model; an older folder says it in its warnings alone."""
        metrics = self.metrics()
        if metrics.findings is None:
            return ModelFindings(Resting(), metrics.warnings)
        known, stated = metrics.findings.controller, metrics.findings.errors
        found = None if stated is None else read_uncertainty(self.path, self.dynamics(), ())
        errors = stated and found and TorqueErrorModel(found.columns, found.covariance, stated)
        return ModelFindings(metrics.findings.rests, metrics.findings.notes, known and known.controller(), errors)


@dataclass(frozen=True)
class UnseenFolder:
    """The folder that holds an identified model against motion it has not seen."""

    path: Path

    @property
    def report(self) -> Path:
        """Scores, verdict, and curves for the certificate."""
        return self.path / REPORT

    def write(self, inputs: IdentificationInputs, found: Assessment) -> None:
        """Write a table of torques per unseen recording, and the report."""
        for number, case in enumerate(inputs.unseen, 1):
            predicted, expected = found.predictions[case.name], found.intervals.get(case.name)
            _write_torques(case, predicted, expected, self.path / f"torques_{number}.csv")
        files.write_json(self.report, report(inputs, found))

    def verdict(self) -> StoredVerdict:
        """Read what was judged."""
        return _read(StoredVerdict, self.report)


def _read(kind: type[T], path: Path) -> T:
    try:
        return read_record(kind, json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError) as error:
        raise UsageError(f"{path} cannot be read ({error}); identify again") from error


def check_identification_target(out: Path, inputs: Sequence[str | Path | None] = ()) -> None:
    """Refuse, before any work is done, a folder that is not for an identification, or that holds one of its inputs."""
    check_target(out, OURS, (METRICS, MODEL), "identification", inputs)


def write_folder(
    outcome: IdentificationOutcome, out: Path, plots: Callable[[IdentificationOutcome, Path], None] | None = None
) -> Path:
    """Write all files of an identification, all or none; see `calib.folders`."""
    check_identification_target(out, [outcome.inputs.source, outcome.inputs.source.parent])

    def write(folder: Path) -> None:
        _write_all(outcome, folder)
        if plots is not None:
            plots(outcome, folder)

    return write_staged(out, OURS, write)


def _write_all(outcome: IdentificationOutcome, folder: Path) -> None:
    inputs, found = outcome.inputs, outcome.found
    robot = replace(inputs.robot, nominal=inputs.robot.nominal or inputs.chain, source=str(inputs.source))
    calibrated.write(folder, robot, comment=f"identified from {inputs.source}")
    write_estimate(folder, HEADER, _estimate_rows(outcome))
    estimate = found.fitted.estimate
    covariance = estimate.covariance if outcome.carried is None else outcome.carried.covariance
    write_covariance(folder / COVARIANCE, found.names, covariance)
    geometry_tables.write(outcome, folder)
    write_instrumental(found.bias, folder)
    held = found.fitted.held is not None and found.fitted.held.solution.binding.any()
    if found.prior is not None or held:  # else estimate and covariance say it all
        information.write(found, folder)
    first = (*inputs.unseen, *inputs.cases)[0]
    expected = outcome.assessment.intervals.get(first.name)
    _write_torques(first, outcome.predictions[first.name], expected, folder / "torques_1.csv")
    table = to_table(found.dynamics, found.base, inputs.unit) | {"drive_gains": _gain_table(inputs.gains, inputs.unit)}
    files.write_json(folder / MODEL, table)
    if inputs.gains is not None:
        columns = (inputs.chain.joint_names, inputs.gains.gains.tolist(), inputs.gains.sigma.tolist())
        files.write_table(folder / "drive_gains.csv", ("joint", f"gain [{inputs.unit} per A]", "sigma"), zip(*columns))
    files.write_json(folder / METRICS, metrics(outcome))


def _write_torques(case: Case, predicted: np.ndarray, expected: TorqueIntervals | None, path: Path) -> Path:
    """Write measured and predicted torques (N, rows) of a recording and its joints (N, n), at about `TORQUE_RATE`.

    Where it is known, with the standard deviation expected of the errors, and 1 where the model extrapolates.
    """
    motion, rows = case.motion, case.target.shape[1]
    step = max(1, round(motion.rate / TORQUE_RATE))
    names = [f"{what}_{j + 1}" for what in ("measured", "predicted") for j in range(rows)]
    joints = [f"q{j + 1}" for j in range(motion.q.shape[1])]
    table = np.column_stack([motion.t, case.target, predicted, motion.q])[::step]
    if expected is None:
        return files.write_numbers(path, ["t [s]", *names, *joints], table)
    near = np.searchsorted(expected.index, np.arange(len(motion))[::step])
    table = np.column_stack([table, expected.sigma[near], expected.beyond[near]])
    sigmas = [f"sigma_{j + 1}" for j in range(rows)]
    return files.write_numbers(path, ["t [s]", *names, *joints, *sigmas, "extrapolated"], table)


def _estimate_rows(outcome: IdentificationOutcome) -> list[tuple[Any, ...]]:
    """Return name, expression, unit, value, σ, RSD [%] and the essential value of each parameter, then σ's two parts.

    σ is the total; the geometry's part is left out where the geometry is taken as exact. Terms that the evidence
    switched off have no σ: nobody measured them.
    """
    found = outcome.found
    estimate = found.fitted.estimate
    words = [line.split(" = ", 1)[1] for line in expressions(found.base)]
    off = switched_off(found.names, found.base.b, estimate.sigma)
    words += [
        f"{one.shape}, switched off: not measured" if one.name in off else one.shape for one in found.friction.terms
    ]
    carried = outcome.carried
    sigmas = estimate.sigma if carried is None else carried.sigma
    parts = [None] * len(sigmas) if carried is None or carried.geometry is None else carried.sigma_geometry.tolist()
    with np.errstate(divide="ignore", invalid="ignore"):
        relative = np.where(estimate.values == 0.0, np.inf, 100.0 * sigmas / np.abs(estimate.values))
    essential = {}
    if found.elimination is not None:
        kept = found.elimination.essential.estimate
        essential = dict(zip(kept.names, kept.values))
    return [
        (
            name,
            expression,
            per_ampere(unit, outcome.inputs.unit),
            float(value),
            None if name in off else float(sigma),
            None if name in off else _finite(rsd),
            _number(essential.get(own)),
            None if name in off else float(noise),
            None if name in off else part,
        )
        for name, own, expression, unit, value, sigma, rsd, noise, part in zip(
            found.names, estimate.names, words, estimate.units, estimate.values, sigmas, relative, estimate.sigma, parts
        )
    ]


def switched_off(names: Sequence[str], base: int, sigma: np.ndarray) -> tuple[str, ...]:
    """Return terms of richer friction (behind `base` columns) that the ridge holds at zero: their σ is its floor.

    Their rows of ``covariance.csv`` hold that floor, so that the model's other σ are those without the terms.
    """
    return tuple(name for name, own in zip(names[base:], sigma[base:]) if own < OFF)


def metrics(outcome: IdentificationOutcome) -> dict[str, Any]:
    """Return the content of ``metrics.json``."""
    found = outcome.found
    essential = found.base.b + len(found.friction.terms)
    if found.elimination is not None:
        essential = len(found.elimination.kept)
    return {
        "identification": {name: _score_table(found_score) for name, found_score in outcome.fit.items()},
        "validation": {
            name: _score_table(found_score)
            | {"evidence": name not in outcome.repeated}
            | _interval_table(outcome.assessment.intervals.get(name), outcome.inputs)
            for name, found_score in outcome.validation.items()
        },
        "parameters": {
            "standard": found.dynamics.model.p,
            "base": found.base.b + len(found.friction.terms),
            "essential": essential,
        },
        "counts": {"without_effect": len(found.base.without_effect), "regrouped": len(found.base.regrouped)},
        "unit": outcome.inputs.unit,
        "drive_gains": _gain_table(outcome.inputs.gains, outcome.inputs.unit),
        "rows": list(found.settings.torque_rows.numbered(outcome.inputs.chain.n)),
        "condition_number": {"raw": _finite(found.condition[0]), "normalised": _finite(found.condition[1])},
        "friction": found.friction.chosen,
        "switched_off": list(switched_off(found.names, found.base.b, found.fitted.estimate.sigma)),
        "method": found.fitted.method,
        "method_assumes": METHODS[found.fitted.method].assumes,
        "ladder": [
            {
                "model": rung.model,
                "parameters": rung.parameters,
                "cross_validated_percent": _finite(rung.cross_validated),
                "joints_percent": [_finite(x) for x in rung.joints],
                "kept_at_joints": [joint + 1 for joint in rung.kept_at],
                "kept": rung.kept,
                "note": rung.note,
            }
            for rung in found.friction.steps
        ],
        "ripple": [
            {
                "joint": one.joint + 1,
                "waves": [{"gear": source + 1, "order_per_turn": order} for source, order in one.waves],
                "explained_share_on_unseen_blocks": one.share,
            }
            for one in found.ripples
        ],
        "elimination": _elimination_table(outcome),
        "loop": loop_table(found.bias),
        "constraints": _constraint_table(found.fitted.held),
        "tracking": tracking_table(outcome.tracking),
        "filters": {case.name: _filter_table(case.motion) for case in (*outcome.inputs.cases, *outcome.inputs.unseen)},
        "geometry": geometry_tables.metrics(outcome.carried, outcome.geometries),
        "repeated": dict(outcome.repeated),
        "findings": asdict(
            StoredFindings(
                outcome.findings.rests,
                outcome.findings.notes,
                StoredController.of(outcome.findings.controller),
                outcome.findings.errors and outcome.findings.errors.discrepancy,
            )
        ),
        "warnings": list(outcome.warnings),
        "verdict": outcome.verdict.level,
        "reason": outcome.verdict.reason,
        "seed": outcome.seed,
    }


def _gain_table(found: DriveGains | None, unit: str) -> dict[str, Any] | None:
    """Return gains as identified, by joint: torque = gain · current; None where none were."""
    if found is None:
        return None
    return {
        "values": [float(x) for x in found.gains],
        "sigma": [float(x) for x in found.sigma],
        "covariance": found.covariance.tolist(),
        "unit": f"{unit} per A",
        "scale": found.scale,
        "not_told": [joint + 1 for joint in found.own],
    }


def _score_table(found: Score) -> dict[str, Any]:
    """Return M of the contract, and what stands beside it."""
    return {
        "raw": _part_table(found.raw),
        "filtered": _part_table(found.filtered),
        "moving": _part_table(found.moving),
        "standing": _part_table(found.standing),
        "above_band_percent": [_finite(x) for x in found.above],
        "r_squared": [_finite(x) for x in found.r_squared],
        "whiteness": [
            None
            if w is None
            else {"outside": w.outside, "ljung_box_p": w.ljung_box_p, "normal_p": w.normal_p, "kurtosis": w.kurtosis}
            for w in found.whiteness
        ],
        "motion_share": found.motion_share,
    }


def _interval_table(found: TorqueIntervals | None, inputs: IdentificationInputs) -> dict[str, Any]:
    """Return how the errors that the model stated held on a recording; nothing where it states none."""
    if found is None:
        return {}
    coverage = TorqueCoverage(
        100.0 * found.covered, tuple((100.0 * found.joints).tolist()), tuple(found.median.tolist()),
        int(found.known.sum()), 100.0 * float(found.beyond.mean()), tuple(found.ways(inputs.chain.joint_names)),
    )  # fmt: skip
    return {"interval95": asdict(coverage)}


def _part_table(part: PredictionErrors) -> dict[str, Any]:
    relative = {"total": _finite(part.total), "joints": [_finite(x) for x in part.joints]}
    return {"relative_error_percent": relative, "rms": [_finite(x) for x in part.rms], "samples": part.samples}


def _filter_table(motion: Any) -> dict[str, Any]:
    return {
        "rate": float(motion.rate),
        "cutoff": [float(x) for x in motion.cutoff],
        "band": float(motion.band),
        "decimation": int(motion.decimator.factor),
    }


def _constraint_table(held: Held | None) -> dict[str, Any] | None:
    """Return all constraints of an estimate and those that hold it; None where the method takes none."""
    if held is None:
        return None
    binding = [
        {
            "name": one.name, "multiplier": one.multiplier, "bound": one.bound, "equality": one.equality,
            "free": one.free, "free_sigma": one.sigma,
        }
        for one in held.binding
    ]  # fmt: skip
    return {"names": list(held.names), "binding": binding, "postures_binding": held.postures}


def _elimination_table(outcome: IdentificationOutcome) -> list[dict[str, Any]]:
    gone = outcome.found.elimination
    if gone is None:
        return []
    return [
        {"name": step.name, "rsd": _finite(step.rsd), "f": _finite(step.f), "p": _finite(step.p), "listed": step.listed}
        for step in gone.steps
    ]


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _number(value: float | None) -> float | None:
    return None if value is None else float(value)


def report(inputs: IdentificationInputs, found: Assessment) -> dict[str, Any]:
    """Return scores, verdict and curves on unseen motion as JSON holds them."""
    chain, rows = inputs.chain, inputs.options.settings.torque_rows
    return {
        "schema": UNSEEN,
        "verdict": found.verdict.level,
        "reason": found.verdict.reason,
        "warnings": list(found.warnings),
        "rows": list(rows.titles(chain.joint_names)),
        "units": list(rows.units([joint.kind == "prismatic" for joint in chain.joints])),
        "fit": {name: _score_table(one) for name, one in found.fit.items()},
        "validation": {
            name: _score_table(one)
            | {"evidence": name not in found.repeated}
            | _interval_table(found.intervals.get(name), inputs)
            for name, one in found.validation.items()
        },
        "curves": [_curves(case, found.predictions[case.name]) for case in (inputs.unseen or inputs.cases)],
        "tracking": tracking_table(found.tracking),
        "autocorrelation": {
            name: {
                "bound": [None if w is None else w.bound for w in one.whiteness],
                "values": [None if w is None else [round(float(x), 4) for x in w.acf] for w in one.whiteness],
            }
            for name, one in (found.validation or found.fit).items()
        },
    }


def _curves(case: Case, predicted: np.ndarray) -> dict[str, Any]:
    """Return measured and predicted torques, thinned for drawing."""
    picked = np.unique(np.linspace(0, len(case.target) - 1, POINTS).astype(int))
    plain = lambda x: [[float(f"{value:.5g}") for value in column] for column in np.asarray(x)[picked].T]  # noqa: E731
    return {
        "name": case.name,
        "t": [round(float(t), 4) for t in case.motion.t[picked]],
        "measured": plain(case.target),
        "predicted": plain(predicted),
    }
