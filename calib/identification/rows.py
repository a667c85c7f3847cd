"""Cases as rows of y = W x: built a block at a time at the full rate, low-passed and thinned alike on both sides."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Protocol, runtime_checkable

import numpy as np

from calib.data.signals.filtering import Decimator, decimate, decimate_blocks, kept, slope
from calib.dynamics import drives
from calib.dynamics.drives import DriveTerm
from calib.dynamics.regressor_model import RegressorModel
from calib.dynamics.torque_rows import MOTOR, POWER, TorqueRows
from calib.errors import UsageError
from calib.estimation.triangles import Triangles, absorb, empty, retriangulate
from calib.identification.cases import Case

BLOCK = 4096  # samples of the full rate at a time


@dataclass(frozen=True, eq=False)
class ObservationRows:
    """M thinned samples of one case.

    Attributes:
        names, units: of the p columns.
        matrix: (M, rows, p).
        target: (M, rows).
        present: (M, rows) bool, rows to learn from.
        block: (M,) number of the time block, for cross-validation; -1 beside a cut.
        rate: [Hz].
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    matrix: np.ndarray
    target: np.ndarray
    present: np.ndarray
    block: np.ndarray
    rate: float

    def by_recording(self, own: int, count: int) -> ObservationRows:
        """Return rows with a place per recording in place of their one row: recording `own` of `count` fills its own.

        So that recordings are weighed apart, as joints are where a sample has a row for each.
        """
        place = np.arange(count) == own
        return replace(
            self, matrix=np.where(place[:, None], self.matrix, 0.0), target=np.where(place, self.target, 0.0),
            present=self.present & place,
        )  # fmt: skip

    def extend(self, terms: Sequence[DriveTerm], columns: np.ndarray) -> ObservationRows:
        """Return rows with more columns (M, rows, k) behind their own."""
        if not terms:
            return self
        return replace(
            self,
            names=(*self.names, *(one.name for one in terms)),
            units=(*self.units, *(one.unit for one in terms)),
            matrix=np.concatenate([self.matrix, columns], axis=2),
        )


def observe(
    model: RegressorModel, columns: np.ndarray, case: Case, decimator: Decimator, load: np.ndarray | None = None
) -> ObservationRows:
    """Return the rows of a case in the model's `columns`, filtered and thinned by `decimator`.

    Args:
        load: (N, n) transmitted torques at the full rate, where a term needs them.
    """
    motion = case.motion
    column, row = _live(model, columns)
    source = model.torque_rows.repeated(motion.n)  # rows that repeat others are copied, not filtered anew
    own, again = source[row] == row, source[row] != row
    size = len(kept(motion.segment, decimator))
    matrix = np.zeros((model.rows, len(columns), size)).transpose(2, 0, 1)  # whoever reads it takes a row's columns
    states = segmented_states(model.columns, case)
    step, place = max(1, BLOCK // decimator.factor) * decimator.factor, 0
    for start, stop in segments(motion.segment):
        spans = [slice(i, min(i + step, stop)) for i in range(start, stop, step)]
        if len(decimator.taps) == 1 and model.torque_rows is not POWER:
            for part in spans:  # nothing to filter: no need to turn entries into series and back
                matrix[part] = _regressor(model, case, part, load, states)[:, :, columns]
            continue
        if model.torque_rows is POWER:
            blocks = (
                _power_block(model, columns[column[own]], case, part, states, slice(start, stop)) for part in spans
            )
        else:
            blocks = (_block(model, columns[column[own]], row[own], case, part, load, states) for part in spans)
        for part in decimate_blocks(blocks, decimator):
            matrix[place : place + part.shape[1], row[own], column[own]] = part.T
            place += part.shape[1]
    matrix[:, row[again], column[again]] = matrix[:, source[row[again]], column[again]]
    names, units = model.names, model.units
    return _rows([names[k] for k in columns], [units[k] for k in columns], matrix, case, decimator)


def observe_terms(
    terms: Sequence[DriveTerm], case: Case, decimator: Decimator, load: np.ndarray | None = None,
    torque_rows: TorqueRows = MOTOR,
) -> np.ndarray:  # fmt: skip
    """Return the columns of drive terms alone, (M, rows, k), filtered and thinned; rows without a projection.

    One column at a time at the full rate: an hour of all friction there is would fill 15 GB.
    """
    segment, n = case.motion.segment, case.motion.n
    out = np.zeros((len(kept(segment, decimator)), torque_rows.count(n), len(terms)))
    for k, one in enumerate(terms):
        for row, values in term_columns(one, case, load):
            out[:, torque_rows.of_side(one.side, row, n), k] += decimate(values, decimator, segment)[:, None]
    return out


def term_columns(one: DriveTerm, case: Case, load: np.ndarray | None = None) -> Iterator[tuple[int, np.ndarray]]:
    """Yield the torque rows that a drive term acts on, each with its column (N,) at the full rate."""
    motion = case.motion
    motions = [motion.q.T, motion.v.T, motion.a.T, None if load is None else load.T]
    return one.acting(motions, segmented_states([one], case))


def segmented_states(terms: Sequence[DriveTerm], case: Case) -> np.ndarray:
    """Return the states (s, N) of friction with memory; each segment starts unstressed."""
    parts = [drives.friction_states(terms, case.motion.q[a:b].T) for a, b in segments(case.motion.segment)]
    return np.concatenate(parts, axis=1)


def segments(segment: np.ndarray) -> list[tuple[int, int]]:
    """Return (start, stop) of each run of equal numbers."""
    edges = np.concatenate([[0], np.flatnonzero(np.diff(segment)) + 1, [len(segment)]])
    return [(int(a), int(b)) for a, b in pairwise(edges)]


def with_blocks(all_rows: Sequence[ObservationRows], count: int) -> list[ObservationRows]:
    """Number the time blocks of all cases: contiguous, about `count` in all, at least one per case.

    Samples within `margin` of a cut get -1: the filter's window reaches over it.
    """
    total = sum(len(rows.target) for rows in all_rows)
    result, first = [], 0
    margin = 2  # thinned samples beside a cut between blocks that share a filter window: not judged
    for rows in all_rows:
        size = len(rows.target)
        own = 1 if len(all_rows) >= count else max(1, round(count * size / max(total, 1)))
        number = first + (np.arange(size) * own) // max(size, 1)
        cut = np.flatnonzero(np.diff(number)) + 1
        near = np.abs(np.arange(size)[:, None] - cut[None, :]).min(axis=1, initial=size) <= margin
        result.append(replace(rows, block=np.where(near, -1, number)))
        first += own
    return result


def triangulate(all_rows: Sequence[ObservationRows]) -> Triangles:
    """Return the triangles of all rows, one group per (block, row): group = block · rows + row.

    The last block holds the samples beside cuts.
    """
    rows = all_rows[0].target.shape[1]
    blocks = 1 + max((int(part.block.max(initial=-1)) for part in all_rows), default=-1)
    result = empty(all_rows[0].names, all_rows[0].units, (blocks + 1) * rows)
    for part in all_rows:
        block = np.where(part.block < 0, blocks, part.block)
        for row in range(rows):
            used = part.present[:, row]
            result = absorb(result, part.matrix[used, row], part.target[used, row], block[used] * rows + row)
    return result


def pool(data: Triangles, rows: int, blocks: Sequence[int] | None = None) -> Triangles:
    """Return triangles with one group per row, of all blocks or of those named."""
    count = data.groups // rows
    wanted = range(count) if blocks is None else blocks
    index = np.array([[block * rows + row for block in wanted] for row in range(rows)], dtype=int)
    size = data.parameters + 1
    factors = np.stack([retriangulate(data.factors[own].reshape(-1, size)) for own in index])
    return replace(data, factors=factors, rows=data.rows[index].sum(axis=1))


def _live(model: RegressorModel, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (k,) column, of those chosen, and (k,) torque row of all entries of the regressor that can differ from 0.

    A body's parameters reach the joints before it, a drive's its own: half of all entries, or less.
    """
    column, row = np.nonzero(model.acting()[columns])
    return column, row


def _block(
    model: RegressorModel,
    columns: np.ndarray,
    rows: np.ndarray,
    case: Case,
    part: slice,
    load: np.ndarray | None,
    states: np.ndarray,
) -> np.ndarray:
    """Return the entries (k, N_i) of the regressor in these columns and rows, each (k,), of a part of the samples."""
    return _regressor(model, case, part, load, states).transpose(2, 1, 0)[columns, rows]


def _regressor(
    model: RegressorModel, case: Case, part: slice, load: np.ndarray | None, states: np.ndarray
) -> np.ndarray:  # fmt: skip
    """Return the regressor (N_i, rows, p) of a part of the samples."""
    motion, own = case.motion, None if load is None else load[part]
    return model.regressor(motion.q[part], motion.v[part], motion.a[part], own, case.carried, states[:, part])


def _power_block(
    model: RegressorModel, columns: np.ndarray, case: Case, part: slice, states: np.ndarray, segment: slice
) -> np.ndarray:
    """Return entries (k, N_i) of the power's regressor, d/dt h of energies and vᵀ W of the other columns.

    No acceleration takes part. Differences and the filter of the decimation are linear and do not mind which comes
    first: this is the derivative of the filtered energies (Gautier 1997; Gautier & Briot 2013).
    """
    if not isinstance(model, _HasEnergy):
        raise UsageError("rows = 'power' need a model that knows its energies")
    motion = case.motion
    edge = 4  # samples beside a block that differences of its energies reach
    near = slice(max(segment.start, part.start - edge), min(segment.stop, part.stop + edge))
    h = model.energy_columns(motion.q[near], motion.v[near], case.carried)[:, columns]
    rising = slope(h, motion.rate)
    plain = np.gradient(h, 1.0 / motion.rate, axis=0) if len(h) > 1 else np.zeros_like(h)
    rising = np.where(np.isfinite(rising), rising, plain)[part.start - near.start :][: part.stop - part.start].T
    q, v = motion.q[part], motion.v[part]
    losses = model.regressor(q, v, np.zeros_like(v), None, case.carried, states[:, part]).transpose(2, 1, 0)[columns, 0]
    stored = [k < model.inertial or model.columns[k - model.inertial].shape == "acceleration" for k in columns]
    return np.where(np.array(stored)[:, None], rising, losses)


@runtime_checkable
class _HasEnergy(Protocol):
    def energy_columns(self, q: np.ndarray, v: np.ndarray, carried: Collection[str] | None = None) -> np.ndarray: ...


def _rows(
    names: Sequence[str], units: Sequence[str], matrix: np.ndarray, case: Case, decimator: Decimator
) -> ObservationRows:
    segment = case.motion.segment
    target = decimate(case.target, decimator, segment)
    present = thinned(case.present, segment, decimator)
    rate = case.motion.rate / decimator.factor
    return ObservationRows(tuple(names), tuple(units), matrix, target, present, np.zeros(len(target), dtype=int), rate)


def thinned(mask: np.ndarray, segment: np.ndarray, decimator: Decimator) -> np.ndarray:
    """Return which thinned rows (M, rows) stand for samples of a mask (N, rows) by more than half."""
    share = decimate(mask.astype(float), decimator, segment)
    return (share > 0.5) & mask[kept(segment, decimator)] if len(decimator.taps) == 1 else share > 0.5
