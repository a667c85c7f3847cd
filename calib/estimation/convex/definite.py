"""Least squares with symmetric matrices, linear in the parameters, that must be positive definite.

min ½ ‖R b - z‖² under A b + c >= 0, E b = d and M_k(b) = Σ_j A_kj b_j ⪰ λ I, a cone program (Clarabel: Goulart & Chen
2024). Of many matrices few bind: those most indefinite enter, until all others are definite; what does not bind may go,
since the least misfit rises from one set to the next and none comes back (our choice).
"""

# pyright: reportAttributeAccessIssue=false
# clarabel is a compiled extension without stubs
from __future__ import annotations

from dataclasses import dataclass
from itertools import count

import numpy as np

from calib.arrays import frozen
from calib.errors import NotConverged
from calib.estimation.convex.interior_point import Constrained, Scaled, scale, spread

ENTER = 8  # matrices that enter at once, the most indefinite (our choice)
SLACK = 1e-3  # of the least eigenvalue, by which a matrix that did not enter may miss it (our choice)
DROPS = 30  # rounds in which what does not bind may go: rounding could let it come back
BINDS = 1e-6  # of the scaled problem, multipliers above which bind
ACCURACIES = 1e-10, 1e-8  # of the scaled problem; the second where rounding forbids the first


@dataclass(frozen=True, eq=False)
class Definite:
    """Matrices M_k(b) = Σ_j A_kj b_j whose eigenvalues must not be below `least`.

    Attributes:
        matrices: A (K, n, n, p), symmetric.
        least: above zero.
        likely: indices of those that bound the optimum of a problem much like this one, to begin with.
    """

    matrices: np.ndarray
    least: float
    likely: np.ndarray | None = None

    def least_eigenvalues(self, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return (K,) by how much the smallest eigenvalues are above `least`, and their slopes (K, p) by b (p,)."""
        size, n, _, p = self.matrices.shape
        flat = self.matrices.reshape(size, n * n, p)
        values, vectors = np.linalg.eigh((flat @ b).reshape(size, n, n))
        pairs = vectors[:, :, None, 0] * vectors[:, None, :, 0]
        return values[:, 0] - self.least, np.asarray((pairs.reshape(size, 1, n * n) @ flat)[:, 0])

    def satisfied(self, sizes: np.ndarray) -> bool:
        """Say whether smallest eigenvalues (K,), as above `least`, are those of definite matrices."""
        return bool((sizes >= -SLACK * self.least).all())


def minimise(
    factor: np.ndarray, rows: np.ndarray, offset: np.ndarray, equal: np.ndarray, held: np.ndarray, definite: Definite
) -> Constrained:
    """Return the optimum; multipliers in the order of rows, matrices, equalities.

    Args:
        factor: (p + 1, p + 1) triangle [R z; 0 ρ], R of full rank.
        rows, offset: A (c, p), c (c,).
        equal, held: E (e, p), d (e,).
        definite: the matrices.

    Raises:
        NotConverged: where no point satisfies all.
    """
    problem, fixed = scale(factor, rows, offset), scale(factor, equal, -held)
    small = Definite(definite.matrices * problem.unit, definite.least)
    used = np.zeros(0, dtype=int) if definite.likely is None else definite.likely
    for rounds in count():
        if not len(used):
            used = np.argsort(small.least_eigenvalues(np.linalg.solve(problem.upper, problem.target))[0])[:ENTER]
        b, mu, pushes, rates, steps = _solve(problem, fixed, small.matrices[used], small.least)
        sizes, normals = small.least_eigenvalues(b)
        traces = np.einsum("kii->k", pushes)
        bind = traces > BINDS
        left = sizes.copy()
        left[used] = 0.0
        if small.satisfied(left):
            break
        worst = np.argsort(left)[:ENTER]
        used = np.union1d(used[bind] if rounds < DROPS else used, worst[left[worst] < 0.0])
    total = len(small.matrices)
    held_by = np.einsum("kij,kijp->kp", pushes[bind], small.matrices[used[bind]])
    normals[used[bind]] = held_by / traces[bind, None]
    force = np.zeros(total)
    force[used[bind]] = traces[bind]
    slope = problem.upper.T @ (problem.upper @ b - problem.target)
    slope -= problem.rows.T @ mu + normals.T @ force + fixed.rows.T @ rates
    slack = np.maximum(problem.h(b), 0.0)
    whole = np.vstack([problem.rows, normals, fixed.rows])
    binding = np.concatenate([mu > slack, force > 0.0, np.ones(len(held), dtype=bool)])
    scales = np.concatenate([problem.sizes, np.ones(total), fixed.sizes])
    apart = np.concatenate([slack, np.where(force > 0.0, np.maximum(sizes, 0.0), sizes), np.zeros(len(held))])
    multipliers = np.concatenate([mu, force, rates])
    return Constrained(
        frozen(b * problem.unit), frozen(multipliers * problem.length**2 / scales), frozen(apart * scales),
        frozen(binding, bool), frozen(whole * scales[:, None] / problem.unit), float(np.abs(slope).max()),
        float(np.abs(multipliers * apart).max()), frozen(spread(problem, whole[binding])), steps,
    )  # fmt: skip


def _solve(
    problem: Scaled, fixed: Scaled, matrices: np.ndarray, least: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, int]:
    """Return b, multipliers of rows, of matrices (k, n, n) and of equalities, and steps; t = R b - z is a variable too.

    So nothing is squared.
    """
    import clarabel
    from scipy import sparse

    size, n, _, p = matrices.shape
    i, j = np.tril_indices(n)[::-1]  # upper triangle, column by column
    weight = np.where(i == j, 1.0, np.sqrt(2.0))
    flat = (matrices[:, i, j] * weight[:, None]).reshape(-1, p)
    rows = np.vstack([problem.upper, fixed.rows, -problem.rows, -flat])
    beside = np.zeros((len(rows), p))
    beside[:p] = -np.eye(p)
    right = np.concatenate([
        problem.target, -fixed.offset, problem.offset, -np.tile(np.where(i == j, least, 0.0), size)
    ])  # fmt: skip
    ends = np.cumsum([p, len(fixed.rows), len(problem.rows)])
    cones = [clarabel.ZeroConeT(int(ends[1]))]
    if len(problem.rows):
        cones.append(clarabel.NonnegativeConeT(len(problem.rows)))
    cones += [clarabel.PSDTriangleConeT(n)] * size
    settings = clarabel.DefaultSettings()
    settings.verbose, settings.max_threads = False, 1
    cost = sparse.diags(np.repeat([0.0, 1.0], p)).tocsc()
    system = sparse.csc_matrix(np.hstack([rows, beside]))
    for accuracy in ACCURACIES:
        settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = accuracy
        found = clarabel.DefaultSolver(cost, np.zeros(2 * p), system, right, cones, settings).solve()
        if str(found.status) in ("Solved", "AlmostSolved", "PrimalInfeasible"):
            break
    b, dual = np.array(found.x)[:p], np.array(found.z)
    if str(found.status) not in ("Solved", "AlmostSolved"):
        raise NotConverged(f"definite matrices: Clarabel says {found.status}", b * problem.unit)
    pushes = np.zeros((size, n, n))
    pushes[:, i, j] = dual[ends[2] :].reshape(size, len(i)) / weight
    pushes[:, j, i] = pushes[:, i, j]
    return b, dual[ends[1] : ends[2]], pushes, -dual[ends[0] : ends[1]], int(found.iterations)
