"""Zero-phase low-pass filters and central differences, along the first axis of evenly sampled arrays."""

from __future__ import annotations

import numpy as np

from calib.errors import MeasurementError

ORDER = 4  # of the Butterworth filter, run forwards and backwards (Gautier's choice; the studies' too)
# Central differences of half-width w are exact for polynomials of degree 2w: coefficients of x(k+i) - x(k-i) for the
# slope, of x(k+i) + x(k-i) - 2 x(k) for the curvature (Fornberg 1988, table 1)
SLOPE = {1: (1 / 2,), 2: (2 / 3, -1 / 12), 3: (3 / 4, -3 / 20, 1 / 60), 4: (4 / 5, -1 / 5, 4 / 105, -1 / 280)}
CURVATURE = {1: (1.0,), 2: (4 / 3, -1 / 12), 3: (3 / 2, -3 / 20, 1 / 90), 4: (8 / 5, -1 / 5, 8 / 315, -1 / 560)}


def low_pass(values: np.ndarray, rate: float, cutoff: float, order: int = ORDER) -> np.ndarray:
    """Return `values` (N, ...) through a Butterworth filter run forwards and backwards: no phase shift.

    Gain |H(f)|² = 1 / (1 + (f/f_c)^(2 order)): 1/2 at the cut-off f_c, where one pass has 1/√2. The ends are continued
    by their odd reflection over 3 rate/f_c samples; some 2/f_c seconds at each end still feel it.

    Args:
        values: with no NaN; a segment without gaps.
        rate, cutoff: [Hz].

    Raises:
        MeasurementError: for a cut-off at or above the Nyquist frequency, or not above zero.
    """
    if not 0 < cutoff < rate / 2:
        message = f"a cut-off of {cutoff:g} Hz is not between 0 and the Nyquist frequency {rate / 2:g} Hz: lower it"
        raise MeasurementError(message + " below 0.8 of that, or sample faster")
    from scipy.signal import butter, sosfiltfilt  # slow to load

    sos = butter(order, cutoff, fs=rate, output="sos")
    pad = min(len(values) - 1, int(3 * rate / cutoff) + 1)
    return sosfiltfilt(sos, values, axis=0, padtype="odd", padlen=pad)


def border(rate: float, cutoff: float) -> int:
    """Return the number of samples at each end that a `low_pass` spoils: 2 rate/f_c, our choice (0.8 % is left)."""
    return int(np.ceil(2 * rate / cutoff))


def hann(size: int) -> np.ndarray:
    """Return Hann's window (size,) for a spectrum: one period, its last zero left out."""
    return 0.5 + 0.5 * np.cos(np.linspace(-np.pi, np.pi, size + 1)[:-1])


def slope(values: np.ndarray, rate: float, width: int = 4) -> np.ndarray:
    """Return the time derivative of `values` (N, ...) by central differences; NaN in the `width` rows at each end.

    ẋ_k = rate Σ_i c_i (x_{k+i} - x_{k-i}). At ω and the period Δ the classic two-point form (width 1) falls short by
    (ωΔ)²/6: 6.6 % at a tenth of the sampling rate; width 4 by (ωΔ)⁸/630: 0.004 % (our default: log rates are low, and
    the noise is the low-pass filter's business).
    """
    return _differences(values, SLOPE[width], rate, -1.0)


def curvature(values: np.ndarray, rate: float, width: int = 4) -> np.ndarray:
    """Return the second time derivative of `values` (N, ...) by central differences; NaN at the ends as in `slope`.

    ẍ_k = rate² Σ_i d_i (x_{k+i} - 2 x_k + x_{k-i}); relative error (ωΔ)²/12 for width 1.
    """
    return _differences(values, CURVATURE[width], rate**2, 1.0)


def _differences(values: np.ndarray, coefficients: tuple[float, ...], scale: float, sign: float) -> np.ndarray:
    width, n = len(coefficients), len(values)
    out = np.full(values.shape, np.nan)
    if n <= 2 * width:
        return out
    inner = out[width : n - width]
    inner[:] = 0.0
    middle = values[width : n - width]
    for i, c in enumerate(coefficients, start=1):
        ahead, behind = values[width + i : n - width + i], values[width - i : n - width - i]
        if sign < 0:
            inner += (scale * c) * (ahead - behind)
        else:
            inner += (scale * c) * ((ahead - middle) - (middle - behind))
    return out
