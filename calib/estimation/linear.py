"""Least squares of y = W x + ρ from R factors of [W y]: ordinary, weighted per group of rows, and with a prior.

Covariances are those of the stated noise model. Filtered and decimated residuals are autocorrelated, and a covariance
that counts every row as independent is then too small. The variance inflation corrects it: group g counts as rows_g /
inflation_g independent rows. Inflation is the integrated autocorrelation 1 + 2 Σ ρ_k of the residuals
(`whiteness.inflation`), or the sampling rate over twice the filter's bandwidth. The correction is exact for columns
that vary slowly compared with the residuals, and conservative for other columns. The estimated values do not depend on
inflation.
"""

from dataclasses import dataclass

import numpy as np
import scipy.linalg

from calib.errors import CalibError, NotConverged, Unidentifiable
from calib.estimation.base_columns import split_columns
from calib.estimation.estimate import Estimate
from calib.estimation.triangles import Triangles, combine, retriangulate, solve_triangle
from calib.records import Frozen, shaped

# relative size below which a group's column depends on its others
RANK_TOLERANCE = 1e-8
# smallest standard deviation of a group, relative to the largest
MIN_STD = 1e-9


@dataclass(frozen=True, eq=False)
class LinearFit(Frozen):
    """Linear least-squares estimate with residual standard deviations per group and condition numbers.

    Attributes:
        estimate: values, covariance, standard deviation of the weighted residuals, degrees of freedom.
        group_std: (g,) standard deviation of the residuals of each group, in units of y.
        condition: condition number of the weighted W, columns in the parameters' units.
        condition_normalised: condition number of the weighted W with columns scaled to unit norm.
    """

    estimate: Estimate
    group_std: np.ndarray
    condition: float
    condition_normalised: float


def ols(data: Triangles, inflation: np.ndarray | None = None) -> LinearFit:
    """Estimate x = argmin ‖y - W x‖² with covariance σ² (WᵀW)⁻¹, σ² = ‖ρ‖² / (r - p), by ordinary least squares.

    This covariance is correct if the noise of y has the same standard deviation in all groups of rows; otherwise use
    `wls`.

    Args:
        data: R factors of [W y], W (r, p) the observation matrix and y (r,) the measured values; ρ are the residuals.
        inflation: (g,) variance inflation >= 1 of each group, explained in the module's docstring; None: every row is
            independent.

    Raises:
        Unidentifiable: for dependent columns, or too few rows to estimate the residuals' variance.
    """
    return _fit(data, np.ones(data.groups), inflation, stated=False)


def wls(data: Triangles, std: np.ndarray | None = None, inflation: np.ndarray | None = None) -> LinearFit:
    """Estimate x = (Wᵀ R⁻¹ W)⁻¹ Wᵀ R⁻¹ y with R = diag(σ_g² I) and covariance (Wᵀ R⁻¹ W)⁻¹, by weighted least squares.

    Kolyubin et al. (2019), eq. 22 and 25; the RSD of eq. 26 is ``fit.estimate.rsd``.

    Args:
        data: R factors of [W y], W (r, p) the observation matrix and y (r,) the measured values, with one group of rows
            per standard deviation.
        std: (g,) noise standard deviation σ_g of each group in units of y; None: `settled_std`. Kolyubin et al. use
            `subsystem_std`.
        inflation: (g,) variance inflation >= 1 of each group, explained in the module's docstring; None: every row is
            independent.

    Raises:
        Unidentifiable: for dependent columns, or too few rows to estimate the residuals' variance.
    """
    if std is None:
        std = settled_std(data)
    return _fit(data, np.asarray(std, dtype=float), inflation, stated=True)


def ridge(data: Triangles, mean: np.ndarray, covariance: np.ndarray, std: np.ndarray | None = None) -> LinearFit:
    """Estimate x from the data and a prior x ~ N(mean, covariance), by QR of [R; L⁻¹] with L Lᵀ = covariance.

    The covariance of the result is that of the posterior; its condition numbers are those of data and prior together.

    Args:
        data: R factors of [W y], W (r, p) the observation matrix and y (r,) the measured values.
        mean: (p,) prior mean.
        covariance: (p, p) prior covariance; an infinite diagonal entry means no prior knowledge of that parameter.
        std: (g,) noise standard deviation of each group in units of y; None: `settled_std`, for which the data alone
            must identify x.

    Raises:
        Unidentifiable: for columns that neither data nor prior determine, or too few rows to estimate the residuals'
            variance.
    """
    p = data.parameters
    mean = shaped(mean, (p,), "prior mean")
    with_prior = np.flatnonzero(np.isfinite(np.diag(covariance)))
    prior = np.asarray(covariance)[np.ix_(with_prior, with_prior)]
    root = np.linalg.cholesky(shaped(prior, (None, None), "prior covariance"))
    rows = np.zeros((len(with_prior), p + 1))
    rows[:, with_prior] = scipy.linalg.solve_triangular(root, np.eye(len(root)), lower=True)
    rows[:, p] = rows[:, :p] @ mean
    if std is None:
        std = settled_std(data)
    sigma = np.asarray(std, dtype=float)
    factor = retriangulate(np.vstack([combine(data, sigma), rows]))
    values, inverse, conditions = solve_triangle(factor, data.names)
    return _pack(data, values, inverse @ inverse.T, sigma, np.ones(data.groups), inverse, conditions)


def subsystem_std(data: Triangles) -> np.ndarray:
    """Return the residual standard deviation σ_g (g,) of each group fitted alone, σ_g² = ‖ρ_g‖² / (r_g - rank W_g).

    Kolyubin et al. (2019), after eq. 22.

    Args:
        data: R factors of [W y] (observation matrix and measured values), one group g with r_g rows per standard
            deviation; ρ_g are the group's residuals in units of y.

    Raises:
        CalibError: for a group with no more rows than independent columns.
    """
    p = data.parameters
    result = np.empty(data.groups)
    for g, factor in enumerate(data.factors):
        columns = split_columns(factor[:, :p], tolerance=RANK_TOLERANCE).kept
        if data.rows[g] <= len(columns):
            raise CalibError(
                f"group {g} has {data.rows[g]} rows for its {len(columns)} independent columns: no residual is left "
                "for its noise; state the standard deviations"
            )
        residual = retriangulate(factor[:, np.append(columns, p)])[-1, -1]
        result[g] = abs(residual) / np.sqrt(data.rows[g] - len(columns))
    return _floored(result)


def settled_std(data: Triangles, tolerance: float = 1e-6, limit: int = 200) -> np.ndarray:
    """Return the noise standard deviations σ_g (g,) of the groups at which weighted least squares is self-consistent.

    At this fixed point σ_g² = ‖y_g - W_g x‖² / (r_g - h_g), where x is the WLS estimate with weights 1 / σ_g² and the
    leverage h_g = ‖W_g R⁻¹‖² / σ_g² is the group's share of the p parameters. It is the restricted maximum likelihood
    estimate (Patterson & Thompson 1971). The iteration starts from `subsystem_std`.

    Args:
        data: R factors of [W y], W (r, p) the observation matrix and y (r,) the measured values; a group g has r_g
            rows.
        tolerance: largest relative change of any σ_g at which the iteration ends.
        limit: largest number of iterations.

    Raises:
        NotConverged: if the standard deviations still change after `limit` iterations.
    """
    std = subsystem_std(data)
    change = np.inf
    for _ in range(limit):
        values, inverse, _ = solve_triangle(combine(data, std), data.names)
        dof = data.rows - leverage(data, std, inverse)
        updated = _floored(np.sqrt(data.residual_squares(values) / np.maximum(dof, 1e-9)))
        change = float(np.max(np.abs(updated / std - 1.0)))
        std = updated
        if change < tolerance:
            return std
    raise NotConverged(
        f"the standard deviations of the groups still change by {change:.1g} after {limit} rounds; a group with few "
        "rows may be fitted exactly; state the standard deviations",
        std,
    )


def _fit(data: Triangles, std: np.ndarray, inflation: np.ndarray | None, stated: bool) -> LinearFit:
    """Return the weighted least-squares fit with the rows of group g divided by std[g].

    Args:
        data: R factors of [W y].
        std: (g,) noise standard deviations of the groups of rows, in units of y.
        inflation: (g,) variance inflation of each group; None: 1.
        stated: whether `std` is the noise itself; if not, only its proportions are used and the residuals give the
            scale of the covariance.
    """
    values, inverse, conditions = solve_triangle(combine(data, std), data.names)
    covariance = inverse @ inverse.T
    tau = np.ones(data.groups)
    if inflation is not None:
        tau = shaped(inflation, (data.groups,), "inflation per group")
        # the sum over rows counts those of group g τ_g times
        scale = (np.sqrt(tau) / std)[:, None, None]
        spread = (data.factors[:, :, :-1] @ inverse * scale).reshape(-1, len(inverse))
        covariance = inverse @ (spread.T @ spread) @ inverse.T
    fit = _pack(data, values, covariance, std, tau, inverse, conditions)
    if stated:
        return fit
    scaled = covariance * fit.estimate.residual_std**2
    return _pack(data, values, scaled, std, tau, inverse, conditions)


def _pack(
    data: Triangles,
    values: np.ndarray,
    covariance: np.ndarray,
    std: np.ndarray,
    tau: np.ndarray,
    inverse: np.ndarray,
    conditions: tuple[float, float],
) -> LinearFit:
    """Return the fit with residual standard deviations and degrees of freedom, both corrected for variance inflation.

    Args:
        data: R factors of [W y].
        values, covariance: (p,) estimate and its (p, p) covariance.
        std, tau: (g,) noise standard deviation (in units of y) and variance inflation of each group of rows.
        inverse: (p, p) R⁻¹ of the weighted W.
        conditions: condition numbers of the weighted W, as it is and with unit-norm columns.

    Raises:
        Unidentifiable: if no degrees of freedom remain.
    """
    squares = data.residual_squares(values)
    group_dof = data.rows - tau * leverage(data, std, inverse)
    dof = int(np.round(np.sum(group_dof / tau), 6))
    if dof <= 0 or group_dof.sum() <= 0:
        independent = float(np.sum(data.rows / tau))
        advice = "record longer or estimate fewer parameters"
        # the rows would do: their residuals are no noise
        if independent > data.parameters:
            advice = (
                "the residuals of neighbouring rows are strongly correlated, as with another robot's model or "
                "swapped columns; check both, then record longer"
            )
        raise Unidentifiable(
            f"{int(data.rows.sum())} rows ({independent:.0f} independent ones) for {data.parameters} "
            f"parameters: no residual is left to check them; {advice}",
            data.names,
        )
    residual_std = float(np.sqrt(np.sum(squares / std**2) / group_dof.sum()))
    group_std = np.sqrt(squares / np.maximum(group_dof, 1e-9))
    estimate = Estimate(data.names, data.units, values, covariance, residual_std, dof)
    return LinearFit(estimate, group_std, *conditions)


def leverage(data: Triangles, std: np.ndarray, inverse: np.ndarray) -> np.ndarray:
    """Return the leverage h_g = ‖W_g R⁻¹‖² / σ_g² (g,) of each group; the leverages of all groups sum to p.

    Args:
        data: R factors of [W y], W_g being the rows of group g of the observation matrix W.
        std: (g,) standard deviations σ_g of the groups, in units of y.
        inverse: (p, p) R⁻¹ of the weighted W.
    """
    whitened = data.factors[:, :, :-1] @ inverse
    return np.sum(whitened**2, axis=(1, 2)) / std**2


def _floored(std: np.ndarray) -> np.ndarray:
    """Return standard deviations (g,) raised to at least `MIN_STD` times the largest, so that weights remain finite.

    If all are zero (exact data), ones are returned.
    """
    largest = std.max(initial=0.0)
    if largest > 0.0:
        return np.maximum(std, MIN_STD * largest)
    return np.ones_like(std)
