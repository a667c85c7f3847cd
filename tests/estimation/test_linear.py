"""Linear estimators: what they agree with, whether their covariance is true, and what weighting gains."""

import numpy as np
import pytest
import scipy.linalg
from linear_problems import TRUTH, noisy, rows
from scipy.signal import lfilter

from calib.errors import CalibError, Unidentifiable
from calib.estimation.linear import ols, ridge, settled_std, subsystem_std, wls
from calib.estimation.triangles import collect

STD = np.array([0.1, 1.0, 5.0])


def test_ols_is_least_squares_of_numpy():
    """OLS is the least-squares solution of NumPy, with the textbook covariance."""
    matrix, target, _ = noisy(0, STD)
    fit = ols(collect(matrix, target))
    expected, rss, *_ = np.linalg.lstsq(matrix, target)
    variance = rss[0] / (len(target) - 5)
    assert fit.estimate.values == pytest.approx(expected, rel=1e-10)
    assert fit.estimate.covariance == pytest.approx(variance * np.linalg.inv(matrix.T @ matrix), rel=1e-9)
    assert fit.estimate.residual_std**2 == pytest.approx(variance, rel=1e-10)
    assert fit.estimate.dof == 595
    assert fit.condition == pytest.approx(np.linalg.cond(matrix), rel=1e-9)
    assert fit.condition_normalised == pytest.approx(np.linalg.cond(matrix / np.linalg.norm(matrix, axis=0)), rel=1e-9)


def test_wls_is_ols_of_scaled_rows():
    """WLS is OLS of the rows divided by their standard deviation."""
    matrix, target, group = noisy(1, STD)
    fit = wls(collect(matrix, target, group), STD)
    w = matrix / STD[group][:, None]
    assert fit.estimate.values == pytest.approx(np.linalg.lstsq(w, target / STD[group])[0], rel=1e-10)
    assert fit.estimate.covariance == pytest.approx(np.linalg.inv(w.T @ w), rel=1e-9)
    assert fit.estimate.residual_std == pytest.approx(1.0, abs=0.1)


def test_group_sigmas_reproduce_themselves():
    """Standard deviations of the groups are found and reproduce themselves."""
    matrix, target, group = noisy(2, STD, 6000)
    data = collect(matrix, target, group)
    assert subsystem_std(data) == pytest.approx(STD, rel=0.06)
    settled = settled_std(data)
    fit = wls(data)
    assert settled == pytest.approx(STD, rel=0.06)
    assert fit.group_std == pytest.approx(settled, rel=1e-5)
    assert fit.estimate.residual_std == pytest.approx(1.0, abs=1e-5)


@pytest.mark.slow
def test_settled_sigmas_are_unbiased():
    """Settled standard deviations are unbiased where parameters are many."""
    found = []
    for seed in range(200):
        matrix, target, group = noisy(seed, np.array([1.0, 1.0, 1.0]), 30)
        found.append(settled_std(collect(matrix, target, group)) ** 2)
    mean = np.mean(found)
    assert mean == pytest.approx(1.0, abs=4 * np.std(found) / np.sqrt(600))
    assert 1.0 - 4 * np.std(found) / np.sqrt(600) > 25 / 30  # residuals without their degrees of freedom would fail


@pytest.mark.parametrize(
    "estimate, std", [(ols, np.array([1.0, 1.0, 1.0])), pytest.param(wls, STD, marks=pytest.mark.slow)]
)
def test_covariance_is_true_over_data_sets(estimate, std):
    """The covariance is true over many data sets."""
    sizes = []
    for seed in range(300):
        matrix, target, group = noisy(seed, std, 120)
        found = estimate(collect(matrix, target, group)).estimate
        error = found.values - TRUTH
        sizes.append(error @ np.linalg.solve(found.covariance, error))
    assert np.mean(sizes) == pytest.approx(5.0, abs=4 * np.sqrt(10 / 300) + 0.25)  # F(5, 115) has mean 5.09


@pytest.mark.slow
def test_wls_beats_ols_by_theoretical_share():
    """WLS beats OLS on unlike groups by what theory says."""

    def spread(estimate):
        values = [estimate(collect(*noisy(seed, STD))).estimate.values for seed in range(100)]
        return np.mean((np.array(values) - TRUTH) ** 2, axis=0)

    matrix, _, group = noisy(0, STD)
    w = matrix / STD[group][:, None]
    hat = np.linalg.pinv(matrix)
    promised = np.diag((hat * STD[group] ** 2) @ hat.T) / np.diag(np.linalg.inv(w.T @ w))
    gain = spread(ols) / spread(wls)
    assert promised.min() > 10
    assert np.all((gain > promised / 2) & (gain < promised * 2))


def test_autocorrelation_needs_inflation():
    """Autocorrelated residuals need the inflation, and get a true covariance with it."""
    naive, corrected, phi = [], [], 0.9
    tau = np.array([(1 + phi) / (1 - phi)])
    for seed in range(150):
        rng = np.random.default_rng(seed)
        t = np.arange(2000) / 2000
        matrix = np.column_stack([np.ones(2000), np.sin(6 * t), t])  # slow columns
        target = matrix @ [1.0, 2.0, 3.0] + lfilter([1.0], [1.0, -phi], rng.normal(size=2200))[200:]
        data = collect(matrix, target)
        for fit, sizes in ((ols(data), naive), (ols(data, tau), corrected)):
            error = fit.estimate.values - [1.0, 2.0, 3.0]
            sizes.append(error @ np.linalg.solve(fit.estimate.covariance, error) / 3)
    assert np.mean(naive) > 10
    assert np.mean(corrected) == pytest.approx(1.0, abs=0.3)
    assert fit.estimate.dof == int(2000 / tau[0] - 3)


def test_inflation_scales_covariance_alone():
    """Inflation leaves the values and scales a single group's covariance."""
    data = collect(*noisy(3, STD)[:2])
    plain, inflated = ols(data), ols(data, np.array([4.0]))
    assert np.array_equal(plain.estimate.values, inflated.estimate.values)
    ratio = inflated.estimate.covariance / plain.estimate.covariance
    assert ratio == pytest.approx(4.0 * (600 - 5) / (600 - 20), rel=1e-9)


def test_prior_acts_as_additional_rows():
    """A prior acts as rows of its own, and what it does not know stays free."""
    matrix, target, group = noisy(4, STD)
    mean, width = np.full(5, 0.7), np.array([0.1, np.inf, 0.5, 0.01, np.inf])
    fit = ridge(collect(matrix, target, group), mean, np.diag(width**2), STD)
    extra = np.diag(1 / width)
    w, y = np.vstack([matrix / STD[group][:, None], extra]), np.concatenate([target / STD[group], extra @ mean])
    assert fit.estimate.values == pytest.approx(np.linalg.lstsq(w, y)[0], rel=1e-9)
    assert fit.estimate.covariance == pytest.approx(np.linalg.inv(w.T @ w), rel=1e-9)


def test_prior_leaves_the_sum_to_the_data():
    """A prior makes an unidentifiable problem solvable, and leaves the sum to the data."""
    rng = np.random.default_rng(5)
    column = rng.normal(size=(50, 1))
    data = collect(np.hstack([column, column]), column[:, 0] * 3.0 + rng.normal(0, 0.01, 50))
    values = ridge(data, np.array([0.0, 1.0]), np.eye(2), np.array([0.01])).estimate.values
    assert values == pytest.approx([1.0, 2.0], abs=0.01)


@pytest.mark.parametrize(("column", "named"), [(3, ("XX1", "Fv1", "Fc1")), (1, ("MX2",))])
def test_dependent_or_idle_columns_are_named(column, named):
    """Dependent columns and those without effect are named, and only they."""
    matrix, target, _ = noisy(6, STD)
    matrix[:, column] = 2 * matrix[:, 0] - matrix[:, 2] if column == 3 else 0.0
    with pytest.raises(Unidentifiable, match="base") as caught:
        ols(collect(matrix, target, names=["XX1", "MX2", "Fv1", "Fc1", "Ia1"]))
    assert caught.value.names == named


def test_few_rows_nan_and_shapes_are_refused():
    """Too few rows, NaN and wrong shapes are refused."""
    matrix, group = rows(0)
    with pytest.raises(Unidentifiable):
        ols(collect(matrix[:4], np.ones(4)))
    with pytest.raises(Unidentifiable, match="no residual is left"):
        ols(collect(matrix[:5], np.ones(5)))
    with pytest.raises(CalibError, match=r"shape \(600"):
        collect(matrix, np.ones(599), group)
    with pytest.raises(CalibError, match="not finite"):
        collect(np.where(matrix == matrix[7, 1], np.nan, matrix), np.ones(600))
    with pytest.raises(CalibError, match="group 1 has 4 rows"):
        wls(collect(matrix[:100], np.ones(100), np.r_[np.zeros(96, int), np.ones(4, int)]))
    with pytest.raises(CalibError, match="positive"):
        wls(collect(matrix, np.ones(600), group), np.array([1.0, 0.0, 1.0]))


def test_ill_conditioning_keeps_qr_accuracy():
    """An ill-conditioned but regular problem is solved to QR accuracy."""
    matrix = scipy.linalg.hilbert(8)[:, :6] @ np.diag(10.0 ** np.arange(6))
    stacked = np.vstack([matrix] * 5)
    fit = ols(collect(stacked, stacked @ np.ones(6)))  # the normal equations would keep no digit
    assert fit.estimate.values == pytest.approx(np.ones(6), abs=1e-7)


def test_correlation_asks_for_another_model():
    """Correlated residuals ask for another model, not for more rows."""
    data = collect(*noisy(3, np.ones(3)))
    with pytest.raises(Unidentifiable, match="swapped columns"):
        wls(data, inflation=np.array([400.0, 1.0, 1.0]))
