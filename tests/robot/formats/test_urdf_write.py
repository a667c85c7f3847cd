"""URDF out: the edit in place changes origins and nothing else, and Pinocchio reads the calibrated robot from it."""

import re

import numpy as np
import pytest
from recordings import DATA
from robot_oracle import axis, inertial, joint, pinocchio_inertias, pinocchio_poses, robot

from calib.errors import RobotError
from calib.robot import library, mdh
from calib.robot.chain import Chain, random_joints
from calib.robot.formats import urdf, urdf_write
from calib.robot.kinematics import forward
from calib.robot.library import load
from calib.transforms import from_xyz_rpy, to_xyz_rpy

# one in eight quickly
REAL_ROBOTS = [
    pytest.param(path, id=f"{path.parent.name}/{path.stem}", marks=[pytest.mark.slow] * (number % 8 != 0))
    for number, path in enumerate(sorted(DATA.glob("*/*.urdf")))
]
AWKWARD = """<?xml version='1.0' encoding="utf-8"?>
<!-- a comment with <joint name="a"><origin xyz="9 9 9"/></joint> in it -->
<robot name="awkward" xmlns:xacro="http://www.ros.org/wiki/xacro">
  <xacro:property name="unused" value="1"/>
  <link name="base"/>	<link name="one"><visual><origin xyz="0 0 0.5" rpy="0 0 0"/>
    <geometry><mesh filename='package://arm/möbius.dae' scale="1 1 1"/></geometry></visual></link>
  <link name="two"/><link name="flange"/><link name="three"/>
  <joint name='a'
         type='revolute'>
    <!-- <origin xyz="8 8 8"/> -->
    <origin
        rpy = '0.1  0.2 0.3'
        xyz='0 0 0.1'
    /><parent link="base"/><child link="one"/>
    <axis xyz="0 0 1"/><limit lower="-1" upper="2" velocity="3" effort="4"/>
    <safety_controller soft_lower_limit="-0.9" k_velocity="20"/>
  </joint>
  <joint name="b" type="prismatic"  >
\t<parent link="one"/><child link="two"/><axis xyz="1 2 3"/><limit lower="-1" upper="2" velocity="3" effort="4"/>
  </joint>
  <joint name="c" type="revolute"><origin xyz="0.3 0 0"/><parent link="two"/><child link="three"/><axis xyz="0 -1 0"/>
    <limit lower="-1" upper="2" velocity="3" effort="4"/></joint>
  <joint name="f" type="fixed"><child link="flange"/><parent link="three"/>
    <origin rpy="0 1.5707963267948966 0"/></joint>
  <transmission name="t"><joint name="a"><hardwareInterface>x</hardwareInterface></joint></transmission>
  <gazebo reference="one"><origin xyz="7 7 7"/></gazebo>
  <ros2_control name="s" type="system"><joint name="b"><param name="x">1 &gt; 0</param></joint></ros2_control>
</robot>
<!-- the end -->
"""


def disturbed(chain: Chain, seed: int = 0, size: float = 3e-3, owners: int | None = None) -> Chain:
    """Return the chain with other values; those of the last owner (the tool's side) only on request."""
    step = np.random.default_rng(seed).normal(0, size, len(chain.values))
    most = chain.n if owners is None else owners
    return chain.with_values(chain.values + [s * (e.owner < most) for s, e in zip(step, chain.elements, strict=True)])


def without_origins(source: str) -> str:
    """Return the text with the insides of the joints' origins blanked, and inserted origins removed."""
    source = re.sub(r'\s*<origin xyz="[^"]*" rpy="[^"]*"/>(?=\s*<parent link="one"/>)', "", source)
    return re.sub(r"(<origin)[^>]*?(/>)", r"\1\2", source)


@pytest.mark.parametrize("ends", ["\n", "\r\n"])
def test_only_origins_change(ends):
    source = AWKWARD.replace("\n", ends)
    nominal = urdf.parse(source)
    calibrated = disturbed(nominal)
    edited = urdf_write.edit(source, nominal, calibrated)
    q = random_joints(nominal, 20)
    assert np.abs(pinocchio_poses(edited, nominal, q) - forward(calibrated, q)).max() < 1e-9
    assert without_origins(edited) == without_origins(source)
    for kept in ("9 9 9", "8 8 8", "7 7 7", "0 0 0.5", "möbius", "0 1.5707963267948966 0", "the end", "rpy = '"):
        assert kept in edited
    again = urdf.parse(edited)
    assert (again.joints, again.links, again.tip) == (nominal.joints, nominal.links, nominal.tip)


def test_unchanged_robot_keeps_every_byte():
    """An unchanged robot leaves every byte."""
    nominal = urdf.parse(AWKWARD)
    assert urdf_write.edit(AWKWARD, nominal, nominal) == AWKWARD


def test_one_length_changes_one_attribute():
    """One changed length changes one attribute."""
    nominal = urdf.parse(AWKWARD)
    edited = urdf_write.edit(AWKWARD, nominal, nominal.with_values({"c.x": 0.0123456789012345}))
    before, after = AWKWARD.split('xyz="0.3 0 0"')
    assert edited.startswith(before + 'xyz="') and edited.endswith(after)
    written = edited.removeprefix(before + 'xyz="').removesuffix(after).rstrip('"').split()
    np.testing.assert_allclose([float(word) for word in written], [0.3123456789012345, 0, 0], atol=1e-15)


def test_missing_origin_is_inserted():
    """A missing origin is inserted with the indentation."""
    nominal = urdf.parse(AWKWARD)
    edited = urdf_write.edit(AWKWARD, nominal, nominal.with_values({"b.x": 0.5, "b.rx": 0.0}))
    assert '<joint name="b" type="prismatic"  >\n\t<origin xyz="' in edited and '/>\n\t<parent link="one"/>' in edited


@pytest.mark.skipif(not DATA.is_dir(), reason=f"no URDFs of real robots at {DATA} (set CALIB_DATA)")
@pytest.mark.parametrize("path", REAL_ROBOTS)
def test_real_robots_read_back_by_pinocchio(path, tmp_path):
    nominal = urdf.read(path)
    calibrated = disturbed(nominal, 1)
    target = urdf_write.edit_file(path, tmp_path / "calibrated.urdf", nominal, calibrated)
    q = random_joints(nominal, 10)
    assert np.abs(pinocchio_poses(target.read_text(), nominal, q) - forward(calibrated, q)).max() < 1e-9
    assert np.abs(forward(urdf.read(target, nominal.base, nominal.tip), q) - forward(calibrated, q)).max() < 1e-9
    urdf_write.edit_file(path, tmp_path / "same.urdf", nominal, nominal)
    assert (tmp_path / "same.urdf").read_bytes() == path.read_bytes()


@pytest.mark.parametrize("name", ["ur5", "panda", "lwr4plus", "tx40"])
def test_mdh_calibration_goes_into_urdf(name):
    """The URDF describes the same axes by other frames: turned about and moved along them, base and tip elsewhere."""
    nominal = load(name)
    source = other_frames(nominal)
    calibrated = disturbed(nominal, 2)
    edited = urdf_write.edit(source, nominal, calibrated)
    before, after = urdf.parse(source), urdf.parse(edited)
    q = random_joints(nominal, 10)
    flange = np.linalg.inv(forward(nominal, q)) @ forward(before, q)
    assert np.ptp(flange, axis=0).max() < 1e-9
    assert np.abs(pinocchio_poses(edited, after, q) - forward(calibrated, q) @ flange).max() < 1e-9


def other_frames(nominal: Chain) -> str:
    """Return a URDF of an MDH chain whose link frames are screwed along their axes by 0.1 m and 0.3 rad."""
    tree = urdf.read_tree(urdf_write.write_new(nominal), "new")
    screw, pending, tags = from_xyz_rpy([0, 0, 0.1], [0, 0, 0.3]), np.eye(4), []
    for tag in tree.joints.values():
        xyz, rpy = to_xyz_rpy(pending @ tag.origin @ (screw if tag.moves else np.eye(4)))
        pending = np.linalg.inv(screw)
        limit = f'<limit lower="{tag.limits[0]}" upper="{tag.limits[1]}" velocity="1" effort="1"/>' * tag.moves
        numbers = [" ".join(map(repr, values.tolist())) for values in (xyz, rpy)]
        tags.append(joint(tag.name, tag.kind, tag.parent, tag.child, axis("0 0 1") + limit, *numbers))
    return robot(*tags)


def test_followers_and_fixed_joints_stay():
    """Followers, and fixed joints in between, keep theirs."""
    source = robot(
        joint("a", "revolute", "base", "one", axis("0 0 -1"), "0 0 0.1"),
        joint("f", "fixed", "one", "plate", "", "0.1 0.2 0.3", "0.3 0.2 0.1"),
        joint("b", "revolute", "plate", "two", axis("0 1 0") + '<mimic joint="a" multiplier="-0.7" offset="0.2"/>'),
        joint("c", "revolute", "two", "three", axis("1 1 0"), "0.2 0 0"),
    )
    nominal = urdf.parse(source)
    calibrated = disturbed(nominal)
    edited = urdf_write.edit(source, nominal, calibrated)
    q = random_joints(nominal, 10)
    assert np.abs(pinocchio_poses(edited, nominal, q) - forward(calibrated, q)).max() < 1e-9
    assert 'xyz="0.1 0.2 0.3" rpy="0.3 0.2 0.1"' in edited and 'offset="0.2"' in edited


def with_flange_row(theta: float = 0.0, r: float = 0.1) -> Chain:
    return mdh.chain(
        "f", [mdh.Row("a", 1, r=0.3), mdh.Row("b", 2, alpha=1.5), mdh.Row("", 3, "fixed", theta=theta, r=r)]
    )


def test_tip_change_goes_to_fixed_joint():
    """What changed behind the last joint goes to the first fixed joint."""
    nominal, calibrated = with_flange_row(), with_flange_row(0.2, 0.15)
    source = urdf_write.write_new(nominal)
    edited = urdf_write.edit(source, nominal, calibrated)
    q = random_joints(nominal, 5)
    assert np.abs(pinocchio_poses(edited, calibrated, q) - forward(calibrated, q)).max() < 1e-12
    bare = re.sub(r'\s*<link name="tip"/>\s*<joint name="tip_fixed".*?</joint>', "", source, flags=re.S)
    with pytest.raises(RobotError, match=r"differs after the last joint, but the URDF has no fixed joint to 'tip'"):
        urdf_write.edit(bare, nominal, calibrated)


def test_another_robot_is_refused():
    nominal = load("ur5")
    longer = nominal.with_values({"d3": -0.427})
    source, panda = urdf_write.write_new(nominal), load("panda")
    for text, calibrated, words in (
        (
            urdf_write.write_new(longer),
            nominal,
            r"not describe the nominal robot .*: at joint 'elbow_joint' .* 0\.00[24]",
        ),
        (
            urdf_write.write_new(panda),
            nominal,
            r"its joints to 'panda_link8' are .*: give the URDF of the nominal robot",
        ),
        (source, panda, r"does not move as the nominal"),
        (source.replace('"0 0 1.0"/>', '"0 0 -1.0"/>', 1), nominal, r"at joint 'shoulder_pan_joint'"),
    ):
        with pytest.raises(RobotError, match=words):
            urdf_write.edit(text, nominal, calibrated)


@pytest.mark.parametrize("name", library.names())
def test_new_urdf_of_the_library(name):
    chain = disturbed(load(name), 3)
    source = urdf_write.write_new(chain)
    q = random_joints(chain, 20)
    assert np.abs(pinocchio_poses(source, chain, q) - forward(chain, q)).max() < 1e-12
    again = urdf.parse(source)
    assert (again.joints, again.base, again.tip) == (chain.joints, chain.base, chain.tip)
    if chain.inertias is not None:
        np.testing.assert_allclose(again.inertias, chain.inertias, atol=1e-15)
        np.testing.assert_allclose(pinocchio_inertias(source, chain), chain.inertias, atol=1e-15)


def test_new_urdf_of_any_chain():
    source = robot(
        joint("a & b", "continuous", "base", "one", axis("1 2 3"), "0 0 0.1"),
        joint(
            "s", "prismatic", "one", "two", axis("0 -1 0") + '<limit lower="-1" upper="1e12" velocity="0" effort="0"/>'
        ),
        joint("m", "revolute", "two", "three", axis("0 1 0") + '<mimic joint="a & b" multiplier="0.5" offset="0.2"/>'),
        joint("c", "revolute", "three", "four", axis("1 1 0"), "0.2 0 0"),
        bodies={"one": inertial(1.0, "0.1 0 0")},
    ).replace("&", "&amp;")
    chain = disturbed(urdf.parse(source))
    new = urdf_write.write_new(chain)
    q = random_joints(chain, 10)
    assert np.abs(pinocchio_poses(new, chain, q) - forward(chain, q)).max() < 1e-12
    again = urdf.parse(new)
    assert again.joints == chain.joints
    np.testing.assert_allclose(forward(again, q), forward(chain, q), atol=1e-12)


def test_a_second_ratio_cannot_be_written():
    chain = urdf.parse(robot(joint("a", "revolute", "base", "one", axis("0 0 1"))))
    elements = (*chain.elements[:-1], urdf.Element("a.offset", "rz", 0.0, 0, 0, ratio=2.0))
    with pytest.raises(RobotError, match=r"'a.offset': a URDF joint moves by q, not by 2 q"):
        urdf_write.write_new(Chain("x", chain.joints, elements))


@pytest.mark.parametrize("gap", [0.0, 1e-16, 1e-12, 1e-9, 5e-8, 1e-7, 1e-5, 0.1, np.pi / 2])
def test_roll_pitch_yaw_near_the_pole(gap):
    for sign in (1, -1):
        there = from_xyz_rpy([0.1, 0.2, 0.3], [0.4, sign * (np.pi / 2 - gap), -2.5])
        assert np.abs(from_xyz_rpy(*to_xyz_rpy(there)) - there).max() < 1e-15
