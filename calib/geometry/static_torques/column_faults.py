"""Columns of measured torques with the other sign, or exchanged: gravity explains them far better if they are changed.

All joints feel the same masses. A reversed column therefore contradicts the others, whatever the masses are.
"""

from itertools import combinations

import numpy as np

# gravity explains less than this share of the torques' variation as recorded, and with the change leaves this share
# of the residual (our choice)
EXPLAINED, BETTER = 0.95, 0.5
# relative ridge that lets base parameters be fitted by all parameters
RIDGE = 1e-9


def column_fault(regressor: np.ndarray, torque: np.ndarray, finite: np.ndarray) -> tuple[str, str] | None:
    """Return which column is reversed or which two are exchanged, and what to do; None without such a fault.

    Args:
        regressor: (m, n, p) gravity regressor of the rows.
        torque: (m, n) measured torques; zero where none was measured.
        finite: (m, n) whether a torque was measured.
    """
    rows = finite.all(axis=1)
    if rows.sum() < regressor.shape[2]:
        return None
    torques = torque[rows] - torque[rows].mean(axis=0)
    spread = np.maximum(torques.std(axis=0), 0.02 * torques.std(axis=0).max())
    matrix = (regressor[rows] - regressor[rows].mean(axis=0)) / spread[:, None]
    torques = torques / spread
    n = torques.shape[1]
    # a vertical axis feels no gravity
    feels = np.abs(matrix).max(axis=(0, 2)) > 1e-9
    square = np.einsum("mjp,mjq->pq", matrix, matrix)
    ridge = RIDGE * np.trace(square) * np.eye(len(square))
    inverse = np.linalg.inv(square + ridge)
    # of regressor row j with torque k
    cross = np.einsum("mjp,mk->jkp", matrix, torques)
    total = float(np.sum(torques[:, feels] ** 2))

    def unexplained(order: np.ndarray, signs: np.ndarray) -> float:
        projected = np.sum(signs[:, None] * cross[np.arange(n), order], axis=0)
        return max(total - float(projected @ inverse @ projected), 0.0) / total

    order, signs = np.arange(n), np.ones(n)
    recorded = unexplained(order, signs)
    if recorded < (1.0 - EXPLAINED) ** 2:
        return None
    best, fault = BETTER * recorded, None
    for joint in np.flatnonzero(feels):
        reversed_signs = signs.copy()
        reversed_signs[joint] = -1.0
        misfit = unexplained(order, reversed_signs)
        if misfit < best:
            name = f"tau{joint + 1}"
            best = misfit
            fault = (
                f"with {name} reversed gravity explains them, as recorded it does not",
                f"reverse the sign of {name}",
            )
    for first, second in combinations(np.flatnonzero(feels), 2):
        exchanged = order.copy()
        exchanged[[first, second]] = second, first
        misfit = unexplained(exchanged, signs)
        if misfit < best:
            names = f"tau{first + 1} and tau{second + 1}"
            best = misfit
            reason = f"with {names} exchanged gravity explains them, as recorded it does not"
            fault = reason, f"exchange the names of {names} in the header"
    return fault
