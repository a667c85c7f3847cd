"""An excitation problem: a family sampled over its period, objectives or goals, and constraints, with all gradients.

Goal attainment (Gembicki 1974; the paper's eq. 24): min γ subject to F_i - w_i γ ≤ g_i, w_i = |g_i| by default, so that
γ is the relative under- or overattainment; w_i = 0 makes a goal hard. Inside, γ = e^s - 1 with s free, and goals on a
condition number are compared by logarithm: the same optimum, well scaled from 10⁶ down (our choice).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from trajectories.basis import Basis, Family, SampledMotion, sample_times
from trajectories.constraints import MotionConstraint, Product, Regressor, gathered
from trajectories.design.objectives import Excitation, Objective
from trajectories.errors import BadInput


@dataclass(frozen=True, eq=False)
class AttainmentGoal:
    """F ≤ goal + weight · γ; weight None: |goal|, 0: hard."""

    objective: Objective
    goal: float
    weight: float | None = None

    def __post_init__(self) -> None:
        if not np.isfinite(self.goal) or (self.weight is not None and not 0 <= self.weight < np.inf):
            raise BadInput(f"goal {self.goal} with weight {self.weight}: expected a number, and a weight of 0 or more")

    @property
    def share(self) -> float:
        return abs(self.goal) if self.weight is None else self.weight

    def attainment(self, value: float) -> float:
        """Return the γ at which F = value just meets the goal; 0 or infinite where the goal is hard."""
        if self.share == 0:
            return -np.inf if value <= self.goal + 1e-6 * max(abs(self.goal), 1e-3) else np.inf
        return (value - self.goal) / self.share


@dataclass(frozen=True, eq=False)
class ExcitationProblem:
    """What is to be designed.

    Attributes:
        family: of motions over one period.
        regressor, product: (N, n, b) of q, v, a, and its derivative product: (q, v, a, G) -> slopes of Σ G · Y.
        objectives: pairs (objective, weight) of the sum to minimise (a condition number enters by its logarithm);
            ignored where there are goals.
        constraints: of `trajectories.constraints`.
        goals: of goal attainment.
        samples: instants over the period at which all is evaluated.
        stretch: (least, most) factor on the period; equal ends fix it.
        tightening: how far inside the constraints to stay, as a share of each one's scale: room for what happens
            between the samples.
    """

    family: Family
    regressor: Regressor
    product: Product
    objectives: tuple[tuple[Objective, float], ...] = ((Excitation(), 1.0),)
    constraints: tuple[MotionConstraint, ...] = ()
    goals: tuple[AttainmentGoal, ...] = ()
    samples: int = 200
    stretch: tuple[float, float] = (1.0, 1.0)
    tightening: float = 0.003

    def __post_init__(self) -> None:
        if not 0 < self.stretch[0] <= self.stretch[1]:
            raise BadInput(f"stretch {self.stretch}: expected two positive factors, the smaller first")
        if self.samples < 8:
            raise BadInput(f"{self.samples} samples: expected 8 or more over a period")
        if not self.objectives and not self.goals:
            raise BadInput("nothing to design for: give objectives or goals")

    @property
    def free_period(self) -> bool:
        return self.stretch[0] < self.stretch[1]

    def basis(self) -> Basis:
        return self.family.basis(sample_times(self.family.period, self.samples))


@dataclass(frozen=True, eq=False)
class Evaluation:
    """A point: merit and objectives with gradients by the variables (x, the factor on the period).

    Attributes:
        values: (k,) of the objectives or goals, smoothed; `slopes` (k, p).
        constraints: (r,) smoothed, feasible where ≤ 0; `rows` (r, p).
        excess: largest constraint value at the samples, over its scale.
    """

    motion: SampledMotion
    regressor: np.ndarray
    values: np.ndarray
    slopes: np.ndarray
    constraints: np.ndarray
    rows: np.ndarray
    excess: float


def evaluate(problem: ExcitationProblem, basis: Basis, y: np.ndarray, sharpness: tuple[float, float]) -> Evaluation:
    """Evaluate everything at y = (x, factor on the period if that is free).

    Args:
        basis: `ExcitationProblem.basis`.
        sharpness: p of the spectra and ρ of the constraints.
    """
    x, factor = (y[:-1], float(y[-1])) if problem.free_period else (y, problem.stretch[0])
    motion = stretched(basis.motion(x), factor)
    Y = problem.regressor(motion.q, motion.v, motion.a)
    values, slopes, by_duration = list[float](), list[np.ndarray](), list[float]()
    for objective in terms(problem):
        found = _sharpened(objective, sharpness[0]).evaluate(motion, Y)
        slope = np.zeros((4, *motion.q.shape)) if found.by_motion is None else found.by_motion
        if found.by_regressor is not None:
            slope[:3] += problem.product(motion.q, motion.v, motion.a, found.by_regressor)
        values.append(found.value)
        slopes.append(slope)
        by_duration.append(found.by_duration)
    parts = [gathered(c, motion, sharpness[1], problem.tightening) for c in problem.constraints]
    stacked = np.concatenate([np.array(slopes), *(part[1] for part in parts)])
    gradient = _by_variables(problem, basis, motion, stacked, factor, np.array(by_duration))
    k = len(values)
    return Evaluation(
        motion, Y, np.array(values), gradient[:k], np.concatenate([np.zeros(0), *(part[0] for part in parts)]),
        gradient[k:], max((part[2] for part in parts), default=-np.inf),
    )  # fmt: skip


def terms(problem: ExcitationProblem) -> list[Objective]:
    """Return the objectives that are evaluated: those of the goals, or those of the sum."""
    return [goal.objective for goal in problem.goals] or [one for one, _ in problem.objectives]


def _sharpened(objective: Objective, p: float) -> Objective:
    return replace(objective, sharpness=p) if isinstance(objective, Excitation) else objective


def is_condition(objective: Objective) -> bool:
    return isinstance(objective, Excitation) and objective.index == "cond"


def exact_values(problem: ExcitationProblem, motion: SampledMotion, regressor: np.ndarray) -> np.ndarray:
    """Return the unsmoothed objectives of a motion (k,)."""
    return np.array([_sharpened(one, np.inf).evaluate(motion, regressor).value for one in terms(problem)])


def merit(problem: ExcitationProblem, values: np.ndarray) -> float:
    """Return what is minimised: γ, or the weighted sum with condition numbers by their logarithm."""
    if problem.goals:
        return max(goal.attainment(value) for goal, value in zip(problem.goals, values))
    total = 0.0
    for (objective, weight), value in zip(problem.objectives, values):
        total += weight * (np.log(value) if is_condition(objective) else value)
    return float(total)


def unmet(problem: ExcitationProblem, values: np.ndarray) -> tuple[float, AttainmentGoal | None, float]:
    """Return by how much the worst hard goal is missed, as a share of it, that goal, and its value; or zeros."""
    worst: tuple[float, AttainmentGoal | None, float] = (0.0, None, 0.0)
    for goal, value in zip(problem.goals, values):
        lacking = (value - goal.goal) / max(abs(goal.goal), 1e-3)
        if goal.share == 0 and lacking > worst[0]:
            worst = (float(lacking), goal, float(value))
    return worst


def stretched(motion: SampledMotion, factor: float) -> SampledMotion:
    """Return the motion along the same path, `factor` times slower."""
    if factor == 1.0:
        return motion
    return SampledMotion(
        factor * motion.times, motion.q, motion.v / factor, motion.a / factor**2, motion.jerk / factor**3
    )


def _by_variables(
    problem: ExcitationProblem,
    basis: Basis,
    motion: SampledMotion,
    slopes: np.ndarray,
    factor: float,
    by_duration: np.ndarray,
) -> np.ndarray:
    """Return gradients (m, p) by (x, factor): d v/d factor = -v / factor, and so on."""
    powers = factor ** np.arange(4)
    gradient = basis.adjoint(slopes / powers[:, None, None] if factor != 1.0 else slopes)
    if not problem.free_period:
        return gradient
    last = np.zeros(len(slopes))
    for order in (1, 2, 3):
        last -= order / factor * np.einsum("mij,ij->m", slopes[:, order], motion.orders[order])
    last[: len(by_duration)] += problem.family.period * by_duration
    return np.concatenate([gradient, last[:, None]], axis=1)
