"""Claims of the closed-loop simulator: the right dynamics, integrated well, without chatter, controlled as stated."""

from dataclasses import replace

import numpy as np
import pytest
from arms import motley_with_follower, physical
from scipy.interpolate import CubicSpline

from calib.dynamics import drives, rigid_body
from calib.dynamics.bodies import bodies_of, standard_parameters, with_payload
from calib.errors import CalibError, NotConverged
from calib.identification.closed_loop import controllers, simulation
from calib.identification.closed_loop.controllers import Reference
from calib.identification.closed_loop.simulation import (
    Plant,
    Sensing,
    feed_forward,
    forward_dynamics,
    simulate,
    tracking_error,
)
from calib.identification.friction.function_tables import knots_of
from calib.robot import description, library
from calib.robot.chain import Chain
from calib.simulation import known_robots
from calib.transforms import displace

HIGH = np.array([2.0, 1.2, 1.2, 2.0, 1.5, 2.0])


def bare(chain: Chain) -> Plant:
    return Plant(bodies_of(chain), (), standard_parameters(chain))


def motion(seed: int = 1, duration: float = 2.0, rate: float = 5000.0) -> Reference:
    return known_robots.random_fourier(-HIGH, HIGH, np.full(6, 3.0), duration, rate, acceleration=20.0, seed=seed)


def still(q: np.ndarray, duration: float, rate: float) -> Reference:
    t = np.arange(round(duration * rate) + 1) / rate
    return Reference(t, np.tile(q, (len(t), 1)), np.zeros((len(t), len(q))), np.zeros((len(t), len(q))))


def free(n: int) -> controllers.LoopController:
    return controllers.pd(np.zeros(n), np.zeros(n))


@pytest.mark.parametrize("chain", [description.read(library.path(x)) for x in ("tx40", "lwr4plus")]
                         + [motley_with_follower()],
                         ids=lambda chain: chain.name)  # fmt: skip
def test_forward_undoes_inverse_dynamics(chain):
    """Forward dynamics undo inverse dynamics with drives."""
    bodies = bodies_of(chain)
    bodies = with_payload(bodies, displace(np.eye(4), np.full(6, 0.2)), "load")
    terms = drives.standard(["Ia Fv Fc off"] * chain.n, 0.05)
    rng = np.random.default_rng(0)
    amounts = rng.uniform(0.1, 1.0, len(terms))
    inertial = physical(bodies.count).ravel()
    q, v, tau = rng.normal(size=(3, 50, chain.n))
    zero = np.zeros_like(q)
    columns = np.zeros((len(terms), chain.n, 50))
    drives.fill(terms, columns, [q.T, v.T, zero.T, None], np.zeros((0, 50)))
    taken = np.einsum("kjn,k->nj", columns, amounts)
    added = simulation.added_inertia(terms, amounts, chain.n)
    found = forward_dynamics(Plant(bodies, terms, np.concatenate([inertial, amounts])), q, v, tau)
    needed = rigid_body.inverse_dynamics(bodies, inertial, q, v, found) + found @ added + taken
    assert np.abs(needed - tau).max() < 1e-10 * np.abs(found).max()


def test_motors_and_couplings_add_inertia():
    terms = (*drives.standard(["Ia"] * 6), *drives.coupled(4, 5)[:1])
    added = simulation.added_inertia(terms, np.arange(1.0, 8.0), 6)
    assert added[4, 5] == added[5, 4] == 7.0 and added[2, 2] == 3.0


def test_simulation_runs_like_pinocchio():
    """The simulation runs like Pinocchio's ABA under RK4."""
    import pinocchio_model as model

    chain = description.read(library.path("tx40"))
    parameters, h = standard_parameters(chain), 1e-3
    q, v = np.array([0.1, -0.3, 0.8, 0.2, -0.4, 0.5]), np.array([1.0, -0.5, 0.3, 2.0, -1.0, 3.0])
    run = simulate(bare(chain), free(6), still(q, 0.1, 1000.0), start=(q, v))

    def slope(x):
        return np.concatenate([x[6:], model.forward_dynamics(chain, parameters, x[None, :6], x[None, 6:], zero)[0]])

    zero, x = np.zeros((1, 6)), np.concatenate([q, v])
    for _ in range(100):
        a = slope(x)
        b = slope(x + 0.5 * h * a)
        c = slope(x + 0.5 * h * b)
        d = slope(x + h * c)
        x = x + h / 6.0 * (a + 2 * b + 2 * c + d)
    assert np.abs(run.q[-1] - x[:6]).max() < 1e-10
    assert np.abs(run.v[-1] - x[6:]).max() < 1e-9


def test_energy_drift_is_of_fourth_order():
    """Without friction and controller the energy stays, and its drift falls with the fourth power."""
    import pinocchio as pin
    from pinocchio_model import model

    chain = description.read(library.path("tx40"))
    made = model(chain)
    data = made.createData()
    q, v = np.array([0.1, -0.3, 0.8, 0.2, -0.4, 0.5]), np.array([0.5, -0.5, 0.3, 1.0, -1.0, 1.0])

    def drift(rate):
        run = simulate(bare(chain), free(6), still(q, 0.5, rate), start=(q, v))
        energy = [pin.computeMechanicalEnergy(made, data, np.array(x), np.array(y)) for x, y in zip(run.q, run.v)]
        kinetic = [pin.computeKineticEnergy(made, data, np.array(x), np.array(y)) for x, y in zip(run.q, run.v)]
        return np.abs(np.array(energy) - energy[0]).max() / max(kinetic)

    coarse, fine = drift(1000.0), drift(2000.0)
    assert fine < 1e-8
    assert 10.0 < coarse / fine < 64.0


def test_recording_obeys_the_model():
    """What is recorded obeys the model to rounding."""
    plant = known_robots.plant("tx40", coupled=True, offset=np.full(6, 0.2))
    run = simulate(plant, known_robots.controller("tx40"), motion(), Sensing(1e-6, 1e-6, 0.0, 0.0, every=5), seed=2)
    tau = np.einsum("kij,j->ki", known_robots.model(plant).regressor(run.q, run.v, run.a), plant.parameters)
    assert np.abs(tau - run.torque).max() < 1e-11 * np.abs(run.torque).max()


def test_friction_holds_without_chatter():
    """Friction holds without chatter where explicit steps are too long."""
    plant, controller = known_robots.plant("tx40"), known_robots.controller("tx40")
    known = known_robots.truth("tx40")["drives"]
    stiffness = known["Fc"][5] / known["v0"] / plant.inertia_diagonal(np.zeros((1, 6)))[5]
    assert stiffness / 1000.0 > 2.785  # a 1 kHz RK4 step is unstable there
    reference = still(np.array([0.2, 0.5, 0.5, 0.3, 0.5, 0.1]), 1.0, 1000.0)
    calm = controller.slower(4.0)
    run = simulate(plant, calm, reference, start=(reference.q[0], np.full(6, 0.3)))
    late = slice(len(run.t) // 2, None)
    assert np.abs(run.a[late]).max() < 1e-2
    assert np.all(np.abs(np.diff(np.sign(run.v[late]), axis=0)).sum(axis=0) <= 2)


def test_computed_torque_makes_pendulums():
    """Without friction the error obeys ë + 2 ζ ω ė + ω² e = 0, up to the sampling."""
    chain = description.read(library.path("tx40"))
    plant, reference = bare(chain), still(np.zeros(6), 0.5, 20000.0)
    controller = controllers.computed_torque(plant.parameters, 20.0, 1.0, 6)
    run = simulate(plant, controller, reference, start=(np.full(6, 0.1), np.zeros(6)))
    expected = 0.1 * (1.0 + 20.0 * run.t) * np.exp(-20.0 * run.t)
    assert np.abs(run.q - expected[:, None]).max() < 2e-3


def test_a_cascade_is_the_pid_it_says():
    position, velocity, reset = np.array([12.0, 9.0]), np.array([4.0, 3.0]), np.array([0.1, 0.2])
    made = controllers.cascade(position, velocity, reset)
    rng, T = np.random.default_rng(0), 1e-3
    e = np.cumsum(rng.normal(size=(200, 2)), axis=0) * 1e-3
    rate = np.diff(e, axis=0, prepend=0.0) / T
    inner = rate + position * e  # v_c - v
    cascade = velocity * (inner + np.cumsum(inner, axis=0) * T / reset)
    pid = made.kp * e + made.kd * rate + made.ki * np.cumsum(e, axis=0) * T
    assert np.abs(cascade - pid).max() < 1e-12 * np.abs(pid).max()


def test_sensing_and_actuation_are_as_stated():
    plant, reference = known_robots.plant("tx40"), motion(duration=0.5)
    controller = replace(known_robots.controller("tx40"), limit=np.full(6, 3.0), delay=2)
    run = simulate(plant, controller, reference, Sensing(quantum=1e-4, sigma_q=1e-5))
    assert np.abs(run.torque).max() == 3.0
    assert np.abs(run.measured / 1e-4 - np.round(run.measured / 1e-4)).max() < 1e-6
    assert np.all(run.torque[:3] == run.torque[0])  # the first command until the delayed ones arrive
    undelayed = simulate(plant, replace(controller, delay=0), reference, Sensing(quantum=1e-4, sigma_q=1e-5))
    assert np.any(undelayed.torque[1] != undelayed.torque[0])


def test_seed_repeats_a_run_exactly():
    """The seed repeats a run to the last bit."""
    plant, controller, reference = known_robots.plant("rv2sq"), known_robots.controller("rv2sq"), motion(duration=0.2)
    sensing = Sensing(1e-6, 0.0, 0.05, 0.5, push_band=20.0)
    one, again, other = (simulate(plant, controller, reference, sensing, seed) for seed in (4, 4, 5))
    assert np.array_equal(one.tau, again.tau) and np.array_equal(one.q, again.q)
    assert np.abs(one.tau - other.tau).max() > 0.1


def test_what_cannot_be_simulated_is_refused():
    plant, controller, reference = known_robots.plant("tx40"), known_robots.controller("tx40"), motion(duration=0.2)
    with pytest.raises(CalibError, match="not positive definite"):
        simulate(replace(plant, parameters=-plant.parameters), controller, reference)
    with pytest.raises(NotConverged, match="diverged"):
        simulate(plant, controller.scaled(300.0), reference)
    stiff = replace(plant, terms=drives.standard(["Ia Fv Fc"] * 6, 1e-5))
    with pytest.raises(CalibError, match="too stiff"):
        simulate(stiff, controller, reference)
    with pytest.raises(CalibError, match="without smoothing"):
        replace(plant, terms=drives.standard(["Ia Fv Fc"] * 6, 0.0))


ARCTAN = tuple(knots_of(lambda x: np.arctan(5.0 * x), lambda x: 5.0 / (1.0 + 25.0 * x**2), -4.0, 4.0, "arctan").ravel())
EVERYTHING = {
    "position": (), "speed": (), "cubic": (), "root": (0.05,), "stribeck": (0.3, 2.0, 0.05), "dead": (0.3,),
    "sine": (5.0, 2.0), "cosine": (3.0, np.inf), "sine_band": (6.0, 0.1, 0.5, 1.0, 1.0, -1.5, 1.5),
    "cosine_band": (6.0, 0.0, 0.4, np.inf, -1.0, -0.5, 0.5), "load": (0.05,), "load_velocity": (), "stop": (0.05,),
    "presliding": (0.05, 0.05), "velocity_table": ARCTAN, "position_table": ARCTAN,
}  # fmt: skip


# those like another one
SIMILAR = {"speed", "cubic", "root", "cosine", "cosine_band", "position_table"}


@pytest.mark.parametrize(
    "shape", [pytest.param(shape, marks=[pytest.mark.slow] * (shape in SIMILAR)) for shape in EVERYTHING]
)
def test_all_known_friction_is_simulated(shape):
    """What is recorded obeys the identification model.

    Within what a sampled record tells of turning points, where friction depends on them; and but for the edge of a dead
    zone, which is a ramp, since no jump can be integrated.
    """
    chain = description.read(library.path("tx40"))
    terms = (*drives.standard(["Ia Fv Fc"] * 6, 0.05), drives.term("extra", shape, 1, *EVERYTHING[shape]))
    plain = known_robots.plant("tx40").parameters
    amount = 0.15 if shape.startswith("load") else 2.0
    plant = Plant(bodies_of(chain), terms, np.append(plain, amount))
    run = simulate(plant, known_robots.controller("tx40"), motion(duration=2.0, rate=2000.0))
    model = known_robots.model(plant)
    load = model.transmitted(plant.parameters, run.q, run.v, run.a)
    columns = model.regressor(run.q, run.v, run.a, load)
    away = np.abs(np.einsum("kij,j->ki", columns, plant.parameters) - run.torque)[:, 1]
    assert np.ptp(columns[:, 1, -1]) > 0.2
    edge = np.abs(np.abs(run.v[:, 1]) - 0.3) < 0.15 if shape == "dead" else np.zeros(len(away), dtype=bool)
    close = 1e-4 if shape in ("stop", "presliding", "dead") else 1e-8
    assert away[~edge].max() < close * np.abs(run.torque).max() and edge.mean() < 0.5


def test_samples_between_control_periods():
    """5 kHz and 140 Hz: 35.7 periods; half periods agree with whole ones, others with the motion in between."""
    plant, controller, reference = known_robots.plant("tx40"), known_robots.controller("tx40"), motion(duration=0.5)
    whole, between = (simulate(plant, controller, reference, Sensing(every=x)) for x in (5, 2.5))
    assert np.array_equal(between.q[::2], whole.q) and np.array_equal(between.a[::2], whole.a)
    slow = simulate(plant, controller, reference, Sensing(every=5000.0 / 140.0))
    assert len(slow.t) == 71 and np.allclose(np.diff(slow.t), 1.0 / 140.0)
    fine = simulate(plant, controller, reference)
    assert np.abs(CubicSpline(fine.t, fine.q)(slow.t) - slow.q).max() < 1e-7
    tau = np.einsum("kij,j->ki", known_robots.model(plant).regressor(slow.q, slow.v, slow.a), plant.parameters)
    assert np.abs(tau - slow.torque).max() < 1e-10 * np.abs(slow.torque).max()


def test_samples_may_vary_in_parameters():
    """Every sample may have parameters of its own."""
    plant = known_robots.plant("tx40", coupled=True, offset=np.full(6, 0.2))
    rng = np.random.default_rng(0)
    q, v, tau = rng.normal(size=(3, 4, 6))
    values = plant.parameters * rng.uniform(0.95, 1.05, (4, len(plant.parameters)))
    alone = [
        forward_dynamics(replace(plant, parameters=one), q[[k]], v[[k]], tau[[k]])[0] for k, one in enumerate(values)
    ]
    assert np.array_equal(forward_dynamics(plant, q, v, tau, values), np.array(alone))


def test_references_match_their_derivatives():
    """References are their own derivatives and keep the limits."""
    moves = known_robots.trapezoidal(np.array([[0.0, 0.0], [1.0, -0.2], [0.5, 2.0]]), np.array([1.0, 2.0]), 5.0, 1000.0)
    wave = known_robots.random_fourier(-HIGH, HIGH, np.full(6, 2.0), 5.0, 1000.0, acceleration=15.0, seed=3)
    for reference, close in ((moves, 6e-3), (wave, 1e-4)):
        v = np.gradient(reference.q, reference.period, axis=0)
        assert np.abs(v - reference.v)[1:-1].max() < close
    assert np.allclose(moves.q[-1], [0.5, 2.0]) and np.all(np.abs(moves.v) <= [1.0 + 1e-9, 2.0 + 1e-9])
    assert np.abs(moves.a).max() <= 5.0 + 1e-9
    assert np.all(np.abs(wave.q) <= HIGH + 1e-12) and np.abs(wave.v).max() <= 2.0 + 1e-12
    assert np.abs(wave.v[[0, -1]]).max() < 1e-9 and np.abs(wave.a[[0, -1]]).max() < 1e-8


def test_the_truths_are_those_of_the_library():
    for name in ("tx40", "rv2sq"):
        chain, plant = description.read(library.path(name)), known_robots.plant(name)
        assert np.array_equal(plant.parameters[: 10 * chain.n], standard_parameters(chain))
        assert known_robots.controller(name).kp.shape == (chain.n,)


def test_better_feed_forward_pays():
    """The robot follows, and feed-forward of the better model pays."""
    plant, controller, reference = known_robots.plant("tx40"), known_robots.controller("tx40"), motion()
    rough = replace(plant, parameters=1.2 * plant.parameters)
    ahead = (None, feed_forward(rough, reference), feed_forward(plant, reference))
    none, poor, good = (tracking_error(plant, controller, reference, one) for one in ahead)
    assert none.max() < 5e-3 and np.all(good < poor) and np.all(poor < none) and np.all(good < 0.2 * none)
