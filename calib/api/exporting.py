"""Exports of calibrated geometry and identified dynamics in the formats of other programs, and validation.

Validation compares a result with measurements that it was not estimated from.
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
from calib.results.registry import open_result
from calib.results.result import ExportSettings, Result


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
    """Validate a result on unseen poses or motion, and update its verdict.

    Args:
        result: a fit or an identification; its parameters stay unchanged.
        unseen: measurements or recordings, as files or in memory, in addition to those it was validated on before.

    Returns:
        The result with its errors on all unseen rows and the updated verdict.

    Raises:
        MeasurementError: for implausible files, naming row and column.
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
    """Write a calibrated robot, with identified dynamics if available, for other programs.

    A fit is written as robot.urdf, joint_offsets.csv, ur_kinematics.yaml (UR arms) and joint corrections, if there are
    any.
    An identification is written with masses and friction, as URDF, MJCF, drives.csv and parameters.json. Each file is
    verified by an independent reader before it is moved to its place. If the verdict is not pass, a warning with the
    reason is given, and written into the URDFs and README.txt.

    Args:
        result: a fit, an identification, or the folder of one.
        into: folder for the files.
        urdf: description of the nominal robot to edit, of which everything else is kept; None: the fit's own source.
        prior: regularisation of masses that the torques do not identify, ``entropic`` or ``euclidean``.
        ros2: name of a ROS 2 package to write into the folder instead of the other files (``calib formats ros2``);
            empty:
            no package.
        moveit: MoveIt files, or a folder with them, to copy into the package.
        control: whether to write a ros2_control for mock hardware into the package's URDF if it has none.
        overwrite: whether to replace existing files of the package.

    Returns:
        Remarks on the written files, as text.

    Raises:
        RobotError: if a file, read back, differs from the robot; it is not written.
    """
    settings = ExportSettings(optional(urdf), prior, ros2, tuple(map(Path, moveit)), control, overwrite)
    with saved(result) as folder:
        exported = open_result(folder, "export").export(Path(into), settings)
    for line in exported.verdicts:
        warnings.warn(line, CalibWarning, stacklevel=3)
    return (*exported.verdicts, *exported.remarks)
