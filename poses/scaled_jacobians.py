"""Check and scaling of the candidates' Jacobians, so that all parameters have equal weight."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import solve_triangular

from .errors import BadInput, NotIdentifiable, TooFewCandidates, require

# smallest accepted ratio of singular values of the column-scaled candidates (our choice; Gram matrices resolve 1e-8)
RANK_TOLERANCE = 1e-7


@dataclass(frozen=True)
class Candidates:
    """Candidates in coordinates z = J T, in which their mean information is the identity matrix.

    The D-optimal set does not depend on T (log det changes by a constant), but T improves the numerical accuracy.

    Attributes:
        z: (N, rows, p) transformed Jacobians.
        known: (p, p) transformed information of the poses already measured.
        transform: (p, p) T, upper triangular.
        shift: the constant in log det(WᵀW) = log det(ZᵀZ) + shift.
    """

    z: np.ndarray
    known: np.ndarray
    transform: np.ndarray
    shift: float


def checked(jacobians: ArrayLike, name: str = "jacobians") -> np.ndarray:
    """Return Jacobians as a finite, C-contiguous (N, rows, p) array of floats.

    Args:
        jacobians: the array to check.
        name: name of the argument, for messages.

    Raises:
        BadInput: an array of another shape, or with values that are not finite; the message names the first pose with
            such values.
    """
    array = np.ascontiguousarray(jacobians, dtype=float)
    if array.ndim != 3 or 0 in array.shape[1:]:
        raise BadInput(f"{name}: expected an array (N, rows, p), found shape {array.shape}")
    finite = np.isfinite(array).all(axis=(1, 2))
    if not finite.all():
        first = int(np.argmin(finite))
        bad_count = int((~finite).sum())
        raise BadInput(
            f"{name}: {bad_count} of {len(array)} poses have values that are not finite, the first is pose "
            f"{first}; check the model there, or exclude such poses by the predicate"
        )
    return array


def prepared(jacobians: ArrayLike, m: int, existing: ArrayLike | None = None) -> Candidates:
    """Return the candidates in well-scaled coordinates, after checking that m poses can determine all parameters.

    The coordinates are z = J T with T = D⁻¹ R⁻¹. D is the diagonal matrix of the columns' root mean squares, and RᵀR
    the mean information after scaling by D.

    Args:
        jacobians: (N, rows, p) Jacobians J of the candidates, each row divided by its standard deviation.
        m: number of poses to choose.
        existing: (k, rows, p) whitened Jacobians of poses already measured; None without such poses.

    Raises:
        BadInput: wrong shapes, values that are not finite, m below 1.
        TooFewCandidates: fewer candidates than m.
        NotIdentifiable: too few equations, a zero column, or candidates without full rank.
    """
    array = checked(jacobians)
    count, rows, p = array.shape
    before = np.zeros((0, rows, p))
    if existing is not None:
        before = checked(existing, "existing")
    if before.shape[2] != p:
        raise BadInput(f"existing: {before.shape[2]} parameters, but the candidates have {p}: use the same columns")
    measured_rows = before.shape[0] * before.shape[1]
    _check_counts(count, rows, p, m, measured_rows)
    stacked = array.reshape(-1, p)
    measured = before.reshape(-1, p)
    gram = (stacked.T @ stacked) / count
    past = measured.T @ measured
    past_diagonal = np.diag(past) / count
    scale = np.sqrt(np.diag(gram) + past_diagonal)
    _check_columns(scale)
    mean = (gram + past / count) / np.outer(scale, scale)
    _check_rank(mean)
    root = np.linalg.cholesky(mean).T
    inverse_root = solve_triangular(root, np.eye(p))
    transform = inverse_root / scale[:, None]
    known_information = transform.T @ past @ transform
    z = (stacked @ transform).reshape(array.shape)
    symmetric = (known_information + known_information.T) / 2
    shift = -2.0 * float(np.log(np.abs(np.diag(transform))).sum())
    return Candidates(z, symmetric, transform, shift)


def log_det(matrices: np.ndarray) -> np.ndarray:
    """Return log det of symmetric matrices (..., p, p); −inf where the determinant is not positive."""
    sign, value = np.linalg.slogdet(matrices)
    return np.where(sign > 0, value, -np.inf)


def _check_counts(count: int, rows: int, p: int, m: int, measured: int) -> None:
    require(m >= 1, f"m = {m}: choose at least one pose")
    if count < m:
        raise TooFewCandidates(
            f"{count} candidates for {m} poses: draw more candidates or ask for fewer poses", count, m
        )
    if m * rows + measured < p:
        before = ""
        if measured:
            before = f" and {measured} rows measured before"
        equations = m * rows + measured
        needed = -(-(p - measured) // rows)
        raise NotIdentifiable(
            f"{m} poses of {rows} rows{before} give {equations} equations for {p} parameters: at least {needed} poses "
            "needed"
        )


def _check_columns(scale: np.ndarray) -> None:
    # scaled up, a column of rounding errors would look healthy
    dead = np.flatnonzero(scale <= 1e-13 * scale.max())
    if len(dead):
        raise NotIdentifiable(
            f"columns {dead.tolist()} of the Jacobians are zero (to rounding) in every candidate: these parameters do "
            "not act on the measurement; keep base columns only"
        )


def _check_rank(mean: np.ndarray) -> None:
    values = np.linalg.eigvalsh(mean)[::-1]
    s = np.sqrt(np.maximum(values, 0.0))
    rank = int((s > RANK_TOLERANCE * s[0]).sum())
    if rank < len(s):
        raise NotIdentifiable(
            f"all candidates together have rank {rank} for {len(s)} parameters (smallest singular value ratio "
            f"{s[-1] / s[0]:.1e}): the columns are not base columns, or the candidates do not move enough joints",
            s,
        )
