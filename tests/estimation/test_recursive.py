"""Recursive estimate: pieces equal one batch, drift rates are estimated, and stated sigmas hold the errors."""

import numpy as np
import pytest

from calib.errors import CalibError
from calib.estimation.recursive import STILL, start, widened

P = 5
NOISE = 0.5
GROUP = np.array([STILL, STILL, 0, 0, 1])


def problem(seed: int, rows: int = 400) -> tuple[np.ndarray, np.ndarray]:
    """Return parameters (p,) and whitened rows [W y] (N, p + 1) with noise 1."""
    rng = np.random.default_rng(seed)
    matrix = rng.normal(size=(rows, P))
    values = rng.normal(size=P)
    target = matrix @ values + rng.normal(size=rows)
    return values, np.column_stack([matrix, target])


@pytest.mark.parametrize("size", [1, 37, 150])
def test_pieces_give_the_estimate_of_one_batch(size: int):
    _, rows = problem(0)
    state = start(np.zeros(P), 4.0 * np.eye(P), GROUP, np.ones(P), 5.0, rates=(0.0, 0.1))
    batch = state.absorb(rows, len(rows))
    pieces = state
    for first in range(0, len(rows), size):
        part = rows[first : first + size]
        pieces = pieces.later(0.0).absorb(part, len(part))
    for piecewise, whole in zip(pieces.posterior(), batch.posterior()):
        np.testing.assert_allclose(piecewise, whole, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(pieces.weights, batch.weights, rtol=1e-8)


def test_batch_is_the_estimate_with_a_normal_prior():
    _, rows = problem(1)
    prior = np.diag([4.0, 1.0, 0.1, 2.0, 3.0])
    mean = np.arange(P, dtype=float)
    state = start(mean, prior, np.full(P, STILL), np.ones(P), 1e9).absorb(rows, len(rows))
    information = rows[:, :-1].T @ rows[:, :-1] + np.linalg.inv(prior)
    values = np.linalg.solve(information, rows[:, :-1].T @ rows[:, -1] + np.linalg.solve(prior, mean))
    np.testing.assert_allclose(state.posterior()[0], values, rtol=1e-10)
    np.testing.assert_allclose(state.posterior()[1], np.linalg.inv(information), rtol=1e-4)


def test_a_step_adds_its_variance():
    _, rows = problem(2)
    state = start(np.zeros(P), np.eye(P), np.full(P, STILL), np.ones(P), 1e9).absorb(rows, len(rows))
    deviations = np.array([0.0, 0.2, 0.0, 3.0, 0.0])
    mean, covariance = state.posterior()
    mean_after, covariance_after = state.freed(deviations).posterior()
    np.testing.assert_allclose(mean_after, mean, rtol=1e-9)
    np.testing.assert_allclose(covariance_after, covariance + np.diag(deviations**2), rtol=1e-7, atol=1e-12)
    np.testing.assert_array_equal(widened(state.factors[0], np.zeros(P)), state.factors[0])


@pytest.mark.parametrize(
    "rate", [pytest.param(0.0, marks=pytest.mark.slow), 0.03, pytest.param(0.1, marks=pytest.mark.slow)]
)
def test_the_rate_of_drift_is_estimated_and_sigmas_hold(rate: float):
    relative_errors = []
    found = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        values = rng.normal(size=P)
        state = start(values, 1e-4 * np.eye(P), GROUP, np.ones(P), 5.0)
        for _ in range(20):
            values[2:4] += rate * rng.normal(size=2)
            matrix = rng.normal(size=(30, P))
            target = matrix @ values + NOISE * rng.normal(size=30)
            state = state.later(1.0).absorb(np.column_stack([matrix, target]) / NOISE, 30)
        mean, covariance = state.posterior()
        relative_errors.append((mean - values)[:2] / np.sqrt(np.diag(covariance))[:2])
        found.append(state.rate_quantiles(0))
    assert np.sqrt(np.mean(np.square(relative_errors))) < 1.5
    covered = [low <= rate <= high for low, _, high in found]
    assert np.mean(covered) >= 0.8
    if rate:
        medians = [median for _, median, _ in found]
        assert np.median(medians) == pytest.approx(rate)


def test_noise_above_the_stated_one_widens_the_estimate():
    values, rows = problem(3)
    rows[:, -1] = rows[:, :-1] @ values + 3.0 * (rows[:, -1] - rows[:, :-1] @ values)
    state = start(values, np.eye(P), np.full(P, STILL), np.ones(P), 5.0).absorb(rows, len(rows))
    assert state.variance_factors[0] == pytest.approx(9.0, rel=0.2)


def test_a_parameter_without_variance_is_refused():
    with pytest.raises(CalibError, match="needs a variance"):
        start(np.zeros(2), np.diag([1.0, 0.0]), np.full(2, STILL), np.ones(2), 1.0)
