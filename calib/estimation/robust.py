"""Weights of robust losses: of the residuals of single rows, and of whole samples.

For e ~ N(0, S) with n joints the size d = (eᵀ S⁻¹ e)^½ is chi-distributed, so what counts as large grows with n. The
expectations below are means over 4000 quantiles of d², good to four digits.

`variance_weights` estimates variances as a sum of known shapes with unknown weights, none negative.
"""

from functools import lru_cache

import numpy as np
from scipy.special import chdtri

ROUNDS = 200  # of the fixed point


def variance_weights(
    squares: np.ndarray, shapes: np.ndarray, start: np.ndarray, counts: np.ndarray | float = 1.0, rounds: int = ROUNDS
) -> np.ndarray:
    """Return the most probable weights θ >= 0 (k,) of  e² ~ (shapes θ) · χ²,  by multiplicative updates.

    Each update multiplies by the ratio of the two halves of the likelihood's gradient, so that all stay positive.

    Args:
        squares: (m,) squared errors.
        shapes: (m, k) columns whose non-negative combination is the variance; not negative.
        start: (k,) not negative; zeros stay zero.
        counts: (m,) how many errors each is worth.
        rounds: of the fixed point; fewer will do from weights of nearly the same errors.
    """
    weights = np.array(start, dtype=float)
    max_ratio = 9.0  # squared errors count as so many times their variance at most (our choice)
    for _ in range(rounds):
        variance = np.maximum(shapes @ weights, 1e-30)
        ratio = np.minimum(squares / variance, max_ratio)
        push, pull = (counts * ratio / variance) @ shapes, (counts / variance) @ shapes
        weights *= push / np.maximum(pull, 1e-300)
    return weights


LOSSES = ("none", "huber", "cauchy")
GATE = 0.999  # probability of a good sample to stay in


def weights(size: np.ndarray, loss: str, scale: float | None = None) -> np.ndarray:
    """Return IRLS weights w(s) for residual sizes s in units of sigma.

    Huber (1964): 1 for s <= k, else k / s, k = 1.345; Cauchy: 1 / (1 + (s / c)²), c = 2.385 (both 95 % efficient on
    normal residuals; Holland & Welsch 1977).

    Args:
        size: any shape, >= 0.
        loss: one of `LOSSES`.
        scale: k or c in place of the defaults.
    """
    if loss == "none":
        return np.ones_like(size)
    if loss == "huber":
        k = 1.345 if scale is None else scale
        return np.where(size <= k, 1.0, k / np.maximum(size, k))
    if loss == "cauchy":
        c = 2.385 if scale is None else scale
        return 1.0 / (1.0 + (size / c) ** 2)
    raise ValueError(f"unknown loss '{loss}'; expected one of {', '.join(LOSSES)}")


def spread(residuals: np.ndarray) -> float:
    """Return the robust standard deviation 1.4826 · median |r| of residuals centred at zero."""
    return float(1.4826 * np.median(np.abs(residuals))) if residuals.size else 0.0


@lru_cache
def tuning(joints: int, efficiency: float = 0.95) -> float:
    """Return Huber's constant with efficiency `efficiency` for normal residuals of `joints` joints at once.

    The efficiency of the weights w(d) is b² / a with a = E w² d² / n and b = E w d² / n (Maronna 1976; the latter
    equals E[w + w' d / n] by Stein's lemma). For one joint: 1.345.
    """
    from scipy.optimize import brentq

    square = _quantiles(joints)

    def excess(constant: float) -> float:
        w = weights(np.sqrt(square), "huber", constant)
        return float(np.mean(w * square) ** 2 / np.mean(w**2 * square) / joints - efficiency)

    return float(brentq(excess, 0.05, 20.0 * np.sqrt(joints)))  # type: ignore[arg-type]


def weigh(size: np.ndarray, joints: np.ndarray, gated: bool = True) -> np.ndarray:
    """Return Huber's weights w(d) (N,) of samples of Mahalanobis size d (N,), zero beyond the gate.

    Args:
        joints: (N,) how many joints each sample has.
        gated: whether samples beyond `GATE` weigh nothing.
    """
    result = np.zeros(len(size))
    for n in np.unique(joints[joints > 0]):
        own = joints == n
        result[own] = _weights(size[own], int(n), gated)
    return result


@lru_cache
def consistency(joints: int) -> float:
    """Return c = E w / E[w d² / n], so that c Σ w e eᵀ / Σ w estimates S for normal residuals."""
    square = _quantiles(joints)
    w = _weights(np.sqrt(square), joints)
    return float(np.mean(w) / np.mean(w * square) * joints)


def variance_factor(size: np.ndarray, joints: np.ndarray) -> float:
    """Return v with cov(x) = v (Σ w_k W_kᵀ S⁻¹ W_k)⁻¹ for the weighted fit (Huber & Ronchetti 2009, section 7.6).

    cov(x) = a / b² (Σ W_kᵀ S⁻¹ W_k)⁻¹ with a = mean w² d² / n and b = mean(w + w' d / n) over the samples, and the sum
    over all samples is the weighted one over mean w. The step of w at the gate is not counted: some per mille.
    """
    n = np.maximum(joints, 1)
    w = weigh(size, joints)
    h = 1e-4
    bent = [np.where(w > 0.0, weigh(size * (1.0 + k * h), joints, False), 0.0) for k in (1, -1)]
    slope = (bent[0] - bent[1]) / (2.0 * h)  # w' d
    share = joints / joints.sum()
    a, b = np.sum(share * w**2 * size**2 / n), np.sum(share * (w + slope / n))
    return float(a / b**2 * np.sum(share * w))


def _weights(size: np.ndarray, joints: int, gated: bool = True) -> np.ndarray:
    w = weights(size, "huber", tuning(joints))
    return np.where(size**2 <= chdtri(joints, 1.0 - GATE), w, 0.0) if gated else w


@lru_cache
def _quantiles(joints: int) -> np.ndarray:
    """Return 4000 equally likely values of d², for numerical expectations."""
    return np.asarray(chdtri(joints, 1.0 - (np.arange(4000) + 0.5) / 4000))
