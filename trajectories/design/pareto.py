"""Trade-offs between two objectives: goals from single-objective optima, and a Pareto front by varying a bound."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..design.objectives import Objective
from ..design.optimise import design
from ..design.problem import AttainmentGoal, ExcitationProblem, exact_values, stretched
from ..design.search import STAGES, SearchResult, one_start


@dataclass(frozen=True, eq=False)
class Front:
    """Motions on a trade-off front between k objectives.

    Attributes:
        names: names of the k objectives.
        values: (m, k) unsmoothed objectives of the m motions.
        found: (m,) search results that contain the motions.
        best: (m,) True where no other motion dominates: is at least as small in every objective and smaller in one.
        designed: index (from 0) of the motion with which the front is compared.
    """

    names: tuple[str, ...]
    values: np.ndarray
    found: tuple[SearchResult, ...]
    best: np.ndarray
    designed: int


def proposed_goals(
    problem: ExcitationProblem,
    objectives: Sequence[Objective],
    *,
    starts: int = 2,
    evaluations: int = 300,
    seed: int = 0,
    guesses: tuple[np.ndarray, ...] = (),
    map: Callable = map,
) -> list[tuple[float, SearchResult]]:
    """Return the optimum of each objective alone, with its motion, as initial goals (Kolyubin et al. 2019).

    Args:
        problem: family and constraints of the motions; its objectives and goals are ignored.
        objectives: the objectives to minimise one after the other.
        starts, evaluations, seed, guesses, map: as for `calib.trajectories.design.optimise.design`.

    Returns:
        The smallest value of each objective, and the search result that attains it.
    """
    result = []
    for objective in objectives:
        single = replace(problem, objectives=((objective, 1.0),), goals=())
        run = design(single, starts=starts, evaluations=evaluations, seed=seed, guesses=guesses, map=map)
        result.append((float(run.values[0]), run))
    return result


def sweep(
    problem: ExcitationProblem,
    first: Objective,
    second: Objective,
    count: int,
    ends: Sequence[SearchResult],
    designed: SearchResult,
    *,
    evaluations: int = 600,
    report: Callable[[int, int, str], None] | None = None,
) -> Front:
    """Return a Pareto front: the smallest values of the objective `first` under bounds on the objective `second`.

    This is the ε-constraint method (Haimes, Lasdon & Wismer 1971). The bounds on the second objective are hard goals,
    evenly spaced from its own optimum to its value at the optimum of the first. Each search starts from the best known
    motion within the bound, and from the motion nearest to the bound; the better result is used.

    Args:
        problem: family and constraints of the motions; its objectives and goals are ignored.
        first, second: the two objectives.
        count: number of bounds on the second objective, including its values at the two optima.
        ends: the search results that minimise the first objective alone, and the second alone.
        designed: search result of another motion, which is added to the front for comparison.
        evaluations: largest number of evaluations of each search.
        report: called with the number of bounds done, their total, and a sentence; None for no report.
    """
    points = [*ends, designed]
    values = [_of(problem, (first, second), run) for run in points]
    levels = np.linspace(values[0][1], values[1][1], count)[1:-1]
    for number, level in enumerate(levels, 1):
        table = np.array(values)
        front = np.where(table[:, 1] <= level, table[:, 0], np.inf)
        first_goal = AttainmentGoal(first, float(values[0][0]))
        second_goal = AttainmentGoal(second, float(level), 0.0)
        goals = (first_goal, second_goal)
        spot = replace(problem, goals=goals)
        best = None
        least_merit = np.inf
        best_within = int(np.argmin(front))
        nearest = int(np.argmin(np.abs(table[:, 1] - level)))
        for k in {best_within, nearest}:
            guess = points[k].x
            if problem.free_period:
                guess = np.append(guess, points[k].factor)
            run = one_start(spot, evaluations, "slsqp", 0, guess, STAGES[1:])
            if isinstance(run, SearchResult) and run.merit < least_merit:
                best = run
                least_merit = run.merit
        # two levels may have the same best motion
        if best is not None and not any(np.allclose(best.values, point) for point in values):
            points.append(best)
            values.append(best.values)
        if report:
            report(number, len(levels), f"{len(points) - 1} motions on the Pareto front")
    table = np.array(values)
    designed_index = next(k for k, run in enumerate(points) if run is designed)
    return Front((first.name, second.name), table, tuple(points), non_dominated(table), designed_index)


def _of(problem: ExcitationProblem, objectives: Sequence[Objective], run: SearchResult) -> np.ndarray:
    """Return the unsmoothed values (k,) of the objectives for the motion of a search result.

    Args:
        problem: family, regressor and times of the motions; its objectives and goals are ignored.
        objectives: the k objectives.
        run: the search result.
    """
    weighted = tuple((objective, 1.0) for objective in objectives)
    spot = replace(problem, objectives=weighted, goals=())
    motion = stretched(spot.basis().motion(run.x), run.factor)
    regressor = problem.regressor(motion.q, motion.v, motion.a)
    return exact_values(spot, motion, regressor)


def non_dominated(values: np.ndarray) -> np.ndarray:
    """Return which rows of `values` (m, k) are not dominated, (m,) bool.

    A row is dominated where another row is at least as small in every column and smaller in one.
    """
    nowhere_larger = (values[:, None] <= values[None]).all(-1)
    somewhere_smaller = (values[:, None] < values[None]).any(-1)
    better = nowhere_larger & somewhere_smaller
    return np.logical_not(better.any(axis=0))
