"""Nonlinear least squares on whitened residuals: Gauss–Newton and Levenberg–Marquardt, solved by QR.

The problem is stated by two functions, so that the unknowns may live on a manifold: ``linearise(state) -> (r, W)`` with
r = y - f(state) and W = ∂f/∂x, and ``retract(state, dx) -> state``. Robust losses enter as weights in ``linearise``.
"""

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import Generic, TypeVar

import numpy as np
import scipy.linalg

State = TypeVar("State")


class Status(Enum):
    """Reason for the end of an iteration, with advice."""

    CONVERGED = "converged"
    STALLED = "stalled: no damping gives a better step; the model is at its smallest residual or the Jacobian is wrong"
    ITERATIONS = "stopped at the iteration limit; start closer (better nominal values, fewer free parameters)"

    @property
    def good(self) -> bool:
        return self is Status.CONVERGED


@dataclass(frozen=True, eq=False)
class Solution(Generic[State]):
    """The last state of an iteration.

    Attributes:
        state: the estimate.
        factor: (p, p) upper triangular R of W at the solution, ``inv(RᵀR)`` being the unscaled covariance.
        cost: ‖r‖² at the solution.
        history: ‖r‖ after each accepted step, the start first.
        status: a `Status`.
        iterations: linearisations made.
    """

    state: State
    factor: np.ndarray
    cost: float
    history: tuple[float, ...]
    status: Status
    iterations: int


def triangle(residual: np.ndarray, matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Return R (p, p), z (p,) and ‖r‖² that reduce min ‖r - W x‖ to min ‖z - R x‖, by one QR of [W r].

    `matrix` is best column-major: LAPACK then works in a single copy.
    """
    p = matrix.shape[1]
    stacked = np.empty((len(residual), p + 1), order="F")
    stacked[:, :p] = matrix
    stacked[:, p] = residual
    factor = np.asarray(scipy.linalg.qr(stacked, mode="r", overwrite_a=True, check_finite=False)[0])
    return np.triu(factor[:p, :p]), factor[:p, p], float(residual @ residual)


def damped_step(factor: np.ndarray, target: np.ndarray, damping: float) -> np.ndarray:
    """Solve [WᵀW + λ diag(WᵀW)] dx = Wᵀ r by QR of [R; sqrt(λ) D] (Kolyubin et al. 2019, eq. 12; λ = 0 is eq. 11)."""
    if damping == 0.0:
        return scipy.linalg.solve_triangular(factor, target)
    p = factor.shape[1]
    tail = np.sqrt(damping) * np.diag(np.linalg.norm(factor, axis=0))
    upper, moved, _ = triangle(np.append(target, np.zeros(p)), np.vstack([factor, tail]))
    return scipy.linalg.solve_triangular(upper, moved)


def solve(
    linearise: Callable[[State], tuple[np.ndarray, np.ndarray]],
    retract: Callable[[State, np.ndarray], State],
    start: State,
    *,
    damping: float = 1e-8,
    tolerance: float = 1e-3,
    limit: int = 300,
) -> Solution[State]:
    """Return the state that minimises ‖y - f(state)‖², by Levenberg–Marquardt with the paper's damping rule.

    A better step divides λ by ten, a worse one is rejected and multiplies it by ten (Kolyubin et al. 2019, after
    eq. 12). ``damping=0`` is the iterative linear least squares of eq. 11: every step is taken.

    Converged (our choice): the next Gauss–Newton step is shorter than ``tolerance`` standard deviations of the
    estimate, ‖Qᵀr‖ <= tolerance · ‖r‖ / sqrt(dof); or ‖r‖ has fallen to rounding, 1e-11 of where it started; or no step
    is better any more, and what is left is `exact_cost` standard deviations of a measurement rms, as of computed ones.

    Args:
        linearise: state -> residual (rows,) and W (rows, p), whitened.
        retract: state, dx (p,) -> state.
        start: the first state.
        damping: first λ; 0 for eq. 11.
        tolerance: length of the last step in standard deviations.
        limit: linearisations at most.
    """
    residual, matrix = linearise(start)
    dof = max(matrix.shape[0] - matrix.shape[1], 1)
    factor, target, cost = triangle(residual, matrix)
    state, lam, count, history, floor = start, damping, 1, [float(np.sqrt(cost))], 1e-22 * cost
    status = None
    exact_cost = 0.01
    while status is None:
        if target @ target <= tolerance**2 * cost / dof or cost <= floor:
            status = Status.CONVERGED
        elif count >= limit:
            status = Status.ITERATIONS
        elif lam > 1e10:
            status = Status.CONVERGED if cost <= exact_cost**2 * matrix.shape[0] else Status.STALLED
        else:
            trial = retract(state, damped_step(factor, target, lam))
            reduced = triangle(*linearise(trial))
            count += 1
            if reduced[2] < cost or damping == 0.0:
                state, (factor, target, cost), lam = trial, reduced, lam / 10.0
                history.append(float(np.sqrt(cost)))
            else:
                lam *= 10.0
    return Solution(state, factor, cost, tuple(history), status, count)


def covariance(factor: np.ndarray, variance: float = 1.0) -> np.ndarray:
    """Return variance · (RᵀR)⁻¹ (p, p)."""
    inverse = scipy.linalg.solve_triangular(factor, np.eye(len(factor)))
    return variance * inverse @ inverse.T
