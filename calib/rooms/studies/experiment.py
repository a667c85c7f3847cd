"""Simulated data sets: a robot with known parameters in its control loop, and the input of the methods.

The robot follows a motion in its controller's loop at 5 kHz, logged at 1 kHz (TX40), 140 Hz (RV-2SQ) or a stated rate;
the encoders' noise enters the loop, the torque's is that of the log. Positions are low-passed and differentiated, rows
decimated, as `calib identify` does it. What is believed of the robot may differ from what it is (`Condition.mismatch`).
All data sets of a condition share the motion: the best by condition number of `MOTION_TRIES` random Fourier series, or
one that `calib excite` designed (``library/ROBOT``, by ``examples/survey/limits.toml``), of the same family within the
same limits of the joints (self-collisions of random ones are not looked at).
"""

from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline

from calib.data.recordings.recording import Recording
from calib.data.signals.bandwidth import USABLE
from calib.data.signals.filtering import design_decimator
from calib.data.signals.motion import FilterOptions, make_motion
from calib.dynamics import base as bases
from calib.dynamics import drives
from calib.dynamics.base import Base
from calib.dynamics.bodies import bodies_of, with_payload
from calib.dynamics.idim import IdentificationModel
from calib.dynamics.pseudo_inertia import ball, margin
from calib.geometry import fit as geometry
from calib.geometry.first_guess import install
from calib.identification.closed_loop.controllers import Reference
from calib.identification.closed_loop.simulation import Plant, Sensing, SimulatedRun, feed_forward, simulate
from calib.identification.loop import Controller, LoopSettings
from calib.identification.methods.constraint_settings import ConstraintSettings
from calib.identification.methods.method import IdentificationProblem
from calib.identification.rows import Case, make_case, observe
from calib.procedure.excitation import coefficients
from calib.robot.chain import Chain, random_joints
from calib.robot.library import load
from calib.rooms.cells import known_robots
from calib.rooms.cells.cell import SimulatedInstrument, measure
from calib.rooms.cells.known_robots import random_fourier
from calib.rooms.cells.virtual_cells import perturbed_cell, rigid
from calib.rooms.studies.conditions import LIBRARY, Condition

# our choices
MOTION_TRIES, HARMONICS = 20, 12  # motions to take the best of; harmonics of each
VALIDATION = 10_000  # number of the random motion that validates
REACH, SPEED, ACCELERATION = 0.9, 0.8, 40.0  # shares of the limits; largest in any joint [rad/s²]
THIN = 50  # of the control rate: instants at which a motion's condition and the validation torques are taken
BELIEVED = 1.3, 0.7  # factors of kp, kd
STRIBECK, SLIP = 0.5, 0.1  # peak of friction at rest beyond Fc, as its share; the speed it falls with [rad/s]
PAYLOAD, AWAY = 1.0, 0.05  # [kg] a ball, [m] in front of the flange


@dataclass(frozen=True, eq=False)
class Setup:
    """Data shared by all data sets of a condition.

    Attributes:
        chain: the arm as it is believed to be.
        plant: the robot as its maker describes it.
        reference: the motion, at the control rate.
        other: the motion that validates.
        every: control periods per sample, whole or not.
    """

    chain: Chain
    plant: Plant
    reference: Reference
    other: Reference
    every: float


@dataclass(frozen=True, eq=False)
class Experiment:
    """One simulated data set.

    Attributes:
        problem: what a method is given; model: of it.
        truth: (b,) true values of the model's base parameters.
        matrix: (K, n, b) base regressor of the believed robot along the validation motion.
        torque: (K, n) noise-free torques that the true robot needs along it, without what it carried unknown [N m].
    """

    problem: IdentificationProblem
    model: IdentificationModel
    truth: np.ndarray
    matrix: np.ndarray
    torque: np.ndarray


def set_up(condition: Condition) -> Setup:
    """Return the data shared by all data sets of a condition."""
    shared = _set_up(condition.robot, condition.duration, condition.motion)
    return replace(shared, every=1.0 / (shared.reference.period * condition.rate)) if condition.rate else shared


@lru_cache(maxsize=4)
def _set_up(robot: str, duration: float, motion: str) -> Setup:
    chain = load(robot)
    plant = known_robots.plant(robot)
    known = known_robots.truth(robot)["control"]
    rate, every = float(known["rate"]), float(known["rate"]) / float(known["sampling"])
    if motion != "random":
        found = coefficients.read(LIBRARY / robot if motion == "designed" else Path(motion))
        t = np.arange(round(duration * rate) + 1) / rate
        return Setup(chain, plant, Reference(t, *found.orders(t)), _drawn(chain, duration, rate, VALIDATION), every)
    model = known_robots.model(plant)
    kept = _nominal_base(robot).kept

    def condition(reference: Reference) -> float:
        part = slice(None, None, 2 * THIN)
        matrix = model.regressor(reference.q[part], reference.v[part], reference.a[part])[:, :, kept]
        matrix = matrix.reshape(-1, len(kept))
        return float(np.linalg.cond(matrix / np.linalg.norm(matrix, axis=0)))

    training = min((_drawn(chain, duration, rate, number) for number in range(MOTION_TRIES)), key=condition)
    return Setup(chain, plant, training, _drawn(chain, duration, rate, VALIDATION), every)


def _drawn(chain: Chain, duration: float, rate: float, number: int) -> Reference:
    """Return a random Fourier series within the limits, always the same for a number."""
    lower, upper = chain.sampling_limits()
    middle, half = 0.5 * (lower + upper), 0.5 * REACH * (upper - lower)
    speed = SPEED * np.array([joint.velocity for joint in chain.joints])
    return random_fourier(
        middle - half,
        middle + half,
        speed,
        duration,
        rate,
        HARMONICS,
        acceleration=ACCELERATION,
        seed=np.random.default_rng([number, HARMONICS]),
    )


@lru_cache(maxsize=4)
def _nominal_base(robot: str) -> Base:
    return bases.find(known_robots.model(known_robots.plant(robot)))


@lru_cache(maxsize=2)
def make_experiment(condition: Condition, seed: int) -> Experiment:
    """Return the simulated data set of a condition and a trial's seed, with its start values; always the same.

    Raises:
        CalibError: where the true robot cannot be recorded.
    """
    number, guess = divmod(seed, condition.guesses)
    data = data_set(condition, number)
    values = _guess(set_up(condition).plant, condition.guess, guess if condition.guesses > 1 else seed)
    problem = replace(data.problem, start=data.problem.base.transform @ values)
    if guess:
        vars(problem)["pooled"] = data.problem.pooled  # the same rows: reduced once for all guesses
    return replace(data, problem=problem)


@lru_cache(maxsize=2)
def data_set(condition: Condition, seed: int) -> Experiment:
    """Return the simulated data set of a condition and a seed, without start values; always the same."""
    setup = set_up(condition)
    controller = known_robots.controller(condition.robot)
    true, model, base, truth = _robots(condition, setup, seed)
    case = _recorded(condition, setup, true, controller, seed)
    decimator = case.motion.decimator
    rows = observe(model, base.kept, case, decimator)
    terms = tuple(None if k < model.inertial else model.columns[k - model.inertial] for k in base.kept)
    problem = IdentificationProblem(
        model,
        base,
        (case,),
        decimator,
        (rows,),
        terms,
        np.full(base.b, -1),
        loop=_loop(condition, controller),
        constraints=ConstraintSettings(bodies=True),
    )
    part = slice(None, None, THIN)
    thin = Reference(*(series[part] for series in (setup.other.t, setup.other.q, setup.other.v, setup.other.a)))
    matrix = model.regressor(thin.q, thin.v, thin.a)[:, :, base.kept]
    torque = feed_forward(truth if condition.mismatch == "payload" else true, thin)
    return Experiment(problem, model, base.transform @ truth.parameters, matrix, torque)


def _robots(condition: Condition, setup: Setup, seed: int) -> tuple[Plant, IdentificationModel, Base, Plant]:
    """Return the true robot, the assumed model with its base, and the robot with the model's parameters."""
    plant, chain = setup.plant, setup.chain
    model, base = known_robots.model(plant), _nominal_base(condition.robot)
    size_factor = 3.0  # times 0.3 mm, 0.5 mrad and 3 mrad of joint offset (1 sigma): a drawing's robot, not calibrated
    pose_count = 40  # measured for the geometric fit, by a tracker of frames (60 µm, 0.2 mrad)
    if condition.mismatch in ("geometry", "calibrated"):
        cell = rigid(perturbed_cell(chain, seed, SimulatedInstrument(), size=size_factor))
        true = replace(plant, bodies=bodies_of(replace(cell.truth.chain, inertias=chain.inertias)))
        if condition.mismatch == "geometry":
            return true, model, base, plant
        measured = [measure(cell, random_joints(chain, pose_count, seed), seed=seed)]
        found = geometry.fit(install(chain, measured), measured).cell.chain
        fitted = replace(model, bodies=bodies_of(found))
        return true, fitted, bases.regroup(base, fitted), plant
    if condition.mismatch == "friction":
        v0 = float(known_robots.truth(condition.robot)["drives"]["v0"])
        peaks = tuple(drives.term(f"Fs{joint + 1}", "stribeck", joint, SLIP, 1.0, v0) for joint in range(chain.n))
        coulomb = np.array(known_robots.truth(condition.robot)["drives"]["Fc"])
        values = np.concatenate([plant.parameters, STRIBECK * coulomb])
        return Plant(plant.bodies, (*plant.terms, *peaks), values), model, base, plant
    if condition.mismatch == "payload":
        size = plant.inertial
        body = ball(PAYLOAD, AWAY, np.array([0.0, 0.0, AWAY]))
        bodies = with_payload(plant.bodies, np.asarray(chain.tail), on=chain.n - 1)
        values = np.concatenate([plant.parameters[:size], body, plant.parameters[size:]])
        return Plant(bodies, plant.terms, values), model, base, plant
    return plant, model, base, plant


def _recorded(condition: Condition, setup: Setup, true: Plant, controller: Controller, seed: int) -> Case:
    """Return the recording of one noisy run of the true robot, as a case."""
    sensing = Sensing(condition.sigma_q, 0.0, condition.sigma_tau, every=setup.every)

    def run(every: float) -> SimulatedRun:
        own = replace(sensing, every=every)
        return simulate(true, controller, setup.reference, own, np.random.default_rng([seed, 20_211]))

    log, period = run(setup.every), setup.reference.period
    rate, torque = 1.0 / (period * setup.every), log.tau
    torque_lag = 2e-3  # [s]
    if condition.mismatch == "clock":
        torque = run(1).tau[np.maximum(np.rint((log.t - log.t[0] - torque_lag) / period).astype(int), 0)]
    asked = CubicSpline(setup.reference.t, setup.reference.q)(log.t)
    recording = Recording(
        log.t, log.measured, torque, "torque", setup.chain.joint_names, q_ref=asked, file=condition.name
    )
    cutoff = condition.cutoff or USABLE * rate / 2
    decimator = design_decimator(rate, condition.decimation, "chebyshev")
    motion = make_motion(recording, FilterOptions(cutoff=cutoff, band=0.999 * decimator.band, clock="stamps"))
    return make_case(condition.name, replace(motion, decimator=decimator, band=decimator.band))


def _loop(condition: Condition, controller: Controller) -> LoopSettings:
    """Return the loop settings for the methods, with the errors of the condition."""
    kp, kd = BELIEVED if condition.mismatch == "controller" else (1.0, 1.0)
    known = known_robots.truth(condition.robot)
    return LoopSettings(
        "pd",
        kp=tuple(kp * controller.kp),
        kd=tuple(kd * controller.kd),
        limit=tuple(controller.limit),
        rate=float(known["control"]["rate"]),
        inertia=tuple(known["drives"]["Ia"]),
    )


def _guess(plant: Plant, spread: float, seed: int) -> np.ndarray:
    """Return the robot's parameters with normal relative errors; the inertias stay physically consistent.

    A body is drawn until it can be (the survey's way, but body by body); where that takes long, from a smaller spread.
    """
    rng = np.random.default_rng([seed, 15])
    values = np.array(plant.parameters)
    for first in range(0, plant.inertial, 10):
        body, own = plant.parameters[first : first + 10], spread
        for attempt in range(1000):
            values[first : first + 10] = body * (1.0 + own * rng.standard_normal(10))
            if margin(values[first : first + 10]) > 0.0:
                break
            own *= 0.5 if attempt % 100 == 99 else 1.0
    drives_ = plant.parameters[plant.inertial :]
    off = 1.0 + spread * rng.standard_normal(len(drives_))
    values[plant.inertial :] = drives_ * np.maximum(off, 0.01)
    return values
