"""Search for exciting motions: sequential quadratic programming from several feasible starts, gradients exact.

A start is a random motion inside the joint limits (`trajectories.design.starts`); if it breaks another constraint it is
repaired (the squared excess is minimised), then searched from (`trajectories.design.search`).
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from itertools import takewhile
from typing import get_args

import numpy as np

from trajectories.design.problem import ExcitationProblem, exact_values, stretched, unmet
from trajectories.design.search import STAGES, Method, SearchResult, Stage, Stuck, one_start
from trajectories.errors import BadInput, NotExciting, NothingFeasible, require

KEPT = 1 / 2  # of the starts, which the next round is for (our choice)
ROUNDS = (STAGES[:1], STAGES[1:2], STAGES[2:])  # of a search: the first one tells most of what a start is worth


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

    The first stage of the search is for all starts, the second for the best half of them, the others for the best half
    of those. A stage ends where a step improves the merit by less than its tolerance (0.001, later 0.0001: 0.01 % of
    condition numbers), or at its share of the evaluations.

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
    tasks: Sequence[int | np.ndarray] = [*guesses, *range(starts)]
    require(tasks, "no starts: ask for at least one, or give an initial guess")
    search = _Starts(problem, evaluations, method, seed, map, report, len(tasks))
    try:
        for stages in ROUNDS:
            if not search.interrupted:
                tasks = search.run(tasks, stages)
    except KeyboardInterrupt:
        if not search.last:
            raise
        search.interrupted = True
    if not search.last:
        raise _nothing(problem, search.stuck, len(tasks))
    best = min(search.last, key=lambda one: one.merit)
    return replace(
        best, evaluations=search.spent, feasible=search.feasible / search.spent, seconds=time.perf_counter() - began,
        interrupted=search.interrupted,
    )  # fmt: skip


class _Starts:
    """Searches from several starts, in rounds: the best half of one goes into the next."""

    def __init__(
        self, problem: ExcitationProblem, evaluations: int, method: Method, seed: int, map: Callable,
        report: Callable[[int, int, str], None] | None, starts: int,
    ):  # fmt: skip
        self.problem, self.arguments, self.map, self.report = problem, (evaluations, method, seed), map, report
        self.last, self.stuck = list[SearchResult](), list[Stuck]()
        self.done, self.total = 0, starts + _kept(starts) + _kept(_kept(starts))
        self.spent, self.feasible, self.interrupted = 0, 0.0, False

    def run(self, tasks: Sequence[int | np.ndarray], stages: tuple[Stage, ...]) -> list[np.ndarray]:
        """Run the given stages of the search for each task; return the variables of the best motions.

        Infeasible ones come last, by constraint violation; `last` are the feasible ones of the last round with any.
        """
        fresh, stuck = list[SearchResult](), list[Stuck]()
        # a map in other processes may still hand back what it has
        wanted = takewhile(lambda _: not self.interrupted, tasks)
        for run in self.map(partial(one_start, self.problem, *self.arguments, stages=stages), wanted):
            self.spent += run.evaluations
            self.done += 1
            if isinstance(run, SearchResult):
                fresh.append(run)
                self.last, self.interrupted = fresh, self.interrupted or run.interrupted
                self.feasible += run.feasible * run.evaluations
            else:
                stuck.append(run)
                self.stuck.append(run)
            if self.report:
                best = min((one.merit for one in self.last), default=np.inf)
                words = f"best so far {best:.4g}" if self.last else "nothing feasible yet"
                self.report(self.done, self.total, words)
        ranked = sorted(fresh, key=lambda one: one.merit) + sorted(stuck, key=lambda one: one.excess)
        chosen = ranked[: _kept(len(ranked))]
        return [np.append(one.x, one.factor) if self.problem.free_period else one.x for one in chosen]


def _kept(starts: int) -> int:
    """Return the number of starts that the next round is for."""
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
                goal.objective.name, lacking, "of the goal",
            )  # fmt: skip
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
        worst.name, excess, worst.unit,
    )  # fmt: skip


def _counted(starts: int) -> str:
    return f"{starts} start{'' if starts == 1 else 's'}"
