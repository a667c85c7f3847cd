"""Constraints on a measurement pose: tool height, distance from the axis, orientation to an instrument, line of sight.

The quantities of the LWR4+ study's Table 1, and the line of sight. None knows a robot: they take the caller's forward
kinematics as a callable, ``tool(q: (m, n)) -> (rotation (m, 3, 3), position (m, 3))`` in whatever frame the limits are
written in, and, for exact gradients, ``tool_jacobian(q) -> (m, 6, n)``: velocity of that point, then angular velocity,
both in that same frame. Every constraint is smooth where stated, and pickles if the callables do.
"""

from collections.abc import Callable
from functools import partial

import numpy as np
from numpy.typing import ArrayLike

from .space import PoseConstraint

Tool = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
ToolJacobian = Callable[[np.ndarray], np.ndarray]


def height(tool: Tool, lowest: float, highest: float = np.inf, jacobian: ToolJacobian | None = None) -> PoseConstraint:
    """Keep the tool point's height within lowest ≤ z ≤ highest [m]."""
    limits = _finite_limits(lowest, highest)
    slope = None
    if jacobian is not None:
        slope = partial(_height_gradient, jacobian, limits)
    return PoseConstraint("height", partial(_height, tool, limits), slope)


def _finite_limits(lower: float, upper: float) -> tuple[tuple[float, float], ...]:
    """Return sign and bound of each finite limit, so that sign · (value − bound) ≤ 0 keeps it."""
    limits = []
    if np.isfinite(lower):
        limits.append((-1.0, lower))
    if np.isfinite(upper):
        limits.append((1.0, upper))
    return tuple(limits)


def axis_distance(tool: Tool, min_distance: float, jacobian: ToolJacobian | None = None) -> PoseConstraint:
    """Keep d_xy = √(x² + y²) ≥ min_distance [m], in the smooth form min_distance² − x² − y² ≤ 0."""
    slope = None
    if jacobian is not None:
        slope = partial(_axis_gradient, tool, jacobian)
    return PoseConstraint("distance from the axis", partial(_axis, tool, min_distance), slope)


def reach(
    tool: Tool, max_distance: float, centre: ArrayLike = (0, 0, 0), jacobian: ToolJacobian | None = None
) -> PoseConstraint:
    """Keep the tool's point within `max_distance` [m] of a centre (3,) [m]: ‖x − c‖² − max_distance² ≤ 0."""
    point = np.asarray(centre, dtype=float)
    slope = None
    if jacobian is not None:
        slope = partial(_reach_gradient, tool, jacobian, point)
    return PoseConstraint("reach", partial(_reach, tool, max_distance, point), slope)


def distance(
    tool: Tool, min_distance: float, max_distance: float, centre: ArrayLike, jacobian: ToolJacobian | None = None
) -> PoseConstraint:
    """Keep the tool's point within an instrument's range, `min_distance` to `max_distance` [m] from a point (3,) [m].

    Not smooth at that point itself.
    """
    point = np.asarray(centre, dtype=float)
    limits = _finite_limits(min_distance, max_distance)
    slope = None
    if jacobian is not None:
        slope = partial(_distance_gradient, tool, jacobian, limits, point)
    return PoseConstraint("range of the instrument", partial(_distance, tool, limits, point), slope)


def orientation(
    tool: Tool,
    camera: ArrayLike,
    roll: tuple[float, float],
    pitch: tuple[float, float],
    jacobian: ToolJacobian | None = None,
) -> PoseConstraint:
    """Keep the tool's roll and pitch in the camera frame within limits [rad].

    R_camera^T R = Rot_z(yaw) Rot_y(pitch) Rot_x(roll). The convention is our reading of Table 1, which does not state
    it. Not smooth where roll jumps by 2π, nor at a pitch of ±π/2.

    Args:
        tool: forward kinematics.
        camera: (3, 3) orientation of the camera in the tool's reference frame.
        roll, pitch: (lowest, highest) [rad].
        jacobian: for the exact gradient.
    """
    stand = np.asarray(camera, dtype=float)
    slope = None
    if jacobian is not None:
        slope = partial(_orientation_gradient, tool, jacobian, stand)
    return PoseConstraint("orientation", partial(_orientation, tool, stand, roll, pitch), slope)


def line_of_sight(
    tool: Tool, instrument: ArrayLike, axis: ArrayLike, half_angle: float, jacobian: ToolJacobian | None = None
) -> PoseConstraint:
    """Keep the instrument inside the target's acceptance cone: cos(half_angle) − (R a)·u ≤ 0, u = (s − x)/‖s − x‖.

    Args:
        tool: forward kinematics of the target's centre x and orientation R.
        instrument: (3,) s, where the tracker or camera stands [m].
        axis: (3,) a, the direction the target faces, in the tool's frame.
        half_angle: of the cone [rad] (a retroreflector accepts about 0.5 rad).
        jacobian: for the exact gradient.
    """
    station = np.asarray(instrument, dtype=float)
    facing = np.asarray(axis, dtype=float)
    facing = facing / np.linalg.norm(facing)
    slope = None
    if jacobian is not None:
        slope = partial(_sight_gradient, tool, jacobian, station, facing)
    return PoseConstraint("line of sight", partial(_sight, tool, station, facing, half_angle), slope)


def _height(tool, limits, q):
    z = tool(q)[1][:, 2]
    return np.stack([sign * (z - bound) for sign, bound in limits], axis=1)


def _height_gradient(jacobian, limits, q):
    row = jacobian(q)[:, 2]
    return np.stack([sign * row for sign, _ in limits], axis=1)


def _axis(tool, min_distance, q):
    x = tool(q)[1]
    return min_distance**2 - (x[:, :2] ** 2).sum(1, keepdims=True)


def _axis_gradient(tool, jacobian, q):
    _, position = tool(q)
    return -2 * np.einsum("mi,min->mn", position[:, :2], jacobian(q)[:, :2])[:, None]


def _reach(tool, max_distance, centre, q):
    return ((tool(q)[1] - centre) ** 2).sum(1, keepdims=True) - max_distance**2


def _reach_gradient(tool, jacobian, centre, q):
    _, position = tool(q)
    return 2 * np.einsum("mi,min->mn", position - centre, jacobian(q)[:, :3])[:, None]


def _distance(tool, limits, centre, q):
    length = np.linalg.norm(tool(q)[1] - centre, axis=1)
    return np.stack([sign * (length - bound) for sign, bound in limits], axis=1)


def _distance_gradient(tool, jacobian, limits, centre, q):
    from_centre = tool(q)[1] - centre
    direction = from_centre / np.linalg.norm(from_centre, axis=1, keepdims=True)
    row = np.einsum("mi,min->mn", direction, jacobian(q)[:, :3])
    return np.stack([sign * row for sign, _ in limits], axis=1)


def _orientation(tool, camera, roll, pitch, q):
    in_camera = camera.T @ tool(q)[0]
    phi = np.arctan2(in_camera[:, 2, 1], in_camera[:, 2, 2])
    theta = np.arcsin(np.clip(-in_camera[:, 2, 0], -1, 1))
    return np.stack([roll[0] - phi, phi - roll[1], pitch[0] - theta, theta - pitch[1]], axis=1)


def _orientation_gradient(tool, jacobian, camera, q):
    x, y = (camera.T @ tool(q)[0])[:, :2, 0].T[:, :, None]  # cos θ cos ψ, cos θ sin ψ
    turn = camera.T @ jacobian(q)[:, 3:]
    cosine = np.maximum(np.hypot(x, y), 1e-9)
    roll = (x * turn[:, 0] + y * turn[:, 1]) / cosine**2
    pitch = (x * turn[:, 1] - y * turn[:, 0]) / cosine
    return np.stack([-roll, roll, -pitch, pitch], axis=1)


def _sight(tool, station, facing, half_angle, q):
    rotation, x = tool(q)
    to_station = station - x
    u = to_station / np.linalg.norm(to_station, axis=1, keepdims=True)
    return np.cos(half_angle) - ((rotation @ facing) * u).sum(1, keepdims=True)


def _sight_gradient(tool, jacobian, station, facing, q):
    rotation, position = tool(q)
    face = rotation @ facing
    to_station = station - position
    length = np.linalg.norm(to_station, axis=1, keepdims=True)
    u = to_station / length
    # ∂(face·u)/∂x = −across; ∂/∂ω = face × u
    across = (face - (face * u).sum(1, keepdims=True) * u) / length
    slope = jacobian(q)
    by_position = np.einsum("mi,min->mn", across, slope[:, :3])
    by_rotation = np.einsum("mi,min->mn", np.cross(face, u), slope[:, 3:])
    return (by_position - by_rotation)[:, None]
