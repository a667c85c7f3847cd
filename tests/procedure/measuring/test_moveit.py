"""MoveIt's files are limits of poses and motions, and those of another robot are refused."""

import numpy as np
import pytest

from calib.errors import UsageError
from calib.geometry.observability import targets_of
from calib.procedure.excitation.limits import read_motion_limits
from calib.procedure.measuring.pose_limits import read_limits
from calib.robot.formats import urdf

ARM = """<robot name="arm">
  <link name="foot"><collision><geometry><box size="0.2 0.2 0.1"/></geometry></collision></link>
  {links}<link name="finger"/>
  {joints}<joint name="grip" type="prismatic"><parent link="l4"/><child link="finger"/><axis xyz="0 1 0"/>
    <limit lower="0" upper="0.04" effort="9" velocity="3"/></joint>
</robot>
"""
LINK = """<link name="l{0}"><collision><origin xyz="0.1 0 0"/><geometry><box size="0.2 0.05 0.05"/></geometry>
  </collision></link>"""
JOINT = """<joint name="j{0}" type="revolute"><parent link="{1}"/><child link="l{0}"/><origin xyz="0.2 0 0.1"/>
  <axis xyz="0 {2}"/><limit lower="-3" upper="3" effort="50" velocity="4"/></joint>"""
LIMITS = """
default_velocity_scaling_factor: 0.1
joint_limits:
  j1: {has_position_limits: true, min_position: !degrees -90.0, max_position: 1.5, has_velocity_limits: true,
       max_velocity: 2.0}
  j2: {max_velocity: !degrees 180.0, has_acceleration_limits: true, max_acceleration: 5.0}
  j3: {has_velocity_limits: false, max_velocity: 0.1, max_effort: 20.0}
  grip: {has_velocity_limits: true, max_velocity: 0.01}
"""
SRDF = """<robot name="arm"><disable_collisions link1="l4" link2="foot"/>
<disable_collisions link1="l1" link2="l3"/><disable_collisions link1="finger" link2="camera"/></robot>"""


@pytest.fixture
def arm(tmp_path):
    joints = [JOINT.format(k, f"l{k - 1}" if k > 1 else "foot", "0 1" if k == 1 else "1 0") for k in range(1, 5)]
    path = tmp_path / "arm.urdf"
    path.write_text(ARM.format(links="".join(map(LINK.format, range(1, 5))), joints="".join(joints)))
    (tmp_path / "config").mkdir()
    (tmp_path / "config/joint_limits.yaml").write_text(LIMITS)
    (tmp_path / "config/arm.srdf").write_text(SRDF)
    return path, urdf.read(path, tip="l4")


def test_moveit_folder_limits_motions(tmp_path, arm):
    """The folder of a MoveIt configuration limits poses and motions."""
    path, chain = arm
    found = read_limits(tmp_path, targets_of(chain), path, ["joint-margin"])
    assert np.allclose(found.lower, [-np.pi / 2, -3, -3, -3]) and np.allclose(found.upper, [1.5, 3, 3, 3])
    plain = read_limits(None, targets_of(chain), path)
    gone = {frozenset(pair) for pair in plain.collision.pairs} - {frozenset(pair) for pair in found.collision.pairs}
    assert gone == {frozenset(("foot", "l4")), frozenset(("l1", "l3"))}
    motion = read_motion_limits(tmp_path, chain, path)
    assert np.allclose(motion.bounds.velocity, [2.0, np.pi, 4.0, 4.0]) and motion.torque.tolist() == [50, 50, 20, 50]
    assert motion.bounds.acceleration[1] == 5.0
    alone = read_motion_limits(tmp_path / "config/joint_limits.yaml", chain, path)
    assert np.allclose(alone.bounds.velocity, motion.bounds.velocity)


@pytest.mark.parametrize(
    ("file", "old", "new", "says"),
    [
        ("joint_limits.yaml", "j2", "j22", r"joint 'j22' is not one of .*did you mean 'j2'"),
        ("joint_limits.yaml", "5.0", "fast", r"j2\.max_acceleration: .*fast"),
        ("joint_limits.yaml", "1.5", "-1.6", r"joints\.j1: -1\.57\S* is not below -1\.6"),
        ("joint_limits.yaml", "joint_limits", "limits", r"is no joint_limits\.yaml of MoveIt"),
        ("joint_limits.yaml", "j1: {", "j1: [", r"cannot be read as YAML"),
        ("arm.srdf", '"l', '"panda_l', r"is it for another robot"),
        ("arm.srdf", "</robot>", "", r"arm\.srdf.*line 2"),
    ],
)
def test_foreign_configuration_is_refused(tmp_path, arm, file, old, new, says):
    """A configuration that cannot be, or is is it for another robot, is refused."""
    path, chain = arm
    place = tmp_path / "config" / file
    place.write_text(place.read_text().replace(old, new))
    with pytest.raises(Exception, match=says):
        read_motion_limits(place, chain, path)


def test_unrelated_folder_or_link_is_refused(tmp_path, arm):
    """A folder without limits is refused, and so is a link that is none."""
    path, chain = arm
    (tmp_path / "empty").mkdir()
    with pytest.raises(UsageError, match=r"empty: neither joint_limits\.yaml nor \*\.srdf"):
        read_limits(tmp_path / "empty", targets_of(chain), path)
    with pytest.raises(UsageError, match=r"ignored: link 'foto' is not one of .*did you mean"):
        read_limits({"collision": {"ignored": [["foto", "l4"]]}}, targets_of(chain), path)


def test_pairs_without_shapes_use_capsules(tmp_path, arm):
    """Pairs of an arm without shapes are those of its capsules."""
    _, chain = arm
    pair = ("foot", "l3")
    found = read_limits({"collision": {"ignored": [pair]}}, targets_of(chain))
    assert pair in read_limits(None, targets_of(chain)).collision.pairs and pair not in found.collision.pairs
