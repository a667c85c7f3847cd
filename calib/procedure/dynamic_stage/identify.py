"""Identification of the guided procedure: the model, its errors on the recordings, and the verdict.

`assess` returns the same result for a new model and for one read from its folder.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from os.path import realpath
from typing import Any, TypeVar

import numpy as np

from calib.data.signals.persistency import ExcitationReport, repeats, report_excitation
from calib.errors import Finding, finding
from calib.identification.friction.passivity import driven
from calib.identification.identify import Identification, identify
from calib.identification.loop import Controller, LoopDisagreement, Replay
from calib.identification.physical_consistency.solve import Contradiction, contradiction
from calib.identification.prediction import Dynamics, Score, predict, score
from calib.identification.rows import Case
from calib.identification.uncertainty import geometry_uncertainty, torque_errors
from calib.procedure.dynamic_stage import plain, plausibility
from calib.procedure.dynamic_stage import verdict as judging
from calib.procedure.dynamic_stage.hypotheses import gravity_hypotheses
from calib.procedure.dynamic_stage.inputs import IdentificationInputs, Progress
from calib.procedure.findings import Verdict, lines_of
from calib.procedure.robot_kinds import stage_of
from calib.units import TORQUE, without_gains

REPEAT = 0.5  # share of states met in training from which on a validation file proves nothing (our choice)


@dataclass(frozen=True, eq=False)
class ModelFindings:
    """Findings of an identification that the verdict needs in addition to the recordings; stored in its folder.

    Attributes:
        rests: its parameters that rest on a prior.
        notes: remarks on the model in folders of earlier versions, as text.
        noticed: findings on the model, whatever the unseen recordings are.
        controller: that was stated or identified; None without any.
        errors: what makes errors of its torques likely; None where too little was recorded to say.
        contradiction: its distance from every physically consistent robot; None if unknown.
        unlike: how recorded torques refute an estimate that takes the loop for granted; None where they do not.
        plain: (p,) the model's parameters by plain least squares; () in files of earlier versions.
    """

    rests: judging.Resting
    notes: tuple[str, ...] = ()
    noticed: tuple[Finding, ...] = ()
    controller: Controller | None = None
    errors: torque_errors.TorqueDiscrepancy | None = None
    contradiction: Contradiction | None = None
    unlike: LoopDisagreement | None = None
    plain: tuple[float, ...] = ()


@dataclass(frozen=True, eq=False)
class Errors:
    """Errors of a model on the recordings.

    Attributes:
        fit, validation: case name → its score.
        predictions: case name → predicted torques (N, rows) at the full rate.
        repeated: validation case → share of its states that the training motion has been in, where it is no proof.
        excitation: case name → what the motion can identify.
        intervals: unseen case (without any, the first of the training) → the errors expected there.
    """

    fit: Mapping[str, Score]
    validation: Mapping[str, Score]
    predictions: Mapping[str, np.ndarray]
    repeated: Mapping[str, float]
    excitation: Mapping[str, ExcitationReport]
    intervals: Mapping[str, torque_errors.TorqueIntervals]

    @property
    def proofs(self) -> dict[str, Score]:
        """Scores on unseen recordings by name, without repeats of the training motion."""
        return {name: one for name, one in self.validation.items() if one.evidence}


@dataclass(frozen=True, eq=False, kw_only=True)
class Assessment(Errors):
    """Errors of a model on the recordings, and the verdict.

    Attributes:
        verdict: as of `calib.procedure.dynamic_stage.verdict`.
        warnings: what a user should know of the recordings, and of the model.
        noticed: the findings behind the warnings.
        tracking: by recording, the replays with the model fed forward.
        tracking_failure: reason for missing replays.
        references: by unseen recording, the errors of plain references beside the model's.
    """

    verdict: Verdict
    warnings: tuple[str, ...]
    noticed: tuple[Finding, ...]
    tracking: Mapping[str, Replay] = field(default_factory=dict)
    tracking_failure: str = ""
    references: Mapping[str, plain.PlainReferences] = field(default_factory=dict)


def repeated_motion(cases: Sequence[Case], unseen: Sequence[Case]) -> dict[str, float]:
    """Return, for each unseen recording that repeats training motion, the share of its states found in the training."""
    shares = {case.name: max(repeats(own.motion, case.motion) for own in cases) for case in unseen}
    return {name: share for name, share in shares.items() if share >= REPEAT}


def overlaps(cases: Sequence[Case], unseen: Sequence[Case]) -> list[Finding]:
    """Return the findings on samples that are both unseen and training data."""
    found = []
    for case, own in product(unseen, cases):
        first, last = max(case.motion.t[0], own.motion.t[0]), min(case.motion.t[-1], own.motion.t[-1])
        if own.motion.file and realpath(case.motion.file) == realpath(own.motion.file) and first < last:
            found.append(finding("unseen-overlaps", file=case.name, training=own.name, first=first, last=last))
    return found


def errors_of(
    inputs: IdentificationInputs,
    dynamics: Dynamics[Any],
    errors: torque_errors.TorqueErrorModel | None = None,
    say: Progress = lambda words: None,
) -> Errors:
    """Return the predictions of every recording by a model, and their errors.

    Args:
        errors: the model's expected torque errors, for the intervals.
    """
    predictions, scores = {}, {}
    for case in (*inputs.cases, *inputs.unseen):
        say(f"predicting {case.name}")
        predictions[case.name] = predict(dynamics, case)
        scores[case.name] = score(case, predictions[case.name], inputs.options.slow, inputs.currents.own)
    expected: dict[str, torque_errors.TorqueIntervals] = {}
    if errors is not None:
        for case in inputs.unseen or inputs.cases[:1]:
            say(f"estimating the errors of {case.name}")
            expected[case.name] = torque_errors.intervals(errors, dynamics, case, predictions[case.name])
    repeated = repeated_motion(inputs.cases, inputs.unseen)
    stated = {name: one.coverage() for name, one in expected.items()}
    validation = {
        case.name: replace(scores[case.name], evidence=case.name not in repeated, interval95=stated.get(case.name))
        for case in inputs.unseen
    }
    fit = {case.name: scores[case.name] for case in inputs.cases}
    excitation = {case.name: report_excitation(case.motion) for case in inputs.cases}
    return Errors(fit, validation, predictions, repeated, excitation, expected)


def assess(
    inputs: IdentificationInputs,
    dynamics: Dynamics,
    findings: ModelFindings,
    errors: torque_errors.TorqueErrorModel | None = None,
    wrong: Sequence[int] | None = None,
    progress: Progress | None = None,
) -> Assessment:
    """Return the predictions of every recording by a model, their errors, and the verdict.

    Args:
        inputs: training recordings (for the model's own error) and unseen ones.
        dynamics: the model.
        findings: what is known of it.
        errors: what errors its torques are expected to have.
        wrong: joints that friction drives, where that is known already (`friction.passivity.driven`).
    """
    say = progress or (lambda words: None)
    wrong = driven(dynamics, inputs.cases) if wrong is None else wrong
    found = errors_of(inputs, dynamics, errors, say)
    say("judging")
    labels = inputs.options.settings.torque_rows.numbered(inputs.chain.n)
    odd = plausibility.implausible(inputs, findings.contradiction, findings.unlike)
    figures, rules = judging.judge(found.fit, found.proofs, found.repeated, found.excitation, labels)
    if drives := judging.friction_drives(joint + 1 for joint in wrong):
        figures, rules = "", drives
    nominal = plain.nominal_values(inputs.chain, dynamics) if inputs.unit == TORQUE else None
    beside = plain.references(
        inputs.unseen,
        found.validation,
        dynamics,
        np.array(findings.plain),
        nominal,
        inputs.options.slow,
        inputs.currents.own,
    )
    rules += plain.worse_than_plain({name: one for name, one in beside.items() if name in found.proofs})
    rules += judging.too_narrow(
        {name: found.intervals[name] for name in found.proofs if name in found.intervals}, labels
    )
    verdict = judging.with_duration(
        judging.with_prior(Verdict.of(figures, [*odd, *rules]), findings.rests), found.excitation
    )
    say("simulating tracking with the model as feedforward")
    relative = inputs.unit != TORQUE
    amperes = [finding("torques-relative", unit=without_gains(inputs.unit))] if relative else []
    replays, failure = {}, ""
    if inputs.replayed and not relative:
        from calib.procedure.dynamic_stage.replay import track

        replays, failure = track(inputs, dynamics, found.predictions, findings.controller)
    if any(one.inertia_added.any() for one in replays.values()):
        use = lines_of([finding("prediction-not-simulation")])
        verdict = replace(verdict, reason="; ".join([verdict.reason, *use]))
    if relative:
        verdict, failure = verdict.for_prediction(f"torques are {without_gains(inputs.unit)}"), lines_of(amperes)[0]
    noticed = (
        *amperes,
        *odd,
        *rules,
        *overlaps(inputs.cases, inputs.unseen),
        *(one for case in (*inputs.cases, *inputs.unseen) for one in judging.beyond(case, inputs.chain)),
        *judging.motion_findings(found.validation, found.repeated),
        *(one for case in inputs.unseen for one in judging.extrapolates(case.name, found.intervals.get(case.name))),
        *findings.noticed,
    )
    said = dict.fromkeys((*lines_of(noticed), *judging.excitation_notes(found.excitation), *findings.notes))
    return Assessment(
        **vars(found),
        verdict=verdict,
        warnings=tuple(said),
        noticed=noticed,
        tracking=replays,
        tracking_failure=failure,
        references=beside,
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class IdentificationOutcome(Assessment):
    """Outcome of an identification: the model, its errors on the recordings, its verdict, and its inputs.

    Attributes:
        inputs: robot, recordings and options.
        found: the model and its estimation.
        findings: findings on the model that the verdict needs besides the recordings.
        carried: effect of the geometry's uncertainty; None if it was not requested.
        geometries: comparison with the estimate on the nominal geometry; None if the geometry is nominal.
        errors: expected torque errors; None if too little was recorded to estimate them.
        seed: of all random numbers.
    """

    inputs: IdentificationInputs
    found: Identification
    findings: ModelFindings
    carried: geometry_uncertainty.GeometryUncertainty | None = None
    geometries: geometry_uncertainty.GeometryComparison | None = None
    errors: torque_errors.TorqueErrorModel | None = None
    seed: int = 0


T = TypeVar("T", bound=IdentificationOutcome)


def run(inputs: IdentificationInputs, progress: Progress | None = None) -> IdentificationOutcome:
    """Return the outcome of an identification: the model, its prediction of every recording, and the verdict.

    Where the torques refute gravity as stated, no richer friction is tried: couplings would take its place.
    """
    settings = inputs.options.settings
    hypotheses = gravity_hypotheses(inputs)
    if settings.friction == "auto" and hypotheses is not None and hypotheses.refuted:
        settings = replace(settings, friction="standard")
    return judged(inputs, identify(inputs.robot, inputs.cases, settings, progress), progress)


def judged(
    inputs: IdentificationInputs, found: Identification, progress: Progress | None = None
) -> IdentificationOutcome:
    """Return the outcome of a finished identification: predictions of every recording, errors, and the verdict.

    Raises:
        MeasurementError: where friction would drive most joints.
    """
    say = progress or (lambda words: None)
    wrong = driven(found.dynamics, inputs.cases)  # refused before hours go into the geometry's share
    carried, geometries = _carry(inputs, found, say)
    say("errors on held-out time")
    errors = torque_errors.learn_torque_errors(found, inputs.cases, carried.covariance)
    findings = ModelFindings(
        judging.resting_parameters(found),
        (),
        judging.model_findings(inputs.cases, found),
        found.loop.controller,
        errors and errors.discrepancy,
        contradiction(found, inputs.chain) if inputs.unit == TORQUE else None,
        found.loop.disagreement,
        tuple(plain.plain_values(found).tolist()),
    )
    result = assess(inputs, found.dynamics, findings, errors, wrong, progress=say)
    return IdentificationOutcome(
        **vars(result),
        inputs=inputs,
        found=found,
        findings=findings,
        carried=carried,
        geometries=geometries,
        errors=errors,
        seed=found.settings.seed,
    )


def assessed(outcome: T, inputs: IdentificationInputs) -> T:
    """Return an outcome with a new verdict on the unseen recordings of `inputs`; nothing is identified."""
    if (stage := stage_of(inputs.robot, "identify")) is not None and stage.judge is not None:
        result = stage.judge(inputs, outcome.found, outcome.findings)
    else:
        result = assess(inputs, outcome.found.dynamics, outcome.findings, outcome.errors)
    return replace(outcome, inputs=inputs, **vars(result))


def _carry(
    inputs: IdentificationInputs, found: Identification, say: Progress
) -> tuple[geometry_uncertainty.GeometryUncertainty, geometry_uncertainty.GeometryComparison | None]:
    """Return the effect of the geometry's uncertainty on the estimate, and the comparison with the nominal geometry."""
    carried = geometry_uncertainty.propagate(found, inputs.robot, inputs.cases, say)
    if inputs.robot.nominal is None or not inputs.robot.moved:
        return carried, None
    say("identification on the nominal geometry")
    return carried, geometry_uncertainty.compare(found, carried, inputs.robot.nominal, inputs.cases)
