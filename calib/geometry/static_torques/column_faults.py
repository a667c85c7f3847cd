"""Columns of measured torques with the other sign, or exchanged: gravity explains them far better if they are changed.

All joints feel the same masses. A reversed column therefore contradicts the others, whatever the masses are.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

import numpy as np

# gravity explains less than this share of the torques' variation as recorded, and with the change leaves this share
# of the residual (our choice)
EXPLAINED, BETTER = 0.95, 0.5
# relative ridge that lets base parameters be fitted by all parameters
RIDGE = 1e-9
# least spread by which a column is divided, as a share of the largest: smaller torques are noise (our choice)
MIN_SPREAD_SHARE = 0.02
# effect of gravity on a joint, relative to its torque's spread, below which its axis is vertical
NO_GRAVITY = 1e-9


class ColumnChange(NamedTuple):
    """Another order and other signs of torque columns.

    Attributes:
        order: (n,) column that is the torque of each joint.
        signs: (n,) 1.0, or -1.0 for a reversed column.
        fault: what is wrong if gravity explains the changed torques, and what to do.
    """

    order: np.ndarray
    signs: np.ndarray
    fault: tuple[str, str]

    def of(self, torque: np.ndarray) -> np.ndarray:
        """Return the changed torques of recorded ones (m, n)."""
        return self.signs * torque[:, self.order]


@dataclass(frozen=True, eq=False)
class _GravitySums:
    """Products of regressor G and torques τ over the rows, both without their means, by joint.

    Attributes:
        squares: (n, p, p) Σ G_jᵀ G_j of each joint j.
        cross: (n, n, p) Σ G_jᵀ τ_k of joint j and column k.
        spread: (n,) standard deviation by which a column is divided [N m].
        total: sum of squares of the divided columns of joints that feel gravity.
    """

    squares: np.ndarray
    cross: np.ndarray
    spread: np.ndarray
    total: float

    def unexplained(self, order: np.ndarray, signs: np.ndarray) -> float:
        """Return the share of the torques' squares that gravity does not explain.

        Args:
            order: (n,) column that is the torque of each joint.
            signs: (n,) 1.0, or -1.0 for a reversed column.
        """
        weights = self.spread[order] ** -2.0
        square = np.einsum("j,jpq->pq", weights, self.squares)
        ridge = RIDGE * np.trace(square) * np.eye(len(square))
        projected = (signs * weights) @ self.cross[np.arange(len(order)), order]
        explained = float(projected @ np.linalg.solve(square + ridge, projected))
        return max(self.total - explained, 0.0) / self.total


def column_fault(regressor: np.ndarray, torque: np.ndarray, finite: np.ndarray) -> tuple[str, str] | None:
    """Return which column is reversed or which two are exchanged, and what to do; None without such a fault.

    Args:
        regressor: (m, n, p) gravity regressor of the rows.
        torque: (m, n) measured torques [N m]; zero where none was measured.
        finite: (m, n) whether a torque was measured; nowhere for a joint without a sensor, which is left out.
    """
    sensed = np.asarray(finite.any(axis=0))
    rows = finite[:, sensed].all(axis=1)
    if rows.sum() < regressor.shape[2]:
        return None
    torques = torque[rows] - torque[rows].mean(axis=0)
    matrix = (regressor[rows] - regressor[rows].mean(axis=0)) * sensed[:, None]
    spread = torques.std(axis=0)
    spread = np.maximum(spread, MIN_SPREAD_SHARE * spread.max())
    feels_gravity = np.abs(matrix).max(axis=(0, 2)) > NO_GRAVITY * spread
    sums = _GravitySums(
        squares=np.einsum("mjp,mjq->jpq", matrix, matrix),
        cross=np.einsum("mjp,mk->jkp", matrix, torques),
        spread=spread,
        total=float(np.sum((torques / spread)[:, feels_gravity] ** 2)),
    )
    order, signs = np.arange(len(spread)), np.ones(len(spread))
    recorded = sums.unexplained(order, signs)
    if recorded < (1.0 - EXPLAINED) ** 2:
        return None
    smallest, fault = BETTER * recorded, None
    for change in column_changes(feels_gravity):
        share = sums.unexplained(change.order, change.signs)
        if share < smallest:
            smallest, fault = share, change.fault
    return fault


def column_changes(changeable: np.ndarray) -> Iterator[ColumnChange]:
    """Yield the changes of columns of which one is reversed, or two are exchanged.

    Args:
        changeable: (n,) whether a column is one of these.
    """
    order, signs = np.arange(len(changeable)), np.ones(len(changeable))
    columns = np.flatnonzero(changeable)
    for column in columns:
        changed_signs = signs.copy()
        changed_signs[column] = -1.0
        name = f"tau{column + 1}"
        reason = f"with {name} reversed gravity explains them, as recorded it does not"
        yield ColumnChange(order, changed_signs, (reason, f"reverse the sign of {name}"))
    for first, second in combinations(columns, 2):
        exchanged = order.copy()
        exchanged[[first, second]] = second, first
        names = f"tau{first + 1} and tau{second + 1}"
        reason = f"with {names} exchanged gravity explains them, as recorded it does not"
        yield ColumnChange(exchanged, signs, (reason, f"exchange the names of {names} in the header"))
