"""What ``metrics.json`` of an identification and ``unseen/report.json`` hold, as values."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from calib.records import read_record

Numbers = tuple[float | None, ...]


@dataclass(frozen=True)
class _RelativeErrors:
    """100 ‖τ - τ̂‖ / ‖τ‖ over all rows, and of each [%]."""

    total: float | None
    joints: Numbers


@dataclass(frozen=True)
class _PredictionErrors:
    """Errors on one set of samples; rms of each torque row in its unit."""

    relative_error_percent: _RelativeErrors
    rms: Numbers
    samples: int = 0


@dataclass(frozen=True)
class _RowWhiteness:
    """Of one row's residual: the share of its autocorrelations beyond the bounds of white noise."""

    outside: float


@dataclass(frozen=True)
class TorqueCoverage:
    """How many errors were within the 95 % interval that the model states, how wide that was, where it extrapolates.

    Attributes:
        coverage_percent: of all rows.
        joints_percent, median: of each, and the half width of its interval in its unit.
        samples: at which this was looked at.
        extrapolated_percent: of them.
        extrapolates: in words how the motion leaves what was learnt from.
    """

    coverage_percent: float
    joints_percent: Numbers
    median: Numbers
    samples: int
    extrapolated_percent: float
    extrapolates: tuple[str, ...] = ()


@dataclass(frozen=True)
class RecordingErrors:
    """One recording, predicted; see `calib.identification.scores.Score`.

    Attributes:
        evidence: False for a repeat of the training motion.
        interval95: how the errors that the model stated held here.
    """

    raw: _PredictionErrors
    filtered: _PredictionErrors
    moving: _PredictionErrors
    standing: _PredictionErrors
    above_band_percent: Numbers
    whiteness: tuple[_RowWhiteness | None, ...]
    evidence: bool = True
    interval95: TorqueCoverage | None = None


@dataclass(frozen=True)
class _ParameterCounts:
    """How many parameters the model has, the torques of any motion tell, and were kept."""

    standard: int
    base: int
    essential: int


@dataclass(frozen=True)
class _ColumnCounts:
    """Standard parameters without effect on any torque, and those regrouped into others."""

    without_effect: int
    regrouped: int


@dataclass(frozen=True)
class _ConditionNumber:
    """Of the observation matrix, in its units and with columns of unit norm."""

    raw: float | None
    normalised: float | None


@dataclass(frozen=True)
class _FrictionStep:
    """One friction model tried, with its error on time left out [%]."""

    model: str
    parameters: int
    cross_validated_percent: float | None
    joints_percent: Numbers
    kept_at_joints: tuple[int, ...]
    kept: bool
    note: str = ""


@dataclass(frozen=True)
class _GearWave:
    """An order per turn of a gear's joint."""

    gear: int
    order_per_turn: float


@dataclass(frozen=True)
class _TorqueRipple:
    """Ripple found at a joint, counted from one."""

    joint: int
    waves: tuple[_GearWave, ...]
    explained_share_on_unseen_blocks: float


@dataclass(frozen=True)
class _EliminatedParameter:
    """A parameter that the data do not tell, with its RSD [%] when it went."""

    name: str
    rsd: float | None


@dataclass(frozen=True)
class _DurbinWuHausman:
    """The test of least squares against instrumental variables."""

    f: float | None
    degrees: tuple[float, ...]
    p: float
    least_squares_biased: bool


@dataclass(frozen=True)
class LoopMetrics:
    """What instruments from a simulated loop say; see `calib.procedure.dynamic_stage.loop_tables`."""

    failure: str = ""
    notes: tuple[str, ...] = ()
    instruments: str = ""
    beside: bool = False
    rounds: int = 0
    durbin_wu_hausman: _DurbinWuHausman | None = None
    largest_shift_sigma: float = 0.0
    cragg_donald: float | None = None
    instruments_weak: bool = False
    least_partial_r2: float = 0.0
    distance_percent: Numbers = ()
    simulated_torque_error_percent: Numbers = ()
    valid: bool = True
    explains: bool = True


@dataclass(frozen=True)
class ReplayController:
    """Whether the controller of a replay was stated."""

    stated: bool = False


@dataclass(frozen=True)
class ReplayMetrics:
    """A recording replayed by the simulated robot: rms of q - reference by what is fed forward [rad or m]."""

    rms: Mapping[str, Numbers]
    feedback_over_model: float
    unseen: bool
    controller: ReplayController
    inertia_added: Numbers


@dataclass(frozen=True)
class _TiltEffect:
    """The parameter that 1 mrad of the base's tilt moves most, and by how many of its sigmas of torque noise."""

    parameter: str
    sigmas: float


@dataclass(frozen=True)
class _GeometryMetrics:
    """What the geometry's uncertainty adds to the estimate."""

    propagated: bool
    summary: str
    changed: tuple[str, ...]
    moved_by_1_mrad_of_tilt: _TiltEffect


@dataclass(frozen=True)
class ModelMetrics:
    """The content of ``metrics.json``; see `calib.procedure.dynamic_stage.folder`."""

    identification: Mapping[str, RecordingErrors]
    validation: Mapping[str, RecordingErrors]
    parameters: _ParameterCounts
    counts: _ColumnCounts
    rows: tuple[str, ...]
    condition_number: _ConditionNumber
    friction: str
    method: str
    method_assumes: str
    ladder: tuple[_FrictionStep, ...]
    ripple: tuple[_TorqueRipple, ...]
    elimination: tuple[_EliminatedParameter, ...]
    warnings: tuple[str, ...]
    verdict: str
    reason: str
    unit: str = "N m"
    loop: LoopMetrics | None = None
    tracking: Mapping[str, ReplayMetrics] = field(default_factory=dict)
    tracking_failure: str = ""
    geometry: _GeometryMetrics | None = None
    repeated: Mapping[str, float] = field(default_factory=dict)


def model_metrics(content: Mapping[str, Any]) -> ModelMetrics:
    """Return the content of ``metrics.json`` as values; where tracking failed, the reason stands in its place there.

    Raises:
        ValueError: where it is none.
    """
    tracking = content.get("tracking") or {}
    failure = tracking.get("failure", "")
    parts = {"tracking": {} if failure else tracking, "tracking_failure": failure}
    return read_record(ModelMetrics, {**content, **parts})


@dataclass(frozen=True)
class _TorqueCurves:
    """Measured and predicted torques of one recording, per row, thinned for drawing; times [s]."""

    name: str
    t: tuple[float, ...]
    measured: tuple[tuple[float, ...], ...]
    predicted: tuple[tuple[float, ...], ...]


@dataclass(frozen=True)
class _Autocorrelations:
    """Of the residual of each row below the band, with the bounds of white noise; None for short ones."""

    bound: Numbers
    values: tuple[tuple[float, ...] | None, ...]


@dataclass(frozen=True)
class UnseenReport:
    """The content of ``unseen/report.json``; see `calib.procedure.dynamic_stage.validation`."""

    schema: int
    verdict: str
    reason: str
    warnings: tuple[str, ...]
    rows: tuple[str, ...]
    units: tuple[str, ...]
    fit: Mapping[str, RecordingErrors]
    validation: Mapping[str, RecordingErrors]
    curves: tuple[_TorqueCurves, ...]
    autocorrelation: Mapping[str, _Autocorrelations]

    @property
    def proofs(self) -> dict[str, RecordingErrors]:
        """Recordings that the model has not seen, by name; repeats of the training motion are none."""
        return {name: one for name, one in self.validation.items() if one.evidence}


class IdentifiedParameter(NamedTuple):
    """A row of ``estimate.csv``; RSD in percent; no σ where nothing was measured."""

    name: str
    expression: str
    unit: str
    value: float
    sigma: float | None
    rsd: float | None


class TwoGeometries(NamedTuple):
    """A row of ``geometries.csv``: a parameter identified on the nominal and on the calibrated geometry."""

    name: str
    unit: str
    nominal: float
    sigma_nominal: float
    calibrated: float
    sigma_calibrated: float
    relative_percent: float | None
    sigma_difference: float
    essential: str


class GeometricEffect(NamedTuple):
    """A row of ``geometry_effects.csv``: what one sigma of a geometric element does to the dynamics."""

    rank: int
    element: str
    unit: str
    sigma: float | None
    matters: str
    parameter: str
    shift_sigma: float | None
    parameters_moved: int | None
    torque_rms: float | None
    torque_rms_left: float | None
    shift_sigma_per_milli: float
