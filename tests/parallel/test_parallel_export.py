"""Exported parallel robots: other programs close the loops of the files and find our accelerations."""

import json
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

from calib import cli
from calib.dynamics.pseudo_inertia import ball
from calib.errors import UsageError
from calib.parallel.export import OpenedRobot, export_parallel
from calib.parallel.mechanism import parallel_robot
from calib.parallel.mechanism.parallel_model import along, make_parallel_model
from calib.parallel.mechanism.velocities import distributed
from calib.parallel.robots import find
from calib.procedure.export.identified import Drives

NAMES = ("dualv", "fivebar", "stewart")


def opened(name: str) -> OpenedRobot:
    """Return a robot with bodies that can exist, viscous friction and motor inertia left out."""
    model = make_parallel_model(find(name).mechanism, ("",))
    rng = np.random.default_rng(0)
    bodies = np.array([ball(m, 0.1, c) for m, c in zip(rng.uniform(1, 2, 40), rng.uniform(-0.1, 0.1, (40, 3)))])
    n = int(model.mechanism.robot.starts[-1])
    drives = Drives(np.zeros((n, 4)), (), np.zeros((0, 4)))
    return OpenedRobot(model, bodies[: len(model.labels)].ravel(), drives)


def moved(robot: OpenedRobot, t: np.ndarray):
    """Return a motion from rest at home and the actuators' torques that it needs."""
    own, f = robot.mechanism.robot, 2.0 * np.pi * (1 + np.arange(robot.mechanism.robot.r) % 2)
    wave = f * t[:, None]
    size = 0.15 * own.upper
    motion = along(robot.mechanism, size * (1 - np.cos(wave)), size * f * np.sin(wave), size * f**2 * np.cos(wave))
    return motion, distributed(robot.mechanism, motion.jacobians, robot.model.platform_force(robot.values, motion, ()))


@pytest.mark.parametrize("name", NAMES)
def test_pinocchio_accelerates_urdf_alike(name):
    """Contact dynamics of the URDF's tree with the pairs of ``robot.yaml`` as constraints give the motion's q̈."""
    robot = opened(name)
    motion, tau = moved(robot, np.array([0.1, 0.3]))
    model = pin.buildModelFromXML(robot.urdf())
    model.gravity = pin.Motion(np.array(robot.mechanism.robot.gravity), np.zeros(3))
    table = dict(line.split(": ", 1) for line in robot.closures().splitlines() if ": [" in line)
    contacts = pin.StdVec_RigidConstraintModel()
    for (end, held), kind in zip(json.loads(table["closed_loop"]), json.loads(table["type"])):
        a, b = (model.frames[model.getFrameId(one)] for one in (end, held))
        kind = pin.ContactType.CONTACT_6D if kind == "6d" else pin.ContactType.CONTACT_3D
        contacts.append(pin.RigidConstraintModel(kind, model, a.parentJoint, a.placement, b.parentJoint, b.placement))
    data, home = model.createData(), np.linalg.inv(robot.mechanism.robot.home)
    joints = [model.joints[model.getJointId(one.name)] for one in robot.joints]
    motors = [model.joints[model.getJointId(one)].idx_v for one in json.loads(table["name_mot"])]
    for m in range(2):
        q, v, forces = pin.neutral(model), np.zeros(model.nv), np.zeros(model.nv)
        for joint, value, speed in zip(joints, motion.posture.q[m], motion.v[m]):
            q[joint.idx_q : joint.idx_q + joint.nq] = [value] if joint.nq == 1 else [np.cos(value), np.sin(value)]
            v[joint.idx_v] = speed
        if name == "stewart":
            pose = motion.posture.pose[m]
            q[-7:] = pin.SE3ToXYZQUAT(pin.SE3(home @ pose))
            v[-6:] = np.kron(np.eye(2), pose[:3, :3].T) @ motion.twist[m]
        forces[motors] = tau[m]
        datas = pin.StdVec_RigidConstraintData()
        datas.extend([one.createData() for one in contacts])
        pin.initConstraintDynamics(model, data, contacts, datas)
        settings = pin.ProximalSettings(1e-14, 1e-10, 1000)
        found = pin.constraintDynamics(model, data, q, v, forces, contacts, datas, settings)
        np.testing.assert_allclose(
            found[[joint.idx_v for joint in joints]], motion.a[m], atol=1e-6 * np.abs(motion.a).max()
        )


def played(mujoco, robot: OpenedRobot, step: float) -> tuple[float, float, float]:
    """Return how far MuJoCo's loops are open before and after 0.3 s of our torques, and the last position's error.

    `step` is that of integration, s; the error is the largest of the joints, rad or m.
    """
    motion, tau = moved(robot, step * np.arange(round(0.3 / step) + 1))
    text = robot.mjcf().replace('"0.002 1"', f'"{2 * step} 1"').replace('"0.001"', f'"{step}"')
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_forward(model, data)
    start = np.abs(data.efc_pos).max()
    for torques in tau[:-1]:
        data.ctrl[:] = torques
        mujoco.mj_step(model, data)
    positions = np.array([data.joint(joint.name).qpos[0] for joint in robot.joints])
    return start, np.abs(data.efc_pos).max(), np.abs(positions - motion.posture.q[-1]).max()


@pytest.mark.parametrize(
    "name", ["fivebar", *(pytest.param(name, marks=pytest.mark.slow) for name in ("dualv", "stewart"))]
)
def test_mujoco_moves_as_planned(name):
    """Played from home without control, the torques of a motion lead to it with an error in proportion to the step."""
    mujoco = pytest.importorskip("mujoco")
    errors = []
    for step in (1e-3, 1e-4):
        start, end, error = played(mujoco, opened(name), step)
        # the loops are closed and stay so
        assert start < 1e-9 and end < 1e-4
        errors.append(error)
    assert errors[1] < 0.15 * errors[0] and errors[1] < 1e-3


def test_masses_and_result_folder_are_needed(tmp_path, capsys):
    """Masses are needed, and the folder of a result."""
    robot = find("fivebar")
    assert cli.run(["export", "fivebar", "--into", str(tmp_path / "a")]) == 2
    assert "give the folder of a fit or of an identification" in capsys.readouterr().err
    (tmp_path / "estimate.csv").write_text("name,unit,value,sigma\n")
    chain = robot.chain

    parallel_robot.write(tmp_path / "robot.toml", replace(chain, platform=None))
    with pytest.raises(UsageError, match="has no inertias"):
        export_parallel(find(str(tmp_path)), tmp_path, tmp_path / "b")
    assert not (tmp_path / "b").exists()
