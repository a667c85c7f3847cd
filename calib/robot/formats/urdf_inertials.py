"""Masses and friction put into the text of a URDF; all else stays, byte for byte (see `urdf_write`)."""

from collections.abc import Mapping

import numpy as np

from calib.robot.formats.markup import Node, edited, insert_child, parse, set_attributes
from calib.robot.formats.urdf_tree import JointTag, UrdfTree

MOMENTS = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
ZERO = "0 0 0"


def put(
    source: str, where: str, bodies: Mapping[str, np.ndarray], friction: Mapping[str, tuple[float, float]] | None = None
) -> str:
    """Return the text with new inertials of some links and new ``<dynamics>`` of some joints.

    Args:
        source: the text of a URDF.
        where: names it in messages.
        bodies: link name to standard parameters (10,) about the link's frame; all zero for none.
        friction: joint name to damping [N m s/rad or N s/m] and friction [N m or N].
    """
    root, changes = parse(source, where), []
    for link in root.all("link"):
        if (body := bodies.get(link.attributes.get("name", ""))) is not None:
            changes += _inertial(source, link, body)
    for joint in root.all("joint"):
        if (pair := (friction or {}).get(joint.attributes.get("name", ""))) is not None:
            values = {"damping": repr(float(pair[0])), "friction": repr(float(pair[1]))}
            changes += _child(source, joint, "dynamics", values)
    return edited(source, changes)


def hanging(tree: UrdfTree, path: list[JointTag], link: str) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Return what moves with a link of a path: links fixed to it, and links on other joints that stand at zero.

    Each by name with its pose (4, 4) in the frame of `link`, which is among the first.
    """
    onward = {joint.name for joint in path}
    fixed = dict(tree.rigid(link))
    loose: dict[str, np.ndarray] = {}
    todo = [(name, placed) for name, placed in fixed.items()]
    while todo:
        name, placed = todo.pop()
        for joint in tree.below[name]:
            if joint.name in onward or joint.child in fixed:
                continue
            loose[joint.child] = placed @ joint.origin
            todo.append((joint.child, loose[joint.child]))
    return fixed, loose


def centred(body: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Return mass, centre of mass (3,) and the six moments about it of standard parameters (10,)."""
    mass = float(body[9])
    x, y, z = centre = body[6:9] / mass if mass else np.zeros(3)
    steiner = mass * np.array([y * y + z * z, -x * y, -x * z, x * x + z * z, -y * z, x * x + y * y])
    return mass, centre, body[:6] - steiner


def _inertial(source: str, link: Node, body: np.ndarray) -> list[tuple[int, int, str]]:
    mass, centre, moments = centred(body)
    place = {"xyz": " ".join(repr(float(x)) for x in centre), "rpy": ZERO}
    values: dict[str, str] = {name: repr(float(x)) for name, x in zip(MOMENTS, moments)}
    node = link.first("inertial")
    if node is None:
        parts = "".join(
            f"<{tag} " + " ".join(f'{key}="{value}"' for key, value in content.items()) + "/>"
            for tag, content in (("origin", place), ("mass", {"value": repr(mass)}), ("inertia", values))
        )
        return insert_child(source, link, f"<inertial>{parts}</inertial>")
    changes = []
    for tag, content in (("origin", place), ("mass", {"value": repr(mass)}), ("inertia", values)):
        changes += _child(source, node, tag, content)
    return changes


def _child(source: str, node: Node, tag: str, values: dict[str, str]) -> list[tuple[int, int, str]]:
    """Return the changes that give a node's first child of this tag these attributes; the child is made if need be."""
    found = node.first(tag)
    if found is not None:
        return set_attributes(source, found, values)
    return insert_child(source, node, f"<{tag} " + " ".join(f'{key}="{value}"' for key, value in values.items()) + "/>")
