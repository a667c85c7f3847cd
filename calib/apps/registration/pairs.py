"""Pairs of poses without joints as measurements of a robot whose six joints are the coordinates of its poses.

So the fit, its checks, its verdict and its result are those of every other measurement.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from calib.apps.registration.agreement import Reading, agreed
from calib.errors import counted, refuse_data
from calib.toolkit.chains import POSE_JOINTS, CalibratedChain, Chain, Element, Joint
from calib.toolkit.installations import chordal_turns, direction
from calib.toolkit.pose_pairs import (
    BOARD_WORDS,
    FIXED_WORDS,
    IN_HAND,
    LENS_WORDS,
    ROBOT_WORDS,
    TO_HAND,
    PosePairs,
    Poses,
)
from calib.transforms import invert, pose, to_quaternion

# Fewest pairs that determine both placements.
MIN_PAIRS = 3
# Elementary transforms of the joints, in their order.
JOINT_AXES = ("tx", "ty", "tz", "rz", "ry", "rx")
# Names under which easy_handeye stores poses of the board in the camera.
EASY_HANDEYE = ("optical", "opt")


def measured_pairs(pairs: PosePairs, mounting: str, robot: Chain | None) -> tuple[CalibratedChain, Poses]:
    """Return the robot of the pairs, whose joints are the coordinates of its poses, and the measurements at them.

    Args:
        pairs: m pairs of poses.
        mounting: ``in hand`` or ``to hand``, as the user stated it; empty where not stated.
        robot: the robot, which names base and tip; None without one.

    Raises:
        MeasurementError: too few pairs, or conventions that cannot be told apart.
    """
    count = len(pairs)
    if count < MIN_PAIRS:
        refuse_data(
            pairs.file,
            f"{counted(count, 'pair')} of poses: two placements need at least {MIN_PAIRS}, a calibration about 12, "
            "with the wrist turned by 90° and more about two axes between them",
        )
    reading, notes = agreed(pairs)
    if not mounting and pairs.in_hand is not None:
        mounting = IN_HAND if pairs.in_hand else TO_HAND
    arm = reading.robot
    reason = _robot_is_inverse(pairs, reading, mounting)
    if reason:
        arm = invert(arm)
        notes.append(f"the robot's poses are read as its base in its tool: {reason}")
    chain, q = free_flyer(arm, pairs, robot)
    agreement = direction(arm, reading.camera)
    if agreement.agrees and agreement.is_inverse is None:
        refuse_data(
            pairs.file,
            f"{count} pairs agree both as they are ({1e3 * agreement.direct:.3g} mm) and as their inverse "
            f"({1e3 * agreement.inverse:.3g} mm), so they do not determine the placements: measure 12 poses, with the "
            "wrist turned by 90° and more about two axes between them",
        )
    block = Poses(
        q,
        POSE_JOINTS,
        reading.camera[:, :3, 3],
        to_quaternion(reading.camera),
        mounting=mounting or _mounting_by_name(pairs, bool(agreement.is_inverse)),
        file=pairs.file,
        rows=pairs.rows,
        station=Path(pairs.file).stem,
        notes=(*pairs.notes, *notes),
    )
    return CalibratedChain(chain, source=f"robot poses of {Path(pairs.file).name}"), block


def _is_board_in_camera(pairs: PosePairs) -> bool | None:
    """Return whether the poses camera are those of the board in the camera, if their name says so."""
    of, frame = pairs.camera.frames
    if of & BOARD_WORDS and frame & LENS_WORDS:
        return True
    if of & LENS_WORDS and frame & BOARD_WORDS:
        return False
    if pairs.camera.name.lower() in EASY_HANDEYE:
        return True
    return None


def _mounting_by_name(pairs: PosePairs, inverse: bool) -> str:
    """Return whether the arm carries the camera or the board, by the names of the poses seen; empty if they do not say.

    Args:
        pairs: the pairs, whose robot poses are those of the tool in the base.
        inverse: whether the poses camera agree as their inverse.
    """
    board_in_camera = _is_board_in_camera(pairs)
    if board_in_camera is None:
        return ""
    if board_in_camera == inverse:
        return IN_HAND
    return TO_HAND


def _robot_is_inverse(pairs: PosePairs, reading: Reading, mounting: str) -> str:
    """Return why the robot's poses are those of its base in its tool; empty where they are the usual ones."""
    of, frame = pairs.robot.frames
    if of & FIXED_WORDS and frame & ROBOT_WORDS and not frame & FIXED_WORDS:
        return f"so says the name '{pairs.robot.name}'"
    board_in_camera = _is_board_in_camera(pairs)
    if not mounting or board_in_camera is None:
        return ""
    expected = board_in_camera == (mounting == IN_HAND)
    if expected == bool(direction(reading.robot, reading.camera).is_inverse):
        return ""
    carried = "camera" if mounting == IN_HAND else "board"
    return f"only so the poses agree with an arm that carries the {carried} (easy_handeye stores them like this)"


def free_flyer(poses: np.ndarray, pairs: PosePairs, robot: Chain | None) -> tuple[Chain, np.ndarray]:
    """Return a robot with three sliding and three turning joints, and the joint values (m, 6) of its poses.

    Its base is shifted by the mean position, so that its reach is that of the arm, and its turning joints start at the
    mean orientation, so that their angles do not wrap.

    Args:
        poses: (m, 4, 4) poses of the tool in the base.
        pairs: the pairs that they are from.
        robot: the robot, which names base and tip; None without one.
    """
    middle = poses[:, :3, 3].mean(axis=0)
    rotation, _ = chordal_turns(poses[:, :3, :3])
    placements = {"x": pose(None, middle), "c": pose(rotation)}
    joints = []
    elements = []
    for index, (name, axis) in enumerate(zip(POSE_JOINTS, JOINT_AXES)):
        kind = "prismatic" if axis[0] == "t" else "revolute"
        joints.append(Joint(name, kind))
        elements.append(Element(f"robot.{name}", axis, owner=index, joint=index, placement=placements.get(name)))
    base, tip = "base", "tool"
    if robot is not None:
        base, tip = robot.base, robot.tip
    chain = Chain(Path(pairs.file).stem, tuple(joints), tuple(elements), base=base, tip=tip)
    angles = Rotation.from_matrix(rotation.T @ poses[:, :3, :3]).as_euler("ZYX")
    return chain, np.hstack([poses[:, :3, 3] - middle, angles])
