"""Identification from recordings: reading of recordings by options, the estimate, and the verdict on it."""

from calib.identification.identify import Identification, identify
from calib.identification.identify_options import read_options as read_identify_options
from calib.procedure.dynamic_stage.identify import judged, overlaps, repeated_motion
from calib.procedure.dynamic_stage.inputs import IdentificationInputs
from calib.procedure.dynamic_stage.inputs import gather as gather_recordings
from calib.procedure.dynamic_stage.verdict import motion_findings

__all__ = [
    "Identification",
    "IdentificationInputs",
    "gather_recordings",
    "identify",
    "judged",
    "motion_findings",
    "overlaps",
    "read_identify_options",
    "repeated_motion",
]
