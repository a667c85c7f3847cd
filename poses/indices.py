"""Observability indices of a set of poses, with their gradients.

``s1 >= ... >= sp`` are the singular values of the whitened observation matrix W of m poses, U and V its singular
vectors.

========  =========================  =========  =========================================================== index
formula                    direction  source
========  =========================  =========  ===========================================================
``O1``    (s1 s2 ... sp)^(1/p)/√m    maximise   Borm & Menq 1989/1991 (D-optimality: det(WᵀW)^(1/2p)/√m)
``O2``    sp / s1                    maximise   Driels & Pathre 1990
``O3``    sp                         maximise   Nahvi, Hollerbach & Hayward 1994 (E-optimality)
``O4``    sp² / s1                   maximise   Nahvi & Hollerbach 1996 (noise amplification index)
``O5``    1 / (1/s1 + ... + 1/sp)    maximise   Sun & Hollerbach 2008 (some write p over the sum)
``cond``  s1 / sp                    minimise   = 1/O2; the number the LWR4+ study minimises
========  =========================  =========  ===========================================================

O1 is the default everywhere in this package: multiplying a column of W (changing the unit of a parameter) multiplies O1
of *every* set by the same factor, so the ranking of sets by O1 does not depend on units. The ranking by O2-O5 and cond
does.
"""

from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from .errors import BadInput, require

Index = Literal["O1", "O2", "O3", "O4", "O5", "cond"]
_POWERS = {"O2": (1.0, 1.0), "O3": (1.0, 0.0), "O4": (2.0, 1.0), "cond": (1.0, 1.0)}  # merit = a log sp − b log s1


def observability(W: ArrayLike, index: Index = "O1", m: int | None = None) -> float:
    """Return an observability index of a set of poses, by the formulas of the module's docstring.

    Args:
        W: (m, rows, p) whitened Jacobians of the poses, or the same Jacobians stacked to (m rows, p). Rows have no
            unit.
        index: one of "O1" ... "O5", "cond".
        m: number of poses; only needed for O1 of a stacked W. None takes the length of W.

    Returns:
        The index; 0 (infinity for cond) where W has not full column rank.
    """
    stacked, poses = _stacked(W, index, m)
    if len(stacked) < stacked.shape[1]:
        return np.inf if index == "cond" else 0.0
    singular_values = np.linalg.svd(stacked, compute_uv=False)
    return float(index_of_singular_values(singular_values, index, poses))


def gradient(W: ArrayLike, index: Index = "O1", m: int | None = None) -> tuple[float, np.ndarray]:
    """Return an index and its gradient with respect to W.

    ∂O/∂W = U diag(∂O/∂s) Vᵀ, because ∂s_i/∂W = u_i v_iᵀ. For O1 and O5, which are symmetric and smooth in s, this
    gradient is valid for any s. For O2, O3, O4 and cond it exists only where the smallest and largest singular values
    are distinct from the others; elsewhere the result is one of many subgradients.

    Args:
        W: (m, rows, p) or (m rows, p), of full column rank.
        index, m: as in `observability`.

    Returns:
        The index, and the gradient in the shape of W.
    """
    stacked, poses = _stacked(W, index, m)
    u, s, vt = np.linalg.svd(stacked, full_matrices=False)
    value = float(index_of_singular_values(s, index, poses))
    slope = (u * (value * log_slope(s, index))) @ vt
    return value, slope.reshape(np.shape(W))


def merit(W: np.ndarray, index: Index, sharpness: float = np.inf) -> tuple[float, np.ndarray]:
    """Return the merit that the searches maximise, log O (−log cond; O1 with m = 1), and its gradient by W.

    O2, O3, O4 and cond have kinks where singular values coincide, and their optima lie at such kinks. A finite
    sharpness a replaces log s1 by (1/a) log Σ s_i^a and log sp by −(1/a) log Σ s_i^−a. Both are smooth and at most
    log(p)/a too pessimistic. The gradient of the smoothed merit is exact.

    Args:
        W: (rows in all, p) stacked observation matrix.
        index: the observability index to maximise.
        sharpness: a; infinite for no smoothing.

    Returns:
        The merit (−inf without full column rank) and its gradient (rows in all, p).
    """
    u, s, vt = np.linalg.svd(W, full_matrices=False)
    if len(s) < W.shape[1] or s[-1] <= 1e-14 * s[0]:
        return -np.inf, np.zeros_like(W)
    if index in ("O1", "O5") or not np.isfinite(sharpness):
        sign = -1.0 if index == "cond" else 1.0
        value = sign * float(np.log(index_of_singular_values(s, index, 1)))
        slope = (u * (sign * log_slope(s, index))) @ vt
        return value, slope
    high, by_high = _soft_maximum(np.log(s), sharpness)
    low, by_low = _soft_maximum(-np.log(s), sharpness)
    below, above = _POWERS[index]
    slope = (below * by_low - above * by_high) / s
    return -below * low - above * high, (u * slope) @ vt


def index_of_singular_values(s: np.ndarray, index: Index, m: int) -> np.ndarray:
    """Return the observability index from singular values (last axis, largest first).

    Args:
        s: (..., p) singular values of the whitened observation matrix W of all poses.
        index: one of "O1" ... "O5", "cond".
        m: number of poses (used by O1).

    Returns:
        (...) indices.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        if index == "O1":
            mean_log = np.log(s).mean(-1)
            return np.exp(mean_log) / np.sqrt(m)
        if index == "O2":
            return s[..., -1] / s[..., 0]
        if index == "O3":
            return s[..., -1]
        if index == "O4":
            return s[..., -1] ** 2 / s[..., 0]
        if index == "O5":
            return 1.0 / (1.0 / s).sum(-1)
        if index == "cond":
            return s[..., 0] / s[..., -1]
    names = ", ".join(get_args(Index))
    raise BadInput(f"index '{index}' is not known; take one of {names}")


def has_kinks(index: Index) -> bool:
    """Return whether an index depends on single singular values, so that its `merit` needs smoothing."""
    return index in _POWERS


def log_slope(s: np.ndarray, index: Index) -> np.ndarray:
    """Return ∂ log O / ∂s (p,) at the singular values s (p,), largest first.

    Args:
        s: (p,) singular values of the whitened observation matrix.
        index: observability index O, "O1" ... "O5" or "cond".
    """
    slope = np.zeros_like(s)
    if index == "O1":
        return 1.0 / (len(s) * s)
    if index == "O5":
        return s**-2.0 / (1.0 / s).sum()
    below, above = _POWERS[index]
    sign = -1.0 if index == "cond" else 1.0
    slope[-1] = sign * below / s[-1]
    slope[0] -= sign * above / s[0]
    return slope


def _soft_maximum(values: np.ndarray, sharpness: float) -> tuple[float, np.ndarray]:
    """Return the smooth maximum (1/a) log Σ exp(a x) of `values` x with a = `sharpness`, and its derivatives by x.

    The derivatives sum to 1.
    """
    top = values.max()
    weights = np.exp(sharpness * (values - top))
    total = weights.sum()
    return float(top + np.log(total) / sharpness), weights / total


def _stacked(W: ArrayLike, index: Index, m: int | None) -> tuple[np.ndarray, int]:
    """Return W, checked and stacked to (m rows, p), and the number of poses m.

    Args:
        W: (m, rows, p) or (m rows, p) Jacobians of the poses.
        index: one of "O1" ... "O5", "cond".
        m: number of poses; None takes the length of a W with three axes.

    Raises:
        BadInput: an unknown index, a wrong shape, values that are not finite, or no `m` where O1 needs it.
    """
    if index not in get_args(Index):
        names = ", ".join(get_args(Index))
        raise BadInput(f"index '{index}' is not known; take one of {names}")
    array = np.asarray(W, dtype=float)
    require(array.ndim in (2, 3) and array.size, f"W: expected (m, rows, p) or (m rows, p), found {array.shape}")
    if not np.isfinite(array).all():
        raise BadInput("W contains values that are not finite; check for poses outside the model's domain")
    if array.ndim == 2 and m is None and index == "O1":
        raise BadInput("O1 of a stacked W needs the number of poses: give m, or W as (m, rows, p)")
    if m is not None:
        poses = m
    else:
        poses = len(array)
    return array.reshape(-1, array.shape[-1]), poses
