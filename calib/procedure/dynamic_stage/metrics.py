"""Content of ``metrics.json`` (schema 3): the record of an identification, from which console and certificate are made.

The fields of the dataclasses are the keys of the file. Most values are those of the estimation, stored with its types.
Files before schema 3 have no schema number and other keys; `with_current_keys` converts them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np

from calib.config_types import ParsedTable
from calib.data.signals.motion import Motion
from calib.errors import Finding
from calib.estimation.essential import EliminationStep
from calib.identification.earlier import ModelChoice
from calib.identification.friction.friction_ladder import FrictionTrial
from calib.identification.friction.ripple import RippleWaves
from calib.identification.gains import GainRecord
from calib.identification.identify import Identification, common_decimator
from calib.identification.loop import LoopMetrics, Replay
from calib.identification.methods.constraint_settings import Binding
from calib.identification.prediction import Score, relative_error_sigma
from calib.identification.registry import METHODS
from calib.identification.rows import Case
from calib.identification.uncertainty.error_bands import ErrorBands, error_bands
from calib.identification.uncertainty.error_growth import error_growth
from calib.procedure.dynamic_stage import geometry_tables, with_geometry
from calib.procedure.dynamic_stage.identify import DynamicsAssessment, IdentificationOutcome, ModelFindings
from calib.procedure.dynamic_stage.inputs import IdentificationInputs
from calib.procedure.dynamic_stage.plain import PlainReferences
from calib.records import Array, FieldValues, Number, Unbounded, evenly
from calib.units import TORQUE

# of metrics.json, and of unseen/report.json
SCHEMA, UNSEEN_SCHEMA = 3, 2
# samples per curve of the certificate (our choice)
MAX_POINTS = 600
# share of a parameter's sigma without constraints below which a constraint holds it
BOUND_SIGMA = 1e-9


@dataclass(frozen=True)
class ParameterCounts:
    """Numbers of standard parameters, base parameters (identifiable from some motion), and essential parameters."""

    standard: int
    base: int
    essential: int


@dataclass(frozen=True)
class ColumnCounts:
    """Numbers of standard parameters without effect on any torque, and of standard parameters regrouped into others."""

    without_effect: int
    regrouped: int


@dataclass(frozen=True)
class ConditionNumber:
    """Condition number of the observation matrix: in SI units (raw), and with columns of unit norm (normalised)."""

    raw: Number
    normalised: Number


@dataclass(frozen=True, eq=False)
class FilterMetrics:
    """Filters of a recording.

    Attributes:
        rate: sampling rate [Hz].
        cutoff: (n,) cutoff f_q of the positions' filter, by joint [Hz].
        band: upper limit f_p of the identification band [Hz].
        decimation: number of samples per row of the identification.
        velocity_cutoff: (n,) cutoff f_v of the velocities' filter, by joint [Hz]; None in files of version 0.1: equal
            to `cutoff`.
    """

    rate: float
    cutoff: Array
    band: float
    decimation: int
    # of 0.1: the same
    velocity_cutoff: Array | None = None

    @classmethod
    def of(cls, motion: Motion) -> FilterMetrics:
        """Return rate, cutoffs, band and decimation factor of a filtered motion."""
        return cls(motion.rate, motion.cutoff, motion.band, motion.decimator.factor, motion.velocity_cutoff)


@dataclass(frozen=True, eq=False)
class ConstraintMetrics:
    """Constraints of an estimate.

    Attributes:
        names: names of the constraints.
        binding: the constraints that are at their bounds.
        postures_binding: number of postures at which the inertia matrix is at the bound of positive definiteness.
    """

    names: tuple[str, ...]
    binding: tuple[Binding, ...]
    postures_binding: int


@dataclass(frozen=True, eq=False, kw_only=True)
class JudgedMetrics:
    """Results of a model on recordings, as stored in ``metrics.json`` and ``unseen/report.json``.

    Attributes:
        verdict, reason: level of the verdict on the model, and the reason as text.
        code, advice: code and advice of the finding that decided the verdict; empty for a pass, and in files of earlier
            versions.
        warnings: texts for the user.
        noticed: findings whose sentences are in the warnings; other warnings are text only.
        rows: names of the torque rows.
        validation: name of a held-out recording -> score of the model.
        tracking: name of a recording -> simulated tracking with the model as feedforward.
        tracking_failure: reason why no tracking was simulated; empty otherwise.
        references: name of a held-out recording -> errors of the plain references beside the model's error.
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


def _judged(assessment: DynamicsAssessment) -> FieldValues:
    """Return the entries of an assessment that both JSON files contain, without the names of the torque rows."""
    return {
        "verdict": assessment.verdict.level,
        "reason": assessment.verdict.reason,
        "code": assessment.verdict.code,
        "advice": assessment.verdict.advice,
        "warnings": assessment.warnings,
        "noticed": assessment.noticed,
        "validation": assessment.validation,
        "tracking": assessment.tracking,
        "tracking_failure": assessment.tracking_failure,
        "references": assessment.references,
    }


@dataclass(frozen=True, eq=False, kw_only=True)
class ModelMetrics(JudgedMetrics):
    """The content of an identification's ``metrics.json``.

    Attributes:
        identification: name of a training recording -> score of the model.
        parameters, counts: numbers of parameters, and of standard parameters that are not estimated.
        condition_number: condition number of the observation matrix.
        friction: name of the friction model.
        method, method_assumes: identification method, and its assumption as text.
        ladder: tried friction models with their errors.
        ripple: torque ripple of the joints; empty: not modelled.
        elimination: steps of the elimination of parameters that are not essential; empty: none.
        unit: unit of the torques.
        switched_off: names of drive terms that were switched off, since nothing was measured for them.
        drive_gains: identified drive gains; None: none.
        loop: results of the closed-loop simulation; None: none.
        constraints: constraints of the estimate; None: none.
        filters: name of a recording -> its filters.
        geometry: effect of the geometry's uncertainty; None: not computed.
        geometry_from_torques: geometry estimated together with the dynamics; None: not requested.
        repeated: name of a held-out recording that repeats training motion -> share of its states in the training.
        findings: findings that the verdict needs besides the recordings; None in files of earlier versions.
        error_density: (rows,) spectral density of the torque errors [N² m² s or N² s]; None in files of earlier
            versions.
        error_growth, torque_variance: (rows,) share of the density that grows with the torque, and the variance of the
            torques from which it was estimated [N² m² or N²]; None in files of earlier versions.
        error_bands: the density in wider bands; None in files of earlier versions.
        choice: chosen friction terms and prior, for an identification that carries them on; None in files of earlier
            versions.
        seed: seed of all random numbers.
        schema: version of the file's format.
    """

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
    geometry_from_torques: with_geometry.GeometryFromTorquesMetrics | None = None
    repeated: Mapping[str, float] = field(default_factory=dict)
    findings: ModelFindings | None = None
    error_density: Array | None = None
    error_growth: Array | None = None
    torque_variance: Array | None = None
    error_bands: ErrorBands | None = None
    choice: ModelChoice | None = None
    seed: int = 0
    schema: int = SCHEMA


def on_bounds(identification: Identification) -> tuple[str, ...]:
    """Return the names of the parameters that a constraint fixes at its bound.

    The recordings do not identify these parameters, so that they have no σ. The covariance treats the constraint as an
    equality; the σ of the other parameters therefore assume that the fixed values are exact.

    Args:
        identification: the identification with its constrained estimate.
    """
    constrained = identification.fitted.held
    if constrained is None:
        return ()
    names = []
    sigmas, free_sigmas = identification.fitted.estimate.sigma, constrained.free.estimate.sigma
    for name, sigma, free_sigma in zip(identification.names, sigmas, free_sigmas):
        if sigma <= BOUND_SIGMA * free_sigma:
            names.append(name)
    return tuple(names)


# file, report and console read the same record one after the other
@lru_cache(maxsize=1)
def metrics(outcome: IdentificationOutcome) -> ModelMetrics:
    """Return the content of ``metrics.json`` for the outcome of an identification."""
    identification, inputs = outcome.found, outcome.inputs
    base, constrained = identification.base, identification.fitted.held
    count = base.b + len(identification.friction.terms)
    essential, steps = count, ()
    if identification.elimination is not None:
        essential, steps = len(identification.elimination.kept), identification.elimination.steps
    method = identification.fitted.method
    filters = {case.name: FilterMetrics.of(case.motion) for case in (*inputs.cases, *inputs.unseen)}
    growth = error_growth(identification.rows, identification.fitted.estimate.values)
    decimator = common_decimator(inputs.cases, identification.settings)
    bands = error_bands(inputs.cases, outcome.predictions, identification.rows, decimator)
    return ModelMetrics(
        **_judged(outcome),
        rows=identification.settings.torque_rows.numbered(inputs.chain.n),
        identification=outcome.fit,
        parameters=ParameterCounts(len(base.standard), count, essential),
        counts=ColumnCounts(len(base.without_effect), len(base.regrouped)),
        condition_number=ConditionNumber(*identification.condition),
        friction=identification.friction.chosen,
        method=method,
        method_assumes=METHODS[method].assumes,
        ladder=identification.friction.steps,
        ripple=tuple(ripple.found for ripple in identification.ripples),
        elimination=steps,
        unit=inputs.unit,
        switched_off=identification.friction.off,
        drive_gains=inputs.gains and GainRecord.of(inputs.gains, inputs.unit),  # ty: ignore[invalid-argument-type]
        loop=identification.loop.metrics,
        constraints=constrained and ConstraintMetrics(constrained.names, constrained.binding, constrained.postures),  # ty: ignore[invalid-argument-type]
        filters=filters,
        geometry=outcome.carried and geometry_tables.metrics(outcome.carried, outcome.geometries),  # ty: ignore[invalid-argument-type]
        geometry_from_torques=outcome.jointly and with_geometry.metrics(outcome.jointly),  # ty: ignore[invalid-argument-type]
        repeated=outcome.repeated,
        findings=outcome.findings,
        error_density=_error_density(identification, inputs.cases),
        error_growth=growth.share,
        torque_variance=growth.torque_variance,
        error_bands=bands,
        choice=identification.choice,
        seed=outcome.seed,
    )


def _error_density(identification: Identification, cases: Sequence[Case]) -> np.ndarray:
    """Return the spectral density of the torque errors (rows,) [N² m² s or N² s].

    The density is the variance of the errors divided by the number of independent rows per second. With it, the
    information matrix of a motion is ∫ ωᵀω / density dt, where ω is the regressor, the matrix that maps parameters to
    torques.

    Args:
        identification: the identification.
        cases: training recordings.
    """
    count = sum(len(rows.target) for rows in identification.rows)
    per_second = count / sum(case.duration for case in cases)
    return identification.fitted.std**2 * identification.fitted.inflation / per_second


@dataclass(frozen=True, eq=False)
class TorqueCurves:
    """Measured and predicted torques of one recording, thinned to K samples for drawing.

    Attributes:
        name: name of the recording.
        t: (K,) times [s].
        measured, predicted: (rows, K) torques.
        band: cutoff [Hz] to which both torques are low-passed; NaN: not filtered, in files of earlier versions.
        error_sigma: standard error [%] of the relative error of the unfiltered torques.
    """

    name: str
    t: Array
    measured: Array
    predicted: Array
    band: Number = np.nan
    error_sigma: Number = np.nan

    @classmethod
    def of(cls, case: Case, predicted: np.ndarray) -> TorqueCurves:
        """Return the curves of measured and predicted torques of a recording, thinned for drawing.

        Args:
            case: the recording with N samples.
            predicted: (N, rows) torques that the model predicts for it.
        """
        motion, measured = case.motion, np.asarray(case.target)
        picked = evenly(len(measured), MAX_POINTS)
        measured_in_band = _five_digits(motion.in_band(measured)[picked].T)
        predicted_in_band = _five_digits(motion.in_band(predicted)[picked].T)
        sigma = relative_error_sigma(measured[picked].T, predicted[picked].T)
        t = np.round(motion.t[picked], 4)
        return cls(case.name, t, measured_in_band, predicted_in_band, motion.band, sigma)


def _five_digits(values: np.ndarray) -> np.ndarray:
    rounded = [float(f"{x:.5g}") for x in values.ravel()]
    return np.array(rounded).reshape(values.shape)


@dataclass(frozen=True, eq=False, kw_only=True)
class UnseenReport(JudgedMetrics):
    """Report on a model's errors on held-out motion, the content of ``unseen/report.json``.

    Attributes:
        units: units of the torque rows.
        fit: name of a training recording -> score of the model.
        curves: torques of the recordings on which the verdict is based.
        limits: (rows,) torque limits of the robot's description; infinite: no limit; None in files of earlier versions.
        robot: name of the robot; empty in files of earlier versions.
    """

    units: tuple[str, ...]
    fit: Mapping[str, Score]
    curves: tuple[TorqueCurves, ...]
    limits: Unbounded | None = None
    robot: str = ""
    schema: int = UNSEEN_SCHEMA

    @classmethod
    def of(cls, inputs: IdentificationInputs, assessment: DynamicsAssessment) -> UnseenReport:
        """Return the report on an assessment of the model on the recordings in `inputs`."""
        torque_rows = inputs.options.settings.torque_rows
        rows = torque_rows.titles(inputs.chain.joint_names)
        cases = inputs.unseen or inputs.cases
        curves = [TorqueCurves.of(case, assessment.predictions[case.name]) for case in cases]
        # the description limits the torques of joints [N m or N], not those of other rows
        efforts = [np.inf] * len(inputs.chain.joints)
        if torque_rows.projection is None and inputs.unit == TORQUE:
            efforts = [joint.effort for joint in inputs.chain.joints]
        limits = np.resize(efforts, len(rows))
        return cls(
            **_judged(assessment),
            rows=tuple(rows),
            units=tuple(inputs.row_units),
            fit=assessment.fit,
            curves=tuple(curves),
            limits=limits,
            robot=inputs.chain.name,
        )

    @property
    def proofs(self) -> dict[str, Score]:
        """Scores on the held-out recordings that do not repeat the training motion: recording name -> score."""
        return {name: score for name, score in self.validation.items() if score.evidence}


# ---- folders of earlier versions ------------------------------------------------------------------------------------

_WHITENESS = ("pacf", "bound", "ljung_box_p", "kurtosis", "normal_p")
_STEP = ("ratio", "f", "p", "p_total")


def with_current_keys(content: ParsedTable) -> ParsedTable:
    """Return the content of an earlier version's ``metrics.json`` or ``unseen/report.json`` with the current keys."""
    if content.get("schema", UNSEEN_SCHEMA - 1) >= UNSEEN_SCHEMA:
        return dict(content)
    result = dict(content)
    for group in ("identification", "fit", "validation"):
        result[group] = {name: _score(score) for name, score in result.get(group, {}).items()}
    # autocorrelations stood apart
    for name, lags in result.pop("autocorrelation", {}).items():
        for scores in (result["fit"], result["validation"]):
            for row, whiteness in enumerate(scores.get(name, {}).get("whiteness", ())):
                if whiteness is not None:
                    whiteness |= {"acf": lags["values"][row], "bound": lags["bound"][row]}
    tracking = result.get("tracking") or {}
    result["tracking_failure"] = tracking.get("failure", "")
    result["tracking"] = {}
    if not result["tracking_failure"]:
        result["tracking"] = {name: _replay(replay) for name, replay in tracking.items()}
    if "elimination" in result:
        missing = dict.fromkeys(_STEP) | {"residual_std": 0.0, "listed": False}
        result["elimination"] = [missing | step for step in result["elimination"]]
        loop = result.get("loop")
        if loop:
            test = loop.get("durbin_wu_hausman")
            if test:
                test = test | {"statistic": test["f"]}
            result["loop"] = loop | {"durbin_wu_hausman": test, "controller": None}
    constraints = result.get("constraints")
    if constraints:
        binding = [bound | {"sigma": bound["free_sigma"]} for bound in constraints["binding"]]
        result["constraints"] = constraints | {"binding": binding}
    return result


def _score(score: ParsedTable) -> ParsedTable:
    """Return the score in a file of an earlier version with the current keys."""
    missing = {"acf": [], **dict.fromkeys(_WHITENESS)}
    rows = [whiteness and missing | whiteness for whiteness in score["whiteness"]]
    return {"rate": None, "r_squared": [], "motion_share": 1.0} | dict(score) | {"whiteness": rows}


def _replay(replay: ParsedTable) -> ParsedTable:
    """Return the simulated tracking (`replay`) in a file of an earlier version with the current keys."""
    stored = replay["controller"]
    controller = None
    if "kp" in stored:
        count = len(stored["kp"])
        controller = {**stored, "share": [1.0] * count, "windup": [None] * count}
    missing = {"name": "", "seconds": 0.0, "terms_left_out": []}
    return missing | dict(replay) | {"stated": stored["stated"], "controller": controller}
