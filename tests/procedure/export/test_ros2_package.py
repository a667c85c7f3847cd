"""A calibrated robot as a ROS 2 package: by parsers of its files, and by reading its URDF again."""

import ast
import re
from dataclasses import replace
from xml.etree import ElementTree as ET

import numpy as np
import pinocchio
import pytest
import yaml

from calib.errors import CalibError, UsageError
from calib.procedure.export.delivery import Export
from calib.procedure.export.ros2_package import PACKAGE_NAME, write_package
from calib.robot import calibrated
from calib.robot.calibrated import CalibratedChain
from calib.robot.chain import random_joints
from calib.robot.formats import urdf
from calib.robot.kinematics import forward

SHAPE = '<{0}><geometry><mesh filename="{1}"/></geometry></{0}>'
ARM = f"""<?xml version="1.0"?>
<!-- an arm -->
<robot name="arm">
  <link name="foot">{SHAPE.format("visual", "package://arm_meshes/meshes/foot.stl")}</link>
  <link name="one">{SHAPE.format("visual", "meshes/visual/part.stl")}{SHAPE.format("collision", "one/part.stl")}</link>
  <link name="two">{SHAPE.format("visual", "package://elsewhere/two.dae")}</link>
  <joint name="a" type="revolute"><parent link="foot"/><child link="one"/><origin xyz="0 0 0.3"/><axis xyz="0 0 1"/>
    <limit lower="-2" upper="2" effort="9" velocity="3"/></joint>
  <joint name="b" type="revolute"><parent link="one"/><child link="two"/><origin xyz="0.4 0 0"/><axis xyz="0 1 0"/>
    <limit lower="-2" upper="2" effort="9" velocity="3"/></joint>
</robot>
"""
LIMITS = "joint_limits:\n  b: {has_velocity_limits: true, max_velocity: !degrees 90}\n"
SRDF = '<robot name="arm"><disable_collisions link1="foot" link2="two" reason="Never"/></robot>'


@pytest.fixture
def export(tmp_path):
    """Return an export of the arm, calibrated by some millimetres."""
    for place in ("arm_meshes/meshes/foot.stl", "arm/meshes/visual/part.stl", "arm/one/part.stl"):
        (tmp_path / place).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / place).write_text(place)
    source = tmp_path / "arm" / "arm.urdf"
    source.write_text(ARM)
    nominal = urdf.read(source)
    chain = nominal.with_values(
        np.array(nominal.values) + np.random.default_rng(0).normal(0.0, 2e-3, len(nominal.names))
    )
    (tmp_path / "fit").mkdir()
    calibrated.write(tmp_path / "fit", CalibratedChain(chain, nominal, source=str(source)))
    return Export(source, tmp_path / "fit", remark="verdict marginal: a & b < c")


def test_package_is_what_ament_reads(tmp_path, export):
    """A package is what ament and launch read."""
    (tmp_path / "joint_limits.yaml").write_text(LIMITS)
    (tmp_path / "arm.srdf").write_text(SRDF)
    notes = write_package(export, "my_arm_description", tmp_path, moveit=[tmp_path], control=True)
    package = tmp_path / "my_arm_description"
    root = ET.parse(package / "package.xml").getroot()
    assert (root.get("format"), root.findtext("name")) == ("3", "my_arm_description")
    assert "a & b < c" in root.findtext("description")
    needed = [each.text for each in root.iter("exec_depend")]
    assert {"robot_state_publisher", "rviz2", "elsewhere"} <= {*needed} and "1 meshes were not found" in " ".join(notes)
    installed = re.findall(r"install\(DIRECTORY (.*) DESTINATION", (package / "CMakeLists.txt").read_text())[0].split()
    assert {*installed} == {each.name for each in package.iterdir() if each.is_dir()}
    launch = ast.parse((package / "launch/display.launch.py").read_text())
    assert "generate_launch_description" in [each.name for each in launch.body if isinstance(each, ast.FunctionDef)]
    view = yaml.safe_load((package / "rviz/display.rviz").read_text())["Visualization Manager"]
    assert view["Global Options"]["Fixed Frame"] == "foot"
    assert (package / "config/joint_limits.yaml").read_text() == LIMITS and (package / "config/arm.srdf").exists()


def test_package_urdf_is_calibrated_robot(tmp_path, export):
    """The URDF of a package is the calibrated robot, with meshes of the package."""
    write_package(export, "my_arm_description", tmp_path, control=True)
    file, robot = tmp_path / "my_arm_description/urdf/my_arm.urdf", calibrated.read(tmp_path / "fit").chain
    model = pinocchio.buildModelFromUrdf(str(file))
    data, q = model.createData(), random_joints(robot, 5, 0)
    for row, wanted in zip(q, forward(robot, q)):
        pinocchio.framesForwardKinematics(model, data, row)
        assert np.abs(data.oMf[model.getFrameId("two")].homogeneous - wanted).max() < 1e-9
    root = ET.parse(file).getroot()
    meshes = [each.get("filename") for each in root.iter("mesh")]
    assert meshes[-1] == "package://elsewhere/two.dae"
    copies = [(tmp_path / each.removeprefix("package://")).read_text() for each in meshes[:-1]]
    assert copies == ["arm_meshes/meshes/foot.stl", "arm/meshes/visual/part.stl", "arm/one/part.stl"]
    assert [each.get("name") for each in root.find("ros2_control").iter("joint")] == ["a", "b"]
    assert "<!-- an arm -->" in file.read_text()


def test_ros2_control_of_source_survives(tmp_path, export):
    """A ros2_control of the source is kept."""
    own = '<ros2_control name="mine" type="system"><hardware><plugin>x/Y</plugin></hardware></ros2_control>'
    export.source.write_text(ARM.replace("</robot>", f"{own}</robot>"))
    write_package(export, "arm", tmp_path / "src", control=True)
    assert (tmp_path / "src/arm/urdf/arm.urdf").read_text().count("<ros2_control") == 1


@pytest.mark.parametrize(
    "name", ["Arm", "arm__description", "_arm", "1arm", "arm_", "arm-description", "", "a" * 60 + "A"]
)
def test_impossible_package_name_is_refused(tmp_path, export, name):
    """A name that no package has is refused."""
    assert re.fullmatch(r"[a-z](_?[a-z0-9]+)*", name[:12]) is None or len(name) > 12
    with pytest.raises(UsageError, match="REP 149"):
        write_package(export, name, tmp_path / "src")
    assert not (tmp_path / "src").exists()


def test_names_are_those_of_rep_149():
    words = [a + b + c for a in "a_A1" for b in ("", "_", "b", "_b", "__", "9") for c in ("", "_", "c", "_9")]
    assert [bool(PACKAGE_NAME.fullmatch(each)) for each in words] == [
        bool(re.fullmatch(r"[a-z](_?[a-z0-9]+)*", each)) for each in words
    ]


def test_foreign_srdf_and_files_are_refused(tmp_path, export):
    """Another robot's SRDF, and files that are there already, are refused."""
    (tmp_path / "other.srdf").write_text(SRDF.replace("foot", "panda_link0"))
    with pytest.raises(UsageError, match=r"none of its 1 disabled pairs .* another robot"):
        write_package(export, "arm", tmp_path / "src", moveit=[tmp_path / "other.srdf"])
    write_package(export, "arm", tmp_path / "src")
    (tmp_path / "src/arm/package.xml").write_text("mine")
    with pytest.raises(CalibError, match="overwrite"):
        write_package(replace(export), "arm", tmp_path / "src")
    assert (tmp_path / "src/arm/package.xml").read_text() == "mine"
    write_package(replace(export), "arm", tmp_path / "src", overwrite=True)
    assert (tmp_path / "src/arm/package.xml").read_text() != "mine"
