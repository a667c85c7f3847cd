"""Zero-phase low-pass filters and central differences, along the first axis of evenly sampled arrays."""

import numpy as np
from scipy.linalg.lapack import dtbtrs  # type: ignore[attr-defined]

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
    sections = _butterworth(order, cutoff / rate)
    pad = min(len(values) - 1, int(3 * rate / cutoff) + 1)
    x = values.reshape(len(values), -1)
    x = np.concatenate([2.0 * x[0] - x[pad:0:-1], x, 2.0 * x[-1] - x[-2 : -2 - pad : -1]])
    for _ in range(2):
        x = _filtered(sections, x)[::-1]
    return x[pad : len(x) - pad].reshape(values.shape)


def _butterworth(order: int, share: float) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the sections b, a (3,) of a low-pass filter by the bilinear transform, each of gain one at rest.

    Args:
        share: of the sampling rate, the cut-off; below one half.
    """
    k, found = np.tan(np.pi * share), []
    for i in range(order // 2):
        damped = 2.0 * np.sin(np.pi * (2 * i + 1) / (2 * order)) * k
        denominator = np.array([1.0 + damped + k**2, 2.0 * (k**2 - 1.0), 1.0 - damped + k**2])
        found.append((k**2 * np.array([1.0, 2.0, 1.0]) / denominator[0], denominator / denominator[0]))
    if order % 2:
        found.append((np.array([k, k, 0.0]) / (1.0 + k), np.array([1.0, (k - 1.0) / (k + 1.0), 0.0])))
    return found


def _filtered(sections: list[tuple[np.ndarray, np.ndarray]], x: np.ndarray) -> np.ndarray:
    """Return x (N, k) through all sections, which have seen its first value for ever.

    The recursion a_0 y_k + a_1 y_{k-1} + a_2 y_{k-2} = … is a triangular system with a band of three: LAPACK's, since
    scipy.signal takes longer to load than a long log to filter.
    """
    y = x - x[0]
    for b, a in sections:
        right = b[0] * y
        right[1:] += b[1] * y[:-1]
        right[2:] += b[2] * y[:-2]
        y, _ = dtbtrs(np.repeat(a[:, None], len(y), axis=1), right, uplo="L", diag="U")
    return y + x[0]


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


def moving_cubics(values: np.ndarray, width: int, order: int = 0) -> np.ndarray:
    """Return `values` (N, n), or a derivative per sample, by the cubic that fits the `width` samples on either side.

    Savitzky and Golay (1964); the first and last `width` rows are on the cubics of the outermost windows.
    """
    reach = np.arange(-width, width + 1.0)
    fit = np.linalg.pinv(np.vander(reach, 4, increasing=True))  # coefficients of 1, k, k², k³
    factorial, powers = np.array([[1, 1, 1, 1], [0, 1, 2, 3], [0, 0, 2, 6]])[order], np.arange(4) - order
    at = np.where(powers >= 0, factorial * reach[:, None] ** np.maximum(powers, 0), 0.0) @ fit  # of every place in it
    inner = sum(at[width, k] * values[k : len(values) - 2 * width + k] for k in range(2 * width + 1))
    size = 2 * width + 1
    return np.concatenate([at[:width] @ values[:size], inner, at[width + 1 :] @ values[len(values) - size :]])


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
