"""A log without torques is referred to the file that has them, and to no other."""

from pathlib import Path

import numpy as np
import pytest

from calib.data.recordings.recording_files import read_recording
from calib.data.schema import Joints
from calib.errors import MeasurementError

ROBOT = Joints(("shoulder_pan", "elbow_flex", "wrist_roll"))


def log(path: Path, *quantities: str, start: float = 0.0) -> Path:
    """Write a log of 20 rows at 100 Hz with columns of the joints for each quantity."""
    header = ["t [s]"]
    for quantity in quantities:
        header += [f"{joint}_{quantity}" for joint in ROBOT.names]
    t = start + 0.01 * np.arange(20)
    values = np.sin(t[:, None] + np.arange(len(header) - 1))
    np.savetxt(path, np.column_stack([t, values]), delimiter=",", header=",".join(header), comments="")
    return path


def refusal(path: Path, *companions: Path) -> str:
    with pytest.raises(MeasurementError) as error:
        read_recording(path, ROBOT, companions=companions)
    return str(error.value)


def test_file_of_the_same_command_is_proposed(tmp_path):
    """The second recording is named, not a complete log that stands before it in the folder."""
    log(tmp_path / "both.csv", "position", "effort")
    log(tmp_path / "a_effort.csv", "effort")
    position = log(tmp_path / "position.csv", "position")
    effort = log(tmp_path / "effort.csv", "effort")
    assert f"{effort} has torques" in refusal(position, position, effort)
    assert f"calib join {effort} {position} " in refusal(effort, effort, position)


def test_file_beside_has_the_same_times_and_joints(tmp_path):
    """Complete logs, logs of other times and of other joints are not proposed."""
    position = log(tmp_path / "position.csv", "position")
    log(tmp_path / "both.csv", "position", "effort")
    log(tmp_path / "a_later.csv", "effort", start=100.0)
    (tmp_path / "b_effort.csv").write_text("t [s],effort_x\n0,1\n1,2\n")
    assert "OTHER.csv" in refusal(position)
    effort = log(tmp_path / "effort.csv", "effort")
    assert f"calib join {position} {effort} " in refusal(position)
