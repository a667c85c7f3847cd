"""Results: their folders, figures and verdicts, and how they are shown."""

from calib.api.dynamic import DynamicsModel
from calib.api.kinematic import GeometryFit
from calib.api.rendering import Drawn, Judged, saved
from calib.procedure.dynamic_stage.folder import IdentificationFolder
from calib.procedure.dynamic_stage.metrics import UnseenReport
from calib.procedure.excitation.coefficients import ARM as ARM_FILE
from calib.procedure.excitation.coefficients import NAME as TRAJECTORY_FILE
from calib.procedure.excitation.coefficients import PLANNED as PLANNED_FILE
from calib.procedure.excitation.coefficients import RUN as RUN_FILE
from calib.procedure.excitation.coefficients import SAMPLES as SAMPLES_FILE
from calib.procedure.excitation.coefficients import read as read_trajectory
from calib.procedure.export.delivery import prediction, verdicts
from calib.procedure.export.geometry import read as read_exported
from calib.procedure.export.geometry import results as geometry_results
from calib.procedure.findings import LEVELS, Verdict, limit, lines_of, sentence, settle
from calib.procedure.kinematic_stage.folder import IN_SESSION, URDF, VALIDATED, FitFolder, ValidationFolder
from calib.procedure.kinematic_stage.inputs import load_robot
from calib.procedure.kinematic_stage.inputs import read_file as read_measured_file
from calib.procedure.kinematic_stage.metrics import ComparedRows, FitMetrics, ValidationMetrics
from calib.procedure.kinematic_stage.settings import FitSettings, Tolerance
from calib.procedure.kinematic_stage.tables import read_covariance
from calib.procedure.robot_kinds import joints_of, stage_of

__all__ = [
    "ARM_FILE",
    "IN_SESSION",
    "LEVELS",
    "PLANNED_FILE",
    "RUN_FILE",
    "SAMPLES_FILE",
    "TRAJECTORY_FILE",
    "URDF",
    "VALIDATED",
    "ComparedRows",
    "Drawn",
    "DynamicsModel",
    "FitFolder",
    "FitMetrics",
    "FitSettings",
    "GeometryFit",
    "IdentificationFolder",
    "Judged",
    "Tolerance",
    "UnseenReport",
    "ValidationFolder",
    "ValidationMetrics",
    "Verdict",
    "geometry_results",
    "joints_of",
    "limit",
    "lines_of",
    "load_robot",
    "prediction",
    "read_covariance",
    "read_exported",
    "read_measured_file",
    "read_trajectory",
    "saved",
    "sentence",
    "settle",
    "stage_of",
    "verdicts",
]
