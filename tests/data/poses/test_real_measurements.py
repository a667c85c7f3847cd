"""Recordings that nobody here made, within the limits of their URDF."""

import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest

from calib.data.poses.fit_options import FileOptions, Sigma
from calib.data.poses.pose_files import joint_columns, read_measurements
from calib.data.schema import Joints


def load(data: Path, file: str, urdf: str, names: list[str] | None = None, options: FileOptions | None = None):
    path = data / file
    joints = {joint.get("name", ""): joint for joint in ET.parse(path.parent / urdf).getroot().iter("joint")}
    names = names or [name for name, joint in joints.items() if joint.get("type") == "revolute"]
    spans = [joints[name].find("limit") for name in names]
    limits = tuple([float(span.get(side, "nan")) for span in spans if span is not None] for side in ("lower", "upper"))
    kinds = [joints[name].get("type", "") for name in names]
    (block,) = read_measurements(path, Joints(tuple(names), kinds, *map(np.array, limits)), options)
    return block


def test_ur5_positions(data):
    block = load(data, "ur5_gts3800/grid_800.csv", "model.urdf")
    assert block.kind == "position" and block.q.shape == (800, 6)
    assert block.ignored == ("x_target", "y_target", "z_target")
    assert block.notes == ("the position is read from x_meas, y_meas, z_meas",)
    np.testing.assert_array_equal(block.position[0], [-0.428183719, -0.00275280253, -0.0994512619])


def test_ur10_poses(data):
    sigma = FileOptions(columns={f"sigma_{axis}": f"std_{axis}" for axis in "xyz"})
    block = load(data, "ur10_ipa/B_joint_configurations.csv", "model.urdf", options=sigma)
    assert block.kind == "pose" and block.q.shape == (1495, 6) and block.sigma is not None
    np.testing.assert_allclose(block.quaternion[0], [-0.405028, -0.58088, -0.4049269, 0.5784159], atol=1e-6)
    assert load(data, "ur10_ipa/A_grid_2500.csv", "model.urdf").q.shape == (2500, 6)


def test_motoman_by_names_and_options(data):
    """The Motoman's joints come by name, and its uncertainties by options."""
    joints = ["E_external", "S", "L", "U", "R", "B", "T"]
    options = FileOptions(columns={f"sigma_{axis}": f"unc_{axis}" for axis in "xyz"}, sigma=Sigma(floor=1e-6))
    block = load(data, "motoman_leica/right_wide_386.csv", "model_right.urdf", options=options)
    assert block.q.shape == (386, 7) and block.joint_names == tuple(f"q_{joint}" for joint in joints)
    assert block.ignored == ("pose_id", "unc") and block.sigma is not None and block.sigma.min() == 1e-6
    assert set(joints) <= set(joint_columns(data / "motoman_leica" / "right_wide_386.csv"))


@pytest.mark.parametrize(("file", "rows", "positions"), [("panda_2.csv", 559, 9), ("panda_3.csv", 387, 6)])
def test_mukca_sockets(data, file, rows, positions):
    names = [f"panda_joint{i}" for i in range(1, 8)]
    block = load(data, f"mukca_sockets/{file}", "panda.urdf", names, FileOptions(socket_distance=0.05))
    assert block.kind == "sockets" and len(block) == rows and not block.notes
    assert len(block.group_names) == 2 * positions and len(block.links) == positions
    assert all(block.group_names[a].split("/")[0] == block.group_names[b].split("/")[0] for a, b, _ in block.links)


def test_tiago_three_markers(data):
    names = ["torso_lift_joint", *(f"arm_{i}_joint" for i in range(1, 8))]
    block = load(data, "tiago_laas/mocap_35poses.csv", "model.urdf", names)
    assert block.kind == "position" and len(block) == 105 and len(block.tool_names) == 3
    assert block.notes == (
        "torso_lift_joint is outside its limits in 1 of 35 rows, most in row 3, by 0.00018 m; these rows are used",
    )
