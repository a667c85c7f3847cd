"""URDFs as Pinocchio reads them: what was written is held against an independent reader."""

import io
import tempfile
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from calib.errors import RobotError, refused_as
from calib.robot.chain import Chain


def tip_poses(source: str, chain: Chain, q: np.ndarray) -> np.ndarray:
    """Return where Pinocchio puts the tip of a chain read from the URDF text `source`, in its base (m, 4, 4).

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


def motion_torques(
    source: str, chain: Chain, q: np.ndarray, v: np.ndarray, a: np.ndarray, mjcf: bool = False
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return what Pinocchio makes of a robot's masses and drives.

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

    from calib.robot.formats.mjcf import joint_name

    pin: Any = pinocchio
    try:
        model: Any = _from_mjcf(pin, source) if mjcf else pin.buildModelFromXML(source)
    except (ValueError, RuntimeError) as error:
        raise RobotError(f"Pinocchio cannot read the {'MJCF' if mjcf else 'URDF'}: {error}") from error
    data = model.createData()
    model.gravity = pin.Motion(np.array(chain.gravity), np.zeros(3))
    moved = [(k, one) for k, one in enumerate(chain.elements) if one.joint is not None]
    joints = [model.joints[model.getJointId(joint_name(chain, k))] for k, _ in moved]
    torques, frames = np.zeros(q.shape), np.empty((len(moved), len(q), 4, 4))
    for row in range(len(q)):
        state = [pin.neutral(model), np.zeros(model.nv), np.zeros(model.nv)]
        for (_, element), joint in zip(moved, joints):
            amount = element.ratio * q[row, element.joint] + (0.0 if mjcf else element.value)
            state[0][joint.idx_q : joint.idx_q + joint.nq] = (
                [amount] if joint.nq == 1 else [np.cos(amount), np.sin(amount)]
            )
            state[1][joint.idx_v] = element.ratio * v[row, element.joint]
            state[2][joint.idx_v] = element.ratio * a[row, element.joint]
        pin.forwardKinematics(model, data, state[0])
        tau = pin.rnea(model, data, *state)
        for number, ((_, element), joint) in enumerate(zip(moved, joints)):
            torques[row, element.joint] += element.ratio * tau[joint.idx_v]
            frames[number, row] = data.oMi[joint.id].homogeneous
    main = [joints[number].idx_v for number, (k, _) in enumerate(moved) if k in chain.moving]
    order = [element.joint for k, element in moved if k in chain.moving and element.joint is not None]
    damping, friction = np.zeros(chain.n), np.zeros(chain.n)
    damping[order], friction[order] = model.damping[main], model.friction[main]
    return torques, frames, damping, friction


def _from_mjcf(pin: Any, source: str) -> Any:
    """Return the model of an MJCF text; Pinocchio reads that from a file only."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "model.xml"
        path.write_text(source, encoding="utf-8")
        return pin.buildModelFromMJCF(str(path))


def link_poses(source: str, links: Sequence[str], base: str, joints: Sequence[str], q: np.ndarray) -> np.ndarray:
    """Return where yourdfpy puts links of the URDF text `source`, in the link `base` (links, m, 4, 4).

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
