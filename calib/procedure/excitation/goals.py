"""Objectives and goals of an excitation, from the settings.

They are described in `calib.procedure.excitation.settings.ExcitationSettings`.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import cast, get_args

import numpy as np

from calib.errors import UsageError, require
from calib.procedure.excitation.inputs import ExcitationInputs
from calib.procedure.excitation.prediction import task_states
from calib.procedure.excitation.settings import AIMS, ExcitationSettings, split_goal
from calib.trajectories.design.objectives import (
    Duration,
    Excitation,
    FrictionCoverage,
    Index,
    Objective,
    Scaling,
    TorqueSlack,
)
from calib.trajectories.design.problem import AttainmentGoal

SCALINGS: tuple[Scaling, ...] = ("raw", "normalised")
GUARD = 0.2  # share of the torque limits kept free where no friction is known (our choice)
TYPICAL = {"sign": 0.07, "velocity": 0.13}  # Coulomb and viscous friction, at full speed together `GUARD` (our choice)


def objectives_of(
    settings: ExcitationSettings, condition: Excitation, given: ExcitationInputs
) -> tuple[tuple[Objective, float], ...]:
    """Return the objectives and their weights: as set, or both condition numbers with equal weights.

    Args:
        condition: see `read_goals`.
        given: robot and model; without goals the determinant is the aim where an identification states torque errors.

    Raises:
        UsageError: for two aims, or one together with the condition numbers that it replaces.
    """
    aims = [one for one in AIMS if one in settings.goals]
    if not aims and not (given.errors_known and not settings.goals):
        if len(given.columns.aimed_names) == 1:
            raise UsageError("columns: a single parameter has no condition number; add --goal parameters")
        return tuple((replace(condition, scaling=scaling), 0.5) for scaling in SCALINGS)
    others = [text for text in (*settings.goals, *settings.hard) if text.partition("=")[0] in (*SCALINGS, *AIMS)]
    if len(others) > 1:
        raise UsageError(f"goals {', '.join(others)}: '{aims[0]}' replaces the others; leave them out")
    aim = (*aims, AIMS[0])[0]
    if aim in get_args(Index):
        return ((replace(condition, index=cast(Index, aim)), 1.0),)
    return ((_predicted(aim, settings, condition, given), 1.0),)


def _predicted(aim: str, settings: ExcitationSettings, condition: Excitation, given: ExcitationInputs) -> Excitation:
    """Return the objective that minimises the predicted σ of the torques of a typical task, or of the parameters.

    Rows are weighted by the torque errors that earlier motions state, or else by the torque limits.

    Raises:
        UsageError: where torque limits or the parameters' values are not known.
    """
    exact, limits, values = given.model.exact, given.limits.torque, given.model.values
    sigmas = np.ones(len(exact.joint_of_row)) if condition.sigmas is None else condition.sigmas
    if aim == "torque":
        require(np.isfinite(limits).all(), "goal 'torque': needs torque limits of all joints", UsageError)
        task = exact.regressor(*task_states(given, settings.seed))[:, :, given.columns.kept]
        rows = (task / limits[exact.joint_of_row][:, None])[:, exact.limited.ravel()]
        task = np.einsum("nri,nrj->ij", rows, rows) / rows[:, :, 0].size
    else:
        require(values is not None, "goal 'parameters': needs masses, or a model (--model)", UsageError)
        columns, known = given.columns, cast(np.ndarray, values)[given.columns.kept]
        counted = (known != 0.0) & np.isin(columns.names, columns.aimed_names)
        task = np.diag(np.divide(1.0, known**2, out=np.zeros(len(known)), where=counted))
    if given.prior is None and given.limits.noise is None and np.isfinite(limits).all():
        sigmas = sigmas * limits[exact.joint_of_row]
    return replace(condition, index="trace", sigmas=sigmas, task=task, columns=given.columns.columns)


def read_goals(settings: ExcitationSettings, given: ExcitationInputs, condition: Excitation) -> list[AttainmentGoal]:
    """Return the goals stated in the settings: first the soft goals, then the hard goals.

    Args:
        condition: what a condition number is of: columns, rows, what is known already.

    Raises:
        UsageError: for an unknown goal, or one that the given data do not suffice to compute.
    """
    result = []
    for weight, texts in ((None, settings.goals), (0.0, settings.hard)):
        for text in texts:
            if text in AIMS and weight is None:
                continue
            name, value = split_goal(text)
            twice = sum(split_goal(other)[0] == name for other in texts if other not in AIMS) > 1
            require(not twice, f"goal '{text}': '{name}' is stated twice; leave one out", UsageError)
            result.append(AttainmentGoal(*_objective(name, value, given, condition, settings.shortest), weight, text))
    return result


def _objective(
    name: str, value: float, given: ExcitationInputs, condition: Excitation, shortest: float | None
) -> tuple[Objective, float]:
    """Return the objective that a goal names, and the value that the objective has to reach."""
    text, chain = f"{name}={value:g}", given.chain
    if name in SCALINGS:
        require(value > 1, f"goal '{text}': expected a condition number above 1", UsageError)
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
        raise UsageError(f"goal '{text}': unknown; use raw, normalised, duration, coverage, wrist, joint1 …")
    require(0 < value < 1, f"goal '{text}': expected a share of the torque limit, above 0 and below 1", UsageError)
    return torque_slack(numbered[name], given, f"goal '{text}'"), 1.0 - value


def wrist(n: int) -> tuple[int, ...]:
    """Return the indices of the last two of n joints."""
    return tuple(range(max(0, n - 2), n))


def torque_slack(joints: tuple[int, ...], given: ExcitationInputs, where: str) -> TorqueSlack:
    """Return the objective that maximises the mean torque of some joints relative to their limits.

    Raises:
        UsageError: where torques cannot be predicted, or have no limit.
    """
    values, limits = given.model.values, given.limits.torque
    if values is None or not np.isfinite(limits[list(joints)]).all():
        raise UsageError(f"{where}: needs torque limits, and a model or masses to predict torques")
    exact = given.model.exact
    values = values if given.model.friction else values + exact.base.transform @ _typical_friction(given)
    rows = tuple(exact.limited[:, list(joints)].ravel().tolist())
    label = f"torque slack of joints {', '.join(str(j + 1) for j in joints)}"
    return TorqueSlack(rows, values, exact.of_rows(limits), given.model.smooth.torque_gradient, label=label)


def _typical_friction(given: ExcitationInputs) -> np.ndarray:
    """Return standard parameters (p,) of typical friction: `TYPICAL` shares of the torque limits at full speed."""
    limits, model = given.limits, given.model.exact.model
    sizes = {"sign": limits.torque, "velocity": limits.torque / limits.bounds.velocity}
    side = "motor" if model.torque_rows.with_motors else "link"
    found = np.zeros(model.p)
    for k, one in enumerate(model.columns, model.inertial):
        if one.side == side and one.shape in TYPICAL:
            found[k] = TYPICAL[one.shape] * sizes[one.shape][one.acts[0][0]]
    return np.where(np.isfinite(found), found, 0.0)


def missed(goals: list[AttainmentGoal], values: Sequence[float], given: ExcitationInputs) -> tuple[str, ...]:
    """Return a note for each goal that a motion with these values misses by more than 1 %."""
    words = [
        f"goal {goal.words} is missed: {goal.stated(value):.4g}"
        for goal, value in zip(goals, values)
        if value > goal.goal + 0.01 * abs(goal.goal)
    ]
    parts = f"{TYPICAL['sign']:.0%} of the torque limits, and {TYPICAL['velocity']:.0%} more at full speed"
    idle = f"torque goals expect friction of {parts} (typical): state [friction] in the limits file, or a model"
    known = given.model.friction or not any(isinstance(goal.objective, TorqueSlack) for goal in goals)
    return tuple(words if known else [*words, idle])
