"""Pairs of poses without joints: reading of files, and conventions of their orientations."""

from calib.data.pose_pairs.pair_files import read_pairs
from calib.data.pose_pairs.poses import BOARD_WORDS, FIXED_WORDS, LENS_WORDS, ROBOT_WORDS, PoseList, PosePairs, poses_of
from calib.data.poses import IN_HAND, TO_HAND
from calib.data.poses.measurements import Poses

__all__ = [
    "BOARD_WORDS",
    "FIXED_WORDS",
    "IN_HAND",
    "LENS_WORDS",
    "ROBOT_WORDS",
    "TO_HAND",
    "PoseList",
    "PosePairs",
    "Poses",
    "poses_of",
    "read_pairs",
]
