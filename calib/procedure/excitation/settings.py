"""Settings of designing and planning motions: one default each, for the commands, the guided run and scripts alike."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Annotated, Literal

from calib.arguments import Within, checked
from calib.errors import UsageError

Rate = Annotated[float, Within(above=0.0, most=1e5)]  # [Hz]
Slower = Annotated[float, Within(1.0, 1000.0)]
HARMONICS = 12  # per joint: cond falls by a fifth from 5 to 12, by a tenth more to 20 at twice the cost (our choice)
FAMILIES = ("fourier", "bspline")
GOALS = ("raw", "normalised", "duration", "coverage", "wrist")  # and joint1, joint2, …
AIMS: tuple[Literal["logdet", "smallest"], ...] = ("logdet", "smallest")
COARSE = 5  # harmonics that a search begins with (our choice)


@checked
@dataclass(frozen=True)
class ExcitationSettings:
    """How an exciting motion is designed and played.

    Attributes:
        goals, hard: ``raw=35``, ``normalised=6`` (condition numbers), ``wrist=0.1`` or ``joint6=0.1`` (mean torque as a
            share of the limit, at least), ``coverage=0.1`` (share of time at low and at high speed, either way),
            ``duration=12`` [s]; hard ones must be met. Without any the logarithms of both condition numbers are
            minimised in equal parts; ``logdet`` or ``smallest`` among the goals: that index in their place.
        period: T0 of the motion [s], at most; shortest: what the search may shorten it to [s]; None: it is kept.
        harmonics: frequencies per joint, or control points beside the rest conditions of splines; None: `HARMONICS`, or
            as many as stay below the limits' resonance.
        family: "fourier" or "bspline".
        drives: terms of each joint's drive, where no identified model has its own.
        rate: of the controller [Hz].
        samples: instants over the period at which the search evaluates.
        starts: random starts of the search; evaluations: most of one start; seed: of the starts.
        front: motions on the front between the normalised condition number and the first torque goal; 0 for none.
        start: (n,) where the robot stands [rad or m], for an approach; None for none.
        repeat: periods to run one after the other.
        slower: factor of a slow rehearsal, 1 for none.
        existing: recordings (``log.npz@0:9.4`` cuts), or folders of earlier excitations, that count already; the new
            motion counts `repeat` times.
        lock: joints that stay, ``joint4`` or ``joint4=0.5`` [rad or m].
        noise: of the torques, what no parameter explains, as a share of their limits; for the prediction alone. None:
            `calib.procedure.excitation.prediction.NOISE`.
        outlook: whether to look at what other periods would tell.
    """

    goals: tuple[str, ...] = ()
    hard: tuple[str, ...] = ()
    period: Annotated[float, Within(above=0.0, most=3600.0)] = 20.0
    shortest: Annotated[float, Within(above=0.0, most=3600.0)] | None = None
    harmonics: Annotated[int, Within(1, 200)] | None = None
    family: str = "fourier"
    drives: str = "Fv Fc off"
    rate: Rate = 1000.0
    samples: Annotated[int, Within(10, 100_000)] = 200
    starts: Annotated[int, Within(1, 10_000)] = 4
    evaluations: Annotated[int, Within(1, 10_000_000)] = 1500
    seed: Annotated[int, Within(0, 2**63)] = 0
    front: Annotated[int, Within(0, 1000)] = 0
    start: tuple[float, ...] | None = None
    repeat: Annotated[int, Within(1, 10_000)] = 1
    slower: Slower = 1.0
    existing: tuple[str, ...] = ()
    lock: tuple[str, ...] = ()
    noise: Annotated[float, Within(above=0.0, most=1.0)] | None = None
    outlook: bool = True

    def __post_init__(self) -> None:
        if self.family not in FAMILIES:
            raise UsageError(f"family '{self.family}' is none of {', '.join(FAMILIES)}")
        for text in (*self.goals, *self.hard):
            if text not in AIMS or text in self.hard:
                split_goal(text)


def split_goal(text: str) -> tuple[str, float]:
    """Return name and number of a goal, ``wrist=0.1``.

    Raises:
        UsageError: for a name that no goal has, and for no number.
    """
    name, _, amount = text.partition("=")
    try:
        value = float(amount)
    except ValueError:
        raise UsageError(f"goal '{text}': expected NAME=NUMBER, e.g. wrist=0.1, or {', '.join(AIMS)}") from None
    if name not in GOALS and not re.fullmatch(r"joint[1-9]\d*", name):
        raise UsageError(f"goal '{text}': '{name}' is none of {', '.join(GOALS)}, joint1 …")
    return name, value


DEFAULT_DESIGN = ExcitationSettings()


@checked
@dataclass(frozen=True)
class PlanSettings:
    """How a motion through waypoints is planned.

    Attributes:
        payloads: labels of identified payloads on board.
        lines: the tool runs straight from waypoint to waypoint, and rests at each.
        rate: of the controller [Hz].
        shorten: timings to spend on a faster shape between waypoints (`trajectories.timing.shape`); 0 for none.
        stray: how far that shape may leave the spline, per joint [rad or m].
        start: (n,) where the robot stands [rad or m], for an approach; None for none.
        slower: factor of a slow rehearsal, 1 for none.
    """

    payloads: tuple[str, ...] = ()
    lines: bool = False
    rate: Rate = 1000.0
    shorten: Annotated[int, Within(0, 100_000)] = 0
    stray: Annotated[float, Within(0.0, 10.0)] = 0.0
    start: tuple[float, ...] | None = None
    slower: Slower = 1.0


DEFAULT_PLAN = PlanSettings()
