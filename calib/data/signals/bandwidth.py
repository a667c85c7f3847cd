"""Cut-off frequencies from the data: bandwidth of the motion, noise level, and the filters for them.

Gautier's rules, with ω_dyn the highest frequency at which the rigid body moves: the positions' low-pass filter at
ω_f ≥ 5 ω_dyn, so that it bends nothing in the band, and the parallel decimation at ω_fp ≥ 2 ω_dyn, with
ω_fp = 2π 0.8 f_m / (2 n_d). His ω_dyn is the closed loop's; a log shows what of it was excited (our choice: the
frequency below which 95 % of a joint's acceleration power lies, the floor of noise taken off, a resonance left out).
"""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import uniform_filter1d

from calib.data.signals.filtering import factor_for, segments
from calib.data.signals.resampling import Resampled
from calib.errors import refuse_data
from calib.records import frozen

SHARE = 0.95  # of the acceleration power that is the motion
LOWEST = 2.0  # [Hz]; friction turns faster than slow trajectories do
USABLE = 0.8  # of the Nyquist frequency


@dataclass(frozen=True, eq=False)
class Cutoffs:
    """Proposed cut-off frequencies of filters and decimation.

    Attributes:
        dynamics: f_dyn of the robot [Hz].
        position: cut-off of the positions' Butterworth filter, f_q [Hz].
        band: cut-off of the parallel decimation, f_p [Hz], factor: its n_d.
        noise: (n,) standard deviation of white noise in the positions [rad or m], read above the motion.
        reasons: explanations of the values.
    """

    dynamics: float
    position: float
    band: float
    factor: int
    noise: np.ndarray
    reasons: tuple[str, ...]

    def acceleration_noise(self, cutoff: float | np.ndarray, rate: float) -> np.ndarray:
        """Return the acceleration noise (n,) due to white position noise at a cut-off f_q [Hz], one or (n,).

        σ_a = σ_q (2π)² sqrt(2 f_q⁵ / (5 f_s)), with `rate` f_s [Hz].
        """
        return self.noise * (2 * np.pi) ** 2 * np.sqrt(2 * cutoff**5 / (5 * rate))


def propose_cutoffs(sampled: Resampled, dynamics: float | None = None) -> Cutoffs:
    """Return the cut-offs proposed for a resampled recording.

    Args:
        dynamics: f_dyn if known [Hz] (the bandwidth of the position loop); else estimated from the data.
    """
    from scipy.signal import welch  # slow to load

    window_length = 4.0  # length of the spectra's windows [s]
    parts = segments(sampled.segment)
    size = min(max(own.stop - own.start for own in parts), max(64, int(window_length * sampled.rate)))
    long = [sampled.series["q"][own] for own in parts if own.stop - own.start >= size]
    spectra = [welch(q, sampled.rate, "hann", size, size - size // 2, detrend="linear", axis=0) for q in long]
    f, power = spectra[0][0], np.average([one for _, one in spectra], axis=0, weights=[len(q) for q in long])
    floor = np.median(power[int(0.6 * len(f)) : int(0.9 * len(f))], axis=0)
    active = _active(np.concatenate([np.diff(q, axis=0) for q in long]))
    read = [_joint_dynamics(f, power[:, j], floor[j]) if active[j] else (0.0, np.nan) for j in range(len(active))]
    dynamics, reason = _choose(np.array([joint for joint, _ in read]), dynamics)
    reasons = [reason]
    reasons += [
        f"joint {j + 1}: a peak at {peak:.3g} Hz (resonance, or noise of the loop) is ignored"
        for j, (_, peak) in enumerate(read)
        if np.isfinite(peak)
    ]
    position, why = _position_cutoff(f, power, floor, active, dynamics, sampled.rate)
    factor = factor_for(sampled.rate, min(2 * dynamics, USABLE * sampled.rate / 2))
    band = USABLE * sampled.rate / (2 * factor)
    reasons += [why, f"f_p = {band:.3g} Hz (2 f_dyn, rounded to a whole decimation factor n_d = {factor})"]
    return Cutoffs(dynamics, position, band, factor, frozen(np.sqrt(floor * sampled.rate / 2)), tuple(reasons))


def check_cutoff(cutoff: float, rate: float, file: str = "") -> None:
    """Refuse a cut-off [Hz] that is not between 0 and half the sampling rate."""
    if not 0 < cutoff < rate / 2:
        message = (
            f"a cut-off of {cutoff:g} Hz is not between 0 and the Nyquist frequency, {rate / 2:g} Hz at {rate:g} Hz: "
            f"choose at most {USABLE * rate / 2:.4g} Hz"
        )
        refuse_data(file, message)


def _position_cutoff(
    f: np.ndarray, power: np.ndarray, floor: np.ndarray, active: np.ndarray, dynamics: float, rate: float
) -> tuple[float, str]:
    """Return f_q [Hz] and the reason: 5 f_dyn, or less if noise exceeds 5 % of the acceleration, at least 2 f_dyn.

    White noise of density S_0 becomes an acceleration of variance (2π)⁴ S_0 f_q⁵/5.
    """
    band = f <= 2 * dynamics
    signal = (f[:, None] ** 4 * np.maximum(power - floor, 0))[band].sum(axis=0) * (f[1] - f[0])
    max_noise = 0.05  # of the acceleration's rms: noise in it that is too much
    quiet = (5 * max_noise**2 * signal / np.maximum(floor, 1e-300)) ** 0.2
    quiet = float(np.median(quiet[active])) if active.any() else np.inf
    most = USABLE * rate / 2
    if most <= min(5 * dynamics, quiet):
        return most, f"f_q = {most:.3g} Hz, {USABLE:g} of the Nyquist frequency; 5 f_dyn would be {5 * dynamics:.3g} Hz"
    if quiet >= 5 * dynamics:
        return 5 * dynamics, f"f_q = {5 * dynamics:.3g} Hz (5 f_dyn)"
    lower = min(max(quiet, 2 * dynamics), most)
    return (lower, f"f_q = {lower:.3g} Hz: at 5 f_dyn = {5 * dynamics:.3g} Hz noise exceeds 5 % of the acceleration")


def _active(steps: np.ndarray, min_speed_share: float = 0.05) -> np.ndarray:
    """Return the mask (n,) of joints that move fast enough to determine the bandwidth, given their steps (N, n).

    `min_speed_share`: slower joints, relative to the fastest one, are not used.
    """
    speed = np.quantile(np.abs(steps), 0.95, axis=0)
    return speed > min_speed_share * speed.max()


def _choose(per_joint: np.ndarray, stated: float | None, max_cutoff: float = 20.0) -> tuple[float, str]:
    """Return f_dyn of the robot [Hz] and the reason.

    `max_cutoff`: [Hz]; rigid industrial robots reach 10 to 20 (Gautier); above that, joints bend.
    """
    if stated is not None:
        return stated, f"f_dyn = {stated:.3g} Hz as stated"
    fastest = int(np.argmax(per_joint))
    top, middle = float(per_joint[fastest]), float(np.median(per_joint[per_joint > 0])) if per_joint.any() else 0.0
    max_spread = 3.0  # a joint this many times above the median of all is taken to vibrate
    found = min(top, max_spread * middle)
    if found < LOWEST:
        where = f"ends at {found:.2g} Hz" if found else "hardly exceeds the noise"
        return LOWEST, f"f_dyn = {LOWEST:g} Hz: the motion {where}; friction is faster"
    if found > max_cutoff:
        why = f"joint {fastest + 1} moves at {top:.3g} Hz, where no robot is rigid"
        return max_cutoff, f"f_dyn = {max_cutoff:g} Hz: {why}"
    if found < top:
        why = f"{max_spread:g} times the median: joint {fastest + 1}'s {top:.3g} Hz is an outlier"
        return found, f"f_dyn = {found:.3g} Hz, {why}"
    return found, f"f_dyn = {found:.3g} Hz: 95 % of the acceleration power of joint {fastest + 1} lies below"


def _joint_dynamics(f: np.ndarray, power: np.ndarray, floor: float, min_rise: float = 30.0) -> tuple[float, float]:
    """Return the highest frequency of one joint's motion, and that of a resonance above it or NaN [Hz].

    `min_rise`: a power that rises this far again above the motion is a resonance, not a gap between two lines.
    """
    smooth = uniform_filter1d(power, 5, mode="nearest")
    min_above_floor = 10.0  # a power that stands this far above the floor is seen
    peak = int(np.argmax(f**2 * np.maximum(smooth - min_above_floor * floor, 0)))
    sunk = smooth[peak:] < min_above_floor * floor
    top = peak + (int(np.argmax(sunk)) if sunk.any() else len(sunk) - 1)
    acceleration = f**4 * smooth
    lowest = np.minimum.accumulate(acceleration[peak : top + 1])
    risen = acceleration[peak : top + 1] > min_rise * lowest
    resonance = np.nan
    if risen.any():
        first = peak + int(np.argmax(risen))
        resonance = float(f[first + int(np.argmax(acceleration[first : top + 1]))])
        top = peak + int(np.argmin(acceleration[peak : first + 1]))
    share = np.cumsum(f[: top + 1] ** 4 * np.maximum(power[: top + 1] - floor, 0))
    if top == 0 or share[-1] <= 0:
        return 0.0, resonance
    return float(f[int(np.argmax(share >= SHARE * share[-1]))]), resonance
