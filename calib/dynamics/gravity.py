"""Gravity torques of a chain whose masses are known, in batch."""

import numpy as np

from calib.errors import RobotError
from calib.robot.chain import Chain
from calib.robot.kinematics import joint_frames


def gravity_torques(chain: Chain, q: np.ndarray) -> np.ndarray:
    """Return the torques that hold the arm still against gravity, g(q) = ∂U/∂q.

        g_j = - Σ_{bodies i ≥ j}  z_j · ((c_i - o_j) × m_i γ)     revolute,
        g_j = - Σ_{bodies i ≥ j}  z_j · m_i γ                     prismatic,

    with z_j, o_j the joint's axis and origin, c_i the centre of mass, m_i the mass, γ the gravity vector: a static
    arm's drives show +g(q).

    Args:
        chain: with `inertias`; without mimic joints.
        q: (m, n) [rad or m].

    Returns:
        (m, n) [N m or N].

    Raises:
        RobotError: where the masses are unknown, or one joint moves several elements.
    """
    if chain.inertias is None:
        raise RobotError(f"robot '{chain.name}': gravity torques need the masses of its bodies")
    if len(chain.driven) != chain.n:
        raise RobotError(f"robot '{chain.name}': gravity torques of mimic joints are not implemented")
    frames = joint_frames(chain, q)
    mass, first = chain.inertias[:, 9], chain.inertias[:, 6:9]
    # m c in the base frame, then moved on to sums over the bodies carried by each joint
    moment = np.einsum("jmab,jb->jma", frames[..., :3, :3], first) + mass[:, None, None] * frames[..., :3, 3]
    carried, weight = np.cumsum(moment[::-1], axis=0)[::-1], np.cumsum(mass[::-1])[::-1]
    result = np.empty((len(q), chain.n))
    for j, k in enumerate(chain.moving):
        element = chain.elements[k]
        axis = element.sign * element.ratio * frames[j, :, :3, "xyz".index(element.axis[1])]
        if element.axis[0] == "t":
            result[:, j] = -weight[j] * (axis @ chain.gravity)
        else:
            lever = carried[j] - weight[j] * frames[j, :, :3, 3]
            result[:, j] = -np.einsum("ma,ma->m", axis, np.cross(lever, chain.gravity))
    return result
