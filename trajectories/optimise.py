"""Search for exciting motions: sequential quadratic programming from several feasible starts, gradients exact.

A start is a random motion inside the joint limits; if it breaks another constraint it is repaired (the squared excess
is minimised). Then the smoothed problem is solved three times, each time sharper, from where the last search ended. The
best motion that kept all constraints at the samples is returned, not the last one.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal, get_args

import nlopt
import numpy as np

from trajectories.basis import Basis, Motion
from trajectories.constraints import BoxLimit
from trajectories.errors import BadInput, NotExciting, NothingFeasible
from trajectories.problem import (
    Evaluation,
    Problem,
    evaluate,
    exact_values,
    is_condition,
    merit,
    stretched,
    unmet,
)  # fmt: skip

Method = Literal["slsqp", "auglag", "mma"]
STAGES = ((4.0, 100.0), (10.0, 200.0), (30.0, 500.0))
"""Sharpness of the spectra and of the constraints, stage by stage (our choice)."""
S_RANGE = (-4.0, 12.0)


@dataclass(frozen=True, eq=False)
class Found:
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


def design(
    problem: Problem,
    *,
    starts: int = 6,
    evaluations: int = 600,
    method: Method = "slsqp",
    seed: int = 0,
    guesses: tuple[np.ndarray, ...] = (),
    map: Callable = map,
    report: Callable[[int, int, str], None] | None = None,
) -> Found:
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
    found, stuck, spent = list[Found](), list[Stuck](), 0
    interrupted = False
    try:
        for number, run in enumerate(map(partial(one_start, problem, evaluations, method, seed), tasks), 1):
            if isinstance(run, Found):
                found.append(run)
            else:
                stuck.append(run)
            spent += run.evaluations
            if report:
                best = min((one.merit for one in found), default=np.inf)
                report(number, len(tasks), f"best so far {best:.4g}" if found else "nothing feasible yet")
            if isinstance(run, Found) and run.interrupted:
                interrupted = True
                break
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


def one_start(problem: Problem, evaluations: int, method: Method, seed: int, start: int | np.ndarray) -> Found | Stuck:
    """Search from one random start (its number) or from given variables."""
    began = time.perf_counter()
    run = _Run(problem, problem.basis())
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
            y = run.solve(run.best if run.best is not None and stage else y, evaluations // len(stages), method)
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
    return Found(
        run.best[:p], factor, run.merit, run.values, tuple(run.history), run.count, share, seconds, label,
        run.interrupted,
    )  # fmt: skip


def random_start(problem: Problem, basis: Basis, rng: np.random.Generator) -> np.ndarray:
    """Draw variables of a motion about a random pose that fills a random part of the joint limits.

    The centre is the best of 200 poses by the constraints that a constant pose can break; the amplitude is scaled down
    to the limits of position, velocity, acceleration and jerk.
    """
    n = basis.n
    boxes = [c for c in problem.constraints if isinstance(c, BoxLimit)]
    lower, upper = np.full(n, -np.pi), np.full(n, np.pi)
    for box in (box for box in boxes if box.order == 0):
        lower, upper = np.maximum(lower, box.lower), np.minimum(upper, box.upper)
    middle, half = (lower + upper) / 2, (upper - lower) / 2
    poses = middle + half * rng.uniform(-0.6, 0.6, (200, n))
    still = np.zeros((200, n))
    resting = Motion(np.arange(200.0), poses, still, still, still)
    excess = np.zeros(200)
    for constraint in (c for c in problem.constraints if not isinstance(c, BoxLimit)):
        excess = np.maximum(excess, (constraint.values(resting) / constraint.scale).max(axis=1))
    centre = poses[np.argmin(np.maximum(excess, -0.1))]
    x = problem.family.random(rng, centre, 0.5 * half)
    constant = problem.family.random(rng, centre, np.zeros(n))
    factor = float(np.mean(problem.stretch))
    fill = _fitting(boxes, stretched(basis.motion(constant), factor), stretched(basis.motion(x), factor))
    x = constant + rng.uniform(0.5, 0.9) * fill * (x - constant)
    return np.append(x, factor) if problem.free_period else x


def _fitting(boxes: list[BoxLimit], still: Motion, moving: Motion) -> float:
    """Return the largest share (at most 1) of a motion about a pose inside the box limits."""
    share = 1.0
    for box in boxes:
        at, move = still.orders[box.order], moving.orders[box.order] - still.orders[box.order]
        with np.errstate(divide="ignore", invalid="ignore"):
            room = np.where(move > 0, (box.upper - at) / move, np.where(move < 0, (box.lower - at) / move, np.inf))
        share = min(share, float(np.nanmin(np.maximum(room, 0.02))))
    return share


class _Run:
    """One start's search: the state that NLopt's callbacks share."""

    def __init__(self, problem: Problem, basis: Basis):
        self.problem, self.basis = problem, basis
        self.sharpness = STAGES[0]
        self.best: np.ndarray | None = None
        self.nearest: np.ndarray | None = None
        self.merit, self.least = np.inf, (np.inf, np.inf)
        self.values = np.zeros(0)
        self.history: list[float] = []
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
        values = exact_values(self.problem, found.motion, found.regressor)
        value = merit(self.problem, values)
        if value < self.merit:
            self.best, self.merit, self.values = y, value, values
            self.history.append(value)

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
        found, total, gradient = self.at(y), 0.0, np.zeros(len(y))
        for (objective, weight), value, row in zip(self.problem.objectives, found.values, found.slopes):
            logarithm = is_condition(objective)
            total += weight * float(np.log(value) if logarithm else value)
            gradient += weight * (row / value if logarithm else row)
        if slope.size:
            slope[:] = gradient * self.scale
        return total * self.scale

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


def _nothing(problem: Problem, stuck: list[Stuck]) -> NothingFeasible:
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
