"""Identification from recordings, and its update: reading by options, estimate, verdict, judgement on further logs."""

from calib.estimation.recursive import DriftBank
from calib.identification.identify import Identification, common_decimator, identify
from calib.identification.identify_options import IdentifyOptions
from calib.identification.identify_options import read_options as read_identify_options
from calib.identification.learning.production import (
    FRICTION,
    GAIN,
    Cause,
    Judgement,
    WorkingModel,
    absorbed,
    judge,
    log_rows,
    torque_shares,
)
from calib.identification.model_file import from_table
from calib.procedure.dynamic_stage.identify import judged, overlaps, repeated_motion
from calib.procedure.dynamic_stage.inputs import IdentificationInputs
from calib.procedure.dynamic_stage.inputs import gather as gather_recordings
from calib.procedure.dynamic_stage.verdict import motion_findings

__all__ = [
    "FRICTION",
    "GAIN",
    "Cause",
    "DriftBank",
    "Identification",
    "IdentificationInputs",
    "IdentifyOptions",
    "Judgement",
    "WorkingModel",
    "absorbed",
    "common_decimator",
    "from_table",
    "gather_recordings",
    "identify",
    "judge",
    "judged",
    "log_rows",
    "motion_findings",
    "overlaps",
    "read_identify_options",
    "repeated_motion",
    "torque_shares",
]
