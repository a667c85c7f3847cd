"""Lag of the recorded torques behind the positions of the same row: common to all joints, or of a single joint.

At every tested lag one model of all joints is fitted by least squares: bodies common to all joints and one drive per
joint, each joint weighted by its residual. (Separate bodies per joint would adapt to late torques: they give 148 ms for
torques that are 100 ms late.) Friction changes its sign later than the speed, since joints deflect before they slide;
this would look like a lag of 20 ms (wrist of the Panda). Therefore sign(v) may also change `FREE_TIME` earlier or later
at each joint, and only masses and inertias determine the lag. The minimum of the residual is interpolated by a
parabola. For sigma each joint counts as one independent sample; the lag of a single joint must agree in both halves of
the recording. Method and thresholds are our choice.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.identification.checks.recorded_motion import CREEP, MotionSamples, spanning
from calib.records import interpolated

LAGS = 0.25
"""Largest lag that is tried [s]."""
STEP = 0.005
"""Step of the lags that are tried [s]."""
SHIFTS = np.arange(-LAGS, LAGS + STEP / 2, STEP)
"""Lags that are tried [s]."""
RECORDED = len(SHIFTS) // 2
"""Index of no lag."""
MIN_LAG = 0.015
"""Smallest lag that is reported [s]."""
MIN_LAG_SIGMAS = 3.5
"""Smallest lag that is reported, in sigmas."""
MIN_GAIN = 1.05
"""Residual without the lag over residual with it, at least: of another robot any lag may be the best."""
LONG = 8.0
"""Time with samples from which on `MIN_GAIN` holds [s]; a shorter one needs the more gain, in inverse proportion.

Parts of 3 s of a sound Panda log seem 50 ms late, with a gain of 1.08 to 1.11; torques that are 40 ms late
there give 1.37 to 2.2.
"""
MAX_UNEXPLAINED = 0.4
"""Share of the joints' torques that a model may leave unexplained: one that leaves more identifies no lag."""
ALONE = 0.2
"""Share by which a lag of its own helps a joint, at least."""
OTHERS = 3.0
"""Times as much as any other joint's that it helps, at least."""
MAX_LAG_DIFFERENCE = 0.5
"""Share of a joint's lag by which those of both halves of the recording may differ from it."""
MIN_TIME = 2.0
"""Time with samples below which no lag is estimated: bodies make up for it [s]."""
ROUNDS = 4
"""Rounds of weighing joints by their residuals."""
LAG_SIGMA = 0.005
"""Sigma that a friction of another form brings [s]: real recordings as they are show lags of 4 ms rms."""
MAX_SWEEPS = 30
"""Sweeps over the joints' separate lags, at most."""
FREE_TIME = 0.03
"""Time by which friction may turn over early or late by itself [s]."""


@dataclass(frozen=True)
class Lag:
    """Lag of the torques behind the positions of the same row, and how much its correction reduces the residual.

    Attributes:
        seconds: the lag common to all joints [s]; positive for late torques.
        sigma: standard deviation of `seconds` [s].
        before, after: rms share of the joints' torques that bodies and friction do not explain, as recorded and after
            shifting the torques by the lag.
        factor: residual as recorded over residual after shifting, each joint weighted by its residual.
        own: (n,) lags of the joints, each estimated separately [s].
        gains: (n,) residual of a joint at the common lag over that at its separate lag, with all other joints at their
            separate lags.
        joint: the only joint, from 0, whose lag differs from the common one in both halves of the recording; None if
            there is none.
        duration: time with samples [s].
    """

    seconds: float
    sigma: float
    before: float
    after: float
    factor: float
    own: np.ndarray
    gains: np.ndarray
    joint: int | None
    duration: float = LONG

    @property
    def certain(self) -> bool:
        """Whether the common lag is significant and large enough to be reported."""
        min_lag = max(MIN_LAG, MIN_LAG_SIGMAS * self.sigma)
        significant = min_lag < abs(self.seconds) < LAGS - STEP
        # few seconds are explained a little better by many a lag
        min_gain = 1.0 + (MIN_GAIN - 1.0) * max(LONG / self.duration, 1.0)
        return significant and self.factor > min_gain and self.after < MAX_UNEXPLAINED


def lag_of(samples: MotionSamples, rate: float) -> Lag | None:
    """Return the lag of the torques; None if the motion is too short to estimate it.

    Args:
        samples: samples of the recording.
        rate: sampling rate of the recording [Hz].
    """
    count = len(samples.index)
    duration = count * float(np.median(np.diff(samples.index))) / rate
    if duration < MIN_TIME:
        return None
    columns, torque = _rows(samples, rate)
    middle = count // 2
    first = _LagRows.of(columns[:, :middle], torque[:, :, :middle])
    second = _LagRows.of(columns[:, middle:], torque[:, :, middle:])
    square = first.square + second.square
    cross = first.cross + second.cross
    power = first.power + second.power
    total = _LagRows(columns, torque, square, cross, power)
    lag = _lag_in(total)
    half_lags = [_lag_in(first), _lag_in(second)]
    difference = abs(half_lags[0].seconds - half_lags[1].seconds) / 2.0
    sigma = float(np.hypot(lag.sigma, difference))
    joint = _single_joint(lag, half_lags)
    return replace(lag, sigma=sigma, joint=joint, duration=duration)


def _single_joint(lag: Lag, half_lags: Sequence[Lag]) -> int | None:
    """Return the joint whose lag alone differs from the common one, in both halves of the recording; else None.

    Args:
        lag: lags in the whole recording.
        half_lags: lags in its first and in its second half.
    """
    joint = int(lag.gains.argmax())
    gains = np.sort(lag.gains) - 1.0
    late = lag.own[joint] - lag.seconds
    if abs(late) < MIN_LAG or abs(lag.own[joint]) > LAGS - 1.5 * STEP or len(gains) < 2:
        return None
    if gains[-1] < max(ALONE, OTHERS * gains[-2]):
        return None
    for half in half_lags:
        half_late = half.own[joint] - half.seconds
        if not abs(half_late - late) < MAX_LAG_DIFFERENCE * abs(late):
            return None
    return joint


@dataclass(frozen=True, eq=False)
class _LagRows:
    """Rows of a fit of n joints' torques at S lags, with products per joint that can be added over parts of a motion.

    Attributes:
        columns, torque: (n, m, p) regressor columns W and (n, S, m) torques τ of m rows per joint.
        square, cross, power: WᵀW (n, p, p), Wᵀτ (n, p, S) and τᵀτ (n, S).
    """

    columns: np.ndarray
    torque: np.ndarray
    square: np.ndarray
    cross: np.ndarray
    power: np.ndarray

    @classmethod
    def of(cls, columns: np.ndarray, torque: np.ndarray) -> "_LagRows":
        """Return the rows for columns (n, m, p) and torques (n, S, m), with the products WᵀW, Wᵀτ and τᵀτ."""
        across = columns.transpose(0, 2, 1)
        cross = across @ torque.transpose(0, 2, 1)
        return cls(columns, torque, across @ columns, cross, np.einsum("jsm,jsm->js", torque, torque))


def _rows(samples: MotionSamples, rate: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the regressor columns (n, m, p) of all joints, and the torques (n, S, m) shifted by all `SHIFTS`.

    Args:
        samples: samples of the recording.
        rate: sampling rate of the recording [Hz].
    """
    shifted = samples.index + SHIFTS[:, None] * rate
    times = np.arange(len(samples.effort))
    shifted_efforts = [np.interp(shifted, times, effort) for effort in samples.effort.T]
    torque = np.stack(shifted_efforts)
    turning = _turning(samples, rate)
    columns = np.concatenate([samples.inertial, samples.drives, *turning], axis=2)
    return np.ascontiguousarray(columns.transpose(1, 0, 2)), torque


def _lag_in(rows: _LagRows) -> Lag:
    """Return the least-squares lag of the rows; its sigma is computed from the differences between joints."""
    n = len(rows.torque)
    spread = rows.torque[:, RECORDED].std(axis=1)
    fit = _LagFit(rows, 1.0 / np.maximum(spread, 1e-12))
    for _ in range(ROUNDS):
        residual = fit.residual(np.full(n, fit.common.argmin()))
        fit = _LagFit(rows, fit.weight / np.maximum(residual.std(axis=1), 1e-12))
    best = int(fit.common.argmin())
    between_steps = STEP * _parabola_minimum(fit.common, best)
    ratio = fit.common[RECORDED] / max(fit.common[best], 1e-300)
    separate = fit.separate_lags(np.full(n, best))
    gains = [fit.gain(separate, joint, best) for joint in range(n)]
    seconds = float(SHIFTS[best] + between_steps)
    sigma = float(np.hypot(fit.sigma(best), LAG_SIGMA))
    factor = float(np.sqrt(ratio))
    recorded_lags = np.full(n, RECORDED)
    best_lags = np.full(n, best)
    return Lag(
        seconds=seconds,
        sigma=sigma,
        before=fit.unexplained_share(recorded_lags, spread),
        after=fit.unexplained_share(best_lags, spread),
        factor=factor,
        own=SHIFTS[separate],
        gains=np.array(gains),
        joint=None,
    )


class _LagFit:
    """Least squares of the joints' torques for any combination of lags; projections for every lag are computed once.

    Attributes:
        rows: columns and torques.
        weight: (n,) weights of the joints.
        spanning: (p, k) matrix that maps the columns to an orthonormal basis of their space.
        parts: (n, shifts, k) projections of each joint's weighted torques onto the basis.
        power: (n, shifts) sums of squares of the weighted torques.
        common: (shifts,) sum of squared residuals if all joints have the same lag.
    """

    def __init__(self, rows: _LagRows, weight: np.ndarray) -> None:
        """Project the torques, multiplied by `weight` (n,), onto the columns of all joints.

        Args:
            rows: columns and torques of n joints at all lags.
            weight: (n,) weights of the joints.
        """
        self.rows = rows
        self.weight = weight
        squares = weight**2
        square = np.tensordot(squares, rows.square, 1)
        self.spanning = spanning(square)
        projected = np.matmul(rows.cross.transpose(0, 2, 1), self.spanning)
        self.parts = projected * squares[:, None, None]
        self.power = rows.power * squares[:, None]
        explained = (self.parts.sum(axis=0) ** 2).sum(axis=1)
        self.common = self.power.sum(axis=0) - explained

    def residual(self, lags: np.ndarray) -> np.ndarray:
        """Return the residuals (n, m) of the weighted torques for joint lags (n,), given as indices of `SHIFTS`."""
        joints = np.arange(len(lags))
        projection = self.parts[joints, lags].sum(axis=0)
        return self._unexplained(self.rows.torque[joints, lags], projection)

    def _unexplained(self, torque: np.ndarray, parts: np.ndarray) -> np.ndarray:
        """Return the weighted torques (n, m) minus their projections, with coefficients `parts` (k,) in the basis."""
        explained = self.rows.columns @ (self.spanning @ parts)
        return self.weight[:, None] * (torque - explained)

    def unexplained_share(self, lags: np.ndarray, spread: np.ndarray) -> float:
        """Return the rms share of the joints' torques that is unexplained.

        Args:
            lags: (n,) lags of the joints, as indices of `SHIFTS`.
            spread: (n,) standard deviations of the joints' torques over time [N m or N], to which residuals are
                relative.
        """
        deviation = self.residual(lags).std(axis=1) / self.weight
        relative = deviation / np.maximum(spread, 1e-12)
        return float(np.sqrt(np.mean(relative**2)))

    def along(self, lags: np.ndarray, joint: int) -> np.ndarray:
        """Return the sum of squared residuals of all joints (shifts,) for every lag of one joint.

        Args:
            lags: (n,) lags of the other joints, as indices of `SHIFTS`.
            joint: joint whose lag varies.
        """
        fixed = np.flatnonzero(np.arange(len(lags)) != joint)
        fixed_part = self.parts[fixed, lags[fixed]].sum(axis=0)
        explained = ((fixed_part + self.parts[joint]) ** 2).sum(axis=1)
        fixed_power = self.power[fixed, lags[fixed]].sum()
        return np.asarray(fixed_power + self.power[joint] - explained)

    def separate_lags(self, start: np.ndarray) -> np.ndarray:
        """Return the joints' separate least-squares lags (n,), as indices of `SHIFTS`.

        The search starts from the lags `start` (n,).
        """
        lags = start.copy()
        for _ in range(MAX_SWEEPS):
            before = lags.copy()
            for joint in range(len(lags)):
                lags[joint] = self.along(lags, joint).argmin()
            if (lags == before).all():
                break
        return lags

    def gain(self, lags: np.ndarray, joint: int, common: int) -> float:
        """Return the ratio of a joint's residuals at the common lag and at its separate lag.

        Args:
            lags: (n,) separate lags of all joints, as indices of `SHIFTS`.
            joint: joint, from 0.
            common: common lag, as an index of `SHIFTS`.
        """
        along = self.along(lags, joint)
        square = float((self.residual(lags)[joint] ** 2).sum())
        increase = max(along[common] - along[lags[joint]], 0.0)
        return float(np.sqrt(1.0 + increase / max(square, 1e-300)))

    def sigma(self, lag: int) -> float:
        """Return the standard deviation of a common lag [s]; each joint counts as one independent sample.

        Args:
            lag: the lag, as an index of `SHIFTS`.
        """
        inner = int(np.clip(lag, 1, len(SHIFTS) - 2))
        torque, parts = self.rows.torque, self.parts
        torque_change = torque[:, inner + 1] - torque[:, inner - 1]
        torque_slope = torque_change / (2.0 * STEP)
        parts_change = parts[:, inner + 1] - parts[:, inner - 1]
        parts_slope = parts_change / (2.0 * STEP)
        slope = self._unexplained(torque_slope, parts_slope.sum(axis=0))
        residual = self.residual(np.full(len(slope), inner))
        votes = (residual * slope).sum(axis=1)
        power = float((slope**2).sum())
        correction = len(votes) / max(len(votes) - 1, 1)
        square = ((votes - votes.mean()) ** 2).sum()
        return float(np.sqrt(correction * square) / max(power, 1e-300))


def _turning(samples: MotionSamples, rate: float) -> list[np.ndarray]:
    """Return two friction regressors (m, n, n) whose sign changes `FREE_TIME` too early and too late, respectively.

    Args:
        samples: m samples of a recording of n joints.
        rate: sampling rate of the recording [Hz].
    """
    times = np.arange(len(samples.velocity))
    regressors = []
    for early in (-FREE_TIME, FREE_TIME):
        shifted = samples.index + early * rate
        v = interpolated(shifted, times, samples.velocity)
        sign = np.tanh(v / CREEP)[:, :, None]
        regressors.append(sign * np.eye(v.shape[1]))
    return regressors


def _parabola_minimum(values: np.ndarray, index: int) -> float:
    """Return where the parabola through values[index] and its two neighbours is smallest, as an offset from `index`.

    The result is 0 at the ends of the array, or if the parabola has no minimum.
    """
    if not 0 < index < len(values) - 1:
        return 0.0
    before, middle, after = values[index - 1 : index + 2]
    bend = before - 2.0 * middle + after
    if not bend > 0.0:
        return 0.0
    return 0.5 * float(before - after) / float(bend)
