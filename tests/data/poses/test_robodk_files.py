"""Files that RoboDK writes, and three reflectors without a header."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calib.data.poses.fit_options import FileOptions
from calib.data.poses.pose_files import read_measurements
from calib.errors import MeasurementError

JOINTS = tuple(f"joint_{i}" for i in range(1, 7))
HEAD = ",".join(f"J{i}" for i in range(1, 7))


@pytest.fixture
def numbers():
    random = np.random.default_rng(2)
    return random.uniform(-100, 100, (8, 6)), random.uniform(-1500, 1500, (8, 3)), random.uniform(-170, 170, (8, 3))


def read(path, options=None):
    (block,) = read_measurements(path, JOINTS, options)
    return block


@pytest.mark.parametrize("head", [HEAD, HEAD.replace("J", "Joint "), ",".join(f"J{i} (deg)" for i in range(1, 7))])
def test_points_with_two_tools(write, numbers, head):
    q, xyz, _ = numbers
    tcp = np.tile([[10.0, 0, 80], [0, 20, 80]], (4, 1))
    block = read(write(f"{head},X,Y,Z,X,Y,Z", np.hstack([q, xyz, tcp]).tolist()))
    np.testing.assert_allclose(block.q, np.deg2rad(q))
    np.testing.assert_allclose(block.position, xyz / 1e3)
    assert block.kind == "position" and block.tool_names == ("tool 1", "tool 2")
    assert block.tool is not None and block.tool.tolist() == [0, 1] * 4
    assert any("2 different TCPs" in note and "10, 0, 80" in note for note in block.notes)
    assert block.ignored == ("TCP x", "TCP y", "TCP z")


@pytest.mark.parametrize("euler", ["wpr", "xyz", "vector"])
def test_poses_in_each_convention(write, numbers, euler):
    q, xyz, wpr = numbers
    tcp = np.zeros((8, 6))
    path = write(f"{HEAD},X,Y,Z,W,P,R,TX,TY,TZ,TW,TP,TR", np.hstack([q, xyz, wpr, tcp]).tolist())
    block = read(path, FileOptions(euler=euler))
    w, p, r = (Rotation.from_rotvec(np.outer(wpr[:, i], np.eye(3)[i]), degrees=True) for i in range(3))
    expected = {"wpr": r * p * w, "xyz": w * p * r, "vector": Rotation.from_rotvec(wpr, degrees=True)}[euler]
    assert (Rotation.from_quat(block.quaternion) * expected.inv()).magnitude().max() < 1e-12
    assert block.kind == "pose" and any("w p r are taken as" in note for note in block.notes)


def test_twelve_columns_are_points_or_poses(write, numbers):
    """Twelve columns are points or poses by the tenth name."""
    rows = np.hstack(numbers).tolist()
    assert read(write(f"{HEAD},X,Y,Z,Rx,Ry,Rz", rows)).kind == "pose"
    assert read(write(f"{HEAD},X,Y,Z,TCPx,TCPy,TCPz", rows)).kind == "position"


def test_possible_radians_are_asked_for(write, numbers):
    """Angles that may be radians are asked for."""
    q, xyz, wpr = numbers
    path = write(f"{HEAD},X,Y,Z,W,P,R", np.hstack([q, xyz, np.deg2rad(wpr)]).tolist())
    with pytest.raises(MeasurementError, match=r"all angles are within.*units.orientation") as error:
        read(path)
    assert (error.value.row, error.value.column) == (1, "w")
    expected = Rotation.from_euler("xyz", wpr, degrees=True)
    block = read(path, FileOptions(units={"orientation": "rad"}))
    assert (Rotation.from_quat(block.quaternion) * expected.inv()).magnitude().max() < 1e-12


def test_robodk_files_that_are_none(write, numbers):
    rows = np.hstack(numbers).tolist()
    with pytest.raises(MeasurementError, match="6 joints, the robot has 7"):
        read_measurements(write(f"{HEAD},X,Y,Z,W,P,R", rows), [*JOINTS, "joint_7"])
    with pytest.raises(MeasurementError, match="has 8 columns"):
        read(write(f"{HEAD},X,Y", [row[:8] for row in rows]))
    with pytest.raises(MeasurementError, match="not J1 to J6"):
        read(write("a,b,c,d,e,f,X,Y,Z", [row[:9] for row in rows]), FileOptions(format="robodk"))
    rows[2][4] = "x"
    with pytest.raises(MeasurementError) as error:
        read(write(f"{HEAD},X,Y,Z,W,P,R", rows))
    assert (error.value.row, error.value.column) == (3, "J5")


@pytest.mark.parametrize(("padding", "separator"), [(3, ","), (6, " "), (4, ";")])
def test_three_reflectors_without_a_header(tmp_path, numbers, padding, separator):
    q, xyz, _ = numbers
    points = np.hstack([xyz, xyz + 100, xyz + 200])
    points[5, 3:6] = 0
    path = tmp_path / "N1N2N3.csv"
    np.savetxt(path, np.hstack([points, np.zeros((8, padding)), q]), delimiter=separator)
    block = read(path, FileOptions(format="three_smr"))
    assert block.kind == "position" and len(block) == 23 and block.tool_names == ("tool 1", "tool 2", "tool 3")
    np.testing.assert_allclose(block.q[:3], np.deg2rad(q[[0, 0, 0]]))
    np.testing.assert_allclose(block.position[:3], points[0].reshape(3, 3) / 1e3)
    assert any("not seen in 1 of 8" in note for note in block.notes)
    with pytest.raises(MeasurementError, match=r"has no header.*format"):
        read(path)


def test_three_reflectors_lacking_columns(tmp_path, numbers):
    """Three reflectors with too few columns."""
    path = tmp_path / "short.csv"
    np.savetxt(path, np.hstack(numbers), delimiter=",")
    with pytest.raises(MeasurementError, match="has 12 columns; three reflectors and 6 joints need 15"):
        read(path, FileOptions(format="three_smr"))
