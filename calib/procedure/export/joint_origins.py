"""Joint origins as YAML, for tesseract's calibration file and for ur_description's kinematics file.

Nested mappings are written in block style, which readers of YAML 1.1 and 1.2 understand. Numbers always have a decimal
point, since YAML 1.1 reads 1e-05 as text. Keys that could be read as another type are quoted.
"""

import json
import re
from collections.abc import Mapping
from typing import cast

import numpy as np
from scipy.spatial.transform import Rotation

from calib.errors import refuse_robot
from calib.robot.formats.urdf_tree import read as read_tree

_PLAIN = re.compile(r"[A-Za-z_][\w./-]*", re.ASCII)
_WORDS = {"yes", "no", "on", "off", "true", "false", "null"}  # no texts in YAML 1.1, in any case


def block(value: Mapping[str, object], indent: str = "") -> str:
    """Return the YAML text of a nested mapping in block style.

    Args:
        value: mapping from texts to mappings, texts and finite floats.
        indent: blanks at the beginning of each line.
    """
    lines = []
    for key, item in value.items():
        head = f"{indent}{_text(key)}:"
        if isinstance(item, Mapping) and item:
            lines.append(f"{head}\n{block(item, indent + '  ')}")
        else:
            lines.append(f"{head} {'{}' if isinstance(item, Mapping) else _scalar(item)}\n")
    return "".join(lines)


def _scalar(value: object) -> str:
    if isinstance(value, str):
        return _text(value)
    digits, e, exponent = repr(float(cast(float, value))).partition("e")
    return digits + ("" if "." in digits else ".0") + e + exponent


def _text(value: str) -> str:
    plain = _PLAIN.fullmatch(value) and value.lower() not in _WORDS
    return value if plain else json.dumps(value)


def joint_origins(source: str, edited: str, where: str) -> str:
    """Return a YAML text with the origins of all joints whose origins differ between two URDF texts.

    Args:
        source, edited: texts of the nominal robot's URDF, and of the calibrated robot's URDF with the same joints.
        where: name of the file for messages.

    Raises:
        RobotError: for an origin whose orientation is not a rotation matrix.
    """
    before, after = read_tree(source, where), read_tree(edited, where)
    moved = {}
    max_difference = 1e-9  # of a rotation matrix, to be one
    for name, joint in after.joints.items():
        if np.array_equal(joint.origin, before.joints[name].origin):
            continue
        turn = Rotation.from_matrix(joint.origin[:3, :3]).as_quat()
        if np.abs(Rotation.from_quat(turn).as_matrix() - joint.origin[:3, :3]).max() > max_difference:
            refuse_robot(where, f"the rotation part of joint '{name}' is not a rotation matrix: correct its origin")
        moved[name] = {
            "position": dict(zip("xyz", joint.origin[:3, 3].tolist())),
            "orientation": dict(zip("xyzw", turn.tolist())),
        }
    head = "# For <calibration_config filename=.../> in the SRDF of the nominal robot; m, unit quaternions.\n"
    return head + block({"calibration": {"joints": moved}})
