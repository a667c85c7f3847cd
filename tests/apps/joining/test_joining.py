"""Joints and points in files of their own are joined by name, time, row or geometry; a session takes points alone."""

import csv
from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag2 import Writer
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation
from sessions import begin

import calib
from calib.cli import run
from calib.controllers.axes import plain_axes
from calib.controllers.table import controller_named
from calib.data.csv_table import read_table
from calib.data.poses.fit_options import FitOptions
from calib.data.poses.measurements import Positions
from calib.errors import MeasurementError, UsageError
from calib.procedure.session.folder import Session
from calib.procedure.session.geometry_steps import arrive, chain_of, read_measured
from calib.robot.chain import Chain, random_joints
from calib.robot.kinematics import forward
from calib.robot.library import load

SHUFFLED = np.random.default_rng(4).permutation(40)[:37]
JOINTS = [f"joint{k} [rad]" for k in range(1, 8)]
STORE = get_typestore(Stores.ROS2_HUMBLE)
POINT = ["x [mm]", "y [mm]", "z [mm]"]


def write(path: Path, header: list[str], rows: object) -> Path:
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([header, *rows])  # type: ignore[misc]
    return path


def seen(chain: Chain, q: np.ndarray, noise: float = 1.5) -> np.ndarray:
    """Return what an instrument sees of a target 0.12 m from the tip [mm], with errors of an uncalibrated arm."""
    arm = forward(chain, q)
    target = arm[:, :3, 3] + arm[:, :3, :3] @ [0.06, -0.04, 0.1]
    turn = np.array([[0.0, -0.6, 0.8], [1.0, 0.0, 0.0], [0.0, 0.8, 0.6]])
    return 1e3 * (target @ turn.T + [1.0, -3.0, 0.4]) + noise * np.random.default_rng(1).normal(size=(len(q), 3))


@pytest.fixture(scope="module")
def arm() -> Chain:
    return load("lwr4plus")


@pytest.fixture(scope="module")
def q(arm: Chain) -> np.ndarray:
    return random_joints(arm, 40, 5)


@pytest.fixture
def joints(tmp_path: Path, q: np.ndarray) -> Path:
    return write(tmp_path / "joints.csv", ["pose", *JOINTS], ([f"P{k + 1}", *row] for k, row in enumerate(q)))


def test_points_are_joined_by_name(tmp_path, joints, arm, q):
    """Points are joined by name, and missing ones are named."""
    points = seen(arm, q)
    named = write(tmp_path / "p.csv", ["Point Name", *POINT], ([f"p_{k + 1:03d}", *points[k]] for k in SHUFFLED))
    out = tmp_path / "measured.csv"
    assert run(["join", str(joints), str(named), "--out", str(out)]) == 0
    found = calib.join(joints, named)
    assert found.poses.tolist() == sorted(SHUFFLED.tolist())
    missing = ", ".join(f"P{k + 1}" for k in range(40) if k not in SHUFFLED)
    assert found.notes[-1] == f"without a point: 3 of 40 poses: {missing}"
    (block,) = calib.read_poses(out, "lwr4plus")
    assert isinstance(block, Positions)
    np.testing.assert_allclose(block.q, q[found.poses], atol=1e-9)
    np.testing.assert_allclose(1e3 * block.position, points[found.poses], rtol=1e-9)


def test_shuffled_points_found_by_geometry(tmp_path, joints, arm, q):
    """37 of 40 points in another order are found by the geometry."""
    points = write(tmp_path / "p.csv", POINT, seen(arm, q)[SHUFFLED])
    with pytest.raises(UsageError, match=r"40 rows of joints, 37 points cannot be joined.*give --robot"):
        calib.join(joints, points)
    found = calib.join(joints, points, robot="lwr4plus")
    np.testing.assert_allclose(
        np.column_stack([found.table.numbers(axis, "length") for axis in "xyz"]), 1e-3 * seen(arm, q)[found.poses]
    )


@pytest.mark.slow
def test_wrong_order_or_arm_is_noticed(tmp_path, joints, arm, q):
    """A wrong order of rows is noticed, and points of another arm are refused."""
    points = seen(arm, q)
    points[[3, 7]] = points[[7, 3]]
    found = calib.join(joints, write(tmp_path / "p.csv", POINT, points), by="row", robot="lwr4plus")
    np.testing.assert_allclose(found.table.numbers("x", "length")[3], 1e-3 * points[7, 0])
    other = write(tmp_path / "o.csv", POINT, seen(arm, random_joints(arm, 40, 9)))
    with pytest.raises(MeasurementError, match="do not fit the 40 poses in any order"):
        calib.join(joints, other, robot="lwr4plus")
    with pytest.raises(UsageError, match="links of a robot: give --robot"):
        calib.join(joints, joints, tip="tool0")
    with pytest.raises(UsageError, match="by 'rows' is not one of name, time, row, geometry"):
        calib.join(joints, other, by="rows")


def test_columns_of_any_name_are_stated_in_options(tmp_path, arm, q):
    """Columns, units and angles of both files are as the options state them, and the result needs no options."""
    angles = np.random.default_rng(3).uniform(-80.0, 80.0, (40, 3))
    rows = np.column_stack([seen(arm, q), angles])
    header = ["x", "Xl", "Yl", "Zl", "A", "B", "C"]
    points = write(tmp_path / "p.csv", header, np.column_stack([np.zeros(40), rows]))
    log = write(tmp_path / "j.csv", [f"A{k}" for k in range(1, 8)], np.degrees(q))
    options = tmp_path / "o.toml"
    columns = [f'q{k} = "A{k}"' for k in range(1, 8)]
    units = '[units]\njoints = "deg"\nposition = "mm"\norientation = "deg"\n'
    text = "\n".join(["[columns]", 'x = "Xl"', 'y = "Yl"', 'z = "Zl"', *columns, units])
    options.write_text('euler = "zyx moving"\n' + text)
    out = tmp_path / "m.csv"
    assert (
        run(["join", str(log), str(points), "--options", str(options), "--robot", "lwr4plus", "--out", str(out)]) == 0
    )
    (block,) = calib.read_poses(out, "lwr4plus")
    np.testing.assert_allclose(block.q, q, atol=1e-9)
    np.testing.assert_allclose(1e3 * block.position, seen(arm, q), rtol=1e-9)
    turns = Rotation.from_euler("ZYX", angles, degrees=True).as_matrix()
    np.testing.assert_allclose(Rotation.from_quat(block.quaternion).as_matrix(), turns, atol=1e-9)
    notes = calib.join(log, points, options=options).notes
    assert any("Xl, Yl, Zl read as x, y, z" in note for note in notes)
    assert any("column x is not read" in note for note in notes)
    assert any("order not checked: give --robot" in note for note in notes)
    options.write_text('[columns]\nx = "Xe"')
    with pytest.raises(UsageError, match=r"columns.x: no file has a column 'Xe'.*p.csv has x, Xl"):
        calib.join(log, points, options=options)


def test_systematic_names_need_no_options(tmp_path, arm, q):
    """Joints by number and positions by the shape of their names are read as `calib fit` reads them, units too."""
    log = write(tmp_path / "j.csv", [f"A{k}" for k in range(1, 8)], np.degrees(q))
    header = ["Punkt", "tracker pos X", "tracker pos Y", "tracker pos Z"]
    points = write(tmp_path / "p.csv", header, ([f"P{k + 1}", *seen(arm, q)[k]] for k in SHUFFLED))
    joined = calib.join(log, points, robot="lwr4plus")
    assert any("joined by geometry" in note for note in joined.notes)
    assert any("tracker pos Z read as x, y, z" in note for note in joined.notes)
    np.testing.assert_allclose(1e3 * joined.table.numbers("x", "length"), seen(arm, q)[joined.poses, 0], rtol=1e-9)
    np.testing.assert_allclose(joined.table.numbers("A3", "angle"), q[joined.poses, 2], atol=1e-9)


@pytest.mark.slow
def test_joints_as_a_controller_shows_them(tmp_path):
    """Joint values as a FANUC shows them are named as such, and converted where the options say so."""
    robot = Path(__file__).parents[1] / "controller_programs/fanuc_m20ia.urdf"
    arm = load(robot)
    q = random_joints(arm, 30, 5)
    shown = plain_axes(6).shown(controller_named("fanuc"), q)
    joints = write(tmp_path / "j.csv", [f"q{k} [deg]" for k in range(1, 7)], shown)
    points = write(tmp_path / "p.csv", POINT, seen(arm, q))
    with pytest.raises(MeasurementError, match=r"its points fit the joints as FANUC.*state controller = \"fanuc\""):
        calib.join(joints, points, robot=robot)
    joined = calib.join(joints, points, robot=robot, options=FitOptions(controller="fanuc"))
    np.testing.assert_allclose(joined.table.numbers(arm.joint_names[2], "angle"), q[:, 2], atol=1e-9)
    with pytest.raises(UsageError, match=r"controller = .fanuc.*give --robot"):
        calib.join(joints, points, options=FitOptions(controller="fanuc"))


def test_near_readings_are_averaged(tmp_path, joints, arm, q):
    """Readings 5 mm apart are named, and near ones are averaged with their scatter."""
    points, rng = seen(arm, q), np.random.default_rng(2)
    rows = [[f"P{k + 1}", *(points[k] + 0.02 * rng.normal(size=3))] for k in range(40) for _ in range(2)]
    rows[8][1] += 5.0
    found = calib.join(joints, write(tmp_path / "p.csv", ["Name", *POINT], rows))
    assert 4 not in found.poses and len(found.poses) == 39
    assert any("pose P5 left out: its readings (rows 9, 10) differ by" in note for note in found.notes)
    sigma = found.table.numbers("sigma_x", "length")
    assert sigma == pytest.approx(0.02e-3 / np.sqrt(2.0), rel=0.3)


def test_points_join_log_where_arm_stands(tmp_path, arm, q):
    """Points join a log by time where the arm stands."""
    times = np.arange(0.0, 80.0, 0.1)
    at = np.interp(times, np.repeat(2.0 * np.arange(40), 2) + np.tile([0.0, 1.5], 40), np.arange(80) // 2)
    values = (
        q[np.floor(at).astype(int)] + (at % 1.0)[:, None] * np.diff(q, axis=0, append=q[-1:])[np.floor(at).astype(int)]
    )
    log = write(tmp_path / "log.csv", ["time [s]", *JOINTS], np.column_stack([times, values]))
    taken = 2.0 * np.arange(40) + 0.75
    taken[6] += 1.0  # while it moves
    points = write(tmp_path / "p.csv", ["t [ms]", *POINT], np.column_stack([1e3 * taken, seen(arm, q)]))
    found = calib.join(log, points)
    assert len(found.poses) == 39 and any("while the arm moved: rows 7" in note for note in found.notes)
    np.testing.assert_allclose(found.table.numbers("joint3", "angle"), np.delete(q, 6, axis=0)[:, 2], atol=1e-9)
    late = write(tmp_path / "late.csv", ["t [s]", *POINT], np.column_stack([taken + 9e4, seen(arm, q)]))
    with pytest.raises(MeasurementError, match="are both times of the same clock"):
        calib.join(log, late)


@pytest.fixture
def planned(tmp_path: Path, q: np.ndarray) -> Session:
    session = begin(tmp_path / "cell", "lwr4plus", "tracker", 40, 0, dynamics=False)
    write(session.path("2-poses/poses.csv"), JOINTS, q)
    return session


@pytest.mark.slow
def test_session_takes_points_alone(planned, arm, q):
    """A session takes points alone with the planned joints."""
    path = write(planned.path("3-measured/points.csv"), POINT, seen(arm, q)[SHUFFLED])
    notes = [str(note) for note in arrive(planned, print)]
    assert any("those of the planned poses are used, σ 0.1" in note for note in notes)
    missing = ", ".join(str(k + 1) for k in range(40) if k not in SHUFFLED)
    assert any(note.startswith(f"3 of 40 planned poses remain to be measured: {missing} (") for note in notes)
    ((_, block),) = read_measured(planned, chain_of(planned), [path])
    np.testing.assert_allclose(block.q, q[sorted(SHUFFLED)], atol=1e-12)


@pytest.mark.slow
def test_interrupted_run_has_a_second_file(planned, arm, q):
    """An interrupted run goes on in a second file."""
    points = seen(arm, q)
    write(planned.path("3-measured/a.csv"), POINT, points[:25])
    assert any("15 of 40 planned poses remain" in note.text for note in arrive(planned, print))
    write(planned.path("3-measured/b.csv"), POINT, points[:24:-1])
    assert not any("remain" in note.text for note in arrive(planned, print))


def test_few_points_need_names(planned, arm, q):
    points = seen(arm, q)[30:33]
    path = write(planned.path("3-measured/rest.csv"), POINT, points)
    with pytest.raises(MeasurementError, match=r"3 points are too few.*column 'pose'"):
        arrive(planned, print)
    write(path, ["pose", *POINT], ([31 + k, *point] for k, point in enumerate(points)))
    ((_, block),) = read_measured(planned, chain_of(planned), [path])
    np.testing.assert_allclose(block.q, q[30:33])


def test_a_written_join_is_read_back(tmp_path, joints, arm, q):
    found = calib.join(joints, write(tmp_path / "p.csv", POINT, seen(arm, q)))
    table = read_table(found.write(tmp_path / "m.csv"))
    assert table.header == ("pose", *(name[:6] for name in JOINTS), "x", "y", "z") and len(table) == 40


def test_joint_states_of_a_bag_are_joints(tmp_path, arm, q):
    """A bag with one joint state per pose is joined to points of the same times, in any order."""
    state = STORE.types["sensor_msgs/msg/JointState"]
    header, stamp = (STORE.types[name] for name in ("std_msgs/msg/Header", "builtin_interfaces/msg/Time"))
    with Writer(tmp_path / "bag", version=9) as writer:
        topic = writer.add_connection("/joint_states", state.__msgtype__, typestore=STORE)
        for number, row in enumerate(q):
            message = state(
                header(stamp(100 + 9 * number, 0), ""), list(arm.joint_names), row, np.zeros(0), np.zeros(0)
            )
            writer.write(topic, 10**9 * (100 + 9 * number), STORE.serialize_cdr(message, state.__msgtype__))
    times = 100.0 + 9.0 * SHUFFLED
    points = write(tmp_path / "p.csv", ["t [s]", *POINT], np.column_stack([times, seen(arm, q)[SHUFFLED]]))
    calib.join(tmp_path / "bag", points, robot="lwr4plus").write(tmp_path / "m.csv")
    table = read_table(tmp_path / "m.csv")
    measured = np.column_stack([table.numbers(f"q_{name}") for name in arm.joint_names])
    np.testing.assert_allclose(measured, q[SHUFFLED], atol=1e-6)
