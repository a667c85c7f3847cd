"""Instrumental variables (IV): consistent estimates although the robot's feedback brings the noise of y into W.

The instruments Z (r, p), one per column of W, are the observation matrix of a noise-free simulation. The R factor of [Z
W y] contains all that IV needs; it is computed as in `triangles`:

    [Z W y] = Q [Rz A b; 0 B c; 0 0 ρ],    Zᵀ W = Rzᵀ A,    P_Z W = Q1 A.

The IV estimate solves A x = b, and the residual of the regression of W on Z is Q2 B. Products such as ZᵀW are not
formed.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import fdtrc

from calib.errors import Unidentifiable, require
from calib.estimation.base_columns import split_columns
from calib.estimation.estimate import Estimate
from calib.estimation.linear import LinearFit
from calib.estimation.triangles import (
    Triangles,
    absorb,
    combine,
    condition_numbers,
    empty,
    require_rank,
    retriangulate,
    solve_triangle,
)
from calib.identification.loop import ExogeneityTest
from calib.identification.methods.constrained import null_space
from calib.records import shaped


@dataclass(frozen=True, eq=False)
class InstrumentStrength:
    """Strength of instruments: how well they explain the columns of W.

    Attributes:
        names: names of the p columns of W.
        correlations: (p,) canonical correlations between Z and W, descending; 1 if Z spans W, 0 if ZᵀW is singular.
        partial_r2: (p,) share of each column, after regression on the other columns, that Z explains (Shea 1997).
        cragg_donald: F statistic of the weakest combination of columns, (r - p) λ² / (1 - λ²) / p with λ the smallest
            correlation; above 10 the usual approximations are valid (Staiger & Stock 1997).
        condition: condition number of Zᵀ W, with columns of Z and W scaled to unit norm.
    """

    names: tuple[str, ...]
    correlations: np.ndarray
    partial_r2: np.ndarray
    cragg_donald: float
    condition: float

    @property
    def weak(self) -> bool:
        return self.cragg_donald < 10.0


@dataclass(frozen=True, eq=False)
class Instruments:
    """R factors of [Z W y], one per group of rows; the first p columns are the instruments Z.

    Attributes:
        data: the R factors.
    """

    data: Triangles

    @property
    def names(self) -> tuple[str, ...]:
        return self.data.names[len(self.data.names) // 2 :]

    def least_squares(self) -> Triangles:
        """Return the R factors of [W y] alone (observation matrix and torques), for `linear.ols` and `linear.wls`."""
        p = len(self.names)
        return self.data.select(np.arange(p, 2 * p))

    def testable(self, fit: LinearFit, std: np.ndarray | None = None) -> Triangles:
        """Return one group's R factor [A b; 0 ‖ρ‖] whose least-squares solution is the IV estimate and covariance.

        W is the observation matrix, y are the torques; ρ = y - W x_IV is the whitened residual of the IV estimate x_IV.
        Tests of nested models with this factor are those of two-stage least squares (Wooldridge 2010, section 5.2.3):
        differences of ‖P_Z (y - W x)‖² against the variance of ρ.

        Args:
            fit: the result of `iv`.
            std: (g,) noise standard deviations of the groups of rows that `iv` used, in units of y; None: equal.
        """
        p = len(self.names)
        sigma = np.ones(self.data.groups) if std is None else std
        by_measured = np.concatenate([np.zeros(p), fit.estimate.values])
        squares = self.data.residual_squares(by_measured)
        factor = np.zeros((1, p + 1, p + 1))
        factor[0, :p] = projected(self, sigma)[:p]
        factor[0, p, p] = np.sqrt(np.sum(squares / sigma**2))
        rows = self.data.rows.sum()[None]
        return replace(empty(self.names, self.data.units[p:], 1), factors=factor, rows=rows)


def instrument(
    instruments: np.ndarray,
    matrix: np.ndarray,
    target: np.ndarray,
    group: np.ndarray | int = 0,
    names: Sequence[str] | None = None,
    units: Sequence[str] | None = None,
    before: Instruments | None = None,
) -> Instruments:
    """Return the R factors of [Z W y]; `before` is updated if it is given.

    Args:
        instruments: Z (r, p), one column for each column of W.
        matrix: W (r, p).
        target: y (r,).
        group: (r,) group index of each row, or one integer for all rows.
        names, units: names and units of the columns of W; None: x1, x2, … without units.
        before: R factors of earlier rows of the same problem; None: these are the first rows.
    """
    shape = (None, None)
    matrix = shaped(matrix, shape, "observation matrix W")
    instruments = shaped(instruments, matrix.shape, "instruments Z")
    if before is None:
        if names is None:
            names = [f"x{k + 1}" for k in range(matrix.shape[1])]
        if units is None:
            units = ("",) * len(names)
        groups = int(np.max(group, initial=0)) + 1
        before = unseen(tuple(names), units, groups)
    data = absorb(before.data, np.hstack([instruments, matrix]), target, group)
    return replace(before, data=data)


def unseen(names: Sequence[str], units: Sequence[str], groups: int) -> Instruments:
    """Return R factors of [Z W y] without rows, for columns of W with these names and units.

    Z (r, p) are the instruments, W (r, p) is the observation matrix, y (r,) are the torques.

    Args:
        names, units: names and units of the p columns of W.
        groups: number of groups of rows.
    """
    data = empty([*(f"Z {name}" for name in names), *names], [*units, *units], groups)
    return Instruments(data)


def iv(problem: Instruments, std: np.ndarray | None = None, inflation: float = 1.0) -> LinearFit:
    """Estimate x = (Zᵀ Ω⁻¹ W)⁻¹ Zᵀ Ω⁻¹ y with Ω = diag(σ_g² I), by instrumental variables.

    Z (r, p) are the instruments, W (r, p) the observation matrix, y (r,) the torques, σ_g the standard deviation of the
    rows of group g.

    The covariance is σ² (ZᵀΩ⁻¹W)⁻¹ (ZᵀΩ⁻¹Z) (WᵀΩ⁻¹Z)⁻¹. Janot, Vandanjon & Gautier (2014) use (ZᵀΩ⁻¹Z)⁻¹, which is
    equal if Z is W without its noise, and too small if the simulation deviates. σ² is estimated, so that a common
    factor of `std` has no effect. Two-stage least squares gives the same estimate, since there are as many instruments
    as columns.

    Args:
        problem: R factors of [Z W y].
        std: (g,) noise standard deviations σ_g of the groups of rows, in units of y, usually those of the weighted
            least squares of W; None: equal.
        inflation: variance inflation >= 1 of all groups, explained in the module `linear`.

    Raises:
        Unidentifiable: if Zᵀ W is singular (the message names the columns), or there are too few rows.
    """
    p = len(problem.names)
    if std is None:
        sigma = np.ones(problem.data.groups)
    else:
        shape = (problem.data.groups,)
        sigma = shaped(std, shape, "std per group")
    factor = combine(problem.data, sigma)
    values, inverse, _ = solve_triangle(_projected(factor, problem.names), problem.names)
    squares = problem.data.residual_squares(np.concatenate([np.zeros(p), values]))
    rows = problem.data.rows
    degrees = rows - inflation * p * rows / rows.sum()
    dof = int(problem.data.rows.sum() / inflation) - p
    require(dof > 0, "fewer independent rows than parameters; record longer motion", Unidentifiable, problem.names)
    residual_std = float(np.sqrt(np.sum(squares / sigma**2) / degrees.sum()))
    covariance = inflation * residual_std**2 * inverse @ inverse.T
    units = problem.data.units[p:]
    estimate = Estimate(problem.names, units, values, covariance, residual_std, dof)
    group_std = np.sqrt(squares / degrees)
    return LinearFit(estimate, group_std, *condition_numbers(factor[:, p : 2 * p]))


def settled(before: LinearFit, after: LinearFit, change: float = 0.025, residual: float = 0.025) -> bool:
    """Return whether the outer loop (simulate, estimate) has converged in parameters and residual.

    The criterion is |Δx_j| < change · |x_j| for every parameter x_j and |Δ‖ρ‖| < residual · ‖ρ‖ for the residuals ρ,
    with Δ the difference of the two estimates (Janot, Vandanjon & Gautier 2014; both usually 1 … 5 %). A parameter that
    changes by less than a fifth of its standard deviation has also converged (our choice: a parameter near zero never
    satisfies a relative criterion).

    Args:
        before, after: the last two estimates.
        change: largest relative change of a parameter.
        residual: largest relative change of the residuals' standard deviation.
    """
    parameter_change = np.abs(after.estimate.values - before.estimate.values)
    by_value = change * np.abs(before.estimate.values)
    allowed = np.maximum(by_value, 0.2 * after.estimate.sigma)
    sizes = before.estimate.residual_std, after.estimate.residual_std
    residual_change = abs(sizes[1] - sizes[0])
    return bool(np.all(parameter_change <= allowed) and residual_change <= residual * sizes[0])


def strength(problem: Instruments, std: np.ndarray | None = None) -> InstrumentStrength:
    """Return the strength of the instruments: how well they explain the columns of W.

    W (r, p) is the observation matrix, Z (r, p) are the instruments.

    Args:
        problem: R factors of [Z W y].
        std: (g,) noise standard deviations of the groups of rows, in units of y; None: equal.
    """
    p = len(problem.names)
    rows = int(problem.data.rows.sum())
    factor = combine(problem.data, std)
    explained = factor[:p, p : 2 * p]
    norms = np.linalg.norm(factor[:, p : 2 * p], axis=0)
    normalised = factor[: 2 * p, p : 2 * p] / norms
    basis = np.linalg.qr(normalised)[0]
    singular_values = np.linalg.svd(basis[:p], compute_uv=False)
    correlations = np.clip(singular_values, 0.0, 1.0)
    instrument_norms = np.linalg.norm(factor[:p, :p], axis=0)
    instruments = factor[:p, :p] / instrument_norms
    cross = instruments.T @ (explained / norms)
    minimum = correlations[-1] ** 2
    with np.errstate(divide="ignore", invalid="ignore"):
        donald = float((rows - p) / p * np.divide(minimum, 1.0 - minimum))
    total = factor[:, p : 2 * p] / norms
    partial_r2 = _shea(explained / norms, total)
    condition = np.linalg.cond(cross)
    return InstrumentStrength(problem.names, correlations, partial_r2, donald, condition)


def exogeneity(problem: Instruments, std: np.ndarray | None = None, inflation: float = 1.0) -> ExogeneityTest:
    """Return the test that W is uncorrelated with the noise (Durbin, Wu, Hausman), by augmented regression and QR.

    W (r, p) is the observation matrix, y (r,) are the torques. With V = W - P_Z W, the part of W's columns that the
    instruments Z do not explain, the model is y = W x + V δ + e. The hypothesis is δ = 0, with F = [(RSS0 - RSS1) / k]
    / [RSS1 / (r - p - k)] (Janot, Vandanjon & Gautier 2016, after Hausman 1978). k is the number of independent columns
    of V. The test assumes valid instruments: check `strength` first.

    Args:
        problem: R factors of [Z W y].
        std: (g,) noise standard deviations of the groups of rows, in units of y; None: equal, which gives false alarms
            for groups of different noise.
        inflation: variance inflation >= 1, the number of rows that count as one; at 1, autocorrelated residuals give
            false alarms.

    Raises:
        CalibError: if the instruments equal the columns, or there are too few rows.
        Unidentifiable: if columns of W are linearly dependent.
    """
    p = len(problem.names)
    rows = problem.data.rows.sum() / inflation
    factor = combine(problem.data, std)
    instrument_rows = factor[:, p : 2 * p]
    norms = np.linalg.norm(instrument_rows, axis=0)
    scaled = instrument_rows / np.where(norms > 0.0, norms, 1.0)
    require_rank(scaled, problem.names)
    unused = np.zeros((p, p))
    part = np.vstack([unused, factor[p:, p : 2 * p]])
    size = np.linalg.norm(part, axis=0) > 1e-8 * norms
    columns = np.hstack([instrument_rows, part[:, size]])
    split = split_columns(columns, [np.arange(p)], 1e-8)
    k = split.rank - p
    dof = int(rows) - p - k
    require(k > 0 and dof > 0, "nothing to test: the instruments equal the columns, or there are too few rows")
    target = factor[:, -1]
    first = _rss(instrument_rows, target)
    matrix = columns[:, split.kept]
    second = _rss(matrix, target)
    if second > 0.0:
        f = (first - second) / k / (second / (rows - p - k)) / inflation
    else:
        f = np.inf
    statistic = float(f)
    degrees = (k, dof)
    return ExogeneityTest(statistic, degrees, float(fdtrc(k, dof, f)))


def projected(problem: Instruments, std: np.ndarray | None = None) -> np.ndarray:
    """Return the R factor (p + 1, p + 1) of min ‖P_Z (y - W x)‖ (two-stage least squares), whose solution is `iv`.

    P_Z is the projection onto the columns of Z.

    Constrained IV minimises with this factor: Q = Wᵀ P_Z W is positive definite, while Zᵀ W need not be.

    Args:
        problem: R factors of [Z W y].
        std: (g,) noise standard deviations of the groups of rows, in units of y; None: equal.
    """
    return _projected(combine(problem.data, std), problem.names)


def by_free_instruments(
    problem: Instruments, std: np.ndarray, constrained: np.ndarray, normals: np.ndarray
) -> np.ndarray:
    """Return the IV estimate x (p,) under equalities A x = A x_c that uses the instruments of the free directions only.

    x satisfies Z_Uᵀ Ω⁻¹ (y - W x) = 0, where W (r, p) is the observation matrix, y (r,) are the torques with covariance
    Ω = diag(std²), and Z_U are the instruments of the directions in the null space of A. Janot's slides on the TX40
    give the criterion ½ ‖P_Z (y - W x)‖² (`projected`), in which all instruments count, but for bounds x_C = d the
    relation x_U = x_U^IV + (Z_UᵀW_U)⁻¹ Z_UᵀW_C (x_C^IV - d), which is the one computed here. Both are consistent if the
    constraint is true. On a simulated TX40 they differ by at most 0.007 σ (`examples/tx40`), in simulated problems with
    weak instruments by 0.24 σ, and by 2.4 σ if the bound is wrong by 6 σ: there the estimate by free instruments has
    the smaller error (`tests/identification/closed_loop/test_instruments.py`).

    Args:
        problem: R factors of [Z W y].
        std: (g,) noise standard deviations of the groups of rows, in units of y.
        constrained: (p,) a point x_c that satisfies the constraints.
        normals: A (k, p), normals of the constraints.
    """
    p = len(problem.names)
    factor = combine(problem.data, std)
    norms = np.linalg.norm(factor[:, p : 2 * p], axis=0)
    free = null_space(normals / norms) / norms[:, None]
    z = factor[:p, :p] @ free
    w = factor[:p, p : 2 * p] @ free
    residual = factor[:p, -1] - factor[:p, p : 2 * p] @ constrained
    by_free = np.linalg.solve(z.T @ w, z.T @ residual)
    return np.asarray(constrained + free @ by_free)


def _projected(factor: np.ndarray, names: Sequence[str]) -> np.ndarray:
    """Return the R factor of P_Z [W y] from the R factor of [Z W y].

    Args:
        factor: R factor of [Z W y].
        names: names of the columns of W, for messages.

    Raises:
        Unidentifiable: if Z or Zᵀ W do not have full rank.
    """
    p = len(names)
    size = np.linalg.norm(factor[:p, :p], axis=0)
    normalised = factor[:p, :p] / np.where(size > 0.0, size, 1.0)
    labels = [f"instrument of {name}" for name in names]
    require_rank(
        normalised, labels, "the simulated motion does not excite them: simulate the reference of this recording"
    )
    norms = np.linalg.norm(factor[:, p : 2 * p], axis=0)
    normalised = factor[:p, p : 2 * p] / np.where(norms > 0.0, norms, 1.0)
    require_rank(
        normalised,
        names,
        "the instruments do not distinguish them: W has dependent columns, or the simulated motion differs",
    )
    stacked = factor[:p, p:]
    return retriangulate(stacked)


def _shea(explained: np.ndarray, total: np.ndarray) -> np.ndarray:
    """Return Shea's partial R² (p,), diag((WᵀW)⁻¹) / diag((WᵀP_Z W)⁻¹) (Shea 1997 in the form of Godfrey 1999).

    Args:
        explained: R factor of P_Z W.
        total: R factor of W.
    """
    variances = [np.sum(np.linalg.pinv(part) ** 2, axis=1) for part in (total, explained)]
    return variances[0] / variances[1]


def _rss(matrix: np.ndarray, target: np.ndarray) -> float:
    """Return the residual sum of squares of the regression of `target` on the columns of `matrix`."""
    size = matrix.shape[1]
    stacked = np.column_stack([matrix, target])
    triangle = retriangulate(stacked)
    return float(np.sum(triangle[size:, size] ** 2))
