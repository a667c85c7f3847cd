"""Users' convex constraints: optima against an independent solver, σ of binding ones, and what is refused."""

from dataclasses import replace

import cvxpy as cp
import numpy as np
import pytest
from scipy.optimize import minimize

from calib.errors import UsageError
from calib.estimation.triangles import combine, retriangulate
from calib.identification.identify_options import IdentifySettings, read_options
from calib.identification.methods.constrained import restricted
from calib.identification.methods.constraint_settings import ConstraintSettings, CurvedConstraint
from calib.identification.methods.convex import user_constraints
from calib.identification.methods.curved import make_curved
from calib.identification.methods.parameter_constraints import Constraints
from calib.identification.registry import METHODS, under_constraints

NAMES = ("a", "b", "c", "d")


def row_of(weights) -> np.ndarray:
    return np.array([weights.get(name, 0.0) for name in NAMES])


def constraints_of(function, inertia=None) -> Constraints:
    convex = user_constraints(function, row_of)
    matrix = np.reshape([affine.row for affine in convex.rows], (-1, 4))
    lower = np.array([affine.lower for affine in convex.rows])
    upper = np.array([affine.upper for affine in convex.rows])
    names = tuple(affine.name for affine in convex.rows)
    if inertia is None:
        inertia = np.zeros((0, 1, 1, 4))
    return Constraints(names, matrix, lower, upper, inertia, sets=convex.sets)


def triangle_of(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    matrix = rng.normal(size=(60, 4)) * [1.0, 30.0, 0.2, 5.0]
    return retriangulate(np.column_stack([matrix, matrix @ [1.0, 0.05, -3.0, 0.4] + rng.normal(size=60)]))


def by_slsqp(triangle: np.ndarray, functions, equalities=(), start=(0.8, 0.01, -0.1, 0.0)) -> np.ndarray:
    """Return the optimum under functions >= 0 and equalities = 0, in units in which the parameters are of order one."""
    unit = np.array([1.0, 0.1, 3.0, 1.0])
    scaled = triangle[:-1, :-1] * unit, triangle[:-1, -1]

    def within(kind, functions):
        return [{"type": kind, "fun": lambda x, h=h: h(x * unit)} for h in functions]

    limits = [*within("ineq", functions), *within("eq", equalities)]
    options = {"ftol": 1e-13, "maxiter": 1000}

    def misfit(x):
        return 0.5 * np.sum((scaled[0] @ x - scaled[1]) ** 2)

    found = minimize(misfit, np.divide(start, unit), constraints=limits, method="SLSQP", options=options)
    # 8: it cannot step any further
    assert found.status in (0, 8) and min(h(found.x * unit) for h in functions) > -1e-7
    return found.x * unit


@pytest.mark.parametrize("seed", range(4))
def test_optimum_is_that_of_another_solver(seed):
    """Norm, absolute value, bound, equality and a semidefinite matrix, together and with a matrix M(β) definite."""
    triangle = triangle_of(seed)

    def wanted(beta):
        matrix = cp.bmat([[beta["a"], beta["d"]], [beta["d"], 0.1]])
        return [
            cp.norm(beta["a", "c"]) <= 1.4,
            cp.abs(beta["b", "d"]) <= [0.04, 5.0],
            beta["a"] >= 0.7,
            beta["d"] == 4 * beta["b"] + 0.1,
            matrix >> 0,
        ]

    others = (
        lambda x: 1.4 - np.hypot(x[0], x[2]),
        lambda x: 0.04 - x[1],
        lambda x: 0.04 + x[1],
        lambda x: x[0] - 0.7,
        lambda x: 0.1 * x[0] - x[3] ** 2,
    )
    expected = by_slsqp(triangle, others, (lambda x: x[3] - 4 * x[1] - 0.1,), (1.0, 0.0, -0.5, 0.1))
    unit = np.linalg.norm(triangle[:-1, :-1], axis=0)
    assert np.abs((constraints_of(wanted).solve(triangle).values - expected) * unit).max() < 1e-3

    inertia = np.zeros((1, 2, 2, 4))
    inertia[0, 0, 0], inertia[0, 1, 1, 0], inertia[0, 0, 1, 3], inertia[0, 1, 0, 3] = [0, 0, -1, 0], 1.0, 1.0, 1.0
    few = constraints_of(lambda beta: [cp.norm(beta["a", "c"]) <= 1.4], inertia)
    solution = few.touched(triangle).solve(triangle)
    expected = by_slsqp(triangle, others[:1])
    assert np.abs((solution.values - expected) * unit).max() < 1e-3


def test_norm_and_bodies_hold_together(problem):
    """Of bodies that can exist, under a norm: each of both holds, and the misfit is not below that of either alone."""
    free = METHODS["pc-wls"].estimate(problem).estimate
    pair = tuple(next(name for name in problem.base.names if name.startswith(prefix)) for prefix in ("MX2", "ZZ2"))
    places = [problem.base.names.index(name) for name in pair]
    limit = 0.5 * float(np.linalg.norm(free.values[places]))

    def wanted(beta):
        return [cp.norm(beta[pair]) <= limit]

    both = METHODS["pc-wls"].estimate(replace(problem, constraints=ConstraintSettings(bodies=True, convex=wanted)))
    assert np.linalg.norm(both.estimate.values[places]) == pytest.approx(limit, rel=1e-5)
    assert {"held-to-convex", "held-to-bodies"} <= {one.code for one in both.held.findings}
    triangle = combine(problem.pooled, both.std)

    def misfit(found):
        return np.linalg.norm(triangle @ np.append(found.estimate.values, -1.0))

    for settings in (ConstraintSettings(bodies=True), ConstraintSettings(convex=wanted, inertia=0)):
        single = METHODS["pc-wls"].estimate(replace(problem, constraints=settings))
        assert misfit(single) <= misfit(both) * (1 + 1e-9)


@pytest.mark.parametrize("name", ["ols", "wls", "pc-ols", "pc-wls"])
def test_binding_norm_counts_as_an_equality(problem, name):
    """Covariance P C Pᵀ with the normal of the norm at the optimum (Gouriéroux & Monfort), and it is told."""
    free_method = METHODS[name.removeprefix("pc-")]
    free = replace(free_method, takes_prior=False).estimate(problem)
    places = [free.estimate.names.index(each) for each in ("Fv1", "Fv2")]
    limit = 0.9 * float(np.linalg.norm(free.estimate.values[places]))
    settings = ConstraintSettings(convex=lambda beta: [cp.norm(beta["Fv1", "Fv2"]) <= limit])
    method, constraints = under_constraints(METHODS[name], settings)
    assert method.name == name
    found = method.estimate(replace(problem, constraints=constraints))
    values = found.estimate.values
    assert np.linalg.norm(values[places]) == pytest.approx(limit, rel=1e-6)
    normal = np.zeros((1, len(values)))
    normal[0, places] = values[places]
    weights = found.std if "wls" in name else None
    expected = restricted(free.estimate.covariance, combine(problem.pooled, weights), normal)
    ratio = np.diag(found.estimate.covariance) / np.maximum(np.diag(expected), 1e-300)
    assert np.allclose(ratio, ratio[0], rtol=1e-3) and (name != "wls" or ratio[0] == pytest.approx(1.0, rel=1e-3))
    assert [one.code for one in found.held.findings] == ["held-to-convex"]
    assert found.held.binding[0].multiplier > 0.0


def test_what_does_not_bind_changes_nothing(problem):
    free = METHODS["pc-wls"].estimate(problem)
    idle = ConstraintSettings(convex=lambda beta: [cp.norm(beta["Fv1", "Fv2"]) <= 1e3])
    found = METHODS["pc-wls"].estimate(replace(problem, constraints=idle))
    assert np.abs((found.estimate.values - free.estimate.values) / free.estimate.sigma).max() < 0.02
    assert found.held.findings == () and any("norm" in name for name in found.held.names)


@pytest.mark.parametrize(
    ("function", "words"),
    [
        (lambda beta: [cp.norm(beta["Fv1", "Fv2"]) >= 1.0], "constraint 1 .*is not convex by CVXPY's rules"),
        (
            lambda beta: [beta["Fv1"] >= 1.0, beta["Fv7"] >= 1.0],
            r"'Fv7' is not a parameter of this model \(did you mean",
        ),
        (lambda beta: [beta["XX1"] >= 1.0], "XX1 has no effect on the torques"),
        (lambda beta: [cp.norm(beta["Fv1", "Fv2"]) <= 1.0, beta["Fv1"] >= 2.0], "contradict each other"),
        (lambda beta: [beta["Fv1"] <= 1.0, beta["Fv1"] >= 2.0], "contradict each other: .*Fv1"),
        (lambda beta: [], "an empty list"),
        (lambda beta: None, "returned NoneType, expected a list"),
        (lambda beta: [True], "constraint 1: is bool, no CVXPY constraint"),
        (lambda beta: [cp.Variable() >= 1.0], "contains no parameter"),
        (lambda beta: [beta["Fv1"] >= cp.Variable(integer=True)], "integer"),
        (lambda beta: [beta["Fv1"] >= cp.Parameter()], "Parameter without value"),
        (lambda beta: [beta[3] >= 1.0], "expected names of parameters"),
        (lambda beta: [beta["Fv1"] >= 1 / 0], r"raised ZeroDivisionError: division by zero \(line \d+ of test_convex"),
    ],
)
def test_impossible_functions_are_refused(problem, function, words):
    with pytest.raises(UsageError, match=words):
        METHODS["pc-wls"].estimate(replace(problem, constraints=ConstraintSettings(convex=function)))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (None, "no such file"),
        ("def constraint(beta): return []", r"no function constraints\(beta\) \(did you mean 'constraint'"),
        ("import no_such_package", "ModuleNotFoundError"),
        ("x = 1\n1 / 0", r"ZeroDivisionError: division by zero \(line 2 of limits.py\)"),
        ("def constraints(beta) return", "SyntaxError"),
    ],
)
def test_a_file_that_fails_is_named(tmp_path, text, words):
    """When the options are read, before any recording is."""
    if text is not None:
        (tmp_path / "limits.py").write_text(text)
    (tmp_path / "options.toml").write_text('[constraints]\nfile = "limits.py"')
    with pytest.raises(UsageError, match=words):
        read_options(tmp_path / "options.toml")


def test_function_and_file_state_the_same(tmp_path, problem):
    text = 'import cvxpy as cp\n\ndef constraints(beta):\n    return [cp.norm(beta["Fv1", "Fv2"]) <= 0.5]\n'
    (tmp_path / "limits.py").write_text(text)
    (tmp_path / "options.toml").write_text('method = "pc-wls"\n[constraints]\nfile = "limits.py"')
    by_file = read_options(tmp_path / "options.toml").settings.constraints
    by_function = IdentifySettings(constraints=lambda beta: [cp.norm(beta["Fv1", "Fv2"]) <= 0.5]).constraints
    first, second = (METHODS["pc-wls"].estimate(replace(problem, constraints=each)) for each in (by_file, by_function))
    assert np.allclose(first.estimate.values, second.estimate.values, rtol=1e-12)
    with pytest.raises(UsageError, match="expected a table"):
        IdentifySettings(constraints=3)


def test_curved_and_convex_hold_together():
    """h >= 0, which is not convex, beside a norm."""
    triangle = triangle_of(0)
    curved = make_curved(CurvedConstraint("a * a + d * d >= 1.69"), row_of)
    constraints = replace(constraints_of(lambda beta: [cp.norm(beta["a", "c"]) <= 1.4]), curved=(curved,))
    functions = (lambda x: 1.4 - np.hypot(x[0], x[2]), lambda x: x[0] ** 2 + x[3] ** 2 - 1.69)
    values = constraints.solve(triangle).values
    assert min(h(values) for h in functions) > -1e-6
    expected = by_slsqp(triangle, functions, start=values)
    assert np.abs((values - expected) * np.linalg.norm(triangle[:-1, :-1], axis=0)).max() < 1e-2
