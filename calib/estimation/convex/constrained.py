"""Least squares under bounds, equalities and matrices that must be positive definite, from a triangle of [W y].

With R from `triangles.combine` it is constrained least squares, with `instruments.projected` the inner problem of
PC-IDIM-IV (Janot's slides on the TX40, where the sign of the multipliers' term must be read as minus). Equalities are
eliminated beforehand: b = b0 + N t. Matrices come in only where the optimum without them leaves one indefinite.
Constraints add knowledge, not consistency: where they bind at wrong values the estimate is biased, and they do not cure
the bias of least squares in a loop.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scipy.linalg

from calib.arrays import frozen, shaped
from calib.errors import CalibError, require
from calib.estimation.convex import definite
from calib.estimation.convex.constraint_relations import from_free
from calib.estimation.convex.definite import Definite
from calib.estimation.convex.interior_point import Constrained, minimise
from calib.estimation.triangles import retriangulate


def within(
    factor: np.ndarray, matrix: np.ndarray, lower: np.ndarray, upper: np.ndarray, matrices: Definite | None = None
) -> Constrained:
    """Minimise ½ ‖R b - z‖² under lower <= A b <= upper, with equality where both are the same, and definite matrices.

    Infinite bounds are left out. Multipliers, slack, binding and normals come in the order of the finite lower bounds,
    the finite upper ones, the matrices, the equalities, whose multipliers have either sign.

    Args:
        factor: (p + 1, p + 1) triangle [R z; 0 ρ], R of full rank.
        matrix: A (c, p); the identity for bounds on single parameters.
        lower, upper: (c,), -inf and inf allowed.
        matrices: that must be positive definite; None: none.

    Raises:
        CalibError: for crossed bounds, and for equalities that contradict each other or leave nothing to estimate.
        NotConverged: where inequalities contradict each other, or no point makes the matrices definite.
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
    rows, offset = np.vstack([matrix[low], -matrix[high]]), np.concatenate([-lower[low], upper[high]])
    equal, held = matrix[same], lower[same]

    def solve(used: int) -> Constrained:
        if len(equal):
            return _on_equalities(factor, rows[:used], offset[:used], equal, held)
        return minimise(factor, rows[:used], offset[:used])

    found = _on_bounds(factor, solve(0), rows[:0], offset[:0])
    if (rows @ found.values + offset < 0.0).any():  # else the optimum without them is that of the whole problem
        found = _on_bounds(factor, solve(len(rows)), rows, offset)
    else:
        found = _widened(found, 0, rows, rows @ found.values + offset)
    if matrices is None:
        return found
    sizes, normals = matrices.least_eigenvalues(found.values)
    if matrices.satisfied(sizes):
        return _widened(found, len(rows), normals, sizes)
    return definite.minimise(factor, rows, offset, equal, held, matrices)


def _on_bounds(factor: np.ndarray, found: Constrained, rows: np.ndarray, offset: np.ndarray) -> Constrained:
    """Return the optimum under linear constraints exactly on those that bind; the barrier keeps it √`TOLERANCE` off.

    Left as it is where it is degenerate: a multiplier of an inequality would change sign, or another be violated.
    """
    if not found.binding.any():
        return found
    p, normals = len(found.values), found.normals[found.binding]
    free = scipy.linalg.solve_triangular(factor[:p, :p], factor[:p, p])
    apart = np.zeros(len(found.slack))
    apart[: len(rows)] = rows @ found.values + offset
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
    if (slack < 0.0).any() or (multipliers[: len(rows)] < 0.0).any() or away > 1e-3:
        return found
    return replace(found, values=frozen(values), slack=frozen(slack), multipliers=frozen(multipliers))


def _widened(found: Constrained, place: int, normals: np.ndarray, slack: np.ndarray) -> Constrained:
    """Return the optimum with further inequalities, none of which binds, from `place` on."""
    zero = np.zeros(len(slack))
    return replace(
        found, multipliers=frozen(np.insert(found.multipliers, place, zero)),
        slack=frozen(np.insert(found.slack, place, slack)),
        binding=frozen(np.insert(found.binding, place, zero > 0.0), bool),
        normals=frozen(np.insert(found.normals, place, normals, axis=0)),
    )  # fmt: skip


def _on_equalities(
    factor: np.ndarray, rows: np.ndarray, offset: np.ndarray, equal: np.ndarray, held: np.ndarray
) -> Constrained:
    """Minimise over b = b0 + N t, E N = 0, E b0 = d, in units that give the columns of R unit norm."""
    p = len(factor) - 1
    norms = np.linalg.norm(factor[:p, :p], axis=0)
    unit = 1.0 / np.where(norms > 0.0, norms, 1.0)
    scaled = equal * unit
    size = np.linalg.norm(scaled, axis=1)
    if not size.all():
        raise CalibError(f"equality {int(np.argmin(size)) + 1} acts on no parameter")
    left, values, right = np.linalg.svd(scaled / size[:, None])
    rank = int(np.sum(values > 1e-10 * values[0]))
    origin = right[:rank].T @ ((left[:, :rank].T @ (held / size)) / values[:rank])
    away = np.abs(scaled @ origin - held) / np.maximum(np.abs(held), size * max(float(np.abs(origin).max()), 1e-300))
    require(away.max() <= 1e-8, "equalities contradict each other: no point satisfies all of them")
    require(rank != p, f"equalities fix all {p} parameters: they leave nothing to estimate")
    origin, basis = unit * origin, unit[:, None] * right[rank:].T
    reduced = retriangulate(np.column_stack([factor[:, :p] @ basis, factor[:, p] - factor[:, :p] @ origin]))
    found = minimise(reduced[: p - rank + 1], rows @ basis, rows @ origin + offset)
    whole = origin + basis @ found.values
    slope = factor[:p, :p].T @ (factor[:p, :p] @ whole - factor[:p, p]) - rows.T @ found.multipliers
    pushing = np.linalg.lstsq((scaled / size[:, None]).T, slope * unit)[0] / size
    return replace(
        found, values=frozen(whole), covariance=frozen(basis @ found.covariance @ basis.T),
        multipliers=frozen(np.append(found.multipliers, pushing)),
        slack=frozen(np.append(found.slack, np.zeros(len(equal)))),
        binding=frozen(np.append(found.binding, np.ones(len(equal), bool)), bool),
        normals=frozen(np.vstack([rows, equal])),
    )  # fmt: skip
