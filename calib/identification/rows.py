"""Rows y = W x of recordings, computed in blocks at the full rate; y and W are equally low-passed and decimated.

A `Case` is one recording: its motion, the torques to explain, and the payloads that the robot carried.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Protocol, runtime_checkable

import numpy as np

from calib.data.signals.filtering import Decimator, decimate, decimate_blocks, kept, slope
from calib.data.signals.motion import Motion
from calib.data.signals.repetition import Course
from calib.dynamics import drives
from calib.dynamics.drives import DriveTerm
from calib.dynamics.regressor_model import RegressorModel
from calib.dynamics.torque_rows import MOTOR, POWER, TorqueRows
from calib.errors import UsageError, refuse_data
from calib.estimation.triangles import Triangles, absorb, empty, retriangulate
from calib.records import frozen

BLOCK = 4096
"""Samples of the full rate at a time."""
CUT_MARGIN = 2
"""Decimated samples beside a cut between time blocks that share a filter window with it."""
MIN_REPEATED_BLOCK = 12
"""Decimated samples of a block of a repeated motion, at least: those beside its cuts are lost (our choice)."""
DIFFERENCE_REACH = 4
"""Samples beside a block that differences of its energies reach."""


@dataclass(frozen=True, eq=False)
class Case:
    """A recorded motion with its torques.

    Attributes:
        name: unique name of the recording.
        motion: q, v, a at the full rate.
        target: (N, rows) torques to explain, unfiltered [N m or N; A if the gain is unknown].
        carried: labels of the attached payloads.
        present: (N, rows) mask of rows that may be used; False at lost samples.
        noise: (rows,) standard deviation of the samples in `target`, estimated from repetitions of the motion; None:
            unknown.
        torque_rows: kind of torques in `target`.
        link: motion q, v, a (N, n) of the links, if joint corrections make it differ from the motors' motion; None:
            equal.
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
        """Motion q, v, a (N, n) of the links, equal to the motors' motion if joints do not deflect."""
        return self.link or (self.motion.q, self.motion.v, self.motion.a)

    def deflected(self, part: slice) -> dict[str, object]:
        """Return the keyword argument ``link`` of a model's regressor for a part of the samples.

        The dictionary is empty if joints are rigid.
        """
        if self.link is None:
            return {}
        q, v, a = self.link
        return {"link": (q[part], v[part], a[part])}

    @property
    def duration(self) -> float:
        """Duration of the samples that remain after filtering [s]."""
        return len(self.motion) / self.motion.rate


def make_case(
    name: str, motion: Motion, rows: TorqueRows = MOTOR, *, gains: np.ndarray | None = None, carried: Sequence[str] = ()
) -> Case:
    """Return the case of a recorded motion with its torques.

    Args:
        name: unique name of the recording.
        motion: q, v, a and efforts at the full rate.
        rows: torque rows that the model explains; all but the motors' need joint torque sensors (`Motion.tau_link`).
        gains: (n,) torque per unit of the effort; None: 1.
        carried: labels of the attached payloads.

    Raises:
        MeasurementError: if the rows need sensor torques and there are none.
    """
    effort = np.array(motion.effort)
    if gains is not None:
        effort = motion.effort * gains
    if rows.sensed and motion.tau_link is None:
        refuse_data(
            motion.file,
            f"rows '{rows.name}' need torques of motors, and of sensors behind the gear (columns tau_l1 …, "
            "tau_sensor1 …)",
        )
    noise = None
    if motion.effort_variance is not None and rows.motors_alone:
        factor = 1.0 if gains is None else np.abs(gains)
        noise = frozen(np.sqrt(motion.effort_variance) * factor)
    in_use = motion.weight[:, None] > 0.5
    valid = np.repeat(in_use, motion.n, axis=1)
    target = frozen(rows.target(effort, motion.tau_link, motion.q, motion.v))
    present = frozen(rows.of_joints(valid), bool)
    return Case(
        name=name, motion=motion, target=target, carried=tuple(carried), present=present, noise=noise, torque_rows=rows
    )


def case_names(paths: Sequence[str]) -> tuple[str, ...]:
    """Return a unique name for each recording: the file's name, with the cut or the folder if needed.

    Args:
        paths: recordings, each with a cut such as ``@0:9.4`` or without.

    Raises:
        UsageError: if the same recording and cut occurs twice.
    """
    repeated = sorted({path for path in paths if list(paths).count(path) > 1})
    if repeated:
        raise UsageError(f"recording {repeated[0]} is listed twice, to fit or to validate: name each once")
    file_names = [_file(path) for path in paths]
    candidates = []
    for path, file_name in zip(paths, file_names):
        if file_names.count(file_name) == 1:
            candidates.append(file_name)
        else:
            with_cut = path.replace("\\", "/").rsplit("/", 1)[-1]
            candidates.append(with_cut)
    return tuple(name if candidates.count(name) == 1 else path for name, path in zip(candidates, paths))


def _file(path: str) -> str:
    """Return the name of a recording's file, without its folder and cut.

    Args:
        path: the recording, with or without a cut.
    """
    from calib.data.recordings.recording import parse_cut

    file, *_ = parse_cut(path)
    return file.replace("\\", "/").rstrip("/").rsplit("/", 1)[-1]


@dataclass(frozen=True, eq=False)
class RestWeights:
    """Weights of standstills, derived in `calib.identification.standstill`.

    Attributes:
        worth: (rows,) weight of one value of the friction at rest, relative to a row in motion.
        count: (rows,) number of rows that such a value counts as when residuals are averaged.
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
        matrix: (M, rows, p) observation matrix W.
        target: (M, rows) torques y [N m or N].
        present: (M, rows) mask of rows used for training.
        block: (M,) number of the time block, for cross-validation; -1 near a cut between blocks.
        rate: sampling rate [Hz].
        standing: (M, rows) share of each row in its standstill, i.e. 1 / number of rows of the standstill; 0 in motion.
        swing: (M, rows) range of the torque in the row's standstill [N m or N]; 0 in motion.
        breakaway: (M, rows) factor of each row in motion: less than 1 while friction of the last standstill still
            decays.
        rest: weights of standstills.
        coulomb: (rows, p) mask of columns that are Coulomb friction of a torque row.
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
    breakaway: np.ndarray
    rest: RestWeights
    coulomb: np.ndarray

    @property
    def weight(self) -> np.ndarray:
        """Factor (M, rows) by which rows are multiplied in estimates: 1 in motion, less at rest, 0 if not used."""
        at_rest = np.sqrt(self._frictions * self.rest.worth)
        return np.where(self.standing > 0.0, at_rest, self.breakaway) * self.present

    @property
    def counted(self) -> np.ndarray:
        """Number of rows that each row counts as when residuals are averaged (M, rows)."""
        counted = self._frictions * self.rest.count
        return np.where(self.standing > 0.0, counted, 1.0) * self.present

    @property
    def _frictions(self) -> np.ndarray:
        """Number of values of the friction at rest that each row represents (M, rows); 0 in motion."""
        return self.standing * (1.0 + self.swing / self.rest.reach)

    def by_recording(self, recording: int, count: int) -> ObservationRows:
        """Return the rows with separate torque rows for each of `count` recordings, which are then weighted separately.

        Only the torque rows of this `recording` (index) are filled; the others are zero.
        """
        filled = np.arange(count) == recording
        matrix = np.where(filled[:, None], self.matrix, 0.0)
        target = np.where(filled, self.target, 0.0)
        present = self.present & filled
        standing = np.repeat(self.standing, count, axis=1)
        swing = np.repeat(self.swing, count, axis=1)
        breakaway = np.repeat(self.breakaway, count, axis=1)
        coulomb = np.repeat(self.coulomb, count, axis=0)
        return replace(
            self,
            matrix=matrix,
            target=target,
            present=present,
            standing=standing,
            swing=swing,
            breakaway=breakaway,
            rest=_no_rest(count),
            coulomb=coulomb,
        )

    def extend(self, terms: Sequence[DriveTerm], columns: np.ndarray) -> ObservationRows:
        """Return the rows with the columns (M, rows, k) of drive terms appended.

        Columns whose value at rest is unknown are set to zero in standstills.

        Args:
            terms: k drive terms.
            columns: their columns, from `observe_terms`.
        """
        if not terms:
            return self
        undecided_at_rest = np.array([term.form.undecided_at_rest for term in terms])
        is_sign = np.array([term.shape == "sign" for term in terms])
        has_coulomb = np.asarray(self.coulomb.any(axis=1))
        coulomb = np.any(columns, axis=0) & is_sign & has_coulomb[:, None]
        at_rest = np.greater(self.standing, 0.0)[:, :, None]
        columns = np.where(at_rest & undecided_at_rest, 0.0, columns)
        names = [term.name for term in terms]
        units = [term.unit for term in terms]
        matrix = np.concatenate([self.matrix, columns], axis=2)
        all_coulomb = np.hstack([self.coulomb, coulomb])
        return replace(
            self, coulomb=all_coulomb, names=(*self.names, *names), units=(*self.units, *units), matrix=matrix
        )


def observe(model: RegressorModel, columns: np.ndarray, case: Case, decimator: Decimator) -> ObservationRows:
    """Return the rows of a case, filtered and decimated.

    Only regressor entries that can differ from 0 are computed.

    Args:
        model: the model.
        columns: indices of the model's columns in the rows.
        case: the recording.
        decimator: filter and decimation.
    """
    motion = case.motion
    segment = motion.segment
    # Entries that can differ from zero; rows that repeat others are copied, not filtered anew.
    entry_column, entry_row = np.nonzero(model.acting()[columns])
    source = model.torque_rows.repeated(motion.n)
    is_source = source[entry_row] == entry_row
    filtered_row, filtered_column = entry_row[is_source], entry_column[is_source]
    copied_row = entry_row[~is_source]
    copied_column = entry_column[~is_source]
    model_column = columns[filtered_column]

    # Transposed, because readers take the columns of one row.
    sample_count = len(kept(segment, decimator))
    storage = np.zeros((model.rows, len(columns), sample_count))
    matrix = storage.transpose(2, 0, 1)
    states = segmented_states(model.columns, case)
    step = max(1, BLOCK // decimator.factor) * decimator.factor
    first = 0
    for start, stop in segments(segment):
        parts = [slice(i, min(i + step, stop)) for i in range(start, stop, step)]
        if len(decimator.taps) == 1 and model.torque_rows != POWER:
            # Nothing to filter: entries need not be turned into series and back.
            for part in parts:
                matrix[part] = _regressor(model, case, part, states, columns)[:, :, columns]
            continue
        if model.torque_rows == POWER:
            segment_slice = slice(start, stop)
            blocks = (power_block(model, model_column, case, part, states, segment_slice) for part in parts)
        else:
            blocks = _entry_blocks(model, case, parts, states, model_column, filtered_row)
        for block in decimate_blocks(blocks, decimator):
            samples = slice(first, first + block.shape[1])
            matrix[samples, filtered_row, filtered_column] = block.T
            first += block.shape[1]
    matrix[:, copied_row, copied_column] = matrix[:, source[copied_row], copied_column]

    target = decimate(case.target, decimator, segment)
    names = tuple(model.names[column] for column in columns)
    units = tuple(model.units[column] for column in columns)
    present = thinned(case.present, segment, decimator)
    rate = motion.rate / decimator.factor
    standing = np.zeros(target.shape)
    swing = np.zeros(target.shape)
    breakaway = np.ones(target.shape)
    coulomb = np.zeros((model.rows, len(columns)), dtype=bool)
    block = np.zeros(len(target), dtype=int)
    return ObservationRows(
        names=names,
        units=units,
        matrix=matrix,
        target=target,
        present=present,
        block=block,
        rate=rate,
        standing=standing,
        swing=swing,
        breakaway=breakaway,
        rest=_no_rest(model.rows),
        coulomb=coulomb,
    )


def _entry_blocks(
    model: RegressorModel, case: Case, parts: Sequence[slice], states: np.ndarray, columns: np.ndarray, rows: np.ndarray
) -> Iterator[np.ndarray]:
    """Yield entries (k, N_i) of the regressor for each part of the samples.

    Args:
        model: the model.
        case: the recording.
        parts: slices of samples.
        states: (s, N) states of friction with hysteresis.
        columns, rows: (k,) column and row of each entry.
    """
    for part in parts:
        regressor = _regressor(model, case, part, states, columns)
        yield regressor.transpose(2, 1, 0)[columns, rows]


def _no_rest(rows: int) -> RestWeights:
    """Return the weights of standstills before any estimate: each standstill counts as one row."""
    worth = np.ones(rows)
    count = np.ones(rows)
    reach = np.full(rows, np.inf)
    return RestWeights(worth, count, reach)


def observe_terms(
    terms: Sequence[DriveTerm],
    case: Case,
    decimator: Decimator,
    load: np.ndarray | None = None,
    torque_rows: TorqueRows = MOTOR,
) -> np.ndarray:
    """Return the regressor columns of drive terms (M, rows, k), filtered and decimated.

    Columns are computed one at a time at the full rate: an hour of all friction terms would need 15 GB.

    Args:
        terms: k drive terms.
        case: the recording.
        decimator: filter and decimation.
        load: (N, n) torques that the gears transmit [N m or N]; None if no term depends on them.
        torque_rows: kind of torques in the rows.
    """
    segment = case.motion.segment
    n = case.motion.n
    sample_count = len(kept(segment, decimator))
    columns = np.zeros((sample_count, torque_rows.count(n), len(terms)))
    for k, term in enumerate(terms):
        for joint, values in term_columns(term, case, load):
            rows = torque_rows.of_side(term.side, joint, n)
            columns[:, rows, k] += decimate(values, decimator, segment)[:, None]
    return columns


def term_columns(term: DriveTerm, case: Case, load: np.ndarray | None = None) -> Iterator[tuple[int, np.ndarray]]:
    """Yield each torque row that a drive term acts on, with the term's column (N,) at the full rate.

    Args:
        term: the drive term.
        case: the recording.
        load: (N, n) torques that the gears transmit [N m or N]; None if the term does not depend on them.
    """
    motion = case.motion
    load_of_joints = None if load is None else load.T
    motions = [motion.q.T, motion.v.T, motion.a.T, load_of_joints]
    return term.acting(motions, segmented_states([term], case))


def segmented_states(terms: Sequence[DriveTerm], case: Case) -> np.ndarray:
    """Return the states (s, N) of friction with hysteresis along a case; they are zero at the start of each segment.

    Args:
        terms: drive terms; s is 0 if none of them has hysteresis.
        case: the recording.
    """
    motion = case.motion
    states = []
    for start, stop in segments(motion.segment):
        states.append(drives.friction_states(terms, motion.q[start:stop].T))
    return np.concatenate(states, axis=1)


def segments(segment: np.ndarray) -> list[tuple[int, int]]:
    """Return (start, stop) of each run of equal numbers in an array (N,).

    Args:
        segment: (N,) segment number of each sample.
    """
    changes = np.flatnonzero(np.diff(segment)) + 1
    edges = np.concatenate([[0], changes, [len(segment)]])
    return list(pairwise(edges.tolist()))


def with_blocks(
    all_rows: Sequence[ObservationRows], count: int, repetition: Course | None = None
) -> list[ObservationRows]:
    """Return the rows with blocks numbered over all cases, as folds of a cross-validation.

    Blocks are contiguous in time, about `count` in all, with at least one per case. Where a motion is repeated, they
    are contiguous parts of the motion, each with all its repetitions: a block of a later period would test nothing.
    There are then fewer of them if the motion is short; one that is too short for two blocks is divided in time.
    Samples within `CUT_MARGIN` of a cut between blocks get -1, since the filter's window extends across the cut.

    Args:
        all_rows: rows of all cases.
        count: approximate number of blocks.
        repetition: the course of the rows' samples; None: blocks are contiguous in time.
    """
    course = Course.without_repetition([len(rows.target) for rows in all_rows])
    if repetition is not None:
        fresh_rows = sum(int(fresh.sum()) for fresh in repetition.fresh)
        possible = fresh_rows // MIN_REPEATED_BLOCK
        if repetition.repeats and possible >= 2:
            course, count = repetition, min(count, possible)
    numbered = []
    for rows, block in zip(all_rows, course.blocks(count)):
        beside_cut = np.zeros(len(block), dtype=bool)
        for cut in (np.flatnonzero(np.diff(block)) + 1).tolist():
            beside_cut[max(0, cut - CUT_MARGIN) : cut + CUT_MARGIN + 1] = True
        numbered.append(replace(rows, block=np.where(beside_cut, -1, block)))
    return numbered


def triangulate(all_rows: Sequence[ObservationRows]) -> Triangles:
    """Return the R factors of all rows, one group per time block and torque row: group = block · rows + row.

    The last block contains the samples near cuts. Standstills have their weights.
    """
    row_count = all_rows[0].target.shape[1]
    last_blocks = [int(rows.block.max(initial=-1)) for rows in all_rows]
    block_count = 1 + max(last_blocks, default=-1)
    groups = (block_count + 1) * row_count
    result = empty(all_rows[0].names, all_rows[0].units, groups)
    counts = np.zeros(result.groups)
    for rows in all_rows:
        block = np.where(rows.block < 0, block_count, rows.block)
        for row in range(row_count):
            present = rows.present[:, row]
            group = block[present] * row_count + row
            matrix = rows.matrix[present, row]
            target = rows.target[present, row]
            if rows.standing[:, row].any() or (rows.breakaway[:, row] < 1.0).any():
                weight = rows.weight[present, row]
                matrix = matrix * weight[:, None]
                target = target * weight
            result = absorb(result, matrix, target, group)
            counts += np.bincount(group, rows.counted[present, row], result.groups)
    return replace(result, rows=frozen(np.round(counts), int))


def pool(data: Triangles, rows: int, blocks: Sequence[int] | None = None) -> Triangles:
    """Return R factors with one group per torque row, over all time blocks or the given ones.

    Args:
        data: R factors by time block and torque row.
        rows: number of torque rows.
        blocks: numbers of the time blocks; None: all.
    """
    if blocks is None:
        blocks = range(data.groups // rows)
    # Groups of each row (rows, blocks).
    first_rows = rows * np.array(blocks, dtype=int)
    index = np.add.outer(np.arange(rows), first_rows)
    size = data.parameters + 1
    factors = [retriangulate(data.factors[groups].reshape(-1, size)) for groups in index]
    counts = data.rows[index].sum(axis=1)
    return replace(data, factors=np.stack(factors), rows=counts)


def _regressor(model: RegressorModel, case: Case, part: slice, states: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Return the regressor (N_i, rows, p) for a part of the samples.

    Args:
        model: the model.
        case: the recording.
        part: slice of its samples.
        states: (s, N) states of friction with hysteresis of all samples.
        columns: indices of the columns that are read; others may be zero.
    """
    motion = case.motion
    q = motion.q[part]
    v = motion.v[part]
    a = motion.a[part]
    if isinstance(model, _HasDriveRegressor) and np.all(columns >= model.inertial):
        return model.drive_regressor(q, v, a)
    deflected = case.deflected(part)
    return model.regressor(q, v, a, None, case.carried, states[:, part], **deflected)


def power_block(
    model: RegressorModel, columns: np.ndarray, case: Case, part: slice, states: np.ndarray, segment: slice
) -> np.ndarray:
    """Return entries (k, N_i) of the power regressor: d/dt h for columns with energy h, vᵀ W for other columns.

    No accelerations are used. Differences and the decimation filter are linear and commute, so that the result is the
    derivative of the filtered energies (Gautier 1997; Gautier & Briot 2013).

    Args:
        model: a model with energies.
        columns: (k,) indices of the columns.
        case: the recording.
        part: slice of samples to compute.
        states: (s, N) states of friction with hysteresis.
        segment: slice of samples of the gap-free segment around `part`.

    Raises:
        UsageError: for a model without energies.
    """
    if not isinstance(model, _HasEnergy):
        raise UsageError("rows = 'power' is not supported by this model, which has no energies: use rows = 'motor'")
    motion = case.motion
    span = power_span(part, segment)
    all_energies = model.energy_columns(motion.q[span], motion.v[span], case.carried)
    q = motion.q[part]
    v = motion.v[part]
    no_acceleration = np.zeros_like(v)
    regressor = model.regressor(q, v, no_acceleration, None, case.carried, states[:, part])
    before = part.start - span.start
    return power_entries(model, columns, all_energies, regressor, before, motion.rate)


def power_span(part: slice, segment: slice) -> slice:
    """Return the samples that the differences of a part reach, within its gap-free segment."""
    start = max(segment.start, part.start - DIFFERENCE_REACH)
    stop = min(segment.stop, part.stop + DIFFERENCE_REACH)
    return slice(start, stop)


def power_entries(
    model: RegressorModel, columns: np.ndarray, energies: np.ndarray, regressor: np.ndarray, before: int, rate: float
) -> np.ndarray:
    """Return entries (k, N) of the power regressor of a part, as `power_block`.

    Args:
        model: the model.
        columns: (k,) indices of the columns.
        energies: (M, p) energies h at the samples of `power_span`.
        regressor: (N, 1, p) power vᵀ W at the samples of the part.
        before: samples of the span before the part.
        rate: sampling rate [Hz].
    """
    chosen = energies[:, columns]
    power = slope(chosen, rate)
    plain_power = np.zeros_like(chosen)
    if len(chosen) > 1:
        plain_power = np.gradient(chosen, 1.0 / rate, axis=0)
    power = np.where(np.isfinite(power), power, plain_power)
    power = power[before:][: len(regressor)].T
    losses = regressor.transpose(2, 1, 0)[columns, 0]
    stores_energy = []
    for column in columns:
        drive = column - model.inertial
        stores_energy.append(drive < 0 or model.columns[drive].shape == "acceleration")
    return np.where(np.array(stores_energy)[:, None], power, losses)


@runtime_checkable
class _HasEnergy(Protocol):
    def energy_columns(self, q: np.ndarray, v: np.ndarray, carried: Collection[str] | None = None) -> np.ndarray: ...


@runtime_checkable
class _HasDriveRegressor(Protocol):
    def drive_regressor(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray: ...


def thinned(mask: np.ndarray, segment: np.ndarray, decimator: Decimator) -> np.ndarray:
    """Return the decimated mask (M, rows), true where more than half of the samples of a mask (N, rows) are true.

    Args:
        mask: (N, rows) mask at the full rate.
        segment: (N,) number of each sample's segment.
        decimator: filter and decimation.
    """
    majority = decimate(mask.astype(float), decimator, segment) > 0.5
    if len(decimator.taps) == 1:
        return majority & mask[kept(segment, decimator)]
    return majority
