"""MJCF files (MuJoCo) of serial arms, read by MuJoCo's own compiler: ``pip install 'armature-calib[mujoco]'``.

What becomes a URDF, wherever one is taken: bodies as links, hinge and slide joints with axes, places, reference
positions and ranges, masses and inertias, damping and dry friction, effort limits of motors, sites as links without
mass. Joints that an equality ties to another one follow it. The root link is ``world``; the tip is a site that alone
ends the arm, or the last body (--tip names another).

Not taken: meshes and other shapes (links are capsules where collisions matter), armature (torques are identified with a
motor inertia of their own), gravity other than along -z. Refused: free and ball joints, loops closed by equalities,
tendons that tie joints of the arm.
"""

from importlib import import_module
from itertools import chain, combinations_with_replacement
from pathlib import Path
from types import ModuleType
from xml.etree import ElementTree as ET

import numpy as np
from scipy.spatial.transform import Rotation

from calib.errors import RobotError, refuse_robot
from calib.robot.formats.native import NativeModel
from calib.robot.formats.urdf_tree import UNLIMITED
from calib.robot.formats.urdf_write import MOMENTS, add_joint, numbers_text, xml_text
from calib.transforms import from_quaternion, invert, pose
from calib.workers.extras import lacking

WORLD = "world"


def convert(path: str) -> str:
    """Return the URDF text for an MJCF file; an ``.xml`` file that is already a URDF is returned unchanged.

    Args:
        path: the ``.xml`` file.

    Raises:
        RobotError: MuJoCo is missing or cannot read the file, or the model is not a serial arm.
    """
    text = Path(path).read_text(encoding="utf-8", errors="replace")
    if "<robot" in text and "<mujoco" not in text.partition("<robot")[0]:
        return text
    try:
        mujoco = import_module("mujoco")
    except ImportError:
        raise RobotError(f"{path}: {lacking('mujoco')}") from None
    try:
        spec = mujoco.MjSpec.from_file(path)
        model = _compiled(spec)
    except Exception as error:  # ValueError of the compiler, whatever its reader raises
        raise RobotError(f"{path}: MuJoCo cannot read it: {' '.join(str(error).split())}") from None
    return _Tree(model, mujoco, path, spec.modelname).text()


def _compiled(spec: NativeModel) -> NativeModel:
    """Return the compiled model, without meshes and textures if their files are missing.

    These files are not needed if the model contains masses.

    Args:
        spec: MuJoCo's specification of the model (``MjSpec``), parsed from the file.
    """
    try:
        return spec.compile()
    except ValueError as error:
        if not any(phrase in str(error) for phrase in ("opening file", "open file", "resource")):
            raise
    for shape in list(spec.geoms):
        if shape.meshname:
            spec.delete(shape)
    unused = (spec.meshes, spec.materials, spec.textures, spec.hfields, spec.skins, spec.keys, spec.pairs, spec.sensors)
    for element in list(chain.from_iterable(unused)):
        spec.delete(element)
    return spec.compile()


class _Tree:
    """Conversion of a compiled MuJoCo model to a URDF, body by body."""

    def __init__(self, model: NativeModel, mujoco: ModuleType, where: str, name: str) -> None:
        self.model, self.mj, self.where = model, mujoco, where
        self.bodies = [WORLD, *(model.body(k).name or f"body_{k}" for k in range(1, model.nbody))]
        self.joints = [model.joint(k).name or f"joint_{k}" for k in range(model.njnt)]
        self.root = ET.Element("robot", name=name or Path(where).stem)
        self.efforts, self.leaders = self._efforts(), self._leaders()

    def text(self) -> str:
        ET.SubElement(self.root, "link", name=WORLD)
        for k in range(1, self.model.nbody):
            self._add_body(k)
        for k in range(self.model.nsite):
            name = self.model.site(k).name
            if not name:
                continue
            if name in self.bodies:
                name = f"{name}_site"
            body = self.bodies[self.model.site_bodyid[k]]
            T_body_site = _pose(self.model.site_pos[k], self.model.site_quat[k])
            ET.SubElement(self.root, "link", name=name)
            add_joint(self.root, f"{name}_fixed", "fixed", body, name, T_body_site)
        return xml_text(self.root)

    def _add_body(self, k: int) -> None:
        """Add body k to the URDF: its joints, in the order in which MuJoCo applies them, and its link.

        The link has the body's frame. With several joints, T = T_body · Π Trans(pos) exp(axis (q - ref)) Trans(-pos)
        (MuJoCo documentation, "Computation", kinematic tree). Each joint but the last is followed by a link without
        mass.
        """
        model, name = self.model, self.bodies[k]
        parent, placed = self.bodies[model.body_parentid[k]], _pose(model.body_pos[k], model.body_quat[k])
        first, count = int(model.body_jntadr[k]), int(model.body_jntnum[k])
        for j in range(first, first + count):
            shift = pose(position=model.jnt_pos[j])
            last = j == first + count - 1 and not model.jnt_pos[j].any()
            child = name if last else f"{name}_{self.joints[j]}"
            if not last:
                ET.SubElement(self.root, "link", name=child)
            self._add_joint(j, parent, child, placed @ shift)
            parent, placed = child, invert(shift)
        if parent != name:
            add_joint(self.root, f"{name}_fixed", "fixed", parent, name, placed)
        link = ET.SubElement(self.root, "link", name=name)
        T_link_inertia = _pose(model.body_ipos[k], model.body_iquat[k])
        inertial = ET.SubElement(link, "inertial")
        ET.SubElement(inertial, "origin", xyz=numbers_text(T_link_inertia[:3, 3]), rpy="0 0 0")
        ET.SubElement(inertial, "mass", value=repr(float(model.body_mass[k])))
        rotation = T_link_inertia[:3, :3]
        inertia = (rotation * model.body_inertia[k]) @ rotation.T
        attributes: dict[str, str] = {}
        for key, (a, b) in zip(MOMENTS, combinations_with_replacement(range(3), 2)):
            attributes[key] = repr(float(inertia[a, b]))
        ET.SubElement(inertial, "inertia", attributes)

    def _add_joint(self, j: int, parent: str, child: str, placed: np.ndarray) -> None:
        model, name, kinds = self.model, self.joints[j], self.mj.mjtJoint
        kind = kinds(int(model.jnt_type[j]))
        if kind not in (kinds.mjJNT_HINGE, kinds.mjJNT_SLIDE):
            free_or_ball = "free" if kind == kinds.mjJNT_FREE else "ball"
            advice = "an arm has hinges and slides only; give the robot's own file, not a scene with it"
            refuse_robot(self.where, f"body '{self.bodies[model.jnt_bodyid[j]]}' has a {free_or_ball} joint; {advice}")
        slides = kind == kinds.mjJNT_SLIDE
        limited = bool(model.jnt_limited[j])
        axis = model.jnt_axis[j]
        # Back from the reference position, at which MuJoCo's frames stand.
        displacement = -model.qpos0[model.jnt_qposadr[j]] * axis
        if slides:
            urdf_kind = "prismatic"
            motion = pose(position=displacement)
        else:
            urdf_kind = "revolute" if limited else "continuous"
            motion = pose(Rotation.from_rotvec(displacement))
        joint = add_joint(self.root, name, urdf_kind, parent, child, placed @ motion)
        ET.SubElement(joint, "axis", xyz=numbers_text(axis))
        limits = {"effort": repr(self.efforts.get(j, UNLIMITED)), "velocity": repr(UNLIMITED)}
        if limited or slides:
            low, high = model.jnt_range[j] if limited else (-UNLIMITED, UNLIMITED)
            limits |= {"lower": repr(float(low)), "upper": repr(float(high))}
        ET.SubElement(joint, "limit", limits)
        dof = model.jnt_dofadr[j]
        damping = repr(float(model.dof_damping[dof]))
        friction = repr(float(model.dof_frictionloss[dof]))
        ET.SubElement(joint, "dynamics", damping=damping, friction=friction)
        if j in self.leaders:
            ET.SubElement(joint, "mimic", self.leaders[j])

    def _efforts(self) -> dict[int, float]:
        """Return the largest force or torque of each joint's actuators that have a limit [N m or N], by joint index."""
        model = self.model
        efforts = {}
        for k in range(model.nu):
            if model.actuator_trntype[k] == int(self.mj.mjtTrn.mjTRN_JOINT) and model.actuator_forcelimited[k]:
                effort = np.abs(model.actuator_forcerange[k]).max() * abs(model.actuator_gear[k, 0])
                efforts[int(model.actuator_trnid[k, 0])] = float(effort)
        return efforts

    def _leaders(self) -> dict[int, dict[str, str]]:
        """Return the attributes of <mimic> for each joint that an equality couples to another joint, by joint index.

        Raises:
            RobotError: an equality that closes a loop.
        """
        model = self.model
        mimics: dict[int, dict[str, str]] = {}
        tied: set[int] = set()
        for k in range(model.neq):
            name = model.equality(k).name or f"number {k + 1}"
            follower, leader = int(model.eq_obj1id[k]), int(model.eq_obj2id[k])
            if model.eq_type[k] != int(self.mj.mjtEq.mjEQ_JOINT) or leader < 0:
                refuse_robot(self.where, f"equality '{name}' closes a loop; describe such a robot as a parallel one")
            offset, ratio, *higher = model.eq_data[k, :5]
            if any(higher):
                refuse_robot(self.where, f"equality '{name}' of '{self.joints[follower]}' is not linear; edit polycoef")
            follower_reference = model.qpos0[model.jnt_qposadr[follower]]
            leader_reference = model.qpos0[model.jnt_qposadr[leader]]
            urdf_offset = repr(float(follower_reference + offset - ratio * leader_reference))
            mimics[follower] = {"joint": self.joints[leader], "multiplier": repr(float(ratio)), "offset": urdf_offset}
            tied |= {follower, leader}
        for k in range(model.nwrap):
            if model.wrap_type[k] != int(self.mj.mjtWrap.mjWRAP_JOINT) or int(model.wrap_objid[k]) not in tied:
                refuse_robot(self.where, "a tendon moves joints of the arm, which is not supported; remove the tendon")
        return mimics


def _pose(position: np.ndarray, quaternion: np.ndarray) -> np.ndarray:
    """Return the pose (4, 4) for MuJoCo's position (3,) and quaternion (4,) w x y z."""
    return from_quaternion(position, np.roll(quaternion, -1))
