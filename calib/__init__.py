"""Joint kinematic-then-dynamic calibration of robots: geometry first, then dynamics, with propagated uncertainty.

    import calib

    robot = calib.load("robot.urdf")
    plan = calib.select_poses(robot, 40, constraints="cell.toml")
    fit = calib.fit_geometry(robot, "measured.csv", calib.FitSettings(holdout=0.25))
    print(fit)                                  # ladder, errors on unseen poses, verdict and its reason
    motion = calib.design_excitation(fit.robot, calib.ExcitationSettings(period=10.0))
    model = calib.identify_dynamics(fit.robot, "log.csv", validate="other.csv")
    calib.export(model, "calibrated/", urdf="robot.urdf")

Where a function takes a robot, measurements or a result, it also takes a file. Results can be printed, converted
(`to_dict`, `to_dataframe`), drawn (`plot`) and written to the folders that the commands write (`save`). Units are SI:
m, rad, s, kg, N m. During a call, BLAS uses one thread, which is fastest for the small matrices here; where
OPENBLAS_NUM_THREADS or OMP_NUM_THREADS is set, that number of threads is used.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from calib.workers import caches

if TYPE_CHECKING:
    from calib.api.dynamic import DynamicsModel, identify_dynamics, methods
    from calib.api.exporting import export, validate
    from calib.api.kinematic import GeometryFit, PoseSelection, fit_geometry, select_poses
    from calib.api.motions import ExcitationDesign, MotionPlan, design_excitation, plan_motion
    from calib.api.reading import load, read_poses, read_recording
    from calib.api.result_table import ResultTable
    from calib.api.sweeps import sweep
    from calib.apps.compensation.api import JointCommands, compensate
    from calib.apps.fleet.fleet import run_sessions
    from calib.apps.joining.joining import join
    from calib.apps.monitoring.comparison.robot_change import diff
    from calib.apps.registration.api import base, hand_eye, tool
    from calib.errors import CalibError
    from calib.identification.friction.friction_terms import FrictionTerm
    from calib.identification.identify_options import IdentifySettings
    from calib.procedure.excitation.settings import ExcitationSettings, PlanSettings
    from calib.procedure.kinematic_stage.settings import FitSettings, SelectionSettings
    from calib.procedure.session.commands import new_session
    from calib.results.result import Result
    from calib.results.result_classes import open_result
    from calib.robot.calibrated import CalibratedChain
    from calib.simulation.cell import SimulatedInstrument
    from calib.simulation.population import PlantedArm, population
    from calib.simulation.virtual_cells import PlantedErrors

# names that `import calib` provides, and their modules, which are loaded at first use to keep `calib --help` fast
_HOMES = {
    "api.reading": ("load", "read_poses", "read_recording"),
    "api.kinematic": ("select_poses", "fit_geometry", "PoseSelection", "GeometryFit"),
    "api.motions": ("design_excitation", "plan_motion", "ExcitationDesign", "MotionPlan"),
    "api.dynamic": ("identify_dynamics", "methods", "DynamicsModel"),
    "api.sweeps": ("sweep",),
    "api.result_table": ("ResultTable",),
    "api.exporting": ("validate", "export"),
    "procedure.session.commands": ("new_session",),
    "apps.fleet.fleet": ("run_sessions",),
    "robot.calibrated": ("CalibratedChain",),
    "results.result_classes": ("open_result",),
    "results.result": ("Result",),
    "apps.compensation.api": ("compensate", "JointCommands"),
    "apps.joining.joining": ("join",),
    "apps.monitoring.comparison.robot_change": ("diff",),
    "apps.registration.api": ("tool", "base", "hand_eye"),
    "procedure.kinematic_stage.settings": ("SelectionSettings", "FitSettings"),
    "procedure.excitation.settings": ("ExcitationSettings", "PlanSettings"),
    "identification.identify_options": ("IdentifySettings",),
    "identification.friction.friction_terms": ("FrictionTerm",),
    "simulation.population": ("population", "PlantedArm"),
    "simulation.virtual_cells": ("PlantedErrors",),
    "simulation.cell": ("SimulatedInstrument",),
    "errors": ("CalibError",),
}

__all__ = [  # noqa: RUF022 (in the order of use)
    "load",
    "read_poses",
    "read_recording",
    "join",
    "select_poses",
    "fit_geometry",
    "diff",
    "tool",
    "base",
    "hand_eye",
    "design_excitation",
    "plan_motion",
    "identify_dynamics",
    "methods",
    "validate",
    "export",
    "open_result",
    "compensate",
    "new_session",
    "run_sessions",
    "population",
    "sweep",
    "CalibratedChain",
    "PoseSelection",
    "GeometryFit",
    "ExcitationDesign",
    "MotionPlan",
    "DynamicsModel",
    "JointCommands",
    "Result",
    "ResultTable",
    "SelectionSettings",
    "FitSettings",
    "ExcitationSettings",
    "PlanSettings",
    "IdentifySettings",
    "FrictionTerm",
    "PlantedArm",
    "PlantedErrors",
    "SimulatedInstrument",
    "CalibError",
]


# before any kernel is loaded
caches.provide()


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        return version("armature-calib")
    home = next((home for home, names in _HOMES.items() if name in names), None)
    if home is None:
        raise AttributeError(f"module 'calib' has no attribute {name!r}")
    value = getattr(import_module(f"calib.{home}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
