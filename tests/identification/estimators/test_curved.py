"""Claims of curved constraints h(β) >= 0: the optimum meets its conditions, wrong derivatives are found, and so on."""

import tomllib
from dataclasses import replace

import numpy as np
import planted_motion as planted
import pytest
from scipy.optimize import minimize

from calib.errors import UsageError
from calib.estimation.triangles import combine
from calib.identification.identify import identify
from calib.identification.identify_options import parse_options
from calib.identification.methods.constraint_settings import ConstraintSettings, CurvedConstraint
from calib.identification.registry import METHODS

CIRCLE = "Fv1**2 + Fv2**2 <= 4"


def circle(Fv1: float, Fv2: float) -> float:
    return 4.0 - Fv1**2 - Fv2**2


def slope(Fv1: float, Fv2: float) -> tuple[float, float]:
    return -2.0 * Fv1, -2.0 * Fv2


def held(problem, name: str = "pc-wls", /, *curved: CurvedConstraint, **settings):
    return METHODS[name].estimate(replace(problem, constraints=ConstraintSettings(curved=curved, **settings)))


@pytest.mark.parametrize("formula", [CIRCLE, "Fv1 * Fv2 <= 1", "exp(Fv3) - sqrt(ZZ2R) * ZZ2R >= 3"])
def test_optimum_is_that_of_general_solver(problem, formula):
    """Sequential quadratic programming of scipy, from the free estimate; and the estimate says what holds it."""
    found = held(problem, "pc-wls", CurvedConstraint(formula), inertia=0, signs=False)
    names = list(found.estimate.names)
    triangle = combine(problem.pooled, found.std)
    norms, size = np.linalg.norm(triangle[:-1, :-1], axis=0), np.linalg.norm(triangle[:-1, -1])
    R, z = triangle[:-1, :-1] / norms, triangle[:-1, -1] / size
    text = formula.replace("ZZ2R", "ZZ2")
    more, less = text.split("<=")[::-1] if "<=" in text else text.split(">=")

    def h(x: np.ndarray) -> float:
        values = dict(zip(names, x * size / norms))
        return eval(f"({more}) - ({less})", {"exp": np.exp, "sqrt": np.sqrt}, values)

    best = minimize(
        lambda x: 0.5 * np.sum((R @ x - z) ** 2), np.linalg.solve(R, z), jac=lambda x: R.T @ (R @ x - z),
        constraints={"type": "ineq", "fun": h}, method="SLSQP", options={"ftol": 1e-15, "maxiter": 500},
    )  # fmt: skip
    ours = found.estimate.values * norms / size
    assert abs(h(ours)) < 1e-7 and np.abs(ours - best.x).max() < 1e-4 * np.abs(ours).max()
    assert 0.5 * np.sum((R @ ours - z) ** 2) <= best.fun * (1.0 + 1e-9)
    assert [one.code for one in found.held.findings] == ["on-its-bound"] and found.held.binding[0].name == formula


@pytest.mark.parametrize("name", ["pc-ols", "pc-wls", pytest.param("pc-irls", marks=pytest.mark.slow)])
def test_function_equals_its_formula(problem, name):
    """A function with its derivatives is its formula."""
    stated = held(problem, name, CurvedConstraint(circle, slope))
    formula = held(problem, name, CurvedConstraint(CIRCLE))
    assert np.allclose(stated.estimate.values, formula.estimate.values, rtol=1e-6, atol=1e-9)
    assert np.allclose(stated.estimate.covariance, formula.estimate.covariance, rtol=1e-5, atol=1e-15)
    rubbing = [stated.estimate.values[stated.estimate.names.index(one)] for one in ("Fv1", "Fv2")]
    assert circle(*rubbing) == pytest.approx(0.0, abs=1e-9)
    spread = np.array(slope(*rubbing))  # what the plane holds has no spread
    places = [stated.estimate.names.index(one) for one in ("Fv1", "Fv2")]
    assert spread @ stated.estimate.covariance[np.ix_(places, places)] @ spread < 1e-12


def test_idle_function_changes_nothing(problem):
    """A function that does not bind changes nothing."""
    found, free = held(problem, "pc-wls", CurvedConstraint("Fv1 * Fv2 >= 1")), held(problem)
    assert np.allclose(found.estimate.values, free.estimate.values, rtol=1e-9)
    assert not found.held.binding and "Fv1 * Fv2 >= 1" in found.held.names


def test_curved_holds_beside_others(problem):
    """A curved constraint holds beside bodies, bounds and another one."""
    curved = (CurvedConstraint(CIRCLE), CurvedConstraint("ZZ2R * ZZ3 >= 0.2"))
    found = held(problem, "pc-wls", *curved, bounds={"Fv3": (0.9, np.inf)}, bodies=True)
    value = dict(zip(found.estimate.names, found.estimate.values))
    assert value["Fv1"] ** 2 + value["Fv2"] ** 2 == pytest.approx(4.0) and value["Fv3"] == pytest.approx(0.9)
    assert value["ZZ2"] * value["ZZ3"] > 0.2 - 1e-6
    assert {CIRCLE, "Fv3 >= 0.9"} <= {one.name for one in found.held.binding}


@pytest.mark.parametrize(
    ("curved", "words"),
    [
        (
            CurvedConstraint(circle, lambda a, b: (-2.0 * a, -b), "disc"),
            r"'disc': its derivative by Fv2 is stated as -1\.5.*differences of h give -3\.0.*correct 'slope'",
        ),
        (CurvedConstraint(circle, lambda a, b: (-2.0 * a,)), "returns 1 numbers, expected 2"),
        (CurvedConstraint(circle), "a function needs 'slope'"),
        (CurvedConstraint("Fv1", slope), "a formula has none"),
        (CurvedConstraint("log(-Fv1) >= 0"), "no finite value or derivative at Fv1 = 1.99"),
        (CurvedConstraint("9**9**9**9 * Fv1 >= 0"), "no finite value or derivative"),
        (CurvedConstraint("__import__('os').getcwd()"), "expected parameters' names, numbers"),
        (CurvedConstraint("Fv1.real >= 0"), "found 'Fv1.real'"),
        (CurvedConstraint("0 <= Fv1 <= 1"), "found '0 <= Fv1 <= 1'"),
        (CurvedConstraint("Fv1 >="), "is not a formula"),
        (CurvedConstraint("2 >= 1"), "contains no parameter"),
        (CurvedConstraint("Fz1**2 >= 1"), "'Fz1' is not a parameter of this model"),
        (CurvedConstraint("M2 * Fv1 >= 1"), "M2 has no effect"),
    ],
)
def test_what_is_no_constraint_is_refused(problem, curved, words):
    with pytest.raises(UsageError, match=words):
        held(problem, "pc-wls", curved)


@pytest.mark.parametrize("formulas", [("Fv1**2 <= -1",), ("Fv1 * Fv2 <= 1", "Fv1 * Fv2 >= 1.2")])
def test_unsatisfiable_constraints_fail(problem, formulas):
    """Constraints that no estimate satisfies are a failure that says so."""
    found = held(problem, "pc-wls", *(CurvedConstraint(one) for one in formulas))
    assert not found.found
    assert f"no estimate satisfies {formulas[0]}" in str(found.failure) and "h of '" in str(found.failure)


def test_the_options_file_says_them():
    text = f'method = "pc-wls"\nfriction = "standard"\nessential = "none"\n[[constraints.curved]]\nh = "{CIRCLE}"\n'
    found = identify(planted.arm(), [planted.case("a", 0)], parse_options(tomllib.loads(text)).settings)
    assert [one.name for one in found.fitted.held.binding] == [CIRCLE]
    with pytest.raises(UsageError, match="slope"):
        parse_options({"constraints": {"curved": [{"h": CIRCLE, "slope": "Fv1"}]}})
