"""Persistency of excitation of a motion, without a model: single sines, coupled joints, repeats of a motion."""

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.fft import next_fast_len
from scipy.spatial import KDTree

from calib.data.signals.filtering import longest
from calib.data.signals.motion import Motion
from calib.errors import listing

SINE = 0.98  # of the variance: a joint that moves as one sine
MIN_TRAVEL = 1e-3  # a joint that goes less far has not moved [rad or m]
MAX_STATES = 20_000  # states of a motion that are compared


@dataclass(frozen=True)
class ExcitationReport:
    """How richly a motion excites the robot.

    Attributes:
        functions: number of independent functions of time in all positions (2 for one sine).
        poor: whether the motion is one frequency, or fewer functions of time than half the joints that move.
        seconds: duration with at least one moving joint [s].
        notes: for the user.
    """

    functions: int
    poor: bool
    seconds: float
    notes: tuple[str, ...]


def report_excitation(motion: Motion) -> ExcitationReport:
    """Return how richly a motion excites the robot, from the positions of its longest segment.

    One frequency cannot separate inertia from gravity and stiffness: with q = A sin ωt, q̈ = -ω² (q - q̄).
    """
    own = longest(motion.segment)
    # samples beyond which positions are thinned to what their own low-pass filter left: four times f_q
    max_samples = 100_000
    thin = max(1, int(motion.rate / (4.0 * float(motion.cutoff.max())))) if own.stop - own.start > max_samples else 1
    q = motion.q[own][::thin] - motion.q[own][::thin].mean(axis=0)
    still = np.ptp(q, axis=0) < MIN_TRAVEL
    unit = q / np.where(still, np.inf, np.sqrt((q**2).sum(axis=0)))
    singular = np.linalg.svd(unit[:: max(1, len(unit) // MAX_STATES)], compute_uv=False)
    min_share = 0.02  # of the largest singular value: a function of time that counts
    functions = int((singular > min_share * singular[0]).sum())
    moving = np.flatnonzero(~still)
    share, strongest = np.array([_best_sine(q[:, j], motion.rate / thin) for j in moving]).reshape(-1, 2).T
    one_frequency, names = bool((share > SINE).all()), motion.joint_names
    notes = [f"{names[j]} never moves" for j in np.flatnonzero(still)]
    if len(moving) and one_frequency:
        low, high = strongest.min(), strongest.max()
        hertz = f"{low:.3g} Hz" if high - low < 0.1 * high else f"{low:.3g} to {high:.3g} Hz"
        notes.append(f"each joint moves at one frequency ({hertz}): inertia, gravity and stiffness are inseparable")
    correlation = unit.T @ unit
    min_correlation = 0.98  # of two joints that move as one
    pairs = [f"{names[i]}–{names[j]}" for i, j in combinations(moving, 2) if abs(correlation[i, j]) > min_correlation]
    if pairs:
        notes.append(f"joints that move together (correlation above {min_correlation:g}): {listing(pairs, 6)}")
    if len(moving) > 1 and functions < len(moving):
        notes.append(f"all {len(moving)} moving joints follow only {functions} independent functions of time")
    seconds = float((~motion.standstill()).sum() / motion.rate)
    return ExcitationReport(functions, one_frequency or functions < 0.5 * len(moving), seconds, tuple(notes))


def repeats(training: Motion, other: Motion) -> float:
    """Return the share (0 to 1) of `other`'s moving samples whose state also occurs in the training motion.

    A state is (q, v); it was met before where the nearest one of the training motion differs by less than 5 % of that
    motion's spread, in the rms over the coordinates. Neither a shift in time, nor another number of laps, nor another
    order of parts hides a repeat; the same path at another speed is none. Evidence from a repeat is no evidence:
    whatever the model gets wrong along that path, the fit has already absorbed (our choice: refuse from a half on).
    """
    moves = np.ptp(training.q, axis=0) > MIN_TRAVEL
    if not moves.any() or training.n != other.n:
        return 0.0
    states = []
    for motion, most in ((training, MAX_STATES), (other, MAX_STATES // 10)):
        own = np.flatnonzero(~motion.standstill())
        own = own[:: max(1, len(own) // most)]
        states.append(np.hstack([motion.q[own], motion.v[own]]))
    spread = np.hstack([training.q.std(axis=0), training.v.std(axis=0)])
    fixed = ~np.hstack([moves, moves])
    spread[fixed] = np.maximum(np.abs(np.hstack([other.q.std(axis=0), other.v.std(axis=0)]))[fixed], MIN_TRAVEL)
    seen, new = (state / spread for state in states)
    if not len(seen) or not len(new):
        return 0.0
    # a state is met again if it differs by less than this share of the motion's spread, in the rms over all
    max_distance = 0.05
    limit = max_distance * np.sqrt(seen.shape[1])
    distance, _ = KDTree(seen).query(new, distance_upper_bound=limit)
    return float(np.isfinite(distance).mean())


def _best_sine(q: np.ndarray, rate: float) -> tuple[float, float]:
    """Return the share of the variance of a series (N,) explained by its best sine, and the frequency [Hz]."""
    window, size = np.hanning(len(q) + 1)[:-1], int(next_fast_len(4 * len(q), real=True) or 0)
    power = np.abs(np.fft.rfft(window * (q - window @ q / window.sum()), size)) ** 2
    eighths = int(np.argmax(power)) + np.arange(-16, 17) / 8  # of a step of the transform, about its strongest line
    return max((_one_sine(q, f, rate), f) for f in (eighths[eighths > 0.5] * rate / size).tolist())


def _one_sine(q: np.ndarray, f: float, rate: float) -> float:
    """Return the share of the variance of `q` (N,) explained by one sine of frequency `f` [Hz] and a constant."""
    thin = max(1, int(rate / (20 * f)), len(q) // MAX_STATES)
    y, angle = q[::thin] - q[::thin].mean(), 2 * np.pi * f * np.arange(0, len(q), thin) / rate
    basis = np.stack([np.ones(len(y)), np.sin(angle), np.cos(angle)], axis=1)
    left = y - basis @ np.linalg.lstsq(basis, y, rcond=None)[0]
    return float(1 - (left @ left) / (y @ y))
