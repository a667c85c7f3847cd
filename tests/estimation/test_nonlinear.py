"""Levenberg-Marquardt against SciPy's optimum on textbook problems; every way it can end."""

from collections.abc import Callable

import numpy as np
import pytest
import scipy.optimize
from differences import check

from calib.estimation.nonlinear import Reduced, Status, covariance, damped_step, reduced, solve, triangle

Problem = tuple[Callable[[np.ndarray], np.ndarray], Callable[[np.ndarray], np.ndarray], np.ndarray]


def rosenbrock() -> Problem:
    return (
        lambda x: np.array([10.0 * (x[1] - x[0] ** 2), 1.0 - x[0]]),
        lambda x: np.array([[-20.0 * x[0], 10.0], [-1.0, 0.0]]),
        np.array([-1.2, 1.0]),
    )


def decay() -> Problem:
    """Two exponentials with noise; a small residual remains."""
    t = np.linspace(0.0, 4.0, 40)
    noise = 0.02 * np.random.default_rng(0).normal(size=40)
    y = 2.0 * np.exp(-1.5 * t) + np.exp(-0.3 * t) + noise

    def residual(x):
        return x[0] * np.exp(-x[1] * t) + x[2] * np.exp(-x[3] * t) - y

    def jacobian(x):
        one, two = np.exp(-x[1] * t), np.exp(-x[3] * t)
        return np.column_stack([one, -x[0] * t * one, two, -x[2] * t * two])

    return residual, jacobian, np.array([1.0, 3.0, 0.5, 0.1])


def brown_dennis() -> Problem:
    """Moré, Garbow & Hillstrom (1981), problem 16: a large residual remains (85822.2)."""
    t = np.arange(1, 21) / 5.0

    def residual(x):
        return (x[0] + t * x[1] - np.exp(t)) ** 2 + (x[2] + x[3] * np.sin(t) - np.cos(t)) ** 2

    def jacobian(x):
        one, two = 2.0 * (x[0] + t * x[1] - np.exp(t)), 2.0 * (x[2] + x[3] * np.sin(t) - np.cos(t))
        return np.column_stack([one, one * t, two, two * np.sin(t)])

    return residual, jacobian, np.array([25.0, 5.0, -5.0, -1.0])


def kowalik_osborne() -> Problem:
    """Problem 15 of the same collection: 3.07505e-4."""
    y = np.array([0.1957, 0.1947, 0.1735, 0.16, 0.0844, 0.0627, 0.0456, 0.0342, 0.0323, 0.0235, 0.0246])
    u = np.array([4.0, 2.0, 1.0, 0.5, 0.25, 0.167, 0.125, 0.1, 0.0833, 0.0714, 0.0625])

    def residual(x):
        return x[0] * (u**2 + u * x[1]) / (u**2 + u * x[2] + x[3]) - y

    def jacobian(x):
        above, below = u**2 + u * x[1], u**2 + u * x[2] + x[3]
        slope = -x[0] * above / below**2
        return np.column_stack([above / below, x[0] * u / below, slope * u, slope])

    return residual, jacobian, np.array([0.25, 0.39, 0.415, 0.39])


PROBLEMS = {f.__name__: f for f in (rosenbrock, decay, kowalik_osborne)}
KNOWN = {"rosenbrock": 0.0, "kowalik_osborne": 3.07505e-4}


def stated(problem: Problem) -> Callable[[np.ndarray], Reduced]:
    """Return the problem as `solve` wants it: r = 0 - f and W = df/dx, reduced."""
    return lambda x: triangle(-problem[0](x), problem[1](x))


def add(x: np.ndarray, dx: np.ndarray) -> np.ndarray:
    return x + dx


@pytest.mark.parametrize("name", PROBLEMS)
def test_the_problems_derivatives(name):
    residual, jacobian, start = PROBLEMS[name]()
    check(residual, jacobian, start + 0.01)


@pytest.mark.parametrize("name", PROBLEMS)
def test_the_optimum_is_scipys(name):
    problem = PROBLEMS[name]()
    reference = scipy.optimize.least_squares(problem[0], problem[2], problem[1], xtol=1e-15, ftol=1e-15, gtol=1e-15)
    found = solve(stated(problem), add, problem[2], tolerance=1e-6)
    assert found.status is Status.CONVERGED and found.status.good
    assert found.cost == pytest.approx(2.0 * reference.cost, rel=1e-9, abs=1e-18)
    assert found.state == pytest.approx(reference.x, rel=1e-4, abs=1e-8)
    if name in KNOWN:
        assert found.cost == pytest.approx(KNOWN[name], rel=1e-5, abs=1e-18)
    gradient = problem[1](found.state).T @ problem[0](found.state)
    assert np.linalg.norm(gradient) <= 1e-5 * np.linalg.norm(problem[1](problem[2]).T @ problem[0](problem[2]))


@pytest.mark.parametrize("name", PROBLEMS)
def test_no_accepted_step_is_worse(name):
    problem = PROBLEMS[name]()
    found = solve(stated(problem), add, problem[2])
    assert np.all(np.diff(found.history) < 0)
    assert found.history[-1] ** 2 == pytest.approx(found.cost)
    assert len(found.history) <= found.iterations


def test_no_damping_is_linear_least_squares():
    """Damping zero is iterative linear least squares."""
    problem = decay()
    x = problem[2]
    for count in range(1, 5):
        found = solve(stated(problem), add, problem[2], damping=0.0, limit=count, tolerance=0.0)
        assert found.state == pytest.approx(x, rel=1e-9)
        x = x + np.linalg.lstsq(problem[1](x), -problem[0](x), rcond=None)[0]


def test_damping_alone_refuses_worse_steps():
    """Damping zero takes worse steps, and Levenberg-Marquardt does not."""
    problem = rosenbrock()
    plain = solve(stated(problem), add, problem[2], damping=0.0)
    assert plain.status.good and np.diff(plain.history).max() > 0  # from (-1.2, 1) the first full step goes uphill


def test_a_damped_step_solves_equation_12():
    rng = np.random.default_rng(0)
    matrix, residual = rng.normal(size=(30, 5)), rng.normal(size=30)
    found = triangle(residual, matrix)
    factor, target, cost = found.factor, found.target, found.cost
    assert cost == pytest.approx(residual @ residual)
    assert factor.T @ factor == pytest.approx(matrix.T @ matrix)
    square = matrix.T @ matrix
    for damping in (0.0, 1e-3, 1.0, 1e4):
        step = np.linalg.solve(square + damping * np.diag(np.diag(square)), matrix.T @ residual)
        assert damped_step(factor, target, damping) == pytest.approx(step, rel=1e-9)


def test_the_iteration_limit_is_said():
    problem = rosenbrock()
    found = solve(stated(problem), add, problem[2], limit=3)
    assert found.status is Status.ITERATIONS and not found.status.good
    assert found.iterations == 3


def test_crawling_damping_is_no_convergence():
    """Eq. 12 scales by the present diag(WᵀW); where the residual stays large it crawls (Moré's maximum cures it).

    The point of this test is the verdict: far from the optimum (85822.2) the status is not ``converged``.
    """
    problem = brown_dennis()
    check(problem[0], problem[1], problem[2])
    found = solve(stated(problem), add, problem[2], limit=100)
    assert found.status.good == (found.cost < 1.001 * 85822.2)
    assert found.cost < np.sum(problem[0](problem[2]) ** 2)


def test_a_wrong_jacobian_stalls():
    problem = decay()
    found = solve(lambda x: triangle(-problem[0](x), -problem[1](x)), add, problem[2])
    assert found.status is Status.STALLED
    assert found.state == pytest.approx(problem[2])  # no uphill step was taken


def test_start_at_solution_converges_at_once():
    """A start at the solution converges at once."""
    problem = rosenbrock()
    found = solve(stated(problem), add, np.ones(2))
    assert found.status is Status.CONVERGED and found.iterations == 1


def test_unknowns_may_live_on_a_manifold():
    """Mean of rotations in a plane: the state is a unit vector, the step an angle."""
    rng = np.random.default_rng(1)
    angles = 3.0 + 0.2 * rng.normal(size=50)  # across the cut of atan2

    def linearise(u):
        gap = (angles - np.arctan2(u[1], u[0]) + np.pi) % (2 * np.pi) - np.pi
        return triangle(gap, np.ones((50, 1)))

    def turn(u, dx):
        c, s = np.cos(dx[0]), np.sin(dx[0])
        return np.array([c * u[0] - s * u[1], s * u[0] + c * u[1]])

    found = solve(linearise, turn, np.array([0.0, -1.0]), tolerance=1e-8)
    assert np.arctan2(found.state[1], found.state[0]) % (2 * np.pi) == pytest.approx(angles.mean(), abs=1e-7)


def test_covariance_is_inverse_information():
    """The covariance is the inverse information."""
    matrix = np.random.default_rng(2).normal(size=(40, 6))
    factor = triangle(np.zeros(40), matrix).factor
    assert covariance(factor, 4.0) == pytest.approx(4.0 * np.linalg.inv(matrix.T @ matrix))


@pytest.mark.parametrize("spread", [1.0, 1e-4, 1e-9])
def test_many_rows_are_reduced_in_pieces(spread):
    """Well-conditioned rows by WᵀW, others by QR: R and z solve the problem as QR of all rows does."""
    rng = np.random.default_rng(2)
    matrix, residual = rng.normal(size=(60_000, 6)), rng.normal(size=60_000)
    matrix[:, 5] = matrix[:, 4] + spread * matrix[:, 5]
    cuts = np.array_split(np.arange(60_000), 30)
    found, whole = reduced(lambda: ((residual[own], matrix[own]) for own in cuts)), triangle(residual, matrix)
    assert found.rows == 60_000 and found.cost == pytest.approx(whole.cost)
    for one, other in ((found.gram(), whole.gram()), (found.moved(TRUTH).gram(), whole.moved(TRUTH).gram())):
        assert one.square == pytest.approx(other.square) and one.cross == pytest.approx(other.cross, abs=1e-6)
        assert one.total == pytest.approx(other.total)
    steps = [damped_step(each.factor, each.target, 0.0) for each in (found, whole)]
    assert steps[0] == pytest.approx(steps[1], rel=1e-5)


TRUTH = np.arange(6.0)
