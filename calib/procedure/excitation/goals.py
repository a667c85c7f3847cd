"""The goals of an excitation, as said on the command line.

``raw=35``, ``normalised=6``: condition numbers; ``wrist=0.1``, ``joint6=0.1``: mean torque; ``coverage=0.1``: speeds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from calib.errors import UsageError
from calib.procedure.excitation.limits import MotionLimits
from calib.procedure.excitation.model import ExcitedModel
from calib.robot.chain import Chain
from trajectories.design.objectives import Excitation, FrictionCoverage, Objective, Scaling, TorqueSlack
from trajectories.design.problem import AttainmentGoal
from trajectories.design.search import SearchResult

SCALINGS: tuple[Scaling, ...] = ("raw", "normalised")


def read_goals(
    texts: Sequence[str], dynamics: ExcitedModel, chain: Chain, limits: MotionLimits, soft: int, condition: Excitation
) -> list[tuple[str, AttainmentGoal]]:
    """Return the goals said on the command line, by name.

    Args:
        soft: those from here on are hard.
        condition: what a condition number is of: columns, rows, what is known already.
    """
    result = []
    for number, text in enumerate(texts):
        name, _, amount = text.partition("=")
        try:
            value = float(amount)
        except ValueError:
            raise UsageError(f"goal '{text}': expected NAME=NUMBER, e.g. wrist=0.1") from None
        objective, goal = objective_of(name, value, dynamics, chain, limits, text, condition)
        result.append((name, AttainmentGoal(objective, goal, None if number < soft else 0.0)))
    return result


def objective_of(
    name: str,
    value: float,
    dynamics: ExcitedModel,
    chain: Chain,
    limits: MotionLimits,
    text: str,
    condition: Excitation,
) -> tuple[Objective, float]:
    if name in SCALINGS:
        if not value > 1:
            raise UsageError(f"goal '{text}': a condition number is above 1")
        return scaled(condition, name), value
    if name == "coverage":
        speeds = np.array([joint.velocity for joint in chain.joints])
        if not np.isfinite(speeds).all() or not 0 < value < 0.25:
            raise UsageError(f"goal '{text}': needs velocity limits, and a share of time above 0 and below 0.25")
        return FrictionCoverage(0.1 * speeds, 0.5 * speeds, value), 0.01
    numbered = {f"joint{j + 1}": (j,) for j in range(chain.n)} | {"wrist": tuple(range(max(0, chain.n - 2), chain.n))}
    if name not in numbered:
        raise UsageError(f"goal '{text}': '{name}' is none of raw, normalised, coverage, wrist, joint1 …")
    if not 0 < value < 1:
        raise UsageError(f"goal '{text}': the mean torque is a share of its limit, above 0 and below 1")
    if dynamics.values is None or not np.isfinite(limits.torque[list(numbered[name])]).all():
        raise UsageError(f"goal '{text}': needs torque limits and a model or masses to predict torques with")
    return TorqueSlack(numbered[name], dynamics.values, limits.torque), 1.0 - value


def scaled(condition: Excitation, scaling: Scaling) -> Excitation:
    return replace(condition, scaling=scaling)


def with_conditions(
    wanted: list[tuple[str, AttainmentGoal]], found: SearchResult, condition: Excitation
) -> tuple[AttainmentGoal, ...]:
    """Add the condition numbers with what the first run reached as their goals."""
    both = zip(SCALINGS, found.values)
    conditions = (AttainmentGoal(scaled(condition, scaling), float(value)) for scaling, value in both)
    return (*(goal for _, goal in wanted), *conditions)
