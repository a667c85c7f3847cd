"""Errors of both arms on fitted rows and validation rows, and the verdict that follows from the errors.

`assess` returns the same result for a new fit and for one read from its folder.

The rules of the verdict have their limits and sentences in the catalogue of findings, chapter 4.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from calib.errors import Finding, finding
from calib.geometry.error_model import ErrorModel
from calib.geometry.fit import without_corrections
from calib.geometry.installation import Installation
from calib.geometry.model_choice.ladder import MIN_GAIN
from calib.geometry.weighing import Settings
from calib.procedure.findings import NOT_JUDGED, Verdict, catalogue, level_of, limit, lines_of, sentence
from calib.procedure.kinematic_stage.comparison import MARGIN, Comparison, compare, compare_unseen
from calib.procedure.kinematic_stage.inputs import Inputs
from calib.procedure.kinematic_stage.metrics import Findings, ValidationMetrics
from calib.procedure.kinematic_stage.plausibility import FLOOR, TOO_GOOD
from calib.procedure.kinematic_stage.settings import FitSettings
from calib.robot.chain import Chain

WORSE = limit("worse-than-nominal", "times")  # ratio of errors from which the calibrated arm is the worse one
RIGID = ("rigid-misfit", "gross-rows", "earlier-misfit")  # no rigid geometry explains the measurements


@dataclass(frozen=True)
class _Proof:
    """Errors on which the verdict on the arms is based: rms before and after [m], and the rows of these errors."""

    before: float
    after: float
    where: str
    rows: Comparison | None = None

    @property
    def left(self) -> float:
        """Ratio of the calibrated to the nominal arm's error."""
        return self.after / max(self.before, 1e-300)


def judge(
    fit: Comparison,
    validation: Mapping[str, Comparison],
    findings: Findings,
    *,
    asked: str = "auto",
    tolerance: float | None = None,
    cross_validated: float | None = None,
    arm: str = "",
) -> Verdict:
    """Return the verdict on a calibration from its validation rows; without such rows, from cross-validation.

    Rules, the first group that says something; inside a group the worst finding decides:

    1. ``placed-elsewhere``, ``far-off``; ``orientations-off``; ``above-tolerance``;
    2. where only frames were asked for: the tolerance, or ``frames-only`` (not judged) without one;
    3. the calibrated arm is as good as the nominal one (within `MIN_GAIN`). ``nothing-to-gain`` (pass) where what
       remains is below `FLOOR` of the reach, ``transfer-untested`` where stations could not be left out as a whole,
       else ``no-better-model``. A pass, too, where the nominal arm leaves less than any instrument (`TOO_GOOD`);
    4. ``worse-than-nominal``; by cross-validation alone, where both leave less than `FLOOR` of the reach,
       ``keep-nominal``, since the nominal arm may have been fitted to these very rows;
    5. ``no-unseen-poses``;
    6. ``rigid-misfit`` or ``gross-rows`` of the fit, ``refuted``, ``no-transfer``, ``intervals-too-narrow``,
       ``small-gain``, ``many-outliers``; none of them: pass.

    The fit's other findings, those of `calib.procedure.kinematic_stage.plausibility`, and ``gross-unseen-rows`` count
    in every group; with the latter there is no ``refuted``.

    Args:
        fit: both arms on the fit's rows.
        validation: both arms on other rows.
        findings: what the fit says of itself.
        asked: the model asked for.
        tolerance: largest rms on unseen poses that is good enough [m]; None where none was given.
        cross_validated: error of what is judged on held-out rows [m]; None where it was not computed.
        arm: what is judged, in a word or two, where there are several deliverables.
    """
    proofs = {name: comparison for name, comparison in validation.items() if comparison.proves}
    nominal, own = (each.rms for each in fit.errors)
    if findings.nominal_cross_validated is not None:
        nominal = findings.nominal_cross_validated
    found = [_Proof(one.errors[0].rms, one.errors[1].rms, f"on {name}, unseen", one) for name, one in proofs.items()]
    if not found and cross_validated is not None:
        found = [_Proof(nominal, cross_validated, "by cross-validation only")]
    frames_only = findings.model == asked == "frames"
    if not found and frames_only:
        # so few parameters leave the errors on the fitted poses as they are
        found = [_Proof(nominal, own, "on the fitted poses")]
    worst = max(found, key=lambda proof: proof.after, default=None)
    gross = [one for proof in found for one in _gross(proof, findings.reach) if level_of(one)]
    others = [*gross, *(one for one in findings.noticed if one.code not in RIGID)]
    for rules in (
        _far_off(found, {"the fitted poses": fit, **proofs}, tolerance, findings.reach),
        () if frames_only else _nothing_gained(found, findings),
        _worse(found, findings.reach),
    ):
        if group := list(filter(level_of, rules)):
            if level_of(group[0]) == "note":  # it stands for the figures
                return Verdict.of(sentence(group[0]), others)
            return Verdict.of("" if worst is None else _figures(worst, arm), [*others, *group])
    if worst is None:
        return Verdict.of("", [finding("no-unseen-poses"), *others])
    if frames_only:
        return _frames_verdict(worst, tolerance, arm, others)
    promised = None if gross else cross_validated
    rules = [*gross, *findings.noticed, *_doubts(worst, own, promised, proofs, findings)]
    verdict = Verdict.of(_figures(worst, arm), rules)
    return Verdict("pass", _figures(worst, arm, tolerance)) if verdict.level == "pass" else verdict


def _frames_verdict(worst: _Proof, tolerance: float | None, arm: str, others: Sequence[Finding]) -> Verdict:
    """Return the verdict where only frames were fitted and the arm errs within the tolerance, if there is one."""
    if tolerance is not None:
        return Verdict.of(_figures(worst, arm, tolerance), others)
    verdict = Verdict.of(sentence(finding("frames-only", rms=worst.after, where=worst.where)), others)
    return replace(verdict, level=NOT_JUDGED) if verdict.level == "pass" else verdict


def _figures(worst: _Proof, arm: str, tolerance: float | None = None) -> str:
    values = {"after": worst.after, "before": worst.before, "where": worst.where, "arm": arm, "tolerance": tolerance}
    return sentence(finding("errors", **values))


def _far_off(
    found: Sequence[_Proof], sets: Mapping[str, Comparison], tolerance: float | None, reach: float
) -> Iterator[Finding]:
    """Yield findings on files where both arms are far off (moved instrument or another robot), or above the tolerance.

    Orientations that are off, of all sets of rows, and errors above the tolerance.
    """
    for proof in found:
        if proof.rows is not None:
            code = "placed-elsewhere" if proof.rows.shares_frames else "far-off"
            yield finding(code, share=min(proof.before, proof.after) / reach)
    for name, rows in sets.items():
        if (angle := rows.errors[1].orientation) is not None:
            yield finding("orientations-off", where=name, angle=float(np.sqrt(np.mean(angle**2))))
    if tolerance is not None:
        for proof in found:
            yield finding("above-tolerance", tolerance=tolerance, times=proof.after / tolerance)


def _gross(proof: _Proof, reach: float) -> Iterator[Finding]:
    """Yield the finding that rows far off for both arms alike, probably measured wrongly, make most of the error."""
    if proof.rows is not None:
        before, after = (found.main for found in proof.rows.errors)
        if rows := _rows_off(proof.rows, far := _far(before) & _far(after)):
            left = float(np.sqrt(np.mean(after[~far] ** 2)))
            share = min(proof.before, proof.after) / reach
            yield finding("gross-unseen-rows", rows=rows, without=left, times=proof.after / left, share=share)


def _far(sizes: np.ndarray) -> np.ndarray:
    return sizes > OUTLIER_SIGMAS * np.median(sizes)


def _rows_off(rows: Comparison, far: np.ndarray) -> list[str]:
    """Return number and error of the rows (m,) that are far off; none where errors are not of single rows."""
    numbers, sizes = [int(row) for block in rows.blocks for row in block.rows], rows.errors[1].main
    if len(numbers) != len(far):
        return []
    return [f"row {numbers[k]} ({1e3 * sizes[k]:.3g} mm)" for k in np.flatnonzero(far)]


def _nothing_gained(found: Sequence[_Proof], findings: Findings) -> list[Finding]:
    """Return a finding where the calibrated arm is as good as the nominal one: nothing to gain, or no model helps."""
    if not found:
        return []
    proof = max(found, key=lambda proof: proof.before)
    nothing = [finding("nothing-to-gain", before=proof.before, where=proof.where)]
    if proof.before < TOO_GOOD:
        return nothing
    if any(not 1.0 - MIN_GAIN < proof.left <= WORSE for proof in found):
        return []
    if not np.isfinite(findings.reach):
        return []
    if proof.before > FLOOR * findings.reach:
        return [finding("no-better-model")]
    return [finding("transfer-untested", stations=findings.blind)] if findings.blind else nothing


def _worse(found: Sequence[_Proof], reach: float) -> list[Finding]:
    worse = [one for proof in found if level_of(one := finding("worse-than-nominal", times=proof.left))]
    if worse and found[0].rows is None and found[0].after <= FLOOR * reach < np.inf:
        return [finding("keep-nominal")]
    return worse


def _doubts(
    worst: _Proof, own: float, cross_validated: float | None, proofs: Mapping[str, Comparison], findings: Findings
) -> Iterator[Finding]:
    """Yield the remaining findings, worst first: no transfer, narrow intervals, small gain, outliers."""
    times = worst.after / max(own, 1e-300)
    shared = any(rows.shares_frames for rows in proofs.values())
    remedy = catalogue()["placed-elsewhere"].advice if shared else ""
    if proofs and cross_validated is not None and not any(one.code in RIGID for one in findings.noticed):
        promised = worst.after / max(cross_validated, 1e-300)
        yield finding("refuted", times=times, promised=promised, left=worst.left, remedy=remedy)
    yield finding("no-transfer", times=times, remedy=remedy)
    for name, rows in proofs.items():
        if (held := rows.intervals) is not None:
            chance = 3.0 * float(np.sqrt(0.95 * 0.05 / len(held.size)))
            yield finding(
                "intervals-too-narrow",
                where=name,
                errors=len(held.size),
                covered=held.covered,
                median=np.median(held.radius),
                missing=0.95 - chance - held.covered,
            )
    yield finding("small-gain", left=worst.left)
    yield finding("many-outliers", share=findings.outlier_share)


ELSEWHERE = 20.0  # nominal errors this many times the fit's: the instrument must have stood elsewhere (our choice)
OUTLIER_SIGMAS = 8.0  # our choice
ARM = {"urdf": "calibrated", "corrections": "with joint corrections"}  # words for what is delivered


@dataclass(frozen=True, eq=False)
class Arms:
    """Nominal and calibrated installation (frames fitted to the fitted rows), and the best rigid geometry.

    With the error model of the calibrated one, and the plain reference, where there are such.
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
        fit: on the fit's rows.
        validation: on unseen rows, by file name.
        verdict: on what is to be delivered, with its reason.
        noticed: findings on the fit and on the unseen rows, worst first.
        notes: what the reading of the files noticed, as text.
        deliverables: the verdict on each deliverable that there is (`DELIVERABLES`).
        deliverable: which of them `verdict` is about.
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
        """Warnings for the user, worst first."""
        return tuple(dict.fromkeys((*lines_of(self.noticed), *self.notes)))

    @property
    def record(self) -> ValidationMetrics:
        """Unseen rows, verdict and warnings, in the form of ``metrics.json``."""
        return ValidationMetrics(
            validation={name: comparison.record() for name, comparison in self.validation.items()},
            verdict=self.verdict.level,
            reason=self.verdict.reason,
            code=self.verdict.code,
            advice=self.verdict.advice,
            warnings=self.warnings,
            noticed=self.noticed,
            deliverables=self.deliverables,
            deliverable=self.deliverable,
        )


def assess(arms: Arms, inputs: Inputs, findings: Findings, settings: Settings, wanted: FitSettings) -> Assessment:
    """Return the errors of both arms on fitted and validation rows, and the verdict.

    Args:
        arms: what is compared.
        inputs: the rows.
        findings: what the fit says of itself.
        settings: of the fit, as asked for; the loss is the one that the fit chose.
        wanted: the model asked for, tolerance, deliverable, and the seed of the pairs whose distances are compared.
    """
    settings = replace(settings, loss=findings.loss or settings.loss)
    alone = without_corrections(arms.calibrated, arms.rigid, inputs.fit, settings)
    cells = [each for each in (arms.nominal, arms.calibrated, alone) if each is not None]
    fitted = compare(cells, inputs.fit, "fitted on these rows", False, wanted.seed)
    validation = {
        name: compare_unseen(cells, unseen, settings, wanted.seed, arms.expected, arms.plain)
        for name, unseen in inputs.unseen.items()
    }
    judged = judge_deliverables(fitted, validation, findings, wanted)
    chosen = wanted.deliverable if wanted.deliverable in judged else "urdf"
    others = [
        finding("other-deliverable", arm=ARM[other], rms=_worst(validation, findings, other), level=judged[other].level)
        for other in judged.keys() - {chosen}
    ]
    copies = _copies(inputs)
    usual = float(np.median(fitted.errors[0].main)) if len(fitted.errors[0].main) else np.inf
    frames_only = findings.model == (wanted.model or "auto") == "frames"
    references: list[Finding] = []
    for name, rows in validation.items():
        references += filter(level_of, _references(name, rows, chosen, frames_only))
    noticed = (
        *others,
        *references,
        *findings.noticed,
        *([finding("not-unseen", files=copies)] if copies else []),
        *(one for name, each in validation.items() for one in _noticed(name, each, usual)),
    )
    blocks = (*inputs.fit, *(unseen.block for unseen in inputs.unseen.values()))
    notes = (*inputs.notes, *(note for block in blocks for note in block.notes))
    return Assessment(fitted, validation, judged[chosen], noticed, notes, judged, chosen)


def _references(name: str, rows: Comparison, deliverable: str, frames_only: bool) -> Iterator[Finding]:
    """Yield the nominal arm's, the plain fit's and the delivered arm's error on validation rows, and what is worse."""
    if rows.plain is None or not rows.proves:
        return
    delivered = (rows.of_urdf if deliverable == "urdf" else rows).errors[1].rms
    values = {"where": name, "plain": rows.plain.rms, "delivered": delivered}
    yield finding("plain-reference", nominal=rows.errors[0].rms, **values)
    if not frames_only:
        yield finding("worse-than-plain", times=delivered / max(rows.plain.rms, 1e-300), **values)


def judge_deliverables(
    fit: Comparison, validation: Mapping[str, Comparison], findings: Findings, wanted: FitSettings
) -> dict[str, Verdict]:
    """Return the verdict on each deliverable: robot.urdf alone, and (if fitted) with joint corrections."""
    common = partial(judge, findings=findings, asked=wanted.model or "auto", tolerance=wanted.tolerance)
    if fit.alone is None:
        return {"urdf": common(fit, validation, cross_validated=findings.cross_validated)}
    bare = {name: each.of_urdf for name, each in validation.items()}
    return {
        "urdf": common(fit.of_urdf, bare, cross_validated=findings.rigid_cross_validated, arm=ARM["urdf"]),
        "corrections": common(fit, validation, cross_validated=findings.cross_validated, arm=ARM["corrections"]),
    }


def _worst(validation: Mapping[str, Comparison], findings: Findings, deliverable: str) -> float:
    """Return the largest rms error [m] of a deliverable on validation rows; without such rows, by cross-validation."""
    alone = deliverable == "urdf"
    sizes = [(each.of_urdf if alone else each).errors[1].rms for each in validation.values() if each.proves]
    by_folds = findings.rigid_cross_validated if alone else findings.cross_validated
    return max(sizes, default=np.nan if by_folds is None else by_folds)


def _copies(inputs: Inputs) -> list[str]:
    """Return a note for each validation file that contains fitted rows."""
    words = []
    for name, unseen in inputs.unseen.items():
        if unseen.seen:
            rows = unseen.block.q, unseen.block.measured
            own = next((Path(b.file).name for b in inputs.fit if all(map(np.array_equal, (b.q, b.measured), rows))), "")
            same = "was fitted on" if own == name else f"is a copy of {own}"
            words.append(f"{name} {same if own else 'repeats rows of the fit'}")
    return words


def _noticed(name: str, each: Comparison, usual: float) -> Iterator[Finding]:
    """Yield the findings on one set of validation rows: moved instrument, doubtful rows, frames, intervals.

    Errors that look like another placement of the instrument than the `usual` nominal ones [m], rows that may be wrong
    measurements, a placement of base and tool that did not settle or took up most of the errors, and how many errors
    are within the 95 % interval.
    """
    before, sizes = (found.main for found in each.errors)
    if np.median(before) > ELSEWHERE * usual:
        yield finding("validation-elsewhere", file=name, rms=float(np.median(before)))
    if rows := _rows_off(each, far := _far(sizes)):
        beyond = np.zeros(len(sizes), bool) if each.intervals is None else each.intervals.beyond
        yield finding(
            "doubtful-rows",
            file=name,
            rows=rows,
            median=np.median(sizes),
            without=float(np.sqrt(np.mean(sizes[~far] ** 2))),
            outside=int(np.count_nonzero(beyond[far])),
        )
    if not each.settled:
        yield finding("placement-unsettled", file=name)
    elif each.placed_by is not None:
        measured, fitted = each.placed_by
        yield finding("placement-takes-all", file=name, measured=measured, fitted=fitted, wanted=MARGIN * fitted)
    elif (found := each.intervals) is not None:
        count = len(found.size)
        values = {"covered": found.covered, "errors": count, "median": np.median(found.radius)}
        yield finding("interval-coverage", file=name, **values)
        if beyond := int(found.beyond.sum()):
            yield finding("outside-fitted-range", file=name, beyond=beyond, poses=count, joints=found.joints)
