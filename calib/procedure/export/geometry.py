"""The calibrated geometry in the forms other programs read: a URDF in place, UR's kinematics YAML, joint offsets."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from calib import files
from calib.errors import RobotError, UsageError
from calib.procedure.kinematic_stage.folder import FitFolder
from calib.robot import calibrated
from calib.robot.calibrated import CalibratedChain, nominal_of
from calib.robot.chain import AXES, Chain, random_joints
from calib.robot.formats import urdf, urdf_write
from calib.robot.formats.markup import text
from calib.robot.formats.readback import link_poses, tip_poses
from calib.robot.formats.urdf_tree import read as read_tree
from calib.robot.kinematics import forward, joint_frames
from calib.transforms import invert, to_xyz_rpy

SAME = 1e-9  # poses read back by Pinocchio have to agree to this [m, and as a rotation matrix]
ON_AXIS = 1e-3  # [m]
UR_KEYS = ("x", "y", "z", "roll", "pitch", "yaw")
UR_LINKS = ("shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3")


def read(folder: Path) -> CalibratedChain:
    """Read the calibrated robot from the folder of a fit.

    Raises:
        UsageError: where it is none, or does not say what it was calibrated from.
    """
    if not FitFolder(folder).robot.is_file():
        raise UsageError(f"{folder} holds no robot.toml; give the folder that `calib fit --out` has written")
    robot = calibrated.read(folder)
    if robot.nominal is None:
        raise UsageError(f"{folder}/robot.toml does not say which nominal robot it was calibrated from; fit again")
    return robot


def without_corrections(folder: Path) -> str:
    """Return what a fit's metrics say of its URDF without the joint corrections, on the first unseen file, or fitted.

    Empty where the fit has none, or does not say it.
    """
    try:
        metrics = FitFolder(folder).metrics()
    except UsageError:  # a fit by an earlier version says nothing of it
        return ""
    unseen = next(iter(metrics.validation.items()), None)
    where, found = (f"on {unseen[0]}, unseen", unseen[1]) if unseen else ("on the fitted poses", metrics.fit)
    bare, after, before = (arm and arm.main for arm in (found.urdf_alone, found.calibrated, found.nominal))
    if not (bare and after and before):
        return ""
    worse = "; THAT IS WORSE THAN THE NOMINAL ARM" if bare.rms > before.rms else ""
    return (
        f"{where}, the URDF alone leaves {bare.rms:.3f} mm rms, with its corrections {after.rms:.3f} mm (nominal arm "
        f"{before.rms:.3f} mm){worse}"
    )


def check_targets(source: Path | None, targets: Sequence[Path]) -> None:
    """Refuse to write over the source, or two files into one."""
    for number, target in enumerate(targets):
        if source is not None and _same_file(source, target):
            raise UsageError(f"{target} is the source URDF, which stays as it is; give another name to write to")
        if any(_same_file(target, other) for other in targets[:number]):
            raise UsageError(f"{target} is to be written twice; give each file a name of its own")


def _same_file(one: Path, other: Path) -> bool:
    return one.resolve() == other.resolve() or (one.exists() and other.exists() and one.samefile(other))


def export_urdf(robot: CalibratedChain, source: Path, out: Path, for_corrections: bool = False) -> str:
    """Put the calibrated geometry into the XML of `source`, have others read it back, and write it to `out`.

    Only the origins of the arm's joints change. The base link stays where the nominal robot has its base, and the fixed
    joints behind the last moving one stay as they are: the choice of base and flange is the source's.

    Args:
        robot: the calibrated robot.
        source: a URDF of the nominal robot.
        out: the file to write.
        for_corrections: take the geometry that the joint corrections belong to, which is worse without them.

    Returns:
        Who has read it back.
    """
    chain = robot.complete if for_corrections else robot.chain
    content, encoding = text(source)
    edited = urdf_write.edit(content, nominal_of(robot), chain, str(source))
    read = check_readback(edited, str(source), chain)
    files.write(out, edited.encode(encoding))
    return read


def check_readback(edited: str, where: str, chain: Chain) -> str:
    """Refuse a URDF text in which Pinocchio or yourdfpy sees other poses than this toolkit does (`SAME`).

    Returns:
        Who has read it; a text that yourdfpy cannot read is not refused, and why is said.
    """
    tree = read_tree(edited, where)
    named = chain.joint_names if chain.joint_names[0] in tree.joints else None
    tip = chain.tip if chain.tip in tree.bodies else None
    own = urdf.build(tree, *urdf.ends(tree, None, tip, named))
    q = random_joints(own, 20, 0)
    error = float(np.abs(tip_poses(edited, own, q) - forward(own, q)).max())
    if error > SAME:
        raise RobotError(f"{where}: Pinocchio reads the calibrated URDF otherwise, by {error:.2g}; nothing was written")
    few = q[:5]
    try:
        seen = link_poses(edited, (*own.links, own.tip), own.base, own.joint_names, few)
    except RobotError as error:
        return f"Pinocchio reads the same poses to 1e-9; not read a second time: {error}"
    straight = np.stack([invert(urdf.align(tree.above[link].axis)) for link in own.links])[:, None]  # of slanted axes
    error = float(np.abs(seen - np.concatenate([joint_frames(own, few) @ straight, forward(own, few)[None]])).max())
    if error > SAME:
        raise RobotError(f"{where}: yourdfpy reads the calibrated URDF otherwise, by {error:.2g}; nothing was written")
    return "Pinocchio and yourdfpy read the same poses to 1e-9"


def export_offsets(robot: CalibratedChain, out: Path) -> Path:
    """Write calibrated minus nominal of each joint's own value: what a controller adds to the angle it reads.

    The sigmas are left out where the fit has joint corrections: the offsets are then for whoever does not apply them.
    """
    nominal, sigma = nominal_of(robot), np.full(len(robot.chain.elements), np.nan)
    if robot.covariance is not None and robot.corrections is None:
        sigma = np.sqrt(np.diag(robot.covariance))
    rows = []
    for joint, k in zip(robot.chain.joints, robot.chain.moving):
        element, before = robot.chain.elements[k], nominal.elements[k]
        known = float(sigma[k]) if sigma[k] > 0.0 else None
        rows.append((joint.name, joint.unit, (element.value - before.value) / element.ratio, known))
    return files.write_table(out, ("joint", "unit", "offset", "sigma"), rows)


def export_ur_kinematics(robot: CalibratedChain, out: Path) -> Path:
    """Write the kinematics YAML of ur_description: x y z roll pitch yaw of the six joints' origins.

    The frames are UR's own (base_link_inertia, then each joint about its z). They follow from the nominal arm's axes,
    so that only the calibrated part of the numbers is new. ur_description puts its tool0 where wrist_3 is: fixed joints
    of the robot's file behind it (a flange, a tool) are not part of it, see `flange_note`.

    Raises:
        UsageError: for an arm that has not UR's axes.
    """
    nominal = nominal_of(robot)
    try:
        template = ur_template(nominal)
        edited = read_tree(urdf_write.edit(template, nominal, robot.chain, "UR frames"), "UR frames")
    except RobotError as error:
        raise UsageError(f"'{robot.chain.name}' has not the axes of a UR arm: {error}") from error
    lines = []
    for link in UR_LINKS:
        xyz, rpy = to_xyz_rpy(edited.joints[link].origin)
        lines.append(f"  {link}:")
        lines += [f"    {key}: {value!r}" for key, value in zip(UR_KEYS, [*xyz.tolist(), *rpy.tolist()])]
    digest = int(hashlib.sha256("\n".join(lines).encode()).hexdigest()[:15], 16)
    head = [
        "# Calibrated by armature-calib; for ur_description's kinematics_params_file. The driver compares the hash",
        "# with the controller's own calibration and will say that they differ: this file is not the controller's.",
        "kinematics:",
    ]
    return files.write(out, "\n".join([*head, *lines, f"  hash: calib_{digest}"]) + "\n")


def flange_note(robot: CalibratedChain) -> str:
    """Say where UR's flange was taken to be, where the robot's file has something behind its last joint."""
    nominal = nominal_of(robot)
    zero = np.zeros((1, nominal.n))
    behind = invert(joint_frames(nominal, zero)[-1, 0]) @ forward(nominal, zero)[0]
    if np.abs(behind - np.eye(4)).max() < ON_AXIS:
        return ""
    away = f"{nominal.tip}, {1e3 * float(np.linalg.norm(behind[:3, 3])):.4g} mm behind the last joint's frame"
    if _wrist(nominal) > ON_AXIS:
        return f"wrist_3 is the last joint's frame, as UR's tool0 is; the fixed joint to {away}, is not in it"
    return f"wrist_3 reaches to {away}: this file holds UR's d6 there; it has to be UR's own flange, without a tool"


def _wrist(nominal: Chain) -> float:
    """Return how far the last joint's frame is from axis 5 at q = 0 [m]: UR's d6, or nothing in URDFs of old."""
    frames = joint_frames(nominal, np.zeros((1, nominal.n)))[:, 0]
    across = _axis(nominal, frames[1], int(nominal.moving[1]))
    return abs(float(across @ (frames[5, :3, 3] - frames[4, :3, 3])))


def ur_template(nominal: Chain) -> str:
    """Return a URDF of a nominal arm in UR's frames, its six lengths taken from the arm's axes at q = 0.

    d1 height of axis 2; a2, a3 distances of axes 2 to 3 and 3 to 4; d4 distance of axis 5 from axis 1; d5 height of
    axis 4 over axis 6; d6 distance of the last joint's frame from axis 5, or of the tip where that frame is on axis 5
    (URDFs of the years before ur_description hold d6 in the fixed joint to tool0).
    """
    if nominal.n != 6 or any(joint.kind != "revolute" for joint in nominal.joints):
        raise RobotError(f"it has {nominal.n} joints, not six revolute ones")
    zero = np.zeros((1, 6))
    frames = joint_frames(nominal, zero)[:, 0]
    axis = np.array([_axis(nominal, frames[j], k) for j, k in enumerate(nominal.moving)])
    point, tip = frames[:, :3, 3], forward(nominal, zero)[0, :3, 3]
    up, across = axis[0], axis[1]
    level = [float(up @ (p - point[0])) for p in point]
    base_height = float(up @ point[0])
    d1 = level[1] + base_height
    a2, a3 = (_gap(point[k], point[k + 1], across) for k in (1, 2))
    d4, d6 = abs(float(across @ (point[4] - point[0]))), _wrist(nominal)
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
