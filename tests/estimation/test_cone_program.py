"""Cone programs, and what a solver that breaks down means: a lower accuracy, then an error that can be handled."""

import clarabel
import numpy as np
import pytest

from calib.errors import NotConverged
from calib.estimation.cone_program import ACCURACIES, minimise


class PanicException(BaseException):
    """What pyo3 raises for a panic of Rust."""


def optimum() -> np.ndarray:
    """Return the b nearest to (1, -2) with b >= 0 and [[b1, b2 + 1], [b2 + 1, b1]] ⪰ 0: (1, 0)."""
    matrix = np.zeros((1, 2, 2, 2))
    matrix[0, 0, 0] = matrix[0, 1, 1] = 1.0, 0.0
    matrix[0, 0, 1] = matrix[0, 1, 0] = 0.0, 1.0
    return minimise(np.eye(2), np.array([1.0, -2.0]), np.eye(2), np.zeros(2), matrix).values


def breaking(failures: int, error: type[BaseException]) -> type:
    """Return a solver that fails at its first so many accuracies."""
    accuracies = []

    class Solver:
        def __init__(self, *problem: object) -> None:
            accuracies.append(problem[-1].tol_feas)  # type: ignore[attr-defined]
            self.real = REAL(*problem)

        def solve(self) -> object:
            if len(accuracies) <= failures:
                raise error
            return self.real.solve()

    return Solver


REAL = clarabel.DefaultSolver


def test_rows_and_matrix_reach_the_optimum():
    """A program with rows and a matrix has its optimum."""
    np.testing.assert_allclose(optimum(), [1.0, 0.0], atol=1e-7)


def test_panic_lowers_the_accuracy(monkeypatch: pytest.MonkeyPatch) -> None:
    """After a panic the program is solved at a lower accuracy."""
    monkeypatch.setattr(clarabel, "DefaultSolver", breaking(1, PanicException))
    np.testing.assert_allclose(optimum(), [1.0, 0.0], atol=1e-6)


def test_panic_at_every_accuracy_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    """A panic at every accuracy is reported as no convergence."""
    monkeypatch.setattr(clarabel, "DefaultSolver", breaking(len(ACCURACIES), PanicException))
    with pytest.raises(NotConverged, match="eigenvalues do not converge"):
        optimum()


def test_ctrl_c_is_no_panic(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(clarabel, "DefaultSolver", breaking(1, KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        optimum()
