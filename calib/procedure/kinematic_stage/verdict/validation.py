"""Errors of both arms on fitted rows and validation rows, and the verdict that follows from the errors.

`assess` computes errors and verdict in the same way for a new fit and for a fit read from its folder. The limits and
sentences of the verdict's rules are in the catalogue of findings, chapter 4.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from operator import attrgetter
from pathlib import Path

import numpy as np

from calib.errors import Finding, finding, listing
from calib.geometry.checks.file_change import changed_since_fit
from calib.geometry.checks.joint_range import JointRange
from calib.geometry.error_model import ErrorModel
from calib.geometry.fit import without_corrections
from calib.geometry.installation import Installation
from calib.geometry.model_choice.ladder import MIN_GAIN
from calib.geometry.static_torques.load_check import suspected_load
from calib.geometry.static_torques.sources import load_changes
from calib.geometry.weighing import Settings
from calib.procedure.findings import NOT_JUDGED, Verdict, catalogue, level_of, limit, lines_of, sentence
from calib.procedure.kinematic_stage.inputs import Inputs
from calib.procedure.kinematic_stage.metrics import Findings, ValidationMetrics
from calib.procedure.kinematic_stage.settings import FitSettings
from calib.procedure.kinematic_stage.verdict.comparison import Comparison, compare, compare_unseen
from calib.procedure.kinematic_stage.verdict.contradictions import (
    TINY,
    contradicted,
    expected_error,
    far_above_median,
    far_off_with_both_arms,
    small_files,
)
from calib.procedure.kinematic_stage.verdict.plausibility import FLOOR, TOO_GOOD
from calib.robot.chain import Chain

# ratio of errors from which the calibrated arm is the worse one
WORSE = limit("worse-than-nominal", "times")
# codes of findings: no rigid geometry explains the measurements
RIGID = ("rigid-misfit", "gross-rows", "earlier-misfit")
# nominal errors this many times the fit's: the instrument must have stood elsewhere (our choice)
ELSEWHERE = 20.0
# share of errors that the fit states to be within the intervals
NOMINAL_COVERAGE = 0.95
# name of each deliverable in messages
ARM = {"urdf": "calibrated", "corrections": "with joint corrections"}


@dataclass(frozen=True)
class _Proof:
    """Errors on which a verdict is based.

    Attributes:
        before, after: rms errors of the nominal and of the calibrated arm [m].
        where: text on the source of the errors.
        rows: the rows with these errors; None for cross-validation.
    """

    before: float
    after: float
    where: str
    rows: Comparison | None = None

    @property
    def ratio(self) -> float:
        """Error of the calibrated arm divided by the error of the nominal arm."""
        return self.after / max(self.before, TINY)


def judge(
    fit: Comparison,
    validation: Mapping[str, Comparison],
    findings: Findings,
    *,
    requested_model: str = "auto",
    tolerance: float | None = None,
    cross_validated: float | None = None,
    arm: str = "",
) -> Verdict:
    """Return the verdict on a calibration from its validation rows; without such rows, from cross-validation.

    The first group of rules that yields a finding decides; within a group, the worst finding decides:

    1. ``placed-elsewhere``, ``far-off``; ``orientations-off``; ``above-tolerance``;
    2. if only frames were requested: the tolerance, or ``frames-only`` (not judged) without a tolerance;
    3. if the calibrated arm is as good as the nominal one (within `MIN_GAIN`): ``nothing-to-gain`` (pass) if the
       error is below `FLOOR` times the reach, ``transfer-untested`` if no station could be held out as a whole,
       otherwise ``no-better-model``; also a pass if the nominal arm's error is smaller than any instrument's
       (`TOO_GOOD`);
    4. ``worse-than-nominal``; from cross-validation only, if both errors are below `FLOOR` times the reach,
       ``keep-nominal``, since the nominal arm may have been fitted to these rows;
    5. ``no-unseen-poses``;
    6. ``rigid-misfit`` or ``gross-rows`` of the fit, ``refuted``, ``contradicted``, ``no-transfer``,
       ``intervals-too-narrow``, ``corrections-worse``, ``small-gain``, ``many-outliers``; without any of them: pass.

    Three kinds of findings count in every group: the other findings on the fit (`plausibility` beside this module),
    ``gross-unseen-rows``, which replaces ``refuted``, and those on files that prove nothing, but may contradict the
    fit: ``few-unseen-poses`` (fewer than `MIN_UNSEEN` poses), ``placement-takes-all`` (few numbers beside the fitted
    placement), and ``contradicted``. Their gross rows are named, and do not contradict it.

    Args:
        fit: errors of both arms on the fitted rows.
        validation: name of a validation file -> errors of both arms.
        findings: warnings and notes on the fit.
        requested_model: the model in the settings, or auto.
        tolerance: largest acceptable rms on held-out poses [m]; None if not stated.
        cross_validated: cross-validated error of the deliverable [m]; None if not computed.
        arm: name of the deliverable if there are several; otherwise empty.
    """
    unseen = {name: comparison for name, comparison in validation.items() if comparison.decides}
    promised = expected_error(fit, cross_validated)
    few = [*small_files(fit, validation, promised), *_gross_of_few(validation, findings.reach)]
    small = {name: rows for name, rows in validation.items() if rows.may_contradict}
    few += filter(level_of, contradicted(fit, small, promised))
    nominal_rms = fit.errors[0].rms
    fitted_rms = fit.errors[1].rms
    frames_only = findings.model == requested_model == "frames"

    # The errors to judge by: on unseen rows, else by cross-validation, else on the fitted rows.
    proofs = []
    for name, comparison in unseen.items():
        nominal, calibrated = comparison.errors
        proofs.append(_Proof(nominal.rms, calibrated.rms, f"on {name}, unseen", comparison))
    if findings.nominal_cross_validated is not None:
        nominal_rms = findings.nominal_cross_validated
    if not proofs and cross_validated is not None:
        where = "by cross-validation only"
        if few and all(level_of(note) == "note" for note in few):
            counts = [f"{name} {rows.few or rows.poses} of {rows.least_poses}" for name, rows in small.items()]
            where += f" (too few unseen poses: {listing(counts, 2)})"
        proofs = [_Proof(nominal_rms, cross_validated, where)]
    if not proofs and frames_only:
        # so few parameters leave the errors on the fitted poses as they are
        proofs = [_Proof(nominal_rms, fitted_rms, "on the fitted poses")]
    worst = max(proofs, key=attrgetter("after"), default=None)

    gross: list[Finding] = []
    for proof in proofs:
        gross += filter(level_of, _gross(proof, findings.reach))
    common = [*gross, *few, *(noticed for noticed in findings.noticed if noticed.code not in RIGID)]

    # orientations contradict the fit on few poses, too
    sets = {"the fitted poses": fit} | {name: rows for name, rows in validation.items() if rows.proves}
    # The first group of rules that says something decides.
    groups: list[Iterable[Finding]] = [_far_off(proofs, sets, tolerance, findings.reach)]
    if not frames_only:
        groups.append(_nothing_gained(proofs, findings))
    groups.append(_worse(proofs, findings.reach))
    for rules in groups:
        group = list(filter(level_of, rules))
        if not group:
            continue
        if level_of(group[0]) == "note":
            # the note stands for the figures
            return Verdict.of(sentence(group[0]), common)
        figures = "" if worst is None else _figures(worst, arm)
        return Verdict.of(figures, [*common, *group])
    if worst is None:
        return Verdict.of("", [finding("no-unseen-poses"), *common])
    if frames_only:
        return _frames_verdict(worst, fitted_rms, tolerance, arm, common)

    # Grossly wrong unseen rows refute no promise of the fit.
    if gross:
        cross_validated = None
    doubts = _doubts(worst, fit, cross_validated, promised, unseen, findings)
    verdict = Verdict.of(_figures(worst, arm), [*gross, *few, *findings.noticed, *doubts])
    if verdict.level == "pass":
        return Verdict("pass", _figures(worst, arm, tolerance))
    return verdict


def _gross_of_few(validation: Mapping[str, Comparison], reach: float) -> Iterator[Finding]:
    """Yield the findings of `_gross` on validation files that prove nothing, but may contradict the fit.

    Args:
        validation: name of a validation file -> errors of both arms.
        reach: reach of the arm [m].
    """
    for name, rows in validation.items():
        if rows.may_contradict:
            nominal, calibrated = rows.errors
            yield from filter(level_of, _gross(_Proof(nominal.rms, calibrated.rms, name, rows), reach))


def _frames_verdict(
    worst: _Proof, fitted_rms: float, tolerance: float | None, arm: str, findings: Sequence[Finding]
) -> Verdict:
    """Return the verdict if only base and tool placement (frames) were fitted.

    With a tolerance it is pass or follows from the findings; without a tolerance it is not judged.

    Args:
        worst: the errors on which the verdict is based.
        fitted_rms: rms error on the fitted poses [m].
        tolerance: largest acceptable rms on held-out poses [m]; None if not stated.
        arm: name of the deliverable if there are several; otherwise empty.
        findings: findings on these errors.
    """
    if tolerance is not None:
        above = finding("fitted-above-tolerance", rms=fitted_rms, tolerance=tolerance, times=fitted_rms / tolerance)
        return Verdict.of(_figures(worst, arm, tolerance), [*findings, above])
    verdict = Verdict.of(sentence(finding("frames-only", rms=worst.after, where=worst.where)), findings)
    if verdict.level == "pass":
        return replace(verdict, level=NOT_JUDGED)
    return verdict


def _figures(worst: _Proof, arm: str, tolerance: float | None = None) -> str:
    """Return a sentence with the errors of the nominal and the calibrated arm on which a verdict is based.

    Args:
        worst: the errors on which the verdict is based.
        arm: name of the deliverable if there are several; otherwise empty.
        tolerance: largest acceptable rms on held-out poses [m]; None if not stated.
    """
    before = worst.before
    if before == worst.after:
        # the arm was not changed
        before = None
    return sentence(
        finding("errors", after=worst.after, before=before, where=worst.where, arm=arm, tolerance=tolerance)
    )


def _far_off(
    proofs: Sequence[_Proof], sets: Mapping[str, Comparison], tolerance: float | None, reach: float
) -> Iterator[Finding]:
    """Yield findings on large errors: of both arms (moved instrument or another robot), or above the tolerance.

    Position errors are those in `proofs`; orientation errors are those of all `sets` of rows.

    Args:
        proofs: rms position errors on which the verdict is based.
        sets: name of a set of rows -> errors, of which orientation errors are used.
        tolerance: largest acceptable rms position error [m]; None if not stated.
        reach: reach of the arm [m].
    """
    for proof in proofs:
        if proof.rows is not None:
            code = "far-off"
            if proof.rows.shares_frames:
                code = "placed-elsewhere"
            yield finding(code, share=min(proof.before, proof.after) / reach)
    for name, rows in sets.items():
        angle = rows.errors[1].orientation
        if angle is not None:
            yield finding("orientations-off", where=name, angle=float(np.sqrt(np.mean(angle**2))))
    if tolerance is not None:
        for proof in proofs:
            yield finding("above-tolerance", tolerance=tolerance, times=proof.after / tolerance)


def _gross(proof: _Proof, reach: float) -> Iterator[Finding]:
    """Yield a finding if a few rows with large errors of both arms dominate the rms.

    These rows are probably wrong measurements.

    Args:
        proof: the errors.
        reach: reach of the arm [m].
    """
    if proof.rows is None:
        return
    after = proof.rows.errors[1].main
    gross = far_off_with_both_arms(proof.rows)
    rows = _row_texts(proof.rows, gross)
    # errors of zero are of rows that determine themselves, such as three points of a plane
    if rows and np.any(after[~gross]):
        without = float(np.sqrt(np.mean(after[~gross] ** 2)))
        share = min(proof.before, proof.after) / reach
        yield finding("gross-unseen-rows", rows=rows, without=without, times=proof.after / without, share=share)


def _row_texts(comparison: Comparison, selected: np.ndarray) -> list[str]:
    """Return number and error of the selected rows as text.

    An empty list if errors do not belong to single rows.

    Args:
        comparison: errors on the rows.
        selected: (m,) flags of the selected rows.
    """
    numbers = [int(row) for block in comparison.blocks for row in block.rows]
    sizes = comparison.errors[1].main
    if len(numbers) != len(selected):
        return []
    return [f"row {numbers[k]} ({1e3 * sizes[k]:.3g} mm)" for k in np.flatnonzero(selected)]


def _nothing_gained(proofs: Sequence[_Proof], findings: Findings) -> list[Finding]:
    """Return a finding if the calibrated arm is as good as the nominal one; otherwise an empty list.

    The finding states that there is nothing to gain, or that no better model was found.

    Args:
        proofs: errors on which the verdict is based.
        findings: warnings and notes on the fit.
    """
    if not proofs:
        return []
    proof = max(proofs, key=attrgetter("before"))
    nothing_to_gain = finding("nothing-to-gain", before=proof.before, where=proof.where)
    if proof.before < TOO_GOOD:
        return [nothing_to_gain]
    as_good = all(1.0 - MIN_GAIN < proof.ratio <= WORSE for proof in proofs)
    if not as_good or not np.isfinite(findings.reach):
        return []
    if proof.before > FLOOR * findings.reach:
        return [finding("no-better-model")]
    if findings.blind:
        return [finding("transfer-untested", stations=findings.blind)]
    return [nothing_to_gain]


def _worse(proofs: Sequence[_Proof], reach: float) -> list[Finding]:
    """Return findings if the calibrated arm is worse than the nominal one; otherwise an empty list.

    Args:
        proofs: errors on which the verdict is based.
        reach: reach of the arm [m].
    """
    rules = [finding("worse-than-nominal", times=proof.ratio) for proof in proofs]
    worse = list(filter(level_of, rules))
    if worse and proofs[0].rows is None and proofs[0].after <= FLOOR * reach < np.inf:
        return [finding("keep-nominal")]
    return worse


def _doubts(
    worst: _Proof,
    fit: Comparison,
    cross_validated: float | None,
    promised: float,
    unseen: Mapping[str, Comparison],
    findings: Findings,
) -> Iterator[Finding]:
    """Yield the findings of the last group of rules: doubts about the calibrated arm.

    They are on missing transfer to held-out rows, narrow intervals, small gain, and outliers.

    Args:
        worst: the largest errors on which the verdict is based.
        fit: errors of both arms on the fitted rows.
        cross_validated: cross-validated error [m]; None if not computed, or if grossly wrong rows may not refute it.
        promised: error that the fit leads to expect [m].
        unseen: name of a validation file -> errors of both arms.
        findings: warnings and notes on the fit.
    """
    times = worst.after / max(fit.errors[1].rms, TINY)
    errors_of = "on unseen poses"
    if not unseen:
        errors_of = "by cross-validation"
    remedy = ""
    if any(rows.shares_frames for rows in unseen.values()):
        remedy = catalogue()["placed-elsewhere"].advice
    rigid_explains = not any(noticed.code in RIGID for noticed in findings.noticed)
    if unseen and cross_validated is not None and rigid_explains:
        times_promised = worst.after / max(cross_validated, TINY)
        yield finding("refuted", times=times, promised=times_promised, left=worst.ratio, remedy=remedy)
    yield from contradicted(fit, unseen, promised)
    yield finding("no-transfer", times=times, errors=errors_of, remedy=remedy)
    for name, rows in unseen.items():
        if rows.intervals is None:
            continue
        count = len(rows.intervals.size)
        covered = rows.intervals.covered
        # three standard deviations of the share of a binomial distribution
        chance = 3.0 * float(np.sqrt(NOMINAL_COVERAGE * 0.05 / count))
        yield finding(
            "intervals-too-narrow",
            where=name,
            errors=count,
            covered=covered,
            median=np.median(rows.intervals.radius),
            missing=NOMINAL_COVERAGE - chance - covered,
        )
    yield from _corrections_worse(unseen)
    yield finding("small-gain", left=worst.ratio)
    if not unseen and findings.model != "frames":
        yield from _no_better_known(findings.joint_range)
    yield finding("many-outliers", share=findings.outlier_share)


def _corrections_worse(unseen: Mapping[str, Comparison]) -> Iterator[Finding]:
    """Yield findings that compare the arm with joint corrections with the rigid one, which is simpler.

    Args:
        unseen: name of a validation file -> errors of both arms.
    """
    for name, rows in unseen.items():
        if rows.alone is None:
            continue
        corrected, rigid = rows.errors[1].rms, rows.alone.rms
        times = corrected / max(rigid, TINY)
        yield finding("corrections-worse", times=times, where=name, corrected=corrected, rigid=rigid)


def _no_better_known(measured_range: JointRange | None) -> Iterator[Finding]:
    """Yield a finding on σ of the target over the joints' whole range, compared with what the fit corrects there.

    Args:
        measured_range: the measured range of the joints, with both; None if unknown.
    """
    if measured_range is None or measured_range.sigma is None or measured_range.nominal is None:
        return
    sigma, correction = measured_range.sigma, measured_range.nominal
    yield finding("no-better-known", sigma=sigma, correction=correction, doubt=sigma / max(correction, TINY))


@dataclass(frozen=True, eq=False)
class Arms:
    """The arms whose errors are compared.

    Attributes:
        nominal, calibrated: nominal and calibrated installation, with frames fitted to the fitted rows.
        rigid: best geometry without joint corrections.
        expected: error model of the calibrated arm; None: no error model.
        plain: plain reference; None: no plain reference.
    """

    nominal: Installation
    calibrated: Installation
    rigid: Chain
    expected: ErrorModel | None = None
    plain: Installation | None = None


@dataclass(frozen=True, eq=False)
class Assessment:
    """Errors of both arms on the same rows, and the verdict.

    Attributes:
        fit: errors on the fitted rows.
        validation: name of a validation file -> errors on its rows.
        verdict: verdict on the requested deliverable, with its reason.
        noticed: findings on the fit and on the held-out rows, worst first.
        notes: remarks from reading the files, as text.
        deliverables: verdict on each existing deliverable (`DELIVERABLES`).
        deliverable: name of the deliverable to which `verdict` applies.
    """

    fit: Comparison
    validation: Mapping[str, Comparison]
    verdict: Verdict
    noticed: tuple[Finding, ...]
    notes: tuple[str, ...]
    deliverables: Mapping[str, Verdict]
    deliverable: str

    @property
    def warnings(self) -> tuple[str, ...]:
        """Texts of findings and remarks for the user, worst first."""
        return tuple(dict.fromkeys((*lines_of(self.noticed), *self.notes)))

    @property
    def record(self) -> ValidationMetrics:
        """Errors on validation rows, verdict and warnings, in the form of ``metrics.json``."""
        rows = {name: comparison.record() for name, comparison in self.validation.items()}
        return ValidationMetrics(
            validation=rows,
            verdict=self.verdict.level,
            reason=self.verdict.reason,
            code=self.verdict.code,
            advice=self.verdict.advice,
            warnings=self.warnings,
            noticed=self.noticed,
            deliverables=self.deliverables,
            deliverable=self.deliverable,
        )


def assess(arms: Arms, inputs: Inputs, findings: Findings, weighing: Settings, settings: FitSettings) -> Assessment:
    """Return the errors of both arms on fitted and validation rows, and the verdict.

    Args:
        arms: the arms to compare.
        inputs: the rows.
        findings: warnings and notes on the fit.
        weighing: requested settings of the loss function; the loss that the fit chose replaces the requested one.
        settings: the requested model, tolerance, deliverable, and the seed of the pairs whose distances are compared.
    """
    weighing = weighing.with_loss(findings.loss or weighing.loss)
    cells = [arms.nominal, arms.calibrated]
    urdf_cell = without_corrections(arms.calibrated, arms.rigid, inputs.fit, weighing)
    if urdf_cell is not None:
        cells.append(urdf_cell)
    fitted = compare(cells, inputs.fit, "fitted on these rows", False, settings.seed)
    validation = {}
    for name, unseen in inputs.unseen.items():
        validation[name] = compare_unseen(cells, unseen, weighing, settings.seed, arms.expected, arms.plain)
    verdicts = judge_deliverables(fitted, validation, findings, settings)
    deliverable = settings.deliverable
    if deliverable not in verdicts:
        deliverable = "urdf"

    noticed: list[Finding] = []
    for name in verdicts.keys() - {deliverable}:
        rms = _worst_rms(validation, findings, name)
        noticed.append(finding("other-deliverable", arm=ARM[name], rms=rms, level=verdicts[name].level))
    frames_only = findings.model == (settings.model or "auto") == "frames"
    for name, rows in validation.items():
        noticed += filter(level_of, _references(name, rows, deliverable, frames_only))
    noticed += findings.noticed
    noticed += inputs.noticed
    if deliverable == "urdf" and fitted.alone is not None:
        of_urdf = {name: rows.of_urdf for name, rows in validation.items()}
        promised = expected_error(fitted.of_urdf, findings.rigid_cross_validated)
        noticed += small_files(fitted, of_urdf, promised)
    else:
        noticed += small_files(fitted, validation, expected_error(fitted, findings.cross_validated))
    noticed += load_changes(inputs.fit, [rows.block for rows in inputs.unseen.values()])
    copies = _copies(inputs)
    if copies:
        noticed.append(finding("not-unseen", files=copies))
    fitted_files = {block.file for block in inputs.fit}
    usual = np.inf
    if len(fitted.errors[0].main):
        usual = float(np.median(fitted.errors[0].main))
    for name, rows in validation.items():
        noticed += _noticed(name, rows, usual)
        if rows.proves:
            noticed += filter(None, [suspected_load(rows.cells[1], block) for block in rows.blocks])
        others = [block for block in rows.blocks if block.file not in fitted_files]
        if rows.shares_frames and rows.proves and others:
            noticed += changed_since_fit(rows.cells[1], others, fitted.errors[1].rms)

    notes = [*inputs.notes]
    for block in inputs.fit:
        notes += block.notes
    for unseen in inputs.unseen.values():
        notes += unseen.block.notes
    return Assessment(
        fit=fitted,
        validation=validation,
        verdict=verdicts[deliverable],
        noticed=tuple(noticed),
        notes=tuple(notes),
        deliverables=verdicts,
        deliverable=deliverable,
    )


def _references(name: str, rows: Comparison, deliverable: str, frames_only: bool) -> Iterator[Finding]:
    """Yield findings on validation rows that compare the deliverable with the nominal arm and the plain reference.

    Args:
        name: name of the validation file.
        rows: errors on its rows.
        deliverable: ``urdf`` or ``corrections``.
        frames_only: whether only base and tool placement were fitted; then the plain reference is no measure.
    """
    if rows.plain is None or not rows.proves:
        return
    delivered = rows.errors[1].rms
    if deliverable == "urdf":
        delivered = rows.of_urdf.errors[1].rms
    plain = rows.plain.rms
    yield finding("plain-reference", nominal=rows.errors[0].rms, where=name, plain=plain, delivered=delivered)
    if not frames_only:
        times = delivered / max(plain, TINY)
        yield finding("worse-than-plain", times=times, where=name, plain=plain, delivered=delivered)


def judge_deliverables(
    fit: Comparison, validation: Mapping[str, Comparison], findings: Findings, settings: FitSettings
) -> dict[str, Verdict]:
    """Return the verdict on each deliverable: ``urdf`` (robot.urdf alone), and, if fitted, ``corrections``.

    Args:
        fit: errors of both arms on the fitted rows.
        validation: name of a validation file -> errors of both arms.
        findings: warnings and notes on the fit.
        settings: the requested model and tolerance.
    """
    model = settings.model or "auto"
    judge_arm = partial(judge, findings=findings, requested_model=model, tolerance=settings.tolerance)
    if fit.alone is None:
        return {"urdf": judge_arm(fit, validation, cross_validated=findings.cross_validated)}
    urdf_rows = {name: rows.of_urdf for name, rows in validation.items()}
    rigid = findings.rigid_cross_validated
    return {
        "urdf": judge_arm(fit.of_urdf, urdf_rows, cross_validated=rigid, arm=ARM["urdf"]),
        "corrections": judge_arm(fit, validation, cross_validated=findings.cross_validated, arm=ARM["corrections"]),
    }


def _worst_rms(validation: Mapping[str, Comparison], findings: Findings, deliverable: str) -> float:
    """Return the largest rms error [m] of a deliverable on validation rows.

    Without such rows, it is the cross-validated error; NaN if neither is known.

    Args:
        validation: name of a validation file -> errors of both arms.
        findings: findings on the fit with the cross-validated errors.
        deliverable: ``urdf`` or ``corrections``.
    """
    comparisons = [rows for rows in validation.values() if rows.decides]
    cross_validated = findings.cross_validated
    if deliverable == "urdf":
        comparisons = [rows.of_urdf for rows in comparisons]
        cross_validated = findings.rigid_cross_validated
    if comparisons:
        return max(rows.errors[1].rms for rows in comparisons)
    if cross_validated is None:
        return np.nan
    return cross_validated


def _copies(inputs: Inputs) -> list[str]:
    """Return a text for each validation file that contains fitted rows.

    Args:
        inputs: robot and measurements.
    """
    notes = []
    for name, unseen in inputs.unseen.items():
        if not unseen.seen:
            continue
        original = ""
        for block in inputs.fit:
            same_joints = np.array_equal(block.q, unseen.block.q)
            if same_joints and np.array_equal(block.measured, unseen.block.measured):
                original = Path(block.file).name
                break
        if not original:
            notes.append(f"{name} repeats rows of the fit")
        elif original == name:
            notes.append(f"{name} was fitted on")
        else:
            notes.append(f"{name} is a copy of {original}")
    return notes


def _noticed(name: str, rows: Comparison, usual: float) -> Iterator[Finding]:
    """Yield findings on one set of validation rows: moved instrument, doubtful rows, placement, intervals.

    The instrument may have moved if the nominal arm's errors are far above the usual ones. Doubtful rows may be wrong
    measurements. The placement of base and tool may not have converged, or may have absorbed most of the errors. The
    last finding states the share of errors within the 95 % intervals.

    Args:
        name: name of the validation file.
        rows: errors on the rows.
        usual: median error of the nominal arm on the fitted rows [m].
    """
    before = rows.errors[0].main
    sizes = rows.errors[1].main
    intervals = rows.intervals
    if np.median(before) > ELSEWHERE * usual:
        yield finding("validation-elsewhere", file=name, rms=float(np.median(before)))
    doubtful = far_above_median(sizes)
    doubtful_rows = _row_texts(rows, doubtful)
    if doubtful_rows:
        outside = 0
        if intervals is not None:
            outside = int(np.count_nonzero(intervals.beyond[doubtful]))
        yield finding(
            "doubtful-rows",
            file=name,
            rows=doubtful_rows,
            median=np.median(sizes),
            without=float(np.sqrt(np.mean(sizes[~doubtful] ** 2))),
            outside=outside,
        )
    if not rows.settled:
        yield finding("placement-unsettled", file=name)
    elif rows.placed_by is None and intervals is not None:
        count = len(intervals.size)
        median = np.median(intervals.radius)
        yield finding("interval-coverage", file=name, covered=intervals.covered, errors=count, median=median)
        outside = int(intervals.beyond.sum())
        if outside:
            yield finding("outside-fitted-range", file=name, beyond=outside, poses=count, joints=intervals.joints)
