"""Pairs of poses without joints: reading of files, and conventions of their orientations."""

from calib.data.pose_pairs.poses import FIXED_WORDS, LENS_WORDS, ROBOT_WORDS, PoseList, PosePairs, poses_of
from calib.data.pose_pairs.reading import read_pairs
from calib.data.poses import IN_HAND, TO_HAND
from calib.data.poses.measurements import Poses

__all__ = [
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
