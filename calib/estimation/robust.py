"""Weights of robust losses: how much a residual that is too large still counts."""

from __future__ import annotations

import numpy as np

LOSSES = ("none", "huber", "cauchy")


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
    raise ValueError(f"loss '{loss}' is none of {', '.join(LOSSES)}")


def spread(residuals: np.ndarray) -> float:
    """Return the robust standard deviation 1.4826 · median |r| of residuals centred at zero."""
    return float(1.4826 * np.median(np.abs(residuals))) if residuals.size else 0.0
