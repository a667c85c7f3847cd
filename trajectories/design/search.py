"""One start's search: sequential quadratic programming on the smoothed problem, sharper from stage to stage.

The first stage uses half of the samples and, where the problem names a coarser family, motions of few harmonics: most
progress costs a fraction in this way. The result is the best motion that kept all constraints at the samples, not the
last one.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np
from scipy.optimize import minimize

from ..basis import Basis
from ..design.problem import Evaluation, ExcitationProblem, critical_times, evaluate, is_condition, merit, unmet
from ..design.starts import random_start, shrunk
from ..errors import NotExciting

if TYPE_CHECKING:
    import nlopt

Method = Literal["slsqp", "auglag", "mma", "ccsaq"]


class Stage(NamedTuple):
    """Stage of a search.

    Attributes:
        spectra: sharpness p of the spectra.
        constraints: sharpness ρ of the constraints.
        tolerance: SLSQP's tolerance.
        share: share of the evaluations.
        rough: half of the samples are used.
        coarse: the coarse family is used.
    """

    spectra: float
    constraints: float
    tolerance: float
    share: float
    rough: bool = False
    coarse: bool = False

    @property
    def sharpness(self) -> tuple[float, float]:
        return self.spectra, self.constraints


STAGES = (
    Stage(4.0, 100.0, 1e-4, 0.2, rough=True, coarse=True),
    Stage(10.0, 200.0, 1e-5, 0.35, rough=True),
    Stage(30.0, 500.0, 1e-5, 0.25),
    Stage(100.0, 2000.0, 1e-6, 0.2),
)
"""Our choice."""
S_RANGE = (-4.0, 12.0)
KEPT = 1e-7  # of a constraint's scale, by which a point that keeps it may break it: rounding


class _Spent(Exception):
    """Raised when the evaluations are used up."""


@dataclass(frozen=True, eq=False)
class SearchResult:
    """Result of a search.

    Attributes:
        x: (p,) variables of the family.
        factor: factor on the family's period.
        merit: the weighted sum, or γ.
        values: (k,) unsmoothed objectives or goals at the problem's samples.
        history: merits of the improving feasible iterates, falling.
        evaluations: number of evaluations of constraints and merit.
        feasible: share of the evaluations that kept all constraints at the samples.
        seconds: wall-clock time of the search [s].
        seed: number of the random start; −1 for a given start.
        interrupted: True after Ctrl-C.
        times: processor time [s] since the search began, for each entry of `history`.
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
    """Result of a search that found no feasible motion.

    Attributes:
        x, factor: variables and factor on the period of the motion that broke the constraints least.
        excess: its largest excess over the constraints, and over the hard goals, each relative to their scale.
        evaluations: number of evaluations of the search.
        reason: why the optimiser ended, empty where it gives no reason.
    """

    x: np.ndarray
    factor: float
    excess: tuple[float, float]
    evaluations: int
    reason: str = ""


def one_start(
    problem: ExcitationProblem,
    evaluations: int,
    method: Method,
    seed: int,
    start: int | np.ndarray,
    stages: tuple[Stage, ...] = STAGES,
) -> SearchResult | Stuck:
    """Search from one random start (its number) or from given variables (p,).

    Where the best motion of a stage breaks a limit between the samples by more than a share of its scale, the stage is
    repeated with those instants as extra times, from that motion or, where it cannot be repaired, from the last motion
    that keeps the limits.

    Args:
        problem: the problem.
        evaluations: largest number of evaluations over all of `STAGES`.
        method: see `calib.trajectories.design.optimise.design`.
        seed: seed of the random start.
        start: number of the random start, or variables to start from.
        stages: the stages to run; given variables are never searched in the coarse family.

    Returns:
        The result, or a `Stuck` where no motion kept the constraints.
    """
    began = time.perf_counter()
    random = isinstance(start, int | np.integer)
    chosen = tuple(stages)
    if not random:
        chosen = tuple(stage._replace(coarse=False) for stage in stages)
    extra = problem.extra
    run = StartSearch(*_at_stage(problem, chosen[0], extra))
    if random:
        generator = np.random.default_rng([seed, int(start)])
        y = random_start(run.problem, run.basis, generator)
    else:
        y = np.asarray(start, dtype=float)
        if problem.free_period and len(y) == run.basis.p:
            y = np.append(y, np.clip(1.0, *problem.stretch))
    repair_evaluations = 30  # evaluations to bring a stage's last motion back inside
    max_retries = 3  # of a stage that ends with such a motion
    try:
        for number, stage in enumerate(chosen):
            if number:
                run, y = run.continued(run.reached(y), *_at_stage(problem, stage, extra))
            max_evaluations = max(2, round(evaluations * stage.share))
            for retries_left in range(0 if stage.rough else max_retries, -1, -1):
                run.sharpness = stage.sharpness
                y = run.solve(run.inside(y), max_evaluations, method, stage.tolerance)
                y = run.repaired(y, repair_evaluations)  # SLSQP travels outside, and may have ended there
                deep = np.zeros(0)
                if run.best is not None:
                    deep = run.broken(run.best)
                extra = np.union1d(extra, deep)
                if not len(deep) or not retries_left:
                    break
                back = run.last_unbroken()
                run, y = run.continued(run.reached(y), *_at_stage(problem, stage, extra))
                y = run.repaired(y)
                if run.least[0] > KEPT:
                    y = back
    except KeyboardInterrupt:
        if run.best is None:
            raise
        run.interrupted = True
    if run.problem.family is not problem.family:  # interrupted before the whole family was looked at
        run, y = run.continued(run.reached(y), problem, problem.basis())
        run.repaired(y)
    seconds = time.perf_counter() - began
    start_number = -1
    if random:
        start_number = int(start)
    return run.result(y, seconds, start_number)


def _at_stage(problem: ExcitationProblem, stage: Stage, extra: np.ndarray) -> tuple[ExcitationProblem, Basis]:
    """Return the problem as a stage sees it (samples, family), with `extra` times [s], and its basis."""
    problem = replace(problem, extra=extra)
    if stage.rough:
        problem = replace(problem, samples=max(8, problem.samples // 2))
    if stage.coarse and problem.coarse is not None:
        problem = replace(problem, family=problem.coarse)
    return problem, problem.basis()


class StartSearch:
    """One start's search in one problem: the state shared by the optimiser's callbacks."""

    def __init__(self, problem: ExcitationProblem, basis: Basis):
        self.problem = problem
        self.basis = basis
        self.sharpness = STAGES[0].sharpness
        self.best: np.ndarray | None = None
        self.nearest: np.ndarray | None = None
        self.merit = np.inf
        self.least = (np.inf, np.inf)
        self.values = np.zeros(0)
        self.history: list[float] = []
        self.times: list[float] = []
        self.began = time.process_time()
        self.count = self.kept = 0
        self.interrupted = False
        self.reason = ""
        self.scale = 1.0
        self._at: tuple[bytes, tuple[float, float]] | None = None
        self._evaluation: Evaluation | None = None
        self._tried = np.zeros(0)
        self._trail: list[np.ndarray] = []

    def reached(self, last: np.ndarray) -> np.ndarray:
        """Return the best feasible point, else the least infeasible, else the last point."""
        if self.best is not None:
            return self.best
        if self.nearest is not None:
            return self.nearest
        return last

    def broken(self, y: np.ndarray) -> np.ndarray:
        """Return times [s] at which a motion breaks limits between samples by more than `max_break`; empty if none."""
        # of a constraint's scale: a motion that breaks it by more between the samples leads nowhere (our choice)
        max_break = 0.02
        return critical_times(self.problem, y, max_break)

    def last_unbroken(self) -> np.ndarray:
        """Return the last improving point that keeps the limits between samples, by bisection; the first point if none
        does.
        """
        low, high = 0, len(self._trail) - 1
        while high - low > 1:
            middle = (low + high) // 2
            if len(self.broken(self._trail[middle])):
                high = middle
            else:
                low = middle
        return self._trail[low]

    def continued(self, y: np.ndarray, problem: ExcitationProblem, basis: Basis) -> tuple[StartSearch, np.ndarray]:
        """Return the search continued in another problem, and the point y expressed in that problem's variables."""
        if problem.family is not self.problem.family:
            p = self.basis.p
            path = self.problem.family.basis(basis.times).motion(y[:p])
            y = np.append(basis.nearest(path.q), y[p:])
        new = StartSearch(problem, basis)
        new.history = self.history
        new.times = self.times
        new.began = self.began
        new.count = self.count
        new.kept = self.kept
        new.interrupted = self.interrupted
        new.reason = self.reason
        return new, y

    def result(self, y: np.ndarray, seconds: float, seed: int) -> SearchResult | Stuck:
        """Return the result of the search, which ended at the point y after `seconds` [s]."""
        p = self.basis.p
        stretch = self.problem.stretch
        best = self.reached(y)
        if self.problem.free_period:
            factor = float(best[p])
        else:
            factor = stretch[0]
        if self.best is None:
            return Stuck(best[:p], factor, self.least, self.count, self.reason)
        records = list[int]()  # fewer samples may have promised more
        for k, value in enumerate(self.history):
            if value >= self.merit and (not records or value < self.history[records[-1]]):
                records.append(k)
        history = tuple(self.history[k] for k in records)
        times = tuple(self.times[k] for k in records)
        return SearchResult(
            best[:p],
            factor,
            self.merit,
            self.values,
            history,
            self.count,
            self.kept / self.count,
            seconds,
            seed,
            self.interrupted,
            times,
        )

    def at(self, y: np.ndarray) -> Evaluation:
        """Return the evaluation of a point, computed once; the best feasible point is remembered."""
        key = (y.tobytes(), self.sharpness)
        if self._evaluation is None or key != self._at:
            self._evaluation = evaluate(self.problem, self.basis, y, self.sharpness)
            self._at = key
            self.count += 1
            self.remember(np.array(y), self._evaluation)
        return self._evaluation

    def remember(self, y: np.ndarray, evaluation: Evaluation) -> None:
        """Remember a point if it keeps the limits and is the best so far, or if it breaks them least so far."""
        missed = None
        if self.problem.goals:
            missed = unmet(self.problem, evaluation.values)
        goal_lacking = 0.0
        if missed:
            goal_lacking, *_ = missed
        lacking = (max(evaluation.excess, 0.0), goal_lacking)
        if lacking < self.least:
            self.least, self.nearest = lacking, y
        if evaluation.excess > KEPT:
            return
        self.kept += 1
        value = merit(self.problem, evaluation.exact)
        if value < self.merit:
            self.best = y
            self.merit = value
            self.values = evaluation.exact
            self._trail.append(y)
            self.history.append(value)
            self.times.append(time.process_time() - self.began)

    def inside(self, y: np.ndarray) -> np.ndarray:
        """Return a point that keeps the constraints: y repaired, or a smaller motion where that fails."""
        evaluation = self.repaired(y)
        max_halvings = 4  # times that a motion is halved which cannot be brought back inside
        for _ in range(max_halvings):
            if self.least[0] <= KEPT:  # some point keeps the constraints, whether or not the hard goals
                break
            y = shrunk(self.problem, y, 0.5)
            evaluation = self.repaired(y)
        return evaluation

    def repaired(self, y: np.ndarray, evaluations: int = 80) -> np.ndarray:
        """Return a point that keeps constraints, or the last one of the repair: min Σ max(0, c + 0.01)² by L-BFGS."""
        if not self.problem.constraints or self.at(y).constraints.max() <= 0:
            return y

        def excess(z: np.ndarray, slope: np.ndarray) -> float:
            evaluation = self.at(z)
            over = np.maximum(evaluation.constraints + 0.01, 0.0)
            if slope.size:
                slope[:] = 2 * over @ evaluation.rows
            return float((over**2).sum())

        import nlopt

        solver = nlopt.opt(nlopt.LD_LBFGS, len(y))
        solver.set_min_objective(excess)
        solver.set_stopval(1e-8)
        solver.set_maxeval(evaluations)
        self._bound(solver, len(y))
        return self._optimised(solver, y)

    def solve(self, y: np.ndarray, evaluations: int, method: Method, tolerance: float = 1e-5) -> np.ndarray:
        """Return the optimiser's last point y for the smoothed problem; with goals it also varies s, γ = e^s - 1."""
        goals = self.problem.goals
        if goals:
            start = np.append(y, self._attainment(y))
        else:
            start = y
        last = self.count + evaluations
        self.scale = 1.0
        if not goals:  # a slope of at most 1 at the start: the first step is as long as the slope
            slope = np.zeros(len(y))
            self._sum(np.ascontiguousarray(y), slope)
            self.scale = 1.0 / max(1.0, float(np.linalg.norm(slope)))
        if method == "slsqp":
            return self._by_scipy(start, last, tolerance * self.scale)[: len(y)]
        import nlopt

        algorithms = {"auglag": nlopt.AUGLAG, "mma": nlopt.LD_MMA, "ccsaq": nlopt.LD_CCSAQ}
        solver = nlopt.opt(algorithms[method], len(start))
        if method == "auglag":
            inner = nlopt.opt(nlopt.LD_LBFGS, len(start))
            inner.set_ftol_rel(1e-5)
            inner.set_maxeval(max(20, evaluations // 6))
            solver.set_local_optimizer(inner)
        solver.set_min_objective(self._last if goals else self._sum)
        rows = self._count(y)
        if rows:
            solver.add_inequality_mconstraint(self._rows, np.full(rows, 1e-8))
        self._bound(solver, len(start))
        solver.set_ftol_rel(1e-5)
        solver.set_maxeval(evaluations)
        return self._optimised(solver, start)[: len(y)]

    def _count(self, y: np.ndarray) -> int:
        """Return the number of inequalities, including those of goals."""
        return len(self.at(np.ascontiguousarray(y)).constraints) + len(self.problem.goals)

    def _by_scipy(self, start: np.ndarray, last: int, tolerance: float) -> np.ndarray:
        """Return the last point of SciPy's SLSQP (Kraft 1988), run until the search has made `last` evaluations.

        Its subproblems are solved faster than in NLopt.
        """
        self._tried = start
        goal_variables = bool(self.problem.goals)
        rows = self._count(start[: len(start) - goal_variables])
        size = len(start)
        if self.problem.goals:
            objective = self._last
        else:
            objective = self._sum

        def value(y: np.ndarray) -> float:
            if self.count >= last:
                raise _Spent
            self._tried = np.array(y)
            return objective(np.ascontiguousarray(y), np.zeros(0))

        def gradient(y: np.ndarray) -> np.ndarray:
            slope = np.zeros(size)
            objective(np.ascontiguousarray(y), slope)
            return slope

        def inequalities(y: np.ndarray, slopes: np.ndarray) -> np.ndarray:
            values = np.empty(rows)
            self._rows(values, np.ascontiguousarray(y), slopes)
            return values

        def sloped(y: np.ndarray) -> np.ndarray:
            slopes = np.empty((rows, size))
            inequalities(y, slopes)
            return -slopes

        inequality = {"type": "ineq", "fun": lambda y: -inequalities(y, np.empty((0, size))), "jac": sloped}
        constraints = []
        if rows:
            constraints.append(inequality)
        bounds = None
        if self.problem.free_period or self.problem.goals:
            bounds = np.column_stack(self._ends(size))
        try:
            run = minimize(
                value,
                start,
                method="SLSQP",
                jac=gradient,
                bounds=bounds,
                constraints=constraints,
                options={"maxiter": max(2, last - self.count), "ftol": tolerance},
            )
        except _Spent:
            return self._tried
        except NotExciting as error:
            self.reason = str(error)
            return start
        self.reason = ""
        if not run.success:
            self.reason = str(run.message)
        return run.x

    def _ends(self, size: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the bounds of all variables: of the factor on the period, and of s (γ from -0.98 to 10⁵); x is not
        bounded.
        """
        lower = np.full(size, -np.inf)
        upper = np.full(size, np.inf)
        p = self.basis.p
        if self.problem.free_period:
            lower[p], upper[p] = self.problem.stretch
        if size > p + self.problem.free_period:
            lower[-1], upper[-1] = S_RANGE
        return lower, upper

    def _bound(self, solver: nlopt.opt, size: int) -> None:
        lower, upper = self._ends(size)
        solver.set_lower_bounds(lower)
        solver.set_upper_bounds(upper)

    def _optimised(self, solver: nlopt.opt, start: np.ndarray) -> np.ndarray:
        import nlopt

        try:
            return np.array(solver.optimize(start))
        except (nlopt.RoundoffLimited, nlopt.runtime_error) as error:  # the best iterate stands
            self.reason = str(error)
        except NotExciting as error:
            self.reason = str(error)
        return start

    def _sum(self, y: np.ndarray, slope: np.ndarray) -> float:
        evaluation = self.at(y)
        if slope.size:
            slope[:] = evaluation.slopes[0] * self.scale
        return evaluation.total * self.scale

    def _last(self, y: np.ndarray, slope: np.ndarray) -> float:
        if slope.size:
            slope[:] = 0.0
            slope[-1] = 1.0
        return float(y[-1])

    def _attainment(self, y: np.ndarray) -> float:
        values = self.at(y).values
        gammas = [goal.attainment(value) for goal, value in zip(self.problem.goals, values) if goal.share]
        largest = max(gammas, default=0.0)
        s = np.log(max(1.0 + largest, 1e-9))
        return float(np.clip(s, *S_RANGE))

    def _rows(self, result: np.ndarray, y: np.ndarray, slope: np.ndarray) -> None:
        goals = self.problem.goals
        point = y
        if goals:
            point = np.ascontiguousarray(y[:-1])
        evaluation = self.at(point)
        k = len(goals)
        size = len(y) - bool(goals)
        result[k:] = evaluation.constraints
        if slope.size:
            slope[:] = 0.0
            slope[k:, :size] = evaluation.rows
        for i, goal in enumerate(goals):
            value = evaluation.values[i]
            grow = goal.share * np.exp(y[-1])
            bound = goal.goal + grow - goal.share
            if is_condition(goal.objective):
                bound = max(bound, 1.0)
                result[i] = np.log(value / bound)
                by_value = 1.0 / value
                by_s = -grow / bound
            else:
                size_of = max(abs(goal.goal), 1e-3)
                result[i] = (value - bound) / size_of
                by_value = 1.0 / size_of
                by_s = -grow / size_of
            if slope.size:
                slope[i, :size] = by_value * evaluation.slopes[i]
                slope[i, -1] = by_s
