"""Settings for designing and planning motions; commands, guided procedure and scripts use the same defaults."""

import re
from dataclasses import dataclass
from typing import Annotated, Literal, get_args

from calib.arguments import checked
from calib.config_types import Checked, Flag, OneOf, Real, Seed, Text, Typed, Whole
from calib.errors import UsageError, refused_as

Solver = Literal["slsqp", "mma", "ccsaq", "auglag"]

# per joint: cond falls by a fifth from 5 to 12, by a tenth more to 20 at twice the cost (our choice)
HARMONICS = 12
# harmonics that a search begins with (our choice)
COARSE = 5
# terms that a description may state
DRIVES = ("Ia", "Fv", "Fc", "off")
# with a number each; besides joint1, joint2, …
GOALS = ("raw", "normalised", "duration", "coverage", "wrist")
# without a number
AIMS = ("logdet", "smallest", "torque", "parameters")


def split_goal(text: str) -> tuple[str, float]:
    """Return name and value of a goal.

    Args:
        text: the goal, such as ``wrist=0.1``.

    Raises:
        UsageError: for an unknown name, or a missing number.
    """
    name, _, amount = text.partition("=")
    expected = f"goal '{text}': expected NAME=NUMBER, e.g. wrist=0.1, or {', '.join(AIMS)}"
    with refused_as(UsageError, ValueError, expected):
        value = float(amount)
    if name not in GOALS and not re.fullmatch(r"joint[1-9]\d*", name):
        advice = f"use {', '.join(GOALS)}, joint1 …, each with its number, or {' or '.join(AIMS)}"
        raise UsageError(f"goal '{text}': '{name}' is unknown; {advice}")
    return name, value


def checked_goal(text: object, aims: tuple[str, ...] = AIMS) -> object:
    """Return the text of a goal after checking its name and number; anything but a text is returned as it is.

    Args:
        text: the goal, such as ``wrist=0.1`` or ``logdet``.
        aims: names of goals without a number.

    Raises:
        UsageError: for an unknown name, or a missing number.
    """
    if isinstance(text, str) and text not in aims:
        split_goal(text)
    return text


Goal = Annotated[str, Checked(checked_goal)]
HardGoal = Annotated[str, Checked(lambda text: checked_goal(text, ()))]
Rate = Annotated[float, Real(above=0.0, most=1e5, unit="Hz")]
Period = Annotated[float, Real(above=0.0, most=3600.0, unit="s")]
Front = Annotated[int, Whole(0, 1000)]
Slower = Annotated[float, Real(least=1.0, most=1000.0)]
Starts = Annotated[int, Whole(1, 10_000)]
Evaluations = Annotated[int, Whole(1, 10_000_000)]
Harmonics = Annotated[int, Whole(1, 200)]
# joint values [rad or m]
Start = tuple[Annotated[float, Real(infinite=True, quantity="1")], ...]


@checked
@dataclass(frozen=True)
class ExcitationSettings:
    """Settings for designing and playing an exciting motion.

    Without goals, the logarithms of both condition numbers (raw and normalised) are minimised with equal weights.

    Attributes:
        goals: raw=35, normalised=6 (condition numbers), wrist=0.1 or joint6=0.1 (mean torque as a share of the limit,
            at least), coverage=0.1 (share of time at low and at high speed), duration=12 [s]; repeatable. Instead of
            condition numbers, without a number: logdet, smallest (of the information), torque or parameters (predicted
            σ of torques on a typical task, or of parameters relative to their values)
        hard: a goal that the motion must reach, e.g. wrist=0.1; repeatable
        period: largest period of the motion [s]
        shortest: shortest period that the search may use [s]; default: the period is fixed
        harmonics: frequencies per joint, or control points of splines; default 12, or as many as are below resonance
        family: fourier (Fourier series) or bspline (splines)
        drives: drive terms to identify, if neither an identified model nor options state them; default Ia Fv Fc off, as
            of calib identify
        loads: payloads of one run: none, a label, or labels with +; the same motion runs once with each; repeatable.
            Default: none, then each payload of the options
        columns: parameters that the motion has to determine, or essential: those that the identification of the model
            kept; repeatable. Default: all
        rate: of the controller [Hz]
        samples: instants per period at which the search evaluates limits and objectives
        starts: random starts of the search
        evaluations: largest number of evaluations per start
        solver: slsqp (SciPy); mma, ccsaq or auglag (NLopt)
        seed: of all random numbers; the same seed gives the same motion
        front: number of trade-offs between condition number (the goals', or normalised) and first torque goal; 0: none
        start: joint values with commas [rad or m]; adds an approach from there
        repeat: number of periods to run one after the other
        slower: factor of a slow rehearsal, written next to the motion; 1: none
        existing: a recording (log.npz@0:9.4 cuts) or folder of an earlier design, to complement; repeatable
        within: folder of an earlier design, whose positions, speeds and accelerations are not exceeded: for a motion to
            validate on
        lock: a joint that does not move: joint4, or joint4=0.5 [rad or m]; repeatable
        noise: expected torque residual as a share of the torque limits; only for predicted sigmas; default 0.01, or
            that of each joint in the limits file ([noise])
        outlook: also predict the sigmas of motions with other periods
    """

    goals: tuple[Goal, ...] = ()
    hard: tuple[HardGoal, ...] = ()
    period: Period = 20.0
    shortest: Period | None = None
    harmonics: Harmonics | None = None
    family: Annotated[str, OneOf(("fourier", "bspline"))] = "fourier"
    drives: Text = ""
    loads: tuple[str, ...] = ()
    columns: tuple[str, ...] = ()
    rate: Rate = 1000.0
    samples: Annotated[int, Whole(10, 100_000)] = 200
    starts: Starts = 4
    evaluations: Evaluations = 1500
    solver: Annotated[Solver, OneOf(get_args(Solver))] = "slsqp"
    seed: Seed = 0
    front: Front = 0
    start: Start | None = None
    repeat: Annotated[int, Whole(1, 10_000)] = 1
    slower: Slower = 1.0
    existing: tuple[str, ...] = ()
    within: Text = ""
    lock: tuple[str, ...] = ()
    noise: Annotated[float, Real(above=0.0, most=1.0)] | None = None
    outlook: Flag = True


DEFAULT_DESIGN = ExcitationSettings()


@checked
@dataclass(frozen=True)
class PlanSettings:
    """Settings for planning a motion through waypoints.

    Attributes:
        payloads: label of an identified payload that is attached; repeatable
        lines: the tool moves straight from waypoint to waypoint, and stops at each
        rate: of the controller [Hz]
        shorten: number of timings to search for a faster path between waypoints; 0: none
        stray: largest deviation of that path from the spline, per joint [rad or m]
        start: joint values with commas [rad or m]; adds an approach from there
        slower: factor of a slow rehearsal, written next to the motion; 1: none
    """

    payloads: tuple[str, ...] = ()
    lines: Annotated[Flag, Typed("--line")] = False
    rate: Rate = 1000.0
    shorten: Annotated[int, Whole(0, 100_000)] = 0
    stray: Annotated[float, Real(least=0.0, most=10.0)] = 0.0
    start: Start | None = None
    slower: Slower = 1.0


DEFAULT_PLAN = PlanSettings()
