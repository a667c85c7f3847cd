"""Search for exciting motions: sequential quadratic programming from several feasible starts, gradients exact.

A start is a random motion inside the joint limits (`trajectories.design.starts`); if it breaks another constraint it is
repaired (the squared excess is minimised), then searched from (`trajectories.design.search`).
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import takewhile
from typing import get_args

import numpy as np

from trajectories.design.problem import ExcitationProblem, exact_values, stretched, unmet
from trajectories.design.search import Method, SearchResult, Stuck, one_start
from trajectories.errors import BadInput, NotExciting, NothingFeasible


def design(
    problem: ExcitationProblem,
    *,
    starts: int = 6,
    evaluations: int = 600,
    method: Method = "slsqp",
    seed: int = 0,
    guesses: tuple[np.ndarray, ...] = (),
    map: Callable = map,
    report: Callable[[int, int, str], None] | None = None,
) -> SearchResult:
    """Return the best motion over several starts.

    Args:
        problem: must pickle where `map` runs in other processes.
        starts: random ones, each from its own child of the seed, besides the guesses.
        evaluations: most per start.
        method: "slsqp" (Kraft 1988), "auglag" (augmented Lagrangian, Birgin & Martínez 2008, over L-BFGS) or "mma"
            (Svanberg 2002), all in NLopt.
        guesses: variables to start from, (p,) each.
        map: the builtin, or one that spreads the work; results in order.
        report: called with starts done, starts, and the best so far in words.

    Raises:
        NothingFeasible: naming the constraint that stood in the way where the excess was least.
    """
    if method not in get_args(Method):
        raise BadInput(f"method '{method}' is none of {', '.join(get_args(Method))}")
    began = time.perf_counter()
    tasks: list[int | np.ndarray] = [*guesses, *range(starts)]
    if not tasks:
        raise BadInput("no starts: ask for one at least, or give a guess")
    found, stuck, spent = list[SearchResult](), list[Stuck](), 0
    interrupted = False
    try:
        wanted = takewhile(lambda _: not interrupted, tasks)  # a map in other processes may still hand back what it has
        for number, run in enumerate(map(partial(one_start, problem, evaluations, method, seed), wanted), 1):
            if isinstance(run, SearchResult):
                found.append(run)
            else:
                stuck.append(run)
            spent += run.evaluations
            if report:
                best = min((one.merit for one in found), default=np.inf)
                report(number, len(tasks), f"best so far {best:.4g}" if found else "nothing feasible yet")
            interrupted |= isinstance(run, SearchResult) and run.interrupted
    except KeyboardInterrupt:
        if not found:
            raise
        interrupted = True
    if not found:
        raise _nothing(problem, stuck)
    best = min(found, key=lambda one: one.merit)
    share = sum(one.feasible * one.evaluations for one in found) / spent
    return replace(
        best, evaluations=spent, feasible=share, seconds=time.perf_counter() - began, interrupted=interrupted
    )


def _nothing(problem: ExcitationProblem, stuck: list[Stuck]) -> NothingFeasible:
    """Return the error that names the constraint which was in the way."""
    best = min(stuck, key=lambda one: one.excess)
    motion = stretched(problem.basis().motion(best.x), best.factor)
    if best.excess[0] <= 0.0 and problem.goals:
        values = exact_values(problem, motion, problem.regressor(motion.q, motion.v, motion.a))
        lacking, goal, value = unmet(problem, values)
        assert goal is not None  # the search kept every limit, so a hard goal stood in its way
        return NothingFeasible(
            f"the hard goal {goal.objective.name} ≤ {goal.goal:g} was not reached in {len(stuck)} starts, though all "
            f"limits were kept: the nearest motion has {value:.4g}; ease it, give it a weight, or take a longer period",
            goal.objective.name, lacking, "of the goal",
        )  # fmt: skip
    worst = max(problem.constraints, key=lambda c: float((c.values(motion) / c.scale).max()), default=None)
    if worst is None:
        raise NotExciting(f"no motion could be evaluated: {best.reason}")
    values = worst.values(motion)
    row, column = np.unravel_index(np.argmax(values / worst.scale), values.shape)
    excess = float(values[row, column])
    return NothingFeasible(
        f"no feasible motion in {len(stuck)} starts: the nearest one breaks the {worst.name} limit "
        f"({worst.labels[column]}) by {max(excess, 0.0):.3g} {worst.unit} at t = {motion.times[row]:.3g} s; widen that "
        "limit, take a longer period, or allow more starts",
        worst.name, excess, worst.unit,
    )  # fmt: skip
