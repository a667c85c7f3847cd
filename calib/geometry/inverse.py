"""Inverse kinematics: joint values that put an arm's tool on its targets, deflections included; all targets at once.

Damped Gauss–Newton (Levenberg 1944) on  e(q) = [p* - p(q);  L · log(R* R(q)ᵀ)],  one damping per target:

    step = Jᵀ (J Jᵀ + λ I)⁻¹ e

J is that of the deflected arm, without the deflections' own slope ∂δ/∂q: some 1e-3, so that each step still takes
two to three digits. Steps of least norm leave the configuration alone; joints at a limit stay there while they would
go beyond.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from calib.geometry.installation import Installation, Seen, see
from calib.robot.calibrated import evaluate
from calib.robot.kinematics import joint_jacobian

DONE = 1e-10  # error [m] below which a target is met
FIRST, LAST = 1e-9, 1e4  # damping, in mean squared singular values of J
BACK = np.geomspace(1e-4, 1.0, 13)  # weights that hold the joints at the start [m/rad]

Torques = Callable[[np.ndarray], np.ndarray] | None
DOF = (6, 5, 3)


@dataclass(frozen=True, eq=False)
class Goal:
    """Arm, joint limits, and number of pose components to reach.

    Attributes:
        cell: the arm with one station and one tool; targets are the tool's poses in the station's frame.
        dof: 6; 5 if the rotation about the tool's z axis is free; 3 for the position only.
        lower, upper: (n,) limits [rad or m]; infinite for none.
        torques: function from joint values (m, n) to gravity torques (m, n) [N m], if a deflection needs them.
    """

    cell: Installation
    dof: int = 6
    lower: np.ndarray | float = -np.inf
    upper: np.ndarray | float = np.inf
    torques: Torques = None


def seen_at(goal: Goal, q: np.ndarray) -> Seen:
    """Return the tool poses (m, 4, 4) at joint values q (m, n), deflections included."""
    terms = goal.cell.deflection.terms
    torque = goal.torques(q) if goal.torques is not None and any(term.basis == "torque" for term in terms) else None
    return see(goal.cell, q, bases=evaluate(goal.cell.deflection, q, torque))


def differences(goal: Goal, q: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """Return the differences of targets and tool poses (m, dof): position [m], then orientation [rad].

    dof 6: rotation vector of R* Rᵀ in the station's axes. dof 5: the turn that brings the tool's z axis onto the
    target's, about the tool's x and y.
    """
    return _differences(seen_at(goal, q), targets, goal.dof)


def _differences(seen: Seen, targets: np.ndarray, dof: int) -> np.ndarray:
    missing = targets[:, :3, 3] - seen.point.T
    if dof == 3:
        return missing
    rotation = seen.rotation.transpose(2, 1, 0)
    if dof == 6:
        turn = Rotation.from_matrix(targets[:, :3, :3] @ np.swapaxes(rotation, 1, 2)).as_rotvec()
        return np.hstack([missing, turn])
    across = np.einsum("mij,mi->mj", rotation, np.cross(rotation[:, :, 2], targets[:, :3, 2]))[:, :2]
    sine = np.linalg.norm(across, axis=1, keepdims=True)
    cosine = np.einsum("mi,mi->m", rotation[:, :, 2], targets[:, :3, 2])[:, None]
    scale = np.where(sine > 1e-9, np.arctan2(sine, cosine) / np.maximum(sine, 1e-9), 1.0)
    return np.hstack([missing, scale * across])


def differences_jacobian(goal: Goal, seen: Seen) -> np.ndarray:
    """Return the Jacobian (m, dof, n) of the pose components of `differences` with respect to the joints."""
    jacobian = joint_jacobian(goal.cell.chain, seen.walked, seen.point)
    if goal.dof == 3:
        return jacobian[:, :3]
    if goal.dof == 6:
        return jacobian
    tilt = np.einsum("cim,mij->mcj", seen.rotation[:2], jacobian[:, 3:])
    return np.concatenate([jacobian[:, :3], tilt], axis=1)


def reach(goal: Goal, targets: np.ndarray, start: np.ndarray, iterations: int = 60) -> np.ndarray:
    """Return joint values (m, n) that put the tool on the targets, or as close as the search from `start` gets.

    Args:
        goal: the arm.
        targets: (m, 4, 4) poses of the tool in the station's frame.
        start: (m, n) joint values to start from and to stay near; beyond a limit, the limit.
        iterations: at most.
    """
    chunk = 2000  # targets at once: bounds the memory
    found = [
        _reach(goal, targets[k : k + chunk], start[k : k + chunk], iterations) for k in range(0, len(targets), chunk)
    ]
    return np.concatenate(found) if found else np.array(start, dtype=float)


def _reach(goal: Goal, targets: np.ndarray, start: np.ndarray, iterations: int, min_step: float = 1e-12) -> np.ndarray:
    # min_step: step [rad or m] that changes nothing
    q = np.clip(start, goal.lower, goal.upper)
    damping = np.full(len(q), FIRST)
    error, jacobian = _weighted(goal, q, targets)
    going = np.arange(len(q))
    for _ in range(iterations):
        going = going[(np.linalg.norm(error[going], axis=1) > DONE) & (damping[going] < LAST)]
        if not len(going):
            break
        step = _inside(goal, q[going], error[going], jacobian[going], damping[going])
        trial = np.clip(q[going] + step, goal.lower, goal.upper)
        fresh, slope = _weighted(goal, trial, targets[going])
        better = np.linalg.norm(fresh, axis=1) < np.linalg.norm(error[going], axis=1)
        won, lost = going[better], going[~better]
        q[won], error[won], jacobian[won] = trial[better], fresh[better], slope[better]
        damping[won] = np.maximum(0.1 * damping[won], FIRST)
        damping[lost] = np.maximum(10.0 * damping[lost], 1e-4)
        going = going[np.abs(trial - q[going]).max(axis=1) + better > min_step]
    return q


def _weighted(goal: Goal, q: np.ndarray, targets: np.ndarray, lever: float = 0.3) -> tuple[np.ndarray, np.ndarray]:
    """Return error (m, dof) and Jacobian (m, dof, n); orientations are multiplied by `lever` [m].

    `lever`: an orientation counts as its displacement at this distance [m]; as all constants here, our choice.
    """
    seen = seen_at(goal, q)
    weight = np.where(np.arange(goal.dof) < 3, 1.0, lever)
    return weight * _differences(seen, targets, goal.dof), weight[:, None] * differences_jacobian(goal, seen)


def _inside(goal: Goal, q: np.ndarray, error: np.ndarray, jacobian: np.ndarray, damping: np.ndarray) -> np.ndarray:
    """Return damped joint steps (m, n); a joint that would exceed its limit stops there, and the others compensate."""
    step = _damped(jacobian, error, damping)
    for _ in range(q.shape[1]):
        held = ((q <= goal.lower) & (step < 0.0)) | ((q >= goal.upper) & (step > 0.0))
        if not held.any():
            break
        jacobian = np.where(held[:, None, :], 0.0, jacobian)
        step = np.where(held, 0.0, _damped(jacobian, error, damping))
    return step


def _damped(jacobian: np.ndarray, error: np.ndarray, damping: np.ndarray) -> np.ndarray:
    """Return the damped step Jᵀ (J Jᵀ + λ I)⁻¹ e; λ is relative to the mean squared singular value."""
    across = np.swapaxes(jacobian, 1, 2)
    square = jacobian @ across
    rows = square.shape[1]
    size = np.maximum(np.trace(square, axis1=1, axis2=2) / rows, 1e-12)
    square = square + (damping * size)[:, None, None] * np.eye(rows)
    return (across @ np.linalg.solve(square, error[:, :, None]))[:, :, 0]


def nearest(goal: Goal, targets: np.ndarray, start: np.ndarray, q: np.ndarray, passes: int = 8) -> np.ndarray:
    """Return the joint values (m, n) with the tool poses of `q` that are nearest to `start`, for a redundant arm.

    Minimises |q - q_start| (radians and metres alike) under e(q) = 0: each pass steps by d + J⁺ (e - J d), d = q_start
    - q. A target at which that loses what `q` has reached keeps `q`.
    """
    if q.shape[1] <= goal.dof:
        return q
    closer, none = q.copy(), np.full(len(q), 1e-12)
    for _ in range(passes):
        error, jacobian = _weighted(goal, closer, targets)
        wish = start - closer
        rest = error - np.einsum("mrn,mn->mr", jacobian, wish)
        closer = np.clip(closer + wish + _damped(jacobian, rest, none), goal.lower, goal.upper)
    closer = reach(goal, targets, closer, 10)
    before, after = (np.linalg.norm(_weighted(goal, each, targets)[0], axis=1) for each in (q, closer))
    keep = (after > np.maximum(before, 10.0 * DONE)) | (
        np.linalg.norm(closer - start, axis=1) > np.linalg.norm(q - start, axis=1)
    )
    return np.where(keep[:, None], q, closer)


def held_back(goal: Goal, targets: np.ndarray, start: np.ndarray, most: float) -> np.ndarray:
    """Return joint values (m, n) near the targets with no joint more than `most` away from `start`.

    For targets near a singularity, where a small correction takes a large motion: minimises |e|² + μ² |q - q_start|²
    with the smallest μ of `BACK` that keeps to `most` [rad or m].
    """
    best = np.clip(start, goal.lower, goal.upper)
    left = np.arange(len(best))
    for weight in BACK:
        q = best[left].copy()
        for _ in range(20):
            error, jacobian = _weighted(goal, q, targets[left])
            across = np.swapaxes(jacobian, 1, 2)
            square = across @ jacobian + weight**2 * np.eye(q.shape[1])
            side = (across @ error[:, :, None])[:, :, 0] + weight**2 * (start[left] - q)
            q = np.clip(q + np.linalg.solve(square, side[:, :, None])[:, :, 0], goal.lower, goal.upper)
        kept = np.abs(q - start[left]).max(axis=1) <= most
        best[left[kept]] = q[kept]
        left = left[~kept]
        if not len(left):
            break
    return best


def conditions(goal: Goal, q: np.ndarray) -> np.ndarray:
    """Return the ratio of smallest to largest singular value of each Jacobian (m,): 0 at a singularity."""
    jacobian = _weighted(goal, q, np.broadcast_to(np.eye(4), (len(q), 4, 4)))[1]
    values = np.linalg.svd(jacobian, compute_uv=False)
    return values[:, -1] / np.maximum(values[:, 0], 1e-300)
