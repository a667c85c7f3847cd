"""robot.toml: exact round trips, the library against what is known elsewhere, and how robots are found."""

import dataclasses

import numpy as np
import pytest
from robot_oracle import axis, inertial, joint, robot

from calib.dynamics.pseudo_inertia import from_standard
from calib.errors import RobotError
from calib.robot import description, library, mdh
from calib.robot.chain import Chain, random_joints
from calib.robot.formats import urdf
from calib.robot.kinematics import forward
from calib.robot.library import load
from calib.robot.tables import dumps

ODD = robot(
    joint("a", "continuous", "base", "one", axis("1 2 -3"), "0.1 0.2 0.3", "0.3 -1.2 2"),
    joint("b", "prismatic", "one", "two", axis("0 -1 0"), "0.1 0 0", "0 1.5707963267948966 0"),
    joint("c", "revolute", "two", "three", axis("0 0 1") + '<mimic joint="a" multiplier="-0.5" offset="0.2"/>'),
    joint("d", "fixed", "three", "tip", "", "0.1 0.2 0.3", "0.4 0.5 0.6"),
    bodies={"one": inertial(1.0, "0.1 0.2 0.3"), "two": inertial(2.0, "0.1 0.2 0.3")},
)


def same(one: Chain, two: Chain) -> bool:
    """Tell whether two chains are equal to the last bit."""
    simple = all(getattr(one, key) == getattr(two, key) for key in ("name", "joints", "base", "tip", "links"))
    pairs = [(one.tail, two.tail), (one.gravity, two.gravity), (one.inertias, two.inertias)]
    for left, right in zip(one.elements, two.elements, strict=True):
        pairs.append((left.placement, right.placement))
        simple = simple and dataclasses.replace(left, placement=None) == dataclasses.replace(right, placement=None)
    return simple and all((a is None) == (b is None) and (a is None or np.array_equal(a, b)) for a, b in pairs)


def disturbed(chain: Chain) -> Chain:
    step = np.random.default_rng(0).normal(0, 1e-3, len(chain.values))
    return dataclasses.replace(chain.with_values(chain.values + step), gravity=np.array([0.1, -0.2, -9.8]))


@pytest.mark.parametrize("name", library.names())
def test_calibrated_tables_round_trip(name, tmp_path):
    """Calibrated tables round trip as tables."""
    chain = disturbed(load(name))
    path = description.write(tmp_path / "robot.toml", chain)
    assert same(description.read(path), chain) and same(load(tmp_path), chain)
    assert "[[joint]]" in path.read_text() and "[[element]]" not in path.read_text()


def test_any_chain_round_trips(tmp_path):
    chain = disturbed(urdf.parse(ODD))
    path = description.write(tmp_path / "robot.toml", chain, source="a test")
    assert same(description.read(path), chain)
    assert "[[element]]" in path.read_text()


def test_table_without_beta_stays_so(tmp_path):
    """A table without proposed beta stays so."""
    chain = description.read(library.path("ur10"), propose_beta=False)
    path = description.write(tmp_path / "robot.toml", chain)
    assert description.read(path).names == chain.names
    assert "beta3" in description.read(library.path("ur10")).names


def test_extra_tables_are_kept(tmp_path):
    extra = {
        "station": {"xyz": np.array([1.0, 2.0, 1 / 3]), "unused": None, "fixed": True},
        "tool": {"name": "ball", "points": [[0.0, 0.1, 0.2], (0.3, 0.4, 0.5)]},
        "deflection": [{"joint": "a", "stiffness": np.float64(1e4)}, {"joint": "b", "stiffness": 2e4}],
    }
    path = description.write(tmp_path / "robot.toml", urdf.parse(ODD), extra)
    assert description.read_extra(path) == {
        "station": {"xyz": [1.0, 2.0, 1 / 3], "fixed": True},
        "tool": {"name": "ball", "points": [[0.0, 0.1, 0.2], [0.3, 0.4, 0.5]]},
        "deflection": [{"joint": "a", "stiffness": 1e4}, {"joint": "b", "stiffness": 2e4}],
    }
    assert same(description.read(path), urdf.parse(ODD))
    with pytest.raises(RobotError, match=r"extra tables: there is no key 'stations' .did you mean 'station'"):
        description.write(tmp_path / "robot.toml", urdf.parse(ODD), {"stations": {}})


ELEMENT = {"name": "a.offset", "axis": "rz", "joint": 0}


@pytest.mark.parametrize(
    "element, message",
    [
        ({"axes": "rz"}, r"number 1 \('a.offset'\): there is no key 'axes' .did you mean 'axis'"),
        ({"axis": "rw"}, r"axis: expected one of tx, ty, tz, rx, ry, rz, found 'rw'"),
        ({"joint": 1}, r"joint 1 is not an integer from 0 to 0"),
        ({"owner": -1}, r"\('a.offset'\), owner: expected a whole number, 0 or more, found -1"),
        ({"sign": 0.5}, r"sign 0.5 is neither 1 nor -1"),
        ({"value": "1 mm"}, r"value: cannot read '1 mm'"),
        ({"placement": {"matrix": [[1, 0, 0, 0], [0, 2, 0, 0], [0, 0, 1, 0]]}}, r"is not a rotation"),
        ({"placement": {"matrix": [[1, 0, 0, 0]]}}, r"matrix needs three or four rows"),
        ({"placement": [1, 2, 3]}, r"placement: expected xyz and rpy, or matrix"),
    ],
)
def test_complaints_about_elements(element, message, tmp_path):
    complains(tmp_path, dumps({"name": "x", "joint": [{"name": "a"}], "element": [{**ELEMENT, **element}]}), message)


def complains(folder, text, message):
    (folder / "robot.toml").write_text(text)
    with pytest.raises(RobotError, match=message):
        description.read(folder / "robot.toml")


A, E = '[[joint]]\nname="a"\n', '[[element]]\nname="e"\naxis="rz"\n'


@pytest.mark.parametrize(
    "text, message",
    [
        (f"{A}{E}joint=0", r"there is no 'name'; needed are name, joint"),
        (f'name="x"\nbase=5\n{A}{E}joint=0', r"base: expected a text, found 5"),
        (f'name="x"\n{E}joint=0', r"there is no 'joint'; needed are name, joint, element"),
        (f'name="x"\n{A}{E}', r"every joint must move"),
        (f'name="x"\n{A}kinds=1\n{E}', r"there is no key 'kinds' .did you mean 'kind'"),
        ('name = "x"\n[[joint]\n', r"robot\.toml: is not a TOML file: .*line 2"),
    ],
)
def test_complaints_about_the_whole(tmp_path, text, message):
    complains(tmp_path, text, message)


def test_library_holds_what_it_says():
    assert library.names() == ("iiwa14", "lwr4plus", "panda", "rv2sq", "tx40", "ur10", "ur10e", "ur5")
    for name in library.names():
        chain = load(name)
        assert np.isfinite(chain.lower).all() and np.isfinite([joint.velocity for joint in chain.joints]).all()
        assert np.isfinite([joint.effort for joint in chain.joints]).all()
        assert "source" in library.path(name).read_text()


def test_library_lengths():
    """Reach at q = 0 and the flange's height, by hand from the data sheets."""
    tip = {name: forward(load(name), np.zeros((1, load(name).n)))[0, :3, 3] for name in library.names()}
    np.testing.assert_allclose(tip["iiwa14"], [0, 0, 0.36 + 0.42 + 0.4 + 0.126], atol=1e-12)
    np.testing.assert_allclose(tip["lwr4plus"], [0, 0, 0.4 + 0.39 + 0.078], atol=1e-12)
    np.testing.assert_allclose(tip["panda"], [0.088, 0, 0.333 + 0.316 + 0.384 - 0.107], atol=1e-12)
    np.testing.assert_allclose(tip["tx40"], [0, 0.035, 0.32 + 0.225 + 0.225], atol=1e-12)
    np.testing.assert_allclose(tip["rv2sq"], [-0.05, 0, 0.295 + 0.23 + 0.27 + 0.07], atol=1e-12)
    np.testing.assert_allclose(tip["ur5"], [-0.425 - 0.39225, -0.10915 - 0.0823, 0.089159 - 0.09465], atol=1e-12)


@pytest.mark.parametrize(
    "name, file, base, tip, turn, tolerance",
    [
        ("ur5", "ur5_gts3800/model.urdf", None, None, 0.0, 1e-9),
        ("ur10", "ur10_ipa/model.urdf", None, None, 0.0, 1e-9),
        ("panda", "franka_panda_inria/model.urdf", None, None, 0.0, 1e-9),
        ("ur10e", "ur10e_innopolis/model.urdf", "base_link", "tool0", np.pi, 2e-3),
        ("iiwa14", "mukca_sockets/iiwa14.urdf", "base_link", "tool0", 0.0, 2e-3),
    ],
)
def test_library_against_urdfs_of_others(name, file, base, tip, turn, tolerance, data):
    """Up to a constant flange; the UR's base_link is turned by pi, its figures and the iiwa's are rounded."""
    mine, theirs = load(name), load(data / file, base, tip)
    q = random_joints(mine, 20)
    spin = np.diag([np.cos(turn), np.cos(turn), 1, 1])
    flange = np.linalg.inv(spin @ forward(mine, q)) @ forward(theirs, q)
    assert np.ptp(flange, axis=0).max() < 2 * tolerance


def test_lwr_bodies_are_possible():
    chain = load("lwr4plus")
    assert chain.inertias is not None
    assert chain.inertias[:, 9].sum() == pytest.approx(14.4, abs=1e-4)
    assert min(np.linalg.eigvalsh(from_standard(body)).min() for body in chain.inertias) > 1e-5


def test_lwr_truth_is_near_its_nominal():
    truth = description.read_extra(library.path("lwr4plus_truth"))["truth"]
    geometry = truth["geometry"]
    nominal, calibrated = np.array(geometry["nominal"]), np.array(geometry["calibrated"])
    assert nominal.shape == calibrated.shape == (9, 4)
    assert np.abs(calibrated - nominal)[2:].max() < 0.011
    np.testing.assert_allclose(nominal[2:8, [0, 3]].ravel(), [
        value for row in mdh.rows(load("lwr4plus"))[1:] for value in (row.alpha, row.r)
    ], atol=1e-15)  # fmt: skip
    drives = truth["drives"]
    np.testing.assert_allclose(np.add(drives["Fcl"], drives["Fcm"]), drives["Fc"], atol=1e-12)
    np.testing.assert_allclose(np.add(drives["Fvl"], drives["Fvm"]), drives["Fv"], atol=1e-12)


@pytest.mark.parametrize("name", ["lwr4plus", "tx40", "rv2sq", "ur10", "panda", "iiwa14"])
def test_gravity_points_down_the_first_axis(name):
    """The height of the tip does not depend on q1: the first axis is vertical."""
    q = random_joints(load(name), 2, 2)
    q[1, 1:] = q[0, 1:]
    assert abs(np.diff(forward(load(name), q)[:, 2, 3])) < 1e-9


def test_loading(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "arm.urdf").write_text(ODD)
    assert load("arm.urdf").tip == "tip" and load("arm.urdf", tip="two").tip == "two"
    description.write("cell/robot.toml", load("ur5"))
    assert load("cell").name == load("cell/robot.toml").name == "ur5"
    (tmp_path / "panda").mkdir()
    assert load("panda").name == "panda"


@pytest.mark.parametrize(
    "robot, message",
    [
        ("ur5x", r"no robot 'ur5x' \(did you mean 'ur5'\?\); give a path .* iiwa14, lwr4plus"),
        ("absent.urdf", r"no file absent\.urdf; give a path of a \.urdf"),
        ("empty", "empty contains no result; give a URDF, .*; the library has"),
        ("arm.urdf.xacro", r"arm\.urdf\.xacro: xacro: syntax error"),
        ("arm.step", r"arm\.step is no robot file; give"),
    ],
)
def test_what_is_no_robot(robot, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    for name in ("arm.urdf.xacro", "arm.step"):
        (tmp_path / name).write_text("x")
    with pytest.raises(RobotError, match=message):
        load(robot)


def test_table_has_fixed_base_and_tip():
    """Base and tip of a table cannot be chosen."""
    assert load("ur5", "base", "tool0").name == "ur5"
    with pytest.raises(RobotError, match="its tip is 'tool0', not 'flange'; only a URDF allows to choose"):
        load("ur5", tip="flange")
