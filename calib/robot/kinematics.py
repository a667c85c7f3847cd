"""Forward kinematics and the Jacobian of every element, for many poses at once, without a Python loop over poses.

Internally, the sample axis is the last one (structure of arrays). Each elementary transform is then a few vector
operations over all poses, and a stacked observation matrix is column-major without a copy.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from calib.errors import refuse_robot
from calib.records import shaped
from calib.robot.chain import AXES, Chain, Element
from calib.transforms import pose


@dataclass(frozen=True, eq=False)
class Sweep:
    """Axes, origins and flange poses from one pass along the chain, for m poses.

    Attributes:
        directions: (K, 3, m) unit vector of each element's motion, in the reference frame, sign included.
        origins: (K, 3, m) origin of each element's frame [m].
        rotation: (3, 3, m) rotation of the flange; ``rotation[c]`` is column c of the matrix.
        position: (3, m) position of the flange [m].
    """

    directions: np.ndarray
    origins: np.ndarray
    rotation: np.ndarray
    position: np.ndarray

    def poses(self) -> np.ndarray:
        """Return the flange poses (m, 4, 4)."""
        return pose(self.rotation.transpose(2, 1, 0), self.position.T)


def _walk(
    chain: Chain, q: np.ndarray, start: tuple[np.ndarray, np.ndarray], extra: np.ndarray | None = None
) -> Iterator[tuple[Element, np.ndarray, np.ndarray, np.ndarray]]:
    """Yield each element, the origin of its frame (3, m) [m], and rotation and position of the frame after it.

    Args:
        chain: the arm.
        q: (m, n) joint values [rad or m].
        start: rotation and position of the base, as `_start` returns them.
        extra: (K, m) displacements added to those of the elements [m or rad]; None without.
    """
    rotation, position = start
    for k, element in enumerate(chain.elements):
        if element.placement is not None:
            rotation, position = _place(rotation, position, element.placement)
        origin, amount = position, element.value
        if element.joint is not None:
            amount = amount + element.ratio * q[:, element.joint]
        if extra is not None:
            amount = amount + extra[k]
        axis = AXES.index(element.axis) % 3
        if isinstance(amount, float) and amount == 0.0:
            pass
        elif element.axis[0] == "r":
            rotation = _rotate(rotation, axis, element.sign * amount)
        else:
            position = position + rotation[axis] * (element.sign * amount)
        yield element, origin, rotation, position


def sweep(chain: Chain, q: np.ndarray, base: np.ndarray | None = None, extra: np.ndarray | None = None) -> Sweep:
    """Return axes and origins of all K elements and the flange poses, in one pass along the chain for all poses.

    Args:
        chain: the arm.
        q: (m, n) joint values [rad or m].
        base: (4, 4) or (m, 4, 4), pose of the arm's base in the reference frame; None for the identity.
        extra: (K, m) displacements added to those of the elements (deflections) [m or rad]; None without.
    """
    q = shaped(q, (None, chain.n), f"joint values of '{chain.name}'")
    shape = (len(chain.elements), 3, len(q))
    directions, origins = np.empty(shape), np.empty(shape)
    behind = start = _start(base, len(q))
    for k, (element, origin, *behind) in enumerate(_walk(chain, q, start, extra)):
        axis = behind[0][AXES.index(element.axis) % 3]  # its own motion does not change it
        directions[k], origins[k] = (axis if element.sign > 0 else -axis), origin
    rotation, position = _place(behind[0], behind[1], chain.tail)
    return Sweep(directions, origins, rotation, position)


def forward(chain: Chain, q: np.ndarray, extra: np.ndarray | None = None) -> np.ndarray:
    """Return the tip's poses (m, 4, 4) [m] in the base frame at joint values q (m, n) [rad or m].

    Args:
        chain: the arm.
        q: (m, n) joint values [rad or m].
        extra: (K, m) displacements added to those of the chain's K elements (deflections) [m or rad]; None without.
    """
    return sweep(chain, q, extra=extra).poses()


def element_jacobian(chain: Chain, walked: Sweep, point: np.ndarray, index: np.ndarray | None = None) -> np.ndarray:
    """Return the Jacobian (K, 6, m) of `point`, fixed to the flange, with respect to the elements' values.

    For a rotation about z through o it is [z × (point - o); z]; for a translation along z, [z; 0].

    Args:
        chain: the arm.
        walked: the result of `sweep`.
        point: (3, m) position in the reference frame [m].
        index: indices of the elements; None for all K.

    Returns:
        (K, 6, m), or one row per entry of `index`: linear velocity of the point, then angular velocity, both in the
        reference frame.
    """
    angular = np.array([element.axis[0] == "r" for element in chain.elements])
    z, origins = walked.directions, walked.origins
    if index is not None:
        angular, z, origins = angular[index], z[index], origins[index]
    jacobian = np.empty((len(angular), 6, point.shape[1]))
    lever = point - origins
    jacobian[:, 0] = z[:, 1] * lever[:, 2] - z[:, 2] * lever[:, 1]
    jacobian[:, 1] = z[:, 2] * lever[:, 0] - z[:, 0] * lever[:, 2]
    jacobian[:, 2] = z[:, 0] * lever[:, 1] - z[:, 1] * lever[:, 0]
    jacobian[:, 3:] = z
    jacobian[~angular, :3] = z[~angular]
    jacobian[~angular, 3:] = 0.0
    return jacobian


def jacobian(chain: Chain, q: np.ndarray) -> np.ndarray:
    """Return the tip's Jacobian [v; ω] with respect to the values of all elements (observation Jacobian), (m, 6, K).

    v is the velocity of the tip, ω its angular velocity, both in the base frame and per unit of an element's value.

    Args:
        chain: the arm, with K elements.
        q: (m, n) joint values [rad or m].
    """
    walked = sweep(chain, q)
    return element_jacobian(chain, walked, walked.position).transpose(2, 1, 0)


def jacobian_product(chain: Chain, q: np.ndarray, G: np.ndarray) -> np.ndarray:
    """Return Σ G[i] · ∂J[i]/∂q (m, n) for weights G (m, 6, K), with J the result of `jacobian`.

    Args:
        chain: the arm, with K elements.
        q: (m, n) joint values [rad or m].
        G: (m, 6, K) weights of the entries of J.
    """
    walked = sweep(chain, q)
    columns = element_jacobian(chain, walked, walked.position)
    return twist_product(chain, columns, columns, np.arange(len(columns)), G.transpose(2, 1, 0)).T


def twist_product(
    chain: Chain, elements: np.ndarray, columns: np.ndarray, places: np.ndarray, G: np.ndarray
) -> np.ndarray:
    """Return Σ_k G_k · ∂J_k/∂q (n, m) for columns J_k = [v; ω] of a Jacobian of the arm.

    v and ω are velocity and angular velocity of a point per unit of an element's value. Joint e rotates every column of
    a later element as a whole. For earlier elements (and for its own), it moves the point:

        ∂J_k = [ω_e × v_k; ω_e × ω_k]  for k after e,   ∂J_k = [ω_k × v_e; 0]  otherwise

    (Hourtash 2005, IJRA, with translations as ω = 0). Two sums of cross products therefore serve all joints.

    Args:
        chain: the arm.
        elements: (K, 6, m) `element_jacobian` of all elements, at the point of the columns.
        columns: (p, 6, m) the columns J_k.
        places: (p,) index of each column's element; -1 for a column before the arm, K for one after it.
        G: (p, 6, m) weights.

    Returns:
        (n, m) [unit of the columns per rad or m].
    """
    moving = chain.driven
    v, w = columns[:, :3], columns[:, 3:]
    rotation_part = _cross(v, G[:, :3]) + _cross(w, G[:, 3:])
    translation_part = _cross(G[:, :3], w)
    behind = (places > moving[:, None]).astype(float)
    shape = (len(moving), 3, G.shape[2])
    rotation_sum = (behind @ rotation_part.reshape(len(G), -1)).reshape(shape)
    translation_sum = ((1.0 - behind) @ translation_part.reshape(len(G), -1)).reshape(shape)
    by_rotation = np.einsum("kim,kim->km", elements[moving, 3:], rotation_sum)
    by_translation = np.einsum("kim,kim->km", elements[moving, :3], translation_sum)
    return chain.rates.T @ (by_rotation + by_translation)


def joint_jacobian(chain: Chain, walked: Sweep, point: np.ndarray, before: int | None = None) -> np.ndarray:
    """Return the Jacobian (m, 6, n) of `point` with respect to the joints, including the motion of mimic followers.

    Args:
        chain: the arm.
        walked: the result of `sweep`.
        point: (3, m) position in the reference frame [m].
        before: index of the first element after the point; this element and later ones do not move the point. None for
            a point on the flange.

    Returns:
        (m, 6, n): linear velocity of the point, then angular velocity, both in the reference frame.
    """
    moving = chain.driven
    if before is not None:
        moving = moving[moving < before]
    columns = element_jacobian(chain, walked, point, moving)
    rates = chain.rates[: len(moving)]
    if not np.array_equal(rates, np.eye(chain.n)):
        columns = np.tensordot(rates.T, columns, 1)
    return columns.transpose(2, 1, 0)


def tip_jacobian(chain: Chain, q: np.ndarray) -> np.ndarray:
    """Return the tip's Jacobian (m, 6, n) [v; ω] with respect to the joints, at joint values q (m, n).

    v is the velocity of the tip, ω its angular velocity, both in the base frame and per unit joint velocity.

    Args:
        chain: the arm.
        q: (m, n) joint values [rad or m].
    """
    walked = sweep(chain, q)
    return joint_jacobian(chain, walked, walked.position)


def moving_frames(chain: Chain, q: np.ndarray) -> np.ndarray:
    """Return the frames (moving, m, 4, 4) after all moving elements, including mimic followers, in the base.

    Args:
        chain: the arm.
        q: (m, n) joint values [rad or m].
    """
    q = shaped(q, (None, chain.n), f"joint values of '{chain.name}'")
    frames = np.zeros((len(chain.driven), len(q), 4, 4))
    frames[..., 3, 3] = 1.0
    number = 0
    for element, _, rotation, position in _walk(chain, q, _start(None, len(q))):
        if element.joint is not None:
            frames[number, :, :3, :3] = rotation.transpose(2, 1, 0)
            frames[number, :, :3, 3] = position.T
            number += 1
    return frames


def joint_frames(chain: Chain, q: np.ndarray) -> np.ndarray:
    """Return the frames (n, m, 4, 4) right after each joint's moving element, in the base.

    `Chain.inertias` refers to these frames.

    Args:
        chain: the arm.
        q: (m, n) joint values [rad or m].
    """
    frames = moving_frames(chain, q)
    if np.array_equal(chain.driven, chain.moving):
        return frames
    return frames[np.searchsorted(chain.driven, chain.moving)]


def gravity_torques(chain: Chain, q: np.ndarray, load: np.ndarray | None = None) -> np.ndarray:
    """Return the torques g(q) = ∂U/∂q (m, n) [N m or N] that balance gravity in an arm of known masses.

    With m_j and s_j the mass and the first moment of all bodies from joint j on, o_j the joint's origin and z_j its
    axis, the torque is -g · (z_j × (s_j - m_j o_j)) for a revolute joint and -g · z_j m_j for a prismatic one.

    Args:
        chain: the arm, with `inertias` and without mimic joints.
        q: (m, n) joint values [rad or m].
        load: (m, 4) first moments [kg m] and mass [kg] that the last body carries in each pose, in its frame; None for
            no load.

    Raises:
        RobotError: masses are unknown, or one joint moves several elements.
    """
    return gravity_moments(chain, q, load)[chain.driven].T @ chain.rates


def gravity_moments(chain: Chain, q: np.ndarray, load: np.ndarray | None = None) -> np.ndarray:
    """Return the moments (K, m) [N m or N] about (along) the axes of all elements that balance gravity.

    Each element carries the bodies from its joint on, as in `gravity_torques`; elements behind the last joint carry
    none.

    Args:
        chain: the arm, with `inertias` and without mimic joints.
        q: (m, n) joint values [rad or m].
        load: (m, 4) first moments [kg m] and mass [kg] that the last body carries in each pose, in its frame; None for
            no load.

    Raises:
        RobotError: masses are unknown, or one joint moves several elements.
    """
    if len(chain.driven) != chain.n:
        refuse_robot(f"robot '{chain.name}'", "gravity torques of mimic joints are not implemented")
    if chain.inertias is None:
        refuse_robot(f"robot '{chain.name}'", "has no masses; add 'inertia' to its joints")
    joints = [chain.elements[k].joint for k in chain.driven]
    masses = np.tile(chain.inertias[joints, 9, None], len(q))
    moments = np.tile(chain.inertias[joints, 6:9, None], len(q))
    if load is not None:
        masses[-1] += load[:, 3]
        moments[-1] += load[:, :3].T
    frames = moving_frames(chain, q)
    walk = sweep(chain, q)
    # First moments (n, 3, m) of each body about the base, then those of all bodies from each joint on.
    moment = np.einsum("jmik,jkm->jim", frames[..., :3, :3], moments)
    moment += masses[:, None] * frames[..., :3, 3].swapaxes(1, 2)
    carried_moment = np.cumsum(moment[::-1], axis=0)[::-1]
    carried_mass = np.cumsum(masses[::-1], axis=0)[::-1][:, None]
    carrying = np.searchsorted(chain.driven, np.arange(len(chain.elements)))
    carries = carrying < chain.n
    body = carrying[carries]
    axes = walk.directions[carries]
    by_rotation = _cross(axes, carried_moment[body] - carried_mass[body] * walk.origins[carries])
    by_translation = carried_mass[body] * axes
    turning = np.array([element.axis[0] == "r" for element in chain.elements])[carries]
    moment_rates = np.where(turning[:, None, None], by_rotation, by_translation)
    result = np.zeros((len(chain.elements), len(q)))
    result[carries] = -np.einsum("i,kim->km", chain.gravity, moment_rates)
    return result


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the cross products a × b of two arrays (K, 3, m) along their middle axis."""
    x = a[:, 1] * b[:, 2] - a[:, 2] * b[:, 1]
    y = a[:, 2] * b[:, 0] - a[:, 0] * b[:, 2]
    z = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    return np.stack([x, y, z], axis=1)


def _start(base: np.ndarray | None, m: int) -> tuple[np.ndarray, np.ndarray]:
    """Return rotation columns (3, 3, m) and positions (3, m) of the base in m poses.

    Args:
        base: (4, 4) or (m, 4, 4) pose of the base in the reference frame; None for the identity.
        m: number of poses.
    """
    if base is None:
        base = np.eye(4)
    placement = np.broadcast_to(base, (m, 4, 4))
    rotation = np.ascontiguousarray(placement[:, :3, :3].transpose(2, 1, 0))
    position = np.ascontiguousarray(placement[:, :3, 3].T)
    return rotation, position


def _place(rotation: np.ndarray, position: np.ndarray, placement: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return frames multiplied from the right by a fixed transform (4, 4).

    Args:
        rotation, position: rotation columns (3, 3, m) and positions (3, m) of the frames.
        placement: the transform.
    """
    flat = rotation.reshape(3, -1)
    position = position + (placement[:3, 3] @ flat).reshape(position.shape)
    if not np.array_equal(placement[:3, :3], np.eye(3)):
        rotation = (placement[:3, :3].T @ flat).reshape(rotation.shape)
    return rotation, position


def _rotate(rotation: np.ndarray, axis: int, angle: np.ndarray | float) -> np.ndarray:
    """Return rotation columns (3, 3, m) of frames after a rotation about one of the frames' own axes.

    Args:
        rotation: rotation columns of the frames.
        axis: 0, 1 or 2 for x, y or z.
        angle: angle (m,), or one for all frames [rad].
    """
    cosine, sine = np.cos(angle), np.sin(angle)
    next_axis, last_axis = (axis + 1) % 3, (axis + 2) % 3
    result = np.empty_like(rotation)
    result[axis] = rotation[axis]
    result[next_axis] = cosine * rotation[next_axis] + sine * rotation[last_axis]
    result[last_axis] = cosine * rotation[last_axis] - sine * rotation[next_axis]
    return result
