"""Claims of maximum likelihood and of the networks: who is right where positions are noisy, who is least squares."""

from dataclasses import replace

import numpy as np
import planted_motion as planted
import pytest

from calib.data.recordings.recording import Recording
from calib.data.signals.filtering import decimate
from calib.data.signals.motion import FilterOptions, make_motion
from calib.dynamics.torque_rows import POWER
from calib.errors import NotConverged, UsageError
from calib.estimation.triangles import collect
from calib.identification.identify import chain_states, common_decimator, find_base
from calib.identification.methods.method import EstimateStatus, IdentificationProblem
from calib.identification.methods.registry import METHODS
from calib.identification.rows import make_case, observe
from calib.identification.settings import IdentificationSettings, make_model
from calib.rooms.studies.methods.maximum_likelihood import noise_of_states
from calib.rooms.studies.methods.networks import hopfield


def noisy(seed: int, noise: float) -> IdentificationProblem:
    """Return the problem of the planted arm with white noise on its positions [rad]."""
    log = planted.series(seed)
    q = log["q"] + noise * np.random.default_rng([seed, 1]).normal(size=log["q"].shape)
    recording = Recording(log["t"], q, log["tau"], "torque", ("joint1", "joint2", "joint3"), file="a")
    cases = [make_case("a", make_motion(recording, FilterOptions(cutoff=30.0, band=10.0)))]
    settings = IdentificationSettings()
    model, decimator = make_model(planted.arm(), settings), common_decimator(cases, settings)
    base = find_base(model, cases, chain_states(planted.arm(), model))
    rows = tuple(observe(model, base.kept, case, decimator) for case in cases)
    terms = [None if k < model.inertial else model.columns[k - model.inertial] for k in base.kept]
    return IdentificationProblem(model, base, cases, decimator, rows, tuple(terms), np.full(base.b, -1))


def errors(name: str, problem: IdentificationProblem) -> tuple[np.ndarray, np.ndarray]:
    found = METHODS[name].estimate(problem).estimate
    return found.values - problem.base.transform @ planted.truth(), found.sigma


@pytest.mark.parametrize("noise", [*(pytest.param(noise, marks=pytest.mark.slow) for noise in (0.0, 1e-4)), 3e-4])
def test_the_stated_sigma_of_maximum_likelihood_covers(noise):
    """Least squares' own is missed by several sigmas at the last level."""
    away = np.array([np.divide(*errors("ml", noisy(seed, noise))) for seed in range(6)])
    assert 0.7 < np.sqrt(np.mean(away**2)) < 1.3
    assert np.mean(np.abs(away) < 2.0) > 0.9


def test_maximum_likelihood_is_nearer_the_truth_than_least_squares():
    problem = noisy(0, 1e-3)
    size = {name: np.linalg.norm(errors(name, problem)[0]) for name in ("wls", "tls", "ml")}
    assert size["ml"] < 0.5 * min(size["wls"], size["tls"])


def test_noise_of_filtered_states_is_what_filters_leave_of_white_noise():
    problem = noisy(0, 3e-4)
    motion = problem.cases[0].motion
    stated = noise_of_states(motion, problem.decimator)
    clean = noisy(0, 0.0).cases[0].motion
    seen = [np.var(decimate(x - y, problem.decimator), axis=0) for x, y in ((motion.v, clean.v), (motion.a, clean.a))]
    assert np.allclose(np.array(seen) / [stated[:, 1, 1], stated[:, 2, 2]], 1.0, atol=0.35)


@pytest.mark.parametrize("name", ["adaline", "hopfield"])
def test_networks_come_to_rest_at_weighted_least_squares(problem, name):
    found, plain = METHODS[name].estimate(problem), METHODS["wls"].estimate(problem)
    assert found.found and found.iterations > 1
    away = (found.estimate.values - plain.estimate.values) / plain.estimate.sigma
    assert np.sqrt(np.mean(away**2)) < 0.3
    assert (found.estimate.sigma >= 0.999 * plain.estimate.sigma).all()


def test_the_stated_sigma_of_the_networks_covers():
    for name in ("adaline", "hopfield"):
        away = np.array([np.divide(*errors(name, noisy(seed, 0.0))) for seed in range(4)])
        assert 0.7 < np.sqrt(np.mean(away**2)) < 1.3


def test_a_saturated_neuron_is_no_estimate():
    matrix = np.random.default_rng(0).normal(size=(200, 2))
    data = collect(matrix, matrix @ [3.0, 1.0] + 0.01)
    with pytest.raises(NotConverged, match="saturate: x1"):
        hopfield(data, np.ones(1), bound=np.array([1.0, 5.0]))


def test_networks_say_when_they_fail(problem, monkeypatch):
    monkeypatch.setattr("calib.rooms.studies.methods.networks.EPOCHS", 1)
    found = METHODS["adaline"].estimate(problem)
    assert found.status is EstimateStatus.NOT_CONVERGED and "from rest after 1 epochs" in str(found.failure)


def test_maximum_likelihood_wants_motor_torques(problem):
    with pytest.raises(UsageError, match="motor torques"):
        METHODS["ml"].estimate(replace(problem, model=replace(problem.model, torque_rows=POWER)))
