"""URDF files converted to a `Chain`.

A joint origin is a fixed placement followed by six elementary motions of the joint frame, zero at first; the one about
(revolute) or along (prismatic) the joint axis stands last and moves with q:

    <joint>.x .y .z .rx .ry .rz, with the moving one called <joint>.offset

So the roll-pitch-yaw angles are never differentiated (at pitch 90° a direction vanishes). Where the axis is none of
±x ±y ±z, the elements stand in a frame turned so that its z is the axis; the turn is undone behind the joint, so that
the links' frames are the URDF's. Fixed joints are folded in; what follows the last moving joint becomes the tail.

The inertia of a moving body includes every link fixed to it, on the way to the tip and off it; bodies behind other
actuated joints (a gripper's fingers) are not included.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from calib.errors import refuse_robot, suggestion
from calib.robot.chain import AXES, Chain, Element
from calib.robot.formats import arm_ends
from calib.robot.formats.arm_ends import ArmEnds
from calib.robot.formats.urdf_tree import JointTag, Mimic, UrdfTree, text, transform_body
from calib.robot.formats.urdf_tree import read as read_tree
from calib.transforms import invert, pose

_IDENTITY = np.eye(4)
_SUFFIX = {"tx": "x", "ty": "y", "tz": "z", "rx": "rx", "ry": "ry", "rz": "rz"}


def read(
    path: str | Path, base: str | None = None, tip: str | None = None, joint_names: Sequence[str] | None = None
) -> Chain:
    """Return the chain from `base` to `tip` in a URDF file.

    Args:
        path: the file.
        base: name of the base link; None: the root.
        tip: name of the tip link; None: chosen by `calib.robot.formats.arm_ends`.
        joint_names: joints named in a measurement file; a chain with other joints is refused. None: no such check.

    Raises:
        RobotError: an invalid URDF, an ambiguous chain, or one that is not a serial arm.
    """
    return parse(text(path)[0], str(path), base, tip, joint_names)


def parse(
    source: str,
    where: str = "URDF",
    base: str | None = None,
    tip: str | None = None,
    joint_names: Sequence[str] | None = None,
) -> Chain:
    """Return the chain from `base` to `tip` in a URDF text.

    The exceptions are those of `read`.

    Args:
        source: text of the URDF.
        where: name of the text in messages.
        base, tip, joint_names: as in `read`.
    """
    tree = read_tree(source, where)
    return build(tree, ends(tree, base, tip, joint_names))


def ends(
    tree: UrdfTree, base: str | None = None, tip: str | None = None, joint_names: Sequence[str] | None = None
) -> ArmEnds:
    """Return the base and tip links of the chain.

    By default, the base is the root, and the tip is chosen from the tree (`calib.robot.formats.arm_ends`).

    Args:
        tree: the URDF.
        base: name of the base link; None: the root.
        tip: name of the tip link; None: chosen.
        joint_names: joints with columns in a table; the arm ends with the last of them. None: all joints count.

    Raises:
        RobotError: the choice is ambiguous; the message lists the candidates.
    """
    if base is None:
        if len(tree.roots) > 1:
            refuse_robot(tree.where, f"several roots: {', '.join(tree.roots)}; choose one as base (--base)")
        base = tree.roots[0]
    tree.link(base, "base")
    if tip is None:
        chosen = arm_ends.choose(tree, base, joint_names)
    else:
        chosen = ArmEnds(base, tree.link(tip, "tip"), "as stated")
    _check_path(tree, tree.path(base, chosen.tip), base, chosen.tip, joint_names)
    return chosen


def build(tree: UrdfTree, between: ArmEnds) -> Chain:
    """Return the chain between two links of a checked URDF tree.

    Args:
        tree: the URDF.
        between: base and tip of the chain.
    """
    path = tree.path(between.base, between.tip)
    actuated = [joint for joint in path if joint.actuated]
    index = {joint.name: j for j, joint in enumerate(actuated)}
    elements: list[Element] = []
    # Transform since the last moving element, and number of actuated joints passed.
    pending = _IDENTITY
    passed = 0
    for joint in path:
        pending = pending @ joint.origin
        if not joint.moves:
            continue
        leader, ratio, offset = drive(tree, joint)
        turn = align(joint.axis)
        elements += _elements(joint, pending @ turn, passed, index[leader], ratio, offset)
        passed += joint.actuated
        pending = turn.T
    return Chain(
        name=tree.name,
        joints=tuple(joint.as_joint() for joint in actuated),
        elements=tuple(elements),
        base=between.base,
        tip=between.tip,
        tail=pending,
        inertias=_inertias(tree, path),
        links=tuple(joint.child for joint in actuated),
        remarks=(*tree.remarks, *_unused_faults(tree, path)),
        ends=between.words,
    )


def _unused_faults(tree: UrdfTree, path: list[JointTag]) -> list[str]:
    """Return remarks on joints outside the chain `path` that have invalid limits.

    Args:
        tree: the URDF.
        path: joints of the chain.
    """
    path_joints = {joint.name for joint in path}
    result = []
    for joint in tree.joints.values():
        if joint.fault and joint.name not in path_joints:
            remark = f"{joint.fault} (this joint is not in the arm)"
            result.append(remark)
    return result


def align(axis: np.ndarray) -> np.ndarray:
    """Return the rotation (4, 4) that maps the z axis to a unit axis (3,); the identity for ±x ±y ±z.

    The columns x and y are any two that complete the frame (our choice: from the coordinate axis farthest from z).
    """
    if np.count_nonzero(axis) == 1:
        return _IDENTITY
    x = np.cross(np.eye(3)[np.argmin(np.abs(axis))], axis)
    x /= np.linalg.norm(x)
    return pose(np.stack([x, np.cross(axis, x), axis], axis=1))


def _elements(
    joint: JointTag, placement: np.ndarray, owner: int, mover: int, ratio: float, offset: float
) -> list[Element]:
    """Return the six elements of a joint: translations, rotations, and the moving one last.

    Args:
        joint: the joint.
        placement: (4, 4) fixed transform before the elements.
        owner: index of the joint whose frame the elements place.
        mover: index of the joint that moves the last element.
        ratio, offset: multiplier and offset of a mimic joint; 1 and 0 for other joints.
    """
    # An oblique axis is z of the frame that `align` turned.
    direction, sign = 2, 1.0
    if np.count_nonzero(joint.axis) == 1:
        direction = int(np.argmax(np.abs(joint.axis)))
        sign = -1.0 if joint.axis[direction] < 0 else 1.0
    motion = "t" if joint.kind == "prismatic" else "r"
    moving_axis = motion + "xyz"[direction]
    constant_axes = [axis for axis in AXES if axis != moving_axis]
    elements = [Element(f"{joint.name}.{_SUFFIX[axis]}", axis, 0.0, owner) for axis in constant_axes]
    if not np.array_equal(placement, _IDENTITY):
        elements[0] = replace(elements[0], placement=placement)
    elements.append(Element(f"{joint.name}.offset", moving_axis, offset, owner, mover, ratio, sign))
    return elements


def drive(tree: UrdfTree, joint: JointTag) -> tuple[str, float, float]:
    """Return the name of the actuated joint that moves `joint`, and ratio and offset of this motion.

    Chains of mimic joints are followed.

    Args:
        tree: the URDF.
        joint: a moving joint; an independent one moves itself, with ratio 1 and offset 0.
    """
    ratio, offset, name = 1.0, 0.0, joint.name
    where = f"{tree.where}, line {joint.node.line}, joint '{joint.name}'"
    passed = {name}
    mimic: Mimic | None = joint.mimic
    while mimic is not None:
        offset += ratio * mimic.offset
        ratio *= mimic.multiplier
        name = mimic.leader
        if name in passed:
            refuse_robot(where, "its <mimic> leads back to itself")
        if name not in tree.joints:
            refuse_robot(where, f"it mimics '{name}', which is not a joint{suggestion(name, tree.joints)}")
        passed.add(name)
        mimic = tree.joints[name].mimic
    return name, ratio, offset


def _check_path(tree: UrdfTree, path: list[JointTag], base: str, tip: str, joint_names: Sequence[str] | None) -> None:
    """Raise RobotError for a path that is not a serial arm, or whose joints differ from the measured ones.

    Args:
        tree: the URDF.
        path: joints from base to tip.
        base, tip: names of the two links, for messages.
        joint_names: joints named in a measurement file; None: no comparison.
    """
    actuated = [joint.name for joint in path if joint.actuated]
    if not actuated:
        refuse_robot(tree.where, f"no actuated joint between '{base}' and '{tip}'; choose another base or tip")
    passed: set[str] = set()
    for joint in path:
        where = f"{tree.where}, line {joint.node.line}, joint '{joint.name}'"
        if joint.kind in ("floating", "planar"):
            refuse_robot(where, f"type '{joint.kind}' cannot be part of an arm; choose a base after it (--base)")
        passed.add(joint.name)
        if not joint.moves or joint.actuated:
            continue
        leader, ratio, _ = drive(tree, joint)
        if leader not in passed:
            side = "comes after it" if leader in actuated else f"is not between '{base}' and '{tip}'"
            refuse_robot(where, f"the joint it mimics, '{leader}', {side}; choose another base or tip")
        if ratio == 0.0 or tree.joints[leader].kind == "fixed":
            refuse_robot(where, f"it mimics '{leader}' but cannot move; change its type to fixed")
    if not joint_names:
        return
    unmeasured = [name for name in actuated if name not in joint_names]
    if unmeasured:
        refuse_robot(
            tree.where,
            f"between '{base}' and '{tip}' some joints are not in the measurements: "
            f"{', '.join(unmeasured)}; choose base and tip (--base, --tip), or make them fixed at their value",
        )


def _inertias(tree: UrdfTree, path: list[JointTag]) -> np.ndarray | None:
    """Return standard parameters (n, 10) about the frames after the joints' moving elements; None without masses.

    None also if the body after a mimic follower has mass, since there is only one row per joint.

    Args:
        tree: the URDF.
        path: joints from base to tip.
    """
    rows = []
    for joint in path:
        if not joint.moves:
            continue
        T_element_joint = invert(align(joint.axis))
        total = np.zeros(10)
        for link, T_joint_link in tree.rigid(joint.child):
            body = tree.bodies[link]
            if body is not None:
                total = total + transform_body(body, T_element_joint @ T_joint_link)
        if joint.actuated:
            rows.append(total)
        elif total.any():
            return None
    inertias = np.array(rows)
    return inertias if inertias.any() else None
