"""Delivered frames stand in the controller's own base and flange; where those are not known, no number is printed."""

import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from calib import cli
from calib.apps.controller_programs.delivery import delivery_text
from calib.apps.controller_programs.frames import Description, base_frame, flange_frame, stated_frame
from calib.controllers.table import controller_named, controllers
from calib.errors import UsageError
from calib.robot.formats.urdf import parse
from calib.robot.formats.urdf_tree import read
from calib.robot.kinematics import forward
from calib.transforms import from_xyz_rpy, invert, pose

NUMBER = r"(-?\d+\.\d+)"
FANUC = Path(__file__).parent / "fanuc_m20ia.urdf"
AXIS_2 = 0.525  # [m] of that arm


def arm_of(source: str) -> Description:
    tree = read(source, "test.urdf")
    return Description(parse(source, "test.urdf"), tree)


def changed(*pairs: tuple[str, str]) -> str:
    source = FANUC.read_text()
    for old, new in pairs:
        assert old in source
        source = source.replace(old, new)
    return source


BASE = '<origin xyz="0 0 0.525"/><parent link="base_link"/><child link="base"/></joint>'
WITHOUT_BASE = (('<link name="base"/>', ""), ('<joint name="base_link-base" type="fixed">' + BASE, ""))


@pytest.fixture(scope="module", params=["link", "rule"])
def fitted(request, tmp_path_factory) -> tuple[Path, np.ndarray, np.ndarray]:
    """A fit of a perfect FANUC, measured from a placement in World, with a tool in its faceplate."""
    folder = tmp_path_factory.mktemp(request.param)
    source = FANUC.read_text() if request.param == "link" else changed(*WITHOUT_BASE)
    (folder / "fanuc.urdf").write_text(source)
    arm = arm_of(source)
    tool = from_xyz_rpy([0.05, -0.02, 0.12], [0.0, 0.0, 0.0])
    workpiece = from_xyz_rpy([1.3, 0.4, -0.2], [0.1, -0.2, 0.7])
    world = from_xyz_rpy([0.0, 0.0, AXIS_2], [0.0, 0.0, 0.0])
    q = np.random.default_rng(1).uniform(-1.0, 1.0, (24, 6))
    points = (invert(world @ workpiece) @ forward(arm.chain, q) @ tool)[:, :3, 3]
    header = ",".join([*(f"q{k} [deg]" for k in range(1, 7)), "x [mm]", "y [mm]", "z [mm]"])
    rows = [",".join(f"{value:.9f}" for value in row) for row in np.hstack([np.degrees(q), 1e3 * points])]
    (folder / "seen.csv").write_text("\n".join([header, *rows, ""]))
    words = [
        "fit",
        folder / "fanuc.urdf",
        folder / "seen.csv",
        "--model",
        "frames",
        "--no-plots",
        "--out",
        folder / "f",
    ]
    assert cli.run([str(word) for word in words]) == 0
    return folder / "f", tool, workpiece


def placed(line: str) -> np.ndarray:
    """Return the frame that a FANUC's line states."""
    frame = re.search(" ".join(f"{name} {NUMBER}.*?" for name in "XYZWPR"), line + " ")
    assert frame is not None
    values = np.array(frame.groups(), float)
    return pose(from_xyz_rpy([0, 0, 0], np.radians(values[3:]))[:3, :3], 1e-3 * values[:3])


def test_fanuc_workpiece_and_tool_frames(fitted):
    """A Fanuc gets its workpiece in World and its tool in the faceplate."""
    folder, tool, workpiece = fitted
    lines = delivery_text(folder, controller_named("fanuc")).split("\n")
    at = next(k for k, line in enumerate(lines) if "UFRAME[1]" in line)
    np.testing.assert_allclose(placed(lines[at]), workpiece, atol=2e-6)
    assert "World (" in lines[at + 1] and "0.525 m above base_link" in lines[at + 1]
    at = next(k for k, line in enumerate(lines) if "UTOOL[1]" in line)
    np.testing.assert_allclose(placed(lines[at])[:3, 3], tool[:3, 3], atol=2e-6)
    assert "faceplate" in lines[at + 1] and "link tool0" in lines[at + 1]


def test_a_stated_world_counts_first(fitted, tmp_path, capsys):
    folder, _, workpiece = fitted
    shift = from_xyz_rpy([0.1, 0.0, AXIS_2 - 0.2], [0.0, 0.0, 0.0])
    words = ["deliver", str(folder), "--for", "fanuc", "--world", f"0.1,0,{AXIS_2 - 0.2}"]
    assert cli.run(words) == 0
    line = next(line for line in capsys.readouterr().out.split("\n") if "UFRAME[1]" in line)
    expected = invert(shift) @ from_xyz_rpy([0.0, 0.0, AXIS_2], [0.0, 0.0, 0.0]) @ workpiece
    np.testing.assert_allclose(placed(line), expected, atol=2e-6)
    for statement, said in (("1,2,3,4,5", "found 5 values"), ("0,0,525", "mm?"), ("0,0,nan", "found 3 values")):
        assert cli.run(["deliver", str(folder), "--for", "fanuc", "--world", statement]) == 2
        assert said in capsys.readouterr().err


def test_unknown_base_prints_no_number(fitted, tmp_path):
    """Where the base is not known, no number is printed."""
    folder = tmp_path / "f"
    shutil.copytree(fitted[0], folder)
    for path in (folder / "robot.toml", folder / "robot.urdf"):
        path.write_text(path.read_text().replace('"base_link"', '"foot"').replace('"base"', '"elsewhere"'))
    lines = delivery_text(folder, controller_named("fanuc")).split("\n")
    said = next(line for line in lines if "instrument" in line)
    assert "not printed" in said and "--world" in said
    assert not any("UFRAME[1]" in line for line in lines) and any("UTOOL[1]" in line for line in lines)


def test_moving_base_is_not_the_controllers():
    """A base that moves is not the controller's."""
    moving = changed(
        ('<joint name="base_link-base" type="fixed">' + BASE, ""),
        (
            '<joint name="joint_1"',
            '<joint name="slide" type="prismatic"><parent link="base_link"/><child link="base"/><axis xyz="1 0 0"/>'
            '<limit lower="0" upper="1" effort="0" velocity="1"/></joint><joint name="joint_1"',
        ),
    )
    frame = base_frame(controller_named("fanuc"), arm_of(moving))
    assert frame.pose is None and "'base' moves with joint 'slide'" in frame.basis and "--world" in frame.basis


def test_base_against_the_rule_is_warned_of():
    """A base elsewhere than the controller's rule puts it is warned of."""
    frame = base_frame(
        controller_named("fanuc"), arm_of(changed(('xyz="0 0 0.525"/><parent', 'xyz="0 0 0.1"/><parent')))
    )
    assert frame.pose is not None and frame.pose[2, 3] == pytest.approx(0.1)
    assert "0.525 m above base_link" in frame.warning


def test_lone_flange_turned_as_controllers():
    """A flange alone is turned as the controller's."""
    bare = changed(('<link name="tool0"/>', '<link name="hand"/>'), ('<child link="tool0"/>', '<child link="hand"/>'))
    whole, frame = (flange_frame(controller_named("fanuc"), arm_of(source)) for source in (FANUC.read_text(), bare))
    assert whole.pose is not None and frame.pose is not None
    tips = [forward(arm_of(source).chain, np.zeros((1, 6)))[0] for source in (FANUC.read_text(), bare)]
    np.testing.assert_allclose(tips[1] @ frame.pose, tips[0] @ whole.pose, atol=1e-12)


def test_tool_across_last_axis_is_no_flange():
    """A tool frame across the last axis is no flange."""
    crooked = changed(('rpy="3.141592653589793 -1.5707963267948966 0"', 'rpy="0 0 0"'))
    frame = flange_frame(controller_named("fanuc"), arm_of(crooked))
    assert frame.pose is None and "not along the last axis" in frame.basis and "--flange" in frame.basis


def test_controllers_say_where_frames_stand():
    """Every controller says where its frames stand, and who states it."""
    for name, controller in controllers().items():
        assert controller.base and controller.flange and controller.frames and controller.base_at, name


def test_stated_frame_needs_3_or_6_numbers():
    """A stated frame needs three or six numbers."""
    np.testing.assert_array_equal(stated_frame("1,2,3", "--world"), from_xyz_rpy([1, 2, 3], [0, 0, 0]))
    assert stated_frame(None, "--world") is None
    for words in ("1,2", "1,2,3,4", "x,y,z", "1,2,inf"):
        with pytest.raises(UsageError, match="--world"):
            stated_frame(words, "--world")


MAKERS = {"fanuc": "fanuc", "abb": "rapid", "kroshu": "krl", "kuka": "krl", "motoman": "yaskawa", "universal": "ur"}


@pytest.mark.slow
def test_rules_match_makers_descriptions(data):
    """Of all public arms with a link `base`: the controller's rule puts its base there, too."""
    folder = data / "public_arms"
    if not folder.is_dir():
        pytest.skip(f"no public descriptions in {folder}")
    judged = dict.fromkeys(MAKERS.values(), 0)
    for path in sorted(folder.glob("*.urdf")):
        maker = next((MAKERS[name] for name in MAKERS if path.name.lower().startswith(name)), None)
        tree = read(path.read_text(), str(path))
        if maker is None or not {"base", "base_link"} <= set(tree.bodies):
            continue
        arm = Description(parse(path.read_text(), str(path), tip="tool0"), tree)
        controller = controller_named(maker)
        frame, flange = base_frame(controller, arm), flange_frame(controller, arm)
        if "motopos" in path.name:  # a table of two axes has no axis 2 that lies level
            continue
        assert frame.pose is not None and not frame.warning, path.name
        crooked = path.name == "abb__irb4400l_30_243.urdf"  # its tool0 has x along the last axis
        assert (flange.pose is None) == crooked, path.name
        judged[maker] += 1
    assert all(judged.values()), judged
