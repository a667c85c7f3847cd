"""Compensation proved on measured poses kept aside: the command for a pose against the joints it was measured at.

The pose that was measured is the target, the nominal robot's joints for it are where compensation starts. Had the
command been sent, the tool would have missed the target by what the command differs from the joints at which the robot
really stood there; the nominal robot's kinematics turn that difference into mm, so that the calibrated model is not
its own judge. (The tool on it is where the calibration puts it: in the Motoman's small box the nominal robot's own best
guess of it is 0.67 m off, and turns of 0.2 mrad would count with that lever.)
"""

from dataclasses import replace

import numpy as np
import pytest

from calib import cli
from calib.data.poses.measurements import Poses
from calib.data.poses.pose_lists import Targets
from calib.geometry import inverse
from calib.geometry.inverse import Goal
from calib.procedure.kinematic_stage import compensation, inputs
from calib.procedure.kinematic_stage.settings import FitSettings
from calib.transforms import from_quaternion

CASES = [  # folder, robot, file, held-out share, goal [mm]
    ("motoman_leica", "model_right.urdf", "right_6x6x6_150.csv", 1 / 3, 0.075),
    pytest.param("ur5_gts3800", "model.urdf", "grid_800.csv", 0.25, 0.07, marks=pytest.mark.slow),
    pytest.param("ur10_ipa", "model.urdf", "A_grid_2500.csv", 0.4, 0.12, marks=pytest.mark.slow),
]


@pytest.mark.slow
@pytest.mark.parametrize(("folder", "robot", "file", "share", "goal"), CASES)
def test_commands_for_measured_poses_are_the_joints_they_were_measured_at(
    data, tmp_path, capsys, folder, robot, file, share, goal
):
    robot, file = data / folder / robot, data / folder / file
    arguments = ["fit", robot, file, "--holdout", share, "--out", tmp_path / "done", "--no-plots"]
    assert cli.run([str(each) for each in arguments]) == 0
    unseen = inputs.gather(robot, [file], settings=FitSettings(holdout=share)).unseen[file.name].block
    fitted = compensation.read(tmp_path / "done")
    turns = from_quaternion(unseen.position, unseen.quaternion)[:, :3, :3] if isinstance(unseen, Poses) else None
    targets = Targets(unseen.q, unseen.position, turns, file=file.name)
    found = compensation.compensate(
        fitted, targets, frame=unseen.station, tool=unseen.tool_names[0], tolerance=(1e-6, 1e-5)
    )
    arms = compensation.placements(fitted, unseen.station, unseen.tool_names[0])
    ruler = Goal(replace(arms[0], tools=arms[1].tools))
    stood = inverse.seen_at(ruler, unseen.q).poses()
    off = {
        name: np.linalg.norm(inverse.differences(ruler, q, stood)[:, :3], axis=1)[found.reached]
        for name, q in (("nominal", found.nominal), ("compensated", found.q))
    }
    rms = {name: 1e3 * np.sqrt(np.mean(sizes**2)) for name, sizes in off.items()}
    with capsys.disabled():
        print(
            f"\n  {folder} {file.name}, {int(found.reached.sum())} of {len(unseen)} held-out poses: "
            f"{rms['nominal']:.3f} mm with the nominal joints, {rms['compensated']:.4f} mm with the commands"
        )
    assert found.reached.mean() > 0.97
    assert rms["compensated"] < goal
    assert rms["compensated"] < 0.5 * rms["nominal"]
    assert rms["compensated"] == pytest.approx(1e3 * fitted.unseen, rel=0.1)
