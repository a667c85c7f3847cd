"""Small planted problems y = W x + ρ, shared by the tests of the linear estimators."""

import numpy as np

TRUTH = np.array([2.0, -1.0, 0.5, 3.0, -0.3])


def rows(seed: int, count: int = 600, groups: int = 3, p: int = 5) -> tuple[np.ndarray, np.ndarray]:
    """Return W (count, p) with columns of unlike size, and the group of every row, interleaved as samples are."""
    rng = np.random.default_rng(seed)
    matrix = rng.normal(size=(count, p)) * np.array([1.0, 10.0, 0.1, 1.0, 3.0])[:p]
    group = np.tile(np.arange(groups), count // groups)
    matrix[group == groups - 1, 0] = 0.0  # the last joint does not feel the first link
    return matrix, group


def noisy(seed: int, std: np.ndarray, count: int = 600) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return W, y and the groups, noise of standard deviation std[g] planted."""
    matrix, group = rows(seed, count, len(std))
    rng = np.random.default_rng(10_000 + seed)
    return matrix, matrix @ TRUTH + rng.normal(size=count) * std[group], group
