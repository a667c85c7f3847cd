"""Excitation of the robot by a motion, judged without a model: single sines, coupled joints, repeats of a motion."""

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.fft import next_fast_len
from scipy.spatial import KDTree

from calib.data.signals.filtering import longest
from calib.data.signals.motion import Motion
from calib.errors import listing

# Share of the variance of a joint that moves as one sine.
SINE = 0.98
# A joint that goes less far has not moved [rad or m].
MIN_TRAVEL = 1e-3
# States of a motion that are compared.
MAX_STATES = 20_000
# States of a block that are looked up in the other blocks.
MAX_TESTED = 500
# Samples beyond which positions are thinned to what their own low-pass filter passes: four times f_q.
MAX_SAMPLES = 100_000
# Share of the largest singular value from which on a function of time counts.
MIN_SHARE = 0.02
# Correlation of two joints that move as one.
MIN_CORRELATION = 0.98
# Frequencies that differ by less than this share are one.
FREQUENCY_SPREAD = 0.1
# A state is met again if it differs by less than this share of the motion's spread, in the rms over all.
MAX_DISTANCE = 0.05
# Share of a motion's states that are met in other motion, from which it is a repeat and proves nothing.
REPEATED = 0.5


@dataclass(frozen=True)
class ExcitationReport:
    """How well a motion excites the robot.

    Attributes:
        functions: number of linearly independent functions of time in all positions (2 for one sine).
        poor: whether the motion has one frequency, or fewer functions of time than half the moving joints.
        seconds: duration with at least one moving joint [s].
        notes: remarks for the user.
    """

    functions: int
    poor: bool
    seconds: float
    notes: tuple[str, ...]


def report_excitation(motion: Motion) -> ExcitationReport:
    """Return how well a motion excites the robot, from the positions of the motion's longest segment.

    A single frequency cannot separate inertia from gravity and stiffness: with q = q̄ + A sin ωt, q̈ = -ω² (q - q̄).
    """
    rows = longest(motion.segment)
    step = 1
    if rows.stop - rows.start > MAX_SAMPLES:
        step = max(1, int(motion.rate / (4.0 * float(motion.cutoff.max()))))
    q = motion.q[rows][::step]
    q = q - q.mean(axis=0)
    still = np.ptp(q, axis=0) < MIN_TRAVEL
    normalised = q / np.where(still, np.inf, np.sqrt((q**2).sum(axis=0)))
    singular = np.linalg.svd(normalised[:: max(1, len(normalised) // MAX_STATES)], compute_uv=False)
    functions = int((singular > MIN_SHARE * singular[0]).sum())

    moving = np.flatnonzero(~still)
    sines = np.array([_best_sine(q[:, j], motion.rate / step) for j in moving])
    share, frequency = sines.reshape(-1, 2).T
    one_frequency = bool((share > SINE).all())
    names = motion.joint_names
    notes = [f"{names[j]} never moves" for j in np.flatnonzero(still)]
    if len(notes) == 1 and motion.n > 1:
        notes = [f"{notes[0]}, all others do: did it stand, or is its position column frozen?"]
    if len(moving) and one_frequency:
        low, high = frequency.min(), frequency.max()
        hertz = f"{low:.3g} Hz" if high - low < FREQUENCY_SPREAD * high else f"{low:.3g} to {high:.3g} Hz"
        notes.append(
            f"each joint moves at one frequency ({hertz}): inertia, gravity and stiffness are not identifiable "
            "separately"
        )
    correlation = normalised.T @ normalised
    pairs = []
    for i, j in combinations(moving, 2):
        if abs(correlation[i, j]) > MIN_CORRELATION:
            pairs.append(f"{names[i]}–{names[j]}")
    if pairs:
        notes.append(f"joints that move together (correlation above {MIN_CORRELATION:g}): {listing(pairs, 6)}")
    if len(moving) > 1 and functions < len(moving):
        notes.append(f"all {len(moving)} moving joints follow only {functions} independent functions of time")
    seconds = float((~motion.standstill()).sum() / motion.rate)
    poor = one_frequency or functions < 0.5 * len(moving)
    return ExcitationReport(functions, poor, seconds, tuple(notes))


def repeats(training: Motion, test: Motion) -> float:
    """Return the share (0 to 1) of a test motion's moving samples whose state also occurs in the training motion.

    A state is (q, v). It occurs in the training motion if the nearest state there differs by less than 5 % of that
    motion's standard deviation, rms over the coordinates. A repeat is recognised in spite of a shift in time, another
    number of cycles or another order of parts. The same path at another speed is no repeat. A repeat is no independent
    test, since the fit has already absorbed the model's errors along that path. Our choice is to refuse a test motion
    with a share of `REPEATED` or more.

    Args:
        training: the motion that was fitted.
        test: the motion for validation.
    """
    moves = np.ptp(training.q, axis=0) > MIN_TRAVEL
    if not moves.any() or training.n != test.n:
        return 0.0
    spread = np.hstack([training.q.std(axis=0), training.v.std(axis=0)])
    fixed = ~np.hstack([moves, moves])
    test_spread = np.abs(np.hstack([test.q.std(axis=0), test.v.std(axis=0)]))
    spread[fixed] = np.maximum(test_spread[fixed], MIN_TRAVEL)
    training_states = _moving_states(training, MAX_STATES) / spread
    test_states = _moving_states(test, MAX_STATES // 10) / spread
    if not len(training_states) or not len(test_states):
        return 0.0
    return share_met(KDTree(training_states), test_states)


def share_met(tree: KDTree, states: np.ndarray) -> float:
    """Return the share (0 to 1) of states whose nearest neighbour differs by less than `MAX_DISTANCE`, rms.

    Args:
        tree: the states to search, over their standard deviations.
        states: (N, k) states, over the same deviations.
    """
    distance, _ = tree.query(states, distance_upper_bound=MAX_DISTANCE * np.sqrt(states.shape[1]))
    return float(np.isfinite(distance).mean())


def met_elsewhere(states: np.ndarray, block: np.ndarray) -> float:
    """Return the share (0 to 1) of a block's states that other blocks pass through, too; the median over the blocks.

    Args:
        states: (N, k) states.
        block: (N,) number of the block of each state.
    """
    scaled = states / np.maximum(states.std(axis=0), 1e-12)
    shares = []
    for number in np.unique(block):
        inside = block == number
        tests = scaled[inside]
        tests = tests[:: max(1, len(tests) // MAX_TESTED)]
        shares.append(share_met(KDTree(scaled[~inside]), tests))
    return float(np.median(shares))


def _moving_states(motion: Motion, max_states: int) -> np.ndarray:
    """Return the states (q, v) of moving samples, thinned to about `max_states` rows: (M, 2 n).

    Args:
        motion: the motion.
        max_states: approximate number M of states.
    """
    rows = np.flatnonzero(~motion.standstill())
    rows = rows[:: max(1, len(rows) // max_states)]
    return np.hstack([motion.q[rows], motion.v[rows]])


def _best_sine(q: np.ndarray, rate: float) -> tuple[float, float]:
    """Return the largest share of the variance of a series (N,) that one sine explains, and its frequency [Hz].

    Args:
        q: (N,) positions of one joint [rad or m].
        rate: sampling rate [Hz].
    """
    window = np.hanning(len(q) + 1)[:-1]
    size = int(next_fast_len(4 * len(q), real=True) or 0)
    power = np.abs(np.fft.rfft(window * (q - window @ q / window.sum()), size)) ** 2
    # Eighths of a step of the transform, about its strongest line.
    lines = int(np.argmax(power)) + np.arange(-16, 17) / 8
    frequencies = (lines[lines > 0.5] * rate / size).tolist()
    return max((_one_sine(q, frequency, rate), frequency) for frequency in frequencies)


def _one_sine(q: np.ndarray, f: float, rate: float) -> float:
    """Return the share of the variance of `q` (N,) that a constant and one sine of frequency `f` [Hz] explain.

    Args:
        q: (N,) positions of one joint [rad or m].
        f: frequency of the sine [Hz].
        rate: sampling rate [Hz].
    """
    step = max(1, int(rate / (20 * f)), len(q) // MAX_STATES)
    y = q[::step] - q[::step].mean()
    angle = 2 * np.pi * f * np.arange(0, len(q), step) / rate
    basis = np.stack([np.ones(len(y)), np.sin(angle), np.cos(angle)], axis=1)
    residual = y - basis @ np.linalg.lstsq(basis, y, rcond=None)[0]
    return float(1 - (residual @ residual) / (y @ y))
