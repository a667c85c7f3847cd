"""Design of exciting motions for identification, by the optimisation in the package `trajectories`.

This module supplies a robot's regressor and limits to the optimisation.
"""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from calib.config import Tables
from calib.dynamics.load_cases import LoadCases
from calib.errors import UsageError
from calib.identification.settings import IdentificationSettings
from calib.procedure.excitation.coefficients import Periodic
from calib.procedure.excitation.excited_model import ExcitedModel
from calib.procedure.excitation.goals import GUARD, missed, objectives_of, read_goals, torque_slack, wrist
from calib.procedure.excitation.inputs import ExcitationInputs, read_inputs
from calib.procedure.excitation.limits import MotionLimits, located
from calib.procedure.excitation.playback import Playback, check_start, play
from calib.procedure.excitation.prediction import MotionOutlook, PredictedSigma, foretell
from calib.procedure.excitation.settings import COARSE, DEFAULT_DESIGN, HARMONICS, ExcitationSettings, split_goal
from calib.procedure.excitation.stored_front import StoredFront, as_search_result
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

    With earlier motions, `raw` and `normalised` apply to all motions together, `…_alone` to the new motion, and
    `…_before` to the earlier motions. `…_alone` and `…_before` are None without earlier motions, or if the motions by
    themselves do not determine all columns.
    """

    raw: float
    normalised: float
    raw_alone: float | None = None
    normalised_alone: float | None = None
    raw_before: float | None = None
    normalised_before: float | None = None

    def table(self) -> dict[str, float]:
        """Return the entry ``condition_number`` of ``metrics.json``: name of a condition number -> value.

        Values that are None are omitted.
        """
        return {name: value for name, value in asdict(self).items() if value is not None}


Progress = Callable[[str], None]
Search = Callable[..., SearchResult]

# relative change of a front's condition number that is noted: it is stated at the search's samples (our choice)
MAX_FRONT_CHANGE = 0.1
# relative difference of periods that comes from rounding to samples
PERIOD_ROUNDING = 0.01
# degree of splines, where a family does not state it
DEFAULT_DEGREE = 5
# over the period, at which condition numbers are reported
INSTANTS = 1000
# index evaluations of the search for the ends of a front of trade-offs
END_EVALUATIONS = 300


@dataclass(frozen=True, eq=False)
class Designed:
    """A designed exciting motion, with its inputs, reached goals, and verified margins to the limits.

    Attributes:
        inputs, settings: inputs and settings of the design.
        problem: optimisation problem that was solved last, with the family of motions.
        found: the motion.
        proof: margins of the motion to the limits, checked independently of the optimisation.
        condition: condition numbers at `INSTANTS` samples over the period, without additional smoothing of Coulomb
            friction.
        goals: stated goals: name, requested value, weight, and value reached without additional smoothing of friction.
        front: trade-offs between goals; None if not requested.
        stored_front: the front with its motions, as the folder keeps it; None without a front.
        playback: setpoints for the controller.
        notes: remarks for the user.
        goal_notes: those of the `notes` that are on goals: missed, or decided by typical friction.
        cut_short: whether Ctrl-C was pressed after the search, so that the front or the predictions may be missing.
        outlook: predicted accuracy of the parameters and torques that the motion identifies; None without torque
            limits, from which torque errors are
            assumed.
        predicted: predicted σ of the parameters; empty without `outlook`.
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
    stored_front: StoredFront | None = None
    goal_notes: tuple[str, ...] = ()
    cut_short: bool = False

    @property
    def interrupted(self) -> bool:
        """Whether Ctrl-C was pressed, during the search or after it."""
        return self.found.interrupted or self.cut_short

    def periodic(self, motion: SearchResult) -> Periodic:
        """Return a result of the search as a periodic motion."""
        return _periodic(motion, self.inputs, self.settings, self.family)

    @property
    def family(self) -> Family:
        return self.problem.family

    @property
    def period(self) -> float:
        """Period of the motion [s]."""
        return self.family.period * self.found.factor

    @property
    def locked(self) -> dict[str, float]:
        """Positions of the locked joints: joint name -> value [rad or m]."""
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
    picked: StoredFront | None = None,
    map: Callable = map,
    progress: Progress | None = None,
) -> Designed:
    """Design a motion that excites the dynamics of a robot within its limits.

    Without goals, the logarithms of both condition numbers, raw and normalised, are minimised with equal weights; an
    aim such as ``logdet`` replaces them. With goals (``wrist=0.1``), the condition numbers become goals, too. Unless
    the settings state their goal values, these are the values reached in a first search for the condition numbers alone
    (as Kolyubin et al. 2019 advise).

    Ctrl-C ends the search; the best motion found until then is verified and returned.

    Args:
        robot: name of a library robot, file (URDF, or MDH table in TOML), folder of a fit, or a robot in memory.
        settings: goals, period, family of motions, search and playback.
        model: folder of an identification, from which torques, friction and their uncertainty are taken; None: no
            identification.
        limits: limits file (`calib formats limits`), or its content as tables; None: limits of the robot's description.
        base, tip: first and last link of the arm in a URDF; None: its root, and its flange.
        options: options of the identification that will follow (torque rows, drive terms, payloads); None: defaults.
        after: folder of an identification whose recordings the motion shall complement; replaces `model`; None: none.
        picked: front of an earlier design with the same settings, whose designed motion is taken instead of a search;
            None: search.
        map: function that runs the starts of the search, possibly in parallel (`calib.workers`).
        progress: called with a text on each step; None: silent.

    Raises:
        UsageError, MeasurementError: for a file that cannot be read, or belongs to another robot.
        NothingFeasible: if no motion within the limits was found.
    """
    inputs = read_inputs(robot, settings, model, limits, base, tip, options, after)
    try:
        return search_motion(inputs, settings, map, progress, picked)
    except NothingFeasible as error:
        raise located(error) from error


def _silent(stage: str) -> None:
    """Ignore a progress text, `stage`."""


def search_motion(
    inputs: ExcitationInputs,
    settings: ExcitationSettings,
    map: Callable = map,
    progress: Progress | None = None,
    picked: StoredFront | None = None,
) -> Designed:
    """Search for an exciting motion of an arm, or, for a parallel robot, of the platform's coordinates.

    Args:
        inputs: robot, model, limits and earlier motions.
        settings: settings of the design.
        map: function that runs the starts of the search, possibly in parallel.
        progress: called with a text on each step; None: silent.
        picked: front of an earlier design, whose designed motion is verified and taken instead of a search; None:
            search.
    """
    show = progress or _silent

    def report(number: int, total: int, stage: str) -> None:
        show(f"{stage} ({number} of {total})")

    def problem_of_period(period: float) -> ExcitationProblem:
        problem, _, _ = _excitation_problem(inputs, replace(settings, period=period, shortest=None))
        return problem

    check_start(settings.start, inputs.chain, inputs.limits)
    problem, checked, notes = _excitation_problem(inputs, settings)
    condition = _condition_objective(inputs, settings)
    goals = read_goals(settings, inputs, condition)
    if picked is None:
        search = partial(
            design, evaluations=settings.evaluations, method=settings.solver, seed=settings.seed, map=map, report=report
        )
        proposed, problem = _searched(problem, goals, settings.starts, search, show)
    else:
        proposed, problem = _picked(problem, goals, picked, inputs, settings)

    show("verifying")
    motion, problem = _with_whole_samples(proposed, problem, settings.rate)
    with finishing() as ignored:
        motion, proof = ensured(problem, motion, checked)
    verified = _Verified(motion, proof, picked)
    if picked is None and settings.front and not motion.interrupted:
        verified = _with_front(verified, problem, inputs, settings, goals, checked, report)
    motion = verified.motion

    with finishing() as ignored_later:
        playback = play(problem.family, motion, inputs, settings)
        condition_numbers = _condition_of(inputs, problem.family, motion, settings.repeat)
        values = _reached(problem, goals, motion, inputs)
    cut_short = verified.cut_short or bool(ignored or ignored_later)
    outlook, predicted = None, ()
    try:
        show("predicting sigmas of other periods")
        outlook, predicted = foretell(inputs, settings, problem, motion, problem_of_period)
    except KeyboardInterrupt:
        cut_short = True

    goal_notes: tuple[str, ...] = ()
    if goals and not problem.goals:
        goal_notes = ("interrupted before any motion met the goals",)
    goal_notes += missed(goals, values, inputs)
    if picked is not None:
        goal_notes += _changes_of_picked(picked, proposed, motion, condition_numbers)
    reached = []
    for goal, value in zip(goals, values):
        name, number = split_goal(goal.words)
        reached.append((name, number, goal.share, goal.stated(value)))
    front = verified.front
    return Designed(
        inputs=inputs,
        settings=settings,
        problem=problem,
        found=motion,
        proof=verified.proof,
        condition=condition_numbers,
        goals=tuple(reached),
        front=None if front is None else front.values,
        playback=playback,
        notes=(*inputs.limits.notes, *inputs.model.notes, *notes, *inputs.columns.notes, *goal_notes, *playback.notes),
        outlook=outlook,
        predicted=predicted,
        stored_front=front,
        goal_notes=goal_notes,
        cut_short=cut_short,
    )


@dataclass(frozen=True, eq=False)
class _Verified:
    """Motion that keeps the limits between its samples.

    Attributes:
        motion, proof: the motion, and its verified margins to the limits.
        front: front of the goals with the motion; None without one.
        cut_short: whether Ctrl-C was pressed before the front was complete.
    """

    motion: SearchResult
    proof: Verification
    front: StoredFront | None
    cut_short: bool = False


def _with_front(
    verified: _Verified,
    problem: ExcitationProblem,
    inputs: ExcitationInputs,
    settings: ExcitationSettings,
    goals: Sequence[AttainmentGoal],
    checked: tuple[MotionConstraint, ...],
    report: Callable[[int, int, str], None],
) -> _Verified:
    """Return the motion of the front that is nearest to the goals, with the front; after Ctrl-C the motion as it was.

    Args:
        verified: the motion of the search.
        problem: the optimisation problem, with the goals.
        inputs: robot and model.
        settings: settings of the design.
        goals: the goals; empty: none.
        checked: constraints of the verification.
        report: called with (number, total, stage).
    """
    try:
        front = _front(problem, inputs, verified.motion, goals, settings.front, settings.evaluations, report)
        motion_and_proof = verified.motion, verified.proof
        front, motion, proof = _nearest_goals(front, problem, goals, inputs, motion_and_proof, checked)
        motions = [_periodic(result, inputs, settings, problem.family) for result in front.found]
    except KeyboardInterrupt:
        return replace(verified, cut_short=True)
    return _Verified(motion, proof, StoredFront(front, tuple(motions)))


def _changes_of_picked(
    front: StoredFront, proposed: SearchResult, motion: SearchResult, condition: DesignCondition
) -> tuple[str, ...]:
    """Return notes on what differs from the front's designed motion as it was stored.

    Args:
        front: the front.
        proposed, motion: the front's motion, and the motion after its verification.
        condition: condition numbers of the motion with the present options.
    """
    notes: tuple[str, ...] = ()
    if not np.allclose(motion.x, proposed.x):
        notes = ("the motion of the front did not keep all limits between its samples, and was changed",)
    return notes + _other_values(front, condition)


def _picked(
    problem: ExcitationProblem,
    goals: Sequence[AttainmentGoal],
    front: StoredFront,
    inputs: ExcitationInputs,
    settings: ExcitationSettings,
) -> tuple[SearchResult, ExcitationProblem]:
    """Return the designed motion of a front, and the problem with the goals.

    Args:
        problem: the optimisation problem.
        goals: the goals; empty: none.
        front: front of an earlier design with the same settings.
        inputs: robot and model.
    """
    stored, chain = front.designed, inputs.chain
    if stored.joint_names != chain.joint_names:
        joints, expected = ", ".join(stored.joint_names), ", ".join(chain.joint_names)
        raise UsageError(f"the front is of a robot with the joints {joints}; {chain.name} has {expected}")
    shortest, longest = problem.stretch
    factor = stored.period / problem.family.period
    same_period = shortest * (1.0 - PERIOD_ROUNDING) <= factor <= longest * (1.0 + PERIOD_ROUNDING)
    if not same_period or (stored.kind, stored.rate) != (settings.family, settings.rate):
        of_front = f"{stored.kind}, {stored.period:g} s at {stored.rate:g} Hz"
        of_settings = f"{settings.family}, {settings.period:g} s at {settings.rate:g} Hz"
        raise UsageError(
            f"the front's motions are {of_front}, the settings say {of_settings}; give the same, or design it again"
        )
    motion = as_search_result(front.designed, problem.family)
    if goals:
        problem = replace(problem, goals=tuple(goals))
    dense = dense_motion(problem.family, motion.x, _instants(problem.family, motion), motion.factor)
    regressor = inputs.model.exact.regressor(dense.q, dense.v, dense.a)
    return replace(motion, merit=merit(problem, exact_values(problem, dense, regressor))), problem


def _other_values(front: StoredFront, condition: DesignCondition) -> tuple[str, ...]:
    """Return a note if the front states another condition number for its designed motion than it has now.

    Args:
        front: the front.
        condition: condition numbers of the motion with the present options.
    """
    name = front.values.names[0]
    now = condition.raw if name.endswith("raw") else condition.normalised
    stored = float(front.values.values[front.values.designed, 0])
    if not name.startswith("cond") or abs(now - stored) <= MAX_FRONT_CHANGE * stored:
        return ()
    return (f"front.csv states {name} {stored:.3g} for this motion; with the present options it has {now:.3g}",)


def _periodic(motion: SearchResult, inputs: ExcitationInputs, settings: ExcitationSettings, family: Family) -> Periodic:
    """Return a result of the search as a periodic motion.

    Args:
        motion: the result of the search.
        inputs: the robot, which names the joints.
        settings: settings of the design, with the controller's rate.
        family: family of motions of the search.
    """
    return Periodic(
        joint_names=inputs.chain.joint_names,
        kinds=tuple(joint.kind for joint in inputs.chain.joints),
        period=family.period * motion.factor,
        rate=settings.rate,
        repeat=settings.repeat,
        kind=settings.family,
        coefficients=tuple(family.coefficients(motion.x)),
        degree=getattr(family, "degree", DEFAULT_DEGREE),
    )


def _reached(
    problem: ExcitationProblem, goals: Sequence[AttainmentGoal], result: SearchResult, inputs: ExcitationInputs
) -> tuple[float, ...]:
    """Return the value of each goal that a motion reaches at `INSTANTS` samples.

    Coulomb friction is not smoothed additionally.

    Args:
        problem: the optimisation problem.
        goals: the goals.
        result: the motion.
        inputs: robot and model.
    """
    if not goals:
        return ()
    motion = dense_motion(problem.family, result.x, _instants(problem.family, result), result.factor)
    # as the condition's: information of earlier motions counts per sample
    scaled_goals = []
    for goal in goals:
        objective = goal.objective
        if isinstance(objective, Excitation) and objective.existing is not None:
            existing = objective.existing * (INSTANTS / problem.samples)
            goal = replace(goal, objective=replace(objective, existing=existing))
        scaled_goals.append(goal)
    Y = inputs.model.exact.regressor(motion.q, motion.v, motion.a)
    values = exact_values(replace(problem, goals=tuple(scaled_goals)), motion, Y)
    return tuple(values.tolist())


def _instants(family: Family, motion: SearchResult) -> np.ndarray:
    return family.period * motion.factor / INSTANTS * np.arange(INSTANTS)


def _excitation_problem(
    inputs: ExcitationInputs, settings: ExcitationSettings
) -> tuple[ExcitationProblem, tuple[MotionConstraint, ...], tuple[str, ...]]:
    """Return the optimisation problem of a design, the constraints for its verification, and notes for the user.

    Args:
        inputs: robot, model, limits and earlier motions.
        settings: settings of the design.

    Raises:
        UsageError: for a shortest period above the period.
    """
    constraints, checked, notes = _constraints(inputs.model, inputs.limits)
    condition = _condition_objective(inputs, settings)
    objectives = objectives_of(settings, condition, inputs)
    family, coarse = _family(inputs, settings)
    shortest = settings.shortest or settings.period
    if shortest > settings.period:
        raise UsageError(f"--shortest {shortest:g} s: expected at most the period, {settings.period:g} s")
    problem = ExcitationProblem(
        family,
        inputs.model.smooth.regressor,
        inputs.model.smooth.regressor_gradient,
        objectives,
        constraints,
        samples=settings.samples,
        stretch=(shortest / settings.period, 1.0),
        coarse=coarse,
    )
    return problem, checked, notes


def _with_whole_samples(
    motion: SearchResult, problem: ExcitationProblem, rate: float
) -> tuple[SearchResult, ExcitationProblem]:
    """Return motion and problem with the period increased to a whole number of controller samples.

    Args:
        motion: result of the search.
        problem: the optimisation problem.
        rate: rate of the controller [Hz].
    """
    if not problem.free_period:
        return motion, problem
    samples = problem.family.period * rate
    factor = np.ceil(motion.factor * samples - 1e-6) / samples
    return replace(motion, factor=factor), replace(problem, stretch=(factor, factor))


def _condition_objective(inputs: ExcitationInputs, settings: ExcitationSettings) -> Excitation:
    """Return the condition number of the identifiable columns as an objective, including earlier motions.

    Args:
        inputs: robot, model and earlier motions.
        settings: settings of the design.
    """
    existing = None
    if inputs.prior is not None:
        existing = inputs.prior.per_sample(settings.samples, settings.repeat * settings.period)
    columns = inputs.columns
    return Excitation("cond", sigmas=columns.sigmas, existing=existing, columns=columns.aimed)


def _searched(
    problem: ExcitationProblem, goals: Sequence[AttainmentGoal], starts: int, search: Search, show: Progress
) -> tuple[SearchResult, ExcitationProblem]:
    """Return the motion that a search finds, and the optimisation problem that was solved.

    If there are goals, but none for the condition numbers, a first search without goals determines the goal values of
    the condition numbers.

    Args:
        problem: the optimisation problem.
        goals: the goals; empty: none.
        starts: number of random starts.
        search: function that searches for the best motion of a problem.
        show: called with a text on each step.
    """
    has_condition_goal = any(isinstance(goal.objective, Excitation) for goal in goals)
    if not goals or has_condition_goal:
        problem = replace(problem, goals=tuple(goals))
        return search(problem, starts=starts), problem
    first = search(problem, starts=starts)
    if first.interrupted:
        return first, problem
    proposed = []
    for (objective, _), value in zip(problem.objectives, first.values):
        proposed.append(AttainmentGoal(objective, float(value)))
    attainment = replace(problem, goals=(*goals, *proposed))
    show("goal attainment")
    try:
        motion = search(attainment, starts=max(1, starts // 3), guesses=(first.x,))
    except KeyboardInterrupt:
        return replace(first, interrupted=True), problem
    evaluations = first.evaluations + motion.evaluations
    seconds = first.seconds + motion.seconds
    return replace(motion, evaluations=evaluations, seconds=seconds), attainment


def _condition_of(inputs: ExcitationInputs, family: Family, result: SearchResult, repeat: int = 1) -> DesignCondition:
    """Return the condition numbers at `INSTANTS` samples over the period, without smoothing of Coulomb friction.

    Args:
        inputs: robot, model and earlier motions.
        family: family of motions.
        result: the motion.
        repeat: number of periods that are run.
    """
    columns = inputs.columns
    motion = dense_motion(family, result.x, _instants(family, result), result.factor)
    Y = inputs.model.exact.regressor(motion.q, motion.v, motion.a)
    this_motion = condition_numbers(Y, columns.sigmas, columns=columns.aimed)
    if inputs.prior is None:
        return DesignCondition(**this_motion)
    existing = inputs.prior.per_sample(INSTANTS, repeat * family.period * result.factor)
    together = condition_numbers(Y, columns.sigmas, existing, columns.aimed)
    earlier = condition_numbers(0.0 * Y, None, existing, columns.aimed)
    return DesignCondition(
        together["raw"],
        together["normalised"],
        raw_alone=_finite(this_motion["raw"]),
        normalised_alone=_finite(this_motion["normalised"]),
        raw_before=_finite(earlier["raw"]),
        normalised_before=_finite(earlier["normalised"]),
    )


def _finite(condition: float) -> float | None:
    """Return a condition number; None if it is infinite, since a motion does not determine all columns."""
    if np.isfinite(condition):
        return condition
    return None


def _family(inputs: ExcitationInputs, settings: ExcitationSettings) -> tuple[Family, Family | None]:
    """Return the family of motions, and a family with fewer harmonics for the first stage of the search.

    The second family is None for splines, or if the first has few harmonics.

    Args:
        inputs: robot, limits and locked joints.
        settings: settings of the design.

    Raises:
        UsageError: for an unknown family.
    """
    fixed = {j: value for j, value in inputs.locked.items() if value is not None}
    resonance, harmonics = inputs.limits.resonance, settings.harmonics
    if harmonics is None:
        harmonics = HARMONICS
        if resonance is not None:
            harmonics = round(0.99 * settings.period * resonance / (2 * np.pi) - 0.5)
        harmonics = max(2, min(harmonics, HARMONICS))
    counts = np.full(inputs.chain.n, harmonics)
    locked = list(inputs.locked)
    if settings.family == "fourier":
        counts[locked] = 0
        fourier = partial(fourier_family, held=fixed, resonance=resonance, rate=settings.rate)
        family = fourier(np.minimum(counts, harmonics).tolist(), settings.period)
        coarse = fourier(np.minimum(counts, COARSE).tolist(), settings.period)
        return family, coarse if harmonics > COARSE else None
    counts[locked] = 1
    if settings.family == "bspline":
        return bspline_family(counts.tolist(), settings.period, held=fixed, rate=settings.rate), None
    raise UsageError(f"family '{settings.family}' is unknown; use fourier or bspline")


def _constraints(
    dynamics: ExcitedModel, limits: MotionLimits
) -> tuple[tuple[MotionConstraint, ...], tuple[MotionConstraint, ...], tuple[str, ...]]:
    """Return the constraints for the search, the constraints for the verification, and notes for the user.

    Constraints for the verification use the sign function of Coulomb friction without additional smoothing.

    Args:
        dynamics: the model to excite, with known values if torques are to be limited.
        limits: limits of the motion.
    """
    values = dynamics.values
    if values is None or not np.isfinite(limits.torque).any():
        return limits.constraints, limits.constraints, ()
    margin, notes = limits.margin, ()
    if margin is None:
        margin = 0.0
        if not dynamics.friction:
            margin = GUARD
            notes = (f"{GUARD:.0%} of the torque limits are reserved for friction",)

    def torque_limit(model: LoadCases) -> TorqueLimit:
        return TorqueLimit(
            model.regressor,
            model.regressor_gradient,
            values,
            model.of_rows(limits.torque),
            dynamics.covariance,
            limits.deviations,
            margin,
            model.torque_gradient,
            rows=model.row_names,
        )

    search = (*limits.constraints, torque_limit(dynamics.smooth))
    checked = (*limits.constraints, torque_limit(dynamics.exact))
    return search, checked, notes


def _nearest_goals(
    front: Front,
    problem: ExcitationProblem,
    goals: Sequence[AttainmentGoal],
    inputs: ExcitationInputs,
    designed: tuple[SearchResult, Verification],
    checked: tuple[MotionConstraint, ...],
) -> tuple[Front, SearchResult, Verification]:
    """Return the front, and the motion nearest to the goals with its verified margins.

    Candidates are the designed motion and the motions of the front. Without goals, the designed motion is returned.

    Args:
        front: the front.
        problem: the optimisation problem.
        goals: the goals; empty: none.
        inputs: robot and model.
        designed: the designed motion and its verified margins.
        checked: constraints for the verification.
    """

    def distance(motion: SearchResult) -> float:
        return merit(problem, np.array(_reached(problem, goals, motion, inputs)))

    motion, proof = designed
    if not goals:
        return front, motion, proof
    index = int(np.argmin([distance(candidate) for candidate in front.found]))
    nearest = replace(motion, x=front.found[index].x, factor=front.found[index].factor)
    with suppress(NothingFeasible):
        nearest, nearest_proof = ensured(problem, nearest, checked)
        if distance(nearest) < distance(motion):
            return replace(front, designed=index), nearest, nearest_proof
    return front, motion, proof


def _front(
    problem: ExcitationProblem,
    inputs: ExcitationInputs,
    motion: SearchResult,
    goals: Sequence[AttainmentGoal],
    count: int,
    evaluations: int,
    report: Callable[[int, int, str], None],
) -> Front:
    """Return the trade-offs between condition number and a torque goal, by the ε-constraint method.

    The torque goal is varied from its value at rest to its best value. It is the first torque goal in the settings
    (default: wrist). The condition number is the first one among the goals (default: the normalised one, or the aim).

    Args:
        problem: the optimisation problem.
        inputs: robot and model.
        motion: the designed motion, which is added to the front.
        goals: the goals.
        count: number of trade-offs.
        evaluations: largest number of evaluations of each search.
        report: called with the number of searches done, their total, and a sentence.
    """
    slacks = [goal.objective for goal in goals if isinstance(goal.objective, TorqueSlack)]
    slack = slacks[0] if slacks else torque_slack(wrist(inputs.chain.n), inputs, "front")
    conditions = [goal.objective for goal in goals if isinstance(goal.objective, Excitation)]
    condition = conditions[0] if conditions else problem.objectives[-1][0]
    without_goals = replace(problem, goals=())
    ends = proposed_goals(without_goals, [condition, slack], starts=1, evaluations=END_EVALUATIONS, guesses=(motion.x,))
    runs = [run for _, run in ends]
    return sweep(problem, condition, slack, count, runs, motion, evaluations=evaluations, report=report)
