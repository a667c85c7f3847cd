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

from calib.data.signals.filtering import Decimator, kept
from calib.estimation.relevance import Gram, relevance
from calib.estimation.triangles import Triangles
from calib.identification.rows import Case, ObservationRows

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
    """Return the products of cases by range of motion: fast, accelerated, at each end of travel, each direction.

    Standstills belong to none: no model is judged by friction that nothing decides.
    """
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
    stacked = [
        np.concatenate([part.matrix, part.target[:, :, None]], axis=2) * part.weight[:, :, None] for part in all_rows
    ]
    squares, counts = np.zeros((len(inside), rows, p + 1, p + 1)), np.zeros((len(inside), rows))
    whole, total = np.zeros((rows, p + 1, p + 1)), np.zeros(rows)
    start = 0
    for part, both in zip(all_rows, stacked):
        own = slice(start, start + len(both))
        start += len(both)
        for row in range(rows):
            used = part.present[:, row]
            whole[row] += both[used, row].T @ both[used, row]
            counted, moves = part.counted[:, row], part.standing[:, row] == 0.0
            total[row] += counted.sum()
            for k in range(len(inside)):
                chosen = used & moves & inside[k, own, row]
                held = both[chosen, row]
                squares[k, row] += held.T @ held
                counts[k, row] += counted[chosen].sum()
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
            each = [own for run, own in zip(runs, self._regularised(columns, runs)) for _ in run]
            self._known[key] = self._errors(columns, each)
        return self._known[key].copy()

    def extrapolated(self, columns: np.ndarray) -> np.ndarray:
        """Return the squared errors (ranges, rows) in each held-out range of motion of a model with these columns."""
        assert self.regimes is not None
        if (key := b"ranges" + np.asarray(columns, dtype=int).tobytes()) in self._known:
            return self._known[key]
        index, weight = np.append(columns, self.data.parameters), 1.0 / (self.std**2 * self.inflation)
        known = 0.0 if self.prior is None else self.prior[:, index].T @ self.prior[:, index]
        rounding = 1e-9 * (weight @ self.regimes.whole.diagonal(axis1=1, axis2=2))[index]
        result = np.zeros((len(self.regimes.squares), self.rows))
        for k, (held, counts) in enumerate(zip(self.regimes.squares, self.regimes.counts)):
            rest = np.tensordot(weight, self.regimes.whole - held, 1).take(index, 0).take(index, 1)
            rest.flat[:: len(index) + 1] += rounding  # differences are positive definite but for that
            rest += known
            rows = int(np.sum((self.regimes.total - counts) / self.inflation))
            values = np.append(_regularised(rest, rows, self.group[columns], self._kinds[columns])[0], -1.0)
            result[k] = np.einsum("i,rij,j->r", values, held.take(index, 1).take(index, 2), values)
        return self._known.setdefault(key, np.maximum(result, 0.0))

    def _errors(self, columns: np.ndarray, values: list[np.ndarray]) -> np.ndarray:
        """Return the squared errors of parameter values (k,) per block."""
        result = np.zeros((self.blocks, self.rows))
        for block, own in enumerate(values):
            x = np.zeros(self.data.parameters)
            x[columns] = own
            factors = self.data.factors[block * self.rows : (block + 1) * self.rows]
            result[block] = np.sum((factors @ np.append(x, -1.0)) ** 2, axis=1)
        return result

    def _regularised(self, columns: np.ndarray, runs: list[np.ndarray]) -> list[np.ndarray]:
        """Return for each run of blocks the ridge estimate from all other blocks."""
        index, blocks = np.append(columns, self.data.parameters), np.arange(self.blocks)
        squares = self._squares.take(index, 1).take(index, 2)
        known = 0.0 if self.prior is None else self.prior[:, index].T @ self.prior[:, index]
        samples = self.data.rows.reshape(-1, self.rows)[: self.blocks]
        found = []
        for run in runs:
            others = ~np.isin(blocks, run)
            whole = squares[others].sum(axis=0) + known
            rows = int(np.sum(samples[others].sum(axis=0) / self.inflation))
            found.append(_regularised(whole, rows, self.group[columns], self._kinds[columns])[0])
        return found

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
    return _regularised(stacked.T @ stacked, int(np.sum(data.rows / inflation)), group, _kinds(group, data.units))


def _kinds(group: np.ndarray, units: Sequence[str]) -> np.ndarray:
    """Return a number (p,) for columns with the same group and unit; -1 for columns without a group."""
    found, unit = np.unique(units, return_inverse=True)
    return np.where(group < 0, -1, group * len(found) + unit)


def _regularised(square: np.ndarray, rows: int, group: np.ndarray, kinds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return values and prior standard deviations (p,) from [W y]ᵀ[W y] (p + 1, p + 1) and its number of rows.

    A group's ridge is in units of what each column explains, so that one is enough for different units; but parameters
    of one kind are about equally large. What the motion hardly shows (Stribeck's torque of a joint that never slows
    down) has a prior deviation of `max_deviation_ratio` times that of the best shown at most, not one without end.
    """
    size = np.sqrt(np.diag(square)[:-1])
    seen = np.zeros(kinds.max(initial=-1) + 2)  # the last for -1
    np.maximum.at(seen, kinds, size)
    max_deviation_ratio = 10.0  # largest ratio of the prior deviations of a group's parameters of one unit (our choice)
    size = np.where(group < 0, size, np.maximum(size, seen[kinds] / max_deviation_ratio))
    scale = np.where(size > 0.0, size, 1.0) / np.sqrt(max(rows, 1))
    scaled = square[:-1, :-1] / (scale[:, None] * scale)
    scaled[np.diag_indices(len(group))] += np.where(group < 0, 1e-9 * rows, 0.0)  # free, without data: stays at zero
    data = Gram(scaled, square[:-1, -1] / scale, float(square[-1, -1]), rows)
    iterations = 12
    found = relevance(data, group, np.ones(len(group)), iterations)
    return found.values / scale, np.where(np.isfinite(found.ridge), found.ridge / scale, np.inf)
