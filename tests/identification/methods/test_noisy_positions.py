"""Claims of maximum likelihood and of the networks: who is right where positions are noisy, who arrives."""

from dataclasses import replace

import numpy as np
import planted_motion as planted
import pytest
from scipy.optimize import linprog

from calib.data.recordings.recording import Recording
from calib.data.signals.filtering import decimate
from calib.data.signals.motion import FilterOptions, make_motion
from calib.dynamics.torque_rows import POWER
from calib.errors import NotConverged, UsageError
from calib.estimation.triangles import collect, combine
from calib.identification.identify import chain_states, common_decimator, find_base
from calib.identification.methods.estimators import samples_of
from calib.identification.methods.method import EstimateStatus, IdentificationProblem
from calib.identification.methods.samples import stack
from calib.identification.registry import METHODS
from calib.identification.rows import make_case, observe
from calib.identification.settings import IdentificationSettings, make_model
from calib.identification.survey.bounded_errors import intervals
from calib.identification.survey.maximum_likelihood import noise_of_states
from calib.identification.survey.networks import adaline, hopfield


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


@pytest.mark.slow
@pytest.mark.parametrize("noise", [*(pytest.param(noise, marks=pytest.mark.slow) for noise in (0.0, 1e-4)), 3e-4])
def test_maximum_likelihood_sigma_covers(noise):
    """Least squares' own is missed by several sigmas at the last level."""
    away = np.array([np.divide(*errors("ml", noisy(seed, noise))) for seed in range(6)])
    assert 0.7 < np.sqrt(np.mean(away**2)) < 1.3
    assert np.mean(np.abs(away) < 2.0) > 0.9


def test_maximum_likelihood_beats_ols():
    """Maximum likelihood is nearer the truth than least squares."""
    problem = noisy(0, 1e-3)
    size = {name: np.linalg.norm(errors(name, problem)[0]) for name in ("wls", "tls", "ml")}
    assert size["ml"] < 0.5 * min(size["wls"], size["tls"])


@pytest.mark.slow
def test_generalised_tls_cures_column_noise():
    """Nearer the truth than least squares and TLS, within its sigma; the same as wls where positions are exact."""
    away = {name: [errors(name, noisy(seed, 3e-4)) for seed in range(3)] for name in ("wls", "tls", "gtls")}
    size = {name: np.mean([np.linalg.norm(error) for error, _ in each]) for name, each in away.items()}
    assert size["gtls"] < 0.8 * min(size["wls"], size["tls"])
    assert 0.6 < np.sqrt(np.mean([(error / sigma) ** 2 for error, sigma in away["gtls"]])) < 1.4
    exact = noisy(0, 0.0)
    same, sigma = errors("gtls", exact)
    assert np.abs((same - errors("wls", exact)[0]) / sigma).max() < 0.05


def test_noise_that_hides_columns_is_told():
    """Noise that hides the columns is told."""
    found = METHODS["gtls"].estimate(noisy(0, 2e-2))
    assert found.status is EstimateStatus.RANK_DEFICIENT and "noise of the encoders alone" in str(found.failure)


@pytest.mark.slow
def test_bounded_error_intervals_hold_truth():
    """Intervals of bounded errors hold the truth, and are those of all rows."""
    rng = np.random.default_rng(0)
    for _ in range(4):
        matrix, truth = rng.normal(size=(300, 3)), rng.normal(size=3)
        target = matrix @ truth + rng.uniform(-0.1, 0.1, 300)
        plain = np.linalg.lstsq(matrix, target)[0]
        left = target - matrix @ plain
        bound = max(0.1, np.abs(left).max())
        lower, upper, _ = intervals(matrix / bound, left / bound)
        assert (plain + lower <= truth).all() and (truth <= plain + upper).all()
        for j, axis in enumerate(np.eye(3)):
            system, limit = np.vstack([matrix, -matrix]), np.concatenate([bound + left, bound - left])
            ends = [-linprog(-s * axis, system, limit, bounds=(None, None)).fun for s in (1.0, -1.0)]
            assert upper[j] >= ends[0] - 1e-9 and -lower[j] >= ends[1] - 1e-9  # outside, if not all rows took part
            assert upper[j] - lower[j] < 1.1 * sum(ends)


@pytest.mark.slow
def test_set_membership_is_certain_and_wide(problem):
    found, plain = METHODS["set-membership"].estimate(problem), METHODS["wls"].estimate(problem)
    away = np.abs(found.estimate.values - problem.base.transform @ planted.truth())
    half = np.sqrt(3.0) * found.estimate.sigma
    assert (away <= half).all() and np.median(half / plain.estimate.sigma) > 5.0


def test_noise_of_filtered_states():
    """Noise of filtered states is what filters leave of white noise."""
    problem = noisy(0, 3e-4)
    motion = problem.cases[0].motion
    stated = noise_of_states(motion, problem.decimator)
    clean = noisy(0, 0.0).cases[0].motion
    seen = [np.var(decimate(x - y, problem.decimator), axis=0) for x, y in ((motion.v, clean.v), (motion.a, clean.a))]
    assert np.allclose(np.array(seen) / [stated[:, 1, 1], stated[:, 2, 2]], 1.0, atol=0.35)


def test_neuron_minimises_along_the_gradient(problem):
    """One step: what is left of that sample's torque is orthogonal to the step; half a step leaves half of it."""
    data, zero = samples_of(problem), np.zeros(problem.pooled.parameters)
    moved = [adaline(data, zero, rate, steps=1) for rate in (1.0, 0.5)]
    left = data.target - data.matrix @ moved[0]
    along = np.einsum("ki,ki->k", left, data.matrix @ moved[0]) / np.linalg.norm(data.target, axis=1) ** 2
    assert np.abs(along).min() < 1e-12
    assert np.allclose(moved[1], 0.5 * moved[0])


@pytest.mark.slow
def test_neuron_gains_nothing_from_more_data():
    """The survey's variance above ten times that of least squares: so it is with enough samples, the neuron's stays."""
    rng, truth, spread = np.random.default_rng(0), np.array([1.0, -2.0, 0.5, 3.0]), {}
    for count in (100, 2500):
        away = []
        for seed in range(15):
            matrix = rng.normal(size=(count, 2, 4))
            target = matrix @ truth + 0.1 * rng.normal(size=(count, 2))
            plain = np.linalg.lstsq(matrix.reshape(-1, 4), target.ravel())[0]
            data = stack(matrix, target, np.ones((count, 2), bool))
            away.append([adaline(data, plain, steps=2500, seed=seed) - truth, plain - truth])
        spread[count] = np.mean(np.square(away), axis=(0, 2))
    neuron, plain = np.transpose([spread[count] for count in (100, 2500)])
    assert 0.5 < neuron[1] / neuron[0] < 2.0 and plain[1] < 0.1 * plain[0]
    assert neuron[1] > 100.0 * plain[1]


def test_network_rests_at_least_squares(problem):
    """u' = -W'Wx + W'y, columns of one size and steps enough."""
    triangle, size = combine(problem.pooled), METHODS["ols"].estimate(problem).estimate
    norms = np.linalg.norm(triangle[:-1, :-1], axis=0)
    scaled = triangle / np.append(norms, 1.0)
    bound = 3.0 * np.abs(size.values * norms).max()
    rest, steps = hopfield(scaled, np.zeros(len(norms)), bound, steps=200_000)
    assert np.allclose(rest / norms, size.values, atol=0.01 * size.sigma.min()) and steps < 200_000


@pytest.mark.parametrize(
    "name", [pytest.param("adaline", marks=pytest.mark.slow), pytest.param("hopfield", marks=pytest.mark.slow)]
)
def test_network_sigma_covers_training_error(name):
    """The stated sigma of the networks covers their error of training."""
    for seed in range(3):
        away = np.divide(*errors(name, noisy(seed, 0.0)))
        assert np.sqrt(np.mean(away**2)) < 1.5


def test_networks_say_when_they_fail(problem):
    data = collect(np.random.default_rng(0).normal(size=(200, 2)), np.zeros(200))
    triangle = combine(replace(data, factors=data.factors * [1.0, 1.0, 0.0]))
    triangle[:2, 2] = triangle[:2, :2] @ [3.0, 1.0]
    with pytest.raises(NotConverged, match="saturate at 2: parameters 1"):
        hopfield(triangle, np.zeros(2), 2.0)
    found = replace(METHODS["adaline"], rate=10.0).estimate(problem)
    assert found.status is EstimateStatus.NOT_CONVERGED and "smaller rate than 10" in str(found.failure)


def test_likelihood_wants_motor_torques(problem):
    """Maximum likelihood wants motor torques."""
    with pytest.raises(UsageError, match="motor torques"):
        METHODS["ml"].estimate(replace(problem, model=replace(problem.model, torque_rows=POWER)))
