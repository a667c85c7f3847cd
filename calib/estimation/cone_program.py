"""Cone programs: least squares under linear constraints and positive semidefinite matrices, solved by Clarabel."""

# pyright: reportAttributeAccessIssue=false
# clarabel is a compiled extension without stubs

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy.linalg

from calib.errors import NotConverged
from calib.estimation.triangles import require_rank

if TYPE_CHECKING:
    import clarabel

ACCURACIES = 1e-10, 1e-8, 1e-6  # of the scaled problem; the others where rounding forbids the first


@dataclass(frozen=True, eq=False)
class ConeOptimum:
    """Optimum b (p,) of a cone program, with the multipliers of rows (c,), matrices (k, n, n) and equalities (e,)."""

    values: np.ndarray
    rows: np.ndarray
    matrices: np.ndarray
    equalities: np.ndarray


def minimise(
    upper: np.ndarray,
    target: np.ndarray,
    rows: np.ndarray,
    offset: np.ndarray,
    matrices: np.ndarray,
    least: np.ndarray | float = 0.0,
    equal: np.ndarray | None = None,
    held: np.ndarray | None = None,
) -> ConeOptimum:
    """Minimise ½ ‖R b - z‖² under A b + c >= 0, E b = d and M_k(b) ⪰ λ 1; t = R b - z is an unknown: no squares.

    Args:
        upper, target: R (m, p), z (m,), of order one.
        rows, offset: A (c, p), c (c,).
        matrices: (k, n, n, p), M_k = Σ_j A_kj b_j.
        least: λ, one or (k,).
        equal, held: E (e, p), d (e,); None for none.

    Raises:
        NotConverged: where no point satisfies all.
    """
    import clarabel
    from scipy import sparse

    (m, p), (size, n, _, _) = upper.shape, matrices.shape
    equal, held = np.zeros((0, p)) if equal is None else equal, np.zeros(0) if held is None else held
    i, j = np.tril_indices(n)[::-1]  # upper triangle, column by column
    weight = np.where(i == j, 1.0, np.sqrt(2.0))
    flat = (matrices[:, i, j] * weight[:, None]).reshape(-1, p)
    system = np.vstack([upper, equal, -rows, -flat])
    right = np.concatenate([target, held, offset, -np.outer(np.broadcast_to(least, size), i == j).ravel()])
    ends = np.cumsum([m, len(equal), len(rows)])
    cones = [clarabel.ZeroConeT(int(ends[1])), *[clarabel.NonnegativeConeT(len(rows))][: len(rows)]]
    cones += [clarabel.PSDTriangleConeT(n)] * size
    settings = clarabel.DefaultSettings()
    settings.verbose, settings.max_threads = False, 1
    cost = sparse.diags(np.repeat([0.0, 1.0], [p, m])).tocsc()
    system = sparse.csc_matrix(np.hstack([system, -np.eye(len(system), m)]))
    for accuracy in ACCURACIES:
        settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = accuracy
        found = _solved(clarabel.DefaultSolver(cost, np.zeros(p + m), system, right, cones, settings))
        if found is not None and str(found.status) in ("Solved", "AlmostSolved", "PrimalInfeasible"):
            break
    if found is None:
        raise NotConverged("the constraints are not solvable to any accuracy: Clarabel's eigenvalues do not converge")
    b, dual = np.array(found.x)[:p], np.array(found.z)
    if str(found.status) not in ("Solved", "AlmostSolved"):
        raise NotConverged(f"the constraints may contradict each other: Clarabel reports {found.status}", b)
    pushes = np.zeros((size, n, n))
    pushes[:, i, j] = dual[ends[2] :].reshape(size, len(i)) / weight
    pushes[:, j, i] = pushes[:, i, j]
    return ConeOptimum(b, dual[ends[1] : ends[2]], pushes, -dual[ends[0] : ends[1]])


def _solved(solver: "clarabel.DefaultSolver") -> "clarabel.DefaultSolution | None":
    """Return Clarabel's solution; None where its step breaks down in LAPACK's eigenvalues, which it ends by a panic.

    Whether an extreme step does depends on the processor's kernels of LAPACK.
    """
    try:
        return solver.solve()
    except BaseException as error:  # a panic of Rust is no Exception
        if type(error).__name__ != "PanicException":
            raise
        return None


def from_free(factor: np.ndarray, free: np.ndarray, normals: np.ndarray, held: np.ndarray) -> np.ndarray:
    """Return the estimate under A b = d from the unconstrained one, b_f - Q⁻¹Aᵀ (A Q⁻¹ Aᵀ)⁻¹ (A b_f - d), Q = RᵀR.

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


def bounded(factor: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Return argmin ‖R x - z‖² (p,) under A x >= 0, exact on the rows that Clarabel finds binding.

    As Clarabel has it where that is degenerate: a multiplier would change its sign, or another row be violated.

    Args:
        factor: (p + 1, p + 1) triangle [R z; 0 ρ], R of full rank.
        rows: A (c, p); one of a single entry is satisfied exactly.
    """
    p = len(factor) - 1
    norms, length = np.linalg.norm(factor[:p, :p], axis=0), float(np.linalg.norm(factor[:p, p])) or 1.0
    upper, target = factor[:p, :p] / np.where(norms > 0.0, norms, 1.0), factor[:p, p] / length
    require_rank(upper, [f"x{k + 1}" for k in range(p)])
    unit, values = length / norms, scipy.linalg.solve_triangular(factor[:p, :p], factor[:p, p])
    alone = np.count_nonzero(rows, axis=1) == 1
    if (rows @ values < 0.0).any():
        sizes = np.linalg.norm(rows * unit, axis=1)
        scaled = rows * unit / np.where(sizes > 0.0, sizes, 1.0)[:, None]
        solved = minimise(upper, target, scaled, np.zeros(len(rows)), np.zeros((0, 1, 1, p)))
        binding = solved.rows > np.maximum(scaled @ solved.values, 0.0)
        exact = from_free(factor, values, rows[binding], np.zeros(int(binding.sum())))
        exact[(rows[binding & alone] != 0.0).any(axis=0)] = 0.0
        slope = upper.T @ (upper @ (exact / unit) - target)
        pushes = np.linalg.lstsq(scaled[binding].T, slope)[0]
        away = np.linalg.norm(upper @ (exact / unit - solved.values))
        max_move = 1e-3  # of ‖z‖, by which the optimum on the binding rows may be off Clarabel's
        good = (rows[~binding] @ exact >= 0.0).all() and (pushes >= 0.0).all() and away <= max_move
        values = exact if good else solved.values * unit
    return np.where((rows[alone] != 0.0).any(axis=0), np.maximum(values, 0.0), values)
