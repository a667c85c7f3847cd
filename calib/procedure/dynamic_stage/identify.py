"""Identification stage of the guided procedure: identified model, its errors on the recordings, and the verdict.

`assess` computes errors and verdict in the same way for a new model and for a model read from its folder.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from os.path import realpath
from typing import TypeVar, cast

import numpy as np

from calib.data.signals.persistency import REPEATED, ExcitationReport, repeats, report_excitation
from calib.dynamics.regressor_model import RegressorModel
from calib.errors import Finding, finding
from calib.identification.checks.gravity import GravityHypotheses
from calib.identification.friction.passivity import driven
from calib.identification.identify import Identification, identify
from calib.identification.loop import LoopController, LoopDisagreement, Replay
from calib.identification.physical_consistency.solve import Contradiction, contradiction
from calib.identification.prediction import Dynamics, Score, predict, score
from calib.identification.rows import Case
from calib.identification.uncertainty import geometry_uncertainty, torque_errors
from calib.identification.uncertainty.learned_torque_errors import learn_torque_errors
from calib.procedure.dynamic_stage import plain, plausibility, with_geometry
from calib.procedure.dynamic_stage import verdict as judging
from calib.procedure.dynamic_stage.hypotheses import gravity_hypotheses
from calib.procedure.dynamic_stage.inputs import IdentificationInputs, Progress, silent
from calib.procedure.findings import Verdict, lines_of
from calib.procedure.robot_kinds import stage_of
from calib.records import field_values
from calib.units import TORQUE, without_gains


@dataclass(frozen=True, eq=False)
class ModelFindings:
    """Findings on an identified model, stored in the model's folder; the verdict needs them besides recordings.

    Attributes:
        rests: parameters whose values are determined by a prior instead of the recordings.
        notes: remarks on the model as text, only in folders of earlier versions.
        noticed: findings on the model that do not depend on held-out recordings.
        controller: stated or identified controller; None: no controller is known.
        errors: distribution of the model's torque errors; None if too little was recorded to estimate it.
        contradiction: distance of the estimate from every physically consistent robot; None if unknown.
        unlike: how recorded torques refute an estimate that relies on the stated control loop; None if they do not.
        plain: (p,) the model's parameters by plain least squares; empty in files of earlier versions.
    """

    rests: judging.Resting
    notes: tuple[str, ...] = ()
    noticed: tuple[Finding, ...] = ()
    controller: LoopController | None = None
    errors: torque_errors.TorqueDiscrepancy | None = None
    contradiction: Contradiction | None = None
    unlike: LoopDisagreement | None = None
    plain: tuple[float, ...] = ()


@dataclass(frozen=True, eq=False)
class RecordingErrors:
    """Errors of a dynamic model on the recordings.

    Attributes:
        fit, validation: name of a training or held-out recording -> score of the model.
        predictions: name of a recording -> predicted torques (N, rows) at the full sampling rate.
        repeated: name of a held-out recording that repeats training motion -> share of its states (position, velocity)
            that are also in the training motion.
        excitation: name of a training recording -> report on the parameters that its motion can identify.
        intervals: name of a held-out recording -> expected torque errors; without held-out recordings, those of the
            first training recording.
    """

    fit: Mapping[str, Score]
    validation: Mapping[str, Score]
    predictions: Mapping[str, np.ndarray]
    repeated: Mapping[str, float]
    excitation: Mapping[str, ExcitationReport]
    intervals: Mapping[str, torque_errors.TorqueIntervals]

    @property
    def proofs(self) -> dict[str, Score]:
        """Scores on the held-out recordings that do not repeat the training motion: recording name -> score."""
        return {name: score for name, score in self.validation.items() if score.evidence}


@dataclass(frozen=True, eq=False, kw_only=True)
class DynamicsAssessment(RecordingErrors):
    """Errors of a model on the recordings, and the verdict.

    Attributes:
        verdict: the verdict, by the rules of `calib.procedure.dynamic_stage.verdict`.
        warnings: texts for the user on the recordings and the model.
        noticed: the findings whose sentences are in the warnings.
        tracking: name of a recording -> simulated tracking with the model as feedforward.
        tracking_failure: reason why no tracking was simulated; empty otherwise.
        references: name of a held-out recording -> errors of the plain references beside the model's error.
    """

    verdict: Verdict
    warnings: tuple[str, ...]
    noticed: tuple[Finding, ...]
    tracking: Mapping[str, Replay] = field(default_factory=dict)
    tracking_failure: str = ""
    references: Mapping[str, plain.PlainReferences] = field(default_factory=dict)


def repeated_motion(cases: Sequence[Case], unseen: Sequence[Case]) -> dict[str, float]:
    """Return the held-out recordings that repeat training motion: name -> share of their states in the training.

    A state is a position with its velocity. A recording counts as a repeat from a share of `REPEATED`.

    Args:
        cases: training recordings.
        unseen: held-out recordings.
    """
    repeated = {}
    for case in unseen:
        share = max(repeats(training.motion, case.motion) for training in cases)
        if share >= REPEATED:
            repeated[case.name] = share
    return repeated


def overlaps(cases: Sequence[Case], unseen: Sequence[Case]) -> list[Finding]:
    """Return findings on held-out recordings that share samples with a training recording.

    Args:
        cases: training recordings.
        unseen: held-out recordings.
    """
    findings = []
    for case, training in product(unseen, cases):
        if not training.motion.file or realpath(case.motion.file) != realpath(training.motion.file):
            continue
        first = max(case.motion.t[0], training.motion.t[0])
        last = min(case.motion.t[-1], training.motion.t[-1])
        if first < last:
            findings.append(finding("unseen-overlaps", file=case.name, training=training.name, first=first, last=last))
    return findings


def errors_of(
    inputs: IdentificationInputs,
    dynamics: Dynamics[RegressorModel],
    errors: torque_errors.TorqueErrorModel | None = None,
    say: Progress = silent,
) -> RecordingErrors:
    """Return a model's torque predictions for every recording, and the errors of these predictions.

    Args:
        inputs: training and held-out recordings, and options.
        dynamics: the model.
        errors: expected torque errors of the model, from which intervals are computed; None: no intervals.
        say: called with a text on each step.
    """
    predictions, scores = {}, {}
    for case in (*inputs.cases, *inputs.unseen):
        say(f"predicting {case.name}")
        predictions[case.name] = predict(dynamics, case)
        scores[case.name] = score(case, predictions[case.name], inputs.options.slow, inputs.currents.own)
    intervals: dict[str, torque_errors.TorqueIntervals] = {}
    if errors is not None:
        for case in inputs.unseen or inputs.cases[:1]:
            say(f"estimating the errors of {case.name}")
            intervals[case.name] = torque_errors.intervals(
                errors, cast(Dynamics, dynamics), case, predictions[case.name]
            )
    repeated = repeated_motion(inputs.cases, inputs.unseen)
    validation = {}
    for case in inputs.unseen:
        coverage = intervals[case.name].coverage() if case.name in intervals else None
        evidence = case.name not in repeated
        validation[case.name] = replace(scores[case.name], evidence=evidence, interval95=coverage)
    return RecordingErrors(
        fit={case.name: scores[case.name] for case in inputs.cases},
        validation=validation,
        predictions=predictions,
        repeated=repeated,
        excitation={case.name: report_excitation(case.motion) for case in inputs.cases},
        intervals=intervals,
    )


def assess(
    inputs: IdentificationInputs,
    dynamics: Dynamics,
    findings: ModelFindings,
    errors: torque_errors.TorqueErrorModel | None = None,
    wrong: Sequence[int] | None = None,
    hypotheses: GravityHypotheses | None = None,
    progress: Progress | None = None,
) -> DynamicsAssessment:
    """Return a model's torque predictions for every recording, the prediction errors, and the verdict.

    Args:
        inputs: training recordings (for the model's error on its own data) and held-out recordings.
        dynamics: the model.
        findings: findings on the model, from its identification.
        errors: expected torque errors of the model; None if unknown.
        wrong: indices of joints whose friction term adds energy; None: computed by `friction.passivity.driven`.
        hypotheses: result of `gravity_hypotheses` for these inputs; None: computed.
        progress: called with a text on each step; None: silent.
    """
    say = progress or silent
    if wrong is None:
        wrong = driven(dynamics, inputs.cases)
    scored = errors_of(inputs, dynamics, errors, say)

    say("judging")
    labels = inputs.options.settings.torque_rows.numbered(inputs.chain.n)
    implausible = plausibility.implausible(inputs, findings.contradiction, findings.unlike, hypotheses)
    figures, rules = judging.judge(scored.fit, scored.proofs, scored.repeated, scored.excitation, labels)
    drives = judging.friction_drives(joint + 1 for joint in wrong)
    if drives:
        figures, rules = "", drives
    nominal = plain.nominal_values(inputs.chain, dynamics) if inputs.unit == TORQUE else None
    references = plain.references(
        inputs.unseen,
        scored.validation,
        dynamics,
        np.array(findings.plain),
        nominal,
        inputs.options.slow,
        inputs.currents.own,
    )
    proofs = scored.proofs
    rules += plain.worse_than_plain({name: shares for name, shares in references.items() if name in proofs})
    of_proofs = {name: scored.intervals[name] for name in proofs if name in scored.intervals}
    rules += judging.too_narrow(of_proofs, labels)
    of_payloads = [item for item in findings.noticed if item.code in judging.PAYLOAD_FINDINGS]
    verdict = Verdict.of(figures, [*of_payloads, *implausible, *rules])
    verdict = judging.with_prior(verdict, findings.rests)
    verdict = judging.with_duration(verdict, scored.excitation)

    say("simulating tracking with the model as feedforward")
    replays, failure = {}, ""
    amperes: list[Finding] = []
    if inputs.unit != TORQUE:
        amperes.append(finding("torques-relative", unit=without_gains(inputs.unit)))
        verdict = verdict.for_prediction(f"torques are {without_gains(inputs.unit)}")
        failure = lines_of(amperes)[0]
    elif inputs.replayed:
        from calib.procedure.dynamic_stage.replay import track

        replays, failure = track(inputs, dynamics, scored.predictions, findings.controller)
    if any(replay.inertia_added.any() for replay in replays.values()):
        remarks = lines_of([finding("prediction-not-simulation")])
        verdict = replace(verdict, reason="; ".join([verdict.reason, *remarks]))

    noticed = [*amperes, *implausible, *rules, *overlaps(inputs.cases, inputs.unseen)]
    for case in (*inputs.cases, *inputs.unseen):
        noticed += judging.beyond(case, inputs.chain)
    noticed += judging.motion_findings(scored.validation, scored.repeated)
    for case in inputs.unseen:
        noticed += judging.extrapolates(case.name, scored.intervals.get(case.name))
    noticed += findings.noticed
    warnings = dict.fromkeys((*lines_of(noticed), *judging.excitation_notes(scored.excitation), *findings.notes))
    return DynamicsAssessment(
        fit=scored.fit,
        validation=scored.validation,
        predictions=scored.predictions,
        repeated=scored.repeated,
        excitation=scored.excitation,
        intervals=scored.intervals,
        verdict=verdict,
        warnings=tuple(warnings),
        noticed=tuple(noticed),
        tracking=replays,
        tracking_failure=failure,
        references=references,
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class IdentificationOutcome(DynamicsAssessment):
    """Outcome of an identification: the model, its errors on the recordings, its verdict, and its inputs.

    Attributes:
        inputs: robot, recordings and options.
        found: the model and how it was estimated.
        findings: findings on the model that the verdict needs in addition to the recordings.
        carried: effect of the geometry's uncertainty; None if it was not requested.
        geometries: comparison with the estimate on the nominal geometry; None if the geometry is nominal.
        errors: expected torque errors; None if too little was recorded to estimate them.
        seed: seed of all random numbers.
        jointly: geometry estimated together with the dynamics; None if it was not requested.
    """

    inputs: IdentificationInputs
    found: Identification
    findings: ModelFindings
    carried: geometry_uncertainty.GeometryUncertainty | None = None
    geometries: geometry_uncertainty.GeometryComparison | None = None
    errors: torque_errors.TorqueErrorModel | None = None
    seed: int = 0
    jointly: with_geometry.GeometryFromTorques | None = None


T = TypeVar("T", bound=IdentificationOutcome)


def run(inputs: IdentificationInputs, progress: Progress | None = None) -> IdentificationOutcome:
    """Identify a model and return it with its torque predictions for every recording, and the verdict.

    If the torques refute the stated gravity, only the standard friction model is tried, since richer friction, such as
    couplings between joints, would absorb the gravity error. Friction that an earlier identification chose is kept.

    Args:
        inputs: robot, recordings and options.
        progress: called with a text on each step; None: silent.
    """
    settings = inputs.options.settings
    hypotheses = gravity_hypotheses(inputs)
    chosen_anew = settings.friction == "auto" and settings.earlier is None
    if chosen_anew and hypotheses is not None and hypotheses.refuted:
        settings = replace(settings, friction="standard")
    if settings.with_geometry:
        inputs = replace(inputs, options=replace(inputs.options, settings=settings))
        return judged(*with_geometry.run_jointly(inputs, progress or silent), progress=progress)
    found = identify(inputs.robot, inputs.cases, settings, progress)
    return judged(inputs, found, hypotheses=hypotheses, progress=progress)


def judged(
    inputs: IdentificationInputs,
    found: Identification,
    jointly: with_geometry.GeometryFromTorques | None = None,
    hypotheses: GravityHypotheses | None = None,
    progress: Progress | None = None,
) -> IdentificationOutcome:
    """Return the outcome of a finished identification: torque predictions for every recording, errors, and the verdict.

    Args:
        inputs: robot, recordings and options.
        found: the identification.
        jointly: geometry estimated together with the dynamics; None if it was not requested.
        hypotheses: result of `gravity_hypotheses` for these inputs; None: computed.
        progress: called with a text on each step; None: silent.

    Raises:
        MeasurementError: if the identified friction accelerates most joints instead of braking them.
    """
    say = progress or silent
    # refused before hours go into the geometry's share
    wrong = driven(found.dynamics, inputs.cases)
    carried, geometries = _carry(inputs, found, say)
    noticed = judging.model_findings(inputs.cases, found)
    if jointly is not None:
        noticed = [*noticed, *jointly.noticed]
        if jointly.delivered:
            carried = with_geometry.with_covariance(carried, jointly)
    say("errors on held-out time")
    errors = learn_torque_errors(found, inputs.cases, carried.covariance)
    findings = ModelFindings(
        rests=judging.resting_parameters(found),
        noticed=tuple(noticed),
        controller=found.loop.controller,
        errors=None if errors is None else errors.discrepancy,
        contradiction=contradiction(found, inputs.chain) if inputs.unit == TORQUE else None,
        unlike=found.loop.disagreement,
        plain=tuple(plain.plain_values(found).tolist()),
    )
    assessment = assess(inputs, found.dynamics, findings, errors, wrong, hypotheses, progress=say)
    return IdentificationOutcome(
        **field_values(assessment),
        inputs=inputs,
        found=found,
        findings=findings,
        carried=carried,
        geometries=geometries,
        errors=errors,
        seed=found.settings.seed,
        jointly=jointly,
    )


def assessed(outcome: T, inputs: IdentificationInputs) -> T:
    """Return an outcome with the predictions of its unchanged model for the recordings of `inputs`, and the verdict."""
    stage = stage_of(inputs.robot, "identify")
    if stage is not None and stage.judge is not None:
        assessment = stage.judge(inputs, outcome.found, outcome.findings)
    else:
        assessment = assess(inputs, outcome.found.dynamics, outcome.findings, outcome.errors)
    return replace(outcome, inputs=inputs, **field_values(assessment))


def _carry(
    inputs: IdentificationInputs, identification: Identification, say: Progress
) -> tuple[geometry_uncertainty.GeometryUncertainty, geometry_uncertainty.GeometryComparison | None]:
    """Return the effect of the geometry's uncertainty on the estimate, and the comparison with the nominal geometry.

    The comparison is None if the robot's geometry is the nominal one.

    Args:
        inputs: robot and recordings.
        identification: the identified model.
        say: called with a text on each step.
    """
    carried = geometry_uncertainty.propagate(identification, inputs.robot, inputs.cases, say)
    if inputs.robot.nominal is None or not inputs.robot.moved:
        return carried, None
    say("identification on the nominal geometry")
    return carried, geometry_uncertainty.compare(identification, carried, inputs.robot.nominal, inputs.cases)
