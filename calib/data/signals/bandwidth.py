"""Cut-off frequencies from the data: bandwidth of the motion, noise level, and suitable filters.

Gautier's rules use ω_dyn, the highest frequency of the rigid-body motion. The low-pass filter of the positions has a
cut-off ω_f ≥ 5 ω_dyn, so that it does not distort the motion. The parallel decimation has ω_fp ≥ 2 ω_dyn, with ω_fp =
2π 0.8 f_m / (2 n_d). Gautier's ω_dyn is the bandwidth of the closed loop. A log shows only the excited part of that
band. Our choice is therefore the frequency below which a joint has 95 % of its acceleration power, after the noise
floor and a resonance are removed.
"""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import uniform_filter1d

from calib.data.signals.filtering import factor_for, segments
from calib.data.signals.resampling import Resampled
from calib.errors import refuse_data
from calib.records import frozen

# Share of the acceleration power that is the motion.
SHARE = 0.95
# Lowest f_dyn [Hz]; friction turns faster than slow trajectories do.
LOWEST = 2.0
# Largest f_dyn [Hz]; rigid industrial robots reach 10 to 20 (Gautier); above that, joints bend.
MAX_CUTOFF = 20.0
# Usable share of the Nyquist frequency.
USABLE = 0.8
# Length of the spectra's windows [s].
WINDOW_LENGTH = 4.0
# Share of the acceleration's rms from which on noise in it is too much.
MAX_NOISE = 0.05
# Joints slower than this share of the fastest one do not determine the bandwidth.
MIN_SPEED_SHARE = 0.05
# A joint this many times above the median of all is taken to vibrate.
MAX_SPREAD = 3.0
# A power that rises this far again above the motion is a resonance, not a gap between two lines.
MIN_RISE = 30.0
# A power that stands this far above the floor is seen.
MIN_ABOVE_FLOOR = 10.0


@dataclass(frozen=True, eq=False)
class Cutoffs:
    """Proposed cut-off frequencies of filters and decimation.

    Attributes:
        dynamics: bandwidth f_dyn of the robot's motion [Hz].
        position: cut-off f_q of the positions' Butterworth filter [Hz].
        band: cut-off f_p of the parallel decimation [Hz].
        factor: decimation factor n_d.
        noise: (n,) standard deviation of white noise in the positions [rad or m], estimated from the spectrum above the
            motion's band.
        reasons: explanations of the values.
    """

    dynamics: float
    position: float
    band: float
    factor: int
    noise: np.ndarray
    reasons: tuple[str, ...]

    def acceleration_noise(self, cutoff: float | np.ndarray, rate: float) -> np.ndarray:
        """Return the acceleration noise (n,) [rad/s² or m/s²] that white position noise causes after the filter.

        σ_a = σ_q (2π)² sqrt(2 f_q⁵ / (5 f_s))

        Args:
            cutoff: cut-off f_q [Hz], one number or (n,).
            rate: sampling rate f_s [Hz].
        """
        return self.noise * (2 * np.pi) ** 2 * np.sqrt(2 * cutoff**5 / (5 * rate))


def propose_cutoffs(sampled: Resampled, dynamics: float | None = None) -> Cutoffs:
    """Return the cut-off frequencies proposed for a resampled recording.

    Args:
        sampled: the recording.
        dynamics: bandwidth f_dyn [Hz] if known (that of the position loop); None: estimated from the data.
    """
    # Slow to load.
    from scipy.signal import welch

    parts = segments(sampled.segment)
    longest = max(rows.stop - rows.start for rows in parts)
    size = min(longest, max(64, int(WINDOW_LENGTH * sampled.rate)))
    blocks = [sampled.series["q"][rows] for rows in parts if rows.stop - rows.start >= size]
    f = np.zeros(0)
    spectra = []
    for q in blocks:
        f, spectrum = welch(q, sampled.rate, "hann", size, size - size // 2, detrend="linear", axis=0)
        spectra.append(spectrum)
    power = np.average(spectra, axis=0, weights=[len(q) for q in blocks])
    floor = np.median(power[int(0.6 * len(f)) : int(0.9 * len(f))], axis=0)
    active = _active(np.concatenate([np.diff(q, axis=0) for q in blocks]))

    joint_dynamics = np.zeros(len(active))
    peak_notes = []
    for j in np.flatnonzero(active):
        joint_dynamics[j], peak = _joint_dynamics(f, power[:, j], floor[j])
        if np.isfinite(peak):
            peak_notes.append(f"joint {j + 1}: a peak at {peak:.3g} Hz (resonance, or noise of the loop) is ignored")
    dynamics, dynamics_reason = _choose(joint_dynamics, dynamics)
    position, position_reason = _position_cutoff(f, power, floor, active, dynamics, sampled.rate)
    factor = factor_for(sampled.rate, min(2 * dynamics, USABLE * sampled.rate / 2))
    band = USABLE * sampled.rate / (2 * factor)
    band_reason = (
        f"identification band f_p = {band:.3g} Hz (2 f_dyn, rounded to a whole decimation factor n_d = {factor})"
    )
    noise = np.sqrt(floor * sampled.rate / 2)
    reasons = (dynamics_reason, *peak_notes, position_reason, band_reason)
    return Cutoffs(dynamics, position, band, factor, frozen(noise), reasons)


def check_cutoff(cutoff: float, rate: float, file: str = "") -> None:
    """Raise MeasurementError for a cut-off [Hz] that is not between 0 and half the sampling rate `rate` [Hz].

    Args:
        cutoff: cut-off of a filter [Hz].
        rate: sampling rate [Hz].
        file: name of the recording, for messages; "" for none.
    """
    if not 0 < cutoff < rate / 2:
        message = (
            f"a cut-off of {cutoff:g} Hz is not between 0 and the Nyquist frequency, {rate / 2:g} Hz at {rate:g} Hz: "
            f"choose at most {USABLE * rate / 2:.4g} Hz"
        )
        refuse_data(file, message)


def _position_cutoff(
    f: np.ndarray, power: np.ndarray, floor: np.ndarray, active: np.ndarray, dynamics: float, rate: float
) -> tuple[float, str]:
    """Return the positions' cut-off f_q [Hz] and the reason for it.

    f_q is 5 f_dyn, or less if noise would exceed 5 % of the acceleration, but at least 2 f_dyn. White noise of density
    S_0 becomes an acceleration of variance (2π)⁴ S_0 f_q⁵/5.

    Args:
        f: (k,) frequencies [Hz].
        power: (k, n) power density of the positions.
        floor: (n,) power density of their noise.
        active: (n,) whether each joint moves fast enough.
        dynamics: bandwidth f_dyn [Hz].
        rate: sampling rate [Hz].
    """
    band = f <= 2 * dynamics
    density = (f[:, None] ** 4 * np.maximum(power - floor, 0))[band]
    signal = density.sum(axis=0) * (f[1] - f[0])
    quiet = np.inf
    if active.any():
        quiet_by_joint = (5 * MAX_NOISE**2 * signal / np.maximum(floor, 1e-300)) ** 0.2
        quiet = float(np.median(quiet_by_joint[active]))
    highest = USABLE * rate / 2
    if highest <= min(5 * dynamics, quiet):
        reason = f"{USABLE:g} of the Nyquist frequency; 5 f_dyn would be {5 * dynamics:.3g} Hz"
        return highest, f"cut-off of positions f_q = {highest:.3g} Hz, {reason}"
    if quiet >= 5 * dynamics:
        return 5 * dynamics, f"cut-off of positions f_q = {5 * dynamics:.3g} Hz (5 f_dyn)"
    lower = min(max(quiet, 2 * dynamics), highest)
    reason = f"at 5 f_dyn = {5 * dynamics:.3g} Hz noise exceeds 5 % of the acceleration"
    return lower, f"cut-off of positions f_q = {lower:.3g} Hz: {reason}"


def _active(steps: np.ndarray) -> np.ndarray:
    """Return for each joint whether it moves fast enough to determine the bandwidth, (n,) bool.

    Args:
        steps: (N, n) differences of successive positions [rad or m].
    """
    speed = np.quantile(np.abs(steps), 0.95, axis=0)
    return speed > MIN_SPEED_SHARE * speed.max()


def _choose(per_joint: np.ndarray, dynamics: float | None) -> tuple[float, str]:
    """Return the robot's bandwidth f_dyn [Hz] and the reason for it.

    Args:
        per_joint: (n,) bandwidth of each joint's motion [Hz]; 0 if unknown.
        dynamics: f_dyn that the options state, which is then returned; None: none.
    """
    if dynamics is not None:
        return dynamics, f"bandwidth of the motion f_dyn = {dynamics:.3g} Hz, as stated"
    fastest = int(np.argmax(per_joint))
    top = float(per_joint[fastest])
    middle = 0.0
    if per_joint.any():
        middle = float(np.median(per_joint[per_joint > 0]))
    frequency = min(top, MAX_SPREAD * middle)
    if frequency < LOWEST:
        extent = f"ends at {frequency:.2g} Hz" if frequency else "hardly exceeds the noise"
        return LOWEST, f"bandwidth f_dyn = {LOWEST:g} Hz: the motion {extent}, but friction is faster"
    if frequency > MAX_CUTOFF:
        reason = f"joint {fastest + 1} moves at {top:.3g} Hz, at which no robot is rigid"
        return MAX_CUTOFF, f"bandwidth of the motion f_dyn = {MAX_CUTOFF:g} Hz: {reason}"
    if frequency < top:
        reason = f"{MAX_SPREAD:g} times the median: joint {fastest + 1}'s {top:.3g} Hz is an outlier"
        return frequency, f"bandwidth of the motion f_dyn = {frequency:.3g} Hz, {reason}"
    return (
        frequency,
        f"bandwidth f_dyn = {frequency:.3g} Hz: 95 % of the acceleration power of joint {fastest + 1} is below it",
    )


def _joint_dynamics(f: np.ndarray, power: np.ndarray, floor: float) -> tuple[float, float]:
    """Return the highest frequency of a joint's motion, and that of a resonance above it [Hz]; NaN without a resonance.

    Args:
        f: (k,) frequencies [Hz].
        power: (k,) power density of the positions.
        floor: power density of their noise.
    """
    smooth = uniform_filter1d(power, 5, mode="nearest")
    peak = int(np.argmax(f**2 * np.maximum(smooth - MIN_ABOVE_FLOOR * floor, 0)))
    sunk = smooth[peak:] < MIN_ABOVE_FLOOR * floor
    top = peak + (int(np.argmax(sunk)) if sunk.any() else len(sunk) - 1)
    acceleration = f**4 * smooth
    lowest = np.minimum.accumulate(acceleration[peak : top + 1])
    risen = acceleration[peak : top + 1] > MIN_RISE * lowest
    resonance = np.nan
    if risen.any():
        first = peak + int(np.argmax(risen))
        resonance = float(f[first + int(np.argmax(acceleration[first : top + 1]))])
        top = peak + int(np.argmin(acceleration[peak : first + 1]))
    share = np.cumsum(f[: top + 1] ** 4 * np.maximum(power[: top + 1] - floor, 0))
    if top == 0 or share[-1] <= 0:
        return 0.0, resonance
    return float(f[int(np.argmax(share >= SHARE * share[-1]))]), resonance
