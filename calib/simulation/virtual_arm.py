"""The moving arm of a virtual cell: true masses and drives, a controller with the maker's model, noisy sensors.

    tau_l = Y(q, v, a) φ + Fvl v + Fcl sign(v) + offl,    tau = tau_l + Ia a + Fvm v + Fcm sign(v) + offm,

the first seen by sensors behind the gears, the second by the motors, each plus what no model holds (`unmodelled`).
True inertias are the library's, made wrong body by body in a way that keeps every one possible, so that the nominal
masses, which a calibration is given, are off.
"""

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

STRETCH, SHIFT, MASS = 0.05, 6e-3, 0.04  # how wrong the maker's masses are, 1 sigma: shape, centre [m], mass
BANDWIDTH, DAMPING, CUTOFF = 8.0, 0.8, 60.0  # of the joint controller, and of its measured speed's filter [Hz]
KNOWN = 0.8  # share of the friction that the controller feeds forward
SIGMA_Q, SIGMA_LINK, SIGMA_MOTOR = 1e-5, 0.003, 0.005  # encoders [rad]; torques as logged, of their limits (our choice)
REST = 1.0  # at rest before and after a motion [s]
UNMODELLED = TorqueErrors(memory=0.3, warming=0.1, ripple=0.005, cable=0.0005, push=0.001)  # our choice
PUSH_BAND = 20.0  # [Hz]


@dataclass(frozen=True, eq=False)
class MovingArm:
    """A simulated arm with drives, controller and sensors.

    Attributes:
        chain: the true arm, its true inertias included.
        plant: chain and drives, motors' torques; `link` sees the same terms behind the gears.
        gains: of the controller, which feeds forward what `believed` needs at low accelerations.
        effort: (n,) limits that the noise of the torques is a share of [N m or N].
        note: what the truth is made of.
        unmodelled: torques that no parameter of an identification holds.
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
        return _modelled(self, q, v, a) + _unmodelled(self, q, v, a, np.full(len(q), np.inf))

    def link_torque(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return the noise-free torques (N, n) on the output side of the gears [N m or N]."""
        motor_model = IdentificationModel(self.plant.bodies, self.plant.terms)
        shared = np.isin(motor_model.names, self.link.names)
        model = np.einsum("kij,j->ki", self.link.regressor(q, v, a), self.plant.parameters[shared])
        return model + self.unmodelled.cable_torques(q, self.effort)


def moving_arm(cell: Cell, robot: str, seed: int = 0, unmodelled: TorqueErrors = UNMODELLED) -> MovingArm:
    """Return the simulated real arm of a cell, with its dynamics, controller and sensors.

    Args:
        cell: whose true geometry it has.
        robot: its name in the library.
        seed: of what is wrong with the nominal masses.
        unmodelled: torques that no model holds.

    Raises:
        CalibError: where the library holds no masses for it.
    """
    nominal = cell.nominal
    if nominal.inertias is None:
        raise CalibError(f"the library holds no masses for {robot}, so that its motion cannot be simulated")
    rng = np.random.default_rng([seed, 71])
    inertias = np.array([_perturbed(row, rng) for row in nominal.inertias])
    chain = replace(cell.truth.chain, inertias=inertias)
    effort = np.array([joint.effort if np.isfinite(joint.effort) else 100.0 for joint in chain.joints])
    terms = drives.standard(
        [" ".join(known_robots.SIDED)] * chain.n, linear=[j.kind == "prismatic" for j in chain.joints]
    )
    values, source = _drives(robot, nominal, effort)
    plant = Plant(bodies_of(chain), tuple(terms), np.concatenate([standard_parameters(chain), values.ravel()]))
    share = np.array([KNOWN if name[:1] == "F" else 1.0 for name in known_robots.SIDED])
    believed_parameters = np.concatenate([standard_parameters(nominal), (values * share).ravel()])
    inertia = plant.inertia_diagonal(random_joints(chain, 200, 0))
    omega = 2 * np.pi * BANDWIDTH
    sensors = sensed(robot)
    noise = f"{SIGMA_MOTOR:.1%} (motors) and {SIGMA_LINK:.1%} (sensors)" if sensors else f"{SIGMA_MOTOR:.1%}"
    note = (
        f"masses off their nominal by {2 * MASS:.0%}, centres by {1e3 * SHIFT:g} mm (1 sigma); {source}; torque noise "
        f"{noise} of the limits{unmodelled.note}"
    )
    return MovingArm(
        chain,
        plant,
        IdentificationModel(plant.bodies, plant.terms, LINK),
        Plant(bodies_of(nominal), tuple(terms), believed_parameters),
        replace(pd(omega**2 * inertia, 2 * DAMPING * omega * inertia), cutoff=CUTOFF),
        effort,
        note,
        unmodelled,
        sensors,
    )


def sensed(robot: str) -> bool:
    """Return whether a robot of the library has joint torque sensors: friction behind its gears is known."""
    return library.path(f"{robot}_truth").exists() and "Fvl" in known_robots.truth(robot)["drives"]


def play(t: np.ndarray, q: np.ndarray, v: np.ndarray, a: np.ndarray, repeats: int) -> Reference:
    """Return the reference of a periodic motion that is repeated, with rest before and after.

    Args:
        t: (N,), even steps [s].
        q, v, a: (N, n).
    """
    rate = (len(t) - 1) / (t[-1] - t[0])
    still = np.zeros((round(REST * rate), q.shape[1]))
    parts = []
    for series, ends in ((q, (q[0], q[-1])), (v, (0.0, 0.0)), (a, (0.0, 0.0))):
        repeated = np.tile(series[:-1], (repeats, 1))
        parts.append(np.concatenate([still + ends[0], repeated, series[-1:], still + ends[1]]))
    return Reference(np.arange(len(parts[0])) / rate, *parts)


def record(
    arm: MovingArm, reference: Reference, seed: int | np.random.Generator = 0, running: float = np.inf
) -> Recording:
    """Return a simulated recording of a motion: encoders, motor torques and, where the arm has any, torque sensors.

    Args:
        arm: what moves.
        reference: what it is to follow.
        seed: of the noise.
        running: for how long the arm has moved before [s]; infinite for a warm one.

    Raises:
        NotConverged: where the loop is unstable.
    """
    rng = np.random.default_rng(seed)
    slow = replace(reference, a=0.0 * reference.a)
    controller = arm.gains.with_feedforward(feed_forward(arm.believed, slow))
    sensing = Sensing(SIGMA_Q, push=arm.unmodelled.push * arm.effort, push_band=PUSH_BAND)
    unmodelled = _unmodelled(arm, reference.q, reference.v, reference.a, running + reference.t)
    run = simulate(arm.plant, controller, reference, sensing, rng, push=-unmodelled)
    noise = [sigma * arm.effort * rng.normal(size=run.q.shape) for sigma in (SIGMA_LINK, SIGMA_MOTOR)]
    link = _held(arm.link_torque(run.q, run.v, run.a)) + noise[0] if arm.sensors else None
    motor = _held(run.torque) + noise[1]
    return Recording(run.t, run.measured, motor, "torque", arm.chain.joint_names, tau_link=link)


def _held(torque: np.ndarray) -> np.ndarray:
    """Return torques (N, n) averaged over the two control periods around each sample.

    The controller's torque is held for a period, so what is commanded at an instant acts half a period later; drives
    and sensors that integrate over their sampling see this mean, without that lead.
    """
    result = torque.copy()
    result[1:] = 0.5 * (torque[1:] + torque[:-1])
    return result


def _modelled(arm: MovingArm, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
    """Return the motor torques (N, n) [N m or N] of the simulated robot: rigid model with friction."""
    model = IdentificationModel(arm.plant.bodies, arm.plant.terms)
    return np.einsum("kij,j->ki", model.regressor(q, v, a), arm.plant.parameters)


def _unmodelled(arm: MovingArm, q: np.ndarray, v: np.ndarray, a: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Return the torques (N, n) of unmodelled effects [N m or N]; t (N,) is the time since the cold start [s]."""
    parameters = dict(zip((term.name for term in arm.plant.terms), arm.plant.parameters[arm.plant.inertial :]))
    viscous, coulomb = (
        np.array([parameters[f"{name}l{j + 1}"] + parameters[f"{name}m{j + 1}"] for j in range(arm.chain.n)])
        for name in ("Fv", "Fc")
    )
    friction = viscous * v + coulomb * np.sign(v)
    drive = _modelled(arm, q, v, a) if arm.unmodelled.ripple else np.zeros_like(q)
    gear_torque = gear_torques(arm.unmodelled, q, drive, coulomb, friction, t)
    return gear_torque + arm.unmodelled.cable_torques(q, arm.effort)


def _drives(robot: str, chain: Chain, effort: np.ndarray) -> tuple[np.ndarray, str]:
    """Return the true drive parameters (n, 7) in the order of `SIDED`, and a note on their source."""
    source = "drives as published for the type"
    if library.path(f"{robot}_truth").exists():
        rows = known_robots.truth(robot)["drives"]
        if "Fvl" not in rows:
            rows = {"Ia": rows["Ia"], "Fvm": rows["Fv"], "Fcm": rows["Fc"]}
    else:
        source = "drives assumed from its limits"
        speed = np.array([joint.velocity if np.isfinite(joint.velocity) else 2.0 for joint in chain.joints])
        bare = Plant(bodies_of(chain), (), standard_parameters(chain))
        inertia = bare.inertia_diagonal(random_joints(chain, 200, 0))
        rows = {"Ia": 0.5 * inertia, "Fvm": 0.05 * effort / speed, "Fcm": 0.05 * effort}
    return np.column_stack([rows.get(name, np.zeros(chain.n)) for name in known_robots.SIDED]), source


def _perturbed(parameters: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return the ten standard parameters of a body after random changes of shape, centre and mass.

    T P Tᵀ of the pseudo-inertia P (`calib.dynamics.pseudo_inertia`) is positive definite where P is.
    """
    turn = np.eye(4)
    turn[:3, :3] += STRETCH * rng.standard_normal((3, 3))
    turn[:3, 3] = SHIFT * rng.standard_normal(3)
    return to_standard((1.0 + MASS * rng.standard_normal()) ** 2 * turn @ from_standard(parameters) @ turn.T)
