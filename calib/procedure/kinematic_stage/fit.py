"""Geometric fit of the guided procedure: model selection, verdict on unseen rows, and findings."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import TypeVar

from calib.data.poses.fit_options import FitOptions
from calib.data.poses.measurements import PoseMeasurements
from calib.errors import Finding, NotConverged, finding
from calib.extensions import Point
from calib.geometry.accuracy import errors
from calib.geometry.checks.joint_range import joint_range
from calib.geometry.checks.row_changes import row_changes
from calib.geometry.diagnosis import diagnose
from calib.geometry.error_model import ErrorModel, learn_errors
from calib.geometry.first_guess import install
from calib.geometry.fit import polish_frames
from calib.geometry.installation import Installation
from calib.geometry.model_choice.folds import folds_by_name
from calib.geometry.model_choice.ladder import ModelSelection, select_model
from calib.geometry.observability import unidentified
from calib.geometry.observation import fixed_parameters, stated_prior
from calib.geometry.weighing import GeometricFit, Settings, calibrated_chain
from calib.procedure.findings import Verdict, level_of, sentence, settle
from calib.procedure.kinematic_stage import plausibility
from calib.procedure.kinematic_stage.comparison import Comparison
from calib.procedure.kinematic_stage.inputs import Inputs, plain_reference
from calib.procedure.kinematic_stage.metrics import Findings, Outlier
from calib.procedure.kinematic_stage.plausibility import gross_rows, misfit, named_outliers
from calib.procedure.kinematic_stage.settings import FitSettings
from calib.procedure.kinematic_stage.validation import Arms, Assessment, assess
from calib.procedure.measuring.prediction import SelectionPrediction, compared_with_fit
from calib.robot.calibrated import CalibratedChain

FIT_NOTES: Point[Callable[[GeometricFit], list[Finding]]] = Point("fit_notes", "findings on a fit")

Progress = Callable[[str], None]
MOVED = 3.0  # nominal errors fall by this factor when each file gets a station of its own: it was moved (our choice)
HEEDS_ALL = ("none", "huber")  # losses that let a few gross rows draw a fit


@dataclass(frozen=True, eq=False)
class Outcome:
    """Outcome of a fit.

    Attributes:
        inputs: what it worked on.
        selection: the rungs, the chosen model, and the fits of the nominal and the calibrated arm.
        rigid: the best fit without joint corrections: the geometry that a URDF holds.
        outliers: rows of the fit that do not fit, worst first.
        unclear: what is not identifiable from the poses.
        findings: what the fit says of itself.
        assessment: both arms on fitted and on unseen rows, and the verdict.
        settings, options: how it was fitted and judged.
        expected: how far off the calibrated arm may be at any pose; None where no positions were measured.
    """

    inputs: Inputs
    selection: ModelSelection
    rigid: GeometricFit
    outliers: Sequence[Outlier]
    unclear: tuple[Finding, ...]
    findings: Findings
    assessment: Assessment
    settings: FitSettings = field(default_factory=FitSettings)
    options: FitOptions = field(default_factory=FitOptions)
    expected: ErrorModel | None = None

    @property
    def robot(self) -> CalibratedChain:
        """Calibrated robot with covariance and corrections, for identification, excitation and export."""
        found = calibrated_chain(self.selection.fit, self.rigid, self.inputs.nominal)
        if found.corrections is not None and self.inputs.masses is not None:
            reference = replace(found.deflection.reference or self.inputs.chain, inertias=self.inputs.masses)
            bent = replace(found.deflection, reference=reference)
            found = replace(found, corrections=replace(found.corrections, deflection=bent))
        return replace(found, source=str(self.inputs.source))

    @cached_property
    def nominal_cell(self) -> Installation:
        """The arm before any calibration, base and tool placed where it fits the rows best.

        A fit of an earlier fit's robot compares with that robot; its nominal arm is placed anew.
        """
        compared, nominal = self.selection.nominal.cell, self.inputs.nominal
        if nominal is self.inputs.chain:
            return compared
        loss = self.settings.loss or self.options.loss
        settings = Settings(self.findings.loss or loss, self.options.loss_scale)
        return polish_frames(install(nominal, self.inputs.fit), self.inputs.fit, settings).cell

    @property
    def fit(self) -> Comparison:
        """Errors of both arms on the fitted rows."""
        return self.assessment.fit

    @property
    def validation(self) -> Mapping[str, Comparison]:
        """Errors of both arms on validation rows, by file name."""
        return self.assessment.validation

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings for the user."""
        return self.assessment.warnings

    @property
    def verdict(self) -> Verdict:
        """Verdict (pass, marginal or fail) with its reason."""
        return self.assessment.verdict


T = TypeVar("T", bound=Outcome)


def run(
    inputs: Inputs,
    options: FitOptions | None = None,
    wanted: FitSettings | None = None,
    progress: Progress | None = None,
    selection: SelectionPrediction | None = None,
) -> Outcome:
    """Return the outcome of a fit: the chosen model, errors on all rows, and the verdict.

    Args:
        inputs: see `calib.procedure.kinematic_stage.inputs.gather`.
        options: the fit options file's content.
        wanted: model, loss and folds of the ladder, tolerance, seed.
        progress: called with a few words at each stage.
        selection: what was predicted when the poses were chosen, to be held against what the fit states.

    Raises:
        NotConverged: where the chosen model's fit did not come to an end.
    """
    options, wanted, say = options or FitOptions(), wanted or FitSettings(), progress or (lambda words: None)
    settings = Settings(wanted.loss or options.loss, options.loss_scale)
    asked, seed = wanted.model or options.model, wanted.seed
    if selection is not None:
        selection.check_robot(inputs.chain.joint_names)
    say("estimating the placements of instrument and tool")
    start = install(inputs.chain, inputs.fit, inputs.known)
    climb = partial(
        select_model,
        start,
        inputs.fit,
        fixed=fixed_parameters(start, options),
        prior=stated_prior(start, options),
        folds=folds_by_name(wanted.folds, inputs.fit, seed),
        seed=seed,
        progress=lambda done, total, what: say(f"fitting: {what}"),
    )
    found = climb(asked, settings=settings)
    reach = found.nominal.cell.reach
    status = found.fit.solution.status
    if not status.good:
        odd = plausibility.findings(found.nominal.cell, found.fit, inputs.fit, None, reach)
        why = [sentence(one) for one in settle(odd, options.accept) if level_of(one) == "fail"]
        words = f"the fit of model '{found.chosen}' did not converge: {status.value}"
        raise NotConverged("; ".join([words, *why]), found.fit)
    changed = row_changes(found.rigid)
    explained = bool(changed) and changed[-1].values["after"] < plausibility.FLOOR * reach
    rigid_misfit = None if explained else misfit(found, reach)
    if rigid_misfit and settings.loss in HEEDS_ALL:
        robust = climb("geometry", settings=replace(settings, loss="cauchy"))
        rigid_misfit = gross_rows(found, robust, reach) or rigid_misfit
    say("comparing on unseen poses")
    settings = replace(settings, loss=found.loss)
    rigid = found.rigid_fit(inputs.fit, settings, inputs.bare)
    named = named_outliers(found.fit)
    notes = [
        *changed,
        *([rigid_misfit] if rigid_misfit else []),
        *_moved_between(found.nominal.cell, inputs.fit, settings),
        *diagnose(found.fit, with_changes=not changed),
        *(note for notes in FIT_NOTES.all() for note in notes(found.fit)),
    ]
    if selection is not None and (ratio := compared_with_fit(selection, found.fit)) is not None:
        notes.append(ratio)
    held = joint_range(found.rigid, found.nominal.cell)
    if found.chosen != "frames":  # else the arm is the nominal one everywhere
        notes += plausibility.of_range(held, wanted.tolerance)
    findings = replace(_found_of(inputs, found, named, notes, options.accept), joint_range=held)
    say("estimating the expected errors")
    expected = learn_errors(found, inputs.fit, seed)
    findings = replace(findings, discrepancy=None if expected is None else expected.discrepancy)
    plain = plain_reference(found.nominal.cell, inputs)
    arms = Arms(found.nominal.cell, found.fit.cell, rigid.cell.chain, expected, plain)
    result = assess(arms, inputs, findings, settings, replace(wanted, model=asked))
    unclear = tuple(unidentified(found.fit))
    return Outcome(inputs, found, rigid, named, unclear, findings, result, wanted, options, expected)


def assessed(outcome: T, inputs: Inputs) -> T:
    """Return the outcome with a new verdict from the validation rows of `inputs`; nothing is fitted."""
    wanted, options, fits = outcome.settings, outcome.options, outcome.selection
    settings = Settings(wanted.loss or options.loss, options.loss_scale)
    plain = plain_reference(fits.nominal.cell, outcome.inputs)
    arms = Arms(fits.nominal.cell, fits.fit.cell, outcome.rigid.cell.chain, outcome.expected, plain)
    result = assess(arms, inputs, outcome.findings, settings, replace(wanted, model=wanted.model or options.model))
    return replace(outcome, inputs=inputs, assessment=result)


def _found_of(
    inputs: Inputs, found: ModelSelection, named: Sequence[Outlier], notes: Sequence[Finding], accepted: Sequence[str]
) -> Findings:
    """Return the findings of a fit that do not depend on validation rows; `notes` are findings on its residuals."""
    reach = found.nominal.cell.reach
    left = found.cross_validated
    odd = plausibility.findings(found.nominal.cell, found.fit, inputs.fit, left, reach)
    blind = [finding("transfer-by-regions", stations=found.folds.blind)] if found.folds.blind else []
    return Findings(
        model=found.chosen,
        loss=found.loss,
        cross_validated=left,
        nominal_cross_validated=found.nominal_step.cross_validated,
        outlier_share=len({(each.file, each.row) for each in named}) / sum(len(block) for block in inputs.fit),
        reach=reach,
        noticed=settle([*odd, *notes, *blind], accepted),
        blind=found.folds.blind,
        rigid_cross_validated=found.rigid_cross_validated,
    )


def _moved_between(nominal: Installation, blocks: Sequence[PoseMeasurements], settings: Settings) -> list[Finding]:
    """Return a finding if separate stations explain the files far better than a common station."""
    own = [block for block in blocks if block.has_instrument]
    if len({block.file for block in own}) < 2 or len({block.station for block in own}) > 1:
        return []
    apart = [replace(block, station=f"{number}") for number, block in enumerate(own)]
    before = errors(nominal, own).rms
    placed = polish_frames(install(nominal.chain, apart, nominal.known), apart, settings).cell
    after = errors(placed, apart).rms
    if before < MOVED * after:
        return []
    return [finding("instrument-moved", before=before, after=after, files=len(own))]
