"""A virtual cell's hidden truth beside what its calibration found: poses, torques, parameters."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from calib.data.poses.measurements import Poses
from calib.dynamics import base as bases
from calib.dynamics.bodies import bodies_of, standard_parameters
from calib.dynamics.gravity import gravity_torques
from calib.dynamics.idim import IdentificationModel
from calib.dynamics.rigid_body import inverse_dynamics
from calib.estimate_files import read_estimate
from calib.geometry import installation_file
from calib.geometry.first_guess import install
from calib.geometry.fit import polish_frames
from calib.geometry.installation import Installation, see
from calib.identification.model_file import read_dynamics
from calib.identification.prediction import Dynamics
from calib.procedure.session.folder import Session
from calib.robot import calibrated
from calib.robot.chain import random_joints, sampling_limits
from calib.robot.deflection import evaluate
from calib.simulation.cells.cell import Cell, true_poses
from calib.simulation.cells.virtual_arm import MovingArm, link_torque, true_torque
from calib.simulation.loop.references import random_fourier
from calib.transforms import to_quaternion

TRUTH = 2000  # poses over the whole joint range
SECONDS, RATE = 20.0, 250.0  # of the motion nobody has seen [s], [Hz]


def against_truth(session: Session, cell: Cell) -> tuple[float, float, float]:
    """Return rms position errors against the noise-free truth [mm]: nominal, calibrated, and its URDF alone.

    The nominal arm and the URDF get their best station and tool for these very poses, so that arms are compared.
    """
    q = random_joints(cell.nominal, TRUTH, 12345)
    true = true_poses(cell, q)
    points = true[:, :3, 3]
    block = Poses(q, cell.nominal.joint_names, points, to_quaternion(true))
    rigid = calibrated.read(session.fit.path).chain
    nominal, alone = (polish_frames(install(chain, [block]), [block]).cell for chain in (cell.nominal, rigid))
    found = installation_file.read(session.fit.path)
    before, after, bare = (_rms(arm, q, points) for arm in (nominal, found, alone))
    return before, after, bare


def _rms(arm: Installation, q: np.ndarray, points: np.ndarray) -> float:
    bases = None
    if arm.deflection.terms:
        reference = arm.deflection.reference or arm.chain
        torque = None if reference.inertias is None else gravity_torques(reference, q)
        bases = evaluate(arm.deflection, q, torque)
    error = see(arm, q, bases=bases).point.T - points
    return float(1e3 * np.sqrt(np.mean(np.sum(error**2, axis=1))))


@dataclass(frozen=True, eq=False)
class TorqueErrors:
    """Errors of predicted torques against the noise-free truth on motion nobody has seen.

    Attributes:
        identified: 100 ‖τ̂ - τ‖ / ‖τ‖ by the identified model, over all rows [%].
        joints: (rows,) rms [N m or N].
        within: share of the base parameters whose truth is within two sigmas of the estimate.
        count: how many base parameters.
        nominal: error behind the gears by the nominal masses on the nominal geometry, the true friction given [%].
    """

    identified: float
    joints: np.ndarray
    within: float
    count: int
    nominal: float


def torques_against_truth(session: Session, cell: Cell, arm: MovingArm, seed: int = 4321) -> TorqueErrors:
    """Compare predicted torques with the noise-free truth along a random motion, and parameters with theirs."""
    chain, dynamics = read_dynamics(session.identification.path)
    lower, upper = sampling_limits(chain)
    speed = np.array([joint.velocity if np.isfinite(joint.velocity) else 2.0 for joint in chain.joints])
    motion = random_fourier(0.8 * lower, 0.8 * upper, 0.8 * speed, SECONDS, RATE, seed=seed)
    states = (motion.q, motion.v, motion.a)
    motor, link = true_torque(arm, *states), link_torque(arm, *states)
    true = dynamics.model.torque_rows.target(motor, link, motion.q, motion.v)
    load = transmitted_along(dynamics, *states)
    predicted = np.einsum("kij,j->ki", dynamics.model.regressor(*states, load, ()), dynamics.values)
    friction = link - inverse_dynamics(arm.plant.bodies, arm.plant.parameters[: arm.plant.inertial], *states)
    nominal = inverse_dynamics(bodies_of(cell.nominal), standard_parameters(cell.nominal), *states) + friction
    error = predicted - true
    within, count = _parameters(session, dynamics.model, cell, arm)
    return TorqueErrors(
        _percent(error, true), np.sqrt(np.mean(error**2, axis=0)), within, count, _percent(nominal - link, link)
    )


def _percent(error: np.ndarray, size: np.ndarray) -> float:
    return float(100.0 * np.linalg.norm(error) / np.linalg.norm(size))


def transmitted_along(dynamics: Dynamics, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
    """Return what the gears pass on to the bodies by the model, without payloads (N, n): load-dependent friction."""
    model = dynamics.model
    return model.transmitted(dynamics.values, q, v, a, ())


def _parameters(session: Session, model: IdentificationModel, cell: Cell, arm: MovingArm) -> tuple[float, int]:
    """Return the share of estimated base parameters whose truth is within two sigmas, and how many there are."""
    found = read_estimate(session.identification.path)
    rows = zip((name.removesuffix("R") for name in found.names), found.values, found.sigma)
    true = true_base(model, cell, arm, session.settings.seed)
    inside = [abs(value - true[name]) < 2 * sigma for name, value, sigma in rows if name in true and sigma > 0]
    return (float(np.mean(inside)) if inside else 0.0), len(inside)


def true_base(model: IdentificationModel, cell: Cell, arm: MovingArm, seed: int) -> dict[str, float]:
    """Return the true base parameters of a model by name: columns of the nominal arm, regrouped on the true one."""
    known = dict(zip((*arm.plant.bodies.names, *(one.name for one in arm.plant.terms)), arm.plant.parameters))
    for j in range(arm.chain.n):  # whole drives, where the model does not part motor and link
        for name in ("Fv", "Fc", "off"):
            known[f"{name}{j + 1}"] = known[f"{name}l{j + 1}"] + known[f"{name}m{j + 1}"]
    names = tuple(name for name in model.names if name in known)
    terms = tuple(one for one in model.terms if one.name in names)
    bare = [replace(model, bodies=bodies_of(chain), terms=terms) for chain in (cell.nominal, arm.chain)]
    lower, upper = sampling_limits(arm.chain)
    samples = bases.random_samples(bare[0], seed=seed, lower=lower, upper=upper)
    base = bases.regroup(bases.find(bare[0], samples), bare[1], samples)
    plain = (base.standard[k] for k in base.kept)  # what is regrouped on one geometry need not be on another
    return dict(zip(plain, base.transform @ np.array([known[name] for name in bare[1].names])))
