"""Xacro files are read wherever a URDF is taken, and what is wrong with them is said with the file."""

import numpy as np
import pytest

import calib
from calib.errors import RobotError
from calib.robot.formats.urdf_tree import text

ARM = """<robot name="arm" xmlns:xacro="http://www.ros.org/wiki/xacro">
  <xacro:arg name="mass" default="2"/>
  <xacro:include filename="$(find arm_parts)/parts.xacro"/>
  <xacro:property name="sizes" value="${xacro.load_yaml('$(find arm_parts)/sizes.yaml')}"/>
  <link name="base_link"/>
  <xacro:bar name="upper" mass="$(arg mass)" length="${sizes.upper}"/>
  <xacro:bar name="fore" mass="1" length="0.3"/>
  <xacro:turn name="shoulder" parent="base_link" child="upper" z="0.5" most="${sizes.most}"/>
  <xacro:turn name="elbow" parent="upper" child="fore" z="${sizes.upper}" most="2"/>
  <ros2_control name="arm" type="system"><joint name="shoulder"/></ros2_control>
</robot>
"""
PARTS = """<robot xmlns:xacro="http://www.ros.org/wiki/xacro">
  <xacro:macro name="bar" params="name mass length">
    <link name="${name}"><inertial><origin xyz="0 0 ${length / 2}"/><mass value="${mass}"/>
      <inertia ixx="${mass * length**2}" ixy="0" ixz="0" iyy="${mass * length**2}" iyz="0" izz="0.01"/></inertial>
    </link>
  </xacro:macro>
  <xacro:macro name="turn" params="name parent child z most">
    <joint name="${name}" type="revolute"><parent link="${parent}"/><child link="${child}"/><origin xyz="0 0 ${z}"/>
      <axis xyz="0 1 0"/><limit lower="${-most}" upper="${most}" velocity="2" effort="50"/></joint>
  </xacro:macro>
</robot>
"""


@pytest.fixture
def arm(tmp_path):
    """A robot's package beside a clone of another one, whose folder does not have the package's name."""
    for folder in ("arm_description/urdf", "clone"):
        (tmp_path / folder).mkdir(parents=True)
    path = tmp_path / "arm_description/urdf/arm.urdf.xacro"
    path.write_text(ARM)
    (tmp_path / "clone/package.xml").write_text("<package><name>arm_parts</name></package>")
    (tmp_path / "clone/parts.xacro").write_text(PARTS)
    (tmp_path / "clone/sizes.yaml").write_text("upper: 0.4\nmost: !degrees 90\n")
    return path


def test_xacro_is_the_expanded_robot(arm):
    """A xacro file is the robot that it expands to."""
    chain = calib.load(f"{arm} mass:=3").chain
    assert chain.joint_names == ("shoulder", "elbow")
    assert np.allclose(chain.inertias[:, 9], [3, 1]) and np.isclose(chain.joints[0].upper, np.pi / 2)
    assert np.allclose(calib.load(str(arm)).chain.inertias[:, 9], [2, 1])


def test_a_changed_file_is_read_again(arm):
    assert calib.load(arm).chain.joints[1].upper == 2.0
    arm.write_text(ARM.replace('most="2"', 'most="1.5"'))
    assert calib.load(arm).chain.joints[1].upper == 1.5


def test_environment_names_packages(arm, tmp_path, monkeypatch):
    """Packages elsewhere are named by the environment."""
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "clone").rename(tmp_path / "elsewhere/far_parts")
    (tmp_path / "elsewhere/far_parts/package.xml").unlink()
    arm.write_text(ARM.replace("arm_parts", "far_parts"))
    with pytest.raises(RobotError, match=r"no package 'far_parts' .* ROS_PACKAGE_PATH=/folder/that/holds/far_parts"):
        calib.load(arm)
    monkeypatch.setenv("ROS_PACKAGE_PATH", str(tmp_path / "elsewhere"))
    assert calib.load(arm).chain.n == 2


def test_a_session_keeps_the_expanded_file(arm, tmp_path):
    calib.new_session(tmp_path / "cell", f"{arm} mass:=3", "tracker")
    kept = tmp_path / "cell/1-robot/robot.urdf"
    assert kept.read_text() == text(f"{arm} mass:=3")[0] and "<ros2_control" in kept.read_text()


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ("<link", r"unclosed token"),
        ("<link name='${size}'/></robot>", r"name 'size' is not defined"),
        ("<xacro:bar/></robot>", r"unknown macro name: xacro:bar"),
        ("<xacro:macro name='m' params=''><xacro:m/></xacro:macro><xacro:m/></robot>", r"nested without end"),
        ("<xacro:include filename='bad.xacro'/></robot>", r"nested without end: .* includes itself"),
        ("<xacro:include filename='none.xacro'/></robot>", r"No such file"),
        (
            "<link name='$(arg side)'/></robot>",
            r"Undefined substitution argument side; state it after the file: side:=",
        ),
    ],
)
def test_xacro_error_is_refused_in_its_words(tmp_path, content, says):
    """What xacro cannot expand is refused with its words."""
    path = tmp_path / "bad.xacro"
    path.write_text(f'<robot name="a" xmlns:xacro="http://www.ros.org/wiki/xacro">{content}')
    with pytest.raises(RobotError, match=rf"bad\.xacro.*: .*{says}"):
        calib.load(path)


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ("mas:=3", r"no xacro argument 'mas' \(did you mean 'mass'\?\); it has mass"),
        ("mass:=3 heavy", r"'heavy' is no xacro argument; write name:=value"),
    ],
)
def test_unknown_arguments_are_refused(arm, given, says):
    """Arguments that the file does not have are refused."""
    with pytest.raises(RobotError, match=says):
        calib.load(f"{arm} {given}")
