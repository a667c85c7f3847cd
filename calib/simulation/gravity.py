"""Gravity torques of a chain whose masses are known."""

from __future__ import annotations

import numpy as np

from calib.robot.chain import Chain
from calib.robot.kinematics import joint_frames


def gravity_torques(chain: Chain, q: np.ndarray) -> np.ndarray:
    """Return what each joint has to hold against gravity (m, n) [N m or N]; zeros where masses are unknown.

    τ_j = -z_j · Σ_{i ≥ j} (m_i c_i - m_i o_j) × g for a revolute joint, -z_j · g Σ m_i for a prismatic one, with
    m_i c_i the first moment of body i in the base frame and o_j the origin of joint j.
    """
    torque = np.zeros((len(q), chain.n))
    if chain.inertias is None:
        return torque
    frames = joint_frames(chain, q)
    mass = chain.inertias[:, 9]
    origins, rotations = frames[..., :3, 3], frames[..., :3, :3]
    moments = np.einsum("nmij,nj->nmi", rotations, chain.inertias[:, 6:9]) + mass[:, None, None] * origins
    for j, k in enumerate(chain.moving):
        element = chain.elements[k]
        axis = element.sign * rotations[j][:, :, "xyz".index(element.axis[1])]
        if element.axis[0] == "r":
            lever = moments[j:].sum(axis=0) - mass[j:].sum() * origins[j]
            torque[:, j] = -np.einsum("mi,mi->m", axis, np.cross(lever, chain.gravity))
        else:
            torque[:, j] = -mass[j:].sum() * axis @ chain.gravity
    return torque
