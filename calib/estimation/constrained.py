"""Least squares under equalities and inequalities h(b) >= 0 by a primal-dual interior point, from a triangle of [W y].

min ½ ‖R b - z‖² under h(b) = s, s > 0 with the barrier -ν Σ log s. With R from `triangles.combine` it is constrained
least squares, with `instruments.projected` the inner problem of PC-IDIM-IV (Janot's slides on the TX40, where the sign
of the multipliers' term must be read as minus). Equalities are eliminated beforehand: b = b0 + N t. Constraints add
knowledge, not consistency: where they bind at wrong values the estimate is biased, and they do not cure the bias of
least squares in a loop.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg

from calib.arrays import frozen, shaped
from calib.errors import CalibError, NotConverged
from calib.estimation.triangles import require_rank, retriangulate

Vector = Callable[[np.ndarray], np.ndarray]
Curvature = Callable[[np.ndarray, np.ndarray], np.ndarray]

TOLERANCE = 1e-10  # on stationarity, feasibility and gap of the scaled problem


@dataclass(frozen=True, eq=False)
class Constrained:
    """The optimum, with what is needed to check it.

    Attributes:
        values: (p,) b.
        multipliers: (c,) μ >= 0 of the constraints.
        slack: (c,) h(b).
        binding: (c,) bool; where the data want to go on, symptom of a constraint too tight or of a biased estimate.
        normals: (c, p) ∂h/∂b at the optimum.
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


@dataclass(frozen=True)
class Curved:
    """Curved constraints h(b) >= 0, each concave.

    Attributes:
        h: b (p,) -> (c,).
        jacobian: b (p,) -> ∂h/∂b (c, p).
        curvature: b (p,), μ (c,) -> Σ μ_i ∇²h_i (p, p). None: taken as zero; where one binds the steps may then
            converge slowly or not at all.
    """

    h: Vector
    jacobian: Vector
    curvature: Curvature | None = None


def within(
    factor: np.ndarray, matrix: np.ndarray, lower: np.ndarray, upper: np.ndarray, curved: Curved | None = None
) -> Constrained:
    """Minimise ½ ‖R b - z‖² under lower <= A b <= upper, with equality where both are the same, and curved h(b) >= 0.

    Infinite bounds are left out. Multipliers, slack, binding and normals come in the order of the finite lower bounds,
    the finite upper ones, the curved ones, the equalities, whose multipliers have either sign.

    Args:
        factor: (p + 1, p + 1) triangle [R z; 0 ρ], R of full rank.
        matrix: A (c, p); the identity for bounds on single parameters.
        lower, upper: (c,), -inf and inf allowed.

    Raises:
        CalibError: for crossed bounds, and for equalities that contradict each other or leave nothing to estimate.
        NotConverged: where inequalities contradict each other.
    """
    p = len(factor) - 1
    matrix = shaped(matrix, (None, p), "constraint matrix A")
    lower, upper = np.asarray(lower, dtype=float), np.asarray(upper, dtype=float)
    if lower.shape != (len(matrix),) or upper.shape != lower.shape or np.isnan(lower).any() or np.isnan(upper).any():
        raise CalibError(f"bounds: expected {len(matrix)} lower and upper ones, none of them NaN")
    if (lower > upper).any():
        worst = int(np.argmax(lower - upper))
        raise CalibError(f"bounds: lower {lower[worst]:g} is above upper {upper[worst]:g} in row {worst}")
    same = lower == upper
    low, high = np.isfinite(lower) & ~same, np.isfinite(upper) & ~same
    rows = np.vstack([matrix[low], -matrix[high]])
    offset = np.concatenate([-lower[low], upper[high]])
    bent = curved or Curved(lambda b: np.zeros(0), lambda b: np.zeros((0, p)))
    curvature = bent.curvature

    def h(b: np.ndarray) -> np.ndarray:
        return np.concatenate([rows @ b + offset, bent.h(b)])

    def jacobian(b: np.ndarray) -> np.ndarray:
        return np.vstack([rows, bent.jacobian(b)])

    ahead = None if curvature is None else lambda b, mu: curvature(b, mu[len(rows) :])
    count = len(offset) + len(bent.h(np.zeros(p)))

    def solve(used: int) -> Constrained:
        part = _Part(h, jacobian, ahead if used > len(rows) else None, used)
        if same.any():
            return _on_equalities(factor, part, matrix[same], lower[same])
        return minimise(factor, part.h, part.jacobian, curvature=part.curvature)

    for used in (0, len(rows)):  # an optimum that satisfies what was left out is that of the whole problem
        found = _on_bounds(factor, solve(used), used, h)
        left = h(found.values)[used:]
        if (left >= 0.0).all():
            return _widened(found, used, left, jacobian(found.values)[used:])
    return solve(count)


@dataclass(frozen=True)
class _Part:
    """The first `used` of all inequalities."""

    whole_h: Vector
    whole_jacobian: Vector
    curvature: Curvature | None
    used: int

    def h(self, b: np.ndarray) -> np.ndarray:
        return self.whole_h(b)[: self.used]

    def jacobian(self, b: np.ndarray) -> np.ndarray:
        return self.whole_jacobian(b)[: self.used]


def _on_bounds(factor: np.ndarray, found: Constrained, inequalities: int, h: Vector) -> Constrained:
    """Return the optimum under linear constraints exactly on those that bind; the barrier keeps it √`TOLERANCE` off.

    Left as it is where it is degenerate: a multiplier of an inequality would change sign, or another be violated.
    """
    if not found.binding.any():
        return found
    p, normals = len(found.values), found.normals[found.binding]
    free = scipy.linalg.solve_triangular(factor[:p, :p], factor[:p, p])
    apart = np.zeros(len(found.slack))
    apart[:inequalities] = h(found.values)[:inequalities]
    held = normals @ found.values - apart[found.binding]
    values = from_free(factor, free, normals, held)
    for row in np.flatnonzero(np.count_nonzero(normals, axis=1) == 1):  # bounds on single parameters: to the last bit
        place = int(np.flatnonzero(normals[row])[0])
        values[place] = held[row] / normals[row, place]
    slack = np.where(found.binding, 0.0, apart + found.normals @ (values - found.values))
    away = np.linalg.norm(factor[:p, :p] @ (values - found.values)) / max(np.linalg.norm(factor[:p, p]), 1e-300)
    unit = 1.0 / np.linalg.norm(factor[:p, :p], axis=0)
    slope = factor[:p, :p].T @ (factor[:p, :p] @ values - factor[:p, p])
    size = np.linalg.norm(normals * unit, axis=1)
    multipliers = np.zeros(len(slack))
    multipliers[found.binding] = np.linalg.lstsq((normals * unit / size[:, None]).T, slope * unit)[0] / size
    if (slack < 0.0).any() or (multipliers[:inequalities] < 0.0).any() or away > 1e-3:
        return found
    return replace(found, values=frozen(values), slack=frozen(slack), multipliers=frozen(multipliers))


def _widened(found: Constrained, used: int, left: np.ndarray, normals: np.ndarray) -> Constrained:
    """Return the optimum with the inequalities that were left out, none of which binds, behind the first `used`."""
    zero = np.zeros(len(left))
    return replace(
        found, multipliers=frozen(np.insert(found.multipliers, used, zero)),
        slack=frozen(np.insert(found.slack, used, left)),
        binding=frozen(np.insert(found.binding, used, zero > 0.0), bool),
        normals=frozen(np.insert(found.normals, used, normals, axis=0)),
    )  # fmt: skip


def _on_equalities(factor: np.ndarray, part: _Part, rows: np.ndarray, held: np.ndarray) -> Constrained:
    """Minimise over b = b0 + N t, E N = 0, E b0 = d, in units that give the columns of R unit norm."""
    p = len(factor) - 1
    norms = np.linalg.norm(factor[:p, :p], axis=0)
    unit = 1.0 / np.where(norms > 0.0, norms, 1.0)
    scaled = rows * unit
    size = np.linalg.norm(scaled, axis=1)
    if not size.all():
        raise CalibError(f"equality {int(np.argmin(size)) + 1} acts on no parameter")
    left, values, right = np.linalg.svd(scaled / size[:, None])
    rank = int(np.sum(values > 1e-10 * values[0]))
    origin = right[:rank].T @ ((left[:, :rank].T @ (held / size)) / values[:rank])
    away = np.abs(scaled @ origin - held) / np.maximum(np.abs(held), size * max(float(np.abs(origin).max()), 1e-300))
    if away.max() > 1e-8:
        raise CalibError("equalities contradict each other: no point satisfies all of them")
    if rank == p:
        raise CalibError(f"equalities fix all {p} parameters: they leave nothing to estimate")
    origin, basis = unit * origin, unit[:, None] * right[rank:].T
    reduced = retriangulate(np.column_stack([factor[:, :p] @ basis, factor[:, p] - factor[:, :p] @ origin]))
    h, jacobian, curvature = part.h, part.jacobian, part.curvature
    found = minimise(
        reduced[: p - rank + 1], lambda t: h(origin + basis @ t), lambda t: jacobian(origin + basis @ t) @ basis,
        curvature=None if curvature is None else lambda t, mu: basis.T @ curvature(origin + basis @ t, mu) @ basis,
    )  # fmt: skip
    whole = origin + basis @ found.values
    normals = jacobian(whole)
    slope = factor[:p, :p].T @ (factor[:p, :p] @ whole - factor[:p, p]) - normals.T @ found.multipliers
    pushing = np.linalg.lstsq((scaled / size[:, None]).T, slope * unit)[0] / size
    return replace(
        found, values=frozen(whole), covariance=frozen(basis @ found.covariance @ basis.T),
        multipliers=frozen(np.append(found.multipliers, pushing)),
        slack=frozen(np.append(found.slack, np.zeros(len(rows)))),
        binding=frozen(np.append(found.binding, np.ones(len(rows), bool)), bool),
        normals=frozen(np.vstack([normals, rows])),
    )  # fmt: skip


def contradicting(matrix: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> tuple[int, ...]:
    """Return rows of lower <= A b <= upper that no b satisfies together; none where some b satisfies all.

    A linear program over the excess of each row; the rows are those with a multiplier, Farkas' certificate.
    """
    from scipy.optimize import linprog

    unit = np.linalg.norm(matrix, axis=0)
    scaled = matrix / np.where(unit > 0.0, unit, 1.0)
    low, high = np.isfinite(lower), np.isfinite(upper)
    rows = np.vstack([-scaled[low], scaled[high]])
    limit = np.concatenate([-lower[low], upper[high]])
    size = np.maximum(np.linalg.norm(rows, axis=1), 1e-300)
    count, p = rows.shape
    found = linprog(
        np.concatenate([np.zeros(p), np.ones(count)]), np.hstack([rows / size[:, None], -np.eye(count)]), limit / size,
        bounds=[(None, None)] * p + [(0.0, None)] * count,
    )  # fmt: skip
    if found.fun <= 1e-9 * max(1.0, float(np.abs(limit / size).max(initial=0.0))):
        return ()
    places = np.concatenate([np.flatnonzero(low), np.flatnonzero(high)])
    return tuple(sorted({int(places[k]) for k in np.flatnonzero(found.ineqlin.marginals < -1e-9)}))


def from_free(factor: np.ndarray, free: np.ndarray, normals: np.ndarray, held: np.ndarray) -> np.ndarray:
    """Return the estimate under A b = d from the free one, b_f - Q⁻¹Aᵀ (A Q⁻¹ Aᵀ)⁻¹ (A b_f - d), Q = RᵀR.

    Gouriéroux & Monfort (1995, section 10.3): under inequalities the same, A and d those that bind.

    Args:
        factor: (p + 1, p + 1) triangle [R z; 0 ρ].
        free: (p,) b_f.
        normals: A (k, p), of full rank.
        held: d (k,).
    """
    p = len(free)
    turned = scipy.linalg.solve_triangular(factor[:p, :p].T, normals.T, lower=True)  # R⁻ᵀ Aᵀ
    push = np.linalg.lstsq(turned, np.linalg.lstsq(turned.T, normals @ free - held)[0])[0]
    return np.asarray(free - scipy.linalg.solve_triangular(factor[:p, :p], turned @ push))


def restricted(covariance: np.ndarray, factor: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Return the covariance of an estimate held on A b = d, P C Pᵀ with P = I - Q⁻¹Aᵀ (A Q⁻¹ Aᵀ)⁻¹ A, Q = RᵀR.

    C may be any covariance of the free estimate, that of correlated residuals too.

    Args:
        covariance: C (p, p).
        factor: (p + 1, p + 1) triangle [R z; 0 ρ] that the estimate minimises.
        normals: A (k, p), of any rank.
    """
    if not len(normals):
        return covariance
    p = len(covariance)
    norms = np.linalg.norm(factor[:p, :p], axis=0)
    free = _null_space(normals / norms)
    if not free.shape[1]:
        return np.zeros((p, p))
    upper = factor[:p, :p] / norms
    shrink = free @ np.linalg.lstsq(upper @ free, upper)[0] * norms / norms[:, None]  # P
    return np.asarray(shrink @ covariance @ shrink.T)


def _null_space(rows: np.ndarray) -> np.ndarray:
    """Return an orthonormal basis (p, p - rank) of what the rows do not see; exact zeros where they fix a parameter."""
    size = np.linalg.norm(rows, axis=1)
    rows = rows[size > 0.0] / size[size > 0.0, None]
    _, values, right = np.linalg.svd(rows)
    basis = right[int(np.sum(values > 1e-9)) :].T
    return np.where(np.abs(basis) < 1e-14, 0.0, basis)


def minimise(
    factor: np.ndarray, h: Vector, jacobian: Vector, start: np.ndarray | None = None, curvature: Curvature | None = None
) -> Constrained:
    """Minimise ½ ‖R b - z‖² under h(b) >= 0.

    Newton steps on the perturbed optimality conditions, solved by QR of [R; √(μ/s) A; √K], K the positive part of
    -Σ μ_i ∇²h_i; a step goes 0.995 of the way to the boundary and is halved until the merit
    ½ ‖R b - z‖² - ν Σ log s + κ Σ |h - s| falls. The start need not be feasible.

    Args:
        factor: (p + 1, p + 1) triangle [R z; 0 ρ], R of full rank.
        h: b (p,) -> (c,).
        jacobian: b (p,) -> ∂h/∂b (c, p).
        start: (p,); None: the unconstrained optimum.
        curvature: b (p,), μ (c,) -> Σ μ_i ∇²h_i (p, p). None: taken as zero, right for linear h; for a curved one that
            binds the steps may then converge slowly or not at all.

    Raises:
        NotConverged: where the constraints contradict each other, or a curved h is not concave.
    """
    problem = _scale(factor, h, jacobian, start, curvature)
    b = problem.start
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
        "contradict each other, or be curved the wrong way (state the curvature)",
        b * problem.unit,
    )


@dataclass(frozen=True, eq=False)
class _Scaled:
    """The problem in b / unit, with columns of R of unit norm and ‖z‖ = 1."""

    upper: np.ndarray
    target: np.ndarray
    unit: np.ndarray
    length: float
    rows: np.ndarray
    start: np.ndarray
    functions: tuple[Vector, Vector, Curvature | None]

    def h(self, b: np.ndarray) -> np.ndarray:
        return self.functions[0](b * self.unit) / self.rows

    def jacobian(self, b: np.ndarray) -> np.ndarray:
        return self.functions[1](b * self.unit) * self.unit / self.rows[:, None]

    def root_curvature(self, b: np.ndarray, mu: np.ndarray) -> np.ndarray:
        """Return √K (k, p) with K the positive part of -Σ μ_i ∇²h_i."""
        if self.functions[2] is None:
            return np.zeros((0, len(b)))
        bend = self.functions[2](b * self.unit, mu / self.rows) * np.outer(self.unit, self.unit)
        values, vectors = np.linalg.eigh(-bend)
        return np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T


def _scale(
    factor: np.ndarray, h: Vector, jacobian: Vector, start: np.ndarray | None, curvature: Curvature | None
) -> _Scaled:
    factor = shaped(factor, (len(factor), len(factor)), "triangle [R z]")
    p = len(factor) - 1
    norms = np.linalg.norm(factor[:p, :p], axis=0)
    upper = factor[:p, :p] / np.where(norms > 0.0, norms, 1.0)
    require_rank(upper, [f"x{k + 1}" for k in range(p)])
    length = float(np.linalg.norm(factor[:p, p])) or 1.0
    unit, target = length / norms, factor[:p, p] / length
    b = np.linalg.solve(upper, target) if start is None else np.asarray(start, dtype=float) / unit
    rows = np.linalg.norm(jacobian(b * unit) * unit, axis=1)
    return _Scaled(upper, target, unit, length, np.where(rows > 0.0, rows, 1.0), b, (h, jacobian, curvature))


def _residuals(problem: _Scaled, b: np.ndarray, s: np.ndarray, mu: np.ndarray) -> tuple[float, float, float]:
    """Return stationarity, infeasibility and gap."""
    slope = problem.upper.T @ (problem.upper @ b - problem.target) - problem.jacobian(b).T @ mu
    apart = np.abs(problem.h(b) - s).max(initial=0.0)
    return float(np.abs(slope).max()), float(apart), float(np.max(s * mu, initial=0.0))


def _newton(
    problem: _Scaled, b: np.ndarray, s: np.ndarray, mu: np.ndarray, nu: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the step of b, s and μ."""
    a, apart, weight = problem.jacobian(b), problem.h(b) - s, np.sqrt(mu / s)
    bend = problem.root_curvature(b, mu)
    stacked = np.vstack([problem.upper, weight[:, None] * a, bend])
    right = np.concatenate(
        [problem.target - problem.upper @ b, nu / np.sqrt(mu * s) - weight * apart, np.zeros(len(bend))]
    )
    db = _least(stacked, right)
    ds = a @ db + apart
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
    problem: _Scaled, b: np.ndarray, s: np.ndarray, mu: np.ndarray,
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
    problem: _Scaled, b: np.ndarray, s: np.ndarray, mu: np.ndarray, residuals: tuple[float, float, float], count: int
) -> Constrained:
    """Return the optimum in the caller's units."""
    binding = mu > s
    jacobian = problem.jacobian(b)
    normal = jacobian[binding]
    free = np.linalg.svd(normal)[2][np.linalg.matrix_rank(normal) :] if binding.any() else np.eye(len(b))
    root = np.linalg.pinv(problem.upper @ free.T)
    spread = free.T @ root * (problem.unit / problem.length)[:, None] if len(free) else np.zeros((len(b), 1))
    values, slack = b * problem.unit, s * problem.rows
    multipliers = mu * problem.length**2 / problem.rows
    return Constrained(
        frozen(values), frozen(multipliers), frozen(slack), frozen(binding, bool),
        frozen(jacobian * problem.rows[:, None] / problem.unit), residuals[0], residuals[2], frozen(spread @ spread.T),
        count,
    )  # fmt: skip
