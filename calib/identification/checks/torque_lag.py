"""Lag of the recorded torques behind the positions of the same row: common to all joints, or of a single joint.

One model of all joints is fitted at every lag that is tried: bodies shared by the joints, drives of each, and least
squares weighed by what is left of each joint. Bodies of each joint's own bend after a late torque: they find 148 ms
where torques are 100 ms late. Friction turns over later than its speed does, as long as joints bend before they slide,
and would pass for a lag of 20 ms (the Panda's wrist); so sign(v) may come `free_time` earlier and later, at each joint,
and friction holds no information on the lag: masses and inertias do. The least of the residual is found by a parabola;
its sigma takes each joint's vote for one draw, and both halves of the recording for two: short ones agree on none. All
of this and its thresholds are our choice.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.identification.checks.recorded_motion import CREEP, MotionSamples, spanning

LAGS = 0.25  # largest lag that is tried [s], in steps of
STEP = 0.005
MIN_LAG, MIN_LAG_SIGMAS = 0.015, 3.5  # smallest lag that is reported [s], and in sigmas
ALONE, OTHERS = 0.2, 3.0  # share by which a lag of its own helps a joint, and times as much as any other joint's


@dataclass(frozen=True)
class Lag:
    """Lag of the torques behind the positions of the same row [s], and how much its correction reduces the residual.

    Attributes:
        sigma: standard deviation of `seconds` [s].
        before, after: rms share of the joints' torques unexplained by bodies and friction: as recorded, shifted.
        factor: residual as recorded over residual after shifting, each joint weighted by its residual.
        own: (n,) lags of the joints, each estimated separately [s].
        gains: (n,) residual of a joint at the common lag over that at its separate lag, the others at theirs.
        joint: the only joint, from 0, whose lag differs, in both halves of the recording; None if no joint does.
    """

    seconds: float
    sigma: float
    before: float
    after: float
    factor: float
    own: np.ndarray
    gains: np.ndarray
    joint: int | None

    @property
    def certain(self) -> bool:
        """Whether the lag of all torques is significant and large enough to report."""
        least = max(MIN_LAG, MIN_LAG_SIGMAS * self.sigma)
        # and what is left without it over what is left with it: of another robot any lag may be the best
        min_gain = 1.05
        max_left = 0.4  # share of the joints' torques that may be left: a model that leaves more knows no lag
        return least < abs(self.seconds) < LAGS - STEP and self.factor > min_gain and self.after < max_left


def lag_of(samples: MotionSamples, rate: float) -> Lag | None:
    """Return the lag of the torques; None where the motion is too short to estimate it.

    Args:
        samples: of the recording.
        rate: of its motion [Hz].
    """
    m = len(samples.index)
    min_time = 2.0  # time with samples below which no lag is estimated: bodies make up for it [s]
    if m * float(np.median(np.diff(samples.index))) < min_time * rate:
        return None
    rows = _rows(samples, rate)
    parts = [_Rows.of(rows[0][:, half], rows[1][:, :, half]) for half in (slice(0, m // 2), slice(m // 2, m))]
    sums = (getattr(parts[0], name) + getattr(parts[1], name) for name in ("square", "cross", "power"))
    whole, *halves = (_lag_in(each) for each in (_Rows(*rows, *sums), *parts))
    apart = abs(halves[0].seconds - halves[1].seconds) / 2.0
    return replace(whole, sigma=float(np.hypot(whole.sigma, apart)), joint=_alone(whole, halves))


def _alone(whole: Lag, halves: Sequence[Lag], max_lag_difference: float = 0.5) -> int | None:
    """Return the one joint whose lag differs from the common lag in both halves of the recording; None without one.

    `max_lag_difference`: share of that lag by which those of both halves may differ from it.
    """
    j, more = int(whole.gains.argmax()), np.sort(whole.gains) - 1.0
    late = whole.own[j] - whole.seconds
    if abs(late) < MIN_LAG or abs(whole.own[j]) > LAGS - 1.5 * STEP or len(more) < 2:
        return None
    if more[-1] < max(ALONE, OTHERS * more[-2]):
        return None
    return (
        j if all(abs(half.own[j] - half.seconds - late) < max_lag_difference * abs(late) for half in halves) else None
    )


SHIFTS = np.arange(-LAGS, LAGS + STEP / 2, STEP)


@dataclass(frozen=True, eq=False)
class _Rows:
    """Rows of a fit of n joints' torques at S lags, and their products by joint, which add up over parts of a motion.

    Attributes:
        columns, torque: (n, m, p) and (n, S, m).
        square, cross, power: (n, p, p), (n, p, S) and (n, S): WᵀW, Wᵀτ and τᵀτ.
    """

    columns: np.ndarray
    torque: np.ndarray
    square: np.ndarray
    cross: np.ndarray
    power: np.ndarray

    @classmethod
    def of(cls, columns: np.ndarray, torque: np.ndarray) -> "_Rows":
        """Return the rows of columns and torques with their products."""
        across = columns.transpose(0, 2, 1)
        cross = across @ torque.transpose(0, 2, 1)
        return cls(columns, torque, across @ columns, cross, np.einsum("jsm,jsm->js", torque, torque))


def _rows(samples: MotionSamples, rate: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the columns (n, m, p) of all joints, and their torques (n, S, m) at the lags `SHIFTS`."""
    places, times = samples.index + SHIFTS[:, None] * rate, np.arange(len(samples.effort))
    torque = np.stack([np.interp(places, times, own) for own in samples.effort.T])
    columns = np.concatenate([samples.inertial, samples.drives, *_turning(samples, rate)], axis=2)
    return np.ascontiguousarray(columns.transpose(1, 0, 2)), torque


def _lag_in(rows: _Rows, rounds: int = 4, lag_sigma: float = 0.005) -> Lag:
    """Return the least-squares lag of the rows, with its sigma from the spread between joints.

    `rounds`: of weighing joints by what is left of them.

    `lag_sigma`: sigma that a friction of another form brings [s]: real recordings as they are show lags of 4 ms rms.
    """
    n, torque = len(rows.torque), rows.torque
    recorded = np.full(n, len(SHIFTS) // 2)
    fit = _Fit(rows, 1.0 / np.maximum(torque[:, recorded[0]].std(axis=1), 1e-12))
    for _ in range(rounds):
        left = fit.left(np.full(n, fit.common.argmin()))
        fit = _Fit(rows, fit.weight / np.maximum(left.std(axis=1), 1e-12))
    at = int(fit.common.argmin())
    common, alone = np.full(n, at), fit.own(np.full(n, at))
    spread = torque[:, recorded[0]].std(axis=1)

    def share(places: np.ndarray) -> float:
        return float(np.sqrt(np.mean((fit.left(places).std(axis=1) / fit.weight / np.maximum(spread, 1e-12)) ** 2)))

    return Lag(
        seconds=float(SHIFTS[at] + STEP * _least(fit.common, at)),
        sigma=float(np.hypot(fit.sigma(at), lag_sigma)),
        before=share(recorded),
        after=share(common),
        factor=float(np.sqrt(fit.common[recorded[0]] / max(fit.common[at], 1e-300))),
        own=SHIFTS[alone],
        gains=np.array([fit.gain(alone, j, at) for j in range(n)]),
        joint=None,
    )


class _Fit:
    """Least squares of the joints' torques at any lags: projections at every lag are computed once."""

    def __init__(self, rows: _Rows, weight: np.ndarray) -> None:
        """Project torques, weighted (n,), onto the columns of all joints."""
        self.rows, self.weight = rows, weight
        weights = weight**2
        self.spanning = spanning(np.tensordot(weights, rows.square, 1))
        self.parts = np.matmul(rows.cross.transpose(0, 2, 1), self.spanning) * weights[:, None, None]  # (n, shifts, k)
        self.power = rows.power * weights[:, None]
        self.common = self.power.sum(axis=0) - (self.parts.sum(axis=0) ** 2).sum(axis=1)
        """(shifts,) squared residual where all joints have the same lag."""

    def left(self, places: np.ndarray) -> np.ndarray:
        """Return the residuals (n, m) of the weighted torques at the joints' lags (n,)."""
        joints = np.arange(len(places))
        return self._unexplained(self.rows.torque[joints, places], self.parts[joints, places].sum(axis=0))

    def _unexplained(self, torque: np.ndarray, parts: np.ndarray) -> np.ndarray:
        """Return torques (n, m) without their projections (k,), weighted."""
        return self.weight[:, None] * (torque - self.rows.columns @ (self.spanning @ parts))

    def along(self, places: np.ndarray, joint: int) -> np.ndarray:
        """Return the squared residual of all joints (shifts,) over one joint's lag; the other lags (n,) stay fixed."""
        others = np.flatnonzero(np.arange(len(places)) != joint)
        fixed = self.parts[others, places[others]].sum(axis=0)
        explained = ((fixed + self.parts[joint]) ** 2).sum(axis=1)
        return np.asarray(self.power[others, places[others]].sum() + self.power[joint] - explained)

    def own(self, places: np.ndarray) -> np.ndarray:
        """Return the separate least-squares lags of the joints (n,), starting from the given ones."""
        places = places.copy()
        max_sweeps = 30  # over the joints' own lags
        for _ in range(max_sweeps):
            before = places.copy()
            for joint in range(len(places)):
                places[joint] = self.along(places, joint).argmin()
            if (places == before).all():
                break
        return places

    def gain(self, places: np.ndarray, joint: int, common: int) -> float:
        """Return the ratio of a joint's residuals at the common lag and at its own lag; `places` (n,): all lags."""
        along, own = self.along(places, joint), float((self.left(places)[joint] ** 2).sum())
        return float(np.sqrt(1.0 + max(along[common] - along[places[joint]], 0.0) / max(own, 1e-300)))

    def sigma(self, at: int) -> float:
        """Return the sigma of the common lag at index `at` [s], each joint counted as one independent sample."""
        inner = int(np.clip(at, 1, len(SHIFTS) - 2))
        torque, parts = ((x[:, inner + 1] - x[:, inner - 1]) / (2.0 * STEP) for x in (self.rows.torque, self.parts))
        slope = self._unexplained(torque, parts.sum(axis=0))
        votes, power = (self.left(np.full(len(slope), inner)) * slope).sum(axis=1), float((slope**2).sum())
        few = len(votes) / max(len(votes) - 1, 1)
        return float(np.sqrt(few * ((votes - votes.mean()) ** 2).sum()) / max(power, 1e-300))


def _turning(samples: MotionSamples, rate: float, free_time: float = 0.03) -> list[np.ndarray]:
    """Return two friction regressors (m, n, n) whose sign changes `free_time` too early, and too late.

    `free_time`: by which friction may turn over early or late by itself [s].
    """
    n, times = samples.q.shape[1], np.arange(len(samples.velocity))
    found = []
    for early in (-free_time, free_time):
        v = np.stack([np.interp(samples.index + early * rate, times, own) for own in samples.velocity.T], axis=1)
        found.append(np.tanh(v / CREEP)[:, :, None] * np.eye(n))
    return found


def _least(left: np.ndarray, at: int) -> float:
    """Return the minimum of a parabola through three points about index `at`, as an offset in indices."""
    if not 0 < at < len(left) - 1:
        return 0.0
    bend = left[at - 1] - 2.0 * left[at] + left[at + 1]
    return 0.5 * float(left[at - 1] - left[at + 1]) / float(bend) if bend > 0.0 else 0.0
