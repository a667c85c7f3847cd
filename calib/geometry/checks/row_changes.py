"""What changed while measuring: a table of hypotheses, each tried on the residuals of the rigid fit and its Jacobian.

Row order is time. A hypothesis says that a placement, a target, the zero of a joint or the instrument's scale changed
in steps or drifted, so that r = W x + s(row) H d + noise: W the observation matrix of all rigid parameters with a prior
of making, H the columns of what changed, s(row) a step behind one row or a ramp over all. By the score test (Rao 1948)
a change lowers the penalised sum of squares by

    gain = gᵀ S⁻¹ g,   g = Σ s Hᵀ e,   S = Σ s² HᵀH - (Σ s HᵀQ)(Σ s HᵀQ)ᵀ,   Q = W (WᵀW + Λ)^(-1/2)

with e what remains after fitting x. All sums over rows behind a cut are cumulative ones, so that every cut is tried.

A change is found where it explains the residuals: by Fisher's test with the number of hypotheses (Bonferroni), by the
share that remains, on rows that did not determine it, and much better than the same change over the order of a joint's
values or of the target's coordinates, as an effect that the arm's model lacks would.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy.linalg

from calib.data.poses.measurements import Positions, take
from calib.errors import Finding, finding
from calib.geometry.fit import plausible_deviation
from calib.geometry.installation import FRAME_AXES
from calib.geometry.observation import Block, layout, observe, parameter_values, prepare
from calib.geometry.weighing import GeometricFit
from calib.records import evenly

MIN_ROWS = 20  # of a block, and of its rows before and after a step the third part (our choice)
MAX_ROWS = 1500  # of a block that are looked at (our choice)
MAX_CHANCE = 1e-6  # that noise explains as much by one of the hypotheses: residuals are not quite white (our choice)
MAX_LEFT = 0.75  # of the rms that remains without the change (our choice)
MAX_LEFT_UNSEEN = 0.85  # the same on rows that did not determine the change (our choice)
MAX_RIVAL = 0.5  # gain of the best change over another order, of that over the rows (our choice)
MAX_CHANGES = 3  # that are searched for in one block
GROSS = 10.0  # times the median residual: rows that are measured wrongly, not of another set-up (our choice)
MIN_NOISE = 1e-6  # [m, rad] no instrument has less
FREE = 10.0  # [m, rad] width of the prior of placements
CHANGED = 0.1  # [m, rad] width of the prior of what changed while measuring
FOLDS = 5
STEPS = {"station": "station-changed", "target": "target-changed", "zero": "zero-changed", "scale": "scale-changed"}
DRIFTS = {"station": "station-drifts", "target": "target-wanders", "zero": "zero-drifts", "scale": "scale-drifts"}


@dataclass(frozen=True, eq=False)
class Rows:
    """Whitened rows of one block, in the order of its file.

    Attributes:
        block: the rows.
        residual: (m, d) of d measured numbers per row.
        matrix: (m, d, f) columns of all rigid parameters.
        precision: (f,) of the parameters' prior.
        pull: (f,) precision times how far the prior's mean is away.
        metres: (m,) divisor of the positions' numbers [m].
    """

    block: Block
    residual: np.ndarray
    matrix: np.ndarray
    precision: np.ndarray
    pull: np.ndarray
    metres: np.ndarray

    def some(self, rows: np.ndarray) -> "Rows":
        """Return some of the rows."""
        measured = take(self.block.measured, rows)
        block = Block(measured, self.block.station, self.block.tool[rows])
        return Rows(block, self.residual[rows], self.matrix[rows], self.precision, self.pull, self.metres[rows])

    def with_columns(self, columns: np.ndarray) -> "Rows":
        """Return the rows with further columns (m, d, k), of what changed."""
        count = columns.shape[2]
        precision = np.append(self.precision, np.full(count, CHANGED**-2.0))
        matrix = np.concatenate([self.matrix, columns], axis=2)
        return Rows(self.block, self.residual, matrix, precision, np.append(self.pull, np.zeros(count)), self.metres)

    def normal(self) -> np.ndarray:
        """Return the matrix of the normal equations (f, f), the prior included."""
        flat = self.matrix.reshape(-1, self.matrix.shape[2])
        square = flat.T @ flat
        return square + np.diag(self.precision + 1e-13 * np.diag(square).max())  # rounding is no loss of rank

    def solve(self) -> np.ndarray:
        """Return the penalised least-squares estimate (f,)."""
        flat = self.matrix.reshape(-1, self.matrix.shape[2])
        return scipy.linalg.solve(self.normal(), flat.T @ self.residual.ravel() + self.pull, assume_a="pos")

    def left(self, estimate: np.ndarray) -> np.ndarray:
        """Return the residuals (m, d) with an estimate."""
        return self.residual - self.matrix @ estimate

    def position_rms(self, left: np.ndarray) -> float:
        """Return the rms of position residuals [m] of whitened ones (m, d)."""
        return float(np.sqrt(np.mean(np.sum(left[:, :3] ** 2, axis=1) * self.metres**2)))


@dataclass(frozen=True, eq=False)
class Subject:
    """What may have changed.

    Attributes:
        code: of its findings in `STEPS` and `DRIFTS`.
        name: of the station, target or joint; of the instrument's scale the station's.
        columns: (m, d, k) derivatives of the rows by its k numbers, whitened.
    """

    code: str
    name: str
    columns: np.ndarray

    @property
    def count(self) -> int:
        """Number of its numbers k."""
        return self.columns.shape[2]


@dataclass(frozen=True, eq=False)
class Change:
    """A change of one subject over an order of the rows.

    Attributes:
        subject: what changed.
        shape: (m,) factor of the change at each row: 0 and 1, or a ramp.
        between: values of the order before and behind the step; None for a drift.
        gain: reduction of the penalised sum of squares.
    """

    subject: Subject
    shape: np.ndarray
    between: tuple[float, float] | None
    gain: float

    @property
    def columns(self) -> np.ndarray:
        """(m, d, k) columns that the change adds."""
        return self.shape[:, None, None] * self.subject.columns


def row_changes(found: GeometricFit) -> list[Finding]:
    """Return findings on what changed while the rows of each block were measured.

    Args:
        found: a fit without joint corrections.
    """
    result: list[Finding] = []
    for number, block in enumerate(found.blocks):
        if not isinstance(block.measured, Positions) or len(block.measured) < MIN_ROWS:
            continue
        rows = _without_gross(_rows_of(found, number))
        subjects = _subjects(found, rows)
        for _ in range(MAX_CHANGES):
            change = _best_change(rows, subjects)
            if change is None:
                break
            result.append(_described(rows, change))
            rows = rows.with_columns(change.columns)
    return result


def _rows_of(found: GeometricFit, number: int) -> Rows:
    """Return a block's rows, whitened, with the columns of all rigid parameters."""
    measured = found.blocks[number].measured
    (block,) = prepare(found.cell, [take(measured, evenly(len(measured), MAX_ROWS))])
    table = layout(found.cell)
    columns = table.index("arm", "station", "tool")
    used = {label: max(sigma, MIN_NOISE) for label, sigma in found.used_sigmas()[number].items()}
    parts = observe(found.cell, block, columns)
    scale = np.concatenate([np.full(len(part.value), used[part.label]) for part in parts])
    residual = np.concatenate([part.value for part in parts]).T / scale
    matrix = np.concatenate([part.jacobian for part in parts], axis=1).transpose(2, 1, 0) / scale[:, None]
    width = np.minimum(plausible_deviation(found.cell, columns), FREE)
    away = (parameter_values(found.start) - parameter_values(found.cell))[columns]
    away[np.array(table.kinds)[columns] != "arm"] = 0.0
    metres = np.full(len(residual), used["position"])
    return Rows(block, residual, matrix, width**-2.0, away * width**-2.0, metres)


def _without_gross(rows: Rows) -> Rows:
    """Return the rows without those that are far off whatever the rigid arm, which would hide all else."""
    passes = 5  # until no row leaves; more are seldom needed
    for _ in range(passes):
        size = np.linalg.norm(rows.left(rows.solve()), axis=1)
        fine = size <= GROSS * np.median(size)
        if fine.all() or fine.sum() < MIN_ROWS:
            break
        rows = rows.some(np.flatnonzero(fine))
    return rows


def _subjects(found: GeometricFit, rows: Rows) -> list[Subject]:
    """Return what may have changed: the station, the instrument's scale, each target, and the zero of each joint."""
    table, cell = layout(found.cell), found.cell
    place = {table.names[k]: number for number, k in enumerate(table.index("arm", "station", "tool"))}
    station = cell.station_names[rows.block.station]
    names = {station: "station"} | {cell.tool_names[number]: "target" for number in np.unique(rows.block.tool)}
    subjects = []
    for name, code in names.items():
        columns = rows.matrix[:, :, [place[f"{name}.{axis}"] for axis in FRAME_AXES]]
        seen = np.linalg.norm(columns, axis=(0, 1)) > 0.0  # a point has no orientation
        subjects.append(Subject(code, name, columns[:, :, seen]))
    for joint, element in zip(cell.chain.joint_names, cell.chain.moving):
        number = place[cell.chain.names[element]]
        subjects.append(Subject("zero", joint, rows.matrix[:, :, [number]]))
    measured = rows.block.measured
    assert isinstance(measured, Positions)
    growth = np.zeros((*rows.residual.shape, 1))
    growth[:, :3, 0] = measured.position / rows.metres[:, None]
    subjects.append(Subject("scale", station, growth))
    return [subject for subject in subjects if subject.count]


def _best_change(rows: Rows, subjects: Sequence[Subject]) -> Change | None:
    """Return the change over the rows that explains the residuals; None where none does."""
    left = rows.left(rows.solve())
    cost, count = float(np.sum(left**2)), left.size
    effective = rows.matrix.shape[2] - _held(rows)
    tried = list(_changes(rows, left, subjects, rows.block.measured.rows))
    # the fewer numbers a change takes, the more likely it is (Schwarz 1978)
    best = min(tried, key=lambda one: _information(cost - one.gain, count, one.subject.count), default=None)
    hypotheses = len(subjects) * len(left)
    if best is None or not _significant(best, cost, count - effective, hypotheses):
        return None
    if max(_gains_over_other_orders(rows, left, subjects)) > MAX_RIVAL * best.gain:
        return None
    return best if _holds_on_unseen(rows, best) else None


def _held(rows: Rows) -> float:
    """Return the number of parameters that rest on their prior."""
    return float(np.sum(rows.precision * np.diag(scipy.linalg.inv(rows.normal()))))


def _information(cost: float, count: int, parameters: int) -> float:
    return count * np.log(max(cost, 1e-300)) + parameters * np.log(count)


def _significant(change: Change, cost: float, dof: float, hypotheses: int) -> bool:
    """Return whether a change explains the residuals by Fisher's test, and leaves little of them."""
    from scipy.stats import f  # slow to load

    number = change.subject.count
    remains, dof = max(cost - change.gain, 1e-300), max(dof, number + 1.0)
    variance = remains / (dof - number)
    chance = float(f.sf(change.gain / number / variance, number, dof - number))
    return chance * hypotheses < MAX_CHANCE and variance < MAX_LEFT**2 * cost / dof


def _changes(rows: Rows, left: np.ndarray, subjects: Sequence[Subject], order: np.ndarray) -> Iterator[Change]:
    """Yield the best step and the drift of each subject over an order (m,) of the rows.

    Args:
        rows: whitened.
        left: (m, d) what remains without a change.
        subjects: what may have changed.
        order: values that order the rows; equal ones stay together.
    """
    flat = rows.matrix.reshape(-1, rows.matrix.shape[2])
    root = scipy.linalg.cholesky(rows.normal())
    fitted = scipy.linalg.solve_triangular(root, flat.T, trans=1).T.reshape(rows.matrix.shape)
    rank = np.argsort(order, kind="stable")
    edge = max(MIN_ROWS // 3, len(left) // 20)
    sorted_order = order[rank]
    cuts = np.arange(edge, len(left) - edge + 1)
    cuts = cuts[sorted_order[cuts - 1] != sorted_order[cuts]]
    spread = np.ptp(order)
    ramp = (order - order.min()) / spread - 0.5 if spread > 0.0 else np.zeros(len(left))
    for subject in subjects:
        columns = subject.columns
        score = np.einsum("mdk,md->mk", columns, left)
        square = np.einsum("mdk,mdl->mkl", columns, columns)
        shared = np.einsum("mdk,mdf->mkf", columns, fitted)
        if len(cuts):
            behind = [np.cumsum(each[rank[::-1]], axis=0)[::-1][cuts] for each in (score, square, shared)]
            gains = _gains(*behind)
            best = int(np.argmax(gains))
            shape = np.zeros(len(left))
            shape[rank[cuts[best] :]] = 1.0
            between = float(sorted_order[cuts[best] - 1]), float(sorted_order[cuts[best]])
            yield Change(subject, shape, between, float(gains[best]))
        weights = ramp, ramp**2, ramp
        sums = [np.tensordot(weight, each, 1)[None] for weight, each in zip(weights, (score, square, shared))]
        yield Change(subject, ramp, None, float(_gains(*sums)[0]))


def _gains(score: np.ndarray, square: np.ndarray, shared: np.ndarray) -> np.ndarray:
    """Return gᵀ S⁻¹ g (c,) of sums over rows: g (c, k), Σ HᵀH (c, k, k), Σ HᵀQ (c, k, f)."""
    matrix = square - shared @ shared.transpose(0, 2, 1) + CHANGED**-2.0 * np.eye(score.shape[1])
    return np.einsum("ck,ck->c", score, np.linalg.solve(matrix, score[:, :, None])[:, :, 0])


def _gains_over_other_orders(rows: Rows, left: np.ndarray, subjects: Sequence[Subject]) -> Iterator[float]:
    """Yield the gains of changes over joint values and the target's coordinates, which are not of time."""
    measured = rows.block.measured
    assert isinstance(measured, Positions)
    for order in (*measured.q.T, *measured.position.T):
        for change in _changes(rows, left, subjects, order):
            yield change.gain


def _holds_on_unseen(rows: Rows, change: Change) -> bool:
    """Return whether the change explains rows that did not determine it."""
    both = rows, rows.with_columns(change.columns)
    squares = [0.0, 0.0]
    for fold in range(FOLDS):
        unseen = np.arange(fold, len(rows.residual), FOLDS)
        others = np.setdiff1d(np.arange(len(rows.residual)), unseen)
        for place, each in enumerate(both):
            squares[place] += float(np.sum(each.some(unseen).left(each.some(others).solve()) ** 2))
    return squares[1] < MAX_LEFT_UNSEEN**2 * squares[0]


def _described(rows: Rows, change: Change) -> Finding:
    """Return the finding on a change, with its size and σ."""
    extended = rows.with_columns(change.columns)
    estimate = extended.solve()
    count = change.subject.count
    after, before = extended.left(estimate), rows.left(rows.solve())
    dof = max(after.size - extended.matrix.shape[2] + _held(extended), 1.0)
    covariance = scipy.linalg.inv(extended.normal()) * float(np.sum(after**2)) / dof
    moved, spread = estimate[-count:], covariance[-count:, -count:]
    if count == 1:
        size, sigma = float(moved[0]), float(np.sqrt(spread[0, 0]))
    else:  # at the targets [m], rms over the rows
        columns = change.subject.columns[:, :3] * rows.metres[:, None, None]
        weight = np.einsum("mdk,mdl->kl", columns, columns) / len(columns)
        size = float(np.sqrt(moved @ weight @ moved))
        sigma = float(np.sqrt(moved @ weight @ spread @ weight @ moved)) / max(size, 1e-300)
    numbers = rows.block.measured.rows
    values = {
        "file": Path(rows.block.measured.file).name or "measurements",
        "name": change.subject.name,
        "first": int(numbers.min()),
        "end": int(numbers.max()),
        "size": size,
        "sigma": sigma,
        "before": rows.position_rms(before),
        "after": rows.position_rms(after),
    }
    if change.between is None:
        return finding(DRIFTS[change.subject.code], **values)
    last, following = (int(row) for row in change.between)
    return finding(STEPS[change.subject.code], last=last, next=following, **values)
