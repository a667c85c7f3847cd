"""Designing exciting motions: the package `trajectories` gets a robot's regressor and limits."""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from calib.config import Tables
from calib.errors import UsageError
from calib.identification.settings import IdentificationSettings
from calib.procedure.excitation.excited_model import ExcitedModel
from calib.procedure.excitation.goals import GUARD, missed, objectives_of, read_goals, torque_slack, wrist
from calib.procedure.excitation.inputs import ExcitationInputs, read_inputs
from calib.procedure.excitation.limits import MotionLimits, located
from calib.procedure.excitation.playback import Playback, check_start, play
from calib.procedure.excitation.prediction import MotionOutlook, PredictedSigma, foretell
from calib.procedure.excitation.settings import COARSE, DEFAULT_DESIGN, HARMONICS, ExcitationSettings, split_goal
from calib.robot.calibrated import CalibratedChain
from calib.trajectories.basis import Family
from calib.trajectories.bspline import bspline_family
from calib.trajectories.constraints import MotionConstraint, TorqueLimit
from calib.trajectories.design.objectives import Excitation, TorqueSlack, condition_numbers
from calib.trajectories.design.optimise import design
from calib.trajectories.design.pareto import Front, proposed_goals, sweep
from calib.trajectories.design.problem import AttainmentGoal, ExcitationProblem, exact_values, merit
from calib.trajectories.design.search import SearchResult
from calib.trajectories.design.verify import Verification, dense_motion, ensured
from calib.trajectories.errors import NothingFeasible
from calib.trajectories.fourier import fourier_family
from calib.workers import finishing


@dataclass(frozen=True)
class DesignCondition:
    """Condition numbers of the observation matrix: raw (SI units), and normalised (columns of unit norm).

    Where motions before count, too: of this motion alone, and of those before it.
    """

    raw: float
    normalised: float
    raw_alone: float | None = None
    normalised_alone: float | None = None
    raw_before: float | None = None
    normalised_before: float | None = None

    def table(self) -> dict[str, float]:
        """Return the values as the entry ``condition_number`` of ``metrics.json``."""
        return {name: value for name, value in asdict(self).items() if value is not None}


INSTANTS = 1000  # over the period, at which condition numbers are reported
Progress = Callable[[str], None]
Search = Callable[..., SearchResult]


@dataclass(frozen=True, eq=False)
class Designed:
    """A designed exciting motion, with its inputs, goals reached, and verified margins to the limits.

    Attributes:
        inputs, settings: of the design.
        problem: that was solved last, with the family of motions.
        found: the motion; `proof`: its margins, checked independently.
        condition: raw and normalised, of `INSTANTS` samples over the period with the model's own Coulomb sign.
        goals: the stated ones: name, number asked for, weight, and number reached (by `exact` of the inputs' model).
        front: trade-offs, where asked for.
        playback: what a controller is to run.
        notes: what a user should know.
        outlook: what the motion is predicted to identify; None where no torque limits say how large errors are.
        predicted: sigmas of the parameters; empty there.
    """

    inputs: ExcitationInputs
    settings: ExcitationSettings
    problem: ExcitationProblem
    found: SearchResult
    proof: Verification
    condition: DesignCondition
    goals: tuple[tuple[str, float, float, float], ...]
    front: Front | None
    playback: Playback
    notes: tuple[str, ...]
    outlook: MotionOutlook | None = None
    predicted: Sequence[PredictedSigma] = ()

    @property
    def family(self) -> Family:
        return self.problem.family

    @property
    def period(self) -> float:
        """The motion's period [s]."""
        return self.family.period * self.found.factor

    @property
    def locked(self) -> dict[str, float]:
        """Positions of the locked joints, by joint name [rad or m]."""
        last = self.playback.run.q[-1]
        return {self.inputs.chain.joint_names[j]: float(last[j]) for j in self.inputs.locked}


def excite(
    robot: str | Path | CalibratedChain,
    settings: ExcitationSettings = DEFAULT_DESIGN,
    *,
    model: Path | None = None,
    limits: Tables | None = None,
    base: str | None = None,
    tip: str | None = None,
    options: IdentificationSettings | None = None,
    after: Path | None = None,
    map: Callable = map,
    progress: Progress | None = None,
) -> Designed:
    """Design a motion that excites the dynamics of a robot within its limits.

    Without goals the logarithms of both condition numbers, raw and normalised, are minimised in equal parts, or an aim
    such as ``logdet`` alone. With goals (``wrist=0.1``) both take part with what a single-objective run reached as
    their goal (the study's advice), unless they are given themselves.

    Args:
        robot, base, tip: see `calib.robot.library`.
        settings: see `calib.procedure.excitation.settings`.
        model: folder of an identification: torques, friction and their uncertainty.
        limits: see `calib.procedure.excitation.limits`.
        options: of the identification that will follow: torque rows, drive terms, payloads.
        after: folder of an identification that the motion shall add to; replaces `model`.
        map: where the starts of the search run (`calib.workers`).
        progress: called with words.

    Ctrl-C ends the search; the best motion found so far is verified and returned.
    """
    given = read_inputs(robot, settings, model, limits, base, tip, options, after)
    try:
        return search_motion(given, settings, map, progress)
    except NothingFeasible as error:
        raise located(error) from error


def search_motion(
    given: ExcitationInputs, settings: ExcitationSettings, map: Callable = map, progress: Progress | None = None
) -> Designed:
    """Search for an exciting motion of an arm, or of the platform's coordinates of a parallel robot."""
    say = progress or (lambda words: None)
    check_start(settings.start, given.chain, given.limits)
    problem, checked, notes = _excitation_problem(given, settings)
    condition = _condition_objective(given, settings)
    goals = read_goals(settings, given, condition)
    report = lambda done, total, what: say(f"{what} ({done} of {total})")  # noqa: E731
    search = partial(
        design, evaluations=settings.evaluations, method=settings.solver, seed=settings.seed, map=map, report=report
    )
    found, problem = _searched(problem, goals, settings.starts, search, say)
    say("verifying")
    found, problem = _whole(found, problem, settings.rate)
    with finishing():
        found, proof = ensured(problem, found, checked)
    front = None
    if settings.front and not found.interrupted:
        with suppress(KeyboardInterrupt):  # the motion is there: what comes besides may be cut short
            front = _front(problem, given, found, goals, settings.front, settings.evaluations, report)
            front, found, proof = _nearest_goals(front, problem, goals, given, (found, proof), checked)
    with finishing():
        played = play(problem.family, found, given, settings)
        condition_found = _condition_of(given, problem.family, found, settings.repeat)
        values = _reached(problem, goals, found, given)
    outlook, predicted = None, ()
    with suppress(KeyboardInterrupt):
        say("predicting sigmas of other periods")
        of_period = lambda period: _excitation_problem(given, replace(settings, period=period, shortest=None))[0]  # noqa: E731
        outlook, predicted = foretell(given, settings, problem, found, of_period)
    cut = ("interrupted before any motion met the goals",) if goals and not problem.goals else ()
    cut += missed(goals, values, given)
    reached = tuple((*split_goal(goal.words), goal.share, goal.stated(value)) for goal, value in zip(goals, values))
    return Designed(
        given,
        settings,
        problem,
        found,
        proof,
        condition_found,
        reached,
        front,
        played,
        (*given.limits.notes, *given.model.notes, *notes, *given.columns.notes, *cut, *played.notes),
        outlook,
        predicted,
    )


def _reached(
    problem: ExcitationProblem, goals: list[AttainmentGoal], found: SearchResult, given: ExcitationInputs
) -> tuple[float, ...]:
    """Return the goals' values of a motion at `INSTANTS`, with the model's own Coulomb sign."""
    if not goals:
        return ()
    motion = dense_motion(problem.family, found.x, _instants(problem.family, found), found.factor)
    denser = []  # as the condition's: information of earlier motions counts per sample
    for goal in goals:
        if isinstance(one := goal.objective, Excitation) and one.existing is not None:
            goal = replace(goal, objective=replace(one, existing=one.existing * (INSTANTS / problem.samples)))
        denser.append(goal)
    Y = given.model.exact.regressor(motion.q, motion.v, motion.a)
    return tuple(exact_values(replace(problem, goals=tuple(denser)), motion, Y).tolist())


def _instants(family: Family, found: SearchResult) -> np.ndarray:
    return family.period * found.factor / INSTANTS * np.arange(INSTANTS)


def _excitation_problem(
    given: ExcitationInputs, settings: ExcitationSettings
) -> tuple[ExcitationProblem, tuple[MotionConstraint, ...], tuple[str, ...]]:
    """Return the optimisation problem (condition numbers, limits), the constraints to verify, and notes."""
    search, checked, notes = _constraints(given.model, given.limits)
    condition, smooth = _condition_objective(given, settings), given.model.smooth
    objectives = objectives_of(settings, condition, given)
    family, coarse = _family(given, settings)
    shortest = settings.shortest or settings.period
    if shortest > settings.period:
        raise UsageError(f"--shortest {shortest:g} s: expected at most the period, {settings.period:g} s")
    problem = ExcitationProblem(
        family,
        smooth.regressor,
        smooth.regressor_gradient,
        objectives,
        search,
        samples=settings.samples,
        stretch=(shortest / settings.period, 1.0),
        coarse=coarse,
    )
    return problem, checked, notes


def _whole(found: SearchResult, problem: ExcitationProblem, rate: float) -> tuple[SearchResult, ExcitationProblem]:
    """Return (motion, problem), both with the period rounded to whole controller samples."""
    if not problem.free_period:
        return found, problem
    whole = problem.family.period * rate
    factor = np.ceil(found.factor * whole - 1e-6) / whole
    return replace(found, factor=factor), replace(problem, stretch=(factor, factor))


def _condition_objective(given: ExcitationInputs, settings: ExcitationSettings) -> Excitation:
    """Return the objective: condition number of the identifiable columns, including earlier motions."""
    known = None if given.prior is None else given.prior.per_sample(settings.samples, settings.repeat * settings.period)
    return Excitation("cond", sigmas=given.columns.sigmas, existing=known, columns=given.columns.aimed)


def _searched(
    problem: ExcitationProblem, goals: list[AttainmentGoal], starts: int, search: Search, say: Progress
) -> tuple[SearchResult, ExcitationProblem]:
    """Return the motion found and the problem solved; a first search sets the goals of the condition numbers."""
    if not goals or any(isinstance(one.objective, Excitation) for one in goals):
        problem = replace(problem, goals=tuple(goals))
        return search(problem, starts=starts), problem
    first = search(problem, starts=starts)
    if first.interrupted:
        return first, problem
    proposed = [AttainmentGoal(one, float(value)) for (one, _), value in zip(problem.objectives, first.values)]
    plain, problem = problem, replace(problem, goals=(*goals, *proposed))
    say("goal attainment")
    try:
        found = search(problem, starts=max(1, starts // 3), guesses=(first.x,))
    except KeyboardInterrupt:
        return replace(first, interrupted=True), plain
    spent, seconds = first.evaluations + found.evaluations, first.seconds + found.seconds
    return replace(found, evaluations=spent, seconds=seconds), problem


def _condition_of(given: ExcitationInputs, family: Family, found: SearchResult, repeat: int = 1) -> DesignCondition:
    """Return the condition numbers at `INSTANTS` samples over the period, without smoothing of Coulomb friction.

    With motions before they are those of all motions together; ``alone`` and ``before`` say what each has by itself.
    """
    motion, columns = dense_motion(family, found.x, _instants(family, found), found.factor), given.columns
    Y = given.model.exact.regressor(motion.q, motion.v, motion.a)
    alone = condition_numbers(Y, columns.sigmas, columns=columns.aimed)
    if given.prior is None:
        return DesignCondition(**alone)
    known = given.prior.per_sample(INSTANTS, repeat * family.period * found.factor)
    both = condition_numbers(Y, columns.sigmas, known, columns.aimed)
    before = condition_numbers(0.0 * Y, None, known, columns.aimed)
    named = {
        f"{key}_{when}": value if np.isfinite(value) else None  # by itself it need not determine all columns
        for when, one in (("alone", alone), ("before", before))
        for key, value in one.items()
    }
    return DesignCondition(both["raw"], both["normalised"], **named)


def _family(given: ExcitationInputs, settings: ExcitationSettings) -> tuple[Family, Family | None]:
    """Return the family of motions, and for the first search stage a family of fewer harmonics or None."""
    fixed = {j: value for j, value in given.locked.items() if value is not None}
    resonance, most = given.limits.resonance, settings.harmonics
    if most is None:
        most = HARMONICS if resonance is None else round(0.99 * settings.period * resonance / (2 * np.pi) - 0.5)
        most = max(2, min(most, HARMONICS))
    counts = np.full(given.chain.n, most)
    counts[list(given.locked)] = 0 if settings.family == "fourier" else 1
    if settings.family == "fourier":
        full, few = (
            fourier_family(
                np.minimum(counts, top).tolist(), settings.period, held=fixed, resonance=resonance, rate=settings.rate
            )
            for top in (most, COARSE)
        )
        return full, few if most > COARSE else None
    if settings.family == "bspline":
        return bspline_family(counts.tolist(), settings.period, held=fixed, rate=settings.rate), None
    raise UsageError(f"family '{settings.family}' is unknown; use fourier or bspline")


def _constraints(
    dynamics: ExcitedModel, limits: MotionLimits
) -> tuple[tuple[MotionConstraint, ...], tuple[MotionConstraint, ...], tuple[str, ...]]:
    """Return the constraints for the search, those for the verification (Coulomb sign not smoothed), and notes."""
    if dynamics.values is None or not np.isfinite(limits.torque).any():
        return limits.constraints, limits.constraints, ()
    margin, notes = limits.margin, ()
    if margin is None:
        margin = 0.0 if dynamics.friction else GUARD
        notes = () if dynamics.friction else (f"{GUARD:.0%} of the torque limits are reserved for friction",)
    torque = [
        TorqueLimit(
            one.regressor,
            one.regressor_gradient,
            dynamics.values,
            one.of_rows(limits.torque),
            dynamics.covariance,
            limits.deviations,
            margin,
            one.torque_gradient,
            rows=one.row_names,
        )
        for one in (dynamics.smooth, dynamics.exact)
    ]
    return (*limits.constraints, torque[0]), (*limits.constraints, torque[1]), notes


def _nearest_goals(
    front: Front,
    problem: ExcitationProblem,
    goals: list[AttainmentGoal],
    given: ExcitationInputs,
    designed: tuple[SearchResult, Verification],
    checked: tuple[MotionConstraint, ...],
) -> tuple[Front, SearchResult, Verification]:
    """Return the front, and of its motions and the designed one that which comes nearest to the goals, verified."""

    def missed(run: SearchResult) -> float:
        return merit(problem, np.array(_reached(problem, goals, run, given)))

    if not goals:
        return front, *designed
    best = int(np.argmin([missed(run) for run in front.found]))
    moved = replace(designed[0], x=front.found[best].x, factor=front.found[best].factor)
    with suppress(NothingFeasible):
        moved, proof = ensured(problem, moved, checked)
        if missed(moved) < missed(designed[0]):
            return replace(front, designed=best), moved, proof
    return front, *designed


def _front(
    problem: ExcitationProblem,
    given: ExcitationInputs,
    found: SearchResult,
    goals: list[AttainmentGoal],
    count: int,
    evaluations: int,
    report: Callable[[int, int, str], None],
) -> Front:
    """Return trade-offs by the ε-constraint: the first torque goal (default: wrist) from idle to its best value.

    Against it stands the condition number among the goals; default the normalised one, or the aim.
    """
    slack = next((one.objective for one in goals if isinstance(one.objective, TorqueSlack)), None)
    slack = slack or torque_slack(wrist(given.chain.n), given, "front")
    stated = (one.objective for one in goals if isinstance(one.objective, Excitation))
    bare, index = replace(problem, goals=()), next(stated, problem.objectives[-1][0])
    ends = proposed_goals(bare, [index, slack], starts=1, evaluations=300, guesses=(found.x,))
    known = [run for _, run in ends]
    return sweep(problem, index, slack, count, known, found, evaluations=evaluations, report=report)
