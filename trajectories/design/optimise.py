"""Search for exciting motions: sequential quadratic programming from several feasible starts, gradients exact.

A start is a random motion inside the joint limits (`calib.trajectories.design.starts`). If the start violates another
constraint, it is first repaired: the squared constraint violation is minimised. The search then begins from the
repaired motion (`calib.trajectories.design.search`).
"""

import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import takewhile
from typing import get_args

import numpy as np

from ..constraints import MotionConstraint
from ..design.problem import ExcitationProblem, exact_values, stretched, unmet
from ..design.search import STAGES, Method, SearchResult, Stage, Stuck, one_start
from ..errors import BadInput, NotExciting, NothingFeasible, require

# share of the starts for which the last stages are run (our choice)
KEPT = 1 / 3


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
    """Return the best motion of searches from several start motions.

    Args:
        problem: the excitation problem; must be picklable where `map` runs in other processes.
        starts: number of random start motions in addition to `guesses`; each is drawn by its own generator.
        evaluations: largest number of evaluations per start.
        method: "slsqp" (Kraft 1988, by SciPy), or by NLopt "auglag" (augmented Lagrangian, Birgin & Martínez 2008, over
            L-BFGS), "mma" or "ccsaq" (sequential convex separable approximations, Svanberg 2002).
        seed: seed of the random starts.
        guesses: free variables x (p,) of the motion family for further start motions; empty for none.
        map: the builtin, or a parallel map that returns results in order.
        report: called with the number of finished searches, the number of all searches, and a sentence on the best
            merit so far; None for no report.

    Raises:
        BadInput: an unknown method, or no starts.
        NothingFeasible: no search reached a feasible motion; the message names the constraint that the least infeasible
            motion violates most.
        NotExciting: no motion could be evaluated.
    """
    if method not in get_args(Method):
        raise BadInput(f"method '{method}' is not one of {', '.join(get_args(Method))}")
    began = time.perf_counter()
    tasks: list[int | np.ndarray] = [*guesses, *range(starts)]
    require(tasks, "no starts: ask for at least one, or give an initial guess")
    search = _Starts(problem, evaluations, method, seed, map, report, len(tasks))
    polished = list[SearchResult]()
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
    best = min(polished or search.found, key=lambda result: result.merit)
    feasible_evaluations = sum(result.feasible * result.evaluations for result in search.found)
    share = feasible_evaluations / search.spent
    seconds = time.perf_counter() - began
    return replace(best, evaluations=search.spent, feasible=share, seconds=seconds, interrupted=search.interrupted)


class _Starts:
    """Searches from several start motions, and the results so far; the searches run stage by stage.

    Args:
        problem: the excitation problem.
        evaluations: largest number of evaluations per start.
        method: optimiser, as for `design`.
        seed: seed of the random starts.
        map: the builtin, or a parallel map that returns results in order.
        report: called with the number of finished searches, the number of all searches, and a sentence; None: no
            report.
        starts: number of all start motions.
    """

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
        self.problem = problem
        self.arguments = (evaluations, method, seed)
        self.map = map
        self.report = report
        self.found = list[SearchResult]()
        self.stuck = list[Stuck]()
        self.done = 0
        self.total = starts + _kept(starts)
        self.spent = 0
        self.interrupted = False

    def run(self, tasks: list[int | np.ndarray], stages: tuple[Stage, ...]) -> list[SearchResult]:
        """Run the given stages of the search for each start and return the results that are feasible.

        Args:
            tasks: for each start, the number of a random start (from 0), or variables (p,) of a motion to start from.
            stages: the stages to run, in order.
        """
        fresh = list[SearchResult]()
        search = partial(one_start, self.problem, *self.arguments, stages=stages)
        # a map in other processes may still hand back what it has
        open_tasks = takewhile(lambda _: not self.interrupted, tasks)
        for result in self.map(search, open_tasks):
            self.spent += result.evaluations
            self.done += 1
            if isinstance(result, SearchResult):
                fresh.append(result)
                self.found.append(result)
                self.interrupted |= result.interrupted
            else:
                self.stuck.append(result)
            if self.report:
                self.report(self.done, self.total, self._summary())
        return fresh

    def _summary(self) -> str:
        """Return a sentence on the best merit so far, for the progress report."""
        if not self.found:
            return "nothing feasible yet"
        best = min(result.merit for result in self.found)
        return f"best so far {best:.4g}"

    def promising(self) -> list[int | np.ndarray]:
        """Return the variables (p,) of the best motions so far, the share `KEPT` of all starts.

        Feasible motions are ranked by merit; infeasible motions follow, ranked by constraint violation.
        """
        feasible = sorted(self.found, key=lambda result: result.merit)
        infeasible = sorted(self.stuck, key=lambda stuck: stuck.excess)
        ranked = feasible + infeasible
        variables: list[int | np.ndarray] = []
        for start in ranked[: _kept(len(ranked))]:
            x = start.x
            if self.problem.free_period:
                x = np.append(x, start.factor)
            variables.append(x)
        return variables


def _kept(starts: int) -> int:
    """Return the number of start motions, out of `starts`, for which the last stages are run."""
    return max(1, round(KEPT * starts))


def _nothing(problem: ExcitationProblem, stuck: list[Stuck], starts: int) -> NothingFeasible:
    """Return the error of a search without a feasible motion, which names the violated constraint or hard goal.

    Args:
        problem: the excitation problem.
        stuck: results of the searches that failed; the least infeasible motion is described.
        starts: number of start motions, for the message.
    """
    best = min(stuck, key=lambda start: start.excess)
    motion = stretched(problem.basis().motion(best.x), best.factor)
    if best.excess[0] <= 0.0 and problem.goals:
        regressor = problem.regressor(motion.q, motion.v, motion.a)
        values = exact_values(problem, motion, regressor)
        missed = unmet(problem, values)
        # every limit was kept, so a hard goal stood in the way
        if missed is not None:
            lacking, goal, value = missed
            wording = goal.words or f"{goal.objective.name} ≤ {goal.goal:g}"
            return NothingFeasible(
                f"the hard goal {wording} was not reached in "
                f"{_counted(starts)}, though all limits were kept: the nearest motion has {goal.stated(value):.4g}; "
                "relax it, give it a weight, or take a longer period",
                goal.objective.name,
                lacking,
                "of the goal",
            )

    def excess_share(constraint: MotionConstraint) -> float:
        scaled = constraint.values(motion) / constraint.scale
        return float(scaled.max())

    worst = max(problem.constraints, key=excess_share, default=None)
    if worst is None:
        raise NotExciting(f"no motion could be evaluated: {best.reason}")
    values = worst.values(motion)
    largest = np.argmax(values / worst.scale)
    row, column = np.unravel_index(largest, values.shape)
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
    if starts == 1:
        return "1 start"
    return f"{starts} starts"
