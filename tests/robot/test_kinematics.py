"""The element Jacobian against finite differences, for an MDH chain and for a URDF with every kind of joint."""

import numpy as np
import pytest
from differences import check
from robot_oracle import axis, joint, robot

from calib.errors import RobotError
from calib.robot.chain import Chain, random_joints
from calib.robot.formats import urdf
from calib.robot.kinematics import forward, jacobian, joint_frames, tip_jacobian
from calib.robot.library import load
from calib.transforms import rotation_vector

MIMIC = '<mimic joint="a" multiplier="-0.5" offset="0.2"/>'
ZOO = robot(
    joint("a", "revolute", "base", "one", axis("1 2 -3"), "0.1 0.2 0.3", "0.3 -1.2 2"),
    joint("b", "prismatic", "one", "two", axis("0 -1 0"), "0.1 0 0", "0 1.5707963267948966 0"),
    joint("c", "revolute", "two", "three", axis("-1 0 0"), "0 0.2 0.1", "0.1 0.2 0.3"),
    joint("d", "revolute", "three", "four", axis("0 0 1") + MIMIC, "0 0 0.1"),
    joint("e", "fixed", "four", "tip", "", "0.1 0.2 0.3", "0.4 0.5 0.6"),
)
CHAINS = [load("ur10"), load("lwr4plus"), urdf.parse(ZOO, "zoo", "base", "tip")]


@pytest.mark.parametrize("chain", CHAINS, ids=lambda chain: chain.name)
def test_element_jacobian(chain: Chain):
    rng = np.random.default_rng(0)
    chain = chain.with_values(chain.values + rng.normal(0, 0.05, len(chain.values)))
    q = random_joints(chain, 3, rng)
    start = forward(chain, q)

    def motion(values):
        moved = forward(chain.with_values(values), q)
        turn = rotation_vector(moved[:, :3, :3] @ start[:, :3, :3].transpose(0, 2, 1))
        return np.concatenate([moved[:, :3, 3], turn], axis=1)

    assert check(motion, jacobian(chain, q), chain.values) < 1e-8


@pytest.mark.parametrize("chain", CHAINS, ids=lambda chain: chain.name)
def test_joint_jacobian_includes_followers(chain: Chain):
    q = random_joints(chain, 1, 3)[0]
    start = forward(chain, q[None])[0]

    def motion(joints):
        moved = forward(chain, joints[None])[0]
        return np.concatenate([moved[:3, 3], rotation_vector(moved[:3, :3] @ start[:3, :3].T)])

    check(motion, tip_jacobian(chain, q[None])[0], q)
    extra = np.random.default_rng(1).normal(0, 0.01, len(chain.values))  # deflections add to the values
    together = forward(chain, q[None], extra[:, None])
    np.testing.assert_allclose(together, forward(chain.with_values(chain.values + extra), q[None]), atol=1e-14)


def test_frames_move_with_their_joints_only():
    """Joint frames move with their joints only."""
    chain = CHAINS[0]
    q = random_joints(chain, 1, 5)
    moved = q.copy()
    moved[0, 3] += 0.3
    change = np.abs(joint_frames(chain, moved) - joint_frames(chain, q)).max(axis=(1, 2, 3))
    assert (change[:3] == 0).all() and (change[3:] > 1e-3).all()


def test_values_by_name():
    chain = CHAINS[0]
    assert chain.with_values({"d3": -0.6}).values[chain.names.index("d3")] == -0.6
    with pytest.raises(RobotError, match="has no element 'd33'"):
        chain.with_values({"d33": 1.0})


def test_the_harness_finds_wrong_derivatives():
    x = np.array([0.3, -1.2])
    check(lambda x: np.sin(x[0]) * x[1], lambda x: np.array([np.cos(x[0]) * x[1], np.sin(x[0])]), x)
    with pytest.raises(AssertionError, match=r"derivative wrong at index \(1,\)"):
        check(lambda x: np.sin(x[0]) * x[1], np.array([np.cos(0.3) * -1.2, np.sin(0.3) + 1e-5]), x)
    with pytest.raises(AssertionError, match="shape"):
        check(lambda x: x, np.eye(3), x)
