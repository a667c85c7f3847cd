"""Names of angles in other languages, signs, units and mixed conventions of tables are read, or named with a cure."""

from pathlib import Path

import numpy as np
import pytest

from calib.data.csv_table import as_column
from calib.data.joint_columns import joint_series
from calib.data.poses.name_shapes import orientations_by_shape
from calib.data.poses.pose_files import read_measurements
from calib.data.schema import Joints
from calib.errors import MeasurementError

ROBOT = Joints(("q1", "q2"), lower=np.full(2, -3.0), upper=np.full(2, 3.0))


def table(path: Path, q: np.ndarray, scale: float = 1.0) -> Path:
    """Write a table of joint values as they are, and of positions."""
    position = np.random.default_rng(2).uniform(0.1, 1.0, (len(q), 3)) * np.reshape(scale, (-1, 1))
    np.savetxt(path, np.column_stack([q, position]), delimiter=",", header="q1,q2,x,y,z", comments="")
    return path


@pytest.mark.parametrize(
    "names",
    [
        "Alabeo Cabeceo Guiñada",
        "Roulis Tangage Lacet",
        "Rollwinkel Nickwinkel Gierwinkel",
        "rollio beccheggio imbardata",
    ],
)
def test_angles_are_named_in_other_languages(names):
    """They are read as roll, pitch and yaw are."""
    (shape,) = orientations_by_shape(names.split())
    assert tuple(shape.columns.values()) == tuple(names.split())


def test_unit_is_asked_before_a_lost_turn(tmp_path):
    """Degrees from 0 to 360 without a unit are outside limits in degrees, too: the unit is said first."""
    q = np.random.default_rng(1).uniform(0.0, 360.0, (20, 2))
    with pytest.raises(MeasurementError, match="looks like deg"):
        read_measurements(table(tmp_path / "m.csv", q), ROBOT)


def test_two_conventions_in_a_file_are_said(tmp_path):
    """Half of the rows in deg or mm: to name the column's unit would damage the others."""
    q = np.random.default_rng(1).uniform(-2.0, 2.0, (20, 2))
    scale = np.repeat([57.3, 1.0], 10)
    with pytest.raises(MeasurementError, match="rows 1 to 10 look like deg, the others like rad"):
        read_measurements(table(tmp_path / "deg.csv", (np.sign(q) + q) * scale[:, None]), Joints(ROBOT.names))
    with pytest.raises(MeasurementError, match="rows 1 to 10 look like mm, the others like m"):
        read_measurements(table(tmp_path / "mm.csv", q, np.repeat([1e3, 1.0], 10)), ROBOT)


def test_typeset_numbers(tmp_path):
    """A minus sign is read; separators of thousands are named."""
    np.testing.assert_array_equal(as_column(["\u22121.5", "2"]), [-1.5, 2.0])
    (tmp_path / "m.csv").write_text("q1;q2;x;y;z\n" + "1,5;2,5;1.045,8959;0,5;0,5\n" * 3)
    with pytest.raises(MeasurementError, match="separators between thousands"):
        read_measurements(tmp_path / "m.csv", ROBOT, None)


def test_unread_angles_are_said(tmp_path):
    """Three columns of unknown names whose numbers may be angles: the note says what to state."""
    rows = np.random.default_rng(3).uniform(-1.0, 1.0, (9, 8))
    path = tmp_path / "m.csv"
    np.savetxt(path, rows, delimiter=",", header="q1,q2,x,y,z,u1st,v2nd,w3rd", comments="")
    (block,) = read_measurements(path, ROBOT)
    assert any("look like three angles" in note and 'rx = "u1st"' in note for note in block.notes)


def test_row_of_german_units(tmp_path):
    """Units in a row below the names are read."""
    path = tmp_path / "m.csv"
    path.write_text("q1;q2;X;Y;Z\nGrad;Grad;mm;mm;mm\n" + "90,5;45,5;100,5;200,5;300,5\n10,5;4,5;10,5;20,5;30,5\n" * 3)
    (block,) = read_measurements(path, ROBOT)
    np.testing.assert_allclose(block.position[0], [0.1005, 0.2005, 0.3005])
    np.testing.assert_allclose(block.q[0], np.deg2rad([90.5, 45.5]))


def test_units_as_words_of_names(tmp_path):
    """A_deg B_deg C_deg are three angles; joints of a rail in m and of turning joints in deg are one series."""
    (shape,) = orientations_by_shape(["a_deg", "b_deg", "c_deg"])
    assert shape.columns == {"rx": "a_deg", "ry": "b_deg", "rz": "c_deg"}
    assert not orientations_by_shape(["a", "b", "c"])
    (series,) = joint_series(["lift_m", "elbow_deg", "wrist_deg"], ["lift", "elbow", "wrist"])
    assert series.columns == ("lift_m", "elbow_deg", "wrist_deg")


def test_a_title_above_the_names(tmp_path):
    """Names by shape below titles of one cell are found as ours are; X1 … Z2 are two targets."""
    rows = "0.1,0.2,1.0,2.0,3.0\n" * 2 + "0.3,-0.2,1.5,2.0,3.0\n" * 2
    (tmp_path / "m.csv").write_text(f"Protocol of Monday\n\nq1,q2,tvec_x,tvec_y,tvec_z\n{rows}")
    (block,) = read_measurements(tmp_path / "m.csv", ROBOT)
    assert len(block) == 4 and block.position[0].tolist() == [1.0, 2.0, 3.0]
    header = "q1,q2,X1,Y1,Z1,X2,Y2,Z2"
    rows = "0.1,0.2,1,2,3,4,5,6\n0.2,0.1,1,2,4,4,5,7\n0.3,0.1,1,2,5,4,5,8\n"
    (tmp_path / "two.csv").write_text(f"{header}\n{rows}")
    (block,) = read_measurements(tmp_path / "two.csv", ROBOT)
    assert len(block.tool_names) == 2 and block.position[1].tolist() == [4.0, 5.0, 6.0]
