"""What ``metrics.json`` and ``report.json`` of an identification hold, as plain tables."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from calib.identification.cases import Case
from calib.identification.gains import DriveGains
from calib.identification.identify import Identification
from calib.identification.methods.loop_agreement import LoopDisagreement
from calib.identification.methods.registry import METHODS
from calib.identification.parameter_constraints import Held
from calib.identification.possible.contradiction import Contradiction
from calib.identification.scores import PredictionErrors, Score
from calib.identification.uncertainty.torque_errors import TorqueDiscrepancy, TorqueIntervals
from calib.procedure.dynamic_stage import geometry_tables
from calib.procedure.dynamic_stage.identify import IdentificationOutcome
from calib.procedure.dynamic_stage.inputs import IdentificationInputs
from calib.procedure.dynamic_stage.loop_tables import loop_table
from calib.procedure.dynamic_stage.metrics import TorqueCoverage
from calib.procedure.dynamic_stage.tracking import tracking_table
from calib.procedure.dynamic_stage.validation import Assessment
from calib.procedure.dynamic_stage.verdict import Resting
from calib.simulation.loop.controllers import Controller

UNSEEN = 1  # schema of the report on unseen motion
POINTS = 400  # samples per curve of the certificate (our choice)


@dataclass(frozen=True)
class _StoredController:
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
    def of(cls, controller: Controller | None) -> _StoredController | None:
        """Return what is to be stored; None without a controller, or with torques or a model of its own."""
        if controller is None or controller.ahead is not None or controller.model is not None:
            return None
        gains = (tuple(finite(x) for x in row) for row in controller.rows)
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
    controller: _StoredController | None = None
    errors: TorqueDiscrepancy | None = None
    contradiction: Contradiction | None = None
    unlike: LoopDisagreement | None = None


def on_bounds(found: Identification) -> tuple[str, ...]:
    """Return parameters that a constraint holds where they are: the data do not tell them, and have no σ of them.

    The covariance takes the constraint as an equality: its zeros there are what the other parameters' σ rest on.
    """
    if found.fitted.held is None:
        return ()
    free = found.fitted.held.free.estimate.sigma
    return tuple(name for name, own, data in zip(found.names, found.fitted.estimate.sigma, free) if own <= 1e-9 * data)


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
            "standard": len(found.base.standard),
            "base": found.base.b + len(found.friction.terms),
            "essential": essential,
        },
        "counts": {"without_effect": len(found.base.without_effect), "regrouped": len(found.base.regrouped)},
        "unit": outcome.inputs.unit,
        "drive_gains": gain_table(outcome.inputs.gains, outcome.inputs.unit),
        "rows": list(found.settings.torque_rows.numbered(outcome.inputs.chain.n)),
        "condition_number": {"raw": finite(found.condition[0]), "normalised": finite(found.condition[1])},
        "friction": found.friction.chosen,
        "switched_off": list(found.friction.off),
        "method": found.fitted.method,
        "method_assumes": METHODS[found.fitted.method].assumes,
        "ladder": [
            {
                "model": rung.model,
                "parameters": rung.parameters,
                "cross_validated_percent": finite(rung.cross_validated),
                "joints_percent": [finite(x) for x in rung.joints],
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
        "loop": loop_table(found.bias, found.fitted.instrumental is None),
        "constraints": _constraint_table(found.fitted.held),
        "tracking": tracking_table(outcome.tracking),
        "filters": {case.name: _filter_table(case.motion) for case in (*outcome.inputs.cases, *outcome.inputs.unseen)},
        "geometry": geometry_tables.metrics(outcome.carried, outcome.geometries),
        "repeated": dict(outcome.repeated),
        "findings": asdict(
            StoredFindings(
                outcome.findings.rests,
                outcome.findings.notes,
                _StoredController.of(outcome.findings.controller),
                outcome.findings.errors and outcome.findings.errors.discrepancy,
                outcome.findings.contradiction,
                outcome.findings.unlike,
            )
        ),
        "warnings": list(outcome.warnings),
        "verdict": outcome.verdict.level,
        "reason": outcome.verdict.reason,
        "seed": outcome.seed,
    }


def gain_table(found: DriveGains | None, unit: str) -> dict[str, Any] | None:
    """Return gains as identified, by joint: torque = gain · current; None where none were.

    A gain that the motion does not tell is None: that joint's torque is in amperes of its own. The reference has no
    sigma.
    """
    if found is None:
        return None
    return {
        "values": [None if word == "not told" else float(x) for x, word in zip(found.gains, found.told)],
        "sigma": [float(x) if word == "told" else None for x, word in zip(found.sigma, found.told)],
        "told": list(found.told),
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
        "above_band_percent": [finite(x) for x in found.above],
        "r_squared": [finite(x) for x in found.r_squared],
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
    relative = {"total": finite(part.total), "joints": [finite(x) for x in part.joints]}
    return {"relative_error_percent": relative, "rms": [finite(x) for x in part.rms], "samples": part.samples}


def _filter_table(motion: Any) -> dict[str, Any]:
    return {
        "rate": float(motion.rate),
        "cutoff": [float(x) for x in motion.cutoff],
        "velocity_cutoff": [float(x) for x in motion.velocity_cutoff],
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
        {"name": step.name, "rsd": finite(step.rsd), "f": finite(step.f), "p": finite(step.p), "listed": step.listed}
        for step in gone.steps
    ]


def finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def report(inputs: IdentificationInputs, found: Assessment) -> dict[str, Any]:
    """Return scores, verdict and curves on unseen motion as JSON holds them."""
    chain, rows = inputs.chain, inputs.options.settings.torque_rows
    return {
        "schema": UNSEEN,
        "verdict": found.verdict.level,
        "reason": found.verdict.reason,
        "warnings": list(found.warnings),
        "rows": list(rows.titles(chain.joint_names)),
        "units": list(inputs.row_units),
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
