"""Straight tool lines as joint paths, by inverse kinematics along the line; the robot is given by callables only.

The tool's position is linear in σ = 0 … 1, and its orientation rotates about one axis (R = R_0 exp(σ log(R_0ᵀ R_1))).
At each sample the pose is reached by damped least squares (Wampler 1986; Nakamura & Hanafusa 1986), and a term in the
null space of J pulls the joint values towards those at the start:

    Δq = J⁺ e + (1 - J⁺ J)(q_start - q),    J⁺ = Jᵀ (J Jᵀ + λ² 1)⁻¹,    e = [Δp; Δφ]

This is iterated until Δq vanishes, so that q is a smooth function of σ. A quintic spline interpolates the samples. The
number of samples is raised until the tool's deviation from the line between them is small.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from ..errors import BadInput, NothingFeasible
from ..timing.path import SAME, Path, through

SAMPLES, MAX_SAMPLES, STEPS = 41, 641, 400
REACHED, KEPT = 1e-9, 1e-6  # [m and rad] of the pose at the samples, and between them

Forward = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True, eq=False)
class _Line:
    """Straight tool line as a joint path.

    Attributes:
        path: the joint path.
        deviation: (2,) largest distance from the line [m] and from its orientation [rad], between the samples.
    """

    path: Path
    deviation: np.ndarray


def line(forward: Forward, jacobian: Forward, start: np.ndarray, goal: np.ndarray) -> _Line:
    """Return the joint path of a straight tool line from `start` to `goal`, with its deviation from the line.

    Args:
        forward: q (m, n) to tool poses T_base_tool (m, 4, 4).
        jacobian: q (m, n) to (m, 6, n), [v; ω] of the tool in the base frame.
        start: (n,) joint values at the start of the line [rad or m].
        goal: (4, 4) tool pose at the end.

    Raises:
        BadInput: both ends have the same tool pose.
        NothingFeasible: a pose of the line is out of reach; the message gives its position on the line and the
            remaining error.
    """
    start = np.asarray(start, dtype=float)
    first = forward(start[None])[0]
    if np.linalg.norm(_error(first[None], np.asarray(goal)[None])) <= SAME:
        raise BadInput("the tool line has no length: both ends have the same tool pose; remove one of them")
    count = SAMPLES
    while True:
        share = np.linspace(0, 1, count)
        q = _follow(forward, jacobian, start, _targets(first, goal, share))
        chords = np.linalg.norm(np.diff(q, axis=0), axis=1)
        length = chords.sum()
        path = through(q, share * length)
        between = (share[1:] + share[:-1]) / 2
        targets = _targets(first, goal, between)
        reached = forward(path(between * length))
        error = np.abs(_error(reached, targets))
        position = np.linalg.norm(error[:, :3], axis=1)
        turn = np.linalg.norm(error[:, 3:], axis=1)
        deviation = np.array([position.max(), turn.max()])
        if deviation.max() <= KEPT or 2 * count > MAX_SAMPLES:
            return _Line(path, deviation)
        count = 2 * count - 1


def _follow(forward: Forward, jacobian: Forward, start: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """Return joint values (m, n) at the tool poses `targets` (m, 4, 4), each solved from the solution before.

    Args:
        forward: q (m, n) to tool poses T_base_tool (m, 4, 4).
        jacobian: q (m, n) to (m, 6, n), [v; ω] of the tool in the base frame.
        start: (n,) joint values at the first tool pose [rad or m].
        targets: (m, 4, 4).
    """
    q = start.copy()
    profile = [start]
    for k, target in enumerate(targets[1:], 1):
        q, error = _reach(forward, jacobian, q, start, target)
        if not np.abs(error).max() <= REACHED:
            short = float(np.linalg.norm(error[:3]))
            turn = float(np.linalg.norm(error[3:]))
            raise NothingFeasible(
                f"no tool line: at {k / (len(targets) - 1):.0%} of it the arm stays {1e3 * short:.3g} mm and "
                f"{np.degrees(turn):.3g} deg short (out of reach, or the elbow must flip); take waypoints closer "
                "to each other, another posture at the start, or joint motion",
                "reach",
                short,
                "m",
            )
        profile.append(q)
    return np.array(profile)


def _reach(forward: Forward, jacobian: Forward, q: np.ndarray, remaining: np.ndarray, target: np.ndarray):
    """Return joint values (n,) at the tool pose `target` (4, 4), and the remaining error [Δp; Δφ] (6,) [m and rad].

    Args:
        forward: q (m, n) to tool poses T_base_tool (m, 4, 4).
        jacobian: q (m, n) to (m, 6, n), [v; ω] of the tool in the base frame.
        q: (n,) joint values from which the iteration starts.
        remaining: (n,) joint values towards which redundant joints are pulled.
        target: (4, 4).
    """
    error = np.full(6, np.inf)
    max_step = 0.2  # [rad or m] of a step of any joint
    for _ in range(STEPS):
        error = _error(forward(q[None]), target[None])[0]
        J = jacobian(q[None])[0]
        squared_error = float(error @ error)
        damping = min(1e-2 * squared_error, 1e-2) + 1e-14
        damped = J @ J.T + damping * np.eye(6)
        inverse = J.T @ np.linalg.inv(damped)
        pull = remaining - q
        step = inverse @ error + pull - inverse @ (J @ pull)
        size = np.abs(step).max()
        q = q + step * min(1.0, max_step / max(size, 1e-300))
        if size <= 1e-11:
            break
    error = _error(forward(q[None]), target[None])[0]
    return q, error


def _targets(first: np.ndarray, goal: np.ndarray, share: np.ndarray) -> np.ndarray:
    rotation = first[:3, :3].T @ goal[:3, :3]
    turn = Rotation.from_matrix(rotation).as_rotvec()
    poses = np.tile(np.eye(4), (len(share), 1, 1))
    start = first[:3, 3]
    end = goal[:3, 3]
    poses[:, :3, 3] = start + share[:, None] * (end - start)
    turns = Rotation.from_rotvec(share[:, None] * turn).as_matrix()
    poses[:, :3, :3] = first[:3, :3] @ turns
    return poses


def _error(poses: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """Return the errors [Δp; Δφ] (m, 6) [m and rad] of `poses` to `targets` (m, 4, 4), in the base frame."""
    rotations = targets[:, :3, :3] @ poses[:, :3, :3].transpose(0, 2, 1)
    turn = Rotation.from_matrix(rotations).as_rotvec()
    shift = targets[:, :3, 3] - poses[:, :3, 3]
    return np.concatenate([shift, turn], axis=1)
