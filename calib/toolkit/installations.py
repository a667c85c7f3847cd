"""Geometry: installations of robots and instruments, observation models, fits, inverse kinematics."""

from calib.geometry.checks.pose_direction import direction, median_misfit
from calib.geometry.error_model import Discrepancy, ErrorModel, outside
from calib.geometry.first_guess import check_scale, chordal_turns, install
from calib.geometry.fit import PLAUSIBLE, plausible_deviation
from calib.geometry.fit import fit as fit_installation
from calib.geometry.installation import FRAME_AXES, Installation, NoOptics, read_arms, see
from calib.geometry.installation import read as read_installation
from calib.geometry.inverse import DOF, Goal, conditions, differences, held_back, nearest, reach
from calib.geometry.model_choice.cross_validation import project_out, term_sizes
from calib.geometry.model_choice.ladder import EFFECTS
from calib.geometry.observability import base_columns
from calib.geometry.observation import (
    families,
    layout,
    layout_counts,
    observe,
    parameter_values,
    pose_sigmas,
    prepare,
    step,
    target_jacobian,
)
from calib.geometry.static_torques.gravity_fit import payload_load
from calib.geometry.weighing import calibrated_chain

__all__ = [
    "DOF",
    "EFFECTS",
    "FRAME_AXES",
    "PLAUSIBLE",
    "Discrepancy",
    "ErrorModel",
    "Goal",
    "Installation",
    "NoOptics",
    "base_columns",
    "calibrated_chain",
    "check_scale",
    "chordal_turns",
    "conditions",
    "differences",
    "direction",
    "families",
    "fit_installation",
    "held_back",
    "install",
    "layout",
    "layout_counts",
    "median_misfit",
    "nearest",
    "observe",
    "outside",
    "parameter_values",
    "payload_load",
    "plausible_deviation",
    "pose_sigmas",
    "prepare",
    "project_out",
    "reach",
    "read_arms",
    "read_installation",
    "see",
    "step",
    "target_jacobian",
    "term_sizes",
]
