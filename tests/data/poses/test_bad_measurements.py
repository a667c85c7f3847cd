"""Bad input: each file ends in one message that says what, where (file, row, column) and what to try."""

import numpy as np
import pytest
from measured_rows import POSE, within

from calib.data.poses.fit_options import FileOptions
from calib.data.poses.pose_files import read_measurements
from calib.errors import MeasurementError

WIDE = ([-3.0] * 3, [3.0] * 3)
SLIDING = ("prismatic", "revolute", "revolute")
Q, XYZ, PAIR, SOCKET = "q1,q2,q3", "q1,q2,q3,x,y,z", "q1,q2,q3,distance,pair", "q1,q2,q3,tool_position,socket"
TWO, MATRIX = f"{Q},x1,y1,z1,x2,y2,z2", f"{XYZ}," + ",".join(f"r{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3))
SIGMAS = f"{XYZ},sigma_x,sigma_y,sigma_z"


def refused(path, words, row=None, column=None, options=None, **more):
    with pytest.raises(MeasurementError, match=words) as error:
        read_measurements(path, within(**more), options)
    assert str(error.value.file) == str(path)
    assert (error.value.row, error.value.column) == (row, column)
    assert str(path) in str(error.value)


def put(row, column, value):
    """Return what writes a value into a cell of the good rows."""

    def spoil(rows):
        rows[row][column] = value
        return rows

    return spoil


def as_is(rows):
    return rows


def matrices(third):
    return lambda rows: [[*row[:6], *np.ravel(third if i == 2 else np.eye(3))] for i, row in enumerate(rows)]


def without(name):
    place = POSE.split(",").index(name)
    header = ",".join(other for other in POSE.split(",") if other != name)
    return header, lambda rows: [[cell for i, cell in enumerate(row) if i != place] for row in rows]


def joints_and(*cells):
    """Return what keeps the joints and puts other cells behind them: values, or functions of the row and its number."""
    return lambda rows: [
        [*row[:3], *(cell(row, i) if callable(cell) else cell for cell in cells)] for i, row in enumerate(rows)
    ]


def pairs(count, row=0, distance=0.1):
    return lambda rows: put(row, 3, distance)(joints_and(0.1, lambda _, i: i // 2)(rows))[:count]


def sockets(rows):
    return joints_and("left", lambda _, i: i % 3)(rows)


def half_seen(rows):
    return put(2, 7, "")([[*row[:6], *row[3:6]] for row in rows])


@pytest.mark.parametrize(
    "header, spoil, words, row, column, more",
    [
        (POSE, put(6, 2, 90), "90 rad is more than a turn of wrist: ", 7, "q3", {}),
        (
            XYZ, lambda rows: [[*row[:3], *(1500 + 100 * value for value in row[3:6])] for row in rows],
            r"if it is in mm, name the column 'x \[mm\]'", 1, "x", {},
        ),
        (f"{Q},distance,bar", joints_and(500, 0), "500 m; if it is in mm", 1, "distance", {}),
        (
            XYZ, lambda rows: [[900 * row[0], *row[1:6]] for row in rows],
            "cannot be the travel of shoulder.*looks like mm", 1, "q1", {"kinds": SLIDING},
        ),
        (*without("q2"), "missing.*the robot has 3 joints", None, "q2", {}),
        (*without("z"), "missing.*x, y, z go together", None, "z", {}),
        (*without("qw"), "missing.*qx, qy, qz, qw go together", None, "qw", {}),
        (POSE.replace("q3", "q2"), as_is, "more than once in the header .columns 2 and 3", None, "q2", {}),
        (POSE, as_is, "is read as two", None, "y", {"options": FileOptions(columns={"x": "y"})}),
        (POSE, as_is, "is read as two", None, "y", {"options": FileOptions(columns={"x": "y", "y": "y"})}),
        (POSE, as_is, "is read as two", None, "qy", {"options": FileOptions(columns={"qx": "qy"})}),
        (
            POSE + ",q4", lambda rows: [[*row, 0.1] for row in rows],
            "the robot has only 3 joints", None, "q4", {},
        ),
        (
            "a,b,c,x,y,z", lambda rows: [row[:6] for row in rows],
            "no joint columns: expected q1 to q3, or shoulder", None, None, {},
        ),
        (f"{Q},X", joints_and(1.0), "no measurements found.*the header has q1, q2, q3, X", None, None, {}),
        (POSE, put(3, 1, "nan"), "empty or NaN", 4, "q2", {}),
        (POSE, put(7, 4, ""), "empty or NaN", 8, "y", {}),
        (POSE, put(7, 4, "beam lost"), "'beam lost' where a number is needed", 8, "y", {}),
        (
            POSE, lambda rows: put(2, 5, "")(put(7, 4, "beam lost")(put(8, 0, "ERR")(rows))),
            "an empty or NaN cell .*and in 2 more rows; of all, 1 in q1, 1 in y, 1 in z", 3, "z", {},
        ),
        (
            POSE, lambda rows: [[*rows[0][:3], *row[3:]] for row in rows],
            "all 10 rows have the same joint values", 10, "q1", {},
        ),
        (
            POSE, lambda rows: [*rows[:4], [*rows[4][:6], *(0.5 * value for value in rows[4][6:])], *rows[5:]],
            "has norm 0.5, not 1", 5, "qx", {},
        ),
        (MATRIX, matrices(np.diag([1.0, 1.0, -1.0])), "left-handed", 3, "r11", {}),
        (MATRIX, matrices([[1, 0.1, 0], [0, 1, 0], [0, 0, 1]]), "not orthonormal", 3, "r11", {}),
        ("q1 [deg]," + POSE[3:], as_is, "does not suit a prismatic joint", None, "q1", {"kinds": SLIDING}),
        ("q1 [mm]," + POSE[3:], as_is, "does not suit a revolute joint", None, "q1", {}),
        (
            POSE, as_is, r"\[mm\] does not suit a revolute joint: the unit is from the options", None, "q1",
            {"options": FileOptions(units={"joints": "mm"})},
        ),
        (
            f"{XYZ},socket", lambda rows: [[*row[:6], 0] for row in rows],
            "allows the kinds sockets, position; state one", None, None, {},
        ),
        (TWO, half_seen, "is empty, unlike others of x2, y2, z2", 3, "y2", {}),
        (TWO, joints_and(*[""] * 6), "no target was seen", None, "x1", {}),
        (
            SIGMAS, lambda rows: [[*row[:6], 1e-5, 1e-5, 0 if i == 8 else 1e-5] for i, row in enumerate(rows)],
            "found 0: a sigma must be above 0.*sigma.floor", 9, "sigma_z", {},
        ),
        (PAIR, pairs(9), "pair '4' has 1 rows", 9, "pair", {}),
        (PAIR, pairs(10, 3, 0.2), "0.2 m here and 0.1 m in row 3", 4, "distance", {}),
        (PAIR, pairs(10, 3, -0.1), "must be above 0", 4, "distance", {}),
        (
            SOCKET, sockets, "left has 3 sockets .0, 1, 2.: state which", None, "socket",
            {"options": FileOptions(socket_distance=0.05)},
        ),
        (
            SOCKET, sockets, "no fixture position has 0 and 9.*found 0, 1, 2", None, "socket",
            {"options": FileOptions(socket_distance=0.05, socket_pairs=(("0", "9"),))},
        ),
        (SOCKET, lambda rows: put(6, 4, "")(sockets(rows)), "a label is needed", 7, "socket", {}),
        (POSE, as_is, "'X_leica' is missing", None, None, {"options": FileOptions(columns={"x": "X_leica"})}),
        (
            POSE, as_is, "map a column 'sigmax'.*did you mean 'sigma_x'", None, "x",
            {"options": FileOptions(columns={"sigmax": "x"})},
        ),
        (
            POSE, as_is, "unit mm for 'positon'.*did you mean 'position'", None, "positon",
            {"options": FileOptions(units={"positon": "mm"})},
        ),
        (POSE, as_is, "'day' is missing", None, None, {"options": FileOptions(where={"day": ("1",)})}),
        (POSE, as_is, "no row is selected by where = 9", None, "q1", {"options": FileOptions(where={"q1": ("9",)})}),
        (
            f"{XYZ},base_x,base_y", lambda rows: [row[:8] for row in rows],
            "base_x, base_y, base_z go together", None, "base_z", {},
        ),
        (POSE, as_is, "'socket' is missing", None, None, {"options": FileOptions(kind="sockets")}),
        (XYZ, lambda rows: [row[:6] for row in rows], "needs qx qy", None, None, {"options": FileOptions(kind="pose")}),
    ],
)  # fmt: skip
def test_spoiled_file_is_refused_at_its_cell(write, good, header, spoil, words, row, column, more):
    """A spoiled file is refused at its cell."""
    refused(write(header, spoil(good)), words, row, column, **more)


@pytest.mark.parametrize("limits", [(None, None), WIDE])
def test_degrees_under_a_rad_header(write, good, limits):
    rows = [[*np.rad2deg(row[:3]), *row[3:]] for row in good]
    first = next(i for i, row in enumerate(rows) if abs(row[0]) > (3 if limits is WIDE else 6.6))
    refused(write(POSE, rows), r"looks like deg; if so, name the column 'q1 \[deg\]'", first + 1, "q1", limits=limits)


def test_a_pose_outside_the_joint_limits(write, good):
    path = write(POSE, put(5, 1, 3.2)(good))
    words = "3.2 rad is outside the limits -3 to 3 rad of elbow: .*check_limits = false"
    refused(path, words, 6, "q2", limits=WIDE)
    (block,) = read_measurements(path, within(WIDE), FileOptions(check_limits=False))
    assert any("elbow is outside its limits" in note for note in block.notes)


def test_lost_turn_and_other_zero_are_asked_for(write, good):
    """A value that fits after a whole turn, and a column that fits after a right angle, say so."""
    wound = write(POSE, put(7, 1, 3.1)(put(5, 1, 6.0)(good)))
    refused(wound, r"\(-1 turn\) is inside: was the joint wound", 6, "q2", limits=WIDE)
    first = good[0][1] + np.pi / 2
    near = ([-2.9, good[0][1] - 0.1, -2.9], [2.9, good[0][1] + 0.1, 2.9])
    turned = [[row[0], first + 0.01 * number, *row[2:]] for number, row in enumerate(good[:9])]
    refused(write(POSE, turned), "another zero. With -90° all rows fit", 1, "q2", limits=near)


def test_swapped_columns_show_in_the_limits(write, good):
    """Swapped joint columns show in the limits."""
    rows = [[row[0], 0.3 * abs(row[1]) - 2.9, *row[2:]] for row in good]
    limits = ([-2.9, -3.0, -2.9], [2.9, 0.1, 2.9])
    assert len(read_measurements(write(POSE, rows), within(limits))[0]) == 10
    first = next(i for i, row in enumerate(good) if row[0] > 0.1) + 1
    path = write(POSE.replace("q1,q2", "q2,q1"), rows)
    refused(path, "outside the limits -3 to 0.1 rad of elbow.*are joint columns swapped", first, "q2", limits=limits)
