"""MJCF files (MuJoCo) of a `Chain` with masses and drives, and exported files as Pinocchio and yourdfpy read them.

In an MJCF file motor inertia becomes ``armature``. The world is the chain's base. Bodies stand where the chain's frames
are, one behind each moving element; a mimic joint's follower is tied to its leader by an equality, which MuJoCo keeps
softly. The tip is a site. There are no meshes: grey capsules without contact and without mass show the links.
"""

import io
import tempfile
import warnings
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
from scipy.spatial.transform import Rotation

from calib.errors import RobotError, refused_as
from calib.robot.chain import AXES, Chain
from calib.robot.formats.native import NativeModel
from calib.robot.formats.urdf_write import centred, numbers_text, xml_text
from calib.robot.kinematics import moving_frames
from calib.transforms import invert


def mjcf_text(chain: Chain, bodies: np.ndarray, armature: np.ndarray, damping: np.ndarray, friction: np.ndarray) -> str:
    """Return the MJCF text of a chain with bodies and drives.

    Args:
        chain: the arm.
        bodies: (B, 10) standard parameters of the body after each of B moving elements.
        armature, damping, friction: (n,) motor inertia, viscous and Coulomb friction of each joint [kg m², N m s/rad, N
            m, or kg, N s/m, N].
    """
    root = ET.Element("mujoco", model=chain.name)
    main_elements = set(chain.moving.tolist())
    ET.SubElement(root, "compiler", angle="radian", autolimits="true", inertiafromgeom="false")
    ET.SubElement(root, "option", gravity=numbers_text(chain.gravity))
    parent = ET.SubElement(root, "worldbody")
    ties = ET.Element("equality")
    frames = moving_frames(chain, np.zeros((1, chain.n)))[:, 0]
    # Each body's frame in the frame of the body before.
    body_poses = [frames[0], *(invert(frames[:-1]) @ frames[1:])]
    ends = [transform[:3, 3] for transform in (*body_poses[1:], chain.tail)]
    for number, k in enumerate(chain.driven.tolist()):
        element, name = chain.elements[k], joint_name(chain, k)
        parent = ET.SubElement(parent, "body", {"name": f"{name}_body", **pose_attributes(body_poses[number])})
        if bodies[number].any():
            mass, centre, (xx, xy, xz, yy, yz, zz) = centred(bodies[number])
            full = numbers_text(np.array([xx, yy, zz, xy, xz, yz]))
            ET.SubElement(parent, "inertial", pos=numbers_text(centre), mass=repr(mass), fullinertia=full)
        axis = numbers_text(element.sign * np.eye(3)[AXES.index(element.axis) % 3])
        kind = "slide" if element.axis[0] == "t" else "hinge"
        joint = ET.SubElement(parent, "joint", name=name, type=kind, axis=axis)
        mover = element.joint or 0
        leader = chain.joints[mover]
        if k in main_elements:
            for key, values in (("armature", armature), ("damping", damping), ("frictionloss", friction)):
                joint.set(key, repr(float(values[mover])))
            if np.isfinite([leader.lower, leader.upper]).all():
                joint.set("range", f"{leader.lower!r} {leader.upper!r}")
        else:
            ratio = f"0 {element.ratio!r} 0 0 0"
            ET.SubElement(ties, "joint", joint1=name, joint2=leader.name, polycoef=ratio)
        if np.linalg.norm(ends[number]) > 1e-3:
            shape = {"type": "capsule", "fromto": f"0 0 0 {numbers_text(ends[number])}", "size": "0.03"}
            ET.SubElement(parent, "geom", shape, contype="0", conaffinity="0", rgba="0.6 0.6 0.6 1")
    ET.SubElement(parent, "site", {"name": f"{chain.tip}_tip", **pose_attributes(chain.tail)})
    if len(ties):
        root.append(ties)
    return xml_text(root)


def joint_name(chain: Chain, k: int) -> str:
    """Return the MJCF name of the joint that moves element k: the chain joint's name, or that of a mimic follower."""
    element = chain.elements[k]
    main = k in chain.moving.tolist()
    return chain.joints[element.joint or 0].name if main else element.name.removesuffix(".offset")


def pose_attributes(frame: np.ndarray) -> dict[str, str]:
    x, y, z, w = Rotation.from_matrix(frame[:3, :3]).as_quat()
    return {"pos": numbers_text(frame[:3, 3]), "quat": numbers_text(np.array([w, x, y, z]))}


def tip_poses(source: str, chain: Chain, q: np.ndarray) -> np.ndarray:
    """Return the tip's poses (m, 4, 4) in the base frame that Pinocchio computes from a URDF text.

    Args:
        source: URDF text.
        chain: the chain that `calib.robot.formats.urdf` read from the text; its joints are the columns of q.
        q: (m, n) joint values [rad or m].

    Raises:
        RobotError: Pinocchio cannot read the text.
    """
    pin = import_module("pinocchio")
    model = pinocchio_model(source)
    data = model.createData()
    base, tip = link_frame(model, chain.base), link_frame(model, chain.tip)
    result = np.empty((len(q), 4, 4))
    for pose, configuration in zip(result, configurations(model, chain, q), strict=True):
        pin.framesForwardKinematics(model, data, configuration)
        pose[:] = (data.oMf[base].inverse() * data.oMf[tip]).homogeneous
    return result


def link_frame(model: NativeModel, link: str) -> int:
    """Return the index of the frame of the link named `link` in Pinocchio's model; a joint of this name is ignored."""
    pin = import_module("pinocchio")
    return model.getFrameId(link, pin.FrameType.BODY)


def driven_joints(model: NativeModel, chain: Chain) -> list[NativeModel]:
    """Return Pinocchio's joints for the moving elements of a chain, including mimic followers.

    Args:
        model: Pinocchio's model of the same robot.
        chain: the arm.
    """
    return [model.joints[model.getJointId(joint_name(chain, k))] for k in chain.driven.tolist()]


def configurations(model: NativeModel, chain: Chain, q: np.ndarray, from_zero: bool = False) -> np.ndarray:
    """Return Pinocchio's configurations (m, nq) at joint values q (m, n); continuous joints have cosine and sine.

    Args:
        model: Pinocchio's model.
        chain: the arm.
        q: joint values [rad or m].
        from_zero: whether the model's frames at zero already include the chain's constant values.
    """
    pin = import_module("pinocchio")
    result = np.tile(pin.neutral(model), (len(q), 1))
    for k, joint in zip(chain.driven, driven_joints(model, chain)):
        element = chain.elements[k]
        constant = 0.0 if from_zero else element.value
        value = element.ratio * q[:, element.joint] + constant
        values = [value] if joint.nq == 1 else [np.cos(value), np.sin(value)]
        result[:, joint.idx_q : joint.idx_q + joint.nq] = np.stack(values, axis=1)
    return result


def motion_torques(
    source: str, chain: Chain, q: np.ndarray, v: np.ndarray, a: np.ndarray, mjcf: bool = False
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return torques, body frames, damping and friction that Pinocchio computes from a robot's URDF or MJCF text.

    Args:
        source: URDF or MJCF text.
        chain: the arm, for joints, gravity (in the root's frame) and mimic ratios; all other joints are fixed at zero.
        q, v, a: (m, n) joint positions, velocities and accelerations [rad or m, per s, per s²].
        mjcf: whether the text is MJCF, in which the frames at q = 0 already include the chain's constant values.

    Returns:
        Torques (m, n) of `rnea`, armature included; frames (moving, m, 4, 4) of the bodies after the moving elements;
        damping and friction (n,).

    Raises:
        RobotError: Pinocchio cannot read the text.
    """
    pin = import_module("pinocchio")
    model = pinocchio_model(source, mjcf)
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
    rows = [joints[number].idx_v for number in np.searchsorted(chain.driven, chain.moving)]
    return torques, frames, model.damping[rows], model.friction[rows]


def pinocchio_model(source: str, mjcf: bool = False) -> NativeModel:
    """Return Pinocchio's model of a URDF or MJCF text; MJCF is written to a temporary file first.

    Args:
        source: URDF or MJCF text.
        mjcf: whether the text is MJCF.

    Raises:
        RobotError: Pinocchio cannot read the text.
    """
    pin = import_module("pinocchio")
    file_format = "MJCF" if mjcf else "URDF"
    with refused_as(RobotError, (ValueError, RuntimeError), f"Pinocchio cannot read the {file_format}: {{}}"):
        if not mjcf:
            return pin.buildModelFromXML(source)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "model.xml"
            with refused_as(RobotError, OSError, f"cannot write {path}: {{}}"):
                path.write_text(source, encoding="utf-8")
            return pin.buildModelFromMJCF(str(path))


def link_poses(source: str, links: Sequence[str], base: str, joints: Sequence[str], q: np.ndarray) -> np.ndarray:
    """Return the poses (links, m, 4, 4) of links in the link `base` that yourdfpy computes from a URDF text.

    Args:
        source: URDF text; meshes are ignored.
        links, base: names of links.
        joints: names of the joints in the columns of q. Other joints are zero, and mimic followers follow their
            leaders.
        q: (m, n) joint values [rad or m].

    Raises:
        RobotError: yourdfpy cannot read the text.
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
