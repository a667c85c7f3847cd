"""URDFs as Pinocchio reads them: what was written is held against an independent reader."""

from __future__ import annotations

from typing import Any

import numpy as np

from calib.errors import RobotError
from calib.robot.chain import Chain


def tip_poses(source: str, chain: Chain, q: np.ndarray) -> np.ndarray:
    """Return where Pinocchio puts the tip of a chain read from the URDF text `source`, in its base (m, 4, 4).

    Args:
        source: URDF text.
        chain: read from it by `calib.robot.urdf`, whose joints, base and tip q belongs to.
        q: (m, n) [rad or m].

    Raises:
        RobotError: where Pinocchio cannot read the text.
    """
    import pinocchio

    pin: Any = pinocchio  # its names come from C++, where no type checker sees them
    try:
        model: Any = pin.buildModelFromXML(source)
    except (ValueError, RuntimeError) as error:
        raise RobotError(f"Pinocchio cannot read the URDF: {error}") from error
    data = model.createData()
    base, tip = model.getFrameId(chain.base), model.getFrameId(chain.tip)
    result = np.empty((len(q), 4, 4))
    for pose, row in zip(result, q, strict=True):
        pin.framesForwardKinematics(model, data, _configuration(model, pin.neutral(model), chain, row))
        pose[:] = (data.oMf[base].inverse() * data.oMf[tip]).homogeneous
    return result


def _configuration(model: Any, neutral: np.ndarray, chain: Chain, q: np.ndarray) -> np.ndarray:
    """Return Pinocchio's configuration; a continuous joint is there by cosine and sine, a follower by its own value."""
    for element in chain.elements:
        if element.joint is None:
            continue
        joint = model.joints[model.getJointId(element.name.removesuffix(".offset"))]
        value = element.value + element.ratio * q[element.joint]
        neutral[joint.idx_q : joint.idx_q + joint.nq] = [value] if joint.nq == 1 else [np.cos(value), np.sin(value)]
    return neutral
