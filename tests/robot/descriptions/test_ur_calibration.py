"""A UR's calibration.conf is the arm of its Denavit-Hartenberg table, and not taken for another type's."""

import numpy as np
import pytest

from calib.errors import RobotError
from calib.robot.chain import random_joints
from calib.robot.formats import urdf
from calib.robot.kinematics import forward
from calib.robot.library import load

# of a UR10e: UR's ROS 2 driver, ur_calibration/doc/algorithm.rst
THETA = [-2.4147806894359e-07, 1.60233952386695, -1.68607190752171, 0.0837331147700119, -1.01260355871158e-07,
         3.91986209186124e-08]  # fmt: skip
A = [2.12234865571206e-05, 0.0193171326277006, -0.569251663611088, -4.61409023720934e-05, -6.39280053471802e-05, 0.0]
D = [0.180539811714259, 439.140974079901, -446.027059806332, 7.0603368964236, 0.119811341150314, 0.115670917257426]
ALPHA = [1.57014608044242, 0.0013941666682559, 0.00693818880325995, 1.56998468543761, -1.57038520649543, 0.0]
NOMINAL = np.array([
    [0, 0, 0, 0, 0, 0], [0, -0.6127, -0.57155, 0, 0, 0], [0.1807, 0, 0, 0.17415, 0.11985, 0.11655],
    [np.pi / 2, 0, 0, np.pi / 2, -np.pi / 2, 0],
])  # fmt: skip
TABLE = np.array([THETA, A, D, ALPHA])


def written(table):
    """Return a calibration.conf with the deltas of a table (4, 6), laid out as in forum t/18921."""
    rows = zip(("theta", "a", "d", "alpha"), table - NOMINAL)
    lines = [f"delta_{key} = [ {', '.join(map(repr, map(float, row)))}]" for key, row in rows]
    return "\n".join(
        ["[mounting]", *lines, "joint_checksum = [ 0x6e0f7bf, 0xa32a713f]", "calibration_status = 2 # 2", ""]
    )


def by_table(table, q):
    """Return the flange's poses (m, 4, 4), row by row of the table."""
    result = np.broadcast_to(np.eye(4), (len(q), 4, 4))
    for angle, (theta, a, d, alpha) in zip(q.T, table.T):
        c, s, ca, sa, o = np.cos(angle + theta), np.sin(angle + theta), np.cos(alpha), np.sin(alpha), 0 * angle
        rows = [[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [o, o + sa, o + ca, o + d], [o, o, o, o + 1]]
        result = result @ np.moveaxis(np.array(rows), 2, 0)
    return result


def test_poses_are_of_table_and_near_nominal(tmp_path):
    """A calibration's poses are those of its table and near the nominal arm's."""
    (tmp_path / "calibration.conf").write_text(written(TABLE))
    arm, nominal = urdf.read(f"{tmp_path}/calibration.conf ur_type:=ur10e"), load("ur10e")
    assert (arm.base, arm.tip, arm.joint_names) == ("base", "tool0", nominal.joint_names)
    q = random_joints(nominal, 50, 0)
    assert np.abs(forward(arm, q) - by_table(TABLE, q)).max() < 1e-12
    away = np.linalg.norm((forward(arm, q) - forward(nominal, q))[:, :3, 3], axis=1)
    assert 1e-4 < away.max() < 5e-3  # though its table has d of 446 m
    (tmp_path / "calibration.conf").write_text(written(NOMINAL))
    same = urdf.read(f"{tmp_path}/calibration.conf ur_type:=ur10e")
    assert np.abs(forward(same, q) - forward(nominal, q)).max() < 1e-12


@pytest.mark.parametrize(
    ("arguments", "content", "says"),
    [
        ("", written(TABLE), r"state the type of the arm.*one of ur3"),
        (" ur_type:=ur5e", written(TABLE), r"axes of a ur5e would be \d+ mm from nominal: is ur_type another"),
        (" ur_type:=ur10x", written(TABLE), r"ur_type 'ur10x' is not one of .*did you mean 'ur10'"),
        (" ur_type:=ur10e", "[mounting]\n", r"is no calibration\.conf of a UR: expected delta_theta .*found 0"),
        (" ur_type:=ur10e", written(TABLE).replace("delta_d = [", "delta_d = [ nan,"), r"delta_d .*found 7"),
        (" ur_type:=ur10e", written(TABLE).replace("delta_a = [ 2", "delta_a = [ x2"), r"delta_a: .*x2"),
    ],
)  # fmt: skip
def test_other_types_are_refused(tmp_path, arguments, content, says):
    """What is none, or of another type, is refused."""
    (tmp_path / "calibration.conf").write_text(content)
    with pytest.raises(RobotError, match=rf"calibration\.conf: .*{says}"):
        urdf.read(f"{tmp_path}/calibration.conf{arguments}")
