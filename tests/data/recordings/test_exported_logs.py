"""Logs as ROS's tools and PlotJuggler export them: any order of joints, rows of other topics, absent quantities."""

import re
import tomllib
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import numpy as np
import pytest

from calib.data.recordings.log_columns import series_of, time_column
from calib.data.recordings.recording import Recording
from calib.data.recordings.recording_files import read_recording
from calib.data.recordings.recording_options import RecordingOptions
from calib.data.recordings.stamps import likely_unit
from calib.data.schema import Joints
from calib.errors import MeasurementError

ROBOT = Joints(("base_joint", "elbow_joint", "wrist_1_joint"))
# joints in the order of a message, with the indices of the robot's
ORDER = (1, 0, 2)
NAMES = tuple(ROBOT.names[j] for j in ORDER)
ROWS = 400


def texts(values: Iterable[float]) -> list[str]:
    return [f"{value:.9g}" for value in values]


def write(path: Path, rows: Iterable[Sequence[object]], mark: str = ",") -> Path:
    path.write_text("".join(mark.join(map(str, row)) + "\n" for row in rows))
    return path


def agrees(recording: Recording, series: dict[str, np.ndarray], count: int = ROWS) -> bool:
    same_positions = np.allclose(recording.q, series["q"][:count], atol=1e-7)
    return same_positions and np.allclose(recording.effort, series["tau"][:count], atol=1e-6)


@pytest.fixture
def rostopic(tmp_path, series) -> Callable[..., Path]:
    """Write what `rostopic echo -p` prints, a gripper's messages between, with some velocities."""

    def _rostopic(velocity: np.ndarray, gripper: bool = False) -> Path:
        header = ["%time", *(f"field.header.{name}" for name in ("seq", "stamp", "frame_id"))]
        for name in ("name", "position", "velocity", "effort"):
            header += [f"field.{name}{k}" for k in range(3)]
        rows: list[list[object]] = [header]
        for k in range(ROWS):
            stamp = 1_700_000_000_000_000_000 + 5_000_000 * k
            values = (texts(part[k, list(ORDER)]) for part in (series["q"], velocity, series["tau"]))
            rows.append([stamp + 300_000, k, stamp, "", *NAMES, *(text for part in values for text in part)])
            if gripper and k % 7 == 0:
                rows.append([stamp + 300_000, k, stamp + 100_000, "", "finger_joint", 0.1, 0, 0])
        return write(tmp_path / "states.csv", rows)

    return _rostopic


@pytest.mark.parametrize("gripper", [False, True])
def test_rostopic_rows_name_their_joints(rostopic, series, gripper):
    """The joints' names in the rows decide, not their numbers; messages of a gripper are left out."""
    recording = read_recording(rostopic(series["dq"], gripper), ROBOT)
    assert agrees(recording, series) and np.allclose(recording.t, series["t"][:ROWS], atol=1e-6)
    assert recording.v is not None and np.allclose(recording.v, series["dq"][:ROWS])
    assert any("rows without positions are not used" in note for note in recording.notes) == gripper


def test_velocities_that_are_nan_are_not_provided(rostopic, series):
    recording = read_recording(rostopic(np.full_like(series["q"], np.nan)), ROBOT)
    assert agrees(recording, series) and recording.v is None
    assert any(note.startswith("not provided, NaN") for note in recording.notes)


@pytest.mark.parametrize("quantities", ["q dq tau", "q tau"])
def test_ros2_topic_echo_has_no_header(tmp_path, series, quantities):
    """Rows of seconds, nanoseconds, frame, names and values; two quantities are told apart by the positions' slope."""
    rows: list[list[object]] = []
    for k in range(ROWS):
        values = [text for name in quantities.split() for text in texts(series[name][k, list(ORDER)])]
        rows.append([1_700_000_000 + k // 200, k % 200 * 5_000_000, "base_link", *NAMES, *values])
    rows.insert(100, ["A message was lost!!!"])
    rows.insert(200, [1_700_000_000, 0, "base_link", "finger_joint", 0.1, 0.2, 0.3])
    recording = read_recording(write(tmp_path / "echo.csv", rows), ROBOT)
    assert agrees(recording, series) and (recording.v is None) == ("dq" not in quantities)
    assert any("1 lines that are no joint state" in note for note in recording.notes)


def test_second_quantity_that_is_the_slope_is_no_torque(tmp_path, series):
    rows = []
    for k in range(ROWS):
        values = texts([*series["q"][k], *np.gradient(series["q"], series["t"], axis=0)[k]])
        rows.append([1_700_000_000 + k // 200, k % 200 * 5_000_000, "", *ROBOT.names, *values])
    with pytest.raises(MeasurementError, match="has no torques and no currents"):
        read_recording(write(tmp_path / "echo.csv", rows), ROBOT)


def test_dynamic_joint_states_in_rows(tmp_path, series):
    """`DynamicJointState` names the interfaces of each joint in its rows."""
    rows: list[list[object]] = []
    for k in range(ROWS):
        row: list[object] = [1_700_000_000 + k // 200, k % 200 * 5_000_000, "", *NAMES]
        for j in ORDER:
            row += ["effort", "position", *texts((series["tau"][k, j], series["q"][k, j]))]
        rows.append(row)
    assert agrees(read_recording(write(tmp_path / "echo.csv", rows), ROBOT), series)


@pytest.fixture
def plotjuggler(tmp_path, series) -> Callable[..., Path]:
    """Write PlotJuggler's table: a row per message, the cells of all other topics empty; efforts late by `late` s."""

    def _plotjuggler(late: float = 0.0, pattern: str = "/joint_states/{}/{}") -> Path:
        quantities = (("effort", series["tau"]), ("position", series["q"]))
        header = ["__time"]
        header += [pattern.format(name, quantity) for quantity, _ in quantities for name in NAMES]
        header += ["/wrench/force/x", *(f"/controller_state/error/positions/{name}" for name in NAMES)]
        by_time: dict[float, list[object]] = {}
        for k in range(ROWS):
            for first, (quantity, values) in zip((1, 4), quantities):
                time = round(series["t"][k] + (late if quantity == "effort" else 0.0), 6)
                row = by_time.setdefault(time, [time, *[""] * 10])
                row[first : first + 3] = texts(values[k, list(ORDER)])
            if k % 5 == 0:
                time = round(series["t"][k] + 0.0011, 6)
                by_time[time] = [time, *[""] * 6, 1.0, 0.1, 0.1, 0.1]
        return write(tmp_path / "plot.csv", [header, *(by_time[time] for time in sorted(by_time))])

    return _plotjuggler


@pytest.mark.parametrize("pattern", ["/joint_states/{}/{}", "/joint_states/{1}/{0}", "arm {}.{} "])
def test_plotjuggler_rows_of_other_topics_are_left_out(plotjuggler, series, pattern):
    recording = read_recording(plotjuggler(pattern=pattern), ROBOT)
    assert agrees(recording, series) and recording.notes[0].startswith("read as columns = { t = ")
    assert any("80 rows without positions" in note for note in recording.notes)


def test_torques_of_other_rows_are_interpolated(plotjuggler, series):
    """Torques with stamps of their own are brought to the times of the positions."""
    recording = read_recording(plotjuggler(late=0.002), ROBOT)
    expected = np.column_stack([np.interp(recording.t, series["t"] + 0.002, tau) for tau in series["tau"].T])
    assert len(recording) == ROWS - 1 and np.allclose(recording.effort, expected, atol=1e-6)


@pytest.mark.parametrize(
    ("names", "words"),
    [
        ("Winkel A{n}|Moment A{n}|Zeit", "German"),
        ("angle axe {n}|couple axe {n}|temps", "French"),
        ("关节{n}位置|关节{n}力矩|时间", "Chinese"),
        ("{joint}|tau{n}|time_s", "names of joints alone"),
        ("- {joint}_position|- {joint}_effort|t", "an exporter's dashes"),
        ("A{n}|A{n} current [mA]|timestamp_us", "axes of KUKA"),
    ],
)
@pytest.mark.parametrize("decimal", [",", "."])
def test_columns_are_told_by_words(tmp_path, series, names, words, decimal):
    """Columns are told by words of several languages, the mapping is said, and works when pasted as [columns]."""
    q, effort, time = names.split("|")
    header = [time]
    for pattern in (effort, q):
        header += [pattern.format(joint=ROBOT.names[j], n=j + 1) for j in (2, 0, 1)]
    factor = 1e6 if time.endswith("_us") else 1.0
    rows = [header]
    for k in range(ROWS):
        values = texts([factor * series["t"][k], *series["tau"][k, [2, 0, 1]], *series["q"][k, [2, 0, 1]]])
        rows.append([value.replace(".", decimal) for value in values])
    recording = read_recording(write(tmp_path / "log.csv", rows, ";"), ROBOT)
    scale = 1e-3 if "mA" in effort else 1.0
    assert np.allclose(recording.q, series["q"][:ROWS]) and np.allclose(recording.effort, scale * series["tau"][:ROWS])
    assert recording.duration == pytest.approx(series["t"][ROWS - 1])
    mapping = next(note for note in recording.notes if note.startswith("read as columns"))
    options = RecordingOptions(columns=tomllib.loads(mapping.removeprefix("read as "))["columns"])
    pasted = read_recording(tmp_path / "log.csv", ROBOT, options)
    assert np.array_equal(pasted.q, recording.q) and np.array_equal(pasted.effort, recording.effort)


@pytest.mark.parametrize(
    "header",
    [["enc_{joint}", "load_{joint}"], ["pan_a lift_a wrist_a", "pan_b lift_b wrist_b"], ["aa bb cc", "u1 u2 u3"]],
)
def test_proposed_line_works(tmp_path, series, header):
    """The line that a message proposes is valid TOML, and the file is read with it."""
    names = ["t"]
    for group in header:
        names += [group.format(joint=joint) for joint in ROBOT.names] if "{" in group else group.split()
    table = np.column_stack([series["t"], series["q"], series["tau"]])[:ROWS]
    np.savetxt(tmp_path / "log.csv", table, delimiter=",", header=",".join(names), comments="")
    with pytest.raises(MeasurementError) as refusal:
        read_recording(tmp_path / "log.csv", ROBOT)
    line = re.search(r"columns = \{.*\} ?\}|columns = \{.*\}", str(refusal.value))
    assert line is not None
    options = RecordingOptions(columns=tomllib.loads(line[0])["columns"])
    assert agrees(read_recording(tmp_path / "log.csv", ROBOT, options), series)


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({"q": "enc {joint}"}, r"no columns are named 'enc \{joint\}'.*'\{joint\}"),
        ({"q1": "base_joint"}, "states q of 1 joints only: q2 is missing"),
        ({"torques": "tau1"}, "names 'torques', which is no quantity"),
    ],
)
def test_mapping_that_cannot_be(tmp_path, series, columns, message):
    names = ["t", *ROBOT.names, "tau1", "tau2", "tau3"]
    table = np.column_stack([series["t"], series["q"], series["tau"]])[:ROWS]
    np.savetxt(tmp_path / "log.csv", table, delimiter=",", header=",".join(names), comments="")
    with pytest.raises(MeasurementError, match=message):
        read_recording(tmp_path / "log.csv", ROBOT, RecordingOptions(columns=columns))


@pytest.mark.parametrize(
    ("words", "series"),
    [
        ("joint_states position", "q"),
        ("desired positions", "q_ref"),
        ("controller_state error velocities", ""),
        ("external torque", ""),
        ("motor torque", "tau_motor"),
        ("feedforward effort", "tau_ff"),
        ("desired effort", ""),
        ("motor current", "current"),
        ("wrench force", ""),
    ],
)
def test_words_tell_the_quantity(words, series):
    assert series_of(re.split(r"[ _]", words)) == series


@pytest.mark.parametrize(
    ("unit", "start", "step"), [("ns", 1.7e18, 2e6), ("us", 1.7e15, 2e3), ("ms", 1.7e12, 2.0), ("ns", 0.0, 2e6)]
)
def test_stamps_tell_their_unit_where_one_is_possible(unit, start, step):
    assert likely_unit(start + step * np.arange(100)) == unit


@pytest.mark.parametrize("step", [2.0, 20.0, 0.002, 1e5])
def test_stamps_of_doubtful_unit_are_not_guessed(step):
    """Two seconds or two milliseconds: the step alone does not tell; it is asked."""
    assert likely_unit(step * np.arange(100)) == ""


def test_column_of_times_is_told_by_words():
    assert time_column(["/joint_states/effort", "timestamp_ms"]) == (1, "ms")
    assert time_column(["time_constant", "q1"]) is None


@pytest.mark.parametrize("back", [0.3e-3, 2.1e-3])
def test_small_steps_back_are_no_second_log(tmp_path, series, back):
    """Stamps that run back by 0.3 to 2 ms at 4 kHz are put in order."""
    t = np.arange(ROWS) / 4000.0
    t[100:] -= back
    table = np.column_stack([t, series["q"][:ROWS], series["tau"][:ROWS]])
    header = "t,q1,q2,q3,tau1,tau2,tau3"
    np.savetxt(tmp_path / "log.csv", table, fmt="%.9g", delimiter=",", header=header, comments="")
    recording = read_recording(tmp_path / "log.csv", ROBOT)
    assert any("stamps are" in note for note in recording.notes)


def test_joint_columns_without_a_quantity_are_not_torques(tmp_path):
    """Columns joint1 … are positions beside torques, and alone no recording; they are never read twice."""
    t = np.arange(200) / 100.0
    q = np.sin(np.outer(t, [1.0, 2.0, 3.0]))
    names = ["joint1", "joint2", "joint3"]
    joints = Joints(tuple(names))
    alone = tmp_path / "positions.csv"
    np.savetxt(alone, np.column_stack([t, q]), delimiter=",", header=",".join(["time", *names]), comments="")
    with pytest.raises(MeasurementError, match="has no torques"):
        read_recording(alone, joints)
    whole = tmp_path / "whole.csv"
    header = ",".join(["time", *names, "tau1", "tau2", "tau3"])
    np.savetxt(whole, np.column_stack([t, q, 5.0 * q]), delimiter=",", header=header, comments="")
    recording = read_recording(whole, joints)
    np.testing.assert_allclose(recording.q, q)
    np.testing.assert_allclose(recording.effort, 5.0 * q)
