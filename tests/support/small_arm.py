"""An arm that turns and slides, in a closed loop, for methods that simulate it."""

from dataclasses import replace
from functools import cache

import numpy as np

from calib.data.recordings.recording import Recording
from calib.data.signals.motion import FilterOptions, make_motion
from calib.dynamics import base as bases
from calib.dynamics import drives
from calib.dynamics.bodies import bodies_of, with_payload
from calib.dynamics.idim import IdentificationModel
from calib.dynamics.torque_rows import LINK, TorqueRows
from calib.identification.closed_loop import controllers
from calib.identification.closed_loop.simulation import Plant, Sensing, simulate
from calib.identification.loop import LoopSettings
from calib.identification.methods.method import IdentificationProblem
from calib.identification.rows import Case, make_case, observe
from calib.robot import mdh
from calib.simulation import known_robots

RATE = 700.0
ROWS = [
    mdh.Row("joint1", 1, "revolute", np.pi / 2, 0.0, 0.0, 0.0, lower=-2.0, upper=2.0),
    mdh.Row("joint2", 2, "prismatic", np.pi / 2, 0.1, 0.0, 0.3, lower=-1.0, upper=1.0),
]
LINKS = np.array([0.3, 0, 0, 0.1, 0, 0.4, 0.6, 0.1, 0, 3.0, 0.05, 0, 0, 0.04, 0, 0.1, 0.2, 0.05, 0, 1.0])
DRIVES = np.array([0.2, 1.0, 1.5, 0.1, 5.0, 0.8])  # Ia Fv Fc
PD = controllers.pd(np.array([900.0, 600.0]), np.array([40.0, 30.0]))
TOOL = np.array([0.02, 0, 0, 0.03, 0, 0.02, 0.1, -0.05, 0.15, 1.5])
STIFF = PD.slower(0.5)  # carries a payload
SETTINGS = FilterOptions(cutoff=40.0, band=20.0, clock="stamps")
NAMES = ("joint1", "joint2")
LOOP = LoopSettings(controller="pd", kp=tuple(PD.kp), kd=tuple(PD.kd), rate=RATE)


@cache
def robot(v0: float = 0.2) -> tuple[Plant, IdentificationModel, bases.Base]:
    """Return the arm as it is simulated, its model, and the base parameters of that."""
    chain = mdh.chain("turn and slide", ROWS)
    terms = drives.standard(["Ia Fv Fc"] * 2, v0, [False, True])
    model = IdentificationModel(bodies_of(chain), terms)
    plant = Plant(model.bodies, terms, np.concatenate([LINKS, DRIVES]))
    return plant, model, bases.find(model)


def random_motion(seconds: float, rate: float, seed: int) -> controllers.Reference:
    """Return a random Fourier motion of both joints."""
    limit = np.array([1.5, 0.6])
    speed = np.full(2, 3.0)
    return known_robots.random_fourier(-limit, limit, speed, seconds, rate, 8, acceleration=20.0, seed=seed)


@cache
def motion(rate: float = RATE) -> controllers.Reference:
    """Return the motion of `problem`, 5 s."""
    return random_motion(5.0, rate, seed=5)


def problem(
    seed: int, sigma_q: float = 0.0, sigma_tau: float = 0.05, rate: float = RATE, v0: float = 0.2
) -> IdentificationProblem:
    """Return the problem of a log at 200 Hz; of a loop at 700 Hz 3.5 periods per sample."""
    plant, model, base = robot(v0)
    tick = rate / 200.0
    run = simulate(plant, PD, motion(rate), Sensing(sigma_q, sigma_tau=sigma_tau, every=tick), seed)
    reference = motion(rate).at(np.arange(len(run.t)) * tick)[0]
    recording = Recording(run.t, run.measured, run.tau, "torque", NAMES, q_ref=reference)
    case = make_case("log", make_motion(recording, SETTINGS))
    return identification_problem(model, base, [case], replace(LOOP, rate=rate))


def identification_problem(
    model: IdentificationModel, base: bases.Base, cases: list[Case], loop: LoopSettings
) -> IdentificationProblem:
    """Return the problem of identifying base parameters from recorded cases of a loop."""
    decimator = cases[0].motion.decimator
    rows = tuple(observe(model, base.kept, case, decimator) for case in cases)
    terms = tuple(None if k < model.inertial else model.columns[k - model.inertial] for k in base.kept)
    groups = np.full(base.b, -1)
    return IdentificationProblem(model, base, tuple(cases), decimator, rows, terms, groups, loop=loop)


def sensed(
    rows: TorqueRows, seed: int, sigma_q: float, seconds: float = 5.0
) -> tuple[IdentificationProblem, np.ndarray]:
    """Return the problem of two logs with joint torque sensors, without and with a payload, and its true parameters."""
    chain = mdh.chain("turn and slide", ROWS)
    terms = drives.standard(["Ia Fvm Fcm Fvl Fcl"] * 2, 0.2, [False, True])
    bodies = with_payload(bodies_of(chain), np.eye(4), "tool")
    amounts = dict(zip(("Ia1", "Fvm1", "Fcm1", "Ia2", "Fvm2", "Fcm2"), DRIVES))
    amounts |= {"Fvl1": 0.4, "Fcl1": 0.5, "Fvl2": 2.0, "Fcl2": 0.3}
    plant = Plant(bodies, terms, np.concatenate([LINKS, TOOL, [amounts[term.name] for term in terms]]))
    model = IdentificationModel(bodies, terms, rows)
    link_model = IdentificationModel(bodies, terms, LINK)

    def values(model: IdentificationModel) -> np.ndarray:
        return np.append(plant.parameters[: plant.inertial], [amounts[term.name] for term in model.columns])

    cases = []
    for k, payloads in enumerate(((), ("tool",))):
        reference = random_motion(seconds, RATE, seed=5 + k)
        present = np.append(link_model.carried_columns(payloads), np.ones(len(terms)))
        loaded = plant.with_parameters(plant.parameters * present)
        run = simulate(loaded, STIFF, reference, Sensing(sigma_q, sigma_tau=0.05, every=3.5), seed)
        tau_link = link_model.torque(values(link_model), run.q, run.v, run.a, payloads)
        tau_link = tau_link + 0.02 * np.random.default_rng([seed, k]).normal(size=run.q.shape)
        q_ref = reference.at(np.arange(len(run.t)) * 3.5)[0]
        recording = Recording(run.t, run.measured, run.tau, "torque", NAMES, tau_link=tau_link, q_ref=q_ref)
        cases.append(make_case(f"log{k}", make_motion(recording, SETTINGS), rows, carried=payloads))
    base = bases.find(model, loads=((), ("tool",)))
    loop = replace(LOOP, kp=tuple(STIFF.kp), kd=tuple(STIFF.kd))
    return identification_problem(model, base, cases, loop), base.transform @ values(model)


def truth() -> np.ndarray:
    """Return the true base parameters of `problem`."""
    plant, _, base = robot()
    return base.transform @ plant.parameters
