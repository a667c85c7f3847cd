"""An identified model as a predictor of torques, and the errors of predicted torques.

The errors are relative errors, separately for moving and standing joints, and the share of the torque above the
identification band.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Generic

import numpy as np
from typing_extensions import TypeVar

from calib.data.signals.filtering import longest
from calib.data.signals.motion import moving
from calib.dynamics.idim import IdentificationModel
from calib.dynamics.regressor_model import RegressorModel
from calib.estimation.whiteness import Whiteness, examine, r_squared
from calib.identification.rows import BLOCK, Case, segmented_states
from calib.records import Array, Frozen, Number

REST_SHARE = 0.05
"""Share of a recording's rows at rest above which errors in motion and at rest are stated separately (our choice)."""
JACKKNIFE_BLOCKS = 10
"""Blocks of time of the jackknife (our choice)."""
MIN_WHITENESS_SAMPLES = 40
"""Decimated samples above which the whiteness of residuals is tested."""
MAX_LAGS = 30
"""Lags of the test of whiteness."""
PASSING_SHARE = 10.0
"""Unexplained share of the raw torque [%] that passes (finding ``torque-unexplained``)."""
MAX_PREDICTED_ABOVE = 0.1
"""Predicted torque above the identification band, in squares over the measured one, up to which there is noise or what
else no motion explains (our choice)."""


@dataclass(frozen=True, eq=False)
class RelativeErrors:
    """Relative errors of predicted torques τ̂ [%].

    Attributes:
        total: 100 ‖τ - τ̂‖_F / ‖τ‖_F over all rows and samples.
        joints: (rows,) 100 ‖τ_j - τ̂_j‖ / ‖τ_j‖; NaN without measurements.
    """

    total: Number
    joints: Array


@dataclass(frozen=True, eq=False)
class PredictionErrors:
    """Prediction errors on a set of samples.

    Attributes:
        relative_error_percent: relative errors of all rows together, and of each row.
        rms: (rows,) rms of τ - τ̂ in the torque's unit.
        samples: number of torque values in all rows.
    """

    relative_error_percent: RelativeErrors
    rms: Array
    samples: int = 0

    @property
    def total(self) -> float:
        """Relative error of all rows together [%]."""
        return self.relative_error_percent.total

    @property
    def joints(self) -> np.ndarray:
        """Relative error of each row (rows,) [%]."""
        return self.relative_error_percent.joints


@dataclass(frozen=True, eq=False)
class IntervalCoverage:
    """Share of the errors within a model's 95 % intervals, and share of samples outside its training range.

    Attributes:
        coverage_percent, joints_percent: share of errors within the intervals, over all rows, and of each row (rows,).
        median: (rows,) median half width of the intervals in motion, in the torque's unit.
        samples: number of samples compared.
        extrapolated_percent: share of these samples outside the training range.
        median_at_rest: (rows,) median half width at rest; NaN for a joint that is never at rest; () in files of earlier
            versions.
    """

    coverage_percent: float
    joints_percent: Array
    median: Array
    samples: int
    extrapolated_percent: float
    median_at_rest: Array = field(default_factory=lambda: np.zeros(0))


@dataclass(frozen=True, eq=False)
class Score:
    """Prediction errors of one recording, a record of ``metrics.json``.

    Attributes:
        raw: errors relative to the torque as recorded, at the full rate.
        filtered: errors with both torques low-passed to the identification band, at the full rate.
        moving, standing: errors as in `raw`, but only of moving joints, and only of standing joints.
        above_band_percent: (rows,) share of the torque above the identification band, 100 ‖τ - τ_f‖ / ‖τ‖ [%]: noise,
            ripple, elasticity; a lower bound of `raw` for any model with predictions in the band.
        r_squared: (rows,) R² of the raw torque.
        whiteness: whiteness test of the residuals below the band, per row; None for series too short to test.
        rate: sampling rate of the series in the whiteness test, decimated to its band [Hz].
        motion_share: share of rows in motion; if small, the test covers mostly friction at rest.
        evidence: False for a repetition of the training motion.
        interval95: coverage of the 95 % intervals; None if the model has no intervals.
        moving_in_band: errors as in `filtered`, but only of moving joints; None in files of earlier versions.
        floor_percent: residual above the identification band, 100 ‖r - r_f‖ / ‖τ‖ over all rows [%], if the model
            predicts next to no torque there; 0 if it predicts some, and in files of earlier versions.
        band: upper end of the identification band [Hz]; NaN: not filtered, and in files of earlier versions.
    """

    raw: PredictionErrors
    filtered: PredictionErrors
    moving: PredictionErrors
    standing: PredictionErrors
    above_band_percent: Array
    r_squared: Array
    whiteness: tuple[Whiteness | None, ...]
    rate: Number
    motion_share: float
    evidence: bool = True
    interval95: IntervalCoverage | None = None
    moving_in_band: PredictionErrors | None = None
    floor_percent: Number = 0.0
    band: Number = np.nan

    @property
    def floor_dominates(self) -> bool:
        """Whether most of the squared error is above the identification band, where the motion predicts no torque."""
        return 2.0 * self.floor_percent**2 > self.counted(in_band=False).total ** 2

    @property
    def noisy(self) -> bool:
        """Whether noise would decide the verdict: the error does not pass, and most of it is above the band."""
        return self.floor_dominates and self.counted(in_band=False).total > PASSING_SHARE

    @property
    def stands(self) -> bool:
        """Whether joints are at rest for a noticeable part of the recording, in addition to reversals."""
        return self.motion_share < 1.0 - REST_SHARE and self.moving.samples > 0

    def counted(self, in_band: bool) -> PredictionErrors:
        """Return the errors of moving joints, or all errors if no joint is at rest.

        Friction at rest is undetermined, so that errors at rest do not count.

        Args:
            in_band: whether only errors in the identification band count.
        """
        if not in_band:
            return self.moving if self.stands else self.raw
        if self.stands and self.moving_in_band is not None:
            return self.moving_in_band
        return self.filtered

    @property
    def judged(self) -> PredictionErrors:
        """Errors that the verdict uses: in a `noisy` recording those in the identification band."""
        return self.counted(in_band=self.noisy)

    @property
    def above_band(self) -> str:
        """Text on the unexplained share of the torque with all frequencies; empty unless the recording is `noisy`."""
        return f"{self.counted(in_band=False).total:.2f} %" if self.noisy else ""

    @property
    def at_rest(self) -> str:
        """Text on the error of joints at rest; empty if no joint is at rest."""
        return f"{self.standing.total:.2f} %" if self.stands else ""


def relative_error_sigma(measured: np.ndarray, predicted: np.ndarray) -> float:
    """Return the standard error of 100 ‖τ - τ̂‖ / ‖τ‖ [%] (measured τ, predicted τ̂), by a jackknife over time blocks.

    Blocks are used because residuals are autocorrelated (Efron and Tibshirani 1993, eq. 11.5, with blocks instead of
    samples: Künsch 1989); ten blocks are our choice.

    Args:
        measured, predicted: (rows, N) torques τ and τ̂, in one unit.

    Returns:
        the standard error; NaN if there are fewer than two samples for each block, or no torque.
    """
    count = measured.shape[1]
    if count < 2 * JACKKNIFE_BLOCKS:
        return np.nan
    starts = np.linspace(0, count, JACKKNIFE_BLOCKS, endpoint=False).astype(int)
    squares = np.sum((measured - predicted) ** 2, axis=0)
    error = np.add.reduceat(squares, starts)
    torque = np.add.reduceat(np.sum(measured**2, axis=0), starts)
    remaining_torque = torque.sum() - torque
    if not (remaining_torque > 0.0).all():
        return np.nan
    percent = 100.0 * np.sqrt((error.sum() - error) / remaining_torque)
    squares = np.sum((percent - percent.mean()) ** 2)
    return float(np.sqrt((JACKKNIFE_BLOCKS - 1) / JACKKNIFE_BLOCKS * squares))


def score(
    case: Case, predicted: np.ndarray, slow: float | tuple[float, ...] | None = None, apart: Sequence[int] = ()
) -> Score:
    """Return the errors of predicted torques at the full rate; lost samples are ignored.

    Args:
        case: the recording.
        predicted: (N, rows) predicted torques, in the unit of the recorded ones.
        slow: share of a joint's peak speed below which the joint counts as at rest, or one speed per joint [rad/s or
            m/s]; None: the default of `calib.data.signals.motion.moving`.
        apart: indices of rows in a different unit, excluded from totals.
    """
    motion = case.motion
    moves = moving(motion) if slow is None else moving(motion, slow)
    sums = []
    floors = []
    above = []
    explained = []
    residuals = []
    for row in range(case.target.shape[1]):
        row_moves = moves[:, row % motion.n]
        row_predicted = np.asarray(predicted)[:, row]
        row_sums, row_floor, row_above, row_explained, residual = _score_row(case, row_predicted, row, row_moves)
        sums.append(row_sums)
        floors.append(row_floor)
        above.append(row_above)
        explained.append(row_explained)
        residuals.append(residual)
    raw, filtered, in_motion, at_rest, in_motion_and_band = np.stack(sums, axis=1)
    step = motion.decimator.factor
    standing = _prediction_errors(at_rest, apart)
    above_band_percent = np.array(above)
    segment = motion.segment[::step]
    whiteness = _whiteness(np.stack(residuals, axis=1), segment)
    rate = motion.rate / step
    motion_share = float(moves.mean())
    raw_errors = _prediction_errors(raw, apart)
    filtered_errors = _prediction_errors(filtered, apart)
    moving_errors = _prediction_errors(in_motion, apart)
    return Score(
        raw=raw_errors,
        filtered=filtered_errors,
        moving=moving_errors,
        standing=standing,
        above_band_percent=above_band_percent,
        r_squared=np.array(explained),
        whiteness=whiteness,
        rate=rate,
        motion_share=motion_share,
        moving_in_band=_prediction_errors(in_motion_and_band, apart),
        floor_percent=_floor_percent(np.array(floors), apart),
        band=motion.band,
    )


def _floor_percent(sums: np.ndarray, apart: Sequence[int]) -> float:
    """Return `Score.floor_percent` from sums (rows, 4) over the squares above the band and of the torque.

    Args:
        sums: Σ r², Σ τ² and Σ τ̂² of the residuals, measured and predicted torques above the band; Σ τ² of the torque.
        apart: rows in a different unit, excluded.
    """
    same_unit = ~np.isin(np.arange(len(sums)), apart)
    residual, measured, predicted, torque = sums[same_unit].sum(axis=0)
    if not torque or predicted > MAX_PREDICTED_ABOVE * measured:
        return 0.0
    return float(100.0 * np.sqrt(residual / torque))


def _score_row(
    case: Case, predicted: np.ndarray, row: int, moves: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float, float, np.ndarray]:
    """Return the sums from which a torque row is scored; rows are processed one by one to save memory.

    Args:
        case: the recording.
        predicted: (N,) predicted torque.
        row: index of the row.
        moves: (N,) mask of samples in which the joint moves.

    Returns:
        an array (5, 3) of Σ (τ - τ̂)², Σ τ² and number of samples, for raw torques, filtered torques, moving joints,
        standing joints, and filtered torques of moving joints; the sums (4,) of `_floor_percent`;
        `Score.above_band_percent` and `Score.r_squared` of the row; the filtered residual (M,), decimated.
    """
    motion = case.motion
    valid = motion.weight > 0.5
    target = case.target[:, row]
    residual = target - predicted
    target_in_band, predicted_in_band = motion.in_band(np.stack([target, predicted], axis=1)).T
    residual_in_band = target_in_band - predicted_in_band
    in_motion = _sums(target, residual, valid & moves)
    at_rest = _sums(target, residual, valid & ~moves)
    raw = _sums(target, residual, valid)
    filtered = _sums(target_in_band, residual_in_band, valid)
    in_motion_and_band = _sums(target_in_band, residual_in_band, valid & moves)
    sums = [raw, filtered, in_motion, at_rest, in_motion_and_band]
    above_band = np.stack([residual - residual_in_band, target - target_in_band, predicted - predicted_in_band, target])
    floor = np.sum(above_band[:, valid] ** 2, axis=1)
    size = float(np.linalg.norm(target))
    above = 0.0
    if size > 0.0:
        above = 100.0 * float(np.linalg.norm(target - target_in_band)) / size
    thinned = residual_in_band[:: motion.decimator.factor]
    return np.array(sums), floor, above, r_squared(target[valid], residual[valid]), thinned


def _sums(target: np.ndarray, residual: np.ndarray, selected: np.ndarray) -> tuple[float, float, float]:
    """Return Σ (τ - τ̂)², Σ τ² and the number of samples, over the selected samples.

    Args:
        target: torques τ of all samples.
        residual: their prediction errors τ - τ̂.
        selected: mask of the samples to count.
    """
    residual_square = float(np.sum(residual[selected] ** 2))
    target_square = float(np.sum(target[selected] ** 2))
    return residual_square, target_square, float(selected.sum())


def _prediction_errors(sums: np.ndarray, apart: Sequence[int]) -> PredictionErrors:
    """Return prediction errors from sums (rows, 3) of the torque rows: Σ (τ - τ̂)², Σ τ² and number of samples.

    The total excludes the rows `apart`.

    Args:
        sums: one row per torque row.
        apart: indices of rows in a different unit.
    """
    square, size, count = np.array(sums).T
    same_unit = ~np.isin(np.arange(len(square)), apart)
    with np.errstate(divide="ignore", invalid="ignore"):
        joints = 100.0 * np.sqrt(square / size)
        rms = np.sqrt(square / count)
        share = square[same_unit].sum() / size[same_unit].sum()
        total = float(100.0 * np.sqrt(share))
    relative = RelativeErrors(total, np.where(size > 0.0, joints, np.nan))
    samples = int(count.sum())
    return PredictionErrors(relative, np.where(count > 0, rms, np.nan), samples)


def _whiteness(residual: np.ndarray, segment: np.ndarray) -> tuple[Whiteness | None, ...]:
    """Return the whiteness test of each row of decimated residuals (M, rows), in the longest segment.

    The test is None for a row with too few samples or without variation.

    Args:
        residual: residuals τ - τ̂ at the decimated samples.
        segment: (M,) number of the gap-free segment of each sample.
    """
    tests: list[Whiteness | None] = []
    for column in residual[longest(segment)].T:
        if len(column) > MIN_WHITENESS_SAMPLES and np.ptp(column) > 0.0:
            tests.append(examine(column, min(MAX_LAGS, len(column) // 2)))
        else:
            tests.append(None)
    return tuple(tests)


Model = TypeVar("Model", bound=RegressorModel, default=IdentificationModel, covariant=True)


@dataclass(frozen=True, eq=False)
class Dynamics(Frozen, Generic[Model]):
    """A dynamic model with its parameter values.

    Attributes:
        model: bodies and drive terms, or another model that is linear in its parameters.
        values: (p,) values of all standard parameters and drive terms. Kept parameters have the base values and
            regrouped ones are zero, so that single bodies may be physically inconsistent
            (`calib.dynamics.base.to_standard`).
    """

    model: Model
    values: np.ndarray

    def transmitted(self: Dynamics[IdentificationModel], case: Case) -> np.ndarray:
        """Return the torques (N, n) that the gears transmit to the bodies along a case, for load-dependent friction."""
        q, v, a = case.links
        result = np.empty(case.motion.q.shape)
        for start in range(0, len(case.motion), BLOCK):
            part = slice(start, start + BLOCK)
            result[part] = self.model.transmitted(self.values, q[part], v[part], a[part], case.carried)
        return result


def predict(dynamics: Dynamics[RegressorModel], case: Case) -> np.ndarray:
    """Return the predicted torques (N, rows) of a case at the full rate [N m or N]: W(q, v, a) · values.

    The regressor W is not computed.

    Args:
        dynamics: the model with its parameter values.
        case: the recording.
    """
    model, motion = dynamics.model, case.motion
    states = segmented_states(model.columns, case)
    result = np.empty((len(motion), model.rows))
    for start in range(0, len(motion), BLOCK):
        part = slice(start, start + BLOCK)
        q = motion.q[part]
        v = motion.v[part]
        a = motion.a[part]
        deflected = case.deflected(part)
        result[part] = model.torque(dynamics.values, q, v, a, case.carried, states[:, part], **deflected)
    return result
