"""Joint kinematic-then-dynamic calibration of robots: geometry first, dynamics on it, uncertainty carried all the way.

    import calib

    robot = calib.load("robot.urdf")
    plan = calib.select_poses(robot, 40, constraints="cell.toml")
    fit = calib.fit_geometry(robot, "measured.csv", calib.FitSettings(holdout=0.25))
    print(fit)                                  # ladder, errors on unseen poses, verdict and its reason
    motion = calib.design_excitation(fit.robot, calib.ExcitationSettings(period=10.0))
    model = calib.identify_dynamics(fit.robot, "log.csv", validate="other.csv")
    calib.export(model, "calibrated/", urdf="robot.urdf")

Every verb takes a file where it takes a value; results print themselves, convert (`to_dict`, `to_dataframe`), draw
(`plot`) and write the folders that the commands write (`save`). Units are SI: m, rad, s, kg, N m. While a call runs,
BLAS has one thread, which is fastest here; OPENBLAS_NUM_THREADS or OMP_NUM_THREADS, where set, count instead.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from calib.api.dynamic import DynamicsModel, identify_dynamics
    from calib.api.exporting import export
    from calib.api.kinematic import GeometryFit, JointCommands, PoseSelection, compensate, fit_geometry, select_poses
    from calib.api.motions import ExcitationDesign, MotionPlan, design_excitation, plan_motion
    from calib.api.reading import load, read_poses, read_recording
    from calib.api.sessions import new_session, run_sessions
    from calib.api.validating import validate
    from calib.errors import CalibError
    from calib.procedure.excitation.settings import ExcitationSettings, PlanSettings
    from calib.procedure.kinematic_stage.settings import FitSettings, SelectionSettings
    from calib.robot.calibrated import CalibratedChain

# what `import calib` offers, and where it lives: loaded when first asked for, so that `calib --help` starts at once
_HOMES = {
    "load": "api.reading",
    "read_poses": "api.reading",
    "read_recording": "api.reading",
    "select_poses": "api.kinematic",
    "fit_geometry": "api.kinematic",
    "design_excitation": "api.motions",
    "plan_motion": "api.motions",
    "identify_dynamics": "api.dynamic",
    "validate": "api.validating",
    "export": "api.exporting",
    "compensate": "api.kinematic",
    "new_session": "api.sessions",
    "run_sessions": "api.sessions",
    "CalibratedChain": "robot.calibrated",
    "PoseSelection": "api.kinematic",
    "GeometryFit": "api.kinematic",
    "ExcitationDesign": "api.motions",
    "MotionPlan": "api.motions",
    "DynamicsModel": "api.dynamic",
    "JointCommands": "api.kinematic",
    "SelectionSettings": "procedure.kinematic_stage.settings",
    "FitSettings": "procedure.kinematic_stage.settings",
    "ExcitationSettings": "procedure.excitation.settings",
    "PlanSettings": "procedure.excitation.settings",
    "CalibError": "errors",
}

__all__ = [  # noqa: RUF022 (in the order of use)
    "load", "read_poses", "read_recording", "select_poses", "fit_geometry", "design_excitation", "plan_motion",
    "identify_dynamics", "validate", "export", "compensate", "new_session", "run_sessions", "CalibratedChain",
    "PoseSelection", "GeometryFit", "ExcitationDesign", "MotionPlan", "DynamicsModel", "JointCommands",
    "SelectionSettings", "FitSettings", "ExcitationSettings", "PlanSettings", "CalibError",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'calib' has no attribute {name!r}")
    value = getattr(import_module(f"calib.{_HOMES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
