"""Assessment of a model on recordings: predictions, errors, and the verdict.

`assess` returns the same result for a new model and for one read from its folder.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from os.path import realpath

import numpy as np

from calib.data.signals.persistency import ExcitationReport, repeats, report_excitation
from calib.errors import CalibError, Finding, finding
from calib.identification.checks.recording_sizes import compare_sizes, signs_of
from calib.identification.friction.passivity import driven
from calib.identification.loop.replay import Replay, replay
from calib.identification.methods.bias import LoopDisagreement
from calib.identification.possible.solve import Contradiction
from calib.identification.prediction import Dynamics, predict
from calib.identification.rows import Case
from calib.identification.scores import Score, score
from calib.identification.uncertainty.torque_errors import (
    TorqueDiscrepancy,
    TorqueErrorModel,
    TorqueIntervals,
    intervals,
)
from calib.procedure.dynamic_stage import plausibility
from calib.procedure.dynamic_stage.inputs import IdentificationInputs, Progress
from calib.procedure.dynamic_stage.verdict import (
    Resting,
    beyond,
    excitation_notes,
    extrapolates,
    friction_drives,
    judge,
    motion_findings,
    too_narrow,
    with_duration,
    with_prior,
)
from calib.procedure.findings import Verdict, lines_of, settle
from calib.simulation.loop.controllers import Controller
from calib.units import TORQUE, without_gains

REPEAT = 0.5  # share of states met in training from which on a validation file proves nothing (our choice)


MAX_REPLAYS = 3  # recordings that are replayed


@dataclass(frozen=True, eq=False)
class Tracking:
    """Result of replaying recordings.

    Attributes:
        replays: one per recording.
        failure: reason for a missing replay.
    """

    replays: tuple[Replay, ...] = ()
    failure: str = ""


@dataclass(frozen=True, eq=False)
class ModelFindings:
    """Findings of an identification that the verdict needs besides the recordings; stored in its folder.

    Attributes:
        rests: its parameters that rest on a prior.
        notes: remarks on the model in folders of earlier versions, as text.
        noticed: findings on the model, whatever the unseen recordings are.
        controller: that was stated or identified; None without any.
        errors: what makes errors of its torques likely; None where too little was recorded to say.
        contradiction: its distance from every physically consistent robot; None if unknown.
        unlike: how recorded torques refute an estimate that takes the loop for granted; None where they do not.
    """

    rests: Resting
    notes: tuple[str, ...] = ()
    noticed: tuple[Finding, ...] = ()
    controller: Controller | None = None
    errors: TorqueDiscrepancy | None = None
    contradiction: Contradiction | None = None
    unlike: LoopDisagreement | None = None


@dataclass(frozen=True, eq=False)
class Assessment:
    """Errors of a model on the recordings, and the verdict.

    Attributes:
        fit, validation: case name → its score.
        predictions: case name → predicted torques (N, rows) at the full rate.
        repeated: validation case → share of its states that the training motion has been in, where it is no proof.
        excitation: case name → what the motion can identify.
        verdict: as of `calib.procedure.dynamic_stage.verdict`.
        warnings: what a user should know of the recordings, and of the model.
        noticed: the findings behind the warnings.
        tracking: with the model fed forward.
        intervals: unseen case (without any, the first of the training) → what errors were expected there, and found.
    """

    fit: Mapping[str, Score]
    validation: Mapping[str, Score]
    predictions: Mapping[str, np.ndarray]
    repeated: Mapping[str, float]
    excitation: Mapping[str, ExcitationReport]
    verdict: Verdict
    warnings: tuple[str, ...]
    noticed: tuple[Finding, ...]
    tracking: Tracking = Tracking()
    intervals: Mapping[str, TorqueIntervals] = field(default_factory=dict)


def repeated_motion(cases: Sequence[Case], unseen: Sequence[Case]) -> dict[str, float]:
    """Return the unseen recordings that repeat training motion: name → share of their states in the training."""
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


def assess(
    inputs: IdentificationInputs,
    dynamics: Dynamics,
    findings: ModelFindings,
    errors: TorqueErrorModel | None = None,
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
    predictions, scores = {}, {}
    for case in (*inputs.cases, *inputs.unseen):
        say(f"predicting {case.name}")
        predictions[case.name] = predict(dynamics, case)
        scores[case.name] = score(case, predictions[case.name], inputs.options.slow, inputs.currents.own)
    expected: dict[str, TorqueIntervals] = {}
    if errors is not None:
        for case in inputs.unseen or inputs.cases[:1]:
            say(f"errors to expect of {case.name}")
            expected[case.name] = intervals(errors, dynamics, case, predictions[case.name])
    say("judging")
    repeated = repeated_motion(inputs.cases, inputs.unseen)
    excitation = {case.name: report_excitation(case.motion) for case in inputs.cases}
    fit = {case.name: scores[case.name] for case in inputs.cases}
    stated = {name: one.coverage() for name, one in expected.items()}
    validation = {
        case.name: replace(scores[case.name], evidence=case.name not in repeated, interval95=stated.get(case.name))
        for case in inputs.unseen
    }
    proofs = {name: one for name, one in validation.items() if name not in repeated}
    settings = inputs.options.settings
    labels = settings.torque_rows.numbered(inputs.chain.n)
    sizes = [compare_sizes(case, inputs.chain, settings.gravity, inputs.unit == TORQUE) for case in inputs.cases]
    odd = plausibility.findings(sizes, inputs.chain.joint_names) + plausibility.impossible(findings.contradiction)
    odd += plausibility.another_loop(findings.unlike) + plausibility.described(inputs.chain)
    signs = {case.name: signs_of(case, inputs.chain, settings.gravity) for case in (*inputs.cases, *inputs.unseen)}
    odd += plausibility.wrong_joints(signs, inputs.chain.joint_names)
    odd = settle(odd, inputs.options.accept)
    figures, rules = judge(fit, proofs, repeated, excitation, labels)
    if drives := friction_drives(joint + 1 for joint in wrong):
        figures, rules = "", drives
    rules += too_narrow({name: expected[name] for name in proofs if name in expected}, labels)
    verdict = with_duration(with_prior(Verdict.of(figures, [*odd, *rules]), findings.rests), excitation)
    say("tracking with the model fed forward")
    relative = inputs.unit != TORQUE
    amperes = [finding("torques-relative", unit=without_gains(inputs.unit))] if relative else []
    tracking = (
        Tracking(failure=lines_of(amperes)[0]) if relative
        else track(inputs, dynamics, predictions, findings.controller)
    )  # fmt: skip
    if any(one.inertia_added.any() for one in tracking.replays):
        use = lines_of([finding("prediction-not-simulation")])
        verdict = replace(verdict, reason="; ".join([verdict.reason, *use]))
    if relative:
        verdict = verdict.for_prediction(f"torques are {without_gains(inputs.unit)}")
    noticed = (
        *amperes, *odd, *rules, *overlaps(inputs.cases, inputs.unseen),
        *(one for case in (*inputs.cases, *inputs.unseen) for one in beyond(case, inputs.chain)),
        *motion_findings(validation, repeated),
        *(one for name in validation if name in expected for one in extrapolates(name, expected[name])),
        *findings.noticed,
    )  # fmt: skip
    said = dict.fromkeys((*lines_of(noticed), *excitation_notes(excitation), *findings.notes))
    return Assessment(
        fit, validation, predictions, repeated, excitation, verdict, tuple(said), noticed, tracking, expected
    )


def track(
    inputs: IdentificationInputs,
    dynamics: Dynamics,
    predictions: Mapping[str, np.ndarray],
    controller: Controller | None = None,
) -> Tracking:
    """Return replays of unseen recordings (else of a training recording); see `calib.identification.loop.replay`.

    Args:
        predictions: case name → torques by the model.
        controller: that was identified, where the loop's is not stated.
    """
    chain, chosen = inputs.chain, list(inputs.unseen)[:MAX_REPLAYS] or list(inputs.cases)[:1]
    loop = inputs.options.settings.loop if inputs.unit == "N m" else None
    read = None if loop is None else controller
    try:
        if loop is not None and loop.controller != "identify":
            read = loop.stated_controller(chain.n)
        rate = None if read is None or loop is None else loop.rate
        replays = (replay(chain, dynamics, case, predictions[case.name], read, rate) for case in chosen)
        return Tracking(tuple(replace(one, unseen=bool(inputs.unseen)) for one in replays))
    except CalibError as error:
        return Tracking(failure=str(error))
