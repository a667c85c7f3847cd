"""Recordings: joint positions and torques over time, and the motions filtered from them."""

from calib.data.recordings.recording import Recording
from calib.data.signals.bandwidth import USABLE
from calib.data.signals.filtering import design_decimator
from calib.data.signals.motion import FilterOptions, make_motion
from calib.data.signals.resampling import GAP

__all__ = ["GAP", "USABLE", "FilterOptions", "Recording", "design_decimator", "make_motion"]
