"""Export of the calibrated geometry: an edited URDF, and a table of joint offsets."""

from pathlib import Path

import numpy as np

from calib import files
from calib.errors import RobotError, UsageError
from calib.folders import files_of
from calib.procedure.dynamic_stage import folder as identification
from calib.procedure.kinematic_stage.folder import OURS, FitFolder
from calib.procedure.kinematic_stage.mastering import Mastering
from calib.procedure.kinematic_stage.mastering import read as read_mastering
from calib.result_kinds import refusal
from calib.robot import calibrated
from calib.robot.calibrated import CalibratedChain, nominal_of
from calib.robot.chain import Chain, random_joints
from calib.robot.formats import urdf, urdf_write
from calib.robot.formats.simulators import link_poses, tip_poses
from calib.robot.formats.urdf_tree import UrdfTree, text
from calib.robot.formats.urdf_tree import read as read_tree
from calib.robot.kinematics import forward, joint_frames
from calib.transforms import invert
from calib.workers.extras import installed, lacking

# of poses read back [m, and as a rotation matrix], and of torques over the largest
MAX_DIFFERENCE = 1e-9
# random configurations at which a URDF is read back, by Pinocchio and by the slower yourdfpy
CHECKED_POSES = 20
CHECKED_AGAIN = 5

OFFSETS_HEADER = ("joint", "unit", "add_to_reading", "add_to_command", "sigma")


class NoSuchArm(UsageError):
    """Error for an arm whose kinematic structure a file format does not support."""


def read(folder: Path, verb: str = "export") -> CalibratedChain:
    """Read the calibrated robot from the folder of a fit.

    Args:
        folder: folder of a fit.
        verb: name of the reading command, for the message (`calib.result_kinds.TAKES`).

    Raises:
        UsageError: if the folder is not that of a fit, or does not state the nominal robot.
    """
    if not FitFolder(folder).robot.is_file():
        raise UsageError(refusal(folder, verb))
    robot = calibrated.read(folder)
    if robot.nominal is None:
        raise UsageError(f"{folder}/robot.toml does not say which nominal robot it was calibrated from; fit again")
    return robot


def results(folder: Path) -> list[Path]:
    """Return the essential files in the folder of a fit or an identification, which no export may overwrite."""
    return [folder / name for name in files_of(folder, (*OURS, *identification.OURS))]


def edited_urdf(robot: CalibratedChain, source: Path, for_corrections: bool = False) -> tuple[bytes, str]:
    """Return the XML of a URDF with the calibrated geometry, and a sentence on the programs that verified it.

    Only the origins of the arm's joints change. The base link and the fixed joints after the last moving joint remain
    unchanged, since the source defines base and flange.

    Args:
        robot: the calibrated robot.
        source: a URDF of the nominal robot.
        for_corrections: whether to write the geometry for use with joint corrections; used without corrections, this
            geometry is less accurate than the rigid geometry.

    Raises:
        RobotError: if the edited URDF, read back, has other poses than the robot.
    """
    chain = robot.complete if for_corrections else robot.chain
    content, encoding = text(source)
    edited = urdf_write.edit(content, nominal_of(robot), chain, str(source))
    return edited.encode(encoding), check_readback(edited, str(source), chain)


def chain_in(tree: UrdfTree, chain: Chain, base: str | None = None) -> Chain:
    """Return the arm in a URDF that corresponds to another arm.

    It has the joints and the tip of the other arm if the URDF contains these names; otherwise they are chosen by
    default.

    Args:
        tree: the URDF.
        chain: the other arm.
        base: name of the first link; None: determined by the joints.
    """
    joints = chain.joint_names if chain.joint_names[0] in tree.joints else None
    tip = chain.tip if chain.tip in tree.bodies else None
    return urdf.build(tree, urdf.ends(tree, base, tip, joints))


def check_readback(edited: str, where: str, chain: Chain) -> str:
    """Check that Pinocchio and yourdfpy compute the same poses from a URDF text as this toolkit.

    Args:
        edited: text of the URDF.
        where: name of the file for messages.
        chain: the arm as this toolkit computes it.

    Returns:
        A sentence on the programs that have read the text, or on why one has not.

    Raises:
        RobotError: if the poses differ.
    """
    tree = read_tree(edited, where)
    urdf_chain = chain_in(tree, chain)
    if not installed("pinocchio"):
        return f"not read back by another program; {lacking('pinocchio')}"
    q = random_joints(urdf_chain, CHECKED_POSES, 0)
    difference = float(np.abs(tip_poses(edited, urdf_chain, q) - forward(urdf_chain, q)).max())
    if difference > MAX_DIFFERENCE:
        raise RobotError(
            f"{where}: poses differ by {difference:.2g} when Pinocchio reads the URDF; nothing was written: report "
            "this as a bug"
        )

    if not installed("yourdfpy"):
        return "Pinocchio reads the same poses to 1e-9"
    q = q[:CHECKED_AGAIN]
    links = (*urdf_chain.links, urdf_chain.tip)
    try:
        T_base_links = link_poses(edited, links, urdf_chain.base, urdf_chain.joint_names, q)
    except RobotError as error:
        return f"Pinocchio reads the same poses to 1e-9; not read a second time: {error}"
    # links of slanted axes are turned against the chain's frames
    turns = [invert(urdf.align(tree.above[link].axis)) for link in urdf_chain.links]
    expected = [joint_frames(urdf_chain, q) @ np.stack(turns)[:, None], forward(urdf_chain, q)[None]]
    difference = float(np.abs(T_base_links - np.concatenate(expected)).max())
    if difference > MAX_DIFFERENCE:
        raise RobotError(
            f"{where}: poses differ by {difference:.2g} when yourdfpy reads the URDF; nothing was written: report "
            "this as a bug"
        )
    return "Pinocchio and yourdfpy read the same poses to 1e-9"


def export_offsets(fit: Path, out: Path) -> Mastering:
    """Write a table of joint offsets, to be added to the controller's readings and subtracted from commands.

    The offset is calibrated minus nominal: a joint with the reading q is at q + offset in the nominal robot's model.
    The offsets are those of a fit of offsets alone, for controllers that take no other parameter.

    Args:
        fit: folder of the fit.
        out: path of the CSV file.

    Returns:
        The offsets with their arm and its error.

    Raises:
        NoOffsets: the fit's folder has none.
    """
    mastering = read_mastering(fit)
    rows = []
    for joint, offset, sigma in zip(mastering.cell.chain.joints, mastering.offset, mastering.sigma, strict=True):
        stated = float(sigma) if sigma > 0.0 else None
        rows.append((joint.name, joint.unit, float(offset), 0.0 - float(offset), stated))
    files.write_table(out, OFFSETS_HEADER, rows)
    return mastering
