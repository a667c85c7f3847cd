"""Exports of calibrated geometry and identified dynamics in the formats of other programs, and validation.

Validation compares a result with measurements that were not used for its estimation.
"""

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import overload

from calib.api.dynamic import DynamicsModel, Recorded
from calib.api.kinematic import GeometryFit, Measured, Several
from calib.api.rendering import listed, optional, saved
from calib.arguments import checked
from calib.errors import CalibWarning, UsageError, require
from calib.procedure.dynamic_stage import identify as arm_identify
from calib.procedure.kinematic_stage import fit as arm_fit
from calib.procedure.kinematic_stage import inputs as measured
from calib.procedure.robot_kinds import MechanismResult
from calib.results.result import ExportSettings, Result
from calib.results.result_classes import open_result


@overload
def validate(result: GeometryFit, unseen: Several) -> GeometryFit: ...
@overload
def validate(result: DynamicsModel, unseen: Recorded | Sequence[Recorded]) -> DynamicsModel: ...
@overload
def validate(result: MechanismResult, unseen: Several | Recorded | Sequence[Recorded]) -> MechanismResult: ...
@checked
def validate(
    result: GeometryFit | DynamicsModel | MechanismResult,
    unseen: Measured | Recorded | Sequence[Measured | Recorded | Sequence[Measured]],
) -> GeometryFit | DynamicsModel | MechanismResult:
    """Return a result validated on further measurements that were not fitted, with an updated verdict.

    Args:
        result: a fit or an identification; its parameters are not changed.
        unseen: measurements or recordings, as files or in memory; they are added to those of earlier validations.

    Returns:
        The result with its errors on all held-out rows and the updated verdict.

    Raises:
        MeasurementError: a file is implausible; the message names row and column.
    """
    sources = listed(unseen)
    require(sources, "validate: unseen is empty; give poses or recordings to validate on", UsageError)
    if isinstance(result, GeometryFit):
        fit_inputs = measured.with_unseen(result.inputs, sources, result.options, result.settings)
        return arm_fit.assessed(result, fit_inputs)
    if not isinstance(result, DynamicsModel):
        return result.with_unseen(sources)
    return arm_identify.assessed(result, result.inputs.with_unseen(sources))


@checked
def export(
    result: Result | str | Path,
    into: str | Path,
    *,
    urdf: str | Path | None = None,
    prior: str = "entropic",
    ros2: str = "",
    moveit: Sequence[str | Path] = (),
    control: bool = False,
    overwrite: bool = False,
) -> tuple[str, ...]:
    """Write a calibrated robot, with its dynamics if identified, to files for other programs.

    A fit is written as robot.urdf, joint_offsets.csv, ur_kinematics.yaml (UR arms) and joint corrections, if there are
    any. An identification is written with masses and friction, as URDF, MJCF, drives.csv and parameters.json. Each file
    is verified by an independent reader before it is moved to its final name. If the verdict is not pass, a warning
    with the reason is issued, and is written into the URDFs and README.txt.

    Args:
        result: a fit, an identification, or the folder of one.
        into: folder for the files.
        urdf: description of the nominal robot to edit; all content except the calibrated values is kept. None takes the
            file from which the fit's robot was read.
        prior: regularisation of inertial parameters that the torques do not identify, ``entropic`` or ``euclidean``.
        ros2: name of a ROS 2 package to write into the folder instead of the other files (``calib formats ros2``);
            empty for no package.
        moveit: MoveIt files, or a folder with them, to copy into the package.
        control: True: write a ros2_control element for mock hardware into the package's URDF if it has none.
        overwrite: True: replace existing files of the package.

    Returns:
        Remarks on the written files, as text.

    Raises:
        RobotError: a file, read back, differs from the robot; this file is not written.
    """
    settings = ExportSettings(optional(urdf), prior, ros2, tuple(map(Path, moveit)), control, overwrite)
    with saved(result) as folder:
        exported = open_result(folder, "export").export(Path(into), settings)
    for line in exported.verdicts:
        warnings.warn(line, CalibWarning, stacklevel=3)
    return (*exported.verdicts, *exported.remarks)
