"""Ridge regression with one ridge per group of columns, each chosen by the data: automatic relevance determination."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.linalg import solve_triangular
from scipy.linalg.lapack import dpotrf, dtrtri  # type: ignore[attr-defined]

from calib.errors import Unidentifiable

SETTLED = 0.02  # share of the parameters' sigmas that a search among many may leave open (our choice)


@dataclass(frozen=True, eq=False)
class Gram:
    """Sufficient statistics of y = W x: WᵀW (p, p), Wᵀy (p,), yᵀy and the number of rows; they add up."""

    square: np.ndarray
    cross: np.ndarray
    total: float
    rows: int

    def __add__(self, other: Gram) -> Gram:
        return Gram(
            self.square + other.square, self.cross + other.cross, self.total + other.total, self.rows + other.rows
        )

    def __sub__(self, other: Gram) -> Gram:
        return Gram(
            self.square - other.square, self.cross - other.cross, self.total - other.total, self.rows - other.rows
        )

    def scaled(self, factor: float) -> Gram:
        """Return the statistics of rows multiplied by √factor."""
        return Gram(factor * self.square, factor * self.cross, factor * self.total, self.rows)


def gram(residual: np.ndarray, matrix: np.ndarray) -> Gram:
    """Return the sufficient statistics of residual (rows,) and W (rows, p)."""
    return Gram(matrix.T @ matrix, matrix.T @ residual, float(residual @ residual), len(residual))


@dataclass(frozen=True, eq=False)
class Relevance:
    """Result of the ridge regression: estimate, ridges and noise.

    Attributes:
        values: (p,) estimate; zero where a group was switched off.
        ridge: (p,) prior standard deviation of each column; infinite for those without a ridge, 0 where switched off.
        effective: how many of the ridged parameters the data determine, Σ 1 - λ_i Σ_ii.
        noise: standard deviation of the residuals, in units of the whitening.
    """

    values: np.ndarray
    ridge: np.ndarray
    effective: float
    noise: float


@dataclass(frozen=True, eq=False)
class Condensed:
    """Coordinates z (r,), r ≤ p, that replace the columns x (p,) without loss of information on any group.

    Harmonics of a joint that turns by less than a whole turn are linear combinations of fewer of them, to within
    rounding: their evidence costs r³, not p³.

    Attributes:
        groups: (r,) group of each coordinate; -1 for no ridge.
        sizes: (r,) first guess of its prior standard deviation, one per group.
        counts: (r,) how many columns of x it stands for.
        blocks: columns of x, and their matrix (columns, coordinates) in consecutive coordinates; None for unchanged
            columns.
    """

    groups: np.ndarray
    sizes: np.ndarray
    counts: np.ndarray
    blocks: tuple[tuple[np.ndarray, np.ndarray | None], ...]

    def columns(self, matrix: np.ndarray) -> np.ndarray:
        """Return Wᵀ (r, ...) in these coordinates from Wᵀ (p, ...) in the original ones."""
        flat = matrix.reshape(len(matrix), -1)
        parts = [flat[own] if basis is None else basis.T @ flat[own] for own, basis in self.blocks]
        return np.concatenate(parts).reshape(-1, *matrix.shape[1:])

    def gram(self, data: Gram) -> Gram:
        """Return statistics in these coordinates."""
        half = self.columns(data.square)
        parts = [half.take(own, 1) if basis is None else half.take(own, 1) @ basis for own, basis in self.blocks]
        return Gram(np.concatenate(parts, axis=1), self.columns(data.cross), data.total, data.rows)


def condensed(square: Callable[[np.ndarray], Any], groups: np.ndarray, start: np.ndarray) -> Condensed:
    """Return coordinates of p columns with statistics WᵀW, with equal prior magnitude within a group.

    Args:
        square: columns (k,) -> their WᵀW (k, k), of all rows that will ever be used.
        groups: (p,) group of each column; -1 for no ridge.
        start: (p,) first guess of each column's prior standard deviation; within a group their ratios stay.
    """
    family, inverse, members = np.unique(groups, return_inverse=True, return_counts=True)
    alone = np.flatnonzero((groups < 0) | (members[inverse] == 1))
    blocks: list[tuple[np.ndarray, np.ndarray | None]] = [(alone, None)]
    labels, sizes, counts = [groups[alone]], [start[alone]], [np.ones(len(alone))]
    rounding = 1e-12  # of a group's largest information, below which a direction is rounding
    for group in family[(family >= 0) & (members > 1)]:
        own = np.flatnonzero(groups == group)
        size = float(np.exp(np.log(start[own]).mean()))
        profile = start[own] / size
        seen, basis = np.linalg.eigh(square(own) * np.outer(profile, profile))
        kept = seen > rounding * seen[-1]
        kept[-1] = True
        blocks.append((own, profile[:, None] * basis[:, kept]))
        width = int(kept.sum())
        labels.append(np.full(width, group))
        sizes.append(np.full(width, size))
        counts.append(np.full(width, len(own) / width))
    return Condensed(np.concatenate(labels), np.concatenate(sizes), np.concatenate(counts), tuple(blocks))


def relevance(
    data: Gram,
    groups: np.ndarray,
    start: np.ndarray,
    iterations: int = 15,
    settled: float = 0.0,
    counts: np.ndarray | None = None,
) -> Relevance:
    """Estimate x with prior x_g ~ N(0, 1/λ_g) per group, every λ and the noise at their most probable values.

    MacKay's fixed point (1992; Tipping 2001, eq. 16–18): λ_g = γ_g / ‖x_g‖² with γ_g = Σ_{i in g} (1 - λ_g Σ_ii), and
    β = (N - Σ γ - p_free) / ‖y - W x‖². Works on WᵀW, which the ridges keep well conditioned; columns without a ridge
    must be independent.

    Args:
        data: statistics of all rows.
        groups: (p,) group of each column; -1 for no ridge.
        start: (p,) first guess of each column's prior standard deviation, one per group (`condensed` for others); read
            where there is a ridge.
        iterations: of the fixed point, at most.
        settled: the search ends when values change by less than this share of their standard deviations, rms
            (`SETTLED`); 0: never early.
        counts: (p,) how many columns each stands for (`Condensed`); None for one.
    """
    counts = np.ones(len(groups)) if counts is None else counts
    ridged = groups >= 0
    count = int(groups.max(initial=-1)) + 1
    family = np.where(ridged, groups, count)  # columns without a ridge form the last family, with precision 0
    members = np.maximum(np.bincount(family, counts, count + 1), 1.0)
    lam = np.bincount(family, counts * np.where(ridged, start, np.inf) ** -2.0, count + 1) / members
    information = np.bincount(family, np.diag(data.square), count + 1) / members
    beta, alive = 1.0, np.ones(count + 1, dtype=bool)
    # columns without a ridge are eliminated once, but where a search ends early, which looks at all columns
    free = np.flatnonzero(~ridged & (settled == 0.0))
    index = np.setdiff1d(np.arange(len(groups)), free)
    root = _root(data.square[np.ix_(free, free)])
    half, known = (solve_triangular(root, x[free], lower=True) for x in (data.square, data.cross))
    square, cross = (data.square - half.T @ half)[np.ix_(index, index)], data.cross - half.T @ known
    solution, effective, last = np.zeros(len(index)), 0.0, np.full(len(groups), np.inf)
    exact_residual = 1e-7  # ‖y - W x‖ relative to ‖y‖ below which a fit counts as perfect: WᵀW knows no better
    # a group is out once its prior is this many times as precise as the data on its columns (our choice)
    max_prior_weight = 2.0
    for _ in range(iterations):
        inside = np.flatnonzero(alive[family[index]])
        if len(inside) < len(index):
            index, square = index[inside], square.take(inside, 0).take(inside, 1)
        own = family[index]
        solution, variance = _posterior(square, cross[index], lam[own], beta)
        determined = np.where(own < count, 1.0 - lam[own] * variance, 0.0)
        gamma = np.bincount(own, determined, count + 1)
        size = np.bincount(own, solution**2, count + 1)
        lam[:count] = np.where(alive, np.maximum(gamma, 1e-12) / np.maximum(size, 1e-300), lam)[:count]
        alive[:count] &= (lam < max_prior_weight * beta * np.maximum(information, 1e-300))[:count]
        effective = float(gamma.sum())
        misfit = data.total - known @ known - 2.0 * solution @ cross[index]
        misfit += solution @ square @ solution
        least = exact_residual**2 * max(data.total, 1e-300)  # what rounding leaves of a perfect fit
        beta = max(data.rows - effective - int((~ridged).sum()), 1.0) / max(float(misfit), least)
        if settled > 0.0 and np.sum((solution - last[index]) ** 2 / variance) < settled**2 * counts[index].sum():
            break
        last[index] = solution
    values, ridge = np.zeros(len(groups)), np.where(ridged, 0.0, np.inf)
    values[index] = solution
    values[free] = solve_triangular(root, known - half @ values, trans=1, lower=True)
    kept = index[ridged[index]]
    ridge[kept] = 1.0 / np.sqrt(lam[groups[kept]])
    return Relevance(values, ridge, effective, float(1.0 / np.sqrt(beta)))


def _posterior(
    square: np.ndarray, cross: np.ndarray, penalty: np.ndarray, beta: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and variances of x from WᵀW and Wᵀy."""
    if not len(cross):
        return cross, cross
    inverse, _ = dtrtri(_root(square, penalty / beta), lower=1, overwrite_c=1)  # the variances need no more
    return (inverse @ cross) @ inverse, np.einsum("ij,ij->j", inverse, inverse) / beta


def _root(square: np.ndarray, penalty: np.ndarray | float = 0.0) -> np.ndarray:
    """Return the lower root of WᵀW with a penalty on its diagonal.

    A diagonal raised by 1e-12, or by as much more as it takes, keeps it regular to rounding: rows that repeat each
    other leave columns that no two poses distinguish.
    """
    for raised in 10.0 ** np.arange(-12.0, 1.0, 2.0):
        system = square.copy()
        diagonal = system.flat[:: len(square) + 1]
        system.flat[:: len(square) + 1] = np.maximum((diagonal + penalty) * (1.0 + raised), 1e-280)
        factor, failed = dpotrf(system.T, lower=1, overwrite_a=1)
        if not failed:
            return factor
    raise Unidentifiable("the measurements cannot distinguish the model's terms. Are rows repeated? Measure more poses")
