"""Choice of linearly independent columns of an observation matrix W, for geometry and dynamics."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg

from calib.records import frozen

# norm of a column relative to the largest below which it has no effect
NO_EFFECT = 1e-12
# relative difference of norms within which columns enter in their own order
TIE = 1e-3


@dataclass(frozen=True, eq=False)
class ColumnSplit:
    """Columns of an observation matrix W (rows, p), split into independent columns and linear combinations of them.

    Attributes:
        kept: (b,) indices of the independent (base) columns, ascending.
        dropped: (p - b,) indices of all other columns, including columns that are zero.
        without_effect: indices of the columns that are zero.
        coefficients: (b, p - b) with ``W[:, dropped] = W[:, kept] @ coefficients`` up to the tolerance.
        singular_values: (p,) singular values of W with its non-zero columns scaled to unit norm, descending.
        tolerance: norm below which the independent part of a unit-norm column counts as zero.
    """

    kept: np.ndarray
    dropped: np.ndarray
    without_effect: np.ndarray
    coefficients: np.ndarray
    singular_values: np.ndarray
    tolerance: float

    @property
    def rank(self) -> int:
        return len(self.kept)

    @property
    def gap(self) -> float:
        """Ratio of the smallest kept to the largest dropped singular value; infinite if no column is dropped."""
        values = self.singular_values
        if self.rank >= len(values) or values[self.rank] == 0.0:
            return float("inf")
        return float(values[self.rank - 1] / values[self.rank])


def split_columns(
    matrix: np.ndarray, groups: Sequence[np.ndarray] | None = None, tolerance: float = 1e-6
) -> ColumnSplit:
    """Return a choice of independent columns of W by pivoted QR, preferring the columns of the first groups.

    Groups are processed in turn. Within a group, pivoted QR chooses the columns (Gautier 1991); of two nearly
    equivalent columns the earlier is chosen, so that rounding does not decide. A later group adds only columns that are
    independent of the earlier groups. All columns are first scaled to unit norm, except columns of negligible norm,
    which count as zero (scaling a column of norm 1e-17 would turn rounding into information).

    Args:
        matrix: observation matrix W (rows, p), its rows divided by their standard deviations or all in one unit.
        groups: arrays of column indices, one per group, most preferred group first; columns in no group form a last
            group. None: one group of all columns.
        tolerance: norm below which the independent part of a unit-norm column counts as zero.
    """
    p = matrix.shape[1]
    factor = np.asarray(matrix, dtype=float)
    if matrix.shape[0] > p:
        factor = np.linalg.qr(matrix, mode="r")
    norms = np.linalg.norm(factor, axis=0)
    silent = norms <= NO_EFFECT * norms.max(initial=0.0)
    divisor = np.where(silent, 1.0, norms)
    scaled = factor / divisor
    scaled[:, silent] = 0.0
    base = _independent(scaled, _with_all_columns(groups, p), np.flatnonzero(silent), tolerance)
    dropped = np.setdiff1d(np.arange(p), base)
    coefficients = np.linalg.lstsq(scaled[:, base], scaled[:, dropped], rcond=None)[0]
    if len(base):
        coefficients = coefficients * divisor[dropped] / divisor[base][:, None]
    values = np.linalg.svd(scaled, compute_uv=False)
    values = np.concatenate([values, np.zeros(p - len(values))])
    return ColumnSplit(
        kept=frozen(base, int),
        dropped=frozen(dropped, int),
        without_effect=frozen(np.flatnonzero(silent), int),
        coefficients=frozen(coefficients),
        singular_values=frozen(values),
        tolerance=tolerance,
    )


def _with_all_columns(groups: Sequence[np.ndarray] | None, p: int) -> list[np.ndarray]:
    """Return the groups of column indices, with a last group of all columns 0 … p - 1 that are in no group.

    Args:
        groups: arrays of column indices, most preferred first; None: no groups.
        p: number of columns.
    """
    result: list[np.ndarray] = []
    remaining = np.arange(p)
    if groups is None:
        groups = []
    for group in groups:
        columns = np.asarray(group, dtype=int)
        result.append(columns)
        remaining = np.setdiff1d(remaining, columns)
    result.append(remaining)
    return result


def _independent(scaled: np.ndarray, groups: list[np.ndarray], silent: np.ndarray, tolerance: float) -> np.ndarray:
    """Return the sorted indices of independent columns, chosen group by group.

    Args:
        scaled: (rows, p) the matrix to split, with columns of unit norm or zero.
        groups: arrays of column indices, most preferred first.
        silent: indices of the zero columns, which are never chosen.
        tolerance: norm below which the independent part of a column counts as zero.
    """
    basis = np.zeros((scaled.shape[0], 0))
    independent: list[int] = []
    for group in groups:
        candidates = np.setdiff1d(group, silent)
        if len(candidates) == 0 or basis.shape[1] == scaled.shape[0]:
            continue
        remainder = scaled[:, candidates]
        # twice is enough (Kahan): orthogonal to rounding
        for _ in range(2):
            remainder = remainder - basis @ (basis.T @ remainder)
        # of columns of nearly equal norm the earlier enters first
        remainder = remainder * (1.0 - TIE * np.arange(len(candidates)) / len(candidates))
        factors = scipy.linalg.qr(remainder, mode="economic", pivoting=True)
        q, r, order = (np.asarray(factor) for factor in factors)
        count = int(np.sum(np.abs(np.diag(r)) > tolerance))
        independent.extend(candidates[order[:count]])
        basis = np.hstack([basis, q[:, :count]])
    return np.array(sorted(independent), dtype=int)
