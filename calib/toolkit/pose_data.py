"""Measurements: tables, files of measured poses, lists of poses and targets."""

from calib.data.csv_table import Table, opened, plain_rows, read_header, read_table, split_units
from calib.data.poses import IMAGES
from calib.data.poses.columns import ANGLES as TURN_NAMES
from calib.data.poses.columns import LATE, OURS, POSITION, QUATERNION, SIGMA, SIGMA_ROTATION, Layout, Sheet
from calib.data.poses.fit_options import EULER, FileOptions, FitOptions
from calib.data.poses.fit_options import parse_options as parse_fit_options
from calib.data.poses.fit_options import read_options as read_fit_options
from calib.data.poses.measurements import PoseMeasurements, Positions, take
from calib.data.poses.name_shapes import positions_by_shape, with_shape
from calib.data.poses.plausible import check_joints, orientation, outside, unit_quaternions
from calib.data.poses.pose_files import read_measurements
from calib.data.poses.pose_lists import Targets, read_poses, read_targets
from calib.data.poses.robodk import recognises as is_robodk_file
from calib.data.poses.silent_units import with_silent_units
from calib.data.schema import BOUNDS, Joints, max_travel

__all__ = [
    "BOUNDS",
    "EULER",
    "IMAGES",
    "LATE",
    "OURS",
    "POSITION",
    "QUATERNION",
    "SIGMA",
    "SIGMA_ROTATION",
    "TURN_NAMES",
    "FileOptions",
    "FitOptions",
    "Joints",
    "Layout",
    "PoseMeasurements",
    "Positions",
    "Sheet",
    "Table",
    "Targets",
    "check_joints",
    "is_robodk_file",
    "max_travel",
    "opened",
    "orientation",
    "outside",
    "parse_fit_options",
    "plain_rows",
    "positions_by_shape",
    "read_fit_options",
    "read_header",
    "read_measurements",
    "read_poses",
    "read_table",
    "read_targets",
    "split_units",
    "take",
    "unit_quaternions",
    "with_shape",
    "with_silent_units",
]
