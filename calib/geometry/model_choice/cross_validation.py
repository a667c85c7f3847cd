"""Errors on rows a model was not fitted to, from sufficient statistics: every fold and every subset of terms is cheap.

The model is linear in its terms and, near its optimum, in the geometry: per fold the statistics WᵀW, Wᵀr of the
training rows give the estimate, those of the held-out rows its error. Nothing is fitted to held-out rows but the
placement of a held-out station (projected out).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from calib.data.poses.measurements import PoseMeasurements, take
from calib.estimation.relevance import SETTLED, Condensed, Gram, Relevance, condensed, gram, relevance
from calib.geometry.fit import plausible_deviation
from calib.geometry.images.image_noise import ImageNoise
from calib.geometry.installation import Installation
from calib.geometry.model_choice.folds import Folds
from calib.geometry.observation import observe, prepare
from calib.geometry.parameters import layout
from calib.geometry.pixel_residuals import PixelPart
from calib.geometry.result import GeometricFit
from calib.robot.calibrated import Deflection, Term
from calib.robot.chain import Chain

METRES = ("position", "consistency", "distance", "plane", "pixel")


@dataclass(frozen=True, eq=False)
class UnseenErrors:
    """Errors on held-out rows.

    Attributes:
        squares: (folds,) sum of squared errors [m²].
        rows: (folds,) rows, each counted by its robust weight.
    """

    squares: np.ndarray
    rows: np.ndarray

    @property
    def rms(self) -> float:
        """Root mean square of the error's norm over all rows [m]."""
        return float(np.sqrt(max(self.squares.sum(), 0.0) / max(self.rows.sum(), 1)))

    def wins(self, other: UnseenErrors) -> bool:
        """Say whether this is better than `other` in at least half of the folds."""
        return bool(np.sum(self.squares < other.squares) * 2 >= len(self.squares))


@dataclass(frozen=True, eq=False)
class FoldStatistics:
    """Statistics of every fold for the columns [free geometry, terms], the latter condensed.

    Attributes:
        rigid: number of geometry columns, which come first.
        groups: (E,) ridge group of each term.
        sizes: (E,) first guess of each coefficient.
        coordinates: of geometry and terms, in which the statistics are.
        plausible: (rigid,) wide prior on the geometry, so that what a fold cannot identify stays at the optimum.
        training: per fold, statistics of the other folds' rows, whitened.
        held_out: per fold, statistics of its rows [m], and how many.
        rows: per fold.
        total: statistics of all rows, whitened.
    """

    rigid: int
    groups: np.ndarray
    sizes: np.ndarray
    coordinates: Condensed
    plausible: np.ndarray
    training: list[Gram]
    held_out: list[Gram]
    rows: np.ndarray
    total: Gram
    _chosen: dict[bytes, np.ndarray] = field(default_factory=dict, init=False)

    def error(self, terms: np.ndarray) -> UnseenErrors:
        """Return the error on held-out rows of geometry + terms, whole groups of them."""
        index, chosen = self._columns(terms), self._widths(terms)
        begin = np.where(chosen > 0.0, chosen, self.coordinates.sizes[index])  # where the search begins
        squares = []
        for training, held in zip(self.training, self.held_out):
            x = self._search(training, index, begin, 8).values
            square = held.square.take(index, 0).take(index, 1)
            squares.append(held.total - 2.0 * x @ held.cross[index] + x @ square @ x)
        return UnseenErrors(np.array(squares), self.rows)

    def error_rigid(self) -> float:
        """Return the rms error on held-out rows of the geometry alone [m]."""
        return self.error(np.array([], dtype=int)).rms

    def ridges(self, terms: np.ndarray) -> np.ndarray:
        """Return the prior standard deviation of each term that all rows choose; 0 where they switch it off."""
        width = np.ones(int(self.groups.max(initial=-1)) + 1)
        own = self.coordinates.groups[self._columns(terms)[self.rigid :]]
        width[own] = (self._widths(terms) / self.coordinates.sizes[self._columns(terms)])[self.rigid :]
        return width[self.groups[terms]] * self.sizes[terms]

    def alive(self, terms: np.ndarray) -> int:
        """Return how many of the terms the data keep."""
        return int(np.sum(self.ridges(terms) > 0.0))

    def _columns(self, terms: np.ndarray) -> np.ndarray:
        return np.flatnonzero(np.isin(self.coordinates.groups, [-1, *self.groups[terms]]))

    def _widths(self, terms: np.ndarray) -> np.ndarray:
        """Return the prior standard deviation of each coordinate of geometry and terms that all rows choose."""
        key = terms.tobytes()
        if key not in self._chosen:
            index = self._columns(terms)
            self._chosen[key] = self._search(self.total, index, self.coordinates.sizes[index], 15).ridge
        return self._chosen[key]

    def _search(self, data: Gram, index: np.ndarray, begin: np.ndarray, iterations: int) -> Relevance:
        square, rigid = data.square.take(index, 0).take(index, 1), np.arange(self.rigid)
        square[rigid, rigid] += 1.0 / self.plausible**2
        _, groups = np.unique(self.coordinates.groups[index], return_inverse=True)
        return relevance(
            Gram(square, data.cross[index], data.total, data.rows), groups - int(self.rigid > 0), begin, iterations,
            SETTLED, self.coordinates.counts[index],
        )  # fmt: skip


def fold_statistics(
    found: GeometricFit,
    measured: Sequence[PoseMeasurements],
    terms: tuple[Term, ...],
    groups: np.ndarray,
    sizes: np.ndarray,
    reference: Chain,
    folds: Folds,
    torques: Sequence[np.ndarray | None] | None = None,
) -> FoldStatistics:
    """Gather the statistics of every fold at a fitted model, for its free parameters and `terms`.

    Args:
        found: the model, fitted to all rows.
        measured: the blocks it was fitted to.
        terms: E deflection terms on offer.
        groups, sizes: (E,) see `calib.geometry.model_choice.ladder`.
        reference: chain on which the terms' bases are evaluated.
        folds: partition of the rows.
        torques: gravity torques per block.
    """
    cell = replace(found.cell, deflection=Deflection(terms, np.zeros(len(terms)), reference))
    free = np.concatenate([found.free, layout(cell).term_index])
    scales, weights = found.used_sigmas(), found.row_weights()
    noises = found.used_noises()
    rigid = len(found.free)
    each: list[Gram] = []
    held_out, rows = [], []
    pooled = all(block.has_instrument for block in measured)
    for fold in range(folds.count):
        inside = [np.flatnonzero(members == fold) for members in folds.members]
        seen = {block.station for block, rows in zip(measured, inside) if len(rows) < len(block)}
        moved = [block.has_instrument and block.station not in seen for block in measured]
        metric, whitened, count = _statistics(cell, measured, inside, free, scales, weights, noises, torques, moved)
        held_out.append(metric)
        rows.append(count)
        if not pooled:
            outside = [np.flatnonzero(members != fold) for members in folds.members]
            whitened = _statistics(cell, measured, outside, free, scales, weights, noises, torques)[1]
        each.append(whitened)
    if pooled:
        total = sum(each[1:], each[0])
    else:
        every = [np.arange(len(b)) for b in measured]
        total = _statistics(cell, measured, every, free, scales, weights, noises, torques)[1]
    families = np.concatenate([np.full(rigid, -1), groups]).astype(int)
    coordinates = condensed(total.square, families, np.concatenate([np.ones(rigid), sizes]))
    total, each, held_out = (
        coordinates.gram(total), [coordinates.gram(own) for own in each], [coordinates.gram(own) for own in held_out],
    )  # fmt: skip
    training = [total - own for own in each] if pooled else each
    wide = plausible_deviation(found.cell, found.free) if found.prior is None else found.prior
    plausible = np.where(np.isfinite(wide), wide, 10.0)
    return FoldStatistics(rigid, groups, sizes, coordinates, plausible, training, held_out, np.array(rows), total)


def blind_folds(
    nominal: GeometricFit,
    measured: Sequence[PoseMeasurements],
    folds: Folds,
    torques: Sequence[np.ndarray | None] | None = None,
) -> np.ndarray:
    """Return which folds cannot be judged (folds,): the other rows do not determine where the tool would be in them.

    There the error that geometry and frames would have by their covariance alone, with the nominal arm's residuals
    taken for noise and `plausible_deviation` known beforehand, is above `max_blind_error` times those residuals.

    Args:
        nominal: the nominal arm with its frames fitted to all rows.
        measured: the blocks it was fitted to, positions or poses all.
        folds: partition of the rows.
        torques: gravity torques per block.
    """
    table = layout(nominal.cell)
    free = np.concatenate([table.arm_index, table.frame_index])
    sigmas: list[dict[str, float]] = [{} for _ in measured]
    for piece in nominal.pieces:
        sigmas[piece.block][piece.part.label] = max(float(np.sqrt(np.mean(piece.part.value**2))), 1e-9)
    frame_sigma = 1.0  # how far a frame may be from where it is [m, rad] (our choice)
    known = np.where(free >= table.arm, frame_sigma, plausible_deviation(nominal.cell, free))
    weights = nominal.row_weights()
    each, squares, none, moved = [], [], [None] * len(measured), [True] * len(measured)
    for fold in range(folds.count):
        inside = [np.flatnonzero(members == fold) for members in folds.members]
        held, own, count = _statistics(nominal.cell, measured, inside, free, sigmas, weights, none, torques, moved)
        each.append(own)
        squares.append((held.square / max(count, 1.0), held.total / max(count, 1.0)))
    total = sum(each[1:], each[0])
    result = np.zeros(folds.count, dtype=bool)
    noise = sum(square for _, square in squares) / folds.count
    # error by covariance alone over the nominal residuals: beyond, a fold says nothing (our choice)
    max_blind_error = 3.0
    for fold, own in enumerate(each):
        spread = np.linalg.inv(((total - own).square + np.diag(known**-2)) * np.outer(known, known))
        predicted = float(np.sum(squares[fold][0] * (spread * np.outer(known, known))))
        result[fold] = predicted > max_blind_error**2 * noise
    return result


def _statistics(
    cell: Installation,
    measured: Sequence[PoseMeasurements],
    chosen: Sequence[np.ndarray],
    free: np.ndarray,
    scales: Sequence[dict[str, float]],
    weights: Sequence[np.ndarray],
    noises: Sequence[ImageNoise | None],
    torques: Sequence[np.ndarray | None] | None,
    moved: Sequence[bool] | None = None,
) -> tuple[Gram, Gram, float]:
    """Return the statistics of chosen rows in metres (of what is in metres), whitened, and the count of metric rows.

    Of the blocks that are `moved` the station's placement is projected out of the statistics in metres.
    """
    p = len(free)
    metric = whitened = Gram(np.zeros((p, p)), np.zeros(p), 0.0, 0)
    count = 0.0
    chunk = 1000  # poses observed at once
    for number, (block, rows) in enumerate(zip(measured, chosen)):
        frames: list[tuple[np.ndarray, np.ndarray]] = []
        pieces = np.array_split(rows, max(1, len(rows) // chunk)) if block.has_instrument else [rows]
        for piece in pieces:
            if len(piece) == 0:
                continue
            torque = None if torques is None else torques[number]
            part_block = take(block, piece)
            ready = prepare(cell, [part_block], [None if torque is None else torque[piece]])
            for part in observe(cell, ready[0], free):
                weight = weights[number][piece][part.index]
                if isinstance(part, PixelPart) and (noise := noises[number]) is not None:
                    part = replace(part, noise=replace(noise, weight=np.ones(len(piece))))
                root = 1.0 / np.sqrt(weight)
                own = gram(*part.whitened(root * scales[number][part.label]))
                whitened = whitened + replace(own, rows=part.value.size)
                if part.label in METRES:
                    bare = replace(part, noise=None) if isinstance(part, PixelPart) else part
                    residual, matrix = bare.whitened(root * part.per_length)
                    count += float(weight.sum())
                    if moved is not None and moved[number]:
                        frames.append((residual, matrix))
                    else:
                        metric = metric + gram(residual, matrix)
        if frames:
            metric = metric + _replaced(cell, frames, free)
    return metric, whitened, count


def _replaced(cell: Installation, frames: list[tuple[np.ndarray, np.ndarray]], free: np.ndarray) -> Gram:
    """Return the statistics of one block with its station's placement projected out."""
    residual = np.concatenate([r for r, _ in frames])
    matrix = np.concatenate([w for _, w in frames])
    station = np.flatnonzero(np.isin(free, layout(cell).station_index))
    q, _ = np.linalg.qr(matrix[:, station])
    residual = residual - q @ (q.T @ residual)
    return gram(residual, matrix - q @ (q.T @ matrix))
