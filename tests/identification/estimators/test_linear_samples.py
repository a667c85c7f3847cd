"""Whole samples: the covariance across joints is found and used, and samples that do not fit are put aside."""

import numpy as np
import pytest

from calib.errors import CalibError
from calib.estimation.linear import wls
from calib.estimation.triangles import collect
from calib.identification.methods.samples import irls, row_irls, stack, tuning

NOISE = np.array([[1.0, 0.9, 0.0], [0.9, 1.0, 0.0], [0.0, 0.0, 25.0]])
TRUTH = np.array([1.0, -2.0, 0.5, 3.0])


def planted(seed: int, count: int = 300, outliers: float = 0.0, size: float = 100.0):
    """Return W (N, 3, 4), y (N, 3) with noise NOISE, and which samples were spoilt."""
    rng = np.random.default_rng(seed)
    matrix = rng.normal(size=(count, 3, 4))
    matrix[:, 2, :2] = 0.0
    target = matrix @ TRUTH + rng.normal(size=(count, 3)) @ np.linalg.cholesky(NOISE).T
    bad = rng.random(count) < outliers
    target[bad] += size * (1.0 + rng.random((bad.sum(), 3)))  # all to one side: least squares is biased
    return matrix, target, bad


def test_formula_uses_estimated_weights():
    """Rows cut from single joints are whitened with their own part of the covariance."""
    matrix, target, _ = planted(1)
    present = np.random.default_rng(1).random(target.shape) < 0.7
    found = irls(stack(matrix, np.where(present, target, 1e6), present))
    information, cross = np.zeros((4, 4)), np.zeros(4)
    for w, y, use, weight in zip(matrix, target, present, found.weights):
        inverse = weight * np.linalg.inv(found.noise[np.ix_(use, use)])
        information += w[use].T @ inverse @ w[use]
        cross += w[use].T @ inverse @ y[use]
    assert found.estimate.values == pytest.approx(np.linalg.solve(information, cross), rel=1e-8)
    assert found.estimate.dof == present[found.weights > 0].sum() - 4


def test_covariance_across_joints_is_found():
    """The covariance across joints is found."""
    found = irls(stack(*planted(2, 4000)[:2]))
    std = np.sqrt(np.diag(NOISE))
    assert np.abs((found.noise - NOISE) / np.outer(std, std)).max() < 0.08


def by_joint(data):
    """Return the least squares of all rows, one converged variance per joint."""
    rows = (data.matrix.reshape(-1, data.matrix.shape[2]), data.target.ravel())
    return wls(collect(*rows, np.tile(np.arange(data.target.shape[1]), len(data.target))))


@pytest.mark.slow
def test_correlated_joints_tell_more():
    """Correlated joints tell more together."""

    def spread(fit):
        return np.mean([(fit(stack(*planted(s, 100)[:2])).estimate.values - TRUTH) ** 2 for s in range(60)], axis=0)

    gain = spread(by_joint)[:2] / spread(irls)[:2]
    assert np.all(gain > 2.0)  # 1 / (1 - 0.9²) = 5.3 where no other joint tells the same


@pytest.mark.parametrize("seeds", [pytest.param(50, marks=pytest.mark.slow), pytest.param(120, marks=pytest.mark.slow)])
def test_covariance_is_true_on_normal_noise(seeds):
    """The covariance of the estimate is true on normal noise."""
    sizes = []
    for seed in range(seeds):
        found = irls(stack(*planted(seed, 120)[:2])).estimate
        error = found.values - TRUTH
        sizes.append(error @ np.linalg.solve(found.covariance, error))
    assert np.mean(sizes) == pytest.approx(4.0, abs=4 * np.sqrt(8 / seeds) + 0.2)


@pytest.mark.slow
def test_ten_percent_outliers_do_no_harm():
    """Ten percent of gross outliers are found, and do no harm."""
    harm, clean, sizes = [], [], []
    root = np.linalg.inv(np.linalg.cholesky(NOISE))
    for seed in range(40):
        matrix, target, bad = planted(seed, 300, 0.1)
        found = irls(stack(matrix, target))
        assert found.outliers[bad].all()
        assert found.outliers[~bad].mean() < 0.02
        error = found.estimate.values - TRUTH
        harm.append(error**2)
        sizes.append(error @ np.linalg.solve(found.estimate.covariance, error))
        w, y = (root @ matrix[~bad]).reshape(-1, 4), (target[~bad] @ root.T).ravel()
        clean.append((np.linalg.lstsq(w, y)[0] - TRUTH) ** 2)
    assert np.mean(harm) < 1.2 * np.mean(clean)
    assert np.mean(sizes) == pytest.approx(4.0, abs=1.8)
    spoilt = by_joint(stack(matrix, target)).estimate
    assert np.mean((spoilt.values - TRUTH) ** 2) > 20 * np.mean(clean)


def test_outliers_show_by_their_combination():
    """Outliers that leave each joint plausible are seen by their combination."""
    matrix, target, _ = planted(5, 400)
    target[:20] = matrix[:20] @ TRUTH + [2.2, -2.2, 0.0]  # 2.2 sigma each, ten together, as the joints go in step
    found = irls(stack(matrix, target))
    assert found.outliers[:20].all()
    assert found.outliers[20:].mean() < 0.02


def test_single_joint_outliers_go_by_row():
    """Outliers of single joints are put aside row by row."""
    matrix, target, _ = planted(6, 400)
    hit = np.random.default_rng(6).random(target.shape) < 0.1
    target = target + 60.0 * hit
    error = row_irls(stack(matrix, target)).estimate.values - TRUTH
    assert np.abs(error).max() < 0.35
    assert np.abs(by_joint(stack(matrix, target)).estimate.values - TRUTH).max() > np.abs(error).max()


def test_constant_grows_with_the_joints():
    """The constant of one joint is the well-known one, and grows with the joints."""
    assert tuning(1) == pytest.approx(1.345, abs=5e-3)
    assert np.all(np.diff([tuning(n) for n in range(1, 8)]) > 0)


def test_inflation_widens_covariance():
    """Inflation widens the covariance and lowers the degrees of freedom."""
    data = stack(*planted(7)[:2])
    plain, wide = irls(data), irls(data, inflation=4.0)
    assert wide.estimate.covariance == pytest.approx(4.0 * plain.estimate.covariance)
    assert wide.estimate.dof == (plain.estimate.dof + 4) // 4 - 4


def test_wrong_shapes_are_refused():
    matrix, target, _ = planted(8)
    with pytest.raises(CalibError, match=r"rows present: expected an array of shape \(300, 3\)"):
        stack(matrix, target, np.ones(300))
    with pytest.raises(CalibError, match="2 names for 4 columns"):
        stack(matrix, target, names=["a", "b"])
    with pytest.raises(CalibError, match="not finite"):
        stack(matrix, np.where(target == target[5, 1], np.inf, target))
