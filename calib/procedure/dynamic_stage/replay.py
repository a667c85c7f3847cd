"""Benefit of the model as feedforward in a controller: simulated tracking errors on recorded motion.

The real robot is replaced by a simulated robot. Along the recorded motion, the simulated robot requires exactly the
measured torque: it is the identified model, on which the torque not explained by the model acts as a disturbance,

    M(q) a + … = tau + (tau_model(q_r, v_r, a_r) - tau_measured), tau = feedback + feedforward,

where the reference (q_r, v_r, a_r) is the filtered recorded motion. A robot that follows the reference needs exactly
the torque tau_measured. Four feedforwards are compared: none; the inertias of the robot's description (CAD) without
friction; the complete identified model; and the measured torque, whose tracking error is the least that the control
period allows. On held-out motion, the whole model error acts as the disturbance, although the simulated robot is the
model. The simulation does not contain disturbances that depend on the path (they are replayed by time), elastic joints,
or additional functions of the real controller. The noise of the torque sensors is replayed as a disturbance; feedback
suppresses most of it.

Estimates are often physically inconsistent (such as a small negative wrist inertia). Then the smallest sufficient motor
inertia is added to the simulated robot and reported. Along the reference the disturbance compensates the added inertia,
so that it affects only how fast the feedback reacts. Likewise, sign functions that are too steep for such a small
inertia are smoothed over a wider range of velocities.

Without a stated controller, PD feedback with `FREQUENCY` and damping `DAMPING` on the model's mean inertia is used. It
is as slow as usual robot controllers, so that the effect of the model is visible. All of this is our choice; the
criterion, tracking error with feedforward, is from Kolyubin, Shiriaev & Jubien (2019, section 7).
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from scipy.interpolate import CubicSpline

from calib.dynamics.bodies import standard_parameters
from calib.dynamics.drives import DriveTerm, standard
from calib.errors import CalibError, require
from calib.identification.closed_loop.controllers import Reference, pd, stated_controller
from calib.identification.closed_loop.loop_recordings import periods_per_sample, take
from calib.identification.closed_loop.simulation import Plant, feed_forward, tracking_error
from calib.identification.loop import CAD, DAMPING, FEEDBACK, FLOOR, FREQUENCY, IDENTIFIED, LoopController, Replay
from calib.identification.prediction import Dynamics
from calib.identification.rows import Case, segments
from calib.procedure.dynamic_stage.inputs import IdentificationInputs
from calib.robot.chain import Chain

# [s] of a recording that are replayed
MAX_SECONDS = 20.0
# recordings that are replayed
MAX_REPLAYS = 3
# least eigenvalue of a physically consistent robot's inertia, scaled by its diagonal
MIN_EIGENVALUE = 0.05
# [kg m² or kg] least inertia of a joint
MIN_INERTIA = 1e-3
# of a sign, in Fc h / inertia: Runge and Kutta's bound in 64 steps at `MIN_EIGENVALUE` is 0.11
MIN_SMOOTHING = 0.25


def replay(
    chain: Chain,
    dynamics: Dynamics,
    case: Case,
    predicted: np.ndarray,
    controller: LoopController | None = None,
    rate: float | None = None,
) -> Replay:
    """Return simulated tracking errors on a recorded motion with four kinds of feedforward torque.

    Args:
        chain: arm, with CAD inertias if its description has any.
        dynamics: the identified model, of motor torques (or of motor and link torques).
        case: the recording.
        predicted: (N, rows) torques predicted by the model for the recording.
        controller: the feedback; its feedforward torques are ignored; None: default controller.
        rate: rate of the controller [Hz]; None: see
            `calib.identification.closed_loop.loop_recordings.periods_per_sample`.

    Raises:
        CalibError: if the torque rows are not motor torques, or the control loop is unstable.
    """
    model = dynamics.model
    n = chain.n
    require(model.torque_rows.with_motors, f"rows '{model.torque_rows.name}' do not contain the whole motor torque")
    part = _stretch(case)
    motion = case.motion
    robot, omitted = _robot(dynamics, case)
    reference, periods = _reference(take(case, part), rate)
    robot, inertia_added = _with_inertia(robot, reference)
    feedback = _default(robot, reference) if controller is None else replace(controller, ahead=None)
    measured = _at_control_rate(case.target[part, -n:], periods)
    feedforwards: dict[str, np.ndarray | None] = {FEEDBACK: None}
    if chain.inertias is not None:
        bodies = standard_parameters(chain)
        values = np.zeros(model.inertial)
        values[: len(bodies)] = bodies
        feedforwards[CAD] = feed_forward(Plant(model.bodies, (), values), reference)
    feedforwards[IDENTIFIED] = _at_control_rate(predicted[part, -n:], periods)
    feedforwards[FLOOR] = measured
    disturbance = feed_forward(robot, reference) - measured
    rms = {}
    for name, feedforward in feedforwards.items():
        rms[name] = tracking_error(robot, feedback, reference, feedforward, disturbance)
    seconds = float(motion.t[part.stop - 1] - motion.t[part.start])
    return Replay(case.name, seconds, feedback, controller is not None, omitted, inertia_added, rms)


def _stretch(case: Case) -> slice:
    """Return the index range of the longest part of a recording without gaps, at most `MAX_SECONDS` long.

    Args:
        case: the recording.
    """
    first, last = max(segments(case.motion.segment), key=lambda ends: ends[1] - ends[0])
    return slice(first, min(last, first + int(MAX_SECONDS * case.motion.rate)))


def _robot(dynamics: Dynamics, case: Case) -> tuple[Plant, tuple[str, ...]]:
    """Return the model as a simulated robot with the recording's payloads, and the names of omitted terms.

    Drive terms that depend on neither velocity nor acceleration cannot be simulated and are omitted.

    Args:
        dynamics: the identified model.
        case: the recording.
    """
    model = dynamics.model
    bodies, drives = dynamics.values[: model.inertial], dynamics.values[model.inertial :]
    terms, values, omitted = [], [], []
    for term, value in zip(model.columns, drives):
        if term.form.of_velocity or term.shape == "acceleration":
            terms.append(replace(term, side="motor"))
            values.append(value)
        else:
            omitted.append(term.name)
    parameters = np.concatenate([bodies * model.carried_columns(case.carried), np.array(values)])
    return Plant(model.bodies, tuple(terms), parameters), tuple(omitted)


def _reference(part: Case, rate: float | None) -> tuple[Reference, float]:
    """Return the recorded motion as a reference at the control rate, and the number of control periods per sample.

    Args:
        part: the recording.
        rate: control rate [Hz]; None: derived from the recording.
    """
    motion = part.motion
    periods = periods_per_sample(motion, rate)
    q, v, a = (_at_control_rate(series, periods) for series in (motion.q, motion.v, motion.a))
    return Reference(np.arange(len(q)) / periods / motion.rate, q, v, a), periods


def _at_control_rate(series: np.ndarray, periods: float) -> np.ndarray:
    """Return the values (M, k) of a sampled series at the M control instants, interpolated by splines.

    Args:
        series: (N, k) samples.
        periods: control periods per sample; with 1, the samples are the values at the instants.
    """
    if periods == 1:
        return np.array(series, order="C")
    instants = np.arange(int((len(series) - 1) * periods + 1e-9) + 1) / periods
    return CubicSpline(np.arange(len(series)), series)(instants)


def _with_inertia(robot: Plant, reference: Reference) -> tuple[Plant, np.ndarray]:
    """Return the simulated robot with motor inertia added until M(q) is positive definite, and the added inertia (n,).

    The smallest eigenvalue of the inertia matrix M(q) along the reference, scaled by the diagonal of M(q), is raised to
    `MIN_EIGENVALUE`. The added inertia is in kg m² (prismatic joints: kg).
    """
    inertia = robot.inertia(reference.q[::50])
    diagonal = np.abs(np.einsum("kii->i", inertia)) / len(inertia)
    size = np.maximum(diagonal, MIN_INERTIA)
    eigenvalues = np.linalg.eigvalsh(inertia / np.sqrt(np.outer(size, size)))
    smallest = float(eigenvalues[:, 0].min())
    added = max(0.0, MIN_EIGENVALUE - smallest) * size
    drives = robot.parameters[robot.inertial :]
    smoothed = [_smoothed(term, value, size, reference) for term, value in zip(robot.terms, drives)]
    robot = replace(robot, terms=tuple(smoothed))
    if not added.any():
        return robot, added
    motors = [replace(term, name=f"added {term.name}") for term in standard(["Ia"] * robot.bodies.n)]
    return Plant(robot.bodies, (*robot.terms, *motors), np.concatenate([robot.parameters, added])), added


def _smoothed(term: DriveTerm, value: float, size: np.ndarray, reference: Reference) -> DriveTerm:
    """Return a drive term with its sign function smoothed enough for integration at the control period of `reference`.

    Args:
        term: the drive term.
        value: coefficient of the term.
        size: (n,) inertia of each joint.
        reference: reference motion at the control rate.
    """
    if "v0" not in term.form.settings:
        return term
    min_v0 = MIN_SMOOTHING * abs(value) * reference.period / size[term.acts[0][0]]
    *settings, v0 = term.settings
    return replace(term, settings=(*settings, max(v0, min_v0)))


def _default(robot: Plant, reference: Reference) -> LoopController:
    omega = 2.0 * np.pi * FREQUENCY
    inertia = robot.inertia_diagonal(reference.q[::200])
    return pd(omega**2 * inertia, 2.0 * DAMPING * omega * inertia)


def track(
    inputs: IdentificationInputs,
    dynamics: Dynamics,
    predictions: Mapping[str, np.ndarray],
    controller: LoopController | None = None,
) -> tuple[dict[str, Replay], str]:
    """Return the simulated tracking by recording, and the reason if none was simulated (otherwise an empty text).

    Held-out recordings are simulated; without held-out recordings, the first training recording.

    Args:
        inputs: recordings and options; without a [loop] in the options, the default controller is used.
        dynamics: the model.
        predictions: name of a recording -> torques predicted by the model.
        controller: the identified controller, used if the options let the controller be identified; None: not
            identified.
    """
    chain = inputs.chain
    loop = inputs.options.settings.loop
    unseen = bool(inputs.unseen)
    replays = {}
    try:
        if loop is None or loop.controller != "identify":
            controller = None if loop is None else stated_controller(loop, chain.n)
        rate = None if controller is None or loop is None else loop.rate
        for case in inputs.unseen[:MAX_REPLAYS] or inputs.cases[:1]:
            simulated = replay(chain, dynamics, case, predictions[case.name], controller, rate)
            replays[simulated.name] = replace(simulated, unseen=unseen)
    except CalibError as error:
        return {}, str(error)
    return replays, ""
