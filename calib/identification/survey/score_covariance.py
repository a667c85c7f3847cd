"""Covariance of the score Σ_k W_kᵀ r_k of autocorrelated residuals r, for methods that do not whiten them."""

import numpy as np

from calib.estimation.whiteness import autocorrelation, inflation
from calib.records import shaped


def scatter(white: np.ndarray, residual: np.ndarray, covariance: np.ndarray | None = None) -> np.ndarray:
    """Return the covariance of the score Σ_k W_kᵀ r_k: Σ_j σ_j² Σ_kl ρ_j(k - l) w_jk w_jlᵀ (p, p).

    σ_j² and ρ_j are variance and autocorrelation of row j's residuals over one uninterrupted record. ρ_j is tapered
    linearly (Bartlett 1946) so that the result is positive definite; the width of the taper is three times the window
    of `whiteness.inflation`. For differentiated noise (accelerations), whose neighbouring samples cancel, the result is
    smaller than Σ σ_j² w wᵀ; for similar neighbouring samples, as in the error of a simulated motion, it is much
    larger.

    Args:
        white: W (N, rows, p).
        residual: r (N, rows); zero where a row is not in use.
        covariance: C (p, p) of the estimate behind the residuals. σ_j² and ρ_j then also include the part of the errors
            that the fit absorbed, E[e_k e_l] = r_k r_l + w_k C w_lᵀ, which matters in short records and where W is
            large. None: of r alone.
    """
    shape = (None, None, None)
    white = shaped(white, shape, "rows")
    residual = shaped(residual, white.shape[:2], "residuals")
    count = len(white)
    p = white.shape[2]
    size = 1 << (2 * count - 1).bit_length()
    result = np.zeros((p, p))
    # at least, of the residuals' autocorrelation
    min_lags = 12
    if covariance is None:
        root = np.zeros((p, 0))
    else:
        root = np.linalg.cholesky(covariance)
    for row in range(white.shape[1]):
        values = white[:, row]
        row_residuals = np.column_stack([residual[:, row], values @ root])
        variance = float(np.sum(row_residuals**2) / count)
        if variance == 0.0 or count < 4 * min_lags:
            result += variance * values.T @ values
            continue
        lags = int(min(count // 4, max(min_lags, 15 * inflation(row_residuals))))
        taper = 1.0 - np.arange(1, lags + 1) / (lags + 1.0)
        rho = autocorrelation(row_residuals, lags) * taper
        kernel = np.zeros(size)
        kernel[0] = 1.0
        kernel[1 : lags + 1] = rho
        kernel[size - lags :] = rho[::-1]
        gain = np.fft.rfft(kernel).real
        spectrum = np.fft.rfft(values, size, axis=0) * gain[:, None]
        smooth = np.fft.irfft(spectrum, size, axis=0)[:count]
        result += variance * values.T @ smooth
    return 0.5 * (result + result.T)
