"""Writing simulated measurements and logs as CSV files for `calib`."""

import io
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from calib import files
from calib.data.poses.measurements import Poses, Positions
from calib.data.poses.pose_lists import read_poses
from calib.data.recordings.recording import Recording
from calib.robot.chain import Chain


def planned(folder: Path, arm: Chain) -> Iterator[tuple[int, str, np.ndarray]]:
    """Yield the pose lists planned by the session in `folder` for an arm: number, name when measured, q (m, n)."""
    kinds = [joint.kind for joint in arm.joints]
    for number, (plan, name) in enumerate((("poses", "measured"), ("validation", "validation"))):
        if (path := folder / f"2-poses/{plan}.csv").exists():
            yield number, name, read_poses(path, arm.joint_names, kinds=kinds)


def write(measured: Positions, path: str | Path, degrees: bool = True) -> Path:
    """Write poses or positions as CSV: joints in deg, positions in mm, as controllers and instruments give them.

    Args:
        measured: positions or poses of one target; every joint revolute where `degrees`.
        path: of the file.
        degrees: False for SI units throughout.
    """
    angle, length, unit = (180.0 / np.pi, 1e3, ("deg", "mm")) if degrees else (1.0, 1.0, ("rad", "m"))
    columns = [angle * measured.q, length * measured.position]
    header = [f"{name} [{unit[0]}]" for name in measured.joint_names] + [f"{axis} [{unit[1]}]" for axis in "xyz"]
    if isinstance(measured, Poses):
        columns.append(measured.quaternion)
        header += ["qx", "qy", "qz", "qw"]
    if measured.sigma is not None:
        columns.append(length * measured.sigma)
        header += [f"sigma_{axis} [{unit[1]}]" for axis in "xyz"]
    if isinstance(measured, Poses) and measured.sigma_rotation is not None:
        columns.append(measured.sigma_rotation)
        header += [f"sigma_r{axis}" for axis in "xyz"]
    return files.write_numbers(path, header, np.hstack(columns))


def write_log(recording: Recording, path: str | Path, degrees: bool = True) -> Path:
    """Write a recording as CSV: ``t [s]``, ``q_joint [deg]``, ``tau_joint [Nm]`` and, of sensors, ``tau_link_joint``.

    Seven digits, as controllers log.
    """
    angle, unit = (180.0 / np.pi, "deg") if degrees else (1.0, "rad")
    series = [("q", angle * recording.q, unit), ("tau", recording.effort, "Nm")]
    if recording.tau_link is not None:
        series.append(("tau_link", recording.tau_link, "Nm"))
    header = ["t [s]", *(f"{key}_{name} [{unit}]" for key, _, unit in series for name in recording.joint_names)]
    table = np.hstack([recording.t[:, None], *(values for _, values, _ in series)])
    text = io.StringIO()
    text.write(",".join(header) + "\n")
    np.savetxt(text, table, fmt=["%.4f"] + ["%.7g"] * (table.shape[1] - 1), delimiter=",")
    return files.write(path, text.getvalue())
