"""Quick calibrations recover planted frames within their σ; commands and functions say the same."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import calib
from calib.apps.registration.settings import PlacementSettings
from calib.cli import run
from calib.data.poses.measurements import PoseMeasurements, Poses
from calib.robot.chain import random_joints
from calib.robot.kinematics import forward
from calib.robot.library import load
from calib.transforms import invert, pose

ARM = load("ur5")
STATION = pose(Rotation.from_euler("xyz", [0.3, -0.2, 1.1]), [1.2, -2.0, 0.7])
TOOL = pose(Rotation.from_euler("xyz", [0.1, 0.4, -0.6]), [0.02, -0.03, 0.11])


def measured(seed: int, count: int = 12, noise: float = 1e-4) -> Poses:
    rng, q = np.random.default_rng(seed), random_joints(ARM, count, seed)
    targets = STATION @ forward(ARM, q) @ TOOL
    turns = Rotation.from_rotvec(noise * rng.normal(size=(count, 3))) * Rotation.from_matrix(targets[:, :3, :3])
    position = targets[:, :3, 3] + noise * rng.normal(size=(count, 3))
    return Poses(q, ARM.joint_names, position, turns.as_quat())


@pytest.mark.slow
def test_frames_are_recovered_within_sigma():
    """Frames are recovered within their sigma."""
    truths = {"tool": TOOL, "base": STATION, "instrument": invert(STATION)}
    scaled = {name: [] for name in truths}
    for seed in range(12):
        for one in calib.tool("ur5", measured(seed)).placed:
            truth = truths[one.name.split()[0]]
            off = np.concatenate(
                [one.pose[:3, 3] - truth[:3, 3], Rotation.from_matrix(one.pose[:3, :3] @ truth[:3, :3].T).as_rotvec()]
            )
            scaled[one.name.split()[0]].append(off / one.sigma)
    for name, found in scaled.items():
        assert 0.75 < np.sqrt(np.mean(np.square(found))) < 1.3, name


def test_positions_leave_orientation_open():
    """Positions alone leave the orientation of the tool open."""
    full = measured(1)
    (tool, *_) = calib.base("ur5", PoseMeasurements.of(full.q, full.position, joint_names=full.joint_names)).placed
    assert np.isnan(tool.sigma[3:]).all() and str(tool).endswith("orientation not identifiable")
    np.testing.assert_allclose(tool.pose[:3, 3], TOOL[:3, 3], atol=5e-4)


@pytest.mark.parametrize(("limit", "level"), [(1.0, "pass"), pytest.param(0.01, "fail", marks=pytest.mark.slow)])
def test_command_says_what_function_says(tmp_path, capsys, limit, level):
    """The command says what the function says."""
    full, path = measured(2), tmp_path / "m.csv"
    header = ",".join([*(f"q{k}" for k in range(1, 7)), "x", "y", "z", "qx", "qy", "qz", "qw"])
    np.savetxt(path, np.hstack([full.q, full.position, full.quaternion]), delimiter=",", header=header, comments="")
    assert run(["tool", "ur5", str(path), "--tolerance", str(limit)]) == (level == "fail")
    found = calib.tool("ur5", path, PlacementSettings(tolerance=1e-3 * limit))
    assert found.verdict == level and capsys.readouterr().out.splitlines()[1] == str(found.placed[0])
