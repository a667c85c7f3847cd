"""Search for a known motion in a recording; the recording is cut to whole periods and averaged.

The motion begins at the sample k where the sum of squared differences between recording q and reference r is least,

    D(k) = Σ_i |q(k + i) - r(i)|² = Σ |q|² + Σ |r|² - 2 (q ⋆ r)(k),

computed by one cross-correlation with FFT. Unlike the peak of q ⋆ r alone, this minimum is not shifted towards samples
where the recording is large.
"""

from dataclasses import dataclass

import numpy as np
from scipy.fft import next_fast_len

from .errors import BadInput, require

LIKENESS = 0.9  # share of the reference's variance that a found period explains at least (our choice)


@dataclass(frozen=True)
class Recalled:
    """Whole periods of a known motion in a recording.

    Attributes:
        start: index (from 0) of the recording's sample at which the first period begins.
        period: samples per period.
        periods: number of successive periods.
        likeness: (periods,) share 1 - D / Σ |r - mean|² of the variance of the reference r that each period explains; D
            is the sum of squared differences between period and reference.
        lag: distance of the best match from a whole sample, in samples, from -1/2 to 1/2.
    """

    start: int
    period: int
    periods: int
    likeness: tuple[float, ...]
    lag: float

    @property
    def rows(self) -> slice:
        return slice(self.start, self.start + self.period * self.periods)


@dataclass(frozen=True, eq=False)
class Averaged:
    """Mean of signals over periods, with variance.

    Attributes:
        mean: (period, k) mean of each sample over the periods.
        variance: (period, k) variance of a single sample, estimated without bias over the periods.
        periods: number of averaged periods; the variance of the mean is variance / periods.
    """

    mean: np.ndarray
    variance: np.ndarray
    periods: int

    @property
    def pooled(self) -> np.ndarray:
        """Variance (k,) of a single sample, averaged over the period; used to weight the signals."""
        return self.variance.mean(axis=0)


def find_periods(recorded: np.ndarray, reference: np.ndarray, skip: int = 0, likeness: float = LIKENESS) -> Recalled:
    """Return the whole periods of a known motion in a recording.

    Args:
        recorded: (N, n) measured joint positions, at the sampling rate of the reference.
        reference: (P, n) one period of the commanded motion, without the last sample, which repeats the first.
        skip: number of periods to discard at the beginning, where the motion has not yet settled.
        likeness: smallest share of the reference's variance that a period must explain to be accepted.

    Raises:
        BadInput: arrays that do not match, or no period resembles the reference; the message names the best matching
            samples.
    """
    q = np.asarray(recorded, dtype=float)
    r = np.asarray(reference, dtype=float)
    if q.ndim != 2 or r.ndim != 2 or q.shape[1] != r.shape[1]:
        raise BadInput(f"recording {q.shape} and reference {r.shape} need the same number of columns, one per joint")
    if not (np.isfinite(q).all() and np.isfinite(r).all()):
        raise BadInput("recording or reference contain values that are not numbers: cut them out first")
    if len(q) < len(r):
        raise BadInput(
            f"the recording has {len(q)} samples, less than one period of the motion ({len(r)}): record longer"
        )
    similarity = _likeness(q, r)
    best = int(similarity.argmax())
    if similarity[best] < likeness:
        raise BadInput(
            f"the motion is not in the recording: the nearest {len(r)} samples begin at {best} and explain "
            f"{max(similarity[best], 0.0):.0%} of its variance; check the rate, the joint order and the units"
        )
    offsets = range(best % len(r), len(similarity), len(r))
    chain = [k for k in offsets if similarity[k] >= likeness]
    run = _run_with(chain, best, len(r))[skip:]
    require(
        run, f"the recording contains fewer than {skip + 1} whole periods of the motion: record more, or skip fewer"
    )
    likenesses = tuple(float(similarity[k]) for k in run)
    return Recalled(run[0], len(r), len(run), likenesses, _lag(similarity, best))


def average(values: np.ndarray, mean: Recalled) -> Averaged:
    """Return mean and variance of k signals over the whole periods of a recording.

    Args:
        values: (N, k) the signals, at the samples of the recording.
        mean: the periods in the recording, from `find_periods`.

    Raises:
        BadInput: fewer than two periods.
    """
    require(mean.periods >= 2, "one period has no variance: record two or more")
    signals = np.asarray(values, dtype=float)[mean.rows]
    parts = signals.reshape(mean.periods, mean.period, -1)
    variance = parts.var(axis=0, ddof=1)
    return Averaged(parts.mean(axis=0), variance, mean.periods)


def _likeness(q: np.ndarray, r: np.ndarray) -> np.ndarray:
    """Return the share 1 - D(k) / Σ |r - mean|² (N - P + 1,) of the variance of r explained at every start sample k.

    D(k) is the sum of squared differences between q from sample k on and r.

    Args:
        q: (N, n) recording.
        r: (P, n) reference.
    """
    centre = r.mean(axis=0)
    q = q - centre
    r = r - centre
    squares = np.cumsum((q**2).sum(axis=1))
    energy = np.concatenate([[0.0], squares])
    overlap = energy[len(r) :] - energy[: -len(r)]
    crossed = sum(sliding_products(q[:, j], r[:, j]) for j in range(q.shape[1]))
    reference_energy = (r**2).sum()
    distance = overlap + reference_energy - 2 * crossed
    return 1.0 - distance / max(reference_energy, 1e-300)


def sliding_products(x: np.ndarray, r: np.ndarray) -> np.ndarray:
    """Return Σ_i x[k + i] r[i] (N - P + 1,) for every start sample k of r (P,) in x (N,), by FFT."""
    size = next_fast_len(len(x) + len(r) - 1, real=True)
    spectrum = np.fft.rfft(x, size) * np.fft.rfft(r[::-1], size)
    products = np.fft.irfft(spectrum, size)
    return products[len(r) - 1 : len(x)]


def _run_with(places: list[int], best: int, period: int) -> list[int]:
    """Return the start samples, including the best match, that follow one another by exactly one period.

    Args:
        places: start samples of acceptable matches, rising.
        best: start sample of the best match, one of `places`.
        period: samples per period.
    """
    k = places.index(best)
    first = last = k
    while first and places[first - 1] == places[first] - period:
        first -= 1
    while last + 1 < len(places) and places[last + 1] == places[last] + period:
        last += 1
    return places[first : last + 1]


def _lag(similarity: np.ndarray, best: int) -> float:
    """Return the peak of the parabola through the best match and its neighbours, in samples from the best match.

    Args:
        similarity: similarity to the reference at every start sample.
        best: start sample of the best match.
    """
    if not 0 < best < len(similarity) - 1:
        return 0.0
    before, lag_index, after = similarity[best - 1 : best + 2]
    bend = before - 2 * lag_index + after
    if bend >= 0:
        return 0.0
    peak = 0.5 * (before - after) / bend
    return float(np.clip(peak, -0.5, 0.5))
