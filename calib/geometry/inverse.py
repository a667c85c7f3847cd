"""Inverse kinematics of many targets at once: joint values that put the tool on the targets, deflections included.

Damped Gauss–Newton (Levenberg 1944) on  e(q) = [p* - p(q);  L · log(R* R(q)ᵀ)],  with one damping λ per target:

    step = Jᵀ (J Jᵀ + λ I)⁻¹ e

J is the Jacobian of the deflected arm without the deflections' derivative ∂δ/∂q, which is about 1e-3; the error still
decreases by a factor of 100 to 1000 per step. Steps of least norm keep the arm's configuration. A joint at a limit is
kept there while its step would exceed the limit.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from calib.geometry.installation import Installation, Seen, see
from calib.robot.calibrated import evaluate
from calib.robot.kinematics import joint_jacobian

# error [m] below which a target is reached
DONE = 1e-10
# first damping, in units of the mean squared singular value of J
FIRST = 1e-9
LAST = 1e4
# step [rad or m] below which the iteration ends
MIN_STEP = 1e-12
# length [m] by which orientations are multiplied to compare them with positions (our choice, as all constants here)
LEVER = 0.3
# weights μ of the joints' distance from the start [m/rad], and number of steps with each
BACK = np.geomspace(1e-4, 1.0, 13)
HELD_STEPS = 20
# largest number of passes towards the nearest joint values
NEAREST_PASSES = 8
# number of targets computed at once, which limits the memory
CHUNK = 2000

Torques = Callable[[np.ndarray], np.ndarray] | None
DOF = (6, 5, 3)


@dataclass(frozen=True, eq=False)
class Goal:
    """Arm, joint limits, and number of pose components that a target fixes.

    Attributes:
        cell: the arm with one station and one tool; targets are poses of the tool in the station's frame.
        dof: 6 for full poses; 5 if the rotation about the tool's z axis is free; 3 for positions only.
        lower, upper: (n,) joint limits [rad or m]; infinite for no limit.
        torques: function from joint values (m, n) to gravity torques (m, n) [N m], if a deflection needs them.
    """

    cell: Installation
    dof: int = 6
    lower: np.ndarray | float = -np.inf
    upper: np.ndarray | float = np.inf
    torques: Torques = None


def seen_at(goal: Goal, q: np.ndarray) -> Seen:
    """Return the predicted tool poses at joint values q (m, n), deflections included, in the station's frame.

    Args:
        goal: the arm.
        q: (m, n) joint values [rad or m].
    """
    deflection = goal.cell.deflection
    torque = None
    if goal.torques is not None and any(term.basis == "torque" for term in deflection.terms):
        torque = goal.torques(q)
    return see(goal.cell, q, bases=evaluate(deflection, q, torque))


def differences(goal: Goal, q: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """Return the differences of targets and tool poses (m, dof): position [m], then orientation [rad].

    dof 6: the orientation is the rotation vector of R* Rᵀ in the station's axes. dof 5: the rotation, about the tool's
    x and y axes, that brings the tool's z axis onto the target's. dof 3: positions only.

    Args:
        goal: the arm.
        q: (m, n) joint values [rad or m].
        targets: (m, 4, 4) target poses in the station's frame.
    """
    return _differences(seen_at(goal, q), targets, goal.dof)


def _differences(seen: Seen, targets: np.ndarray, dof: int) -> np.ndarray:
    displacement = targets[:, :3, 3] - seen.point.T
    if dof == 3:
        return displacement
    rotation = seen.rotation.transpose(2, 1, 0)
    if dof == 6:
        turn = Rotation.from_matrix(targets[:, :3, :3] @ np.swapaxes(rotation, 1, 2)).as_rotvec()
        return np.hstack([displacement, turn])
    tool_z = rotation[:, :, 2]
    target_z = targets[:, :3, 2]
    # the turn's axis times its sine, in the tool's frame
    across = np.einsum("mij,mi->mj", rotation, np.cross(tool_z, target_z))[:, :2]
    sine = np.linalg.norm(across, axis=1, keepdims=True)
    cosine = np.einsum("mi,mi->m", tool_z, target_z)[:, None]
    scale = np.where(sine > 1e-9, np.arctan2(sine, cosine) / np.maximum(sine, 1e-9), 1.0)
    return np.hstack([displacement, scale * across])


def differences_jacobian(goal: Goal, seen: Seen) -> np.ndarray:
    """Return the Jacobian (m, dof, n) of the tool's pose components, as in `differences`, by the joint values.

    Args:
        goal: the arm, and the number of pose components.
        seen: predicted tool poses at the joint values, from `seen_at`.
    """
    jacobian = joint_jacobian(goal.cell.chain, seen.walked, seen.point)
    if goal.dof == 3:
        return jacobian[:, :3]
    if goal.dof == 6:
        return jacobian
    tilt = np.einsum("cim,mij->mcj", seen.rotation[:2], jacobian[:, 3:])
    return np.concatenate([jacobian[:, :3], tilt], axis=1)


def reach(goal: Goal, targets: np.ndarray, start: np.ndarray, iterations: int = 60) -> np.ndarray:
    """Return joint values (m, n) that put the tool on the targets, or as near as the search from `start` comes.

    Args:
        goal: the arm.
        targets: (m, 4, 4) poses of the tool in the station's frame.
        start: (m, n) joint values to start from; values beyond a joint limit are set to the limit. The result stays
            near them where the arm is redundant.
        iterations: largest number of iterations.
    """
    if not len(targets):
        return np.array(start, dtype=float)
    solutions = []
    for first in range(0, len(targets), CHUNK):
        chunk = slice(first, first + CHUNK)
        solutions.append(_reach(goal, targets[chunk], start[chunk], iterations))
    return np.concatenate(solutions)


def _reach(goal: Goal, targets: np.ndarray, start: np.ndarray, iterations: int) -> np.ndarray:
    q = np.clip(start, goal.lower, goal.upper)
    damping = np.full(len(q), FIRST)
    error, jacobian = _weighted(goal, q, targets)
    active = np.arange(len(q))
    for _ in range(iterations):
        size = np.linalg.norm(error[active], axis=1)
        active = active[(size > DONE) & (damping[active] < LAST)]
        if not len(active):
            break
        step = _step_within_limits(goal, q[active], error[active], jacobian[active], damping[active])
        trial = np.clip(q[active] + step, goal.lower, goal.upper)
        trial_error, trial_jacobian = _weighted(goal, trial, targets[active])
        better = np.linalg.norm(trial_error, axis=1) < np.linalg.norm(error[active], axis=1)
        improved = active[better]
        worse = active[~better]
        q[improved] = trial[better]
        error[improved] = trial_error[better]
        jacobian[improved] = trial_jacobian[better]
        damping[improved] = np.maximum(0.1 * damping[improved], FIRST)
        damping[worse] = np.maximum(10.0 * damping[worse], 1e-4)
        # a worse step counts by its length; a better one goes on, since q has moved to it
        length = np.abs(trial - q[active]).max(axis=1)
        active = active[length + better > MIN_STEP]
    return q


def _weighted(goal: Goal, q: np.ndarray, targets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the error (m, dof) and its Jacobian (m, dof, n), with orientations multiplied by `LEVER` [m].

    Args:
        goal: the arm.
        q: (m, n) joint values [rad or m].
        targets: (m, 4, 4) target poses in the station's frame.
    """
    seen = seen_at(goal, q)
    weight = np.where(np.arange(goal.dof) < 3, 1.0, LEVER)
    error = weight * _differences(seen, targets, goal.dof)
    return error, weight[:, None] * differences_jacobian(goal, seen)


def _step_within_limits(
    goal: Goal, q: np.ndarray, error: np.ndarray, jacobian: np.ndarray, damping: np.ndarray
) -> np.ndarray:
    """Return damped joint steps (m, n) within the joint limits.

    A joint that would exceed its limit stops at it, and the other joints compensate.

    Args:
        goal: the arm, with its joint limits.
        q: (m, n) joint values [rad or m].
        error, jacobian: (m, dof) and (m, dof, n), as of `_weighted` [m].
        damping: (m,) λ of each target, relative to the mean squared singular value of its Jacobian.
    """
    step = _damped(jacobian, error, damping)
    for _ in range(q.shape[1]):
        below = (q <= goal.lower) & (step < 0.0)
        above = (q >= goal.upper) & (step > 0.0)
        stopped = below | above
        if not stopped.any():
            break
        jacobian = np.where(stopped[:, None, :], 0.0, jacobian)
        step = np.where(stopped, 0.0, _damped(jacobian, error, damping))
    return step


def _damped(jacobian: np.ndarray, error: np.ndarray, damping: np.ndarray) -> np.ndarray:
    """Return the damped joint steps Jᵀ (J Jᵀ + λ I)⁻¹ e (m, n).

    Args:
        jacobian: J (m, dof, n).
        error: e (m, dof).
        damping: (m,) λ of each target, relative to the mean squared singular value of J.
    """
    across = np.swapaxes(jacobian, 1, 2)
    square = jacobian @ across
    rows = square.shape[1]
    size = np.maximum(np.trace(square, axis1=1, axis2=2) / rows, 1e-12)
    square = square + (damping * size)[:, None, None] * np.eye(rows)
    return (across @ np.linalg.solve(square, error[:, :, None]))[:, :, 0]


def nearest(goal: Goal, targets: np.ndarray, start: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Return the joint values (m, n) nearest to `start` that have the same tool poses as `q`, for a redundant arm.

    The function minimises |q - q_start| (radians and metres with equal weight) under e(q) = 0. Each pass steps by d +
    J⁺ (e - J d) with d = q_start - q, J the Jacobian and e the pose error at q. The given `q` is kept for targets that
    the result would no longer reach.

    Args:
        goal: the arm.
        targets: (m, 4, 4) target poses in the station's frame.
        start: (m, n) joint values q_start to stay near [rad or m].
        q: (m, n) joint values that reach the targets, J being the Jacobian and e the pose error there.
    """
    if q.shape[1] <= goal.dof:
        return q
    closer = q.copy()
    no_damping = np.full(len(q), 1e-12)
    for _ in range(NEAREST_PASSES):
        error, jacobian = _weighted(goal, closer, targets)
        to_start = start - closer
        remaining = error - np.einsum("mrn,mn->mr", jacobian, to_start)
        step = to_start + _damped(jacobian, remaining, no_damping)
        closer = np.clip(closer + step, goal.lower, goal.upper)
    closer = reach(goal, targets, closer, 10)
    before = np.linalg.norm(_weighted(goal, q, targets)[0], axis=1)
    after = np.linalg.norm(_weighted(goal, closer, targets)[0], axis=1)
    loses_target = after > np.maximum(before, 10.0 * DONE)
    is_farther = np.linalg.norm(closer - start, axis=1) > np.linalg.norm(q - start, axis=1)
    return np.where((loses_target | is_farther)[:, None], q, closer)


def held_back(goal: Goal, targets: np.ndarray, start: np.ndarray, max_change: float) -> np.ndarray:
    """Return joint values (m, n) near the targets, with no joint more than `max_change` from `start`.

    This is for targets near a singularity, where a small correction needs a large motion. With e the pose error, the
    function minimises |e|² + μ² |q - q_start|² with the smallest μ of `BACK` for which the change is at most
    `max_change` [rad or m].

    Args:
        goal: the arm.
        targets: (m, 4, 4) target poses in the station's frame.
        start: (m, n) joint values q_start [rad or m].
        max_change: largest change of a joint value [rad or m].
    """
    best = np.clip(start, goal.lower, goal.upper)
    open_rows = np.arange(len(best))
    for weight in BACK:
        q = best[open_rows].copy()
        for _ in range(HELD_STEPS):
            error, jacobian = _weighted(goal, q, targets[open_rows])
            transposed = np.swapaxes(jacobian, 1, 2)
            square = transposed @ jacobian + weight**2 * np.eye(q.shape[1])
            gradient = (transposed @ error[:, :, None])[:, :, 0]
            gradient = gradient + weight**2 * (start[open_rows] - q)
            step = np.linalg.solve(square, gradient[:, :, None])[:, :, 0]
            q = np.clip(q + step, goal.lower, goal.upper)
        within = np.abs(q - start[open_rows]).max(axis=1) <= max_change
        best[open_rows[within]] = q[within]
        open_rows = open_rows[~within]
        if not len(open_rows):
            break
    return best


def conditions(goal: Goal, q: np.ndarray) -> np.ndarray:
    """Return the ratio of smallest to largest singular value (m,) of the Jacobian at each pose q (m, n).

    The ratio is 0 at a singularity.

    Args:
        goal: the arm, and the pose components that form the Jacobian (orientations multiplied by `LEVER` [m]).
        q: (m, n) joint values [rad or m].
    """
    no_targets = np.broadcast_to(np.eye(4), (len(q), 4, 4))
    _, jacobian = _weighted(goal, q, no_targets)
    values = np.linalg.svd(jacobian, compute_uv=False)
    return values[:, -1] / np.maximum(values[:, 0], 1e-300)
