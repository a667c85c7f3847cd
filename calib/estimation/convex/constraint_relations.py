"""What holds between constraints alone, and between a constrained estimate and the free one."""

import numpy as np
import scipy.linalg


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
