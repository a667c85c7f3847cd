"""Robust weights: they are the slope of their loss, 95 % efficient, and the spread ignores outliers."""

import numpy as np
import pytest
from differences import check
from scipy.integrate import quad
from scipy.stats import norm

from calib.estimation.robust import spread, weights


def huber(s: np.ndarray, k: float = 1.345) -> np.ndarray:
    return np.where(np.abs(s) <= k, s**2 / 2, k * np.abs(s) - k**2 / 2)


def cauchy(s: np.ndarray, c: float = 2.385) -> np.ndarray:
    return c**2 / 2 * np.log1p((s / c) ** 2)


@pytest.mark.parametrize("name, loss", [("huber", huber), ("cauchy", cauchy), ("none", lambda s: s**2 / 2)])
def test_weighted_residual_is_slope_of_loss(name, loss):
    """The weight times the residual is the slope of the loss."""
    sizes = np.random.default_rng(0).uniform(0.05, 8.0, 40)
    check(lambda s: loss(s).sum(), lambda s: weights(s, name) * s, sizes)


@pytest.mark.parametrize("name", ["huber", "cauchy"])
def test_constants_are_95_percent_efficient(name):
    """The usual constants are 95 percent efficient on normal residuals."""

    def psi(s: float) -> float:
        return float(weights(np.abs(np.array(s)), name) * s)

    slope = quad(lambda s: s * psi(s) * norm.pdf(s), -9, 9, limit=200)[0]  # E psi' = E s psi, by parts
    power = quad(lambda s: psi(s) ** 2 * norm.pdf(s), -9, 9, limit=200)[0]
    assert slope**2 / power == pytest.approx(0.95, abs=1e-3)


def test_own_scale_replaces_the_constant():
    """A scale that is stated replaces the constant."""
    sizes = np.array([0.5, 2.0, 6.0])
    assert weights(sizes, "huber", 2.0) == pytest.approx([1.0, 1.0, 1 / 3])
    assert weights(sizes, "cauchy", 2.0) == pytest.approx([1 / (1 + 1 / 16), 0.5, 0.1])


def test_an_unknown_loss_is_refused():
    with pytest.raises(ValueError, match="tukey"):
        weights(np.ones(3), "tukey")


def test_spread_is_sigma_despite_outliers():
    """The spread is sigma with and without outliers."""
    rng = np.random.default_rng(1)
    clean = 3e-4 * rng.normal(size=20000)
    assert spread(clean) == pytest.approx(3e-4, rel=0.02)
    dirty = clean.copy()
    dirty[:1000] += 1.0
    assert spread(dirty) == pytest.approx(norm.ppf(0.5 + 0.25 / 0.95) / norm.ppf(0.75) * 3e-4, rel=0.02)
    assert np.std(dirty) > 100 * spread(dirty)
    assert spread(np.zeros(0)) == 0.0
