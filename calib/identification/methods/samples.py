"""Robust least squares with noise that is correlated across the rows (joints) of a sample.

The residual of sample k, e_k = y_k - W_k x (n joints), has covariance S across joints and no correlation between
samples. Its Mahalanobis size is d_k² = e_kᵀ S⁻¹ e_k. A robust fit weights each sample by w(d_k), and by zero beyond a
gate. This protects against wrong y; a sample with a wrong W of large leverage remains undetected, as in every
M-estimator. All samples are in memory, since each iteration weights them anew, so the method is meant for decimated
data.

For e ~ N(0, S) with n joints, d = (eᵀ S⁻¹ e)^½ is chi-distributed, so that the limit between small and large d grows
with n. Expectations are means over 4000 quantiles of d², accurate to four digits.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import scipy.linalg
from scipy.special import chdtri

from calib.errors import CalibError, NotConverged
from calib.estimation import robust
from calib.estimation.estimate import Estimate
from calib.estimation.linear import LinearFit, leverage, wls
from calib.estimation.robust import weights
from calib.estimation.triangles import Triangles, absorb, combine, empty, solve_triangle
from calib.records import frozen, shaped

# probability of a good sample to stay in
GATE = 0.999


@lru_cache
def tuning(joints: int, efficiency: float = 0.95) -> float:
    """Return the constant of Huber's weights with which the estimate has the given efficiency for normal residuals.

    The efficiency of the weights w(d) is b² / a with a = E w² d² / n and b = E w d² / n (Maronna 1976; b equals E[w +
    w' d / n] by Stein's lemma). For one joint the constant is 1.345.

    Args:
        joints: number n of joints in a sample.
        efficiency: efficiency relative to least squares.
    """
    from scipy.optimize import brentq

    square = _quantiles(joints)

    def excess(constant: float) -> float:
        w = weights(np.sqrt(square), "huber", constant)
        mean_square = np.mean(w * square) ** 2
        fourth = np.mean(w**2 * square)
        return float(mean_square / fourth / joints - efficiency)

    return float(brentq(excess, 0.05, 20.0 * np.sqrt(joints)))  # type: ignore[arg-type]


def weigh(size: np.ndarray, joints: np.ndarray, gated: bool = True) -> np.ndarray:
    """Return Huber's weights w(d) (N,) of samples with Mahalanobis sizes d (N,).

    Args:
        size: (N,) Mahalanobis sizes.
        joints: (N,) number of joints in use in each sample.
        gated: whether samples beyond the gate (quantile `GATE`) have weight zero.
    """
    result = np.zeros(len(size))
    for n in np.unique(joints[joints > 0]):
        rows = joints == n
        result[rows] = _weights(size[rows], int(n), gated)
    return result


@lru_cache
def consistency(joints: int) -> float:
    """Return c = E w / E[w d² / n], with which c Σ w e eᵀ / Σ w is a consistent estimate of S for normal residuals.

    S is the noise covariance of a sample, e its residual, d its Mahalanobis size, w(d) its weight.

    Args:
        joints: number n of joints in use in a sample.
    """
    square = _quantiles(joints)
    size = np.sqrt(square)
    w = _weights(size, joints)
    return float(np.mean(w) / np.mean(w * square) * joints)


def variance_factor(size: np.ndarray, joints: np.ndarray) -> float:
    """Return the factor v of the weighted fit's covariance cov(x) = v (Σ w_k W_kᵀ S⁻¹ W_k)⁻¹.

    W_k (n, p) is the regressor of sample k, S (n, n) the noise covariance, w_k the weight. cov(x) = a / b² (Σ W_kᵀ S⁻¹
    W_k)⁻¹ with a = mean w² d² / n and b = mean(w + w' d / n) over the samples (Huber & Ronchetti 2009, section 7.6),
    and the sum over all samples is the weighted sum over mean w. The step of w at the gate is neglected, an error of a
    few per mille.

    Args:
        size: (N,) Mahalanobis sizes.
        joints: (N,) number of joints in use in each sample.
    """
    n = np.maximum(joints, 1)
    w = weigh(size, joints)
    h = 1e-4
    larger = weigh(size * (1.0 + h), joints, False)
    above = np.where(w > 0.0, larger, 0.0)
    smaller = weigh(size * (1.0 - h), joints, False)
    below = np.where(w > 0.0, smaller, 0.0)
    # w' d
    slope = (above - below) / (2.0 * h)
    share = joints / joints.sum()
    a = np.sum(share * w**2 * size**2 / n)
    b = np.sum(share * (w + slope / n))
    return float(a / b**2 * np.sum(share * w))


def _weights(size: np.ndarray, joints: int, gated: bool = True) -> np.ndarray:
    w = weights(size, "huber", tuning(joints))
    if gated:
        return np.where(size**2 <= chdtri(joints, 1.0 - GATE), w, 0.0)
    return w


@lru_cache
def _quantiles(joints: int) -> np.ndarray:
    """Return 4000 equally probable values of d², the squared Mahalanobis size of normal residuals.

    Args:
        joints: number of joints in a sample, the degrees of freedom of d².
    """
    return np.asarray(chdtri(joints, 1.0 - (np.arange(4000) + 0.5) / 4000))


# samples whitened at a time
CHUNK = 2000
ROUNDS = 200


@dataclass(frozen=True, eq=False)
class Samples:
    """N samples of the torques of n joints.

    Attributes:
        names, units: names and units of the p parameters.
        matrix: (N, n, p) regressors.
        target: (N, n) torques [N m or N].
        present: (N, n) mask of rows in use; rows of slow joints may be unused in single samples.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    matrix: np.ndarray
    target: np.ndarray
    present: np.ndarray

    @property
    def joints(self) -> np.ndarray:
        """Number of joints whose rows are in use, per sample (N,)."""
        return self.present.sum(axis=1)


@dataclass(frozen=True, eq=False)
class SampleFit:
    """Linear fit with the noise covariance across joints.

    Attributes:
        fit: the estimate; ``fit.group_std`` is the square root of the diagonal of `noise`.
        noise: (n, n) covariance S of one sample's residual.
        weights: (N,) weights of the samples, 0 to 1.
        outliers: (N,) mask of samples beyond the gate.
        factor: (p + 1, p + 1) upper triangle [R z; 0 ρ] of the whitened and weighted samples.
    """

    fit: LinearFit
    noise: np.ndarray
    weights: np.ndarray
    outliers: np.ndarray
    factor: np.ndarray

    @property
    def estimate(self) -> Estimate:
        return self.fit.estimate


def stack(
    matrix: np.ndarray,
    target: np.ndarray,
    present: np.ndarray | None = None,
    names: Sequence[str] | None = None,
    units: Sequence[str] | None = None,
) -> Samples:
    """Return samples, after checks of shapes and finiteness, without a copy.

    Args:
        matrix: (N, n, p) regressors.
        target: (N, n) torques [N m or N].
        present: (N, n) mask of rows in use; None: all.
        names, units: names and units of the p parameters; None: x1, x2, … without units.

    Raises:
        CalibError: for wrong shapes or numbers of names.
    """
    shape = (None, None, None)
    matrix = shaped(matrix, shape, "observation matrices W")
    target = shaped(target, matrix.shape[:2], "target y")
    if present is None:
        present = np.ones(target.shape, dtype=bool)
    else:
        present = np.asarray(present, dtype=bool)
    if present.shape != target.shape:
        raise CalibError(f"rows present: expected an array of shape {target.shape}, found {present.shape}")
    if names is None:
        names = [f"x{k + 1}" for k in range(matrix.shape[2])]
    # Checks and completes names and units.
    columns = empty(names, units)
    if columns.parameters != matrix.shape[2]:
        raise CalibError(f"{columns.parameters} names for {matrix.shape[2]} columns")
    return Samples(columns.names, columns.units, matrix, target, present)


def irls(data: Samples, inflation: float = 1.0, solve: Callable[[np.ndarray], np.ndarray] | None = None) -> SampleFit:
    """Estimate x and S by iteratively reweighted least squares over whole samples (Maronna 1976), with a gate.

    x (p,) are the parameters, S (n, n) is the noise covariance across joints. S, weights and x are computed in turn
    until x changes by less than 1e-4 of its standard deviation. The iteration starts from a Cauchy fit of single rows
    with median-based standard deviations, because outliers would increase a covariance estimated from all samples and
    so remain hidden. The covariance of x is that of the M-estimator, `variance_factor`.

    Args:
        data: the samples.
        inflation: variance inflation >= 1 of all joints, explained in the module `linear`.
        solve: function of the triangle [R z; 0 ρ] of the weighted least-squares problem that returns x (p,), e.g. under
            constraints, which the covariance ignores; None: least squares.

    Raises:
        NotConverged: if the weights do not converge.
    """
    start = row_irls(data)
    shares = np.sqrt(_share_left(data, start.group_std))
    covariance = np.diag(start.group_std**2)
    values = start.estimate.values
    for _ in range(ROUNDS):
        residual = np.where(data.present, data.target - data.matrix @ values, 0.0) / shares
        size = _sizes(residual, covariance, data.present)
        weights = weigh(size, data.joints)
        scaled = weights * _consistent(data)
        covariance = _scatter(data, residual, scaled, weights)
        factor = _factor(data, covariance, weights)
        last = values
        if solve is None:
            values = solve_triangle(factor, data.names)[0]
        else:
            values = solve(factor)
        if np.sum((factor[:-1, :-1] @ (values - last)) ** 2) <= 1e-8 * len(values):
            return _pack(data, values, covariance, size, weights, factor, inflation)
    raise NotConverged(f"the weights of the samples have not converged after {ROUNDS} rounds; use method wls", values)


def row_irls(data: Samples) -> LinearFit:
    """Estimate x with one Cauchy weight w(|ρ| / σ_j) per row, σ_j = 1.4826 · median |ρ| of joint j.

    This is for outliers of single joints. The covariance is that of weighted rows, without the factor of the
    M-estimator.

    Args:
        data: the samples; ρ is the residual of a row.

    Raises:
        NotConverged: if the weights do not converge.
    """
    weights = np.ones(data.target.shape)
    values = wls(_triangles(data, weights), _spreads(data, data.target)).estimate.values
    for _ in range(ROUNDS):
        residual = data.target - data.matrix @ values
        std = _spreads(data, residual)
        row_weights = robust.weights(np.abs(residual) / std, "cauchy")
        fit = wls(_triangles(data, row_weights), std)
        step = fit.estimate.values - values
        values = fit.estimate.values
        if np.all(np.abs(step) <= 1e-3 * fit.estimate.sigma):
            return LinearFit(fit.estimate, std, fit.condition, fit.condition_normalised)
    raise NotConverged(f"the weights of the rows have not converged after {ROUNDS} rounds; use method wls", values)


def _pack(
    data: Samples,
    values: np.ndarray,
    noise: np.ndarray,
    size: np.ndarray,
    weights: np.ndarray,
    factor: np.ndarray,
    inflation: float,
) -> SampleFit:
    """Return the fit with the covariance of the M-estimator.

    Args:
        data: the samples.
        values: (p,) estimate.
        noise: (n, n) covariance S.
        size, weights: (N,) Mahalanobis sizes and weights.
        factor: triangle of the whitened and weighted samples.
        inflation: variance inflation.
    """
    _, inverse, conditions = solve_triangle(factor, data.names)
    squares = np.sum(weights * _consistent(data) * size**2)
    dof = int(data.joints[weights > 0.0].sum() / inflation) - len(values)
    residual_std = float(np.sqrt(squares / np.sum(weights * data.joints)))
    covariance = variance_factor(size, data.joints) * inflation * inverse @ inverse.T
    estimate = Estimate(data.names, data.units, values, covariance, residual_std, dof)
    outliers = (weights == 0.0) & (data.joints > 0)
    fit = LinearFit(estimate, np.sqrt(np.diag(noise)), *conditions)
    return SampleFit(fit, frozen(noise), frozen(weights), frozen(outliers, bool), frozen(factor))


def _sizes(residual: np.ndarray, noise: np.ndarray, present: np.ndarray) -> np.ndarray:
    """Return the Mahalanobis sizes (e_kᵀ S⁻¹ e_k)^½ (N,) of residuals (N, n), computed with the rows in use.

    Args:
        residual: (N, n) residuals.
        noise: (n, n) noise covariance S.
        present: (N, n) mask of rows in use.
    """
    patterns, pattern = _roots(noise, present)
    result = np.empty(len(residual))
    for k, root in enumerate(patterns):
        rows = pattern == k
        result[rows] = np.linalg.norm(residual[rows] @ root.T, axis=1)
    return result


def _roots(noise: np.ndarray, present: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return whitening matrices for every pattern of rows in use, and the pattern of each sample.

    The matrices (k, n, n) are L⁻¹ with L Lᵀ = S for the rows in use, and zero for the others; the pattern is an index
    (N,).

    Args:
        noise: (n, n) noise covariance S.
        present: (N, n) mask of rows in use.
    """
    patterns, pattern_index = np.unique(present, axis=0, return_inverse=True)
    roots = np.zeros((len(patterns), *noise.shape))
    for k, pattern in enumerate(patterns):
        block = np.ix_(pattern, pattern)
        lower = np.linalg.cholesky(noise[block])
        identity = np.eye(len(lower))
        roots[k][block] = scipy.linalg.solve_triangular(lower, identity, lower=True)
    return roots, pattern_index.reshape(-1)


def _factor(data: Samples, noise: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return the R factor of the whitened and weighted [W y], computed from blocks of samples.

    Args:
        data: the samples.
        noise: (n, n) noise covariance, by which rows are whitened.
        weights: (N,) weights of the samples.
    """
    roots, pattern = _roots(noise, data.present)
    p = len(data.names)
    total = empty(data.names)
    for start in range(0, len(data.target), CHUNK):
        part = slice(start, start + CHUNK)
        root = roots[pattern[part]] * np.sqrt(weights[part])[:, None, None]
        target = np.einsum("kij,kj->ki", root, data.target[part])
        whitened = (root @ data.matrix[part]).reshape(-1, p)
        total = absorb(total, whitened, target.reshape(-1))
    return total.factors[0]


def _triangles(data: Samples, weights: np.ndarray) -> Triangles:
    """Return the R factors of all rows in use, one group per joint, weighted by `weights` (N, n).

    Args:
        data: the samples.
        weights: (N, n) weights of the rows.
    """
    root = np.sqrt(weights)
    groups = data.target.shape[1]
    total = empty(data.names, data.units, groups)
    for start in range(0, len(data.target), CHUNK):
        part = slice(start, start + CHUNK)
        sample, joint = np.nonzero(data.present[part])
        scale = root[part][sample, joint]
        matrix = data.matrix[part][sample, joint] * scale[:, None]
        target = data.target[part][sample, joint] * scale
        total = absorb(total, matrix, target, joint)
    return total


def _spreads(data: Samples, residual: np.ndarray) -> np.ndarray:
    """Return the robust standard deviation of each joint's residuals (n,), always above zero.

    Args:
        data: the samples.
        residual: (N, n) residuals.
    """
    spreads = []
    for joint_residual, present in zip(residual.T, data.present.T):
        spreads.append(robust.spread(joint_residual[present]))
    std = np.array(spreads)
    return np.maximum(std, 1e-9 * max(std.max(initial=0.0), 1e-300))


def _share_left(data: Samples, std: np.ndarray) -> np.ndarray:
    """Return the share 1 - h_j / r_j (n,) of joint j's noise variance that remains in its r_j residuals after the fit.

    h_j is the leverage of the joint's rows.

    Args:
        data: the samples.
        std: (n,) standard deviations of the joints' residuals [N m or N].
    """
    triangles = _triangles(data, np.ones(data.target.shape))
    inverse = solve_triangle(combine(triangles, std), data.names)[1]
    leverages = leverage(triangles, std, inverse)
    return np.maximum(1.0 - leverages / np.maximum(triangles.rows, 1), 1e-3)


def _consistent(data: Samples) -> np.ndarray:
    """Return the factor (N,) of `consistency` for each sample, by its number of joints in use.

    Args:
        data: the samples.
    """
    # By the number of joints in use; a sample without any has no weight.
    factors = [0.0]
    factors += [consistency(count) for count in range(1, data.target.shape[1] + 1)]
    return np.array(factors)[data.joints]


def _scatter(data: Samples, residual: np.ndarray, scaled: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return the noise covariance S_ij = Σ c w e_i e_j / Σ w over samples with both rows in use.

    Eigenvalues are kept positive.

    Args:
        data: the samples.
        residual: (N, n) residuals e.
        scaled: (N,) products c w, with c of `consistency`.
        weights: (N,) weights w.
    """
    present = data.present.astype(float)
    total_weight = np.maximum((present * weights[:, None]).T @ present, 1e-300)
    noise = (residual * scaled[:, None]).T @ residual / total_weight
    std = np.sqrt(np.diag(noise))
    values, vectors = np.linalg.eigh(noise / np.outer(std, std))
    if values[0] >= 1e-8:
        return noise
    # pairs of unlike rows: not positive
    return (vectors * np.maximum(values, 1e-8)) @ vectors.T * np.outer(std, std)
