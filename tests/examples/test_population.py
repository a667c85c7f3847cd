"""Public arms with planted errors: the exported robot is right to the noise, in the frame where a tool hangs."""

from pathlib import Path

import numpy as np
import pytest
from planted_arms import ANGLE_ERROR, POSITION_ERROR, Arm, pinocchio_poses, target_link, yourdfpy_poses
from population import Conditions, calibrate_safely, classified
from robot_oracle import axis, joint, robot

# of each kind: a jaw, one name of link and joint, prefixes, a mimicking wrist, two leaves, two and seven axes
SAMPLE = (
    "Interbotix__px150",
    "RethinkRobotics__sawyer",
    "TechmanRobotInc__tm12-nominal",
    "TheRobotStudio__so101_old_calib",
    "UniversalRobots__ur_ur3e_tf_prefix_left",
    "abb__irb5400",
    "doosan-robotics__m1509",
    "fanuc__lrmate200id",
    "frankarobotics__fr3",
    "kroshu__kr210_r3300_2_k",
    "motoman__motopos_d500",
    "xArm-Developer__xarm_device_dof_7",
)
TEXT = robot(
    joint("a", "revolute", "base", "upper", axis("0 0 1"), xyz="0 0 0.4"),
    joint("b", "prismatic", "upper", "lower", axis("1 0 0"), xyz="0.3 0 0", rpy="0.1 0.2 1.5"),
    joint("c", "continuous", "lower", "wrist", axis("0 -1 0"), xyz="0 0.2 0"),
    joint("to_tool0", "fixed", "wrist", "tool0", xyz="0 0 0.1", rpy="0 1.5707963267948966 0"),
    joint("to_camera", "fixed", "lower", "camera", xyz="0 0 0.1"),
)
NOMINAL = Arm(TEXT, "base", "tool0")


@pytest.mark.slow
@pytest.mark.parametrize("name", SAMPLE)
def test_a_public_arm_is_exported_right(data: Path, name: str):
    row = calibrate_safely(data / "public_arms" / f"{name}.urdf", Conditions())
    assert row.group == "noise level", row


def test_errors_are_in_arm_joints_alone():
    """Over seeds positions have the stated size, turns too; what is no moving joint of the arm stays."""
    truths = [NOMINAL.with_errors(np.random.default_rng(seed)) for seed in range(100)]
    q = np.zeros((1, 3))
    first_joint = [pinocchio_poses(Arm(truth.text, "base", "upper"), q[:, :1])[0] for truth in truths]
    shifts = np.array([pose[:3, 3] - (0.0, 0.0, 0.4) for pose in first_joint])
    turns = np.array([(pose[2, 1] - pose[1, 2]) / 2 for pose in first_joint])
    assert shifts.std() == pytest.approx(POSITION_ERROR, rel=0.15)
    assert turns.std() == pytest.approx(ANGLE_ERROR, rel=0.25)
    mount = pinocchio_poses(Arm(TEXT, "lower", "camera"), np.zeros((1, 0)))
    assert pinocchio_poses(Arm(truths[0].text, "lower", "camera"), np.zeros((1, 0))) == pytest.approx(mount, abs=1e-12)


def test_both_readers_place_the_arm_alike():
    q = NOMINAL.postures(20, np.random.default_rng(0))
    assert np.abs(pinocchio_poses(NOMINAL, q) - yourdfpy_poses(NOMINAL, q)).max() < 1e-12


def test_postures_fill_the_limits():
    """Postures fill the limits, and half a turn of a continuous joint."""
    q = NOMINAL.postures(2000, np.random.default_rng(0))
    assert q.max(axis=0) == pytest.approx([2.0, 2.0, np.pi], rel=0.01)
    assert q.min(axis=0) == pytest.approx([-2.0, -2.0, -np.pi], rel=0.01)


def test_the_target_hangs_at_tool0():
    assert target_link(TEXT, "base", "wrist") == "tool0"
    assert target_link(TEXT.replace("tool0", "plate"), "base", "wrist") == "wrist"
    flange = TEXT.replace('"wrist"', '"left_flange"').replace('"tool0"', '"plate"')
    assert target_link(flange, "base", "plate") == "left_flange"
    assert target_link(TEXT.replace('"upper"', '"tool0_of_the_column"'), "base", "wrist") == "tool0"


def test_classes():
    assert classified("pass", 0.02, 0.02, limit=0.03) == "noise level"
    assert classified("marginal", 0.02, 0.04, limit=0.03) == "wrong frame"
    assert classified("pass", 0.04, 0.02, limit=0.03) == "above"
    assert classified("fail", 0.02, 0.02, limit=0.03) == "fail"


def test_an_error_is_a_row(tmp_path: Path):
    path = tmp_path / "broken.urdf"
    path.write_text("<robot>")
    row = calibrate_safely(path, Conditions())
    assert row.group == "error" and "broken.urdf" in row.remark
