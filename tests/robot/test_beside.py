"""Links outside the chain (second arm, torso, gripper) as obstacles of an arm of capsules."""

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from differences import check
from robot_oracle import axis, inertial, joint, robot

from calib.errors import UsageError
from calib.geometry.installation import Installation
from calib.procedure.measuring.pose_limits import read_limits
from calib.robot import calibrated, capsules
from calib.robot.beside import links_beside
from calib.robot.calibrated import CalibratedChain
from calib.robot.chain import random_joints
from calib.robot.formats import urdf

OBLIQUE = axis("1 2 -2")


def dual() -> str:
    """Return two three-axis arms on a lift, one with fingers, one of oblique axes, and a frame that is no body."""
    joints = [joint("lift", "prismatic", "world", "torso", axis("0 0 1"), "0 0 1")]
    for side, y in (("left", 0.3), ("right", -0.3)):
        joints += [
            joint(f"{side}_1", "revolute", "torso", f"{side}_a", axis("0 0 1"), f"0 {y} 0.1", "0.1 0.2 0.3"),
            joint(f"{side}_2", "revolute", f"{side}_a", f"{side}_b", OBLIQUE, "0.1 0 0.3"),
            joint(f"{side}_3", "revolute", f"{side}_b", f"{side}_c", axis("0 1 0"), "0 0.05 0.4"),
            joint(f"{side}_hand", "fixed", f"{side}_c", f"{side}_tool0", "", "0 0 0.2"),
            joint(f"{side}_finger", "prismatic", f"{side}_tool0", f"{side}_jaw", axis("0 1 0"), "0 0.05 0.1"),
        ]
    joints.append(joint("mark", "fixed", "right_b", "only_a_frame", "", "5 5 5"))
    return robot(*joints, bodies={"left_a": inertial(1.0, "0 0 0.1")})


def arm(source: str) -> tuple[urdf.Chain, capsules.Capsules]:
    chain = urdf.parse(source, tip="right_tool0")
    beside = links_beside(source, "dual", chain)
    return chain, capsules.from_chain(chain, 0.03, -0.5, targets=[(0.0, 0.02, 0.1)], beside=beside)


def test_links_beside_agree_with_pinocchio():
    """Links beside stand where Pinocchio puts them."""
    source = dual()
    chain, found = arm(source)
    names = {one.name for one in found.beside}
    assert names == {"left_a", "left_b", "left_c", "left_tool0", "left_jaw", "right_jaw"}
    q = random_joints(chain, 10, 1)
    lines = found.lines_at(q)
    model = pin.buildModelFromXML(source)
    data = model.createData()
    base = model.getFrameId("world", pin.FrameType.BODY)
    for m, row in enumerate(q):
        configuration = pin.neutral(model)
        for name, value in zip(chain.joint_names, row, strict=True):
            configuration[model.joints[model.getJointId(name)].idx_q] = value
        pin.framesForwardKinematics(model, data, configuration)
        for one in found.beside:
            place = data.oMf[base].actInv(data.oMf[model.getFrameId(one.name, pin.FrameType.BODY)]).translation
            assert np.abs(lines.end[m, found.names.index(one.name)] - place).max() < 1e-12


def test_links_beside_are_kept_away_from():
    """The arm keeps away from links beside it, with exact gradients and in the compiled test."""
    chain, found = arm(dual())
    assert ("left_c", "right_c") in found.pairs and ("right_jaw", "floor") in found.pairs
    assert not any(set(pair) == {"left_a", "left_b"} for pair in found.pairs)
    q = random_joints(chain, 400, 2)
    distances = found.distances(q)
    margin = float(np.median(distances.min(axis=1)))
    assert np.array_equal(found.free(q, margin), (distances > margin).all(axis=1))
    for row in q[distances.min(axis=1) > 0.01][:3]:
        check(lambda x: found.distances(x[None])[0], found.gradients(row[None])[0], row, tolerance=1e-5)


def test_limits_name_what_stands_beside(tmp_path):
    """Limits say what stands beside the arm."""
    path = tmp_path / "dual.urdf"
    path.write_text(dual())
    chain = urdf.read(path, tip="right_tool0")
    said = read_limits(None, Installation(chain), path)
    assert any("at zero of their joints: left_a, left_b" in words for words in said.checked)
    folder = tmp_path / "fit"
    folder.mkdir()
    calibrated.write(folder, CalibratedChain(chain, nominal=chain, source=str(path)))
    again = read_limits(None, Installation(chain), folder / "robot.toml")
    assert again.checked == said.checked
    path.unlink()
    without = read_limits(None, Installation(chain), folder / "robot.toml")
    assert any("links outside the arm (the URDF is not at hand)" in words for words in without.unchecked)
    assert not any("left_a" in words for words in without.checked)


def test_links_beside_need_shapes(tmp_path):
    """Links beside without shapes are named where shapes are used."""
    sphere = '<collision><geometry><sphere radius="0.02"/></geometry></collision>'
    shaped = dual().replace('<link name="right_c"></link>', f'<link name="right_c">{sphere}</link>')
    path = Path(tmp_path / "shaped.urdf")
    path.write_text(shaped)
    chain = urdf.read(path, tip="right_tool0")
    said = read_limits(None, Installation(chain), path)
    assert any("left_a" in words and "without collision shapes" in words for words in said.unchecked)


def test_always_touching_pairs_are_named():
    """Axes that meet: the links around a link without length have a point in common."""
    source = robot(
        joint("a", "revolute", "base", "one", axis("0 0 1"), "0 0 0.4"),
        joint("b", "revolute", "one", "two", axis("0 1 0")),
        joint("c", "revolute", "two", "three", axis("0 1 0"), "0 0 0.4"),
        joint("d", "fixed", "three", "tool0", "", "0 0 0.3"),
    )
    said = read_limits(None, Installation(urdf.parse(source)))
    assert any(words.startswith("collision of base with two (their shapes touch") for words in said.unchecked)


def test_pillar_makes_arm_no_thicker():
    """An arm on a pillar is no thicker for it."""

    def radius(height: float) -> float:
        shoulder = joint("a", "revolute", "base", "one", axis("0 1 0"), f"0 0 {height}")
        elbow = joint("b", "revolute", "one", "two", axis("0 1 0"), "1 0 0")
        return capsules.usual_radius(
            urdf.parse(robot(shoulder, elbow, joint("c", "fixed", "two", "tool0", "", "1 0 0")))
        )

    assert radius(0.2) == 0.11 and radius(1.0) == radius(4.0) == 0.15


def test_posture_places_links_beside(tmp_path):
    """A stated posture places the links beside the arm by capsules and by shapes."""
    sphere = '<collision><geometry><sphere radius="0.02"/></geometry></collision>'
    path, stated = tmp_path / "dual.urdf", {"collision": {"posture": {"left_2": "40 deg", "left_finger": "20 mm"}}}
    values = {"left_2": np.radians(40.0), "left_finger": 0.02}
    for link, source in (("left_jaw", dual()), ("left_jaw", dual().replace('jaw"></link>', f'jaw">{sphere}</link>'))):
        path.write_text(source)
        chain = urdf.read(path, tip="right_tool0")
        limits = read_limits(stated, Installation(chain), path)
        assert any("at the stated posture" in words for words in limits.checked)
        model = pin.buildModelFromXML(source)
        data, still = model.createData(), pin.neutral(model)
        for name, value in values.items():
            still[model.joints[model.getJointId(name)].idx_q] = value
        pin.framesForwardKinematics(model, data, still)
        ends = [data.oMf[model.getFrameId(f"{side}_jaw", pin.FrameType.BODY)].translation for side in ("left", "right")]
        found = limits.collision
        assert found is not None
        column = [set(pair) for pair in found.pairs].index({"left_jaw", "right_jaw"})
        distance = found.distances(np.zeros((1, chain.n)))[0, column]
        if source == dual():
            lines = found.lines_at(np.zeros((1, chain.n)))
            assert np.abs(lines.end[0, found.names.index(link)] - ends[0]).max() < 1e-12
        else:
            assert abs(distance - (np.linalg.norm(ends[0] - ends[1]) - 0.04)) < 1e-6


@pytest.mark.parametrize(
    "posture, words",
    [({"right_2": 0.1}, "joint outside the arm 'right_2' is not one of"), ({"left_9": 0.1}, "did you mean 'left_")],
)
def test_posture_of_other_joints_is_refused(tmp_path, posture, words):
    """A posture of other joints is refused."""
    path = tmp_path / "dual.urdf"
    path.write_text(dual())
    with pytest.raises(UsageError, match=words):
        read_limits({"collision": {"posture": posture}}, Installation(urdf.read(path, tip="right_tool0")), path)
