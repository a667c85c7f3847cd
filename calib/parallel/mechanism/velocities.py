"""Velocities and accelerations of closed loops by rigid-body relations (eqs 4-10 and 15-18 of Briot, Gautier & Krut).

q̇_k = J_k⁺ G_k D v              joints of leg k from the independent parts v of the platform's twist t = D v
q̈_k = J_k⁺ (G_k ṫ + g_k)        g_k: acceleration of the attachment at ṫ = 0 less that of the leg's end at q̈_k = 0
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.parallel.mechanism.closure import (
    ClosedRobot,
    LegLinks,
    Posture,
    joint_rates,
    leg_links,
    pseudo_inverse,
    times,
    twists,
)
from calib.records import shaped


@dataclass(frozen=True, eq=False)
class LoopJacobians:
    """Jacobians at N postures, with respect to the independent parts v (r,) of the platform's twist.

    Attributes:
        joints: (N, n_t, r) J_t: rates of all joints of the tree.
        readings: (N, n, r) J_p^inv: rates of the actuated joints.
        platform: (N, 6, r) D: the platform's twist, in the base's axes.
        links: Jacobians and gaps of the legs.
    """

    joints: np.ndarray
    readings: np.ndarray
    platform: np.ndarray
    links: Sequence[LegLinks]


@dataclass(frozen=True, eq=False)
class LoopMotion:
    """Velocities and accelerations of N postures.

    Attributes:
        posture: postures of joints and platform.
        jacobians: Jacobians at the postures.
        v, a: (N, n_t) of all joints of the tree [per s, per s²].
        twist, change: (N, 6) of the platform: velocity of its origin, angular velocity, and their derivatives.
        rate: (N, r) the independent parts of the twist.
    """

    posture: Posture
    jacobians: LoopJacobians
    v: np.ndarray
    a: np.ndarray
    twist: np.ndarray
    change: np.ndarray
    rate: np.ndarray


def loop_jacobians(mechanism: ClosedRobot, posture: Posture) -> LoopJacobians:
    """Return the Jacobians of postures."""
    links = leg_links(mechanism.robot, posture)
    D, _ = twists(mechanism, links)
    joints = joint_rates(links, D)
    return LoopJacobians(joints, joints[:, mechanism.robot.actuated], D, links)


def of_platform(
    mechanism: ClosedRobot,
    posture: Posture,
    rate: np.ndarray,
    change: np.ndarray,
    jacobians: LoopJacobians | None = None,
) -> LoopMotion:
    """Return velocities and accelerations at postures from those of the platform.

    Args:
        rate, change: (N, r) independent parts of the platform's twist, and their derivatives.
        jacobians: Jacobians at the postures; None to compute them.
    """
    loop = jacobians or loop_jacobians(mechanism, posture)
    v = np.einsum("ntr,nr->nt", loop.joints, rate)
    twist = np.einsum("nkr,nr->nk", loop.platform, rate)
    shifts = []
    starts = mechanism.robot.starts
    for link, a, b in zip(loop.links, starts, starts[1:]):
        end_bias = _end_bias(link, v[:, a:b])
        shifts.append(end_bias - _attachment_bias(link, twist))
    _, still = twists(mechanism, loop.links, shifts)
    twist_change = still + np.einsum("nkr,nr->nk", loop.platform, change)
    leg_accelerations = []
    for link, shift in zip(loop.links, shifts):
        attachment = times(link.carried, twist_change)
        leg_accelerations.append(times(link.inverse, attachment - shift))
    accelerations = np.concatenate(leg_accelerations, axis=1)
    return LoopMotion(posture, loop, v, accelerations, twist, twist_change, rate)


def of_readings(
    mechanism: ClosedRobot, posture: Posture, v: np.ndarray, a: np.ndarray, jacobians: LoopJacobians | None = None
) -> LoopMotion:
    """Return velocities and accelerations at postures from those of the encoders (eqs 16, 18).

    The result covers all joints and the platform; redundant encoders are combined by least squares.

    Args:
        v, a: (N, n) velocities and accelerations of the actuated joints.
        jacobians: Jacobians at the postures; None to compute them.
    """
    loop = jacobians or loop_jacobians(mechanism, posture)
    back = pseudo_inverse(loop.readings)
    rate = times(back, v)
    still = of_platform(mechanism, posture, rate, np.zeros_like(rate), loop)
    a_remaining = a - still.a[:, mechanism.robot.actuated]
    change = times(back, a_remaining)
    joint_accelerations = still.a + np.einsum("ntr,nr->nt", loop.joints, change)
    twist_change = still.change + np.einsum("nkr,nr->nk", loop.platform, change)
    return replace(still, a=joint_accelerations, change=twist_change)


def _attachment_bias(links: LegLinks, twist: np.ndarray) -> np.ndarray:
    """Return the attachment's acceleration (N, c) at ṫ = 0: ω × (ω × lever); its angular part is zero."""
    result = np.zeros(links.gap.shape)
    turn = twist[:, 3:]
    along = np.einsum("ni,ni->n", turn, links.lever)[:, None]
    speed_squared = np.sum(turn**2, axis=1)[:, None]
    result[:, :3] = turn * along - links.lever * speed_squared
    return result


def _end_bias(links: LegLinks, v: np.ndarray) -> np.ndarray:
    """Return J̇ q̇ (N, c) of a leg's end: Σ_j [(2 w_j + ω_j q̇_j) × v_j q̇_j; w_j × ω_j q̇_j], w_j = Σ_{i<j} ω_i q̇_i.

    The columns [v_j; ω_j] of the Jacobian are those of axes fixed in link j - 1, see
    `calib.robot.kinematics.twist_product`.
    """
    w = np.zeros((len(v), 3))
    result = np.zeros(links.full.shape[:2])
    for j in range(v.shape[1]):
        rate = v[:, j : j + 1]
        linear = links.full[:, :3, j] * rate
        angular = links.full[:, 3:, j] * rate
        result[:, :3] += cross(2.0 * w + angular, linear)
        result[:, 3:] += cross(w, angular)
        w = w + angular
    return result[:, : links.gap.shape[1]]


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return a × b (N, 3); ten times as fast as `numpy.cross` for few samples."""
    following = [1, 2, 0]
    preceding = [2, 0, 1]
    return a[:, following] * b[:, preceding] - a[:, preceding] * b[:, following]


def preload_directions(mechanism: ClosedRobot, jacobians: LoopJacobians) -> np.ndarray:
    """Return N (N, n, n - r), orthonormal torques without effect on the platform.

    Of all orthonormal bases, that nearest to the basis at home is returned (orthogonal Procrustes problem), so that a
    constant preload is a continuous torque along a motion.
    """
    robot = mechanism.robot
    directions = _left_null(jacobians.readings, robot.r)
    home_jacobians = loop_jacobians(mechanism, mechanism.home)
    home = _left_null(home_jacobians.readings, robot.r)[0]
    # sign convention: the largest entry of the first direction at home is positive
    if home.shape[1]:
        largest = np.argmax(np.abs(home[:, 0]))
        if home[largest, 0] < 0:
            home = -home
    overlap = directions.transpose(0, 2, 1) @ home
    u, _, vt = np.linalg.svd(overlap)
    return directions @ (u @ vt)


def overconstraint(mechanism: ClosedRobot, jacobians: LoopJacobians, torques: np.ndarray) -> np.ndarray:
    """Return the overconstraint c (N, n - r) [N m or N] of actuator torques (N, n): the part that does no work."""
    shape = (len(jacobians.readings), mechanism.robot.n)
    torques = shaped(torques, shape, "torques of the actuators")
    directions = preload_directions(mechanism, jacobians)
    return np.einsum("nac,na->nc", directions, torques)


def distributed(
    mechanism: ClosedRobot, jacobians: LoopJacobians, forces: np.ndarray, preload: np.ndarray | float = 0.0
) -> np.ndarray:
    """Return actuator torques (N, n) that produce given forces in platform coordinates.

    Args:
        mechanism: the robot.
        jacobians: Jacobians at N postures.
        forces: (N, r) forces and moments on the platform's coordinates.
        preload: overconstraint c of redundant actuators, (N, n - r) or (n - r,) [N m or N]; 0: the torques of least
            norm.
    """
    inverse = np.linalg.pinv(jacobians.readings)
    distribution = inverse.transpose(0, 2, 1)
    minimum = np.einsum("nar,nr->na", distribution, forces)
    if not mechanism.robot.redundant:
        return minimum
    N = preload_directions(mechanism, jacobians)
    preloads = np.broadcast_to(preload, (len(N), N.shape[2]))
    return minimum + np.einsum("nac,nc->na", N, preloads)


def _left_null(A: np.ndarray, rank: int) -> np.ndarray:
    """Return an orthonormal basis (N, n, n - r) of the left null space of A (N, n, r)."""
    U, _, _ = np.linalg.svd(A)
    return U[:, :, rank:]
