"""Simulated data sets: a robot with known parameters in its control loop, and the input of the methods.

The robot follows a motion in its controller's loop at 5 kHz. It is logged at 1 kHz (TX40), at 140 Hz (RV-2SQ), or at
the condition's rate. The encoders' noise acts within the loop; the torque's noise is added to the log. Positions are
low-pass filtered and differentiated, and rows decimated, as by `calib identify`. The model that the methods assume may
differ from the simulated robot (`Condition.mismatch`). All data sets of a condition share one motion. It is the best,
by condition number, of `MOTION_TRIES` random Fourier series, or one that `calib excite` designed (``library/ROBOT``, by
``examples/survey/limits.toml``) of the same family within the same joint limits. Random motions are not checked for
self-collisions.
"""

from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline

from calib.apps.studies.conditions import LIBRARY, Condition
from calib.toolkit.chains import Chain, load, random_joints
from calib.toolkit.installations import fit_installation, install
from calib.toolkit.recordings import USABLE, FilterOptions, Recording, design_decimator, make_motion, read_trajectory
from calib.toolkit.simulations import (
    LoopController,
    LoopSettings,
    Plant,
    Reference,
    Sensing,
    SimulatedInstrument,
    SimulatedRun,
    feed_forward,
    known_plant,
    known_truth,
    measure,
    perturbed_cell,
    plant_model,
    published_controller,
    random_fourier,
    rigid,
    simulate,
)
from calib.toolkit.torque_models import (
    Base,
    Case,
    ConstraintSettings,
    IdentificationModel,
    IdentificationProblem,
    ball,
    bodies_of,
    drive_term,
    find_base,
    make_case,
    margin,
    observe,
    regroup,
    with_payload,
)

# The numbers below are our choices.
# Random motions to take the best of; harmonics of each.
MOTION_TRIES, HARMONICS = 20, 12
# Number of the random motion that validates.
VALIDATION = 10_000
# Shares of the joints' limits of position and speed; largest acceleration of any joint [rad/s²].
REACH, SPEED, ACCELERATION = 0.9, 0.8, 40.0
# Factor of the control period: instants at which a motion's condition and the validation torques are taken.
THIN = 50
# Factors of kp and kd in the believed controller (mismatch "controller").
BELIEVED = 1.3, 0.7
# Peak of friction at rest beyond Fc, as its share; the speed that it falls with [rad/s] (mismatch "friction").
STRIBECK, SLIP = 0.5, 0.1
# Mass of a ball [kg]; its radius, and its distance from the flange [m] (mismatch "payload").
PAYLOAD, AWAY = 1.0, 0.05
# Delay of the logged torques [s] (mismatch "clock").
TORQUE_LAG = 2e-3
# Times 0.3 mm, 0.5 mrad and 3 mrad of joint offset (1 sigma): a drawing's robot, not calibrated (mismatch "geometry").
DRAWING_ERROR = 3.0
# Poses measured for the geometric fit, by a tracker of frames (60 µm, 0.2 mrad) (mismatch "calibrated").
POSE_COUNT = 40
# Draws of start values of a body with one spread; then it is halved. Draws in all.
DRAWS, MAX_DRAWS = 100, 1000


@dataclass(frozen=True, eq=False)
class Setup:
    """Data common to all data sets of a condition.

    Attributes:
        chain: the arm that the methods assume.
        plant: the robot with the parameters published by its manufacturer.
        reference: the training motion, at the control rate.
        validation: the motion on which estimates are judged.
        every: number of control periods per sample of the log; need not be whole.
    """

    chain: Chain
    plant: Plant
    reference: Reference
    validation: Reference
    every: float


@dataclass(frozen=True, eq=False)
class Experiment:
    """One simulated data set.

    Attributes:
        problem: input of a method.
        model: identification model of the problem.
        truth: (b,) true values of the model's base parameters.
        matrix: (K, n, b) base regressor of the assumed robot at K samples of the validation motion.
        torque: (K, n) noise-free torques of the true robot along the validation motion, without its unknown payload [N
            m].
    """

    problem: IdentificationProblem
    model: IdentificationModel
    truth: np.ndarray
    matrix: np.ndarray
    torque: np.ndarray


def set_up(condition: Condition) -> Setup:
    """Return the data common to all data sets of a condition."""
    setup = _set_up(condition.robot, condition.duration, condition.motion)
    if not condition.rate:
        return setup
    return replace(setup, every=1.0 / (setup.reference.period * condition.rate))


@lru_cache(maxsize=4)
def _set_up(robot: str, duration: float, motion: str) -> Setup:
    """Return the data common to all data sets of a robot and a motion, logged at the robot's own rate.

    Args:
        robot: name of the robot, one of `ROBOTS`.
        duration: duration of the motion [s].
        motion: one of `MOTIONS`, or the folder of a motion by `calib excite`.
    """
    chain = load(robot)
    plant = known_plant(robot)
    control = known_truth(robot)["control"]
    rate = float(control["rate"])
    every = rate / float(control["sampling"])
    validation = _drawn(chain, duration, rate, VALIDATION)
    if motion == "random":
        training = _best_random_motion(robot, chain, duration, rate)
    else:
        if motion == "designed":
            folder = LIBRARY / robot
        else:
            folder = Path(motion)
        series = read_trajectory(folder)
        t = np.arange(round(duration * rate) + 1) / rate
        training = Reference(t, *series.orders(t))
    return Setup(chain, plant, training, validation, every)


def _best_random_motion(robot: str, chain: Chain, duration: float, rate: float) -> Reference:
    """Return the one of `MOTION_TRIES` random motions whose base regressor has the smallest condition number.

    Args:
        robot: name of the robot.
        chain: its nominal geometry.
        duration: duration of the motion [s].
        rate: sampling rate of the motion [Hz].
    """
    model = plant_model(known_plant(robot))
    base_columns = _nominal_base(robot).kept
    part = slice(None, None, 2 * THIN)

    def condition_number(motion: Reference) -> float:
        regressor = model.regressor(motion.q[part], motion.v[part], motion.a[part])
        matrix = regressor[:, :, base_columns].reshape(-1, len(base_columns))
        return float(np.linalg.cond(matrix / np.linalg.norm(matrix, axis=0)))

    motions = (_drawn(chain, duration, rate, number) for number in range(MOTION_TRIES))
    return min(motions, key=condition_number)


def _drawn(chain: Chain, duration: float, rate: float, number: int) -> Reference:
    """Return a random Fourier series within the joint limits; reproducible.

    Args:
        chain: the arm with its limits.
        duration: duration of the motion [s].
        rate: sampling rate of the motion [Hz].
        number: seed of the series.
    """
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
    return find_base(plant_model(known_plant(robot)))


@lru_cache(maxsize=2)
def make_experiment(condition: Condition, seed: int) -> Experiment:
    """Return the simulated data set of a condition and a trial's seed, with start values for methods; reproducible.

    Raises:
        CalibError: the true robot cannot be simulated in its control loop.
    """
    number, guess = divmod(seed, condition.guesses)
    data = data_set(condition, number)
    guess_seed = seed
    if condition.guesses > 1:
        guess_seed = guess
    values = _guess(set_up(condition).plant, condition.guess, guess_seed)
    problem = replace(data.problem, start=data.problem.base.transform @ values)
    if guess:
        # The rows are the same: `pooled`, a cached property, is reduced once for all guesses.
        problem.__dict__["pooled"] = data.problem.pooled
    return replace(data, problem=problem)


@lru_cache(maxsize=2)
def data_set(condition: Condition, seed: int) -> Experiment:
    """Return the simulated data set of a condition and a seed, without start values; reproducible."""
    setup = set_up(condition)
    controller = published_controller(condition.robot)
    robots = _robots(condition, setup, seed)
    model = robots.model
    base = robots.base
    case = _recorded(condition, setup, robots.true, controller, seed)
    decimator = case.motion.decimator
    rows = observe(model, base.kept, case, decimator)
    all_terms = [*[None] * model.inertial, *model.columns]
    terms = [all_terms[column] for column in base.kept]
    problem = IdentificationProblem(
        model,
        base,
        (case,),
        decimator,
        (rows,),
        tuple(terms),
        np.full(base.b, -1),
        loop=_loop(condition, controller),
        constraints=ConstraintSettings(bodies=True),
    )
    part = slice(None, None, THIN)
    motion = setup.validation
    validation = Reference(motion.t[part], motion.q[part], motion.v[part], motion.a[part])
    matrix = model.regressor(validation.q, validation.v, validation.a)[:, :, base.kept]
    # A payload that nobody knows of is no part of the robot that the model shall predict.
    if condition.mismatch == "payload":
        predicted = robots.truth
    else:
        predicted = robots.true
    torque = feed_forward(predicted, validation)
    return Experiment(problem, model, base.transform @ robots.truth.parameters, matrix, torque)


@dataclass(frozen=True, eq=False)
class _Robots:
    """The true and the assumed robot of a data set.

    Attributes:
        true: the simulated robot.
        model, base: the assumed model with its base parameters.
        truth: a robot with the true values of the assumed model's parameters.
    """

    true: Plant
    model: IdentificationModel
    base: Base
    truth: Plant


def _robots(condition: Condition, setup: Setup, seed: int) -> _Robots:
    """Return the true and the assumed robot of a data set, which differ by the condition's mismatch.

    Args:
        condition: the condition.
        setup: the data common to all data sets of the condition.
        seed: seed of the data set.
    """
    plant = setup.plant
    chain = setup.chain
    robots = _Robots(plant, plant_model(plant), _nominal_base(condition.robot), plant)
    if condition.mismatch in ("geometry", "calibrated"):
        cell = rigid(perturbed_cell(chain, seed, SimulatedInstrument(), size=DRAWING_ERROR))
        true_chain = replace(cell.truth.chain, inertias=chain.inertias)
        robots = replace(robots, true=replace(plant, bodies=bodies_of(true_chain)))
        if condition.mismatch == "geometry":
            return robots
        measured = [measure(cell, random_joints(chain, POSE_COUNT, seed), seed=seed)]
        fitted_chain = fit_installation(install(chain, measured), measured).cell.chain
        fitted_model = replace(robots.model, bodies=bodies_of(fitted_chain))
        return replace(robots, model=fitted_model, base=regroup(robots.base, fitted_model))
    if condition.mismatch == "friction":
        friction = known_truth(condition.robot)["drives"]
        v0 = float(friction["v0"])
        peaks = [drive_term(f"Fs{joint + 1}", "stribeck", joint, SLIP, 1.0, v0) for joint in range(chain.n)]
        values = np.concatenate([plant.parameters, STRIBECK * np.array(friction["Fc"])])
        return replace(robots, true=Plant(plant.bodies, (*plant.terms, *peaks), values))
    if condition.mismatch == "payload":
        size = plant.inertial
        payload = ball(PAYLOAD, AWAY, np.array([0.0, 0.0, AWAY]))
        bodies = with_payload(plant.bodies, np.asarray(chain.tail), on=chain.n - 1)
        values = np.concatenate([plant.parameters[:size], payload, plant.parameters[size:]])
        return replace(robots, true=Plant(bodies, plant.terms, values))
    return robots


def _recorded(condition: Condition, setup: Setup, true: Plant, controller: LoopController, seed: int) -> Case:
    """Return the recording of one noisy run of the true robot in its control loop.

    Args:
        condition: the condition, which gives the noise.
        setup: the data common to all data sets of the condition.
        true: the simulated robot.
        controller: its controller.
        seed: seed of the noise.
    """
    sensing = Sensing(condition.sigma_q, 0.0, condition.sigma_tau, every=setup.every)

    def run(every: float) -> SimulatedRun:
        rng = np.random.default_rng([seed, 20_211])
        return simulate(true, controller, setup.reference, replace(sensing, every=every), rng)

    log = run(setup.every)
    period = setup.reference.period
    rate = 1.0 / (period * setup.every)
    torque = log.tau
    if condition.mismatch == "clock":
        late_ticks = np.rint((log.t - log.t[0] - TORQUE_LAG) / period).astype(int)
        torque = run(1).tau[np.maximum(late_ticks, 0)]
    q_ref = CubicSpline(setup.reference.t, setup.reference.q)(log.t)
    names = setup.chain.joint_names
    recording = Recording(log.t, log.measured, torque, "torque", names, q_ref=q_ref, file=condition.name)
    cutoff = condition.cutoff or USABLE * rate / 2
    decimator = design_decimator(rate, condition.decimation, "chebyshev")
    motion = make_motion(recording, FilterOptions(cutoff=cutoff, band=0.999 * decimator.band, clock="stamps"))
    return make_case(condition.name, replace(motion, decimator=decimator, band=decimator.band))


def _loop(condition: Condition, controller: LoopController) -> LoopSettings:
    """Return the control loop that the methods assume, with wrong gains if this is the condition's mismatch.

    Args:
        condition: the condition.
        controller: the controller of the simulated robot.
    """
    kp = kd = 1.0
    if condition.mismatch == "controller":
        kp, kd = BELIEVED
    truth = known_truth(condition.robot)
    believed_kp = tuple(kp * controller.kp)
    believed_kd = tuple(kd * controller.kd)
    limit = tuple(controller.limit)
    rate = float(truth["control"]["rate"])
    inertia = tuple(truth["drives"]["Ia"])
    return LoopSettings("pd", kp=believed_kp, kd=believed_kd, limit=limit, rate=rate, inertia=inertia)


def _guess(plant: Plant, spread: float, seed: int) -> np.ndarray:
    """Return start values: the robot's parameters with normally distributed relative errors.

    The inertial parameters of each link stay physically consistent: a link's errors are drawn until they are (as in the
    survey, but link by link). If that takes too many draws, `spread` is halved for the link.

    Args:
        plant: the robot.
        spread: standard deviation of the relative errors.
        seed: seed of the errors.
    """
    rng = np.random.default_rng([seed, 15])
    size = plant.inertial
    values = np.array(plant.parameters)
    for first in range(0, size, 10):
        body = plant.parameters[first : first + 10]
        body_spread = spread
        for draw in range(1, MAX_DRAWS + 1):
            drawn = body * (1.0 + body_spread * rng.standard_normal(10))
            values[first : first + 10] = drawn
            if margin(drawn) > 0.0:
                break
            if draw % DRAWS == 0:
                body_spread *= 0.5
    drive_parameters = plant.parameters[size:]
    factors = 1.0 + spread * rng.standard_normal(len(drive_parameters))
    values[size:] = drive_parameters * np.maximum(factors, 0.01)
    return values
