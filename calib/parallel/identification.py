"""Identification of a parallel robot from encoders and motor torques: platform, actuator or power rows."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import fields, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from calib.api.dynamic import DynamicsModel
from calib.data.recordings.recording import Recording
from calib.dynamics.regressor_model import RegressorModel
from calib.errors import Finding, UsageError, finding
from calib.estimation.whiteness import inflation
from calib.identification.checks.recorded_motion import DesignedMotion
from calib.identification.friction.passivity import MIN_ENERGY_SHARE
from calib.identification.identify import Identification, identify_model
from calib.identification.identify_options import IdentifyOptions
from calib.identification.loop import per_joint
from calib.identification.methods.method import Method
from calib.identification.registry import METHODS, method_named
from calib.identification.rows import Case
from calib.identification.settings import IdentificationSettings
from calib.parallel.geometry_share import propagate
from calib.parallel.identical_legs import legs_differ
from calib.parallel.mechanism.closure import ClosedRobot
from calib.parallel.mechanism.parallel_model import PLATFORM, ParallelModel, make_parallel_model, rows_named
from calib.parallel.mechanism.velocities import loop_jacobians, overconstraint
from calib.parallel.robots import ParallelMechanism, refuse_unread
from calib.procedure.dynamic_stage.identify import DynamicsAssessment, ModelFindings, RecordingErrors, errors_of
from calib.procedure.dynamic_stage.inputs import IdentificationInputs, gather
from calib.procedure.dynamic_stage.verdict import (
    PAYLOAD_FINDINGS,
    excitation_notes,
    friction_drives,
    judge,
    motion_findings,
    parameter_findings,
    resting_parameters,
    with_duration,
    with_prior,
)
from calib.procedure.findings import Verdict, lines_of, settle
from calib.records import as_numbers, field_values, shaped
from calib.robot.calibrated import like_joints
from calib.workers.threads import one_blas_thread

# Names of settings that apply to serial arms only.
OF_ARMS = {"couplings", "terms", "gravity", "payload_values"}
# Methods whose simulation is available for parallel robots.
SIMULATED = ("iv", "didim", "pc-iv", "pc-didim", "cloe", "clie")
# Number of samples of a recording at which redundant encoders are compared.
MAX_SAMPLES = 200

Recorded = str | Path | Recording


class ParallelDynamics(DynamicsModel):
    """Identified dynamics of a parallel robot, as `calib.identify_dynamics` returns them."""

    @one_blas_thread()
    def torques(self, q: ArrayLike, v: ArrayLike, a: ArrayLike) -> np.ndarray:
        """Return the torques that the model predicts without payload: (N, rows) of a motion, (rows,) of one state.

        The rows are those of the identification: torques of the actuators [N m or N], forces on the platform's
        coordinates [N or N m] (always for redundant actuators), or the actuators' power [W].

        Args:
            q, v, a: (N, n) or (n,) positions, velocities and accelerations of the actuated joints.

        Raises:
            CalibError: an array of a wrong shape.
        """
        dynamics: Any = self.found.dynamics
        count = dynamics.model.mechanism.robot.n
        positions = shaped(np.atleast_2d(as_numbers(q, "q")), (None, count), "q")
        velocities = shaped(np.atleast_2d(as_numbers(v, "v")), positions.shape, "v")
        accelerations = shaped(np.atleast_2d(as_numbers(a, "a")), positions.shape, "a")
        torques = dynamics.model.torque(dynamics.values, positions, velocities, accelerations, ())
        return like_joints(q, torques)


def identify_parallel(
    robot: ParallelMechanism,
    recordings: Sequence[Recorded],
    validate: Sequence[Recorded] = (),
    *,
    options: IdentifyOptions | None = None,
    method: str | None = None,
    friction: str | None = None,
    seed: int = 0,
    designed: Sequence[DesignedMotion] = (),
    on_read: Callable[[IdentificationInputs], None] | None = None,
    progress: Callable[[str], None] | None = None,
) -> ParallelDynamics:
    """Return the identified dynamics of a parallel robot from recordings of its actuated joints, with a verdict.

    Args:
        robot: the robot.
        recordings: recordings to fit: files (optionally with a cut in time), or recordings in memory.
        validate: recordings to judge by, in the same form.
        options: filters, payloads, drives, method; ``rows``: motor (on the platform's coordinates where actuators are
            redundant) or power; ``passive``: friction of the passive joints.
        method, friction: replace those of the options; None: the options' method and friction.
        seed: seed of random samples and folds.
        designed: motions of `calib excite` that serve as references of recordings without reference, for options with a
            [loop].
        on_read: function called with the inputs once they are read; None: none.
        progress: function called with a line of text; None: none.

    Raises:
        UsageError: for options that apply to serial arms only.
        MeasurementError: for invalid recordings.
    """
    options = options or IdentifyOptions()
    mechanism = robot.mechanism
    row_kind = options.settings.torque_rows.name
    if row_kind == "motor":
        row_kind = ""
    rows = rows_named(mechanism, row_kind)
    settings = replace(options.settings, torque_rows=rows, seed=seed)
    if method is not None:
        settings = replace(settings, method=method)
    if friction is not None:
        settings = replace(settings, friction=friction)
    options = replace(options, settings=settings)
    refuse_options_of_arms(settings, options)
    inputs = gather(robot, recordings, validate, options=options, seed=seed, designed=designed, progress=progress)
    if on_read is not None:
        on_read(inputs)
    model = model_of(mechanism, settings)
    identification: Any = identify_model(model, inputs.cases, settings, cad=model.known_parameters(), progress=progress)
    noticed = [*_payloads(model, inputs.cases)]
    if settings.identical_legs:
        noticed += legs_differ(identification, inputs.cases)
    if mechanism.robot.redundant:
        noticed.append(finding("torques-projected", actuators=mechanism.robot.n, freedoms=mechanism.robot.r))
        means = []
        for case in inputs.cases:
            preload = _preload(mechanism, inputs, case)
            noticed += preload
            means.append([item.values["mean"] for item in preload])
        mean = np.mean(means, axis=0)
        preloaded = replace(model, preload=tuple(mean.tolist()))
        dynamics = replace(identification.dynamics, model=preloaded)
        identification = replace(identification, dynamics=dynamics)
    noticed = (*parameter_findings(identification), *identification.loop.findings, *settle(noticed))
    findings = ModelFindings(resting_parameters(identification), noticed=noticed)
    assessment = assess(inputs, identification, findings)
    carried = None
    if robot.covariance is not None:
        if progress is not None:
            progress("the geometry's share of the covariance")
        torques = partial(actuator_torques, inputs)
        carried = propagate(identification, robot.covariance, inputs.cases, torques, progress)
    return ParallelDynamics(
        **field_values(assessment),
        inputs=inputs,
        found=identification,
        findings=findings,
        carried=carried,
        seed=settings.seed,
    )


def model_of(mechanism: ClosedRobot, settings: IdentificationSettings) -> ParallelModel:
    """Return the model of a robot with the bodies, terms and torque rows of the settings."""
    v0 = per_joint(settings.v0, 1, "v0")[0]
    return make_parallel_model(
        mechanism,
        settings.sets,
        v0,
        settings.torque_rows,
        tuple(settings.payloads),
        settings.passive,
        settings.identical_legs,
    )


def actuator_torques(inputs: IdentificationInputs, case: Case) -> np.ndarray:
    """Return the torques (N, n) of the actuators in a recording [N m or N; A without known gains]."""
    motion = case.motion
    file_settings = inputs.options.file_settings(motion.file)
    gains = inputs.currents.for_motion(motion, file_settings)
    if gains is None:
        return np.asarray(motion.effort)
    return np.asarray(motion.effort * gains)


def _preload(mechanism: ClosedRobot, inputs: IdentificationInputs, case: Case) -> list[Finding]:
    """Return findings on the overconstraint of redundant actuators in a recording.

    The overconstraint is the part of the torques that does no work. A finding per component states its mean with σ, and
    its standard deviation over the recording.
    """
    motion = case.motion
    posture = mechanism.locate(motion.q)
    jacobians = loop_jacobians(mechanism, posture)
    torques = actuator_torques(inputs, case)
    forces = overconstraint(mechanism, jacobians, torques)
    forces = motion.in_band(forces)[:: motion.decimator.factor]
    unit = "N m"
    if mechanism.robot.joints[0].kind == "prismatic":
        unit = "N"
    findings = []
    for number, force in enumerate(forces.T, 1):
        mean = force.mean()
        spread = force.std()
        # Samples are correlated: σ of the mean follows from the number of independent samples.
        variance_ratio = inflation(force) / len(force)
        sigma = spread * np.sqrt(variance_ratio)
        preload = finding("preload", file=case.name, number=number, mean=mean, spread=spread, unit=unit, sigma=sigma)
        findings.append(preload)
    return findings


def assess(
    inputs: IdentificationInputs, identification: Identification[RegressorModel], findings: ModelFindings
) -> DynamicsAssessment:
    """Return the prediction errors of a model on all recordings, with the verdict and its findings."""
    model = identification.dynamics.model
    cases = inputs.cases
    unseen = inputs.unseen
    assert isinstance(model, ParallelModel)
    errors = errors_of(inputs, identification.dynamics)
    verdict, rules = _judged(model, identification, cases, errors)
    motion = motion_findings(errors.validation, errors.repeated)
    encoders = settle(_encoders(model.mechanism, (*cases, *unseen)))
    noticed = (*rules, *motion, *findings.noticed, *encoders)
    notes = (*lines_of(noticed), *excitation_notes(errors.excitation), *findings.notes)
    return DynamicsAssessment(**field_values(errors), verdict=verdict, warnings=notes, noticed=noticed)


def _judged(
    model: ParallelModel, identification: Identification[RegressorModel], cases: Sequence[Case], errors: RecordingErrors
) -> tuple[Verdict, list[Finding]]:
    """Return the verdict on an identification, and the findings on which it is based."""
    driven = _driven_joints(model, identification, cases)
    drives = friction_drives(driven, "a payload that the options do not name")
    if drives:
        return Verdict.of("", drives), drives
    labels = identification.settings.torque_rows.titles(model.mechanism.robot.joint_names)
    kind = "joint"
    if model.torque_rows.name == PLATFORM:
        kind = "platform"
    figures, rules = judge(errors.fit, errors.proofs, errors.repeated, errors.excitation, labels, kind)
    resting = resting_parameters(identification)
    of_payloads = [item for item in parameter_findings(identification) if item.code in PAYLOAD_FINDINGS]
    verdict = with_prior(Verdict.of(figures, [*of_payloads, *rules]), resting)
    return with_duration(verdict, errors.excitation), rules


def _driven_joints(
    model: ParallelModel, identification: Identification[RegressorModel], cases: Sequence[Case]
) -> tuple[str, ...]:
    """Return the names of joints whose identified friction would feed energy into the motion."""
    joints: list[str] = []
    for leg in model.mechanism.robot.legs:
        joints += leg.chain.joint_names
    inertial = [False] * model.inertial
    dissipative = [column.form.dissipative for column in model.columns]
    friction = np.array(inertial + dissipative)
    values = np.where(friction, identification.dynamics.values, 0.0)
    energy = np.zeros(len(joints))
    total = 0.0
    for case in cases:
        step = max(1, len(case.motion) // (10 * MAX_SAMPLES))
        v = case.motion.v[::step]
        motion = model.moved(case.motion.q[::step], v, case.motion.a[::step])
        target = case.target[::step]
        # power of the target's forces; the target of power rows is a power
        power = target
        if case.torque_rows.name == PLATFORM:
            power = target * motion.rate
        elif target.shape[1] == model.n:
            power = target * v
        total += np.abs(power.sum(axis=1)).sum()
        friction_torque = model.tree_torque(values, motion)
        energy += (friction_torque * motion.v).sum(axis=0)
    min_energy = MIN_ENERGY_SHARE * total
    return tuple(name for name, joint_energy in zip(joints, energy) if joint_energy < min_energy)


def refuse_options_of_arms(settings: IdentificationSettings, options: IdentifyOptions) -> None:
    """Raise UsageError for settings and options that apply to serial arms only."""
    names = {field.name for field in fields(settings)}
    read = names - OF_ARMS
    refuse_unread(settings, IdentificationSettings(), read, options.source)
    if settings.friction not in ("auto", "standard"):
        raise UsageError(
            f"friction = '{settings.friction}': a parallel robot has standard friction only (Fv Fc off): remove the key"
        )
    method = method_named(settings.method)
    if _of_arms(method):
        activity = "differentiates the torques of"
        if method.needs_simulation:
            activity = "simulates"
        available = [name for name, candidate in METHODS.items() if not _of_arms(candidate)]
        accepted = ", ".join(available)
        raise UsageError(f"method '{method.name}' {activity} a serial arm; parallel robots take {accepted}")


def _of_arms(method: Method) -> bool:
    """Return whether a method requires the model of a serial arm."""
    return method.name in ("ml", "gtls") or (method.needs_simulation and method.name not in SIMULATED)


def _encoders(mechanism: ClosedRobot, cases: Sequence[Case]) -> Iterator[Finding]:
    """Yield findings on contradictory redundant encoders, and on columns of passive joints, which are not used."""
    robot = mechanism.robot
    passive: list[str] = []
    for leg in robot.legs:
        passive += [name for name in leg.chain.joint_names if name not in robot.joint_names]
    for case in cases:
        step = max(1, len(case.motion) // MAX_SAMPLES)
        q = case.motion.q[::step]
        difference = 0.0
        if robot.redundant:
            closed_q = mechanism.locate(q).q[:, robot.actuated]
            mean_square = np.mean((q - closed_q) ** 2)
            difference = float(np.sqrt(mean_square))
        yield finding("encoders-contradict", file=case.name, count=robot.n, rms=difference)
        unread_notes = [note for note in case.motion.notes if note.startswith("not read: ")]
        unread = " ".join(unread_notes)
        unread_names = [name for name in passive if name in unread]
        if unread_names:
            yield finding("passive-joints-unread", file=case.name, joints=unread_names)


def _payloads(model: ParallelModel, cases: Sequence[Case]) -> Iterator[Finding]:
    """Yield findings on payloads that are attached in all recordings, or in none."""
    for label in model.payloads:
        count = sum(label in case.carried for case in cases)
        if count == 0:
            yield finding("payload-never", label=label)
        elif count == len(cases):
            yield finding("payload-always", label=label)
