"""Links of a URDF outside the arm's chain, as capsules for collision tests: a second arm, a torso, a gripper, a camera.

Joints outside the chain are fixed at zero or at a given value, so that each such link is fixed to a body of the arm or
to the arm's base. A capsule extends from each link's frame to the frame of each of its child links; a link without
children is a sphere. Links without mass, visual and collision shape are only frames and have no capsule, unless a joint
outside the chain moves them.
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

# Length [m] below which a capsule is a sphere.
MIN_LENGTH = 1e-6


def links_beside(
    source: str, where: str, chain: Chain, posture: Mapping[str, float] | None = None
) -> tuple[Attached, ...]:
    """Return the links of a URDF text that are outside a chain, as capsules.

    Args:
        source: text of the URDF.
        where: name of the URDF in messages.
        chain: the arm; its base and tip are links of the URDF.
        posture: values of joints outside the chain [rad or m]; all others are zero. None: all are zero.

    Raises:
        RobotError: the chain's base or tip is not a link of the URDF.
    """
    tree = read(source, where)
    path = tree.path(tree.link(chain.base, "base"), tree.link(chain.tip, "tip"))
    chain_links = {chain.base, *(joint.child for joint in path)}
    body_numbers: dict[str, int] = {}
    for joint in path:
        if joint.moves:
            body_numbers[joint.child] = len(body_numbers) + 1
    taking_space = _with_space(tree, source, where, chain_links)
    posture = posture or {}
    result: list[Attached] = []
    for link in tree.bodies:
        if link in chain_links or link not in taking_space:
            continue
        joint_above = tree.above.get(link)
        parent = link if joint_above is None else joint_above.parent
        carrier = _carrier(tree, link, body_numbers)
        start = _position(tree, chain.base, parent, carrier, posture)
        end = _position(tree, chain.base, link, carrier, posture)
        body = body_numbers.get(carrier, 0)
        followers = [joint for joint in tree.below[link] if joint.child in taking_space]
        if joint_above is not None and np.linalg.norm(end - start) > MIN_LENGTH:
            result.append(Attached(link, body, start, end))
        elif not followers:
            result.append(Attached(link, body, end, end))
    return tuple(result)


def _with_space(tree: UrdfTree, source: str, where: str, chain_links: set[str]) -> set[str]:
    """Return the names of the links that take space.

    These are links with a mass or a shape, links moved by joints outside the chain, and the links between them and the
    root of the URDF.

    Args:
        tree: the URDF.
        source: text of the URDF.
        where: name of the URDF in messages.
        chain_links: names of the links of the arm's chain.
    """
    solid = {link for link, body in tree.bodies.items() if body is not None}
    for node in parse(source, where).all("link"):
        if node.first("visual") or node.first("collision"):
            solid.add(node.attributes["name"])
    for link in tree.bodies:
        moving = [joint for joint in tree.ancestry(link) if joint.moves and joint.child not in chain_links]
        if moving and _is_beside(tree, chain_links, moving[-1]):
            solid.add(link)
    taking_space = set(solid)
    for link in solid:
        taking_space.update(joint.parent for joint in tree.ancestry(link))
    return taking_space


def _is_beside(tree: UrdfTree, chain_links: set[str], joint: JointTag) -> bool:
    """Return whether a joint is not on the path from the root to the chain's tip.

    Args:
        tree: the URDF.
        chain_links: names of the links of the arm's chain.
        joint: a joint of the URDF.
    """
    before_chain: set[str] = set()
    for link in chain_links:
        before_chain.update(earlier.child for earlier in tree.ancestry(link))
    return joint.child not in before_chain


def _carrier(tree: UrdfTree, link: str, bodies: dict[str, int]) -> str:
    """Return the last of the chain's moving links on the path from the root to a link; "" if there is none.

    Args:
        tree: the URDF.
        link: name of the link.
        bodies: name of each moving link of the chain, to its number of moving elements.
    """
    carriers = [joint.child for joint in tree.ancestry(link) if joint.child in bodies]
    return carriers[-1] if carriers else ""


def _position(tree: UrdfTree, base: str, link: str, carrier: str, posture: Mapping[str, float]) -> np.ndarray:
    """Return the origin (3,) [m] of a link, in the frame of the moving element that carries it, or in the base.

    Where the element's axis is oblique, this frame is rotated relative to the URDF's (`calib.robot.formats.urdf`).

    Args:
        tree: the URDF.
        base: the chain's base link.
        link: the link.
        carrier: the moving link that carries it; "" for the base.
        posture: values of joints outside the chain [rad or m].
    """
    origin = invert(_still_pose(tree, carrier or base, posture)) @ _still_pose(tree, link, posture)
    rotation = np.eye(4)
    if carrier:
        rotation = align(tree.above[carrier].axis).T
    return (rotation @ origin)[:3, 3]


def _still_pose(tree: UrdfTree, link: str, posture: Mapping[str, float]) -> np.ndarray:
    """Return the pose (4, 4) of a link in its root's frame; joints have the values in `posture`, or else zero.

    Args:
        tree: the URDF.
        link: name of the link.
        posture: values of joints by name [rad or m].
    """
    result = np.eye(4)
    for joint in tree.ancestry(link):
        displacement = posture.get(joint.name, 0.0) * joint.axis
        if joint.kind == "prismatic":
            motion = pose(position=displacement)
        else:
            motion = pose(Rotation.from_rotvec(displacement))
        result = result @ joint.origin @ motion
    return result


def links_of(chain: Chain, source: Path | None) -> Collection[str]:
    """Return the names of a robot's links: those in its URDF, or, without a URDF, those of the arm's capsules.

    Args:
        chain: the arm, whose capsules have the names of its links.
        source: file that describes the robot; None if unknown.
    """
    if source is not None and is_urdf(source):
        return read(text(source)[0], str(source)).bodies
    return (chain.base, *(chain.links or [f"{name}_link" for name in chain.joint_names]), chain.tip)
