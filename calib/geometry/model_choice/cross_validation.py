"""Cross-validation errors from sufficient statistics, cheap for every fold and every subset of terms.

The model is linear in its terms and, near its optimum, in the geometry: per fold the statistics WᵀW, Wᵀr of the
training rows give the estimate, those of the held-out rows its error. Nothing is fitted to held-out rows but the
placement of a held-out station (projected out).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import chain, repeat
from typing import Any

import numpy as np

from calib.data.poses.measurements import PoseMeasurements, take
from calib.estimation.relevance import SETTLED, Condensed, Gram, Relevance, condensed, gram, relevance
from calib.geometry.fit import plausible_deviation
from calib.geometry.installation import Installation
from calib.geometry.many_corrections import row_statistics, separable
from calib.geometry.model_choice.folds import Folds
from calib.geometry.observation import layout, observe, prepare, sampled
from calib.geometry.weighing import GeometricFit
from calib.robot.calibrated import Deflection, Term
from calib.robot.chain import Chain

JUDGED_POSES = 20_000  # poses that models are judged by (our choice)
METRES = ("position", "consistency", "distance", "plane", "pixel")


def term_groups(terms: tuple[Term, ...]) -> np.ndarray:
    """Return the ridge index of each term (E,): harmonics of one joint on one element share one, others have their own.

    With a ridge per order the evidence switches most orders off and makes the rest too large, which shows only on
    distant rows; see `term_sizes` for the decrease with the order.
    """
    keys: dict[tuple, int] = {}
    result = []
    for term in terms:
        paired = term.basis in ("cos", "sin")
        key = (term.element, "turn" if paired else term.basis, term.source, 0 if paired else term.order)
        result.append(keys.setdefault(key, len(keys)))
    return np.array(result, dtype=int)


def term_sizes(terms: tuple[Term, ...]) -> np.ndarray:
    """Return the first guess of each coefficient's magnitude (E,), for harmonics inverse to their order.

    Our choice among constant, 1 / √order and 1 / order: the last predicts held-out regions of a UR5 and a Motoman best.
    """
    return np.array([1e-4 / term.order if term.basis in ("cos", "sin") else 1e-4 for term in terms])


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
        """Return whether the error is smaller than `other` in at least half of the folds."""
        return bool(np.sum(self.squares < other.squares) * 2 >= len(self.squares))


@dataclass(frozen=True, eq=False)
class FoldStatistics:
    """Least-squares statistics of every fold, for the columns of free geometry and deflection terms.

    Attributes:
        rigid: number of geometry columns, which come first.
        identified: how many of their combinations the rows identify.
        groups: (E,) ridge group of each term.
        sizes: (E,) first guess of each coefficient.
        coordinates: of geometry and terms, in which the statistics are.
        plausible: (rigid,) wide prior on the geometry, which keeps parameters that a fold does not identify at the
            optimum.
        training: per fold, statistics of the other folds' rows, whitened.
        held_out: per fold, statistics of its rows [m], and how many.
        rows: per fold.
        total: statistics of all rows, whitened.
    """

    rigid: int
    identified: int
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
        """Return the errors on held-out rows of a model with the geometry and `terms` (whole groups)."""
        index, chosen = self._columns(terms), self._widths(terms)
        begin = np.where(chosen > 0.0, chosen, self.coordinates.sizes[index])  # where the search begins
        squares = []
        for training, held in zip(self.training, self.held_out):
            x = self._search(training, index, begin, 8).values
            square = held.square.take(index, 0).take(index, 1)
            squares.append(held.total - 2.0 * x @ held.cross[index] + x @ square @ x)
        return UnseenErrors(np.array(squares), self.rows)

    def ridges(self, terms: np.ndarray) -> np.ndarray:
        """Return the most probable prior standard deviation of each term from all rows; 0 if the data drop the term."""
        width = np.ones(int(self.groups.max(initial=-1)) + 1)
        own = self.coordinates.groups[self._columns(terms)[self.rigid :]]
        width[own] = (self._widths(terms) / self.coordinates.sizes[self._columns(terms)])[self.rigid :]
        return width[self.groups[terms]] * self.sizes[terms]

    def _columns(self, terms: np.ndarray) -> np.ndarray:
        return np.flatnonzero(np.isin(self.coordinates.groups, [-1, *self.groups[terms]]))

    def _widths(self, terms: np.ndarray) -> np.ndarray:
        """Return the most probable prior standard deviation of each geometry and term coordinate, from all rows."""
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
            Gram(square, data.cross[index], data.total, data.rows),
            groups - int(self.rigid > 0),
            begin,
            iterations,
            SETTLED,
            self.coordinates.counts[index],
        )


def fold_statistics(
    found: GeometricFit, measured: Sequence[PoseMeasurements], terms: tuple[Term, ...], reference: Chain, folds: Folds
) -> FoldStatistics:
    """Return the statistics of every fold at a fitted model, for its free parameters and `terms`.

    Args:
        found: the model, fitted to all rows.
        measured: the blocks it was fitted to.
        terms: E deflection terms on offer.
        reference: chain on which the terms' bases are evaluated.
        folds: partition of the rows.
    """
    cell = replace(found.cell, deflection=Deflection(terms, np.zeros(len(terms)), reference))
    free = np.concatenate([found.free, layout(cell).index("deflection")])
    chosen = sampled(measured, JUDGED_POSES)
    measured = [take(block, rows) for block, rows in zip(measured, chosen)]
    folds = replace(folds, members=tuple(members[rows] for members, rows in zip(folds.members, chosen)))
    weights = [each[rows] for each, rows in zip(found.row_weights(), chosen)]
    rows_of = _Rows(cell, measured, free, found.used_sigmas(), weights, found.used_noises())
    rigid, groups, sizes = len(found.free), term_groups(terms), term_sizes(terms)
    pooled = all(block.has_instrument for block in measured)
    outside, shares, rows = list[list[Share]](), list[list[Share]](), []
    for fold in range(folds.count):
        inside = [np.flatnonzero(members == fold) for members in folds.members]
        seen = {block.station for block, chosen in zip(measured, inside) if len(chosen) < len(block)}
        moved = [block.has_instrument and block.station not in seen for block in measured]
        own, count = rows_of.statistics(inside, moved)
        shares.append(own)
        rows.append(count)
        if not pooled:
            outside.append(rows_of.statistics([np.flatnonzero(members != fold) for members in folds.members])[0])
    whole = list(chain(*shares)) if pooled else rows_of.statistics([np.arange(len(b)) for b in measured])[0]
    coordinates = condensed(
        lambda columns: sum(factor * own.square[np.ix_(columns, columns)] for own, factor, _ in whole),
        np.concatenate([np.full(rigid, -1), groups]).astype(int),
        np.concatenate([np.ones(rigid), sizes]),
    )
    shares = [[(coordinates.gram(data), white, metric) for data, white, metric in own] for own in shares]
    held_out, each = ([_sum(own, in_metres) for own in shares] for in_metres in (True, False))
    total = sum(each[1:], each[0]) if pooled else coordinates.gram(_sum(whole))
    training = [total - own for own in each] if pooled else [coordinates.gram(_sum(own)) for own in outside]
    wide = plausible_deviation(found.cell, found.free) if found.prior is None else found.prior
    plausible = np.where(np.isfinite(wide), wide, 10.0)
    return FoldStatistics(
        rigid, found.identified, groups, sizes, coordinates, plausible, training, held_out, np.array(rows), total
    )


def blind_folds(nominal: GeometricFit, measured: Sequence[PoseMeasurements], folds: Folds) -> np.ndarray:
    """Return which folds cannot be predicted (folds,): the other rows do not determine the tool position in them.

    There the error by the covariance of geometry and frames (nominal residuals as noise, `plausible_deviation` as
    prior) exceeds `max_blind_error` times those residuals.

    Args:
        nominal: the nominal arm with its frames fitted to all rows.
        measured: the blocks it was fitted to, positions or poses all.
        folds: partition of the rows.
    """
    free = layout(nominal.cell).rigid_index
    sigmas: list[dict[str, float]] = [{} for _ in measured]
    for piece in nominal.pieces:
        sigmas[piece.block][piece.part.label] = max(float(np.sqrt(np.mean(piece.part.value**2))), 1e-9)
    frame_sigma = 1.0  # how far a frame may be from where it is [m, rad] (our choice)
    known = np.minimum(plausible_deviation(nominal.cell, free), frame_sigma)
    none = [None] * len(measured)
    rows = _Rows(nominal.cell, measured, free, sigmas, nominal.row_weights(), none)
    each, squares = [], []
    for fold in range(folds.count):
        inside = [np.flatnonzero(members == fold) for members in folds.members]
        own, count = rows.statistics(inside, [True] * len(measured))
        held = _sum(own, in_metres=True)
        each.append(_sum(own))
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


Share = tuple[Gram, float, float]  # statistics of some rows, and factors that whiten them and put them in metres


def _sum(shares: Sequence[Share], in_metres: bool = False) -> Gram:
    """Return the statistics of all shares, whitened or in metres."""
    factors = [metric if in_metres else white for _, white, metric in shares]
    first, *rest = (own.scaled(factor) for (own, *_), factor in zip(shares, factors) if factor)
    return sum(rest, first)


@dataclass(frozen=True, eq=False)
class _Rows:
    """Measured blocks with the weights of their rows: rms sigma by label, robust weights, noise of images."""

    cell: Installation
    measured: Sequence[PoseMeasurements]
    free: np.ndarray
    scales: Sequence[dict[str, float]]
    weights: Sequence[np.ndarray]
    noises: Sequence[Any]

    def statistics(
        self, chosen: Sequence[np.ndarray], moved: Sequence[bool] | None = None
    ) -> tuple[list[Share], float]:
        """Return the statistics of chosen rows, and the number of rows in metres.

        Of the blocks that are `moved` the station's placement is projected out of the statistics in metres.
        """
        found, count = list[Share](), 0.0
        chunk = 1000  # poses observed at once
        for number, (block, rows) in enumerate(zip(self.measured, chosen)):
            frames: list[np.ndarray] = []
            apart, scales = moved is not None and moved[number], self.scales[number]
            pieces = np.array_split(rows, max(1, len(rows) // chunk)) if block.has_instrument else [rows]
            for piece in filter(len, pieces):
                ready, weights = prepare(self.cell, [take(block, piece)])[0], self.weights[number][piece]
                if separable(block) and not apart:
                    divisors = repeat(1.0 / np.sqrt(weights[None]))
                    for part, own in row_statistics(self.cell, ready, self.free, divisors):
                        found.append((own, scales[part.label] ** -2.0, float(part.label in METRES)))
                    count += float(weights.sum())  # each has one position
                    continue
                noise = self.noises[number].unweighted(len(piece)) if self.noises[number] else None
                for bare in observe(self.cell, ready, self.free):
                    part, weight = replace(bare, noise=noise), weights[bare.index]
                    root = 1.0 / np.sqrt(weight)
                    own = gram(*part.whitened(root * scales[part.label]))
                    found.append((replace(own, rows=part.value.size), 1.0, 0.0))
                    if part.label in METRES:
                        residual, matrix = bare.whitened(root * part.per_length)
                        count += float(weight.sum())
                        if apart:
                            frames.append(np.vstack([matrix.T, residual]))
                        else:
                            found.append((gram(residual, matrix), 0.0, 1.0))
            if frames:
                station = np.flatnonzero(np.isin(self.free, layout(self.cell).index("station")))
                columns = project_out(np.concatenate(frames, axis=1), station)
                found.append((gram(columns[-1], columns[:-1].T), 0.0, 1.0))
        return found, count


def project_out(columns: np.ndarray, frames: np.ndarray) -> np.ndarray:
    """Return columns (f, ...) with those at `frames` projected out, as if these were fitted to the rows."""
    flat = columns.reshape(len(columns), -1)
    basis, size, _ = np.linalg.svd(flat[frames].T, full_matrices=False)
    basis = basis[:, size > 1e-9 * size[0]]
    return (flat - (flat @ basis) @ basis.T).reshape(columns.shape)
