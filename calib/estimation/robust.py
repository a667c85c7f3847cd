"""Weights of robust losses for the residuals of single rows, and variances as weighted sums of known shapes.

`variance_weights` estimates variances as a sum of known shapes with unknown non-negative weights.
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

    Each update multiplies by the ratio of the two halves of the likelihood's gradient, so that all stay positive.

    Args:
        squares: (m,) squared errors.
        shapes: (m, k) columns whose non-negative combination is the variance; not negative.
        start: (k,) not negative; zeros stay zero.
        counts: (m,) number of errors that each squared error represents.
        rounds: number of fixed-point updates; fewer suffice if `start` is from nearly the same errors.
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
    """Return IRLS weights w(s) for residual sizes s in units of sigma.

    Huber (1964): 1 for s <= k, else k / s, k = 1.345; Cauchy: 1 / (1 + (s / c)²), c = 2.385 (both 95 % efficient on
    normal residuals; Holland & Welsch 1977).

    Args:
        size: residuals' absolute values over sigma, of any shape.
        loss: one of `LOSSES`.
        scale: k or c; None: the values above.
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
