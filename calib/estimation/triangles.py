"""R factors ("triangles") of [W y], one per group of rows, which contain all information of y = W x.

For seven joints with 100 parameters, an hour at 1 kHz is a matrix of 20 GB but a triangle of 80 kB. Triangles are
updated with one block of rows at a time. One triangle per group (a joint, a load case, a file) is stored, so that
weights may change afterwards without another pass over the data: the weighted problem is the QR of the stacked R_g /
σ_g. WᵀW is never formed, so the triangles are as accurate as a QR of the whole matrix.
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
# rows per factorisation: bounds the working memory, 16 MB at 100 parameters
CHUNK = 20_000
# columns of LAPACK's panels; of 8 to 32 the fastest for 1000 rows and 10 to 70 columns
PANEL = 8
# singular values of unit-norm columns below this part of the largest are rounding
RESOLUTION = 1e-10
# part in a null direction from which on a column is named
MIN_PART = 0.01


@dataclass(frozen=True, eq=False)
class Triangles:
    """R factors of [W y], one per group of rows.

    Attributes:
        names, units: names and units of the p parameters (columns of W).
        factors: (g, p + 1, p + 1) upper triangular matrices; the last column contains y.
        rows: (g,) number of rows absorbed so far in each group.
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
        """Return ‖y_g - W_g x‖² of every group (g,) for parameter values x (p,)."""
        return np.sum((self.factors @ np.append(values, -1.0)) ** 2, axis=1)

    def relative_errors(self, values: np.ndarray) -> np.ndarray:
        """Return 100 ‖y_g - W_g x‖ / ‖y_g‖ [%] of every group (g,) for parameter values x (p,); 0 where y_g is zero."""
        size = self.residual_squares(np.zeros(self.parameters))
        ratio = self.residual_squares(values) / np.where(size > 0.0, size, np.inf)
        return 100.0 * np.sqrt(ratio)

    def select(self, columns: np.ndarray) -> Triangles:
        """Return the R factors of the model with only the columns at the indices `columns`, in their given order."""
        columns = np.asarray(columns, dtype=int)
        with_target = np.append(columns, self.parameters)
        factors = np.stack([retriangulate(factor[:, with_target]) for factor in self.factors])
        names = tuple(self.names[k] for k in columns)
        units = tuple(self.units[k] for k in columns)
        return Triangles(names, units, frozen(factors), self.rows)


def empty(names: Sequence[str], units: Sequence[str] | None = None, groups: int = 1) -> Triangles:
    """Return the R factors of a problem without rows.

    Args:
        names: names of the parameters.
        units: their units; None: units are unknown (empty strings).
        groups: number of groups of rows.
    """
    p = len(names)
    if units is None:
        units = [""] * p
    require(len(units) == p, f"{p} parameter names but {len(units)} units")
    factors = frozen(np.zeros((groups, p + 1, p + 1)))
    return Triangles(tuple(names), tuple(units), factors, frozen(np.zeros(groups), int))


def absorb(data: Triangles, matrix: np.ndarray, target: np.ndarray, group: np.ndarray | int = 0) -> Triangles:
    """Return the R factors updated with more rows: R_g becomes the R factor of [R_g; W_g y_g].

    Columns that are zero in all rows of a group cost no time (the torque of a joint does not depend on the links before
    it).

    Args:
        data: triangles of the previous rows.
        matrix: (r, p) rows of W.
        target: (r,) rows of y.
        group: (r,) group index of each row, or one integer for all rows.

    Raises:
        CalibError: for a group index outside 0 … g - 1, or a wrong shape.
    """
    matrix = shaped(matrix, (None, data.parameters), "observation matrix W")
    target = shaped(target, (len(matrix),), "target y")
    if not len(matrix):
        return data
    index = np.asarray(group, dtype=int)
    groups = np.unique(index)
    if not 0 <= groups[0] <= groups[-1] < data.groups:
        raise CalibError(f"rows belong to groups {groups[0]} to {groups[-1]}, but there are {data.groups} groups")
    factors = np.array(data.factors)
    rows = np.array(data.rows)
    for g in groups:
        # no copies of rows that are all of one group
        group_rows = np.flatnonzero(index == g) if index.ndim else None
        count = len(matrix) if group_rows is None else len(group_rows)
        rows[g] += count
        for start in range(0, count, CHUNK):
            part = slice(start, start + CHUNK)
            if group_rows is not None:
                part = group_rows[part]
            factors[g] = _update(factors[g], matrix[part], target[part])
    return replace(data, factors=frozen(factors), rows=frozen(rows, int))


def collect(
    matrix: np.ndarray,
    target: np.ndarray,
    group: np.ndarray | None = None,
    names: Sequence[str] | None = None,
    units: Sequence[str] | None = None,
) -> Triangles:
    """Return the R factors of a whole problem.

    Args:
        matrix: (r, p) W, the observation matrix.
        target: (r,) y, the measured values.
        group: (r,) group index of each row; None: all rows form one group.
        names: names of the p columns; None: x1, x2, …
        units: units of the parameters; None: unknown.
    """
    matrix = shaped(matrix, (None, None), "observation matrix W")
    if names is None:
        names = [f"x{k + 1}" for k in range(matrix.shape[1])]
    if group is None:
        return absorb(empty(names, units), matrix, target)
    groups = 1 if len(group) == 0 else int(np.max(group)) + 1
    return absorb(empty(names, units, groups), matrix, target, group)


def combine(data: Triangles, std: np.ndarray | None = None) -> np.ndarray:
    """Return the R factor (p + 1, p + 1) of all rows together, with the rows of group g divided by std[g].

    Args:
        data: R factors of the groups.
        std: (g,) noise standard deviation of each group of rows, in units of y; None: rows are not divided.

    Raises:
        CalibError: for a standard deviation that is not positive.
    """
    scale = np.ones(data.groups)
    if std is not None:
        scale = shaped(std, (data.groups,), "standard deviation per group")
    if (scale <= 0.0).any():
        raise CalibError(f"standard deviations per group must be positive, smallest is {scale.min()}")
    size = data.parameters + 1
    weighted = data.factors / scale[:, None, None]
    return retriangulate(weighted.reshape(data.groups * size, size))


def retriangulate(stacked: np.ndarray, overwrite: bool = False) -> np.ndarray:
    """Return the R factor of a matrix (N, k) as an upper triangular matrix (k, k), with zero rows if N < k.

    Args:
        stacked: the matrix (N, k).
        overwrite: whether the matrix may be overwritten, which saves a copy.
    """
    size = stacked.shape[1]
    result = np.zeros((size, size))
    if stacked.size:
        packed = dgeqrf(stacked, lwork=32 * size, overwrite_a=overwrite)[0][:size]
        height = len(packed)
        np.copyto(result[:height], packed, where=_upper(size)[:height])
    return result


def continued(upper: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Return the R factor (k, k) of [upper; rows], for a triangle `upper` (k, k) and more rows (N, k).

    Householder reflections, as in `retriangulate`, in half the time thanks to narrow panels. Both arguments may be
    overwritten.
    """
    panel = min(PANEL, len(upper))
    triangle = np.array(upper, order="F")
    return dtpqrt(0, panel, triangle, np.asfortranarray(rows), overwrite_a=True, overwrite_b=True)[0]


@lru_cache(maxsize=256)
def _upper(size: int) -> np.ndarray:
    return np.triu(np.ones((size, size), dtype=bool))


def condition_numbers(factor: np.ndarray) -> tuple[float, float]:
    """Return two condition numbers of W: as it is, and with columns scaled to unit norm. Zero columns are ignored.

    Zero columns are those of parameters without effect, e.g. of a joint at rest. Both numbers are infinite if all
    columns are zero.

    Args:
        factor: W (rows, p), or any triangular factor of it.
    """
    norms = np.linalg.norm(factor, axis=0)
    excited = norms > 0.0
    columns = factor[:, excited]
    if not columns.size:
        return float("inf"), float("inf")
    values = np.linalg.svd(columns, compute_uv=False)
    normed_values = np.linalg.svd(columns / norms[excited], compute_uv=False)
    return _ratio(values), _ratio(normed_values)


def solve_triangle(factor: np.ndarray, names: Sequence[str]) -> tuple[np.ndarray, np.ndarray, tuple[float, float]]:
    """Return x, R⁻¹ and the condition numbers of W, from the R factor [R z; 0 ρ] of [W y], by solving R x = z.

    The two condition numbers are those of W as it is and of W with unit-norm columns.

    Args:
        factor: (p + 1, p + 1) R factor of [W y], observation matrix and measured values.
        names: names of the p columns, for the error message.

    Raises:
        Unidentifiable: if columns are linearly dependent; the message names them.
    """
    p = len(names)
    upper = factor[:p, :p]
    norms = np.linalg.norm(upper, axis=0)
    scaled = upper / np.where(norms > 0.0, norms, 1.0)
    scaled_values = require_rank(scaled, names)
    inverse = np.asarray(scipy.linalg.solve_triangular(scaled, np.eye(p))) / norms[:, None]
    solution = np.asarray(scipy.linalg.solve_triangular(scaled, factor[:p, p])) / norms
    values = np.linalg.svd(upper, compute_uv=False)
    return solution, inverse, (_ratio(values), _ratio(scaled_values))


def require_rank(scaled: np.ndarray, names: Sequence[str], advice: str = ADVICE) -> np.ndarray:
    """Return the singular values of a matrix with columns of comparable norms, if its columns are independent.

    Args:
        scaled: (rows, p) matrix, or its R factor.
        names: names of the p columns.
        advice: end of the error message: what the user can do.

    Raises:
        Unidentifiable: if columns are linearly dependent; the message names the columns with a part in a null
            direction.
    """
    values = np.linalg.svd(scaled, compute_uv=False)
    weak = np.ones(len(values), dtype=bool)
    if values[0] > 0.0:
        weak = values <= RESOLUTION * values[0]
    if not weak.any():
        return values
    null_directions = np.linalg.svd(scaled)[2][weak]
    parts = np.linalg.norm(null_directions, axis=0)
    concerned = [name for name, part in zip(names, parts) if part > MIN_PART]
    message = f"{int(weak.sum())} combination(s) of {len(names)} parameters have no effect on the data"
    raise Unidentifiable(f"{message}: {listing(concerned)}; {advice}", concerned, values)


def _update(factor: np.ndarray, matrix: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return the R factor of [factor; matrix target]; columns that are zero in both are skipped.

    Args:
        factor: (p + 1, p + 1) R factor of the rows absorbed so far.
        matrix, target: (r, p) and (r,), further rows of W and y.
    """
    top = factor[factor.any(axis=1)]
    in_matrix = np.append(matrix.any(axis=0), True)
    live = np.flatnonzero(in_matrix | top.any(axis=0))
    stacked = np.empty((len(top) + len(matrix), len(live)), order="F")
    stacked[: len(top)] = top[:, live]
    stacked[len(top) :, :-1] = matrix[:, live[:-1]]
    stacked[len(top) :, -1] = target
    result = np.zeros_like(factor)
    # live[i] >= i: still upper triangular
    result[: len(live), live] = retriangulate(stacked, overwrite=True)
    return result


def _ratio(values: np.ndarray) -> float:
    """Return the condition number from singular values in descending order; infinite for a singular matrix."""
    if values[-1] > 0.0:
        return float(values[0] / values[-1])
    return float("inf")
