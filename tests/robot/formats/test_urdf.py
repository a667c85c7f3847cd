"""URDF reading: trees of every kind against Pinocchio, the choice of base and tip, and the complaints."""

import numpy as np
import pytest
from recordings import DATA
from robot_oracle import axis, inertial, joint, pinocchio_inertias, pinocchio_poses, robot

from calib.errors import RobotError
from calib.robot.chain import random_joints
from calib.robot.formats import urdf
from calib.robot.kinematics import forward

Z, MIMIC = axis("0 0 1"), '<mimic joint="a" multiplier="-0.7" offset="0.2"/>'


def agrees(source: str, base: str | None = None, tip: str | None = None) -> urdf.Chain:
    chain = urdf.parse(source, "synthetic", base, tip)
    q = random_joints(chain, 20)
    assert np.abs(pinocchio_poses(source, chain, q) - forward(chain, q)).max() < 1e-12
    return chain


@pytest.mark.parametrize("kind", ["revolute", "prismatic", "continuous"])
@pytest.mark.parametrize(
    "direction",
    ["1 0 0", "0 1 0", "0 0 1", "-1 0 0", "0 -1 0", "0 0 -1", "1 2 3", "-0.6 0 0.8", "1e-9 0 1", "0 0 7", "-0 -2 0"],
)
def test_every_axis(kind, direction):
    source = robot(
        joint("a", kind, "base", "one", axis(direction), "0.1 -0.2 0.3", "0.3 -0.4 2"),
        joint("b", "revolute", "one", "two", axis("0 1 0"), "0.3 0.2 0.1", "1 1.5707963267948966 0.2"),
        joint("c", "fixed", "two", "tip", "", "0.1 0.2 0.3", "0.4 0.5 0.6"),
    )
    chain = agrees(source)
    assert (chain.base, chain.tip, chain.links) == ("base", "tip", ("one", "two"))
    assert chain.names[:6] == (*(name for name in chain.names[:5]), "a.offset")
    assert (chain.joints[0].lower == -np.inf) == (kind == "continuous")
    assert chain.joints[0].velocity == 2.0 and chain.joints[0].effort == 9.0


def test_elements_of_a_joint():
    chain = agrees(robot(joint("a", "revolute", "base", "one", axis("0 -1 0"), "0.1 0 0")))
    assert chain.names == ("a.x", "a.y", "a.z", "a.rx", "a.rz", "a.offset")
    moving = chain.elements[-1]
    assert (moving.axis, moving.sign, moving.joint) == ("ry", -1.0, 0)
    chain = agrees(robot(joint("a", "prismatic", "base", "one", axis("1 0 0"))))
    assert chain.names == ("a.y", "a.z", "a.rx", "a.ry", "a.rz", "a.offset")
    assert chain.elements[-1].axis == "tx" and chain.elements[0].placement is None


def test_fixed_joints_are_folded_in():
    source = robot(
        joint("f", "fixed", "world", "base", "", "1 2 3", "0.1 0.2 0.3"),
        joint("a", "revolute", "base", "one", Z, "0 0 0.1"),
        joint("g", "fixed", "one", "two", "", "0.1 0.2 0.3", "0.4 0.5 0.6"),
        joint("h", "fixed", "two", "three", "", "0.3 0.2 0.1", "0.6 0.5 0.4"),
        joint("b", "revolute", "three", "four", axis("1 0 0")),
    )
    chain = agrees(source)
    assert (chain.base, chain.tip, chain.n, len(chain.elements)) == ("world", "four", 2, 12)
    agrees(source, "base", "two")


def test_mimic_on_the_path():
    source = robot(
        joint("a", "revolute", "base", "one", axis("0 0 -1"), "0 0 0.1"),
        joint("b", "revolute", "one", "two", axis("0 1 0") + MIMIC, "0.3 0 0"),
        joint("c", "revolute", "two", "three", axis("1 0 0"), "0.2 0 0"),
    )
    chain = urdf.parse(source, "synthetic")
    assert chain.joint_names == ("a", "c") and len(chain.elements) == 18
    follower = chain.elements[11]
    assert (follower.name, follower.joint, follower.ratio, follower.value) == ("b.offset", 0, -0.7, 0.2)
    assert [chain.names[k] for k in chain.moving] == ["a.offset", "c.offset"]
    agrees(source)
    again = joint("d", "revolute", "three", "four", Z + '<mimic joint="b" multiplier="3" offset="0.2"/>')
    element = urdf.parse(source.replace("</robot>", '<link name="four"/>' + again + "</robot>")).elements[-1]
    assert (element.joint, element.ratio, element.value) == (0, pytest.approx(-2.1), pytest.approx(0.8))


def gripper(*arm: str, leader: str = "finger1") -> str:
    follow = f'<mimic joint="{leader}"/>'
    return robot(
        *arm,
        joint("a", "revolute", "base", "one", Z),
        joint("mount", "fixed", "one", "hand", "", "0 0 0.1"),
        joint("finger1", "prismatic", "hand", "left", axis("0 1 0")),
        joint("finger2", "prismatic", "hand", "right", axis("0 -1 0") + follow),
    )


def test_default_tip_stops_before_a_gripper():
    chain = urdf.parse(gripper())
    assert (chain.joint_names, chain.tip) == (("a",), "one")  # the hand holds the fingers: it is the gripper's
    assert urdf.parse(gripper(), tip="left").joint_names == ("a", "finger1")
    with pytest.raises(RobotError, match=r"joint 'finger2': the joint it mimics, 'finger1', is not between"):
        urdf.parse(gripper(), tip="right")


@pytest.mark.parametrize(
    "more, joints, tip",
    [
        ([joint("rod", "revolute", "base", "rods", Z + '<mimic joint="a"/>'), joint("b", "revolute", "one", "two", Z)],
         ("a", "b"), "two"),
        ([joint("f", "fixed", "one", "flange"), joint("g", "fixed", "one", "camera")], ("a",), "flange"),
    ],
)  # fmt: skip
def test_default_tip_beside_a_linkage(more, joints, tip):
    """The default tip beside a driven linkage, or with several leaves."""
    chain = urdf.parse(robot(joint("a", "revolute", "base", "one", Z), *more))
    assert (chain.joint_names, chain.tip) == (joints, tip)


TWO_ARMS = robot(
    joint("torso", "prismatic", "base", "chest", Z),
    joint("l1", "revolute", "chest", "left1", Z, "0 1 0"),
    joint("l2", "revolute", "left1", "left2", Z, "1 0 0"),
    joint("r1", "revolute", "chest", "right1", Z, "0 -1 0"),
    joint("r2", "revolute", "right1", "right2", Z, "1 0 0"),
)


def test_joint_names_choose_the_chain():
    chain = urdf.parse(TWO_ARMS, joint_names=["r1", "torso", "r2"])
    assert (chain.tip, chain.joint_names) == ("right2", ("torso", "r1", "r2"))
    assert urdf.parse(TWO_ARMS, joint_names=["l1", "torso"]).tip == "left1"
    assert urdf.parse(TWO_ARMS, base="chest", joint_names=["l1", "l2"]).joint_names == ("l1", "l2")


@pytest.mark.parametrize(
    "options, message",
    [
        ({}, r"two arms: choose one by its last link, --tip left2 or right2$"),
        ({"joint_names": ["l1", "l2"]}, r"some joints are not in the measurements: torso; choose base and tip"),
        ({"joint_names": ["torso", "l1", "r1"]}, r"two arms: .*--tip left1 or right1; the table has"),
        ({"joint_names": ["torso", "l11"]}, r"no joint 'l11' \(did you mean 'l[12]'\?\) \(joints: torso, l1, l2, r1"),
        ({"tip": "left_2"}, r"no link 'left_2' for the tip .did you mean 'left2'"),
        ({"base": "bass", "tip": "left2"}, r"no link 'bass' for the base .did you mean 'base'"),
        ({"base": "left1", "tip": "right2"}, r"link 'right2' does not follow 'left1'"),
        ({"base": "left2", "tip": "left2"}, r"no actuated joint between 'left2' and 'left2'"),
        ({"base": "left2"}, r"no actuated joint follows 'left2'"),
    ],
)
def test_wrong_choices(options, message):
    with pytest.raises(RobotError, match=message):
        urdf.parse(TWO_ARMS, "two.urdf", **options)


def three(*joints: str) -> str:
    return "".join(['<robot name="x"><link name="a"/><link name="b"/><link name="c"/>\n', *joints, "</robot>"])


def arm_with(limit: str) -> str:
    return three(joint("j", "revolute", "a", "b", limit), joint("k", "fixed", "b", "c"))


@pytest.mark.parametrize(
    "source, message",
    [
        ("<robot><link name='a'></robot>", r"bad, line 1, column 25: not XML \(mismatched tag\)"),
        ("", r"not XML \(no element found\)"),
        ("<sdf/>", r"the root element is <sdf>, a URDF has <robot>"),
        (three(), r"several roots: a, b, c; choose one as base"),
        ("<robot name='x'/>", r"no <link> found"),
        ("<robot name='x'><link name='a'/></robot>", r"no actuated joint \(revolute, continuous or prismatic\) found"),
        ("<robot name='x'><link name='a'/><link name='a'/></robot>", r"line 1: a second link named 'a'"),
        ("<robot name='x'><link/></robot>", r"line 1: a <link> without a name"),
        ("<robot name='x'><link name='a'/><joint type='fixed'/></robot>", r"line 1: a <joint> without a name"),
        (three(joint("j", "revolut", "a", "b")), r"line 2, joint 'j': type 'revolut' is not one of .*'revolute'"),
        (three(joint("j", "revolute", "a", "bb")), r"its child 'bb' is not a link of this file"),
        (three('<joint name="j" type="fixed"><child link="b"/></joint>'), r"joint 'j': no <parent link"),
        (three(joint("j", "fixed", "a", "b") * 2), r"line 3: a second joint named 'j'"),
        (
            three(joint("j", "fixed", "a", "c"), joint("k", "fixed", "b", "c")),
            r"line 3: link 'c' has two parents, .*'k'",
        ),
        (three(joint("j", "fixed", "b", "c"), joint("k", "fixed", "c", "b")), r"links b, c form a loop"),
        (three(joint("j", "revolute", "a", "b", axis("0 0 0"))), r"joint 'j': its axis is zero"),
        (three(joint("j", "revolute", "a", "b", axis("0 0 nan"))), r'xyz="0 0 nan" of <axis> in line 2 is not 3'),
        (three(joint("j", "fixed", "a", "b", xyz="0 0")), r'xyz="0 0" of <origin> .* 3 finite numbers'),
        (three(joint("j", "fixed", "a", "b", rpy="0 x 0")), r'rpy="0 x 0" of <origin>'),
        (three(joint("j", "fixed", "a", "b", xyz="0 0 ${h}")), r"this is a xacro file; rename it"),
        ("<robot xmlns:xacro='x'><xacro:include filename='f'/></robot>", r"found <xacro:include>: this is a xacro"),
        (arm_with('<limit lower="1" upper="1"/>'), r"'j': lower limit 1 is not below"),
        (arm_with('<limit lower="one" upper="1"/>'), r'lower="one" of <limit> in line'),
    ],
)
def test_bad_files(source, message):
    with pytest.raises(RobotError, match=message):
        urdf.parse(source, "bad")


@pytest.mark.parametrize(
    "one, two, three, message",
    [
        (("revolute", "b"), ("revolute", ""), ("fixed", ""), r"joint 'a': the joint it mimics, 'b', comes after it"),
        (("revolute", "b"), ("revolute", "a"), ("revolute", ""), r"joint 'a': its <mimic> leads back to itself"),
        (("revolute", ""), ("revolute", "aa"), ("revolute", ""), r"joint 'b': it mimics 'aa', which is not a joint"),
        (("revolute", ""), ("floating", ""), ("revolute", ""), r"joint 'b': type 'floating' cannot be part of an arm"),
    ],
)
def test_bad_arms(one, two, three, message):
    ends = (("base", "one"), ("one", "two"), ("two", "three"))
    joints = [
        joint(name, kind, *own, Z + f'<mimic joint="{leader}"/>' * bool(leader))
        for name, (kind, leader), own in zip("abc", (one, two, three), ends)
    ]
    with pytest.raises(RobotError, match=message):
        urdf.parse(robot(*joints))


def test_missing_limits_are_infinite():
    """Missing and placeholder limits are infinite."""
    source = robot(
        joint("a", "revolute", "base", "one", Z + '<limit velocity="0" effort="0"/>'),
        joint("b", "revolute", "one", "two", Z + '<limit lower="-1" velocity="1e9" effort="3"/>'),
    )
    a, b = urdf.parse(source).joints
    assert (a.lower, a.upper, a.velocity, a.effort) == (-np.inf, np.inf, np.inf, np.inf)
    assert (b.lower, b.upper, b.velocity, b.effort) == (-1.0, 0.0, np.inf, 3.0)
    assert (a.unstated, b.unstated) == (("velocity 0", "effort 0"), ())


def test_angles_beyond_a_turn_are_told():
    """Angles beyond a full turn are told, and several of them refused."""
    one, two = (joint(name, "revolute", *ends, Z, "0 0 0.1", "90 0 0") for name, *ends in ("abc", "dcd"))
    assert "joint 'd' (line 5): rpy=\"90 0 0\" is beyond" in urdf.parse(robot(two)).remarks[0]
    with pytest.raises(RobotError, match=r"joint 'a' .*joint 'd' .*degrees"):
        urdf.parse(robot(one, two))


BODIES = ("base", "one", "box", "lid", "tip")


def test_inertias_with_fixed_bodies():
    """Inertias with fixed bodies on and off the path."""
    source = robot(
        joint("a", "revolute", "base", "one", Z, "0 0 0.1", "0.1 0.2 0.3"),
        joint("f", "fixed", "one", "box", "", "0.1 0.2 0.3", "0.4 0.5 0.6"),
        joint("g", "fixed", "box", "lid", "", "0 0 0.1", "1 0 0"),
        joint("b", "revolute", "one", "two", axis("0 1 0"), "0.3 0 0", "0 0.5 0"),
        joint("h", "fixed", "two", "tip", "", "0 0 0.2"),
        bodies={name: inertial(mass, "0.01 0.02 0.03") for mass, name in enumerate(BODIES, 1)},
    )
    chain = agrees(source)
    assert chain.inertias is not None
    np.testing.assert_allclose(chain.inertias, pinocchio_inertias(source, chain), atol=1e-14)
    np.testing.assert_allclose(urdf.parse(source, tip="one").inertias[0, 9], 2 + 3 + 4)


def test_inertia_about_a_turned_frame():
    """Inertia about the turned frame of a general axis."""
    turned = robot(
        joint("a", "revolute", "base", "one", axis("1 2 -2"), "0 0 0.1"), bodies={"one": inertial(2.0, "0.3 0.1 -0.2")}
    )
    chain = urdf.parse(turned)
    about = urdf.transform_body(chain.inertias[0], np.linalg.inv(chain.tail))
    np.testing.assert_allclose(about, pinocchio_inertias(turned, chain)[0], atol=1e-14)
    np.testing.assert_allclose(np.linalg.inv(chain.tail)[:3, 2], np.array([1, 2, -2]) / 3, atol=1e-15)


def test_no_masses_no_inertias():
    assert urdf.parse(TWO_ARMS, tip="left2").inertias is None
    zero = robot(joint("a", "revolute", "base", "one", Z), bodies={"base": inertial(1, "0 0 0")})
    assert urdf.parse(zero).inertias is None


def test_file_encodings_and_byte_order_marks(tmp_path):
    source = robot(joint("gelénk", "revolute", "base", "one", Z, "0 0 0.1"))
    latin = source.replace('version="1.0"', 'version="1.0" encoding="ISO-8859-1"').encode("latin-1")
    for name, data in (("a", source.encode()), ("b", latin), ("c", b"\xef\xbb\xbf" + source.encode())):
        (tmp_path / f"{name}.urdf").write_bytes(data)
        assert urdf.read(tmp_path / f"{name}.urdf").joint_names == ("gelénk",)
    with pytest.raises(RobotError, match=r"cannot read .*absent\.urdf: No such file"):
        urdf.read(tmp_path / "absent.urdf")
    (tmp_path / "d.urdf").write_bytes(source.encode("latin-1"))
    assert urdf.read(tmp_path / "d.urdf").joint_names == ("gelénk",)
    (tmp_path / "e.urdf").write_bytes(b"\r\n  \n" + source.encode())
    assert urdf.read(tmp_path / "e.urdf").joint_names == ("gelénk",)
    unknown = source.replace('version="1.0"', 'version="1.0" encoding="klingon"').encode()
    (tmp_path / "f.urdf").write_bytes(unknown)
    with pytest.raises(RobotError, match="not readable as klingon"):
        urdf.read(tmp_path / "f.urdf")


REAL = sorted(DATA.glob("*/*.urdf"))


@pytest.mark.skipif(not REAL, reason=f"no URDFs of real robots at {DATA} (set CALIB_DATA)")
@pytest.mark.parametrize(
    "path",
    [
        pytest.param(path, id=f"{path.parent.name}/{path.stem}", marks=[pytest.mark.slow] * (number % 4 > 0))
        for number, path in enumerate(REAL)
    ],
)
def test_real_robots_against_pinocchio(path):
    agrees(path.read_text())
    source, chain = path.read_text(), urdf.read(path)
    if chain.inertias is not None:
        np.testing.assert_allclose(chain.inertias, pinocchio_inertias(source, chain), atol=1e-12)


def test_truncated_file_is_a_clear_error():
    """A file cut short is always a clear error."""
    source = gripper()
    for end in range(0, len(source) - len("</robot>") - 1, 7):
        with pytest.raises(RobotError, match="not XML"):
            urdf.parse(source[:end])
