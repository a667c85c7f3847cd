"""Geometric fit of the guided procedure: model selection, verdict on held-out rows, and findings."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import TypeVar

from calib.data.poses.fit_options import FitOptions
from calib.data.poses.measurements import PoseMeasurements
from calib.errors import Finding, NotConverged, finding
from calib.estimation.robust import Loss, loss_name
from calib.geometry.accuracy import errors
from calib.geometry.checks.joint_errors import joint_factors, joint_scatter, scatter_finding
from calib.geometry.checks.joint_range import joint_range
from calib.geometry.checks.pose_direction import parted_set_up
from calib.geometry.checks.row_changes import row_changes
from calib.geometry.diagnosis import diagnose
from calib.geometry.error_model import ErrorModel, learn_errors
from calib.geometry.first_guess import install
from calib.geometry.fit import polish_frames
from calib.geometry.installation import Installation
from calib.geometry.model_choice.folds import folds_by_name
from calib.geometry.model_choice.ladder import MIN_GAIN, RIGID_MODELS, ModelSelection, select_model
from calib.geometry.model_choice.stated_compliance import contradictions
from calib.geometry.observability import unidentified
from calib.geometry.observation import fixed_parameters, stated_prior
from calib.geometry.static_torques.load_errors import DESCRIBED, WEIGHED
from calib.geometry.static_torques.mass_factors import SETTLED, MassFactors, several_loads
from calib.geometry.static_torques.sources import MODELLED, torques_used, weightless_payloads
from calib.geometry.weighing import GeometricFit, Settings, calibrated_chain
from calib.procedure.findings import Verdict, level_of, sentence, settle
from calib.procedure.kinematic_stage.inputs import Inputs, plain_reference
from calib.procedure.kinematic_stage.metrics import Findings, Outlier
from calib.procedure.kinematic_stage.settings import FitSettings
from calib.procedure.kinematic_stage.verdict import plausibility
from calib.procedure.kinematic_stage.verdict.comparison import Comparison
from calib.procedure.kinematic_stage.verdict.image_findings import image_notes
from calib.procedure.kinematic_stage.verdict.plausibility import gross_rows, misfit, named_outliers
from calib.procedure.kinematic_stage.verdict.validation import Arms, Assessment, assess
from calib.procedure.measuring.prediction import SelectionPrediction, compared_with_fit
from calib.robot.calibrated import CalibratedChain

Progress = Callable[[str], None]

# nominal errors fall by this factor when each file gets a station of its own: the instrument was moved (our choice)
MOVED = 3.0
# largest number of selections until the masses under several loads have converged; the last masses are taken then (our
# choice)
MASS_ROUNDS = 8
# smallest cross-validated error with corrections over that without, if errors of joints are random (our choice)
MIN_RANDOM = 0.8
# losses that let a few gross rows draw a fit
HEEDS_ALL = ("none", "huber")


@dataclass(frozen=True, eq=False)
class Outcome:
    """Outcome of a fit.

    Attributes:
        inputs: robot and measurements.
        selection: tried models (rungs of the ladder), the chosen model, and the fits of the nominal and the calibrated
            arm.
        rigid: the best fit without joint corrections: the geometry that a URDF can describe.
        outliers: fitted rows with large residuals, worst first.
        undetermined: findings on parameters that are not identifiable from the poses.
        findings: warnings and notes on the fit.
        assessment: errors of both arms on fitted and on held-out rows, and the verdict.
        settings, options: settings and options of fit and verdict.
        expected: error model of the calibrated arm at any pose; None if no positions were measured.
        loss: the loss as a function; None for a loss by name.
    """

    inputs: Inputs
    selection: ModelSelection
    rigid: GeometricFit
    outliers: Sequence[Outlier]
    undetermined: tuple[Finding, ...]
    findings: Findings
    assessment: Assessment
    settings: FitSettings = field(default_factory=FitSettings)
    options: FitOptions = field(default_factory=FitOptions)
    expected: ErrorModel | None = None
    loss: Loss | None = None

    @property
    def robot(self) -> CalibratedChain:
        """Calibrated robot with covariance and joint corrections, as used by identification, excitation and export."""
        robot = calibrated_chain(self.selection.fit, self.rigid, self.inputs.nominal)
        if robot.corrections is not None and self.inputs.masses is not None:
            # the corrections' gravity torques are those of the identified masses
            reference = replace(robot.deflection.reference or self.inputs.chain, inertias=self.inputs.masses)
            deflection = replace(robot.deflection, reference=reference)
            robot = replace(robot, corrections=replace(robot.corrections, deflection=deflection))
        return replace(robot, source=str(self.inputs.source))

    @cached_property
    def nominal_cell(self) -> Installation:
        """Installation of the arm before any calibration, with base and tool placed to fit the rows best.

        If the robot is from an earlier fit, the nominal arm of that fit is placed, although the new fit started from
        the calibrated geometry of the earlier fit.
        """
        nominal = self.inputs.nominal
        if nominal is self.inputs.chain:
            return self.selection.nominal.cell
        settings = weighing_settings(self.options, self.settings, self.loss)
        if self.findings.loss:
            settings = settings.with_loss(self.findings.loss)
        return polish_frames(install(nominal, self.inputs.fit), self.inputs.fit, settings).cell

    @property
    def fit(self) -> Comparison:
        """Errors of the nominal and the calibrated arm on the fitted rows."""
        return self.assessment.fit

    @property
    def validation(self) -> Mapping[str, Comparison]:
        """Errors of the nominal and the calibrated arm on validation rows: file name -> errors."""
        return self.assessment.validation

    @property
    def warnings(self) -> tuple[str, ...]:
        """Texts of findings and remarks for the user."""
        return self.assessment.warnings

    @property
    def verdict(self) -> Verdict:
        """Verdict (pass, marginal or fail) with its reason."""
        return self.assessment.verdict


T = TypeVar("T", bound=Outcome)


def weighing_settings(options: FitOptions, settings: FitSettings, loss: Loss | None = None) -> Settings:
    """Return the settings of the residuals' loss function.

    The loss in the fit's settings has precedence over the loss in the options file, and a function over both.

    Args:
        options: content of the options file.
        settings: settings of the fit.
        loss: the loss as a function; None for a loss by name.
    """
    if loss is not None:
        return Settings(loss_name(loss), options.loss_scale, function=loss)
    return Settings(settings.loss or options.loss, options.loss_scale)


def _silent(stage: str) -> None:
    """Ignore a progress text, `stage`."""


def run(
    inputs: Inputs,
    options: FitOptions | None = None,
    settings: FitSettings | None = None,
    progress: Progress | None = None,
    prediction: SelectionPrediction | None = None,
    loss: Loss | None = None,
) -> Outcome:
    """Fit the geometry, and return the chosen model, errors on all rows, and the verdict.

    Args:
        inputs: robot, rows to fit, and validation rows.
        options: content of the fit options file; None: defaults.
        settings: model, loss and folds of the ladder, tolerance, seed; None: defaults.
        progress: called with a text on each stage; None: silent.
        prediction: accuracy predicted at pose selection, to be compared with the accuracy of the fit; None: no
            comparison.
        loss: the loss as a function; None: as in the settings.

    Raises:
        NotConverged: if the fit of the chosen model did not converge.
    """
    options = options or FitOptions()
    settings = settings or FitSettings()
    progress = progress or _silent
    weighing = weighing_settings(options, settings, loss)
    model = settings.model or options.model
    if prediction is not None:
        prediction.check_robot(inputs.chain.joint_names)

    progress("estimating the placements of instrument and tool")
    climb, selection = _selected(inputs, options, settings, weighing, progress)
    if inputs.gravity is not None and model not in RIGID_MODELS:
        modelled = inputs.driven_by(MODELLED)
        of_modelled = _selected(modelled, options, settings, weighing, progress)
        if of_modelled[1].cross_validated < (1.0 - MIN_GAIN) * selection.cross_validated:
            inputs = modelled
            climb, selection = of_modelled
    mass_doubt = DESCRIBED if inputs.gravity is None else WEIGHED
    mass_factors: MassFactors | None = None
    if _masses_unknown(inputs) and model not in RIGID_MODELS:
        progress("weighing the arm by its loads")
        factors, loaded, of_loads = _weighed(inputs, options, settings, weighing)
        if factors is not None and of_loads[1].cross_validated < (1.0 + MIN_GAIN) * selection.cross_validated:
            inputs = loaded
            climb, selection = of_loads
            mass_doubt = factors.doubt
            mass_factors = factors
    nominal = selection.nominal.cell
    _check_convergence(selection, inputs, options)

    changes = row_changes(selection.rigid) or joint_factors(selection.rigid)
    rigid_misfit = _rigid_misfit(selection, changes, climb, weighing)

    progress("comparing on unseen poses")
    weighing = weighing.with_loss(selection.loss)
    rigid = selection.rigid_fit(inputs.fit, weighing, inputs.bare)
    outliers = named_outliers(selection.fit)
    notes = _residual_findings(selection, inputs, changes, rigid_misfit, weighing)
    if not changes:
        for block in inputs.fit:
            notes += parted_set_up(inputs.chain, block)
    if mass_factors is not None:
        notes += mass_factors.findings()
    blocks = [*inputs.fit, *(rows.block for rows in inputs.unseen.values() if not rows.held_out)]
    notes += weightless_payloads(inputs.chain, blocks)
    by_loads = mass_factors is not None
    notes += torques_used(selection.fit.cell.deflection, inputs.gravity, inputs.torques, by_loads)
    if inputs.compliance is not None:
        notes += contradictions(selection.fit, selection.rigid, inputs.compliance)
    if prediction is not None:
        ratio = compared_with_fit(prediction, selection.fit)
        if ratio is not None:
            notes.append(ratio)
    measured_range = joint_range(selection.rigid, nominal)
    # with frames alone the arm is the nominal one everywhere
    if selection.chosen != "frames":
        notes += plausibility.of_range(measured_range, settings.tolerance)
    findings = _findings(inputs, selection, outliers, notes, options.accept)
    findings = replace(findings, joint_range=measured_range)

    progress("estimating the expected errors")
    expected = learn_errors(selection, inputs.fit, settings.seed, mass_doubt)
    if expected is not None:
        findings = replace(findings, discrepancy=expected.discrepancy)
    plain = plain_reference(nominal, inputs)
    arms = Arms(nominal, selection.fit.cell, rigid.cell.chain, expected, plain)
    assessment = assess(arms, inputs, findings, weighing, replace(settings, model=model))
    return Outcome(
        inputs=inputs,
        selection=selection,
        rigid=rigid,
        outliers=outliers,
        undetermined=tuple(unidentified(selection.fit)),
        findings=findings,
        assessment=assessment,
        settings=settings,
        options=options,
        expected=expected,
        loss=loss,
    )


def _selected(
    inputs: Inputs, options: FitOptions, settings: FitSettings, weighing: Settings, progress: Progress
) -> tuple[Callable[..., ModelSelection], ModelSelection]:
    """Return the function that selects models on the rows to fit, and the model that it selects.

    Args:
        inputs: robot and measurements.
        options: content of the fit options file.
        settings: model, folds and seed.
        weighing: settings of the loss function.
        progress: called with a text on each stage.
    """
    start = install(inputs.chain, inputs.fit, inputs.known)
    climb = partial(
        select_model,
        start,
        inputs.fit,
        fixed=fixed_parameters(start, options),
        prior=stated_prior(start, options),
        folds=folds_by_name(settings.folds, inputs.fit, settings.seed),
        seed=settings.seed,
        progress=lambda done, total, what: progress(f"fitting: {what}"),
        masses=inputs.masses,
        compliance=inputs.compliance,
    )
    return climb, climb(settings.model or options.model, settings=weighing)


def _masses_unknown(inputs: Inputs) -> bool:
    """Return whether only poses under several stated loads can determine the masses that deflect the arm."""
    known = inputs.gravity is not None or inputs.masses is not None or inputs.compliance is not None
    corrected = inputs.earlier is not None and inputs.earlier.corrections is not None
    serial = len(inputs.chain.driven) == inputs.chain.n
    return serial and not known and not corrected and several_loads(inputs.fit)


def _weighed(
    inputs: Inputs, options: FitOptions, settings: FitSettings, weighing: Settings
) -> tuple[MassFactors | None, Inputs, tuple[Callable[..., ModelSelection], ModelSelection]]:
    """Return the masses fitted to the deflection under loads, the inputs with their torques, and the model of these.

    The masses are None where no compliance by torques is selected.

    Args:
        inputs: robot and measurements.
        options: content of the fit options file.
        settings: model, folds and seed.
        weighing: settings of the loss function.
    """
    factors = MassFactors.before(inputs.chain)
    for _ in range(MASS_ROUNDS):
        loaded = inputs.with_masses(factors.masses)
        selected = _selected(loaded, options, settings, weighing, _silent)
        fit = selected[1].fit
        if not fit.cell.deflection.by_torque or not fit.solution.status.good:
            return None, inputs, selected
        following = factors.step(fit, loaded.fit)
        # the masses of this fit, with the covariance that the step computed there
        reached = replace(following, values=factors.values)
        if following.change_from(factors) < SETTLED:
            break
        factors = following
    return reached, loaded, selected


def _rigid_misfit(
    selection: ModelSelection, changes: Sequence[Finding], climb: Callable[..., ModelSelection], weighing: Settings
) -> Finding | None:
    """Return a finding if no rigid geometry explains the rows, or if a few rows with gross errors are the reason.

    Otherwise, None is returned.

    Args:
        selection: the selection of models.
        changes: findings on changed rows or on joints with a factor; if they explain the misfit, None is returned.
        climb: function that selects models on the same rows with another loss.
        weighing: loss settings of the selection.
    """
    reach = selection.nominal.cell.reach
    if changes and changes[-1].values["after"] < plausibility.FLOOR * reach:
        return None
    rigid_misfit = misfit(selection, reach)
    if rigid_misfit and weighing.loss in HEEDS_ALL:
        robust = climb("geometry", settings=weighing.with_loss("cauchy"))
        return gross_rows(selection, robust, reach) or rigid_misfit
    return rigid_misfit


def _residual_findings(
    selection: ModelSelection,
    inputs: Inputs,
    changes: Sequence[Finding],
    rigid_misfit: Finding | None,
    weighing: Settings,
) -> list[Finding]:
    """Return findings on the residuals of a fit: changed rows, misfit, moved instrument, joints, images.

    Args:
        selection: the selection of models.
        inputs: robot and measurements.
        changes: findings on changed rows, or on joints with a factor.
        rigid_misfit: finding that no rigid geometry explains the rows; None: a rigid geometry explains them.
        weighing: settings of the loss function.
    """
    notes = list(changes)
    if rigid_misfit and not changes and rigid_misfit.code == "rigid-misfit":
        # systematic errors of joints would be predicted by corrections
        random = selection.cross_validated > MIN_RANDOM * rigid_misfit.values["folds"]
        scatter = joint_scatter(selection.rigid) if random else None
        if scatter is not None:
            notes.append(scatter_finding(scatter))
        elif not rigid_misfit.values["causes"]:
            excluded = plausibility.excluded_causes(selection, inputs.fit, random)
            rigid_misfit = replace(rigid_misfit, values={**rigid_misfit.values, "excluded": excluded})
    if rigid_misfit:
        notes.append(rigid_misfit)
    notes += _moved_between(selection.nominal.cell, inputs.fit, weighing)
    notes += diagnose(selection.fit, with_changes=not changes)
    with_factor = [change.values.get("joint") for change in changes]
    for scale in plausibility.joint_scales(selection.fit):
        if scale.values["joint"] not in with_factor:
            notes.append(scale)
    notes += image_notes(selection.fit)
    return notes


def _without_excluded(note: Finding) -> Finding:
    """Return a finding without the causes that were excluded for it."""
    if "excluded" not in note.values:
        return note
    return replace(note, values={**note.values, "excluded": None})


def _check_convergence(selection: ModelSelection, inputs: Inputs, options: FitOptions) -> None:
    """Check that the chosen model's fit has converged.

    Args:
        selection: the selection of models.
        inputs: robot and measurements.
        options: content of the options file, with the accepted findings.

    Raises:
        NotConverged: if it has not; the message contains findings that may be the reason.
    """
    status = selection.fit.solution.status
    if status.good:
        return
    nominal = selection.nominal.cell
    contradictions = plausibility.findings(nominal, selection.fit, inputs.fit, None, nominal.reach, inputs.files)
    reasons = [sentence(reason) for reason in settle(contradictions, options.accept) if level_of(reason) == "fail"]
    message = f"the fit of model '{selection.chosen}' did not converge: {status.value}"
    raise NotConverged("; ".join([message, *reasons]), selection.fit)


def assessed(outcome: T, inputs: Inputs) -> T:
    """Return the outcome with a new verdict from the validation rows of `inputs`; nothing is fitted again."""
    settings, options, selection = outcome.settings, outcome.options, outcome.selection
    nominal = selection.nominal.cell
    plain = plain_reference(nominal, outcome.inputs)
    arms = Arms(nominal, selection.fit.cell, outcome.rigid.cell.chain, outcome.expected, plain)
    weighing = weighing_settings(options, settings, outcome.loss)
    settings = replace(settings, model=settings.model or options.model)
    assessment = assess(arms, inputs, outcome.findings, weighing, settings)
    return replace(outcome, inputs=inputs, assessment=assessment)


def _findings(
    inputs: Inputs,
    selection: ModelSelection,
    outliers: Sequence[Outlier],
    notes: Sequence[Finding],
    accepted: Sequence[str],
) -> Findings:
    """Return the findings of a fit that do not depend on validation rows.

    Args:
        inputs: robot and measurements.
        selection: the selection of models.
        outliers: fitted rows with large residuals.
        notes: findings on the residuals.
        accepted: names of findings that the options accept.
    """
    nominal = selection.nominal.cell
    cross_validated = selection.cross_validated
    reach = nominal.reach
    contradictions = plausibility.findings(nominal, selection.fit, inputs.fit, cross_validated, reach, inputs.files)
    if any(contradiction.code != "unexplained" for contradiction in contradictions):
        # they name the cause of a misfit
        notes = [_without_excluded(note) for note in notes]
    noticed = [*contradictions, *notes]
    if selection.folds.blind:
        noticed.append(finding("transfer-by-regions", stations=selection.folds.blind))
    outlier_rows = {(outlier.file, outlier.row) for outlier in outliers}
    row_count = sum(len(block) for block in inputs.fit)
    return Findings(
        model=selection.chosen,
        loss=selection.loss,
        cross_validated=cross_validated,
        nominal_cross_validated=selection.nominal_step.cross_validated,
        outlier_share=len(outlier_rows) / row_count,
        reach=reach,
        noticed=settle(noticed, accepted),
        blind=selection.folds.blind,
        rigid_cross_validated=selection.rigid_cross_validated,
        torques=inputs.torques,
    )


def _moved_between(nominal: Installation, blocks: Sequence[PoseMeasurements], settings: Settings) -> list[Finding]:
    """Return a finding if the instrument seems to have moved between the files; otherwise an empty list.

    The finding is made if the nominal arm's errors are much smaller when each file has a separate station (position of
    the instrument).

    Args:
        nominal: the nominal arm with base and tool placed.
        blocks: the measurements.
        settings: settings of the placement.
    """
    blocks = [block for block in blocks if block.has_instrument]
    files = {block.file for block in blocks}
    stations = {block.station for block in blocks}
    if len(files) < 2 or len(stations) > 1:
        return []
    separate = [replace(block, station=f"{number}") for number, block in enumerate(blocks)]
    before = errors(nominal, blocks).rms
    start = install(nominal.chain, separate, nominal.known)
    placed = polish_frames(start, separate, settings).cell
    after = errors(placed, separate).rms
    if before < MOVED * after:
        return []
    return [finding("instrument-moved", before=before, after=after, files=len(blocks))]
