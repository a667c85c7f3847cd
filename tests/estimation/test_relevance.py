"""Automatic relevance determination: a planted sparse model is found, the rest is switched off."""

import numpy as np
import pytest

from calib.estimation.relevance import Gram, condensed, gram, relevance

NOISE = 0.05


def planted(seed: int, rows: int = 300) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return W (rows, 44), y, groups and the truth: 4 free columns, 20 groups of two, of which 3 matter."""
    rng = np.random.default_rng(seed)
    matrix = rng.normal(size=(rows, 44))
    groups = np.concatenate([np.full(4, -1), np.repeat(np.arange(20), 2)])
    truth = np.zeros(44)
    truth[:4] = rng.normal(size=4)
    for group in (2, 7, 13):
        truth[groups == group] = rng.choice([-1, 1], 2) * rng.uniform(0.3, 1.0, 2)
    return matrix, matrix @ truth + NOISE * rng.normal(size=rows), groups, truth


@pytest.mark.parametrize("seed", range(10))
def test_planted_groups_alone_stay_on(seed):
    """Planted groups are found, and nearly all others are switched off."""
    matrix, y, groups, truth = planted(seed)
    found = relevance(gram(y, matrix), groups, np.full(44, 0.1), iterations=60)
    on = {int(g) for g in groups[(found.ridge > 0) & (groups >= 0)]}
    assert {2, 7, 13} <= on
    assert len(on) <= 3 + 8  # a fixed point keeps a group whose chance correlation exceeds its expectation
    assert np.all(found.values[found.ridge == 0] == 0.0)
    assert np.abs(found.values - truth).max() < 6 * NOISE / np.sqrt(300)
    assert np.all(np.isinf(found.ridge[:4]))
    assert found.noise == pytest.approx(NOISE, rel=0.15)
    assert 6 - 0.5 < found.effective < 6 + 2 * 8


def test_errs_less_than_ols_on_all_columns():
    """Relevance errs less than least squares on all columns."""
    ours, plain = [], []
    for seed in range(20):
        matrix, y, groups, truth = planted(seed, rows=80)
        found = relevance(gram(y, matrix), groups, np.full(44, 0.1), iterations=40)
        ours.append(np.sum((found.values - truth) ** 2))
        plain.append(np.sum((np.linalg.lstsq(matrix, y, rcond=None)[0] - truth) ** 2))
    assert np.mean(ours) < 0.5 * np.mean(plain)


def test_pure_noise_leaves_next_to_nothing():
    effective = []
    for seed in range(20):
        rng = np.random.default_rng(1000 + seed)
        matrix = rng.normal(size=(300, 40))
        found = relevance(gram(rng.normal(size=300), matrix), np.repeat(np.arange(20), 2), np.full(40, 0.1), 60)
        effective.append(found.effective)
        assert found.noise == pytest.approx(1.0, rel=0.2)
    assert np.mean(effective) < 0.25 * 40


def test_one_iteration_is_ridge_posterior():
    """One iteration is the ridge posterior of the given sizes."""
    matrix, y, groups, _ = planted(3)
    size = np.random.default_rng(0).uniform(0.2, 0.3)
    found = relevance(gram(y, matrix), groups, np.full(44, size), iterations=1)
    penalty = np.where(groups >= 0, size**-2.0, 0.0)
    posterior = np.linalg.solve(matrix.T @ matrix + np.diag(penalty), matrix.T @ y)
    assert found.values[found.ridge > 0] == pytest.approx(posterior[found.ridge > 0], rel=1e-9)
    variance = np.diag(np.linalg.inv(matrix.T @ matrix + np.diag(penalty)))
    assert found.effective == pytest.approx(np.sum(1 - penalty[4:] * variance[4:]), rel=1e-9)


def test_the_fixed_point_is_reached():
    """λ = γ / |x|² and the noise are consistent with each other at the end (MacKay 1992)."""
    matrix, y, groups, _ = planted(4)
    found = relevance(gram(y, matrix), groups, np.full(44, 0.1), iterations=400)
    alive = np.flatnonzero(found.ridge > 0)
    penalty = np.where(np.isfinite(found.ridge[alive]), found.ridge[alive] ** -2.0, 0.0)
    system = matrix[:, alive].T @ matrix[:, alive] / found.noise**2 + np.diag(penalty)
    values = np.linalg.solve(system, matrix[:, alive].T @ y / found.noise**2)
    assert found.values[alive] == pytest.approx(values, abs=1e-6)
    gamma = 1 - penalty * np.diag(np.linalg.inv(system))
    for group in np.unique(groups[alive][groups[alive] >= 0]):
        own = groups[alive] == group
        # 1/λ = |x|²/γ; slow where a group is barely alive, hence compared on what the data see of it
        assert gamma[own].sum() * found.ridge[alive][own][0] ** 2 == pytest.approx(np.sum(values[own] ** 2), rel=0.02)
    misfit = np.sum((y - matrix[:, alive] @ values) ** 2)
    assert found.noise**2 == pytest.approx(misfit / (300 - (gamma[penalty > 0]).sum() - 4), rel=1e-3)


def test_without_ridges_it_is_least_squares():
    matrix, y, _, _ = planted(5)
    found = relevance(gram(y, matrix), np.full(44, -1), np.ones(44))
    assert found.values == pytest.approx(np.linalg.lstsq(matrix, y, rcond=None)[0], rel=1e-8, abs=1e-10)
    assert found.effective == 0.0 and np.all(np.isinf(found.ridge))


def test_units_of_a_group_do_not_matter():
    matrix, y, groups, _ = planted(6)
    factor = np.where(groups == 7, 1e4, np.where(groups == 2, 1e-3, 1.0))
    one = relevance(gram(y, matrix), groups, np.full(44, 0.1), iterations=200)
    other = relevance(gram(y, matrix * factor), groups, np.full(44, 0.1) / factor, iterations=200)
    assert other.values * factor == pytest.approx(one.values, abs=1e-6)


def test_statistics_add_up():
    matrix, y, _, _ = planted(7)
    whole, parts = gram(y, matrix), gram(y[:100], matrix[:100]) + gram(y[100:], matrix[100:])
    assert isinstance(parts, Gram) and parts.rows == whole.rows
    for name in ("square", "cross", "total"):
        assert getattr(parts, name) == pytest.approx(getattr(whole, name), abs=1e-9)


def test_condensed_columns_give_the_same():
    """Harmonics of two joints that turn by a third of a turn, beside three free columns; the prior falls with order."""
    rng = np.random.default_rng(8)
    order = np.arange(1, 31)
    turns = [
        np.concatenate([np.cos(q[:, None] * order), np.sin(q[:, None] * order)], 1)
        for q in rng.uniform(-1, 1, (2, 400))
    ]
    matrix = np.concatenate([rng.normal(size=(400, 3)), *turns], axis=1)
    groups = np.repeat([-1, 0, 1], [3, 60, 60])
    fall = np.concatenate([np.ones(3), np.tile(1.0 / order, 4)])
    y = matrix @ (fall * rng.normal(size=123)) + NOISE * rng.normal(size=400)
    data, size = gram(y, matrix), np.exp(np.log(1.0 / order).mean())
    few = condensed(lambda own: data.square[np.ix_(own, own)], groups, fall)
    found = relevance(few.gram(data), few.groups, few.sizes, 30, counts=few.counts)
    profile = np.where(groups < 0, 1.0, fall / size)
    every = relevance(gram(y, matrix * profile), groups, np.full(123, size), 30)
    assert len(few.groups) <= 0.5 * len(groups)
    assert found.effective == pytest.approx(every.effective, rel=1e-6)
    assert found.noise == pytest.approx(every.noise, rel=1e-6)
    assert few.columns(matrix.T).T @ found.values == pytest.approx(matrix @ (profile * every.values), abs=1e-6)
