"""The dynamics of three parallel robots, planar and spatial, redundant or not, against Pinocchio's constrained ones."""

from types import SimpleNamespace

import numpy as np
import pytest
from closed_tree import ClosedTree

from calib.dynamics import base as bases
from calib.errors import CalibError, UsageError
from calib.parallel.design_goal import LoadedPlatform
from calib.parallel.identification import ParallelDynamics
from calib.parallel.mechanism.closure import ClosedRobot
from calib.parallel.mechanism.parallel_model import ParallelModel, make_parallel_model, rows_named
from calib.parallel.mechanism.velocities import of_platform
from calib.parallel.robots import find

ROBOTS = ("dualv", "fivebar", "stewart")


def robot(name: str) -> ClosedRobot:
    return find(name).mechanism


def bodies(count: int, rng: np.random.Generator) -> np.ndarray:
    """Return parameters (count, 10) of possible bodies."""
    result = np.empty((count, 10))
    for row in result:
        m, c, A = rng.uniform(0.5, 2.0), 0.05 * rng.normal(size=3), 0.05 * rng.normal(size=(3, 3))
        inertia = A @ A.T + 0.02 * np.eye(3) + m * (c @ c * np.eye(3) - np.outer(c, c))
        row[:] = [*inertia[np.triu_indices(3)], *(m * c), m]
    return result


def change_of(pose: np.ndarray, twist: np.ndarray, acceleration: np.ndarray) -> np.ndarray:
    """Return (6,) in the base's axes of Pinocchio's spatial acceleration of a free body, in its own."""
    R = pose[:3, :3]
    spatial = acceleration[:3] + np.cross(R.T @ twist[3:], R.T @ twist[:3])
    return np.concatenate([R @ spatial, R @ acceleration[3:]])


@pytest.mark.parametrize("name", ROBOTS)
def test_torques_are_those_of_pinocchio(name):
    """Its accelerations under random torques, put into our model, give these torques back, to 1e-8 and better."""
    known, rng = robot(name), np.random.default_rng(1)
    model = make_parallel_model(known, [""], payloads=["load"])
    values = bodies(len(model.labels), rng)
    tree, own = ClosedTree(known, values), known.robot.actuated
    for _ in range(3):
        posture = known.place(rng.uniform(known.robot.lower, known.robot.upper, (1, known.robot.r)))
        rate, tau = rng.normal(size=(1, known.robot.r)), np.zeros(posture.q.shape[1])
        tau[own] = 5.0 * rng.normal(size=known.robot.n)
        moving = of_platform(known, posture, rate, np.zeros_like(rate))
        found = tree.accelerations(posture, moving.v[0], moving.twist[0], tau)
        change = change_of(posture.pose[0], moving.twist[0], found[-6:])
        motion = of_platform(known, posture, rate, change[None, known.robot.selected])
        assert np.allclose(motion.a[0], found[:-6], rtol=0, atol=1e-8)
        assert np.allclose(motion.change[0], change, rtol=0, atol=1e-8)
        forces = model.platform_force(values.ravel(), motion)[0]
        assert np.allclose(forces, motion.jacobians.readings[0].T @ tau[own], rtol=0, atol=1e-8)
        if not known.robot.redundant:
            q, v, a = posture.q[:, own], motion.v[:, own], motion.a[:, own]
            assert np.allclose(model.torque(values.ravel(), q, v, a)[0], tau[own], rtol=0, atol=1e-8)


@pytest.mark.parametrize("name", ROBOTS)
@pytest.mark.parametrize("rows", ["", "power"])
def test_regressor_gives_the_torque(name, rows):
    """The regressor times parameters is the torque."""
    known, rng = robot(name), np.random.default_rng(2)
    model = make_parallel_model(known, rows=rows_named(known, rows), payloads=["load"], passive="Fv Fc")
    values, states = rng.normal(size=model.p), model.sample(20, rng)
    for carried in (None, ()):
        W = model.regressor(states.q, states.v, states.a, carried=carried)
        assert W.shape == (20, model.rows, model.p)
        assert np.allclose(W @ values, model.torque(values, states.q, states.v, states.a, carried), atol=1e-9)


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] * (name != "fivebar")) for name in ROBOTS]
)
def test_power_is_the_change_of_energy(name):
    """Along a motion, vᵀ W χ without friction is the derivative of the energies' columns."""
    known, rng = robot(name), np.random.default_rng(3)
    model = make_parallel_model(known, ["Ia"], rows=rows_named(known, "power"))
    size = 0.3 * np.minimum(known.robot.upper, -known.robot.lower)
    size[3:] = 0.0  # roll-pitch-yaw is no integral of the twist
    t = np.linspace(0.0, 1.0, 2001)[:, None]
    phase, omega = rng.uniform(0.0, 6.0, known.robot.r), rng.uniform(2.0, 5.0, known.robot.r)
    posture = known.place(size * np.sin(omega * t + phase))
    rate, change = size * omega * np.cos(omega * t + phase), -size * omega**2 * np.sin(omega * t + phase)
    motion, own = of_platform(known, posture, rate, change), known.robot.actuated
    values = np.concatenate([bodies(len(model.labels), rng).ravel(), rng.uniform(0.01, 0.1, len(model.terms))])
    power = model.torque(values, posture.q[:, own], motion.v[:, own], motion.a[:, own])[:, 0]
    energy = model.energies(motion) @ values
    assert np.allclose(np.gradient(energy, t[:, 0])[1:-1], power[1:-1], rtol=0, atol=2e-5 * np.abs(power).max())


def test_dualv_has_16_base_parameters():
    """zz1iR, mx2iR, my2i, and zz4R, mx4, my4R, m4R, regrouped as Briot, Gautier & Krut's procedure does."""
    known = robot("dualv")
    for rows in ("platform", "power"):
        model = make_parallel_model(known, ["Ia"], rows=rows_named(known, rows))
        base = bases.find(model)
        assert base.b == 16 and {name[:3] for name in base.names} == {"ZZ1", "MX2", "MY2", "ZZ4", "MX4", "MY4", "M4R"}
        wanted = {"ZZ11": 1.0, "Ia11": 1.0, "M21": 0.28**2, "ZZ21": -1.0}
        assert expressed(model, base, "ZZ11R") == pytest.approx(wanted)
        assert expressed(model, base, "MX21R") == pytest.approx({"MX21": 1.0, "ZZ21": -1 / 0.28})
        square = {f"ZZ2{k}": 1 / 0.28**2 for k in range(1, 5)}
        assert expressed(model, base, "M4R") == pytest.approx({"M4": 1.0} | square)
        assert expressed(model, base, "ZZ4R") == pytest.approx(
            {"ZZ4": 1.0} | {k: 0.11**2 * x for k, x in square.items()}
        )


def expressed(model: ParallelModel, base: bases.Base, name: str) -> dict[str, float]:
    row = base.transform[base.names.index(name)]
    return {model.names[k]: row[k] for k in np.flatnonzero(np.abs(row) > 1e-9)}


def test_one_state_gives_one_row_of_torques():
    """As with serial arms, torques of (n,) are (rows,), those of (N, n) are (N, rows)."""
    known, rng = find("fivebar").mechanism, np.random.default_rng(4)
    model = make_parallel_model(known, ["Ia"])
    values, states = rng.normal(size=model.p), model.sample(3, rng)
    dynamics = SimpleNamespace(found=SimpleNamespace(dynamics=SimpleNamespace(model=model, values=values)))
    torques = ParallelDynamics.torques(dynamics, states.q, states.v, states.a)
    single = ParallelDynamics.torques(dynamics, states.q[1], states.v[1], states.a[1])
    assert torques.shape == (3, 2) and single.shape == (2,)
    np.testing.assert_allclose(single, torques[1], rtol=1e-6)
    with pytest.raises(CalibError, match="v: expected an array of shape"):
        ParallelDynamics.torques(dynamics, states.q, states.v[1], states.a)


def test_redundant_actuators_lack_motor_rows():
    """Redundant actuators have no motor rows."""
    with pytest.raises(UsageError, match="overconstraint"):
        rows_named(robot("dualv"), "motor")


def test_rows_of_loads_match_single_loads():
    """Functions of the platform's coordinates for designs, against the regressor at the encoders' motion."""
    known = find("fivebar").mechanism
    model = make_parallel_model(known, ["Ia Fv Fc off"], payloads=["tool"])
    values = np.concatenate([model.known_parameters(), np.full(len(model.terms), 0.1)])
    values[model.names.index("Mtool")] = 2.0
    loads, kept = ((), ("tool",)), np.arange(model.p)
    plan = LoadedPlatform(model, kept, values, names=model.names, units=model.units, loads=loads)
    x, v, a = np.random.default_rng(0).uniform(-0.05, 0.05, (3, 5, 2))
    motion, own = plan.motion(x, v, 10 * a), known.robot.actuated
    q = motion.posture.q[:, own], motion.v[:, own], motion.a[:, own]
    wanted = np.concatenate([model.regressor(*q, carried=one) for one in loads], axis=1)
    np.testing.assert_allclose(plan.regressor(x, v, 10 * a), wanted, atol=1e-9)
    np.testing.assert_allclose(plan.torques(motion), wanted @ values, atol=1e-8)
    assert plan.row_names[::2] == ("motor_left (no payload)", "motor_left (tool)")
