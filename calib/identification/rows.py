"""Rows y = W x of cases, computed in blocks at the full rate; y and W get the same low-pass and decimation.

A `Case` is one recording: its motion, the torques to explain, and what the robot carried.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Protocol, runtime_checkable

import numpy as np

from calib.data.signals.filtering import Decimator, decimate, decimate_blocks, kept, slope
from calib.data.signals.motion import Motion
from calib.dynamics import drives
from calib.dynamics.drives import DriveTerm
from calib.dynamics.regressor_model import RegressorModel
from calib.dynamics.torque_rows import MOTOR, POWER, TorqueRows
from calib.errors import UsageError, refuse_data
from calib.estimation.triangles import Triangles, absorb, empty, retriangulate
from calib.records import frozen


@dataclass(frozen=True, eq=False)
class Case:
    """A recorded motion with its torques.

    Attributes:
        name: unique name of the recording.
        motion: q, v, a at the full rate.
        target: (N, rows) torques to explain, unfiltered [N m or N; A where no gain is known].
        carried: labels of the mounted payloads.
        present: (N, rows) which rows may be used: without lost samples.
        noise: (rows,) standard deviation of the targets' samples, as estimated from repeats of the motion; None: not
            known.
        torque_rows: kind of torques in the target.
        link: q, v, a (N, n) of the links, where joint corrections part them from the motors' motion; None: the same.
    """

    name: str
    motion: Motion
    target: np.ndarray
    carried: tuple[str, ...]
    present: np.ndarray
    noise: np.ndarray | None = None
    torque_rows: TorqueRows = MOTOR
    link: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None

    @property
    def links(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Motion q, v, a (N, n) of the links: the motors' own, where joints do not deflect."""
        return self.link or (self.motion.q, self.motion.v, self.motion.a)

    def deflected(self, part: slice) -> dict[str, Any]:
        """Return the argument ``link`` of a model's regressor at a part of the samples; none where joints are stiff."""
        return {} if self.link is None else {"link": tuple(x[part] for x in self.link)}

    @property
    def duration(self) -> float:
        """Duration of the samples that remain after filtering [s]."""
        return len(self.motion) / self.motion.rate


def make_case(
    name: str, motion: Motion, rows: TorqueRows = MOTOR, *, gains: np.ndarray | None = None, carried: Sequence[str] = ()
) -> Case:
    """Return the case of a motion and its torques.

    Args:
        rows: which torques the model explains; all but the motors' need joint torque sensors (`Motion.tau_link`).
        gains: (n,) torque per unit of the effort; None: 1.
        carried: labels of payloads.
    """
    effort = np.array(motion.effort) if gains is None else motion.effort * gains
    if rows.sensed and motion.tau_link is None:
        refuse_data(
            motion.file,
            f"rows '{rows.name}' need torques of motors, and of sensors behind the gear (columns tau_l1 …, "
            "tau_sensor1 …)",
        )
    target = rows.target(effort, motion.tau_link, motion.q, motion.v)
    known = np.repeat(motion.weight[:, None] > 0.5, motion.n, axis=1)
    noise = None
    if motion.effort_variance is not None and rows.motors_alone:
        noise = frozen(np.sqrt(motion.effort_variance) * (1.0 if gains is None else np.abs(gains)))
    return Case(name, motion, frozen(target), tuple(carried), frozen(rows.of_joints(known), bool), noise, rows)


def case_names(paths: Sequence[str]) -> tuple[str, ...]:
    """Return a unique name per recording: the file's name, with the cut or the folder if needed.

    Raises:
        UsageError: where the same recording and cut is given twice.
    """
    twice = sorted({path for path in paths if list(paths).count(path) > 1})
    if twice:
        raise UsageError(f"{twice[0]} is given twice")
    plain = [_file(path) for path in paths]
    tail = [path.replace("\\", "/").rsplit("/", 1)[-1] for path in paths]
    chosen = [p if plain.count(p) == 1 else t for p, t in zip(plain, tail)]
    return tuple(c if chosen.count(c) == 1 else path for c, path in zip(chosen, paths))


def _file(path: str) -> str:
    from calib.data.recordings.recording import parse_cut

    return parse_cut(path)[0].replace("\\", "/").rstrip("/").rsplit("/", 1)[-1]


BLOCK = 4096  # samples of the full rate at a time


@dataclass(frozen=True, eq=False)
class RestWeights:
    """Weights of standstills, see `calib.identification.standstill`.

    Attributes:
        worth: (rows,) how many rows in motion a value of the friction at rest weighs.
        count: (rows,) how many rows it counts as where residuals are averaged.
        reach: (rows,) change of torque [N m or N] after which the friction has another value.
    """

    worth: np.ndarray
    count: np.ndarray
    reach: np.ndarray


@dataclass(frozen=True, eq=False)
class ObservationRows:
    """Observation matrix and torques of M decimated samples of one case.

    Attributes:
        names, units: names and units of the p columns.
        matrix: (M, rows, p).
        target: (M, rows).
        present: (M, rows) bool, rows for training.
        block: (M,) number of the time block, for cross-validation; -1 next to a cut.
        rate: sampling rate [Hz].
        standing: (M, rows) share of its standstill that each row is; 0 in motion.
        swing: (M, rows) range of the torque in that standstill [N m or N]; 0 in motion.
        slowness: (M, rows) factor of each row in motion: less than 1 where its joint is slow and the model errs more.
        rest: weights of standstills.
        coulomb: (rows, p) columns that are Coulomb friction of a torque row.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    matrix: np.ndarray
    target: np.ndarray
    present: np.ndarray
    block: np.ndarray
    rate: float
    standing: np.ndarray
    swing: np.ndarray
    slowness: np.ndarray
    rest: RestWeights
    coulomb: np.ndarray

    @property
    def weight(self) -> np.ndarray:
        """Factor (M, rows) of rows in estimates: 1 in motion, less where slow or at rest, 0 where not used."""
        at_rest = np.sqrt(self._frictions * self.rest.worth)
        return np.where(self.standing > 0.0, at_rest, self.slowness) * self.present

    @property
    def counted(self) -> np.ndarray:
        """How many rows each one counts as (M, rows), where residuals are averaged."""
        return np.where(self.standing > 0.0, self._frictions * self.rest.count, 1.0) * self.present

    @property
    def _frictions(self) -> np.ndarray:
        """How many values of the friction at rest each row stands for (M, rows)."""
        return self.standing * (1.0 + self.swing / self.rest.reach)

    def by_recording(self, own: int, count: int) -> ObservationRows:
        """Return rows with separate torque rows per recording: those of recording `own` of `count` are filled.

        So that recordings are weighed apart, as joints are where a sample has a row for each.
        """
        place = np.arange(count) == own
        return replace(
            self,
            matrix=np.where(place[:, None], self.matrix, 0.0),
            target=np.where(place, self.target, 0.0),
            present=self.present & place,
            standing=np.repeat(self.standing, count, axis=1),
            swing=np.repeat(self.swing, count, axis=1),
            slowness=np.repeat(self.slowness, count, axis=1),
            rest=_no_rest(count),
            coulomb=np.repeat(self.coulomb, count, axis=0),
        )

    def extend(self, terms: Sequence[DriveTerm], columns: np.ndarray) -> ObservationRows:
        """Return rows with columns (M, rows, k) appended."""
        if not terms:
            return self
        undecided = np.array([one.form.undecided_at_rest for one in terms])
        signs = np.array([one.shape == "sign" for one in terms])
        holding = np.asarray(self.coulomb.any(axis=1))
        coulomb = np.any(columns, axis=0) & signs & holding[:, None]
        at_rest = np.greater(self.standing, 0.0)[:, :, None]
        columns = np.where(at_rest & undecided, 0.0, columns)
        return replace(
            self,
            coulomb=np.hstack([self.coulomb, coulomb]),
            names=(*self.names, *(one.name for one in terms)),
            units=(*self.units, *(one.unit for one in terms)),
            matrix=np.concatenate([self.matrix, columns], axis=2),
        )


def observe(model: RegressorModel, columns: np.ndarray, case: Case, decimator: Decimator) -> ObservationRows:
    """Return the rows of a case in the model's `columns`, filtered and decimated by `decimator`.

    A body's parameters reach the joints before it, a drive's its own: half of all entries, or less, can differ from 0.
    """
    motion = case.motion
    column, row = np.nonzero(model.acting()[columns])
    source = model.torque_rows.repeated(motion.n)  # rows that repeat others are copied, not filtered anew
    own, again = source[row] == row, source[row] != row
    seen = columns[column[own]]
    size = len(kept(motion.segment, decimator))
    matrix = np.zeros((model.rows, len(columns), size)).transpose(2, 0, 1)  # whoever reads it takes a row's columns
    states = segmented_states(model.columns, case)
    step, place = max(1, BLOCK // decimator.factor) * decimator.factor, 0
    for start, stop in segments(motion.segment):
        spans = [slice(i, min(i + step, stop)) for i in range(start, stop, step)]
        if len(decimator.taps) == 1 and model.torque_rows != POWER:
            for part in spans:  # nothing to filter: no need to turn entries into series and back
                matrix[part] = _regressor(model, case, part, states)[:, :, columns]
            continue
        if model.torque_rows == POWER:
            blocks = (power_block(model, seen, case, part, states, slice(start, stop)) for part in spans)
        else:
            entries = (_regressor(model, case, part, states).transpose(2, 1, 0) for part in spans)
            blocks = (each[seen, row[own]] for each in entries)
        for part in decimate_blocks(blocks, decimator):
            matrix[place : place + part.shape[1], row[own], column[own]] = part.T
            place += part.shape[1]
    matrix[:, row[again], column[again]] = matrix[:, source[row[again]], column[again]]
    names, units = (tuple(one[k] for k in columns) for one in (model.names, model.units))
    target, present = decimate(case.target, decimator, motion.segment), thinned(case.present, motion.segment, decimator)
    rate, block = motion.rate / decimator.factor, np.zeros(len(target), dtype=int)
    standing, coulomb = np.zeros(target.shape), np.zeros((model.rows, len(columns)), dtype=bool)
    return ObservationRows(
        names,
        units,
        matrix,
        target,
        present,
        block,
        rate,
        standing,
        np.zeros(target.shape),
        np.ones(target.shape),
        _no_rest(model.rows),
        coulomb,
    )


def _no_rest(rows: int) -> RestWeights:
    """Return the weights of standstills before any estimate: each is a row."""
    return RestWeights(np.ones(rows), np.ones(rows), np.full(rows, np.inf))


def observe_terms(
    terms: Sequence[DriveTerm],
    case: Case,
    decimator: Decimator,
    load: np.ndarray | None = None,
    torque_rows: TorqueRows = MOTOR,
) -> np.ndarray:
    """Return the regressor columns of drive terms (M, rows, k), filtered and decimated.

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
    """Return the states (s, N) of friction with hysteresis, zero at the start of each segment."""
    parts = [drives.friction_states(terms, case.motion.q[a:b].T) for a, b in segments(case.motion.segment)]
    return np.concatenate(parts, axis=1)


def segments(segment: np.ndarray) -> list[tuple[int, int]]:
    """Return (start, stop) of each run of equal numbers in an array."""
    edges = np.concatenate([[0], np.flatnonzero(np.diff(segment)) + 1, [len(segment)]])
    return [(int(a), int(b)) for a, b in pairwise(edges)]


def with_blocks(all_rows: Sequence[ObservationRows], count: int) -> list[ObservationRows]:
    """Return rows with time blocks numbered over all cases: contiguous, about `count`, at least one per case.

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
    """Return the R factors of all rows, one group per time block and torque row: group = block · rows + row.

    The last block holds the samples beside cuts. Rows of standstills have their weights.
    """
    rows = all_rows[0].target.shape[1]
    blocks = 1 + max((int(part.block.max(initial=-1)) for part in all_rows), default=-1)
    result = empty(all_rows[0].names, all_rows[0].units, (blocks + 1) * rows)
    counts = np.zeros(result.groups)
    for part in all_rows:
        block = np.where(part.block < 0, blocks, part.block)
        for row in range(rows):
            used = part.present[:, row]
            group = block[used] * rows + row
            matrix, target = part.matrix[used, row], part.target[used, row]
            if part.standing[:, row].any() or (part.slowness[:, row] < 1.0).any():
                weight = part.weight[used, row]
                matrix, target = matrix * weight[:, None], target * weight
            result = absorb(result, matrix, target, group)
            counts += np.bincount(group, part.counted[used, row], result.groups)
    return replace(result, rows=frozen(np.round(counts), int))


def pool(data: Triangles, rows: int, blocks: Sequence[int] | None = None) -> Triangles:
    """Return R factors with one group per torque row, over all blocks or the given ones."""
    count = data.groups // rows
    wanted = range(count) if blocks is None else blocks
    index = np.array([[block * rows + row for block in wanted] for row in range(rows)], dtype=int)
    size = data.parameters + 1
    factors = np.stack([retriangulate(data.factors[own].reshape(-1, size)) for own in index])
    return replace(data, factors=factors, rows=data.rows[index].sum(axis=1))


def _regressor(model: RegressorModel, case: Case, part: slice, states: np.ndarray) -> np.ndarray:
    """Return the regressor (N_i, rows, p) at a part of the samples."""
    motion = case.motion
    given = motion.q[part], motion.v[part], motion.a[part], None, case.carried, states[:, part]
    return model.regressor(*given, **case.deflected(part))


def power_block(
    model: RegressorModel, columns: np.ndarray, case: Case, part: slice, states: np.ndarray, segment: slice
) -> np.ndarray:
    """Return entries (k, N_i) of the power regressor: d/dt h of energies, vᵀ W of the other columns.

    No acceleration takes part. Differences and the filter of the decimation are linear and do not mind which comes
    first: this is the derivative of the filtered energies (Gautier 1997; Gautier & Briot 2013).
    """
    if not isinstance(model, _HasEnergy):
        raise UsageError("rows = 'power' requires a model with energies")
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


def thinned(mask: np.ndarray, segment: np.ndarray, decimator: Decimator) -> np.ndarray:
    """Return the decimated mask (M, rows): true where more than half of the samples of a mask (N, rows) are true."""
    share = decimate(mask.astype(float), decimator, segment)
    return (share > 0.5) & mask[kept(segment, decimator)] if len(decimator.taps) == 1 else share > 0.5
