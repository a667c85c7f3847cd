"""Dynamics: regressor models, base parameters, drives, identification problems and methods."""

from calib.dynamics.base import Base, BaseModel, regroup, standard_name
from calib.dynamics.base import find as find_base
from calib.dynamics.bodies import bodies_of, standard_parameters, with_payload
from calib.dynamics.drives import term as drive_term
from calib.dynamics.idim import IdentificationModel
from calib.dynamics.load_cases import LoadCases
from calib.dynamics.pseudo_inertia import ball, margin
from calib.dynamics.torque_rows import BOTH, LINK, MOTOR, POWER, ROWS, TorqueRows
from calib.identification.methods.constraint_settings import ConstraintSettings
from calib.identification.methods.method import EstimateStatus, IdentificationProblem, Method, MethodEstimate
from calib.identification.model_file import MODEL, read_dynamics
from calib.identification.model_file import read_table as read_model_table
from calib.identification.physical_consistency.information import INFORMATION
from calib.identification.prediction import Dynamics, predict, score
from calib.identification.registry import METHODS, VERSIONS, method_named
from calib.identification.rows import Case, make_case, observe
from calib.identification.settings import IdentificationSettings, make_model
from calib.identification.uncertainty.torque_errors import estimated_columns, parameter_variances

__all__ = [
    "BOTH",
    "INFORMATION",
    "LINK",
    "METHODS",
    "MODEL",
    "MOTOR",
    "POWER",
    "ROWS",
    "VERSIONS",
    "Base",
    "BaseModel",
    "Case",
    "ConstraintSettings",
    "Dynamics",
    "EstimateStatus",
    "IdentificationModel",
    "IdentificationProblem",
    "IdentificationSettings",
    "LoadCases",
    "Method",
    "MethodEstimate",
    "TorqueRows",
    "ball",
    "bodies_of",
    "drive_term",
    "estimated_columns",
    "find_base",
    "make_case",
    "make_model",
    "margin",
    "method_named",
    "observe",
    "parameter_variances",
    "predict",
    "read_dynamics",
    "read_model_table",
    "regroup",
    "score",
    "standard_name",
    "standard_parameters",
    "with_payload",
]
