"""Constraints on a measurement pose: tool height, distance from the axis, orientation to an instrument, line of sight.

All but the line of sight are the quantities in Table 1 of the study of the KUKA LWR4+ by Kolyubin, Shiriaev & Jubien
(2019). The constraints use no robot class. Each takes the caller's forward kinematics as a callable ``tool(q: (m, n))
-> (rotation (m, 3, 3), position (m, 3))`` in the frame in which the limits are given. For exact gradients each also
takes ``tool_jacobian(q) -> (m, 6, n)``: velocity of the tool point, then angular velocity, both in the same frame.
Without it the gradient is computed by central differences. Every constraint is smooth unless its docstring says
otherwise. A constraint can be pickled if its callables can.
"""

from collections.abc import Callable
from functools import partial

import numpy as np
from numpy.typing import ArrayLike

from .space import PoseConstraint

Tool = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
ToolJacobian = Callable[[np.ndarray], np.ndarray]


def height(tool: Tool, lowest: float, highest: float = np.inf, jacobian: ToolJacobian | None = None) -> PoseConstraint:
    """Return the constraint lowest ≤ z ≤ highest on the height z [m] of the tool point.

    Args:
        tool: forward kinematics, see the module's docstring.
        lowest, highest: limits [m]; infinite for no limit.
        jacobian: tool Jacobian for exact gradients; None uses central differences.
    """
    limits = _finite_limits(lowest, highest)
    slope = None
    if jacobian is not None:
        slope = partial(_height_gradient, jacobian, limits)
    values = partial(_height, tool, limits)
    return PoseConstraint("height", values, slope)


def _finite_limits(lower: float, upper: float) -> tuple[tuple[float, float], ...]:
    """Return (sign, bound) of each finite limit; a value satisfies the limit where sign · (value − bound) ≤ 0.

    Args:
        lower, upper: limits of one value; an infinite limit is skipped. The sign is −1 for `lower` and 1 for `upper`.
    """
    limits = []
    if np.isfinite(lower):
        limits.append((-1.0, lower))
    if np.isfinite(upper):
        limits.append((1.0, upper))
    return tuple(limits)


def axis_distance(tool: Tool, min_distance: float, jacobian: ToolJacobian | None = None) -> PoseConstraint:
    """Return the constraint d_xy = √(x² + y²) ≥ min_distance [m] on the tool point's distance from the z axis.

    The constraint is evaluated in the smooth form min_distance² − x² − y² ≤ 0.

    Args:
        tool: forward kinematics, see the module's docstring; x, y, z are the tool point's coordinates in its frame [m].
        min_distance: least distance [m].
        jacobian: tool Jacobian for exact gradients; None uses central differences.
    """
    slope = None
    if jacobian is not None:
        slope = partial(_axis_gradient, tool, jacobian)
    values = partial(_axis, tool, min_distance)
    return PoseConstraint("distance from the axis", values, slope)


def reach(
    tool: Tool, max_distance: float, centre: ArrayLike = (0, 0, 0), jacobian: ToolJacobian | None = None
) -> PoseConstraint:
    """Return the constraint that the tool point x is within `max_distance` [m] of the point `centre` c (3,) [m].

    The constraint is evaluated in the smooth form ‖x − c‖² − max_distance² ≤ 0.

    Args:
        tool: forward kinematics, see the module's docstring.
        max_distance: largest distance [m].
        centre: c (3,) in the frame of `tool` [m].
        jacobian: tool Jacobian for exact gradients; None uses central differences.
    """
    point = np.asarray(centre, dtype=float)
    slope = None
    if jacobian is not None:
        slope = partial(_reach_gradient, tool, jacobian, point)
    values = partial(_reach, tool, max_distance, point)
    return PoseConstraint("reach", values, slope)


def distance(
    tool: Tool, min_distance: float, max_distance: float, centre: ArrayLike, jacobian: ToolJacobian | None = None
) -> PoseConstraint:
    """Return the constraint that the tool point is `min_distance` to `max_distance` [m] from an instrument at `centre`.

    `centre` is a point (3,) [m]. The constraint is not smooth where the tool point coincides with `centre`.

    Args:
        tool: forward kinematics, see the module's docstring.
        min_distance, max_distance: limits of the distance [m].
        centre: (3,) position of the instrument in the frame of `tool` [m].
        jacobian: tool Jacobian for exact gradients; None uses central differences.
    """
    point = np.asarray(centre, dtype=float)
    limits = _finite_limits(min_distance, max_distance)
    slope = None
    if jacobian is not None:
        slope = partial(_distance_gradient, tool, jacobian, limits, point)
    values = partial(_distance, tool, limits, point)
    return PoseConstraint("range of the instrument", values, slope)


def orientation(
    tool: Tool,
    camera: ArrayLike,
    roll: tuple[float, float],
    pitch: tuple[float, float],
    jacobian: ToolJacobian | None = None,
) -> PoseConstraint:
    """Return the constraint that the tool's roll and pitch in the camera frame are within limits [rad].

    R_camera^T R = Rot_z(yaw) Rot_y(pitch) Rot_x(roll). This convention is our reading of Table 1 of the study, which
    does not state one. The constraint is not smooth where roll jumps by 2π, nor at a pitch of ±π/2.

    Args:
        tool: forward kinematics.
        camera: (3, 3) orientation of the camera in the tool's reference frame.
        roll, pitch: (lowest, highest) [rad].
        jacobian: tool Jacobian for exact gradients; None uses central differences.
    """
    stand = np.asarray(camera, dtype=float)
    slope = None
    if jacobian is not None:
        slope = partial(_orientation_gradient, tool, jacobian, stand)
    values = partial(_orientation, tool, stand, roll, pitch)
    return PoseConstraint("orientation", values, slope)


def line_of_sight(
    tool: Tool, instrument: ArrayLike, axis: ArrayLike, half_angle: float, jacobian: ToolJacobian | None = None
) -> PoseConstraint:
    """Return the constraint that the instrument lies inside the cone of directions that the target accepts.

    The constraint is cos(half_angle) − (R a)·u ≤ 0 with u = (s − x)/‖s − x‖.

    Args:
        tool: forward kinematics of the target: its centre x (3,) [m] and orientation R (3, 3).
        instrument: (3,) s, position of the tracker or camera [m].
        axis: (3,) a, the direction in which the target faces, in the tool's frame.
        half_angle: half opening angle of the cone [rad] (a retroreflector accepts about 0.5 rad).
        jacobian: tool Jacobian for exact gradients; None uses central differences.
    """
    station = np.asarray(instrument, dtype=float)
    facing = np.asarray(axis, dtype=float)
    facing = facing / np.linalg.norm(facing)
    slope = None
    if jacobian is not None:
        slope = partial(_sight_gradient, tool, jacobian, station, facing)
    values = partial(_sight, tool, station, facing, half_angle)
    return PoseConstraint("line of sight", values, slope)


def _height(tool, limits, q):
    _, position = tool(q)
    z = position[:, 2]
    excess = [sign * (z - bound) for sign, bound in limits]
    return np.stack(excess, axis=1)


def _height_gradient(jacobian, limits, q):
    row = jacobian(q)[:, 2]
    rows = [sign * row for sign, _ in limits]
    return np.stack(rows, axis=1)


def _axis(tool, min_distance, q):
    _, position = tool(q)
    squared_distance = (position[:, :2] ** 2).sum(1, keepdims=True)
    return min_distance**2 - squared_distance


def _axis_gradient(tool, jacobian, q):
    _, position = tool(q)
    slope = jacobian(q)[:, :2]
    rows = np.einsum("mi,min->mn", position[:, :2], slope)
    return -2 * rows[:, None]


def _reach(tool, max_distance, centre, q):
    _, position = tool(q)
    from_centre = position - centre
    squared_distance = (from_centre**2).sum(1, keepdims=True)
    return squared_distance - max_distance**2


def _reach_gradient(tool, jacobian, centre, q):
    _, position = tool(q)
    slope = jacobian(q)[:, :3]
    rows = np.einsum("mi,min->mn", position - centre, slope)
    return 2 * rows[:, None]


def _distance(tool, limits, centre, q):
    _, position = tool(q)
    length = np.linalg.norm(position - centre, axis=1)
    excess = [sign * (length - bound) for sign, bound in limits]
    return np.stack(excess, axis=1)


def _distance_gradient(tool, jacobian, limits, centre, q):
    _, position = tool(q)
    from_centre = position - centre
    length = np.linalg.norm(from_centre, axis=1, keepdims=True)
    direction = from_centre / length
    slope = jacobian(q)[:, :3]
    row = np.einsum("mi,min->mn", direction, slope)
    rows = [sign * row for sign, _ in limits]
    return np.stack(rows, axis=1)


def _orientation(tool, camera, roll, pitch, q):
    rotation, _ = tool(q)
    in_camera = camera.T @ rotation
    last_row = in_camera[:, 2]
    phi = np.arctan2(last_row[:, 1], last_row[:, 2])
    sine = np.clip(-last_row[:, 0], -1, 1)
    theta = np.arcsin(sine)
    excess = [roll[0] - phi, phi - roll[1], pitch[0] - theta, theta - pitch[1]]
    return np.stack(excess, axis=1)


def _orientation_gradient(tool, jacobian, camera, q):
    # first column of the rotation: cos θ cos ψ, cos θ sin ψ
    rotation, _ = tool(q)
    in_camera = camera.T @ rotation
    x, y = in_camera[:, :2, 0].T[:, :, None]
    turn = camera.T @ jacobian(q)[:, 3:]
    cosine = np.maximum(np.hypot(x, y), 1e-9)
    roll = (x * turn[:, 0] + y * turn[:, 1]) / cosine**2
    pitch = (x * turn[:, 1] - y * turn[:, 0]) / cosine
    return np.stack([-roll, roll, -pitch, pitch], axis=1)


def _sight(tool, station, facing, half_angle, q):
    rotation, x = tool(q)
    to_station = station - x
    length = np.linalg.norm(to_station, axis=1, keepdims=True)
    u = to_station / length
    face = rotation @ facing
    cosine = (face * u).sum(1, keepdims=True)
    return np.cos(half_angle) - cosine


def _sight_gradient(tool, jacobian, station, facing, q):
    rotation, position = tool(q)
    face = rotation @ facing
    to_station = station - position
    length = np.linalg.norm(to_station, axis=1, keepdims=True)
    u = to_station / length
    # ∂(face·u)/∂x = −across; ∂/∂ω = face × u
    cosine = (face * u).sum(1, keepdims=True)
    across = (face - cosine * u) / length
    slope = jacobian(q)
    by_position = np.einsum("mi,min->mn", across, slope[:, :3])
    turning_axis = np.cross(face, u)
    by_rotation = np.einsum("mi,min->mn", turning_axis, slope[:, 3:])
    return (by_position - by_rotation)[:, None]
