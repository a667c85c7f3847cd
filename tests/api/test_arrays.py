"""Arrays in place of files: measurements, recordings, and what a robot says of a pose."""

import sys
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import calib
from calib.data.poses.measurements import PoseMeasurements, Poses, Positions
from calib.data.recordings.recording import Recording

OFFSETS = calib.FitSettings(model="offsets")
Q = np.random.default_rng(0).uniform(-2.0, 2.0, (60, 6))


@pytest.mark.slow
def test_fit_of_arrays_restores_their_robot():
    """A fit of arrays brings back the robot that made them."""
    robot = calib.load("ur5")
    pose = robot.forward(Q)
    turns = Rotation.from_matrix(pose[:, :3, :3]).as_quat()
    block = PoseMeasurements.of(Q, pose[:, :3, 3], turns, joint_names=robot.chain.joint_names)
    assert isinstance(block, Poses) and type(PoseMeasurements.of(Q, pose[:, :3, 3])) is Positions
    fit = calib.fit_geometry(robot, block, OFFSETS)
    np.testing.assert_allclose(fit.robot.forward(Q[0])[:3, 3], pose[0, :3, 3], atol=1e-6)
    for targets in (Q[:3], pose[:3]):
        found = calib.compensate(fit, targets, frame="nominal").q
        np.testing.assert_allclose(robot.forward(found), pose[:3], atol=1e-5)


def test_fit_predicts_tool_and_its_error():
    """With noise of 0.1 mm per axis: errors at new poses are below what is expected of them."""
    robot, rng = calib.load("ur5"), np.random.default_rng(1)
    fit = calib.fit_geometry(
        robot, PoseMeasurements.of(Q, robot.forward(Q)[:, :3, 3] + rng.normal(0, 1e-4, (60, 3))), OFFSETS
    )
    q = rng.uniform(-2.0, 2.0, (200, 6))
    pose, sigma = fit.predict(q)
    error = np.linalg.norm(pose[:, :3, 3] - robot.forward(q)[:, :3, 3], axis=1)
    assert pose.shape == (200, 4, 4) and sigma.shape == (200, 2) and (sigma > 0.0).all()
    assert np.sqrt(np.mean(error**2)) < np.sqrt(np.mean(sigma[:, 0] ** 2)) < 5e-4
    single = fit.predict(q[0])
    np.testing.assert_allclose(single.pose, pose[0])
    np.testing.assert_allclose(single.sigma, sigma[0])
    assert np.shape(fit.position_sigma(q[0])) == () and fit.position_sigma(q[:1]).shape == (1,)
    with pytest.raises(calib.CalibError, match="q: expected an array of shape"):
        fit.predict(q[:, :5])


def test_jacobian_is_slope_of_pose():
    """The Jacobian is the slope of the pose."""
    robot, step = calib.load("ur5"), 1e-6
    for j in range(6):
        away = step * np.eye(6)[j]
        slope = (robot.forward(Q + away) - robot.forward(Q - away))[:, :3, 3] / (2.0 * step)
        np.testing.assert_allclose(robot.jacobian(Q)[:, :3, j], slope, atol=1e-8)
    np.testing.assert_array_equal(robot.jacobian(Q[0]), robot.jacobian(Q)[0])


def test_joint_values_of_one_pose_give_one_pose():
    """(n,) gives (4, 4), (m, n) gives (m, 4, 4), and a wrong number of joints is an error."""
    robot = calib.load("ur5")
    np.testing.assert_array_equal(robot.forward(Q[0].tolist()), robot.forward(Q)[0])
    assert robot.forward(Q[:1]).shape == (1, 4, 4)
    with pytest.raises(calib.CalibError, match="q: expected an array of shape"):
        robot.forward(Q[0, :5])


def test_a_recording_of_arrays_has_names():
    log = Recording.of(np.arange(60) / 100.0, Q, 0.0 * Q)
    assert log.joint_names == ("q1", "q2", "q3", "q4", "q5", "q6") and log.kind == "torque"


def test_waypoints_limits_poses_in_memory(tmp_path):
    """Waypoints, limits and poses in memory are those of files."""
    way, limits = np.array([[0.0, -1.2, 1.2, 0.0, 0.6, 0.1], [0.8, -0.6, 0.9, 0.4, 0.2, 0.0]]), tmp_path / "l.toml"
    limits.write_text('[velocity]\nall = "60 deg/s"\n[acceleration]\nall = 4.0\n')
    (tmp_path / "way.csv").write_text("\n".join(["q1,q2,q3,q4,q5,q6", *(",".join(map(str, q)) for q in way)]))
    tables = {"velocity": {"all": "60 deg/s"}, "acceleration": {"all": np.float64(4.0)}}
    by_file = calib.plan_motion("ur5", tmp_path / "way.csv", limits=limits)
    in_memory = calib.plan_motion("ur5", way, limits=tables)
    np.testing.assert_array_equal(in_memory.track.q, by_file.track.q)
    there = calib.plan_motion("ur5", calib.load("ur5").forward(way), calib.PlanSettings(start=way[0]), limits=tables)
    np.testing.assert_allclose(there.track.q[-1], way[1], atol=1e-5)
    with pytest.raises(calib.CalibError, match="limits: velocity: there is no key 'q9'"):
        calib.plan_motion("ur5", way, limits={"velocity": {"q9": 1.0}})


@pytest.mark.slow
def test_constraints_and_poses_are_values(tmp_path):
    """Constraints, and poses measured before, are values, too."""
    (tmp_path / "c.toml").write_text("[joints]\nq1 = [-1.0, 1.0]\n")
    (tmp_path / "p.csv").write_text("\n".join(["q1,q2,q3,q4,q5,q6", *(",".join(map(str, q)) for q in Q[:20])]))
    settings = calib.SelectionSettings(method="detmax", candidates=100, climbs=0)
    block = PoseMeasurements.of(Q[:20], np.zeros((20, 3)))
    by_file, *others = (
        calib.select_poses("ur5", 6, settings, constraints=limits, existing=before).q
        for limits, before in (
            (tmp_path / "c.toml", tmp_path / "p.csv"),
            ({"joints": {"q1": [-1.0, 1.0]}}, Q[:20]),
            ({"joints": {"q1": (-1.0, 1.0)}}, block),
        )
    )
    assert np.abs(by_file[:, 0]).max() <= 1.0
    for q in others:
        np.testing.assert_array_equal(q, by_file)


@pytest.mark.slow
def test_notebook_shows_progress_in_one_line(monkeypatch):
    """A notebook shows progress in one line."""
    said = []
    line = SimpleNamespace(update=lambda content, raw: said.append(content.get("text/plain")))
    display = SimpleNamespace(display=lambda content, raw, display_id: line)
    shell = SimpleNamespace(kernel=None)
    monkeypatch.setitem(sys.modules, "IPython", SimpleNamespace(display=display, get_ipython=lambda: shell))
    calib.fit_geometry("ur5", PoseMeasurements.of(Q, calib.load("ur5").forward(Q)[:, :3, 3]), OFFSETS)
    assert said[0] == "reading" and len(said) > 4 and said[-1] is None, "the line is gone when the result is there"
