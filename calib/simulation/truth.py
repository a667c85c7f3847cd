"""Errors of a calibration against the hidden truth of a virtual cell: positions, torques, base parameters."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.data.poses.measurements import Poses
from calib.dynamics import base as bases
from calib.dynamics.bodies import bodies_of, standard_parameters, with_payload
from calib.dynamics.idim import IdentificationModel
from calib.dynamics.rigid_body import inverse_dynamics
from calib.folders import EstimateRow
from calib.geometry.accuracy import errors
from calib.geometry.first_guess import install
from calib.geometry.fit import polish_frames
from calib.geometry.installation import Installation
from calib.robot.calibrated import Deflection
from calib.robot.chain import Chain, random_joints
from calib.robot.kinematics import gravity_torques
from calib.simulation.cell import Cell, true_poses
from calib.simulation.known_robots import random_fourier
from calib.simulation.unmodelled import WARM_TIME
from calib.simulation.virtual_arm import MovingArm
from calib.transforms import to_quaternion

# Number of random poses over the whole joint range on which position errors are compared.
TRUTH = 2000
# Duration [s] and sampling rate [Hz] of the validation motion.
SECONDS = 20.0
RATE = 250.0
# Speed assumed for joints without a stated limit [rad/s or m/s].
DEFAULT_SPEED = 2.0


def position_errors(cell: Cell, calibrated: Installation, urdf: Chain) -> tuple[float, float, float]:
    """Return the rms position error [mm] of nominal arm, calibrated arm and URDF over `TRUTH` noise-free poses.

    Station and tool of the nominal arm and of the URDF are fitted to these poses, so that only the arms are compared.

    Args:
        cell: the virtual cell.
        calibrated: the fitted arm with its station, tool and deflections.
        urdf: the calibrated arm without joint corrections.
    """
    q = random_joints(cell.nominal, TRUTH, 12345)
    true = true_poses(cell, q)
    block = Poses(
        q,
        cell.nominal.joint_names,
        true[:, :3, 3],
        to_quaternion(true),
        station=calibrated.station_names[0],
        tool_names=calibrated.tool_names[:1],
    )
    nominal_arm = placed(cell.nominal, block)
    urdf_arm = placed(urdf, block)
    return _rms(nominal_arm, block), _rms(calibrated, block), _rms(urdf_arm, block)


def placed(chain: Chain, block: Poses, deflection: Deflection | None = None) -> Installation:
    """Return an arm, with its deflection if any, with its best station and tool for the poses of a block."""
    guess = install(chain, [block], deflection)
    return polish_frames(guess, [block]).cell


def _rms(arm: Installation, block: Poses) -> float:
    """Return the rms position error [mm] of an arm at the poses of a block."""
    reference = arm.deflection.reference or arm.chain
    if reference.inertias is not None:
        block = replace(block, torque=gravity_torques(reference, block.q))
    return 1e3 * errors(arm, [block]).rms


@dataclass(frozen=True, eq=False)
class TorqueComparison:
    """Errors of predicted torques against noise-free torques on a validation motion.

    Attributes:
        identified: 100 ‖τ̂ - τ‖ / ‖τ‖ by the identified model, over all rows [%].
        joints: (rows,) rms error of each row [N m or N].
        nominal: relative error of the torques behind the gears, computed from nominal masses and geometry with the true
            friction [%].
    """

    identified: float
    joints: np.ndarray
    nominal: float


def torque_errors(
    cell: Cell, arm: MovingArm, model: IdentificationModel, values: np.ndarray, chain: Chain, seed: int = 4321
) -> TorqueComparison:
    """Return the errors of a model's torques against noise-free torques along a random validation motion.

    Args:
        cell, arm: the virtual cell and its moving arm.
        model: the identified model; values: (p,) of its parameters.
        chain: the calibrated arm, whose limits the motion keeps.
        seed: seed of the motion.
    """
    lower, upper = chain.sampling_limits()
    speed = np.array([joint.velocity for joint in chain.joints])
    speed = np.where(np.isfinite(speed), speed, DEFAULT_SPEED)
    # motion within 80 % of the limits
    lower = 0.8 * lower
    upper = 0.8 * upper
    speed = 0.8 * speed
    motion = random_fourier(lower, upper, speed, SECONDS, RATE, seed=seed)
    states = (motion.q, motion.v, motion.a)
    motor = arm.true_torque(*states)
    link = arm.link_torque(*states)
    true = model.torque_rows.target(motor, link, motion.q, motion.v)

    load = model.transmitted(values, *states, ())
    regressor = model.regressor(*states, load, ())
    predicted = np.einsum("kij,j->ki", regressor, values)
    error = predicted - true

    plant = arm.plant
    inertial = plant.parameters[: plant.inertial]
    friction = link - inverse_dynamics(plant.bodies, inertial, *states)
    nominal_bodies = bodies_of(cell.nominal)
    nominal_parameters = standard_parameters(cell.nominal)
    nominal = inverse_dynamics(nominal_bodies, nominal_parameters, *states) + friction
    mean_square = np.mean(error**2, axis=0)
    identified_error = _percent(error, true)
    nominal_error = _percent(nominal - link, link)
    return TorqueComparison(identified_error, np.sqrt(mean_square), nominal_error)


def _percent(error: np.ndarray, torque: np.ndarray) -> float:
    """Return 100 ‖error‖ / ‖torque‖ [%]."""
    share = 100.0 * np.linalg.norm(error) / np.linalg.norm(torque)
    return float(share)


def share_within(true: Mapping[str, float], estimate: Sequence[EstimateRow]) -> tuple[float, int]:
    """Return the share of estimated parameters within two σ of the truth, and the number of parameters compared.

    Args:
        true: true values by name, as `true_base` returns them; parameters without true value or sigma are not counted.
        estimate: rows of the estimate with sigmas; a final R of a name (regrouped) is ignored.
    """
    within = []
    for row in estimate:
        name = row.name.removesuffix("R")
        if name in true and row.sigma:
            error = abs(row.value - true[name])
            within.append(error < 2 * row.sigma)
    if not within:
        return 0.0, 0
    return float(np.mean(within)), len(within)


def true_base(
    model: IdentificationModel,
    cell: Cell,
    arm: MovingArm,
    seed: int,
    running: float = np.inf,
    payloads: Mapping[str, Sequence[float]] | None = None,
) -> dict[str, float]:
    """Return the true base parameters of a model by name, regrouped on the true geometry.

    Friction is that of an arm in steady sliding that has moved for the time `running` [s], infinite for a warm one:
    friction with memory, all of it slipping, is Coulomb friction.

    Args:
        model: the identified model.
        cell, arm: the virtual cell and its moving arm, without payload.
        seed: seed of the samples that the regrouping is computed from.
        running: time for which the arm has moved [s].
        payloads: (10,) true standard parameters of the model's payloads in the tip's frame, by label.
    """
    parameters = _true_parameters(arm, running)
    nominal_bodies, true_bodies = bodies_of(cell.nominal), bodies_of(arm.chain)
    for label, values in (payloads or {}).items():
        nominal_bodies = with_payload(nominal_bodies, np.asarray(cell.nominal.tail), label)
        true_bodies = with_payload(true_bodies, np.asarray(arm.chain.tail), label)
        parameters |= zip(true_bodies.names[-10:], values)
    names = {name for name in model.names if name in parameters}
    terms = tuple(term for term in model.terms if term.name in names)
    nominal_model = replace(model, bodies=nominal_bodies, terms=terms)
    true_model = replace(model, bodies=true_bodies, terms=terms)
    lower, upper = arm.chain.sampling_limits()
    samples = bases.random_samples(nominal_model, seed=seed, lower=lower, upper=upper)
    base = bases.find(true_model, samples, nominal=nominal_model)
    values = np.array([parameters[name] for name in true_model.names])
    # A parameter may be regrouped (final R of its name) on one geometry and not on another: names without the R.
    base_names = [base.standard[column] for column in base.kept]
    return dict(zip(base_names, base.transform @ values))


def _true_parameters(arm: MovingArm, running: float) -> dict[str, float]:
    """Return the true standard parameters of an arm by name.

    Friction and offsets are given both for the link's and the motor's side of each gear and as the sum of both sides.
    """
    plant = arm.plant
    names = [*plant.bodies.names, *(term.name for term in plant.terms)]
    parameters = dict(zip(names, plant.parameters))
    warming = arm.unmodelled.warming * (1.0 - np.exp(-running / WARM_TIME))
    for number in range(1, arm.chain.n + 1):
        for name, change in (("Fv", 0.0), ("Fc", arm.unmodelled.memory)):
            link = f"{name}l{number}"
            motor = f"{name}m{number}"
            total = parameters[link] + parameters[motor]
            parameters[motor] += (change - warming) * total
        # sums of both sides, for models that do not separate motor and link
        for name in ("Fv", "Fc", "off"):
            link_value = parameters[f"{name}l{number}"]
            motor_value = parameters[f"{name}m{number}"]
            parameters[f"{name}{number}"] = link_value + motor_value
    return parameters
