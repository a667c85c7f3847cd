"""An excitation problem: a motion family sampled over its period, objectives or goals, and constraints, with gradients.

Goal attainment (Gembicki 1974; Kolyubin, Shiriaev, Jubien 2019, eq. 24): min γ subject to F_i - w_i γ ≤ g_i for
objectives F_i with goals g_i. By default w_i = |g_i|, so that γ is the relative amount by which goals are missed
(negative: exceeded); w_i = 0 makes a goal hard, that is, a constraint. The optimiser varies s with γ = e^s - 1, and
goals on a condition number are compared by logarithm. This does not change the optimum, and keeps the problem well
scaled for condition numbers up to 10⁶ (our choice).
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from ..basis import Basis, Family, SampledMotion, sample_times
from ..constraints import MotionConstraint, Product, Regressor, Smoothed, smoothed
from ..design.objectives import Excitation, FrictionCoverage, Objective, Observed, TorqueSlack, Value
from ..errors import BadInput, require

_Matrix = tuple[int, int, int]
INSTANTS = 2000  # over a period at which a motion is looked at between its samples (our choice)


@dataclass(frozen=True, eq=False)
class AttainmentGoal:
    """Goal F ≤ goal + weight · γ on an objective F, where γ, the largest miss of all goals, is minimised.

    Attributes:
        objective: F.
        goal: the value to attain.
        weight: factor of γ; None takes |goal|, so that γ is a relative miss; 0 makes the goal hard (a constraint).
        words: wording of the goal in messages; empty for a wording made from name and value.
    """

    objective: Objective
    goal: float
    weight: float | None = None
    words: str = ""

    def __post_init__(self) -> None:
        if not np.isfinite(self.goal) or (self.weight is not None and not 0 <= self.weight < np.inf):
            raise BadInput(f"goal {self.goal} with weight {self.weight}: expected a number, and a weight of 0 or more")

    @property
    def share(self) -> float:
        if self.weight is None:
            return abs(self.goal)
        return self.weight

    def stated(self, value: float) -> float:
        """Return the value F of the objective, converted to the quantity that the goal's `words` name.

        This quantity is the mean torque over its limit, a share of time, or F itself.
        """
        if isinstance(self.objective, FrictionCoverage):
            return self.objective.wanted * (1.0 - float(np.sqrt(value)))  # of its rms shortfall
        if isinstance(self.objective, TorqueSlack):
            return 1.0 - value
        return value

    def attainment(self, value: float) -> float:
        """Return the attainment γ, for which the objective's `value` equals goal + weight · γ.

        Negative: the goal is exceeded. For a hard goal, γ is −∞ where the value meets the goal, else ∞.
        """
        if self.share == 0:
            rounding = 1e-6 * max(abs(self.goal), 1e-3)
            if value <= self.goal + rounding:
                return -np.inf
            return np.inf
        return (value - self.goal) / self.share


@dataclass(frozen=True, eq=False)
class ExcitationProblem:
    """Definition of an excitation design problem.

    Attributes:
        family: the family of motions over one period.
        regressor: (q, v, a) -> Y (N, n, b), which maps b dynamic parameters to the joint torques.
        product: derivative product of the regressor, (q, v, a, G (N, n, b)) -> slopes of Σ G · Y in q, v, a.
        objectives: pairs (objective, weight) of the weighted sum to minimise (of a condition number, the logarithm is
            added); ignored where there are goals.
        constraints: constraints on the motion, from `calib.trajectories.constraints`.
        goals: goals of goal attainment; empty for the weighted sum of the objectives.
        samples: number of instants over the period at which objectives and constraints are evaluated.
        stretch: (smallest, largest) factor on the period; equal numbers fix the period.
        extra: further times [s] within the period at which the constraints are evaluated.
        tightening: margin to keep from each constraint for the motion between the samples, as a share of the
            constraint's scale; one number or one per constraint.
        coarse: a family of fewer variables and the same period, in which searches from random starts begin; None takes
            `family`.

    Raises:
        BadInput: invalid stretch, fewer than 8 samples, a coarse family that does not match, or nothing to minimise.
    """

    family: Family
    regressor: Regressor
    product: Product
    objectives: tuple[tuple[Objective, float], ...] = ((Excitation(), 1.0),)
    constraints: tuple[MotionConstraint, ...] = ()
    goals: tuple[AttainmentGoal, ...] = ()
    samples: int = 200
    stretch: tuple[float, float] = (1.0, 1.0)
    extra: np.ndarray = field(default_factory=lambda: np.zeros(0))
    tightening: float | np.ndarray = 0.003
    coarse: Family | None = None

    def __post_init__(self) -> None:
        if not 0 < self.stretch[0] <= self.stretch[1]:
            raise BadInput(f"stretch {self.stretch}: expected two positive factors, the smaller first")
        require(self.samples >= 8, f"{self.samples} samples: expected 8 or more over a period")
        if self.coarse is not None and (self.coarse.n, self.coarse.period) != (self.family.n, self.family.period):
            raise BadInput("the coarse family must have the same joints and period as the family")
        require(self.objectives or self.goals, "nothing to design for: give objectives or goals")

    @property
    def free_period(self) -> bool:
        return self.stretch[0] < self.stretch[1]

    def basis(self) -> Basis:
        """Return the linear map from variables to the motion at the sample times, followed by the extra times."""
        times = np.append(sample_times(self.family.period, self.samples), self.extra)
        return self.family.basis(times)


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Evaluation of a problem at one point; merit and gradients are computed only when used.

    The gradients are by the variables x and, where the period is free, the factor on the period. Rejected steps of the
    optimiser need no gradients, and the repair of constraint violations needs no merit; leaving them out saves a third
    of the computation of a search.

    Attributes:
        problem: the problem.
        basis: the family's basis at the problem's times.
        motion: the motion at the samples, then at the extra times.
        factor: factor on the period.
        sharpness: p of the smoothed excitation indices.
        smoothed: smoothed values of each constraint.
        constraints: (r,) smoothed values of all constraints, satisfied where ≤ 0.
        excess: largest unsmoothed constraint value divided by its scale.
    """

    problem: ExcitationProblem
    basis: Basis
    motion: SampledMotion
    factor: float
    sharpness: float
    smoothed: tuple[Smoothed, ...]
    constraints: np.ndarray
    excess: float

    @cached_property
    def sampled(self) -> SampledMotion:
        """The motion at the samples only, without the extra times; the objectives depend on these."""
        if not len(self.problem.extra):
            return self.motion
        return self.motion.part(np.arange(self.problem.samples))

    @property
    def regressor(self) -> np.ndarray:
        return self.sampled.evaluated(self.problem.regressor)

    @property
    def values(self) -> np.ndarray:
        """Smoothed values (k,) of the objectives, or of the goals' objectives."""
        values, _ = self._found
        return np.array([value.value for value in values])

    @property
    def exact(self) -> np.ndarray:
        """Unsmoothed values (k,) of the objectives, or of the goals' objectives."""
        values, _ = self._found
        return np.array([value.exact for value in values])

    @property
    def total(self) -> float:
        """The weighted sum of the smoothed objectives; 0 for problems with goals."""
        if self.problem.goals:
            return 0.0
        values, _ = self._found
        total, _ = _summed(self.problem, [value.value for value in values])
        return total

    @property
    def slopes(self) -> np.ndarray:
        """Gradients (k, p) of the goals' objectives; without goals, the gradient (1, p) of the weighted sum."""
        return self._gradient[: len(self.problem.goals) or 1]

    @property
    def rows(self) -> np.ndarray:
        """Gradients (r, p) of the r smoothed constraints."""
        count = len(self.problem.goals) or 1
        if "_found" in self.__dict__:  # whoever asked for the merit will ask for its gradient
            return self._gradient[count:]
        empty = [np.zeros((4, *self.sampled.q.shape))] * count
        return self._by_variables(empty, np.zeros(count))[count:]

    @cached_property
    def _found(self) -> tuple[list[Value], dict[_Matrix, Observed]]:
        observed: dict[_Matrix, Observed] = {}
        terms = (_sharpened(term, self.sharpness) for term in _terms(self.problem))
        values = [_value(term, self.sampled, self.regressor, observed) for term in terms]
        return values, observed

    @cached_property
    def _gradient(self) -> np.ndarray:
        values, observed = self._found
        shares = np.eye(len(values))
        if not self.problem.goals:
            _, shares = _summed(self.problem, [value.value for value in values])
        slopes = [_slope(self.problem, self.sampled, self.regressor, values, share, observed) for share in shares]
        by_duration = np.array([value.by_duration for value in values])
        return self._by_variables(slopes, shares @ by_duration)

    def _by_variables(self, slopes: list[np.ndarray], by_duration: np.ndarray) -> np.ndarray:
        spread = np.zeros((len(slopes), 4, *self.motion.q.shape))
        spread[:, :, : self.problem.samples] = slopes
        part_slopes = [part.slopes(self.motion) for part in self.smoothed]
        stacked = np.concatenate([spread, *part_slopes])
        return _by_variables(self.problem, self.basis, self.motion, stacked, self.factor, by_duration)


def evaluate(problem: ExcitationProblem, basis: Basis, y: np.ndarray, sharpness: tuple[float, float]) -> Evaluation:
    """Return the evaluation of a problem at the point y = (x, factor on the period where the period is free).

    Args:
        problem: the problem.
        basis: result of `ExcitationProblem.basis`.
        y: (p + 1,) or (p,) the point: x (p,) are the family's free variables.
        sharpness: exponent p of the smoothed excitation indices, and ρ of the smoothed maximum (1/ρ) log Σ exp(ρ g) of
            the scaled constraints g.
    """
    x, factor = _variables(problem, y)
    motion = stretched(basis.motion(x), factor)
    tightenings = np.broadcast_to(problem.tightening, len(problem.constraints))
    of_spectra, of_constraints = sharpness
    parts = []
    for constraint, tightening in zip(problem.constraints, tightenings):
        parts.append(smoothed(constraint, motion, of_constraints, float(tightening)))
    values = np.concatenate([np.zeros(0), *(part.values for part in parts)])
    excess = max((part.excess for part in parts), default=-np.inf)
    return Evaluation(problem, basis, motion, factor, of_spectra, tuple(parts), values, excess)


def _variables(problem: ExcitationProblem, y: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the family's variables x (p,) and the factor on the period from the point y = (x, factor).

    Where the problem fixes the period, y is x alone, and the factor is that of the problem.
    """
    if problem.free_period:
        return y[:-1], float(y[-1])
    return y, problem.stretch[0]


def critical_times(
    problem: ExcitationProblem,
    y: np.ndarray,
    min_excess: float,
    constraints: Sequence[MotionConstraint] = (),
    count: int = INSTANTS,
) -> np.ndarray:
    """Return the times [s] within the family's period at which the motion violates constraints, or nearly does.

    Args:
        problem: the problem.
        y: free variables x (p,) of the family, then the factor on the period where the period is free.
        min_excess: violation from which a constraint is considered, as a share of its scale. Of such a constraint,
            instants up to a tenth of the scale below the limit are returned, too.
        constraints: constraints to check; empty checks those of the problem.
        count: number of instants to check.
    """
    times = sample_times(problem.family.period, count)
    x, factor = _variables(problem, y)
    motion = stretched(problem.family.basis(times).motion(x), factor)
    is_critical = np.zeros(len(times), dtype=bool)
    near_share = 0.1  # of a constraint's scale: instants so near to what is broken are looked at besides (our choice)
    for constraint in constraints or problem.constraints:
        shares = (constraint.values(motion) / constraint.scale).max(axis=1)
        is_critical |= (shares > -near_share) & (shares.max() > min_excess)
    critical = times[is_critical]
    max_extra = 150  # instants that are added at a time
    stride = -(-len(critical) // max_extra)
    return critical[:: stride or 1]


def _value(objective: Objective, motion: SampledMotion, Y: np.ndarray, observed: dict[_Matrix, Observed]) -> Value:
    """Return an objective's value.

    Args:
        objective: the objective.
        motion: the motion.
        Y: (N, n, b) regressor of the motion.
        observed: observation matrices formed so far; excitation indices with equal columns, sigmas and existing
            information share one.
    """
    if not isinstance(objective, Excitation):
        return objective.evaluate(motion, Y)
    key = _matrix(objective)
    if key not in observed:
        observed[key] = objective.observed(Y)
    return objective.seen(observed[key])


def _matrix(objective: Excitation) -> _Matrix:
    return id(objective.sigmas), id(objective.existing), id(objective.columns)


def _summed(problem: ExcitationProblem, values: list[float]) -> tuple[float, np.ndarray]:
    """Return the weighted sum of the problem's objectives and its gradient (1, k) by their values.

    Of condition numbers, the logarithm is summed.

    Args:
        problem: the problem, which gives objectives and weights.
        values: the k values of the objectives.
    """
    is_log = [is_condition(objective) for objective, _ in problem.objectives]
    logs = np.array(is_log)
    weights = np.array([weight for _, weight in problem.objectives])
    sizes = np.array(values)
    sizes = np.where(logs, sizes, 1.0)
    terms = np.where(logs, np.log(sizes), values)
    return float(weights @ terms), (weights / sizes)[None]


def _slope(
    problem: ExcitationProblem,
    motion: SampledMotion,
    Y: np.ndarray,
    values: list[Value],
    shares: np.ndarray,
    observed: dict[_Matrix, Observed],
) -> np.ndarray:
    """Return the gradients (4, N, n) of Σ shares · objectives by q, v, a, jerk, computed by one derivative product.

    Args:
        problem: the problem.
        motion: the motion at the problem's samples.
        Y: (N, n, b) regressor of the motion.
        values: values and gradients of the k objectives.
        shares: (k,) factors of the objectives in the sum.
        observed: observation matrices of the excitation indices, as formed by `_value`.
    """
    result = np.zeros((4, *motion.q.shape))
    by_regressor = None
    by_information: dict[_Matrix, np.ndarray] = {}
    for value, objective, share in zip(values, _terms(problem), shares):
        if share == 0.0:
            continue
        if value.by_motion is not None:
            result += share * value.by_motion
        if isinstance(objective, Excitation):
            key = _matrix(objective)
            by_information[key] = by_information.get(key, 0.0) + share * value.by_information
        elif isinstance(objective, TorqueSlack) and value.by_torque is not None:
            state = (motion.q, motion.v, motion.a)
            result[:3] += objective.torque_product(*state, objective.parameters, share * value.by_torque)
    for key, S in by_information.items():
        slope = observed[key].by_regressor(S)
        by_regressor = slope if by_regressor is None else by_regressor + slope
    if by_regressor is not None:
        result[:3] += problem.product(motion.q, motion.v, motion.a, by_regressor)
    return result


def _terms(problem: ExcitationProblem) -> list[Objective]:
    """Return the objectives to evaluate: those of a problem's goals or, without goals, of its weighted sum."""
    if problem.goals:
        return [goal.objective for goal in problem.goals]
    return [objective for objective, _ in problem.objectives]


def _sharpened(objective: Objective, p: float) -> Objective:
    if not isinstance(objective, Excitation):
        return objective
    return replace(objective, sharpness=p)


def is_condition(objective: Objective) -> bool:
    return isinstance(objective, Excitation) and objective.index == "cond"


def exact_values(problem: ExcitationProblem, motion: SampledMotion, regressor: np.ndarray) -> np.ndarray:
    """Return the unsmoothed values (k,) of a problem's objectives (or of its goals' objectives) for a motion.

    Args:
        problem: the problem.
        motion: the motion at N samples.
        regressor: (N, n, b) of the motion.
    """
    values = []
    for objective in _terms(problem):
        unsmoothed = _sharpened(objective, np.inf)
        values.append(unsmoothed.evaluate(motion, regressor).value)
    return np.array(values)


def merit(problem: ExcitationProblem, values: np.ndarray) -> float:
    """Return the merit to minimise from objective values (k,) of a problem.

    It is γ, the largest relative miss of the goals, for a problem with goals, else the weighted sum. In the weighted
    sum, condition numbers are taken by logarithm.

    Args:
        problem: the problem.
        values: unsmoothed values of the objectives, or of the goals' objectives.
    """
    if problem.goals:
        return max(goal.attainment(value) for goal, value in zip(problem.goals, values))
    total, _ = _summed(problem, list(values))
    return total


def unmet(problem: ExcitationProblem, values: np.ndarray) -> tuple[float, AttainmentGoal, float] | None:
    """Return, of the problem's hard goals, the relative amount by which the worst is missed, that goal, and its value.

    Args:
        problem: the problem with its goals.
        values: (k,) values of the goals' objectives.

    Returns:
        The miss relative to the goal, the goal, and the value of its objective; None if all hard goals are met.
    """
    worst = None
    for goal, value in zip(problem.goals, values):
        lacking = (value - goal.goal) / max(abs(goal.goal), 1e-3)
        if goal.share == 0 and lacking > (worst[0] if worst else 0.0):
            worst = (float(lacking), goal, float(value))
    return worst


def stretched(motion: SampledMotion, factor: float) -> SampledMotion:
    """Return the motion along the same path with the duration multiplied by `factor`."""
    if factor == 1.0:
        return motion
    velocity = motion.v / factor
    acceleration = motion.a / factor**2
    jerk = motion.jerk / factor**3
    return SampledMotion(factor * motion.times, motion.q, velocity, acceleration, jerk)


def _by_variables(
    problem: ExcitationProblem,
    basis: Basis,
    motion: SampledMotion,
    slopes: np.ndarray,
    factor: float,
    by_duration: np.ndarray,
) -> np.ndarray:
    """Return the gradients (m, p) of m functions by the variables of the point y = (x, factor on the period).

    The derivatives by the factor are d v/d factor = -v / factor, and correspondingly for a and jerk. Where the period
    is fixed, the gradients are by x alone.

    Args:
        problem: the problem, which says whether the period is free.
        basis: the linear map from x to the motion.
        motion: the motion with the duration multiplied by `factor`.
        slopes: (m, 4, N, n) gradients by q, v, a, jerk of this motion.
        factor: factor on the family's period.
        by_duration: (m,) gradients by the duration [1/s].
    """
    powers = factor ** np.arange(4)
    in_family_time = slopes
    if factor != 1.0:
        in_family_time = slopes / powers[:, None, None]
    gradient = basis.adjoint(in_family_time)
    if not problem.free_period:
        return gradient
    last = np.zeros(len(slopes))
    for order in (1, 2, 3):
        along_order = np.einsum("mij,ij->m", slopes[:, order], motion.orders[order])
        last -= order / factor * along_order
    last[: len(by_duration)] += problem.family.period * by_duration
    return np.concatenate([gradient, last[:, None]], axis=1)
