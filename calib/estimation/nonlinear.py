"""Nonlinear least squares on whitened residuals: Gauss–Newton and Levenberg–Marquardt, solved by QR.

Two functions define the problem, so that the unknowns may live on a manifold. ``linearise(state)`` returns the
residuals r = y - f(state) and W = ∂f/∂x, reduced to a triangle (`reduced`). ``retract(state, dx)`` returns the state
moved by dx. Robust losses are applied as row weights.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from enum import Enum
from typing import Generic, TypeVar

import numpy as np
import scipy.linalg
from scipy.linalg.lapack import dpotrf, dtpqrt, dtrcon, dtrtri  # type: ignore[attr-defined]

from calib.estimation.relevance import Gram, gram

# numbers of W held at once (our choice)
MOST_NUMBERS = 500_000
# condition number up to which R has relative errors of 1e-6 at most: κ² times rounding
MAX_CONDITION = 1e5
# columns of LAPACK's panels
PANEL = 32
# λ from which on no step is better
MAX_DAMPING = 1e10
# rms residual [standard deviations of a measurement] at which computed measurements are met
EXACT_RMS = 0.01

State = TypeVar("State")
# residual (m,) and W (m, p)
Rows = tuple[np.ndarray, np.ndarray]


class Status(Enum):
    """Reason why an iteration ended; the value of a member is its message with advice."""

    CONVERGED = "converged"
    STALLED = "stalled: no damping gives a better step; the residual is at its minimum, or the Jacobian is wrong"
    ITERATIONS = "stopped at the iteration limit; start closer (better nominal values, fewer free parameters)"

    @property
    def good(self) -> bool:
        return self is Status.CONVERGED


@dataclass(frozen=True, eq=False)
class Solution(Generic[State]):
    """Last state of an iteration, with its cost and convergence.

    Attributes:
        state: the estimate.
        factor: (p, p) upper triangular R of W at the estimate; ``inv(RᵀR)`` is the unscaled covariance.
        cost: ‖r‖² at the estimate.
        history: ‖r‖ at the start and after each accepted step.
        status: reason why the iteration ended.
        iterations: number of linearisations.
    """

    state: State
    factor: np.ndarray
    cost: float
    history: tuple[float, ...]
    status: Status
    iterations: int


@dataclass(frozen=True, eq=False)
class Reduced:
    """Least-squares problem min ‖r - W x‖² reduced by QR to min ‖z - R x‖², which has the same solution.

    Attributes:
        factor: R (p, p), upper triangular.
        target: z (p,).
        cost: ‖r‖² of the whole residual, not ‖z‖².
        rows: number of rows of W.
    """

    factor: np.ndarray
    target: np.ndarray
    cost: float
    rows: int

    def extended(self, residual: np.ndarray, matrix: np.ndarray) -> Reduced:
        """Return the problem extended by further residuals r (m,) and rows W (m, p).

        Args:
            residual: r (m,).
            matrix: W (m, p), derivatives of the model by the parameters.
        """
        stacked = triangle(np.concatenate([self.target, residual]), np.vstack([self.factor, matrix]))
        cost = self.cost + float(residual @ residual)
        return replace(stacked, cost=cost, rows=self.rows + len(residual))

    def moved(self, change: np.ndarray) -> Reduced:
        """Return the problem with the residual r + W dx instead of r, for `change` dx (p,) of the parameters.

        W are the rows of the problem, the derivatives of the model by the parameters.
        """
        target = self.target + self.factor @ change
        cost = self.cost + float(target @ target - self.target @ self.target)
        return replace(self, target=target, cost=cost)

    def gram(self) -> Gram:
        """Return the problem's sufficient statistics WᵀW, Wᵀr, rᵀr."""
        return replace(gram(self.target, self.factor), total=self.cost, rows=self.rows)


def triangle(residual: np.ndarray, matrix: np.ndarray) -> Reduced:
    """Return the problem min ‖r - W x‖² of r (rows,) and W (rows, p), reduced by one QR of [W r].

    Args:
        residual: r (rows,), whitened.
        matrix: W (rows, p); column-major order saves a copy.
    """
    p = matrix.shape[1]
    stacked = np.empty((len(residual), p + 1), order="F")
    stacked[:, :p] = matrix
    stacked[:, p] = residual
    factor = np.asarray(scipy.linalg.qr(stacked, mode="r", overwrite_a=True, check_finite=False)[0])
    return Reduced(np.triu(factor[:p, :p]), factor[:p, p], float(residual @ residual), len(residual))


def reduced(pieces: Callable[[], Iterable[Rows]], total: Gram | None = None) -> Reduced:
    """Return the reduced problem of many pieces of rows, with the memory of one piece.

    If W has at most `MOST_NUMBERS` entries, one QR is used. A larger W is reduced by Cholesky of WᵀW with columns
    scaled to unit norm, which takes a quarter of the time but squares the condition number. If the condition number
    exceeds `MAX_CONDITION`, QR is used piece by piece.

    Args:
        pieces: function that yields the problem in pieces (r, W), residuals (rows,) with their rows of W (rows, p);
            each call yields the same pieces.
        total: sufficient statistics WᵀW, Wᵀr, rᵀr of all rows, if they are already known; None: computed if needed.
    """
    if total is None:
        rows, total = _gathered(pieces())
        if total is None:
            residual = np.concatenate([residual for residual, _ in rows])
            return triangle(residual, _stacked([matrix for _, matrix in rows]))
    scale = np.sqrt(np.diag(total.square))
    scale[scale == 0.0] = 1.0
    factor, failed = dpotrf(total.square / np.outer(scale, scale), clean=True)
    if failed or dtrcon(factor)[0] * MAX_CONDITION < 1.0:
        return _by_qr(pieces())
    target = scipy.linalg.solve_triangular(factor.T, total.cross / scale, lower=True)
    return Reduced(factor * scale, target, total.total, total.rows)


def _gathered(pieces: Iterable[Rows]) -> tuple[list[Rows], Gram | None]:
    """Return the list of all pieces and None, or an empty list and the sufficient statistics for a large W.

    W is large if it has more than `MOST_NUMBERS` entries.

    Args:
        pieces: the problem in pieces (r, W), residuals (rows,) with their rows of W (rows, p).
    """
    rows = list[Rows]()
    total = None
    for residual, matrix in pieces:
        if total is not None:
            total = total + gram(residual, matrix)
            continue
        rows.append((residual, matrix))
        if sum(matrix.size for _, matrix in rows) > MOST_NUMBERS:
            statistics = [gram(residual, matrix) for residual, matrix in rows]
            total = sum(statistics[1:], statistics[0])
            rows = []
    return rows, total


def _by_qr(pieces: Iterable[Rows]) -> Reduced:
    problem = None
    for residual, matrix in pieces:
        if problem is None:
            problem = triangle(residual, matrix)
        else:
            problem = problem.extended(residual, matrix)
    assert problem is not None
    return problem


def _stacked(matrices: list[np.ndarray]) -> np.ndarray:
    """Return the matrices stacked vertically, in column-major order; a single matrix is returned unchanged."""
    if len(matrices) == 1:
        return matrices[0]
    return np.concatenate([matrix.T for matrix in matrices], axis=1).T


def damped_step(factor: np.ndarray, target: np.ndarray, damping: float) -> np.ndarray:
    """Return the step dx (p,) that solves [RᵀR + λ diag(RᵀR)] dx = Rᵀz, by QR of [R; sqrt(λ) D] with D² = diag(RᵀR).

    Kolyubin et al. (2019), eq. 12; λ = 0 is eq. 11.

    Args:
        factor: R (p, p), upper triangular factor of the rows W = ∂f/∂x.
        target: z (p,) = Qᵀr, the reduced residuals (`Reduced`).
        damping: λ >= 0.
    """
    p = len(target)
    stacked = np.zeros((p + 1, p + 1))
    stacked[:p, :p] = factor
    stacked[:p, p] = target
    if damping:
        diagonal = np.zeros((p + 1, p + 1))
        np.fill_diagonal(diagonal[:p, :p], np.sqrt(damping) * np.linalg.norm(factor, axis=0))
        # both are triangles
        stacked = dtpqrt(p + 1, min(PANEL, p + 1), stacked, diagonal)[0]
    return scipy.linalg.solve_triangular(stacked[:p, :p], stacked[:p, p])


def solve(
    linearise: Callable[[State], Reduced],
    retract: Callable[[State, np.ndarray], State],
    start: State,
    *,
    damping: float = 1e-8,
    tolerance: float = 1e-3,
    limit: int = 300,
) -> Solution[State]:
    """Return the state that minimises ‖y - f(state)‖², by Levenberg–Marquardt (Kolyubin et al. 2019, after eq. 12).

    After a step that reduces the cost, λ is divided by ten; another step is rejected, and λ is multiplied by ten.
    ``damping=0`` is the iterative linear least squares of eq. 11, which accepts every step.

    The iteration has converged (our choice) in any of three cases. The next Gauss–Newton step is shorter than
    ``tolerance`` standard deviations of the estimate: ‖z‖ <= tolerance · ‖r‖ / sqrt(dof), with z = Qᵀr. Or ‖r‖ has
    fallen to 1e-11 of its first value, which is rounding. Or no step reduces the cost any more, or the limit is
    reached, while the rms residual is below `EXACT_RMS` standard deviations; this happens with computed (noise-free)
    measurements, where poorly determined directions cannot be followed further.

    Args:
        linearise: function of a state that returns the whitened problem, reduced.
        retract: function of a state and a step dx (p,) that returns the next state.
        start: the first state.
        damping: first value of λ; 0 for eq. 11.
        tolerance: length of the last step in standard deviations of the estimate.
        limit: largest number of linearisations.
    """
    state = start
    problem = linearise(state)
    dof = max(problem.rows - len(problem.target), 1)
    rounding = 1e-22 * problem.cost
    history = [float(np.sqrt(problem.cost))]
    lam = damping
    count = 1
    status = None
    while status is None:
        short = problem.target @ problem.target <= tolerance**2 * problem.cost / dof
        if short or problem.cost <= rounding:
            status = Status.CONVERGED
        elif count >= limit or lam > MAX_DAMPING:
            exact = problem.cost <= EXACT_RMS**2 * problem.rows
            failure = Status.ITERATIONS if count >= limit else Status.STALLED
            status = Status.CONVERGED if exact else failure
        else:
            trial = retract(state, damped_step(problem.factor, problem.target, lam))
            trial_problem = linearise(trial)
            count += 1
            if trial_problem.cost < problem.cost or damping == 0.0:
                state = trial
                problem = trial_problem
                lam = lam / 10.0
                history.append(float(np.sqrt(problem.cost)))
            else:
                lam *= 10.0
    return Solution(state, problem.factor, problem.cost, tuple(history), status, count)


def covariance(factor: np.ndarray, variance: float = 1.0) -> np.ndarray:
    """Return the covariance variance · (RᵀR)⁻¹ (p, p) from an upper triangular R (p, p).

    Args:
        factor: R (p, p), the triangular factor of the whitened W.
        variance: variance of the whitened residuals.

    Raises:
        LinAlgError: if R has a zero on its diagonal.
    """
    inverse, failed = dtrtri(factor)
    if failed:
        raise np.linalg.LinAlgError(f"parameter {failed} of {len(factor)} is not determined")
    return variance * (inverse @ inverse.T)
