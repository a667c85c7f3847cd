"""Cross-validation of models over time blocks, computed from R factors with one fit per fold.

Models are also tested on held-out ranges of a motion ("regimes"), the extremes of each joint: a correct model
extrapolates to higher speeds and accelerations, to more distant positions, and to the other direction of motion. Time
blocks hardly test this, since each contains some of every range.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from calib.data.signals.filtering import Decimator, kept
from calib.estimation.relevance import Gram, relevance
from calib.estimation.triangles import Triangles
from calib.identification.rows import Case, ObservationRows

FAST_SHARE = 0.1
"""Share of the rows that are a joint's fastest, or its hardest accelerated (our choice)."""
END_SHARE = 0.15
"""Share of the rows at each end of a joint's travel (our choice)."""
MAX_DEVIATION_RATIO = 10.0
"""Largest ratio of the prior deviations of a group's parameters of one unit (our choice)."""
RELEVANCE_ITERATIONS = 12


@dataclass(frozen=True, eq=False)
class Regimes:
    """Products [W y]ᵀ[W y] of the samples in which a torque row's joint is in a range of its motion (e.g. fast).

    Attributes:
        squares, counts: (k, rows, p + 1, p + 1) products and (k, rows) numbers of rows in the k ranges.
        total_squares, total_counts: (rows, p + 1, p + 1) products and (rows,) numbers of all rows.
    """

    squares: np.ndarray
    counts: np.ndarray
    total_squares: np.ndarray
    total_counts: np.ndarray


def regimes(all_rows: Sequence[ObservationRows], cases: Sequence[Case], decimator: Decimator) -> Regimes:
    """Return the products [W y]ᵀ[W y] by range of motion: fast, accelerated, near each end of travel, each direction.

    W is the observation matrix, y are the torques. Standstills are in no range, since friction at rest is undetermined.

    Args:
        all_rows: rows of all recordings.
        cases: recordings.
        decimator: filter and decimation of the rows.
    """
    positions = []
    speeds = []
    accelerations = []
    for case in cases:
        motion = case.motion
        index = kept(motion.segment, decimator)
        positions.append(motion.q[index])
        speeds.append(motion.v[index])
        accelerations.append(motion.a[index])
    q = np.concatenate(positions)
    v = np.concatenate(speeds)
    a = np.concatenate(accelerations)

    row_count, p = all_rows[0].matrix.shape[1:]
    joint = np.arange(row_count) % q.shape[1]
    if row_count % q.shape[1]:
        # Rows of the platform, or the power: of all joints together, and of the one that moves most.
        joint = np.full(row_count, np.argmax(np.std(q, axis=0)))
        v = _signed_norm(v)
        a = _signed_norm(a)
    low, high = np.quantile(q, [END_SHARE, 1.0 - END_SHARE], axis=0)
    speed_limit = np.quantile(np.abs(v), 1.0 - FAST_SHARE, axis=0)
    fastest = np.abs(v) > speed_limit
    acceleration_limit = np.quantile(np.abs(a), 1.0 - FAST_SHARE, axis=0)
    hardest = np.abs(a) > acceleration_limit
    ranges = [fastest, hardest, q < low, q > high, v > 0.0, v < 0.0]
    in_range = np.stack(ranges)[:, :, joint]

    range_count = len(in_range)
    squares = np.zeros((range_count, row_count, p + 1, p + 1))
    counts = np.zeros((range_count, row_count))
    total_squares = np.zeros((row_count, p + 1, p + 1))
    total_counts = np.zeros(row_count)
    start = 0
    for rows in all_rows:
        target = rows.target[:, :, None]
        augmented = np.concatenate([rows.matrix, target], axis=2)
        augmented = augmented * rows.weight[:, :, None]
        part = slice(start, start + len(augmented))
        start += len(augmented)
        for row in range(row_count):
            present = rows.present[:, row]
            total_squares[row] += augmented[present, row].T @ augmented[present, row]
            counted = rows.counted[:, row]
            total_counts[row] += counted.sum()
            moves = rows.standing[:, row] == 0.0
            for k in range(range_count):
                selected = present & moves & in_range[k, part, row]
                selected_rows = augmented[selected, row]
                squares[k, row] += selected_rows.T @ selected_rows
                counts[k, row] += counted[selected].sum()
    return Regimes(squares, counts, total_squares, total_counts)


def _signed_norm(rates: np.ndarray) -> np.ndarray:
    """Return the norm over the joints of rates (N, n), with the sign of each joint's rate, as (N, n).

    Each rate is divided by its standard deviation first.
    """
    normalised = rates / (np.std(rates, axis=0) + 1e-12)
    norm = np.linalg.norm(normalised, axis=1)
    return np.copysign(norm[:, None], rates)


@dataclass(frozen=True, eq=False)
class CrossValidation:
    """Cross-validation with the R factors of all candidate columns, their weights and priors.

    Attributes:
        data: R factors by time block and torque row.
        rows: number of torque rows per sample.
        blocks: number of time blocks, each held out in turn.
        std: (rows,) standard deviation of the residuals [N m or N].
        inflation: (rows,) variance inflation, i.e. number of rows that count as one.
        group: (p,) ridge group of each column, -1 for none.
        prior: (k, p + 1) whitened rows of [W y] of a prior; None without one.
        regimes: function that returns products by range of motion and torque row, called when ranges are first tested;
            None: they are not tested.
    """

    data: Triangles
    rows: int
    blocks: int
    std: np.ndarray
    inflation: np.ndarray
    group: np.ndarray
    prior: np.ndarray | None = None
    regimes: Callable[[], Regimes] | None = None
    _results: dict[bytes, np.ndarray] = field(default_factory=dict, init=False)

    def errors(self, columns: np.ndarray, folds: int | None = None) -> np.ndarray:
        """Return the squared errors (blocks, rows) on each held-out time block, for a model with these columns.

        Errors are sums over samples, not whitened. Blocks without samples have zero errors.

        Args:
            columns: indices of the model's columns.
            folds: number of runs of neighbouring blocks that are held out in turn; None: each block is one. With two,
                each half predicts the other, which is the most that one recording can test extrapolation.
        """
        columns = np.asarray(columns, dtype=int)
        runs = np.array_split(np.arange(self.blocks), folds or self.blocks)
        key = len(runs).to_bytes(4, "little") + columns.tobytes()
        if key not in self._results:
            self._results[key] = self._held_out_errors(columns, runs)
        return self._results[key].copy()

    def extrapolated(self, columns: np.ndarray) -> np.ndarray:
        """Return the squared errors (ranges, rows) in each held-out range of motion, for a model with these columns.

        Args:
            columns: indices of the model's columns.
        """
        regimes = self._regimes
        key = b"ranges" + np.asarray(columns, dtype=int).tobytes()
        if key in self._results:
            return self._results[key]
        index = np.append(columns, self.data.parameters)
        weight = 1.0 / (self.std**2 * self.inflation)
        prior_square = self._prior_square(index)
        diagonals = regimes.total_squares.diagonal(axis1=1, axis2=2)
        rounding = 1e-9 * (weight @ diagonals)[index]
        result = np.zeros((len(regimes.squares), self.rows))
        for k, (held_out, counts) in enumerate(zip(regimes.squares, regimes.counts)):
            training = np.tensordot(weight, regimes.total_squares - held_out, 1)
            training = training.take(index, 0).take(index, 1)
            # Differences of products are positive definite but for rounding.
            training.flat[:: len(index) + 1] += rounding
            training += prior_square
            training_rows = int(np.sum((regimes.total_counts - counts) / self.inflation))
            values, _ = _regularised(training, training_rows, self.group[columns], self._kinds[columns])
            combination = np.append(values, -1.0)
            selected = held_out.take(index, 1).take(index, 2)
            result[k] = np.einsum("i,rij,j->r", combination, selected, combination)
        return self._results.setdefault(key, np.maximum(result, 0.0))

    def _held_out_errors(self, columns: np.ndarray, runs: list[np.ndarray]) -> np.ndarray:
        """Return the squared errors (blocks, rows) of ridge estimates, each run of blocks predicted from the others.

        Args:
            columns: indices of the model's columns.
            runs: sets of block numbers, each held out together.
        """
        index = np.append(columns, self.data.parameters)
        squares = self._squares.take(index, 1).take(index, 2)
        prior_square = self._prior_square(index)
        samples = self.data.rows.reshape(-1, self.rows)[: self.blocks]
        errors = np.zeros((self.blocks, self.rows))
        for run in runs:
            training_blocks = ~np.isin(np.arange(self.blocks), run)
            training = squares[training_blocks].sum(axis=0) + prior_square
            training_rows = int(np.sum(samples[training_blocks].sum(axis=0) / self.inflation))
            values, _ = _regularised(training, training_rows, self.group[columns], self._kinds[columns])
            combination = np.zeros(self.data.parameters + 1)
            combination[columns] = values
            combination[-1] = -1.0
            for block in run:
                factors = self.data.factors[block * self.rows : (block + 1) * self.rows]
                errors[block] = np.sum((factors @ combination) ** 2, axis=1)
        return errors

    def _prior_square(self, index: np.ndarray) -> np.ndarray | float:
        """Return the product [W y]ᵀ[W y] of the prior's rows in the columns `index`; zero without a prior."""
        if self.prior is None:
            return 0.0
        return self.prior[:, index].T @ self.prior[:, index]

    @cached_property
    def _regimes(self) -> Regimes:
        assert self.regimes is not None
        return self.regimes()

    @cached_property
    def _kinds(self) -> np.ndarray:
        return _kinds(self.group, self.data.units)

    @cached_property
    def _squares(self) -> np.ndarray:
        """Products [W y]ᵀ[W y] of the whitened rows of each time block (blocks, p + 1, p + 1)."""
        factors = self.data.factors[: self.blocks * self.rows]
        weight = np.tile(1.0 / (self.std**2 * self.inflation), self.blocks)
        weighted = factors.transpose(0, 2, 1) * weight[:, None, None]
        squares = weighted @ factors
        by_block = squares.reshape(self.blocks, self.rows, *squares.shape[1:])
        return by_block.sum(axis=1)


def estimate(
    data: Triangles, std: np.ndarray, inflation: np.ndarray, group: np.ndarray, prior: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return parameter values (p,) and their prior standard deviations (p,).

    Columns with a group are regularised towards zero with the strength that maximises the evidence
    (`calib.estimation.relevance`). If no column has a group, the estimate is that of weighted least squares. Directions
    without data are zero. Prior standard deviations are infinite without ridge, and 0 for columns of a group that is
    switched off.

    Args:
        data: R factors, one group per torque row.
        std, inflation: (rows,) standard deviation [N m or N] and variance inflation of the residuals.
        group: (p,) ridge group of each column; -1 for none.
        prior: (k, p + 1) whitened rows of a prior, to be appended to the rows [W y]; None without one.
    """
    weight = 1.0 / (std * np.sqrt(inflation))
    weighted = data.factors * weight[:, None, None]
    whitened = weighted.reshape(-1, data.parameters + 1)
    if prior is not None:
        whitened = np.vstack([whitened, prior])
    if (group < 0).all():
        size = np.sqrt(np.sum(whitened[:, :-1] ** 2, axis=0))
        scale = np.where(size > 0.0, size, 1.0)
        scaled_matrix = whitened[:, :-1] / scale
        scaled_values, *_ = np.linalg.lstsq(scaled_matrix, whitened[:, -1], rcond=1e-10)
        return scaled_values / scale, np.full(len(group), np.inf)
    row_count = int(np.sum(data.rows / inflation))
    return _regularised(whitened.T @ whitened, row_count, group, _kinds(group, data.units))


def _kinds(group: np.ndarray, units: Sequence[str]) -> np.ndarray:
    """Return a number (p,) that is equal for columns of the same group and unit; -1 for columns without a group.

    Args:
        group: (p,) ridge group of each column; -1 for none.
        units: unit of each column.
    """
    distinct, unit = np.unique(units, return_inverse=True)
    return np.where(group < 0, -1, group * len(distinct) + unit)


def _regularised(square: np.ndarray, rows: int, group: np.ndarray, kinds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return values and prior standard deviations (p,) from the product [W y]ᵀ[W y] and its number of rows.

    A group's ridge is in units of what each column explains, so that one ridge suffices for different units. But
    parameters of one kind have about equal sizes. A parameter that the motion hardly excites (Stribeck friction of a
    joint that never slows down) therefore has a prior standard deviation of at most `MAX_DEVIATION_RATIO` times that of
    the best excited parameter of its kind.

    Args:
        square: (p + 1, p + 1) product [W y]ᵀ[W y] of whitened rows.
        rows: number of rows.
        group: (p,) ridge group of each column; -1 for none.
        kinds: (p,) number that is equal for columns of the same group and unit; -1 without group.
    """
    size = np.sqrt(np.diag(square)[:-1])
    # Largest size of each kind; the last entry is that of kind -1.
    largest = np.zeros(kinds.max(initial=-1) + 2)
    np.maximum.at(largest, kinds, size)
    size = np.where(group < 0, size, np.maximum(size, largest[kinds] / MAX_DEVIATION_RATIO))
    safe_size = np.where(size > 0.0, size, 1.0)
    scale = safe_size / np.sqrt(max(rows, 1))
    scaled = square[:-1, :-1] / (scale[:, None] * scale)
    # Free columns without data stay at zero.
    scaled[np.diag_indices(len(group))] += np.where(group < 0, 1e-9 * rows, 0.0)
    cross = square[:-1, -1] / scale
    total = float(square[-1, -1])
    data = Gram(scaled, cross, total, rows)
    start = np.ones(len(group))
    fit = relevance(data, group, start, RELEVANCE_ITERATIONS)
    ridge = np.where(np.isfinite(fit.ridge), fit.ridge / scale, np.inf)
    return fit.values / scale, ridge
