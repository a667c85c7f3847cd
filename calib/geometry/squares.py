"""Sufficient statistics WᵀW, Wᵀr, rᵀr of measured rows, without the rows of W that belong to joint corrections."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from calib.estimation.relevance import Gram
from calib.geometry.installation import Installation
from calib.geometry.observation import Block, layout_counts, observe, pieces
from calib.geometry.residuals import Part
from calib.robot.calibrated import target_elements

MANY = 30  # corrections of one element from which on it pays to multiply elements first (our choice)


def squares(
    cell: Installation, block: Block, free: np.ndarray, scales: Iterable[np.ndarray]
) -> Iterator[tuple[Part, Gram]]:
    """Yield the residual parts of a block of positions or poses, piece by piece, with their rows' statistics.

    The column of a correction is that of the element it moves, times the correction's basis. With the columns of two
    elements multiplied row by row first, a pose counts as one row, not as three, and takes a third of the time.

    Args:
        cell, block, free: as of `calib.geometry.observation.observe`.
        scales: for each of its parts, the divisor (rows, m) of its residuals.
    """
    numbers = free - sum(layout_counts(cell)[:4])  # of corrections; negative for all else
    element = np.append(target_elements(cell.chain, cell.deflection), -1)[np.maximum(numbers, -1)]
    known, count = np.unique(element[numbers >= 0], return_counts=True)
    moved = known[count >= MANY]
    groups = [np.flatnonzero(element == one) for one in moved]
    single = np.flatnonzero(~np.isin(element, moved) | (numbers < 0))
    places, done = np.append(single, len(free)), 0
    for piece in pieces(cell, block):
        bases = [np.asarray(piece.bases)[numbers[own]] for own in groups]
        for part, scale in zip(observe(cell, piece, np.concatenate([free[single], moved])), scales):
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
