"""The moving arm of a virtual cell: true masses and drives, a controller with the maker's model, noisy sensors.

    tau_l = Y(q, v, a) φ + Fvl v + Fcl sign(v) + offl,    tau = tau_l + Ia a + Fvm v + Fcm sign(v) + offm,

the first being measured by sensors behind the gears, the second by the motors, each plus unmodelled torques
(`unmodelled`). True inertias are the library's, perturbed body by body such that each remains physically consistent, so
that the nominal masses given to a calibration are wrong.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.data.recordings.recording import Recording
from calib.dynamics import drives
from calib.dynamics.bodies import bodies_of, standard_parameters
from calib.dynamics.idim import IdentificationModel
from calib.dynamics.pseudo_inertia import from_standard, to_standard
from calib.dynamics.torque_rows import LINK
from calib.errors import CalibError
from calib.identification.closed_loop.controllers import Reference, pd
from calib.identification.closed_loop.simulation import Plant, Sensing, feed_forward, simulate
from calib.identification.loop import LoopController
from calib.robot import library
from calib.robot.chain import Chain, random_joints
from calib.simulation import known_robots
from calib.simulation.cell import Cell
from calib.simulation.unmodelled import TorqueErrors, gear_torques

# Standard deviations of the nominal bodies' errors: shape [-], centre of mass [m], root of the mass [-].
STRETCH = 0.05
SHIFT = 6e-3
MASS = 0.04
# Bandwidth [Hz] and damping ratio of the joint controller, and cutoff of its filter of the measured speed [Hz].
BANDWIDTH = 8.0
DAMPING = 0.8
CUTOFF = 60.0
# Share of the friction that the controller feeds forward.
KNOWN = 0.8
# Noise of the encoders [rad], and of the logged torques as a share of the torque limits (our choice).
SIGMA_Q = 1e-5
SIGMA_LINK = 0.003
SIGMA_MOTOR = 0.005
# Time at rest before and after a motion [s].
REST = 1.0
# Sizes of the unmodelled torques (our choice).
UNMODELLED = TorqueErrors(memory=0.3, warming=0.1, ripple=0.005, cable=0.0005, push=0.001)
# Bandwidth of the external torque [Hz].
PUSH_BAND = 20.0
# Speed [rad/s or m/s] and torque [N m or N] assumed for joints without a stated limit.
DEFAULT_SPEED = 2.0
DEFAULT_EFFORT = 100.0


@dataclass(frozen=True, eq=False)
class MovingArm:
    """A simulated arm with drives, controller and sensors.

    Attributes:
        chain: the true arm, including its true inertias.
        plant: the true dynamics, with the torques of the motors.
        link: model of the torques on the output side of the gears, with the parameters of `plant` that act there.
        believed: dynamics with the nominal masses and a part of the friction, from which the feedforward is computed.
        gains: gains of the controller.
        effort: (n,) torque limits, to which the torque noise is proportional [N m or N].
        note: sentence on how the truth was generated.
        unmodelled: torques that no parameter of an identification describes.
        sensors: whether torque sensors behind the gears are recorded, too.
    """

    chain: Chain
    plant: Plant
    link: IdentificationModel
    believed: Plant
    gains: LoopController
    effort: np.ndarray
    note: str
    unmodelled: TorqueErrors
    sensors: bool

    def true_torque(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return the noise-free motor torques (N, n) [N m or N] of a warm arm along a finely sampled motion."""
        warm = np.full(len(q), np.inf)
        return _modelled(self, q, v, a) + _unmodelled(self, q, v, a, warm)

    def link_torque(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return the noise-free torques (N, n) on the output side of the gears [N m or N]."""
        motor_model = IdentificationModel(self.plant.bodies, self.plant.terms)
        shared = np.isin(motor_model.names, self.link.names)
        regressor = self.link.regressor(q, v, a)
        model = np.einsum("kij,j->ki", regressor, self.plant.parameters[shared])
        return model + self.unmodelled.cable_torques(q, self.effort)


def moving_arm(
    cell: Cell, robot: str, seed: int = 0, unmodelled: TorqueErrors = UNMODELLED, masses: float = 1.0
) -> MovingArm:
    """Return the simulated real arm of a cell, with its dynamics, controller and sensors.

    Args:
        cell: the cell whose true geometry the arm has.
        robot: name of the robot in the library.
        seed: seed of the errors of the nominal masses.
        unmodelled: torques that no model describes.
        masses: scale of the errors of the nominal masses.

    Raises:
        CalibError: if the robot's description has no masses.
    """
    nominal = cell.nominal
    if nominal.inertias is None:
        raise CalibError(f"the description of {robot} has no masses, so that its motion cannot be simulated")
    rng = np.random.default_rng([seed, 71])
    bodies = [_perturbed(row, rng, masses) for row in nominal.inertias]
    chain = replace(cell.truth.chain, inertias=np.array(bodies))
    effort = np.array([joint.effort for joint in chain.joints])
    effort = np.where(np.isfinite(effort), effort, DEFAULT_EFFORT)

    drive_terms = " ".join(known_robots.SIDED)
    prismatic = [joint.kind == "prismatic" for joint in chain.joints]
    terms = tuple(drives.standard([drive_terms] * chain.n, linear=prismatic))
    values, source = _drives(robot, nominal, effort)
    true_bodies = standard_parameters(chain)
    parameters = np.concatenate([true_bodies, values.ravel()])
    plant = Plant(bodies_of(chain), terms, parameters)

    # what the maker believes: the nominal masses and a part of the friction
    believed_values = values.copy()
    for column, name in enumerate(known_robots.SIDED):
        if name.startswith("F"):
            believed_values[:, column] *= KNOWN
    nominal_bodies = standard_parameters(nominal)
    believed_parameters = np.concatenate([nominal_bodies, believed_values.ravel()])
    believed = Plant(bodies_of(nominal), terms, believed_parameters)
    postures = random_joints(chain, 200, 0)
    inertia = plant.inertia_diagonal(postures)
    omega = 2 * np.pi * BANDWIDTH
    kp = omega**2 * inertia
    kd = 2 * DAMPING * omega * inertia
    gains = pd(kp, kd)

    sensors = sensed(robot)
    noise = f"{SIGMA_MOTOR:.1%}"
    if sensors:
        noise = f"{SIGMA_MOTOR:.1%} (motors) and {SIGMA_LINK:.1%} (sensors)"
    note = (
        f"masses off their nominal by {2 * MASS * masses:.0%}, centres by {1e3 * SHIFT * masses:g} mm (1 sigma); "
        f"{source}; torque noise {noise} of the limits{unmodelled.note}"
    )
    return MovingArm(
        chain=chain,
        plant=plant,
        link=IdentificationModel(plant.bodies, plant.terms, LINK),
        believed=believed,
        gains=replace(gains, cutoff=CUTOFF),
        effort=effort,
        note=note,
        unmodelled=unmodelled,
        sensors=sensors,
    )


def carrying(arm: MovingArm, payload: Sequence[float]) -> MovingArm:
    """Return the arm with a body at its flange, which its controller does not know.

    Args:
        arm: the moving arm.
        payload: (10,) standard parameters in the tip's frame: inertia [kg m²], first moments [kg m], mass [kg].
    """
    parameters = arm.plant.parameters.copy()
    last_link = slice(10 * (arm.chain.n - 1), 10 * arm.chain.n)
    tail = np.asarray(arm.chain.tail)
    parameters[last_link] += to_standard(tail @ from_standard(np.asarray(payload)) @ tail.T)
    return replace(arm, plant=arm.plant.with_parameters(parameters))


def sensed(robot: str) -> bool:
    """Return whether a robot of the library has joint torque sensors: its file states friction behind the gears."""
    if not library.path(f"{robot}_truth").exists():
        return False
    return "Fvl" in known_robots.truth(robot)["drives"]


def play(t: np.ndarray, q: np.ndarray, v: np.ndarray, a: np.ndarray, repeats: int) -> Reference:
    """Return the reference of a periodic motion that is repeated, with rest before and after.

    Args:
        t: (N,) times of a period's samples, in even steps [s]; both ends of the period are included.
        q, v, a: (N, n) positions, velocities and accelerations over a period.
        repeats: number of periods.
    """
    rate = (len(t) - 1) / (t[-1] - t[0])
    still = np.zeros((round(REST * rate), q.shape[1]))

    def repeated(series: np.ndarray, start: np.ndarray, stop: np.ndarray) -> np.ndarray:
        period = np.tile(series[:-1], (repeats, 1))
        return np.concatenate([still + start, period, series[-1:], still + stop])

    zero = np.zeros(q.shape[1])
    positions = repeated(q, q[0], q[-1])
    velocities = repeated(v, zero, zero)
    accelerations = repeated(a, zero, zero)
    times = np.arange(len(positions)) / rate
    return Reference(times, positions, velocities, accelerations)


def record(
    arm: MovingArm, reference: Reference, seed: int | np.random.Generator = 0, running: float = np.inf
) -> Recording:
    """Return a simulated recording of a motion: encoders, motor torques and, where the arm has any, torque sensors.

    Args:
        arm: the moving arm.
        reference: the motion to follow.
        seed: seed of the noise.
        running: time for which the arm has moved before [s]; infinite for a warm arm.

    Raises:
        NotConverged: if the control loop is unstable.
    """
    rng = np.random.default_rng(seed)
    # the controller feeds forward the torques at low accelerations
    slow = replace(reference, a=0.0 * reference.a)
    torque = feed_forward(arm.believed, slow)
    controller = arm.gains.with_feedforward(torque)
    push = arm.unmodelled.push * arm.effort
    sensing = Sensing(SIGMA_Q, push=push, push_band=PUSH_BAND)
    since_cold_start = running + reference.t
    unmodelled = _unmodelled(arm, reference.q, reference.v, reference.a, since_cold_start)
    run = simulate(arm.plant, controller, reference, sensing, rng, push=-unmodelled)
    # both are drawn, with sensors or without, so that the motors' noise is the same
    shape = run.q.shape
    link_noise = SIGMA_LINK * arm.effort * rng.normal(size=shape)
    motor_noise = SIGMA_MOTOR * arm.effort * rng.normal(size=shape)
    motor = _held(run.torque) + motor_noise
    link = None
    if arm.sensors:
        link_torque = arm.link_torque(run.q, run.v, run.a)
        link = _held(link_torque) + link_noise
    return Recording(run.t, run.measured, motor, "torque", arm.chain.joint_names, tau_link=link)


def _held(torque: np.ndarray) -> np.ndarray:
    """Return torques (N, n) averaged over the two control periods around each sample.

    The controller's torque is held for a period, so that on average a command acts half a period later. The mean has
    this delay, as drives and sensors that integrate over a sampling period have.
    """
    result = torque.copy()
    result[1:] = 0.5 * (torque[1:] + torque[:-1])
    return result


def _modelled(arm: MovingArm, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
    """Return the motor torques (N, n) [N m or N] of the simulated robot: rigid model with friction."""
    model = IdentificationModel(arm.plant.bodies, arm.plant.terms)
    regressor = model.regressor(q, v, a)
    return np.einsum("kij,j->ki", regressor, arm.plant.parameters)


def _unmodelled(arm: MovingArm, q: np.ndarray, v: np.ndarray, a: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Return the torques (N, n) of unmodelled effects [N m or N]; t (N,) is the time since the cold start [s]."""
    plant = arm.plant
    names = [term.name for term in plant.terms]
    parameters = dict(zip(names, plant.parameters[plant.inertial :]))
    # friction of motor and link together
    viscous = np.zeros(arm.chain.n)
    coulomb = np.zeros(arm.chain.n)
    for j in range(arm.chain.n):
        number = j + 1
        viscous[j] = parameters[f"Fvl{number}"] + parameters[f"Fvm{number}"]
        coulomb[j] = parameters[f"Fcl{number}"] + parameters[f"Fcm{number}"]
    friction = viscous * v + coulomb * np.sign(v)
    drive = np.zeros_like(q)
    if arm.unmodelled.ripple:
        drive = _modelled(arm, q, v, a)
    gear_torque = gear_torques(arm.unmodelled, q, drive, coulomb, friction, t)
    return gear_torque + arm.unmodelled.cable_torques(q, arm.effort)


def _drives(robot: str, chain: Chain, effort: np.ndarray) -> tuple[np.ndarray, str]:
    """Return the true drive parameters (n, 7) in the order of `SIDED`, and a note on their source."""
    if not library.path(f"{robot}_truth").exists():
        speed = np.array([joint.velocity for joint in chain.joints])
        speed = np.where(np.isfinite(speed), speed, DEFAULT_SPEED)
        postures = random_joints(chain, 200, 0)
        bare = Plant(bodies_of(chain), (), standard_parameters(chain))
        inertia = bare.inertia_diagonal(postures)
        friction = 0.05 * effort
        rows = {"Ia": 0.5 * inertia, "Fvm": friction / speed, "Fcm": friction}
        source = "drives assumed from its limits"
    else:
        rows = known_robots.truth(robot)["drives"]
        if "Fvl" not in rows:
            rows = {"Ia": rows["Ia"], "Fvm": rows["Fv"], "Fcm": rows["Fc"]}
        source = "drives as published for the type"
    zero = np.zeros(chain.n)
    columns = [rows.get(name, zero) for name in known_robots.SIDED]
    return np.column_stack(columns), source


def _perturbed(parameters: np.ndarray, rng: np.random.Generator, scale: float) -> np.ndarray:
    """Return the ten standard parameters of a body after random changes of shape, centre and mass, times `scale`.

    T P Tᵀ of the pseudo-inertia P (`calib.dynamics.pseudo_inertia`) is positive definite where P is.
    """
    transform = np.eye(4)
    transform[:3, :3] += scale * STRETCH * rng.standard_normal((3, 3))
    transform[:3, 3] = scale * SHIFT * rng.standard_normal(3)
    mass_scale = (1.0 + scale * MASS * rng.standard_normal()) ** 2
    pseudo_inertia = from_standard(parameters)
    perturbed = mass_scale * transform @ pseudo_inertia @ transform.T
    return to_standard(perturbed)
