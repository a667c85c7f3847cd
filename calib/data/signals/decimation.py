"""Parallel decimation: the same low-pass filter and thinning for the torque and for every column of W.

Filtering is linear along time, so y = W x + ρ becomes y_f = W_f x + ρ_f with the *same* x, whatever the filter: what
lies above the band of the model (ripple, flexibility, noise) goes, and no bias comes in (Gautier's parallel decimation;
figures below in Briot & Gautier's DualV studies and the TX40 slides). The filter is finite, even about its centre and
evaluated at the kept samples only, so it has no phase, can run over blocks, and at the ends of a segment the rows whose
window sticks out are left out.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Protocol

import numpy as np
from scipy.special import i0

from calib.arrays import frozen
from calib.errors import MeasurementError, require

KINDS = ("chebyshev", "kaiser")
SHARE = 0.8  # of the new Nyquist frequency that is kept
KAISER = 0.1102 * (60.0 - 8.7)  # beta of a window whose stop band is 60 dB down (Kaiser 1974)


@dataclass(frozen=True, eq=False)
class Decimator:
    """A low-pass filter that keeps one sample in `factor`.

    Attributes:
        factor: n_d; 1 changes nothing.
        taps: (2 h + 1,) weights of the samples k-h … k+h, symmetric, of sum 1.
        rate: of the signal before [Hz].
        band: the cut-off f_p = 0.8 rate / (2 n_d) [Hz]: what is below survives.
    """

    factor: int
    taps: np.ndarray
    rate: float
    band: float

    @property
    def reach(self) -> int:
        """h, the samples on each side that a kept one needs."""
        return len(self.taps) // 2


class _Timed(Protocol):
    @property
    def segment(self) -> np.ndarray: ...
    @property
    def q(self) -> np.ndarray: ...
    @property
    def v(self) -> np.ndarray: ...
    @property
    def a(self) -> np.ndarray: ...


def design_decimator(rate: float, factor: int, kind: str = "kaiser") -> Decimator:
    """Return the filter for keeping one sample in `factor` of a signal at `rate` [Hz].

    ``chebyshev``: Matlab's and Gautier's decimate: type I, order 8, 0.05 dB, cut-off 0.8 of the new Nyquist frequency,
    run forwards and backwards; taken as its impulse response (the inverse transform of |H|²), cut where 1e-4 of it is
    left: some 46 n_d samples on each side. ``kaiser``: a windowed sinc with the same band, 60 dB down from 1.2 of the
    new Nyquist frequency on, 9 n_d samples on each side: a fifth of the work and of the lost ends (our default).

    Raises:
        CalibError: for a factor below 1 or a kind that is none.
    """
    words = f"decimation by {factor} with a '{kind}' filter: expected at least 1, and {' or '.join(KINDS)}"
    require(factor >= 1 and kind in KINDS, words)
    band = SHARE * rate / (2 * factor)
    if factor == 1:
        return Decimator(1, frozen([1.0]), rate, band)
    taps = np.asarray(_chebyshev(factor) if kind == "chebyshev" else _kaiser(factor), dtype=float)
    return Decimator(factor, frozen(taps / taps.sum()), rate, band)


def factor_for(rate: float, band: float) -> int:
    """Return the largest n_d whose filter keeps `band` [Hz]: floor(0.8 rate / (2 f_p)), at least 1."""
    return max(1, int(SHARE * rate / (2 * band) + 1e-9))


def kept(segment: np.ndarray, decimator: Decimator) -> np.ndarray:
    """Return the indices (M,) of the samples that `decimate` keeps, from the segment numbers (N,), which rise."""
    edges = np.concatenate([[0], np.flatnonzero(np.diff(segment)) + 1, [len(segment)]])
    h, r = decimator.reach, decimator.factor
    parts = [np.arange(a + h, b - h, r) for a, b in pairwise(edges)]
    return np.concatenate(parts)


def decimate(values: np.ndarray, decimator: Decimator, segment: np.ndarray | None = None) -> np.ndarray:
    """Return `values` (N, ...) filtered and thinned to (M, ...), at the samples `kept`; each segment (N,) by itself."""
    values = np.asarray(values, dtype=float)
    segment = np.zeros(len(values), dtype=int) if segment is None else segment
    edges = np.concatenate([[0], np.flatnonzero(np.diff(segment)) + 1, [len(segment)]])
    parts = [np.empty((0, *values.shape[1:]))]
    for a, b in pairwise(edges):
        parts += [np.moveaxis(part, -1, 0) for part in decimate_blocks([np.moveaxis(values[a:b], 0, -1)], decimator)]
    return np.concatenate(parts)


def spread(values: np.ndarray, decimator: Decimator, length: int) -> np.ndarray:
    """Return the adjoint of `decimate` on one segment of `length` samples: Σ y · decimate(x) = Σ spread(y) · x.

    Args:
        values: (M, ...) at the kept samples.
    """
    r, taps, count = decimator.factor, decimator.taps, len(values)
    phases = -(-len(taps) // r)
    weights = np.zeros(phases * r)
    weights[: len(taps)] = taps
    result = np.zeros((count + phases, r, *values.shape[1:]))
    shape = (1, r, *(1 for _ in values.shape[1:]))
    for phase in range(phases):
        result[phase : phase + count] += weights[phase * r : (phase + 1) * r].reshape(shape) * values[:, None]
    return result.reshape(-1, *values.shape[1:])[:length]


def decimate_blocks(blocks: Iterable[np.ndarray], decimator: Decimator) -> Iterator[np.ndarray]:
    """Return, block by block, what `decimate` returns of the blocks (..., N_i) of one segment joined together.

    The sample axis is the last one. Holds one block, and of those before it the samples that windows still need.
    """
    r, taps = decimator.factor, decimator.taps
    if r == 1 and len(taps) == 1:
        yield from blocks
        return
    rest = None
    for block in blocks:
        rest = block if rest is None or not rest.shape[-1] else np.concatenate([rest, block], axis=-1)
        if (count := (rest.shape[-1] - len(taps)) // r + 1) > 0:
            yield _windows(rest, taps, r, count)
            rest = rest[..., count * r :]


def decimate_regressor(
    regressor: Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray],
    motion: _Timed,
    decimator: Decimator,
    block: int = 4096,
) -> Iterator[np.ndarray]:
    """Return blocks (M_i, rows, p) of the decimated observation matrix of a motion, built `block` samples at a time.

    Args:
        regressor: (q, v, a), each (k, n), to (k, rows, p).
        motion: q, v, a and segments; an hour of 1 kHz needs no more memory than a minute.
    """
    edges = np.concatenate([[0], np.flatnonzero(np.diff(motion.segment)) + 1, [len(motion.segment)]])
    for a, b in pairwise(edges):
        spans = [slice(i, min(i + block, b)) for i in range(a, b, block)]
        blocks = (np.moveaxis(regressor(motion.q[s], motion.v[s], motion.a[s]), 0, -1) for s in spans)
        yield from (np.moveaxis(part, -1, 0) for part in decimate_blocks(blocks, decimator))


def _windows(values: np.ndarray, taps: np.ndarray, r: int, count: int) -> np.ndarray:
    """Return the first `count` windows (..., count) of values (..., N), one every r samples.

    As many windows at a time as one is long, as a product with their band of taps: twice the multiplications, which
    the processor's cache makes up for many times over.
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
    place = np.arange(18 * factor + 1) - 9 * factor
    window = i0(KAISER * np.sqrt(1.0 - (place / (9 * factor)) ** 2)) / i0(KAISER)
    return np.sinc(place / factor) * window


def _chebyshev(factor: int, ripple: float = 0.05) -> np.ndarray:
    # ripple: of one pass of the Chebyshev filter [dB]
    from scipy.signal import cheby1, sosfreqz  # slow to load, and seldom needed

    sos = cheby1(8, ripple, SHARE / factor, output="sos")
    size = 1 << int(np.ceil(np.log2(400 * factor)))
    _, response = sosfreqz(sos, np.linspace(0, np.pi, size // 2 + 1))
    even = np.fft.irfft(np.abs(response) ** 2, size)
    half = even[: size // 2]
    left = np.cumsum(np.abs(half)[::-1])[::-1]
    reach = int(np.argmax(left < 1e-4 * np.abs(half).sum()))
    return np.concatenate([half[reach:0:-1], half[: reach + 1]])


def too_short(motion_length: int, decimator: Decimator) -> MeasurementError:
    """Return the complaint that no window of the filter fits into a motion."""
    need = len(decimator.taps) / decimator.rate
    message = (
        f"decimation by {decimator.factor} needs {need:.3g} s without a gap, of {motion_length / decimator.rate:.3g}"
    )
    return MeasurementError(message + " s there are: raise the band, or record longer")
