"""The record of an identification, as console and certificate show it and ``metrics.json`` stores it (schema 3).

Its fields are the keys of the file. Most are values of the mathematics, stored as they are typed. Until schema 3 the
file had no number, and some keys another place: `with_current_keys` moves them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from calib.data.signals.motion import Motion
from calib.estimation.essential import EliminationStep
from calib.identification.friction.friction_ladder import FrictionTrial
from calib.identification.friction.ripple import RippleWaves
from calib.identification.gains import GainRecord
from calib.identification.identify import Identification
from calib.identification.loop.replay import Replay
from calib.identification.methods.registry import METHODS
from calib.identification.parameter_constraints import Binding
from calib.identification.rows import Case
from calib.identification.scores import Score
from calib.procedure.dynamic_stage import geometry_tables
from calib.procedure.dynamic_stage.identify import IdentificationOutcome
from calib.procedure.dynamic_stage.inputs import IdentificationInputs
from calib.procedure.dynamic_stage.loop_tables import LoopMetrics
from calib.procedure.dynamic_stage.validation import Assessment, ModelFindings
from calib.records import Array, Number

SCHEMA, UNSEEN_SCHEMA = 3, 2  # of metrics.json, and of unseen/report.json
MAX_POINTS = 400  # samples per curve of the certificate (our choice)


@dataclass(frozen=True)
class ParameterCounts:
    """How many parameters the model has, are identifiable from any motion, and were kept."""

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
    """Of the observation matrix, in its units and with columns of unit norm."""

    raw: Number
    normalised: Number


@dataclass(frozen=True, eq=False)
class FilterMetrics:
    """Sampling rate, f_q and f_v by joint, identification band f_p [Hz], and the decimation to it."""

    rate: float
    cutoff: Array
    band: float
    decimation: int
    velocity_cutoff: Array | None = None  # of 0.1: the same

    @classmethod
    def of(cls, motion: Motion) -> FilterMetrics:
        """Return those of a motion."""
        return cls(motion.rate, motion.cutoff, motion.band, motion.decimator.factor, motion.velocity_cutoff)


@dataclass(frozen=True, eq=False)
class ConstraintMetrics:
    """All constraints of an estimate, those at their bounds, and in how many postures M(q) is at its bound."""

    names: tuple[str, ...]
    binding: tuple[Binding, ...]
    postures_binding: int


@dataclass(frozen=True, eq=False)
class ModelMetrics:
    """The content of ``metrics.json``; see `calib.identification.model_file`."""

    identification: Mapping[str, Score]
    validation: Mapping[str, Score]
    parameters: ParameterCounts
    counts: ColumnCounts
    rows: tuple[str, ...]
    condition_number: ConditionNumber
    friction: str
    method: str
    method_assumes: str
    ladder: tuple[FrictionTrial, ...]
    ripple: tuple[RippleWaves, ...]
    elimination: tuple[EliminationStep, ...]
    warnings: tuple[str, ...]
    verdict: str
    reason: str
    unit: str = "N m"
    switched_off: tuple[str, ...] = ()
    drive_gains: GainRecord | None = None
    loop: LoopMetrics | None = None
    constraints: ConstraintMetrics | None = None
    tracking: Mapping[str, Replay] = field(default_factory=dict)
    tracking_failure: str = ""
    filters: Mapping[str, FilterMetrics] = field(default_factory=dict)
    geometry: geometry_tables.GeometryMetrics | None = None
    repeated: Mapping[str, float] = field(default_factory=dict)
    findings: ModelFindings | None = None
    seed: int = 0
    schema: int = SCHEMA


def on_bounds(found: Identification) -> tuple[str, ...]:
    """Return parameters that a constraint holds where they are: the data do not identify them, and have no σ of them.

    The covariance takes the constraint as an equality: its zeros there are what the other parameters' σ rest on.
    """
    if found.fitted.held is None:
        return ()
    free = found.fitted.held.free.estimate.sigma
    return tuple(name for name, own, data in zip(found.names, found.fitted.estimate.sigma, free) if own <= 1e-9 * data)


def metrics(outcome: IdentificationOutcome) -> ModelMetrics:
    """Return the record of an identification."""
    found, inputs, held = outcome.found, outcome.inputs, outcome.found.fitted.held
    base, count = found.base, found.base.b + len(found.friction.terms)
    return ModelMetrics(
        outcome.fit,
        outcome.validation,
        ParameterCounts(
            len(base.standard), count, count if found.elimination is None else len(found.elimination.kept)
        ),
        ColumnCounts(len(base.without_effect), len(base.regrouped)),
        found.settings.torque_rows.numbered(inputs.chain.n),
        ConditionNumber(*found.condition),
        found.friction.chosen,
        found.fitted.method,
        METHODS[found.fitted.method].assumes,
        found.friction.steps,
        tuple(one.found for one in found.ripples),
        () if found.elimination is None else found.elimination.steps,
        outcome.warnings,
        outcome.verdict.level,
        outcome.verdict.reason,
        inputs.unit,
        found.friction.off,
        inputs.gains and GainRecord.of(inputs.gains, inputs.unit),
        LoopMetrics.of(found.bias, found.fitted.instrumental is None),
        held and ConstraintMetrics(held.constraints.names, held.binding, held.postures),
        {one.name: one for one in outcome.tracking.replays},
        outcome.tracking.failure,
        {case.name: FilterMetrics.of(case.motion) for case in (*inputs.cases, *inputs.unseen)},
        outcome.carried and geometry_tables.metrics(outcome.carried, outcome.geometries),
        outcome.repeated,
        outcome.findings,
        outcome.seed,
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class TorqueCurves:
    """Measured and predicted torques of one recording, (rows, K) each, thinned for drawing; times [s]."""

    name: str
    t: Array
    measured: Array
    predicted: Array

    @classmethod
    def of(cls, case: Case, predicted: np.ndarray) -> TorqueCurves:
        """Return them of a case and its prediction (N, rows)."""
        picked = np.unique(np.linspace(0, len(case.target) - 1, MAX_POINTS).astype(int))
        shown = (np.asarray(x)[picked].T for x in (case.target, predicted))
        return cls(case.name, np.round(case.motion.t[picked], 4), *(_five_digits(x) for x in shown))


def _five_digits(values: np.ndarray) -> np.ndarray:
    return np.array([float(f"{x:.5g}") for x in values.ravel()]).reshape(values.shape)


@dataclass(frozen=True, eq=False)
class UnseenReport:
    """A model on unseen motion, as ``unseen/report.json`` stores it; see `calib.procedure.dynamic_stage.validation`."""

    verdict: str
    reason: str
    warnings: tuple[str, ...]
    rows: tuple[str, ...]
    units: tuple[str, ...]
    fit: Mapping[str, Score]
    validation: Mapping[str, Score]
    curves: tuple[TorqueCurves, ...]
    tracking: Mapping[str, Replay] = field(default_factory=dict)
    tracking_failure: str = ""
    schema: int = UNSEEN_SCHEMA

    @classmethod
    def of(cls, inputs: IdentificationInputs, found: Assessment) -> UnseenReport:
        """Return the report of an assessment."""
        rows = inputs.options.settings.torque_rows.titles(inputs.chain.joint_names)
        curves = (TorqueCurves.of(case, found.predictions[case.name]) for case in (inputs.unseen or inputs.cases))
        return cls(
            found.verdict.level, found.verdict.reason, found.warnings, tuple(rows), tuple(inputs.row_units), found.fit,
            found.validation, tuple(curves), {one.name: one for one in found.tracking.replays}, found.tracking.failure,
        )  # fmt: skip

    @property
    def proofs(self) -> dict[str, Score]:
        """Recordings that the model has not seen, by name; repeats of the training motion are none."""
        return {name: one for name, one in self.validation.items() if one.evidence}


# ---- folders of earlier versions ------------------------------------------------------------------------------------

_WHITENESS = ("pacf", "bound", "ljung_box_p", "kurtosis", "normal_p")
_STEP = ("ratio", "f", "p", "p_total")


def with_current_keys(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return what an earlier version's ``metrics.json`` or ``unseen/report.json`` holds, under today's keys."""
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
    return {"name": "", "seconds": 0.0, "terms_left_out": []} | dict(one) | {
        "stated": control["stated"], "controller": {**control, **rows} if rows else None,
    }  # fmt: skip
