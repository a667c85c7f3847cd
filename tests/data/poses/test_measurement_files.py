"""The measurement CSV: what is read, and how."""

import numpy as np
import pytest
from measured_rows import POSE, within
from scipy.spatial.transform import Rotation

from calib.data.poses.columns import MATRIX
from calib.data.poses.fit_options import FileOptions, Sigma
from calib.data.poses.pose_files import joint_columns, read_measurements
from calib.errors import MeasurementError


def read(path, options=None, **more):
    (block,) = read_measurements(path, within(**more), options)
    return block


def table(rows, names, wanted):
    """Pick columns of the good rows by name."""
    place = [names.split(",").index(name) for name in wanted.split(",")]
    return [[row[i] for i in place] for row in rows]


def test_poses(write, good):
    block = read(write(POSE + ",temperature,note", [[*row, 20, "ok"] for row in good]))
    values = np.array(good, dtype=float)
    assert block.kind == "pose" and block.joint_names == ("q1", "q2", "q3") and block.station == "poses"
    np.testing.assert_array_equal(block.q, values[:, :3])
    np.testing.assert_array_equal(block.position, values[:, 3:6])
    np.testing.assert_allclose(block.quaternion, values[:, 6:], atol=1e-8)
    np.testing.assert_allclose(np.linalg.norm(block.quaternion, axis=1), 1, rtol=1e-15)
    assert block.ignored == ("temperature", "note")
    assert block.rows is not None and block.rows.tolist() == list(range(1, 11))
    assert block.sigma is None and block.tool_names == ("tool",)


@pytest.mark.parametrize("names", ["shoulder,elbow,wrist", "q_shoulder,q_elbow,q_wrist", "q1,q2,q3"])
def test_joint_columns_by_name_in_any_order(write, good, names):
    a, b, c = names.split(",")
    rows = table(good, POSE, "q3,q1,q2,x,y,z")
    block = read(write(f"{c},{a},{b},x,y,z", rows))
    np.testing.assert_array_equal(block.q, np.array(good, dtype=float)[:, :3])
    assert block.joint_names == (a, b, c)


def test_degrees_and_millimetres(write, good):
    values = np.array(good, dtype=float)
    rows = np.hstack([np.rad2deg(values[:, :3]), 1e3 * values[:, 3:6], np.full((10, 3), 20.0)]).tolist()
    header = "q1 [deg],q2 (deg),q3 [°],x [mm],y [mm],z [mm],sigma_x [um],sigma_y [um],sigma_z [um]"
    block = read(write(header, rows))
    np.testing.assert_allclose(block.q, values[:, :3], rtol=1e-14)
    np.testing.assert_allclose(block.position, values[:, 3:6], rtol=1e-14)
    np.testing.assert_allclose(block.sigma, 20e-6)
    plain = read(
        write("q1,q2,q3,x,y,z,a,b,c", rows),
        FileOptions(units={"joints": "deg", "position": "mm"}),
        limits=([-3] * 3, [3] * 3),
    )
    np.testing.assert_allclose(plain.q, block.q)
    np.testing.assert_allclose(plain.position, block.position)


def test_a_prismatic_joint_in_millimetres(write, good):
    rows = [[1e3 * row[0], *row[1:6]] for row in good]
    block = read(write("q1 [mm],q2,q3,x,y,z", rows), kinds=("prismatic", "revolute", "revolute"))
    np.testing.assert_allclose(block.q, np.array(good, dtype=float)[:, :3])


@pytest.mark.parametrize("suffix", ["_meas", "_measured"])
def test_columns_with_suffix_are_taken(write, good, suffix):
    """Measured columns with a suffix are taken, and the suffix is said."""
    header = "q1,q2,q3," + ",".join(name + suffix for name in ["x", "y", "z", "qx", "qy", "qz", "qw"]) + ",x_target"
    block = read(write(header, [[*row, 0] for row in good]))
    assert block.kind == "pose" and block.ignored == ("x_target",)
    assert any(f"x{suffix}" in note for note in block.notes) and any(f"qw{suffix}" in note for note in block.notes)


@pytest.mark.parametrize("names", [("x", "y", "z"), ("x_meas", "y_meas", "z_meas")])
def test_commanded_beside_measured_refused(write, good, names):
    """Commanded positions beside measured ones are refused until the options say which to take."""
    path = write("q1,q2,q3,x,y,z,x_meas,y_meas,z_meas", [[*row[:6], 9, 9, 9] for row in good])
    with pytest.raises(MeasurementError, match=r'map the columns.*\[columns\] x = "x_meas"'):
        read(path)
    block = read(path, FileOptions(columns=dict(zip("xyz", names))))
    expected = np.array(good, dtype=float)[:, 3:6] if names[0] == "x" else np.full((len(good), 3), 9.0)
    np.testing.assert_array_equal(block.position, expected)
    assert block.ignored == (("x_meas", "y_meas", "z_meas") if names[0] == "x" else ("x", "y", "z"))


POSITIONS, TURNS = ("x", "y", "z"), ("qx", "qy", "qz", "qw")


@pytest.mark.parametrize(
    "header, mapped, plain",
    [
        ("x_meas,y_meas,z_meas,qx,qy,qz,qw", {}, TURNS),
        ("x_measured,y_measured,z_measured,r11,r12,r13,r21,r22,r23,r31,r32,r33", {}, MATRIX.names),
        ("x,y,z,x_meas,y_meas,z_meas,qx,qy,qz,qw", {name: name + "_meas" for name in POSITIONS}, TURNS),
        ("x,y,z,px,py,pz,qx,qy,qz,qw", dict(zip(POSITIONS, ("px", "py", "pz"))), TURNS),
        ("x,y,z,qx_meas,qy_meas,qz_meas,qw_meas", {}, POSITIONS),
    ],
)
def test_unmapped_orientation_is_refused(write, good, header, mapped, plain):
    """A plain orientation beside measured positions is refused until it is mapped."""
    names = header.split(",")
    matrices = Rotation.from_quat(np.array(good, dtype=float)[:, 6:]).as_matrix().reshape(-1, 9)
    turned = [[*row[6:]] if "r11" not in names else [*matrix] for row, matrix in zip(good, matrices)]
    count = len(names) - len(turned[0])
    path = write(f"q1,q2,q3,{header}", [[*row[:6], *row[3:6]][: 3 + count] + turn for row, turn in zip(good, turned)])
    with pytest.raises(MeasurementError, match=f'measured or commanded.*{plain[0]} = "{plain[0]}"') as told:
        read(path, FileOptions(columns=mapped))
    assert ('kind = "position"' in str(told.value)) == (plain != POSITIONS)
    block = read(path, FileOptions(columns={**mapped, **{name: name for name in plain}}))
    assert block.kind == "pose"
    assert read(path, FileOptions(kind="position", columns=mapped)).kind == "position"


def test_partial_map_is_completed(write, good):
    """A map of some columns is completed by those that go with them."""
    path = write("q1,q2,q3,x_meas,y_meas,z_meas", [row[:6] for row in good])
    block = read(path, FileOptions(columns={"x": "y_meas", "y": "x_meas"}))
    np.testing.assert_array_equal(block.position, np.array(good, dtype=float)[:, [4, 3, 5]])


@pytest.mark.parametrize(
    "header, columns, said",
    [
        ("x_meas,y_meas,z_meas", {"x": "z_meas"}, "is read as two different columns"),
        ("x,y,z,x_meas,y_meas,z_meas", {"x": "x_meas", "y": "y_meas"}, "z and z_meas could be meant"),
        ("a,b,height", {"x": "a", "y": "b"}, "map this one"),
        ("x,y,z,qx_meas", {"qx": "qx_meas"}, "map this one"),
        ("x,y,z,std", {"sigma_distance": "std"}, "not read in a file of kind 'position'"),
    ],
)
def test_impossible_map_is_refused(write, good, header, columns, said):
    """A map that cannot be followed is refused."""
    width = len(header.split(","))
    path = write(f"q1,q2,q3,{header}", [[*row[:3], *range(1, 1 + width)] for row in good])
    with pytest.raises(MeasurementError, match=said):
        read(path, FileOptions(columns=columns))


def test_several_reflectors_with_gaps(write, good):
    rows = [[*row[:6], *row[3:6]] for row in good]
    rows[1][3:6] = ["", "", ""]
    rows[4][6:9] = ["NaN"] * 3
    block = read(
        write("q1,q2,q3,x1,y1,z1,x2,y2,z2", rows), FileOptions(tool="ball", sigma=Sigma(position=(1e-5, 1e-5, 2e-5)))
    )
    assert block.kind == "position" and len(block) == 18 and block.tool_names == ("ball 1", "ball 2")
    assert block.rows is not None and block.rows.tolist()[:4] == [1, 1, 2, 3]
    assert block.tool is not None and block.tool.tolist()[:4] == [0, 1, 1, 0]
    np.testing.assert_array_equal(block.position, np.array(good, dtype=float)[block.rows - 1, 3:6])
    np.testing.assert_array_equal(block.sigma, np.tile((1e-5, 1e-5, 2e-5), (18, 1)))
    assert [note for note in block.notes if "not seen in 1 of 10 rows" in note] == list(block.notes)


def test_a_tool_column_separates_reflectors(write, good):
    rows = [[*row[:6], "A" if i % 2 else "B"] for i, row in enumerate(good)]
    block = read(write("q1,q2,q3,x,y,z,tool", rows))
    assert block.tool_names == ("B", "A") and block.tool is not None and block.tool.tolist() == [0, 1] * 5


def test_distances_between_two_poses(write, good):
    rows = [[*row[:3], 0.1 * (1 + i // 2), f"p{i // 2}", 2e-5] for i, row in enumerate(good)]
    block = read(write("q1,q2,q3,distance,pair,sigma_distance", rows))
    assert block.kind == "distance" and block.group_names == tuple(f"p{i}" for i in range(5))
    assert block.group is not None and block.group.tolist() == [i // 2 for i in range(10)]
    np.testing.assert_allclose(block.distance, [row[3] for row in rows])
    np.testing.assert_array_equal(block.sigma, np.full(10, 2e-5))


def test_distances_to_bars_and_planes(write, good):
    """Distances to the ends of bars, and points on planes."""
    block = read(write("q1,q2,q3,plane", [[*row[:3], "table"] for row in good]))
    assert block.kind == "plane" and block.group_names == ("table",) and not block.has_instrument
    rows = [[*row[:3], 500, i // 5] for i, row in enumerate(good)]
    block = read(write("q1,q2,q3,distance [mm],bar", rows), FileOptions(sigma=Sigma(distance=1e-5)))
    assert block.kind == "bar" and block.group_names == ("0", "1")
    np.testing.assert_allclose(block.distance, 0.5)
    np.testing.assert_array_equal(block.sigma, np.full(10, 1e-5))


SOCKETS = "q1,q2,q3,tool_position,socket"


def sockets(good):
    return [[*row[:3], "left" if i < 5 else "right", i % 2] for i, row in enumerate(good)]


def test_sockets_are_grouped_with_fixture(write, good):
    """Sockets are grouped with their fixture."""
    block = read(write(SOCKETS, sockets(good)), FileOptions(socket_distance=0.05))
    assert block.kind == "sockets" and block.group_names == ("left/0", "left/1", "right/1", "right/0")
    assert block.links == ((0, 1, 0.05), (2, 3, 0.05))
    assert read(write(SOCKETS, sockets(good))).links == ()


def test_socket_groups_and_pairs_by_options(write, good):
    rows = [[*row[:3], "left", i % 3, i // 3] for i, row in enumerate(good[:9])]
    path = write(SOCKETS + ",day", rows)
    block = read(path, FileOptions(socket_distance=0.05, socket_pairs=(("0", "2"),)))
    assert block.links == ((0, 2, 0.05),)
    block = read(path, FileOptions(groups=("day",), kind="sockets"))
    assert block.group_names[:4] == ("0/0", "0/1", "0/2", "1/0")
    assert any("measured in one row only" in note for note in block.notes)


def test_where_keeps_rows_and_their_numbers(write, good):
    block = read(write(SOCKETS, sockets(good)), FileOptions(where={"tool_position": ("right",), "socket": ("1",)}))
    assert block.rows is not None and block.rows.tolist() == [6, 8, 10] and block.group_names == ("right/1",)


def test_other_names_by_the_options(write, good):
    header = "A1,A2,A3,X_leica,Y_leica,Z_leica,std1,std2,std3"
    ours = ("q1", "elbow", "q3", "x", "y", "z", "sigma_x", "sigma_y", "sigma_z")
    options = FileOptions(columns=dict(zip(ours, header.split(","))), units={"A1": "rad"})
    block = read(write(header, [[*row[:6], 1e-5, 1e-5, 1e-5] for row in good]), options)
    assert block.joint_names == ("A1", "A2", "A3") and block.ignored == ()
    np.testing.assert_array_equal(block.position, np.array(good, dtype=float)[:, 3:6])
    np.testing.assert_array_equal(block.sigma, np.full((10, 3), 1e-5))


def test_the_options_choose_among_kinds(write, good):
    path = write("q1,q2,q3,x,y,z,socket", [[*row[:6], 0] for row in good])
    assert read(path, FileOptions(kind="sockets")).kind == "sockets"
    position = read(path, FileOptions(kind="position"))
    assert position.kind == "position" and position.ignored == ("socket",)
    path = write(POSE, good)
    assert read(path, FileOptions(kind="position")).ignored == ("qx", "qy", "qz", "qw")


def test_column_sigmas_win_above_the_floor(write, good):
    """Sigmas of columns win and are raised to the floor."""
    rows = [[*row[:6], *row[3:6], 1e-5, 2e-5, 3e-5, 4e-5, 5e-5, 6e-5] for row in good]
    names = ",".join(f"sigma_{axis}{k}" for k in (1, 2) for axis in "xyz")
    block = read(write(f"q1,q2,q3,x1,y1,z1,x2,y2,z2,{names}", rows))
    np.testing.assert_array_equal(block.sigma[:2], [[1e-5, 2e-5, 3e-5], [4e-5, 5e-5, 6e-5]])
    header = POSE + ",sigma_x,sigma_y,sigma_z,sigma_rx,sigma_ry,sigma_rz"
    path = write(header, [[*row, 0, 2e-6, 1, 1, 1, 1] for row in good])
    options = FileOptions(sigma=Sigma(position=(1, 1, 1), orientation=(9, 9, 9), floor=1e-6))
    block = read(path, options)
    np.testing.assert_array_equal(block.sigma[0], [1e-6, 2e-6, 1])
    np.testing.assert_array_equal(block.sigma_rotation, np.ones((10, 3)))


def test_constant_quaternion_is_fine(write, good):
    """A constant quaternion and small rounding are fine."""
    block = read(write(POSE, [[*row[:6], 0, 0, 0, 1.0005] for row in good]))
    np.testing.assert_allclose(block.quaternion, np.tile([0, 0, 0, 1.0], (10, 1)))


def test_joint_like_names_of_a_header(write):
    path = write("id,q_S,q_L,x_meas,y_meas,z_meas,x1,sigma_x,socket,T [C]", "1,2,3,4,5,6,7,8,9,10")
    assert joint_columns(path) == ("id", "S", "L")


def test_limit_and_unit_oddities_are_notes(write, good):
    """A little beyond a limit, and radians under a degree header, are notes."""
    limit = max(row[0] for row in good)
    block = read(write(POSE, good), limits=([-3, -3, -3], [limit - 5e-4, 3, 3]))
    assert any("shoulder is outside its limits in 1 of 10 rows" in note for note in block.notes)
    block = read(write(POSE.replace("q1,q2,q3", "q1 [deg],q2 [deg],q3 [deg]"), good))
    assert any("radians instead of degrees" in note for note in block.notes)


def test_multi_turn_joint_passes_in_limits(write, good):
    """A multi-turn joint passes within its limits."""
    rows = [[row[0], row[1], 5 * row[2], *row[3:]] for row in good]
    assert len(read(write(POSE, rows), limits=([-3, -3, -20], [3, 3, 20]))) == 10
    assert len(read(write(POSE, rows), kinds=("revolute", "revolute", "continuous"))) == 10


@pytest.mark.parametrize(
    "names, euler, turn",
    [
        ("rx,ry,rz", "vector", lambda q: q.as_rotvec()),
        ("A,B,C", "zyx moving", lambda q: q.as_euler("ZYX")),
        ("roll,pitch,yaw", "xyz fixed", lambda q: q.as_euler("xyz")),
        (",".join(MATRIX.names), "", lambda q: q.as_matrix().reshape(-1, 9)),
    ],
)
def test_angles_follow_stated_convention(write, good, names, euler, turn):
    """Orientations in angles are those of the stated convention."""
    quaternion = np.array(good, dtype=float)[:, 6:]
    rows = [[*row[:6], *angles] for row, angles in zip(good, turn(Rotation.from_quat(quaternion)))]
    path = write(f"q1,q2,q3,x,y,z,{names}", rows)
    found = Rotation.from_quat(read(path, FileOptions(euler=euler)).quaternion)
    assert (found * Rotation.from_quat(quaternion).inv()).magnitude().max() < 1e-7
    if euler:
        with pytest.raises(MeasurementError, match="look like an orientation"):
            read(path)
    assert read(path, FileOptions(kind="position")).kind == "position"
