"""Forward selection of friction terms, step by step and joint by joint, by the errors on held-out time.

    standard → + coupling → + load → + presliding (→ + cable) → + stribeck → + asymmetric → + root → + cubic → + ripple

Every step is tried on top of those taken: all joints get its terms, every time block is predicted by a fit to the
others, and the terms stay at the joints whose error on unseen time falls by `MIN_GAIN`, and does not grow where one
half of the time predicts the other: neighbouring blocks judge what holds between them, not what holds elsewhere. Terms
of a step have a ridge per joint, chosen by evidence, so that a rich step (ripple) may offer more than the data can
tell.

A coupling is a gear whose motor turns with two joints; it is offered for pairs of joints of which what the standard
model leaves is explained by the other's motion. Cables are offered where sensors see them behind the gears, apart from
friction; by name, anywhere. A term is judged by the rows that it acts on, each in units of its own residuals.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import scipy.linalg

from calib.data.signals.filtering import Decimator, kept
from calib.dynamics import drives
from calib.dynamics.drives import DriveTerm
from calib.dynamics.shapes import STEPS, JointRange
from calib.dynamics.torque_rows import MOTOR, TorqueRows
from calib.errors import UsageError, one_of
from calib.identification.prior import TEMPERING, Prior
from calib.identification.rows import Case, ObservationRows, observe_terms, triangulate
from calib.identification.time_folds import CrossValidation, regimes
from calib.records import Number, stored

MIN_GAIN = 0.02  # a step has to lower a joint's rms error on unseen time by this share (our choice)


NAMES = ("auto", "standard", "coupling", *STEPS, "ripple")

Progress = Callable[[str], None]


@dataclass(frozen=True)
class FrictionTrial:
    """Result of one tested step of the friction selection.

    Attributes:
        model: e.g. ``standard`` or ``+ load``.
        parameters: number of parameters of the model, all joints.
        cross_validated_percent: relative error on held-out time, over all rows [%].
        joints_percent: the same for each row [%].
        kept_at_joints: joints, from 1, at which the step is kept.
        note: remark on the step, as text.
        terms: names of the terms that are kept.
    """

    model: str
    parameters: int
    cross_validated_percent: Number
    joints_percent: tuple[Number, ...]
    kept_at_joints: tuple[int, ...]
    note: str = ""
    terms: tuple[str, ...] = ()

    @stored
    def kept(self) -> bool:
        """Whether the step is part of the model."""
        return bool(self.kept_at_joints) or self.model == "standard"


@dataclass(frozen=True, eq=False)
class FrictionSelection:
    """Result of forward selection: the selected terms, their ridge groups, and the tested steps.

    Attributes:
        off: names of terms that the final fit's ridges set to zero; their rows of ``covariance.csv`` state the ridges'
            floor, so that the model's other σ are those without them.
    """

    terms: tuple[DriveTerm, ...]
    groups: tuple[int, ...]
    steps: tuple[FrictionTrial, ...]
    off: tuple[str, ...] = ()

    def fitted(self, sigma: np.ndarray) -> FrictionSelection:
        """Return the selection without the terms that the final fit switched off, from the σ (k,) of its terms."""
        min_sigma = 1e-9  # σ of a term below which its ridge holds it at zero
        off = tuple(one.name for one, own in zip(self.terms, sigma, strict=True) if own < min_sigma)
        joints = {one.name: _joints(one) for one in self.terms if one.name not in off}
        steps = []
        for step in self.steps:
            left = tuple(1 + joint for joint in _flat([joints[name] for name in step.terms if name in joints]))
            if step.terms and left != step.kept_at_joints:
                step = replace(step, kept_at_joints=left, note="" if left else "switched off by the final fit")
            steps.append(step)
        return replace(self, steps=tuple(steps), off=off)

    @property
    def chosen(self) -> str:
        return " + ".join(["standard", *(step.model[2:] for step in self.steps if step.kept and step.model[0] == "+")])


@dataclass(frozen=True, eq=False)
class FrictionCandidates:
    """Input of the forward selection of friction.

    Attributes:
        cases: training recordings.
        rows: their rows in the base columns and standard drive terms, blocks numbered.
        loads: torques transmitted by the gears of each case (N, n), from a first fit.
        decimator: filter of the rows.
        std, inflation: (rows,) standard deviation and variance inflation of the first fit's residuals.
        v0: (n,) smoothing of the Coulomb sign.
        linear: (n,) which joints are prismatic.
        apart: rows with a different unit, excluded from totals.
        prior: prior of the base parameters; None without one.
        torque_rows: kind of torques in the rows, motor torques included.
        coupled: pairs of joints, from 0, whose coupling is already in the model.
    """

    cases: Sequence[Case]
    rows: Sequence[ObservationRows]
    loads: Sequence[np.ndarray | None]
    decimator: Decimator
    std: np.ndarray
    inflation: np.ndarray
    v0: np.ndarray
    linear: np.ndarray
    prior: Prior | None = None
    apart: tuple[int, ...] = ()
    torque_rows: TorqueRows = MOTOR
    coupled: frozenset[tuple[int, ...]] = frozenset()

    @property
    def n(self) -> int:
        return self.cases[0].motion.n


def select_friction(
    candidates: FrictionCandidates, wanted: str = "auto", progress: Progress | None = None
) -> FrictionSelection:
    """Return the friction terms that reduce the error on held-out time, or all terms of a named step.

    Args:
        wanted: ``auto``; ``standard`` (or ``ripple``, found later by `calib.identification.friction.ripple`): none;
            a step's name: that step at all joints, nothing else.
    """
    say = progress or (lambda words: None)
    one_of(wanted, NAMES, "friction", UsageError)
    say("friction: columns")
    sensed = candidates.torque_rows.sensed
    steps_tried = [name for name in NAMES[2:-1] if wanted == name or (wanted == "auto" and (sensed or name != "cable"))]
    offered = {name: terms for name, terms in _terms(candidates, steps_tried).items() if terms or name == wanted}
    every = [one for terms in offered.values() for one in terms]
    validation, place = _cross_validation(candidates, offered, every)
    bench = _Bench(candidates, validation, every, wanted != "auto")
    say("friction: standard")
    error = bench.errors([])
    steps = [bench.trial("standard", [], error, tuple(range(candidates.n)))]
    taken: list[int] = []
    waiting = list(offered)
    for second in (False, True):
        refused = []
        for name in waiting:
            say(f"friction: {name}")
            columns = [k for k in place[name] if k not in taken]
            found, new, at = bench.tried(taken, columns, error)
            note = "" if at else "no improvement on held-out time: not used"
            note = note if columns else "no joint shows a need for such terms in its residual: none tried"
            shown = new if found else bench.errors([*taken, *columns])
            names = tuple(bench.term(k).name for k in found)
            steps.append(bench.trial(f"+ {name}", [*taken, *(found or columns)], shown, at, note, names))
            if found:
                taken, error = [*taken, *found], new
            else:
                refused.append(name)
        if second or not taken or not refused:
            break
        waiting = [name for name in refused if any(at > place[name][0] for at in taken)]
    groups = validation.group[taken]
    return FrictionSelection(tuple(map(bench.term, taken)), tuple(int(g) for g in groups), tuple(steps))


@dataclass(frozen=True, eq=False)
class _Bench:
    """Test of friction terms by cross-validation; the columns of all candidate terms, `every`, follow the base columns.

    Attributes:
        forced: whether terms are kept without a test.
    """

    candidates: FrictionCandidates
    validation: CrossValidation
    every: Sequence[DriveTerm]
    forced: bool

    def term(self, column: int) -> DriveTerm:
        return self.every[column - self.validation.data.parameters]  # counted from behind

    def errors(self, taken: Sequence[int], folds: int | None = None) -> np.ndarray:
        """Return the squared errors (blocks, rows) of a model with the base columns and these columns."""
        return self.validation.errors(self._with_base(taken), folds)

    def _with_base(self, taken: Sequence[int]) -> np.ndarray:
        return np.array([*range(self.validation.data.parameters - len(self.every)), *taken])

    def tried(
        self, taken: list[int], columns: list[int], error: np.ndarray
    ) -> tuple[list[int], np.ndarray, tuple[int, ...]]:
        """Return the columns that pass the test, the errors of the model with them, and their joints."""
        if not columns:  # a step asked for by name that has no terms here
            return [], error, ()
        joints = {k: _joints(self.term(k)) for k in columns}
        everyone, side = tuple(sorted(set(joints.values()))), self.term(columns[0]).side
        if self.forced:
            return columns, self.errors([*taken, *columns]), _flat(everyone)

        def felt(squares: np.ndarray, own: tuple[int, ...]) -> np.ndarray:
            """Return the whitened squared errors (blocks,) of the torque rows affected by terms of these joints."""
            rows = [row for j in own for row in self.candidates.torque_rows.of_side(side, j, self.candidates.n)]
            return np.sum(squares[:, rows] / self.validation.std[rows] ** 2, axis=1)

        half, far = self.errors(taken, 2), self.validation.extrapolated(self._with_base(taken))
        at, some = everyone, columns
        for _ in range(2):  # with the joints left that it pays at, once more
            both = [*taken, *some]
            new, other, beyond = (
                self.errors(both),
                self.errors(both, 2),
                self.validation.extrapolated(self._with_base(both)),
            )
            at = tuple(
                own
                for own in at
                if _pays(felt(error, own), felt(new, own))
                and _carries(felt(half, own), felt(other, own))
                and _extrapolates(felt(far, own), felt(beyond, own))
            )
            some, before = [k for k in some if joints[k] in at], some
            if not some:
                return [], error, ()
            if some == before:
                break
        else:
            new = self.errors([*taken, *some])
        return some, new, _flat(at)

    def trial(
        self,
        name: str,
        taken: Sequence[int],
        error: np.ndarray,
        at: tuple[int, ...],
        note: str = "",
        terms: tuple[str, ...] = (),
    ) -> FrictionTrial:
        """Return the result of a step from its columns, its squared errors, and the joints at which it is kept."""
        squares = (self.validation.data.factors[:, :, -1] ** 2).sum(axis=1).reshape(-1, self.validation.rows)
        size = squares[: self.validation.blocks].sum(axis=0)  # Σ τ² per row over the judged blocks
        with np.errstate(divide="ignore", invalid="ignore"):
            joints = 100.0 * np.sqrt(error.sum(axis=0) / size)
        alike = np.setdiff1d(np.arange(len(size)), self.candidates.apart)
        total = float(100.0 * np.sqrt(error[:, alike].sum() / size[alike].sum()))
        percent, count = tuple(float(x) for x in np.nan_to_num(joints)), len(self._with_base(taken))
        return FrictionTrial(name, count, total, percent, tuple(1 + joint for joint in at), note, terms)


def _joints(one: DriveTerm) -> tuple[int, ...]:
    """Return the joints whose torques a term acts on."""
    return tuple(sorted({row for row, _ in one.acts}))


def _flat(at: Sequence[tuple[int, ...]]) -> tuple[int, ...]:
    return tuple(sorted({joint for own in at for joint in own}))


def _carries(before: np.ndarray, after: np.ndarray) -> bool:
    """Return whether the rms error of cross-validation with two halves grew by at most the share `MIN_GAIN`."""
    return bool(after.sum() <= (1.0 + MIN_GAIN) ** 2 * before.sum())


def _extrapolates(before: np.ndarray, after: np.ndarray) -> bool:
    """Return whether the geometric mean of a joint's squared errors in held-out ranges (k,) did not increase."""
    used = (before > 0.0) & (after > 0.0)
    return bool(np.log(after[used] / before[used]).mean() <= 0.0) if used.any() else True


def _pays(before: np.ndarray, after: np.ndarray, min_blocks_won: float = 0.6) -> bool:
    """Return whether the squared errors per time block decreased by enough in total, and on enough blocks.

    `min_blocks_won`: smallest share of blocks with a smaller error.
    """
    used = before > 0.0
    if not used.any():
        return False
    lower = float(np.mean(after[used] < before[used]))
    return bool(after.sum() < (1.0 - MIN_GAIN) ** 2 * before.sum() and lower >= min_blocks_won)


def _terms(candidates: FrictionCandidates, names: Sequence[str]) -> dict[str, list[DriveTerm]]:
    """Return the candidate terms of steps for all joints."""
    found = {name: _couplings(candidates) if name == "coupling" else [] for name in names}
    for j in range(candidates.n):
        v = np.concatenate([np.abs(case.motion.v[:, j]) for case in candidates.cases])
        travel = float(np.ptp(np.concatenate([case.motion.q[:, j] for case in candidates.cases])))
        seen = JointRange(float(candidates.v0[j]), float(np.quantile(v, 0.98)), float(v.max()), travel)
        for name in found.keys() & STEPS.keys() if seen.peak > 0.0 else ():
            found[name] += drives.offered(name, j, seen, bool(candidates.linear[j]))
    return found


def _couplings(candidates: FrictionCandidates, min_explained: float = 0.05) -> list[DriveTerm]:
    """Return the coupling terms of neighbouring joints that explain residual torques of the standard model.

    A joint is in one coupling at most, and its motor turns with the sum or the difference, whichever explains more.

    `min_explained`: of two joints' squared residuals, by a coupling that is offered (our choice).
    """
    n = candidates.n
    if not candidates.torque_rows.motors_alone:
        return []
    matrix, target, factors, motion = _sampled(candidates)
    rows = (matrix / candidates.std[:, None]).reshape(-1, matrix.shape[2])
    basis = np.asarray(scipy.linalg.qr(rows, mode="economic")[0])
    y = (target / candidates.std).ravel()
    left = y - basis @ (basis.T @ y)
    size = np.sum(left.reshape(-1, n) ** 2, axis=0)
    found = []
    for i, j in pairwise(range(n)):
        if candidates.linear[i] != candidates.linear[j] or (i, j) in candidates.coupled:
            continue
        for weight in (1.0, -1.0):
            terms = drives.coupled(i, j, float(candidates.v0[j]), f"{i + 1}.{j + 1}", weight)
            columns = np.zeros((len(terms), n, len(target)))
            drives.fill(terms, columns, [*motion, None], np.zeros((0, len(target))))
            white = (factors / candidates.std)[:, :, None]
            seen = (columns.transpose(2, 1, 0) * white).reshape(-1, len(terms))
            seen -= basis @ (basis.T @ seen)
            rest = left - seen @ np.linalg.lstsq(seen, left, rcond=None)[0]
            explained = float((left @ left - rest @ rest) / max(size[[i, j]].sum(), 1e-300))
            if explained > min_explained:
                found.append((explained, terms))
    taken: list[DriveTerm] = []
    for _, terms in sorted(found, key=lambda one: -one[0]):
        if not {row for one in taken for row in _joints(one)} & set(_joints(terms[0])):
            taken += [replace(one, linear=bool(candidates.linear[_joints(one)[0]])) for one in terms]
    return taken


def _sampled(candidates: FrictionCandidates) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[np.ndarray]]:
    """Return about `coupling_rows` training rows, weighed, (M, n, b) and (M, n), their weights, and q, v, a (n, M)."""
    parts = []
    for part, case in zip(candidates.rows, candidates.cases):
        own = kept(case.motion.segment, candidates.decimator)
        used = part.present.all(axis=1)
        weighed = part.matrix * part.weight[:, :, None], part.target * part.weight, part.weight
        parts.append([x[used] for x in (*weighed, *(getattr(case.motion, key)[own] for key in "qva"))])
    matrix, target, weight, *motion = (np.concatenate(series) for series in zip(*parts))
    coupling_rows = 3000  # of the rows that couplings are sought in, about
    every = slice(None, None, max(1, len(target) // coupling_rows))
    return matrix[every], target[every], weight[every], [series[every].T for series in motion]


def _cross_validation(
    candidates: FrictionCandidates, offered: dict[str, list[DriveTerm]], every: list[DriveTerm]
) -> tuple[CrossValidation, dict[str, list[int]]]:
    """Return the cross-validation of base and all candidate columns, and the column indices of each step."""
    rows = [
        part.extend(every, observe_terms(every, case, candidates.decimator, load, candidates.torque_rows))
        for part, case, load in zip(candidates.rows, candidates.cases, candidates.loads)
    ]
    data, prior = triangulate(rows), candidates.prior
    base = data.parameters - len(every)
    kinds = [(name, _joints(one)) for name, terms in offered.items() for one in terms]
    steps = np.cumsum([one != other for one, other in pairwise(kinds[:1] + kinds)])  # a ridge per step and joints
    group = np.concatenate([np.full(base, -1), steps]).astype(int)
    place = {own: [base + k for k, (name, _) in enumerate(kinds) if name == own] for own in offered}
    blocks = 1 + max(int(part.block.max(initial=-1)) for part in rows)
    return CrossValidation(
        data,
        rows[0].target.shape[1],
        blocks,
        candidates.std,
        candidates.inflation,
        group,
        prior and np.sqrt(TEMPERING) * prior.widened(len(every)),
        regimes(rows, candidates.cases, candidates.decimator),
    ), place
