"""Reading of robots and measurements from files, as inputs of the API functions."""

from pathlib import Path
from typing import cast

from calib.api.rendering import optional
from calib.arguments import checked
from calib.data.poses.fit_options import FitOptions, read_options
from calib.data.poses.measurements import PoseMeasurements
from calib.data.recordings.recording import Recording
from calib.data.recordings.recording_files import read_recording as read_file
from calib.data.recordings.recording_options import RecordingOptions
from calib.procedure.kinematic_stage import inputs
from calib.procedure.robot_kinds import Mechanism, mechanism, stage_of
from calib.robot.calibrated import CalibratedChain
from calib.robot.library import load_calibrated


@checked
def load(robot: str | Path, *, base: str | None = None, tip: str | None = None) -> CalibratedChain:
    """Return a robot read from a file, a folder or the library.

    Args:
        robot: a ``.urdf``, an MDH table in TOML, a library name (``lwr4plus tx40 rv2sq ur5 ur10 ur10e panda iiwa14``),
            or the folder of an earlier fit. From a fit, nominal robot, covariance and joint corrections are also read.
            For a parallel robot (``dualv fivebar stewart``, or a TOML of legs) the result is a
            `calib.procedure.robot_kinds.Mechanism`, which the other API functions also accept.
        base, tip: first and last link of the arm in a URDF; None takes the root, and the flange as found by
            `calib.robot.formats.arm_ends`. ``print`` names the chosen link and the reason.

    Returns:
        The robot. Its ``nominal``, ``covariance`` and ``corrections`` are None unless it was read from a fit.

    Raises:
        RobotError: the robot is not found, or its file is invalid; the message gives the line and advice.
    """
    if stage_of(robot, "identify", base, tip) is not None:
        return cast(CalibratedChain, mechanism(robot))
    return load_calibrated(robot, base, tip)


@checked
def read_poses(
    path: str | Path, robot: str | Path | CalibratedChain, *, options: FitOptions | str | Path | None = None
) -> tuple[PoseMeasurements, ...]:
    """Return measured poses, positions, distances, sockets or planes of a robot, read from a CSV file.

    Args:
        path: the file; ``calib formats measurements`` describes its columns and units.
        robot: robot whose joints the columns name: an argument or the result of `load`.
        options: units and columns that the header does not state, or a TOML file with them (``calib formats options``).
            None where the header states all.

    Returns:
        One block per kind of measurement and station, joints [rad, m], lengths [m].

    Raises:
        MeasurementError: the file is invalid; the message names file, row, column and the likely cause.
    """
    if not isinstance(options, FitOptions):
        options = read_options(optional(options))
    stage_of(robot, "calib.read_poses")
    blocks = inputs.read_file(Path(path), _loaded(robot).complete, options)
    return tuple(blocks)


@checked
def read_recording(
    path: str | Path, robot: str | Path | CalibratedChain | Mechanism, *, options: RecordingOptions | None = None
) -> Recording:
    """Return a log of joint positions and torques (or currents), read from npz, CSV, a ROS bag or MCAP.

    Args:
        path: the file; ``log.npz@0:9.4`` reads only seconds 0 to 9.4.
        robot: robot whose joints are logged: an argument or the result of `load`.
        options: units and columns that the file does not state
            (`calib.data.recordings.recording_options.RecordingOptions`); None takes the defaults.

    Raises:
        MeasurementError: the file is invalid; the message names file, row, column and the likely cause.
    """
    # The dynamics' modules: none of the geometry's.
    from calib.procedure.robot_kinds import joints_of

    parallel_robot = mechanism(robot)
    if parallel_robot is None:
        chain = _loaded(cast(str | Path | CalibratedChain, robot)).chain
    else:
        chain = parallel_robot.chain
    return read_file(path, joints_of(chain), options or RecordingOptions())


def _loaded(robot: str | Path | CalibratedChain) -> CalibratedChain:
    return robot if isinstance(robot, CalibratedChain) else load_calibrated(robot)
