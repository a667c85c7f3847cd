"""Gravity torques against Pinocchio, from the URDF itself."""

import numpy as np
import pytest

from calib.errors import RobotError
from calib.robot.chain import random_joints
from calib.robot.formats import urdf
from calib.robot.kinematics import gravity_torques
from calib.robot.library import load

ARM = """<robot name="arm"><link name="base"/>{links}
<joint name="lift" type="prismatic"><parent link="base"/><child link="l1"/><origin xyz="0.1 0 0.2" rpy="0.3 0.2 0.1"/>
  <axis xyz="0 0 1"/><limit lower="0" upper="1" effort="1" velocity="1"/></joint>
<joint name="turn" type="revolute"><parent link="l1"/><child link="l2"/><origin xyz="0.3 0.1 0" rpy="1 0 0.4"/>
  <axis xyz="0 -1 0"/><limit lower="-2" upper="2" effort="1" velocity="1"/></joint>
<joint name="bend" type="revolute"><parent link="l2"/><child link="l3"/><origin xyz="0.2 0 0.4" rpy="0 1 0"/>
  <axis xyz="0.6 0 0.8"/><limit lower="-2" upper="2" effort="1" velocity="1"/></joint></robot>"""
LINK = """<link name="l{0}"><inertial><origin xyz="0.0{0} 0.05 -0.1" rpy="0.1 0 0.2"/><mass value="{0}.5"/>
  <inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>"""


def test_equal_to_pinocchio():
    pin = pytest.importorskip("pinocchio")
    text = ARM.format(links="".join(LINK.format(k) for k in (1, 2, 3)))
    chain, model = urdf.parse(text), pin.buildModelFromXML(text)
    data = model.createData()
    q = random_joints(chain, 20, 0)
    expected = np.array([pin.computeGeneralizedGravity(model, data, row) for row in q])
    assert np.abs(expected).max() > 1.0
    assert gravity_torques(chain, q) == pytest.approx(expected, abs=1e-12)


def test_no_gravity_torques_without_masses():
    """An arm of unknown masses has no gravity torques."""
    with pytest.raises(RobotError, match="masses"):
        gravity_torques(load("ur5"), np.zeros((1, 6)))
