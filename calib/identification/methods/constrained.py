"""Least squares under bounds, equalities and positive definite matrices, from an R factor of [W y].

min ½ ‖R b - z‖² under A b >= e, E b = d and M_k(b) = Σ_j A_kj b_j ⪰ λ I. With R from `triangles.combine` this is
constrained least squares; with `instrumental_variables.projected` it is the inner problem of PC-IDIM-IV (Janot's slides
on the TX40, where the sign of the multipliers' term must be read as minus). Clarabel finds which constraints bind
(Goulart & Chen 2024); for these, the optimum is computed exactly by the formula of Gouriéroux & Monfort. Matrices are
added only if the optimum without them violates one.

Constraints add knowledge, not consistency: if they bind at wrong values, the estimate is biased, and they do not remove
the bias of least squares in a closed loop.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg

from calib.errors import CalibError, require
from calib.estimation.cone_program import from_free, minimise
from calib.estimation.convex_sets import ConvexSet
from calib.estimation.triangles import require_rank
from calib.records import frozen, shaped


@dataclass(frozen=True, eq=False)
class Definite:
    """Constraint on matrices M_k(b) = Σ_j A_kj b_j: no eigenvalue below `least`.

    Attributes:
        matrices: A (K, n, n, p), symmetric.
        least: lower bound of the eigenvalues, above zero.
        likely: indices of matrices that were binding in a similar problem, with which the search starts; None: unknown.
    """

    matrices: np.ndarray
    least: float
    likely: np.ndarray | None = None

    def least_eigenvalues(self, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the smallest eigenvalue of each matrix minus `least` (K,), and the derivatives (K, p) by b (p,)."""
        size, n, _, p = self.matrices.shape
        flat = self.matrices.reshape(size, n * n, p)
        combined = flat @ b
        values, vectors = np.linalg.eigh(combined.reshape(size, n, n))
        pairs = vectors[:, :, None, 0] * vectors[:, None, :, 0]
        products = pairs.reshape(size, 1, n * n) @ flat
        return values[:, 0] - self.least, np.asarray(products[:, 0])

    def satisfied(self, sizes: np.ndarray) -> bool:
        """Return whether the smallest eigenvalues, given minus `least` as `sizes` (K,), satisfy the constraint.

        Args:
            sizes: smallest eigenvalue of each of the K matrices, minus `least`.
        """
        # of the least eigenvalue, by which a matrix that did not enter may miss it (our choice)
        max_violation = 1e-3
        return bool((sizes >= -max_violation * self.least).all())


def contradicting(matrix: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> tuple[int, ...]:
    """Return the indices of rows of lower <= A b <= upper that contradict each other; empty if all can be satisfied.

    A linear program minimises the sum of violations. Rows with a non-zero multiplier contradict each other (Farkas'
    certificate).

    Args:
        matrix: A (c, p).
        lower, upper: (c,) bounds, -inf and inf allowed.
    """
    from scipy.optimize import linprog

    unit = np.linalg.norm(matrix, axis=0)
    scaled = matrix / np.where(unit > 0.0, unit, 1.0)
    low = np.isfinite(lower)
    high = np.isfinite(upper)
    rows = np.vstack([-scaled[low], scaled[high]])
    limit = np.concatenate([-lower[low], upper[high]])
    size = np.maximum(np.linalg.norm(rows, axis=1), 1e-300)
    count, p = rows.shape
    # The least sum of violations, one unknown for each row beside the parameters.
    goal = np.concatenate([np.zeros(p), np.ones(count)])
    system = np.hstack([rows / size[:, None], -np.eye(count)])
    bounds = [(None, None)] * p + [(0.0, None)] * count
    program = linprog(goal, system, limit / size, bounds=bounds)
    if program.fun <= 1e-9 * max(1.0, float(np.abs(limit / size).max(initial=0.0))):
        return ()
    places = np.concatenate([np.flatnonzero(low), np.flatnonzero(high)])
    binding = np.flatnonzero(program.ineqlin.marginals < -1e-9)
    return tuple(sorted({int(places[k]) for k in binding}))


def restricted(covariance: np.ndarray, factor: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Return the covariance P C Pᵀ of an estimate under A b = d, from the covariance C of the unconstrained estimate.

    P = I - Q⁻¹Aᵀ (A Q⁻¹ Aᵀ)⁻¹ A with Q = RᵀR, R (p, p) the triangular factor of the observation matrix. C may also be a
    covariance for correlated residuals.

    Args:
        covariance: C (p, p).
        factor: (p + 1, p + 1) upper triangle [R z; 0 ρ] of the least-squares problem.
        normals: A (k, p), of any rank.
    """
    if not len(normals):
        return covariance
    p = len(covariance)
    norms = np.linalg.norm(factor[:p, :p], axis=0)
    free = null_space(normals / norms)
    if not free.shape[1]:
        return np.zeros((p, p))
    upper = factor[:p, :p] / norms
    # P
    projection, *_ = np.linalg.lstsq(upper @ free, upper)
    shrink = free @ projection * norms / norms[:, None]
    return np.asarray(shrink @ covariance @ shrink.T)


def null_space(rows: np.ndarray) -> np.ndarray:
    """Return an orthonormal basis (p, p - rank) of the null space of `rows` (k, p).

    Entries of parameters that the rows fix are exactly zero.
    """
    size = np.linalg.norm(rows, axis=1)
    rows = rows[size > 0.0] / size[size > 0.0, None]
    _, values, right = np.linalg.svd(rows)
    basis = right[int(np.sum(values > 1e-9)) :].T
    return np.where(np.abs(basis) < 1e-14, 0.0, basis)


@dataclass(frozen=True, eq=False)
class Constrained:
    """Optimum under constraints, with multipliers and slack to check it.

    Attributes:
        values: (p,) optimum b.
        multipliers: (c,) Lagrange multipliers μ of the constraints; >= 0 except those of equalities.
        slack: (c,) distances to the bounds, and smallest eigenvalues minus their limit.
        binding: (c,) whether each constraint is binding, which indicates a too tight constraint or a biased estimate.
        normals: (c, p) derivatives of the slack at the optimum; for a binding matrix <A, Z> / trace Z with its
            multiplier Z.
        planes: for each convex set the normal (p,) of the plane that touches it; None where the set does not bind.
    """

    values: np.ndarray
    multipliers: np.ndarray
    slack: np.ndarray
    binding: np.ndarray
    normals: np.ndarray
    planes: tuple[np.ndarray | None, ...] = ()


def within(
    factor: np.ndarray,
    matrix: np.ndarray,
    lower: np.ndarray,
    upper: np.ndarray,
    matrices: Definite | None = None,
    sets: Sequence[ConvexSet] = (),
) -> Constrained:
    """Return the optimum of min ½ ‖R b - z‖² under lower <= A b <= upper and definite matrices.

    And in convex sets, whose planes at the optimum are in `Constrained.planes`, not among the normals.

    R (p, p) and z (p,) are the data's triangle, b (p,) the unknowns. Equal bounds are an equality; infinite bounds are
    ignored. Multipliers, slack, binding and normals have the order: finite lower bounds, finite upper bounds, matrices,
    equalities. Multipliers of equalities have either sign.

    Args:
        factor: (p + 1, p + 1) upper triangle [R z; 0 ρ] of the least-squares problem in b, R of full rank.
        matrix: A (c, p); the identity for bounds on single parameters.
        lower, upper: (c,), -inf and inf allowed.
        matrices: matrices that must be positive definite; None: no matrices.
        sets: convex sets of b.

    Raises:
        CalibError: for crossed bounds, and for equalities that contradict each other or fix all parameters.
        NotConverged: if inequalities contradict each other, or no point makes the matrices definite.
    """
    p = len(factor) - 1
    shape = (None, p)
    matrix = shaped(matrix, shape, "constraint matrix A")
    lower = np.asarray(lower, dtype=float)
    upper = np.asarray(upper, dtype=float)
    has_length = lower.shape == (len(matrix),) == upper.shape
    sound = has_length and not np.isnan([lower, upper]).any()
    require(sound, f"bounds: expected {len(matrix)} lower and as many upper values, none of them NaN")
    if (lower > upper).any():
        worst = int(np.argmax(lower - upper))
        raise CalibError(f"bounds: lower {lower[worst]:g} is above upper {upper[worst]:g} in row {worst}")
    equal = lower == upper
    low = np.isfinite(lower) & ~equal
    high = np.isfinite(upper) & ~equal
    rows = np.vstack([matrix[low], -matrix[high]])
    edges = np.concatenate([lower[low], -upper[high]])
    planes = _Planes(factor, rows, edges, matrix[equal], lower[equal])
    matrices = matrices or Definite(np.zeros((0, 1, 1, p)), 1.0)
    if sets:
        return planes.definite(matrices, sets)
    solution = planes.optimum(np.zeros(len(rows), dtype=bool))
    if (solution.slack[: len(rows)] < 0.0).any():
        solution = planes.bounded()
    sizes, normals = matrices.least_eigenvalues(solution.values)
    if not matrices.satisfied(sizes):
        return planes.definite(matrices)
    return _widened(solution, len(rows), normals, sizes)


class _Planes:
    """Least-squares problem under the linear constraints A b >= e and E b = d only, in scaled units.

    Columns of R and rows of A and E are scaled to unit norm, and ‖z‖ = 1. `upper`, `target`, `scaled` and `edges`
    describe this problem for the unknowns b / `unit`.
    """

    def __init__(self, factor: np.ndarray, rows: np.ndarray, sides: np.ndarray, equal: np.ndarray, fixed: np.ndarray):
        p = len(factor) - 1
        norms = np.linalg.norm(factor[:p, :p], axis=0)
        safe_norms = np.where(norms > 0.0, norms, 1.0)
        self.upper = factor[:p, :p] / safe_norms
        names = [f"x{k + 1}" for k in range(p)]
        require_rank(self.upper, names)
        self.length = float(np.linalg.norm(factor[:p, p])) or 1.0
        self.unit = self.length / norms
        self.target = factor[:p, p] / self.length
        self.normals = np.vstack([rows, equal])
        self.sides = np.concatenate([sides, fixed])
        self.count = len(rows)
        sizes = np.linalg.norm(self.normals * self.unit, axis=1)
        self.sizes = np.where(sizes > 0.0, sizes, 1.0)
        self.scaled = self.normals * self.unit / self.sizes[:, None]
        self.edges = self.sides / self.sizes
        self.factor = factor
        upper = factor[:p, :p]
        self.free = scipy.linalg.solve_triangular(upper, factor[:p, p])
        self._require_solvable()

    def _require_solvable(self, max_contradiction: float = 1e-8) -> None:
        """Raise an error for equalities that contradict each other or fix all parameters.

        `max_contradiction`: largest relative violation of an equality by the best point.
        """
        scaled = self.scaled[self.count :]
        edges = self.edges[self.count :]
        if not len(scaled):
            return
        acts = scaled.any(axis=1)
        require(acts.all(), f"equality {int(np.argmin(acts)) + 1} has only zero coefficients; remove it")
        origin, _, rank, _ = np.linalg.lstsq(scaled, edges, rcond=1e-10)
        largest = max(float(np.abs(origin).max()), 1e-300)
        away = np.abs(scaled @ origin - edges) / np.maximum(np.abs(edges), largest)
        require(
            away.max() <= max_contradiction,
            "equalities contradict each other: no point satisfies all of them; remove one",
        )
        require(rank < len(self.free), f"equalities fix all {rank} parameters, so that none is estimated; remove some")

    def optimum(self, active: np.ndarray) -> Constrained:
        """Return the optimum under all equalities and the inequalities marked in `active` (c,), taken as equalities."""
        equalities = np.ones(len(self.sides) - self.count, dtype=bool)
        binding = np.append(active, equalities)
        normals = self.normals[binding]
        sides = self.sides[binding]
        values = np.array(self.free)
        multipliers = np.zeros(len(binding))
        if len(normals):
            values = from_free(self.factor, self.free, normals, sides)
            # bounds on single parameters
            for row in np.flatnonzero(np.count_nonzero(normals, axis=1) == 1):
                column = int(np.flatnonzero(normals[row])[0])
                values[column] = sides[row] / normals[row, column]
            slope = self.upper.T @ (self.upper @ (values / self.unit) - self.target)
            multipliers[binding] = np.linalg.lstsq(self.scaled[binding].T, slope)[0]
        slack = np.where(binding, 0.0, self.normals @ values - self.sides)
        scaled_multipliers = multipliers * self.length**2 / self.sizes
        return _frozen(values, scaled_multipliers, slack, binding, self.normals)

    def bounded(self) -> Constrained:
        """Return the optimum under the inequalities; the binding ones are satisfied exactly.

        If that point is not optimal (a multiplier would change its sign, or another inequality be violated), the
        solver's solution is returned.
        """
        c = self.count
        p = len(self.free)
        solution = self.definite(Definite(np.zeros((0, 1, 1, p)), 1.0))
        exact = self.optimum(solution.binding[:c])
        relative = (exact.values - solution.values) / self.unit
        away = np.linalg.norm(self.upper @ relative)
        # of ‖z‖, by which the optimum on the constraints that bind may be off the solver's
        max_move = 1e-3
        feasible = (exact.slack >= 0.0).all()
        optimal = (exact.multipliers[:c] >= 0.0).all()
        good = feasible and optimal and away <= max_move
        return exact if good else solution

    def definite(self, matrices: Definite, sets: Sequence[ConvexSet] = ()) -> Constrained:
        """Return the optimum under inequalities, definite matrices and convex sets, by cone programs.

        Few of many matrices are binding. The matrices with the smallest eigenvalues are added until all others are
        definite, and matrices that are not binding are removed. Since the minimum grows with every change of the set,
        no set occurs twice (our choice).
        """
        c = self.count
        rows = self.scaled
        edges = self.edges
        small = Definite(matrices.matrices * self.unit, matrices.least)
        small_sets = [convex.of(np.diag(self.unit)) for convex in sets]
        if matrices.likely is None:
            active = np.zeros(0, dtype=int)
        else:
            active = matrices.likely
        # of the scaled problem, multipliers of matrices and sets above which bind
        min_multiplier = 1e-6
        # matrices that enter at once, the most indefinite (our choice)
        max_entering = 8
        # rounds in which what does not bind may go: rounding could let it come back
        max_drops = 30
        rounds = 0
        while True:
            if not len(active):
                active = np.argsort(small.least_eigenvalues(self.free / self.unit)[0])[:max_entering]
            goal = self.upper, self.target, rows[:c], -edges[:c]
            active_matrices = small.matrices[active]
            solved = minimise(*goal, active_matrices, small.least, rows[c:], edges[c:], small_sets)
            b = solved.values
            mu = solved.rows
            pushes = solved.matrices
            rates = solved.equalities
            sizes, normals = small.least_eigenvalues(b)
            traces = np.einsum("kii->k", pushes)
            bind = traces > min_multiplier
            margins = sizes.copy()
            margins[active] = 0.0
            if small.satisfied(margins):
                break
            worst = np.argsort(margins)[:max_entering]
            if rounds < max_drops:
                active = active[bind]
            active = np.union1d(active, worst[margins[worst] < 0.0])
            rounds += 1
        held_by = np.einsum("kij,kijp->kp", pushes[bind], small.matrices[active[bind]])
        normals[active[bind]] = held_by / traces[bind, None]
        force = np.zeros(len(small.matrices))
        force[active[bind]] = traces[bind]
        slack = np.maximum(rows[:c] @ b - edges[:c], 0.0)
        all_rows = np.vstack([rows[:c], normals, rows[c:]])
        equalities = np.ones(len(rates), dtype=bool)
        binding = np.concatenate([mu > slack, force > 0.0, equalities])
        unit_sizes = np.ones(len(force))
        scales = np.concatenate([self.sizes[:c], unit_sizes, self.sizes[c:]])
        margins = np.where(force > 0.0, np.maximum(sizes, 0.0), sizes)
        gaps = np.concatenate([slack, margins, np.zeros(len(rates))])
        multipliers = np.concatenate([mu, force, rates]) * self.length**2 / scales
        all_normals = all_rows * scales[:, None] / self.unit
        optimum = _frozen(b * self.unit, multipliers, gaps * scales, binding, all_normals)
        planes: list[np.ndarray | None] = []
        for convex, dual in zip(small_sets, solved.sets):
            normal = convex.normal(dual)
            binds = np.abs(normal).max() > min_multiplier
            planes.append(normal / self.unit if binds else None)
        return replace(optimum, planes=tuple(planes))


def _frozen(*parts: np.ndarray) -> Constrained:
    values, multipliers, slack, binding, normals = parts
    return Constrained(frozen(values), frozen(multipliers), frozen(slack), frozen(binding, bool), frozen(normals))


def _widened(solution: Constrained, position: int, normals: np.ndarray, slack: np.ndarray) -> Constrained:
    """Return the optimum with further inequalities, which are not binding, inserted at index `position`.

    Args:
        solution: the optimum without the further inequalities.
        position: index of the first inserted inequality in the order of `within`.
        normals: (k, p) their derivatives.
        slack: (k,) their distances to the bounds.
    """
    zero = np.zeros(len(slack))
    multipliers = np.insert(solution.multipliers, position, zero)
    all_slack = np.insert(solution.slack, position, slack)
    binding = np.insert(solution.binding, position, zero > 0.0)
    all_normals = np.insert(solution.normals, position, normals, axis=0)
    return _frozen(solution.values, multipliers, all_slack, binding, all_normals)
