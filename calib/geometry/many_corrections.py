"""Statistics WᵀW, Wᵀr, rᵀr of measured rows, and variances of positions, for models with many joint corrections.

A joint correction adds a function of q (its basis) times a coefficient to the value of one chain element. The Jacobian
column of a correction is the column of this element times the basis. The products of two elements' columns are summed
over the three coordinates first; a pose then enters as one row instead of three, which takes a third of the time.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from calib.data.poses.measurements import PoseMeasurements, Positions
from calib.estimation.relevance import Gram
from calib.geometry.installation import Installation
from calib.geometry.observation import Block, layout_counts, observe, pieces, predict, rows_of, target_jacobian
from calib.geometry.residuals import ResidualPart
from calib.robot.calibrated import target_elements

# number of corrections of one element above which multiplying elements first is faster (our choice)
MANY = 30
# number of poses computed at once, so that their basis functions fit into the processor's cache
CHUNK = 500


def separable(measured: PoseMeasurements) -> bool:
    """Return whether the rows of `measured` are positions or poses without errors that all rows share."""
    return isinstance(measured, Positions) and measured.late is None


def row_statistics(
    cell: Installation, block: Block, free: np.ndarray, scales: Iterable[np.ndarray]
) -> Iterator[tuple[ResidualPart, Gram]]:
    """Yield the residual parts of a `separable` block, piece by piece, with the statistics of their rows.

    Args:
        cell: the installation.
        block: the prepared measurements.
        free: (f,) indices of the fitted parameters.
        scales: for each residual part of the block, the numbers (rows, m) by which its residuals are divided.
    """
    grouping = _grouped(cell, free)
    single = len(grouping.single)
    # the last row and column of the statistics are those of the residual
    positions = np.append(grouping.single, len(free))
    start = 0
    for piece in pieces(cell, block):
        bases = [np.asarray(piece.bases)[numbers] for numbers in grouping.numbers]
        for part, scale in zip(observe(cell, piece, grouping.observed), scales):
            m = part.value.shape[1]
            residual, matrix = part.whitened(scale[:, start : start + m])
            columns = np.concatenate([matrix.T, residual[None]])
            columns = columns.reshape(-1, len(part.value), m)
            elements = columns[single:-1]
            singles = np.delete(columns, slice(single, -1), axis=0)
            flat = singles.reshape(len(singles), -1)
            square = np.empty((len(free) + 1, len(free) + 1))
            square[np.ix_(positions, positions)] = flat @ flat.T
            for k, group in enumerate(grouping.groups):
                across = bases[k] @ np.einsum("im,cim->mc", elements[k], singles)
                square[np.ix_(group, positions)] = across
                square[np.ix_(positions, group)] = across.T
                along = np.einsum("im,cim->cm", elements[k], elements)
                for j in range(k, len(grouping.groups)):
                    second = grouping.groups[j]
                    across = (bases[k] * along[j]) @ bases[j].T
                    square[np.ix_(group, second)] = across
                    square[np.ix_(second, group)] = across.T
            total = float(square[-1, -1])
            yield part, Gram(square[:-1, :-1], square[:-1, -1], total, part.value.size)
        start += len(piece.measured)


def position_variances(
    cell: Installation,
    measured: PoseMeasurements,
    free: np.ndarray,
    covariance: np.ndarray,
    station: int,
    tool: np.ndarray | int,
) -> np.ndarray:
    """Return the variance (m,) [m²] of a tool's position, trace J Σ Jᵀ.

    Args:
        cell: the fitted installation.
        measured: joint values (m, n), and gravity torques if the model has compliance terms.
        free: (f,) indices in the parameter vector.
        covariance: (f, f) covariance Σ of these parameters; J are the derivatives of the position by them.
        station: index of the station of reference; -1 for the arm's base.
        tool: index of the tool, one or (m,).
    """
    grouping = _grouped(cell, free)
    single = grouping.single
    poses = Block(measured, station, np.broadcast_to(tool, len(measured)))
    result = np.zeros(len(measured))
    for start in range(0, len(measured), CHUNK):
        rows = np.arange(start, min(start + CHUNK, len(measured)))
        block = rows_of(cell, poses, rows)
        predicted = predict(cell, block)
        jacobian = target_jacobian(cell, predicted, grouping.observed, station, block.tool, block.bases)
        singles = jacobian[: len(single), :3]
        elements = jacobian[len(single) :, :3]
        spread = covariance[np.ix_(single, single)] @ singles.reshape(len(singles), -1)
        variance = np.einsum("cim,cim->m", spread.reshape(singles.shape), singles)
        bases = [np.asarray(block.bases)[numbers] for numbers in grouping.numbers]
        for k, group in enumerate(grouping.groups):
            by_singles = np.einsum("im,cim->cm", elements[k], singles)
            across = covariance[np.ix_(group, single)] @ by_singles
            along = np.einsum("im,cim->cm", elements[k], elements)
            for j in range(k + 1):
                # pairs of two groups count twice, those of one group once
                factor = 0.5 if j == k else 1.0
                spread = covariance[np.ix_(group, grouping.groups[j])] @ bases[j]
                across += factor * along[j] * spread
            variance += 2.0 * np.einsum("cm,cm->m", bases[k], across)
        result[rows] = np.maximum(variance, 0.0)
    return result


@dataclass(frozen=True, eq=False)
class Grouping:
    """Parameters (f,), divided into the corrections of elements with many corrections, and all others (single ones).

    Attributes:
        observed: parameters whose Jacobian columns are computed: the single ones, then the elements with many
            corrections.
        single: positions of the single parameters among the f.
        groups: for each element with many corrections, positions of its corrections among the f.
        numbers: for each element with many corrections, numbers of its corrections among the deflection's terms.
    """

    observed: np.ndarray
    single: np.ndarray
    groups: list[np.ndarray]
    numbers: list[np.ndarray]


def _grouped(cell: Installation, free: np.ndarray) -> Grouping:
    """Return the parameters `free` (f,) grouped by the chain element that their corrections change.

    Args:
        cell: the installation.
        free: (f,) indices in the parameter vector.
    """
    # numbers of corrections; negative for all other parameters
    numbers = free - sum(layout_counts(cell)[:4])
    is_correction = numbers >= 0
    targets = np.append(target_elements(cell.chain, cell.deflection), -1)
    element = targets[np.maximum(numbers, -1)]
    elements, counts = np.unique(element[is_correction], return_counts=True)
    corrected_often = elements[counts >= MANY]
    groups = [np.flatnonzero(element == number) for number in corrected_often]
    single = np.flatnonzero(~np.isin(element, corrected_often) | ~is_correction)
    observed = np.concatenate([free[single], corrected_often])
    group_numbers = [numbers[group] for group in groups]
    return Grouping(observed, single, groups, group_numbers)
