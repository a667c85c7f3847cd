"""Least squares under linear inequalities by a primal-dual interior point, from a triangle of [W y].

min ½ ‖R b - z‖² under A b + c = s, s > 0 with the barrier -ν Σ log s (Nocedal & Wright 2006, section 19.2).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg

from calib.arrays import frozen, shaped
from calib.errors import NotConverged
from calib.estimation.triangles import require_rank

TOLERANCE = 1e-10  # on stationarity, feasibility and gap of the scaled problem


@dataclass(frozen=True, eq=False)
class Constrained:
    """The optimum, with what is needed to check it.

    Attributes:
        values: (p,) b.
        multipliers: (c,) μ >= 0 of the constraints.
        slack: (c,) h(b): what linear bounds leave, and smallest eigenvalues above their least.
        binding: (c,) bool; where the data want to go on, symptom of a constraint too tight or of a biased estimate.
        normals: (c, p) ∂h/∂b at the optimum; of a matrix that binds <A, Z> / trace Z, Z its multiplier.
        stationarity: largest |Rᵀ(R b - z) - Aᵀ μ| with columns of R of unit norm and ‖z‖ = 1.
        gap: largest μ_i s_i, scaled likewise.
        covariance: (p, p) unscaled (multiply by σ²), binding constraints taken as equalities.
        iterations: Newton steps.
    """

    values: np.ndarray
    multipliers: np.ndarray
    slack: np.ndarray
    binding: np.ndarray
    normals: np.ndarray
    stationarity: float
    gap: float
    covariance: np.ndarray
    iterations: int


def minimise(factor: np.ndarray, rows: np.ndarray, offset: np.ndarray) -> Constrained:
    """Minimise ½ ‖R b - z‖² under A b + c >= 0.

    Newton steps on the perturbed optimality conditions, solved by QR of [R; √(μ/s) A]; a step goes 0.995 of the way to
    the boundary and is halved until the merit ½ ‖R b - z‖² - ν Σ log s + κ Σ |A b + c - s| falls. It starts from the
    unconstrained optimum.

    Args:
        factor: (p + 1, p + 1) triangle [R z; 0 ρ], R of full rank.
        rows, offset: A (c, p), c (c,).

    Raises:
        NotConverged: where the constraints contradict each other.
    """
    problem = scale(factor, rows, offset)
    b = np.linalg.solve(problem.upper, problem.target)
    distance = problem.h(b)
    s = np.full(len(distance), np.abs(distance).max(initial=1e-2))
    mu = np.full(len(distance), 0.1)
    for count in range(200):
        residuals = _residuals(problem, b, s, mu)
        if max(residuals) <= TOLERANCE:
            return _result(problem, b, s, mu, residuals, count)
        if mu.max(initial=0.0) > 1e8:
            break  # multipliers without bound: no point satisfies all constraints
        nu = _barrier(s, mu)
        db, ds, dmu = _newton(problem, b, s, mu, nu)
        size = _step_size(problem, b, s, mu, db, ds, dmu, nu)
        b, s, mu = b + size * db, s + size * ds, mu + size * dmu
    raise NotConverged(
        f"constrained least squares: the residuals do not fall below {max(residuals):.2g}; the constraints may "
        "contradict each other",
        b * problem.unit,
    )


@dataclass(frozen=True, eq=False)
class Scaled:
    """The problem in b / unit, with columns of R of unit norm and ‖z‖ = 1, rows A of unit norm.

    Attributes:
        upper, target: R (p, p), z (p,).
        unit, length: (p,) of b, and ‖z‖ as they were.
        rows, offset, sizes: A (c, p), c (c,), and the norms (c,) that A had in these units.
    """

    upper: np.ndarray
    target: np.ndarray
    unit: np.ndarray
    length: float
    rows: np.ndarray
    offset: np.ndarray
    sizes: np.ndarray

    def h(self, b: np.ndarray) -> np.ndarray:
        return np.asarray(self.rows @ b + self.offset)


def scale(factor: np.ndarray, rows: np.ndarray, offset: np.ndarray) -> Scaled:
    """Return a problem in units of its own; arguments as of `minimise`."""
    factor = shaped(factor, (len(factor), len(factor)), "triangle [R z]")
    p = len(factor) - 1
    norms = np.linalg.norm(factor[:p, :p], axis=0)
    upper = factor[:p, :p] / np.where(norms > 0.0, norms, 1.0)
    require_rank(upper, [f"x{k + 1}" for k in range(p)])
    length = float(np.linalg.norm(factor[:p, p])) or 1.0
    unit = length / norms
    sizes = np.linalg.norm(rows * unit, axis=1)
    sizes = np.where(sizes > 0.0, sizes, 1.0)
    return Scaled(upper, factor[:p, p] / length, unit, length, rows * unit / sizes[:, None], offset / sizes, sizes)


def spread(problem: Scaled, normals: np.ndarray) -> np.ndarray:
    """Return the unscaled covariance (p, p) of an optimum held on planes of these scaled normals (k, p)."""
    p = len(problem.unit)
    free = np.linalg.svd(normals)[2][np.linalg.matrix_rank(normals) :] if len(normals) else np.eye(p)
    if not len(free):
        return np.zeros((p, p))
    root = free.T @ np.linalg.pinv(problem.upper @ free.T) * (problem.unit / problem.length)[:, None]
    return np.asarray(root @ root.T)


def _residuals(problem: Scaled, b: np.ndarray, s: np.ndarray, mu: np.ndarray) -> tuple[float, float, float]:
    """Return stationarity, infeasibility and gap."""
    slope = problem.upper.T @ (problem.upper @ b - problem.target) - problem.rows.T @ mu
    apart = np.abs(problem.h(b) - s).max(initial=0.0)
    return float(np.abs(slope).max()), float(apart), float(np.max(s * mu, initial=0.0))


def _newton(
    problem: Scaled, b: np.ndarray, s: np.ndarray, mu: np.ndarray, nu: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the step of b, s and μ."""
    apart, weight = problem.h(b) - s, np.sqrt(mu / s)
    stacked = np.vstack([problem.upper, weight[:, None] * problem.rows])
    right = np.concatenate([problem.target - problem.upper @ b, nu / np.sqrt(mu * s) - weight * apart])
    db = _least(stacked, right)
    ds = problem.rows @ db + apart
    return db, ds, (nu - mu * ds) / s - mu


def _least(stacked: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Solve least squares with rows of very unlike size: heavy rows first and columns pivoted (Powell & Reid 1969).

    Plain QR loses the light rows' digits, and the iteration jams on most problems.
    """
    order = np.argsort(-np.abs(stacked).max(axis=1))
    q, r, pivots = (np.asarray(x) for x in scipy.linalg.qr(stacked[order], mode="economic", pivoting=True))
    solution = np.empty(stacked.shape[1])
    solution[pivots] = scipy.linalg.solve_triangular(r, q.T @ right[order])
    return solution


def _barrier(s: np.ndarray, mu: np.ndarray) -> float:
    """Return ν = 0.1 min(0.05 (1 - ξ) / ξ, 2)³ sᵀμ / c, ξ the least s_i μ_i over their mean (Vanderbei & Shanno 1999).

    Larger where the products are uneven; with a fixed share the iterates crawl along the boundary.
    """
    if not len(s):
        return 0.0
    mean = float(s @ mu) / len(s)
    even = float(np.min(s * mu)) / mean
    return max(mean * max(0.1 * min(0.05 * (1.0 - even) / even, 2.0) ** 3, 1e-3), 0.01 * TOLERANCE)


def _step_size(
    problem: Scaled, b: np.ndarray, s: np.ndarray, mu: np.ndarray,
    db: np.ndarray, ds: np.ndarray, dmu: np.ndarray, nu: float,
) -> float:  # fmt: skip
    """Return the part of the step that keeps s and μ positive and lowers the merit."""
    both, change = np.concatenate([s, mu]), np.concatenate([ds, dmu])
    falling = change < 0.0
    size = min(1.0, 0.995 * float(np.min(-both[falling] / change[falling], initial=np.inf)))
    price = 2.0 * float(np.max(np.abs(mu + dmu), initial=0.0)) + 1.0

    def merit(t: float) -> float:
        ahead, slack = b + t * db, s + t * ds
        misfit = problem.upper @ ahead - problem.target
        return float(0.5 * misfit @ misfit - nu * np.log(slack).sum() + price * np.abs(problem.h(ahead) - slack).sum())

    now = merit(0.0)
    for _ in range(20):
        if merit(size) <= now + 1e-12 * (1.0 + abs(now)):
            break
        size *= 0.5
    return size


def _result(
    problem: Scaled, b: np.ndarray, s: np.ndarray, mu: np.ndarray, residuals: tuple[float, float, float], count: int
) -> Constrained:
    """Return the optimum in the caller's units."""
    binding = mu > s
    return Constrained(
        frozen(b * problem.unit), frozen(mu * problem.length**2 / problem.sizes), frozen(s * problem.sizes),
        frozen(binding, bool), frozen(problem.rows * problem.sizes[:, None] / problem.unit), residuals[0], residuals[2],
        frozen(spread(problem, problem.rows[binding])), count,
    )  # fmt: skip
