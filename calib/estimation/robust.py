"""Weights of robust losses for the residuals of single rows, and variances estimated from squared errors.

`variance_weights` estimates variances as a sum of known functions with unknown non-negative weights.
"""

import numpy as np

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


def weights(size: np.ndarray, loss: str, scale: float | None = None) -> np.ndarray:
    """Return the weights w(s) of iteratively reweighted least squares (IRLS) for residual sizes s in units of sigma.

    Huber (1964): w = 1 for s <= k, else k / s, with k = 1.345. Cauchy: w = 1 / (1 + (s / c)²) with c = 2.385. Both are
    95 % efficient on normal residuals (Holland & Welsch 1977).

    Args:
        size: s, absolute values of the residuals over their standard deviations, of any shape.
        loss: one of `LOSSES`; "none" gives weights of 1.
        scale: k or c; None: the default values 1.345 or 2.385.

    Raises:
        ValueError: for an unknown loss.
    """
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
