"""Search for exciting motions: sequential quadratic programming from several feasible starts, gradients exact.

A start is a random motion inside the joint limits (`calib.trajectories.design.starts`); if it breaks another
constraint it is
repaired (the squared excess is minimised), then searched from (`calib.trajectories.design.search`).
"""

import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import takewhile
from typing import get_args

import numpy as np

from calib.trajectories.design.problem import ExcitationProblem, exact_values, stretched, unmet
from calib.trajectories.design.search import STAGES, Method, SearchResult, Stage, Stuck, one_start
from calib.trajectories.errors import BadInput, NotExciting, NothingFeasible, require

KEPT = 1 / 3  # of the starts, which the last stages are for (our choice)


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
        method: "slsqp" (Kraft 1988, of SciPy), or of NLopt "auglag" (augmented Lagrangian, Birgin & Martínez 2008,
            over L-BFGS), "mma" or "ccsaq" (sequential convex separable approximations, Svanberg 2002).
        guesses: variables to start from, (p,) each.
        map: the builtin, or one that spreads the work; results in order.
        report: called with starts done, starts, and the best so far in words.

    Raises:
        NothingFeasible: naming the constraint that stood in the way where the excess was least.
    """
    if method not in get_args(Method):
        raise BadInput(f"method '{method}' is not one of {', '.join(get_args(Method))}")
    began = time.perf_counter()
    tasks: list[int | np.ndarray] = [*guesses, *range(starts)]
    require(tasks, "no starts: ask for at least one, or give an initial guess")
    search, polished = _Starts(problem, evaluations, method, seed, map, report, len(tasks)), list[SearchResult]()
    try:
        search.run(tasks, STAGES[:2])
        if not search.interrupted:
            polished = search.run(search.promising(), STAGES[2:])
    except KeyboardInterrupt:
        if not search.found:
            raise
        search.interrupted = True
    if not search.found:
        raise _nothing(problem, search.stuck, len(tasks))
    best = min(polished or search.found, key=lambda one: one.merit)
    share = sum(one.feasible * one.evaluations for one in search.found) / search.spent
    return replace(
        best,
        evaluations=search.spent,
        feasible=share,
        seconds=time.perf_counter() - began,
        interrupted=search.interrupted,
    )


class _Starts:
    """Searches from several starts, in rounds."""

    def __init__(
        self,
        problem: ExcitationProblem,
        evaluations: int,
        method: Method,
        seed: int,
        map: Callable,
        report: Callable[[int, int, str], None] | None,
        starts: int,
    ):
        self.problem, self.arguments, self.map, self.report = problem, (evaluations, method, seed), map, report
        self.found, self.stuck = list[SearchResult](), list[Stuck]()
        self.done, self.total = 0, starts + _kept(starts)
        self.spent, self.interrupted = 0, False

    def run(self, tasks: list[int | np.ndarray], stages: tuple[Stage, ...]) -> list[SearchResult]:
        """Run the given stages of the search for each task; return the results."""
        fresh = list[SearchResult]()
        # a map in other processes may still hand back what it has
        wanted = takewhile(lambda _: not self.interrupted, tasks)
        for run in self.map(partial(one_start, self.problem, *self.arguments, stages=stages), wanted):
            self.spent += run.evaluations
            self.done += 1
            if isinstance(run, SearchResult):
                fresh.append(run)
                self.found.append(run)
                self.interrupted |= run.interrupted
            else:
                self.stuck.append(run)
            if self.report:
                best = min((one.merit for one in self.found), default=np.inf)
                words = f"best so far {best:.4g}" if self.found else "nothing feasible yet"
                self.report(self.done, self.total, words)
        return fresh

    def promising(self) -> list[int | np.ndarray]:
        """Return the variables of the best motions so far; infeasible ones last, by constraint violation."""
        ranked = sorted(self.found, key=lambda one: one.merit) + sorted(self.stuck, key=lambda one: one.excess)
        chosen = ranked[: _kept(len(ranked))]
        return [np.append(one.x, one.factor) if self.problem.free_period else one.x for one in chosen]


def _kept(starts: int) -> int:
    """Return the number of starts to search to the end."""
    return max(1, round(KEPT * starts))


def _nothing(problem: ExcitationProblem, stuck: list[Stuck], starts: int) -> NothingFeasible:
    """Return an error that names the limiting constraint."""
    best = min(stuck, key=lambda one: one.excess)
    motion = stretched(problem.basis().motion(best.x), best.factor)
    if best.excess[0] <= 0.0 and problem.goals:
        values = exact_values(problem, motion, problem.regressor(motion.q, motion.v, motion.a))
        if (missed := unmet(problem, values)) is not None:  # every limit was kept, so a hard goal stood in the way
            lacking, goal, value = missed
            return NothingFeasible(
                f"the hard goal {goal.words or f'{goal.objective.name} ≤ {goal.goal:g}'} was not reached in "
                f"{_counted(starts)}, though all limits were kept: the nearest motion has {goal.stated(value):.4g}; "
                "relax it, give it a weight, or take a longer period",
                goal.objective.name,
                lacking,
                "of the goal",
            )
    worst = max(problem.constraints, key=lambda c: float((c.values(motion) / c.scale).max()), default=None)
    if worst is None:
        raise NotExciting(f"no motion could be evaluated: {best.reason}")
    values = worst.values(motion)
    row, column = np.unravel_index(np.argmax(values / worst.scale), values.shape)
    excess = float(values[row, column])
    return NothingFeasible(
        f"no feasible motion in {_counted(starts)}: the nearest one breaks the {worst.name} limit "
        f"({worst.labels[column]}) by {max(excess, 0.0):.3g} {worst.unit} at t = {motion.times[row]:.3g} s; widen that "
        "limit or take a longer period",
        worst.name,
        excess,
        worst.unit,
    )


def _counted(starts: int) -> str:
    return f"{starts} start{'' if starts == 1 else 's'}"
