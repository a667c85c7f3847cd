"""MJCF files are read as MuJoCo compiles them, and what no serial arm has is refused."""

import numpy as np
import pytest

import calib
from calib.errors import RobotError
from calib.robot.chain import random_joints
from calib.robot.formats import simulators, urdf
from calib.robot.formats.urdf_tree import text
from calib.robot.kinematics import forward
from calib.robot.library import load, names

mujoco = pytest.importorskip("mujoco", reason="MJCF files are read by MuJoCo: pip install mujoco")

AWKWARD = """<mujoco model="awkward">
  <compiler angle="degree" eulerseq="XYZ" autolimits="false"/>
  <default>
    <default class="a"><joint axis="0 1 1" range="-90 90" limited="true"/>
      <default class="b"><joint axis="0 0 2" frictionloss="3" damping="2"/></default></default>
  </default>
  <worldbody>
    <body name="stand" pos="0.1 0 0.2" euler="10 20 30">
      <body name="upper" pos="0 0 0.3" axisangle="0 1 0 40" childclass="a">
        <inertial mass="2" pos="0.1 0.2 0.3" quat="1 0.2 0.3 0.4" diaginertia="0.3 0.2 0.4"/>
        <joint name="j1" pos="0.05 0.02 0.01"/>
        <body name="fore" pos="0.2 0 0" xyaxes="1 1 0 -1 1 0">
          <inertial mass="1" pos="0.1 0 0" fullinertia="0.3 0.2 0.4 0.01 0.02 0.03"/>
          <joint name="j2" class="b" ref="30"/>
          <joint name="j3" type="slide" axis="1 0 0" range="-0.1 0.2" ref="0.05"/>
          <body name="hand" pos="0 0.2 0" zaxis="0 1 1">
            <geom type="box" size="0.1 0.05 0.02" mass="1.5" pos="0.05 0 0" euler="0 0 30"/>
            <joint name="j4" axis="1 0 0"/>
            <site name="tcp" pos="0 0 0.1" euler="0 90 0"/>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator><motor joint="j1" gear="10" forcerange="-5 4" forcelimited="true"/></actuator>
</mujoco>
"""


def seen_by_mujoco(path, q, site):
    """Return poses (m, 4, 4) of a site in the world, and gravity torques (m, n)."""
    model = mujoco.MjModel.from_xml_path(str(path))
    data, poses, torques = mujoco.MjData(model), np.tile(np.eye(4), (len(q), 1, 1)), np.empty(q.shape)
    for k, row in enumerate(q):
        data.qpos[:], data.qvel[:] = row, 0.0
        mujoco.mj_forward(model, data)
        poses[k, :3, :3], poses[k, :3, 3] = data.site(site).xmat.reshape(3, 3), data.site(site).xpos
        torques[k] = data.qfrc_bias
    return poses, torques


def test_frames_masses_limits_are_mujocos(tmp_path):
    """Frames, masses and limits are those of MuJoCo."""
    path = tmp_path / "awkward.xml"
    path.write_text(AWKWARD)
    chain = urdf.read(path)
    assert (chain.base, chain.tip, chain.joint_names) == ("world", "tcp", ("j1", "j2", "j3", "j4"))
    q = random_joints(chain, 10, 0)
    poses, torques = seen_by_mujoco(path, q, "tcp")
    assert np.abs(forward(chain, q) - poses).max() < 1e-12
    still = np.zeros(q.shape)
    found, _, damping, friction = simulators.motion_torques(text(path)[0], chain, q, still, still)
    assert np.abs(found - torques).max() < 1e-12
    assert damping.tolist() == [0, 2, 0, 0] and friction.tolist() == [0, 3, 0, 0]
    assert np.allclose(chain.upper, [np.pi / 2, np.pi / 2, 0.2, np.pi / 2]) and chain.joints[0].effort == 50.0


@pytest.mark.parametrize("name", names())
def test_written_mjcf_is_read_back(tmp_path, name):
    """What the toolkit writes as MJCF is read back."""
    chain = load(name)
    path = tmp_path / f"{name}.xml"
    bodies = np.tile([0.2, 0.01, 0.02, 0.3, 0.03, 0.25, 0.1, 0.2, 0.3, 3.0], (len(chain.driven), 1))
    path.write_text(simulators.mjcf_text(chain, bodies, *np.zeros((3, chain.n))))
    read, q = urdf.read(path), random_joints(chain, 10, 0)
    assert read.joint_names == chain.joint_names and read.tip == f"{chain.tip}_tip"
    assert np.abs(forward(read, q) - forward(chain, q)).max() < 1e-9
    assert np.abs(read.inertias - bodies).max() < 1e-9


def test_stated_masses_need_no_meshes(tmp_path):
    """Meshes need not be there where masses are stated."""
    path = tmp_path / "meshes.xml"
    mesh = '<asset><mesh name="m" file="none.stl"/></asset><worldbody>'
    shape = '<inertial mass="2" pos="0 0 0" diaginertia="1 1 1"/><geom type="mesh" mesh="m"/>'
    path.write_text(one_joint('<joint name="j"/>', shape).replace("<worldbody>", mesh))
    assert calib.load(path).chain.inertias[0, 9] == 2.0
    path.write_text(path.read_text().replace(shape, '<geom type="mesh" mesh="m"/>'))
    with pytest.raises(RobotError, match=r"MuJoCo cannot read it: .*mass and inertia"):
        calib.load(path)


def one_joint(joint, shape='<geom size="0.1"/>', more=""):
    """Return an MJCF of one body."""
    return f'<mujoco><worldbody><body name="b">{joint}{shape}</body></worldbody>{more}</mujoco>'


TWO = '<joint name="j" axis="0 1 0"/>'
OTHER = '<geom size="0.1"/><body name="c"><joint name="k" axis="0 1 0"/><geom size="0.1"/><site name="s"/></body>'


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (one_joint("<freejoint/>"), r"body 'b' has a free joint; .* not a scene"),
        (one_joint('<joint type="ball"/>'), r"body 'b' has a ball joint"),
        (one_joint(TWO, OTHER, '<equality><connect body1="c" anchor="0 0 1"/></equality>'), r"closes a loop"),
        (
            one_joint(TWO, OTHER, '<equality><joint joint1="k" joint2="j" polycoef="0 1 2 0 0"/></equality>'),
            r"equality 'number 1' of 'k' is not linear",
        ),
        (
            one_joint(TWO, OTHER, '<tendon><fixed><joint joint="k" coef="1"/></fixed></tendon>'),
            r"a tendon moves joints of the arm, which is not supported",
        ),
        (one_joint('<joint type="screw"/>'), r"MuJoCo cannot read it: .*screw"),
        ("<mujoco><worldbody/></mujoco>", r"no actuated joint"),
        ("<html></html>", r"MuJoCo cannot read it"),
        ("", r"MuJoCo cannot read it"),
    ],
)
def test_what_is_no_serial_arm_is_refused(tmp_path, content, says):
    path = tmp_path / "bad.xml"
    path.write_text(content)
    with pytest.raises(RobotError, match=rf"bad\.xml: .*{says}"):
        calib.load(path)


def test_equality_makes_a_joint_follow(tmp_path):
    """A joint that an equality ties to another follows it."""
    path = tmp_path / "tied.xml"
    tie = '<equality><joint joint1="k" joint2="j" polycoef="0.1 -0.5 0 0 0"/></equality>'
    path.write_text(one_joint(TWO, OTHER, tie))
    chain = urdf.read(path, tip="s")
    moving = [chain.elements[k] for k in chain.driven]
    assert chain.joint_names == ("j",)
    assert [(one.ratio, one.value) for one in moving] == [(1.0, 0.0), (-0.5, 0.1)]


def test_urdf_named_xml_is_read(tmp_path):
    """A URDF that ends in `.xml` is read as one."""
    path = tmp_path / "arm.xml"
    path.write_text('<?xml version="1.0"?><robot name="a"><link name="b"/></robot>')
    assert text(path)[0].endswith("</robot>")
