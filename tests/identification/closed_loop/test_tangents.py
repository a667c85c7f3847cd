"""The claim of the tangents: they are the derivative of what is simulated, whatever the robot and the loop."""

from dataclasses import replace

import numpy as np
import pytest
from arms import motley_with_follower

from calib.dynamics import drives
from calib.dynamics.bodies import bodies_of
from calib.errors import CalibError, NotConverged
from calib.identification.closed_loop import controllers
from calib.identification.closed_loop.simulation import Plant, Sensing, simulate
from calib.identification.survey.simulated_robot import simulate_differences, simulate_tangents
from calib.simulation import known_robots

RATE = 1000.0
SHAPES = [
    drives.term("Fva2", "speed", 1), drives.term("Fvc1", "cubic", 0), drives.term("Fvr3", "root", 2, 0.05),
    drives.term("Fs1", "stribeck", 0, 0.4, 1.5, 0.1), drives.term("K5", "position", 4),
    drives.term("Rs2.3", "sine", 1, 3.0, 2.0), drives.term("Rc3.2", "cosine", 2, 2.0, np.inf),
    drives.term("Fd4", "dead", 3, 0.1),
]  # fmt: skip


def odd() -> Plant:
    """Return an arm with prismatic joints, a follower, a coupling, and every friction that has slopes."""
    rng = np.random.default_rng(1)
    chain = motley_with_follower()
    terms = (*drives.standard(["Ia Fv Fc off"] * 5, 0.1), *drives.coupled(2, 3, 0.1), *SHAPES)
    inertial = np.zeros(10 * bodies_of(chain).count).reshape(-1, 10)
    inertial[:, [0, 3, 5, 9]] = [0.2, 0.3, 0.25, 2.0]
    inertial[:, 6:9] = 0.2 * rng.normal(size=(len(inertial), 3))
    amounts = [0.8 if one.shape == "acceleration" else 0.4 for one in terms]
    amounts[-len(SHAPES) - 3] = 0.1
    return Plant(bodies_of(chain), terms, np.concatenate([inertial.ravel(), amounts]))


def motion(n: int) -> controllers.Reference:
    limit = np.full(n, 0.8)
    return known_robots.random_fourier(-limit, limit, np.full(n, 2.0), 0.6, RATE, acceleration=30.0, seed=3)


LOOPS = {
    "pid with delay and filter": (
        controllers.pd(400.0 * np.ones(5), 20.0 * np.ones(5), ki=300.0 * np.ones(5)),
        1,
        60.0,
    ),
    "saturated": (controllers.pd(800.0 * np.ones(5), 40.0 * np.ones(5), limit=12.0), 0, None),
    "computed torque": (controllers.computed_torque(0.8 * odd().parameters[: odd().inertial], 20.0, 0.7, 5), 0, None),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", LOOPS)
def test_tangents_are_simulation_derivatives(name):
    """Tangents are the derivative of the simulation."""
    plant, (controller, delay, cutoff) = odd(), LOOPS[name]
    controller, reference = replace(controller, delay=delay, cutoff=cutoff), motion(5)
    columns = np.arange(len(plant.parameters))[::3]
    found = simulate_tangents(plant, controller, reference, columns, every=2.5)
    run = simulate(plant, controller, reference, Sensing(every=2.5))
    assert np.array_equal(found.q, run.q) and np.array_equal(found.torque, run.torque)
    forward = simulate_differences(plant, controller, reference, columns[-2:], np.full(2, 1e-6), every=2.5)
    assert np.abs(forward.by_q - found.by_q[:, :, -2:]).max() < 1e-3 * np.abs(found.by_q[:, :, -2:]).max()

    def at(column: int, step: float):
        x = plant.parameters.copy()
        x[column] += step
        return simulate(replace(plant, parameters=x), controller, reference, Sensing(every=2.5))

    h = 1e-5
    for k, column in enumerate(columns):
        ahead, behind = at(column, h), at(column, -h)
        for slopes, series in ((found.by_q, "q"), (found.by_v, "v"), (found.by_torque, "torque")):
            expected = (getattr(ahead, series) - getattr(behind, series)) / (2.0 * h)
            away = np.abs(slopes[:, :, k] - expected).max()
            assert away < 1e-5 * np.abs(expected).max() + 1e-6, (column, series)


@pytest.mark.slow
def test_gains_may_follow_the_parameters():
    bodies, reference, controller = bodies_of(motley_with_follower()), motion(5), LOOPS["saturated"][0]
    plant = Plant(bodies, (), np.tile([0.2, 0, 0, 0.3, 0, 0.25, 0.02, 0.01, 0.03, 2.0], bodies.count))
    relative = np.linspace(0.1, 0.5, 5)[:, None]
    found = simulate_tangents(plant, controller, reference, np.array([9]), relative=relative)

    def at(step: float):
        x = plant.parameters.copy()
        x[9] += step
        own = controller.scaled(1.0 + step * relative[:, 0])
        return simulate(replace(plant, parameters=x), own, reference).q

    expected = (at(1e-5) - at(-1e-5)) / 2e-5
    assert np.abs(found.by_q[:, :, 0] - expected).max() < 1e-5 * np.abs(expected).max()


def test_what_has_no_tangents_says_so():
    plant, reference = known_robots.plant("tx40"), short()
    past = drives.term("Fp1.1", "presliding", 0, 0.01, 0.01)
    held = Plant(plant.bodies, (*plant.terms, past), np.append(plant.parameters, 0.1))
    with pytest.raises(CalibError, match=r"Fp1\.1"):
        simulate_tangents(held, known_robots.controller("tx40"), reference, np.array([0]))


def short() -> controllers.Reference:
    return known_robots.random_fourier(-np.ones(6), np.ones(6), np.ones(6), 0.2, 5000.0)


@pytest.mark.slow  # the kernel takes 14 s to compile
def test_a_loop_that_diverges_says_so():
    plant, controller, reference = known_robots.plant("tx40"), known_robots.controller("tx40"), short()
    with pytest.raises(NotConverged, match="diverged"):
        simulate_tangents(plant, controller.scaled(300.0), reference, np.array([5]))


@pytest.mark.slow  # as above
def test_saturated_loop_is_called_unstable():
    """Its simulation ends; its slopes grow without bounds, and no method may be given them."""
    plant, controller = known_robots.plant("rv2sq"), known_robots.controller("rv2sq")
    rate = 5000.0
    reference = known_robots.random_fourier(-np.ones(6), np.ones(6), np.ones(6), 1.0, rate, acceleration=20.0, seed=0)
    wild = replace(controller, kp=60.0 * controller.kp, kd=1e-4 * controller.kd)
    simulate(plant, wild, reference, Sensing(every=10))
    with pytest.raises(NotConverged, match="these gains cannot stabilise"):
        simulate_tangents(plant, wild, reference, np.arange(len(plant.parameters)), 10.0)
