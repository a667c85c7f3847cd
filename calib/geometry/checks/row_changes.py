"""Changes of the set-up during the measurement: each possible change is tested on the residuals of the rigid fit.

The order of rows is taken as time. A hypothesis is that a placement, a target, the zero of a joint or the instrument's
scale changed in one step or drifted. The residuals are then r = W x + s(row) H d + noise. W is the observation matrix
of all rigid parameters x, which have a prior of making (plausible deviations from nominal). H are the columns of the
changed parameters, and d is the size of the change. s(row) is a step after one row or a ramp over all rows. By the
score test (Rao 1948) a change lowers the penalised sum of squares by

    gain = gᵀ S⁻¹ g,   g = Σ s Hᵀ e,   S = Σ s² HᵀH - (Σ s HᵀQ)(Σ s HᵀQ)ᵀ,   Q = W (WᵀW + Λ)^(-1/2)

with e the residuals after fitting x and Λ the precision of the prior. The sums over the rows after a step are
cumulative sums, so that a step after every row can be tried.

A change is reported if all of these conditions are met: it is significant by Fisher's test, corrected for the number of
hypotheses (Bonferroni); it leaves only a small share of the residuals; it also reduces the residuals of held-out rows;
and changes over rows ordered by a joint's values or the target's coordinates explain the residuals much less. An effect
that is missing in the arm's model would violate the last condition.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import scipy.linalg
from scipy.special import fdtrc

from calib.data.poses.measurements import Positions, take
from calib.errors import Finding, finding
from calib.geometry.fit import plausible_deviation
from calib.geometry.installation import FRAME_AXES
from calib.geometry.observation import Block, layout, observe, parameter_values, prepare
from calib.geometry.weighing import GeometricFit
from calib.records import evenly

# smallest number of rows of a block; a third of it is the smallest number before and after a step (our choice)
MIN_ROWS = 20
# largest number of rows of a block that are used (our choice)
MAX_ROWS = 1500
# largest probability that noise has such a gain for any hypothesis; small, since residuals are not quite white
# (our choice)
MAX_CHANCE = 1e-6
# largest rms with the change, as a share of the rms without it (our choice)
MAX_LEFT = 0.75
# the same share on held-out rows (our choice)
MAX_LEFT_UNSEEN = 0.85
# largest gain of a change over rows in another order, as a share of the gain in the order of the file (our choice)
MAX_RIVAL = 0.5
# largest number of changes that are searched for in one block
MAX_CHANGES = 3
# rows with residuals above this multiple of the median are outliers, not rows of another set-up (our choice)
GROSS = 10.0
# smallest standard deviation of a reading [m, rad]
MIN_NOISE = 1e-6
# prior standard deviation of placements [m, rad]
FREE = 10.0
# prior standard deviation of a change during the measurement [m, rad]
CHANGED = 0.1
# largest number of passes that remove outliers
GROSS_PASSES = 5
# number of parts of the rows, each of which is held out once to test a change
FOLDS = 5
STEPS = {"station": "station-changed", "target": "target-changed", "zero": "zero-changed", "scale": "scale-changed"}
DRIFTS = {"station": "station-drifts", "target": "target-wanders", "zero": "zero-drifts", "scale": "scale-drifts"}


@dataclass(frozen=True, eq=False)
class WhitenedRows:
    """Whitened rows of one block, in the order of its file.

    Attributes:
        block: the measurements.
        residual: (m, d) residuals of the d measured numbers of each row, in sigmas.
        matrix: (m, d, f) derivatives of the predictions by all f rigid parameters, in sigmas per unit.
        precision: (f,) precision (1/σ²) of the parameters' prior.
        pull: (f,) precision times (mean of the prior minus present value).
        metres: (m,) standard deviation by which each row's position was divided [m].
    """

    block: Block
    residual: np.ndarray
    matrix: np.ndarray
    precision: np.ndarray
    pull: np.ndarray
    metres: np.ndarray

    def some(self, rows: np.ndarray) -> "WhitenedRows":
        """Return the whitened rows with the given row numbers or mask."""
        measured = take(self.block.measured, rows)
        block = Block(measured, self.block.station, self.block.tool[rows])
        return WhitenedRows(block, self.residual[rows], self.matrix[rows], self.precision, self.pull, self.metres[rows])

    def with_columns(self, columns: np.ndarray) -> "WhitenedRows":
        """Return the rows with the columns (m, d, k) of k changed parameters appended to `matrix`.

        The appended parameters have a prior so wide that it has no effect.
        """
        count = columns.shape[2]
        matrix = np.concatenate([self.matrix, columns], axis=2)
        precision = np.append(self.precision, np.full(count, CHANGED**-2.0))
        pull = np.append(self.pull, np.zeros(count))
        return replace(self, matrix=matrix, precision=precision, pull=pull)

    def normal(self) -> np.ndarray:
        """Return the matrix of the normal equations (f, f), the prior included."""
        flat = self.matrix.reshape(-1, self.matrix.shape[2])
        square = flat.T @ flat
        # rounding is no loss of rank
        rounding = 1e-13 * np.diag(square).max()
        return square + np.diag(self.precision + rounding)

    def residuals(self, estimate: np.ndarray) -> np.ndarray:
        """Return the residuals (m, d) after the parameters changed by `estimate` (f,), in sigmas."""
        return self.residual - self.matrix @ estimate

    def solve(self) -> np.ndarray:
        """Return the penalised least-squares estimate (f,)."""
        flat = self.matrix.reshape(-1, self.matrix.shape[2])
        right = flat.T @ self.residual.ravel() + self.pull
        return scipy.linalg.solve(self.normal(), right, assume_a="pos")

    def position_rms(self, residuals: np.ndarray) -> float:
        """Return the rms of the position residuals' norms [m], from whitened residuals (m, d)."""
        squares = np.sum(residuals[:, :3] ** 2, axis=1)
        return float(np.sqrt(np.mean(squares * self.metres**2)))

    def resting(self) -> float:
        """Return the effective number of parameters that are determined by their prior rather than by the rows."""
        variances = np.diag(scipy.linalg.inv(self.normal()))
        return float(np.sum(self.precision * variances))


@dataclass(frozen=True, eq=False)
class Subject:
    """A part of the set-up that may have changed during the measurement.

    It is a station, a target, the zero of a joint, or the scale of an instrument.

    Attributes:
        code: key of the part's findings in `STEPS` and `DRIFTS`.
        name: name of the station, target or joint; for the instrument's scale, name of its station.
        columns: (m, d, k) whitened derivatives of the rows by the k parameters of this part.
    """

    code: str
    name: str
    columns: np.ndarray

    @property
    def count(self) -> int:
        """Number k of parameters of this part."""
        return self.columns.shape[2]


@dataclass(frozen=True, eq=False)
class RowChange:
    """A step or drift of one part of the set-up, over the rows in some order.

    Attributes:
        subject: the part that changed.
        shape: (m,) factor of the change at each row: 0 and 1 for a step, a ramp for a drift.
        between: for a step, the values of the ordering quantity just before and just after it; None for a drift.
        gain: reduction of the penalised sum of squares.
    """

    subject: Subject
    shape: np.ndarray
    between: tuple[float, float] | None
    gain: float

    @property
    def columns(self) -> np.ndarray:
        """Columns (m, d, k) that the change adds to the whitened matrix: the columns of `subject` times `shape`."""
        return self.shape[:, None, None] * self.subject.columns


class ChangeSize(NamedTuple):
    """Size of a change, as findings state it.

    The fields are the file, the name of the changed part, first and last row; the size with its standard deviation (at
    the targets [m], or of one number [m, rad or 1]); and the rms of the position residuals without and with it [m].
    """

    file: str
    name: str
    first: int
    end: int
    size: float
    sigma: float
    before: float
    after: float


def row_changes(fit: GeometricFit) -> list[Finding]:
    """Return findings on the parts of the set-up that changed while the rows of a block were measured.

    Args:
        fit: a fit without joint corrections.
    """
    findings: list[Finding] = []
    for number, block in enumerate(fit.blocks):
        if not isinstance(block.measured, Positions) or len(block.measured) < MIN_ROWS:
            continue
        rows = without_gross(whitened_rows(fit, number))
        subjects = _subjects(fit, rows)
        for _ in range(MAX_CHANGES):
            change = _best_change(rows, subjects)
            if change is None:
                break
            findings.append(_described(rows, change))
            rows = rows.with_columns(change.columns)
    return findings


def whitened_rows(fit: GeometricFit, number: int) -> WhitenedRows:
    """Return the whitened rows of the block with index `number` in a fit, with the columns of all rigid parameters."""
    measured = fit.blocks[number].measured
    (block,) = prepare(fit.cell, [take(measured, evenly(len(measured), MAX_ROWS))])
    table = layout(fit.cell)
    columns = table.index("arm", "station", "tool")
    sigmas = fit.used_sigmas()[number]
    values, jacobians, scales = [], [], []
    for part in observe(fit.cell, block, columns):
        values.append(part.value)
        jacobians.append(part.jacobian)
        scales.append(np.full(len(part.value), max(sigmas[part.label], MIN_NOISE)))
    scale = np.concatenate(scales)
    residual = np.concatenate(values).T / scale
    matrix = np.concatenate(jacobians, axis=1).transpose(2, 1, 0) / scale[:, None]
    precision = np.minimum(plausible_deviation(fit.cell, columns), FREE) ** -2.0
    from_nominal = (parameter_values(fit.start) - parameter_values(fit.cell))[columns]
    from_nominal[np.array(table.kinds)[columns] != "arm"] = 0.0
    metres = np.full(len(residual), max(sigmas["position"], MIN_NOISE))
    return WhitenedRows(block, residual, matrix, precision, from_nominal * precision, metres)


def without_gross(rows: WhitenedRows) -> WhitenedRows:
    """Return the rows without gross outliers of the rigid fit. Outliers would hide smaller changes."""
    for _ in range(GROSS_PASSES):
        size = np.linalg.norm(rows.residuals(rows.solve()), axis=1)
        fine = size <= GROSS * np.median(size)
        if fine.all() or fine.sum() < MIN_ROWS:
            break
        rows = rows.some(np.flatnonzero(fine))
    return rows


def _subjects(fit: GeometricFit, rows: WhitenedRows) -> list[Subject]:
    """Return the parts of the set-up that may have changed: station, instrument scale, targets, zeros of the joints.

    Args:
        fit: a fit without joint corrections.
        rows: the whitened rows of one of its blocks.
    """
    cell = fit.cell
    table = layout(cell)
    column = {table.names[k]: number for number, k in enumerate(table.index("arm", "station", "tool"))}
    station = cell.station_names[rows.block.station]
    codes = {station: "station"}
    for number in np.unique(rows.block.tool):
        codes[cell.tool_names[number]] = "target"
    subjects = []
    for name, code in codes.items():
        columns = rows.matrix[:, :, [column[f"{name}.{axis}"] for axis in FRAME_AXES]]
        # a point has no orientation
        visible = np.linalg.norm(columns, axis=(0, 1)) > 0.0
        subjects.append(Subject(code, name, columns[:, :, visible]))
    joints = [] if cell.chain.is_free_flyer else zip(cell.chain.joint_names, cell.chain.moving)
    for joint, element in joints:
        number = column[cell.chain.names[element]]
        subjects.append(Subject("zero", joint, rows.matrix[:, :, [number]]))
    measured = rows.block.measured
    assert isinstance(measured, Positions)
    growth = np.zeros((*rows.residual.shape, 1))
    growth[:, :3, 0] = measured.position / rows.metres[:, None]
    subjects.append(Subject("scale", station, growth))
    return [subject for subject in subjects if subject.count]


def _best_change(rows: WhitenedRows, subjects: Sequence[Subject]) -> RowChange | None:
    """Return the change over time (row order) that explains the residuals best; None if no change meets all conditions.

    The conditions are those of the module's docstring.

    Args:
        rows: the whitened rows of one block.
        subjects: the parts that may have changed.
    """
    residuals = rows.residuals(rows.solve())
    cost = float(np.sum(residuals**2))
    count = residuals.size
    best = None
    smallest = np.inf
    for change in _changes(rows, residuals, subjects, rows.block.measured.rows):
        # the fewer numbers a change takes, the more likely it is (Schwarz 1978)
        information = _information(cost - change.gain, count, change.subject.count)
        if information < smallest:
            best = change
            smallest = information
    effective = rows.matrix.shape[2] - rows.resting()
    hypotheses = len(subjects) * len(residuals)
    if best is None or not significant(best, cost, count - effective, hypotheses):
        return None
    if max(_gains_over_other_orders(rows, residuals, subjects)) > MAX_RIVAL * best.gain:
        return None
    if not holds_on_held_out(rows, best):
        return None
    return best


def _information(cost: float, count: int, parameters: int) -> float:
    """Return Schwarz's criterion (BIC) of a fit.

    Args:
        cost: sum of squared residuals of the fit, in sigmas.
        count: number of measured numbers.
        parameters: number of unknowns.
    """
    return count * np.log(max(cost, 1e-300)) + parameters * np.log(count)


def significant(change: RowChange, cost: float, dof: float, hypotheses: int) -> bool:
    """Return whether a change is significant by Fisher's test and leaves only a small share of the residuals.

    Args:
        change: the change.
        cost: sum of squares without it.
        dof: degrees of freedom of `cost`.
        hypotheses: number of changes tried (Bonferroni).
    """
    count = change.subject.count
    remaining = max(cost - change.gain, 1e-300)
    dof = max(dof, count + 1.0)
    variance = remaining / (dof - count)
    statistic = max(change.gain / count / variance, 0.0)
    chance = float(fdtrc(count, dof - count, statistic))
    return chance * hypotheses < MAX_CHANCE and variance < MAX_LEFT**2 * cost / dof


def _changes(
    rows: WhitenedRows, residuals: np.ndarray, subjects: Sequence[Subject], order: np.ndarray
) -> Iterator[RowChange]:
    """Yield, for each part of the set-up, its best step and its drift over an order (m,) of the rows.

    Args:
        rows: the whitened rows.
        residuals: (m, d) whitened residuals without a change.
        subjects: the parts that may have changed.
        order: (m,) values that order the rows; a step never separates rows of equal value.
    """
    count = len(residuals)
    flat = rows.matrix.reshape(-1, rows.matrix.shape[2])
    root = scipy.linalg.cholesky(rows.normal())
    fitted = scipy.linalg.solve_triangular(root, flat.T, trans=1).T.reshape(rows.matrix.shape)
    rank = np.argsort(order, kind="stable")
    sorted_order = order[rank]
    edge = max(MIN_ROWS // 3, count // 20)
    cuts = np.arange(edge, count - edge + 1)
    cuts = cuts[sorted_order[cuts - 1] != sorted_order[cuts]]
    spread = np.ptp(order)
    ramp = np.zeros(count)
    if spread > 0.0:
        ramp = (order - order.min()) / spread - 0.5
    for subject in subjects:
        columns = subject.columns
        score = np.einsum("mdk,md->mk", columns, residuals)
        square = np.einsum("mdk,mdl->mkl", columns, columns)
        shared = np.einsum("mdk,mdf->mkf", columns, fitted)
        if len(cuts):
            gains = _gains(
                _sums_behind(score, rank, cuts), _sums_behind(square, rank, cuts), _sums_behind(shared, rank, cuts)
            )
            best = int(np.argmax(gains))
            cut = cuts[best]
            shape = np.zeros(count)
            shape[rank[cut:]] = 1.0
            between = float(sorted_order[cut - 1]), float(sorted_order[cut])
            yield RowChange(subject, shape, between, float(gains[best]))
        ramp_score = np.tensordot(ramp, score, 1)[None]
        ramp_square = np.tensordot(ramp**2, square, 1)[None]
        ramp_shared = np.tensordot(ramp, shared, 1)[None]
        gain = _gains(ramp_score, ramp_square, ramp_shared)
        yield RowChange(subject, ramp, None, float(gain[0]))


def best_gain(rows: WhitenedRows, residuals: np.ndarray, subject: Subject) -> RowChange:
    """Return the change of a part of the set-up that acts on all rows, with its gain.

    Args:
        rows: the whitened rows.
        residuals: (m, d) whitened residuals without a change.
        subject: the part.
    """
    columns = subject.columns
    flat = rows.matrix.reshape(-1, rows.matrix.shape[2])
    added = columns.reshape(-1, subject.count)
    root = scipy.linalg.cholesky(rows.normal())
    fitted = scipy.linalg.solve_triangular(root, flat.T, trans=1).T
    score = added.T @ residuals.ravel()
    gain = _gains(score[None], (added.T @ added)[None], (added.T @ fitted)[None])
    return RowChange(subject, np.ones(len(residuals)), None, float(gain[0]))


def _sums_behind(terms: np.ndarray, rank: np.ndarray, cuts: np.ndarray) -> np.ndarray:
    """Return the sums (c, …) of `terms` (m, …) over all rows after each of c cuts.

    Args:
        terms: one array per row.
        rank: (m,) row numbers in the order in which the rows are cut.
        cuts: (c,) positions in that order.
    """
    from_last = np.cumsum(terms[rank[::-1]], axis=0)
    return from_last[::-1][cuts]


def _gains(score: np.ndarray, square: np.ndarray, shared: np.ndarray) -> np.ndarray:
    """Return the gains gᵀ S⁻¹ g (c,) of c changes, from their sums over rows.

    Args:
        score: (c, k) g, the score Σ Hᵀr of each change: H are the derivatives of the rows by the change's k parameters,
            r the residuals without a change.
        square: (c, k, k) Σ HᵀH over the rows; S is Σ HᵀH less the part that the other parameters explain, plus the
            prior precision of a change.
        shared: (c, k, f) Σ HᵀQ, with Q orthonormal columns for the other f parameters.
    """
    prior = CHANGED**-2.0 * np.eye(score.shape[1])
    matrix = square - shared @ shared.transpose(0, 2, 1) + prior
    solution = np.linalg.solve(matrix, score[:, :, None])
    return np.einsum("ck,ck->c", score, solution[:, :, 0])


def _gains_over_other_orders(rows: WhitenedRows, residuals: np.ndarray, subjects: Sequence[Subject]) -> Iterator[float]:
    """Yield the gains of changes over rows ordered by each joint's values and target coordinate instead of time.

    Args:
        rows: the whitened rows of one block of positions.
        residuals: (m, d) whitened residuals without a change.
        subjects: the parts that may have changed.
    """
    measured = rows.block.measured
    assert isinstance(measured, Positions)
    for order in (*measured.q.T, *measured.position.T):
        for change in _changes(rows, residuals, subjects, order):
            yield change.gain


def holds_on_held_out(rows: WhitenedRows, change: RowChange) -> bool:
    """Return whether the change also reduces the residuals of held-out rows, every k-th row being held out in turn.

    Args:
        rows: the whitened rows of one block.
        change: the change, whose columns are added.
    """
    changed = rows.with_columns(change.columns)
    count = len(rows.residual)
    squares = changed_squares = 0.0
    for fold in range(FOLDS):
        held_out = np.arange(fold, count, FOLDS)
        fitted = np.setdiff1d(np.arange(count), held_out)
        squares += _squares_on(rows, held_out, fitted)
        changed_squares += _squares_on(changed, held_out, fitted)
    return changed_squares < MAX_LEFT_UNSEEN**2 * squares


def _squares_on(rows: WhitenedRows, held_out: np.ndarray, fitted: np.ndarray) -> float:
    """Return the sum of squares of the rows `held_out`, predicted with the estimate from the rows `fitted`.

    Args:
        rows: the whitened rows of one block.
        held_out, fitted: row numbers.
    """
    residuals = rows.some(held_out).residuals(rows.some(fitted).solve())
    return float(np.sum(residuals**2))


def _described(rows: WhitenedRows, change: RowChange) -> Finding:
    """Return the finding on a change, with the estimated size of the change and its standard deviation.

    Args:
        rows: the whitened rows of one block.
        change: the change to describe.
    """
    values = size_of(rows, change)._asdict()
    if change.between is None:
        return finding(DRIFTS[change.subject.code], **values)
    last, following = change.between
    return finding(STEPS[change.subject.code], last=int(last), next=int(following), **values)


def size_of(rows: WhitenedRows, change: RowChange) -> ChangeSize:
    """Return the estimated size of a change with its standard deviation, and the residuals with and without it.

    Args:
        rows: the whitened rows of one block.
        change: the change to describe.
    """
    extended = rows.with_columns(change.columns)
    estimate = extended.solve()
    count = change.subject.count
    before = rows.residuals(rows.solve())
    after = extended.residuals(estimate)
    dof = max(after.size - extended.matrix.shape[2] + extended.resting(), 1.0)
    covariance = scipy.linalg.inv(extended.normal()) * float(np.sum(after**2)) / dof
    change_estimate = estimate[-count:]
    change_covariance = covariance[-count:, -count:]
    if count == 1:
        size = float(change_estimate[0])
        sigma = float(np.sqrt(change_covariance[0, 0]))
    else:
        # at the targets [m], rms over the rows
        columns = change.subject.columns[:, :3] * rows.metres[:, None, None]
        weight = np.einsum("mdk,mdl->kl", columns, columns) / len(columns)
        gradient = change_estimate @ weight
        size = float(np.sqrt(gradient @ change_estimate))
        sigma = float(np.sqrt(gradient @ change_covariance @ weight @ change_estimate)) / max(size, 1e-300)
    numbers = rows.block.measured.rows
    return ChangeSize(
        file=Path(rows.block.measured.file).name or "measurements",
        name=change.subject.name,
        first=int(numbers.min()),
        end=int(numbers.max()),
        size=size,
        sigma=sigma,
        before=rows.position_rms(before),
        after=rows.position_rms(after),
    )
