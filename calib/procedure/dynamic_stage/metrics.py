"""The record of an identification, as console and certificate show it and ``metrics.json`` stores it (schema 3).

Its fields are the keys of the file. Most are values of the mathematics, stored as they are typed. Until schema 3 the
file had no number, and some keys another place: `with_current_keys` moves them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from calib.data.signals.motion import Motion
from calib.errors import Finding
from calib.estimation.essential import EliminationStep
from calib.identification.friction.friction_ladder import FrictionTrial
from calib.identification.friction.ripple import RippleWaves
from calib.identification.gains import GainRecord
from calib.identification.identify import Identification
from calib.identification.loop import LoopMetrics, Replay
from calib.identification.methods.constraint_settings import Binding
from calib.identification.prediction import Score, relative_error_sigma
from calib.identification.registry import METHODS
from calib.identification.rows import Case
from calib.procedure.dynamic_stage import geometry_tables
from calib.procedure.dynamic_stage.identify import Assessment, IdentificationOutcome, ModelFindings
from calib.procedure.dynamic_stage.inputs import IdentificationInputs
from calib.procedure.dynamic_stage.plain import PlainReferences
from calib.records import Array, Number, Unbounded, evenly
from calib.units import TORQUE

SCHEMA, UNSEEN_SCHEMA = 3, 2  # of metrics.json, and of unseen/report.json
MAX_POINTS = 600  # samples per curve of the certificate (our choice)


@dataclass(frozen=True)
class ParameterCounts:
    """Numbers of parameters: in the model, identifiable from any motion, and kept."""

    standard: int
    base: int
    essential: int


@dataclass(frozen=True)
class ColumnCounts:
    """Standard parameters without effect on any torque, and those regrouped into others."""

    without_effect: int
    regrouped: int


@dataclass(frozen=True)
class ConditionNumber:
    """Condition number of the observation matrix, in its units and with columns of unit norm."""

    raw: Number
    normalised: Number


@dataclass(frozen=True, eq=False)
class FilterMetrics:
    """Sampling rate, f_q and f_v by joint, identification band f_p [Hz], and decimation factor."""

    rate: float
    cutoff: Array
    band: float
    decimation: int
    velocity_cutoff: Array | None = None  # of 0.1: the same

    @classmethod
    def of(cls, motion: Motion) -> FilterMetrics:
        """Return the filter metrics of a motion."""
        return cls(motion.rate, motion.cutoff, motion.band, motion.decimator.factor, motion.velocity_cutoff)


@dataclass(frozen=True, eq=False)
class ConstraintMetrics:
    """Constraints of an estimate, those at their bounds, and the number of postures with M(q) at its bound."""

    names: tuple[str, ...]
    binding: tuple[Binding, ...]
    postures_binding: int


@dataclass(frozen=True, eq=False, kw_only=True)
class JudgedMetrics:
    """Results of a model on recordings, as stored in both JSON files.

    Attributes:
        verdict, reason: of the model.
        code, advice: of the finding that decided the verdict; empty for a pass, and in files of earlier versions.
        noticed: the findings of the warnings; other remarks on recordings and estimate are text only.
        rows: names of the torque rows.
        tracking: by recording that was replayed; or why none was.
        references: by unseen recording, the errors of plain references beside the model's.
    """

    verdict: str
    reason: str
    code: str = ""
    advice: str = ""
    warnings: tuple[str, ...]
    noticed: tuple[Finding, ...] = ()
    rows: tuple[str, ...]
    validation: Mapping[str, Score]
    tracking: Mapping[str, Replay] = field(default_factory=dict)
    tracking_failure: str = ""
    references: Mapping[str, PlainReferences] = field(default_factory=dict)


def _judged(found: Assessment) -> dict[str, Any]:
    """Return the entries of an assessment common to both records, without the names of the rows."""
    same = ("warnings", "noticed", "validation", "tracking", "tracking_failure", "references")
    judged = dict(zip(("verdict", "reason", "code", "advice"), vars(found.verdict).values()))
    return judged | {name: getattr(found, name) for name in same}


@dataclass(frozen=True, eq=False, kw_only=True)
class ModelMetrics(JudgedMetrics):
    """The content of ``metrics.json``; see `calib.identification.model_file`."""

    identification: Mapping[str, Score]
    parameters: ParameterCounts
    counts: ColumnCounts
    condition_number: ConditionNumber
    friction: str
    method: str
    method_assumes: str
    ladder: tuple[FrictionTrial, ...]
    ripple: tuple[RippleWaves, ...]
    elimination: tuple[EliminationStep, ...]
    unit: str = "N m"
    switched_off: tuple[str, ...] = ()
    drive_gains: GainRecord | None = None
    loop: LoopMetrics | None = None
    constraints: ConstraintMetrics | None = None
    filters: Mapping[str, FilterMetrics] = field(default_factory=dict)
    geometry: geometry_tables.GeometryMetrics | None = None
    repeated: Mapping[str, float] = field(default_factory=dict)
    findings: ModelFindings | None = None
    error_density: Array | None = None
    seed: int = 0
    schema: int = SCHEMA


def on_bounds(found: Identification) -> tuple[str, ...]:
    """Return the parameters fixed by a constraint at its bound: the data do not identify them, and they have no σ.

    The covariance takes the constraint as an equality: its zeros there are what the other parameters' σ rest on.
    """
    if found.fitted.held is None:
        return ()
    free = found.fitted.held.free.estimate.sigma
    return tuple(name for name, own, data in zip(found.names, found.fitted.estimate.sigma, free) if own <= 1e-9 * data)


def metrics(outcome: IdentificationOutcome) -> ModelMetrics:
    """Return the content of ``metrics.json`` for an identification."""
    found, inputs, held = outcome.found, outcome.inputs, outcome.found.fitted.held
    base, count = found.base, found.base.b + len(found.friction.terms)
    kept = count if found.elimination is None else len(found.elimination.kept)
    return ModelMetrics(
        **_judged(outcome),
        rows=found.settings.torque_rows.numbered(inputs.chain.n),
        identification=outcome.fit,
        parameters=ParameterCounts(len(base.standard), count, kept),
        counts=ColumnCounts(len(base.without_effect), len(base.regrouped)),
        condition_number=ConditionNumber(*found.condition),
        friction=found.friction.chosen,
        method=found.fitted.method,
        method_assumes=METHODS[found.fitted.method].assumes,
        ladder=found.friction.steps,
        ripple=tuple(one.found for one in found.ripples),
        elimination=() if found.elimination is None else found.elimination.steps,
        unit=inputs.unit,
        switched_off=found.friction.off,
        drive_gains=inputs.gains and GainRecord.of(inputs.gains, inputs.unit),
        loop=found.loop.metrics,
        constraints=held and ConstraintMetrics(held.names, held.binding, held.postures),
        filters={case.name: FilterMetrics.of(case.motion) for case in (*inputs.cases, *inputs.unseen)},
        geometry=outcome.carried and geometry_tables.metrics(outcome.carried, outcome.geometries),
        repeated=outcome.repeated,
        findings=outcome.findings,
        error_density=_error_density(found, inputs.cases),
        seed=outcome.seed,
    )


def _error_density(found: Identification, cases: Sequence[Case]) -> np.ndarray:
    """Return the errors' density (rows,) [N² m² s or N² s]: a motion's information is ∫ ωᵀω / density dt.

    It is their variance over the independent rows per second.
    """
    per_second = sum(len(rows.target) for rows in found.rows) / sum(case.duration for case in cases)
    return found.fitted.std**2 * found.fitted.inflation / per_second


@dataclass(frozen=True, eq=False)
class TorqueCurves:
    """Measured and predicted torques of one recording, (rows, K) each, thinned for drawing; times [s].

    Attributes:
        band: both are low-passed to this [Hz]; NaN: they are as recorded, as earlier versions kept them.
        error_sigma: standard error of the relative error of the torques as recorded [%].
    """

    name: str
    t: Array
    measured: Array
    predicted: Array
    band: Number = np.nan
    error_sigma: Number = np.nan

    @classmethod
    def of(cls, case: Case, predicted: np.ndarray) -> TorqueCurves:
        """Return the curves of a case and its prediction (N, rows)."""
        motion, measured = case.motion, np.asarray(case.target)
        picked = evenly(len(measured), MAX_POINTS)
        low, other = (_five_digits(motion.in_band(one)[picked].T) for one in (measured, predicted))
        sigma = relative_error_sigma(measured[picked].T, predicted[picked].T)
        return cls(case.name, np.round(motion.t[picked], 4), low, other, motion.band, sigma)


def _five_digits(values: np.ndarray) -> np.ndarray:
    return np.array([float(f"{x:.5g}") for x in values.ravel()]).reshape(values.shape)


@dataclass(frozen=True, eq=False, kw_only=True)
class UnseenReport(JudgedMetrics):
    """A model on unseen motion, as ``unseen/report.json`` stores it; see `calib.procedure.dynamic_stage.identify`.

    Attributes:
        robot: its name; empty in files of earlier versions.
        units: of the torque rows.
        curves: of the recordings that are judged.
        limits: (rows,) torques that the robot's description allows; infinite without one.
    """

    units: tuple[str, ...]
    fit: Mapping[str, Score]
    curves: tuple[TorqueCurves, ...]
    limits: Unbounded | None = None
    robot: str = ""
    schema: int = UNSEEN_SCHEMA

    @classmethod
    def of(cls, inputs: IdentificationInputs, found: Assessment) -> UnseenReport:
        """Return the report of an assessment."""
        rows = inputs.options.settings.torque_rows.titles(inputs.chain.joint_names)
        curves = (TorqueCurves.of(case, found.predictions[case.name]) for case in (inputs.unseen or inputs.cases))
        known = inputs.options.settings.torque_rows.projection is None and inputs.unit == TORQUE
        limits = np.resize([joint.effort if known else np.inf for joint in inputs.chain.joints], len(rows))
        return cls(
            **_judged(found),
            rows=tuple(rows),
            units=tuple(inputs.row_units),
            fit=found.fit,
            curves=tuple(curves),
            limits=limits,
            robot=inputs.chain.name,
        )

    @property
    def proofs(self) -> dict[str, Score]:
        """Scores on unseen recordings by name, without repeats of the training motion."""
        return {name: one for name, one in self.validation.items() if one.evidence}


# ---- folders of earlier versions ------------------------------------------------------------------------------------

_WHITENESS = ("pacf", "bound", "ljung_box_p", "kurtosis", "normal_p")
_STEP = ("ratio", "f", "p", "p_total")


def with_current_keys(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return the content of an earlier version's ``metrics.json`` or ``unseen/report.json`` with today's keys."""
    if content.get("schema", UNSEEN_SCHEMA - 1) >= UNSEEN_SCHEMA:
        return dict(content)
    found = dict(content)
    for group in ("identification", "fit", "validation"):
        found[group] = {name: _score(one) for name, one in found.get(group, {}).items()}
    for name, lags in found.pop("autocorrelation", {}).items():
        for sets in (found["fit"], found["validation"]):
            for row, white in enumerate(sets.get(name, {}).get("whiteness", ())):
                if white is not None:
                    white |= {"acf": lags["values"][row], "bound": lags["bound"][row]}
    tracking = found.get("tracking") or {}
    found["tracking_failure"] = tracking.get("failure", "")
    found["tracking"] = {} if found["tracking_failure"] else {name: _replay(one) for name, one in tracking.items()}
    if "elimination" in found:
        missing = dict.fromkeys(_STEP) | {"residual_std": 0.0, "listed": False}
        found["elimination"] = [missing | one for one in found["elimination"]]
        if loop := found.get("loop"):
            test = loop.get("durbin_wu_hausman")
            test = test and test | {"statistic": test["f"]}
            found["loop"] = loop | {"durbin_wu_hausman": test, "controller": None}
    if held := found.get("constraints"):
        found["constraints"] = held | {"binding": [one | {"sigma": one["free_sigma"]} for one in held["binding"]]}
    return found


def _score(one: Mapping[str, Any]) -> dict[str, Any]:
    missing = {"acf": [], **dict.fromkeys(_WHITENESS)}
    white = [each and missing | each for each in one["whiteness"]]
    return {"rate": None, "r_squared": [], "motion_share": 1.0} | dict(one) | {"whiteness": white}


def _replay(one: Mapping[str, Any]) -> dict[str, Any]:
    control = one["controller"]
    rows = {"share": [1.0] * len(control["kp"]), "windup": [None] * len(control["kp"])} if "kp" in control else {}
    return (
        {"name": "", "seconds": 0.0, "terms_left_out": []}
        | dict(one)
        | {"stated": control["stated"], "controller": {**control, **rows} if rows else None}
    )
