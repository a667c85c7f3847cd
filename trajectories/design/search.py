"""Search from one start motion: sequential quadratic programming on the problem, smoothed less from stage to stage.

The first stage uses half of the samples and, where the problem has a coarse family, motions of few harmonics; this
makes most of the progress at a fraction of the cost. The result is the best motion that satisfied all constraints at
the samples, which need not be the last one.
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
    """Settings of one stage of a search.

    Attributes:
        spectra: exponent p of the smoothed excitation indices; the larger, the less they are smoothed.
        constraints: sharpness ρ of the smoothed constraints; the larger, the less they are smoothed.
        tolerance: SLSQP's tolerance.
        share: share (0 to 1) of the search's evaluations that the stage may use.
        rough: True uses half of the samples.
        coarse: True uses the problem's coarse family.
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
    """Raised inside a stage when the stage has used all its evaluations."""


@dataclass(frozen=True, eq=False)
class SearchResult:
    """Result of a search.

    Attributes:
        x: (p,) free variables of the motion family (coefficients that the equations of rest leave free).
        factor: factor on the family's period.
        merit: the weighted sum of the objectives; for problems with goals γ, the largest relative miss of the goals.
        values: (k,) unsmoothed values of the objectives, or of the goals' objectives, at the problem's samples.
        history: merits of the feasible iterates that improved on all before, falling.
        evaluations: number of evaluations of constraints and merit.
        feasible: share of the evaluations that satisfied all constraints at the samples.
        seconds: wall-clock time of the search [s].
        seed: number of the random start; −1 for a start given by its variables.
        interrupted: True where Ctrl-C ended the search.
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
        x, factor: free variables (p,) of the family and factor on the period of the motion that violated the
            constraints least.
        excess: largest violation of the constraints by this motion, and of the hard goals, each relative to its scale.
        evaluations: number of evaluations of the search.
        reason: why the optimiser ended; empty where it gives no reason.
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
    """Return the result of the search from one start motion.

    The best motion of a stage may violate a limit between the samples by more than a share of the limit's scale. The
    stage is then repeated with the instants of violation as extra times. It begins from the best motion or, where this
    cannot be repaired, from the last motion that satisfies the limits.

    Args:
        problem: the problem.
        evaluations: largest number of evaluations over all of `STAGES`.
        method: optimiser, "slsqp", "auglag", "mma" or "ccsaq"; see `calib.trajectories.design.optimise.design`.
        seed: seed of the random start.
        start: number (from 0) of the random start, or variables (p,) of the motion to start from.
        stages: the stages to run; a search from given variables never uses the coarse family.

    Returns:
        The result; a `Stuck` where no motion satisfied the constraints.
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
    """Return the problem with the samples and the family of a stage, and the linear map from variables to its motion.

    Args:
        problem: the full problem.
        stage: the stage, which may use half of the samples or the coarse family.
        extra: further times [s] at which the constraints are evaluated.
    """
    problem = replace(problem, extra=extra)
    if stage.rough:
        problem = replace(problem, samples=max(8, problem.samples // 2))
    if stage.coarse and problem.coarse is not None:
        problem = replace(problem, family=problem.coarse)
    return problem, problem.basis()


class StartSearch:
    """Search from one start motion in one problem: the state that the optimiser's callbacks share.

    Args:
        problem: the excitation problem.
        basis: linear map from variables to motion of the problem.
    """

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
        """Return the best feasible point so far; without one, the point that violates the constraints least.

        A point y is the family's variables x (p,), with the factor on the period where the period is free.

        Args:
            last: the point to return if none was evaluated.
        """
        if self.best is not None:
            return self.best
        if self.nearest is not None:
            return self.nearest
        return last

    def broken(self, y: np.ndarray) -> np.ndarray:
        """Return the times [s] at which the motion of a point y violates limits between samples.

        Violations are counted from `max_break` on, a share of a limit's scale. The result is empty if there are none.
        """
        # of a constraint's scale: a motion that breaks it by more between the samples leads nowhere (our choice)
        max_break = 0.02
        return critical_times(self.problem, y, max_break)

    def last_unbroken(self) -> np.ndarray:
        """Return the last improving point that satisfies the limits between samples, found by bisection.

        If no point does, the first point is returned.
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
        """Return a search in another problem with this search's history, and the point y in that problem's variables.

        Args:
            y: point of this search: variables (p,), with the factor on the period where the period is free.
            problem: the other problem.
            basis: linear map from variables to motion of the other problem.
        """
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
        """Return the result of the search, which ended at the point y after `seconds` [s].

        Args:
            y: last point: variables (p,), with the factor on the period where the period is free.
            seconds: wall-clock time of the search [s].
            seed: number of the random start, to be recorded; −1 for a start given by its variables.
        """
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
        """Return the evaluation of the point y, computed once per point; the best feasible point is remembered."""
        key = (y.tobytes(), self.sharpness)
        if self._evaluation is None or key != self._at:
            self._evaluation = evaluate(self.problem, self.basis, y, self.sharpness)
            self._at = key
            self.count += 1
            self.remember(np.array(y), self._evaluation)
        return self._evaluation

    def remember(self, y: np.ndarray, evaluation: Evaluation) -> None:
        """Remember a feasible point if it is the best so far, and any point if it violates the constraints least.

        Args:
            y: the point.
            evaluation: constraints and objectives evaluated at y.
        """
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
        """Return a point that satisfies the constraints: y repaired or, if this fails, y's motion scaled down."""
        evaluation = self.repaired(y)
        max_halvings = 4  # times that a motion is halved which cannot be brought back inside
        for _ in range(max_halvings):
            if self.least[0] <= KEPT:  # some point keeps the constraints, whether or not the hard goals
                break
            y = shrunk(self.problem, y, 0.5)
            evaluation = self.repaired(y)
        return evaluation

    def repaired(self, y: np.ndarray, evaluations: int = 80) -> np.ndarray:
        """Return a point that satisfies the constraints, found from y by minimising their violation with L-BFGS.

        The violation is Σ max(0, c + 0.01)² of the smoothed constraints c ≤ 0. If the minimisation does not succeed,
        its last point is returned.

        Args:
            y: the point to start from.
            evaluations: largest number of evaluations.
        """
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
        """Return the optimiser's last point for the smoothed problem.

        With goals, the optimiser also varies s, where γ = e^s - 1 is the relative amount by which goals are missed.

        Args:
            y: the point to start from.
            evaluations: largest number of evaluations.
            method: optimiser, "slsqp", "auglag", "mma" or "ccsaq".
            tolerance: relative change of the merit at which the optimiser stops.
        """
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
        """Return the number of inequalities of constraints and goals together.

        Args:
            y: any point, at which they are evaluated.
        """
        return len(self.at(np.ascontiguousarray(y)).constraints) + len(self.problem.goals)

    def _by_scipy(self, start: np.ndarray, last: int, tolerance: float) -> np.ndarray:
        """Return the last point of SciPy's SLSQP (Kraft 1988), run until the search has made `last` evaluations.

        SciPy's version solves the quadratic subproblems faster than NLopt's.

        Args:
            start: point to start from, followed by s where the problem has goals.
            last: number of evaluations of the whole search at which to stop.
            tolerance: change of the merit at which SLSQP stops.
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
        """Return the lower and upper bounds, each (size,), of the `size` variables of the optimiser.

        Bounded are the factor on the period, and s of the goal attainment γ = e^s - 1, so that γ is from -0.98 to 10⁵.
        The family's variables x are not bounded.
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
