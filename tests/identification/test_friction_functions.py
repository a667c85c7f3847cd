"""Friction as a function of a script: identified, simulated, stored and exported without any package being edited."""

import json
from pathlib import Path

import numpy as np
import planted_motion as planted
import pytest

import calib
from calib.dynamics import drives
from calib.dynamics.bodies import bodies_of
from calib.errors import UsageError
from calib.identification.closed_loop import controllers
from calib.identification.closed_loop.simulation import Plant, Sensing, simulate
from calib.identification.friction.function_tables import knots_of
from calib.identification.model_file import read_dynamics
from calib.simulation import known_robots

TRUE = np.array([1.5, 1.0, 0.4])  # N m


def bend(v: np.ndarray) -> np.ndarray:
    return np.arctan(20.0 * v)


def bend_slope(v: np.ndarray) -> np.ndarray:
    return 20.0 / (1.0 + (20.0 * v) ** 2)


ARCTAN = calib.FrictionTerm("Fa", bend, bend_slope)


def log(folder: Path, name: str, seed: int) -> Path:
    """Write a log of the planted arm whose joints have friction by the arctangent, too."""
    t, q, v, a = planted.motion(seed)
    noise = 0.05 * np.random.default_rng(seed).normal(size=q.shape)
    np.savez(folder / name, t=t, q=q, tau=planted.torques(q, v, a) + TRUE * bend(v) + noise)
    return folder / name


robot = planted.robot


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("logs")


@pytest.fixture
def model(folder, robot) -> calib.DynamicsModel:
    recordings = [log(folder, "train.npz", 0), log(folder, "other.npz", 1)]
    return calib.identify_dynamics(robot, recordings[0], validate=recordings[1], terms=[ARCTAN], friction="standard")


@pytest.mark.slow
def test_a_function_is_identified_stored_and_read_without_it(model, robot, tmp_path):
    values = dict(zip(model.estimate.names, model.estimate.values))
    sigmas = dict(zip(model.estimate.names, model.estimate.sigma))
    for number, true in enumerate(TRUE, 1):
        assert abs(values[f"Fa{number}"] - true) < 4.0 * sigmas[f"Fa{number}"] < 0.05
    errors = model.residuals
    unseen = errors["joint1 [N m]"][errors["file"] == "other.npz"]
    assert np.std(unseen) == pytest.approx(0.05, rel=0.1)
    _, q, v, a = planted.motion(3)
    stored = read_dynamics(model.save(tmp_path / "model", plots=False))[1]
    np.testing.assert_allclose(stored.model.torque(stored.values, q, v, a), model.torques(q, v, a), atol=1e-9)
    remarks = calib.export(model, tmp_path / "out")
    assert any("as URDF and MJCF have no place for them: offsets, Fa1, Fa2, Fa3" in remark for remark in remarks)
    assert "Fa1" in json.dumps(json.loads((tmp_path / "out/parameters.json").read_text()))


def test_simulation_of_a_function_is_that_of_its_shape():
    """tanh(v / 0.05) as a function runs like the smoothed sign with this width."""
    chain = planted.arm()
    own = calib.FrictionTerm(
        "Fq", lambda v: np.tanh(v / 0.05), lambda v: 20.0 / np.cosh(np.minimum(np.abs(v) / 0.05, 300.0)) ** 2
    )
    limit = np.full(3, 1.0)
    asked = known_robots.random_fourier(-limit, limit, np.full(3, 2.0), 2.0, 500.0, 4, acceleration=10.0, seed=1)
    gains = controllers.pd(np.array([900.0, 600.0, 200.0]), np.array([40.0, 30.0, 10.0]))
    runs = []
    for terms in (own.drive_terms(chain), drives.standard(["Fc"] * 3, 0.05)):
        every = (*drives.standard(["Ia Fv"] * 3), *terms)
        values = np.concatenate([planted.INERTIAS.ravel(), np.tile([0.4, 1.0], 3), [3.0, 2.5, 0.8]])
        runs.append(simulate(Plant(bodies_of(chain), every, values), gains, asked, Sensing(), 0))
    np.testing.assert_allclose(runs[0].q, runs[1].q, atol=1e-6)
    assert np.ptp(runs[0].q) > 0.3


@pytest.mark.parametrize("kink", (0.0, 0.3))
def test_tables_are_within_a_millionth_of_their_function(kink):
    """A kink, a steep smooth sign and a far bend, between the knots, too."""
    knots = knots_of(
        lambda v: np.abs(v - kink) + np.tanh(v / 1e-3) + np.exp(-v),
        lambda v: np.sign(v - kink) + 1e3 / np.cosh(np.minimum(np.abs(v) * 1e3, 300.0)) ** 2 - np.exp(-v),
        -4.0, 4.0, "f",
    )  # fmt: skip
    term = drives.term("f", "velocity_table", 0, *knots.ravel())
    v = np.random.default_rng(0).uniform(-4.0, 4.0, 20000)
    exact = np.abs(v - kink) + np.tanh(v / 1e-3) + np.exp(-v)
    away = term.values(drives.TermMotion(v, v, v)) - exact
    assert np.abs(away).max() < 2e-6 * np.abs(exact).max() and len(knots) < 1000


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"function": np.sign, "slope": lambda v: 0.0 * v}, "joint1: the function changes by 1 .* too abruptly"),
        ({"slope": lambda v: 2.0 * bend_slope(v)}, "slope is 40 at .*differences of the function give 20"),
        ({"function": lambda v: v[0]}, "function: expected an array of shape"),
        ({"function": lambda v: 1.0 / v, "slope": lambda v: -1.0 / v**2}, "function is inf at 0"),
        ({"function": lambda v: 0.0 * v, "slope": lambda v: 0.0 * v}, "the function is zero"),
        ({"joints": [7]}, "joint 7: expected a number from 1 to 3"),
        ({"of": "speed"}, "of 'speed' is not one of velocity, position"),
        ({"slope": 3.0}, "slope: expected a function, found 3.0"),
        ({"name": "Fa 1"}, "name 'Fa 1': expected letters"),
        ({"name": "Fc"}, "FrictionTerm Fc: the name is already a parameter of the drives"),
        ({"name": "Fs"}, "FrictionTerm Fs: the name is already a parameter of the drives"),
        ({"joints": 3}, "joints: expected several numbers, such as .3., found 3"),
        ({"joints": []}, "joints: found no joint"),
        ({"joints": [2, 2]}, "joints: 2 appears more than once"),
        ({"joints": [1.5]}, "joints: expected whole numbers, found 1.5"),
    ],
)  # fmt: skip
def test_functions_that_are_no_friction_are_refused(folder, robot, change, message):
    with np.errstate(divide="ignore"), pytest.raises(UsageError, match=message):
        term = calib.FrictionTerm(**{"name": "Fa", "function": bend, "slope": bend_slope, **change})
        calib.identify_dynamics(robot, log(folder, "train.npz", 0), terms=[term])
