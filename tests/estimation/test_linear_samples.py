"""Whole samples: the covariance across joints is found and used, and samples that do not fit are put aside."""

import numpy as np
import pytest

from calib.errors import CalibError
from calib.estimation.linear import wls
from calib.estimation.robust import tuning
from calib.estimation.samples import by_joint, gls, irls, row_irls, stack
from calib.estimation.triangles import collect

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


def dense(matrix, target, noise):
    """Return the generalised least-squares estimate and covariance, by the textbook formula."""
    inverse = np.linalg.inv(noise)
    information = np.einsum("kia,ij,kjb->ab", matrix, inverse, matrix)
    cross = np.einsum("kia,ij,kj->a", matrix, inverse, target)
    return np.linalg.solve(information, cross), np.linalg.inv(information)


def test_gls_with_a_stated_covariance_is_the_textbook_formula():
    matrix, target, _ = planted(0)
    found = gls(stack(matrix, target), NOISE)
    values, covariance = dense(matrix, target, NOISE)
    assert found.estimate.values == pytest.approx(values, rel=1e-9)
    assert found.estimate.covariance == pytest.approx(covariance, rel=1e-8)
    assert found.estimate.residual_std == pytest.approx(1.0, abs=0.1)


def test_rows_cut_from_single_joints_are_whitened_with_their_own_part_of_the_covariance():
    matrix, target, _ = planted(1)
    present = np.random.default_rng(1).random(target.shape) < 0.7
    spoilt = np.where(present, target, 1e6)
    found = gls(stack(matrix, spoilt, present), NOISE)
    information, cross = np.zeros((4, 4)), np.zeros(4)
    for w, y, use in zip(matrix, target, present):
        inverse = np.linalg.inv(NOISE[np.ix_(use, use)])
        information += w[use].T @ inverse @ w[use]
        cross += w[use].T @ inverse @ y[use]
    assert found.estimate.values == pytest.approx(np.linalg.solve(information, cross), rel=1e-8)
    assert found.estimate.dof == present.sum() - 4


@pytest.mark.parametrize("fit", [gls, irls])
def test_the_covariance_across_joints_is_found(fit):
    found = fit(stack(*planted(2, 4000)[:2]))
    std = np.sqrt(np.diag(NOISE))
    assert np.abs((found.noise - NOISE) / np.outer(std, std)).max() < 0.08


def test_without_correlation_gls_is_wls():
    rng = np.random.default_rng(3)
    matrix = rng.normal(size=(500, 2, 3))
    target = matrix @ [1.0, 2.0, 3.0] + rng.normal(size=(500, 2)) * [1.0, 4.0]
    data = stack(matrix, target)
    flat = wls(collect(matrix.reshape(-1, 3), target.ravel(), np.tile([0, 1], 500)))
    assert by_joint(data).estimate.values == pytest.approx(flat.estimate.values, rel=1e-9)
    assert np.abs((gls(data).estimate.values - flat.estimate.values) / flat.estimate.sigma).max() < 0.3


def test_correlated_joints_tell_more_together():
    def spread(fit):
        return np.mean([(fit(stack(*planted(s, 100)[:2])).estimate.values - TRUTH) ** 2 for s in range(60)], axis=0)

    gain = spread(by_joint)[:2] / spread(gls)[:2]
    assert np.all(gain > 2.0)  # 1 / (1 - 0.9²) = 5.3 where no other joint tells the same


@pytest.mark.parametrize(
    "loss, gate, seeds",
    [
        ("none", None, 50),
        pytest.param("none", None, 120, marks=pytest.mark.slow),
        pytest.param("huber", 0.999, 120, marks=pytest.mark.slow),
        pytest.param("cauchy", None, 120, marks=pytest.mark.slow),
        pytest.param("none", 0.99, 120, marks=pytest.mark.slow),
    ],
)
def test_the_covariance_of_the_estimate_is_true_on_normal_noise(loss, gate, seeds):
    sizes = []
    for seed in range(seeds):
        found = irls(stack(*planted(seed, 120)[:2]), loss, gate).estimate
        error = found.values - TRUTH
        sizes.append(error @ np.linalg.solve(found.covariance, error))
    assert np.mean(sizes) == pytest.approx(4.0, abs=4 * np.sqrt(8 / seeds) + 0.2)


@pytest.mark.parametrize(
    "loss, gate",
    [("none", 0.999), *(pytest.param(loss, 0.999, marks=pytest.mark.slow) for loss in ("huber", "cauchy"))],
)
def test_ten_percent_of_gross_outliers_are_found_and_do_no_harm(loss, gate):
    harm, clean, sizes = [], [], []
    for seed in range(40):
        matrix, target, bad = planted(seed, 300, 0.1)
        found = irls(stack(matrix, target), loss, gate)
        assert found.outliers[bad].all()
        assert found.outliers[~bad].mean() < 0.02
        error = found.estimate.values - TRUTH
        harm.append(error**2)
        sizes.append(error @ np.linalg.solve(found.estimate.covariance, error))
        clean.append((dense(matrix[~bad], target[~bad], NOISE)[0] - TRUTH) ** 2)
    assert np.mean(harm) < 1.2 * np.mean(clean)
    assert np.mean(sizes) == pytest.approx(4.0, abs=1.8)
    spoilt = gls(stack(matrix, target)).estimate
    assert np.mean((spoilt.values - TRUTH) ** 2) > 20 * np.mean(clean)


def test_outliers_that_leave_each_joint_plausible_are_seen_by_their_combination():
    matrix, target, _ = planted(5, 400)
    target[:20] = matrix[:20] @ TRUTH + [2.2, -2.2, 0.0]  # 2.2 sigma each, ten together, as the joints go in step
    found = irls(stack(matrix, target))
    assert found.outliers[:20].all()
    assert found.outliers[20:].mean() < 0.02


def test_outliers_of_single_joints_are_put_aside_row_by_row():
    matrix, target, _ = planted(6, 400)
    hit = np.random.default_rng(6).random(target.shape) < 0.1
    target = target + 60.0 * hit
    error = row_irls(stack(matrix, target)).estimate.values - TRUTH
    assert np.abs(error).max() < 0.35
    assert np.abs(by_joint(stack(matrix, target)).estimate.values - TRUTH).max() > np.abs(error).max()


def test_the_constants_of_one_joint_are_the_well_known_ones_and_grow_with_the_joints():
    assert tuning(1, "huber") == pytest.approx(1.345, abs=5e-3)
    assert tuning(1, "cauchy") == pytest.approx(2.385, abs=5e-3)
    for loss in ("huber", "cauchy"):
        constants = [tuning(n, loss) for n in range(1, 8)]
        assert np.all(np.diff(constants) > 0)


def test_inflation_widens_the_covariance_and_lowers_the_degrees_of_freedom():
    data = stack(*planted(7)[:2])
    plain, wide = gls(data), gls(data, inflation=4.0)
    assert wide.estimate.covariance == pytest.approx(4.0 * plain.estimate.covariance)
    assert wide.estimate.dof == 225 - 4


def test_wrong_shapes_are_refused():
    matrix, target, _ = planted(8)
    with pytest.raises(CalibError, match=r"rows present: expected an array of shape \(300, 3\)"):
        stack(matrix, target, np.ones(300))
    with pytest.raises(CalibError, match="2 names for 4 columns"):
        stack(matrix, target, names=["a", "b"])
    with pytest.raises(CalibError, match="not finite"):
        stack(matrix, np.where(target == target[5, 1], np.inf, target))
    with pytest.raises(CalibError, match="noise covariance"):
        gls(stack(matrix, target), np.eye(2))
