"""Where the arm of a URDF ends: at tool0 or the flange, jaws left out, two arms offered; on public arms, too."""

import csv
import re
from xml.etree import ElementTree as ET

import pytest
from recordings import DATA
from robot_oracle import axis, joint, robot

from calib.errors import RobotError
from calib.robot.formats import urdf
from calib.robot.formats.arm_ends import ArmEnds
from calib.robot.formats.urdf_tree import read as read_tree

Z = axis("0 0 1")
WRIST = [joint(f"joint_{k}", "revolute", f"link_{k - 1}", f"link_{k}", Z) for k in range(1, 7)]


def fixed(name: str, on: str = "link_6") -> str:
    return joint(f"{name}_fixed", "fixed", on, name)


def moving(name: str, on: str, link: str = "", kind: str = "revolute") -> str:
    return joint(name, kind, on, link or f"{name}_link", Z)


def ends(*more: str, names: list[str] | None = None, base: str | None = None) -> ArmEnds:
    return urdf.ends(read_tree(robot(*WRIST, *more), "arm"), base, None, names)


@pytest.mark.parametrize(
    "more, tip, why",
    [
        ([], "link_6", "the last link"),
        ([fixed("flange"), fixed("tool0")], "tool0", "REP 199"),
        ([fixed("tool0"), fixed("flange")], "tool0", "REP 199"),
        ([fixed("flange"), fixed("tool0", "flange"), fixed("camera")], "tool0", "REP 199"),
        ([fixed("flange"), fixed("camera"), fixed("probe")], "flange", "REP 199"),
        ([fixed("left_flange"), fixed("left_tool0", "left_flange"), fixed("ft_frame")], "left_tool0", "REP 199"),
        ([fixed("tool0"), fixed("gripper_base", "tool0"), moving("left_jaw", "gripper_base")], "tool0", "REP 199"),
        ([fixed("tool0"), fixed("tool0_controller")], "tool0", "REP 199"),
        ([fixed("link_ee"), fixed("camera_link", "link_ee")], "link_ee", "end-effector"),
        ([fixed("probe"), fixed("camera")], "probe", "no gripper or sensor"),
        ([fixed("hand"), moving("finger_1", "hand"), moving("finger_2", "hand")], "link_6", "no gripper"),
        ([fixed("a"), fixed("b"), fixed("c")], "link_6", "a, b, c are attached to it; choose one"),
        ([joint("t", "fixed", "link_2", "tool0")], "link_6", "the last link"),
    ],
)
def test_the_tip_is_the_flange(more, tip, why):
    found = ends(*more)
    assert (found.base, found.tip) == ("link_0", tip) and why in found.reason


def test_tool0_on_second_link_is_not_taken():
    """A tool0 on the second link is named and not taken."""
    found = ends(joint("t", "fixed", "link_2", "tool0"))
    assert found.unused == ("tool0 is not taken as the end: 4 axes follow it",)
    assert (
        urdf.ends(read_tree(robot(*WRIST, joint("t", "fixed", "link_2", "tool0")), "arm"), tip="tool0").tip == "tool0"
    )


FINGERS = [
    moving(f"{part}_{k}", "link_6" if part == "proximal" else f"proximal_{k}_link")
    for k in range(3)
    for part in ("proximal", "distal")
]
SCREWED = [moving("left", "link_6", kind="prismatic"), moving("right", "link_6", kind="prismatic")]


@pytest.mark.parametrize(
    "more, unused",
    [
        ([moving("gripper", "link_6", "jaw")], "gripper"),
        ([moving("drive", "link_6", "moving_jaw")], "drive"),
        (FINGERS, "finger of a hand"),
        (SCREWED, "left, right (finger of a hand)"),
        ([fixed("tool0"), moving("spindle", "tool0")], "spindle (behind tool0)"),
        (
            [moving("a", "link_6"), joint("b", "revolute", "link_6", "other", Z + '<mimic joint="a"/>')],
            "drives a gripper",
        ),
    ],
)
def test_jaws_are_no_axes_of_the_arm(more, unused):
    source = robot(*WRIST, *more)
    chain = urdf.parse(source)
    assert chain.joint_names == tuple(f"joint_{k}" for k in range(1, 7))
    assert unused in chain.ends and "not an axis of the arm" in chain.ends


@pytest.mark.parametrize(
    "more, last",
    [
        ([moving("joint_7", "link_6")], "joint_7"),
        ([fixed("flange"), moving("joint_7", "flange")], "joint_7"),
        ([moving("gripper_rotation", "link_6")], "gripper_rotation"),
        ([moving("quill", "link_6", kind="prismatic")], "quill"),
        ([moving("camera_pan", "link_1"), moving("joint_7", "link_6")], "joint_7"),
        ([moving("joint_7", "link_6"), moving("cover", "link_6")], "joint_7"),
        ([moving("last", "link_6"), fixed("tool0", "last_link"), moving("cover", "link_6")], "last"),
    ],
)
def test_axes_that_look_like_a_tool_stay(more, last):
    assert urdf.parse(robot(*WRIST, *more)).joint_names[-1] == last


def test_gripper_and_gripper_arm_are_arms():
    """A gripper alone, and an arm with gripper in all names, are arms."""
    alone = robot(moving("left_finger", "palm", "l", "prismatic"), fixed("pad", "l"))
    assert urdf.parse(alone).joint_names == ("left_finger",)
    named = robot(*(joint(f"gripper_arm_{k}", "revolute", f"g{k - 1}", f"g{k}", Z) for k in range(1, 5)))
    assert urdf.parse(named).n == 4


def pair(left: int, right: int, *more: str) -> str:
    torso = joint("lift", "prismatic", "world", "torso", Z)
    arms = [
        joint(f"{side}_{k}", "revolute", f"{side}_l{k - 1}" if k > 1 else "torso", f"{side}_l{k}", Z)
        for side, count in (("left", left), ("right", right))
        for k in range(1, count + 1)
    ]
    tools = [fixed(f"{side}_tool0", f"{side}_l{count}") for side, count in (("left", left), ("right", right))]
    jaws = [moving(f"{side}_finger_{k}", f"{side}_tool0") for side in ("left", "right") for k in (1, 2)]
    return robot(torso, *arms, *tools, *jaws, *more)


@pytest.mark.parametrize("right", [6, 7])
def test_two_arms_are_offered_by_flanges(right):
    """Two arms are offered by their flanges."""
    source = pair(7, right)
    with pytest.raises(RobotError, match=r"two arms: .*--tip left_tool0 or right_tool0$"):
        urdf.parse(source)
    assert urdf.parse(source, tip="right_tool0").n == right + 1
    right_names = ["lift", *(f"right_{k}" for k in range(1, right + 1))]
    assert urdf.parse(source, joint_names=right_names).tip == "right_tool0"
    with pytest.raises(RobotError, match=r"two arms: .*the table has columns of several"):
        urdf.parse(source, joint_names=[*right_names, *(f"left_{k}" for k in range(1, 8))])


def test_head_or_track_is_no_arm():
    """A head or a track beside the arm is no arm."""
    assert urdf.parse(pair(7, 2)).tip == "left_tool0"


def test_columns_of_jaws_are_not_used():
    found = ends(moving("gripper", "link_6", "jaw"), names=[*(f"joint_{k}" for k in range(1, 7)), "gripper"])
    assert found.tip == "link_6" and "columns not used: gripper" in found.unused
    assert ends(fixed("tool0"), names=["joint_1", "joint_2"]).tip == "link_2"


def test_wrong_limits_refuse_arm_joints_only():
    """Wrong limits refuse only the joints of the arm."""
    wrong = '<limit lower="1" upper="0" effort="1" velocity="1"/>'
    source = robot(*WRIST, joint("camera_pan", "revolute", "link_0", "pan", Z + wrong))
    chain = urdf.parse(source)
    assert chain.n == 6 and "camera_pan" in chain.remarks[0] and "not in the arm" in chain.remarks[0]
    with pytest.raises(RobotError, match="joint 'camera_pan': lower limit 1 is not below the upper 0"):
        urdf.parse(source, tip="pan")


PUBLIC = DATA / "public_arms"
ONE_JAW_COUNTED = (  # as an axis in arms.csv
    "px100", "px150", "rx150", "rx200", "vx300", "wx250", "omx_l", "so100", "so101_old_calib",
)  # fmt: skip
needs_arms = pytest.mark.skipif(not PUBLIC.is_dir(), reason=f"no public arms at {PUBLIC} (set CALIB_DATA)")


def rigid_behind(root: ET.Element, link: str) -> list[str]:
    """Return the links that hang on a link by fixed joints, read without the toolkit."""
    found = [link]
    for tag in root.iter("joint"):
        parent, child = tag.find("parent"), tag.find("child")
        if tag.get("type") == "fixed" and parent is not None and child is not None and parent.get("link") == link:
            found += rigid_behind(root, child.get("link", ""))
    return found


@pytest.mark.slow
@needs_arms
def test_public_arms_end_at_their_flanges():
    rows = list(csv.DictReader((PUBLIC / "arms.csv").open()))
    assert len(rows) == 81
    for row in rows:
        path = PUBLIC / row["file"]
        chain, root = urdf.read(path), ET.fromstring(path.read_text())
        behind = rigid_behind(root, chain.links[-1])
        for name in ("tool0", "flange"):
            marked = [link for link in behind if re.search(rf"(^|_){name}$", link)]
            if marked:
                assert chain.tip == marked[0], path.name
                break
        else:
            assert chain.tip in behind, path.name
            assert not re.search("finger|jaw|knuckle|hand_tcp", chain.tip), path.name
        jaws = [name for name in chain.joint_names if re.search("finger|gripper|jaw|drive", name)]
        assert not jaws, path.name
        jaw = path.stem.partition("__")[2] in ONE_JAW_COUNTED
        assert chain.n == int(row["joints"]) - jaw, path.name
