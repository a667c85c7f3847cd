"""Export of a calibrated Universal Robots arm: the kinematics file of ur_description, in UR's frames.

The file is a nested mapping in block style (`calib.procedure.export.joint_origins.block`).
"""

import hashlib
from pathlib import Path

import numpy as np

from calib.errors import RobotError, refused_as
from calib.procedure.export.geometry import NoSuchArm
from calib.procedure.export.joint_origins import block
from calib.robot.calibrated import CalibratedChain, nominal_of
from calib.robot.chain import AXES, Chain
from calib.robot.formats import urdf_write
from calib.robot.formats.urdf_tree import read as read_tree
from calib.robot.formats.urdf_tree import text
from calib.robot.kinematics import forward, joint_frames
from calib.transforms import invert, to_xyz_rpy
from calib.transforms import pose as pose_of

ON_AXIS = 1e-3  # [m]
INERTIA = "base_link_inertia"
KEYS = ("x", "y", "z", "roll", "pitch", "yaw")
LINKS = ("shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3")
HEAD = """\
# Calibrated by armature-calib; for ur_description's kinematics_params_file. The driver compares the hash
# with the controller's own calibration and will say that they differ: this file is not the controller's.
"""


def kinematics(robot: CalibratedChain, urdf: Path | None = None) -> tuple[str, str]:
    """Return the text of a kinematics file for ur_description, and a remark for the user (empty: none).

    The file states x, y, z, roll, pitch, yaw of six joint origins [m, rad]. The frames are UR's (base_link_inertia,
    then one frame per joint with z as the joint's axis). They follow from the nominal arm's axes, so that the numbers
    differ from UR's nominal numbers only by the calibration. ur_description places tool0 at wrist_3. Fixed joints after
    wrist_3 in the robot's file (a flange, a tool) are not included, which the remark states.

    Args:
        robot: the calibrated robot, with any base and tip links.
        urdf: URDF of the robot, from which the pose of ``base_link_inertia`` is read; None, or without this link: the
            pose follows from the axes.

    Raises:
        NoSuchArm: for an arm without the axes of a UR arm.
    """
    with refused_as(NoSuchArm, RobotError, f"'{robot.chain.name}' does not have the axes of a UR arm: {{}}"):
        source = _template(nominal_of(robot), urdf)
        edited = read_tree(urdf_write.edit(source, nominal_of(robot), robot.chain, "UR frames"), "UR frames")
    places = {link: to_xyz_rpy(edited.joints[link].origin) for link in LINKS}
    origins = {link: dict(zip(KEYS, [*xyz.tolist(), *rpy.tolist()])) for link, (xyz, rpy) in places.items()}
    digest = int(hashlib.sha256(block(origins, "  ").rstrip().encode()).hexdigest()[:15], 16)
    return HEAD + block({"kinematics": {**origins, "hash": f"calib_{digest}"}}), _flange_note(robot)


def _flange_note(robot: CalibratedChain) -> str:
    """Return a remark on the assumed position of UR's flange if a fixed joint follows the last joint; else empty.

    Args:
        robot: the calibrated robot.
    """
    nominal = nominal_of(robot)
    zero = np.zeros((1, nominal.n))
    behind = invert(joint_frames(nominal, zero)[-1, 0]) @ forward(nominal, zero)[0]
    if np.abs(behind - np.eye(4)).max() < ON_AXIS:
        return ""
    away = f"{nominal.tip}, {1e3 * float(np.linalg.norm(behind[:3, 3])):.4g} mm behind the last joint's frame"
    if _wrist_offset(nominal) > ON_AXIS:
        return f"wrist_3 is the last joint's frame, like UR's tool0; it excludes the fixed joint to {away}"
    return f"wrist_3 includes {away}, as UR's d6; this must be UR's flange without a tool"


def _wrist_offset(nominal: Chain) -> float:
    """Return the distance of the last joint's frame from axis 5 at q = 0 [m]: UR's length d6, or 0 in old URDFs.

    Args:
        nominal: the nominal arm.
    """
    frames = joint_frames(nominal, np.zeros((1, nominal.n)))[:, 0]
    across = _axis(nominal, frames[1], int(nominal.moving[1]))
    return abs(float(across @ (frames[5, :3, 3] - frames[4, :3, 3])))


def _inertia_frame(nominal: Chain, urdf: Path | None, up: np.ndarray, ahead: np.ndarray) -> np.ndarray:
    """Return the pose (4, 4) of UR's frame base_link_inertia in the arm's base frame.

    UR's descriptions have a link with this name, turned by 180° about z relative to base_link. Without such a link, z
    is along axis 1, -x is the direction in which the arm is stretched at q = 0, and the origin is that of the base.

    Args:
        nominal: the arm.
        urdf: URDF of the arm; None: no URDF.
        up, ahead: (3,) direction of axis 1, and from axis 2 to axis 3 at q = 0, in the arm's base frame.
    """
    if urdf is not None and urdf.is_file():
        tree = read_tree(text(urdf)[0], str(urdf))
        for link, pose in tree.rigid(nominal.base):
            if link.endswith(INERTIA):
                return pose
    level = ahead - up * (up @ ahead)
    if np.linalg.norm(level) < ON_AXIS:
        raise RobotError("axis 3 lies above axis 2 at q = 0, where a UR is stretched")
    x = -level / np.linalg.norm(level)
    turned = pose_of(np.stack([x, np.cross(up, x), up], axis=1))
    rounded = np.round(turned)
    return rounded if np.abs(rounded - turned).max() < ON_AXIS else turned


def _template(nominal: Chain, urdf: Path | None) -> str:
    """Return the text of a URDF of a nominal arm in UR's frames, with six lengths measured between the axes at q = 0.

    d1: height of axis 2; a2, a3: distances of axes 2 to 3 and 3 to 4; d4: distance of axis 5 from axis 1; d5: height of
    axis 4 over axis 6; d6: distance of the last joint's frame from axis 5. If this frame is on axis 5, d6 is the
    distance of the tip (early UR URDFs have d6 in the fixed joint to tool0).
    """
    if nominal.n != 6 or any(joint.kind != "revolute" for joint in nominal.joints):
        raise RobotError(f"it has {nominal.n} joints; expected six revolute joints")
    zero = np.zeros((1, 6))
    frames = joint_frames(nominal, zero)[:, 0]
    axis = np.array([_axis(nominal, frames[j], k) for j, k in enumerate(nominal.moving)])
    point, tip = frames[:, :3, 3], forward(nominal, zero)[0, :3, 3]
    up, across = axis[0], axis[1]
    level = [float(up @ (p - point[0])) for p in point]
    foot = _inertia_frame(nominal, urdf, up, point[2] - point[1])
    base_height = float(up @ (point[0] - foot[:3, 3]))
    d1 = level[1] + base_height
    a2, a3 = (_gap(point[k], point[k + 1], across) for k in (1, 2))
    d4, d6 = abs(float(across @ (point[4] - point[0]))), _wrist_offset(nominal)
    d6 = d6 if d6 > ON_AXIS else abs(float(across @ (tip - point[4])))
    d5 = abs(level[3] - level[5])
    half = repr(np.pi / 2)
    origins = {
        "shoulder": (f"0 0 {d1!r}", "0 0 0"),
        "upper_arm": ("0 0 0", f"{half} 0 0"),
        "forearm": (f"{-a2!r} 0 0", "0 0 0"),
        "wrist_1": (f"{-a3!r} 0 {d4!r}", "0 0 0"),
        "wrist_2": (f"0 {-d5!r} 0", f"{half} 0 0"),
        "wrist_3": (f"0 {d6!r} 0", f"{half} {np.pi!r} {np.pi!r}"),
    }
    xyz, rpy = (" ".join(map(repr, values.tolist())) for values in to_xyz_rpy(foot))
    lines, parent = (
        [
            f'<robot name="ur"><link name="base_link"/><link name="{INERTIA}"/><joint name="foot" type="fixed">'
            f'<parent link="base_link"/><child link="{INERTIA}"/><origin xyz="{xyz}" rpy="{rpy}"/></joint>'
        ],
        INERTIA,
    )
    for name, (xyz, rpy) in origins.items():
        lines.append(
            f'<link name="{name}_link"/><joint name="{name}" type="revolute"><parent link="{parent}"/>'
            f'<child link="{name}_link"/><origin xyz="{xyz}" rpy="{rpy}"/><axis xyz="0 0 1"/>'
            '<limit lower="-6.3" upper="6.3" effort="1" velocity="1"/></joint>'
        )
        parent = f"{name}_link"
    return "\n".join([*lines, "</robot>"])


def _axis(chain: Chain, frame: np.ndarray, k: int) -> np.ndarray:
    element = chain.elements[k]
    return element.sign * frame[:3, AXES.index(element.axis) % 3]


def _gap(one: np.ndarray, two: np.ndarray, direction: np.ndarray) -> float:
    """Return the distance [m] of two parallel lines.

    Args:
        one, two: (3,) a point on each line [m].
        direction: (3,) unit direction of the lines.
    """
    between = two - one
    return float(np.linalg.norm(between - direction * (direction @ between)))
