"""Sample numbers on an even clock (a lattice with holes), from jittering time stamps with lost samples.

    t_i = T (k_i + d_i) + jitter_i,    k_i whole numbers that increase by 1 or more, d_i a slow drift in steps

The difference of two stamps does not determine their step in k reliably: both stamps jitter, and one wrong step makes
all later k wrong. The phase exp(2πi t / T) is more reliable, since it is equal for all k. The direction of its mean
over some samples gives the drift, and the length of the mean gives the jitter: 1 without jitter, exp(-2 π² σ² / T²) for
a jitter of standard deviation σ, and 0 for stamps that are on no lattice. Estimation of a period from sparse, noisy
times: Fogel and Gavish (1988); Sidiropoulos, Swami and Sadler (2005), who maximise the periodogram, as is done here. To
follow a drift is our addition.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.ndimage import uniform_filter1d
from scipy.optimize import isotonic_regression

MIN_CONCENTRATION = 0.35  # length of the mean direction: 0.23 of a step of jitter (our choice)
LONG_STOP = 20  # steps without a sample, from which on the phase begins anew
MAX_PERIOD_ERROR = 0.12  # of the median step, which jitter and lost samples move
VOTES = 64  # samples that vote on a period together: longer ones would need it more exactly beforehand
PERIODS = 193  # that are tried (our choice): from one to the next, the phases of VOTES samples turn by 0.08 of a step
MAX_TRIED = 20_000  # samples on which they are tried


@dataclass(frozen=True, eq=False)
class Lattice:
    """Sample numbers on an even clock.

    Attributes:
        steps: (N,) whole numbers k, increasing.
        period: period T of the clock [s].
        concentration: length of the phases' mean about their drift, from 0 (random phases) to 1 (no jitter).
    """

    steps: np.ndarray
    period: float
    concentration: float


def find_lattice(t: np.ndarray, drift_samples: int, rounds: int = 3) -> Lattice | None:
    """Return the even clock behind increasing time stamps t (N,) [s].

    None if the stamps jitter by more than about a quarter of the period.

    Args:
        t: the time stamps.
        drift_samples: number of samples over which the phase is averaged to follow a drift of the stamps.
        rounds: number of iterations; each rounds the stamps to steps and fits the period to the steps.
    """
    period = _likeliest_period(t)
    steps, concentration = np.arange(len(t)), 0.0
    for _ in range(rounds):
        steps, concentration = _rounded(t, period, drift_samples)
        if concentration < MIN_CONCENTRATION:
            return None
        period = float(np.polyfit(steps, t, 1)[0])
    return Lattice(steps, period, concentration)


def _likeliest_period(t: np.ndarray) -> float:
    """Return the period near the median step [s] for which the phases within short runs of stamps agree best."""
    median = float(np.median(np.diff(t)))
    compared = t[: max(len(t[:MAX_TRIED]) // VOTES, 1) * VOTES]
    runs = compared.reshape(-1, min(VOTES, len(compared)))
    # the length of a run's mean direction does not depend on the run's origin
    since_first = runs - runs[:, :1]
    highest, lowest = 1.0 / (1.0 - MAX_PERIOD_ERROR), 1.0 / (1.0 + MAX_PERIOD_ERROR)
    frequencies = np.linspace(lowest, highest, PERIODS) / median
    # the phases for one frequency after the other: from each to the next they turn by the same angles
    directions = _directions(since_first, 1.0 / frequencies[0])
    turn = _directions(since_first, 1.0 / (frequencies[1] - frequencies[0]))
    agreement = []
    for _ in frequencies:
        agreement.append(float(np.abs(directions.mean(axis=1)).mean()))
        directions *= turn
    return float(1.0 / frequencies[int(np.argmax(agreement))])


def _rounded(t: np.ndarray, period: float, drift_samples: int) -> tuple[np.ndarray, float]:
    """Return the step number (N,) nearest to each time stamp after removing drift.

    The second value is the concentration of the phases, from 0 (random) to 1 (no jitter).

    Args:
        t: (N,) time stamps [s].
        period: period of the clock [s].
        drift_samples: number of samples over which the phase is averaged to follow a drift of the stamps.
    """
    stops = np.flatnonzero(np.diff(t) > LONG_STOP * period) + 1
    steps, votes = np.zeros(len(t), dtype=int), 0.0
    for start, end in pairwise([0, *stops.tolist(), len(t)]):
        stamps = t[start:end]
        directions = _directions(stamps, period)
        real = uniform_filter1d(np.real(directions), drift_samples)
        imaginary = uniform_filter1d(np.imag(directions), drift_samples)
        mean = real + 1j * imaginary
        drift = np.unwrap(np.angle(mean)) / (2.0 * np.pi)
        exact = (stamps - stamps[0]) / period - (drift - drift[0])
        # steps rise: what is left after one per sample does not fall, and rounding keeps the nearest such numbers
        lost = isotonic_regression(exact - np.arange(len(stamps))).x
        steps[start:end] = np.arange(len(stamps)) + np.round(lost).astype(int)
        # the stop before it, in whole steps
        if start:
            steps[start:end] += steps[start - 1] + round((stamps[0] - t[start - 1]) / period) - steps[start]
        votes += float(np.abs(mean).sum())
    return steps, votes / len(t)


def _directions(t: np.ndarray, period: float) -> np.ndarray:
    """Return the phases exp(2πi t / T) of time stamps t [s] for the period T = `period` [s]."""
    return np.exp(2j * np.pi * (t / period))
