"""Estimates: the covariance is the scatter over many seeds; correlations are named."""

import numpy as np
import pytest
import scipy.stats

from calib.estimation.estimate import Estimate
from calib.estimation.nonlinear import covariance, solve, triangle

TRUTH = np.array([2.0, 1.5, 0.4])
TIME = np.linspace(0.0, 3.0, 60)
SIGMA = 0.01


def fit_decay(seed: int) -> tuple[np.ndarray, np.ndarray, float]:
    """Return x, covariance and residual variance of a decay with an offset, noise SIGMA."""
    y = TRUTH[0] * np.exp(-TRUTH[1] * TIME) + TRUTH[2] + SIGMA * np.random.default_rng(seed).normal(size=60)

    def linearise(x):
        e = np.exp(-x[1] * TIME)
        slopes = np.column_stack([e, -x[0] * TIME * e, np.ones(60)])
        return triangle((y - x[0] * e - x[2]) / SIGMA, slopes / SIGMA)

    found = solve(linearise, lambda x, dx: x + dx, np.array([1.0, 1.0, 0.0]))
    assert found.status.good
    return found.state, covariance(found.factor), found.cost / 57


@pytest.mark.slow
def test_normalised_errors_are_chi_squared():
    """Normalised errors over many seeds are chi squared."""
    sizes, variances = [], []
    for seed in range(400):
        x, c, variance = fit_decay(seed)
        sizes.append((x - TRUTH) @ np.linalg.solve(c, x - TRUTH))
        variances.append(variance)
    assert scipy.stats.kstest(sizes, scipy.stats.chi2(3).cdf).pvalue > 1e-3
    assert scipy.stats.kstest(57 * np.array(variances), scipy.stats.chi2(57).cdf).pvalue > 1e-3


def test_sigma_and_rsd():
    e = Estimate(("a", "b", "c"), ("m", "m", "rad"), np.array([2.0, 0.0, -4.0]), np.diag([0.04, 1.0, 0.01]), 1.0, 5)
    assert e.sigma == pytest.approx([0.2, 1.0, 0.1])
    assert e.rsd == pytest.approx([10.0, np.inf, 2.5])


def test_correlations_are_listed_by_strength():
    """Strong correlations name the planted pairs, the strongest first."""
    rng = np.random.default_rng(0)
    matrix = rng.normal(size=(500, 5))
    matrix[:, 3] = matrix[:, 0] + 0.05 * rng.normal(size=500)
    matrix[:, 4] = -matrix[:, 1] + 0.2 * rng.normal(size=500)
    scale = np.diag([1.0, 1e3, 1.0, 1e-3, 1.0])
    c = scale @ np.linalg.inv(matrix.T @ matrix) @ scale
    pairs = Estimate(tuple("abcde"), ("m",) * 5, np.ones(5), c, 1.0, 495).strong_correlations()
    assert [pair[:2] for pair in pairs] == [("a", "d"), ("b", "e")]
    assert pairs[0][2] < -0.99 and 0.95 < pairs[1][2] < 0.99
    assert Estimate(("a", "b"), ("m", "m"), np.ones(2), np.diag([1.0, 0.0]), 1.0, 9).strong_correlations() == []


def test_arrays_of_an_estimate_are_read_only():
    e = Estimate(("a",), ("m",), np.ones(1), np.ones((1, 1)), 1.0, 5)
    with pytest.raises(ValueError):
        e.values[0] = 2.0
