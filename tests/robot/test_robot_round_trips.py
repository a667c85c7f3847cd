"""Any chain, whatever its names, comes back from the files it is written to."""

import numpy as np
from hypothesis import given
from strategies import chains

from calib.robot import description
from calib.robot.chain import random_joints
from calib.robot.formats import urdf, urdf_write
from calib.robot.kinematics import forward


@given(chains(inertias=True))
def test_robot_file_returns_the_same_chain(tmp_path_factory, chain):
    """A robot file returns the same chain to the last bit."""
    back = description.read(description.write(tmp_path_factory.mktemp("robot") / "robot.toml", chain))
    assert (back.name, back.joints, back.base, back.tip) == (chain.name, chain.joints, chain.base, chain.tip)
    assert [e.name for e in back.elements] == [e.name for e in chain.elements]
    assert np.array_equal(back.values, chain.values) and np.array_equal(back.tail, chain.tail)
    q = random_joints(chain, 5, 0)
    assert np.array_equal(forward(back, q), forward(chain, q))


@given(chains(inertias=True))
def test_a_new_urdf_holds_the_same_arm(chain):
    back = urdf.parse(urdf_write.write_new(chain), "written")
    assert back.joint_names == chain.joint_names
    q = random_joints(chain, 5, 0)
    np.testing.assert_allclose(forward(back, q), forward(chain, q), atol=1e-9)
