"""Arrays in place of files: measurements, recordings, and what a robot says of a pose."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

import calib
from calib.data.poses.measurements import PoseMeasurements, Poses, Positions
from calib.data.recordings.recording import Recording

Q = np.random.default_rng(0).uniform(-2.0, 2.0, (60, 6))


def test_a_fit_of_arrays_brings_back_the_robot_that_made_them():
    robot = calib.load("ur5")
    pose = robot.forward(Q)
    turns = Rotation.from_matrix(pose[:, :3, :3]).as_quat()
    block = PoseMeasurements.of(Q, pose[:, :3, 3], turns, joint_names=robot.chain.joint_names)
    assert isinstance(block, Poses) and type(PoseMeasurements.of(Q, pose[:, :3, 3])) is Positions
    fit = calib.fit_geometry(robot, block, calib.FitSettings(model="offsets"))
    np.testing.assert_allclose(fit.robot.forward(Q[0])[0, :3, 3], pose[0, :3, 3], atol=1e-6)
    for targets in (Q[:3], pose[:3]):
        found = calib.compensate(fit, targets, frame="nominal").q
        np.testing.assert_allclose(robot.forward(found), pose[:3], atol=1e-5)


def test_the_jacobian_is_the_slope_of_the_pose():
    robot, step = calib.load("ur5"), 1e-6
    for j in range(6):
        away = step * np.eye(6)[j]
        slope = (robot.forward(Q + away) - robot.forward(Q - away))[:, :3, 3] / (2.0 * step)
        np.testing.assert_allclose(robot.jacobian(Q)[:, :3, j], slope, atol=1e-8)


def test_a_recording_of_arrays_has_names():
    log = Recording.of(np.arange(60) / 100.0, Q, 0.0 * Q)
    assert log.joint_names == ("q1", "q2", "q3", "q4", "q5", "q6") and log.kind == "torque"
