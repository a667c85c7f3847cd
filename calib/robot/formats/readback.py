"""Exported URDFs and MJCFs as read by Pinocchio and yourdfpy, for comparison with what was written."""

import io
import tempfile
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from calib.errors import RobotError, refused_as
from calib.robot.chain import Chain
from calib.robot.formats.mjcf import joint_name


def tip_poses(source: str, chain: Chain, q: np.ndarray) -> np.ndarray:
    """Return Pinocchio's tip poses (m, 4, 4) in the base, for a chain read from the URDF text `source`.

    Args:
        source: URDF text.
        chain: read from it by `calib.robot.formats.urdf`, whose joints, base and tip q belongs to.
        q: (m, n) [rad or m].

    Raises:
        RobotError: where Pinocchio cannot read the text.
    """
    import pinocchio

    pin: Any = pinocchio  # its names come from C++, where no type checker sees them
    with refused_as(RobotError, (ValueError, RuntimeError), "Pinocchio cannot read the URDF: {}"):
        model: Any = pin.buildModelFromXML(source)
    data = model.createData()
    base, tip = model.getFrameId(chain.base), model.getFrameId(chain.tip)
    result = np.empty((len(q), 4, 4))
    for pose, configuration in zip(result, configurations(model, chain, q), strict=True):
        pin.framesForwardKinematics(model, data, configuration)
        pose[:] = (data.oMf[base].inverse() * data.oMf[tip]).homogeneous
    return result


def driven_joints(model: Any, chain: Chain) -> list[Any]:
    """Return Pinocchio's joints of a chain's moving elements, including mimic followers."""
    return [model.joints[model.getJointId(joint_name(chain, k))] for k in chain.driven.tolist()]


def configurations(model: Any, chain: Chain, q: np.ndarray, from_zero: bool = False) -> np.ndarray:
    """Return Pinocchio's configurations (m, nq) at joint values q (m, n): cosine and sine for continuous joints.

    Args:
        from_zero: whether the model's frames at zero hold the chain's constant values.
    """
    import pinocchio

    pin: Any = pinocchio
    result = np.tile(pin.neutral(model), (len(q), 1))
    for k, joint in zip(chain.driven, driven_joints(model, chain)):
        element = chain.elements[k]
        value = element.ratio * q[:, element.joint] + (0.0 if from_zero else element.value)
        values = [value] if joint.nq == 1 else [np.cos(value), np.sin(value)]
        result[:, joint.idx_q : joint.idx_q + joint.nq] = np.stack(values, axis=1)
    return result


def motion_torques(
    source: str, chain: Chain, q: np.ndarray, v: np.ndarray, a: np.ndarray, mjcf: bool = False
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return Pinocchio's torques, body frames, damping and friction of a robot with masses and drives.

    Args:
        source: URDF or MJCF text.
        chain: whose joints, gravity (in the root's frame) and mimic ratios count; other joints stand still at zero.
        q, v, a: (m, n) [rad or m, and per s, per s²].
        mjcf: whether it is MJCF, where the frames at q = 0 hold the chain's constant values.

    Returns:
        Torques (m, n) of `rnea`, armature included; frames of the bodies behind the moving elements (moving, m, 4, 4);
        damping and friction (n,).

    Raises:
        RobotError: where Pinocchio cannot read the text.
    """
    import pinocchio

    pin: Any = pinocchio
    try:
        model: Any = _from_mjcf(pin, source) if mjcf else pin.buildModelFromXML(source)
    except (ValueError, RuntimeError) as error:
        raise RobotError(f"Pinocchio cannot read the {'MJCF' if mjcf else 'URDF'}: {error}") from error
    data = model.createData()
    model.gravity = pin.Motion(np.array(chain.gravity), np.zeros(3))
    joints = driven_joints(model, chain)
    velocity = np.zeros((model.nv, chain.n))
    velocity[[joint.idx_v for joint in joints]] = chain.rates
    torques, frames = np.zeros(q.shape), np.empty((len(joints), len(q), 4, 4))
    for row, configuration in enumerate(configurations(model, chain, q, mjcf)):
        pin.forwardKinematics(model, data, configuration)
        torques[row] = pin.rnea(model, data, configuration, velocity @ v[row], velocity @ a[row]) @ velocity
        frames[:, row] = [data.oMi[joint.id].homogeneous for joint in joints]
    main = [joints[place].idx_v for place in np.searchsorted(chain.driven, chain.moving)]
    return torques, frames, model.damping[main], model.friction[main]


def _from_mjcf(pin: Any, source: str) -> Any:
    """Return Pinocchio's model of an MJCF text, by way of a temporary file."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "model.xml"
        path.write_text(source, encoding="utf-8")
        return pin.buildModelFromMJCF(str(path))


def link_poses(source: str, links: Sequence[str], base: str, joints: Sequence[str], q: np.ndarray) -> np.ndarray:
    """Return yourdfpy's poses (links, m, 4, 4) in the link `base` of the links of a URDF text.

    Args:
        source: URDF text; meshes are not looked for.
        links, base: names of links.
        joints: names of the joints that q (m, n) belongs to [rad or m]; others stand at zero, followers follow.

    Raises:
        RobotError: where yourdfpy cannot read the text.
    """
    import yourdfpy  # and trimesh with it: a second to load

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            model = yourdfpy.URDF.load(io.BytesIO(source.encode()), load_meshes=False, load_collision_meshes=False)
        result = np.empty((len(links), len(q), 4, 4))
        for m, row in enumerate(q):
            model.update_cfg(dict(zip(joints, map(float, row), strict=True)))
            for k, link in enumerate(links):
                result[k, m] = model.get_transform(link, base)
    except Exception as error:  # whatever it and its parsers raise
        raise RobotError(f"yourdfpy cannot read the URDF: {type(error).__name__}: {error}") from error
    return result
