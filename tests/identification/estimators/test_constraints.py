"""Claims of the PC methods: constraints by name hold, cost what they must, and those that say nothing are refused."""

import tomllib
from dataclasses import replace

import numpy as np
import planted_motion as planted
import pytest

from calib.dynamics import pseudo_inertia
from calib.errors import UsageError
from calib.estimation.triangles import combine
from calib.identification.identify import identify
from calib.identification.identify_options import parse_options
from calib.identification.methods.constraint_settings import ConstraintSettings, WeightedSum
from calib.identification.methods.method import IdentificationProblem
from calib.identification.methods.parameter_constraints import MIN_EIGENVALUE, constraints_of
from calib.identification.registry import METHODS

FREE = {"pc-ols": "ols", "pc-wls": "wls", "pc-irls": "irls"}


def asked(problem: IdentificationProblem, **settings) -> IdentificationProblem:
    return replace(problem, constraints=ConstraintSettings(**settings))


def value(found, name: str) -> float:
    return float(found.estimate.values[found.estimate.names.index(name)])


@pytest.mark.parametrize("name", FREE)
def test_idle_constraints_change_nothing(problem, name):
    """Constraints that do not bind change nothing."""
    held, free = METHODS[name].estimate(problem), METHODS[FREE[name]].estimate(problem)
    moved = (held.estimate.values - free.estimate.values) / free.estimate.sigma
    assert np.abs(moved).max() < 0.02
    assert np.allclose(held.estimate.sigma, free.estimate.sigma, rtol=1e-3)
    assert held.held is not None and not held.held.binding and held.held.findings == ()


@pytest.mark.parametrize("name", FREE)
def test_bound_against_the_truth_is_told(problem, name):
    """A bound that excludes the truth holds, and is told."""
    free = METHODS[FREE[name]].estimate(problem)
    limit = 1.2 * value(free, "Fv1")
    found = METHODS[name].estimate(asked(problem, bounds={"Fv1": (limit, np.inf)}))
    assert value(found, "Fv1") == pytest.approx(limit, rel=1e-6)
    place = found.estimate.names.index("Fv1")
    assert found.estimate.sigma[place] < 1e-9 * free.estimate.sigma[place]
    others = np.arange(len(found.estimate.names)) != place
    assert np.all(found.estimate.sigma[others] > 0.0)
    assert found.held is not None and [one.name for one in found.held.binding] == [f"Fv1 >= {limit:g}"]
    assert found.held.binding[0].multiplier > 0.0
    assert [one.code for one in found.held.findings] == ["on-its-bound"]


def test_ols_weighs_no_row_and_wls_does(problem):
    """PC-OLS minimises ‖y - W x‖² with the covariance σ² (WᵀW)⁻¹, PC-WLS that of whitened rows."""
    limit = 1.5 * value(METHODS["wls"].estimate(problem), "Fv1")
    wanted = asked(problem, bounds={"Fv1": (limit, np.inf)}, inertia=0)
    for name, weigh in (("pc-ols", False), ("pc-wls", True)):
        found = METHODS[name].estimate(wanted)
        triangle = combine(problem.pooled, found.std if weigh else None)
        p = len(triangle) - 1
        slope = triangle[:p, :p].T @ (triangle[:p, :p] @ found.estimate.values - triangle[:p, p])
        slope[found.estimate.names.index("Fv1")] = 0.0
        assert np.abs(slope / np.linalg.norm(triangle[:p, :p], axis=0)).max() < 1e-6 * np.linalg.norm(triangle[:p, p])


def test_equality_holds_and_conflict_is_told(problem):
    """An equality between parameters holds, and disagreement is told."""
    same = WeightedSum({"Fv1": 1.0, "Fv2": -1.0}, equal=0.0, name="joints alike")
    found = METHODS["pc-wls"].estimate(asked(problem, sum=(same,)))
    assert value(found, "Fv1") == pytest.approx(value(found, "Fv2"), rel=1e-9)
    assert found.held is not None and [one.code for one in found.held.findings] == ["against-equality"]


def test_impossible_robot_is_made_possible(problem):
    """A bound that wants an inertia away makes M(q) indefinite; held definite, every posture's least eigenvalue is."""
    pulled = {"ZZ2R": (-np.inf, -0.2 * value(METHODS["wls"].estimate(problem), "ZZ2"))}
    loose = METHODS["pc-wls"].estimate(asked(problem, bounds=pulled, inertia=0))
    wanted = asked(problem, bounds=pulled, inertia=30)
    held = METHODS["pc-wls"].estimate(wanted)
    tensor = constraints_of(wanted).inertia
    assert np.linalg.eigvalsh(tensor @ loose.estimate.values).min() < 0.0
    assert np.linalg.eigvalsh(tensor @ held.estimate.values).min() > 0.1 * MIN_EIGENVALUE * np.abs(tensor).min()
    assert held.held is not None and held.held.postures > 0


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"bounds": {"XX1": (0.0, 1.0)}}, "XX1 has no effect on the torques"),
        ({"bounds": {"M2": (0.0, 1.0)}}, "(no effect|only in sums with others)"),
        ({"bounds": {"Fz1": (0.0, 1.0)}}, "'Fz1' is not a parameter of this model"),
        (
            {"bounds": {"Fv1": (5.0, 6.0)}, "sum": (WeightedSum({"Fv1": 2.0}, most=3.0, name="twice Fv1"),)},
            "contradict each other: 5 <= Fv1 <= 6; twice Fv1 <= 3",
        ),
        (
            {"sum": (WeightedSum({"Fv1": 1.0}, equal=1.0), WeightedSum({"Fv1": 2.0}, equal=1.0))},
            "contradict each other: 1 Fv1 = 1; 2 Fv1 = 1",
        ),
        ({"sum": (WeightedSum({"Fv1": 1.0, "Fv2": 1.0}),)}, "expected equal, or least <= most"),
    ],
)
def test_impossible_constraints_are_named(problem, settings, words):
    """Constraints that cannot be are refused with their names."""
    with pytest.raises(UsageError, match=words):
        METHODS["pc-wls"].estimate(asked(problem, **settings))


def test_bounds_without_possible_robot_fail(problem):
    """The last joint's own inertia, its entry of M(q) in every posture, below zero."""
    last = WeightedSum({"ZZ3": 1.0, "Ia3": 1.0}, most=-1.0)
    found = METHODS["pc-wls"].estimate(asked(problem, sum=(last,), signs=False))
    assert not found.found and "no estimate satisfies 1 ZZ3 + 1 Ia3 <= -1 with M(q)" in str(found.failure)


@pytest.mark.parametrize("name", ["pc-ols", "pc-wls"])
def test_impossible_bodies_go_to_the_border(problem, name):
    """The optimum of cvxpy over standard parameters with P_i >= 0, what no torque tells of them free."""
    cp = pytest.importorskip("cvxpy")
    free = METHODS["wls"].estimate(problem)
    pulled = {"ZZ2R": (-np.inf, 0.3 * value(free, "ZZ2"))}
    loose = METHODS[name].estimate(asked(problem, bounds=pulled, inertia=0))
    held = METHODS[name].estimate(asked(problem, bounds=pulled, bodies=True))
    assert held.held is not None and held.held.names[-1] in [one.name for one in held.held.binding]
    assert "held-to-bodies" in [one.code for one in held.held.findings]
    assert np.all(held.estimate.sigma <= loose.estimate.sigma * 1.5)
    base, count = problem.base, problem.model.inertial // 10
    factor = combine(problem.pooled, loose.std if name == "pc-wls" else np.ones(len(loose.std)))
    size = np.linalg.norm(factor[:-1, :-1], axis=0)
    chi, terms = cp.Variable(10 * count), cp.Variable(problem.model.p - 10 * count)
    beta = base.transform[:, : 10 * count] @ chi + base.transform[:, 10 * count :] @ terms
    asks = [beta[base.names.index("ZZ2R")] <= pulled["ZZ2R"][1]]
    asks += [terms[k] >= 0.0 for k, one in enumerate(problem.model.columns) if one.nonnegative]
    asks += [sum(chi[10 * i + k] * pseudo_inertia.BASIS[k] for k in range(10)) >> 0 for i in range(count)]
    scale = np.linalg.norm(factor[:-1, -1])
    cp.Problem(cp.Minimize(cp.sum_squares((factor[:-1, :-1] @ beta - factor[:-1, -1]) / scale)), asks).solve(
        solver=cp.CLARABEL
    )
    costs = [np.linalg.norm(factor[:-1, :-1] @ b - factor[:-1, -1]) for b in (held.estimate.values, beta.value)]
    assert costs[0] == pytest.approx(costs[1], rel=1e-4)
    assert np.abs((held.estimate.values - beta.value) * size).max() < 2e-2 * scale


def test_possible_bodies_are_unchanged(problem):
    """Bodies that exist are left alone, and impossible bounds are told."""
    free = METHODS["wls"].estimate(problem)
    held = METHODS["pc-wls"].estimate(asked(problem, bodies=True))
    assert held.held is not None and not any("bodies" in name for name in held.held.names)
    assert np.abs((held.estimate.values - free.estimate.values) / free.estimate.sigma).max() < 0.02
    last = WeightedSum({"ZZ3": 1.0, "Ia3": 1.0}, most=-1.0)
    found = METHODS["pc-wls"].estimate(asked(problem, sum=(last,), signs=False, bodies=True))
    assert not found.found and "no physically consistent bodies satisfy 1 ZZ3 + 1 Ia3 <= -1" in str(found.failure)


def test_told_sum_is_its_base_parameter(problem):
    """A sum of standard parameters that the torques tell is its base parameter."""
    base = problem.base
    name = next(name for name, row in zip(base.names, base.split.coefficients) if np.abs(row).max() > 1e-6)
    row = base.transform[base.names.index(name)]
    weights = {base.standard[k]: float(row[k]) for k in np.flatnonzero(row)}
    made = constraints_of(asked(problem, sum=(WeightedSum(weights, least=0.0),), signs=False, inertia=0))
    assert made.matrix[0] == pytest.approx(np.eye(base.b)[base.names.index(name)])


def test_options_file_states_constraints():
    """The options file states the constraints, and other methods refuse them."""
    text = """
    method = "pc-wls"
    friction = "standard"
    essential = "none"
    [constraints]
    bounds = { Fv1 = [0.0, inf] }
    [[constraints.sum]]
    weights = { Fv1 = 1.0, Fv2 = -1.0 }
    equal = 0.0
    """
    settings = parse_options(tomllib.loads(text)).settings
    found = identify(planted.arm(), [planted.case("a", 0)], settings)
    assert found.fitted.held is not None and "1 Fv1 + -1 Fv2 = 0" in found.fitted.held.names
    with pytest.raises(UsageError, match="method 'wls' does not support them; use 'pc-wls'"):
        identify(planted.arm(), [planted.case("a", 0)], replace(settings, method="wls"))
    with pytest.raises(UsageError, match="lower bound 2 is above the upper 1"):
        parse_options({"constraints": {"bounds": {"Fv1": [2.0, 1.0]}}})
    with pytest.raises(UsageError, match="Fv1: expected two numbers"):
        parse_options({"constraints": {"bounds": {"Fv1": [float("nan"), 1.0]}}})


def test_definite_inertia_reaches_optimum(problem):
    """Definite inertia gives the optimum of cvxpy."""
    cvxpy = pytest.importorskip("cvxpy")
    limit = -0.2 * value(METHODS["wls"].estimate(problem), "ZZ2")
    made = constraints_of(asked(problem, bounds={"ZZ2R": (-np.inf, limit)}, inertia=6, signs=False))
    triangle = combine(problem.pooled, METHODS["wls"].estimate(problem).std)
    p = problem.base.b
    found = made.solve(triangle)
    norms = np.linalg.norm(triangle[:p, :p], axis=0)
    free = np.linalg.solve(triangle[:p, :p], triangle[:p, p])
    size = np.abs(np.einsum("kiip,p->ki", made.inertia, free)).mean(axis=0)
    b = cvxpy.Variable(p)
    scaled = made.inertia / np.sqrt(size)[:, None, None] / np.sqrt(size)[:, None] / norms
    cones = [sum(b[k] * one[:, :, k] for k in range(p)) - MIN_EIGENVALUE * np.eye(len(size)) >> 0 for one in scaled]
    bound = made.matrix / norms @ b <= made.upper
    aim = cvxpy.sum_squares((triangle[:p, :p] / norms @ b - triangle[:p, p]) / np.linalg.norm(triangle[:p, p]))
    cvxpy.Problem(cvxpy.Minimize(aim), [*cones, bound]).solve(solver="CLARABEL")
    assert found.values * norms == pytest.approx(b.value, abs=1e-4 * np.abs(b.value).max())
    assert found.binding.sum() > 1
