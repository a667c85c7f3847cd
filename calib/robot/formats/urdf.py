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
from pathlib import Path

import numpy as np

from calib.errors import RobotError, refuse_robot, require, suggestion
from calib.robot.chain import AXES, Chain, Element
from calib.robot.formats.urdf_tree import JointTag, Mimic, UrdfTree, text, transform_body
from calib.robot.formats.urdf_tree import read as read_tree
from calib.transforms import invert, pose

_IDENTITY = np.eye(4)
_SUFFIX = {"tx": "x", "ty": "y", "tz": "z", "rx": "rx", "ry": "ry", "rz": "rz"}


def read(
    path: str | Path, base: str | None = None, tip: str | None = None, joint_names: Sequence[str] | None = None
) -> Chain:
    """Return the chain from `base` to `tip` of a URDF file.

    Args:
        path: the file.
        base: a link; default the root.
        tip: a link; default see `ends`.
        joint_names: the joints a measurement file names; the chain has to hold exactly these.

    Raises:
        RobotError: saying what was found, where, and what to try.
    """
    return parse(text(path)[0], str(path), base, tip, joint_names)


def parse(
    source: str,
    where: str = "URDF",
    base: str | None = None,
    tip: str | None = None,
    joint_names: Sequence[str] | None = None,
) -> Chain:
    """Return the chain from `base` to `tip` of a URDF text; `where` names it in messages."""
    tree = read_tree(source, where)
    return build(tree, *ends(tree, base, tip, joint_names))


def ends(
    tree: UrdfTree, base: str | None = None, tip: str | None = None, joint_names: Sequence[str] | None = None
) -> tuple[str, str]:
    """Return the base and tip links of the chain, by default chosen from the tree.

    The base defaults to the root. The tip defaults to the end of the chain that holds the joints named, or else of
    the one with most actuated joints, where a last joint that others mimic in another branch (a gripper's) does not
    count. Behind the
    last moving link the tip is the leaf that hangs on it by fixed joints where there is exactly one, else the link.

    Raises:
        RobotError: where the choice is not clear, listing the candidates.
    """
    if base is None:
        if len(tree.roots) > 1:
            refuse_robot(tree.where, f"several roots: {', '.join(tree.roots)}; choose one as base (--base)")
        base = tree.roots[0]
    tree.link(base, "base")
    if tip is None:
        last = _last_named(tree, base, joint_names) if joint_names else _longest(tree, base)
        leaves = [name for name, _ in tree.rigid(last) if not any(one.kind == "fixed" for one in tree.below[name])]
        tip = leaves[0] if len(leaves) == 1 else last
    path = tree.path(base, tree.link(tip, "tip"))
    _check_path(tree, path, base, tip, joint_names)
    return base, tip


def build(tree: UrdfTree, base: str, tip: str) -> Chain:
    """Return the chain between two links of a checked tree."""
    path = tree.path(base, tip)
    actuated = [joint for joint in path if joint.actuated]
    index = {joint.name: j for j, joint in enumerate(actuated)}
    elements: list[Element] = []
    pending, passed = _IDENTITY, 0
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
        base=base,
        tip=tip,
        tail=pending,
        inertias=_inertias(tree, path),
        links=tuple(joint.child for joint in actuated),
        remarks=tree.remarks,
    )


def align(axis: np.ndarray) -> np.ndarray:
    """Return the rotation (4, 4) that aligns an elementary axis with a unit axis: identity for ±x ±y ±z, else z.

    The columns x and y are any two that complete z (our choice: from the coordinate axis farthest from it).
    """
    if np.count_nonzero(axis) == 1:
        return _IDENTITY
    x = np.cross(np.eye(3)[np.argmin(np.abs(axis))], axis)
    x /= np.linalg.norm(x)
    return pose(np.stack([x, np.cross(axis, x), axis], axis=1))


def _elements(
    joint: JointTag, placement: np.ndarray, owner: int, mover: int, ratio: float, offset: float
) -> list[Element]:
    """Return the six elements of a joint: translations, rotations, the moving one last."""
    main = int(np.argmax(np.abs(joint.axis))) if np.count_nonzero(joint.axis) == 1 else 2
    sign = -1.0 if np.count_nonzero(joint.axis) == 1 and joint.axis[main] < 0 else 1.0
    moving = ("t" if joint.kind == "prismatic" else "r") + "xyz"[main]
    order = [axis for axis in AXES if axis != moving]
    first = None if np.array_equal(placement, _IDENTITY) else placement
    elements = [
        Element(f"{joint.name}.{_SUFFIX[axis]}", axis, 0.0, owner, placement=first if k == 0 else None)
        for k, axis in enumerate(order)
    ]
    return [*elements, Element(f"{joint.name}.offset", moving, offset, owner, mover, ratio, sign)]


def drive(tree: UrdfTree, joint: JointTag) -> tuple[str, float, float]:
    """Return the actuated joint that moves `joint`, the ratio and the offset, through chains of mimic joints."""
    ratio, offset, name = 1.0, 0.0, joint.name
    seen = {name}
    mimic: Mimic | None = joint.mimic
    while mimic is not None:
        offset += ratio * mimic.offset
        ratio *= mimic.multiplier
        name = mimic.leader
        if name in seen or name not in tree.joints:
            what = "a circle" if name in seen else f"'{name}', which is not a joint{suggestion(name, tree.joints)}"
            refuse_robot(f"{tree.where}, line {joint.node.line}, joint '{joint.name}'", f"it mimics {what}")
        seen.add(name)
        mimic = tree.joints[name].mimic
    return name, ratio, offset


def _check_path(tree: UrdfTree, path: list[JointTag], base: str, tip: str, joint_names: Sequence[str] | None) -> None:
    """Refuse a path that is not a serial arm, or whose joints differ from the measured ones."""
    actuated = [joint.name for joint in path if joint.actuated]
    if not actuated:
        refuse_robot(tree.where, f"no actuated joint between '{base}' and '{tip}'; choose another base or tip")
    passed: set[str] = set()
    for joint in path:
        place = f"{tree.where}, line {joint.node.line}, joint '{joint.name}'"
        if joint.kind in ("floating", "planar"):
            refuse_robot(place, f"type '{joint.kind}' cannot be part of an arm; choose a base after it (--base)")
        passed.add(joint.name)
        if not joint.moves or joint.actuated:
            continue
        leader, ratio, _ = drive(tree, joint)
        if leader not in passed:
            side = "comes after it" if leader in actuated else f"is not between '{base}' and '{tip}'"
            refuse_robot(place, f"the joint it mimics, '{leader}', {side}; choose another base or tip")
        if ratio == 0.0 or tree.joints[leader].kind == "fixed":
            refuse_robot(place, f"it mimics '{leader}' but cannot move; change its type to fixed")
    if joint_names and (extra := [name for name in actuated if name not in joint_names]):
        refuse_robot(
            tree.where,
            f"between '{base}' and '{tip}' some joints are not in the measurements: "
            f"{', '.join(extra)}; choose base and tip (--base, --tip), or make them fixed at their value",
        )
    if joint_names and (absent := [name for name in joint_names if name not in actuated]):
        there = f"{suggestion(absent[0], actuated)} (found there: {', '.join(actuated)})"
        refuse_robot(tree.where, f"joint '{absent[0]}' is not between '{base}' and '{tip}'{there}")


def _longest(tree: UrdfTree, base: str) -> str:
    """Return the last moving link of the chain with the most actuated joints."""
    if not any(joint.actuated for joint in tree.joints.values()):
        refuse_robot(tree.where, "no actuated joint (revolute, continuous or prismatic) found")
    grippers = _gripper_joints(tree)
    best: dict[str, int] = {}
    todo = [(base, base, 0)]
    while todo:
        link, last, count = todo.pop(0)
        best[last] = count
        todo += [
            (joint.child, joint.child if joint.moves else last, count + joint.actuated)
            for joint in tree.below[link]
            if joint.name not in grippers
        ]
    most = max(best.values())
    require(most != 0, f"{tree.where}: no actuated joint follows '{base}'; choose another base (--base)", RobotError)
    found = [link for link, count in best.items() if count == most]
    found = [link for link in found if not any(_hangs(tree, other, link) for other in found if other != link)]
    if len(found) > 1:
        refuse_robot(
            tree.where,
            f"several chains with {most} actuated joints, to the links {', '.join(found)}; "
            f"choose one as tip (--tip), or a base (--base)",
        )
    return found[0]


def _gripper_joints(tree: UrdfTree) -> set[str]:
    """Return mimic joints whose leader is in another branch, and leaders that no actuated joint follows."""
    found: set[str] = set()
    for joint in tree.joints.values():
        leader = tree.joints.get(joint.mimic.leader) if joint.mimic else None
        if leader is None or _hangs(tree, joint.child, leader.child) or _hangs(tree, leader.child, joint.child):
            continue
        found.add(joint.name)
        if not any(other.actuated and _hangs(tree, other.child, leader.child) for other in tree.joints.values()):
            found.add(leader.name)
    return found


def _hangs(tree: UrdfTree, link: str, on: str) -> bool:
    return any(joint.parent == on for joint in tree.ancestry(link))


def _last_named(tree: UrdfTree, base: str, joint_names: Sequence[str]) -> str:
    """Return the child link of the named joint farthest from the base."""
    for name in joint_names:
        if name not in tree.joints:
            known = ", ".join(joint.name for joint in tree.joints.values() if joint.actuated)
            refuse_robot(tree.where, f"no joint '{name}'{suggestion(name, tree.joints)} (joints: {known})")
    return max((tree.joints[name].child for name in joint_names), key=lambda link: len(tree.ancestry(link)))


def _inertias(tree: UrdfTree, path: list[JointTag]) -> np.ndarray | None:
    """Return standard parameters (n, 10) about the frames after the moving elements; None without masses.

    Also None where the body behind a mimic follower has mass: it would need a row of its own.
    """
    rows, known = [], False
    for joint in path:
        if not joint.moves:
            continue
        back = invert(align(joint.axis))
        bodies = [(tree.bodies[link], placed) for link, placed in tree.rigid(joint.child)]
        total = sum((transform_body(body, back @ placed) for body, placed in bodies if body is not None), np.zeros(10))
        if joint.actuated:
            rows.append(total)
            known = known or bool(total.any())
        elif total.any():
            return None
    return np.array(rows) if known else None
