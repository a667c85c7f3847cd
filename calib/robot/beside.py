"""Links of a URDF that are not in the arm's chain, as capsules: a second arm, a torso, a gripper, a camera.

Their joints stand still, at zero or where it is stated, so that each link is fixed to one body of the arm or to its
base. A capsule runs from each link's frame to that of each link behind it; a link that nothing follows is a sphere.
Links without masses, pictures and shapes are mere frames and take no space, unless a joint outside the chain moves
them.
"""

from collections.abc import Collection, Mapping
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from calib.robot.capsules import Attached
from calib.robot.chain import Chain
from calib.robot.formats.urdf import align
from calib.robot.formats.urdf_tree import JointTag, UrdfTree, is_urdf, parse, read, text
from calib.transforms import invert, pose


def links_beside(
    source: str, where: str, chain: Chain, posture: Mapping[str, float] | None = None
) -> tuple[Attached, ...]:
    """Return the links of a URDF text beside a chain of it, as capsules.

    Args:
        source: the URDF.
        where: names it in messages.
        chain: whose base and tip are links of it.
        posture: values of joints outside the chain [rad or m] that do not stand at zero.

    Raises:
        RobotError: where its base or tip is no link of the URDF.
    """
    tree = read(source, where)
    path = tree.path(tree.link(chain.base, "base"), tree.link(chain.tip, "tip"))
    inside = {chain.base, *(joint.child for joint in path)}
    bodies = {joint.child: number for number, joint in enumerate((one for one in path if one.moves), 1)}
    taking_space = _with_space(tree, source, where, inside)
    result: list[Attached] = []
    for link in tree.bodies:
        above = tree.above.get(link)
        if link in inside or link not in taking_space:
            continue
        carrier = _carrier(tree, link, bodies)
        start = _place(tree, chain.base, above.parent if above else link, carrier, posture or {})
        end = _place(tree, chain.base, link, carrier, posture or {})
        number = bodies.get(carrier, 0)
        ends = [joint for joint in tree.below[link] if joint.child in taking_space]
        if above is not None and np.linalg.norm(end - start) > MIN_LENGTH:
            result.append(Attached(link, number, start, end))
        elif not ends:
            result.append(Attached(link, number, end, end))
    return tuple(result)


MIN_LENGTH = 1e-6  # [m] of a capsule that is no sphere


def _with_space(tree: UrdfTree, source: str, where: str, inside: set[str]) -> set[str]:
    """Return the links that take space: with a mass or a shape, moved outside the chain, or before such a link."""
    nodes = {node.attributes["name"]: node for node in parse(source, where).all("link")}
    shaped = {name for name, node in nodes.items() if node.first("visual") or node.first("collision")}
    solid = {name for name in tree.bodies if name in shaped or tree.bodies[name] is not None}
    for name in tree.bodies:
        outside = [joint for joint in tree.ancestry(name) if joint.moves and joint.child not in inside]
        if outside and _parts(tree, inside, outside[-1]):
            solid.add(name)
    return solid | {joint.parent for name in solid for joint in tree.ancestry(name)}


def _parts(tree: UrdfTree, inside: set[str], joint: JointTag) -> bool:
    """Return whether a joint does not stand between the root and the chain."""
    return not any(one.child == joint.child for link in inside for one in tree.ancestry(link))


def _carrier(tree: UrdfTree, link: str, bodies: dict[str, int]) -> str:
    """Return the last of the chain's moving links before a link; "" for what stands with the base."""
    carriers = [joint.child for joint in tree.ancestry(link) if joint.child in bodies]
    return carriers[-1] if carriers else ""


def _place(tree: UrdfTree, base: str, link: str, carrier: str, posture: Mapping[str, float]) -> np.ndarray:
    """Return the origin (3,) of a link in the frame of the chain's moving element that carries it, else in the base.

    The element's frame is turned where its axis is oblique (`calib.robot.formats.urdf`).
    """
    origin = invert(_still_pose(tree, carrier or base, posture)) @ _still_pose(tree, link, posture)
    turn = align(tree.above[carrier].axis).T if carrier else np.eye(4)
    return (turn @ origin)[:3, 3]


def _still_pose(tree: UrdfTree, link: str, posture: Mapping[str, float]) -> np.ndarray:
    """Return the pose (4, 4) of a link in its root's frame with all joints at zero but those of a posture."""
    result = np.eye(4)
    for joint in tree.ancestry(link):
        along = posture.get(joint.name, 0.0) * joint.axis
        moved = pose(position=along) if joint.kind == "prismatic" else pose(Rotation.from_rotvec(along))
        result = result @ joint.origin @ moved
    return result


def links_of(chain: Chain, source: Path | None) -> Collection[str]:
    """Return the names of a robot's links: of all in its URDF, else of the arm's capsules."""
    if source is not None and is_urdf(source):
        return read(text(source)[0], str(source)).bodies
    return (chain.base, *(chain.links or [f"{name}_link" for name in chain.joint_names]), chain.tip)
