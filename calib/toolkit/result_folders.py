"""Results: their folders, figures and verdicts, and functions to display them."""

from calib.api.dynamic import DynamicsModel
from calib.api.kinematic import GeometryFit, Several, fit_geometry
from calib.api.rendering import ChartedResult, Progress, ReportedResult, Shown, WithoutVerdict, saved
from calib.procedure.dynamic_stage.folder import INSTRUMENTAL, IdentificationFolder
from calib.procedure.dynamic_stage.metrics import TorqueCurves, UnseenReport
from calib.procedure.export.delivery import prediction
from calib.procedure.export.geometry import read as read_exported
from calib.procedure.export.geometry import results as geometry_results
from calib.procedure.findings import (
    LEVELS,
    NOT_JUDGED,
    Note,
    Verdict,
    as_notes,
    limit,
    lines_of,
    notes_of,
    sentence,
    settle,
)
from calib.procedure.kinematic_stage.fit_tables import read_covariance
from calib.procedure.kinematic_stage.folder import IN_SESSION, URDF, VALIDATED, FitFolder, ValidationFolder
from calib.procedure.kinematic_stage.inputs import load_robot
from calib.procedure.kinematic_stage.inputs import read_file as read_measured_file
from calib.procedure.kinematic_stage.mastering import NoOffsets
from calib.procedure.kinematic_stage.mastering import read as read_mastering
from calib.procedure.kinematic_stage.metrics import ComparedRows, FitMetrics, ValidationMetrics
from calib.procedure.kinematic_stage.settings import FitSettings
from calib.procedure.robot_kinds import joints_of, stage_of
from calib.results.result import Result, StoredResult
from calib.results.result_classes import drawn, open_result
from calib.results.scene import Drawn as DrawnRobot
from calib.results.scene import ErrorSizes, Measured, Played, Scene, Torques, TradeOffs, skeleton, strips, thinned

__all__ = [
    "INSTRUMENTAL",
    "IN_SESSION",
    "LEVELS",
    "NOT_JUDGED",
    "URDF",
    "VALIDATED",
    "ChartedResult",
    "ComparedRows",
    "DrawnRobot",
    "DynamicsModel",
    "ErrorSizes",
    "FitFolder",
    "FitMetrics",
    "FitSettings",
    "GeometryFit",
    "IdentificationFolder",
    "Measured",
    "NoOffsets",
    "Note",
    "Played",
    "Progress",
    "ReportedResult",
    "Result",
    "Scene",
    "Several",
    "Shown",
    "StoredResult",
    "TorqueCurves",
    "Torques",
    "TradeOffs",
    "UnseenReport",
    "ValidationFolder",
    "ValidationMetrics",
    "Verdict",
    "WithoutVerdict",
    "as_notes",
    "drawn",
    "fit_geometry",
    "geometry_results",
    "joints_of",
    "limit",
    "lines_of",
    "load_robot",
    "notes_of",
    "open_result",
    "prediction",
    "read_covariance",
    "read_exported",
    "read_mastering",
    "read_measured_file",
    "saved",
    "sentence",
    "settle",
    "skeleton",
    "stage_of",
    "strips",
    "thinned",
]
