"""Bad input: each ends in one message that says what, where (file, row, column) and what to try."""

from __future__ import annotations

import numpy as np
import pytest
from measured_rows import JOINTS, POSE

from calib.data.poses.fit_options import FileOptions
from calib.data.poses.pose_files import read_measurements
from calib.errors import MeasurementError

WIDE = ([-3.0] * 3, [3.0] * 3)


def refused(path, words, row=None, column=None, options=None, **more):
    with pytest.raises(MeasurementError, match=words) as error:
        read_measurements(path, JOINTS, options, **more)
    assert str(error.value.file) == str(path)
    assert (error.value.row, error.value.column) == (row, column)
    assert str(path) in str(error.value)


@pytest.mark.parametrize("limits", [None, WIDE])
def test_degrees_under_a_rad_header(write, good, limits):
    rows = [[*np.rad2deg(row[:3]), *row[3:]] for row in good]
    first = next(i for i, row in enumerate(rows) if abs(row[0]) > (6.6 if limits is None else 3))
    refused(write(POSE, rows), r"looks like deg; if so, name the column 'q1 \[deg\]'", first + 1, "q1", limits=limits)


def test_one_absurd_joint_value_is_found_too(write, good):
    good[6][2] = 90
    refused(write(POSE, good), "90 rad is more than a turn of wrist: ", 7, "q3")


def test_millimetres_under_m(write, good):
    rows = [[*row[:3], *(1500 + 100 * value for value in row[3:6])] for row in good]
    refused(write("q1,q2,q3,x,y,z", rows), r"if it is in mm, name the column 'x \[mm\]'", 1, "x")
    rows = [[*row[:3], 500, 0] for row in good]
    refused(write("q1,q2,q3,distance,bar", rows), r"500 m; if it is in mm", 1, "distance")
    rows = [[900 * row[0], *row[1:6]] for row in good]
    kinds = ("prismatic", "revolute", "revolute")
    refused(write("q1,q2,q3,x,y,z", rows), "cannot be the travel of shoulder.*looks like mm", 1, "q1", kinds=kinds)


@pytest.mark.parametrize(
    ("drop", "words", "column"),
    [
        ("q2", "missing.*the robot has 3 joints", "q2"),
        ("z", "missing.*x, y, z go together", "z"),
        ("qw", "missing.*qx, qy, qz, qw go together", "qw"),
    ],
)
def test_a_column_missing(write, good, drop, words, column):
    keep = [i for i, name in enumerate(POSE.split(",")) if name != drop]
    rows = [[row[i] for i in keep] for row in good]
    refused(write(",".join(POSE.split(",")[i] for i in keep), rows), words, None, column)


def test_a_column_doubled(write, good):
    refused(write(POSE.replace("q3", "q2"), good), "more than once .columns 2 and 3", None, "q2")


@pytest.mark.parametrize("columns", [{"x": "y"}, {"x": "y", "y": "y"}, {"qx": "qy"}])
def test_a_column_read_twice(write, good, columns):
    twice = next(iter(columns.values()))
    refused(write(POSE, good), "read twice", None, twice, FileOptions(columns=columns))


def test_a_column_too_many(write, good):
    refused(
        write(POSE + ",q4", [[*row, 0.1] for row in good]), "the robot has 3 joints, and this is one more", None, "q4"
    )


def test_no_joint_columns_at_all(write, good):
    refused(write("a,b,c,x,y,z", [row[:6] for row in good]), "no joint columns: expected q1 to q3, or shoulder")


def test_nothing_measured(write, good):
    refused(write("q1,q2,q3,X", [row[:4] for row in good]), "nothing measured found.*the header has q1, q2, q3, X")


def test_nan_and_text(write, good):
    good[3][1] = "nan"
    refused(write(POSE, good), "empty or NaN", 4, "q2")
    good[3][1], good[7][4] = 0.1, ""
    refused(write(POSE, good), "empty or NaN", 8, "y")
    good[7][4] = "beam lost"
    refused(write(POSE, good), "'beam lost' where a number is needed", 8, "y")


def test_all_poses_equal(write, good):
    rows = [[*good[0][:3], *row[3:]] for row in good]
    refused(write(POSE, rows), "all 10 rows have the same joint values", 10, "q1")


def test_a_quaternion_of_norm_one_half(write, good):
    good[4][6:] = [0.5 * value for value in good[4][6:]]
    refused(write(POSE, good), "has norm 0.5, not 1", 5, "qx")


def matrix_file(write, good, matrix):
    header = "q1,q2,q3,x,y,z," + ",".join(f"r{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3))
    rows = [[*row[:6], *np.eye(3).ravel()] for row in good]
    rows[2][6:] = np.ravel(matrix).tolist()
    return write(header, rows)


def test_left_handed_and_skewed_matrices(write, good):
    refused(matrix_file(write, good, np.diag([1.0, 1.0, -1.0])), "left-handed", 3, "r11")
    refused(matrix_file(write, good, [[1, 0.1, 0], [0, 1, 0], [0, 0, 1]]), "not orthonormal", 3, "r11")


def test_a_pose_outside_the_joint_limits(write, good):
    good[5][1] = 3.2
    path = write(POSE, good)
    words = "3.2 rad is outside the limits -3 to 3 rad of elbow: .*check_limits = false"
    refused(path, words, 6, "q2", limits=WIDE)
    (block,) = read_measurements(path, JOINTS, FileOptions(check_limits=False), limits=WIDE)
    assert any("elbow is outside its limits" in note for note in block.notes)


def test_swapped_joint_columns_show_in_the_limits(write, good):
    rows = [[row[0], 0.3 * abs(row[1]) - 2.9, *row[2:]] for row in good]
    limits = ([-2.9, -3.0, -2.9], [2.9, 0.1, 2.9])
    assert len(read_measurements(write(POSE, rows), JOINTS, limits=limits)[0]) == 10
    first = next(i for i, row in enumerate(good) if row[0] > 0.1) + 1
    path = write(POSE.replace("q1,q2", "q2,q1"), rows)
    refused(path, "outside the limits -3 to 0.1 rad of elbow.*are joint columns swapped", first, "q2", limits=limits)


def test_a_unit_that_does_not_suit_the_joint(write, good):
    kinds = ("prismatic", "revolute", "revolute")
    refused(write("q1 [deg]," + POSE[3:], good), "does not suit a prismatic joint", None, "q1", kinds=kinds)
    refused(write("q1 [mm]," + POSE[3:], good), "does not suit a revolute joint", None, "q1")
    stated = FileOptions(units={"joints": "mm"})
    refused(write(POSE, good), r"\[mm\] does not suit a revolute joint: the options state it", None, "q1", stated)


def test_a_header_that_fits_several_kinds(write, good):
    path = write("q1,q2,q3,x,y,z,socket", [[*row[:6], 0] for row in good])
    refused(path, "allows the kinds sockets, position: say which one")


def test_a_reflector_seen_by_half(write, good):
    rows = [[*row[:6], *row[3:6]] for row in good]
    rows[2][7] = ""
    refused(write("q1,q2,q3,x1,y1,z1,x2,y2,z2", rows), "is empty while others of x2, y2, z2 are not", 3, "y2")
    gone = [[*row[:3], *[""] * 6] for row in good]
    refused(write("q1,q2,q3,x1,y1,z1,x2,y2,z2", gone), "no target was seen", None, "x1")


def test_sigmas_that_are_not_positive(write, good):
    rows = [[*row[:6], 1e-5, 1e-5, 0 if i == 8 else 1e-5] for i, row in enumerate(good)]
    path = write("q1,q2,q3,x,y,z,sigma_x,sigma_y,sigma_z", rows)
    refused(path, "found 0: a sigma must be above 0.*sigma.floor", 9, "sigma_z")


def test_pairs_that_are_no_pairs(write, good):
    rows = [[*row[:3], 0.1, i // 2] for i, row in enumerate(good)]
    refused(write("q1,q2,q3,distance,pair", rows[:9]), "pair '4' has 1 rows", 9, "pair")
    rows[3][3] = 0.2
    refused(write("q1,q2,q3,distance,pair", rows), "0.2 m here and 0.1 m in row 3", 4, "distance")
    rows[3][3] = -0.1
    refused(write("q1,q2,q3,distance,pair", rows), "must be above 0", 4, "distance")


def test_sockets_that_nothing_joins(write, good):
    rows = [[*row[:3], "left", i % 3] for i, row in enumerate(good)]
    path = write("q1,q2,q3,tool_position,socket", rows)
    refused(path, "left has 3 sockets .0, 1, 2.: say which", None, "socket", FileOptions(socket_distance=0.05))
    options = FileOptions(socket_distance=0.05, socket_pairs=(("0", "9"),))
    refused(path, "no fixture position has 0 and 9.*found 0, 1, 2", None, "socket", options)
    rows[6][4] = ""
    refused(write("q1,q2,q3,tool_position,socket", rows), "a label is needed", 7, "socket")


def test_options_that_name_what_is_not_there(write, good):
    path = write(POSE, good)
    refused(path, "'X_leica' is missing", None, None, FileOptions(columns={"x": "X_leica"}))
    refused(path, "map a column 'sigmax'.*did you mean 'sigma_x'", None, "x", FileOptions(columns={"sigmax": "x"}))
    refused(
        path, "unit mm for 'positon'.*did you mean 'position'", None, "positon", FileOptions(units={"positon": "mm"})
    )
    refused(path, "'day' is missing", None, None, FileOptions(where={"day": ("1",)}))
    refused(path, "no row is left by where = 9; found", None, "q1", FileOptions(where={"q1": ("9",)}))
    refused(path, "'socket' is missing", None, None, FileOptions(kind="sockets"))
    refused(write("q1,q2,q3,x,y,z", [row[:6] for row in good]), "needs qx qy", None, None, FileOptions(kind="pose"))
