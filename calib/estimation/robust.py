"""Weights of robust losses for the residuals of single rows, and variances estimated from squared errors.

A loss may also be a function ρ as `scipy.optimize.least_squares` takes it (`Loss`).

`variance_weights` estimates variances as a sum of known functions with unknown non-negative weights.
"""

from collections.abc import Callable
from inspect import signature

import numpy as np

from calib.errors import UsageError, require

Loss = Callable[[np.ndarray], np.ndarray]
"""A loss ρ(z) of squared residuals z = (r/σ)² (m,): rows ρ, ρ' and (unused) ρ'', each (m,).

This is the form of ``scipy.optimize.least_squares(loss=…)``: minimised is ½ Σ ρ(z)."""
# rounds of the fixed point of variances
ROUNDS = 200
# squared errors count as so many times their variance at most (our choice)
MAX_RATIO = 9.0
LOSSES = ("none", "huber", "cauchy")
# scales [standard deviations] of 95 % efficiency on normal residuals
HUBER_SCALE = 1.345
CAUCHY_SCALE = 2.385


def variance_weights(
    squares: np.ndarray, shapes: np.ndarray, start: np.ndarray, counts: np.ndarray | float = 1.0, rounds: int = ROUNDS
) -> np.ndarray:
    """Return the most probable weights θ >= 0 (k,) of  e² ~ (shapes θ) · χ²,  by multiplicative updates.

    The variance of error e_i is modelled as the weighted sum Σ_k shapes_ik θ_k. Each update multiplies the weights by
    the ratio of the positive and negative parts of the likelihood's gradient, so that they remain non-negative. A
    squared error counts as at most `MAX_RATIO` times its variance, for robustness.

    Args:
        squares: (m,) squared errors.
        shapes: (m, k) non-negative columns whose weighted sum is the variance.
        start: (k,) non-negative first values of the weights θ; zeros remain zero.
        counts: (m,) number of errors that each squared error represents.
        rounds: number of updates; few suffice if `start` is the result for nearly equal errors.
    """
    weights = np.array(start, dtype=float)
    columns = np.ascontiguousarray(shapes.T)
    for _ in range(rounds):
        precision = 1.0 / np.maximum(weights @ columns, 1e-30)
        counted = counts * precision
        push = columns @ (counted * np.minimum(squares * precision, MAX_RATIO))
        weights *= push / np.maximum(columns @ counted, 1e-300)
    return weights


# Squared residuals at which a loss is checked: rounding to rows with gross errors, up to 1000 σ.
CHECKED = np.geomspace(1e-4, 1e6, 61)
# Relative step of the central differences of a loss, and largest relative error of its derivative.
STEP = 1e-5
MAX_SLOPE_ERROR = 1e-3


def check_loss(loss: Loss) -> None:
    """Raise an error for a loss that cannot weight rows.

    Raises:
        UsageError: the values have another shape, are not finite, ρ' is negative, all zero, or not the derivative of ρ.
    """
    values = _loss_rows(loss, CHECKED)
    if not np.isfinite(values).all():
        z = CHECKED[~np.isfinite(values).all(axis=0)][0]
        raise UsageError(f"loss: rho or its derivative is not finite at z = {z:.3g} (z is the squared residual in σ²)")
    slope = values[1]
    if (slope < 0.0).any() or not slope.any():
        z = CHECKED[int(np.argmin(slope))]
        raise UsageError(
            f"loss: rho' is {slope.min():.3g} at z = {z:.3g}: row weights must not be negative, nor all zero"
        )
    after = _loss_rows(loss, CHECKED * (1.0 + STEP))[0]
    before = _loss_rows(loss, CHECKED * (1.0 - STEP))[0]
    difference = (after - before) / (2.0 * STEP * CHECKED)
    rounding = 1e-15 * np.abs(values[0]) / (STEP * CHECKED)
    error = np.abs(difference - slope) - rounding
    wrong = error > MAX_SLOPE_ERROR * np.maximum(np.abs(slope), np.abs(difference))
    # a kink of rho is at few points only
    if wrong.sum() > 2:
        k = int(np.flatnonzero(wrong)[0])
        raise UsageError(
            f"loss: row 1 is not the derivative of row 0: at z = {CHECKED[k]:.3g} it is {slope[k]:.6g}, differences "
            f"of rho give {difference[k]:.6g}; both are functions of z = (r/σ)², as in scipy's least_squares"
        )


def _loss_rows(loss: Loss, z: np.ndarray) -> np.ndarray:
    """Return ρ and ρ' (2, m) of squared residuals z (m,)."""
    takes_one_argument = True
    try:
        signature(loss).bind(z)
    except TypeError:
        takes_one_argument = False
    except ValueError:
        # functions of some C modules have no signature
        pass
    require(takes_one_argument, f"loss: {loss_name(loss)} must take one argument, z = (r/σ)²", UsageError)
    values = np.asarray(loss(z), dtype=float)
    if values.ndim != 2 or len(values) not in (2, 3) or values.shape[1] != len(z):
        raise UsageError(
            f"loss: expected rows rho, rho', rho'' (3, {len(z)}) of z ({len(z)},), as for scipy's least_squares; found "
            f"an array of shape {values.shape}"
        )
    return values[:2]


def loss_name(loss: Loss) -> str:
    """Return the name of a loss that is a function, for reports, such as ``soft_l1()``."""
    name = getattr(loss, "__name__", "")
    if name in ("", "<lambda>"):
        name = "function"
    return f"{name}()"


def weights(size: np.ndarray, loss: str | Loss, scale: float | None = None) -> np.ndarray:
    """Return the weights w(s) of iteratively reweighted least squares (IRLS) for residual sizes s in units of sigma.

    Huber (1964): w = 1 for s <= k, else k / s, with k = 1.345. Cauchy: w = 1 / (1 + (s / c)²) with c = 2.385. Both are
    95 % efficient on normal residuals (Holland & Welsch 1977).

    Args:
        size: s, absolute values of the residuals over their standard deviations, of any shape.
        loss: one of `LOSSES`, where "none" gives weights of 1; or a function, with the weights ρ'(s²/C²).
        scale: k, c, or C of a function; None: the default values 1.345, 2.385 or 1.

    Raises:
        ValueError: for an unknown loss.
    """
    if callable(loss):
        constant = 1.0 if scale is None else scale
        return _loss_rows(loss, (size.ravel() / constant) ** 2)[1].reshape(size.shape)  # ty: ignore[invalid-argument-type]
    if loss == "none":
        return np.ones_like(size)
    if loss == "huber":
        k = HUBER_SCALE if scale is None else scale
        return np.where(size <= k, 1.0, k / np.maximum(size, k))
    if loss == "cauchy":
        c = CAUCHY_SCALE if scale is None else scale
        return 1.0 / (1.0 + (size / c) ** 2)
    raise ValueError(f"unknown loss '{loss}'; expected one of {', '.join(LOSSES)}")


def spread(residuals: np.ndarray) -> float:
    """Return the robust standard deviation 1.4826 · median |r| of residuals r centred at zero; 0 if there are none."""
    if not residuals.size:
        return 0.0
    return float(1.4826 * np.median(np.abs(residuals)))
