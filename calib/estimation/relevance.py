"""Ridge regression with a separate ridge per group of columns (automatic relevance determination).

The ridge of a group is the prior precision of the group's parameters; the data determine each ridge.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular
from scipy.linalg.lapack import dpotrf, dtrtri  # type: ignore[attr-defined]

from calib.errors import Unidentifiable

# share of the parameters' sigmas that a search among many may leave open (our choice)
SETTLED = 0.02
# of a group's largest information, below which a direction is rounding
ROUNDING = 1e-12
# ‖y - W x‖ relative to ‖y‖ below which a fit counts as perfect: WᵀW knows no better
EXACT_RESIDUAL = 1e-7
# a group is out once its prior is this many times as precise as the data on its columns (our choice)
MAX_PRIOR_WEIGHT = 2.0


@dataclass(frozen=True, eq=False)
class Gram:
    """Sufficient statistics of the least-squares problem y = W x; the statistics of two sets of rows can be added.

    Attributes:
        square: WᵀW (p, p).
        cross: Wᵀy (p,).
        total: yᵀy.
        rows: number of rows of W.
    """

    square: np.ndarray
    cross: np.ndarray
    total: float
    rows: int

    def __add__(self, term: Gram) -> Gram:
        return Gram(self.square + term.square, self.cross + term.cross, self.total + term.total, self.rows + term.rows)

    def __sub__(self, term: Gram) -> Gram:
        return Gram(self.square - term.square, self.cross - term.cross, self.total - term.total, self.rows - term.rows)

    def scaled(self, factor: float) -> Gram:
        """Return the statistics after multiplication of W and y by √`factor`; the number of rows does not change."""
        return Gram(factor * self.square, factor * self.cross, factor * self.total, self.rows)


def gram(residual: np.ndarray, matrix: np.ndarray) -> Gram:
    """Return the sufficient statistics of y ≈ W x, with y = `residual` (rows,) and W = `matrix` (rows, p)."""
    return Gram(matrix.T @ matrix, matrix.T @ residual, float(residual @ residual), len(residual))


@dataclass(frozen=True, eq=False)
class Relevance:
    """Result of the ridge regression: parameter values, ridges and noise.

    Attributes:
        values: (p,) estimate; zero for the columns of a group without evidence, which is switched off.
        ridge: (p,) prior standard deviation of each parameter; infinite without a ridge, 0 in a group that is switched
            off.
        effective: effective number of ridged parameters that the data determine, Σ_i (1 - λ_i Σ_ii).
        noise: standard deviation of the residuals; 1 if the rows' whitening is correct.
    """

    values: np.ndarray
    ridge: np.ndarray
    effective: float
    noise: float


@dataclass(frozen=True, eq=False)
class Condensed:
    """Coordinates z (r,), r ≤ p, that replace the columns' parameters x (p,) without loss of information on any group.

    The harmonics of a joint that moves by less than a turn are, to within rounding, linear combinations of fewer
    columns. In the coordinates z the evidence costs r³ operations instead of p³.

    Attributes:
        groups: (r,) group of each coordinate; -1 for no ridge.
        sizes: (r,) first guess of each coordinate's prior standard deviation, equal within a group.
        counts: (r,) number of columns of x that each coordinate replaces.
        blocks: pairs of column indices of x and a matrix (columns, coordinates) that maps z to these x; the matrix is
            None where z = x. The coordinates of consecutive blocks are consecutive in z.
    """

    groups: np.ndarray
    sizes: np.ndarray
    counts: np.ndarray
    blocks: tuple[tuple[np.ndarray, np.ndarray | None], ...]

    def columns(self, matrix: np.ndarray) -> np.ndarray:
        """Return Wᵀ (r, ...) in the coordinates z, from Wᵀ (p, ...) in the original parameters x.

        Args:
            matrix: (p, ...) Wᵀ, or any stack of columns with one entry per original parameter.
        """
        flat = matrix.reshape(len(matrix), -1)
        parts = []
        for columns, basis in self.blocks:
            part = flat[columns]
            if basis is not None:
                part = basis.T @ part
            parts.append(part)
        return np.concatenate(parts).reshape(-1, *matrix.shape[1:])

    def gram(self, data: Gram) -> Gram:
        """Return the sufficient statistics in the coordinates z, from those in the original parameters x.

        Args:
            data: statistics of the p original parameters.
        """
        half = self.columns(data.square)
        parts = []
        for columns, basis in self.blocks:
            part = half.take(columns, 1)
            if basis is not None:
                part = part @ basis
            parts.append(part)
        return Gram(np.concatenate(parts, axis=1), self.columns(data.cross), data.total, data.rows)


def condensed(square: Callable[[np.ndarray], np.ndarray], groups: np.ndarray, start: np.ndarray) -> Condensed:
    """Return coordinates z that replace the p parameters; within a group all have the same prior standard deviation.

    Args:
        square: function of column indices (k,) that returns WᵀW (k, k) of these columns, over all rows of the problem.
        groups: (p,) group of each column; -1 for no ridge.
        start: (p,) first guess of each parameter's prior standard deviation, in the parameter's unit; the ratios within
            a group are kept.
    """
    numbers, number_of_column, members = np.unique(groups, return_inverse=True, return_counts=True)
    single = np.flatnonzero((groups < 0) | (members[number_of_column] == 1))
    blocks: list[tuple[np.ndarray, np.ndarray | None]] = [(single, None)]
    labels = [groups[single]]
    sizes = [start[single]]
    counts = [np.ones(len(single))]
    for group in numbers[(numbers >= 0) & (members > 1)]:
        columns = np.flatnonzero(groups == group)
        size = float(np.exp(np.log(start[columns]).mean()))
        profile = start[columns] / size
        information, axes = np.linalg.eigh(square(columns) * np.outer(profile, profile))
        visible = information > ROUNDING * information[-1]
        visible[-1] = True
        blocks.append((columns, profile[:, None] * axes[:, visible]))
        width = int(visible.sum())
        labels.append(np.full(width, group))
        sizes.append(np.full(width, size))
        counts.append(np.full(width, len(columns) / width))
    return Condensed(np.concatenate(labels), np.concatenate(sizes), np.concatenate(counts), tuple(blocks))


@dataclass(frozen=True, eq=False)
class _Elimination:
    """Columns without a ridge, eliminated from the sufficient statistics.

    Attributes:
        columns: (f,) indices of the eliminated columns.
        root: (f, f) lower Cholesky factor of WᵀW of the eliminated columns.
        half: (f, p) root⁻¹ times the eliminated columns' rows of WᵀW.
        target: (f,) root⁻¹ times the eliminated columns' entries of Wᵀy.
    """

    columns: np.ndarray
    root: np.ndarray
    half: np.ndarray
    target: np.ndarray

    @classmethod
    def of(cls, data: Gram, columns: np.ndarray) -> _Elimination:
        """Return the elimination of the columns with indices `columns` (f,) from the statistics `data`."""
        root = _root(data.square[np.ix_(columns, columns)])
        half = solve_triangular(root, data.square[columns], lower=True)
        target = solve_triangular(root, data.cross[columns], lower=True)
        return cls(columns, root, half, target)

    def values(self, other_values: np.ndarray) -> np.ndarray:
        """Return the eliminated columns' parameters (f,) for given values of all other parameters.

        Args:
            other_values: (p,) parameters, zero at the eliminated columns.
        """
        return solve_triangular(self.root, self.target - self.half @ other_values, trans=1, lower=True)


def relevance(
    data: Gram,
    groups: np.ndarray,
    start: np.ndarray,
    iterations: int = 15,
    settled: float = 0.0,
    counts: np.ndarray | None = None,
) -> Relevance:
    """Return the estimate of x with a prior x_g ~ N(0, 1/λ_g) per group, with the most probable λ_g and noise.

    x_g are the parameters of group g, Σ is the posterior covariance. MacKay's fixed point (1992; Tipping 2001, eq.
    16–18) is λ_g = γ_g / ‖x_g‖² with γ_g = Σ_{i in g} (1 - λ_g Σ_ii), and the noise precision is β = (N - Σ γ - p_free)
    / ‖y - W x‖², where p_free is the number of columns without a ridge. A group is switched off (its parameters become
    zero) once its prior is `MAX_PRIOR_WEIGHT` times as precise as the data. The ridges keep WᵀW well conditioned;
    columns without a ridge must be independent.

    Args:
        data: sufficient statistics WᵀW, Wᵀy, yᵀy of all N rows.
        groups: (p,) group of each column; -1 for no ridge.
        start: (p,) first guess of each parameter's prior standard deviation, equal within a group (otherwise use
            `condensed`); ignored for columns without a ridge.
        iterations: largest number of fixed-point iterations.
        settled: the iteration ends when the rms change of the values is below this share of their standard deviations
            (`SETTLED`); 0: all iterations are made.
        counts: (p,) number of original columns that each column replaces (`Condensed.counts`); None: 1 each.

    Raises:
        Unidentifiable: if the regularised WᵀW cannot be factorised.
    """
    if counts is None:
        counts = np.ones(len(groups))
    ridged = groups >= 0
    without_ridge = int((~ridged).sum())
    count = int(groups.max(initial=-1)) + 1
    # columns without a ridge form the last family, with precision 0
    family = np.where(ridged, groups, count)
    members = np.maximum(np.bincount(family, counts, count + 1), 1.0)
    start_precision = np.where(ridged, start, np.inf) ** -2.0
    lam = np.bincount(family, counts * start_precision, count + 1) / members
    information = np.bincount(family, np.diag(data.square), count + 1) / members
    alive = np.ones(count + 1, dtype=bool)
    beta = 1.0
    # columns without a ridge are eliminated once, but where a search ends early, which looks at all columns
    eliminated = np.array([], dtype=int)
    if settled == 0.0:
        eliminated = np.flatnonzero(~ridged)
    elimination = _Elimination.of(data, eliminated)
    index = np.setdiff1d(np.arange(len(groups)), eliminated)
    square = (data.square - elimination.half.T @ elimination.half)[np.ix_(index, index)]
    cross = data.cross - elimination.half.T @ elimination.target
    total = data.total - elimination.target @ elimination.target
    # what rounding leaves of a perfect fit
    least_misfit = EXACT_RESIDUAL**2 * max(data.total, 1e-300)
    solution = np.zeros(len(index))
    last = np.full(len(groups), np.inf)
    effective = 0.0
    for _ in range(iterations):
        # groups that were switched off leave the system
        remaining = np.flatnonzero(alive[family[index]])
        if len(remaining) < len(index):
            index = index[remaining]
            square = square.take(remaining, 0).take(remaining, 1)
        group = family[index]
        solution, variance = _posterior(square, cross[index], lam[group], beta)
        determined = np.where(group < count, 1.0 - lam[group] * variance, 0.0)
        gamma = np.bincount(group, determined, count + 1)
        size = np.bincount(group, solution**2, count + 1)
        most_probable = np.maximum(gamma, 1e-12) / np.maximum(size, 1e-300)
        lam[:count] = np.where(alive, most_probable, lam)[:count]
        max_lam = MAX_PRIOR_WEIGHT * beta * np.maximum(information, 1e-300)
        alive[:count] &= (lam < max_lam)[:count]
        effective = float(gamma.sum())
        misfit = total - 2.0 * solution @ cross[index]
        misfit += solution @ square @ solution
        dof = max(data.rows - effective - without_ridge, 1.0)
        beta = dof / max(float(misfit), least_misfit)
        if settled > 0.0:
            change = np.sum((solution - last[index]) ** 2 / variance)
            if change < settled**2 * counts[index].sum():
                break
        last[index] = solution
    values = np.zeros(len(groups))
    values[index] = solution
    values[eliminated] = elimination.values(values)
    ridge = np.where(ridged, 0.0, np.inf)
    alive_index = index[ridged[index]]
    ridge[alive_index] = 1.0 / np.sqrt(lam[groups[alive_index]])
    return Relevance(values, ridge, effective, float(1.0 / np.sqrt(beta)))


def _posterior(
    square: np.ndarray, cross: np.ndarray, penalty: np.ndarray, beta: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the posterior mean (p,) and posterior variances (p,) of x.

    Args:
        square, cross: WᵀW (p, p) and Wᵀy (p,).
        penalty: (p,) prior precision of each parameter.
        beta: β, the inverse variance of y's noise.
    """
    if not len(cross):
        return cross, cross
    # the variances need no more than the inverse of the root
    inverse, _ = dtrtri(_root(square, penalty / beta), lower=1, overwrite_c=1)
    mean = (inverse @ cross) @ inverse
    return mean, np.einsum("ij,ij->j", inverse, inverse) / beta


def _root(square: np.ndarray, penalty: np.ndarray | float = 0.0) -> np.ndarray:
    """Return the lower Cholesky factor of WᵀW with a penalty added to its diagonal.

    The diagonal is raised by a relative 1e-12, or by the smallest larger power of ten with which the factorisation
    succeeds: repeated rows may leave columns that no two poses distinguish.

    Args:
        square: WᵀW (p, p).
        penalty: (p,) or one number, added to the diagonal.

    Raises:
        Unidentifiable: if the factorisation fails even with a doubled diagonal.
    """
    for raised in 10.0 ** np.arange(-12.0, 1.0, 2.0):
        system = square.copy()
        diagonal = system.flat[:: len(square) + 1]
        system.flat[:: len(square) + 1] = np.maximum((diagonal + penalty) * (1.0 + raised), 1e-280)
        factor, failed = dpotrf(system.T, lower=1, overwrite_a=1)
        if not failed:
            return factor
    raise Unidentifiable("the measurements cannot distinguish the model's terms. Are rows repeated? Measure more poses")
