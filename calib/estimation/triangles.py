"""All information of y = W x in triangles, the R factors of [W y] of each group of rows, updated block by block.

An hour at 1 kHz of seven joints with 100 parameters is a matrix of 20 GB and a triangle of 80 kB. One triangle is kept
per group (a joint, a load case, a file), so that weights may change afterwards without another pass over the data: the
weighted problem is the QR of the stacked R_g / σ_g. Nothing is squared on the way: what QR of the whole matrix can
resolve, the triangles resolve too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import scipy.linalg
from scipy.linalg.lapack import dgeqrf, dtpqrt  # type: ignore[attr-defined]

from calib.errors import CalibError, Unidentifiable, listing, require
from calib.records import frozen, shaped

ADVICE = "choose base columns first (columns.split_columns), or add motion that distinguishes them"


@dataclass(frozen=True, eq=False)
class Triangles:
    """R factors of [W y], one per group of rows.

    Attributes:
        names, units: p strings each, of the columns of W.
        factors: (g, p + 1, p + 1) upper triangular; its last column belongs to y.
        rows: (g,) rows absorbed so far.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    factors: np.ndarray
    rows: np.ndarray

    @property
    def groups(self) -> int:
        return len(self.rows)

    @property
    def parameters(self) -> int:
        return len(self.names)

    def residual_squares(self, values: np.ndarray) -> np.ndarray:
        """Return ‖y_g - W_g x‖² of every group (g,), from the R factors alone."""
        return np.sum((self.factors @ np.append(values, -1.0)) ** 2, axis=1)

    def relative_errors(self, values: np.ndarray) -> np.ndarray:
        """Return 100 ‖y_g - W_g x‖ / ‖y_g‖ [%] of every group (g,); 0 where y_g is."""
        size = self.residual_squares(np.zeros(self.parameters))
        return 100.0 * np.sqrt(self.residual_squares(values) / np.where(size > 0.0, size, np.inf))

    def select(self, columns: np.ndarray) -> Triangles:
        """Return the R factors of the model with only these columns, in the given order."""
        columns = np.asarray(columns, dtype=int)
        wanted = np.append(columns, self.parameters)
        factors = [retriangulate(factor[:, wanted]) for factor in self.factors]
        names = tuple(self.names[k] for k in columns)
        return Triangles(names, tuple(self.units[k] for k in columns), frozen(np.stack(factors)), self.rows)


def empty(names: Sequence[str], units: Sequence[str] | None = None, groups: int = 1) -> Triangles:
    """Return empty R factors, of a problem without rows."""
    p = len(names)
    given = tuple(units) if units is not None else ("",) * p
    require(len(given) == p, f"{p} parameter names but {len(given)} units")
    return Triangles(tuple(names), given, frozen(np.zeros((groups, p + 1, p + 1))), frozen(np.zeros(groups), int))


def absorb(data: Triangles, matrix: np.ndarray, target: np.ndarray, group: np.ndarray | int = 0) -> Triangles:
    """Return the R factors updated by more rows: R_g becomes the R of [R_g; W_g y_g].

    Columns that are zero in all rows of a group (a joint does not feel the links before it) cost nothing.

    Args:
        data: triangles of the previous rows.
        matrix: (r, p) rows of W.
        target: (r,) rows of y.
        group: (r,) group index of each row, or one integer for all.
    """
    matrix = shaped(matrix, (None, data.parameters), "observation matrix W")
    target = shaped(target, (len(matrix),), "target y")
    index = np.asarray(group, dtype=int)
    found = np.unique(index)
    if len(matrix) and not 0 <= found[0] <= found[-1] < data.groups:
        raise CalibError(f"rows belong to groups {found[0]} to {found[-1]}, but there are {data.groups} groups")
    factors, rows = np.array(data.factors), np.array(data.rows)
    chunk = 20_000  # rows per factorisation: bounds the working memory, 16 MB at 100 parameters
    for g in found if len(matrix) else ():
        own = np.flatnonzero(index == g) if index.ndim else None  # no copies of rows that are all of one group
        count = len(matrix) if own is None else len(own)
        rows[g] += count
        for start in range(0, count, chunk):
            part = slice(start, start + chunk) if own is None else own[start : start + chunk]
            factors[g] = _update(factors[g], matrix[part], target[part])
    return replace(data, factors=frozen(factors), rows=frozen(rows, int))


def collect(
    matrix: np.ndarray,
    target: np.ndarray,
    group: np.ndarray | None = None,
    names: Sequence[str] | None = None,
    units: Sequence[str] | None = None,
) -> Triangles:
    """Return the R factors of a whole problem; without names the columns are called x1, x2, …"""
    matrix = shaped(matrix, (None, None), "observation matrix W")
    count = 1 if group is None or len(group) == 0 else int(np.max(group)) + 1
    names = names if names is not None else [f"x{k + 1}" for k in range(matrix.shape[1])]
    return absorb(empty(names, units, count), matrix, target, 0 if group is None else group)


def combine(data: Triangles, std: np.ndarray | None = None) -> np.ndarray:
    """Return the R factor (p + 1, p + 1) of all rows, those of group g divided by std[g] (None: by one)."""
    scale = np.ones(data.groups) if std is None else shaped(std, (data.groups,), "standard deviation per group")
    if (scale <= 0.0).any():
        raise CalibError(f"standard deviations per group must be positive, smallest is {scale.min()}")
    size = data.parameters + 1
    return retriangulate((data.factors / scale[:, None, None]).reshape(data.groups * size, size))


def retriangulate(stacked: np.ndarray, overwrite: bool = False) -> np.ndarray:
    """Return the R factor of any matrix as a square upper triangular matrix, padded with zero rows."""
    size = stacked.shape[1]
    result = np.zeros((size, size))
    if stacked.size:
        packed = dgeqrf(stacked, lwork=32 * size, overwrite_a=overwrite)[0][:size]
        np.copyto(result[: len(packed)], packed, where=_upper(size)[: len(packed)])
    return result


def continued(upper: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Return the R factor (k, k) of [upper; rows], of a triangle (k, k) and more rows (N, k), which are overwritten.

    Householder's way as in `retriangulate`, in half the time, since the panels are narrow.
    """
    panel = min(8, len(upper))  # columns; of 8 to 32 the fastest for 1000 rows and 10 to 70 columns
    return dtpqrt(0, panel, np.array(upper, order="F"), np.asfortranarray(rows), overwrite_a=True, overwrite_b=True)[0]


@lru_cache(maxsize=256)
def _upper(size: int) -> np.ndarray:
    return np.triu(np.ones((size, size), dtype=bool))


def condition_numbers(factor: np.ndarray) -> tuple[float, float]:
    """Return cond(W) and cond(W with unit-norm columns) from W or any R factor of it; zero columns are left out.

    Such columns belong to parameters without rows, e.g. of a joint that stands; infinite where all columns are.
    """
    norms = np.linalg.norm(factor, axis=0)
    excited = factor[:, norms > 0.0]
    if not excited.size:
        return float("inf"), float("inf")
    normed = excited / norms[norms > 0.0]
    return _ratio(np.linalg.svd(excited, compute_uv=False)), _ratio(np.linalg.svd(normed, compute_uv=False))


def solve_triangle(factor: np.ndarray, names: Sequence[str]) -> tuple[np.ndarray, np.ndarray, tuple[float, float]]:
    """Solve R x = z from the R factor [R z; 0 ρ] of [W y]; return x, R⁻¹ and the condition numbers of W.

    Raises:
        Unidentifiable: naming the columns that take part in a dependence.
    """
    p = len(names)
    upper = factor[:p, :p]
    norms = np.linalg.norm(upper, axis=0)
    scaled = upper / np.where(norms > 0.0, norms, 1.0)
    values = require_rank(scaled, names)
    inverse = np.asarray(scipy.linalg.solve_triangular(scaled, np.eye(p))) / norms[:, None]
    solution = np.asarray(scipy.linalg.solve_triangular(scaled, factor[:p, p])) / norms
    return solution, inverse, (_ratio(np.linalg.svd(upper, compute_uv=False)), _ratio(values))


def require_rank(scaled: np.ndarray, names: Sequence[str], advice: str = ADVICE) -> np.ndarray:
    """Return the singular values of a matrix with columns of comparable size; refuse dependent columns by name.

    Raises:
        Unidentifiable: naming every column with a part in a null direction.
    """
    values = np.linalg.svd(scaled, compute_uv=False)
    resolution = 1e-10  # singular values of unit-norm columns below this part of the largest are rounding
    weak = values <= resolution * values[0] if values[0] > 0.0 else np.ones(len(values), dtype=bool)
    if not weak.any():
        return values
    part = np.linalg.norm(np.linalg.svd(scaled)[2][weak], axis=0)
    concerned = [name for name, size in zip(names, part) if size > 0.01]
    message = f"{int(weak.sum())} combination(s) of {len(names)} parameters have no effect on the data"
    raise Unidentifiable(f"{message}: {listing(concerned)}; {advice}", concerned, values)


def _update(factor: np.ndarray, matrix: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return the R of [factor; matrix target], factorising non-zero columns only."""
    old = factor[factor.any(axis=1)]
    live = np.flatnonzero(np.append(matrix.any(axis=0), True) | old.any(axis=0))
    stacked = np.empty((len(old) + len(matrix), len(live)), order="F")
    stacked[: len(old)] = old[:, live]
    stacked[len(old) :, :-1] = matrix[:, live[:-1]]
    stacked[len(old) :, -1] = target
    result = np.zeros_like(factor)
    result[: len(live), live] = retriangulate(stacked, overwrite=True)  # live[i] >= i: still upper triangular
    return result


def _ratio(values: np.ndarray) -> float:
    return float(values[0] / values[-1]) if values[-1] > 0.0 else float("inf")
