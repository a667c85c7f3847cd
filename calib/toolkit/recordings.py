"""Recordings: joint positions and torques over time, the motions filtered from recordings, and planned motions."""

from calib.data.joint_columns import words_of
from calib.data.recordings.bags import bag_table, is_bag
from calib.data.recordings.datasets import dataset_table, is_dataset
from calib.data.recordings.log_columns import families, series_of, time_column
from calib.data.recordings.recording import Recording, parse_cut
from calib.data.recordings.recording_files import read_recording
from calib.data.recordings.recording_options import SYNONYMS
from calib.data.recordings.stamps import likely_unit
from calib.data.recordings.topics import at_times
from calib.data.signals.bandwidth import USABLE
from calib.data.signals.filtering import design_decimator
from calib.data.signals.fingerprint import SKETCH, Fingerprint, common_share, sketch
from calib.data.signals.motion import FilterOptions, make_motion
from calib.data.signals.resampling import GAP
from calib.procedure.excitation.coefficients import ARM as ARM_FILE
from calib.procedure.excitation.coefficients import NAME as TRAJECTORY_FILE
from calib.procedure.excitation.coefficients import PLANNED as PLANNED_FILE
from calib.procedure.excitation.coefficients import RUN as RUN_FILE
from calib.procedure.excitation.coefficients import SAMPLES as SAMPLES_FILE
from calib.procedure.excitation.coefficients import read as read_trajectory

__all__ = [
    "ARM_FILE",
    "GAP",
    "PLANNED_FILE",
    "RUN_FILE",
    "SAMPLES_FILE",
    "SKETCH",
    "SYNONYMS",
    "TRAJECTORY_FILE",
    "USABLE",
    "FilterOptions",
    "Fingerprint",
    "Recording",
    "at_times",
    "bag_table",
    "common_share",
    "dataset_table",
    "design_decimator",
    "families",
    "is_bag",
    "is_dataset",
    "likely_unit",
    "make_motion",
    "parse_cut",
    "read_recording",
    "read_trajectory",
    "series_of",
    "sketch",
    "time_column",
    "words_of",
]
