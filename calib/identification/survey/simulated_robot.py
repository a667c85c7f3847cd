"""The simulated robot of an identification problem, and start parameters of methods that simulate.

Closed loops are simulated with their derivatives by parameters: a whole motion at once, or single time steps.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from calib.dynamics.drives import standard
from calib.dynamics.idim import IdentificationModel
from calib.dynamics.shapes import V0
from calib.errors import CalibError, CannotSimulate, Diverged, UsageError, refused_as, require
from calib.identification.closed_loop.controllers import Reference
from calib.identification.closed_loop.simulation import (
    LOWER,
    Packed,
    Plant,
    Sensing,
    body_rows,
    failure,
    layout_of,
    packed,
    plant_of,
    sample_ticks,
)
from calib.identification.loop import LoopController
from calib.identification.methods.method import IdentificationProblem, Method
from calib.identification.rows import Case
from calib.records import frozen, shaped


@dataclass(frozen=True, eq=False)
class Sensitivities:
    """Simulated motion of M samples, and its derivatives by c parameters.

    Attributes:
        t: (M,) times [s].
        q, v, torque: (M, n) positions, velocities and torques [rad or m, per s, N m or N].
        by_q, by_v, by_torque: (M, n, c) derivatives of q, v and torque, per unit of each parameter.
    """

    t: np.ndarray
    q: np.ndarray
    v: np.ndarray
    torque: np.ndarray
    by_q: np.ndarray
    by_v: np.ndarray
    by_torque: np.ndarray


def simulate_tangents(
    plant: Plant,
    controller: LoopController,
    reference: Reference,
    columns: np.ndarray,
    every: float = 1,
    relative: np.ndarray | None = None,
    noise: np.ndarray | None = None,
) -> Sensitivities:
    """Return a simulated motion along a reference, with exact derivatives by the parameters.

    Args:
        plant: robot whose friction depends on position and velocity alone.
        controller: its controller.
        reference: reference sampled at the controller's rate.
        columns: (c,) indices of the parameters.
        every: control periods per sample.
        relative: (n, c) derivatives of the logarithm of all gains of a joint by the parameters, if the gains depend on
            them (`calib.identification.closed_loop.loop_recordings.Loop.design`); None: the gains are constant.
        noise: (N, n) noise of the measured positions, on which the controller acts [rad or m]; None: none.

    Raises:
        CannotSimulate: if the inertia matrix is not positive definite, or friction too stiff.
        CalibError: for friction without derivatives.
        Diverged: if the loop is unstable.
    """
    from calib.identification.closed_loop import loop_kernels
    from calib.identification.survey import tangent_kernels

    for term in plant.terms:
        message = (
            f"term '{term.name}' ({term.shape}): no derivatives of friction that depends on past motion or on torques"
        )
        require(term.form.slopes, f"{message}; methods iv and didim support it")
    n = plant.bodies.n
    count = len(reference.t)
    c = len(columns)
    find = np.full(len(plant.parameters), -1)
    find[np.asarray(columns, dtype=int)] = np.arange(c)
    tick = sample_ticks(count, every)
    out = np.empty((3, len(tick), n))
    slopes = np.empty((3, len(tick), n, c))
    if controller.model is None:
        model = np.empty((0, 0))
    else:
        model = body_rows(plant.bodies, controller.model)
    if relative is None:
        scale = np.zeros((n, c))
    else:
        scale = np.ascontiguousarray(shaped(relative, (n, c), "relative"))
    status, reached = tangent_kernels.closed_loop_tangent(
        packed(plant),
        (*layout_of(plant), find),
        model,
        controller.rows,
        scale,
        reference.sampled(controller.ahead),
        np.empty((0, n)) if noise is None else np.ascontiguousarray(shaped(noise, reference.q.shape, "noise")),
        reference.period,
        controller.smoothing(reference.period),
        controller.delay,
        float(every),
        np.array(reference.q[0]),
        np.array(reference.v[0]),
        count,
        out,
        slopes,
    )
    if status != loop_kernels.FINE:
        raise failure(status, reached * reference.period)
    # slope of the last sample by a parameter, in SI units, from which on the loop is unstable (our choice)
    max_slope = 1e20
    # saturated torques keep only the motion finite
    if not np.abs(slopes[:, -1]).max(initial=0.0) < max_slope:
        raise Diverged(f"the loop is unstable, its derivatives diverge: {LOWER}", None)
    t = reference.t[0] + tick * reference.period
    run = [frozen(values) for values in out]
    run_slopes = [frozen(values) for values in slopes]
    return Sensitivities(t, *run, *run_slopes)


def simulate_differences(
    plant: Any,
    controller: LoopController,
    reference: Reference,
    columns: np.ndarray,
    steps: np.ndarray,
    every: float = 1,
) -> Sensitivities:
    """Return the result of `simulate_tangents` by differences, with one simulation per parameter.

    Args:
        plant: simulated robot with the attached payloads.
        controller: its controller.
        reference: reference sampled at the controller's rate.
        columns: (c,) indices of the parameters.
        steps: (c,) steps of the forward differences, so small that the motion is linear in them.
        every: control periods per sample.
    """

    def moved(parameters: np.ndarray) -> np.ndarray:
        run = plant.with_parameters(parameters).run(controller, reference, Sensing(every=every))
        return np.array([run.q, run.v, run.torque])

    values = np.array(plant.parameters)
    nominal = moved(values)
    shifts = np.eye(len(values))[columns] * steps[:, None]
    differences = [(moved(values + shift) - nominal) / step for shift, step in zip(shifts, steps)]
    slopes = np.stack(differences, axis=-1)
    count = len(reference.t)
    tick = sample_ticks(count, every)
    t = reference.t[0] + tick * reference.period
    return Sensitivities(t, *map(frozen, (*nominal, *slopes)))


@dataclass(frozen=True, eq=False)
class Stepper:
    """Simulated robot prepared for single time steps with varying parameters and states.

    Attributes:
        parts: arrays of the kernels, from `packed`.
        layout: index arrays of the kernels, from `layout_of`, and the column of each parameter in the Jacobian.
    """

    parts: Packed
    layout: Packed

    def points(
        self, parameters: np.ndarray, q: np.ndarray, v: np.ndarray, tau: np.ndarray, period: float
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return q and v (K, n) of K states one period later under a common torque, and M⁻¹ (n, n) of the first state.

        Args:
            parameters: (K, p) parameters of the robot for each state.
            q, v: (K, n) states.
            tau: (n,) drive torques [N m or N], held for the period.
            period: duration [s].

        Raises:
            CannotSimulate, Diverged: if a state cannot be advanced; the message names the first one.
        """
        from calib.identification.closed_loop import loop_kernels

        q = np.array(q)
        v = np.array(v)
        gain = np.empty((q.shape[1], q.shape[1]))
        order, entries, shares, owners, _ = self.layout
        where = (order, entries, shares, owners, np.ascontiguousarray(parameters), q, v, tau, period, gain)
        status, reached = loop_kernels.advance_points(*self.parts, *where)
        if status != loop_kernels.FINE:
            raise failure(status, 0.0, f"point {reached}: ")
        return q, v, gain

    def linearised(
        self, parameters: np.ndarray, q: np.ndarray, v: np.ndarray, tau: np.ndarray, period: float, columns: int
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return q, v (n,) one period later, M⁻¹ (n, n), and their Jacobian (2 n, 2 n + c) by q, v and c parameters.

        Args:
            parameters: (p,) parameters of the robot.
            q, v: (n,) state.
            tau: (n,) drive torques [N m or N], held for the period.
            period: duration [s].
            columns: number c of parameters in the Jacobian.

        Raises:
            CannotSimulate, Diverged: if the state cannot be advanced.
        """
        from calib.identification.closed_loop import loop_kernels
        from calib.identification.survey import tangent_kernels

        n = len(q)
        q = np.array(q)
        v = np.array(v)
        gain = np.empty((n, n))
        slopes = np.empty((2, n, 2 * n + columns))
        args = (self.parts, self.layout, np.ascontiguousarray(parameters), q, v, tau, period, gain)
        status = tangent_kernels.advance_linearised(*args, slopes[0], slopes[1])
        if status != loop_kernels.FINE:
            raise failure(status, 0.0, "")
        return q, v, gain, slopes.reshape(2 * n, -1)


def stepper(plant: Plant, columns: np.ndarray) -> Stepper:
    """Return a robot prepared for single time steps, with derivatives by the parameters of indices `columns` (c,).

    Args:
        plant: the robot.
        columns: (c,) indices of the parameters.
    """
    find = np.full(len(plant.parameters), -1)
    numbers = 2 * plant.bodies.n + np.arange(len(columns))
    find[np.asarray(columns, dtype=int)] = numbers
    parts = packed(plant)
    layout = (*layout_of(plant), find)
    return Stepper(parts, layout)


# shares of least squares, the rest being a regular robot, that are tried until one can be simulated
SHARES = (1.0, 0.9, 0.75, 0.5, 0.25, 0.0)


@dataclass(frozen=True, eq=False)
class BelievedRobot:
    """Robot model that is simulated with the parameters of an identification problem.

    Attributes:
        model: model including the problem's additional friction.
        columns: (p,) index of each of the problem's parameters among those of the simulated robot; without motor
            torques, the indices of the motors' parameters follow.
        plant: simulated robot with all parameters zero.
        steps: (p,) steps of differences for a robot without tangents, 0.01 σ of least squares; None for a serial arm.
    """

    model: Any
    columns: np.ndarray
    plant: Any
    steps: np.ndarray | None = None

    def at(self, values: np.ndarray, case: Case | None = None) -> Any:
        """Return the simulated robot with parameters (p,) and the payloads of a case; None: all payloads.

        Args:
            values: (p,) parameters of the problem.
            case: recording with its payloads; None: all payloads are attached.
        """
        parameters = np.zeros(len(self.plant.parameters))
        parameters[self.columns] = values
        plant = self.plant.with_parameters(parameters)
        if case is None:
            return plant
        return plant.carrying(case.carried)

    def sensitivities(
        self,
        values: np.ndarray,
        case: Case,
        controller: LoopController,
        reference: Reference,
        every: float,
        relative: np.ndarray | None = None,
        noise: np.ndarray | None = None,
    ) -> Sensitivities:
        """Return the simulated motion with parameters (p,) and its derivatives by them.

        Derivatives by parameters of payloads that are not attached are zero.

        Args:
            values: (p,) parameters.
            case: the recording, which has the payloads.
            controller: controller of the robot.
            reference: reference sampled at the controller's rate.
            every: control periods per sample.
            relative: (n, p) derivatives of the logarithm of the gains by the parameters; None: the gains are constant.
            noise: (N, n) noise of the measured positions [rad or m]; ignored for a robot without tangents.
        """
        plant = self.at(values, case)
        if self.steps is not None:
            return simulate_differences(plant, controller, reference, self.columns, self.steps, every)
        sensitivities = simulate_tangents(plant, controller, reference, self.columns, every, relative, noise)
        carried = self.carried(case)
        by_q = sensitivities.by_q * carried
        by_v = sensitivities.by_v * carried
        by_torque = sensitivities.by_torque * carried
        return replace(sensitivities, by_q=by_q, by_v=by_v, by_torque=by_torque)

    def carried(self, case: Case) -> np.ndarray:
        """Return a factor (p,) per parameter of a serial arm: 0 for payloads not attached in a case, otherwise 1."""
        bodies = self.model.carried_columns(case.carried)
        return np.append(bodies, np.ones(len(self.plant.terms)))[self.columns]


def serial_arm(problem: IdentificationProblem, method: Method) -> IdentificationModel:
    """Return the model of a problem, which must be a serial arm with torque rows that the method supports.

    Args:
        problem: data and settings.
        method: the method that simulates.

    Raises:
        UsageError: for any other model.
    """
    model = problem.model
    if not isinstance(model, IdentificationModel) or not method.takes(model.torque_rows):
        message = f"needs a serial arm with motor torques, not rows '{model.torque_rows.name}'"
        raise UsageError(f"method '{method.name}' {message}; otherwise take wls or tls")
    return model


def believed_robot(problem: IdentificationProblem, method: Method, steps: np.ndarray | None = None) -> BelievedRobot:
    """Return the robot model that simulates an identification problem.

    Without motor torques (rows link) the problem does not identify the motion of the motors. Inertia, friction and
    offset of each motor are then appended as further parameters (our choice).

    Args:
        problem: data and settings.
        method: the method that simulates.
        steps: (p,) steps of differences for a model other than a serial arm; None: such a model is refused.

    Raises:
        UsageError: for a model that cannot be simulated, or torque rows that the method does not support.
        CannotSimulate: for friction that cannot be simulated, such as an exact sign.
    """
    if steps is not None and not isinstance(problem.model, IdentificationModel):
        columns = np.array(problem.base.kept)
        values = np.zeros(problem.model.p)
        plant = plant_of(problem.model, values)
        return BelievedRobot(problem.model, columns, plant, steps)
    model, columns = with_friction(problem, serial_arm(problem, method))
    terms = model.columns
    size = model.p
    if not model.torque_rows.with_motors:
        widths = {}
        for term in terms:
            if term.shape == "sign":
                joint = term.acts[0][0]
                widths[joint] = term.settings[-1]
        width = [widths.get(joint, V0) for joint in range(model.n)]
        sets = ["Ia Fvm Fcm offm"] * model.n
        linear = model.prismatic.tolist()
        motors = standard(sets, width, linear)
        terms = (*terms, *(replace(motor, name=f"motor {motor.name}") for motor in motors))
        columns = np.append(columns, np.arange(size, size + len(motors)))
    with refused_as(CannotSimulate, CalibError, "{}"):
        parameters = np.zeros(model.inertial + len(terms))
        plant = Plant(model.bodies, terms, parameters)
    return BelievedRobot(model, columns, plant)


def with_friction(problem: IdentificationProblem, model: IdentificationModel) -> tuple[IdentificationModel, np.ndarray]:
    """Return a problem's model with all friction terms, and the index (p,) of each of its parameters in this model.

    Args:
        problem: data and settings, with p parameters.
        model: the problem's model with standard friction.
    """
    extra = [term for term in problem.terms[problem.base.b :] if term is not None]
    model = model.with_terms(*extra)
    extra_columns = range(model.p - len(extra), model.p)
    columns = [*problem.base.kept, *extra_columns]
    return model, np.array(columns, dtype=int)


def start_of(
    problem: IdentificationProblem, plain: np.ndarray, inertia: np.ndarray, simulated: Callable[[np.ndarray], object]
) -> np.ndarray:
    """Return start parameters (p,): the stated ones, or those nearest to least squares that can be simulated.

    Args:
        problem: data and settings.
        plain: (p,) estimate by weighted least squares.
        inertia: (n,) joint inertias of a regular robot, whose joints are not coupled [kg m² or kg].
        simulated: function that raises `CalibError` if parameters (p,) cannot be simulated.

    Raises:
        CannotSimulate: if no parameters between least squares and the regular robot can be simulated.
    """
    if problem.start is not None:
        return np.array(problem.start, dtype=float)
    model: Any = problem.model
    base_count = problem.base.b
    standard = np.zeros(model.p)
    serial = isinstance(model, IdentificationModel)
    motors = {
        column.joint: k for k, column in enumerate(model.columns, model.inertial) if column.shape == "acceleration"
    }
    for joint, own_inertia in zip(range(model.n) if serial else model.mechanism.robot.actuated, inertia):
        if joint in motors:
            standard[motors[joint]] = own_inertia
    regular = np.append(problem.base.transform @ standard, np.zeros(len(plain) - base_count))
    if serial and not np.any(standard):
        base_values = problem.base.transform @ _hubs(model, inertia)
        regular = np.append(base_values, np.zeros(len(plain) - base_count))
    failure: CalibError | None = None
    for share in SHARES:
        values = share * plain + (1.0 - share) * regular
        try:
            simulated(values)
        except CalibError as error:
            failure = failure or error
        else:
            return values
    raise CannotSimulate(f"no parameters between least squares and regular inertias can be simulated: {failure}", plain)


def _hubs(model: IdentificationModel, inertia: np.ndarray) -> np.ndarray:
    """Return parameters (p,) of bodies with inertia about their joint axis only, or mass only for prismatic joints.

    Args:
        model: model of the robot.
        inertia: (n,) these inertias or masses.
    """
    result = np.zeros(model.p)
    for i, (coordinate, axis) in enumerate(zip(model.bodies.coordinates, model.bodies.axes)):
        if coordinate >= 0:
            if model.prismatic[coordinate]:
                entry = 9
            else:
                entry = (0, 3, 5)[int(axis)]
            result[10 * i + entry] = inertia[coordinate]
    return result
