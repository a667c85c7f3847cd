"""Redundant actuators: overconstraint and share of torques, a simulated robot, identification with a payload."""

import numpy as np
import pytest
from computed_torque import ComputedTorque, simulate
from platform_sines import sines

from calib.data.recordings.recording import Recording
from calib.data.signals.motion import FilterOptions, make_motion
from calib.errors import NotConverged
from calib.identification.identify import identify_model
from calib.identification.rows import make_case
from calib.identification.settings import IdentificationSettings
from calib.parallel.mechanism.parallel_model import PlatformRegressor, along, make_parallel_model, rows_named
from calib.parallel.mechanism.velocities import distributed, overconstraint
from calib.parallel.robots import find

PAYLOAD = {"M5": 5.37, "MX5": -0.127, "ZZ5": 0.0161}
RATE = 1000.0


@pytest.fixture(scope="module")
def dualv():
    """Return the robot, its model with a payload, the true values, and runs without and with the payload."""
    known = find("dualv").mechanism
    model = make_parallel_model(known, ["Fv Fc"], v0=0.05, payloads=["5"])
    values = np.concatenate([model.known_parameters(), [{"Fv": 0.05, "Fc": 0.3}[one.name[:2]] for one in model.terms]])
    for name, value in PAYLOAD.items():
        values[model.names.index(name)] = value
    runs = {carried: run(model, values, carried) for carried in ((), ("5",))}
    return known, model, values, runs


def reference(seconds: float = 4.0):
    """Return x, v, a (N, 3): sines of five frequencies on each coordinate."""
    t, frequencies = np.arange(int(seconds * RATE)) / RATE, (1.5, 2.5, 4.0, 5.5, 7.0)
    return sines(t, frequencies, lambda f: np.array([0.02, 0.02, 0.12]) * 1.5 / f, np.random.default_rng(0))


def run(model, values, carried, preload=10.0):
    controller = ComputedTorque(values, preload=preload, encoder=1e-5, torque=1.0)
    return simulate(model, values, controller, *reference(), carried, seed=1)


def test_overconstraint_does_no_work():
    """τ = (Jᵀ)⁺ w + N c: the forces come back, c comes back, whatever c; without preload no torques are smaller."""
    known = find("dualv").mechanism
    motion = along(known, *reference(0.3))
    rng = np.random.default_rng(2)
    forces, c = rng.normal(size=(len(motion.v), 3)), rng.normal(size=(len(motion.v), 1))
    J = motion.jacobians
    for preload in (0.0, c):
        torques = distributed(known, J, forces, preload)
        assert np.allclose(np.einsum("nar,na->nr", J.readings, torques), forces, atol=1e-10)
        assert np.allclose(overconstraint(known, J, torques), preload, atol=1e-10)
    assert (np.linalg.norm(distributed(known, J, forces), axis=1) <= np.linalg.norm(torques, axis=1)).all()
    constant = distributed(known, J, np.zeros_like(forces), 10.0)
    assert np.abs(np.diff(constant, axis=0)).max() < 0.5  # its sign does not jump along a motion


@pytest.mark.slow  # the simulation's kernel takes 14 s to compile
def test_simulation_obeys_inverse_dynamics(dualv):
    """The forces of the log are those of the model on the log's own motion; the preload is the one asked for."""
    known, model, values, runs = dualv
    log = runs[("5",)]
    motion = make_motion(recording(log), FilterOptions(cutoff=120.0, band=40.0, borders=0.1))
    moved = model.moved(motion.q, motion.v, motion.a)
    forces = np.einsum("nar,na->nr", moved.jacobians.readings, motion.effort)
    wrong = np.linalg.norm(forces - model.platform_force(values, moved, ("5",)), axis=0)
    noise = np.sqrt(np.sum(moved.jacobians.readings**2, axis=(0, 1)))  # of 1 N m on every torque
    assert (wrong < 1.15 * noise).all()
    assert abs(np.mean(overconstraint(known, moved.jacobians, motion.effort)) - 10.0) < 0.1


def recording(log) -> Recording:
    return Recording(log.t, log.q, log.tau, "torque", ("motor1", "motor2", "motor3", "motor4"), file="run")


def identified(dualv, rows: str):
    known, _, _, runs = dualv
    own = rows_named(known, rows)
    model = make_parallel_model(known, ["Ia Fv Fc"], v0=0.05, rows=own, payloads=["5"])
    filters = FilterOptions(cutoff=120.0, band=40.0, borders=0.1)
    cases = [make_case(str(c), make_motion(recording(log), filters), own, carried=c) for c, log in runs.items()]
    return model, identify_model(model, cases, IdentificationSettings(prior="none", essential="none", torque_rows=own))


@pytest.mark.slow  # as above
def test_both_models_weigh_the_payload(dualv):
    """Two runs, one with payload (eq. 36): its mass to 1 %, base parameters within their σ, IDIM tighter than PIM."""
    _, truth_model, truth, _ = dualv
    own, sigmas = dict(zip(truth_model.names, truth)), {}
    for rows in ("platform", "power"):
        model, found = identified(dualv, rows)
        standard = np.array([own.get(name, 0.0) for name in model.names])
        estimate = found.fitted.estimate
        away = (estimate.values - found.base.transform @ standard) / estimate.sigma
        assert np.sqrt(np.mean(away**2)) < 2.0
        sigmas[rows] = dict(zip(estimate.names, estimate.sigma))
        assert abs(estimate.values[estimate.names.index("M5")] / 5.37 - 1.0) < 0.01
        assert len(found.fitted.std) == (3 if rows == "platform" else 2)  # weights by coordinate, by recording
    legs = ["ZZ11", "ZZ12", "ZZ13", "ZZ14", "ZZ4"]
    assert all(sigmas["platform"][name] < sigmas["power"][name] for name in legs)


@pytest.mark.slow  # as above
def test_what_cannot_be_simulated_is_said(dualv):
    _, model, values, _ = dualv
    with pytest.raises(NotConverged, match="diverged at"):
        simulate(model, values, ComputedTorque(-values), *reference(1.0))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["fivebar", "stewart"])
def test_dependent_platform_is_simulated(name):
    """The five-bar's platform turns as its loop says: held torques meet those of the model as 1 / rate."""
    known = find(name).mechanism
    model = make_parallel_model(known, ["Ia Fv Fc"], v0=0.05, passive="Fv")
    drives = {"Ia": 0.02, "Fv": 0.2, "Fc": 0.3}
    values = np.concatenate([model.known_parameters(), [drives[one.name[:2]] for one in model.terms]])
    wrong = []
    for rate in (1000.0, 4000.0):
        t, size = np.arange(int(0.5 * rate)) / rate, 0.17 * (known.robot.upper - known.robot.lower)
        x, v, a = sines(t, (0.7, 1.6), size, np.random.default_rng(0))
        log = simulate(model, values, ComputedTorque(values, rate=rate), x, v, a)
        assert np.abs(log.q - log.reference).max() < 1e-4
        motion, part = along(known, x, v, a), slice(len(t) // 10, None)
        forces = model.platform_force(values, motion)
        own = np.einsum("nar,na->nr", motion.jacobians.readings, log.tau)
        wrong.append(np.abs(own - forces)[part].max() / np.abs(forces).max())
    assert wrong[0] < 0.02 and wrong[1] < 0.35 * wrong[0]


def test_design_slopes_are_derivatives():
    """Of Σ weights · W by x, v, a, against differences of the whole sum."""
    known = find("dualv").mechanism
    model = make_parallel_model(known, ["Fv Fc"], v0=0.5)
    plan, rng = PlatformRegressor(model, np.arange(model.p)), np.random.default_rng(4)
    state = [0.5 * rng.uniform(known.robot.lower, known.robot.upper, (4, 3)), *rng.normal(size=(2, 4, 3))]
    weights, way = rng.normal(size=(4, 3, model.p)), rng.normal(size=(3, 4, 3))
    h = 1e-5
    ends = [np.sum(plan.regressor(*(s + sign * h * d for s, d in zip(state, way))) * weights) for sign in (1, -1)]
    slope = sum(np.sum(own * d) for own, d in zip(plan.regressor_gradient(*state, weights), way))
    assert np.isclose(slope, (ends[0] - ends[1]) / (2 * h), rtol=1e-5)
