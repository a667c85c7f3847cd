"""Robust weights of whole samples, by the Mahalanobis size of their residuals.

For e ~ N(0, S) with n joints the size d = (eᵀ S⁻¹ e)^½ is chi-distributed, so what counts as large grows with n. The
expectations below are means over 4000 quantiles of d², good to four digits.
"""

from functools import lru_cache

import numpy as np
from scipy.special import chdtri

from calib.estimation.robust import weights

GATE = 0.999  # probability of a good sample to stay in


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
