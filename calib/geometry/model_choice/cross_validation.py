"""Cross-validation errors from sufficient statistics, fast for every fold and every subset of correction terms.

The model is linear in the coefficients of its terms and, near its optimum, in the geometry. For each fold, the
statistics WᵀW, Wᵀr of the training rows give the estimate, and the statistics of the held-out rows its error. Nothing
is fitted to held-out rows except the placement of a station all of whose rows are held out (it is projected out).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import chain, repeat

import numpy as np

from calib.data.poses.measurements import PoseMeasurements, take
from calib.estimation.relevance import SETTLED, Condensed, Gram, Relevance, condensed, gram, relevance
from calib.geometry.fit import plausible_deviation
from calib.geometry.installation import Installation
from calib.geometry.many_corrections import row_statistics, separable
from calib.geometry.model_choice.folds import Folds
from calib.geometry.observation import layout, observe, prepare, sampled
from calib.geometry.residuals import CommonNoise
from calib.geometry.weighing import GeometricFit
from calib.robot.calibrated import BY_TORQUE, Deflection, Term
from calib.robot.chain import Chain

# largest number of poses by which models are compared (our choice)
JUDGED_POSES = 20_000
# labels of the residual parts whose errors are evaluated in metres
METRES = ("position", "consistency", "distance", "plane", "pixel")
HARMONIC = ("cos", "sin")
# first guess of a coefficient's magnitude; for harmonics, that of the first order (our choice)
FIRST_SIZE = 1e-4
# largest number of iterations of the search for the ridges, of a fold and of all rows
FOLD_ROUNDS = 8
TOTAL_ROUNDS = 15
# prior standard deviation of a parameter without prior [m, rad] (our choice)
UNKNOWN_SIGMA = 10.0
# prior standard deviation of a placement about its estimate [m, rad] (our choice)
FRAME_SIGMA = 1.0
# largest ratio of the error by covariance to the nominal residuals, for a fold that can be predicted (our choice)
MAX_BLIND_ERROR = 3.0
# number of poses evaluated at once
CHUNK = 1000


def term_groups(terms: tuple[Term, ...]) -> np.ndarray:
    """Return the ridge group of each term (E,): terms of one group have prior standard deviations in a fixed ratio.

    Harmonics of one joint on one element are one group, so are the compliances of all joints about their axes, and
    those across the axes; every other term is a group of its own. With a ridge for each order, the evidence would
    switch most orders off and make the others too large, which is seen only on distant rows.
    `term_sizes` gives the decrease of the prior with the order.
    """
    numbers: dict[tuple, int] = {}
    result = []
    for term in terms:
        key = (term.element, term.basis, term.source, term.order)
        if term.basis in HARMONIC:
            key = (term.element, "turn", term.source, 0)
        if term.basis in BY_TORQUE:
            key = (term.basis,)
        result.append(numbers.setdefault(key, len(numbers)))
    return np.array(result, dtype=int)


def term_sizes(terms: tuple[Term, ...]) -> np.ndarray:
    """Return the first guess of each coefficient's magnitude (E,); for harmonics it is inverse to their order.

    This is our choice among constant, 1 / √order and 1 / order: the last predicts held-out regions of a UR5 and a
    Motoman best.

    Args:
        terms: the E terms.
    """
    sizes = []
    for term in terms:
        order = term.order if term.basis in HARMONIC else 1
        sizes.append(FIRST_SIZE / order)
    return np.array(sizes)


@dataclass(frozen=True, eq=False)
class UnseenErrors:
    """Errors on held-out rows.

    Attributes:
        squares: (folds,) sum of squared errors [m²].
        rows: (folds,) number of rows, each weighted by its robust weight.
    """

    squares: np.ndarray
    rows: np.ndarray

    @property
    def rms(self) -> float:
        """Root mean square of the error's norm over all rows [m]."""
        mean_square = max(self.squares.sum(), 0.0) / max(self.rows.sum(), 1)
        return float(np.sqrt(mean_square))

    def wins(self, errors: UnseenErrors) -> bool:
        """Return whether the error is smaller than the other error `errors` in at least half of the folds."""
        return bool(np.sum(self.squares < errors.squares) * 2 >= len(self.squares))


@dataclass(frozen=True, eq=False)
class FoldStatistics:
    """Least-squares statistics of every fold, for the columns of the fitted geometry and of deflection terms.

    Attributes:
        rigid: number of geometry columns, which are the first columns.
        identified: number of geometry parameters or combinations that the rows identify.
        groups: (E,) ridge group of each term.
        sizes: (E,) first guess of each coefficient's magnitude.
        coordinates: coordinates of geometry and terms in which the statistics are expressed.
        plausible: (rigid,) wide prior on the geometry, which keeps parameters that a fold does not identify at the
            optimum.
        training: for each fold, whitened statistics of the rows of all other folds.
        held_out: for each fold, statistics of its rows [m].
        rows: (folds,) number of held-out rows, each weighted by its robust weight.
        total: whitened statistics of all rows.
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
    _widths_of_terms: dict[bytes, np.ndarray] = field(default_factory=dict, init=False)

    def error(self, terms: np.ndarray) -> UnseenErrors:
        """Return the errors on held-out rows of a model with the geometry and the terms numbered `terms`.

        If a term of a group is included, all terms of the group are.
        """
        index = self._columns(terms)
        widths = self._widths(terms)
        start = np.where(widths > 0.0, widths, self.coordinates.sizes[index])
        squares = []
        for training, held_out in zip(self.training, self.held_out):
            x = self._search(training, index, start, FOLD_ROUNDS).values
            square = held_out.square.take(index, 0).take(index, 1)
            squares.append(held_out.total - 2.0 * x @ held_out.cross[index] + x @ square @ x)
        return UnseenErrors(np.array(squares), self.rows)

    def ridges(self, terms: np.ndarray) -> np.ndarray:
        """Return the most probable prior standard deviation of each term, from all rows; 0 for a term that is
        switched off.
        """
        columns = self._columns(terms)
        factors = self._widths(terms) / self.coordinates.sizes[columns]
        factor_of_group = np.ones(int(self.groups.max(initial=-1)) + 1)
        group_of_column = self.coordinates.groups[columns[self.rigid :]]
        factor_of_group[group_of_column] = factors[self.rigid :]
        return factor_of_group[self.groups[terms]] * self.sizes[terms]

    def _columns(self, terms: np.ndarray) -> np.ndarray:
        return np.flatnonzero(np.isin(self.coordinates.groups, [-1, *self.groups[terms]]))

    def _widths(self, terms: np.ndarray) -> np.ndarray:
        """Return the most probable prior standard deviation of each coordinate of geometry and terms, from all rows."""
        key = terms.tobytes()
        if key not in self._widths_of_terms:
            index = self._columns(terms)
            estimate = self._search(self.total, index, self.coordinates.sizes[index], TOTAL_ROUNDS)
            self._widths_of_terms[key] = estimate.ridge
        return self._widths_of_terms[key]

    def _search(self, data: Gram, index: np.ndarray, start: np.ndarray, iterations: int) -> Relevance:
        """Return the estimate of the coordinates `index`, with the most probable prior standard deviations.

        Args:
            data: sufficient statistics of the rows, in all coordinates.
            index: indices of the coordinates to estimate.
            start: initial prior standard deviations.
            iterations: largest number of iterations.
        """
        square = data.square.take(index, 0).take(index, 1)
        rigid = np.arange(self.rigid)
        square[rigid, rigid] += 1.0 / self.plausible**2
        _, groups = np.unique(self.coordinates.groups[index], return_inverse=True)
        if self.rigid:
            groups = groups - 1
        statistics = Gram(square, data.cross[index], data.total, data.rows)
        return relevance(statistics, groups, start, iterations, SETTLED, self.coordinates.counts[index])


def fold_statistics(
    fit: GeometricFit, measured: Sequence[PoseMeasurements], terms: tuple[Term, ...], reference: Chain, folds: Folds
) -> FoldStatistics:
    """Return the statistics of every fold at a fitted model, for its fitted parameters and `terms`.

    Args:
        fit: the model, fitted to all rows.
        measured: the blocks to which it was fitted.
        terms: E deflection terms that the model selection may choose from.
        reference: chain on which the terms' basis functions are evaluated.
        folds: partition of the rows.
    """
    cell = with_terms(fit.cell, terms, reference)
    added = layout(cell).index("deflection")[len(fit.cell.deflection.terms) :]
    free = np.concatenate([fit.free, added])
    sample = sampled(measured, JUDGED_POSES)
    measured = [take(block, rows) for block, rows in zip(measured, sample)]
    folds_of_rows = [members[rows] for members, rows in zip(folds.members, sample)]
    weights = [weight[rows] for weight, rows in zip(fit.row_weights(), sample)]
    rows = _FoldRows(cell, measured, free, fit.used_sigmas(), weights, fit.used_noises())
    # with instruments alone a fold's training rows are all rows but its own, so that statistics subtract
    pooled = all(block.has_instrument for block in measured)
    held_out_shares = list[list[Share]]()
    training_shares = list[list[Share]]()
    counts = []
    for fold in range(folds.count):
        held_out = [np.flatnonzero(members == fold) for members in folds_of_rows]
        shares, count = rows.statistics(held_out, _placed_anew(measured, held_out))
        held_out_shares.append(shares)
        counts.append(count)
        if not pooled:
            training = [np.flatnonzero(members != fold) for members in folds_of_rows]
            training_shares.append(rows.statistics(training)[0])
    if pooled:
        all_shares = list(chain(*held_out_shares))
    else:
        all_shares = rows.statistics([np.arange(len(block)) for block in measured])[0]
    rigid = len(fit.free)
    groups = term_groups(terms)
    sizes = term_sizes(terms)

    def square(columns: np.ndarray) -> np.ndarray:
        result = np.zeros((len(columns), len(columns)))
        for share in all_shares:
            result += share.gram.square[np.ix_(columns, columns)] * share.whitening
        return result

    all_groups = np.concatenate([np.full(rigid, -1), groups]).astype(int)
    all_sizes = np.concatenate([np.ones(rigid), sizes])
    coordinates = condensed(square, all_groups, all_sizes)
    metric_sums = []
    whitened_sums = []
    for shares in held_out_shares:
        condensed_shares = [share.condensed(coordinates) for share in shares]
        metric_sums.append(_sum(condensed_shares, in_metres=True))
        whitened_sums.append(_sum(condensed_shares))
    if pooled:
        total = sum(whitened_sums[1:], whitened_sums[0])
        training_sums = [total - held_out for held_out in whitened_sums]
    else:
        total = coordinates.gram(_sum(all_shares))
        training_sums = [coordinates.gram(_sum(shares)) for shares in training_shares]
    width = fit.prior
    if width is None:
        width = plausible_deviation(fit.cell, fit.free)
    return FoldStatistics(
        rigid=rigid,
        identified=fit.identified,
        groups=groups,
        sizes=sizes,
        coordinates=coordinates,
        plausible=np.where(np.isfinite(width), width, UNKNOWN_SIGMA),
        training=training_sums,
        held_out=metric_sums,
        rows=np.array(counts),
        total=total,
    )


def with_terms(cell: Installation, terms: tuple[Term, ...], reference: Chain) -> Installation:
    """Return an installation with deflection terms after its own, with coefficients of zero.

    Args:
        cell: the installation.
        terms: the terms to add.
        reference: chain on which the basis functions of all terms are evaluated.
    """
    coefficients = np.asarray(cell.deflection.coefficients)
    coefficients = np.concatenate([coefficients, np.zeros(len(terms))])
    return replace(cell, deflection=Deflection((*cell.deflection.terms, *terms), coefficients, reference))


def _placed_anew(measured: Sequence[PoseMeasurements], held_out: Sequence[np.ndarray]) -> list[bool]:
    """Return, for each block, whether all rows of its station are held out.

    The placement of such a station is fitted to the held-out rows.

    Args:
        measured: the blocks of measurements.
        held_out: for each block, the numbers of its held-out rows.
    """
    fitted_stations = set()
    for block, rows in zip(measured, held_out):
        if len(rows) < len(block):
            fitted_stations.add(block.station)
    return [block.has_instrument and block.station not in fitted_stations for block in measured]


def blind_folds(nominal: GeometricFit, measured: Sequence[PoseMeasurements], folds: Folds) -> np.ndarray:
    """Return which folds cannot be predicted, (folds,) bool: the other rows do not determine the tool position in them.

    The expected error of a fold follows from the covariance of geometry and placements, with the nominal arm's
    residuals as noise and `plausible_deviation` as prior. A fold cannot be predicted where this error exceeds
    `MAX_BLIND_ERROR` times the residuals.

    Args:
        nominal: the nominal arm with placements fitted to all rows.
        measured: the blocks to which it was fitted; all must be positions or poses.
        folds: partition of the rows.
    """
    free = layout(nominal.cell).rigid_index
    sigmas: list[dict[str, float]] = [{} for _ in measured]
    for piece in nominal.pieces:
        rms = float(np.sqrt(np.mean(piece.part.value**2)))
        sigmas[piece.block][piece.part.label] = max(rms, 1e-9)
    prior = np.minimum(plausible_deviation(nominal.cell, free), FRAME_SIGMA)
    scales = np.outer(prior, prior)
    rows = _FoldRows(nominal.cell, measured, free, sigmas, nominal.row_weights(), [None] * len(measured))
    statistics = []
    mean_squares = []
    noise = 0.0
    for fold in range(folds.count):
        held_out = [np.flatnonzero(members == fold) for members in folds.members]
        shares, count = rows.statistics(held_out, [True] * len(measured))
        in_metres = _sum(shares, in_metres=True)
        statistics.append(_sum(shares))
        mean_squares.append(in_metres.square / max(count, 1.0))
        noise += in_metres.total / max(count, 1.0)
    noise /= folds.count
    total = sum(statistics[1:], statistics[0])
    result = np.zeros(folds.count, dtype=bool)
    for fold, held_out_statistics in enumerate(statistics):
        information = (total - held_out_statistics).square + np.diag(prior**-2)
        covariance = np.linalg.inv(information * scales) * scales
        predicted = float(np.sum(mean_squares[fold] * covariance))
        result[fold] = predicted > MAX_BLIND_ERROR**2 * noise
    return result


@dataclass(frozen=True, eq=False)
class Share:
    """Statistics of some rows, and the factors that convert them to whitened statistics and to metres.

    A factor is 0 where the rows are not included in statistics of that kind.
    """

    gram: Gram
    whitening: float
    metric: float

    def condensed(self, coordinates: Condensed) -> Share:
        """Return the statistics expressed in other coordinates."""
        return replace(self, gram=coordinates.gram(self.gram))


def _sum(shares: Sequence[Share], in_metres: bool = False) -> Gram:
    """Return the summed statistics of all shares: in metres if `in_metres`, else whitened."""
    scaled = []
    for share in shares:
        factor = share.metric if in_metres else share.whitening
        if factor:
            scaled.append(share.gram.scaled(factor))
    return sum(scaled[1:], scaled[0])


@dataclass(frozen=True, eq=False)
class _FoldRows:
    """Measured blocks with the weights of their rows: rms sigma by label, robust weights, noise of images."""

    cell: Installation
    measured: Sequence[PoseMeasurements]
    free: np.ndarray
    sigmas: Sequence[dict[str, float]]
    weights: Sequence[np.ndarray]
    noises: Sequence[CommonNoise | None]

    def statistics(
        self, block_rows: Sequence[np.ndarray], placed_anew: Sequence[bool] | None = None
    ) -> tuple[list[Share], float]:
        """Return the statistics of some rows, and the number of rows in metres, weighted by their robust weights.

        For blocks marked in `placed_anew`, the station's placement is projected out of the statistics in metres.

        Args:
            block_rows: for each block, the row numbers.
            placed_anew: for each block, whether its station's placement is fitted to these rows; None for no block.
        """
        shares = list[Share]()
        count = 0.0
        for number, (block, rows) in enumerate(zip(self.measured, block_rows)):
            projected = placed_anew is not None and placed_anew[number]
            pieces = [rows]
            if block.has_instrument:
                pieces = np.array_split(rows, max(1, len(rows) // CHUNK))
            frames: list[np.ndarray] = []
            for piece in pieces:
                if not len(piece):
                    continue
                if separable(block) and not projected:
                    shares += self._separable_shares(number, piece)
                    # each row has one position
                    count += float(self.weights[number][piece].sum())
                    continue
                piece_shares, metric_parts = self._observed_shares(number, piece)
                shares += piece_shares
                for residual, matrix, weight in metric_parts:
                    count += float(weight.sum())
                    if projected:
                        frames.append(np.vstack([matrix.T, residual]))
                    else:
                        shares.append(Share(gram(residual, matrix), 0.0, 1.0))
            if frames:
                station = np.flatnonzero(np.isin(self.free, layout(self.cell).index("station")))
                columns = project_out(np.concatenate(frames, axis=1), station)
                shares.append(Share(gram(columns[-1], columns[:-1].T), 0.0, 1.0))
        return shares, count

    def _separable_shares(self, number: int, rows: np.ndarray) -> list[Share]:
        """Return the statistics of positions or poses; for these, whitened and metric rows differ only by a factor.

        Args:
            number: index of the block.
            rows: row numbers in the block.
        """
        block = prepare(self.cell, [take(self.measured[number], rows)])[0]
        divisors = repeat(1.0 / np.sqrt(self.weights[number][rows][None]))
        shares = []
        for part, statistics in row_statistics(self.cell, block, self.free, divisors):
            whitening = self.sigmas[number][part.label] ** -2.0
            shares.append(Share(statistics, whitening, float(part.label in METRES)))
        return shares

    def _observed_shares(
        self, number: int, rows: np.ndarray
    ) -> tuple[list[Share], list[tuple[np.ndarray, np.ndarray, np.ndarray]]]:
        """Return the statistics of whitened rows, and for rows in metres residual, Jacobian and weights of each part.

        Args:
            number: index of the block.
            rows: row numbers in the block.
        """
        block = prepare(self.cell, [take(self.measured[number], rows)])[0]
        weights = self.weights[number][rows]
        noise = self.noises[number]
        if noise:
            noise = noise.unweighted(len(rows))
        shares = []
        metric_parts = []
        for part in observe(self.cell, block, self.free):
            weight = weights[part.index]
            root = 1.0 / np.sqrt(weight)
            residual, matrix = replace(part, noise=noise).whitened(root * self.sigmas[number][part.label])
            statistics = replace(gram(residual, matrix), rows=part.value.size)
            shares.append(Share(statistics, 1.0, 0.0))
            if part.label in METRES:
                residual, matrix = part.whitened(root * part.per_length)
                metric_parts.append((residual, matrix, weight))
        return shares, metric_parts


def project_out(columns: np.ndarray, frames: np.ndarray) -> np.ndarray:
    """Return the part of `columns` (f, ...) that is orthogonal to the columns at `frames`.

    This has the same effect as a fit of the parameters at `frames` to the rows.

    Args:
        columns: (f, ...) statistics or Jacobian columns of f parameters.
        frames: indices of the parameters to project out.
    """
    flat = columns.reshape(len(columns), -1)
    basis, size, _ = np.linalg.svd(flat[frames].T, full_matrices=False)
    basis = basis[:, size > 1e-9 * size[0]]
    return (flat - (flat @ basis) @ basis.T).reshape(columns.shape)
