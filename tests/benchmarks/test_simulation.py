"""Speed of the closed loop and of IDIM-IV, each beside what it is compared with.

python -m pytest tests/benchmarks/test_simulation.py -o addopts= --benchmark-group-by=group \
    --benchmark-columns=min,median,rounds
"""

import sys
from functools import cache

import numpy as np
import pinocchio_model as model
import pytest

from calib.data.recordings.recording import Recording
from calib.data.signals.motion import FilterOptions, make_motion
from calib.dynamics import base as bases
from calib.dynamics.bodies import standard_parameters
from calib.identification.closed_loop.controllers import Reference
from calib.identification.closed_loop.instrumental import identify_instrumental
from calib.identification.closed_loop.loop_recordings import Loop
from calib.identification.closed_loop.simulation import Plant, Sensing, forward_dynamics, simulate
from calib.identification.rows import Case, make_case
from calib.robot import description, library
from calib.simulation import known_robots
from calib.simulation.known_robots import random_fourier

STATES = 20_000
REACH = np.array([2.8, 1.8, 2.0, 3.5, 1.9, 4.0])
SPEED = 0.8 * np.deg2rad([287.0, 287.0, 430.0, 410.0, 320.0, 700.0])


@cache
def setting() -> tuple[Plant, Reference]:
    plant = known_robots.plant("tx40", coupled=True, offset=np.full(6, 0.1))
    return plant, random_fourier(-REACH, REACH, SPEED, 10.0, 5000.0, 20, acceleration=40.0, seed=1)


@cache
def states() -> np.ndarray:
    return np.random.default_rng(0).normal(size=(3, STATES, 6))


@cache
def log() -> Case:
    plant, reference = setting()
    run = simulate(plant, known_robots.controller("tx40"), reference, Sensing(1e-6, sigma_tau=0.05, every=5))
    recording = Recording(run.t, run.measured, run.tau, "torque", tuple(f"joint_{j + 1}" for j in range(6)))
    return make_case("log", make_motion(recording, FilterOptions(cutoff=50.0, band=20.0, clock="stamps")))


@pytest.mark.benchmark(group="TX40, 10 s, controller and RK4 at 5 kHz (200 000 forward dynamics)")
@pytest.mark.parametrize("what", ["ours", "plain Python loop, a tenth of the time"])
def test_closed_loop(benchmark, what):
    plant, reference = setting()
    controller = known_robots.controller("tx40")
    if what == "ours":
        simulate(plant, controller, reference)
        run = benchmark.pedantic(simulate, (plant, controller, reference), rounds=7)
        assert np.abs(run.q - reference.q).max() < 0.02
    else:
        q = benchmark.pedantic(python_loop, (plant, controller, reference, 5000), rounds=1)
        assert np.abs(q - simulate(plant, controller, reference).q[5000]).max() < 1e-3


def python_loop(plant, controller, reference, count):
    """Pinocchio's articulated bodies, called from Python: the loop people write first. No substeps at rest."""
    import pinocchio as pin

    chain = description.read(library.path("tx40"))
    made = model.model(chain)
    bodies = 10 * plant.bodies.count
    values = dict(zip((one.name for one in plant.terms), plant.parameters[bodies:]))
    fv, fc, offset = (np.array([values[f"{name}{j + 1}"] for j in range(6)]) for name in ("Fv", "Fc", "off"))
    coupled, added = np.zeros((6, 6)), np.diag([values[f"Ia{j + 1}"] for j in range(6)])
    coupled[4, 5] = coupled[5, 4] = values["Fvm6"]
    added[4, 5] = added[5, 4] = values["Ia6"]
    data = made.createData()
    h, q, v = reference.period, reference.q[0].copy(), reference.v[0].copy()

    def accelerate(q, v, tau):
        both = values["Fcm6"] * np.tanh((v[4] + v[5]) / 0.01) * np.array([0.0, 0, 0, 0, 1, 1])
        taken = fv * v + coupled @ v + fc * np.tanh(v / 0.01) + both + offset
        bias = pin.rnea(made, data, q, v, zero)
        inertia = pin.crba(made, data, q)
        inertia = np.triu(inertia) + np.triu(inertia, 1).T + added
        return np.linalg.solve(inertia, tau - taken - bias)

    zero, before = np.zeros(6), q.copy()
    for k in range(count):
        rate = (q - before) / h if k else v
        before = q.copy()
        tau = controller.kp * (reference.q[k] - q) + controller.kd * (reference.v[k] - rate)
        a = accelerate(q, v, tau)
        b = accelerate(q + 0.5 * h * v, v + 0.5 * h * a, tau)
        c = accelerate(q + 0.5 * h * v + 0.25 * h * h * a, v + 0.5 * h * b, tau)
        d = accelerate(q + h * v + 0.5 * h * h * b, v + h * c, tau)
        q = q + h * v + h * h / 6.0 * (a + b + c)
        v = v + h / 6.0 * (a + 2 * b + 2 * c + d)
    return q


@pytest.mark.benchmark(group=f"forward dynamics, TX40, {STATES} states")
@pytest.mark.parametrize("what", ["about the base's origin, drives included", "Pinocchio in a loop"])
def test_forward_dynamics(benchmark, what):
    plant, _ = setting()
    q, v, tau = states()
    chain = description.read(library.path("tx40"))
    parameters = standard_parameters(chain)
    if what.startswith("about"):
        call = lambda: forward_dynamics(plant, q, v, tau)  # noqa: E731
    else:
        call = lambda: model.forward_dynamics(chain, parameters, q, v, tau)  # noqa: E731
    call()
    benchmark.pedantic(call, rounds=5)


@pytest.mark.benchmark(group="IDIM-IV, TX40, 60 parameters, 10 s (target: rounds x one simulation + 30 %)")
@pytest.mark.parametrize("what", ["IDIM-IV to convergence", "as many simulations alone"])
def test_instrumental(benchmark, what):
    plant, reference = setting()
    identification = known_robots.model(plant)
    base, case = bases.find(identification), log()
    loop = Loop(known_robots.controller("tx40"), reference, 5)
    inertia = np.array(known_robots.truth("tx40")["drives"]["Ia"])

    def identify():
        return identify_instrumental(identification, base, [(case, loop)], case.motion.decimator, inertia=inertia)

    result = identify()
    rounds = len(result.rounds)
    assert len(result.columns) == 60
    benchmark.extra_info["rounds"] = rounds
    if what.startswith("IDIM"):
        benchmark.pedantic(identify, rounds=5)
    else:
        benchmark.pedantic(
            lambda: [simulate(result.plant, loop.controller, reference, Sensing(every=5)) for _ in range(rounds)],
            rounds=5,
        )
    print(f"{rounds} rounds", file=sys.stderr)
