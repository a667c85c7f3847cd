"""Multi-level single linkage over all joint values (NLopt's MLSL), then the local search from the best set.

MLSL (Rinnooy Kan & Timmer 1987; Sobol points as in Kucherenko & Sytsko 2005) starts a local search at a sampled point
only if no better point lies near, so that no optimum is searched twice. NLopt's MLSL handles bounds but no constraints:
a violated constraint is penalised quadratically. The best set is then corrected to satisfy the constraints. Poses that
still violate the constraints or the predicate are replaced by the corresponding poses of the start. MLSL may use half
of the evaluations and of the time, `calib.poses.continuous.local` the rest.
"""

import time
from contextlib import suppress
from dataclasses import replace

import numpy as np

from ..continuous.local import FEASIBLE, SHARPNESS, Improved, improved, merit_of, restored
from ..indices import Index
from ..space import SearchSpace, constraint_gradients, constraint_values, is_feasible

CHARGE = 100.0  # of the merit, per squared unit of a violated constraint (our choice)
POINTS = 4  # sampled between local searches (our choice)
LOCAL = 60  # most evaluations of a local search, by NLopt's CCSAQ (our choice)


def mlsl_search(
    space: SearchSpace,
    start: np.ndarray,
    index: Index = "O1",
    existing: np.ndarray | None = None,
    *,
    evaluations: int = 5000,
    seconds: float = np.inf,
) -> Improved:
    """Return a set of poses searched by MLSL, then by a local search from the best set of MLSL.

    Args:
        space: limits, constraints, predicate, Jacobian.
        start: (m, n) feasible poses, the first point of MLSL [rad or m]; MLSL takes its other points from a Sobol
            sequence.
        index: the observability index to improve.
        existing: (k, rows, p) Jacobians of poses already measured; None without such poses.
        evaluations: largest number of evaluations of the index, in MLSL and local search together.
        seconds: limit of processor time [s], for MLSL and local search together.
    """
    import nlopt

    began = time.process_time()
    spent = 0
    best = -np.inf
    best_q = start
    interrupted = False
    solver = nlopt.opt(nlopt.G_MLSL_LDS, start.size)
    local = nlopt.opt(nlopt.LD_CCSAQ, start.size)

    def charged(x: np.ndarray, slope: np.ndarray) -> float:
        nonlocal spent, best, best_q, interrupted
        spent += 1
        try:
            value, gradient = _charged(space, x.reshape(start.shape), index, existing)
        except KeyboardInterrupt:  # NLopt hides an exception of its callbacks behind one of its own
            interrupted = True
            value = -np.inf
            gradient = np.zeros(start.shape)
        if interrupted or time.process_time() - began > seconds / 2:
            solver.force_stop()
        if slope.size:
            slope[:] = -gradient.ravel()
        if value > best:
            best, best_q = value, x.reshape(start.shape).copy()
        return -value

    local.set_ftol_rel(1e-4)
    local.set_maxeval(LOCAL)
    solver.set_local_optimizer(local)
    solver.set_population(POINTS)
    solver.set_min_objective(charged)
    solver.set_lower_bounds(np.tile(space.lower, len(start)))
    solver.set_upper_bounds(np.tile(space.upper, len(start)))
    solver.set_maxeval(max(1, evaluations // 2))
    with suppress(nlopt.ForcedStop, nlopt.RoundoffLimited):  # the best set stands
        solver.optimize(start.ravel())
    best_q = restored(space, best_q)
    bad = ~is_feasible(space, best_q, FEASIBLE)
    best_q[bad] = start[bad]
    elapsed = time.process_time() - began
    if interrupted:
        remaining = 0.0
    else:
        remaining = seconds - elapsed
    remaining_evaluations = max(1, evaluations - spent)
    run = improved(space, best_q, index, existing, evaluations=remaining_evaluations, seconds=remaining)
    evaluations_in_all = spent + run.evaluations
    return replace(run, evaluations=evaluations_in_all, interrupted=interrupted or run.interrupted)


def _charged(space: SearchSpace, q: np.ndarray, index: Index, existing: np.ndarray | None) -> tuple[float, np.ndarray]:
    """Return the smoothed merit of poses q (m, n), less the penalty for violated constraints, and its gradient.

    Args:
        space: limits, constraints and Jacobian; a violated constraint is penalised quadratically.
        q: (m, n) joint values [rad or m].
        index: observability index to maximise.
        existing: (k, rows, p) Jacobians of poses already measured; None without such poses.
    """
    value, gradient = merit_of(space, q, index, existing, SHARPNESS[0])
    broken = np.maximum(constraint_values(space, q), 0.0)
    by_q = np.einsum("mk,mkn->mn", broken, constraint_gradients(space, q))
    charge = CHARGE * float((broken**2).sum())
    if not np.isfinite(value):
        value = -1e6
    value = value - charge
    return value, gradient - 2.0 * CHARGE * by_q
