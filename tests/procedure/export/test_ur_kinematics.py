"""UR's own descriptions, as they are, give back the kinematics that they were made from."""

import re

import numpy as np
import pytest

from calib.procedure.export.ur_kinematics import LINKS, kinematics
from calib.robot.calibrated import CalibratedChain
from calib.robot.formats.urdf import parse
from calib.robot.formats.urdf_tree import read
from calib.robot.library import load
from calib.transforms import from_xyz_rpy

JOINTS = ("shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint", "wrist_1_joint", "wrist_2_joint", "wrist_3_joint")


def origins(text: str) -> dict[str, np.ndarray]:
    """Return the joint origins (4, 4) of a kinematics file by link."""
    poses = {}
    for link, block in re.findall(r"^  (\w+):\n((?:    \w+: \S+\n){6})", text, re.MULTILINE):
        value = {key: float(number) for key, number in re.findall(r"(\w+): (\S+)", block)}
        poses[link] = from_xyz_rpy([value[k] for k in "xyz"], [value[k] for k in ("roll", "pitch", "yaw")])
    return poses


@pytest.mark.parametrize(
    "base",
    [
        None,
        pytest.param("base_link", marks=pytest.mark.slow),
        pytest.param("base_link_inertia", marks=pytest.mark.slow),
    ],
)
def test_ur_descriptions_keep_their_origins(data, base):
    """UR's own descriptions give back their origins."""
    paths = sorted((data / "public_arms").glob("[uU]niversal*.urdf"))
    if not paths:
        pytest.skip(f"no public descriptions of UR arms in {data}")
    for path in paths:
        tree = read(path.read_text(), str(path))
        prefix = next(name for name in tree.bodies if name.endswith("base_link")).removesuffix("base_link")
        chain = parse(path.read_text(), str(path), base and prefix + base, prefix + "tool0")
        text, remark = kinematics(CalibratedChain(chain, chain), path)
        assert remark == "", path.name
        for link, joint in zip(LINKS, JOINTS, strict=True):
            expected = tree.joints[prefix + joint].origin
            np.testing.assert_allclose(origins(text)[link], expected, atol=1e-9, err_msg=f"{path.name}, {link}")


@pytest.mark.parametrize("turn", [0.0, np.pi, 0.3])
def test_foreign_base_is_found_from_axes(turn):
    """The library's UR5, its base turned about z: the lengths of UR's table, whatever the turn."""
    from dataclasses import replace

    chain = load("ur5")
    first = chain.elements[0]
    placement = from_xyz_rpy([0, 0, 0], [0, 0, turn]) @ (np.eye(4) if first.placement is None else first.placement)
    turned = replace(chain, elements=(replace(first, placement=placement), *chain.elements[1:]))
    text, _ = kinematics(CalibratedChain(turned, turned))
    straight, _ = kinematics(CalibratedChain(chain, chain))
    for link in LINKS:
        np.testing.assert_allclose(origins(text)[link], origins(straight)[link], atol=1e-9)
