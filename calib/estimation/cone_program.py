"""Cone programs solved by Clarabel: least squares under linear constraints and semidefinite matrix constraints."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
import scipy.linalg

from calib.errors import NotConverged
from calib.estimation.convex_sets import ConvexSet
from calib.estimation.triangles import require_rank

if TYPE_CHECKING:
    import clarabel

# of the scaled problem; the others where rounding forbids the first
ACCURACIES = (1e-10, 1e-8, 1e-6)
# states of Clarabel that end the search for an accuracy, and those with an optimum
OPTIMAL = ("Solved", "AlmostSolved")
FINAL = (*OPTIMAL, "PrimalInfeasible")
# of ‖z‖, by which the optimum on the binding rows may be off Clarabel's
MAX_MOVE = 1e-3


@dataclass(frozen=True, eq=False)
class ConeOptimum:
    """Optimum of a cone program with the Lagrange multipliers of its constraints.

    Attributes:
        values: (p,) optimal unknowns b.
        rows: (c,) multipliers of the linear inequalities, >= 0.
        matrices: (k, n, n) multipliers of the semidefinite constraints, symmetric.
        equalities: (e,) multipliers of the linear equalities.
        sets: multipliers (k,) of each convex set's rows.
    """

    values: np.ndarray
    rows: np.ndarray
    matrices: np.ndarray
    equalities: np.ndarray
    sets: tuple[np.ndarray, ...] = ()


def minimise(
    upper: np.ndarray,
    target: np.ndarray,
    rows: np.ndarray,
    offset: np.ndarray,
    matrices: np.ndarray,
    least: np.ndarray | float = 0.0,
    equality_rows: np.ndarray | None = None,
    equality_values: np.ndarray | None = None,
    sets: Sequence[ConvexSet] = (),
) -> ConeOptimum:
    """Minimise ½ ‖R b - z‖² over b (p,) subject to A b + c >= 0, E b = d, M_k(b) ⪰ λ_k 1 and b in convex sets.

    RᵀR is never formed: t = R b - z is added to the unknowns of the program.

    Args:
        upper, target: R (m, p) and z (m,), scaled to order one.
        rows, offset: A (c, p) and c (c,).
        matrices: (k, n, n, p) coefficients A_kj of M_k(b) = Σ_j A_kj b_j.
        least: lower bound λ of the eigenvalues of the M_k, one number or (k,).
        equality_rows, equality_values: E (e, p) and d (e,); None without equalities.
        sets: convex sets of b.

    Raises:
        NotConverged: if no b satisfies all constraints, or Clarabel finds no optimum.
    """
    import clarabel
    from scipy import sparse

    m, p = upper.shape
    size, n, _, _ = matrices.shape
    if equality_rows is None or equality_values is None:
        equality_rows = np.zeros((0, p))
        equality_values = np.zeros(0)
    # upper triangle, column by column
    j, i = np.tril_indices(n)
    weight = np.where(i == j, 1.0, np.sqrt(2.0))
    flat = (matrices[:, i, j] * weight[:, None]).reshape(-1, p)
    bounds = -np.outer(np.broadcast_to(least, size), i == j).ravel()
    set_rows: list[np.ndarray] = []
    set_sides: list[np.ndarray] = []
    set_unknowns: list[np.ndarray] = []
    for convex in sets:
        set_rows.append(convex.matrix)
        set_sides.append(convex.sides)
        set_unknowns.append(convex.further)
    system = np.vstack([upper, equality_rows, -rows, -flat, *set_rows])
    right = np.concatenate([target, equality_values, offset, bounds, *set_sides])
    ends = np.cumsum([m, len(equality_rows), len(rows), len(flat), *map(len, set_sides)]).tolist()
    end_of_target, end_of_equalities, end_of_rows, end_of_matrices = ends[:4]
    cones = [clarabel.ZeroConeT(end_of_equalities)]
    if len(rows):
        cones.append(clarabel.NonnegativeConeT(len(rows)))
    cones += [clarabel.PSDTriangleConeT(n)] * size
    for convex in sets:
        cones += convex.cones
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.max_threads = 1
    further = np.asarray(scipy.linalg.block_diag(np.zeros((end_of_matrices, 0)), *set_unknowns))
    further_count = further.shape[1]
    cost = sparse.diags(np.repeat([0.0, 1.0, 0.0], [p, m, further_count])).tocsc()
    system = sparse.csc_matrix(np.hstack([system, -np.eye(len(system), m), further]))
    solution = None
    for accuracy in ACCURACIES:
        settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = accuracy
        solution = _solved(
            clarabel.DefaultSolver(cost, np.zeros(p + m + further_count), system, right, cones, settings)
        )
        if solution is not None and str(solution.status) in FINAL:
            break
    if solution is None:
        raise NotConverged(
            "the constraints are not solvable to any accuracy: Clarabel's eigenvalues do not converge; relax or "
            "remove constraints"
        )
    values = np.array(solution.x)[:p]
    if str(solution.status) not in OPTIMAL:
        raise NotConverged(
            f"the constraints may contradict each other: Clarabel reports {solution.status}; relax or remove some",
            values,
        )
    dual = np.array(solution.z)
    matrix_multipliers = np.zeros((size, n, n))
    matrix_multipliers[:, i, j] = dual[end_of_rows:end_of_matrices].reshape(size, len(i)) / weight
    matrix_multipliers[:, j, i] = matrix_multipliers[:, i, j]
    set_multipliers: list[np.ndarray] = []
    for start, end in pairwise(ends[3:]):
        set_multipliers.append(dual[start:end])
    return ConeOptimum(
        values=values,
        rows=dual[end_of_equalities:end_of_rows],
        matrices=matrix_multipliers,
        equalities=-dual[end_of_target:end_of_equalities],
        sets=tuple(set_multipliers),
    )


def _solved(solver: "clarabel.DefaultSolver") -> "clarabel.DefaultSolution | None":
    """Return the solution found by Clarabel's `solver`; None if Clarabel panics as an eigenvalue computation fails.

    Whether LAPACK's eigenvalue computation fails depends on the processor, since LAPACK's kernels differ.
    """
    try:
        return solver.solve()
    # a panic of Rust is no Exception
    except BaseException as error:
        if type(error).__name__ != "PanicException":
            raise
        return None


def from_free(factor: np.ndarray, free: np.ndarray, normals: np.ndarray, sides: np.ndarray) -> np.ndarray:
    """Return the least-squares estimate under the equalities A b = d, computed from the unconstrained estimate b_f.

        b_f - Q⁻¹Aᵀ (A Q⁻¹ Aᵀ)⁻¹ (A b_f - d),    Q = RᵀR

    (Gouriéroux & Monfort 1995, section 10.3). For inequalities, A and d are the rows of the binding ones.

    Args:
        factor: (p + 1, p + 1) upper triangle [R z; 0 ρ] of the least-squares problem min ‖R b - z‖².
        free: (p,) unconstrained estimate b_f.
        normals: A (k, p), of full rank.
        sides: d (k,).
    """
    p = len(free)
    upper = factor[:p, :p]
    # R⁻ᵀ Aᵀ
    whitened = scipy.linalg.solve_triangular(upper.T, normals.T, lower=True)
    violation = np.linalg.lstsq(whitened.T, normals @ free - sides)[0]
    multipliers = np.linalg.lstsq(whitened, violation)[0]
    return np.asarray(free - scipy.linalg.solve_triangular(upper, whitened @ multipliers))


def bounded(factor: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Return argmin ‖R x - z‖² (p,) subject to A x >= 0.

    Clarabel finds which rows of A bind; x is then computed from the equalities A x = 0 of these rows, without
    Clarabel's tolerance. If that point is not optimal (a multiplier is negative, another row is violated, or the point
    is far from Clarabel's), Clarabel's solution is returned.

    Args:
        factor: (p + 1, p + 1) upper triangle [R z; 0 ρ] of a least-squares problem, with R of full rank; ρ is not used.
        rows: A (c, p); a row with a single non-zero entry is satisfied exactly.

    Raises:
        Unidentifiable: if R is singular.
        NotConverged: if Clarabel finds no optimum.
    """
    p = len(factor) - 1
    norms = np.linalg.norm(factor[:p, :p], axis=0)
    upper = factor[:p, :p] / np.where(norms > 0.0, norms, 1.0)
    require_rank(upper, [f"x{k + 1}" for k in range(p)])
    length = float(np.linalg.norm(factor[:p, p])) or 1.0
    target = factor[:p, p] / length
    unit = length / norms
    values = scipy.linalg.solve_triangular(factor[:p, :p], factor[:p, p])
    single_entry = np.count_nonzero(rows, axis=1) == 1
    if (rows @ values < 0.0).any():
        scaled = rows * unit
        sizes = np.linalg.norm(scaled, axis=1)
        scaled = scaled / np.where(sizes > 0.0, sizes, 1.0)[:, None]
        optimum = minimise(upper, target, scaled, np.zeros(len(rows)), np.zeros((0, 1, 1, p)))
        binding = optimum.rows > np.maximum(scaled @ optimum.values, 0.0)
        exact = from_free(factor, values, rows[binding], np.zeros(int(binding.sum())))
        exact[(rows[binding & single_entry] != 0.0).any(axis=0)] = 0.0
        gradient = upper.T @ (upper @ (exact / unit) - target)
        multipliers = np.linalg.lstsq(scaled[binding].T, gradient)[0]
        move = np.linalg.norm(upper @ (exact / unit - optimum.values))
        satisfies_others = (rows[~binding] @ exact >= 0.0).all()
        if satisfies_others and (multipliers >= 0.0).all() and move <= MAX_MOVE:
            values = exact
        else:
            values = optimum.values * unit
    bounded_alone = (rows[single_entry] != 0.0).any(axis=0)
    return np.where(bounded_alone, np.maximum(values, 0.0), values)
