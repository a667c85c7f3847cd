"""Forward selection of friction terms ("ladder"), step by step and joint by joint, by the errors on held-out time.

    standard → + coupling → + the steps of `calib.dynamics.shapes.STEPS` in their order → + ripple

Every step is tested in addition to the accepted ones. All joints get the terms of the step, and every time block is
predicted by a fit to the other blocks. The terms are kept at joints whose error on held-out time falls by `MIN_GAIN`
and does not grow when one half of the time predicts the other (neighbouring blocks alone do not test extrapolation).
Terms of a step have a ridge per joint, determined by the evidence, so that a step with many terms may have more terms
than the data identify.

A coupling is a gear whose motor turns with two joints. It is a candidate for two neighbouring joints if it explains
most of the standard model's residual at both, and if the motion distinguishes it from the standard model. Cable torques
are candidates only if sensors behind the gears separate them from friction, or if the user requests them. A term is
judged by the torque rows that it affects, each in units of its residuals' standard deviation.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise

import numpy as np
import scipy.linalg

from calib.data.signals.filtering import Decimator, kept
from calib.dynamics import drives
from calib.dynamics.drives import DriveTerm
from calib.dynamics.shapes import STEPS, RecordedRange
from calib.dynamics.torque_rows import MOTOR, TorqueRows
from calib.errors import UsageError, one_of
from calib.identification.earlier import CLEAR_GAIN, EarlierChoice
from calib.identification.prior import TEMPERING, Prior
from calib.identification.rows import Case, ObservationRows, observe_terms, triangulate
from calib.identification.time_folds import CrossValidation, regimes
from calib.records import Number, stored

MIN_GAIN = 0.02
"""Share by which a step has to lower a joint's rms error on unseen time (our choice)."""
MIN_BLOCKS_WON = 0.6
"""Share of time blocks on which the error has to fall (our choice)."""
MIN_SIGMA = 1e-9
"""σ of a term below which its ridge holds it at zero."""
MIN_EXPLAINED = 0.5
"""Share of two joints' squared residuals that a coupling has to explain to be offered (our choice).

A gear that two joints share leaves most of what the standard model cannot explain at both (measured 0.58 to 0.96);
pairs that share none have up to 0.33 where the motion tells it apart."""
MIN_DISTINCT = 0.1
"""Size of a coupling's columns beside those of the standard model, of their whole size, to be offered (our choice).

In a motion of one frequency each joint's torque can be made of any other's: 0.02 to 0.06 are left there, 0.34 to 0.94
where the coupling was real."""
COUPLING_ROWS = 3000
"""Rows in which couplings are sought, about."""


NAMES = ("auto", "standard", "coupling", *STEPS, "ripple")

Progress = Callable[[str], None]


@dataclass(frozen=True)
class FrictionTrial:
    """Result of one tested step of the friction selection.

    Attributes:
        model: name of the step, e.g. ``standard`` or ``+ load``.
        parameters: number of parameters of the model, all joints.
        cross_validated_percent: relative error on held-out time, over all rows [%].
        joints_percent: relative error on held-out time of each row [%].
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
    """Result of the forward selection of friction terms.

    Attributes:
        terms: the selected drive terms.
        groups: ridge group of each term.
        steps: the tested steps, in order.
        off: names of terms that the final fit's ridges set to zero; their rows of ``covariance.csv`` contain the
            smallest ridge, so that all other σ are those of a model without these terms.
    """

    terms: tuple[DriveTerm, ...]
    groups: tuple[int, ...]
    steps: tuple[FrictionTrial, ...]
    off: tuple[str, ...] = ()

    def fitted(self, sigma: np.ndarray) -> FrictionSelection:
        """Return the selection without the terms that the final fit switched off.

        Args:
            sigma: (k,) standard deviations of the selected terms' parameters in the final fit; zero if switched off.
        """
        off = []
        joints = {}
        for term, term_sigma in zip(self.terms, sigma, strict=True):
            if term_sigma < MIN_SIGMA:
                off.append(term.name)
            else:
                joints[term.name] = _joints(term)
        steps = []
        for step in self.steps:
            active = [joints[name] for name in step.terms if name in joints]
            at = tuple(1 + joint for joint in _flat(active))
            if step.terms and at != step.kept_at_joints:
                note = "" if at else "switched off by the final fit"
                step = replace(step, kept_at_joints=at, note=note)
            steps.append(step)
        return replace(self, steps=tuple(steps), off=tuple(off))

    @property
    def chosen(self) -> str:
        """Text on the steps that are part of the model: ``standard + load + stribeck``."""
        names = [step.model[2:] for step in self.steps if step.kept and step.model[0] == "+"]
        return " + ".join(["standard", *names])


@dataclass(frozen=True, eq=False)
class FrictionCandidates:
    """Input of the forward selection of friction.

    Attributes:
        cases: training recordings.
        rows: rows of these recordings in the base columns and standard drive terms, with time blocks numbered.
        loads: torques transmitted by the gears of each case (N, n), from a first fit; None if no term depends on them.
        decimator: filter of the rows.
        std, inflation: (rows,) standard deviation [N m or N] and variance inflation of the first fit's residuals.
        v0: (n,) smoothing of the Coulomb sign [rad/s or m/s].
        linear: (n,) whether each joint is prismatic.
        apart: indices of rows with a different unit, excluded from totals.
        prior: prior of the base parameters; None without one.
        torque_rows: kind of torques in the rows.
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
    candidates: FrictionCandidates,
    friction: str = "auto",
    progress: Progress | None = None,
    earlier: EarlierChoice | None = None,
) -> FrictionSelection:
    """Return the friction terms that reduce the error on held-out time, or all terms of a named step.

    Args:
        candidates: rows, and the data on which terms depend.
        friction: ``auto`` for the selection; ``standard`` or ``ripple`` for no terms
            (`calib.identification.friction.ripple` identifies ripple later); the name of a step for the terms of this
            step at all joints.
        progress: function that is called with a short text at each step; None: not called.
        earlier: choice of an earlier identification, whose terms are kept; None: none.

    Raises:
        UsageError: for an unknown name.
    """
    say = progress or (lambda message: None)
    one_of(friction, NAMES, "friction", UsageError)
    say("friction: columns")
    names = [friction] if friction in NAMES[2:-1] else []
    if friction == "auto":
        sensed = candidates.torque_rows.sensed
        names = [name for name in NAMES[2:-1] if sensed or name != "cable"]
    offered = {name: terms for name, terms in _terms(candidates, names).items() if terms or name == friction}
    carried = _carried(earlier)
    if earlier is not None:
        for name, terms in offered.items():
            offered[name] = [term for term in terms if term.name not in earlier.ridges]
        further = {name: terms for name, terms in offered.items() if terms}
        offered = {**carried, **further}
    all_terms = [term for terms in offered.values() for term in terms]
    validation, columns_of = _cross_validation(candidates, offered, all_terms)
    min_gain = MIN_GAIN if earlier is None else CLEAR_GAIN
    bench = _Bench(candidates, validation, all_terms, friction != "auto", min_gain)

    say("friction: standard")
    error = bench.errors([])
    joints = tuple(range(candidates.n))
    steps = [bench.trial("standard", [], error, joints)]
    selected = [column for name in carried for column in columns_of[name]]
    if selected:
        error = bench.errors(selected)
        kept_terms = [bench.term(column) for column in selected]
        at = _flat([_joints(term) for term in kept_terms])
        term_names = tuple(term.name for term in kept_terms)
        steps.append(bench.trial("+ earlier terms", selected, error, at, "carried on", term_names))
    waiting = [name for name in offered if name not in carried]
    for second_round in (False, True):
        refused = []
        for name in waiting:
            say(f"friction: {name}")
            columns = [column for column in columns_of[name] if column not in selected]
            accepted, accepted_error, at = bench.test(selected, columns, error)
            note = ""
            if not columns:
                note = "the residual of no joint shows a need for such terms: none tried"
            elif not at:
                note = "no improvement on held-out time: not used"
            if accepted:
                selected = [*selected, *accepted]
                error = accepted_error
                term_names = tuple(bench.term(column).name for column in accepted)
                steps.append(bench.trial(f"+ {name}", selected, error, at, note, term_names))
            else:
                tested = [*selected, *columns]
                steps.append(bench.trial(f"+ {name}", tested, bench.errors(tested), at, note))
                refused.append(name)
        if second_round or not selected or not refused:
            break
        # A step that was refused may pay beside a later one that was accepted.
        waiting = [name for name in refused if max(selected) > columns_of[name][0]]
    terms = tuple(bench.term(column) for column in selected)
    groups = tuple(validation.group[selected].tolist())
    return FrictionSelection(terms, groups, tuple(steps))


@dataclass(frozen=True, eq=False)
class _Bench:
    """Test of friction terms by cross-validation; the columns of all candidate terms follow the base columns.

    Attributes:
        candidates: rows, and the data on which terms depend.
        validation: cross-validation of the base columns and all terms.
        terms: all candidate terms.
        forced: whether terms are kept without a test.
        min_gain: share by which a step has to lower a joint's rms error on unseen time.
    """

    candidates: FrictionCandidates
    validation: CrossValidation
    terms: Sequence[DriveTerm]
    forced: bool
    min_gain: float

    def term(self, column: int) -> DriveTerm:
        """Return the drive term of a column."""
        first = self.validation.data.parameters - len(self.terms)
        return self.terms[column - first]

    def errors(self, columns: Sequence[int], folds: int | None = None) -> np.ndarray:
        """Return the squared errors (blocks, rows) of the model with the base columns and these further columns.

        Args:
            columns: indices of further columns, counted from the first base column.
            folds: number of folds of the cross-validation; None: each time block is one.
        """
        return self.validation.errors(self._with_base(columns), folds)

    def _with_base(self, columns: Sequence[int]) -> np.ndarray:
        base_count = self.validation.data.parameters - len(self.terms)
        return np.array([*range(base_count), *columns])

    def test(
        self, selected: list[int], columns: list[int], error: np.ndarray
    ) -> tuple[list[int], np.ndarray, tuple[int, ...]]:
        """Return the columns that pass the test, the squared errors of the model with these columns, and their joints.

        Args:
            selected: columns of the model so far.
            columns: columns to test.
            error: (blocks, rows) squared errors of the model so far.
        """
        if not columns:
            # A step that the settings name has no terms for this robot.
            return [], error, ()
        joints = {column: _joints(self.term(column)) for column in columns}
        at = tuple(sorted(set(joints.values())))
        if self.forced:
            return columns, self.errors([*selected, *columns]), _flat(at)

        side = self.term(columns[0]).side
        accepted = columns
        # Twice: the second time with the terms of those joints only at which they pay.
        for _ in range(2):
            model = [*selected, *accepted]
            new_error = self.errors(model)
            improved = []
            for joint_set in at:
                rows = self._rows(joint_set, side)
                pays = _pays(self._whitened(error, rows), self._whitened(new_error, rows), self.min_gain)
                # Halves and ranges take as long again, and most terms do not pay.
                if pays and self._carries(selected, model, rows) and self._extrapolates(selected, model, rows):
                    improved.append(joint_set)
            at = tuple(improved)
            tested = accepted
            accepted = [column for column in tested if joints[column] in at]
            if not accepted:
                return [], error, ()
            if accepted == tested:
                return accepted, new_error, _flat(at)
        return accepted, self.errors([*selected, *accepted]), _flat(at)

    def _carries(self, selected: Sequence[int], model: Sequence[int], rows: list[int]) -> bool:
        """Return whether the rms error of cross-validation with two halves grew by a share of at most `MIN_GAIN`.

        Args:
            selected, model: columns without and with the tested terms.
            rows: torque rows that the terms affect.
        """
        before = self._whitened(self.errors(selected, 2), rows)
        after = self._whitened(self.errors(model, 2), rows)
        return bool(after.sum() <= (1.0 + MIN_GAIN) ** 2 * before.sum())

    def _extrapolates(self, selected: Sequence[int], model: Sequence[int], rows: list[int]) -> bool:
        """Return whether the squared errors in held-out ranges of motion did not increase, in geometric mean.

        Args:
            selected, model: columns without and with the tested terms.
            rows: torque rows that the terms affect.
        """
        before = self._whitened(self.validation.extrapolated(self._with_base(selected)), rows)
        after = self._whitened(self.validation.extrapolated(self._with_base(model)), rows)
        positive = (before > 0.0) & (after > 0.0)
        if not positive.any():
            return True
        return bool(np.log(after[positive] / before[positive]).mean() <= 0.0)

    def _rows(self, joints: tuple[int, ...], side: str) -> list[int]:
        """Return the indices of the torque rows that terms of these joints affect, on one side of the gears.

        Args:
            joints: joints, from 0.
            side: ``link`` or ``motor``.
        """
        torque_rows = self.candidates.torque_rows
        rows: list[int] = []
        for joint in joints:
            rows += torque_rows.of_side(side, joint, self.candidates.n)
        return rows

    def _whitened(self, squares: np.ndarray, rows: list[int]) -> np.ndarray:
        """Return the squared errors (k,) of the given rows, each divided by its residual variance, summed.

        Args:
            squares: (k, all rows) squared errors.
            rows: indices of the rows.
        """
        relative = squares[:, rows] / self.validation.std[rows] ** 2
        return np.sum(relative, axis=1)

    def trial(
        self,
        name: str,
        columns: Sequence[int],
        error: np.ndarray,
        at: tuple[int, ...],
        note: str = "",
        terms: tuple[str, ...] = (),
    ) -> FrictionTrial:
        """Return the record of a tested step.

        Args:
            name: name of the step.
            columns: columns of the model besides the base columns.
            error: (blocks, rows) squared errors on held-out time.
            at: joints, from 0, at which the step is kept.
            note: remark on the step.
            terms: names of the terms that are kept.
        """
        blocks = self.validation.blocks
        rows = self.validation.rows
        target_squares = (self.validation.data.factors[:, :, -1] ** 2).sum(axis=1)
        squares = target_squares.reshape(-1, rows)
        # Σ τ² per row over the blocks that are held out.
        size = squares[:blocks].sum(axis=0)
        with np.errstate(divide="ignore", invalid="ignore"):
            percent = 100.0 * np.sqrt(error.sum(axis=0) / size)
        same_unit = np.setdiff1d(np.arange(len(size)), self.candidates.apart)
        share = error[:, same_unit].sum() / size[same_unit].sum()
        total = 100.0 * np.sqrt(share)
        joints_percent = tuple(np.nan_to_num(percent).tolist())
        kept_at_joints = tuple(1 + joint for joint in at)
        parameters = len(self._with_base(columns))
        cross_validated_percent = float(total)
        return FrictionTrial(name, parameters, cross_validated_percent, joints_percent, kept_at_joints, note, terms)


def _joints(term: DriveTerm) -> tuple[int, ...]:
    """Return the joints whose torques a term affects."""
    return tuple(sorted({row for row, _ in term.acts}))


def _flat(joint_sets: Sequence[tuple[int, ...]]) -> tuple[int, ...]:
    """Return the sorted union of sets of joints."""
    return tuple(sorted({joint for joint_set in joint_sets for joint in joint_set}))


def _pays(before: np.ndarray, after: np.ndarray, min_gain: float) -> bool:
    """Return whether the squared errors fell by a share of `min_gain` (rms), and in a share `MIN_BLOCKS_WON` of blocks.

    Args:
        before, after: squared errors per time block without and with the tested terms.
        min_gain: the share.
    """
    positive = before > 0.0
    if not positive.any():
        return False
    won = float(np.mean(after[positive] < before[positive]))
    decreased = after.sum() < (1.0 - min_gain) ** 2 * before.sum()
    return bool(decreased and won >= MIN_BLOCKS_WON)


def _carried(earlier: EarlierChoice | None) -> dict[str, list[DriveTerm]]:
    """Return the terms of an earlier choice, as a step for each of their ridge groups."""
    steps: dict[str, list[DriveTerm]] = {}
    if earlier is not None:
        for term, group in zip(earlier.terms, earlier.choice.groups, strict=True):
            steps.setdefault(f"earlier group {group}", []).append(term)
    return steps


def _terms(candidates: FrictionCandidates, names: Sequence[str]) -> dict[str, list[DriveTerm]]:
    """Return the candidate terms of each named step, for all joints.

    Args:
        candidates: rows, and the data on which terms depend.
        names: names of the steps.
    """
    terms: dict[str, list[DriveTerm]] = {name: [] for name in names}
    if "coupling" in terms:
        terms["coupling"] = _couplings(candidates)
    for joint in range(candidates.n):
        speeds = [np.abs(case.motion.v[:, joint]) for case in candidates.cases]
        speed = np.concatenate(speeds)
        position = np.concatenate([case.motion.q[:, joint] for case in candidates.cases])
        v0 = float(candidates.v0[joint])
        edge = float(np.quantile(speed, 0.98))
        fastest = float(speed.max())
        travel = float(np.ptp(position))
        joint_range = RecordedRange(v0, edge, fastest, travel)
        if joint_range.peak <= 0.0:
            continue
        for name in names:
            if name in STEPS:
                linear = bool(candidates.linear[joint])
                terms[name] += drives.offered(name, joint, joint_range, linear)
    return terms


def _couplings(candidates: FrictionCandidates) -> list[DriveTerm]:
    """Return coupling terms of neighbouring joints that explain residual torques of the standard model.

    A joint is in one coupling at most. Its motor turns with the sum or the difference of the joints, whichever explains
    more.

    Args:
        candidates: rows, and the data on which terms depend.
    """
    n = candidates.n
    if not candidates.torque_rows.motors_alone:
        return []
    matrix, target, weight, motion = _sampled(candidates)
    weighed = matrix / candidates.std[:, None]
    whitened = weighed.reshape(-1, matrix.shape[2])
    basis = np.asarray(scipy.linalg.qr(whitened, mode="economic")[0])
    torque = (target / candidates.std).ravel()
    residual = torque - basis @ (basis.T @ torque)
    residual_squares = np.sum(residual.reshape(-1, n) ** 2, axis=0)
    explaining = []
    for i, j in pairwise(range(n)):
        if candidates.linear[i] != candidates.linear[j] or (i, j) in candidates.coupled:
            continue
        for ratio in (1.0, -1.0):
            terms = drives.coupled(i, j, float(candidates.v0[j]), f"{i + 1}.{j + 1}", ratio)
            columns = np.zeros((len(terms), n, len(target)))
            no_values = np.zeros((0, len(target)))
            drives.fill(terms, columns, [*motion, None], no_values)
            row_weight = (weight / candidates.std)[:, :, None]
            weighed = columns.transpose(2, 1, 0) * row_weight
            white = weighed.reshape(-1, len(terms))
            size = np.linalg.norm(white)
            white -= basis @ (basis.T @ white)
            if np.linalg.norm(white) < MIN_DISTINCT * size:
                continue
            values = np.linalg.lstsq(white, residual, rcond=None)[0]
            remainder = residual - white @ values
            pair_squares = max(residual_squares[[i, j]].sum(), 1e-300)
            explained = float((residual @ residual - remainder @ remainder) / pair_squares)
            if explained > MIN_EXPLAINED:
                explaining.append((explained, terms))

    selected: list[DriveTerm] = []
    coupled_joints: set[int] = set()
    for _, terms in sorted(explaining, key=lambda entry: -entry[0]):
        if coupled_joints.isdisjoint(_joints(terms[0])):
            for term in terms:
                joint = _joints(term)[0]
                selected.append(replace(term, linear=bool(candidates.linear[joint])))
            for term in terms:
                coupled_joints.update(_joints(term))
    return selected


def _sampled(candidates: FrictionCandidates) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[np.ndarray]]:
    """Return about `COUPLING_ROWS` weighted samples of the recordings.

    Args:
        candidates: rows, and the data on which terms depend.

    Returns:
        regressor (M, n, b), torques (M, n), weights (M, n), and the list of q, v, a (n, M).
    """
    matrices = []
    targets = []
    weights = []
    motions = []
    for rows, case in zip(candidates.rows, candidates.cases):
        motion = case.motion
        index = kept(motion.segment, candidates.decimator)
        used = rows.present.all(axis=1)
        matrices.append((rows.matrix * rows.weight[:, :, None])[used])
        targets.append((rows.target * rows.weight)[used])
        weights.append(rows.weight[used])
        states = np.stack([motion.q[index], motion.v[index], motion.a[index]])
        motions.append(states[:, used])
    matrix = np.concatenate(matrices)
    target = np.concatenate(targets)
    weight = np.concatenate(weights)
    step = max(1, len(target) // COUPLING_ROWS)
    q, v, a = np.concatenate(motions, axis=1)[:, ::step]
    return matrix[::step], target[::step], weight[::step], [q.T, v.T, a.T]


def _cross_validation(
    candidates: FrictionCandidates, offered: dict[str, list[DriveTerm]], all_terms: list[DriveTerm]
) -> tuple[CrossValidation, dict[str, list[int]]]:
    """Return the cross-validation of base and all candidate columns, and the column indices of each step.

    Args:
        candidates: rows, and the data on which terms depend.
        offered: candidate terms of each step.
        all_terms: all candidate terms, in the order of the steps.
    """
    decimator, torque_rows = candidates.decimator, candidates.torque_rows
    rows = []
    for part, case, load in zip(candidates.rows, candidates.cases, candidates.loads):
        term_columns = observe_terms(all_terms, case, decimator, load, torque_rows)
        rows.append(part.extend(all_terms, term_columns))
    data = triangulate(rows)

    # A ridge per step and joints: the group's number grows where one of them changes.
    base_count = data.parameters - len(all_terms)
    groups = [-1] * base_count
    columns_of: dict[str, list[int]] = {}
    group = -1
    previous = None
    for name, terms in offered.items():
        columns_of[name] = []
        for term in terms:
            kind = (name, _joints(term))
            if kind != previous:
                group += 1
                previous = kind
            columns_of[name].append(len(groups))
            groups.append(group)
    prior_rows = None
    if candidates.prior is not None:
        prior_rows = np.sqrt(TEMPERING) * candidates.prior.widened(len(all_terms))
    blocks = 1 + max(int(part.block.max(initial=-1)) for part in rows)
    validation = CrossValidation(
        data,
        rows=rows[0].target.shape[1],
        blocks=blocks,
        std=candidates.std,
        inflation=candidates.inflation,
        group=np.array(groups),
        prior=prior_rows,
        regimes=partial(regimes, rows, candidates.cases, decimator),
    )
    return validation, columns_of
