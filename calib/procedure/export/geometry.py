"""Export of the calibrated geometry: an edited URDF, joint offsets, and joint origins as YAML.

The YAML files are the kinematics file of ur_description in UR's own frames, and tesseract's calibration file. Both are
nested mappings in block style, which every reader takes, in YAML 1.1 and 1.2 alike. A number always has a point, since
YAML 1.1 takes 1e-05 for text; a key that could be read as something else is quoted.
"""

import hashlib
import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from calib import files
from calib.errors import RobotError, UsageError, refuse_robot, refused_as
from calib.folders import files_of
from calib.procedure.dynamic_stage import folder as identification
from calib.procedure.kinematic_stage.folder import OURS, FitFolder
from calib.robot import calibrated
from calib.robot.calibrated import CalibratedChain, nominal_of
from calib.robot.chain import AXES, Chain, random_joints
from calib.robot.formats import urdf, urdf_write
from calib.robot.formats.simulators import link_poses, tip_poses
from calib.robot.formats.urdf_tree import UrdfTree, text
from calib.robot.formats.urdf_tree import read as read_tree
from calib.robot.kinematics import forward, joint_frames
from calib.transforms import invert, to_xyz_rpy

OFFSETS_HEADER = ("joint", "unit", "add_to_reading", "add_to_command", "sigma")
MAX_DIFFERENCE = 1e-9  # of poses read back [m, and as a rotation matrix], and of torques over the largest


class NoSuchArm(UsageError):
    """Error for an arm of a kind that a file format does not support."""


def read(folder: Path) -> CalibratedChain:
    """Read the calibrated robot from the folder of a fit.

    Raises:
        UsageError: where it is none, or does not say what it was calibrated from.
    """
    if not FitFolder(folder).robot.is_file():
        raise UsageError(f"{folder} contains no robot.toml; give the folder written by `calib fit --out`")
    robot = calibrated.read(folder)
    if robot.nominal is None:
        raise UsageError(f"{folder}/robot.toml does not say which nominal robot it was calibrated from; fit again")
    return robot


def results(folder: Path) -> list[Path]:
    """Return the essential files of a fit's or an identification's folder, which no export may replace."""
    return [folder / name for name in files_of(folder, (*OURS, *identification.OURS))]


def edited_urdf(robot: CalibratedChain, source: Path, for_corrections: bool = False) -> tuple[bytes, str]:
    """Return the XML of `source` with the calibrated geometry, and a sentence on the programs that verified it.

    Only the origins of the arm's joints change. The base link stays where the nominal robot has its base, and the fixed
    joints behind the last moving one stay as they are: the choice of base and flange is the source's.

    Args:
        robot: the calibrated robot.
        source: a URDF of the nominal robot.
        for_corrections: take the geometry that the joint corrections belong to, which is worse without them.
    """
    chain = robot.complete if for_corrections else robot.chain
    content, encoding = text(source)
    edited = urdf_write.edit(content, nominal_of(robot), chain, str(source))
    return edited.encode(encoding), check_readback(edited, str(source), chain)


def chain_in(tree: UrdfTree, chain: Chain, base: str | None = None) -> Chain:
    """Return the chain of a URDF with another chain's joints and tip, if the URDF has these names."""
    named = chain.joint_names if chain.joint_names[0] in tree.joints else None
    return urdf.build(tree, *urdf.ends(tree, base, chain.tip if chain.tip in tree.bodies else None, named))


def check_readback(edited: str, where: str, chain: Chain) -> str:
    """Refuse a URDF text with other poses in Pinocchio or yourdfpy than in this toolkit (`MAX_DIFFERENCE`).

    Returns:
        The programs that have read it. A text that yourdfpy cannot read is accepted, and the reason is stated.
    """
    tree = read_tree(edited, where)
    own = chain_in(tree, chain)
    q = random_joints(own, 20, 0)
    error = float(np.abs(tip_poses(edited, own, q) - forward(own, q)).max())
    if error > MAX_DIFFERENCE:
        raise RobotError(f"{where}: poses differ by {error:.2g} when Pinocchio reads the URDF; nothing was written")
    few = q[:5]
    try:
        seen = link_poses(edited, (*own.links, own.tip), own.base, own.joint_names, few)
    except RobotError as error:
        return f"Pinocchio reads the same poses to 1e-9; not read a second time: {error}"
    straight = np.stack([invert(urdf.align(tree.above[link].axis)) for link in own.links])[:, None]  # of slanted axes
    error = float(np.abs(seen - np.concatenate([joint_frames(own, few) @ straight, forward(own, few)[None]])).max())
    if error > MAX_DIFFERENCE:
        raise RobotError(f"{where}: poses differ by {error:.2g} when yourdfpy reads the URDF; nothing was written")
    return "Pinocchio and yourdfpy read the same poses to 1e-9"


def export_offsets(robot: CalibratedChain, out: Path) -> Path:
    """Write the offset of each joint: to add to what the controller reads, and with the other sign to commands.

    Calibrated minus nominal: a joint that reads q stands at q + offset in the nominal robot's terms.
    Where the fit has joint corrections, offsets and their sigmas are those of the best geometry without them: for
    whoever does not apply them.
    """
    nominal, sigma = nominal_of(robot), np.full(len(robot.chain.elements), np.nan)
    if robot.covariance is not None:
        sigma = np.sqrt(np.diag(robot.covariance))
    rows = []
    for joint, k in zip(robot.chain.joints, robot.chain.moving):
        element, before = robot.chain.elements[k], nominal.elements[k]
        offset = (element.value - before.value) / element.ratio
        rows.append((joint.name, joint.unit, offset, 0.0 - offset, float(sigma[k]) if sigma[k] > 0.0 else None))
    return files.write_table(out, OFFSETS_HEADER, rows)


def ur_kinematics(robot: CalibratedChain) -> str:
    """Return the kinematics YAML for ur_description: x y z roll pitch yaw of the six joint origins [m, rad].

    The frames are UR's own (base_link_inertia, then each joint about its z). They follow from the nominal arm's axes,
    so that only the calibrated part of the numbers is new. ur_description puts its tool0 where wrist_3 is: fixed joints
    of the robot's file behind it (a flange, a tool) are not part of it, see `flange_note`.

    Raises:
        NoSuchArm: for an arm that has not UR's axes.
    """
    with refused_as(NoSuchArm, RobotError, f"'{robot.chain.name}' does not have the axes of a UR arm: {{}}"):
        source = _template(nominal_of(robot))
        edited = read_tree(urdf_write.edit(source, nominal_of(robot), robot.chain, "UR frames"), "UR frames")
    places = {link: to_xyz_rpy(edited.joints[link].origin) for link in LINKS}
    origins = {link: dict(zip(KEYS, [*xyz.tolist(), *rpy.tolist()])) for link, (xyz, rpy) in places.items()}
    digest = int(hashlib.sha256(block(origins, "  ").rstrip().encode()).hexdigest()[:15], 16)
    return HEAD + block({"kinematics": {**origins, "hash": f"calib_{digest}"}})


def flange_note(robot: CalibratedChain) -> str:
    """Return a remark on where UR's flange is assumed, if a fixed joint follows the last joint."""
    nominal = nominal_of(robot)
    zero = np.zeros((1, nominal.n))
    behind = invert(joint_frames(nominal, zero)[-1, 0]) @ forward(nominal, zero)[0]
    if np.abs(behind - np.eye(4)).max() < ON_AXIS:
        return ""
    away = f"{nominal.tip}, {1e3 * float(np.linalg.norm(behind[:3, 3])):.4g} mm behind the last joint's frame"
    if wrist_offset(nominal) > ON_AXIS:
        return f"wrist_3 is the last joint's frame, like UR's tool0; it excludes the fixed joint to {away}"
    return f"wrist_3 includes {away}, as UR's d6; this must be UR's flange without a tool"


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


def wrist_offset(nominal: Chain) -> float:
    """Return the distance of the last joint's frame from axis 5 at q = 0 [m]: UR's d6, or 0 in old URDFs."""
    frames = joint_frames(nominal, np.zeros((1, nominal.n)))[:, 0]
    across = _axis(nominal, frames[1], int(nominal.moving[1]))
    return abs(float(across @ (frames[5, :3, 3] - frames[4, :3, 3])))


def _template(nominal: Chain) -> str:
    """Return a URDF of a nominal arm in UR's frames, with the six lengths of the arm's axes at q = 0.

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
    before, after = read_tree(source, where), read_tree(edited, where)
    moved = {}
    max_difference = 1e-9  # of a rotation matrix, to be one
    for name, joint in after.joints.items():
        if np.array_equal(joint.origin, before.joints[name].origin):
            continue
        turn = Rotation.from_matrix(joint.origin[:3, :3]).as_quat()
        if np.abs(Rotation.from_quat(turn).as_matrix() - joint.origin[:3, :3]).max() > max_difference:
            refuse_robot(where, f"the rotation part of joint '{name}' is not a rotation matrix")
        moved[name] = {
            "position": dict(zip("xyz", joint.origin[:3, 3].tolist())),
            "orientation": dict(zip("xyzw", turn.tolist())),
        }
    head = "# For <calibration_config filename=.../> in the SRDF of the nominal robot; m, unit quaternions.\n"
    return head + block({"calibration": {"joints": moved}})
