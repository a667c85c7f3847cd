"""Robots: kinematic chains, calibrated chains, the library of arms, descriptions and controllers."""

from calib.controllers.axes import Axes, PlainJoint, as_described, axes_of, check_controller, check_pulses, named_axis
from calib.controllers.table import Controller, controller_named, controller_of, controllers
from calib.robot.calibrated import ROBOT as ROBOT_FILE
from calib.robot.calibrated import CalibratedChain, Deflection, Term, evaluate, nominal_of
from calib.robot.calibrated import read as read_calibrated
from calib.robot.calibrated import write as write_calibrated
from calib.robot.chain import AXES, POSE_JOINTS, Chain, Element, Joint, joint_kinds, random_joints
from calib.robot.collision import find_mesh, urdf_meshes
from calib.robot.formats.urdf_tree import UrdfTree, is_urdf
from calib.robot.formats.urdf_tree import numbers as read_numbers
from calib.robot.formats.urdf_tree import origin as read_origin
from calib.robot.formats.urdf_tree import read as read_tree
from calib.robot.formats.urdf_tree import text as description_text
from calib.robot.kinematics import forward, joint_frames
from calib.robot.library import load, load_calibrated, resolve
from calib.robot.library import names as robot_names
from calib.robot.tables import dumps as toml_text
from calib.robot.tables import load as toml_table
from calib.units import NamedJoint

__all__ = [
    "AXES",
    "POSE_JOINTS",
    "ROBOT_FILE",
    "Axes",
    "CalibratedChain",
    "Chain",
    "Controller",
    "Deflection",
    "Element",
    "Joint",
    "NamedJoint",
    "PlainJoint",
    "Term",
    "UrdfTree",
    "as_described",
    "axes_of",
    "check_controller",
    "check_pulses",
    "controller_named",
    "controller_of",
    "controllers",
    "description_text",
    "evaluate",
    "find_mesh",
    "forward",
    "is_urdf",
    "joint_frames",
    "joint_kinds",
    "load",
    "load_calibrated",
    "named_axis",
    "nominal_of",
    "random_joints",
    "read_calibrated",
    "read_numbers",
    "read_origin",
    "read_tree",
    "resolve",
    "robot_names",
    "toml_table",
    "toml_text",
    "urdf_meshes",
    "write_calibrated",
]
