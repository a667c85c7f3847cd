"""Least squares of y = W x + ρ from R factors of [W y]: ordinary, weighted per group, and with a prior.

Covariances are those of the stated model of the noise. Filtered and decimated residuals are not white, and a covariance
that counts every row as independent is too small; `inflation` corrects the covariance: group g counts as rows_g /
inflation_g rows. The inflation is the integrated autocorrelation 1 + 2 Σ ρ_k of the residuals (`whiteness.inflation`),
or the sampling rate over twice the band that was kept. The correction is exact for columns that vary slowly against the
residuals and cautious for other columns. The estimated values do not depend on it.
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
    """Linear estimate with the residuals of groups and condition numbers.

    Attributes:
        estimate: values, covariance, standard deviation of the weighted residuals, degrees of freedom.
        group_std: (g,) standard deviation of the residuals of each group, in units of y.
        condition: condition number of W as solved (rows weighted, columns in their units).
        condition_normalised: condition number of W with columns of unit norm.
    """

    estimate: Estimate
    group_std: np.ndarray
    condition: float
    condition_normalised: float


def ols(data: Triangles, inflation: np.ndarray | None = None) -> LinearFit:
    """Estimate x = argmin ‖y - W x‖² with covariance σ² (WᵀW)⁻¹, σ² = ‖ρ‖² / (r - p).

    The covariance holds where all groups have the same noise; otherwise use `wls`.

    Args:
        data: triangles of W and y.
        inflation: (g,) >= 1, see the module; None: 1, every row is independent.
    """
    return _fit(data, np.ones(data.groups), inflation, stated=False)


def wls(data: Triangles, std: np.ndarray | None = None, inflation: np.ndarray | None = None) -> LinearFit:
    """Estimate x = (Wᵀ R⁻¹ W)⁻¹ Wᵀ R⁻¹ y with R = diag(σ_g² I), covariance (Wᵀ R⁻¹ W)⁻¹.

    Kolyubin et al. (2019), eq. 22 and 25; the RSD of eq. 26 is ``fit.estimate.rsd``.

    Args:
        data: triangles of W and y, one group per standard deviation.
        std: (g,) standard deviation of each group in units of y; `subsystem_std` is Kolyubin et al.'s choice. None:
            `settled_std`.
        inflation: (g,) >= 1, see the module; None: 1.
    """
    if std is None:
        std = settled_std(data)
    return _fit(data, np.asarray(std, dtype=float), inflation, stated=True)


def ridge(data: Triangles, mean: np.ndarray, covariance: np.ndarray, std: np.ndarray | None = None) -> LinearFit:
    """Estimate x from the data and a prior x ~ N(mean, covariance), by QR of [R; L⁻¹] with L Lᵀ = covariance.

    The result has the covariance of the posterior, and the condition number of data and prior together.

    Args:
        data: triangles of W and y.
        mean: (p,) prior mean.
        covariance: (p, p) prior covariance; an infinite diagonal entry means no prior knowledge.
        std: (g,) noise of each group in units of y; None: `settled_std` of the data, which must then determine x alone.
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
    """Return σ_g (g,) of each group fitted alone, σ_g² = ‖ρ_g‖² / (r_g - rank W_g).

    Kolyubin et al. (2019), after eq. 22.
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
    """Return the converged σ_g (g,): σ_g² = ‖y_g - W_g x‖² / (r_g - h_g), x being the WLS estimate with these σ.

    h_g = ‖W_g R⁻¹‖² / σ_g² is the group's share of the p parameters; the fixed point is the restricted maximum
    likelihood (Patterson & Thompson 1971). The iteration starts from `subsystem_std`.
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
    """Return fit with rows divided by std; `stated`: whether std is the noise itself or the noise up to a factor."""
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
    """Return the fit with the residuals' standard deviations; its degrees of freedom account for the inflation τ."""
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
    """Return the leverage h_g = ‖W_g R⁻¹‖² / σ_g² (g,) of each group; their sum is p."""
    whitened = data.factors[:, :, :-1] @ inverse
    return np.sum(whitened**2, axis=(1, 2)) / std**2


def _floored(std: np.ndarray) -> np.ndarray:
    """Return std (g,) with a floor relative to the largest one, so that weights of exact data remain finite."""
    largest = std.max(initial=0.0)
    if largest > 0.0:
        return np.maximum(std, MIN_STD * largest)
    return np.ones_like(std)
