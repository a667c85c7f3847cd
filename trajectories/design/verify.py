"""The last word on feasibility: a motion evaluated anew, densely, with an allowance for what lies between the instants.

Positions and derivatives come from the family's own formula, not from the optimiser's tables. Between two instants dt
apart a function rises above both by at most max|f''| dt² / 8. For limits on d^r q / dt^r that maximum is bounded by the
coefficients (*proved*); for torques, places and distances it is estimated as twice the second difference on the spot
(*estimated*: our choice; a jump between two instants, as of Coulomb friction, needs no allowance beyond it).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from trajectories.basis import Family, SampledMotion, sample_times
from trajectories.constraints import BoxLimit, MotionConstraint
from trajectories.design.problem import ExcitationProblem, critical_times
from trajectories.design.search import STAGES, SearchResult, Stuck, one_start
from trajectories.design.starts import shrunk
from trajectories.errors import NothingFeasible

BLOCK = 2000
OTHERS = 3  # starts besides the best whose motions are searched again
EVALUATIONS = 240  # of a search that goes on from a motion, if all its stages are gone through
CLOSER = 3  # instants per sample that are added where all of a motion is looked at closer


@dataclass(frozen=True)
class Margin:
    """What is left of one limit.

    Attributes:
        name, label, unit: of the constraint and of its column.
        margin: least distance to the limit over all times [unit], the allowance taken off; negative: broken.
        share: the same over the constraint's scale.
        time: where [s].
        allowance: for what lies between the instants [unit].
        proved: whether the allowance is a bound or an estimate.
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
    """Margins of all columns of all constraints.

    Attributes:
        instants: how many were looked at over the period.
        rest: largest velocity and acceleration at the start [per s, per s²].
    """

    margins: tuple[Margin, ...]
    instants: int
    rest: tuple[float, float]

    @property
    def feasible(self) -> bool:
        return all(one.margin >= 0 for one in self.margins)

    @property
    def worst(self) -> dict[str, Margin]:
        """The smallest margin of each constraint, by its name."""
        result: dict[str, Margin] = {}
        for one in self.margins:
            if one.name not in result or one.share < result[one.name].share:
                result[one.name] = one
        return result


def dense_motion(family: Family, x: np.ndarray, times: np.ndarray, factor: float = 1.0) -> SampledMotion:
    """Return the motion at times [s] of the stretched motion, from the family's own formula."""
    orders = [family.evaluate(x, times / factor, order) / factor**order for order in range(4)]
    return SampledMotion(times, *orders)


def verify_motion(
    family: Family, x: np.ndarray, constraints: Sequence[MotionConstraint], *, factor: float = 1.0, instants: int = 5000
) -> Verification:
    """Check a motion against constraints at `instants` over one period, and between them.

    Args:
        factor: on the family's period.
    """
    period = family.period * factor
    step = period / instants
    times = step * np.arange(instants + 1)
    motion = dense_motion(family, x, times, factor)
    found = [one for constraint in constraints for one in _margins(family, x, constraint, motion, step, factor)]
    return Verification(tuple(found), instants, (float(np.abs(motion.v[0]).max()), float(np.abs(motion.a[0]).max())))


def ensured(
    problem: ExcitationProblem,
    found: SearchResult,
    constraints: Sequence[MotionConstraint] | None = None,
    instants: int = 5000,
    rounds: int = 4,
) -> tuple[SearchResult, Verification]:
    """Return a motion that passes `verify_motion`.

    One that does not is searched again from there, with the instants near what it breaks and further inside the limits
    that it breaks; then what other starts found is; then a smaller motion about the pose that is furthest inside.

    Args:
        constraints: to verify against, one for each of the problem's; default these.
        rounds: of searching again, from each motion.

    Raises:
        NothingFeasible: where none of that helps.
    """
    checked = problem.constraints if constraints is None else constraints
    refining = _Refining(problem, checked, instants, rounds)
    first, small = None, None
    for one in (found, *found.others[:OTHERS]):
        run, report = refining.refined(one)
        if report.feasible:
            return refining.told(run, found), report
        first = first or report
        if run.interrupted:
            break
    for one in (found, *found.others[:OTHERS]):
        if (small := refining.smaller(one)) is not None:
            run, report = refining.refined(small, uniform=True)
            run, report = (run, report) if report.feasible else (small, refining.report(small))
            return refining.told(run, found), report
    worst = min(first.margins, key=lambda one: one.share)
    raise NothingFeasible(
        f"no motion was found that keeps the {worst.name} limit ({worst.label}) between its samples, too: the best one "
        f"breaks it by {-worst.margin:.3g} {worst.unit} at t = {worst.time:.3g} s",
        worst.name, -worst.margin, worst.unit,
    )  # fmt: skip


@dataclass
class _Refining:
    """Searches again where a motion breaks limits between the samples; see `ensured`."""

    problem: ExcitationProblem
    checked: Sequence[MotionConstraint]
    instants: int
    rounds: int
    spent: int = 0
    seconds: float = 0.0

    def report(self, found: SearchResult) -> Verification:
        return verify_motion(self.problem.family, found.x, self.checked, factor=found.factor, instants=self.instants)

    def told(self, run: SearchResult, found: SearchResult) -> SearchResult:
        """Return a run with the history of the search that it ends."""
        return replace(
            run, history=found.history, times=found.times, evaluations=found.evaluations + self.spent,
            feasible=found.feasible, seconds=found.seconds + self.seconds,
            interrupted=found.interrupted or run.interrupted, others=(),
        )  # fmt: skip

    def refined(self, found: SearchResult, uniform: bool = False) -> tuple[SearchResult, Verification]:
        """Return what searching again from a motion comes to.

        Args:
            uniform: look closer everywhere from the beginning, as a motion that goes elsewhere needs it.
        """
        report, tighter = self.report(found), self.problem
        for number in range(self.rounds):
            if report.feasible and not (uniform and number == 0):
                break
            y = np.append(found.x, found.factor) if self.problem.free_period else found.x
            tighter = self._tighter(tighter, report, y, uniform)
            run = one_start(tighter, EVALUATIONS, "slsqp", found.seed, y, STAGES[1:] if uniform else STAGES[2:])
            self.spent += run.evaluations
            if isinstance(run, Stuck):
                break
            self.seconds += run.seconds
            found, report = run, self.report(run)
        return found, report

    def _tighter(
        self, problem: ExcitationProblem, report: Verification, y: np.ndarray, uniform: bool
    ) -> ExcitationProblem:
        """Return the problem with the instants near what is broken, and further inside that."""
        extra = np.union1d(problem.extra, critical_times(problem, y, 0.0, self.checked, self.instants))
        if uniform:
            extra = np.union1d(extra, sample_times(problem.family.period, CLOSER * problem.samples))
        lacking = {name: max(-one.share, 0.0) for name, one in report.worst.items()}
        further = np.array([lacking.get(one.name, 0.0) for one in self.checked])
        further = np.where(further > 0.0, np.minimum(1.2 * further, 0.01) + 1e-4, 0.0)  # our choice
        return replace(problem, extra=extra, tightening=problem.tightening + further)

    def smaller(self, found: SearchResult) -> SearchResult | None:
        """Return the motion made so small that it keeps the limits, or None."""
        for share in 0.8 ** np.arange(1, 21):
            small = replace(found, x=shrunk(self.problem, found.x, share))
            if self.report(small).feasible:
                return small
        return None


def _margins(
    family: Family, x: np.ndarray, constraint: MotionConstraint, motion: SampledMotion, step: float, factor: float
) -> list[Margin]:
    starts = range(0, len(motion), BLOCK)
    values = np.concatenate([constraint.values(motion.part(np.arange(len(motion))[s : s + BLOCK])) for s in starts])
    proved = isinstance(constraint, BoxLimit)
    if isinstance(constraint, BoxLimit):
        curve = family.largest(x, constraint.order + 2) / factor ** (constraint.order + 2)
        allowance = np.broadcast_to(np.tile(curve[constraint.joints], 2) * step**2 / 8, values.shape)
    else:
        bend = np.abs(np.diff(values, 2, axis=0))
        bend = np.concatenate([bend[-1:], bend, bend[:1]])  # periodic
        allowance = np.maximum(bend, np.maximum(np.roll(bend, 1, 0), np.roll(bend, -1, 0))) / 4
    reached = values + allowance
    rows = np.argmax(reached, axis=0)
    result = []
    for k, (row, label) in enumerate(zip(rows, constraint.labels)):
        margin = -float(reached[row, k])
        result.append(
            Margin(
                constraint.name, label, constraint.unit, margin, margin / float(constraint.scale[k]),
                float(motion.times[row]), float(allowance[row, k]), proved,
            )
        )  # fmt: skip
    return result
