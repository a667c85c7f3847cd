"""Zero-phase low-pass filters, central differences and parallel decimation of evenly sampled arrays.

All act along the first axis. Parallel decimation applies one low-pass filter and decimation to the torque and to every
column of the regressor W. Filtering is linear along time, so that y = W x + ρ becomes y_f = W_f x + ρ_f with the *same*
parameters x, whatever the filter. The filter removes frequencies above the band of the model (ripple, flexibility,
noise) and introduces no bias (Gautier's parallel decimation; the figures below are from Briot & Gautier's DualV studies
and the TX40 slides). The filter is finite, symmetric and evaluated at the kept samples only. It has no phase shift and
can be applied block by block. Samples whose filter window exceeds the ends of a segment are left out.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from calib.errors import MeasurementError, require
from calib.records import frozen

KINDS = ("chebyshev", "kaiser")
# Share of the new Nyquist frequency that is kept.
SHARE = 0.8
# Beta of a window whose stop band is 60 dB down (Kaiser 1974).
KAISER = 0.1102 * (60.0 - 8.7)
# Of one pass of the Chebyshev filter: its order and ripple [dB], and the share of its impulse response that is cut.
CHEBYSHEV_ORDER = 8
RIPPLE = 0.05
CUT_SHARE = 1e-4
# Order of the Butterworth filter, run forwards and backwards (Gautier's choice; the studies' too).
ORDER = 4
# Samples at a time: they stay in the processor's cache.
CHUNK = 4096
# Central differences of half-width w are exact for polynomials of degree 2w: coefficients of x(k+i) - x(k-i) for the
# slope, of x(k+i) + x(k-i) - 2 x(k) for the curvature (Fornberg 1988, table 1).
SLOPE = {1: (1 / 2,), 2: (2 / 3, -1 / 12), 3: (3 / 4, -3 / 20, 1 / 60), 4: (4 / 5, -1 / 5, 4 / 105, -1 / 280)}
CURVATURE = {1: (1.0,), 2: (4 / 3, -1 / 12), 3: (3 / 2, -3 / 20, 1 / 90), 4: (8 / 5, -1 / 5, 8 / 315, -1 / 560)}


@dataclass(frozen=True, eq=False)
class Decimator:
    """Low-pass filter with decimation, which keeps one of `factor` samples.

    Attributes:
        factor: decimation factor n_d; 1 changes nothing.
        taps: (2 h + 1,) symmetric weights of the samples k-h … k+h, with sum 1.
        rate: sampling rate of the signal before decimation [Hz].
        band: cut-off f_p = 0.8 rate / (2 n_d) [Hz]; lower frequencies pass.
    """

    factor: int
    taps: np.ndarray
    rate: float
    band: float

    @property
    def reach(self) -> int:
        """Number of samples h that the filter needs on each side of a kept sample."""
        return len(self.taps) // 2


def design_decimator(rate: float, factor: int, kind: str = "kaiser") -> Decimator:
    """Return the filter that keeps one of `factor` samples of a signal sampled at `rate` [Hz].

    ``chebyshev`` is the decimate function of Matlab and Gautier: type I, order 8, 0.05 dB, cut-off 0.8 of the new
    Nyquist frequency, applied forwards and backwards. It is represented by its impulse response (the inverse transform
    of |H|²), truncated where the response has fallen to 1e-4: some 46 n_d samples on each side. ``kaiser`` (our
    default) is a windowed sinc with an equal band, 60 dB down from 1.2 of the new Nyquist frequency on, with 9 n_d
    samples on each side: it needs a fifth of the work, and loses a fifth of the samples at the ends.

    Args:
        rate: sampling rate [Hz].
        factor: decimation factor n_d.
        kind: ``kaiser`` or ``chebyshev``.

    Raises:
        CalibError: a factor below 1 or an unknown kind.
    """
    message = f"decimation by {factor} with a '{kind}' filter: expected at least 1, and {' or '.join(KINDS)}"
    require(factor >= 1 and kind in KINDS, message)
    band = SHARE * rate / (2 * factor)
    if factor == 1:
        return Decimator(1, frozen([1.0]), rate, band)
    taps = _chebyshev(factor) if kind == "chebyshev" else _kaiser(factor)
    return Decimator(factor, frozen(taps / taps.sum()), rate, band)


def factor_for(rate: float, band: float) -> int:
    """Return the largest decimation factor n_d whose filter passes `band` f_p [Hz], at least 1.

    n_d = floor(0.8 rate / (2 f_p))

    Args:
        rate: sampling rate before decimation [Hz].
        band: f_p, highest frequency to keep [Hz].
    """
    return max(1, int(SHARE * rate / (2 * band) + 1e-9))


def kept(segment: np.ndarray, decimator: Decimator) -> np.ndarray:
    """Return the indices (M,) of the samples that `decimate` keeps.

    Args:
        segment: (N,) number of each sample's segment, increasing.
        decimator: the decimation.
    """
    reach, factor = decimator.reach, decimator.factor
    parts = [np.arange(rows.start + reach, rows.stop - reach, factor) for rows in segments(segment)]
    return np.concatenate(parts)


def segments(segment: np.ndarray) -> list[slice]:
    """Return the slice of each segment's samples.

    Args:
        segment: (N,) number of each sample's segment, increasing.
    """
    edges = np.concatenate([[0], np.flatnonzero(np.diff(segment)) + 1, [len(segment)]])
    return [slice(int(start), int(stop)) for start, stop in pairwise(edges)]


def longest(segment: np.ndarray) -> slice:
    """Return the slice of the longest segment's samples; `segment` (N,) are increasing segment numbers."""
    return max(segments(segment), key=lambda rows: rows.stop - rows.start)


def decimate(values: np.ndarray, decimator: Decimator, segment: np.ndarray | None = None) -> np.ndarray:
    """Return `values` (N, ...) filtered and decimated segment by segment, (M, ...), at the samples `kept`.

    Args:
        values: samples.
        decimator: the decimation.
        segment: (N,) number of each sample's segment, increasing; None: one segment.
    """
    values = np.asarray(values, dtype=float)
    if segment is None:
        segment = np.zeros(len(values), dtype=int)
    parts = [np.empty((0, *values.shape[1:]))]
    for rows in segments(segment):
        block = np.moveaxis(values[rows], 0, -1)
        parts += [np.moveaxis(part, -1, 0) for part in decimate_blocks([block], decimator)]
    return np.concatenate(parts)


def spread(values: np.ndarray, decimator: Decimator, length: int) -> np.ndarray:
    """Return the adjoint of `decimate` on one segment: Σ y · decimate(x) = Σ spread(y) · x.

    Args:
        values: (M, ...) values y at the kept samples.
        decimator: the decimation.
        length: number of samples of the segment.
    """
    r, taps, count = decimator.factor, decimator.taps, len(values)
    phases = -(-len(taps) // r)
    weights = np.zeros(phases * r)
    weights[: len(taps)] = taps
    result = np.zeros((count + phases, r, *values.shape[1:]))
    shape = (1, r) + (1,) * (values.ndim - 1)
    for phase in range(phases):
        phase_weights = weights[phase * r : (phase + 1) * r].reshape(shape)
        result[phase : phase + count] += phase_weights * values[:, None]
    return result.reshape(-1, *values.shape[1:])[:length]


def decimate_blocks(blocks: Iterable[np.ndarray], decimator: Decimator) -> Iterator[np.ndarray]:
    """Yield, block by block, the decimation of one segment whose samples are given as blocks (..., N_i).

    The sample axis is the last one. Only one block and the earlier samples that windows still need are in memory.

    Args:
        blocks: blocks of the segment's samples, in order of time.
        decimator: the decimation.
    """
    r, taps = decimator.factor, decimator.taps
    if r == 1 and len(taps) == 1:
        yield from blocks
        return
    pending = None
    for block in blocks:
        if pending is None or not pending.shape[-1]:
            pending = block
        else:
            pending = np.concatenate([pending, block], axis=-1)
        count = (pending.shape[-1] - len(taps)) // r + 1
        if count > 0:
            yield _windows(pending, taps, r, count)
            pending = pending[..., count * r :]


def _windows(values: np.ndarray, taps: np.ndarray, r: int, count: int) -> np.ndarray:
    """Return the filtered values (..., count) of the first `count` windows of values (..., N), one every r samples.

    Windows are computed in groups, as a product with a band matrix of weights. This needs twice the multiplications,
    but is much faster owing to the processor's cache.

    Args:
        values: (..., N) samples.
        taps: (2 h + 1,) weights of the samples in one window.
        r: distance between windows, in samples.
        count: number of windows.
    """
    flat = values.reshape(-1, values.shape[-1])
    together = min(count, -(-len(taps) // r))
    band = np.zeros(((together - 1) * r + len(taps), together))
    for k in range(together):
        band[k * r : k * r + len(taps), k] = taps
    result = np.empty((len(flat), count))
    for first in range(0, count, together):
        width = min(together, count - first)
        rows = (width - 1) * r + len(taps)
        result[:, first : first + width] = flat[:, first * r : first * r + rows] @ band[:rows, :width]
    return result.reshape(*values.shape[:-1], count)


def _kaiser(factor: int) -> np.ndarray:
    sample = np.arange(18 * factor + 1) - 9 * factor
    return np.sinc(sample / factor) * np.kaiser(len(sample), KAISER)


def _chebyshev(factor: int) -> np.ndarray:
    # Slow to load.
    from scipy.signal import cheby1, sosfreqz

    sos = cheby1(CHEBYSHEV_ORDER, RIPPLE, SHARE / factor, output="sos")
    size = 1 << int(np.ceil(np.log2(400 * factor)))
    _, response = sosfreqz(sos, np.linspace(0, np.pi, size // 2 + 1))
    impulse_response = np.fft.irfft(np.abs(response) ** 2, size)
    half = impulse_response[: size // 2]
    remaining = np.cumsum(np.abs(half)[::-1])[::-1]
    reach = int(np.argmax(remaining < CUT_SHARE * np.abs(half).sum()))
    return np.concatenate([half[reach:0:-1], half[: reach + 1]])


def too_short(motion_length: int, decimator: Decimator) -> MeasurementError:
    """Return the error about a motion of `motion_length` samples, which is shorter than the filter's window.

    Args:
        motion_length: number of samples of the motion.
        decimator: the filter.
    """
    needed = len(decimator.taps) / decimator.rate
    duration = motion_length / decimator.rate
    message = f"decimation by {decimator.factor} needs {needed:.3g} s without a gap, found {duration:.3g} s"
    return MeasurementError(f"{message}: raise the band, or record longer")


def low_pass(values: np.ndarray, rate: float, cutoff: float, order: int = ORDER) -> np.ndarray:
    """Return `values` (N, ...) filtered by a Butterworth low-pass forwards and backwards, without phase shift.

    The gain is |H(f)|² = 1 / (1 + (f/f_c)^(2 order)): 1/2 at the cut-off f_c, where a single pass has 1/√2. The ends
    are extended by odd reflection over 3 rate/f_c samples; about 2/f_c seconds at each end are affected.

    Args:
        values: (N, ...) samples of a segment without gaps or NaN.
        rate, cutoff: sampling rate and cut-off f_c [Hz].
        order: order of a single pass.

    Raises:
        MeasurementError: a cut-off at or above the Nyquist frequency, or not above zero.
    """
    if not 0 < cutoff < rate / 2:
        message = f"a cut-off of {cutoff:g} Hz is not between 0 and the Nyquist frequency {rate / 2:g} Hz: lower it"
        raise MeasurementError(message + " below 0.8 of that, or sample faster")
    # Slow to load.
    from scipy.signal import butter, sosfiltfilt

    sos = butter(order, 2.0 * cutoff / rate, output="sos")
    pad = min(len(values) - 1, int(3 * rate / cutoff) + 1)
    return sosfiltfilt(sos, values, axis=0, padlen=pad)


def border(rate: float, cutoff: float) -> int:
    """Return the number of samples at each end that `low_pass` affects: 2 rate/f_c, our choice (0.8 % remain).

    Args:
        rate: sampling rate [Hz].
        cutoff: cut-off f_c of the filter [Hz].
    """
    return int(np.ceil(2 * rate / cutoff))


def slope(values: np.ndarray, rate: float, width: int = 4) -> np.ndarray:
    """Return the time derivative of `values` (N, ...) by central differences; NaN in the `width` rows at each end.

    ẋ_k = rate Σ_i c_i (x_{k+i} - x_{k-i}). At the angular frequency ω and the sampling period Δ, the classic two-point
    form (width 1) is too small by the relative error (ωΔ)²/6, which is 6.6 % at a tenth of the sampling rate. Width 4
    is too small by (ωΔ)⁸/630, which is 0.004 % there. It is our default, since log rates are low, and the low-pass
    filter removes noise.

    Args:
        values: (N, ...) samples of a segment without gaps.
        rate: sampling rate [Hz].
        width: number of samples on each side that the differences use.
    """
    return _differences(values, SLOPE[width], rate, -1.0)


def curvature(values: np.ndarray, rate: float, width: int = 4) -> np.ndarray:
    """Return the second time derivative of `values` (N, ...) by central differences; NaN at the ends as in `slope`.

    ẍ_k = rate² Σ_i d_i (x_{k+i} - 2 x_k + x_{k-i}). At the angular frequency ω and the sampling period Δ, the relative
    error of width 1 is (ωΔ)²/12.

    Args:
        values: (N, ...) samples of a segment without gaps.
        rate: sampling rate [Hz].
        width: number of samples on each side that the differences use.
    """
    return _differences(values, CURVATURE[width], rate**2, 1.0)


def _differences(values: np.ndarray, coefficients: tuple[float, ...], scale: float, sign: float) -> np.ndarray:
    width, n = len(coefficients), len(values)
    result = np.full_like(values, np.nan, dtype=float)
    for start in range(width, n - width, CHUNK):
        stop = min(start + CHUNK, n - width)
        derivative, middle = result[start:stop], values[start:stop]
        derivative[:] = 0.0
        for i, c in enumerate(coefficients, start=1):
            ahead = values[start + i : stop + i]
            behind = values[start - i : stop - i]
            if sign < 0:
                derivative += (scale * c) * (ahead - behind)
            else:
                derivative += (scale * c) * ((ahead - middle) - (middle - behind))
    return result
