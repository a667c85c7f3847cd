"""Least squares over cones by Clarabel (Goulart & Chen 2024), and matrices that must be definite."""

# pyright: reportAttributeAccessIssue=false
# clarabel is a compiled extension without stubs

from dataclasses import dataclass

import numpy as np

from calib.errors import NotConverged

ACCURACIES = 1e-10, 1e-8, 1e-6  # of the scaled problem; the others where rounding forbids the first


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
        max_violation = 1e-3  # of the least eigenvalue, by which a matrix that did not enter may miss it (our choice)
        return bool((sizes >= -max_violation * self.least).all())


@dataclass(frozen=True, eq=False)
class ConeOptimum:
    """Optimum b (p,) of a cone program, and multipliers of rows (c,), of matrices (k, n, n), of equalities (e,)."""

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
        found = clarabel.DefaultSolver(cost, np.zeros(p + m), system, right, cones, settings).solve()
        if str(found.status) in ("Solved", "AlmostSolved", "PrimalInfeasible"):
            break
    b, dual = np.array(found.x)[:p], np.array(found.z)
    if str(found.status) not in ("Solved", "AlmostSolved"):
        raise NotConverged(f"the constraints may contradict each other: Clarabel says {found.status}", b)
    pushes = np.zeros((size, n, n))
    pushes[:, i, j] = dual[ends[2] :].reshape(size, len(i)) / weight
    pushes[:, j, i] = pushes[:, i, j]
    return ConeOptimum(b, dual[ends[1] : ends[2]], pushes, -dual[ends[0] : ends[1]])
