"""Deterministic local search over all m · n joint values at once, under constraints, with exact gradients.

The method is sequential quadratic programming (SLSQP, Kraft 1988, in SciPy) on a smoothed index. The smoothing is
reduced from stage to stage (see `calib.poses.indices.merit`); a stage ends when the merit stagnates. An iterate may
violate the constraints slightly. Every stage therefore ends with a correction: each pose is moved by Newton steps of
least norm until it satisfies the constraints. The result is the corrected set with the best index, unsmoothed.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from ..indices import Index, has_kinks, merit
from ..space import SearchSpace, constraint_gradients, constraint_values, is_feasible, product

Objective = Callable[[np.ndarray], tuple[float, np.ndarray]]

# above this number of variables, poses are searched in blocks, the others fixed: SLSQP's cost is cubic
MAX_BLOCK = 300
# sharpness of each stage of a smoothed search (our choice); in the last one the smoothed merit is at most log(p)/1024
# below the merit itself
SHARPNESS = (16.0, 64.0, 256.0, 1024.0)
# number of iterations within which the merit must improve for a stage to go on (our choice)
PATIENCE = 25
# largest accepted constraint violation in a result [unit of the constraint]
FEASIBLE = 1e-8


@dataclass(frozen=True)
class Improved:
    """Result of a search over joint values.

    Attributes:
        q: (m, n) poses [rad or m]; never worse than the start, feasible to `FEASIBLE` if the start was.
        merit: log O (−log cond; O1 without 1/√m).
        history: merits of the start and of every stage that improved the best merit, rising.
        evaluations: number of evaluations of the index with its gradient.
        interrupted: True where Ctrl-C ended the search; q is then the best set reached.
    """

    q: np.ndarray
    merit: float
    history: tuple[float, ...]
    evaluations: int
    interrupted: bool = False


def merit_of(
    space: SearchSpace, q: np.ndarray, index: Index, existing: np.ndarray | None = None, sharpness: float = np.inf
) -> tuple[float, np.ndarray]:
    """Return the merit log O of poses together with the poses measured before, and its gradient by q.

    ∂ log O/∂q_ik = Σ_rp G[i,r,p] ∂J[i,r,p]/∂q_ik with G = ∂ log O/∂W (see `calib.poses.indices`).

    Args:
        space: provides the Jacobian and its derivative product.
        q: (m, n) poses [rad or m].
        index: the observability index O, "O1" ... "O5" or "cond".
        existing: Jacobians (k, rows, p), or stacked (k rows, p), of poses whose information is added but which are not
            changed; None for no such poses.
        sharpness: sharpness of the smoothing, see `calib.poses.indices.merit`; infinite for the index itself.

    Returns:
        The merit and its gradient (m, n); −inf and zeros where W has not full column rank.
    """
    jacobians = np.asarray(space.jacobian(q), dtype=float)
    stacked = jacobians.reshape(-1, jacobians.shape[2])
    if existing is not None and len(existing):
        measured_rows = existing.reshape(-1, jacobians.shape[2])
        stacked = np.concatenate([stacked, measured_rows])
    value, slope = merit(stacked, index, sharpness)
    moving_rows = jacobians.shape[0] * jacobians.shape[1]
    G = slope[:moving_rows].reshape(jacobians.shape)
    if not np.isfinite(value):
        return value, np.zeros_like(q)
    return value, product(space, q, G)


def improved(
    space: SearchSpace,
    q: np.ndarray,
    index: Index = "O1",
    existing: np.ndarray | None = None,
    *,
    evaluations: int = 5000,
    tolerance: float = 1e-5,
    seconds: float = np.inf,
    sharpness: Sequence[float] = SHARPNESS,
    report: Callable[[float], None] | None = None,
) -> Improved:
    """Return a set of poses with improved index, within limits and constraints; all joint values are varied at once.

    A predicate has no gradient to guide the search. Poses at which the predicate is false at the end are reset to their
    start values, and the other poses are searched again with these fixed (our choice).

    Args:
        space: limits, constraints, predicate, Jacobian.
        q: (m, n) start [rad or m].
        index: the observability index to improve.
        existing: (k, rows, p) Jacobians of poses already measured; None without such poses.
        evaluations: largest number of evaluations of index and gradient; most searches converge long before.
        tolerance: gain of the merit over `PATIENCE` iterations below which the last stage ends; the other stages end at
            ten times this gain.
        seconds: processor time [s] after which the search ends with the best set reached.
        sharpness: sharpness of the smoothing in each stage, for indices with kinks.
        report: called with every improved merit; None for no report.
    """
    deadline = time.process_time() + seconds
    start = np.asarray(q, dtype=float)
    start = np.clip(start, space.lower, space.upper)
    value = -np.inf
    if is_feasible(space, start, FEASIBLE).all():
        value, _ = merit_of(space, start, index, existing)
    free = np.ones(len(start), dtype=bool)
    best = start
    spent = 1
    interrupted = False
    history = []
    if np.isfinite(value):
        history.append(value)
    for _ in range(3):
        fixed_rows = _with_rows(space, best[~free], existing)
        remaining = evaluations - spent
        run = _search(space, best[free], index, fixed_rows, remaining, tolerance, sharpness, deadline)
        trial = best.copy()
        spent = spent + run.evaluations
        interrupted = run.interrupted
        trial[free] = run.q
        bad = ~is_feasible(space, trial, FEASIBLE)
        trial[bad] = start[bad]
        trial_value, _ = merit_of(space, trial, index, existing)
        if trial_value > value or (trial_value == value and not bad.any()):
            best, value = trial, trial_value
            highest = max(history, default=-np.inf)
            history += [stage_merit for stage_merit in run.history if highest < stage_merit < value]
            history.append(value)
            if report:
                report(value)
        if interrupted or not (bad & free).any() or spent >= evaluations or time.process_time() > deadline:
            break
        free &= ~bad
        if not free.any():
            break
    return Improved(best, value, tuple(history), spent + 1, interrupted)


def _objective(
    space: SearchSpace, index: Index, existing: np.ndarray | None, sharpness: float, q: np.ndarray
) -> tuple[float, np.ndarray]:
    return merit_of(space, q, index, existing, sharpness)


class _Ended(Exception):
    """Raised when a stage no longer improves the merit, or has used all its evaluations."""


def _search(
    space: SearchSpace,
    start: np.ndarray,
    index: Index,
    existing: np.ndarray | None,
    evaluations: int,
    tolerance: float,
    sharpness: Sequence[float],
    deadline: float,
) -> Improved:
    """Run all stages from one start and return the best set that satisfies the constraints; ignore the predicate.

    Args:
        space: limits, constraints, Jacobian.
        start: (m, n) poses [rad or m].
        index: observability index to improve.
        existing: (k, rows, p) Jacobians of poses already measured; None without such poses.
        evaluations: largest number of evaluations of index and gradient in all stages together.
        tolerance: gain of the merit below which the last stage ends (`improved`).
        sharpness: sharpness of the smoothing in each stage.
        deadline: value of `time.process_time` [s] at which the search ends.
    """
    feasible = bool(_keeps(space, start).all())
    best = start
    value = -np.inf
    if feasible:
        value, _ = merit_of(space, start, index, existing)
    history = [value]
    spent = 0
    iterate = start
    interrupted = False
    stages = [np.inf]
    if has_kinks(index):
        stages = list(sharpness)
    blocks = -(-start.size // MAX_BLOCK)
    while stages and spent < evaluations and time.process_time() < deadline and not interrupted:
        sharp = stages.pop(0)
        order = np.random.default_rng(len(history)).permutation(len(start))
        for block in np.array_split(order, blocks):
            fixed = np.setdiff1d(np.arange(len(start)), block)
            fixed_rows = _with_rows(space, iterate[fixed], existing)
            objective = partial(_objective, space, index, fixed_rows, sharp)
            stage_tolerance = tolerance
            if stages:
                stage_tolerance = 10 * tolerance
            remaining = evaluations - spent
            block_poses, steps, interrupted = climb(
                space, iterate[block], objective, remaining, stage_tolerance, deadline
            )
            iterate = iterate.copy()
            spent = spent + steps
            iterate[block] = block_poses
            if interrupted or spent >= evaluations or time.process_time() > deadline:
                break
        trial = restored(space, iterate)
        if feasible:
            bad = ~_keeps(space, trial)
            trial[bad] = best[bad]
        trial_value, _ = merit_of(space, trial, index, existing)
        last = value
        if trial_value > value:
            best, value = trial, trial_value
            history.append(value)
        # the last stage again where it gained much: blocks, and stages cut short by a failed line search
        if not stages and 10 * tolerance < value - last < np.inf:
            stages = [sharp]
            iterate = best
    return Improved(best, value, tuple(history), spent, interrupted)


def climb(
    space: SearchSpace,
    start: np.ndarray,
    objective: Objective,
    evaluations: int,
    tolerance: float,
    deadline: float = np.inf,
) -> tuple[np.ndarray, int, bool]:
    """Maximise a smooth function of poses by SLSQP until the gain over `PATIENCE` iterations is below `tolerance`.

    Args:
        space: limits and constraints; its Jacobian and predicate are not used.
        start: (m, n) poses [rad or m].
        objective: (m, n) -> value and gradient (m, n).
        evaluations: largest number of calls of the objective.
        tolerance: gain over `PATIENCE` iterations below which the search ends.
        deadline: value of `time.process_time` [s] at which the search ends.

    Returns:
        The last iterate (m, n), which may violate constraints slightly (see `restored`), the number of calls of the
        objective, and whether Ctrl-C ended the search.
    """
    m, n = start.shape
    count = 0
    last = start
    latest = 0.0
    merits = list[float]()

    def negative(x: np.ndarray) -> tuple[float, np.ndarray]:
        nonlocal count, latest
        count += 1
        value, gradient = objective(x.reshape(m, n))
        if np.isfinite(value):
            latest = value
        else:
            latest = -1e6
        return -latest, -gradient.ravel()

    def accepted(x: np.ndarray) -> None:
        nonlocal last
        last = x.reshape(m, n).copy()
        merits.append(latest)
        stalled = False
        if len(merits) > PATIENCE:
            gain = merits[-1] - merits[-1 - PATIENCE]
            stalled = gain < tolerance
        if stalled or count >= evaluations or time.process_time() > deadline:
            raise _Ended

    def values(x: np.ndarray) -> np.ndarray:
        values = constraint_values(space, x.reshape(m, n))
        return -values.ravel()

    def slopes(x: np.ndarray) -> np.ndarray:
        blocks = constraint_gradients(space, x.reshape(m, n))
        result = np.zeros((m, blocks.shape[1], m, n))
        result[np.arange(m), :, np.arange(m)] = -blocks
        return result.reshape(-1, m * n)

    # slow to load
    import scipy.optimize

    lower = np.tile(space.lower, m)
    upper = np.tile(space.upper, m)
    bounds = list(zip(lower, upper, strict=True))
    constraints = []
    if space.constraints:
        constraints.append({"type": "ineq", "fun": values, "jac": slopes})
    options = {"maxiter": evaluations, "ftol": 1e-2 * tolerance}
    try:
        run = scipy.optimize.minimize(
            negative,
            start.ravel(),
            jac=True,
            method="SLSQP",
            bounds=bounds,
            constraints=constraints,
            callback=accepted,
            options=options,
        )
        last = np.asarray(run.x).reshape(m, n)
    except _Ended:
        pass
    except KeyboardInterrupt:
        return last, count, True
    return np.clip(last, space.lower, space.upper), count, False


def restored(space: SearchSpace, q: np.ndarray, steps: int = 20) -> np.ndarray:
    """Return poses (m, n) corrected to satisfy the constraints, by Newton steps of least norm within the joint limits.

    A pose that still violates a constraint after `steps` steps is returned in its last state.

    Args:
        space: limits and constraints; its predicate is not checked.
        q: (m, n) joint values [rad or m].
        steps: largest number of Newton steps.
    """
    q = np.clip(q, space.lower, space.upper)
    for _ in range(steps if space.constraints else 0):
        is_broken = (constraint_values(space, q) > 0.1 * FEASIBLE).any(1)
        broken = np.flatnonzero(is_broken)
        if not len(broken):
            break
        values = constraint_values(space, q[broken])
        slopes = constraint_gradients(space, q[broken])
        for pose, value, slope in zip(broken, values, slopes, strict=True):
            binding = value > -1e-6
            free = np.ones(q.shape[1], dtype=bool)
            for _ in range(q.shape[1]):
                step = np.zeros(q.shape[1])
                correction = -value[binding] - 0.05 * FEASIBLE
                binding_slope = slope[binding][:, free]
                step[free] = np.linalg.lstsq(binding_slope, correction, rcond=1e-9)[0]
                moved = q[pose] + step
                outside = (moved < space.lower) | (moved > space.upper)
                out = free & outside
                if not out.any() or out.sum() == free.sum():
                    break
                free &= ~out
            q[pose] = np.clip(q[pose] + step, space.lower, space.upper)
    return q


def _keeps(space: SearchSpace, q: np.ndarray) -> np.ndarray:
    """Return whether each pose q (m, n) satisfies the constraints of `space`, (m,) bool; the predicate is ignored."""
    satisfied = constraint_values(space, q) <= FEASIBLE
    return np.asarray(satisfied.all(axis=1))


def _with_rows(space: SearchSpace, q: np.ndarray, existing: np.ndarray | None) -> np.ndarray | None:
    """Return the Jacobian rows (R, p) of the poses q, followed by those of `existing`; `existing` where q is empty.

    Args:
        space: provides the Jacobian of the poses q (m, n).
        existing: (k, rows, p) Jacobians of poses already measured; None without such poses.
    """
    if not len(q):
        return existing
    rows = np.asarray(space.jacobian(q), dtype=float)
    rows = rows.reshape(-1, rows.shape[2])
    if existing is None:
        return rows
    measured_rows = existing.reshape(-1, rows.shape[1])
    return np.concatenate([rows, measured_rows])
