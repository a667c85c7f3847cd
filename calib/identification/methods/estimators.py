"""Methods other than ordinary and weighted least squares: robust, total, and constrained least squares.

Total least squares (TLS) assumes noise in the columns of W as well as in y. Some columns may be exact, and each noise
has its own size. TLS is needed if measured signals are on both sides, as the motor currents in the identification of
drive gains with a known payload (Gautier & Briot 2014): [V -W] [g; χ] = y, with y the torque of the payload.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import scipy.linalg

from calib.errors import CalibError, Unidentifiable
from calib.estimation.estimate import Estimate
from calib.estimation.linear import LinearFit
from calib.estimation.triangles import Triangles, combine, condition_numbers, retriangulate
from calib.identification.methods.least_squares import OLS, WLS, LeastSquares, weighed
from calib.identification.methods.method import EstimateStatus, IdentificationProblem, Method, MethodEstimate, attempted
from calib.identification.methods.parameter_constraints import Constraints, constraints_of, hold
from calib.identification.methods.samples import SampleFit, Samples, irls, stack
from calib.records import shaped


def tls(
    data: Triangles, noise: np.ndarray, std: np.ndarray | None = None, inflation: np.ndarray | None = None
) -> LinearFit:
    """Estimate x of (W - ΔW) x = y - Δy with the smallest Σ (ΔW_kc / noise_c)² + (Δy_k / noise_y)², by TLS.

    With exact columns first, the QR of [W y] is Q [R11 R12; 0 R22]. The right singular vector of R22 / noise for the
    smallest singular value gives the noisy components of [x; -1], and back substitution the exact ones (Golub, Hoffman
    & Stewart 1987; Van Huffel & Vandewalle 1991, section 3.6). The noise level is σ² = s_min² / (r - p). The covariance
    (Fuller 1987, theorem 2.3.2, normal noise) is V = M⁻¹ σ_vv + r M⁻¹ (Σ_uu σ_vv - Σ_uv Σ_uvᵀ) M⁻¹ with M = WᵀW - r
    Σ_uu, Σ_uv = -Σ_uu x and σ_vv = σ² (noise_y² + Σ noise_c² x_c²). For correlated rows with variance inflations τ_g it
    becomes V + σ_vv M⁻¹ (Σ_g (τ_g - 1) W_gᵀ W_g) M⁻¹.

    Args:
        data: R factors of W and y.
        noise: (p + 1,) standard deviation of the noise in each column and in y, in their units, up to one common
            factor; zero for exact ones.
        std: (g,) factor by which the noise of each group of rows exceeds `noise`; None: 1.
        inflation: (g,) variance inflation τ_g >= 1, explained in the module `linear`; None: every row is independent.

    Raises:
        CalibError: for negative noise, or no noise at all.
        Unidentifiable: if the noise, not the data, determines the solution.
    """
    p = data.parameters
    count = int(data.rows.sum())
    shape = (p + 1,)
    noise = shaped(noise, shape, "noise of the columns and of y")
    if (noise < 0.0).any() or not noise.any():
        raise CalibError("noise of the columns and of y: no entry may be negative and at least one must be positive")
    factor = combine(data, std)
    direction, singular = _null_direction(factor, noise, count, data.names)
    if abs(direction[p]) <= 1e-10 * np.abs(direction).max():
        raise Unidentifiable(
            "no combination of the columns explains y: the columns depend on each other; choose base columns",
            data.names,
        )
    values = -direction[:p] / direction[p]
    if count > p:
        variance = singular**2 / (count - p)
    else:
        variance = np.nan
    if not np.isfinite(variance):
        raise Unidentifiable(
            f"{count} rows for {p} parameters: no residual is left to check them; record longer", data.names
        )
    prior_rows = np.zeros((0, p))
    independent = count
    if inflation is not None:
        scale = np.sqrt(inflation - 1.0) / (1.0 if std is None else std)
        group_scale = np.broadcast_to(scale, (data.groups,))
        scaled = data.factors[:, :, :p] * group_scale[:, None, None]
        prior_rows = scaled.reshape(-1, p)
        independent = int(np.sum(data.rows / inflation))
    upper = factor[:p, :p]
    covariance = _covariance(upper, noise, values, variance, count, data.names, prior_rows)
    dof = max(independent - p, 1)
    residual_std = float(np.sqrt(variance))
    estimate = Estimate(data.names, data.units, values, covariance, residual_std, dof)
    freedoms = np.maximum(data.rows * (1.0 - p / count), 1e-300)
    group_std = np.sqrt(data.residual_squares(values) / freedoms)
    return LinearFit(estimate, group_std, *condition_numbers(factor[:p, :p]))


def _null_direction(
    factor: np.ndarray, noise: np.ndarray, rows: int, names: tuple[str, ...]
) -> tuple[np.ndarray, float]:
    """Return v (p + 1,) that minimises ‖[W y] v‖ relative to the noise, and the smallest singular value.

    Singular values of pure noise are spread between 1 ± sqrt(columns / rows) (Marchenko & Pastur 1967). If the second
    smallest one is within this range of the smallest, the noise determines the solution.

    Args:
        factor: (p + 1, p + 1) R factor of [W y].
        noise: (p + 1,) relative noise of the columns and of y; 0 for exact columns.
        rows: number of rows.
        names: names of the columns, for messages.

    Raises:
        Unidentifiable: if the noise determines the solution, or exact columns are dependent.
    """
    exact = np.flatnonzero(noise == 0.0)
    noisy = np.flatnonzero(noise > 0.0)
    stacked = factor[:, np.concatenate([exact, noisy])]
    upper = retriangulate(stacked)
    k = len(exact)
    _, values, vt = np.linalg.svd(upper[k:, k:] / noise[noisy])
    edge = min(np.sqrt(len(noisy) / rows), 0.5)
    if len(values) > 1 and values[-2] * (1.0 - edge) < values[-1] * (1.0 + edge):
        raise Unidentifiable(
            f"the two smallest singular values are {values[-2]:.4g} and {values[-1]:.4g}: some columns contain only "
            "their stated noise; state less noise, or excite more",
            [names[c] for c in noisy[noisy < len(names)]],
            values,
        )
    direction = np.zeros(len(noise))
    direction[noisy] = vt[-1] / noise[noisy]
    if k:
        if np.abs(np.diag(upper)[:k]).min() <= 1e-12 * np.abs(upper).max():
            raise Unidentifiable(
                "the columns without noise are linearly dependent; choose base columns",
                [names[c] for c in exact if c < len(names)],
            )
        coupled = upper[:k, k:] @ direction[noisy]
        direction[exact] = -scipy.linalg.solve_triangular(upper[:k, :k], coupled)
    return direction, float(values[-1])


def _covariance(
    upper: np.ndarray,
    noise: np.ndarray,
    values: np.ndarray,
    variance: float,
    rows: int,
    names: tuple[str, ...],
    prior_rows: np.ndarray,
) -> np.ndarray:
    """Return the covariance V (p, p) of `tls`, computed with columns of unit norm.

    Args:
        upper: (p, p) R factor of W.
        noise: (p + 1,) relative noise of columns and y.
        values: (p,) estimate.
        variance: σ² of the noise level.
        rows: number of rows.
        names: names of the columns.
        prior_rows: (k, p) rows √(τ - 1) W, which correct for correlated rows.

    Raises:
        Unidentifiable: if some columns contain only noise.
    """
    norms = np.linalg.norm(upper, axis=0)
    scaled = upper / norms
    column_noise = variance * (noise[:-1] / norms) ** 2
    x = values * norms
    gram = scaled.T @ scaled - rows * np.diag(column_noise)
    eigenvalues = np.linalg.eigvalsh(gram)
    if eigenvalues[0] <= 0.0:
        raise Unidentifiable("some columns contain only noise; filter, or excite more", names, eigenvalues)
    inverse = np.linalg.inv(gram)
    total = variance * noise[-1] ** 2 + column_noise @ x**2
    middle = np.diag(column_noise) * total - np.outer(column_noise * x, column_noise * x)
    extra = (prior_rows / norms) @ inverse
    noise_part = rows * inverse @ middle @ inverse
    extra_part = total * extra.T @ extra
    return (inverse * total + noise_part + extra_part) / np.outer(norms, norms)


CONSISTENT, CONSTRAINED = "; parameters satisfy [constraints]", " under constraints on its parameters"
# of a column's rms: what filtered derivatives miss (our choice)
COLUMN_NOISE = 0.01


def scaled_tls(pooled: Triangles, std: np.ndarray, exact: np.ndarray, inflation: np.ndarray | None = None) -> LinearFit:
    """Return the TLS fit with noise of `COLUMN_NOISE` times the rms in each column, and of the residuals' size in y.

    The smallest singular value gives the common level of the noise. The ratio of the noises, which no single recording
    identifies, is our choice.

    Args:
        pooled: R factors, one group per torque row.
        std: (rows,) standard deviations of the residuals [N m or N].
        exact: (p,) mask of columns without noise: ones (offsets) and signs.
        inflation: (rows,) variance inflation of the residuals; None: every row is independent.
    """
    p = pooled.parameters
    weighted = pooled.factors / std[:, None, None]
    stacked = np.sum(weighted**2, axis=(0, 1))
    size = np.sqrt(stacked / max(float(pooled.rows.sum()), 1.0))
    column_noise = np.where(exact, 0.0, COLUMN_NOISE * size[:p])
    noise = np.append(column_noise, 1.0)
    return tls(pooled, noise, std, inflation)


@dataclass(frozen=True)
class _ConstrainedLeastSquares(Method):
    """Physically consistent least squares: a method that solves the rows directly, under constraints.

    Row weights are computed from the residuals of the unconstrained estimate. Only IRLS uses residuals of the
    constrained estimate, on which its weights of samples depend.

    Attributes:
        free: the method without constraints.
    """

    takes_constraints: bool = field(default=True, kw_only=True)
    free: LeastSquares

    def estimate(self, problem: IdentificationProblem) -> MethodEstimate:
        """Return the estimate under the problem's constraints; its covariance treats binding ones as equalities.

        Raises:
            UsageError: for constraints that contradict each other.
        """
        constraints = constraints_of(problem)
        return attempted(self.name, problem, lambda: self._estimate(problem, constraints))

    def _estimate(self, problem: IdentificationProblem, constraints: Constraints) -> MethodEstimate:
        std, tau = weighed(problem)
        pooled = problem.pooled
        free = self.free.solve(problem, std, tau)
        if self.free.weighted:
            weights = std
        else:
            weights = np.ones(len(std))
        factor = combine(pooled, weights)
        if self.free is IRLS:
            factor = _reweighted(problem, tau, lambda triangle: constraints.solve(triangle).values).factor
        fit, binding = hold(free, factor, pooled, weights, constraints, stated_noise=self.free.weighted)
        return MethodEstimate(self.name, EstimateStatus.FOUND, fit, pooled, std, tau, self.free.weighted, held=binding)


def _reweighted(
    problem: IdentificationProblem, tau: np.ndarray, solve: Callable[[np.ndarray], np.ndarray] | None = None
) -> SampleFit:
    """Return the IRLS fit of whole samples, with the largest variance inflation `tau` of any torque row.

    Args:
        problem: data and settings.
        tau: (rows,) variance inflations.
        solve: function of a triangle [R z; 0 ρ] that returns x (p,); None: least squares.
    """
    inflation = float(np.max(tau))
    data = samples_of(problem)
    return irls(data, inflation=inflation, solve=solve)


def samples_of(problem: IdentificationProblem) -> Samples:
    """Return the weighted rows of all recordings, grouped by sample.

    Args:
        problem: data and settings.
    """
    rows = problem.rows
    weighted = [part.matrix * part.weight[:, :, None] for part in rows]
    matrix = np.concatenate(weighted)
    target = np.concatenate([part.target * part.weight for part in rows])
    present = np.concatenate([part.present for part in rows])
    return stack(matrix, target, present, rows[0].names, rows[0].units)


IRLS = LeastSquares(
    "irls",
    "torque noise is correlated across joints, outlier samples are rejected; q, v, a are exact",
    lambda problem, std, tau: _reweighted(problem, tau).fit,
    description="least squares, weighted across joints, outliers rejected",
    source="Han, Wu, Liu & Xiong 2020",
    tunes=("gate of 3 sigma",),
    version=2,
)
TLS = LeastSquares(
    "tls",
    f"W has noise of {COLUMN_NOISE:.0%} of each column's rms, each joint's torque that of its "
    "residuals, both up to a common estimated factor, independently in each row; offsets and signs are exact",
    lambda problem, std, tau: scaled_tls(problem.pooled, std, problem.exact, tau),
    description="total least squares with scaled columns",
    version=2,
    source="Golub & Van Loan 1980; Van Huffel & Vandewalle 1991",
    tunes=("ratio of the columns' noise to the torques'",),
)


def _constrained(method: LeastSquares) -> _ConstrainedLeastSquares:
    """Return the variant of a least-squares method with the constraints of ``[constraints]``."""
    description = method.name + CONSTRAINED
    return _ConstrainedLeastSquares(
        f"pc-{method.name}",
        method.assumes + CONSISTENT,
        method,
        tunes=method.tunes,
        version=method.version,
        description=description,
        source="Sousa & Cortesão 2014; Wensing et al. 2018",
    )


PC_OLS = _constrained(OLS)
PC_WLS = _constrained(WLS)
PC_IRLS = _constrained(IRLS)
METHODS = (IRLS, TLS, PC_OLS, PC_WLS, PC_IRLS)
