"""The one finite-difference harness: every derivative in the toolkit is checked with `check`."""

from collections.abc import Callable

import numpy as np


def central(f: Callable[[np.ndarray], np.ndarray], x: np.ndarray, step: float = 1e-6) -> np.ndarray:
    """Return the derivative of ``f`` at ``x`` (p,) by central differences, shape (*f(x).shape, p)."""
    columns = []
    for k in range(len(x)):
        h = np.zeros(len(x))
        h[k] = step * max(1.0, abs(x[k]))
        columns.append((np.asarray(f(x + h)) - np.asarray(f(x - h))) / (2 * h[k]))
    return np.stack(columns, axis=-1)


def check(
    f: Callable[[np.ndarray], np.ndarray],
    jacobian: Callable[[np.ndarray], np.ndarray] | np.ndarray,
    x: np.ndarray,
    step: float = 1e-6,
    tolerance: float = 1e-7,
) -> float:
    """Assert that ``jacobian`` is the derivative of ``f`` at ``x``.

    Args:
        f: (p,) to an array (a scalar for a gradient).
        jacobian: the array (*f(x).shape, p), or a function of x that returns it.
        x: (p,) where to look; choose it at random, away from zeros and symmetric places.
        step: of the differences, relative to max(1, abs(x)).
        tolerance: on the largest error, relative to max(1, the largest entry of the derivative).

    Returns:
        The largest relative error, so that a test can state how good it is.
    """
    x = np.asarray(x, dtype=float)
    claimed = np.asarray(jacobian(x) if callable(jacobian) else jacobian, dtype=float)
    measured = central(f, x, step)
    assert claimed.shape == measured.shape, f"the derivative has shape {claimed.shape}, f wants {measured.shape}"
    error = np.abs(claimed - measured) / max(1.0, np.abs(measured).max())
    worst = np.unravel_index(np.argmax(error), error.shape)
    assert np.isfinite(claimed).all(), "the derivative is not finite"
    assert error[worst] <= tolerance, (
        f"derivative wrong at index {tuple(map(int, worst))}: {claimed[worst]:.9g}, differences say "
        f"{measured[worst]:.9g} (relative error {error[worst]:.2g} > {tolerance:.2g})"
    )
    return float(error[worst])
