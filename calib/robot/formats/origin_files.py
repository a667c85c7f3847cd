"""Joint origins as YAML: the kinematics file of ur_description in UR's own frames, and tesseract's calibration file.

Both are nested mappings in block style, which every reader takes, in YAML 1.1 and 1.2 alike. A number always has a
point, since YAML 1.1 takes 1e-05 for text; a key that could be read as something else is quoted.
"""

import hashlib
import json
import re
from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from calib.errors import RobotError, refuse_robot
from calib.robot.chain import AXES, Chain
from calib.robot.formats import urdf_write
from calib.robot.formats.urdf_tree import read
from calib.robot.kinematics import forward, joint_frames
from calib.transforms import to_xyz_rpy

_PLAIN = re.compile(r"[A-Za-z_][\w./-]*", re.ASCII)
_WORDS = {"yes", "no", "on", "off", "true", "false", "null"}  # no texts in YAML 1.1, in any case


def block(value: Mapping[str, Any], indent: str = "") -> str:
    """Return the YAML lines of a mapping from texts to mappings, texts and finite floats."""
    lines = []
    for key, item in value.items():
        head = f"{indent}{_text(key)}:"
        if isinstance(item, Mapping) and item:
            lines.append(f"{head}\n{block(item, indent + '  ')}")
        else:
            lines.append(f"{head} {'{}' if isinstance(item, Mapping) else _scalar(item)}\n")
    return "".join(lines)


def _scalar(value: float | str) -> str:
    if isinstance(value, str):
        return _text(value)
    digits, e, exponent = repr(float(value)).partition("e")
    return digits + ("" if "." in digits else ".0") + e + exponent


def _text(value: str) -> str:
    plain = _PLAIN.fullmatch(value) and value.lower() not in _WORDS
    return value if plain else json.dumps(value)


ON_AXIS = 1e-3  # [m]
KEYS = ("x", "y", "z", "roll", "pitch", "yaw")
LINKS = ("shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3")
HEAD = """\
# Calibrated by armature-calib; for ur_description's kinematics_params_file. The driver compares the hash
# with the controller's own calibration and will say that they differ: this file is not the controller's.
"""


def kinematics(nominal: Chain, calibrated: Chain) -> str:
    """Return the kinematics YAML for ur_description: x y z roll pitch yaw of the six joint origins [m, rad].

    The frames are UR's own (base_link_inertia, then each joint about its z). They follow from the nominal arm's axes,
    so that only the calibrated part of the numbers is new.

    Raises:
        RobotError: for an arm without UR's axes.
    """
    edited = read(urdf_write.edit(_template(nominal), nominal, calibrated, "UR frames"), "UR frames")
    places = {link: to_xyz_rpy(edited.joints[link].origin) for link in LINKS}
    origins = {link: dict(zip(KEYS, [*xyz.tolist(), *rpy.tolist()])) for link, (xyz, rpy) in places.items()}
    digest = int(hashlib.sha256(block(origins, "  ").rstrip().encode()).hexdigest()[:15], 16)
    return HEAD + block({"kinematics": {**origins, "hash": f"calib_{digest}"}})


def wrist_offset(nominal: Chain) -> float:
    """Return the distance of the last joint's frame from axis 5 at q = 0 [m]: UR's d6, or 0 in old URDFs."""
    frames = joint_frames(nominal, np.zeros((1, nominal.n)))[:, 0]
    across = _axis(nominal, frames[1], int(nominal.moving[1]))
    return abs(float(across @ (frames[5, :3, 3] - frames[4, :3, 3])))


def _template(nominal: Chain) -> str:
    """Return a URDF of a nominal arm in UR's frames, its six lengths taken from the arm's axes at q = 0.

    d1 height of axis 2; a2, a3 distances of axes 2 to 3 and 3 to 4; d4 distance of axis 5 from axis 1; d5 height of
    axis 4 over axis 6; d6 distance of the last joint's frame from axis 5, or of the tip where that frame is on axis 5
    (URDFs of the years before ur_description hold d6 in the fixed joint to tool0).
    """
    if nominal.n != 6 or any(joint.kind != "revolute" for joint in nominal.joints):
        raise RobotError(f"it has {nominal.n} joints; expected six revolute joints")
    zero = np.zeros((1, 6))
    frames = joint_frames(nominal, zero)[:, 0]
    axis = np.array([_axis(nominal, frames[j], k) for j, k in enumerate(nominal.moving)])
    point, tip = frames[:, :3, 3], forward(nominal, zero)[0, :3, 3]
    up, across = axis[0], axis[1]
    level = [float(up @ (p - point[0])) for p in point]
    base_height = float(up @ point[0])
    d1 = level[1] + base_height
    a2, a3 = (_gap(point[k], point[k + 1], across) for k in (1, 2))
    d4, d6 = abs(float(across @ (point[4] - point[0]))), wrist_offset(nominal)
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
    lines, parent = ['<robot name="ur"><link name="base_link_inertia"/>'], "base_link_inertia"
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
    """Return the distance of two parallel lines [m]."""
    between = two - one
    return float(np.linalg.norm(between - direction * (direction @ between)))


def joint_origins(source: str, edited: str, where: str) -> str:
    """Return the YAML with the origins of all joints that differ between two URDF texts.

    Args:
        source, edited: the nominal robot, and the calibrated one with the same joints.
        where: names them in messages.

    Raises:
        RobotError: for an origin that is not a rotation.
    """
    before, after = read(source, where), read(edited, where)
    moved = {}
    max_difference = 1e-9  # of a rotation matrix, to be one
    for name, joint in after.joints.items():
        if np.array_equal(joint.origin, before.joints[name].origin):
            continue
        turn = Rotation.from_matrix(joint.origin[:3, :3]).as_quat()
        if np.abs(Rotation.from_quat(turn).as_matrix() - joint.origin[:3, :3]).max() > max_difference:
            refuse_robot(where, f"the origin of joint '{name}' is not a rotation")
        moved[name] = {
            "position": dict(zip("xyz", joint.origin[:3, 3].tolist())),
            "orientation": dict(zip("xyzw", turn.tolist())),
        }
    head = "# For <calibration_config filename=.../> in the SRDF of the nominal robot; m, unit quaternions.\n"
    return head + block({"calibration": {"joints": moved}})
