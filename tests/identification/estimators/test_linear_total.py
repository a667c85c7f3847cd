"""Total least squares: the analytic solution, exact columns, its covariance, drive gains with a known payload."""

import numpy as np
import pytest

from calib.errors import CalibError, Unidentifiable
from calib.estimation.linear import ols
from calib.estimation.triangles import collect
from calib.identification.methods.estimators import tls

TRUTH = np.array([2.0, -1.0, 0.5])
NOISE = np.array([0.0, 0.2, 0.3, 0.1])  # the first column is exact


def planted(seed: int, count: int = 400, noise: np.ndarray = NOISE, scale: float = 1.0):
    rng = np.random.default_rng(seed)
    clean = rng.normal(size=(count, 3)) @ np.array([[1.0, 0.3, 0.0], [0.0, 1.0, 0.5], [0.0, 0.0, 1.0]])
    spoilt = np.column_stack([clean, clean @ TRUTH]) + scale * noise * rng.normal(size=(count, 4))
    return spoilt[:, :3], spoilt[:, 3]


def test_equal_noise_gives_singular_vector():
    """With noise alike in all columns the estimate is the smallest singular vector."""
    matrix, target = planted(1)
    v = np.linalg.svd(np.column_stack([matrix, target]))[2][-1]
    assert tls(collect(matrix, target), np.ones(4)).estimate.values == pytest.approx(-v[:3] / v[3], rel=1e-9)


def test_noise_in_y_alone_is_ols():
    """With noise in y alone, the estimate is ordinary least squares with its covariance."""
    matrix, target = planted(2)
    data = collect(matrix, target)
    total, ordinary = tls(data, np.array([0.0, 0.0, 0.0, 1.0])).estimate, ols(data).estimate
    assert total.values == pytest.approx(ordinary.values, rel=1e-9)
    assert total.covariance == pytest.approx(ordinary.covariance, rel=1e-8)


def test_unlike_noise_minimises_the_distance():
    """Exact columns and unlike noise minimise the stated distance."""
    matrix, target = planted(3)
    found = tls(collect(matrix, target), NOISE).estimate.values

    def distance(x):  # Σ over rows of (y - w x)² / (σ_y² + Σ σ_c² x_c²), the distance with the best corrections
        return np.sum((target - matrix @ x) ** 2) / (NOISE[3] ** 2 + NOISE[:3] ** 2 @ x**2)

    best = distance(found)
    rng = np.random.default_rng(3)
    assert all(distance(found + 1e-3 * rng.normal(size=3)) > best for _ in range(50))


def test_scaled_columns_scale_values_only():
    """Scaling columns and their noise scales the values only."""
    matrix, target = planted(4)
    scale = np.array([10.0, 1e-3, 1e4])
    plain = tls(collect(matrix, target), NOISE).estimate
    scaled = tls(collect(matrix * scale, target), NOISE * np.append(scale, 1.0)).estimate
    assert scaled.values * scale == pytest.approx(plain.values, rel=1e-8)
    assert scaled.covariance * np.outer(scale, scale) == pytest.approx(plain.covariance, rel=1e-6)


@pytest.mark.slow
def test_tls_is_unbiased_unlike_ols():
    """Total least squares is unbiased where least squares is not, and its covariance is true."""
    errors, sizes, naive = [], [], []
    for seed in range(300):
        data = collect(*planted(seed))
        found = tls(data, NOISE).estimate
        errors.append(found.values - TRUTH)
        sizes.append(errors[-1] @ np.linalg.solve(found.covariance, errors[-1]))
        naive.append(ols(data).estimate.values - TRUTH)
    standard = np.std(errors, axis=0) / np.sqrt(300)
    assert np.all(np.abs(np.mean(errors, axis=0)) < 4 * standard + 2e-3)
    assert np.abs(np.mean(naive, axis=0)).max() > 20 * standard.max()
    assert np.mean(sizes) == pytest.approx(3.0, abs=4 * np.sqrt(6 / 300) + 0.15)


def test_the_common_noise_level_is_found():
    found = tls(collect(*planted(5, 4000, scale=0.5)), NOISE).estimate
    assert found.residual_std == pytest.approx(0.5, rel=0.05)


def test_rows_of_unlike_noise_weigh_by_it():
    errors = {"weighted": [], "plain": []}
    ratio = np.array([1.0, 10.0])
    for seed in range(60):
        rng = np.random.default_rng(seed)
        group = np.repeat([0, 1], 200)
        clean = rng.normal(size=(400, 3))
        whole = np.column_stack([clean, clean @ TRUTH]) + 0.05 * ratio[group][:, None] * rng.normal(size=(400, 4))
        data = collect(whole[:, :3], whole[:, 3], group)
        errors["weighted"].append(tls(data, np.full(4, 0.05), ratio).estimate.values - TRUTH)
        errors["plain"].append(tls(data, np.full(4, 0.05)).estimate.values - TRUTH)
    assert np.mean(np.square(errors["plain"])) > 10 * np.mean(np.square(errors["weighted"]))


def test_gains_come_from_a_payload():
    """[V -W] [g; χ] = y with measured currents V and motion W, y the payload's known torque (Gautier & Briot 2014)."""
    rng = np.random.default_rng(8)
    gains, links, sigma = np.array([50.0, 20.0]), np.array([8.0, 1.5, 3.0]), 0.01
    blocks, loads = [], []
    for loaded in (0.0, 1.0):
        motion = rng.normal(size=(2, 1500, 3))
        load = loaded * (4.0 * motion[:, :, 1] + 2.0 * rng.normal(size=(2, 1500)))
        for j in range(2):
            currents = np.zeros((1500, 2))
            currents[:, j] = (motion[j] @ links + load[j]) / gains[j]
            currents[:, j] += sigma * rng.normal(size=1500)
            blocks.append(np.hstack([currents, -(motion[j] + sigma * rng.normal(size=(1500, 3)))]))
            loads.append(load[j] + sigma * rng.normal(size=1500))
    noise = np.full(6, sigma)
    matrix, target = np.vstack(blocks), np.concatenate(loads)
    group = np.repeat([0, 1, 0, 1], 1500)
    row = sigma * np.sqrt(gains**2 + links @ links + 1.0)  # joint rows differ by what their current's noise means
    found = tls(collect(matrix, target, group), noise, row / row[0]).estimate
    assert np.abs(found.values - np.concatenate([gains, links])).max() < 0.3
    assert found.values[:2] == pytest.approx(gains, rel=0.01)
    naive = ols(collect(matrix, target)).estimate.values
    assert np.abs(naive[:2] / gains - 1).max() > 3 * np.abs(found.values[:2] / gains - 1).max()


def test_columns_of_noise_only_are_refused():
    """Columns that hold noise only are refused by name."""
    rng = np.random.default_rng(9)
    clean = rng.normal(size=400)
    matrix = np.column_stack([clean, np.zeros(400)]) + 0.1 * rng.normal(size=(400, 2))
    with pytest.raises(Unidentifiable, match="noise"):
        tls(collect(matrix, clean + 0.1 * rng.normal(size=400), names=["a", "b"]), np.full(3, 0.1))


def test_degenerate_problems_are_refused():
    """A y that no column needs, dependent exact columns and wrong noise are refused."""
    matrix, target = planted(10)
    with pytest.raises(CalibError, match=r"shape \(4\)"):
        tls(collect(matrix, target), np.ones(3))
    with pytest.raises(CalibError, match="negative"):
        tls(collect(matrix, target), np.array([1.0, 1.0, -1.0, 1.0]))
    twice = np.column_stack([matrix[:, 0], matrix[:, 0], matrix[:, 1]])
    with pytest.raises(Unidentifiable, match="columns without noise"):
        tls(collect(twice, target), np.array([0.0, 0.0, 1.0, 1.0]))


def test_repeated_rows_widen_the_covariance():
    """Every error stands for four rows: with each of them counted as news, the intervals are half as wide."""
    away = {1.0: [], 4.0: []}
    for seed in range(60):
        rng = np.random.default_rng(seed)
        clean = np.repeat(rng.normal(size=(100, 3)), 4, axis=0) @ np.array([[1.0, 0.3, 0], [0, 1.0, 0.5], [0, 0, 1.0]])
        error = np.repeat(rng.normal(size=(100, 4)), 4, axis=0) * NOISE
        spoilt = np.column_stack([clean, clean @ TRUTH]) + error
        for tau, each in away.items():
            found = tls(collect(spoilt[:, :3], spoilt[:, 3]), NOISE, inflation=np.array([tau])).estimate
            each.append((found.values - TRUTH) / found.sigma)
    assert np.std(away[1.0]) > 1.6
    assert 0.8 < np.std(away[4.0]) < 1.25
