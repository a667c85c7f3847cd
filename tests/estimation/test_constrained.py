"""Constrained least squares: the optimum of cvxpy, proved by the result itself; least squares where nothing binds."""

from __future__ import annotations

import numpy as np
import pytest

from calib.errors import CalibError, NotConverged, Unidentifiable
from calib.estimation.constrained import minimise, within
from calib.estimation.linear import ols
from calib.estimation.triangles import collect, combine


def problem(seed: int, p: int = 8, count: int = 100):
    rng = np.random.default_rng(seed)
    matrix = rng.normal(size=(count, p)) * 10.0 ** rng.uniform(-3, 3, p)
    return matrix, matrix @ (rng.normal(size=p) / np.linalg.norm(matrix, axis=0)) * 10 + rng.normal(size=count), rng


@pytest.mark.parametrize("seed", range(8))
def test_linear_inequalities_give_the_optimum_of_cvxpy(seed):
    cvxpy = pytest.importorskip("cvxpy")
    matrix, target, rng = problem(seed)
    unit = np.linalg.norm(matrix, axis=0)
    rows = rng.normal(size=(10, 8)) * unit
    lower, upper = np.full(10, -np.inf), np.full(10, np.inf)
    lower[:7], upper[5:] = -0.1, 0.3
    found = within(combine(collect(matrix, target)), rows, lower, upper)
    b = cvxpy.Variable(8)  # columns of unit norm, for the solver's sake
    conditions = [(rows[:7] / unit) @ b >= -0.1, (rows[5:] / unit) @ b <= 0.3]
    cvxpy.Problem(cvxpy.Minimize(cvxpy.sum_squares(target - (matrix / unit) @ b)), conditions).solve(
        solver="CLARABEL", tol_gap_abs=1e-12, tol_gap_rel=1e-12, tol_feas=1e-12
    )
    assert found.values * unit == pytest.approx(b.value, abs=1e-6 * np.abs(b.value).max())
    assert found.binding.any()
    assert found.iterations < 40


def test_the_result_proves_its_optimality():
    matrix, target, _ = problem(1)
    found = within(combine(collect(matrix, target)), np.eye(8), np.zeros(8), np.full(8, np.inf))
    slope = matrix.T @ (matrix @ found.values - target)
    assert slope == pytest.approx(found.multipliers, abs=1e-8 * np.abs(matrix.T @ target).max())
    assert found.multipliers.min() >= 0 and found.values.min() >= 0
    assert found.stationarity < 1e-10 and found.gap < 1e-10
    assert np.all(found.binding == (found.slack < 1e-6 / np.linalg.norm(matrix, axis=0)))


def test_satisfied_constraints_leave_least_squares_and_its_covariance():
    matrix, target, _ = problem(2)
    data = collect(matrix, target)
    found, free = within(combine(data), np.eye(8), np.full(8, -1e9), np.full(8, 1e9)), ols(data).estimate
    assert found.values == pytest.approx(free.values, rel=1e-6)
    assert found.covariance * free.residual_std**2 == pytest.approx(free.covariance, rel=1e-6)
    assert not found.binding.any()


def test_no_constraint_at_all_is_least_squares():
    matrix, target, _ = problem(3)
    found = within(combine(collect(matrix, target)), np.eye(8), np.full(8, -np.inf), np.full(8, np.inf))
    assert found.values == pytest.approx(np.linalg.lstsq(matrix, target)[0], rel=1e-9)


def test_a_binding_parameter_has_no_variance_and_the_others_that_of_the_rest():
    rng = np.random.default_rng(4)
    matrix = rng.normal(size=(200, 3))
    target = matrix @ [1.0, -2.0, 3.0] + rng.normal(size=200)
    found = within(combine(collect(matrix, target)), np.eye(3), np.zeros(3), np.full(3, np.inf))
    assert found.binding.tolist() == [False, True, False]
    rest = matrix[:, [0, 2]]
    assert found.covariance[np.ix_([0, 2], [0, 2])] == pytest.approx(np.linalg.inv(rest.T @ rest), rel=1e-8)
    assert found.covariance[1] == pytest.approx(np.zeros(3), abs=1e-12)


@pytest.mark.parametrize("seed", range(4))
def test_a_positive_definite_matrix_as_a_curved_constraint_gives_the_optimum_of_cvxpy(seed):
    """[[b0, b1], [b1, b2]] >= 0 as b0 > 0, b2 > 0 and the geometric mean √(b0 b2) - |b1| smoothed away: b2 - b1²/b0."""
    cvxpy = pytest.importorskip("cvxpy")
    rng = np.random.default_rng(seed)
    matrix = rng.normal(size=(60, 3))
    target = matrix @ [1.0, 1.8, 1.0] + rng.normal(size=60)

    def h(b):
        return np.array([b[0] - 1e-3, b[2] - b[1] ** 2 / b[0]])

    def jacobian(b):
        return np.array([[1.0, 0.0, 0.0], [b[1] ** 2 / b[0] ** 2, -2 * b[1] / b[0], 1.0]])

    def curvature(b, mu):
        v = np.array([b[1] / b[0], -1.0, 0.0])
        return -2.0 * mu[1] / b[0] * np.outer(v, v)

    found = minimise(combine(collect(matrix, target)), h, jacobian, np.array([1.0, 0.0, 1.0]), curvature)
    b = cvxpy.Variable(3)
    cone = cvxpy.bmat([[b[0], b[1]], [b[1], b[2]]]) >> 0
    cvxpy.Problem(cvxpy.Minimize(cvxpy.sum_squares(target - matrix @ b)), [cone, b[0] >= 1e-3]).solve(solver="CLARABEL")
    assert found.values == pytest.approx(b.value, abs=1e-5)
    assert found.binding[1]


def test_contradicting_constraints_and_crossed_bounds_are_refused():
    matrix, target, _ = problem(5)
    triangle = combine(collect(matrix, target))
    apart = np.vstack([np.eye(8)[:1], -np.eye(8)[:1]])
    with pytest.raises(NotConverged, match="contradict"):
        within(triangle, apart, np.array([1.0, 1.0]), np.full(2, np.inf))
    with pytest.raises(CalibError, match="row 3"):
        within(triangle, np.eye(8), np.array([0, 0, 0, 5.0, 0, 0, 0, 0]), np.ones(8))
    with pytest.raises(CalibError, match="bounds: expected 8"):
        within(triangle, np.eye(8), np.zeros(3), np.ones(3))


def test_dependent_columns_are_refused():
    matrix, target, _ = problem(6)
    matrix[:, 1] = matrix[:, 0]
    with pytest.raises(Unidentifiable):
        within(combine(collect(matrix, target)), np.eye(8), np.zeros(8), np.ones(8))
