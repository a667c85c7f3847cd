"""LeRobot data sets are read by the names of their joints, a gripper left out, episodes one behind the other."""

import json
from pathlib import Path

import numpy as np
import pytest

from calib.cli import run
from calib.data.csv_table import read_table
from calib.data.recordings.datasets import dataset_table
from calib.data.recordings.recording_files import read_recording
from calib.data.recordings.recording_options import RecordingOptions
from calib.data.schema import Joints
from calib.data.signals.resampling import resample
from calib.errors import MeasurementError

parquet = pytest.importorskip("pyarrow.parquet", reason="pyarrow is not installed")

ROBOT = Joints(("shoulder_pan", "elbow_flex", "wrist_roll"))
NAMES = ["wrist_roll", "shoulder_pan", "elbow_flex", "gripper"]
EPISODES = 3


def dataset(folder: Path, series: dict[str, np.ndarray], names: object, effort: str = "", version: int = 3) -> Path:
    """Write a data set of three episodes in which the joints stand in another order than the robot's."""
    from pyarrow import table

    count = len(series["t"]) // EPISODES
    features = {"observation.state": {"dtype": "float32", "names": names}, "action": {"names": names}}
    if effort:
        features[effort] = {"names": names}
    (folder / "meta").mkdir(parents=True)
    (folder / "meta" / "info.json").write_text(json.dumps({"codebase_version": "v3.0", "features": features}))
    (folder / "data" / "chunk-000").mkdir(parents=True)
    parts = []
    for episode in range(EPISODES):
        rows = slice(episode * count, (episode + 1) * count)
        lists = {}
        for name, key in (("observation.state", "q"), ("action", "q"), (effort, "tau")):
            lists[name] = np.column_stack([series[key][rows][:, [2, 0, 1]], np.zeros(count)]).tolist()
        lists.pop("", None)
        parts.append({**lists, "timestamp": series["t"][:count], "episode_index": np.full(count, episode)})
    if version == 3:
        joined = {name: [value for part in parts for value in part[name]] for name in parts[0]}
        parquet.write_table(table(joined), folder / "data" / "chunk-000" / "file-000.parquet")
    else:
        for episode, part in enumerate(parts):
            parquet.write_table(table(part), folder / "data" / "chunk-000" / f"episode_{episode:06d}.parquet")
    return folder


@pytest.mark.parametrize("version", [2, 3])
@pytest.mark.parametrize(
    "names", [[f"{name}.pos" for name in NAMES], {"motors": NAMES}, [NAMES], [f"main_{name}" for name in NAMES]]
)
def test_data_set_is_read_by_names(tmp_path, series, names, version):
    """Positions, references and torques are put in the robot's order, however the file states the names."""
    folder = dataset(tmp_path / "set", series, names, "observation.effort", version)
    recording = read_recording(folder, ROBOT)
    np.testing.assert_allclose(recording.q, series["q"])
    np.testing.assert_allclose(recording.effort, series["tau"])
    assert recording.q_ref is not None and recording.kind == "torque"
    assert recording.t[800] - recording.t[799] == pytest.approx(1.0)
    assert any("3 episodes" in note for note in recording.notes)


def test_one_episode_is_a_file(tmp_path, series):
    """A file of one episode is read alone, with the names of its data set, and currents are currents."""
    folder = dataset(tmp_path / "set", series, NAMES, "observation.current", version=2)
    recording = read_recording(folder / "data" / "chunk-000" / "episode_000001.parquet", ROBOT)
    assert recording.kind == "current" and len(recording) == 800
    np.testing.assert_allclose(recording.effort, series["tau"][800:1600])


def test_positions_alone_are_told(tmp_path, series):
    """A data set without torques, as most are, is refused with what it has."""
    with pytest.raises(MeasurementError, match=r"no torques and no currents.*in another file"):
        read_recording(dataset(tmp_path / "set", series, NAMES), ROBOT)


def test_unnamed_numbers_are_proposed_in_their_order(tmp_path, series):
    """Where a data set names nothing, the line that the message proposes works."""
    folder = dataset(tmp_path / "set", series, None, "observation.effort")
    with pytest.raises(MeasurementError, match=r'columns = \{ q1 = "observation.state.0.pos"'):
        read_recording(folder, ROBOT)
    columns = {f"q{k + 1}": f"observation.state.{j}.pos" for k, j in enumerate((1, 2, 0))}
    columns |= {f"torque{k + 1}": f"observation.effort.{j}" for k, j in enumerate((1, 2, 0))}
    recording = read_recording(folder, ROBOT, RecordingOptions(columns=columns))
    np.testing.assert_allclose(recording.effort, series["tau"])


def test_two_data_sets_of_a_motion_are_joined(tmp_path, series):
    """`calib join` reads a data set as a log."""
    folder = dataset(tmp_path / "set", series, NAMES)
    table = dataset_table(folder)
    t = table.cells[table.header.index("timestamp")]
    header = ",".join(["t", *(f"{name} torque [Nm]" for name in ROBOT.names)])
    np.savetxt(tmp_path / "torque.csv", np.column_stack([t, series["tau"]]), delimiter=",", header=header, comments="")
    assert run(["join", str(folder), str(tmp_path / "torque.csv"), "--out", str(tmp_path / "log.csv")]) == 0
    np.testing.assert_allclose(read_recording(tmp_path / "log.csv", ROBOT).effort, series["tau"], atol=1e-6)
    assert "t" in read_table(tmp_path / "log.csv").header


def test_breaks_between_episodes_are_no_gaps(tmp_path, series):
    """No sample is missing between episodes, however many there are."""
    recording = read_recording(dataset(tmp_path / "set", series, NAMES, "observation.effort"), ROBOT)
    assert len(recording.breaks) == EPISODES - 1
    report = resample(recording).report
    assert report.gaps == () and report.lost == 0
    assert not any("episode_index" in note for note in recording.notes)


def changed(path: Path, name: str, values: list[object]) -> Path:
    """Replace a column of a data set's only file."""
    from pyarrow import array

    file = path / "data" / "chunk-000" / "file-000.parquet"
    content = parquet.read_table(file)
    content = content.set_column(content.column_names.index(name), name, array(values))
    parquet.write_table(content, file)
    return path


@pytest.mark.parametrize(
    "row, says",
    [(None, "row 1.*is null, 1 of 2400 rows are not lists of 4"), ([0.0], "a list of 1 numbers"), ("[0, 1]", "text")],
)
def test_damaged_state_is_said(tmp_path, series, row, says):
    """Rows of the state without numbers, too short, or written as text are not taken for a missing state."""
    path = dataset(tmp_path / "set", series, NAMES, "observation.effort")
    state = [row] + [[0.0, 1.0, 2.0, 3.0]] * 2399
    if isinstance(row, str):
        state = [row] * 2400
    with pytest.raises(MeasurementError, match=f"observation.state.*{says}|{says}"):
        read_recording(changed(path, "observation.state", state), ROBOT)


def test_damaged_data_sets_are_said(tmp_path, series):
    """Stamps that stand still, a folder without meta, a file without rows; poses are not read from Parquet."""
    path = dataset(tmp_path / "set", series, NAMES, "observation.effort", version=3)
    file = path / "data" / "chunk-000" / "file-000.parquet"
    with pytest.raises(MeasurementError, match="is a Parquet file"):
        read_table(file)
    parquet.write_table(parquet.read_table(file).slice(0, 0), tmp_path / "none.parquet")
    with pytest.raises(MeasurementError, match="has no rows"):
        read_recording(tmp_path / "none.parquet", ROBOT)
    alone = changed(path, "episode_index", [0] * 2400)
    alone = changed(alone, "timestamp", [0.0] * 2400)
    with pytest.raises(MeasurementError, match=r"all 2400 stamps are 0.*recording\.rate"):
        read_recording(alone, ROBOT)
    assert read_recording(alone, ROBOT, RecordingOptions(rate=200.0)).t[1] == pytest.approx(0.005)
    (path / "meta" / "info.json").unlink()
    with pytest.raises(MeasurementError, match="LeRobot data set without its folder meta"):
        read_recording(path, ROBOT)
