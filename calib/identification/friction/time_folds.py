"""Models judged on time they have not seen: everything from triangles, one fit per fold."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.estimation.relevance import Gram, relevance
from calib.estimation.triangles import Triangles, residual_squares, select
from calib.identification.rows import pool

ITERATIONS = 12


@dataclass(frozen=True, eq=False)
class CrossValidation:
    """Triangles of all candidate columns by (block, row), and how they are weighed.

    Attributes:
        data: the triangles.
        rows: torque rows per sample.
        blocks: number of time blocks that are left out in turn.
        std: (rows,) standard deviation of the residuals.
        inflation: (rows,) how many rows count as one.
        group: (p,) ridge group of each column, -1 for none.
        prior: (k, p + 1) rows of [W y] that say what is known beforehand, whitened; None for nothing.
    """

    data: Triangles
    rows: int
    blocks: int
    std: np.ndarray
    inflation: np.ndarray
    group: np.ndarray
    prior: np.ndarray | None = None

    def errors(self, columns: np.ndarray) -> np.ndarray:
        """Return the squared errors (blocks, rows) on each block of the model with these columns, fitted to the others.

        Squares are of samples, not whitened; blocks that a recording's gaps left empty hold zeros.
        """
        chosen = select(self.data, columns)
        group = self.group[columns]
        result = np.zeros((self.blocks, self.rows))
        prior = None if self.prior is None else self.prior[:, np.append(columns, -1)]
        for block in range(self.blocks):
            others = [other for other in range(self.blocks) if other != block]
            values = estimate(pool(chosen, self.rows, others), self.std, self.inflation, group, prior)[0]
            squares = residual_squares(chosen, values).reshape(-1, self.rows)
            result[block] = squares[block]
        return result

    def counts(self) -> np.ndarray:
        """Return the number of samples (blocks, rows)."""
        return self.data.rows.reshape(-1, self.rows)[: self.blocks]


def estimate(
    data: Triangles, std: np.ndarray, inflation: np.ndarray, group: np.ndarray, prior: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return values (p,) and prior standard deviations (p,; infinite where there is no ridge, 0 where switched off).

    Columns with a group are drawn to zero as strongly as the evidence says (`calib.estimation.relevance`); with none,
    this is weighted least squares. Directions without any data stay where they are: at zero.
    """
    weight = 1.0 / (std * np.sqrt(inflation))
    stacked = (data.factors * weight[:, None, None]).reshape(-1, data.parameters + 1)
    if prior is not None:
        stacked = np.vstack([stacked, prior])
    size = np.sqrt(np.sum(stacked[:, :-1] ** 2, axis=0))
    scale = np.where(size > 0.0, size, 1.0)
    scaled = stacked[:, :-1] / scale
    if (group < 0).all():
        return np.linalg.lstsq(scaled, stacked[:, -1], rcond=1e-10)[0] / scale, np.full(len(group), np.inf)
    target = stacked[:, -1]
    rows = int(np.sum(data.rows / inflation))
    unit = np.sqrt(max(rows, 1))
    scaled, scale = scaled * unit, scale / unit
    square = scaled.T @ scaled
    free = group < 0
    square[np.diag_indices(len(group))] += np.where(
        free, 1e-9 * rows, 0.0
    )  # a free direction without data stays at zero
    found = relevance(
        Gram(square, scaled.T @ target, float(target @ target), rows), group, np.ones(len(group)), ITERATIONS
    )
    return found.values / scale, np.where(np.isfinite(found.ridge), found.ridge / scale, np.inf)
