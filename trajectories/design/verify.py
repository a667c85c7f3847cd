"""Final check of feasibility: a motion is evaluated again at dense instants, with an allowance between the instants.

Positions and derivatives are computed by the formula of the family, not from the optimiser's tables. Between two
instants dt apart a function exceeds the larger of its values at both by at most max|f''| dt² / 8. For limits on d^r q /
dt^r, a bound on max|f''| follows from the coefficients (*proved*). For torques, positions and distances the allowance
is twice the second difference at the instant, divided by 8 (*estimated*: our choice). A jump between two instants, as
of Coulomb friction, needs no further allowance.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..basis import Family, SampledMotion
from ..constraints import BoxLimit, MotionConstraint
from ..design.problem import ExcitationProblem, critical_times
from ..design.search import STAGES, SearchResult, one_start
from ..design.starts import shrunk
from ..errors import NothingFeasible


@dataclass(frozen=True)
class Margin:
    """Margin to one limit.

    Attributes:
        name, label, unit: name of the constraint, label of the column, unit of the values.
        margin: least distance to the limit over all times, minus the allowance [unit]; negative where the limit is
            violated.
        share: margin divided by the constraint's scale.
        time: time of the least distance [s].
        allowance: largest excess that is possible between the instants [unit].
        proved: True where the allowance is a bound, False where it is an estimate.
    """

    name: str
    label: str
    unit: str
    margin: float
    share: float
    time: float
    allowance: float
    proved: bool


@dataclass(frozen=True)
class Verification:
    """Margins to all constraints, one for each column of a constraint (such as one side of one joint's limit).

    Attributes:
        margins: one margin per column of every constraint.
        instants: number of instants checked over the period.
        rest: largest velocity and acceleration at the start [per s, per s²].
    """

    margins: tuple[Margin, ...]
    instants: int
    rest: tuple[float, float]

    @property
    def feasible(self) -> bool:
        return all(margin.margin >= 0 for margin in self.margins)

    @property
    def worst(self) -> dict[str, Margin]:
        """The smallest margin of each constraint, by the constraint's name."""
        result: dict[str, Margin] = {}
        for margin in self.margins:
            if margin.name not in result or margin.share < result[margin.name].share:
                result[margin.name] = margin
        return result


def dense_motion(family: Family, x: np.ndarray, times: np.ndarray, factor: float = 1.0) -> SampledMotion:
    """Return the time-scaled motion sampled at times [s], computed by the family's formula.

    Args:
        family: the family of motions.
        x: (p,) free variables of the family.
        times: (N,) [s].
        factor: factor on the period.
    """
    family_times = times / factor
    orders = [family.evaluate(x, family_times, order) / factor**order for order in range(4)]
    return SampledMotion(times, *orders)


def verify_motion(
    family: Family, x: np.ndarray, constraints: Sequence[MotionConstraint], *, factor: float = 1.0, instants: int = 5000
) -> Verification:
    """Return the margins of a motion to its constraints, at `instants` instants over one period and between them.

    Args:
        family: the family of motions.
        x: (p,) free variables of the family for this motion.
        constraints: the constraints to check.
        factor: factor on the family's period.
        instants: number of instants.
    """
    period = family.period * factor
    step = period / instants
    times = step * np.arange(instants + 1)
    motion = dense_motion(family, x, times, factor)
    margins = []
    for constraint in constraints:
        margins += _margins(family, x, constraint, motion, step, factor)
    velocity_at_start = float(np.abs(motion.v[0]).max())
    acceleration_at_start = float(np.abs(motion.a[0]).max())
    return Verification(tuple(margins), instants, (velocity_at_start, acceleration_at_start))


def ensured(
    problem: ExcitationProblem,
    result: SearchResult,
    constraints: Sequence[MotionConstraint] | None = None,
    instants: int = 5000,
    rounds: int = 4,
) -> tuple[SearchResult, Verification]:
    """Return a motion that passes `verify_motion`, and its verification.

    A motion that does not pass is searched again from its variables, with the instants near the violated limits as
    extra times, and with more tightening of these limits. Where this does not help, the motion is scaled down about its
    own pose that lies furthest inside the limits.

    Args:
        problem: the excitation problem.
        result: the motion to start from.
        constraints: constraints to verify, one for each constraint of the problem; None takes those of the problem.
        instants: number of instants at which the motion is verified.
        rounds: largest number of repeated searches.

    Raises:
        NothingFeasible: neither a repeated search nor scaling down gives a motion that passes.
    """
    checked = constraints or problem.constraints
    tighter = problem
    original = result

    def verified(x: np.ndarray) -> Verification:
        return verify_motion(problem.family, x, checked, factor=result.factor, instants=instants)

    report = verified(result.x)
    max_evaluations = 240  # of a search that goes on from a motion, if all its stages are gone through
    for _ in range(rounds):
        if report.feasible:
            return result, report
        y = result.x
        if problem.free_period:
            y = np.append(y, result.factor)
        shares = [report.worst[margin.name].share for margin in checked]
        lacking = np.array([max(-share, 0.0) for share in shares])
        # our choice
        step_inside = np.minimum(1.2 * lacking, 0.01) + 1e-4
        further = np.where(lacking > 0.0, step_inside, 0.0)
        critical = critical_times(problem, y, 0.0, checked, instants)
        extra = np.union1d(tighter.extra, critical)
        tighter = replace(tighter, extra=extra, tightening=tighter.tightening + further)
        continued = one_start(tighter, max_evaluations, "slsqp", result.seed, y, STAGES[2:])
        evaluations = result.evaluations + continued.evaluations
        result = replace(result, evaluations=evaluations)
        if isinstance(continued, SearchResult):
            result = replace(
                continued,
                history=original.history,
                evaluations=result.evaluations,
                seconds=result.seconds + continued.seconds,
                interrupted=result.interrupted or continued.interrupted,
            )
            report = verified(result.x)
    for share in 0.8 ** np.arange(21):
        small = shrunk(problem, result.x, share)
        if (proof := verified(small)).feasible:
            return replace(result, x=small), proof
    worst = min(report.margins, key=lambda margin: margin.share)
    raise NothingFeasible(
        f"feasible at the samples, but between them the {worst.name} limit ({worst.label}) is broken by "
        f"{-worst.margin:.3g} {worst.unit} at t = {worst.time:.3g} s; widen that limit or take a longer period",
        worst.name,
        -worst.margin,
        worst.unit,
    )


def _margins(
    family: Family, x: np.ndarray, constraint: MotionConstraint, motion: SampledMotion, step: float, factor: float
) -> list[Margin]:
    block = 2000
    starts = range(0, len(motion), block)
    blocks = []
    for start in starts:
        rows = np.arange(len(motion))[start : start + block]
        blocks.append(constraint.values(motion.part(rows)))
    values = np.concatenate(blocks)
    proved = isinstance(constraint, BoxLimit)
    if isinstance(constraint, BoxLimit):
        order = constraint.order + 2
        curve = family.largest(x, order) / factor**order
        both_sides = np.tile(curve[constraint.joints], 2)
        allowance = np.broadcast_to(both_sides * step**2 / 8, values.shape)
    else:
        bend = np.abs(np.diff(values, 2, axis=0))
        bend = np.concatenate([bend[-1:], bend, bend[:1]])  # periodic
        before = np.roll(bend, 1, 0)
        behind = np.roll(bend, -1, 0)
        allowance = np.maximum(bend, np.maximum(before, behind)) / 4
    reached = values + allowance
    rows = np.argmax(reached, axis=0)
    result = []
    for k, (row, label) in enumerate(zip(rows, constraint.labels)):
        margin = -float(reached[row, k])
        result.append(
            Margin(
                constraint.name,
                label,
                constraint.unit,
                margin,
                margin / float(constraint.scale[k]),
                float(motion.times[row]),
                float(allowance[row, k]),
                proved,
            )
        )
    return result
