"""Errors of a calibration against the hidden truth of a virtual cell: positions, torques, base parameters."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.data.poses.measurements import Poses
from calib.dynamics import base as bases
from calib.dynamics.bodies import bodies_of, standard_parameters
from calib.dynamics.idim import IdentificationModel
from calib.dynamics.rigid_body import inverse_dynamics
from calib.folders import EstimateRow
from calib.geometry.accuracy import errors
from calib.geometry.first_guess import install
from calib.geometry.fit import polish_frames
from calib.geometry.installation import Installation
from calib.robot.chain import Chain, random_joints
from calib.robot.kinematics import gravity_torques
from calib.simulation.cell import Cell, true_poses
from calib.simulation.known_robots import random_fourier
from calib.simulation.unmodelled import WARM_TIME
from calib.simulation.virtual_arm import MovingArm
from calib.transforms import to_quaternion

TRUTH = 2000  # poses over the whole joint range
SECONDS, RATE = 20.0, 250.0  # of the motion nobody has seen [s], [Hz]


def position_errors(cell: Cell, calibrated: Installation, urdf: Chain) -> tuple[float, float, float]:
    """Return the rms position error [mm] of nominal arm, calibrated arm and URDF over `TRUTH` noise-free poses.

    The nominal arm and the URDF get their best station and tool for these very poses, so that arms are compared.

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
    nominal, urdf_cell = (polish_frames(install(chain, [block]), [block]).cell for chain in (cell.nominal, urdf))
    before, after, bare = (_rms(arm, block) for arm in (nominal, calibrated, urdf_cell))
    return before, after, bare


def _rms(arm: Installation, block: Poses) -> float:
    reference = arm.deflection.reference or arm.chain
    torque = None if reference.inertias is None else gravity_torques(reference, block.q)
    return 1e3 * errors(arm, [replace(block, torque=torque)]).rms


@dataclass(frozen=True, eq=False)
class TorqueComparison:
    """Errors of predicted torques against noise-free torques on a validation motion.

    Attributes:
        identified: 100 ‖τ̂ - τ‖ / ‖τ‖ by the identified model, over all rows [%].
        joints: (rows,) rms [N m or N].
        nominal: error behind the gears by the nominal masses on the nominal geometry, the true friction given [%].
    """

    identified: float
    joints: np.ndarray
    nominal: float


def torque_errors(
    cell: Cell, arm: MovingArm, model: IdentificationModel, values: np.ndarray, chain: Chain, seed: int = 4321
) -> TorqueComparison:
    """Return the errors of a model's torques against noise-free torques along a random validation motion.

    Args:
        cell, arm: the virtual cell, and its arm as it moves.
        model: as identified, with values (p,) of its parameters.
        chain: the calibrated arm, whose limits the motion keeps.
        seed: of the motion.
    """
    lower, upper = chain.sampling_limits()
    speed = np.array([joint.velocity if np.isfinite(joint.velocity) else 2.0 for joint in chain.joints])
    motion = random_fourier(0.8 * lower, 0.8 * upper, 0.8 * speed, SECONDS, RATE, seed=seed)
    states = (motion.q, motion.v, motion.a)
    motor, link = arm.true_torque(*states), arm.link_torque(*states)
    true = model.torque_rows.target(motor, link, motion.q, motion.v)
    load = model.transmitted(values, *states, ())
    predicted = np.einsum("kij,j->ki", model.regressor(*states, load, ()), values)
    friction = link - inverse_dynamics(arm.plant.bodies, arm.plant.parameters[: arm.plant.inertial], *states)
    nominal = inverse_dynamics(bodies_of(cell.nominal), standard_parameters(cell.nominal), *states) + friction
    error = predicted - true
    return TorqueComparison(_percent(error, true), np.sqrt(np.mean(error**2, axis=0)), _percent(nominal - link, link))


def _percent(error: np.ndarray, size: np.ndarray) -> float:
    return float(100.0 * np.linalg.norm(error) / np.linalg.norm(size))


def share_within(true: Mapping[str, float], estimate: Sequence[EstimateRow]) -> tuple[float, int]:
    """Return the share of estimated parameters within two σ of the truth, and the number of parameters compared.

    Args:
        true: values by name, as `true_base` returns; parameters without one, or without sigma, are not counted.
        estimate: with sigmas; an R behind a name (regrouped) is not part of it.
    """
    rows = [(true[name], row) for row in estimate if (name := row.name.removesuffix("R")) in true]
    within = [abs(row.value - value) < 2 * row.sigma for value, row in rows if row.sigma]
    return (float(np.mean(within)) if within else 0.0), len(within)


def true_base(
    model: IdentificationModel, cell: Cell, arm: MovingArm, seed: int, running: float = np.inf
) -> dict[str, float]:
    """Return the true base parameters of a model by name, regrouped on the true geometry.

    Friction is that of an arm in steady sliding that has moved for the time `running` [s], infinite for a warm one:
    friction with memory, all of it slipping, is Coulomb friction.
    """
    warming = arm.unmodelled.warming * (1.0 - np.exp(-running / WARM_TIME))
    parameters = dict(zip((*arm.plant.bodies.names, *(term.name for term in arm.plant.terms)), arm.plant.parameters))
    for j in range(arm.chain.n):
        for name, change in (("Fv", 0.0), ("Fc", arm.unmodelled.memory)):
            parameters[f"{name}m{j + 1}"] += (change - warming) * (
                parameters[f"{name}l{j + 1}"] + parameters[f"{name}m{j + 1}"]
            )
        for name in ("Fv", "Fc", "off"):  # whole drives, where the model does not part motor and link
            parameters[f"{name}{j + 1}"] = parameters[f"{name}l{j + 1}"] + parameters[f"{name}m{j + 1}"]
    names = tuple(name for name in model.names if name in parameters)
    terms = tuple(term for term in model.terms if term.name in names)
    bare = [replace(model, bodies=bodies_of(chain), terms=terms) for chain in (cell.nominal, arm.chain)]
    lower, upper = arm.chain.sampling_limits()
    samples = bases.random_samples(bare[0], seed=seed, lower=lower, upper=upper)
    base = bases.find(bare[1], samples, nominal=bare[0])
    plain = (base.standard[k] for k in base.kept)  # what is regrouped on one geometry need not be on another
    return dict(zip(plain, base.transform @ np.array([parameters[name] for name in bare[1].names])))
