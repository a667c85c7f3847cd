"""One start's search: NLopt on the smoothed problem, three times, each time sharper, from where the last one ended.

The best motion that kept all constraints at the samples is returned, not the last one.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Literal

import nlopt
import numpy as np

from trajectories.basis import Basis
from trajectories.design.problem import (
    Evaluation,
    ExcitationProblem,
    evaluate,
    is_condition,
    merit,
    unmet,
)
from trajectories.design.starts import random_start
from trajectories.errors import NotExciting

Method = Literal["slsqp", "auglag", "mma"]
STAGES = ((4.0, 100.0), (10.0, 200.0), (30.0, 500.0))
"""Sharpness of the spectra and of the constraints, stage by stage (our choice)."""
S_RANGE = (-4.0, 12.0)


@dataclass(frozen=True, eq=False)
class SearchResult:
    """What a search ends with.

    Attributes:
        x: variables of the family; `factor` multiplies its period.
        merit: the weighted sum, or γ.
        values: (k,) of the objectives or goals, not smoothed, at the problem's samples.
        history: merits of the improving feasible iterates, falling.
        evaluations: of everything, with gradients.
        feasible: share of them that kept all constraints at the samples.
        seconds: it took.
        seed: of its start; `interrupted`: ended by Ctrl-C.
        times: of the history, processor seconds since its start.
    """

    x: np.ndarray
    factor: float
    merit: float
    values: np.ndarray
    history: tuple[float, ...]
    evaluations: int
    feasible: float
    seconds: float
    seed: int = 0
    interrupted: bool = False
    times: tuple[float, ...] = ()


@dataclass(frozen=True, eq=False)
class Stuck:
    """A start that never became feasible.

    Attributes:
        x, factor: of the motion that broke the constraints least.
        excess: of its constraints over their scales, and of its hard goals over theirs.
        evaluations: what the search cost; `reason`: why NLopt ended, where it says so.
    """

    x: np.ndarray
    factor: float
    excess: tuple[float, float]
    evaluations: int
    reason: str = ""


def one_start(
    problem: ExcitationProblem, evaluations: int, method: Method, seed: int, start: int | np.ndarray
) -> SearchResult | Stuck:
    """Search from one random start (its number) or from given variables."""
    began = time.perf_counter()
    run = StartSearch(problem, problem.basis())
    if isinstance(start, int | np.integer):
        rng = np.random.default_rng([seed, int(start)])
        y = random_start(problem, run.basis, rng)
    else:
        y = np.asarray(start, dtype=float)
        y = np.append(y, np.clip(1.0, *problem.stretch)) if problem.free_period and len(y) == run.basis.p else y
    stages = STAGES if isinstance(start, int | np.integer) else STAGES[1:]  # a guess is not to be led far away
    run.sharpness = stages[0]
    try:
        y = run.repaired(y)
        for stage, sharpness in enumerate(stages):
            run.sharpness = sharpness
            y = run.solve(run.best if run.best is not None and stage else y, max(1, evaluations // len(stages)), method)
    except KeyboardInterrupt:
        if run.best is None:
            raise
        run.interrupted = True
    factor = float(run.best[-1] if run.best is not None and problem.free_period else problem.stretch[0])
    p = run.basis.p
    if run.best is None:
        nearest = run.nearest if run.nearest is not None else y
        factor = float(nearest[p]) if problem.free_period else factor
        return Stuck(nearest[:p], factor, run.least, run.count, run.reason)
    seconds, share = time.perf_counter() - began, run.kept / run.count
    label = int(start) if isinstance(start, int | np.integer) else -1
    return SearchResult(
        run.best[:p], factor, run.merit, run.values, tuple(run.history), run.count, share, seconds, label,
        run.interrupted, tuple(run.times),
    )  # fmt: skip


class StartSearch:
    """One start's search: the state that NLopt's callbacks share."""

    def __init__(self, problem: ExcitationProblem, basis: Basis):
        self.problem, self.basis = problem, basis
        self.sharpness = STAGES[0]
        self.best: np.ndarray | None = None
        self.nearest: np.ndarray | None = None
        self.merit, self.least = np.inf, (np.inf, np.inf)
        self.values = np.zeros(0)
        self.history: list[float] = []
        self.times: list[float] = []
        self.began = time.process_time()
        self.count = self.kept = 0
        self.interrupted, self.reason, self.scale = False, "", 1.0
        self._at: tuple[bytes, tuple[float, float]] | None = None
        self._evaluation: Evaluation | None = None

    def at(self, y: np.ndarray) -> Evaluation:
        """Evaluate once per point, and keep the best feasible one."""
        key = (y.tobytes(), self.sharpness)
        if self._evaluation is None or key != self._at:
            self._evaluation, self._at = evaluate(self.problem, self.basis, y, self.sharpness), key
            self.count += 1
            self._remember(np.array(y), self._evaluation)
        return self._evaluation

    def _remember(self, y: np.ndarray, found: Evaluation) -> None:
        lacking = (max(found.excess, 0.0), unmet(self.problem, found.values)[0])
        if lacking < self.least:
            self.least, self.nearest = lacking, y
        if found.excess > 1e-7:
            return
        self.kept += 1
        value = merit(self.problem, found.exact)
        if value < self.merit:
            self.best, self.merit, self.values = y, value, found.exact
            self.history.append(value)
            self.times.append(time.process_time() - self.began)

    def repaired(self, y: np.ndarray, evaluations: int = 80) -> np.ndarray:
        """Return a point that keeps the constraints, or the nearest found: min Σ max(0, c + 0.01)² by L-BFGS."""
        if not self.problem.constraints or self.at(y).constraints.max() <= 0:
            return y

        def excess(z: np.ndarray, slope: np.ndarray) -> float:
            found = self.at(z)
            over = np.maximum(found.constraints + 0.01, 0.0)
            if slope.size:
                slope[:] = 2 * over @ found.rows
            return float((over**2).sum())

        solver = nlopt.opt(nlopt.LD_LBFGS, len(y))
        solver.set_min_objective(excess)
        solver.set_stopval(1e-8)
        solver.set_maxeval(evaluations)
        self._bound(solver, len(y))
        return self._optimised(solver, y)

    def solve(self, y: np.ndarray, evaluations: int, method: Method) -> np.ndarray:
        """Run NLopt on the smoothed problem from y (with s, of γ = e^s - 1, behind it where there are goals)."""
        goals = self.problem.goals
        start = np.append(y, self._attainment(y)) if goals else y
        if not goals:  # a slope of at most 1 at the start: SLSQP's first step is as long as the slope
            slope, self.scale = np.zeros(len(y)), 1.0
            self._sum(np.ascontiguousarray(y), slope)
            self.scale = 1.0 / max(1.0, float(np.linalg.norm(slope)))
        algorithm = {"slsqp": nlopt.LD_SLSQP, "auglag": nlopt.AUGLAG, "mma": nlopt.LD_MMA}[method]
        solver = nlopt.opt(algorithm, len(start))
        if method == "auglag":
            inner = nlopt.opt(nlopt.LD_LBFGS, len(start))
            inner.set_ftol_rel(1e-5)
            inner.set_maxeval(max(20, evaluations // 6))
            solver.set_local_optimizer(inner)
        solver.set_min_objective(self._last if goals else self._sum)
        rows = len(self.at(np.ascontiguousarray(y)).constraints) + len(goals)
        if rows:
            solver.add_inequality_mconstraint(self._rows, np.full(rows, 1e-8))
        self._bound(solver, len(start))
        solver.set_ftol_rel(1e-5)
        solver.set_maxeval(evaluations)
        return self._optimised(solver, start)[: len(y)]

    def _bound(self, solver: nlopt.opt, size: int) -> None:
        """Bound the factor on the period, and s to γ from -0.98 to 10⁵: SLSQP may try any length of step."""
        lower, upper = np.full(size, -np.inf), np.full(size, np.inf)
        p = self.basis.p
        if self.problem.free_period:
            lower[p], upper[p] = self.problem.stretch
        if size > p + self.problem.free_period:
            lower[-1], upper[-1] = S_RANGE
        solver.set_lower_bounds(lower)
        solver.set_upper_bounds(upper)

    def _optimised(self, solver: nlopt.opt, start: np.ndarray) -> np.ndarray:
        try:
            return np.array(solver.optimize(start))
        except (nlopt.RoundoffLimited, nlopt.runtime_error) as error:  # the best iterate stands
            self.reason = str(error)
        except NotExciting as error:
            self.reason = str(error)
        return start

    def _sum(self, y: np.ndarray, slope: np.ndarray) -> float:
        found = self.at(y)
        if slope.size:
            slope[:] = found.slopes[0] * self.scale
        return found.total * self.scale

    def _last(self, y: np.ndarray, slope: np.ndarray) -> float:
        if slope.size:
            slope[:] = 0.0
            slope[-1] = 1.0
        return float(y[-1])

    def _attainment(self, y: np.ndarray) -> float:
        gammas = [goal.attainment(value) for goal, value in zip(self.problem.goals, self.at(y).values) if goal.share]
        return float(np.clip(np.log(max(1.0 + max(gammas, default=0.0), 1e-9)), *S_RANGE))

    def _rows(self, result: np.ndarray, y: np.ndarray, slope: np.ndarray) -> None:
        goals = self.problem.goals
        found = self.at(np.ascontiguousarray(y[:-1]) if goals else y)
        k, size = len(goals), len(found.slopes[0]) if len(found.slopes) else len(y)
        result[k:] = found.constraints
        if slope.size:
            slope[:] = 0.0
            slope[k:, :size] = found.rows
        for i, goal in enumerate(goals):
            value, grow = found.values[i], goal.share * np.exp(y[-1])
            bound = goal.goal + grow - goal.share
            if is_condition(goal.objective):
                bound = max(bound, 1.0)
                result[i], by_value, by_s = np.log(value / bound), 1.0 / value, -grow / bound
            else:
                size_of = max(abs(goal.goal), 1e-3)
                result[i], by_value, by_s = (value - bound) / size_of, 1.0 / size_of, -grow / size_of
            if slope.size:
                slope[i, :size] = by_value * found.slopes[i]
                slope[i, -1] = by_s
