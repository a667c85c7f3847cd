"""Cross-validation of models over time blocks: computed from R factors, one fit per fold.

Regimes of a motion, on which models are judged without having been fitted to them, are each joint's extremes. A model
that is right goes on being right where a joint is faster, accelerates more, or stands farther out than in its training
data, and in the direction of travel that it has not seen. Blocks of time hardly ask for that: each holds some of
everything.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import scipy.linalg

from calib.data.signals.filtering import Decimator, kept
from calib.estimation.relevance import Gram, relevance
from calib.estimation.triangles import Triangles
from calib.identification.rows import Case, ObservationRows, pool

FAST_SHARE, END_SHARE = 0.1, 0.15  # of the rows: a joint's fastest, its hardest accelerated; at each end (our choice)


@dataclass(frozen=True, eq=False)
class Regimes:
    """Products [W y]ᵀ[W y] of the samples in which a torque row's joint is in a range of motion (e.g. fast).

    Attributes:
        squares, counts: (k, rows, p + 1, p + 1) and (k, rows) of the k ranges.
        whole, total: (rows, p + 1, p + 1) and (rows,) of all rows.
    """

    squares: np.ndarray
    counts: np.ndarray
    whole: np.ndarray
    total: np.ndarray


def regimes(all_rows: Sequence[ObservationRows], cases: Sequence[Case], decimator: Decimator) -> Regimes:
    """Return the products of cases by range of motion: fast, accelerated, at each end of travel, each direction."""
    motions = [case.motion for case in cases]
    chosen = [kept(motion.segment, decimator) for motion in motions]
    q, v, a = (
        np.concatenate([getattr(motion, key)[own] for motion, own in zip(motions, chosen)]) for key in ("q", "v", "a")
    )
    rows, p = all_rows[0].matrix.shape[1:]
    joint = np.arange(rows) % q.shape[1]
    if rows % q.shape[1]:  # rows of the platform, or the power: of all joints together, and of the one that moves most
        joint = np.full(rows, np.argmax(np.std(q, axis=0)))
        v, a = (np.copysign(np.linalg.norm(x / (np.std(x, axis=0) + 1e-12), axis=1)[:, None], x) for x in (v, a))
    low, high = np.quantile(q, [END_SHARE, 1.0 - END_SHARE], axis=0)
    fastest, hardest = (np.abs(x) > np.quantile(np.abs(x), 1.0 - FAST_SHARE, axis=0) for x in (v, a))
    inside = np.stack([fastest, hardest, q < low, q > high, v > 0.0, v < 0.0])[:, :, joint]
    stacked = [np.concatenate([part.matrix, part.target[:, :, None]], axis=2) for part in all_rows]
    squares, counts = np.zeros((len(inside), rows, p + 1, p + 1)), np.zeros((len(inside), rows))
    whole, total = np.zeros((rows, p + 1, p + 1)), np.zeros(rows)
    start = 0
    for part, both in zip(all_rows, stacked):
        own = slice(start, start + len(both))
        start += len(both)
        for row in range(rows):
            used = part.present[:, row]
            whole[row] += both[used, row].T @ both[used, row]
            total[row] += used.sum()
            for k in range(len(inside)):
                held = both[used & inside[k, own, row], row]
                squares[k, row] += held.T @ held
                counts[k, row] += len(held)
    return Regimes(squares, counts, whole, total)


@dataclass(frozen=True, eq=False)
class CrossValidation:
    """R factors of all candidate columns by (block, row), with their weights and priors.

    Attributes:
        data: triangles by (block, row).
        rows: number of torque rows per sample.
        blocks: number of time blocks, each held out in turn.
        std: (rows,) standard deviation of the residuals.
        inflation: (rows,) variance inflation: number of rows that count as one.
        group: (p,) ridge group of each column, -1 for none.
        prior: (k, p + 1) whitened rows of [W y] of a prior; None without one.
        regimes: products by range of motion and torque row, see `calib.identification.time_folds`.
    """

    data: Triangles
    rows: int
    blocks: int
    std: np.ndarray
    inflation: np.ndarray
    group: np.ndarray
    prior: np.ndarray | None = None
    regimes: Regimes | None = None
    _known: dict[bytes, np.ndarray] = field(default_factory=dict, init=False)
    _kept: dict[int, list["_Ridgeless"]] = field(default_factory=dict, init=False)

    def errors(self, columns: np.ndarray, folds: int | None = None) -> np.ndarray:
        """Return the squared errors (blocks, rows) on each held-out block of a model with these columns.

        Squares are of samples, not whitened; blocks that a recording's gaps left empty hold zeros.

        Args:
            folds: in how many runs of neighbouring blocks the time is left out; None: block by block. Two: each half
                predicts the other, as far as one recording can extrapolate.
        """
        columns = np.asarray(columns, dtype=int)
        runs = np.array_split(np.arange(self.blocks), folds or self.blocks)
        key = len(runs).to_bytes(4, "little") + columns.tobytes()
        if key not in self._known:
            fitted = self._fitted if (self.group[columns] < 0).all() else self._ridged
            values = fitted(columns, runs)
            each = [own for run, own in zip(runs, values) for _ in run]
            self._known[key] = self._errors(columns, each)
        return self._known[key].copy()

    def extrapolated(self, columns: np.ndarray) -> np.ndarray:
        """Return the squared errors (ranges, rows) in each held-out range of motion of a model with these columns."""
        assert self.regimes is not None
        index = np.append(columns, self.data.parameters)
        result = np.zeros((len(self.regimes.squares), self.rows))
        for k, (held, own) in enumerate(zip(self.regimes.squares, self._ridged(columns))):
            values = np.append(own, -1.0)
            result[k] = np.einsum("i,rij,j->r", values, held.take(index, 1).take(index, 2), values)
        return np.maximum(result, 0.0)

    def _ridged(self, columns: np.ndarray, runs: Sequence[np.ndarray] | None = None) -> list[np.ndarray]:
        """Return the ridge estimates from all rows outside each run of blocks, or each range of motion (None).

        Args:
            columns: all that have no ridge, and some with one.
        """
        key = 0 if runs is None else len(runs)
        if key not in self._kept:
            assert self.regimes is not None
            wholes = map(self._outside, range(len(self.regimes.squares))) if runs is None else map(self._others, runs)
            self._kept[key] = [_Ridgeless.of(*whole, np.flatnonzero(self.group < 0)) for whole in wholes]
        return [fold.ridged(columns, self.group[columns], self._kinds[columns])[0] for fold in self._kept[key]]

    def _outside(self, k: int) -> tuple[np.ndarray, int]:
        """Return the whitened products [W y]ᵀ[W y] and number of rows outside a held-out range of motion."""
        assert self.regimes is not None
        weight = 1.0 / (self.std**2 * self.inflation)
        rest = np.tensordot(weight, self.regimes.whole - self.regimes.squares[k], 1)
        rounding = 1e-9 * (weight @ self.regimes.whole.diagonal(axis1=1, axis2=2))
        rest.flat[:: len(rest) + 1] += rounding  # differences are positive definite but for that
        rows = np.sum((self.regimes.total - self.regimes.counts[k]) / self.inflation)
        return rest + self._beforehand, int(rows)

    def _others(self, run: np.ndarray) -> tuple[np.ndarray, int]:
        """Return the whitened products [W y]ᵀ[W y] and number of rows of all blocks but a run of them."""
        others = ~np.isin(np.arange(self.blocks), run)
        rows = np.sum(self.counts()[others].sum(axis=0) / self.inflation)
        return self._squares[others].sum(axis=0) + self._beforehand, int(rows)

    @cached_property
    def _beforehand(self) -> np.ndarray | float:
        return 0.0 if self.prior is None else self.prior.T @ self.prior

    def _errors(self, columns: np.ndarray, values: list[np.ndarray]) -> np.ndarray:
        """Return the squared errors of parameter values (k,) per block."""
        result = np.zeros((self.blocks, self.rows))
        for block, own in enumerate(values):
            x = np.zeros(self.data.parameters)
            x[columns] = own
            factors = self.data.factors[block * self.rows : (block + 1) * self.rows]
            result[block] = np.sum((factors @ np.append(x, -1.0)) ** 2, axis=1)
        return result

    def _fitted(self, columns: np.ndarray, runs: list[np.ndarray]) -> list[np.ndarray]:
        """Return, for each run of blocks, the least-squares fit to all other blocks."""
        chosen, group = self.data.select(columns), self.group[columns]
        prior = None if self.prior is None else self.prior[:, np.append(columns, -1)]
        folds = [[other for other in range(self.blocks) if other not in run] for run in runs]
        pooled = (pool(chosen, self.rows, others) for others in folds)
        return [estimate(data, self.std, self.inflation, group, prior)[0] for data in pooled]

    @cached_property
    def _kinds(self) -> np.ndarray:
        return _kinds(self.group, self.data.units)

    @cached_property
    def _squares(self) -> np.ndarray:
        """Products [W y]ᵀ[W y] of the whitened rows of each block (blocks, p + 1, p + 1)."""
        factors = self.data.factors[: self.blocks * self.rows]
        weight = np.tile(1.0 / (self.std**2 * self.inflation), self.blocks)
        squares = (factors.transpose(0, 2, 1) * weight[:, None, None]) @ factors
        return squares.reshape(self.blocks, self.rows, *squares.shape[1:]).sum(axis=1)

    def counts(self) -> np.ndarray:
        """Return the number of samples (blocks, rows)."""
        return self.data.rows.reshape(-1, self.rows)[: self.blocks]


def estimate(
    data: Triangles, std: np.ndarray, inflation: np.ndarray, group: np.ndarray, prior: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return values (p,) and prior standard deviations (p,): infinite without ridge, 0 for columns switched off.

    Columns with a group are regularised towards zero as strongly as the evidence says (`calib.estimation.relevance`);
    with none, this is weighted least squares. Directions without any data stay where they are: at zero.
    """
    weight = 1.0 / (std * np.sqrt(inflation))
    stacked = (data.factors * weight[:, None, None]).reshape(-1, data.parameters + 1)
    if prior is not None:
        stacked = np.vstack([stacked, prior])
    if (group < 0).all():
        size = np.sqrt(np.sum(stacked[:, :-1] ** 2, axis=0))
        scale = np.where(size > 0.0, size, 1.0)
        found = np.linalg.lstsq(stacked[:, :-1] / scale, stacked[:, -1], rcond=1e-10)[0]
        return found / scale, np.full(len(group), np.inf)
    whole = _Ridgeless.of(stacked.T @ stacked, int(np.sum(data.rows / inflation)), np.flatnonzero(group < 0))
    return whole.ridged(np.arange(len(group)), group, _kinds(group, data.units))


def _kinds(group: np.ndarray, units: Sequence[str]) -> np.ndarray:
    """Return a number (p,) for columns with the same group and unit; -1 for columns without a group."""
    found, unit = np.unique(units, return_inverse=True)
    return np.where(group < 0, -1, group * len(found) + unit)


@dataclass(frozen=True, eq=False)
class _Ridgeless:
    """Products [W y]ᵀ[W y] with the columns eliminated that have no ridge: what those leave, and how to get them back.

    Attributes:
        square, rows: (p + 1, p + 1) of all columns, and the number of rows.
        free: (k,) indices of the columns without a ridge.
        root: (k, k) of their products, lower.
        across, left: (k, p + 1) and (p + 1, p + 1): R⁻ᵀ WᵀW of them with all columns, and what they leave of the
            products.
    """

    square: np.ndarray
    rows: int
    free: np.ndarray
    root: np.ndarray
    across: np.ndarray
    left: np.ndarray

    @classmethod
    def of(cls, square: np.ndarray, rows: int, free: np.ndarray) -> "_Ridgeless":
        size = np.diag(square)[free]
        root = np.linalg.cholesky(square[np.ix_(free, free)] + 1e-9 * np.diag(np.where(size > 0.0, size, 1.0)))
        across = scipy.linalg.solve_triangular(root, square[free], lower=True)
        return cls(square, rows, free, root, across, square - across.T @ across)

    def ridged(self, columns: np.ndarray, group: np.ndarray, kinds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return values and prior standard deviations (c,) of a model with these columns: `free`, and some with ridges.

        A ridge is in units of what each column explains, so that one is enough for different units; but parameters of
        one kind are about equally large. What the motion hardly shows (Stribeck's torque of a joint that never slows
        down) has a prior deviation of `max_deviation_ratio` times that of the best shown at most, not one without end.

        Args:
            group, kinds: (c,) of the columns; -1 for those without a ridge.
        """
        ridged, values, deviations = group >= 0, np.zeros(len(columns)), np.full(len(columns), np.inf)
        own, kinds = columns[ridged], kinds[ridged]
        if len(own):
            squares, seen = np.diag(self.square)[own], np.zeros(kinds.max() + 1)
            np.maximum.at(seen, kinds, np.sqrt(squares))
            max_deviation_ratio = 10.0  # largest of a group's prior deviations of one unit (our choice)
            size = np.maximum(np.sqrt(squares), seen[kinds] / max_deviation_ratio)
            scale = np.where(size > 0.0, size, 1.0) / np.sqrt(max(self.rows, 1))
            index, units = np.append(own, len(self.square) - 1), np.append(scale, 1.0)
            left = self.left.take(index, 0).take(index, 1) / (units[:, None] * units)
            exact_residual = 1e-7  # of ‖y‖, what rounding leaves at most of a perfect fit
            total = float(left[-1, -1]) + exact_residual**2 * float(self.square[-1, -1])
            data = Gram(left[:-1, :-1], left[:-1, -1], total, self.rows - len(self.free))
            found = relevance(data, group[ridged], np.ones(len(own)), 12, information=squares / scale**2)
            values[ridged], deviations[ridged] = found.values / scale, found.ridge / scale
        rest = self.across[:, -1] - self.across[:, own] @ values[ridged]
        values[~ridged] = scipy.linalg.solve_triangular(self.root, rest, lower=True, trans=1)
        return values, deviations
