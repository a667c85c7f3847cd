"""Planned motions: their files, and the trajectory that they hold."""

from calib.procedure.excitation.coefficients import ARM as ARM_FILE
from calib.procedure.excitation.coefficients import NAME as TRAJECTORY_FILE
from calib.procedure.excitation.coefficients import PLANNED as PLANNED_FILE
from calib.procedure.excitation.coefficients import RUN as RUN_FILE
from calib.procedure.excitation.coefficients import SAMPLES as SAMPLES_FILE
from calib.procedure.excitation.coefficients import read as read_trajectory

__all__ = ["ARM_FILE", "PLANNED_FILE", "RUN_FILE", "SAMPLES_FILE", "TRAJECTORY_FILE", "read_trajectory"]
