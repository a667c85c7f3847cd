"""The simulated robot with a problem's parameters, and the values that methods which simulate it start from."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from calib.dynamics.idim import IdentificationModel
from calib.errors import CalibError, CannotSimulate, UsageError, refused_as
from calib.identification.methods.method import IdentificationProblem
from calib.identification.rows import Case
from calib.simulation.loop.closed_loop import Plant

# shares of least squares, the rest being a regular robot, that are tried until one can be simulated
SHARES = (1.0, 0.9, 0.75, 0.5, 0.25, 0.0)


@dataclass(frozen=True, eq=False)
class BelievedRobot:
    """A problem's columns as parameters of a robot.

    Attributes:
        model: with richer friction, where the problem has any.
        columns: (p,) place of each of the problem's parameters among the plant's.
        plant: with all parameters zero.
    """

    model: IdentificationModel
    columns: np.ndarray
    plant: Plant

    def at(self, values: np.ndarray, case: Case | None = None) -> Plant:
        """Return the robot with the problem's parameters (p,), without payloads that the case does not carry."""
        parameters = np.zeros(len(self.plant.parameters))
        parameters[self.columns] = values
        return replace(self.plant, parameters=parameters * self.carried(case))

    def carried(self, case: Case | None) -> np.ndarray:
        """Return (plant's parameters,) one for what is on board of a case, zero for payloads that are not."""
        if case is None:
            return np.ones(len(self.plant.parameters))
        return np.append(self.model.carried_columns(case.carried), np.ones(len(self.plant.terms)))


def serial_arm(problem: IdentificationProblem, method: str) -> IdentificationModel:
    """Return the model of a problem, if it is one of motor torques of a serial arm.

    Raises:
        UsageError: for another.
    """
    model = problem.model
    if not isinstance(model, IdentificationModel) or not model.torque_rows.motors_alone:
        raise UsageError(f"method '{method}' simulates a serial arm with motor torques")
    return model


def believed_robot(problem: IdentificationProblem, method: str) -> BelievedRobot:
    """Return the robot of a problem.

    Raises:
        UsageError: for a model that is no serial arm with motor torques.
        CannotSimulate: for friction that the simulator does not know, or an exact sign.
    """
    model, columns = with_friction(problem, serial_arm(problem, method))
    with refused_as(CannotSimulate, CalibError, "{}"):
        plant = Plant(model.bodies, model.terms, np.zeros(model.p))
    return BelievedRobot(model, columns, plant)


def with_friction(problem: IdentificationProblem, model: IdentificationModel) -> tuple[IdentificationModel, np.ndarray]:
    """Return a problem's model with its richer friction, and the place (p,) of each of its columns there."""
    extra = [one for one in problem.terms[problem.base.b :] if one is not None]
    model = model.with_terms(*extra)
    return model, np.array([*problem.base.kept, *range(model.p - len(extra), model.p)], dtype=int)


def start_of(
    problem: IdentificationProblem,
    method: str,
    plain: np.ndarray,
    inertia: np.ndarray,
    simulated: Callable[[np.ndarray], object],
) -> np.ndarray:
    """Return values (p,) to start from: those stated, or those nearest to least squares that can be simulated.

    Args:
        method: name of the one that simulates.
        plain: (p,) of weighted least squares.
        inertia: (n,) of a regular robot, which nothing couples [kg m² or kg].
        simulated: raises `CalibError` where values cannot be simulated.

    Raises:
        CannotSimulate: where none can be.
        UsageError: for a model that is no serial arm with motor torques.
    """
    if problem.start is not None:
        return np.array(problem.start, dtype=float)
    model, own = serial_arm(problem, method), problem.base.b
    standard = np.zeros(model.p)
    for k, one in enumerate(model.columns):
        if one.shape == "acceleration" and one.joint is not None:
            standard[model.inertial + k] = inertia[one.joint]
    regular = np.append(problem.base.transform @ standard, np.zeros(len(plain) - own))
    if not np.any(standard):
        regular = np.append(problem.base.transform @ _hubs(model, inertia), np.zeros(len(plain) - own))
    failure: CalibError | None = None
    for share in SHARES:
        values = share * plain + (1.0 - share) * regular
        try:
            simulated(values)
        except CalibError as error:
            failure = failure or error
        else:
            return values
    raise CannotSimulate(f"no robot between least squares and a regular one can be simulated: {failure}", plain)


def _hubs(model: IdentificationModel, inertia: np.ndarray) -> np.ndarray:
    """Return parameters (p,) of bodies with this inertia about their joint's axis alone, or this mass along it."""
    result = np.zeros(model.p)
    for i, (coordinate, axis) in enumerate(zip(model.bodies.coordinates, model.bodies.axes)):
        if coordinate >= 0:
            place = 9 if model.prismatic[coordinate] else (0, 3, 5)[int(axis)]
            result[10 * i + place] = inertia[coordinate]
    return result
