"""Exported URDFs as a second independent reader sees them."""

import numpy as np
import pytest

from calib.errors import RobotError
from calib.procedure.export.geometry import check_readback
from calib.robot.formats import simulators, urdf, urdf_write
from calib.robot.kinematics import joint_frames
from calib.robot.library import load


@pytest.mark.parametrize("robot", ["ur5", "lwr4plus"])
def test_yourdfpy_agrees_on_every_link(robot):
    """The reader yourdfpy puts every link where we do."""
    source = urdf_write.write_new(load(robot))
    own = urdf.parse(source)
    q = np.random.default_rng(0).uniform(-2.0, 2.0, (7, own.n))
    seen = simulators.link_poses(source, own.links, own.base, own.joint_names, q)
    assert seen.shape == (own.n, 7, 4, 4) and np.abs(seen - joint_frames(own, q)).max() < 1e-12
    assert check_readback(source, "robot.urdf", load(robot)) == "Pinocchio and yourdfpy read the same poses to 1e-9"


def test_a_slanted_axis_is_no_disagreement():
    source = urdf_write.write_new(load("lwr4plus")).replace('<axis xyz="0 0 1.0"/>', '<axis xyz="0.48 -0.6 0.64"/>')
    own = urdf.parse(source)
    assert source.count("0.48 -0.6 0.64") > 1
    assert check_readback(source, "robot.urdf", own) == "Pinocchio and yourdfpy read the same poses to 1e-9"


def test_disagreeing_reader_refuses(monkeypatch):
    """A second reader that disagrees refuses, and one that cannot read is said."""
    chain = load("ur5")
    source, right = urdf_write.write_new(chain), simulators.link_poses
    place = "calib.procedure.export.geometry.link_poses"
    monkeypatch.setattr(place, lambda *given: right(*given) + 1e-8)
    with pytest.raises(RobotError, match="poses differ by 1e-08 when yourdfpy reads the URDF"):
        check_readback(source, "robot.urdf", chain)
    monkeypatch.setattr(place, lambda text, *given: right("<robot", *given))
    assert "not read a second time: yourdfpy cannot read the URDF" in check_readback(source, "robot.urdf", chain)
