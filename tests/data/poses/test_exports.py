"""Exports of instruments, written from their published descriptions, are read; our own tables stay as they are."""

import numpy as np
import pytest

from calib.data.csv_table import read_table
from calib.data.poses.exports import translated
from calib.errors import MeasurementError

POINTS = np.random.default_rng(0).uniform(-2.0, 2.0, (12, 3)).round(6)

MOTIVE = """Format Version,1.23,Take Name,Take 1,Rotation Type,Quaternion,Length Units,Meters,Coordinate Space,Global

,Type,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Marker,Marker,Marker
,Name,hand,hand,hand,hand,hand,hand,hand,hand,m1,m1,m1
,ID,1,1,1,1,1,1,1,1,2,2,2
,,Rotation,Rotation,Rotation,Rotation,Position,Position,Position,Mean Marker Error,Position,Position,Position
Frame,Time (Seconds),X,Y,Z,W,X,Y,Z,,X,Y,Z
"""
VICON = "Trajectories;;;;\n100;;;;\n;;1 1936;;\nFrame;Sub Frame;X;Y;Z\n;;mm;mm;mm\n"


def lines(form: str, factor: float = 1.0) -> str:
    return "".join(form.format(k + 1, *(factor * point).tolist()) + "\n" for k, point in enumerate(POINTS))


def commas(text: str) -> str:
    return text.replace(".", ",")


EXPORTS = {
    "spatialanalyzer": "// SA 2023\n// Frame A::World, Units: Inches\n"
    + lines("A Main P{} {:.9f} {:.9f} {:.9f}", 1 / 0.0254),
    "motive": MOTIVE + lines("{0},0.1,0,0,0,1,{1:.9f},{2:.9f},{3:.9f},0.0003,7,8,9"),
    "vicon": VICON + lines("{};0;{:.9f};{:.9f};{:.9f}", 1e3),
    "decimal commas, inches": "Name;X [inch];Y [inch];Z [inch]\n"
    + commas(lines("P{};{:.9f};{:.9f};{:.9f}", 1 / 0.0254)),
    "CMM": "Part: A7\nUnit: mm\n\nID\tActual X\tActual Y\tActual Z\n" + lines("{}\t{:.9f}\t{:.9f}\t{:.9f}", 1e3),
    "names, no header": lines("P{},{:.9f},{:.9f},{:.9f}"),
    "units below": "Point;X;Y;Z\n;mm;mm;mm\n" + lines("P{};{:.9f};{:.9f};{:.9f}", 1e3),
}


@pytest.mark.parametrize("name", EXPORTS)
@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_positions_of_an_export(tmp_path, name, encoding):
    path = tmp_path / "export.csv"
    path.write_text(EXPORTS[name], encoding=encoding)
    table = read_table(path)
    found = np.column_stack([table.numbers(axis, "length") for axis in "xyz"])
    np.testing.assert_allclose(found, POINTS, atol=1e-9)
    assert table.notes[0].startswith("read as ")


def test_body_is_a_pose_markers_are_targets(tmp_path):
    """One rigid body is read as a pose, and markers as several targets."""
    path = tmp_path / "take.csv"
    path.write_text(EXPORTS["motive"])
    assert {"qx", "qy", "qz", "qw", "x"} <= set(read_table(path).header) and "x1" not in read_table(path)
    head = "Trajectories;;;;;;;\n100;;;;;;;\n;;a;;;b;;\nFrame;Sub Frame;X;Y;Z;X;Y;Z\n;;mm;mm;mm;mm;mm;mm\n"
    path.write_text(head + "1;0;1.0;2.0;3.0;4.0;5.0;6.0\n" * 5)
    assert read_table(path).numbers("z2", "length")[0] == 6e-3


@pytest.mark.parametrize(
    "text",
    [
        "q1 [deg],q2 [deg],x [mm],y [mm],z [mm]\n1,2,3,4,5\n2,3,4,5,6\n",
        "# notes\nx_meas,y_meas,z_meas,X\n1,2,3,4\n1,2,3,4\n",
        "J1,J2,J3,J4,J5,J6,X,Y,Z\n1,2,3,4,5,6,7,8,9\n1,2,3,4,5,6,7,8,8\n",
        "t,q_a,q_b,tau_a\n0,1,2,3\n1,1,2,3\n",
        "1,2,3\n4,5,6\n",
        "a,b\n1,5,2,5\n",
        "joint,unit,reading,command,sigma\njoint1,rad,0,0,\njoint2,rad,1,2,3\njoint3,rad,1,2,3\n",
    ],
)
def test_our_tables_are_left_alone(tmp_path, text):
    path = tmp_path / "table.csv"
    path.write_text(text)
    assert translated(path) is None


def test_a_bad_cell_of_an_export_is_named(tmp_path):
    path = tmp_path / "export.csv"
    path.write_text(EXPORTS["CMM"] + "13\t1.0\tlost\t2.0\n")
    with pytest.raises(MeasurementError, match="row 13, column 'y': found 'lost'"):
        read_table(path).numbers("y", "length")
