"""A UR controller's ``calibration.conf``, read as a robot: the geometry with which the controller itself computes.

The arm's type follows the file::

    calib fit "calibration.conf ur_type:=ur5e" measured.csv --out fit
    calib diff "calibration.conf ur_type:=ur5e" fit

The fit's report then says how well the factory's calibration meets the measurements, and `calib diff` what has moved
since. The file's ``delta_theta``, ``delta_a``, ``delta_d`` and ``delta_alpha`` are added to the nominal table of the
type (``universal_robots.toml``), T = Π Rz(q + θ) Tz(d) Tx(a) Rx(α): all values count, as is said at
forum.universal-robots.com/t/1638. Axes 2, 3 and 4 are nearly parallel, so that their d are metres that cancel
(``ur_calibration/doc/algorithm.rst`` of UR's ROS 2 driver): the frames written here are those points of the same axes
that are next to the nominal ones. Two published files become arms within 5 mm of the nominal one of their type
(UR10, forum t/18921; UR3, pyrobotlab issue 145) and 10 cm off other sizes: such a type is refused. By that a
UR10 and a UR10e are too similar to be told apart.

It is not written: a file holds ``joint_checksum``, ``joint_raw_offset`` and ``joint_selftest_data_crc`` of the robot's
joints, and no public description of how the checksums are computed was found. For ROS: calib export --ur-kinematics.
"""

import re
import tomllib
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
from scipy.spatial.transform import Rotation

from calib.config_types import number
from calib.errors import RobotError, one_of, refuse_robot, refused_as, require
from calib.files import shipped_text
from calib.robot.descriptions.xacro_arguments import split
from calib.robot.formats.urdf_tree import UNLIMITED
from calib.robot.formats.urdf_write import add_joint, xml_text
from calib.transforms import invert, pose

KEYS = ("theta", "a", "d", "alpha")
JOINTS = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
TYPE = "ur_type"
FARTHEST = 0.03  # [m] of a joint's axis from the nominal place of its joint: no factory's calibration (our choice)


def convert(path: str) -> str:
    """Return the URDF text for ``calibration.conf ur_type:=TYPE``, the file's path followed by the arm's type.

    Raises:
        RobotError: an invalid file, a missing type, or a type that contradicts the file.
    """
    file, arguments = split(path)
    table = tomllib.loads(shipped_text("calib.robot.descriptions", "universal_robots.toml"))
    message = f'{file}: state the type of the arm, in quotes: "{file} {TYPE}:=ur5e" (one of {", ".join(table)})'
    require({*arguments} == {TYPE}, message, RobotError)
    kind = one_of(arguments[TYPE], table, f"{file}: {TYPE}", RobotError)
    nominal, deltas = _nominal(**table[kind]), _deltas(file)
    frames, nominal_frames = _frames(nominal + deltas), _frames(nominal)
    axis_frames = np.array([_beside(axis, near) for axis, near in zip(frames[:6], nominal_frames)])
    deviation = float(np.linalg.norm(axis_frames[:, :3, 3] - nominal_frames[:6, :3, 3], axis=1).max())
    if deviation > FARTHEST:
        refuse_robot(file, f"the axes of a {kind} would be {1e3 * deviation:.0f} mm from nominal: is {TYPE} another?")
    root = ET.Element("robot", name=kind)
    ET.SubElement(root, "link", name="base")
    parent, previous_frame = "base", np.eye(4)
    for name, frame in zip(JOINTS, axis_frames):
        joint = add_joint(root, f"{name}_joint", "revolute", parent, f"{name}_link", invert(previous_frame) @ frame)
        ET.SubElement(root, "link", name=f"{name}_link")
        ET.SubElement(joint, "axis", xyz="0 0 1")
        turn, unlimited = repr(2.0 * np.pi), repr(UNLIMITED)
        ET.SubElement(joint, "limit", lower=f"-{turn}", upper=turn, effort=unlimited, velocity=unlimited)
        parent, previous_frame = f"{name}_link", frame
    ET.SubElement(root, "link", name="tool0")
    add_joint(root, "flange", "fixed", parent, "tool0", invert(previous_frame) @ frames[6])
    return xml_text(root)


def _nominal(a: list[float], d: list[float]) -> np.ndarray:
    """Return the nominal table (6, 4) of θ, a, d, α [rad, m] from a type's lengths a and d (6 each) [m]."""
    half = np.pi / 2
    lengths = [0.0, *a, 0.0, 0.0, 0.0], [d[0], 0.0, 0.0, *d[1:]]
    return np.column_stack([np.zeros(6), *lengths, [half, 0.0, 0.0, half, -half, 0.0]])


def _deltas(path: str) -> np.ndarray:
    """Return the corrections (6, 4) to θ, a, d, α [rad, m] in a calibration file.

    Args:
        path: the file ``calibration.conf``.
    """
    with refused_as(RobotError, (OSError, UnicodeDecodeError), f"{path}: cannot be read: {{}}"):
        content = Path(path).read_text(encoding="utf-8")
    rows = []
    for key in KEYS:
        match = re.search(rf"^\s*delta_{key}\s*=\s*\[([^\]]*)\]", content, re.M)
        values = match[1].split(",") if match else []
        message = f"{path}: is no calibration.conf of a UR: expected delta_{key} = [six numbers], found {len(values)}"
        require(len(values) == 6, message, RobotError)
        rows.append([number(value.strip(), f"{path}: delta_{key}", error=RobotError) for value in values])
    result = np.array(rows).T
    require(np.isfinite(result).all(), f"{path}: expected finite numbers", RobotError)
    return result


def _frames(table: np.ndarray) -> np.ndarray:
    """Return the frames (7, 4, 4) of the base and after each row of a table (6, 4) of θ, a, d, α, at q = 0."""
    result = [np.eye(4)]
    for theta, a, d, alpha in table:
        rotation_z, rotation_x = (Rotation.from_euler(axis, angle) for axis, angle in (("z", theta), ("x", alpha)))
        result.append(result[-1] @ pose(rotation_z, [0.0, 0.0, d]) @ pose(rotation_x, [a, 0.0, 0.0]))
    return np.array(result)


def _beside(axis: np.ndarray, nominal: np.ndarray) -> np.ndarray:
    """Return a frame (4, 4) on the z axis of the frame `axis`, at the point nearest to the origin of `nominal`.

    The frame's z axis is that of `axis`; its x axis is as near as possible to that of `nominal`.
    """
    z, start = axis[:3, 2], axis[:3, 3]
    position = start + z * (z @ (nominal[:3, 3] - start))
    x = nominal[:3, 0] - z * (z @ nominal[:3, 0])
    x = x / np.linalg.norm(x)
    result = np.eye(4)
    result[:3] = np.column_stack([x, np.cross(z, x), z, position])
    return result
