"""Deterministic local search over all m · n joint values at once, with exact gradients."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import nlopt
import numpy as np

from poses.indices import Index, merit
from poses.space import SearchSpace, constraint_gradient, is_feasible, product

LARGE = 300
"""Above so many variables constrained searches use MMA, because SLSQP solves a dense problem that large every step."""


@dataclass(frozen=True)
class Improved:
    """What a local search ends with.

    Attributes:
        q: (m, n) poses [rad or m]; never worse than the start, always feasible if the start was.
        merit: log O (−log cond; O1 without 1/√m).
        history: merits of the improving iterates, rising.
        evaluations: of the index, with its gradient.
        interrupted: True after Ctrl-C; q is then the best so far.
    """

    q: np.ndarray
    merit: float
    history: tuple[float, ...]
    evaluations: int
    interrupted: bool = False


def merit_of(
    space: SearchSpace, q: np.ndarray, index: Index, existing: np.ndarray | None = None
) -> tuple[float, np.ndarray]:
    """Return the merit log O of poses with those measured before, and its gradient with respect to q.

    ∂ log O/∂q_ik = Σ_rp G[i,r,p] ∂J[i,r,p]/∂q_ik with G = ∂ log O/∂W (see `poses.indices`).

    Args:
        space: gives the Jacobian and its derivative product.
        q: (m, n) poses [rad or m].
        index: "O1" ... "O5", "cond".
        existing: (k, rows, p) Jacobians (or stacked, (k rows, p)) that count but do not move.

    Returns:
        The merit and its gradient (m, n).
    """
    jacobians = np.asarray(space.jacobian(q), dtype=float)
    stacked = jacobians.reshape(-1, jacobians.shape[2])
    if existing is not None and len(existing):
        stacked = np.concatenate([stacked, existing.reshape(-1, jacobians.shape[2])])
    value, slope = merit(stacked, index)
    G = slope[: jacobians.shape[0] * jacobians.shape[1]].reshape(jacobians.shape)
    return value, product(space, q, G) if np.isfinite(value) else np.zeros_like(q)


def improved(
    space: SearchSpace,
    q: np.ndarray,
    index: Index = "O1",
    existing: np.ndarray | None = None,
    *,
    evaluations: int = 300,
    tolerance: float = 1e-6,
    report: Callable[[float], None] | None = None,
) -> Improved:
    """Improve a set of poses under limits and constraints, all joint values at once.

    Box limits only: L-BFGS (Nocedal 1980); with constraints: SLSQP (Kraft 1988), MMA (Svanberg 2002) above `LARGE`
    variables; all in NLopt. For O2, O3, O4 and cond the objective has kinks where singular values meet: the search may
    stop at one. The best *feasible* iterate is returned. A predicate without gradient cannot steer the search: poses
    that end where it says no go back to their start, and the others are searched again around them (our choice).

    Args:
        space: limits, constraints, Jacobian.
        q: (m, n) start [rad or m].
        index: what to improve.
        existing: (k, rows, p) Jacobians of poses already measured.
        evaluations: most evaluations of index and gradient in one search.
        tolerance: relative change of the merit to stop at.
        report: called with every improved merit.
    """
    start = np.clip(np.asarray(q, dtype=float), space.lower, space.upper)
    free = np.ones(len(start), dtype=bool)
    run = _search(space, start, index, existing, evaluations, tolerance, report)
    spent, history = run.evaluations, run.history
    for _ in range(3):
        found = start.copy()
        found[free] = run.q
        bad = free & ~is_feasible(space, found, 1e-6)
        if not bad.any() or run.interrupted:
            break
        found[bad], free = start[bad], free & ~bad
        if not free.any():
            break
        held = np.asarray(space.jacobian(found[~free]), dtype=float)
        held = held.reshape(-1, held.shape[2])
        fixed = held if existing is None else np.concatenate([held, existing.reshape(-1, held.shape[1])])
        run = _search(space, found[free], index, fixed, evaluations, tolerance, None)
        spent += run.evaluations
    else:
        found = start
    bad = ~is_feasible(space, found, 1e-6)
    found[bad] = start[bad]
    value, before = (merit_of(space, x, index, existing)[0] for x in (found, start))
    if value < before:
        found, value = start, before
    rising = tuple(h for h in history if h <= value)
    return Improved(found, value, rising, spent + 2, run.interrupted)


def _search(
    space: SearchSpace,
    start: np.ndarray,
    index: Index,
    existing: np.ndarray | None,
    evaluations: int,
    tolerance: float,
    report: Callable[[float], None] | None,
) -> Improved:
    """Run NLopt from one start and return the best iterate that keeps the constraints."""
    m, n = start.shape
    best: list = [start, -np.inf]
    history, count = list[float](), 0

    def objective(x: np.ndarray, slope: np.ndarray) -> float:
        nonlocal count
        count += 1
        q = np.array(x).reshape(m, n)
        value, gradient = merit_of(space, q, index, existing)
        if slope.size:
            slope[:] = gradient.ravel()
        if value > best[1] and all((np.asarray(c.function(q)) <= 1e-6).all() for c in space.constraints):
            best[:] = q, value
            history.append(value)
            if report:
                report(value)
        return value if np.isfinite(value) else -1e6

    algorithm = nlopt.LD_LBFGS
    if space.constraints:
        algorithm = nlopt.LD_SLSQP if m * n <= LARGE else nlopt.LD_MMA
    solver = nlopt.opt(algorithm, m * n)
    solver.set_max_objective(objective)
    solver.set_lower_bounds(np.tile(space.lower, m))
    solver.set_upper_bounds(np.tile(space.upper, m))
    for constraint in space.constraints:
        k = np.asarray(constraint.function(start)).shape[1]
        solver.add_inequality_mconstraint(_blocks(constraint, m, n), np.full(m * k, 1e-8))
    solver.set_ftol_rel(tolerance)
    solver.set_maxeval(evaluations)
    interrupted = False
    try:
        solver.optimize(start.ravel())
    except KeyboardInterrupt:
        interrupted = True
    except (nlopt.RoundoffLimited, nlopt.runtime_error):  # the line search ran out of digits: the best iterate stands
        pass
    return Improved(best[0], best[1], tuple(history), count, interrupted)


def _blocks(constraint, m: int, n: int) -> Callable[[np.ndarray, np.ndarray, np.ndarray], None]:
    """Return NLopt's form of a constraint: values (m k,) and the block-diagonal gradient (m k, m n)."""

    def function(result: np.ndarray, x: np.ndarray, slope: np.ndarray) -> None:
        q = np.array(x).reshape(m, n)
        values = np.asarray(constraint.function(q), dtype=float)
        result[:] = values.ravel()
        if slope.size:
            slope[:] = 0.0
            rows = slope.reshape(m, values.shape[1], m, n)
            rows[np.arange(m), :, np.arange(m), :] = constraint_gradient(constraint, q)

    return function
