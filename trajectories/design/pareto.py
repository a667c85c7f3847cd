"""Trade-offs between objectives: goals proposed from single-objective runs, and a front by sweeping one goal."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from trajectories.design.objectives import Objective
from trajectories.design.optimise import design
from trajectories.design.problem import AttainmentGoal, ExcitationProblem
from trajectories.design.search import SearchResult, Stuck, one_start


@dataclass(frozen=True, eq=False)
class Front:
    """Motions on a trade-off front between objectives.

    Attributes:
        names: of the k objectives.
        values: (m, k), not smoothed, of the motions found; `found` (m,) the motions.
        best: (m,) whether no other one is as good in everything and better in something.
    """

    names: tuple[str, ...]
    values: np.ndarray
    found: tuple[SearchResult, ...]
    best: np.ndarray


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
    """Return the optimum of each objective alone, with its motion, as initial goals (the study's advice)."""
    result = []
    for objective in objectives:
        alone = replace(problem, objectives=((objective, 1.0),), goals=())
        run = design(alone, starts=starts, evaluations=evaluations, seed=seed, guesses=guesses, map=map)
        result.append((float(run.values[0]), run))
    return result


def sweep(
    problem: ExcitationProblem,
    first: Objective,
    second: Objective,
    levels: Sequence[float],
    guess: np.ndarray,
    other: np.ndarray | None = None,
    *,
    evaluations: int = 240,
    report: Callable[[int, int, str], None] | None = None,
) -> Front:
    """Minimise the first objective under second ≤ level (a hard goal) for each level, from the last motion.

    Args:
        levels: of the second objective, in the order they are tried (best from easy to hard).
        guess: variables to start from (p,).
        other: to try where the last motion does not lead to a level, best what the second objective alone reached.
    """
    runs, values = list[SearchResult](), list[np.ndarray]()
    for number, level in enumerate(levels, 1):
        goals = (AttainmentGoal(first, _level(problem, first, guess)), AttainmentGoal(second, float(level), 0.0))
        run = one_start(replace(problem, goals=goals), evaluations, "slsqp", 0, guess)
        if isinstance(run, Stuck) and other is not None:
            run = one_start(replace(problem, goals=goals), evaluations, "slsqp", 0, other)
        if not isinstance(run, Stuck) and np.isfinite(run.merit):
            guess = np.append(run.x, run.factor) if problem.free_period else run.x
            runs.append(run)
            values.append(run.values)
        if report:
            report(number, len(levels), f"{len(runs)} motions on the Pareto front")
    table = np.array(values).reshape(len(runs), 2)
    return Front((first.name, second.name), table, tuple(runs), non_dominated(table))


def non_dominated(values: np.ndarray) -> np.ndarray:
    """Return which rows (m, k) are not dominated (no other row is as small everywhere and smaller somewhere)."""
    better = (values[:, None] <= values[None]).all(-1) & (values[:, None] < values[None]).any(-1)
    return np.logical_not(better.any(axis=0))


def _level(problem: ExcitationProblem, objective: Objective, y: np.ndarray) -> float:
    """Return the objective's value at an initial guess, as a goal to improve on."""
    x = y[: problem.basis().p]
    motion = problem.basis().motion(x)
    return float(objective.evaluate(motion, problem.regressor(motion.q, motion.v, motion.a)).value)
