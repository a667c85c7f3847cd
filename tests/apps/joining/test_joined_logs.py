"""Two logs of one motion are joined by time to a recording; columns are mapped by [columns], and said."""

from pathlib import Path

import numpy as np
import pytest

from calib.apps.joining.joining import join
from calib.cli import run
from calib.data.csv_table import read_table
from calib.data.recordings.recording_files import read_recording
from calib.data.schema import Joints
from calib.errors import MeasurementError

NAMES = ("pan", "lift", "elbow")
ROBOT = Joints(NAMES)
T = np.arange(400) / 200.0
Q = np.column_stack([np.sin(3.0 * T), np.cos(2.0 * T), np.sin(T)])
TAU = 20.0 * Q + 1.0


def table(path: Path, header: list[str], *columns: np.ndarray) -> Path:
    np.savetxt(path, np.column_stack(columns), fmt="%.9f", delimiter=",", header=",".join(header), comments="")
    return path


@pytest.mark.parametrize("reverse", [False, True])
@pytest.mark.parametrize(
    ("files", "headings"),
    [
        (("position.csv", "effort.csv"), ("- {}_joint_position", "- {}_joint_effort")),
        (("arm_q.csv", "arm_tau.csv"), ("{}", "{}")),
        (("a.csv", "b.csv"), ("{} pos", "{} torque [Nm]")),
    ],
)
def test_two_logs_become_one(tmp_path, files, headings, reverse):
    """Torques are interpolated at the positions' times, whichever file is named first and however columns are named."""
    paths = []
    for file, heading, values, late in zip(files, headings, (Q, TAU), (0.0, 0.002)):
        header = ["time", *(heading.format(name) for name in NAMES)]
        paths.append(table(tmp_path / file, header, 1.7e9 + T + late, values))
    if reverse:
        paths.reverse()
    out = tmp_path / "log.csv"
    assert run(["join", *map(str, paths), "--out", str(out)]) == 0
    recording = read_recording(out, ROBOT)
    expected = np.column_stack([np.interp(T[1:], T + 0.002, column) for column in TAU.T])
    assert np.allclose(recording.q, Q[1:], atol=1e-7) and np.allclose(recording.effort, expected, atol=1e-3)


def test_file_names_tell_quantity_and_unit(tmp_path):
    """Equal names of columns are told apart by the files' names, which may state a unit."""
    header = ["t", *NAMES, "gripper"]
    positions = table(tmp_path / "q.csv", header, T, Q, T)
    currents = table(tmp_path / "current_mA.csv", header, T, 1e3 * TAU, T)
    joined = join(currents, positions)
    joined.write(tmp_path / "log.csv")
    recording = read_recording(tmp_path / "log.csv", ROBOT)
    assert recording.kind == "current" and np.allclose(recording.effort, TAU)
    assert any("pan as current_pan" in note and "[mA" in note for note in joined.notes)


def test_logs_that_cannot_be_joined(tmp_path):
    """Equal names without a quantity, other clocks and other lengths are refused with what to do."""
    header = ["t", *NAMES]
    first, second = table(tmp_path / "a.csv", header, T, Q), table(tmp_path / "b.csv", header, T, TAU)
    with pytest.raises(MeasurementError, match=r"columns named as those of .*Name each file by its quantity"):
        join(first, second)
    other = table(tmp_path / "torque.csv", ["t", *(f"tau_{name}" for name in NAMES)], T + 1000.0, TAU)
    with pytest.raises(MeasurementError, match=r"of one clock\? If the rows belong together .*--by row"):
        join(first, other)
    assert len(join(first, other, by="row").poses) == len(T)


def test_options_name_columns_of_either_file(tmp_path):
    """[columns] and [units] apply to both files, and what they mapped is said."""
    joints = table(tmp_path / "joints.csv", ["A", "B", "C"], np.degrees(Q[:5]))
    points = table(tmp_path / "points.csv", ["X_leica", "Y_leica", "Z_leica"], 1e3 * Q[:5])
    options = tmp_path / "options.toml"
    lines = ['columns = { q1 = "A", q2 = "B", q3 = "C", x = "X_leica", y = "Y_leica", z = "Z_leica" }']
    lines += ['units = { joints = "deg", position = "mm" }', 'model = "geometry"']
    options.write_text("\n".join(lines))
    out = tmp_path / "m.csv"
    assert run(["join", str(joints), str(points), "--by", "row", "--options", str(options), "--out", str(out)]) == 0
    joined = read_table(out)
    assert joined.header == ("pose", "q1", "q2", "q3", "x", "y", "z")
    assert joined.units[1:] == ("deg", "deg", "deg", "mm", "mm", "mm")
    assert "A, B, C read as q1, q2, q3" in out.read_text()


def test_options_name_quantities_of_logs(tmp_path):
    """A quantity of all joints is mapped by one entry with {joint}."""
    first = table(tmp_path / "a.csv", ["clock", *(f"{name}.enc" for name in NAMES)], T, Q)
    second = table(tmp_path / "b.csv", ["clock", *(f"{name}.load" for name in NAMES)], T, TAU)
    options = tmp_path / "options.toml"
    options.write_text('columns = { t = "clock", q = "{joint}.enc", torque = "{joint}.load" }')
    joined = join(first, second, options=options)
    joined.write(tmp_path / "log.csv")
    assert np.allclose(read_recording(tmp_path / "log.csv", ROBOT).effort, TAU)
    options.write_text('columns = { q = "{joint}.encoder" }')
    with pytest.raises(MeasurementError, match=r"q = '\{joint\}.encoder' is in neither file"):
        join(first, second, options=options)
    options.write_text('units = { velocity = "deg" }')
    with pytest.raises(MeasurementError, match="no column of this name"):
        join(first, second, options=options)
