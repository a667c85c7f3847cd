"""Designing exciting motions: a robot's regressor and limits handed to the package `trajectories`."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from calib.data.poses.fit_options import FitOptions
from calib.errors import UsageError
from calib.procedure.excitation.goals import SCALINGS, objective_of, read_goals, scaled, with_conditions
from calib.procedure.excitation.limits import MotionLimits, read_motion_limits
from calib.procedure.excitation.locked_joints import IdentifiableColumns, read_held, told
from calib.procedure.excitation.model import ExcitedModel, read_dynamics
from calib.procedure.excitation.playback import Playback, check_playback, play
from calib.procedure.excitation.prior_motions import Existing, read_existing
from calib.procedure.kinematic_stage.inputs import load_robot
from calib.robot.chain import Chain
from trajectories.basis import Family, aligned_period
from trajectories.bspline import bspline_family
from trajectories.constraints import MotionConstraint, TorqueLimit
from trajectories.design.objectives import Excitation, TorqueSlack, condition_numbers
from trajectories.design.optimise import design
from trajectories.design.pareto import Front, proposed_goals, sweep
from trajectories.design.problem import AttainmentGoal, ExcitationProblem
from trajectories.design.search import SearchResult
from trajectories.design.verify import Verification, dense_motion, ensured
from trajectories.fourier import fourier_family

GUARD = 0.2  # share of the torque limits kept free where no friction is known (our choice)
INSTANTS = 1000  # over the period, at which condition numbers are reported
Progress = Callable[[str], None]


@dataclass(frozen=True, eq=False)
class Designed:
    """An exciting motion with its proof.

    Attributes:
        chain, dynamics, limits, family: what it was made for.
        problem: that was solved last.
        found: the motion; `proof`: its margins, checked independently.
        condition: raw and normalised, of `INSTANTS` samples over the period with the model's own Coulomb sign.
        goals: name, goal, weight and what was reached.
        front: trade-offs, where asked for.
        playback: what a controller is to run.
        held: joints that stay, and their values; `told`: the columns that can be told.
        existing: what motions before tell; None without any.
        rate: of the controller [Hz].
        notes: what a user should know.
    """

    chain: Chain
    dynamics: ExcitedModel
    limits: MotionLimits
    family: Family
    problem: ExcitationProblem
    found: SearchResult
    proof: Verification
    condition: dict[str, float]
    goals: tuple[tuple[str, float, float, float], ...]
    front: Front | None
    playback: Playback
    held: Mapping[int, float]
    told: IdentifiableColumns
    existing: Existing | None
    rate: float
    kind: str
    notes: tuple[str, ...]

    @property
    def period(self) -> float:
        return self.family.period * self.found.factor


def excite(
    robot: str | Path,
    *,
    model: Path | None = None,
    limits: Path | None = None,
    goals: Sequence[str] = (),
    hard: Sequence[str] = (),
    period: float = 20.0,
    harmonics: int = 5,
    family: str = "fourier",
    drives_: str = "Fv Fc off",
    rate: float = 1000.0,
    samples: int = 200,
    starts: int = 6,
    evaluations: int = 600,
    front: int = 0,
    start: Sequence[float] | None = None,
    repeat: int = 1,
    slower: float = 1.0,
    existing: Sequence[str] = (),
    lock: Sequence[str] = (),
    base: str | None = None,
    tip: str | None = None,
    seed: int = 0,
    map: Callable = map,
    progress: Progress | None = None,
) -> Designed:
    """Design a motion that excites the dynamics of a robot within its limits.

    Without goals the logarithms of both condition numbers, raw and normalised, are minimised in equal parts. With goals
    (``wrist=0.1``) both take part with what a single-objective run reached as their goal (the study's advice), unless
    they are given themselves.

    Args:
        robot: see `calib.robot.load`.
        model: folder of an identification: torques, friction and their uncertainty.
        limits: see `calib.procedure.excitation.limits`.
        goals, hard: ``raw=35``, ``normalised=6`` (condition numbers), ``wrist=0.1`` or ``joint6=0.1`` (mean torque as a
            share of the limit, at least), ``coverage=0.1`` (share of time at low and at high speed, either way).
        period: T0 [s], of the first motion.
        harmonics: n_f, or control points beside the rest conditions for splines.
        family: "fourier" or "bspline".
        drives_: terms of each joint's drive, without a model.
        rate: the controller's [Hz].
        samples, starts, evaluations, seed, map: of the search.
        front: motions on the front between the normalised condition number and the first torque goal.
        start: (n,) where the robot stands, for an approach; repeat: periods; slower: factor of a rehearsal.
        existing: recordings, or folders of earlier excitations, that count already; the new motion counts `repeat`
            times.
        lock: joints that stay, ``joint4`` or ``joint4=0.5``.

    Ctrl-C ends the search; the best motion found so far is verified and returned.
    """
    say = progress or (lambda words: None)
    chain, source = load_robot(robot, None, FitOptions(), base, tip)
    found_limits = read_motion_limits(limits, chain, source)
    dynamics = read_dynamics(chain, model, drives_, found_limits)
    check_playback(repeat, slower, start, chain, found_limits)
    held = read_held(lock, chain, found_limits.positions)
    motions = _family(family, harmonics, period, held, chain, found_limits, rate)
    search, check, notes = _constraints(dynamics, found_limits)
    before = read_existing(existing, dynamics, chain)
    columns = told(dynamics, chain, held, None if before is None else before.information)
    known = None if before is None else before.per_sample(samples, repeat * period)
    condition = Excitation("cond", sigmas=columns.sigmas, existing=known, columns=columns.columns)
    problem = ExcitationProblem(
        motions, dynamics.smooth.regressor, dynamics.smooth.regressor_gradient,
        tuple((scaled(condition, scaling), 0.5) for scaling in SCALINGS), search, samples=samples,
    )  # fmt: skip
    wanted = read_goals([*goals, *hard], dynamics, chain, found_limits, len(goals), condition)
    run = partial(design, evaluations=evaluations, seed=seed, map=map, report=_reporter(say))
    found, problem = _searched(problem, wanted, starts, run, say, condition)
    say("verifying")
    found, proof = ensured(problem, found, check)
    trade = None
    if front and not found.interrupted:
        with suppress(KeyboardInterrupt):  # the motion is there: what comes besides may be cut short
            trade = _front(problem, dynamics, chain, found_limits, found, wanted, front, condition, _reporter(say))
    reached = condition_of(dynamics, motions, found, columns, before, repeat)
    played = play(motions, found, dynamics, chain, found_limits, rate=rate, start=start, repeat=repeat, slower=slower)
    cut = ("interrupted before any motion met the goals",) if wanted and not problem.goals else ()
    stays = {j: float(played.run.q[-1, j]) for j in held}
    return Designed(
        chain, dynamics, found_limits, motions, problem, found, proof, reached, _reached(problem, found), trade,
        played, stays, columns, before, rate, family,
        (*found_limits.notes, *dynamics.notes, *notes, *columns.notes, *cut, *played.notes),
    )  # fmt: skip


def _searched(
    problem: ExcitationProblem,
    wanted: list[tuple[str, AttainmentGoal]],
    starts: int,
    search: Callable[..., SearchResult],
    say: Progress,
    condition: Excitation,
) -> tuple[SearchResult, ExcitationProblem]:
    """Search without goals, or for the goals: with a first run that proposes some for the condition numbers."""
    if not wanted:
        return search(problem, starts=starts), problem
    if set(SCALINGS) & {name for name, _ in wanted}:
        problem = replace(problem, goals=tuple(goal for _, goal in wanted))
        return search(problem, starts=starts), problem
    first = search(problem, starts=starts)
    if first.interrupted:
        return first, problem
    plain, problem = problem, replace(problem, goals=with_conditions(wanted, first, condition))
    say("goal attainment")
    try:
        found = search(problem, starts=max(1, starts // 3), guesses=(first.x,))
    except KeyboardInterrupt:
        return replace(first, interrupted=True), plain
    spent, seconds = first.evaluations + found.evaluations, first.seconds + found.seconds
    return replace(found, evaluations=spent, seconds=seconds), problem


def _reporter(say: Progress) -> Callable[[int, int, str], None]:
    return lambda done, total, what: say(f"{what} ({done} of {total})")


def condition_of(
    dynamics: ExcitedModel,
    family: Family,
    found: SearchResult,
    told: IdentifiableColumns,
    existing: Existing | None = None,
    repeat: int = 1,
) -> dict[str, float]:
    """Return the condition numbers of `INSTANTS` samples over the period, with the model's own Coulomb sign.

    With motions before they are those of all motions together; ``alone`` and ``before`` say what each has by itself.
    """
    times = family.period * found.factor / INSTANTS * np.arange(INSTANTS)
    motion = dense_motion(family, found.x, times, found.factor)
    Y = dynamics.exact.regressor(motion.q, motion.v, motion.a)
    alone = condition_numbers(Y, told.sigmas, columns=told.columns)
    if existing is None:
        return alone
    known = existing.per_sample(INSTANTS, repeat * family.period * found.factor)
    both = condition_numbers(Y, told.sigmas, known, told.columns)
    before = condition_numbers(0.0 * Y, None, known, told.columns)
    return both | {f"{key}_alone": alone[key] for key in alone} | {f"{key}_before": before[key] for key in before}


def metrics(designed: Designed) -> dict[str, Any]:
    """Return the content of ``metrics.json``."""
    found = designed.found
    return {
        "condition_number": designed.condition,
        "objective": found.merit,
        "feasible": designed.proof.feasible,
        "margins": {
            name: {
                "margin": one.margin, "unit": one.unit, "at": one.label, "time": one.time, "share": one.share,
                "allowance": one.allowance, "proved": one.proved,
            }
            for name, one in designed.proof.worst.items()
        },
        "seconds": found.seconds,
        "evaluations": found.evaluations,
        "feasible_evaluations": found.feasible,
        "history": list(found.history),
        "goals": {name: {"goal": goal, "weight": w, "reached": value} for name, goal, w, value in designed.goals},
        "setting": {
            "robot": designed.chain.name, "family": designed.kind, "period": designed.period,
            "harmonics": list(getattr(designed.family, "harmonics", getattr(designed.family, "counts", ()))),
            "columns": list(designed.told.names), "samples": designed.problem.samples,
            "samples_reported": INSTANTS, "instants_verified": designed.proof.instants, "rate": designed.rate,
            "interrupted": found.interrupted,
            "held": {designed.chain.joint_names[j]: value for j, value in designed.held.items()},
        },
        "existing": None if designed.existing is None
        else {"names": list(designed.existing.names), "seconds": designed.existing.seconds},
        "playback": {
            "repeat": designed.playback.repeat, "seconds": designed.playback.run.duration,
            "approach": None if designed.playback.approach is None else designed.playback.approach.duration,
            "rehearsal": None if designed.playback.rehearsal is None else designed.playback.rehearsal.duration,
        },
        "notes": list(designed.notes),
    }  # fmt: skip


def _family(
    kind: str,
    harmonics: int,
    period: float,
    held: Mapping[int, float | None],
    chain: Chain,
    limits: MotionLimits,
    rate: float,
) -> Family:
    values = {j: value for j, value in held.items() if value is not None}
    if kind == "fourier":
        counts = [0 if j in held else harmonics for j in range(chain.n)]
        return fourier_family(counts, period, held=values, resonance=limits.resonance, rate=rate)
    if kind == "bspline":
        counts = [1 if j in held else harmonics for j in range(chain.n)]
        return bspline_family(counts, period, held=values, rate=rate)
    raise UsageError(f"family '{kind}' is none of fourier, bspline")


def _constraints(
    dynamics: ExcitedModel, limits: MotionLimits
) -> tuple[tuple[MotionConstraint, ...], tuple[MotionConstraint, ...], tuple[str, ...]]:
    """Return what the search keeps, and what is verified: the torque with the model's own Coulomb sign."""
    if dynamics.values is None or not np.isfinite(limits.torque).any():
        return limits.constraints, limits.constraints, ("no torque limit is checked",)
    margin, notes = limits.margin, ()
    if margin is None:
        margin = 0.0 if dynamics.friction else GUARD
        notes = () if dynamics.friction else (f"{GUARD:.0%} of the torque limits stay free for friction",)
    torque = [
        TorqueLimit(
            one.regressor, one.regressor_gradient, dynamics.values, limits.torque, dynamics.covariance,
            limits.deviations, margin,
        )
        for one in (dynamics.smooth, dynamics.exact)
    ]  # fmt: skip
    return (*limits.constraints, torque[0]), (*limits.constraints, torque[1]), notes


def _reached(problem: ExcitationProblem, found: SearchResult) -> tuple[tuple[str, float, float, float], ...]:
    return tuple(
        (goal.objective.name, goal.goal, goal.share, float(value)) for goal, value in zip(problem.goals, found.values)
    )


def _front(
    problem: ExcitationProblem,
    dynamics: ExcitedModel,
    chain: Chain,
    limits: MotionLimits,
    found: SearchResult,
    wanted: list[tuple[str, AttainmentGoal]],
    count: int,
    condition: Excitation,
    report: Callable[[int, int, str], None],
) -> Front:
    """Sweep the first torque goal (default: the wrist) between what this motion has and what it can reach alone."""
    slack = next((goal.objective for _, goal in wanted if isinstance(goal.objective, TorqueSlack)), None)
    if slack is None:
        slack = objective_of("wrist", 0.5, dynamics, chain, limits, "wrist", condition)[0]
    motion = problem.basis().motion(found.x)
    begin = slack.evaluate(motion, problem.regressor(motion.q, motion.v, motion.a)).value
    (end, alone), *_ = proposed_goals(
        replace(problem, goals=()), [slack], starts=1, evaluations=150, guesses=(found.x,)
    )
    levels = np.linspace(begin, end, count + 1)[:-1].tolist() if end < begin else [begin]
    return sweep(problem, scaled(condition, "normalised"), slack, levels, found.x, alone.x, report=report)


def periods(designed: Designed) -> int:
    """Return how many samples of the controller one period holds."""
    return aligned_period(designed.period, designed.rate)
