"""MDH tables: the product, the proposal of beta, the numbers, the complaints."""

import numpy as np
import pytest
from robot_oracle import pinocchio_poses
from scipy.spatial.transform import Rotation

from calib.errors import RobotError
from calib.robot import mdh
from calib.robot.chain import random_joints
from calib.robot.formats.urdf_write import write_new
from calib.robot.kinematics import forward, joint_frames
from calib.robot.mdh import Row
from calib.robot.tables import number
from calib.transforms import pose

HALF = np.pi / 2


def turn(axis: int, angle: float) -> np.ndarray:
    return pose(Rotation.from_euler("xyz"[axis], angle))


def shift(axis: int, length: float) -> np.ndarray:
    return pose(position=length * np.eye(3)[axis])


ROWS = [
    Row("a", 1, alpha=0.1, d=0.2, theta=0.3, r=0.4),
    Row("slide", 2, "prismatic", alpha=-1.2, d=0.1, theta=0.5, r=-0.3, beta=0.2, lower=-0.5, upper=0.5),
    Row("mount", 3, "fixed", alpha=0.7, d=0.05, theta=-0.4, r=0.06),
    Row("b", 4, alpha=1.5, d=-0.2, theta=-0.3, r=0.2, beta=0.02),
    Row("end", 5, "fixed", alpha=0.3, r=0.1),
]


def test_row_is_the_documented_product():
    chain = mdh.chain("rows", ROWS, tail=shift(2, 0.3) @ turn(0, 0.4))
    q = np.array([0.3, -0.2, 1.1])
    wanted = np.eye(4)
    amounts = iter(q)
    for row in ROWS:
        wanted = wanted @ turn(0, row.alpha) @ shift(0, row.d) @ turn(1, row.beta or 0.0)
        amount = 0.0 if row.kind == "fixed" else next(amounts)
        slide, rotate = (amount, 0.0) if row.kind == "prismatic" else (0.0, amount)
        wanted = wanted @ turn(2, row.theta + rotate) @ shift(2, row.r + slide)
    wanted = wanted @ shift(2, 0.3) @ turn(0, 0.4)
    np.testing.assert_allclose(forward(chain, q[None])[0], wanted, atol=1e-15)


def test_frames_agree_with_pinocchio():
    """Frames agree with Pinocchio and with the row."""
    chain = mdh.chain("rows", ROWS)
    q = random_joints(chain, 50)
    assert np.abs(pinocchio_poses(write_new(chain), chain, q) - forward(chain, q)).max() < 1e-12
    chain = mdh.chain("one", [Row("a", 1, alpha=0.3, d=0.2, theta=0.1, r=0.5)])
    frame = joint_frames(chain, np.array([[0.7]]))[0, 0]
    np.testing.assert_allclose(frame, turn(0, 0.3) @ shift(0, 0.2) @ turn(2, 0.8) @ shift(2, 0.5), atol=1e-15)


def test_elements_names_owners_and_order():
    chain = mdh.chain("rows", ROWS, propose_beta=False)
    assert chain.names[:4] == ("alpha1", "d1", "r1", "theta1")
    assert chain.names[4:9] == ("alpha2", "d2", "beta2", "theta2", "r2")
    owners = dict(zip(chain.names, (element.owner for element in chain.elements), strict=True))
    assert (owners["r2"], owners["alpha3"], owners["theta4"], owners["r5"]) == (1, 2, 2, 3)
    assert [chain.names[k] for k in chain.moving] == ["theta1", "r2", "theta4"]


@pytest.mark.parametrize(
    "alphas, proposed",
    [
        ((0.0, 0.0, HALF), ["beta2"]),
        ((0.0, np.pi, 0.04), ["beta2", "beta3"]),
        ((0.0, 0.06, HALF), []),
        ((0.0, -0.04, HALF), ["beta2"]),
    ],
)
def test_beta_is_proposed_near_parallel(alphas, proposed):
    """Beta is proposed for nearly parallel axes."""
    rows = [Row(f"j{k}", k + 1, alpha=alpha, d=0.3) for k, alpha in enumerate(alphas)]
    assert [name for name in mdh.chain("p", rows).names if "beta" in name] == proposed
    assert not any("beta" in name for name in mdh.chain("p", rows, propose_beta=False).names)
    fixed_between = [Row("a", 1), Row("f", 2, "fixed", alpha=HALF), Row("b", 3, alpha=-HALF)]
    assert [name for name in mdh.chain("p", fixed_between).names if "beta" in name] == ["beta3"]


def test_rows_round_trip():
    chain = mdh.chain("rows", ROWS)
    again = mdh.from_table(mdh.to_table(chain), "again")
    assert again.elements == chain.elements and again.joints == chain.joints
    assert [row.beta for row in mdh.rows(chain)] == [row.beta for row in ROWS]


def test_index_from_zero():
    table = {"name": "z", "joint": [{"index": 0, "kind": "fixed", "r": 1}, {"r": 2}]}
    assert mdh.from_table(table, "z").names == ("alpha0", "d0", "r0", "theta0", "alpha1", "d1", "r1", "theta1")


@pytest.mark.parametrize(
    "text, quantity, value",
    [
        ("-pi/2", "angle", -HALF),
        ("90 deg", "angle", HALF),
        ("-(3+1)*pi/8", "angle", -HALF),
        ("180deg", "angle", np.pi),
        ("180 deg/s", "angular speed", np.pi),
        ("-313 mm", "length", -0.313),
        ("2.5 m", "length", 2.5),
        ("1e-3", None, 1e-3),
        (3, "length", 3.0),
        ("-inf", "angle", -np.inf),
    ],
)
def test_numbers(text, quantity, value):
    assert number(text, "here", quantity) == pytest.approx(value, rel=1e-15)


NO_NUMBERS = ("__import__('os')", "2**3", "1/0", "true", True, [1], "nan", float("nan"), "(" * 300 + "1" + ")" * 300)


@pytest.mark.parametrize(
    "value, quantity", [("90 mm", "angle"), ("0.4 deg", "length"), ("", "angle"), *((one, None) for one in NO_NUMBERS)]
)
def test_what_is_no_number(value, quantity):
    with pytest.raises(RobotError, match="here: "):
        number(value, "here", quantity)


def row(**entry) -> dict:
    return {"name": "bad", "joint": [{"alpha": 0}, entry]}


@pytest.mark.parametrize(
    "table, message",
    [
        (row(aplha=1), r"number 2: there is no key 'aplha' .did you mean 'alpha'"),
        (row(a=1), r"there is no key 'a'"),
        (row(alpha="90 mm"), r"number 2, alpha: cannot read '90 mm' as a number \(here .*: rad, deg, mrad, degrees\)"),
        (row(kind="spherical"), r"kind: expected one of revolute, prismatic, fixed, found 'spherical'"),
        (row(kind="fixed", lower=1), r"a fixed row cannot have 'lower'"),
        (row(index=1.5), r"index: expected a whole number, 0 or more, found 1.5"),
        (row(index=1), r"joint name 'joint1' occurs twice"),
        (row(index=1, name="b"), r"element name 'alpha1' occurs twice"),
        (row(lower=1, upper="-1"), r"lower limit 1 is not below the upper -1"),
        (row(inertia=[1, 2]), r"inertia: expected a list of 10 values"),
        (row(inertia=[1] * 10), r"row 'joint1' has no inertia while others have"),
        (row(d="inf"), r"d: expected a number, found 'inf'"),
        ({"joint": [{}]}, r"there is no 'name'; needed are name, joint"),
        ({"name": "bad", "joint": []}, r"no \[\[joint\]\] rows found"),
        ({"name": "bad", "joint": [{"kind": "fixed"}]}, r"every row is fixed"),
        ({"name": "bad", "joint": [{}], "gravity": [0, 0]}, r"gravity: expected a list of 3 values"),
        ({"name": "bad", "joint": [{}], "tail": {"rotation": 1}}, r"tail: there is no key 'rotation'"),
        ({"name": "bad", "joint": [{}], "propose_beta": "no"}, r"propose_beta: expected true or false"),
        ({"name": "bad", "joints": [{}]}, r"there is no key 'joints' .did you mean 'joint'"),
    ],
)
def test_complaints(table, message):
    with pytest.raises(RobotError, match=message):
        mdh.from_table(table, "bad.toml")
