"""Whiteness: known processes have their known correlations, and the verdicts keep their rates."""

import numpy as np
import pytest
import scipy.stats
from scipy.signal import lfilter

from calib.errors import CalibError
from calib.estimation.whiteness import (
    autocorrelation,
    examine,
    inflation,
    ljung_box,
    partial_autocorrelation,
    r_squared,
)


def ar(seed: int, coefficients: list[float], count: int = 4000) -> np.ndarray:
    return lfilter([1.0], [1.0, *[-c for c in coefficients]], np.random.default_rng(seed).normal(size=count + 500))[
        500:
    ]


def test_autocorrelation_is_its_defining_sum():
    """The autocorrelation is its defining sum."""
    x = np.random.default_rng(0).normal(size=57) + 3.0
    c = x - x.mean()
    assert autocorrelation(x, 5) == pytest.approx([np.sum(c[:-k] * c[k:]) / np.sum(c**2) for k in range(1, 6)])
    assert np.array_equal(autocorrelation(np.ones(30), 4), np.zeros(4))


def test_partials_solve_yule_walker():
    """Partial autocorrelations solve the Yule-Walker equations and end at the order."""
    rho = autocorrelation(ar(1, [0.5, 0.3]), 8)
    found = partial_autocorrelation(rho)
    for k in range(1, 9):
        table = scipy.linalg.toeplitz(np.append(1.0, rho[: k - 1]))
        assert found[k - 1] == pytest.approx(np.linalg.solve(table, rho[:k])[-1], abs=1e-12)
    assert found[1] == pytest.approx(0.3, abs=0.05)
    assert np.abs(found[2:]).max() < 0.06


def test_ljung_box_level_and_power():
    """Ljung-Box rejects white series at its level and sees a weak correlation."""

    def rejected(series):
        return ljung_box(autocorrelation(series, 20), len(series))[1] < 0.05

    rng = np.random.default_rng(2)
    size = np.mean([rejected(rng.normal(size=500)) for _ in range(400)])
    power = np.mean([rejected(ar(s, [0.3], 500)) for s in range(100)])
    assert 0.02 < size < 0.09
    assert power > 0.95


def test_examine_tells_white_residuals():
    """Examine tells white normal residuals from others."""
    rng = np.random.default_rng(3)
    white, coloured, heavy = (examine(x) for x in (rng.normal(size=3000), ar(3, [0.8]), rng.standard_t(3, 3000)))
    assert white.outside < 0.15 < 0.3 < coloured.outside
    assert white.normal_p > 0.01 and white.ljung_box_p > 0.01
    assert coloured.ljung_box_p < 1e-6
    assert heavy.normal_p < 1e-6 and heavy.kurtosis > 1.0
    assert white.bound == pytest.approx(1.96 / np.sqrt(3000))


@pytest.mark.parametrize("phi", [0.0, 0.5, 0.9])
def test_inflation_of_an_autoregression(phi):
    """The inflation of an autoregression is its integrated correlation."""
    found = np.mean([inflation(ar(s, [phi], 20_000)) for s in range(8)])
    assert found == pytest.approx((1 + phi) / (1 - phi), rel=0.1)


def test_inflation_is_a_ratio_of_variances():
    """The inflation is the variance of the mean over that of white noise."""
    means = [np.mean(ar(s, [0.8], 2000)) for s in range(400)]
    promised = np.mean([inflation(ar(s, [0.8], 2000)) * np.var(ar(s, [0.8], 2000)) / 2000 for s in range(30)])
    assert np.var(means) == pytest.approx(promised, rel=0.3)


def test_negative_correlation_adds_no_rows():
    """Negative correlation never counts as more than the rows there are."""
    assert inflation(ar(4, [-0.6])) == 1.0
    assert inflation(np.ones(5)) == 1.0


def test_r_squared_at_its_reference_points():
    """R squared is one for no residual, zero for the mean, and negative below."""
    y = np.random.default_rng(5).normal(size=100) + 4.0
    assert r_squared(y, np.zeros(100)) == 1.0
    assert r_squared(y, y - y.mean()) == pytest.approx(0.0)
    assert r_squared(y, y) < 0.0


def test_too_few_residuals_are_refused():
    with pytest.raises(CalibError, match="too few"):
        examine(np.ones(25))


@pytest.mark.parametrize("count", [20, 33, 1000])
def test_normality_test_is_that_of_scipy(count):
    """Normality is tested as SciPy does."""
    rng = np.random.default_rng(count)
    for x in (rng.standard_normal(count), rng.standard_exponential(count), rng.standard_t(2, count)):
        found = examine(x, lags=10)
        assert found.kurtosis == pytest.approx(scipy.stats.kurtosis(x), rel=1e-12)
        assert found.normal_p == pytest.approx(scipy.stats.normaltest(x).pvalue, rel=1e-9)


def test_absorbed_correlation_is_put_back():
    """354 errors behind a fit of 14 slow columns, as 7 s of a joint: residuals read 0.6 of their τ, with it 0.8."""
    read = []
    for seed in range(30):
        errors, rng = ar(seed, [0.5], 354), np.random.default_rng(seed)
        q, _ = np.linalg.qr(lfilter([1.0], [1.0, -0.9], rng.normal(size=(354, 14)), axis=0))
        residual = errors - q @ (q.T @ errors)
        tau = alone = inflation(residual)
        for _ in range(3):
            std = np.sqrt(residual @ residual / (354 - 14 * tau))
            tau = inflation(np.column_stack([residual, std * np.sqrt(tau) * q]))
        read.append([alone, tau, inflation(errors)])
    alone, whole, true = np.mean(read, axis=0)
    assert alone < 0.65 * true and 0.75 * true < whole < true
