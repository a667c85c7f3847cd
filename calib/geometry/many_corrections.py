"""Sufficient statistics WᵀW, Wᵀr, rᵀr of measured rows, and variances of positions, with many joint corrections.

The column of a correction is that of the element it moves, times the correction's basis. With the columns of two
elements multiplied row by row first, a pose counts as one row, not as three, and takes a third of the time.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np

from calib.data.poses.measurements import PoseMeasurements, Positions
from calib.estimation.relevance import Gram
from calib.geometry.installation import Installation
from calib.geometry.observation import Block, layout_counts, observe, pieces, predict, rows_of, target_jacobian
from calib.geometry.residuals import Part
from calib.robot.calibrated import target_elements

MANY = 30  # corrections of one element from which on it pays to multiply elements first (our choice)


def separable(measured: PoseMeasurements) -> bool:
    """Return whether rows are positions or poses without errors that all of them share."""
    return isinstance(measured, Positions) and measured.late is None


def row_statistics(
    cell: Installation, block: Block, free: np.ndarray, scales: Iterable[np.ndarray]
) -> Iterator[tuple[Part, Gram]]:
    """Yield the residual parts of a `separable` block, piece by piece, with their rows' statistics.

    Args:
        cell, block, free: as of `calib.geometry.observation.observe`.
        scales: for each of its parts, the divisor (rows, m) of its residuals.
    """
    few, single, groups, numbers = _grouped(cell, free)
    places, done = np.append(single, len(free)), 0
    for piece in pieces(cell, block):
        bases = [np.asarray(piece.bases)[own] for own in numbers]
        for part, scale in zip(observe(cell, piece, few), scales):
            m = part.value.shape[1]
            residual, matrix = part.whitened(scale[:, done : done + m])
            columns = np.concatenate([matrix.T, residual[None]]).reshape(-1, len(part.value), m)
            elements, rest = columns[len(single) : -1], np.delete(columns, slice(len(single), -1), axis=0)
            flat = rest.reshape(len(rest), -1)
            found = np.empty((len(free) + 1, len(free) + 1))
            found[np.ix_(places, places)] = flat @ flat.T
            for k, own in enumerate(groups):
                across = bases[k] @ np.einsum("im,cim->mc", elements[k], rest)
                found[np.ix_(own, places)], found[np.ix_(places, own)] = across, across.T
                along = np.einsum("im,cim->cm", elements[k], elements)
                for other, theirs in enumerate(groups[k:], k):
                    across = (bases[k] * along[other]) @ bases[other].T
                    found[np.ix_(own, theirs)], found[np.ix_(theirs, own)] = across, across.T
            yield part, Gram(found[:-1, :-1], found[:-1, -1], float(found[-1, -1]), part.value.size)
        done += len(piece.measured)


def position_variances(
    cell: Installation, at: PoseMeasurements, free: np.ndarray, covariance: np.ndarray, station: int, tool: Any
) -> np.ndarray:
    """Return the variance (m,) [m²] of a tool's position, trace J Σ Jᵀ; arguments: `observation.pose_sigmas`."""
    few, single, groups, numbers = _grouped(cell, free)
    whole, result = Block(at, station, np.broadcast_to(tool, len(at))), np.zeros(len(at))
    chunk = 500  # poses at once: their bases stay in the processor's cache
    for first in range(0, len(at), chunk):
        rows = np.arange(first, min(first + chunk, len(at)))
        block = rows_of(cell, whole, rows)
        columns = target_jacobian(cell, predict(cell, block), few, station, block.tool, block.bases)[:, :3]
        rest, elements = columns[: len(single)], columns[len(single) :]
        own = (covariance[np.ix_(single, single)] @ rest.reshape(len(rest), -1)).reshape(rest.shape)
        found = np.einsum("cim,cim->m", own, rest)
        bases = [np.asarray(block.bases)[each] for each in numbers]
        for k, own in enumerate(groups):
            across = covariance[np.ix_(own, single)] @ np.einsum("im,cim->cm", elements[k], rest)
            along = np.einsum("im,cim->cm", elements[k], elements)
            for other, theirs in enumerate(groups[: k + 1]):
                half = 0.5 if other == k else 1.0
                across += half * along[other] * (covariance[np.ix_(own, theirs)] @ bases[other])
            found += 2.0 * np.einsum("cm,cm->m", bases[k], across)
        result[rows] = np.maximum(found, 0.0)
    return result


def _grouped(cell: Installation, free: np.ndarray) -> tuple[np.ndarray, np.ndarray, list[np.ndarray], list[np.ndarray]]:
    """Return parameters to observe: those at `single` places of `free`, and elements that many corrections move.

    Then these single places, and for each such element the places of its corrections and their numbers.
    """
    numbers = free - sum(layout_counts(cell)[:4])  # of corrections; negative for all else
    element = np.append(target_elements(cell.chain, cell.deflection), -1)[np.maximum(numbers, -1)]
    known, count = np.unique(element[numbers >= 0], return_counts=True)
    moved = known[count >= MANY]
    groups = [np.flatnonzero(element == one) for one in moved]
    single = np.flatnonzero(~np.isin(element, moved) | (numbers < 0))
    return np.concatenate([free[single], moved]), single, groups, [numbers[own] for own in groups]
