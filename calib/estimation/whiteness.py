"""Tests of residuals: autocorrelation, departure from the normal distribution, and explained share (R²)."""

from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc

from calib.errors import CalibError
from calib.records import Array, Number, frozen, shaped


@dataclass(frozen=True, eq=False)
class Whiteness:
    """Results of the whiteness tests of one series of residuals.

    Attributes:
        acf, pacf: (lags,) autocorrelation and partial autocorrelation at lags 1, 2, …
        bound: 1.96 / sqrt(N); 95 % of a white series' autocorrelations are within ± this bound.
        outside: share of the autocorrelations beyond the bound; about 0.05 for a white series.
        ljung_box_p: p-value of the Ljung–Box test, the probability that a white series has a larger statistic.
        kurtosis: excess kurtosis, 0 for normal residuals.
        normal_p: p-value of the hypothesis that the residuals are normal and independent, D'Agostino & Pearson (1973).
    """

    acf: Array
    pacf: Array
    bound: Number
    outside: float
    ljung_box_p: Number
    kurtosis: Number
    normal_p: Number


def examine(residual: np.ndarray, lags: int = 30) -> Whiteness:
    """Return the whiteness tests of the residuals (N,) of one joint in one recording, sampled at a constant rate.

    Args:
        residual: (N,) in order of time, of any unit, with N > lags and N >= 20.
        lags: number of autocorrelations.

    Raises:
        CalibError: for too few residuals.
    """
    x = shaped(residual, (None,), "residuals")
    min_count = max(lags + 1, 20)
    if len(x) < min_count:
        raise CalibError(f"{len(x)} residuals are too few for {lags} lags; needed are at least {min_count}")
    rho = autocorrelation(x, lags)
    bound = 1.96 / np.sqrt(len(x))
    _, ljung_box_p = ljung_box(rho, len(x))
    skewness, kurtosis = _shape(x)
    return Whiteness(
        acf=frozen(rho),
        pacf=frozen(partial_autocorrelation(rho)),
        bound=bound,
        outside=float(np.mean(np.abs(rho) > bound)),
        ljung_box_p=ljung_box_p,
        kurtosis=kurtosis,
        normal_p=_normality(skewness, kurtosis, len(x)),
    )


def _shape(x: np.ndarray) -> tuple[float, float]:
    """Return skewness and excess kurtosis of a series (N,); NaN for a constant series."""
    mean = x.mean()
    centred = x - mean
    square = centred**2
    variance = square.mean()
    if variance <= (np.finfo(float).eps * mean) ** 2:
        return float("nan"), float("nan")
    skewness = (square * centred).mean() / variance**1.5
    kurtosis = (square**2).mean() / variance**2 - 3.0
    return float(skewness), float(kurtosis)


def _normality(skewness: float, kurtosis: float, n: int) -> float:
    """Return the p-value of the hypothesis that n >= 20 values with this skewness and excess kurtosis are normal.

    Skewness and kurtosis are each transformed into a standard normal variable, and the sum of both squares is tested
    (D'Agostino & Pearson 1973; D'Agostino 1970; Anscombe & Glynn 1983). The result equals that of
    `scipy.stats.normaltest`, whose import takes half a second.
    """
    # skewness (D'Agostino 1970)
    y = skewness * np.sqrt((n + 1) * (n + 3) / (6.0 * (n - 2)))
    beta = 3.0 * (n**2 + 27 * n - 70) * (n + 1) * (n + 3) / ((n - 2.0) * (n + 5) * (n + 7) * (n + 9))
    w = np.sqrt(2.0 * (beta - 1.0)) - 1.0
    delta = np.sqrt(0.5 * np.log(w))
    normal_skewness = np.arcsinh(y * np.sqrt((w - 1.0) / 2.0)) / delta
    # kurtosis (Anscombe & Glynn 1983)
    variance = 24.0 * n * (n - 2) * (n - 3) / ((n + 1) ** 2 * (n + 3.0) * (n + 5))
    mean = 3.0 * (n - 1) / (n + 1)
    x = (kurtosis + 3.0 - mean) / np.sqrt(variance)
    root_beta = np.sqrt(6.0 * (n + 3) * (n + 5) / (n * (n - 2) * (n - 3)))
    third = 6.0 * (n * n - 5 * n + 2) / ((n + 7) * (n + 9)) * root_beta
    a = 6.0 + 8.0 / third * (2.0 / third + np.sqrt(1.0 + 4.0 / third**2))
    root = np.cbrt((1.0 - 2.0 / a) / (1.0 + x * np.sqrt(2.0 / (a - 4.0))))
    normal_kurtosis = (1.0 - 2.0 / (9.0 * a) - root) / np.sqrt(2.0 / (9.0 * a))
    return float(chdtrc(2, normal_skewness**2 + normal_kurtosis**2))


def autocorrelation(residual: np.ndarray, lags: int) -> np.ndarray:
    """Return the autocorrelations ρ_k = Σ_t x_t x_{t+k} / Σ_t x_t² for k = 1 … lags (by FFT), with means removed.

    For residuals (N, columns) both sums also run over the columns. A constant series gives zeros.

    Args:
        residual: (N,) or (N, columns), in order of time.
        lags: number of autocorrelations.
    """
    columns = np.asarray(residual, dtype=float).reshape(len(residual), -1).T
    size = 1 << (2 * len(residual) - 1).bit_length()
    spectrum = np.zeros(size // 2 + 1)
    for x in columns:
        spectrum += np.abs(np.fft.rfft(x - x.mean(), size)) ** 2
    covariance = np.fft.irfft(spectrum, size)[: lags + 1]
    if not covariance[0] > 0.0:
        return np.zeros(lags)
    return covariance[1:] / covariance[0]


def partial_autocorrelation(acf: np.ndarray) -> np.ndarray:
    """Return the partial autocorrelations of lags 1 … k from the autocorrelations `acf` (k,) (Durbin–Levinson)."""
    result = np.empty(len(acf))
    phi = np.zeros(0)
    for k, rho in enumerate(acf):
        unexplained = 1.0 - phi @ acf[:k]
        last = 0.0
        if unexplained > 0.0:
            last = (rho - phi @ acf[:k][::-1]) / unexplained
        phi = np.append(phi - last * phi[::-1], last)
        result[k] = last
    return result


def ljung_box(acf: np.ndarray, count: int) -> tuple[float, float]:
    """Return the Ljung–Box statistic Q = N (N + 2) Σ ρ_k² / (N - k) and its p-value P(χ²(lags) > Q) (Ljung & Box 1978).

    No degrees of freedom are subtracted: this is correct for residuals of a regression on given columns, but not for
    residuals of an ARMA model.

    Args:
        acf: (lags,) autocorrelations ρ_k.
        count: N, the length of the series.
    """
    lags = np.arange(1, len(acf) + 1)
    statistic = count * (count + 2.0) * np.sum(acf**2 / (count - lags))
    return float(statistic), float(chdtrc(len(acf), statistic))


def inflation(residual: np.ndarray) -> float:
    """Return the integrated autocorrelation τ = 1 + 2 Σ_{k<=m} ρ_k >= 1: N residuals count as N / τ independent ones.

    The window m is the smallest with m >= 5 τ(m) (Sokal 1997), since longer sums only add noise; it is at most N / 4.
    Fewer than 8 residuals give τ = 1.

    Args:
        residual: (N,) residuals, or (N, 1 + p) residuals with the columns W C^(1/2) appended (W the fitted columns, C
            the covariance of the fit), which account for the part of the errors that the fit absorbed.
    """
    x = np.asarray(residual, dtype=float)
    if len(x) < 8:
        return 1.0
    tau = 1.0 + 2.0 * np.cumsum(autocorrelation(x, len(x) // 4))
    long_enough = np.arange(1, len(tau) + 1) >= 5.0 * tau
    window = np.argmax(long_enough) if long_enough.any() else -1
    return float(max(1.0, tau[window]))


def r_squared(target: np.ndarray, residual: np.ndarray) -> float:
    """Return R² = 1 - Σ ρ² / Σ (y - mean y)²; NaN for a constant y, negative if the mean of y predicts y better.

    Args:
        target: y (N,), the measured values.
        residual: ρ (N,), measured minus predicted values.
    """
    total = float(np.sum((target - np.mean(target)) ** 2))
    if not total > 0.0:
        return float("nan")
    return 1.0 - float(np.sum(np.asarray(residual) ** 2)) / total
