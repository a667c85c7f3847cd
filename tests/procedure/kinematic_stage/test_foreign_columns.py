"""Files with the columns of controllers and other programs: read where names, numbers and the arm leave one reading."""

from itertools import chain as joined

import numpy as np
import pytest
from robot_oracle import axis, joint, robot
from scipy.spatial.transform import Rotation

from calib.data.poses.fit_options import FileOptions, FitOptions
from calib.data.poses.measurements import Positions
from calib.data.poses.pose_files import read_measurements
from calib.data.schema import Joints
from calib.errors import MeasurementError, RobotError, UsageError
from calib.geometry.checks.readings import without_unseen
from calib.procedure.kinematic_stage.inputs import load_robot, read_file
from calib.robot.kinematics import forward
from calib.robot.library import load

COUNT = 16
DEGREES = 180.0 / np.pi
STATION = Rotation.from_euler("xyz", [0.3, -0.2, 2.0])
TOOL = Rotation.from_euler("xyz", [0.4, 0.7, -0.5])
SIX = range(1, 7)


@pytest.fixture(scope="module")
def arm():
    """Return the arm, joint values and the poses that an instrument sees."""
    chain = load("ur5")
    q = np.random.default_rng(5).uniform(-2.2, 2.2, (COUNT, 6))
    pose = forward(chain, q)
    rotation = STATION * Rotation.from_matrix(pose[:, :3, :3])
    position = STATION.apply(pose[:, :3, 3]) + np.array([1.0, 2.0, 0.5]) + rotation.apply([0.02, 0.05, 0.1])
    return chain, q, position, rotation * TOOL


def written(path, header, columns, separator=",", mark="."):
    """Write columns to a file, with a header or without."""
    lines = [separator.join(header)] if header else []
    rows = np.column_stack(columns)
    lines += [separator.join(f"{value:.6f}".replace(".", mark) for value in row) for row in rows]
    path.write_text("\n".join([*lines, ""]))
    return path


def matrices(position, rotation):
    """Return (m, 4, 4) poses."""
    result = np.tile(np.eye(4), (len(position), 1, 1))
    result[:, :3, :3] = rotation.as_matrix()
    result[:, :3, 3] = position
    return result


def numbered(*forms):
    return list(joined(*([form.format(number) for number in SIX] for form in forms)))


SCALAR_FIRST = [3, 0, 1, 2]
FORMS = {
    "kuka": lambda q, p, r: (
        [*numbered("A{}"), "X", "Y", "Z", "A", "B", "C"],
        [q * DEGREES, p * 1e3, r.as_euler("ZYX", degrees=True)],
    ),
    "kawasaki": lambda q, p, r: (
        [*numbered("JT{} / °"), *(f"{name} / mm" for name in "XYZ"), *(f"{name} / °" for name in "OAT")],
        [q * DEGREES, p * 1e3, r.as_euler("ZYZ", degrees=True)],
    ),
    "abb": lambda q, p, r: (
        [*numbered("rax_{}"), "x_mm", "y_mm", "z_mm", "q1", "q2", "q3", "q4"],
        [q * DEGREES, p * 1e3, r.as_quat()[:, SCALAR_FIRST]],
    ),
    "yaskawa": lambda q, p, r: (
        [*"SLURBT", "X", "Y", "Z", "Rx", "Ry", "Rz"],
        [q * DEGREES, p * 1e3, r.as_euler("xyz", degrees=True)],
    ),
    "ros": lambda q, p, r: (
        [
            *numbered("joint{}.pos"),
            *(f"pose.position.{axis}" for axis in "xyz"),
            *(f"pose.orientation.{axis}" for axis in "xyzw"),
        ],
        [q, p, r.as_quat()],
    ),
    "opencv": lambda q, p, r: (
        [*numbered("theta{}"), *(f"tvec[{k}]" for k in range(3)), *(f"rvec[{k}]" for k in range(3))],
        [q, p, r.as_rotvec()],
    ),
    "figaroh": lambda q, p, r: (
        ["x1", "y1", "z1", "phix1", "phiy1", "phiz1", *numbered("q{}")],
        [p, r.as_euler("xyz"), q],
    ),
    "rows of a matrix": lambda q, p, r: (
        [*numbered("q{}"), *(f"T_{i}{j}" for i in range(4) for j in range(4))],
        [q, matrices(p, r).reshape(-1, 16)],
    ),
    "columns of a matrix": lambda q, p, r: (
        [*numbered("q{}"), *(f"pose_{k}" for k in range(16))],
        [q, np.swapaxes(matrices(p, r), 1, 2).reshape(-1, 16)],
    ),
    "auto id": lambda q, p, r: (None, [p * 1e3, r.as_euler("xyz", degrees=True), q * DEGREES]),
    "counted": lambda q, p, r: (None, [np.arange(COUNT), q, p, r.as_quat()]),
}


SEPARATORS = [(",", "."), (";", ","), ("\t", ".")]
# Several readings of their angles are possible until the arm decides, which takes long: one separator for each of them.
DECIDED_BY_ARM = {"kuka": ";", "kawasaki": "\t", "yaskawa": ",", "figaroh": ";", "auto id": "\t"}
READ = [
    (name, separator, mark)
    for name in FORMS
    for separator, mark in SEPARATORS
    if DECIDED_BY_ARM.get(name, separator) == separator
]


def test_every_form_is_read_with_some_separator():
    assert set(DECIDED_BY_ARM) <= set(FORMS)
    assert {name for name, _, _ in READ} == set(FORMS)


@pytest.mark.parametrize(
    ("name", "separator", "mark"),
    [pytest.param(*form, marks=[pytest.mark.slow] * (form[0] in DECIDED_BY_ARM)) for form in READ],
)
def test_one_reading_is_taken_and_said(arm, tmp_path, name, separator, mark):
    chain, q, position, rotation = arm
    path = written(tmp_path / "m.csv", *FORMS[name](q, position, rotation), separator, mark)
    (block,) = read_file(path, chain, FitOptions())
    np.testing.assert_allclose(block.q, q, atol=2e-6)
    np.testing.assert_allclose(block.position, position, atol=2e-6)
    turn = Rotation.from_quat(block.quaternion) * rotation.inv()
    assert block.kind == "pose" and turn.magnitude().max() < 1e-5
    assert block.notes


@pytest.mark.slow
def test_what_is_not_told_is_asked_by_a_line_to_paste(arm, tmp_path):
    chain, q, position, _ = arm
    path = written(tmp_path / "a.csv", [*numbered("M{}"), "x", "y", "z"], [q, position])
    with pytest.raises(MeasurementError, match=r'columns = \{ q1 = "M1", .*q6 = "M6" \}'):
        read_file(path, chain, FitOptions())
    columns = {f"q{number}": f"M{number}" for number in SIX}
    (block,) = read_measurements(path, chain.joint_names, FileOptions(columns=columns))
    np.testing.assert_allclose(block.q, q, atol=2e-6)

    path = written(tmp_path / "b.csv", [*numbered("q{}"), "x", "y", "z", "rx", "ry", "rz"], [q, position, position])
    with pytest.raises(MeasurementError, match=r"look like an orientation.*one line in the options: euler = 'vector'"):
        read_file(path, chain, FitOptions())
    path = written(tmp_path / "c.csv", None, [q + 1.0, position])
    with pytest.raises(MeasurementError, match="has no header: put a line of names and units"):
        read_file(path, chain, FitOptions())
    two = [*numbered("q{}"), "tip_x", "tip_y", "tip_z", "ball_x", "ball_y", "ball_z"]
    path = written(tmp_path / "d.csv", two, [q, position, position])
    with pytest.raises(MeasurementError, match=r'may be meant.*columns = \{ x = "tip_x"'):
        read_file(path, chain, FitOptions())


def test_small_angles_beside_joints_in_degrees(arm, tmp_path):
    """Small angles without a unit are read as the arm says, or asked for."""
    chain, q, position, rotation = arm
    path = written(
        tmp_path / "m.csv",
        [*numbered("A{}"), "X", "Y", "Z", "rvec_x", "rvec_y", "rvec_z"],
        [q * DEGREES, position * 1e3, rotation.as_rotvec()],
    )
    (block,) = read_file(path, chain, FitOptions())
    assert (Rotation.from_quat(block.quaternion) * rotation.inv()).magnitude().max() < 1e-5
    with pytest.raises(MeasurementError, match=r"units = \{ orientation = 'deg' \} or units"):
        read_measurements(path, chain.joint_names)


def test_our_own_names_without_a_unit_are_si(arm, tmp_path):
    chain, q, position, _ = arm
    path = written(tmp_path / "m.csv", [*numbered("q{}"), "x", "y", "z"], [q * DEGREES, position])
    with pytest.raises(MeasurementError, match="looks like deg"):
        read_file(path, chain, FitOptions())


def test_readings_beyond_a_limit_by_a_turn(arm, tmp_path):
    chain, q, position, _ = arm
    few = q / 2.0
    joints = Joints(chain.joint_names, (), np.full(6, -1.2), np.full(6, 1.2))
    shown = np.where(few < 0, few + 2 * np.pi, few)
    path = written(tmp_path / "m.csv", [*numbered("q{}"), "x", "y", "z"], [shown, position])
    (block,) = read_measurements(path, joints)
    np.testing.assert_allclose(block.q, few, atol=2e-6)
    assert any("within them by a turn" in note for note in block.notes)
    shown[3, 2] = 2.0
    path = written(tmp_path / "m.csv", [*numbered("q{}"), "x", "y", "z"], [shown, position])
    with pytest.raises(MeasurementError, match="outside the limits"):
        read_measurements(path, joints)


@pytest.mark.parametrize("mark", ["---", "9999", ""])
def test_placeholders_of_one_target_are_rows_not_seen(arm, tmp_path, mark):
    chain, q, position, _ = arm
    path = written(tmp_path / "m.csv", [*numbered("q{}"), "x", "y", "z"], [q, position])
    lines = path.read_text().splitlines()
    for row in (3, 8):
        lines[row] = ",".join([*lines[row].split(",")[:6], mark, mark, mark])
    path.write_text("\n".join(lines))
    (block,) = read_measurements(path, chain.joint_names)
    assert block.rows.tolist() == [row for row in range(1, COUNT + 1) if row not in (3, 8)]
    assert any("x, y, z: not seen in row(s) 3, 8" in note for note in block.notes)


def test_placeholders_of_one_of_two_targets(arm, tmp_path):
    chain, q, position, _ = arm
    header = [*numbered("q{}"), "x1", "y1", "z1", "x2", "y2", "z2"]
    path = written(tmp_path / "m.csv", header, [q, position, position + 0.1])
    lines = path.read_text().splitlines()
    lines[5] = ",".join([*lines[5].split(",")[:9], "lost", "lost", "lost"])
    path.write_text("\n".join(lines))
    (block,) = read_measurements(path, chain.joint_names)
    assert len(block) == 2 * COUNT - 1
    assert any("x2, y2, z2: not seen in row(s) 5, which hold 'lost' three times" in note for note in block.notes)


@pytest.mark.parametrize(("copied", "targets", "count"), [(range(COUNT), 2, 2 * COUNT), ((2, 5, 9), 3, 3 * COUNT - 3)])
def test_copies_are_left_out_of_the_target_that_is_one(arm, copied, targets, count):
    chain, q, position, rotation = arm
    offsets = ([0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.1, 0.03])
    points = np.stack([position + rotation.apply(offset) for offset in offsets], axis=1)
    # a filter leaves 2 µm between a target and its copy
    points[list(copied), 1] = points[list(copied), 0] + 2e-6 * np.random.default_rng(0).normal(size=(len(copied), 3))
    tool = np.tile(np.arange(3), COUNT)
    names = ("a", "b", "c")
    rows = np.repeat(np.arange(1, COUNT + 1), 3)
    block = Positions(
        np.repeat(q, 3, axis=0), chain.joint_names, points.reshape(-1, 3), tool=tool, tool_names=names, rows=rows
    )
    seen, findings = without_unseen(chain, block)
    assert [entry.code for entry in findings] == ["target-copied"]
    assert (len(seen.tool_names), len(seen)) == (targets, count)
    if targets == 3:
        assert sorted(set(rows.tolist()) - set(seen.rows[seen.tool == 1].tolist())) == [3, 6, 10]
    same, nothing = without_unseen(chain, block, copies_accepted=True)
    assert len(same) == len(block) and not nothing


@pytest.mark.parametrize(("stale", "value"), [((4, 5, 6), None), ((2, 11), 0.0), ((7,), 0.0)])
def test_repeated_readings_are_left_out(arm, stale, value):
    chain, q, position, _ = arm
    points = position.copy()
    points[list(stale)] = points[stale[0]] if value is None else value
    block = Positions(q, chain.joint_names, points, rows=np.arange(1, COUNT + 1))
    seen, findings = without_unseen(chain, block)
    assert [entry.code for entry in findings] == ["reading-repeated"]
    assert findings[0].values["rows"] == tuple(str(row + 1) for row in stale)
    assert set(seen.rows.tolist()) == set(range(1, COUNT + 1)) - {row + 1 for row in stale}


def test_stated_arm_without_columns_is_refused(tmp_path):
    """A table of the left arm is not read as that of the right arm, and its arm is named."""
    joints = []
    for side in ("left", "right"):
        joints += [
            joint(f"{side}_joint_1", "revolute", "torso", f"{side}_a", axis("0 0 1"), "0 0 0.1"),
            joint(f"{side}_joint_2", "revolute", f"{side}_a", f"{side}_b", axis("0 1 0"), "0.1 0 0.3"),
            joint(f"{side}_hand", "fixed", f"{side}_b", f"{side}_tool0", "", "0 0 0.2"),
        ]
    source = tmp_path / "two.urdf"
    source.write_text(robot(*joints))
    header = ["left_joint_1 [deg]", "left_joint_2 [deg]", "x", "y", "z"]
    table = written(tmp_path / "left.csv", header, np.ones((5, 3)))
    with pytest.raises(UsageError, match=r"another arm .*give --tip left_tool0"):
        load_robot(source, table, FitOptions(), tip="right_tool0")
    assert load_robot(source, table, FitOptions(), tip="left_tool0")[0].tip == "left_tool0"


@pytest.mark.parametrize("first", [0, 1])
def test_the_arm_that_was_measured_is_told_from_two(arm, tmp_path, first):
    """Of the columns of two arms those are read with which the measured positions agree, in any order."""
    chain, q, position, _ = arm
    still = np.random.default_rng(7).uniform(-2.0, 2.0, q.shape)
    joints = [("left_j{}", q * DEGREES), ("right_j{}", still * DEGREES)]
    names, values = zip(*(joints[first], joints[1 - first]))
    path = written(tmp_path / "m.csv", [*numbered(*names), "x", "y", "z"], [*values, position])
    (block,) = read_file(path, chain, FitOptions())
    assert "left_j1" in block.notes[0] and "contradicts" in block.notes[0]
    np.testing.assert_allclose(block.q, q, atol=2e-6)
    with pytest.raises(MeasurementError, match=r'q1 = "left_j1".* or .*q1 = "right_j1"|"right_j1".* or .*"left_j1"'):
        read_measurements(path, chain.joint_names)


def test_columns_of_another_arm_are_said_with_a_line(arm, tmp_path):
    """Columns named as this arm's are read; a second set is not passed over in silence."""
    chain, q, position, _ = arm
    header = [*numbered("q{}"), "x", "y", "z", *numbered("right_q{}"), *(f"right_{axis}" for axis in "xyz")]
    (block,) = read_file(written(tmp_path / "m.csv", header, [q, position, q + 0.1, position]), chain, FitOptions())
    notes = "; ".join(block.notes)
    assert 'columns = { q1 = "right_q1"' in notes and 'columns = { x = "right_x"' in notes
    columns = {f"q{number}": f"right_q{number}" for number in SIX}
    (block,) = read_measurements(tmp_path / "m.csv", chain.joint_names, FileOptions(columns=columns))
    np.testing.assert_allclose(block.q, q + 0.1, atol=2e-6)
    commanded = [*numbered("q{}"), "x", "y", "z", *numbered("q_cmd_{}")]
    (block,) = read_file(written(tmp_path / "c.csv", commanded, [q, position, q]), chain, FitOptions())
    assert not block.notes


def test_numbered_columns_of_a_torso_with_two_arms(tmp_path):
    """One joint by name beside numbered ones does not make an arm of one joint: which arm is asked."""
    tags = [joint("lift", "prismatic", "base", "torso", axis("0 0 1"))]
    for side in "lr":
        for number in SIX:
            parent = "torso" if number == 1 else f"{side}_{number - 1}"
            turn = axis("0 0 1" if number % 2 else "0 1 0")
            tags.append(joint(f"{side}_joint_{number}", "revolute", parent, f"{side}_{number}", turn, "0.1 0 0.2"))
    (tmp_path / "two.urdf").write_text(robot(*tags))
    header = ["lift", *numbered("joint_{}"), "x", "y", "z"]
    path = written(tmp_path / "m.csv", header, [np.random.default_rng(1).uniform(0.0, 0.3, (9, 10))])
    with pytest.raises(RobotError, match="two arms: choose one by its last link"):
        load_robot(tmp_path / "two.urdf", path, FitOptions())


@pytest.mark.parametrize(
    ("per_turn", "zero"),
    [pytest.param(4096, 2048, marks=pytest.mark.slow), pytest.param(10_000, 0, marks=pytest.mark.slow), (2**20, 0)],
)
def test_encoder_counts_are_told_by_the_arm(arm, tmp_path, per_turn, zero):
    """Whole numbers too large for deg are read by the usual encoder that agrees with the arm, or asked for."""
    chain, q, position, _ = arm
    counts = np.round(q * per_turn / (2.0 * np.pi)) + zero
    path = written(tmp_path / "m.csv", [*numbered("q{}"), "x", "y", "z"], [counts, position])
    (block,) = read_file(path, chain, FitOptions())
    np.testing.assert_allclose(block.q, q, atol=np.pi / per_turn + 1e-6)
    assert f"counts/{per_turn}@{zero}" in block.notes[0]
    with pytest.raises(MeasurementError, match=r"encoder counts.*one line|encoder counts.*One line"):
        read_measurements(path, chain.joint_names)


@pytest.mark.slow
def test_counts_from_an_odd_zero_are_asked_for(arm, tmp_path):
    """Counts from a zero that no usual encoder has are asked for joint by joint, and read as stated."""
    chain, q, position, _ = arm
    counts = np.round(q * 4096 / (2.0 * np.pi)) + 2457
    odd = written(tmp_path / "odd.csv", [*numbered("q{} [ticks]"), "x", "y", "z"], [counts, position])
    with pytest.raises(MeasurementError, match="joint by joint: units = "):
        read_file(odd, chain, FitOptions())
    (block,) = read_file(odd, chain, FitOptions(units={"joints": "counts/4096@2457"}))
    np.testing.assert_allclose(block.q, q, atol=np.pi / 4096 + 1e-6)
