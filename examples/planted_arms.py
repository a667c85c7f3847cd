"""Serial arms out of URDF files, with planted errors, posed by readers that share no code with the toolkit."""

import io
import re
import warnings
import xml.etree.ElementTree as ET
from dataclasses import dataclass

import numpy as np
import pinocchio as pin
import yourdfpy
from scipy.spatial.transform import Rotation

POSITION_ERROR = 0.5e-3  # of a joint origin along each axis, σ [m]
ANGLE_ERROR = 1e-3  # of a joint origin about each axis, σ [rad]
FLANGES = ("tool0", "flange")  # ends of link names: where a target hangs, the first that exists


@dataclass(frozen=True)
class Arm:
    """A serial arm in a URDF, from its base to the link that carries the target."""

    text: str
    base: str
    tip: str

    @property
    def path(self) -> list[ET.Element]:
        """Return the joints between base and tip, from the base on."""
        joint_above = {}
        for joint in ET.fromstring(self.text).findall("joint"):
            joint_above[attribute(joint, "child", "link")] = joint
        joints = []
        link = self.tip
        while link != self.base and link in joint_above:
            joint = joint_above[link]
            joints.append(joint)
            link = attribute(joint, "parent", "link")
        return joints[::-1]

    @property
    def movable(self) -> list[ET.Element]:
        """Return the joints that are read: neither fixed nor mimicking."""
        return [joint for joint in self.path if joint.get("type") != "fixed" and joint.find("mimic") is None]

    @property
    def names(self) -> list[str]:
        return [joint.get("name", "") for joint in self.movable]

    def postures(self, count: int, rng: np.random.Generator) -> np.ndarray:
        """Draw joint values (count, n) [rad or m] within the limits; of continuous joints within half a turn."""
        ranges = np.reshape([limits(joint) for joint in self.movable], (-1, 2))
        return rng.uniform(ranges[:, 0], ranges[:, 1], (count, len(ranges)))

    def with_errors(self, rng: np.random.Generator) -> "Arm":
        """Return the arm whose joint origins are moved along and about their axes."""
        root = ET.fromstring(self.text)
        moving = {joint.get("name") for joint in self.path if joint.get("type") != "fixed"}
        for joint in root.findall("joint"):
            if joint.get("name") in moving:
                move_origin(joint, rng.normal(0.0, POSITION_ERROR, 3), rng.normal(0.0, ANGLE_ERROR, 3))
        return Arm(ET.tostring(root, encoding="unicode"), self.base, self.tip)

    def positions(self, q: np.ndarray, point: np.ndarray) -> np.ndarray:
        """Return where a point of the tip [m] stands in the base frame, (m, 3) [m], at joint values q (m, n)."""
        try:
            poses = pinocchio_poses(self, q)
        except (RuntimeError, ValueError):
            poses = yourdfpy_poses(self, q)
        return poses[:, :3, :3] @ point + poses[:, :3, 3]


def attribute(joint: ET.Element, tag: str, name: str, default: str = "") -> str:
    """Return an attribute of a tag below a joint."""
    element = joint.find(tag)
    return default if element is None else element.get(name, default)


def limits(joint: ET.Element) -> tuple[float, float]:
    """Return the limits of a joint [rad or m]; of a continuous one half a turn."""
    if joint.get("type") == "continuous":
        return -np.pi, np.pi
    return float(attribute(joint, "limit", "lower", "0")), float(attribute(joint, "limit", "upper", "0"))


def move_origin(joint: ET.Element, shift: np.ndarray, turn: np.ndarray) -> None:
    """Move a joint's origin by a translation [m] in the parent's frame and a rotation vector [rad] in its frame."""
    origin = joint.find("origin")
    if origin is None:
        origin = ET.SubElement(joint, "origin")
    xyz = np.array(origin.get("xyz", "0 0 0").split(), dtype=float)
    rpy = np.array(origin.get("rpy", "0 0 0").split(), dtype=float)
    turned = Rotation.from_euler("xyz", rpy) * Rotation.from_rotvec(turn)
    origin.set("xyz", numbers(xyz + shift))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # pitch of a quarter turn: one of its many triples will do
        origin.set("rpy", numbers(turned.as_euler("xyz")))


def numbers(values: np.ndarray) -> str:
    """Return values as an attribute, all their digits."""
    return " ".join(repr(value) for value in values.tolist())


def set_joint(configuration: np.ndarray, joint: pin.JointModel, value: float) -> None:
    """Set a joint's value [rad or m] in a configuration of Pinocchio, which has cosine and sine of continuous ones."""
    entry = [value]
    if joint.nq == 2:
        entry = [np.cos(value), np.sin(value)]
    configuration[joint.idx_q : joint.idx_q + joint.nq] = entry


def pinocchio_model(arm: Arm) -> pin.Model:
    """Return Pinocchio's model of a description, in which mimic joints follow."""
    return pin.buildModelFromXML(re.sub(r"<\?xml[^>]*\?>", "", arm.text), True)


def pinocchio_poses(arm: Arm, q: np.ndarray) -> np.ndarray:
    """Return the poses (m, 4, 4) of the tip in the base frame after Pinocchio; joints outside the arm at zero."""
    model = pinocchio_model(arm)
    data = model.createData()
    base = model.getFrameId(arm.base, pin.FrameType.BODY)
    tip = model.getFrameId(arm.tip, pin.FrameType.BODY)
    if max(base, tip) >= model.nframes:
        raise ValueError(f"Pinocchio finds no link {arm.base} or {arm.tip}")
    joints = [model.joints[model.getJointId(name)] for name in arm.names]
    poses = np.empty((len(q), 4, 4))
    for k, values in enumerate(q):
        configuration = pin.neutral(model)
        for joint, value in zip(joints, values, strict=True):
            set_joint(configuration, joint, value)
        pin.framesForwardKinematics(model, data, configuration)
        poses[k] = data.oMf[base].actInv(data.oMf[tip]).homogeneous
    return poses


def yourdfpy_poses(arm: Arm, q: np.ndarray) -> np.ndarray:
    """Return the poses (m, 4, 4) of the tip in the base frame after yourdfpy; joints outside the arm at zero."""
    robot = yourdfpy.URDF.load(io.BytesIO(arm.text.encode()), load_meshes=False, build_collision_scene_graph=False)
    poses = np.empty((len(q), 4, 4))
    for k, values in enumerate(q):
        robot.update_cfg(dict(zip(arm.names, values, strict=True)))
        poses[k] = robot.get_transform(arm.tip, arm.base)
    return poses


def target_link(text: str, base: str, tip: str) -> str:
    """Return the link that carries the target: `tool0`, else `flange`, on the arm from base to tip, else the tip.

    Of several, as of a `tool0` below the wrist, the one behind most joints.
    """
    arm_joints = Arm(text, base, tip).names
    links = [link.get("name", "") for link in ET.fromstring(text).findall("link")]
    for ending in FLANGES:
        joints_before: dict[str, int] = {}
        for link in links:
            names = Arm(text, base, link).names
            if link.endswith(ending) and names and names == arm_joints[: len(names)]:
                joints_before[link] = len(names)
        if joints_before:
            return max(joints_before, key=joints_before.__getitem__)
    return tip
