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
from calib.identification.rows import make_case, observe
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
LOOP = LoopSettings(controller="pd", kp=tuple(PD.kp), kd=tuple(PD.kd), rate=RATE)


@cache
def robot(v0: float = 0.2) -> tuple[Plant, IdentificationModel, bases.Base]:
    chain = mdh.chain("turn and slide", ROWS)
    terms = drives.standard(["Ia Fv Fc"] * 2, v0, [False, True])
    model = IdentificationModel(bodies_of(chain), terms)
    return Plant(model.bodies, terms, np.concatenate([LINKS, DRIVES])), model, bases.find(model)


@cache
def motion(rate: float = RATE) -> controllers.Reference:
    limit = np.array([1.5, 0.6])
    return known_robots.random_fourier(-limit, limit, np.full(2, 3.0), 5.0, rate, 8, acceleration=20.0, seed=5)


def problem(
    seed: int, sigma_q: float = 0.0, sigma_tau: float = 0.05, rate: float = RATE, v0: float = 0.2
) -> IdentificationProblem:
    """Return the problem of a log at 200 Hz; of a loop at 700 Hz 3.5 periods per sample."""
    plant, model, base = robot(v0)
    tick = rate / 200.0
    run = simulate(plant, PD, motion(rate), Sensing(sigma_q, sigma_tau=sigma_tau, every=tick), seed)
    asked = motion(rate).at(np.arange(len(run.t)) * tick)[0]
    recording = Recording(run.t, run.measured, run.tau, "torque", ("joint1", "joint2"), q_ref=asked)
    case = make_case("log", make_motion(recording, FilterOptions(cutoff=40.0, band=20.0, clock="stamps")))
    decimator = case.motion.decimator
    rows = (observe(model, base.kept, case, decimator),)
    terms = tuple(None if k < model.inertial else model.columns[k - model.inertial] for k in base.kept)
    return IdentificationProblem(
        model, base, (case,), decimator, rows, terms, np.full(base.b, -1), loop=replace(LOOP, rate=rate)
    )  # fmt: skip


def sensed(
    rows: TorqueRows, seed: int, sigma_q: float, seconds: float = 5.0
) -> tuple[IdentificationProblem, np.ndarray]:
    """Return the problem of two logs with joint torque sensors, without and with a payload, and its true parameters."""
    chain, motors = mdh.chain("turn and slide", ROWS), np.append(DRIVES, [0.4, 0.5, 2.0, 0.3])
    terms = drives.standard(["Ia Fvm Fcm Fvl Fcl"] * 2, 0.2, [False, True])
    bodies = with_payload(bodies_of(chain), np.eye(4), "tool")
    amounts = dict(zip([f"{name}{j}" for j in (1, 2) for name in ("Ia", "Fvm", "Fcm")], motors[:6]))
    amounts |= dict(zip(("Fvl1", "Fcl1", "Fvl2", "Fcl2"), motors[6:]))
    plant = Plant(bodies, terms, np.concatenate([LINKS, TOOL, [amounts[one.name] for one in terms]]))
    model, link = (IdentificationModel(bodies, terms, kind) for kind in (rows, LINK))
    values = {
        kind: np.append(plant.parameters[: plant.inertial], [amounts[one.name] for one in own.columns])
        for kind, own in (("model", model), ("link", link))
    }
    cases = []
    for k, carried in enumerate(((), ("tool",))):
        limit = np.array([1.5, 0.6])
        asked = known_robots.random_fourier(
            -limit, limit, np.full(2, 3.0), seconds, RATE, 8, acceleration=20.0, seed=5 + k
        )
        there = np.append(link.carried_columns(carried), np.ones(len(terms)))
        loaded = plant.with_parameters(plant.parameters * there)
        moved = simulate(loaded, STIFF, asked, Sensing(sigma_q, sigma_tau=0.05, every=3.5), seed)
        felt = link.torque(values["link"], moved.q, moved.v, moved.a, carried)
        felt = felt + 0.02 * np.random.default_rng([seed, k]).normal(size=moved.q.shape)
        ticks = np.arange(len(moved.t)) * 3.5
        recording = Recording(
            moved.t, moved.measured, moved.tau, "torque", ("joint1", "joint2"), tau_link=felt, q_ref=asked.at(ticks)[0]
        )
        motion_of = make_motion(recording, FilterOptions(cutoff=40.0, band=20.0, clock="stamps"))
        cases.append(make_case(f"log{k}", motion_of, rows, carried=carried))
    base = bases.find(model, loads=((), ("tool",)))
    observed = tuple(observe(model, base.kept, case, cases[0].motion.decimator) for case in cases)
    own = tuple(None if k < model.inertial else model.columns[k - model.inertial] for k in base.kept)
    found = IdentificationProblem(
        model, base, tuple(cases), cases[0].motion.decimator, observed, own, np.full(base.b, -1),
        loop=replace(LOOP, kp=tuple(STIFF.kp), kd=tuple(STIFF.kd)),
    )  # fmt: skip
    return found, base.transform @ values["model"]


def truth() -> np.ndarray:
    plant, _, base = robot()
    return base.transform @ plant.parameters
