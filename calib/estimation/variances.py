"""What makes errors large: variances as a sum of known shapes with unknown weights, none negative."""

import numpy as np

ROUNDS = 200  # of the fixed point


def variance_weights(
    squares: np.ndarray, shapes: np.ndarray, start: np.ndarray, counts: np.ndarray | float = 1.0, rounds: int = ROUNDS
) -> np.ndarray:
    """Return the most probable weights θ >= 0 (k,) of  e² ~ (shapes θ) · χ²,  by multiplicative updates.

    Each update multiplies by the ratio of the two halves of the likelihood's gradient, so that all stay positive.

    Args:
        squares: (m,) squared errors.
        shapes: (m, k) by what their variances may grow, not negative.
        start: (k,) not negative; what is zero stays.
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
