"""Constrained least squares: the optimum of cvxpy, proved by the result itself; least squares where nothing binds."""

import numpy as np
import pytest

from calib.errors import CalibError, NotConverged, Unidentifiable
from calib.estimation.cone_program import from_free
from calib.estimation.linear import ols
from calib.estimation.triangles import collect, combine
from calib.identification.closed_loop.instrumental_variables import instrument, projected
from calib.identification.methods.constrained import Definite, contradicting, restricted, within


def problem(seed: int, p: int = 8, count: int = 100):
    rng = np.random.default_rng(seed)
    matrix = rng.normal(size=(count, p)) * 10.0 ** rng.uniform(-3, 3, p)
    return matrix, matrix @ (rng.normal(size=p) / np.linalg.norm(matrix, axis=0)) * 10 + rng.normal(size=count), rng


@pytest.mark.parametrize("equal", [0, 2])
@pytest.mark.parametrize("seed", range(8))
def test_linear_constraints_reach_optimum(seed, equal):
    """Linear constraints give the optimum of cvxpy and prove it."""
    cvxpy = pytest.importorskip("cvxpy")
    matrix, target, rng = problem(seed)
    unit = np.linalg.norm(matrix, axis=0)
    rows = rng.normal(size=(10, 8)) * unit
    lower, upper = np.full(10, -np.inf), np.full(10, np.inf)
    lower[:7], upper[5:] = -0.1, 0.3
    lower[:equal] = upper[:equal] = [0.2, -0.1][:equal]
    found = within(combine(collect(matrix, target)), rows, lower, upper)
    b = cvxpy.Variable(8)  # columns of unit norm, for the solver's sake
    conditions = [(rows[equal:7] / unit) @ b >= -0.1, (rows[5:] / unit) @ b <= 0.3]
    conditions += [(rows[:equal] / unit) @ b == lower[:equal]] if equal else []
    cvxpy.Problem(cvxpy.Minimize(0.5 * cvxpy.sum_squares(target - (matrix / unit) @ b)), conditions).solve(
        solver="CLARABEL", tol_gap_abs=1e-12, tol_gap_rel=1e-12, tol_feas=1e-12
    )
    assert found.values * unit == pytest.approx(b.value, abs=1e-6 * np.abs(b.value).max())
    assert rows[:equal] @ found.values == pytest.approx(lower[:equal], rel=1e-9) and found.binding.any()
    slope = matrix.T @ (matrix @ found.values - target)
    assert found.normals.T @ found.multipliers == pytest.approx(slope, abs=1e-6 * np.abs(matrix.T @ target).max())
    assert found.multipliers[: 7 - equal] == pytest.approx(conditions[0].dual_value, abs=1e-4)


def test_the_result_proves_its_optimality():
    matrix, target, _ = problem(1)
    found = within(combine(collect(matrix, target)), np.eye(8), np.zeros(8), np.full(8, np.inf))
    slope = matrix.T @ (matrix @ found.values - target)
    assert slope == pytest.approx(found.multipliers, abs=1e-8 * np.abs(matrix.T @ target).max())
    assert found.multipliers.min() >= 0 and found.values.min() >= 0
    assert np.abs(found.multipliers * found.slack).max() < 1e-10 * np.abs(target @ target)
    assert np.all(found.binding == (found.slack < 1e-6 / np.linalg.norm(matrix, axis=0)))


def covariance(found, triangle):
    """Return the unscaled covariance with the constraints that bind as equalities."""
    upper = triangle[:-1, :-1]
    return restricted(np.linalg.inv(upper.T @ upper), triangle, found.normals[found.binding])


@pytest.mark.parametrize("bound", [1e9, np.inf])
def test_satisfied_constraints_leave_ols(bound):
    """Satisfied constraints leave least squares and its covariance."""
    matrix, target, _ = problem(2)
    data = collect(matrix, target)
    found, free = within(combine(data), np.eye(8), np.full(8, -bound), np.full(8, bound)), ols(data).estimate
    assert found.values == pytest.approx(free.values, rel=1e-6)
    assert covariance(found, combine(data)) * free.residual_std**2 == pytest.approx(free.covariance, rel=1e-6)
    assert not found.binding.any()


def test_binding_parameter_has_no_variance():
    """A binding parameter has no variance, and the others have that of the rest."""
    rng = np.random.default_rng(4)
    matrix = rng.normal(size=(200, 3))
    target = matrix @ [1.0, -2.0, 3.0] + rng.normal(size=200)
    found = within(combine(collect(matrix, target)), np.eye(3), np.zeros(3), np.full(3, np.inf))
    assert found.binding.tolist() == [False, True, False]
    rest = matrix[:, [0, 2]]
    spread = covariance(found, combine(collect(matrix, target)))
    assert spread[np.ix_([0, 2], [0, 2])] == pytest.approx(np.linalg.inv(rest.T @ rest), rel=1e-8)
    assert spread[1] == pytest.approx(np.zeros(3), abs=1e-12)


@pytest.mark.parametrize("seed", range(4))
def test_definite_matrix_reaches_the_optimum(seed):
    """[[b0, b1], [b1, b2]] ⪰ 0.01 with 2 b0 >= 1.5 beside it, by another solver."""
    cvxpy = pytest.importorskip("cvxpy")
    rng = np.random.default_rng(seed)
    matrix = rng.normal(size=(60, 3))
    target = matrix @ [1.0, 1.8, 1.0] + rng.normal(size=60)
    triangle = combine(collect(matrix, target))
    cone = np.array([[[1, 0, 0], [0, 1, 0]], [[0, 1, 0], [0, 0, 1]]], dtype=float)
    bound = np.array([[2.0, 0.0, 0.0]])
    found = within(triangle, bound, np.array([1.5]), np.array([np.inf]), Definite(cone[None], 0.01))
    b = cvxpy.Variable(3)
    conditions = [cvxpy.bmat([[b[0] - 0.01, b[1]], [b[1], b[2] - 0.01]]) >> 0, 2.0 * b[0] >= 1.5]
    cvxpy.Problem(cvxpy.Minimize(cvxpy.sum_squares(target - matrix @ b)), conditions).solve(solver="SCS", eps=1e-9)
    assert found.values == pytest.approx(b.value, abs=1e-5)
    assert found.binding[1] and found.slack[1] == pytest.approx(0.0, abs=1e-6)
    slope = matrix.T @ (matrix @ found.values - target)
    assert found.normals.T @ found.multipliers == pytest.approx(slope, abs=1e-5 * np.abs(matrix.T @ target).max())
    assert found.normals[found.binding] @ covariance(found, triangle) == pytest.approx(0.0, abs=1e-12)


def test_many_matrices_reach_the_optimum():
    """Twin eigenvalues on the bound and matrices that follow one another closely do not stop it; any start will do."""
    rng = np.random.default_rng(1)
    p, n, count = 12, 4, 400
    matrix = rng.normal(size=(80, p))
    triangle = combine(collect(matrix, matrix @ rng.normal(size=p) + rng.normal(size=80)))
    ends = rng.normal(size=(2, n, n, p - 1))
    ends = ends + ends.transpose(0, 2, 1, 3)
    between = np.linspace(0.0, 1.0, count)[:, None, None, None]
    bodies = np.concatenate([(1 - between) * ends[0] + between * ends[1], np.zeros((count, n, n, 1))], axis=3)
    bodies[..., -1] = np.eye(n)
    nothing = np.zeros((0, p)), np.zeros(0), np.zeros(0)
    found = within(triangle, *nothing, Definite(bodies, 0.5))
    again = within(triangle, *nothing, Definite(bodies, 0.5, np.arange(0, count, 37)))
    assert np.linalg.eigvalsh(bodies @ found.values).min() > 0.5 * (1.0 - 2e-3)
    slope = triangle[:p, :p].T @ (triangle[:p, :p] @ found.values - triangle[:p, p])
    assert found.normals.T @ found.multipliers == pytest.approx(slope, abs=1e-6 * np.abs(matrix.T).sum(axis=1).max())
    assert found.multipliers.min() >= 0.0 and 0 < found.binding.sum() < 20
    assert again.values == pytest.approx(found.values, abs=1e-3 * np.abs(found.values).max())


def test_never_definite_matrices_are_refused():
    """Matrices that no point makes definite are refused."""
    matrix, target, _ = problem(5, p=3)
    cone = np.array([[[1, 0, 0], [0, 1, 0]], [[0, 1, 0], [0, 0, 1]]], dtype=float)
    with pytest.raises(NotConverged, match="Infeasible"):
        within(
            combine(collect(matrix, target)), np.eye(3)[:1], np.array([-np.inf]), np.array([-1.0]),
            Definite(cone[None], 0.01),
        )  # fmt: skip


def test_clashing_constraints_are_refused():
    """Contradicting constraints and crossed bounds are refused."""
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


def from_free_holding(moments: np.ndarray, free: np.ndarray, fixed: np.ndarray, held: np.ndarray) -> np.ndarray:
    """Return the estimate with some parameters held at d, from the free one: b_U + M_UU⁻¹ M_UC (b_C - d).

    M = WᵀW for least squares and Wᵀ P_Z W for two-stage least squares: the optimum under those constraints. M = ZᵀW,
    as on Janot's slides, solves Z_Uᵀ (y - W b) = 0 instead, with the held columns' instruments left out: as consistent,
    and not the optimum of ½ ‖P_Z ε‖².

    Args:
        moments: M (p, p).
        free: (p,) b.
        fixed: (p,) bool, C.
        held: d, one per held parameter.
    """
    result = np.array(free, dtype=float)
    result[fixed] = held
    left = moments[np.ix_(~fixed, ~fixed)]
    result[~fixed] += np.linalg.solve(left, moments[np.ix_(~fixed, fixed)] @ (free[fixed] - held))
    return result


@pytest.mark.parametrize("seed", range(4))
def test_gourieroux_monfort_meets_the_solver(seed):
    """With the constraints that bind as equalities, in the general form; with held parameters, in the partition's."""
    matrix, target, _ = problem(seed)
    triangle, free = combine(collect(matrix, target)), np.linalg.lstsq(matrix, target)[0]
    found = within(triangle, np.eye(8), np.zeros(8), np.full(8, np.inf))
    normals = found.normals[found.binding]
    assert from_free(triangle, free, normals, np.zeros(len(normals))) == pytest.approx(found.values, abs=1e-6)
    other = from_free_holding(matrix.T @ matrix, free, found.binding, np.zeros(int(found.binding.sum())))
    unit = np.linalg.norm(matrix, axis=0)
    assert other * unit == pytest.approx(found.values * unit, abs=1e-6 * np.linalg.norm(target))


def test_slides_relation_is_not_the_optimum():
    """The slides' relation for instruments is not the optimum of two-stage least squares."""
    rng = np.random.default_rng(0)
    instruments = rng.normal(size=(400, 3))
    matrix = instruments + 0.5 * rng.normal(size=(400, 3)) @ rng.normal(size=(3, 3))
    target = matrix @ [1.0, -0.5, 2.0] + rng.normal(size=400)
    found = instrument(instruments, matrix, target)
    triangle, cross = projected(found), instruments.T @ matrix
    free = np.linalg.solve(cross, instruments.T @ target)
    solved = within(triangle, np.eye(3), np.zeros(3), np.full(3, np.inf))
    assert solved.binding.tolist() == [False, True, False]
    moments = triangle[:3, :3].T @ triangle[:3, :3]
    assert from_free_holding(moments, free, solved.binding, np.zeros(1)) == pytest.approx(solved.values, abs=1e-7)
    slides = from_free_holding(cross, free, solved.binding, np.zeros(1))
    rest = instruments[:, [0, 2]]
    assert rest.T @ (target - matrix @ slides) == pytest.approx(np.zeros(2), abs=1e-9)
    assert np.abs(slides - solved.values).max() > 1e-4


@pytest.mark.slow
def test_restricted_covariance_over_noises():
    """The restricted covariance is that of estimates over many noises."""
    rng = np.random.default_rng(3)
    matrix, normals = rng.normal(size=(60, 4)), np.array([[1.0, -1.0, 0.0, 0.0]])
    triangles = [combine(collect(matrix, matrix @ np.ones(4) + rng.normal(size=60))) for _ in range(3000)]
    free = [np.linalg.solve(one[:4, :4], one[:4, 4]) for one in triangles]
    drawn = np.array([from_free(one, b, normals, np.zeros(1)) for one, b in zip(triangles, free)])
    covariance = restricted(np.linalg.inv(matrix.T @ matrix), triangles[0], normals)
    assert np.cov(drawn.T) == pytest.approx(covariance, abs=0.1 * covariance.max())
    assert normals @ covariance == pytest.approx(np.zeros((1, 4)), abs=1e-15)


def test_degenerate_equalities_are_refused():
    """Equalities that contradict or determine everything are refused."""
    matrix, target, _ = problem(5)
    triangle = combine(collect(matrix, target))
    twice, values = np.vstack([np.eye(8)[:1], 2.0 * np.eye(8)[:1]]), np.array([1.0, 3.0])
    with pytest.raises(CalibError, match="contradict"):
        within(triangle, twice, values, values)
    with pytest.raises(CalibError, match="so that none is estimated"):
        within(triangle, np.eye(8), np.ones(8), np.ones(8))
    found = within(triangle, twice, np.array([1.0, 2.0]), np.array([1.0, 2.0]))
    assert found.values[0] == pytest.approx(1.0)
    assert contradicting(twice, np.array([1.0, 3.0]), np.array([np.inf, np.inf])) == ()
    assert contradicting(twice, np.array([2.0, -np.inf]), np.array([np.inf, 3.0])) == (0, 1)
