"""Objectives and goals of an excitation, made from the settings.

`calib.procedure.excitation.settings.ExcitationSettings` describes the available goals.
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
# share of the torque limits kept free where no friction is known (our choice)
GUARD = 0.2
# shares of the torque limits: Coulomb and viscous friction, at full speed together `GUARD` (our choice)
TYPICAL = {"sign": 0.07, "velocity": 0.13}
# a goal is missed by more than this share of it (our choice)
TOLERANCE = 0.01


def objectives_of(
    settings: ExcitationSettings, condition: Excitation, inputs: ExcitationInputs
) -> tuple[tuple[Objective, float], ...]:
    """Return the objectives of a design with their weights: an aim, or both condition numbers with equal weights.

    Args:
        settings: settings of the design.
        condition: condition number as an objective, with the columns, rows and earlier information of the design; the
            other objectives are derived from it.
        inputs: robot and model; without goals, the aim is ``logdet`` if an identification states torque errors.

    Raises:
        UsageError: for two aims, or an aim together with the condition numbers that it replaces.
    """
    aims = [aim for aim in AIMS if aim in settings.goals]
    default_aim = inputs.errors_known and not settings.goals
    if not aims and not default_aim:
        if len(inputs.columns.aimed_names) == 1:
            raise UsageError("columns: a single parameter has no condition number; add --goal parameters")
        return tuple((replace(condition, scaling=scaling), 0.5) for scaling in SCALINGS)
    texts = (*settings.goals, *settings.hard)
    of_parameters = [text for text in texts if text.partition("=")[0] in (*SCALINGS, *AIMS)]
    if len(of_parameters) > 1:
        raise UsageError(f"goals {', '.join(of_parameters)}: '{aims[0]}' replaces the others; leave them out")
    aim = AIMS[0]
    if aims:
        aim = aims[0]
    if aim in get_args(Index):
        return ((replace(condition, index=cast(Index, aim)), 1.0),)
    return ((_predicted(aim, settings, condition, inputs), 1.0),)


def _predicted(aim: str, settings: ExcitationSettings, condition: Excitation, inputs: ExcitationInputs) -> Excitation:
    """Return the objective that minimises the predicted σ of the torques of a typical task, or of the parameters.

    Torque rows are weighted by the torque errors that earlier motions state, otherwise by the torque limits.

    Args:
        aim: ``torque`` or ``parameters``.
        settings: settings of the design.
        condition: condition number as an objective, from which this objective is derived.
        inputs: robot and model.

    Raises:
        UsageError: if torque limits or values of the parameters are not known.
    """
    exact, limits, columns = inputs.model.exact, inputs.limits.torque, inputs.columns
    limited = bool(np.isfinite(limits).all())
    if aim == "torque":
        require(limited, "goal 'torque': needs torque limits of all joints", UsageError)
        regressors = exact.regressor(*task_states(inputs, settings.seed))[:, :, columns.kept]
        row_limits = limits[exact.joint_of_row][:, None]
        rows = (regressors / row_limits)[:, exact.limited.ravel()]
        task = np.einsum("nri,nrj->ij", rows, rows) / rows[:, :, 0].size
    else:
        if inputs.model.values is None:
            raise UsageError("goal 'parameters': needs masses, or a model (--model)")
        values = inputs.model.values[columns.kept]
        counted = (values != 0.0) & np.isin(columns.names, columns.aimed_names)
        task = np.diag(np.divide(1.0, values**2, out=np.zeros(len(values)), where=counted))
    sigmas = condition.sigmas
    if sigmas is None:
        sigmas = np.ones(len(exact.joint_of_row))
    if inputs.prior is None and inputs.limits.noise is None and limited:
        sigmas = sigmas * limits[exact.joint_of_row]
    return replace(condition, index="trace", sigmas=sigmas, task=task, columns=columns.columns)


def read_goals(settings: ExcitationSettings, inputs: ExcitationInputs, condition: Excitation) -> list[AttainmentGoal]:
    """Return the goals in the settings: first the soft goals, then the hard goals.

    Args:
        settings: settings of the design.
        inputs: robot and model.
        condition: condition number as an objective, with the columns, rows and earlier information of the design.

    Raises:
        UsageError: for an unknown goal, or a goal that cannot be computed from the inputs.
    """
    soft = [text for text in settings.goals if text not in AIMS]
    goals = _goals(soft, None, inputs, condition, settings.shortest)
    return goals + _goals(settings.hard, 0.0, inputs, condition, settings.shortest)


def _goals(
    texts: Sequence[str], weight: float | None, inputs: ExcitationInputs, condition: Excitation, shortest: float | None
) -> list[AttainmentGoal]:
    """Return the goals that texts (``name=value``) state.

    Args:
        texts: the texts.
        weight: 0 for hard goals, None for soft goals.
        inputs: robot and model.
        condition: condition number as an objective.
        shortest: shortest allowed period [s]; None: the period is fixed.
    """
    names = [split_goal(text)[0] for text in texts if text not in AIMS]
    goals = []
    for text in texts:
        name, value = split_goal(text)
        require(names.count(name) <= 1, f"goal '{text}': '{name}' is stated twice; leave one out", UsageError)
        objective, goal = _objective(name, value, inputs, condition, shortest)
        goals.append(AttainmentGoal(objective, goal, weight, text))
    return goals


def _objective(
    name: str, value: float, inputs: ExcitationInputs, condition: Excitation, shortest: float | None
) -> tuple[Objective, float]:
    """Return the objective with a goal's name, and the value that it has to reach.

    Args:
        name: name of the goal, such as ``raw``, ``wrist`` or ``coverage``.
        value: stated value of the goal.
        inputs: robot and model.
        condition: condition number as an objective.
        shortest: shortest allowed period [s]; None: the period is fixed.

    Raises:
        UsageError: for an unknown name, an invalid value, or missing inputs.
    """
    text, chain = f"{name}={value:g}", inputs.chain
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
    joints_of: dict[str, tuple[int, ...]] = {f"joint{j + 1}": (j,) for j in range(chain.n)}
    joints_of["wrist"] = wrist(chain.n)
    if name not in joints_of:
        raise UsageError(f"goal '{text}': unknown; use raw, normalised, duration, coverage, wrist, joint1 …")
    require(0 < value < 1, f"goal '{text}': expected a share of the torque limit, above 0 and below 1", UsageError)
    return torque_slack(joints_of[name], inputs, f"goal '{text}'"), 1.0 - value


def wrist(n: int) -> tuple[int, ...]:
    """Return the indices of the wrist joints, which are the last two of n joints."""
    return tuple(range(max(0, n - 2), n))


def torque_slack(joints: tuple[int, ...], inputs: ExcitationInputs, where: str) -> TorqueSlack:
    """Return the objective that maximises the mean torque of some joints relative to the torque limits.

    Args:
        joints: indices of the joints.
        inputs: robot and model.
        where: name of the goal for messages.

    Raises:
        UsageError: if torques cannot be predicted, or have no limit.
    """
    values, limits = inputs.model.values, inputs.limits.torque
    if values is None or not np.isfinite(limits[list(joints)]).all():
        raise UsageError(f"{where}: needs torque limits, and a model or masses to predict torques")
    exact = inputs.model.exact
    if not inputs.model.friction:
        values = values + exact.base.transform @ _typical_friction(inputs)
    rows = tuple(exact.limited[:, list(joints)].ravel().tolist())
    label = f"torque slack of joints {', '.join(str(j + 1) for j in joints)}"
    return TorqueSlack(rows, values, exact.of_rows(limits), inputs.model.smooth.torque_gradient, label=label)


def _typical_friction(inputs: ExcitationInputs) -> np.ndarray:
    """Return standard parameters (p,) of typical friction, all others zero.

    At full speed, the friction torques are the shares `TYPICAL` of the torque limits.

    Args:
        inputs: robot and model with torque limits.
    """
    limits, model = inputs.limits, inputs.model.exact.model
    # the values at which a term's torque is the joint's limit
    full = {"sign": limits.torque, "velocity": limits.torque / limits.bounds.velocity}
    side = "motor" if model.torque_rows.with_motors else "link"
    friction = np.zeros(model.p)
    for k, term in enumerate(model.columns, model.inertial):
        if term.side == side and term.shape in TYPICAL:
            joint = term.acts[0][0]
            friction[k] = TYPICAL[term.shape] * full[term.shape][joint]
    return np.where(np.isfinite(friction), friction, 0.0)


def missed(goals: Sequence[AttainmentGoal], values: Sequence[float], inputs: ExcitationInputs) -> tuple[str, ...]:
    """Return a note for each goal that a motion misses by more than 1 %.

    Args:
        goals: the goals.
        values: value of each goal that the motion reaches.
        inputs: robot and model.
    """
    notes = []
    for goal, value in zip(goals, values):
        # a torque goal of 0.1 is a slack of 0.9
        scale = 1.0 - goal.goal if isinstance(goal.objective, TorqueSlack) else abs(goal.goal)
        if value > goal.goal + TOLERANCE * scale:
            notes.append(f"goal {goal.words} is missed: {goal.stated(value):.4g}")
    of_torque = any(isinstance(goal.objective, TorqueSlack) for goal in goals)
    if of_torque and not inputs.model.friction:
        shares = f"{TYPICAL['sign']:.0%} of the torque limits, and {TYPICAL['velocity']:.0%} more at full speed"
        notes.append(
            f"torque goals expect friction of {shares} (typical): state [friction] in the limits file, or a model"
        )
    return tuple(notes)
