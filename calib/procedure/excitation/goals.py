"""The goals of an excitation, as said on the command line.

``raw=35``, ``normalised=6``: condition numbers; ``wrist=0.1``, ``joint6=0.1``: mean torque; ``coverage=0.1``: speeds;
``duration=12``: the period [s], where ``--shortest`` leaves it free. ``logdet`` and ``smallest``, without a number: the
information's determinant, or its smallest singular value, is made as large as can be in place of condition numbers.
"""

from dataclasses import dataclass, replace

import numpy as np

from calib.errors import UsageError, require
from calib.procedure.excitation.inputs import ExcitationInputs
from calib.procedure.excitation.settings import AIMS, ExcitationSettings, split_goal
from trajectories.design.objectives import (
    Duration,
    Excitation,
    FrictionCoverage,
    Index,
    Objective,
    Scaling,
    TorqueSlack,
)
from trajectories.design.problem import AttainmentGoal

SCALINGS: tuple[Scaling, ...] = ("raw", "normalised")


@dataclass(frozen=True, eq=False)
class NamedGoal:
    """A goal under the name it was given."""

    name: str
    goal: AttainmentGoal


def objectives_of(settings: ExcitationSettings, condition: Excitation) -> tuple[tuple[Objective, float], ...]:
    """Return what is minimised: the aim of the settings, or both condition numbers in equal parts.

    Args:
        condition: see `read_goals`.

    Raises:
        UsageError: for two aims, or one together with the condition numbers that it replaces.
    """
    aims: list[Index] = [one for one in AIMS if one in settings.goals]
    if not aims:
        return tuple((replace(condition, scaling=scaling), 0.5) for scaling in SCALINGS)
    others = [text for text in (*settings.goals, *settings.hard) if text.partition("=")[0] in (*SCALINGS, *AIMS)]
    if len(others) > 1:
        raise UsageError(f"goals {', '.join(others)}: '{aims[0]}' takes the place of the others; leave them out")
    return ((replace(condition, index=aims[0]), 1.0),)


def read_goals(settings: ExcitationSettings, given: ExcitationInputs, condition: Excitation) -> list[NamedGoal]:
    """Return the goals of the settings, soft ones first.

    Args:
        condition: what a condition number is of: columns, rows, what is known already.

    Raises:
        UsageError: for a goal that is none, or that nothing is known to reckon it with.
    """
    result = []
    for weight, texts in ((None, settings.goals), (0.0, settings.hard)):
        for text in texts:
            if text in AIMS and weight is None:
                continue
            name, value = split_goal(text)
            objective, goal = _objective(name, value, given, condition, settings.shortest)
            result.append(NamedGoal(name, AttainmentGoal(objective, goal, weight)))
    return result


def _objective(
    name: str, value: float, given: ExcitationInputs, condition: Excitation, shortest: float | None
) -> tuple[Objective, float]:
    """Return the objective of a name, and the goal to minimise it to."""
    text, chain = f"{name}={value:g}", given.chain
    if name in SCALINGS:
        require(value > 1, f"goal '{text}': a condition number is above 1", UsageError)
        return replace(condition, scaling=name), value
    if name == "duration":
        if shortest is None or not value > 0:
            raise UsageError(f"goal '{text}': needs --shortest, and a period above 0 s")
        return Duration(), value
    if name == "coverage":
        speeds = np.array([joint.velocity for joint in chain.joints])
        if not np.isfinite(speeds).all() or not 0 < value < 0.25:
            raise UsageError(f"goal '{text}': needs velocity limits, and a share of time above 0 and below 0.25")
        return FrictionCoverage(0.1 * speeds, 0.5 * speeds, value), 0.01
    numbered = {f"joint{j + 1}": (j,) for j in range(chain.n)} | {"wrist": wrist(chain.n)}
    if name not in numbered:
        raise UsageError(f"goal '{text}': '{name}' is none of raw, normalised, duration, coverage, wrist, joint1 …")
    require(0 < value < 1, f"goal '{text}': the mean torque is a share of its limit, above 0 and below 1", UsageError)
    return torque_slack(numbered[name], given, f"goal '{text}'"), 1.0 - value


def wrist(n: int) -> tuple[int, ...]:
    """Return the last two of n joints."""
    return tuple(range(max(0, n - 2), n))


def torque_slack(joints: tuple[int, ...], given: ExcitationInputs, where: str) -> TorqueSlack:
    """Return the objective that the mean torque of some joints leaves little of their limits.

    Raises:
        UsageError: where torques cannot be predicted, or have no limit.
    """
    values, limits = given.model.values, given.limits.torque
    if values is None or not np.isfinite(limits[list(joints)]).all():
        raise UsageError(f"{where}: needs torque limits and a model or masses to predict torques with")
    return TorqueSlack(joints, values, limits)
