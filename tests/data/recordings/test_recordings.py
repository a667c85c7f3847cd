"""Recordings read from archives, tables and bags, cut, and refused with the row and the reason."""

import re
import zipfile
from pathlib import Path

import numpy as np
import pytest

from calib.data.recordings.recording import Recording, parse_cut
from calib.data.recordings.recording_files import read_recording
from calib.data.recordings.recording_options import RecordingOptions
from calib.data.schema import Joints
from calib.errors import MeasurementError, UsageError

LIMITS = {"lower": np.full(3, -3.0), "upper": np.full(3, 3.0), "effort": np.full(3, 100.0)}
ROBOT = Joints(("a", "b", "c"), **LIMITS)
NAMED = (("q", "_deg"), ("dq", "_deg_s"), ("i", "_mA"))


def refused(path: Path | str, pattern: str, joints: Joints | None = ROBOT, **options) -> MeasurementError:
    with pytest.raises(MeasurementError, match=pattern) as caught:
        read_recording(path, joints, RecordingOptions(**options))
    return caught.value


def test_archive_comes_back_as_written(archive, series):
    """An archive comes back as it was written."""
    recording = read_recording(archive(), ROBOT)
    np.testing.assert_array_equal(recording.q, series["q"])
    np.testing.assert_array_equal(recording.effort, series["tau"])
    assert recording.kind == "torque" and recording.joint_names == ("a", "b", "c") and not recording.notes
    assert recording.n == 3 and recording.duration == pytest.approx(11.995)
    with pytest.raises(ValueError, match="read-only"):
        recording.q[0, 0] = 1.0


def test_flobaroids_names_and_currents(tmp_path, series):
    path = tmp_path / "floba.npz"
    np.savez(path, times=series["t"], positions=series["q"], velocities=series["dq"], torques=series["tau"])
    assert read_recording(path).v is not None
    np.savez(path, time=series["t"], Position=series["q"], i=series["tau"], drive_gain=[1.0, 2.0, 3.0])
    recording = read_recording(path)
    assert recording.kind == "current" and recording.drive_gain is not None
    assert read_recording(path, options=RecordingOptions(kind="torque")).kind == "torque"


def test_joints_found_by_name_in_any_order(archive, series):
    """Joints are found by name in any order."""
    path = archive(joint_names=np.array(["gripper", "c", "b", "a"]), **{
        key: np.column_stack([np.zeros(2400), series[key][:, ::-1]]) for key in ("q", "dq", "tau")
    })  # fmt: skip
    np.testing.assert_array_equal(read_recording(path, ROBOT).q, series["q"])
    refused(path, r"has no joint 'arm_a'", Joints(("arm_a", "b", "c")))


def test_a_rate_stands_in_for_stamps(archive):
    assert read_recording(archive(t=None, frequency=200.0)).t[-1] == pytest.approx(2399 / 200)
    assert read_recording(archive(t=None), options=RecordingOptions(rate=200.0)).duration == pytest.approx(2399 / 200)
    refused(archive(t=None), "neither stamps nor a rate")


def test_cuts(archive, recording):
    part = read_recording(f"{archive()}@2:4.5", ROBOT)
    assert part.t[0] == 2.0 and len(part) == 500 and part.rows[0] == 401
    np.testing.assert_array_equal(part.q, recording.cut(2.0, 4.5).q)
    assert len(read_recording(f"{archive()}@10:")) == 400
    assert parse_cut("a@b.npz") == ("a@b.npz", None, None) and parse_cut("x.npz@:3") == ("x.npz", None, 3.0)
    refused(f"{archive()}@20:30", r"the cut @20:30 leaves no sample; the recording ends at 11.99 s")
    for wrong in ("x.npz@3:1", "x.npz@a:b"):
        with pytest.raises(UsageError):
            parse_cut(wrong)


def test_use_range_holds_unless_cut(archive):
    """The stated `use_range` is followed unless a cut says otherwise."""
    path = archive(use_range=np.array([400, 2000]))
    recording = read_recording(path)
    assert len(recording) == 1600 and recording.t[0] == 2.0 and recording.rows[0] == 401
    assert recording.notes == ("rows 401 to 2000 of 2400 are used, as its use_range states",)
    assert len(read_recording(f"{path}@0:12")) == 2400
    assert len(read_recording(path, options=RecordingOptions(use_range=False))) == 2400


def test_tables_with_units_and_names(tmp_path, series):
    path = tmp_path / "log.csv"
    q, t, tau = np.degrees(series["q"]), series["t"] * 1e3 + 5000, series["tau"]
    np.savetxt(path, np.column_stack([t, q, tau]), delimiter=",", comments="",
               header="time [ms],q1 [deg],q2 [deg],q3 [deg],tau_a [Nm],tau_b [Nm],tau_c [Nm]")  # fmt: skip
    recording = read_recording(path, ROBOT)
    np.testing.assert_allclose(recording.q, series["q"], atol=1e-12)
    np.testing.assert_allclose(recording.t, series["t"], atol=1e-9)
    assert recording.kind == "torque" and recording.v is None
    np.savetxt(path, np.column_stack([t, q, tau]), delimiter=",", comments="",
               header="t,position_c,position_b,position_a,current[0],current[1],current[2]")  # fmt: skip
    options = RecordingOptions(units={"t": "ms", "q": "deg"})
    by_name = read_recording(path, ROBOT, options)
    np.testing.assert_allclose(by_name.q, series["q"][:, ::-1], atol=1e-12)
    assert by_name.kind == "current"
    refused(path, "looks like deg", units={"t": "ms"})
    assert len(read_recording(f"{path}@1:2", ROBOT, options)) == 200


def test_a_table_says_which_cell_is_wrong(tmp_path, series):
    rows = np.column_stack([series["t"], series["q"], series["tau"]])
    path = tmp_path / "log.csv"
    header = "t,q1,q2,q3,tau1,tau2,tau3"
    rows[700, 5] = np.nan
    np.savetxt(path, rows, delimiter=",", comments="", header=header)
    error = refused(path, "found nan")
    assert (error.row, error.column) == (701, "torque of b (joint 2)")
    np.savetxt(path, rows[:, :6], delimiter=",", comments="", header=header[:-5])
    refused(path, "2 columns of torque")
    np.savetxt(path, rows[:, :4], delimiter=",", comments="", header=header[:10])
    refused(path, "no torques and no currents")
    path.write_text(header.replace("tau2", "tau2 [furlong]") + "\n0,1,2,3,4,5,6\n")
    refused(path, r"unit \[furlong\]")


@pytest.mark.parametrize("kind", ["mcap", "sqlite3"])
def test_ros2_bags_without_ros(tmp_path, series, kind):
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    state, header, stamp = (
        store.types[name]
        for name in ("sensor_msgs/msg/JointState", "std_msgs/msg/Header", "builtin_interfaces/msg/Time")
    )
    plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
    with Writer(tmp_path / "bag", version=9, storage_plugin=plugin) as writer:
        topic = writer.add_connection("/joint_states", state.__msgtype__, typestore=store)
        for k in range(600):
            ns = 1_700_000_000 * 10**9 + k * 5_000_000
            time = header(stamp=stamp(sec=ns // 10**9, nanosec=ns % 10**9), frame_id="")
            q, v, tau = (series[key][k, ::-1].copy() for key in ("q", "dq", "tau"))
            message = state(header=time, name=["c", "b", "a"], position=q, velocity=v, effort=tau)
            writer.write(topic, ns + 300_000, store.serialize_cdr(message, state.__msgtype__))
            if k % 10 == 0:
                grip = state(header=time, name=["finger"], position=q[:1], velocity=v[:1], effort=tau[:1])
                writer.write(topic, ns + 400_000, store.serialize_cdr(grip, state.__msgtype__))
    recording = read_recording(tmp_path / "bag", ROBOT)
    np.testing.assert_array_equal(recording.q, series["q"][:600])
    np.testing.assert_array_equal(recording.effort, series["tau"][:600])
    np.testing.assert_allclose(recording.t, series["t"][:600], atol=1e-9)
    assert recording.kind == "torque" and recording.notes == ("60 messages that lack a joint are not used",)
    if kind == "mcap":
        bare = next((tmp_path / "bag").glob("*.mcap"))
        np.testing.assert_array_equal(read_recording(f"{bare}@1:2", ROBOT).q, series["q"][200:400])
        refused(bare, "no joint states on '/states'", topic="/states")
        refused(bare, "has no joint 'elbow'", Joints(("elbow",)))


def test_franka_ros2_bags_use_measured_state(tmp_path, series):
    """Bags of franka_ros2 are read by their measured joint state."""
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store, name = get_typestore(Stores.ROS2_HUMBLE), "franka_msgs/msg/FrankaRobotState"
    fields = "std_msgs/Header header\nsensor_msgs/JointState measured_joint_state\nfloat64[3] dtau_j\n"
    store.register(get_types_from_msg(fields, name))
    whole, state, header, stamp = (
        store.types[each]
        for each in (name, "sensor_msgs/msg/JointState", "std_msgs/msg/Header", "builtin_interfaces/msg/Time")
    )
    with Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        topic = writer.add_connection("/franka_robot_state_broadcaster/robot_state", name, typestore=store)
        for k in range(200):
            time = header(stamp=stamp(sec=10, nanosec=k * 5_000_000), frame_id="")
            q, v, tau = (series[key][k].copy() for key in ("q", "dq", "tau"))
            own = state(header=time, name=["a", "b", "c"], position=q, velocity=v, effort=tau)
            message = whole(header=time, measured_joint_state=own, dtau_j=np.zeros(3))
            writer.write(topic, 10**10 + k, store.serialize_cdr(message, name))
    recording = read_recording(tmp_path / "bag", ROBOT)
    np.testing.assert_array_equal(recording.q, series["q"][:200])
    np.testing.assert_array_equal(recording.effort, series["tau"][:200])


def test_a_cut_does_not_hide_damage(archive):
    path = archive()
    assert len(read_recording(f"{path}@0:1", ROBOT)) > 0
    with zipfile.ZipFile(path) as whole:
        member = whole.getinfo("tau.npy")
    content = bytearray(path.read_bytes())
    content[member.header_offset + member.compress_size] ^= 0x40  # within the member's last rows
    path.write_bytes(content)
    with pytest.raises(MeasurementError, match="damaged archive"):
        read_recording(f"{path}@0:1", ROBOT)


def test_broken_and_foreign_files(tmp_path, archive):
    refused(tmp_path / "none.npz", "No such file")
    (tmp_path / "empty.npz").write_bytes(b"")
    refused(tmp_path / "empty.npz", "is empty")
    (tmp_path / "cut.npz").write_bytes(archive().read_bytes()[:9000])
    refused(tmp_path / "cut.npz", "damaged archive")
    (tmp_path / "zeros.csv").write_bytes(bytes(10_000))
    refused(tmp_path / "zeros.csv", "neither a NumPy archive")
    (tmp_path / "endless.csv").write_bytes(b"y" * 200_000)
    refused(tmp_path / "endless.csv", "not a table")
    (tmp_path / "x.mcap").write_bytes(b"nothing of the kind")
    refused(tmp_path / "x.mcap", "cannot be read as a ROS bag")
    refused(tmp_path, "cannot be read as a ROS bag")
    np.savez(tmp_path / "objects.npz", t=np.arange(9.0), q=np.array([None] * 9))
    refused(tmp_path / "objects.npz", "no torques and no currents")
    np.savez(tmp_path / "objects.npz", t=np.arange(9.0), q=np.array([None] * 9), tau=np.ones((9, 1)))
    refused(tmp_path / "objects.npz", "Python objects")


def test_time_that_cannot_be(archive, series):
    t = series["t"].copy()
    t[500:] -= 1.0
    error = refused(archive(t=t), r"time goes back from 2.495 s to 1.5 s")
    assert (error.row, error.column) == (501, "t")
    cut = re.findall(r"@[\d.]+:[\d.]+", str(error))
    assert cut == ["@2.5:10.995"]  # where the clock has caught up
    assert len(read_recording(f"{archive(t=t)}{cut[0]}")) == 1699
    t = series["t"].copy()
    t[500] = t[499]
    assert refused(archive(t=t), "two samples have the stamp").row == 501
    refused(archive(t=series["t"] * 1e3), "stamps look like ms")
    nanoseconds = read_recording(archive(t=(series["t"] * 1e9).astype(int)))
    np.testing.assert_allclose(nanoseconds.t, series["t"], atol=1e-8)
    assert "its stamps are read as ns" in nanoseconds.notes[0]
    assert read_recording(archive(t=series["t"] * 1e3), options=RecordingOptions(units={"t": "ms"})).duration < 13
    t = series["t"].copy()
    t[7] = np.nan
    assert refused(archive(t=t), "found nan").column == "t"


def test_rows_written_twice_are_left_out(archive, series):
    twice = {key: np.repeat(series[key], [2 if i in (5, 9) else 1 for i in range(2400)], axis=0) for key in series}
    recording = read_recording(archive(**twice))
    np.testing.assert_array_equal(recording.q, series["q"])
    assert recording.notes == ("2 rows repeat the row before, with its stamp (first: row 7); not used",)


def test_values_that_cannot_be(archive, series):
    tau = series["tau"].copy()
    tau[12, 1] = tau[80, 2] = np.nan
    error = refused(archive(tau=tau), r"found nan; .* is @0.405:11.995 \(and in 1 more row; of all, 1 in torque of b")
    assert (error.row, error.column) == (13, "torque of b (joint 2)")
    tau[::15] = np.nan
    assert "longest" not in str(refused(archive(tau=tau), r"found nan; cut this part out \(and in"))
    t = series["t"].copy()
    t[800] = np.inf
    refused(archive(t=t), "found inf; cut this part out; the longest part without such rows is @0:3.995")
    refused(archive(q=np.degrees(series["q"])), r"looks like deg; if so, state the unit \(header 'q1 \[deg\]'")
    refused(archive(dq=np.degrees(series["dq"])), "the velocities look like deg/s")
    refused(archive(q=np.degrees(series["q"]), dq=series["dq"]), "deg", None)
    tau = series["tau"].copy()
    tau[:, 2] = 4.5
    assert refused(archive(tau=tau), "is 4.5 in all 2400 rows while the joint moves").column == "torque of c (joint 3)"
    refused(archive(**{key: series[key][:15] for key in series}), "15 samples are too few")
    refused(f"{archive()}@0:0.075", "15 samples are too few")
    refused(archive(tau=series["tau"][:, :2]), r"has shape \(2400, 2\)")
    refused(archive(), r"has 3 joints .*, the robot has 2", Joints(("a", "b")))


def test_what_is_odd_is_noted(archive, series):
    still = series["q"].copy()
    still[:, 1] = 0.7
    (note,) = read_recording(archive(q=still, dq=None), ROBOT).notes
    assert note.startswith("b never moves (its position is constant)")
    notes = read_recording(archive(tau=-series["tau"]), ROBOT).notes
    assert any("is their sign reversed?" in note for note in notes)
    notes = read_recording(archive(tau=series["tau"] / 80), ROBOT).notes
    assert any("no torque reaches 3 % of its joint" in note for note in notes)
    notes = read_recording(archive(tau=series["tau"] * [10, 1, 1]), ROBOT).notes
    assert any("its limit is 100" in note for note in notes)
    narrow = Joints(("a", "b", "c"), lower=np.full(3, -0.1), upper=np.full(3, 0.1))
    assert len([note for note in read_recording(archive(), narrow).notes if "beyond its limits" in note]) == 3


def test_recordings_and_options_have_shapes(recording):
    """Recordings and options are held to their shapes."""
    with pytest.raises(MeasurementError, match="expected"):
        Recording(recording.t, recording.q[:, :2], recording.effort, "torque", ("a", "b", "c"))
    with pytest.raises(MeasurementError, match="not one of torque, current"):
        Recording(recording.t, recording.q, recording.effort, "force", ("a", "b", "c"))
    with pytest.raises(UsageError, match="did you mean 'torque'"):
        RecordingOptions(names={"torqe": "x"})
    with pytest.raises(UsageError, match="unknown; expected one of rad"):
        RecordingOptions(units={"q": "grad"})


def test_number_blocks_and_others_read_alike(tmp_path, monkeypatch):
    """Blocks of numbers, and what is none of them, read alike."""
    from calib.data import csv_table

    monkeypatch.setattr(csv_table, "_CHUNK", 4)
    rows = [f"{k}.5,{-k}e-3,{k}" for k in range(11)]
    plain, mixed = tmp_path / "plain.csv", tmp_path / "mixed.csv"
    plain.write_text("\n".join(["a,b,c", *rows]))
    rows[5] = "# a comment\n\n" + rows[5]
    rows[9] = '9.5,"-9e-3",'
    mixed.write_text("\n".join(["a,b,c", *rows, ""]))
    found, other = csv_table.read_table(plain), csv_table.read_table(mixed)
    expected = np.array([[k + 0.5, float(f"{-k}e-3"), k] for k in range(11)])
    np.testing.assert_array_equal(np.stack(found.cells, axis=1), expected)
    expected[9, 2] = np.nan
    np.testing.assert_array_equal(np.stack(other.cells, axis=1), expected)
    np.testing.assert_array_equal(other.rows, np.arange(1, 12))


@pytest.mark.parametrize("rate", [100.0, pytest.param(1000.0, marks=pytest.mark.slow)])
def test_half_hour_stamps_fall_on_grid(rate):
    """Half an hour's stamps fall on their grid."""
    from calib.data.recordings.recording import Recording
    from calib.data.signals.resampling import find_clock, resample

    t = np.arange(2000 * int(rate)) / rate
    q = np.sin(t)[:, None]
    recording = Recording(t, q, q, "torque", ("a",))
    assert abs(find_clock(recording).period * rate - 1.0) < 1e-12
    np.testing.assert_array_equal(resample(recording).series["q"], q)


def test_encoder_counts(archive, tmp_path, series):
    """A count is a share of a turn from the count at zero, in archives and tables, by header or options."""
    counts = np.round(series["q"] * 4096 / (2 * np.pi) + 2048)
    options = RecordingOptions(units={"q": "counts/4096@2048"})
    step = np.pi / 4096 + 1e-9
    np.testing.assert_allclose(read_recording(archive(q=counts), ROBOT, options).q, series["q"], atol=step)
    path = tmp_path / "log.csv"
    for unit, stated in (("", options), ("[counts/4096@2048]", None), ("[ticks]", options)):
        header = ",".join(["t", *(f"q{j}{unit}" for j in (1, 2, 3)), "tau_a,tau_b,tau_c"])
        columns = np.column_stack([series["t"], counts, series["tau"]])
        np.savetxt(path, columns, delimiter=",", comments="", header=header)
        np.testing.assert_allclose(read_recording(path, ROBOT, stated).q, series["q"], atol=step)
    refused(path, r"\[ticks\] is not one of .*\[counts/4096@2048\]")
    with pytest.raises(UsageError, match="unit 'counts/0' of q is unknown"):
        RecordingOptions(units={"q": "counts/0"})


def test_units_at_the_end_of_names(tmp_path, series):
    """``q1_deg``, ``dq1_deg_s`` and ``i1_mA`` are read in these units; a header's unit comes first; UTF-16 is text."""
    header = ",".join(["t", *(f"{head}{j}{unit}" for head, unit in NAMED for j in (1, 2, 3))])
    columns = [series["t"], np.degrees(series["q"]), np.degrees(series["dq"]), 1e3 * series["tau"]]
    path = tmp_path / "log.csv"
    np.savetxt(path, np.column_stack(columns), delimiter=",", comments="", header=header, encoding="utf-16")
    recording = read_recording(path, ROBOT)
    np.testing.assert_allclose(recording.q, series["q"], atol=1e-12)
    np.testing.assert_allclose(recording.v, series["dq"], atol=1e-12)
    np.testing.assert_allclose(recording.effort, series["tau"], atol=1e-12)
    assert recording.kind == "current"
