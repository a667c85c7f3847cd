"""What a motion can excite, before any model: is it one sine, do joints move together, is it the motion seen before?"""

from dataclasses import dataclass

import numpy as np
from scipy.fft import next_fast_len
from scipy.spatial import KDTree

from calib.arrays import frozen
from calib.data.signals.filtering import hann
from calib.data.signals.motion import Motion

SINE = 0.98  # of the variance: a joint that moves as one sine
MIN_TRAVEL = 1e-3  # a joint that goes less far has not moved [rad or m]
MAX_STATES = 20_000  # states of a motion that are compared


@dataclass(frozen=True, eq=False)
class ExcitationReport:
    """How rich the motion of the joints is.

    Attributes:
        lines: (n,) number of spectral lines of each joint's position that have 3e-3 or more of the strongest's power.
        strongest: (n,) frequency of the sine that fits best [Hz]; NaN for a joint that does not move.
        share: (n,) part of the joint's variance that one sine at about that frequency explains.
        correlation: (n, n) of the positions.
        functions: number of independent functions of time that all positions are made of (2 for one sine).
        still: (n,) joints that never move.
        seconds: for which any joint moves [s].
        notes: for the user.
    """

    lines: np.ndarray
    strongest: np.ndarray
    share: np.ndarray
    correlation: np.ndarray
    functions: int
    still: np.ndarray
    seconds: float
    notes: tuple[str, ...]

    @property
    def poor(self) -> bool:
        """Whether the motion is one frequency, or fewer functions of time than half the joints that move."""
        moving = ~self.still
        return bool((self.share[moving] > SINE).all()) or self.functions < 0.5 * moving.sum()


def report_excitation(motion: Motion) -> ExcitationReport:
    """Return what the positions of `motion` say of its richness; its longest segment is looked at.

    One frequency cannot separate inertia from gravity and stiffness: with q = A sin ωt, q̈ = -ω² (q - q̄).
    """
    longest = int(np.bincount(motion.segment).argmax())
    start, stop = (int(i) for i in np.searchsorted(motion.segment, [longest, longest + 1]))
    # samples beyond which positions are thinned to what their own low-pass filter left: four times f_q
    max_samples = 100_000
    thin = max(1, int(motion.rate / (4.0 * float(motion.cutoff.max())))) if stop - start > max_samples else 1
    q = motion.q[start:stop:thin] - motion.q[start:stop:thin].mean(axis=0)
    still = np.ptp(q, axis=0) < MIN_TRAVEL
    found = [(0, np.nan, 0.0) if still[j] else _lines(q[:, j], motion.rate / thin) for j in range(motion.n)]
    unit = q / np.where(still, np.inf, np.sqrt((q**2).sum(axis=0)))
    correlation = unit.T @ unit
    singular = np.linalg.svd(unit[:: max(1, len(unit) // MAX_STATES)], compute_uv=False)
    min_share = 0.02  # of the largest singular value: a function of time that counts
    functions = int((singular > min_share * singular[0]).sum())
    lines, strongest, share = (np.array(part) for part in zip(*found))
    notes = _notes(motion.joint_names, share, strongest, correlation, functions, still)
    seconds = float((~motion.standstill()).sum() / motion.rate)
    return ExcitationReport(
        frozen(lines, int), frozen(strongest), frozen(share), frozen(correlation), functions, frozen(still, bool),
        seconds, notes,
    )  # fmt: skip


def repeats(training: Motion, other: Motion) -> float:
    """Return the share of `other`'s moving samples whose state the training motion has been in, 0 to 1.

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


def _lines(q: np.ndarray, rate: float, min_line_power: float = 3e-3) -> tuple[int, float, float]:
    """Return the number of lines of a series (N,), the best sine's frequency [Hz], and the variance it explains.

    `min_line_power`: of the strongest line's power: a line that counts; Hann's side lobes are at 7e-4.
    """
    window, size = hann(len(q)), int(next_fast_len(4 * len(q), real=True) or 0)
    power = np.abs(np.fft.rfft(window * (q - window @ q / window.sum()), size)) ** 2
    best, frequency = max((_one_sine(q, f, rate), f) for f in _about(int(np.argmax(power)), rate, size))
    return max(1, count_peaks(power, min_line_power * power.max())), frequency, best


def count_peaks(power: np.ndarray, least: float) -> int:
    """Return how many peaks of a spectrum (N,) are at least so high, 8 bins apart and half as high above the dips."""
    high = 1 + np.flatnonzero((power[1:-1] > power[:-2]) & (power[1:-1] > power[2:]) & (power[1:-1] >= least))
    apart: list[int] = []
    for peak in high[np.argsort(-power[high], kind="stable")]:
        if all(abs(peak - other) >= 8 for other in apart):
            apart.append(int(peak))
    count = 0
    for peak in apart:
        above = np.flatnonzero(power > power[peak])
        place = int(np.searchsorted(above, peak))
        start, stop = above[place - 1] if place else 0, above[place] if place < len(above) else len(power)
        dip = max(power[start : peak + 1].min(), power[peak:stop].min())
        count += bool(power[peak] - dip >= 0.5 * least)
    return count


def _about(top: int, rate: float, size: int) -> list[float]:
    """Return frequencies about the strongest line of a transform of `size`, an eighth of its step apart [Hz]."""
    return [(top + i / 8) * rate / size for i in range(-16, 17) if top + i / 8 > 0.5]


def _one_sine(q: np.ndarray, f: float, rate: float) -> float:
    """Return the part of the variance of `q` (N,) that one sine of frequency `f` [Hz] and a constant explain."""
    thin = max(1, int(rate / (20 * f)), len(q) // MAX_STATES)
    y, angle = q[::thin] - q[::thin].mean(), 2 * np.pi * f * np.arange(0, len(q), thin) / rate
    basis = np.stack([np.ones(len(y)), np.sin(angle), np.cos(angle)], axis=1)
    left = y - basis @ np.linalg.lstsq(basis, y, rcond=None)[0]
    return float(1 - (left @ left) / (y @ y))


def _notes(
    names: tuple[str, ...],
    share: np.ndarray,
    strongest: np.ndarray,
    correlation: np.ndarray,
    functions: int,
    still: np.ndarray,
) -> tuple[str, ...]:
    moving = np.flatnonzero(~still)
    notes = [f"{names[j]} never moves" for j in np.flatnonzero(still)]
    if len(moving) and (share[moving] > SINE).all():
        low, high = strongest[moving].min(), strongest[moving].max()
        hertz = f"{low:.3g} Hz" if high - low < 0.1 * high else f"{low:.3g} to {high:.3g} Hz"
        notes.append(f"each joint moves at one frequency ({hertz}): inertia and gravity or stiffness look alike")
    min_correlation = 0.98  # correlation of two joints that move as one
    pairs = [(i, j) for i in moving for j in moving if i < j and abs(correlation[i, j]) > min_correlation]
    if pairs:
        told = ", ".join(f"{names[i]}–{names[j]}" for i, j in pairs[:6]) + (" …" if len(pairs) > 6 else "")
        notes.append(f"joints that move as one (correlation above {min_correlation:g}): {told}")
    if len(moving) > 1 and functions < len(moving):
        notes.append(f"all {len(moving)} moving joints follow {functions} functions of time")
    return tuple(notes)
