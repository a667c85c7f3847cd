"""Full standard parameters: of possible bodies, with the torques that were identified."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.stats import chi2

from calib.dynamics import base as bases
from calib.dynamics import pseudo_inertia
from calib.dynamics.idim import IdentificationModel, from_chain
from calib.errors import UsageError
from calib.estimation.estimate import whitened
from calib.identification.physical_consistency import solve
from calib.identification.physical_consistency.consistency_problem import (
    BodyCost,
    find_prior_bodies,
    make_problem,
    nearest,
)
from calib.identification.physical_consistency.information import Information
from calib.identification.prediction import Dynamics
from calib.robot.chain import Chain, Element, Joint

CAD = (pseudo_inertia.rod(4.0, [0.0, 0.0, 0.4], 0.12), pseudo_inertia.rod(3.0, [0.3, 0.05, 0.0], 0.1),
       pseudo_inertia.ball(1.5, 0.1, np.array([0.02, 0.0, 0.05])))  # fmt: skip


def arm(inertias: np.ndarray | None) -> Chain:
    """Two hinges and a slide."""
    return Chain(
        "arm",
        (Joint("a"), Joint("b"), Joint("c", "prismatic", -0.3, 0.3)),
        (
            Element("a", "rz", joint=0),
            Element("az", "tz", 0.4, owner=1),
            Element("ax", "rx", 1.2, owner=1),
            Element("b", "rz", joint=1, owner=1),
            Element("bx", "tx", 0.3, owner=2),
            Element("by", "ry", 0.7, owner=2),
            Element("c", "tz", joint=2, owner=2),
        ),
        inertias=inertias,
    )


def planted(seed: int, noise: float = 0.02) -> tuple[np.ndarray, IdentificationModel, bases.Base, Information]:
    """Return true standard parameters, off the CAD's by a third, and what noisy torques tell of them."""
    rng = np.random.default_rng(seed)
    pseudo = pseudo_inertia.from_standard(np.array(CAD))
    stretch = np.eye(4) + 0.15 * rng.standard_normal((3, 4, 4))
    true = pseudo_inertia.to_standard(stretch @ pseudo @ stretch.transpose(0, 2, 1)).ravel()
    chain = arm(np.array(CAD))
    model = from_chain(chain)
    truth = np.concatenate([true, np.tile([0.2, 1.0, 2.0, 0.1], 3)])
    base = bases.find(model)
    samples = bases.random_samples(model, 200, seed)
    matrix = model.regressor(samples.q, samples.v, samples.a).reshape(-1, model.p)
    kept = matrix[:, base.kept]
    values = np.linalg.lstsq(kept, matrix @ truth + noise * rng.standard_normal(len(matrix)), rcond=None)[0]
    covariance = noise**2 * np.linalg.inv(kept.T @ kept)
    return truth, model, base, told(chain, model, base, values, covariance)


def told(
    chain: Chain, model: IdentificationModel, base: bases.Base, values: np.ndarray, covariance: np.ndarray
) -> Information:
    dynamics = Dynamics(model, base.to_standard(values))
    return Information(
        chain, dynamics, base.names, base.units, values, covariance, base.transform, whitened(values, covariance)
    )


def test_pseudo_inertia_is_one_to_one():
    """Pseudo-inertia is one to one and knows possible bodies."""
    body = np.random.default_rng(1).standard_normal((5, 10))
    assert np.abs(pseudo_inertia.to_standard(pseudo_inertia.from_standard(body)) - body).max() < 1e-14
    ball = pseudo_inertia.ball(2.0, 0.5, np.array([1.0, -2.0, 0.3]))
    assert pseudo_inertia.margin(ball) == pytest.approx(0.5 / np.sqrt(5.0))
    assert pseudo_inertia.margin(ball - np.array([0.5, 0, 0, 0, 0, 0, 0, 0, 0, 0])) < 0.0, "triangle inequality"
    rod = pseudo_inertia.rod(3.0, [0.0, 0.0, 2.0], 0.1)
    assert rod[0] == pytest.approx(3.0 * 4.0 / 3.0 + 0.4 * 3.0 * 0.01), "m l²/3 about its end"


def test_the_same_divergence_in_any_frame():
    rng = np.random.default_rng(2)
    one, two, turn = (rng.standard_normal((4, 4)) for _ in range(3))
    one, two = one @ one.T, two @ two.T
    away = pseudo_inertia.divergence(one, two)
    assert away > 0.0 and pseudo_inertia.divergence(two, two) == pytest.approx(0.0, abs=1e-9)
    assert pseudo_inertia.divergence(turn @ one @ turn.T, turn @ two @ turn.T) == pytest.approx(away)


@pytest.mark.parametrize(("seeds", "outside"), [(range(1), 0), pytest.param(range(6), 1, marks=pytest.mark.slow)])
def test_planted_robots_within_covariance(seeds, outside):
    """Pooled over seeds, the distance² from the estimate stays within χ²(b), and the truth within the posterior."""
    inside = 0
    for seed in seeds:
        truth, _, base, data = planted(seed)
        found = solve.find_possible(data)
        assert (found.margins > 1e-3).all() and found.possible and not found.blamed
        assert found.distance < found.allowed
        off = base.transform @ (found.dynamics.values - truth)
        spread = base.transform @ found.covariance @ base.transform.T
        inside += float(off @ np.linalg.solve(spread, off)) < chi2.ppf(0.99, base.b)
        drives = found.dynamics.values[30:].reshape(3, 4)[:, :3]
        assert (drives > 0.0).all()
    assert inside >= len(seeds) - outside


@pytest.mark.slow
def test_exact_data_keep_base_torques():
    """With exact data the torques are those of the base parameters."""
    _, model, _, data = planted(3, noise=1e-5)
    found = solve.find_possible(data)
    samples = bases.random_samples(model, 50, 9)
    matrix = model.regressor(samples.q, samples.v, samples.a)
    wanted = matrix @ data.dynamics.values
    assert np.abs(matrix @ found.dynamics.values - wanted).max() < 1e-5 * np.abs(wanted).max()


def test_impossible_base_is_told_with_body():
    """An impossible base is told with the body, and a possible one is not."""
    _, model, base, data = planted(4)
    assert data.distance(nearest(problem_of(data))) < 4.0
    values = np.array(data.values)
    place = base.names.index(next(name for name in base.names if name.startswith("ZZ2")))
    values[place] = -0.5
    found = solve.find_possible(told(data.chain, model, base, values, data.covariance))
    assert not found.possible and found.nearest > found.allowed
    assert any("body 2" in name or "body 3" in name for name, _ in found.blamed)
    assert found.blamed[0][1] < found.nearest
    assert (found.margins > 0.0).all(), "what is exported is possible all the same"


@pytest.mark.slow
def test_euclidean_prior_fits_data_as_well():
    """They differ in what the torques do not tell; only the entropic one keeps off the border of what can exist."""
    _, _, _, data = planted(3)
    entropic, euclidean = (solve.find_possible(data, prior=prior) for prior in solve.PRIORS)
    assert max(entropic.distance, euclidean.distance) < entropic.allowed == euclidean.allowed
    assert np.abs(entropic.dynamics.values - euclidean.dynamics.values).max() > 1e-3
    assert euclidean.prior == "euclidean" and euclidean.margins.min() < entropic.margins.min()
    spread = np.sqrt(np.diag(euclidean.covariance))
    assert np.isfinite(spread).all() and (spread[:10] > 0.0).all()


def test_an_unknown_prior_is_refused():
    _, _, _, data = planted(3)
    with pytest.raises(UsageError, match="prior 'euclid' is not one of entropic, euclidean"):
        solve.find_possible(data, prior="euclid")


def test_rods_stand_in_for_a_cad():
    """Without a CAD, rods of a mass that the data choose stand in."""
    _, model, base, data = planted(5)
    bare = told(arm(None), model, base, data.values, data.covariance)
    found = solve.find_possible(bare)
    assert "no masses" in found.source and found.possible and found.distance < found.allowed
    assert 1.0 < found.dynamics.values[[9, 19, 29]].sum() < 100.0


def problem_of(data: Information) -> BodyCost:
    return make_problem(data, next(find_prior_bodies(data.chain, data.dynamics.model)))


@pytest.mark.slow
def test_optimum_does_not_depend_on_start():
    """The optimum is the same from that of another weight."""
    _, model, _, information = planted(3)
    problem = make_problem(information, next(find_prior_bodies(arm(None), model)))
    cold = solve.solve(problem, 1e3)
    warm = solve.solve(problem, 1e3, solve.solve(problem, 10.0))
    assert np.abs(warm - cold).max() < 1e-6 * np.abs(cold).max()


def test_slope_and_curvature_match_the_cost():
    """Slope and curvature are those of the cost."""
    _, _, _, data = planted(6, noise=1.0)
    problem = problem_of(data)
    values = solve.solve(problem, 30.0)
    slope, curvature = solve.derivatives(problem, 30.0, values)
    scale = 1.0 / np.sqrt(np.diag(curvature))
    assert np.abs(slope * scale).max() < 1e-3, "optimal"
    shifted = values + 0.05 * scale * np.random.default_rng(0).standard_normal(len(values))
    slope, curvature = solve.derivatives(problem, 30.0, shifted)
    for k in range(0, len(values), 3):
        step = np.zeros(len(values))
        step[k] = 1e-4 * scale[k]
        ends = [solve.cost(problem, 30.0, shifted + sign * step) for sign in (1, -1)]
        slopes = [solve.derivatives(problem, 30.0, shifted + sign * step)[0] for sign in (1, -1)]
        assert (ends[0] - ends[1]) / 2e-4 == pytest.approx(slope[k] * scale[k], rel=1e-5, abs=1e-5)
        bent = (slopes[0] - slopes[1]) / (2 * step[k])
        assert np.abs((bent - curvature[k]) * scale * scale[k]).max() < 1e-5


def test_cvxpy_finds_the_same_optimum():
    cp = pytest.importorskip("cvxpy")
    _, _, _, data = planted(7, noise=1.0)
    problem = problem_of(data)
    gamma = 50.0
    values = solve.solve(problem, gamma)
    x = cp.Variable(len(values))
    scale = np.abs(values) + 1e-2
    chi = cp.multiply(x, scale)
    parts = [cp.sum_squares(problem.factor[:, :-1] @ chi - problem.factor[:, -1])]
    for i in range(3):
        pseudo = sum(chi[10 * i + k] * pseudo_inertia.BASIS[k] for k in range(10))
        parts.append(gamma * (cp.trace(np.linalg.inv(problem.references[i]) @ pseudo) - cp.log_det(pseudo)))
    for k, size in enumerate(problem.sizes):
        term = chi[30 + k]
        parts.append(term / size - cp.log(term) if problem.positive[k] else cp.square(term / size))
    cp.Problem(cp.Minimize(0.5 * sum(parts))).solve(solver=cp.CLARABEL)
    theirs = scale * x.value
    ours, other = (solve.cost(problem, gamma, one) for one in (values, theirs))
    assert ours <= other + 1e-6 * abs(other)
    assert np.linalg.norm((theirs - values) / scale) < 1e-2


def test_switched_off_term_frees_the_others():
    """Its information is without bound: 1e12 against 1e4 of any other."""
    data = planted(0)[3]
    pinned = 1e12 * np.eye(data.factor.shape[1])[-2]
    data = replace(data, factor=np.vstack([data.factor, pinned]))
    assert make_problem(data, next(iter(find_prior_bodies(data.chain, data.dynamics.model)))).free.all()


@pytest.mark.slow
@pytest.mark.parametrize("pull", [0.0, 50.0])
def test_log_cholesky_finds_the_same_robot(pull):
    """An independent way without a cone: P = L Lᵀ with exp on L's diagonal, exp of drive terms, by least squares.

    With a pull, the rows of the Euclidean prior beside those of the data; from the solution itself, slightly off, since
    that prior does not keep off the border, to which factors with exp only creep.
    """
    _, model, base, data = planted(1)
    values = np.array(data.values)
    if not pull:
        values[list(data.names).index("Fv1")] = -0.3  # no robot has that
    data = told(data.chain, model, base, values, data.covariance)
    problem = make_problem(data, next(iter(find_prior_bodies(data.chain, model))))
    solution = nearest(problem, pull=pull)
    lower, bodies = np.tril_indices(4), problem.bodies
    start = np.linalg.cholesky(problem.references)
    positive = problem.positive & (problem.sizes > 0.0)

    def parameters(x: np.ndarray) -> np.ndarray:
        roots = np.zeros((bodies, 4, 4))
        roots[:, lower[0], lower[1]] = x[: 10 * bodies].reshape(bodies, 10)
        diagonal = np.arange(4)
        roots[:, diagonal, diagonal] = np.exp(roots[:, diagonal, diagonal])
        terms = x[10 * bodies :]
        drives = np.where(positive, problem.sizes * np.exp(np.where(positive, terms, 0.0)), terms)
        pseudo = start @ roots @ roots.transpose(0, 2, 1) @ start.transpose(0, 2, 1)
        return np.concatenate([pseudo_inertia.to_standard(pseudo).ravel(), drives])

    inverse, sized = np.linalg.inv(start), problem.sizes > 0.0

    def rows(values: np.ndarray) -> np.ndarray:
        pseudo = inverse @ pseudo_inertia.from_standard(values[: 10 * bodies].reshape(-1, 10))
        away = (pseudo @ inverse.transpose(0, 2, 1) - np.eye(4)) * np.sqrt(0.5 * problem.weights(pull))[:, None, None]
        ratio = values[10 * bodies :][sized] / problem.sizes[sized]
        drives = np.where(problem.positive[sized], np.sqrt(0.5) * (ratio - 1.0), ratio)
        drawn = np.concatenate([away.ravel(), drives]) if pull else np.zeros(0)
        return np.concatenate([problem.factor[:, :-1] @ values - problem.factor[:, -1], drawn])

    begin = np.zeros(10 * bodies + len(positive))
    if pull:
        pseudo = inverse @ pseudo_inertia.from_standard(solution[: 10 * bodies].reshape(-1, 10))
        roots = np.linalg.cholesky(pseudo @ inverse.transpose(0, 2, 1) + 1e-4 * np.eye(4))
        roots[:, range(4), range(4)] = np.log(roots[:, range(4), range(4)])
        terms = solution[10 * bodies :]
        ratio = np.maximum(terms / np.where(positive, problem.sizes, 1.0), 1e-4)
        begin = np.concatenate([roots[:, lower[0], lower[1]].ravel(), np.where(positive, np.log(ratio), terms)])
    found = least_squares(lambda x: rows(parameters(x)), begin, x_scale="jac", max_nfev=400)
    costs = [float(np.linalg.norm(rows(one))) for one in (solution, parameters(found.x))]
    assert costs[0] <= costs[1] * (1.0 + 1e-4) and costs[1] == pytest.approx(costs[0], rel=1e-3)
    away = data.distance(solution)
    assert pull or away > 5.0
    assert pull or data.distance(parameters(found.x)) == pytest.approx(away, rel=1e-3)
