"""URDF export of a `Chain`: a new file, or an existing file with the calibrated geometry.

`edit` changes the attributes of ``<origin>`` in the text and nothing else, byte for byte: comments, transmissions,
simulator tags, meshes, order and blanks stay. With F_k(q) the nominal chain's frame behind its k-th moving element and
L_k(q) the frame of the URDF link behind its k-th moving joint, both in the base,

    X_k = F_k(q)⁻¹ L_k(q)       has to be the same for every q: both describe the same axes;
    L'_k = F'_k X_k             where the link has to stand on the calibrated chain F';
    O'_k = (L'_{k-1} C_k)⁻¹ L'_k  at q = 0, the new origin, C_k being the fixed joints in between, which stay.

Conventions (ours): the base link stays where the nominal chain has its base, so the first joint's origin takes what the
chain says about the base; the fixed joints behind the last moving one stay as they are unless the calibrated chain has
other elements there (owner n), which the first fixed joint towards the tip then takes up.

`put` writes masses and friction into the text of a URDF; all else stays, byte for byte.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
from scipy.spatial.transform import Rotation

from calib import files
from calib.errors import RobotError, refuse_robot
from calib.robot.chain import AXES, Chain, Element, random_joints
from calib.robot.formats.urdf import drive, ends
from calib.robot.formats.urdf_tree import (
    UNLIMITED,
    JointTag,
    Node,
    UrdfTree,
    edited,
    insert_child,
    parse,
    set_attributes,
    text,
)
from calib.robot.formats.urdf_tree import read as read_tree
from calib.robot.kinematics import forward, moving_frames
from calib.robot.tables import LIMITS
from calib.transforms import invert, pose, to_xyz_rpy

MOMENTS = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
# Change of an origin's element [m or 1] below which it stays as written.
UNCHANGED = 1e-12
# Largest element by which the edited URDF's link frames may differ from the calibrated robot's [m or 1].
MAX_DIFFERENCE = 1e-9
# Largest element by which a link may move against the nominal chain's frame [m or 1].
MAX_OFFSET = 1e-6
# Number below which 0 is written.
MIN_NUMBER = 1e-15


def put(
    source: str, where: str, bodies: Mapping[str, np.ndarray], friction: Mapping[str, tuple[float, float]] | None = None
) -> str:
    """Return the URDF text with new inertials of some links and new ``<dynamics>`` of some joints.

    Args:
        source: text of a URDF.
        where: name of the URDF in messages.
        bodies: link name to standard parameters (10,) about the link's frame; all zero to remove the inertial.
        friction: joint name to damping [N m s/rad or N s/m] and friction [N m or N]; None: unchanged.
    """
    root = parse(source, where)
    friction = friction or {}
    changes: list[tuple[int, int, str]] = []
    for link in root.all("link"):
        body = bodies.get(link.attributes.get("name", ""))
        if body is not None:
            changes += _inertial(source, link, body)
    for joint in root.all("joint"):
        pair = friction.get(joint.attributes.get("name", ""))
        if pair is not None:
            values = {"damping": repr(float(pair[0])), "friction": repr(float(pair[1]))}
            changes += _child(source, joint, "dynamics", values)
    return edited(source, changes)


def hanging(tree: UrdfTree, path: list[JointTag], link: str) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Return the links that move with a link of a path: those fixed to it, and those after other joints (at zero).

    Args:
        tree: the URDF.
        path: joints of the path, which are not followed.
        link: name of the link.

    Returns:
        Two mappings from link name to pose (4, 4) in the frame of `link`; the first one includes `link`.
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
    """Return a body's mass [kg], centre of mass (3,) [m], and the six moments about the centre of mass [kg m²].

    Args:
        body: (10,) standard parameters XX XY XZ YY YZ ZZ MX MY MZ M about the body's frame.
    """
    mass = float(body[9])
    x, y, z = centre = body[6:9] / mass if mass else np.zeros(3)
    steiner = mass * np.array([y * y + z * z, -x * y, -x * z, x * x + z * z, -y * z, x * x + y * y])
    return mass, centre, body[:6] - steiner


def _inertial_parts(body: np.ndarray) -> dict[str, dict[str, str]]:
    """Return the attributes of <origin>, <mass> and <inertia> for standard parameters (10,), by tag.

    Args:
        body: (10,) standard parameters about the link's frame.
    """
    mass, centre, moments = centred(body)
    inertia = {name: repr(float(moment)) for name, moment in zip(MOMENTS, moments)}
    xyz = " ".join(repr(float(coordinate)) for coordinate in centre)
    return {"origin": {"xyz": xyz, "rpy": "0 0 0"}, "mass": {"value": repr(mass)}, "inertia": inertia}


def _inertial(source: str, link: Node, body: np.ndarray) -> list[tuple[int, int, str]]:
    parts = _inertial_parts(body)
    node = link.first("inertial")
    if node is None:
        content = "".join(_tag(tag, values) for tag, values in parts.items())
        return insert_child(source, link, f"<inertial>{content}</inertial>")
    changes: list[tuple[int, int, str]] = []
    for tag, values in parts.items():
        changes += _child(source, node, tag, values)
    return changes


def _tag(tag: str, values: Mapping[str, str]) -> str:
    attributes = " ".join(f'{key}="{value}"' for key, value in values.items())
    return f"<{tag} {attributes}/>"


def _child(source: str, node: Node, tag: str, values: dict[str, str]) -> list[tuple[int, int, str]]:
    """Return the changes that set attributes of a node's first child with this tag, which is inserted if missing.

    Args:
        source: the text that contains the node.
        node: the parent element.
        tag: tag of the child.
        values: attribute name to new value.
    """
    child = node.first(tag)
    if child is not None:
        return set_attributes(source, child, values)
    return insert_child(source, node, _tag(tag, values))


def edit_file(source: str | Path, target: str | Path, nominal: Chain, calibrated: Chain) -> Path:
    """Write the URDF `source` with the calibrated geometry to `target`, in the encoding that the source declares.

    The path of the new file is returned.

    Args:
        source: the URDF of the nominal robot.
        target: the file to write.
        nominal, calibrated: the chain before and after calibration, as in `edit`.
    """
    content, encoding = text(source)
    return files.write(target, edit(content, nominal, calibrated, str(source)).encode(encoding))


def edit(source: str, nominal: Chain, calibrated: Chain, where: str = "URDF") -> str:
    """Return the URDF text with the calibrated geometry in its joint origins (equations in the module's docstring).

    Args:
        source: text of a URDF that describes the nominal robot.
        nominal: the chain before calibration; read from this URDF, or an MDH table of the same robot.
        calibrated: the same chain with other values.
        where: name of the text in messages.

    Raises:
        RobotError: the URDF does not describe the nominal robot (the message names joint and difference), or the
            calibrated chain differs from the nominal one in more than values.
    """
    _check_pair(nominal, calibrated)
    tree = read_tree(source, where)
    path = _matching_path(tree, nominal)
    q = np.vstack([np.zeros(nominal.n), random_joints(nominal, 7, 1)])
    links = _link_frames(tree, path, nominal, q)
    frames, calibrated_frames = moving_frames(nominal, q), moving_frames(calibrated, q)
    base = _base_offset(tree, path, nominal, frames, links)
    offsets = invert(frames[:, 0]) @ base @ links[:, 0]
    goal = invert(base) @ calibrated_frames @ offsets[:, None]
    origins = _origins(tree, path, goal[:, 0])
    origins |= _tip_origin(tree, path, nominal, calibrated, base @ links[-1, 0], base @ goal[-1, 0])
    changes: list[tuple[int, int, str]] = []
    for name, origin in origins.items():
        changes += _change(source, tree.joints[name], origin)
    result = edited(source, changes)

    # The edited text, read again, has to put every link where the calibrated chain has it.
    edited_tree = read_tree(result, where)
    edited_path = [edited_tree.joints[joint.name] for joint in path]
    error = np.abs(_link_frames(edited_tree, edited_path, nominal, q) - goal).max()
    if error > MAX_DIFFERENCE:
        refuse_robot(where, f"the edited URDF differs from the calibrated robot by {error:.2g}; report this as a bug")
    return result


def write_new(chain: Chain) -> str:
    """Return a new URDF text for a chain, with a link frame after each moving element.

    Constant elements are combined into the joint origins. Limits are kept; an unknown velocity or effort limit is
    written as 1e9, since URDF requires a number. A body of unknown inertia gets no inertial. Pinocchio computes the
    same kinematics from the text.
    """
    root = ET.Element("robot", name=chain.name)
    ET.SubElement(root, "link", name=chain.base)
    main_elements = set(chain.moving.tolist())
    parent = chain.base
    # Transform since the last moving element.
    T_parent_joint = np.eye(4)
    for k, element in enumerate(chain.elements):
        placement = np.eye(4) if element.placement is None else element.placement
        T_parent_joint = T_parent_joint @ placement @ _motion(element, element.value)
        if element.joint is None:
            continue
        main = k in main_elements
        if main and element.ratio != 1.0:
            refuse_robot(
                f"element '{element.name}'",
                f"a URDF joint moves by q, not by {element.ratio:g} q: it cannot be written as a URDF",
            )
        child = _link_name(chain, k, element.joint, main)
        link = ET.SubElement(root, "link", name=child)
        if main and chain.inertias is not None and chain.inertias[element.joint].any():
            inertial = ET.SubElement(link, "inertial")
            for tag, values in _inertial_parts(chain.inertias[element.joint]).items():
                ET.SubElement(inertial, tag, values)
        _add_moving_joint(root, chain, element, main, parent, child, T_parent_joint)
        parent = child
        T_parent_joint = np.eye(4)
    if parent != chain.tip:
        ET.SubElement(root, "link", name=chain.tip)
        add_joint(root, f"{chain.tip}_fixed", "fixed", parent, chain.tip, T_parent_joint @ chain.tail)
    return '<?xml version="1.0"?>\n' + xml_text(root)


def xml_text(root: ET.Element) -> str:
    """Return the indented text of the XML tree `root`."""
    ET.indent(root)
    return ET.tostring(root, encoding="unicode").replace(" />", "/>") + "\n"


def _link_frames(tree: UrdfTree, path: Sequence[JointTag], chain: Chain, q: np.ndarray) -> np.ndarray:
    """Return the frames (moving, m, 4, 4) of the links after a path's moving joints, in the path's first link.

    Args:
        tree: the URDF.
        path: joints from base to tip.
        chain: a chain whose joints, in the order of the path's actuated joints, are the columns of q.
        q: (m, n) joint values [rad or m].
    """
    index: dict[str, int] = {}
    for joint in path:
        if joint.actuated:
            index[joint.name] = len(index)
    frame = np.broadcast_to(np.eye(4), (len(q), 4, 4))
    frames = []
    for joint in path:
        frame = frame @ joint.origin
        if joint.moves:
            leader, ratio, offset = drive(tree, joint)
            amount = ratio * q[:, index[leader]] + offset
            frame = frame @ _screw(joint.axis, amount, joint.kind == "prismatic")
            frames.append(frame)
    return np.array(frames)


def _screw(axis: np.ndarray, amount: np.ndarray, slides: bool) -> np.ndarray:
    displacement = np.multiply.outer(amount, axis)
    if slides:
        return pose(position=displacement)
    return pose(Rotation.from_rotvec(displacement).as_matrix())


def _motion(element: Element, amount: float | np.ndarray) -> np.ndarray:
    """Return the transform exp(sign · axis · amount) of an element, (4, 4), or (m, 4, 4) for amounts (m,).

    Args:
        element: the element, which gives sign and axis.
        amount: displacement along or about the axis [m or rad].
    """
    axis = element.sign * np.eye(3)[AXES.index(element.axis) % 3]
    return _screw(axis, np.asarray(amount, dtype=float), element.axis[0] == "t")


def _check_pair(nominal: Chain, calibrated: Chain) -> None:
    """Raise RobotError if a calibrated chain differs from the nominal one in more than the values of its elements."""

    def motions(chain: Chain) -> list[tuple[str, int | None, float]]:
        moving = [chain.elements[k] for k in chain.driven]
        return [(element.axis, element.joint, element.ratio) for element in moving]

    if nominal.joint_names != calibrated.joint_names or motions(nominal) != motions(calibrated):
        raise RobotError(
            f"the calibrated chain '{calibrated.name}' (joints {', '.join(calibrated.joint_names)}) does not move as "
            f"the nominal '{nominal.name}' (joints {', '.join(nominal.joint_names)}); give its nominal robot"
        )


def _matching_path(tree: UrdfTree, nominal: Chain) -> list[JointTag]:
    """Return the URDF's joints from the first moving one to the tip; refuse joints that differ from the chain's.

    Joints are matched by name. If the URDF has none of the names, they are matched by the order of its longest chain.

    Args:
        tree: the URDF.
        nominal: the chain to match.
    """
    names = nominal.joint_names
    named = any(name in tree.joints for name in names)
    tip = nominal.tip if nominal.tip in tree.bodies else None
    if tip is None and named:
        tip = ends(tree, tree.roots[0], None, names).tip
    elif tip is None:
        tip = ends(tree).tip
    path = tree.ancestry(tip)
    path_names = [joint.name for joint in path]
    if names[0] in path_names:
        path = path[path_names.index(names[0]) :]
    actuated = tuple(joint.name for joint in path if joint.actuated)
    moving = [joint for joint in path if joint.moves]
    if len(actuated) != nominal.n or (named and actuated != names) or len(moving) != len(nominal.driven):
        refuse_robot(
            tree.where,
            f"its joints to '{tip}' are {', '.join(actuated)}; the nominal robot '{nominal.name}' has "
            f"{', '.join(names)}: give the URDF of the nominal robot",
        )
    return path[path.index(moving[0]) :]


def _base_offset(
    tree: UrdfTree, path: list[JointTag], nominal: Chain, frames: np.ndarray, links: np.ndarray
) -> np.ndarray:
    """Return the pose (4, 4) of the path's first link in the chain's base; refuse a URDF of another robot.

    The chain's base is the URDF's link of this name if there is one, else the best-fitting link among those fixed to
    the root.

    Args:
        tree: the URDF.
        path: joints of the path.
        nominal: the nominal chain.
        frames: (moving, m, 4, 4) frames after the chain's moving elements, in the chain's base.
        links: (moving, m, 4, 4) frames of the URDF's links, in the path's first link.
    """
    foot = path[0].parent
    top = foot
    while top in tree.above and tree.above[top].kind == "fixed":
        top = tree.above[top].parent
    body = dict(tree.rigid(top))
    names = [nominal.base] if nominal.base in body else list(body)
    least_spread = np.full(len(path), np.inf)
    T_base_foot = np.eye(4)
    for name in names:
        offset = invert(body[name]) @ body[foot]
        relative = invert(frames) @ offset @ links
        spread = np.abs(relative - relative[:, :1]).max(axis=(1, 2, 3))
        if spread.max() < least_spread.max():
            least_spread = spread
            T_base_foot = offset
    if least_spread.max() > MAX_OFFSET:
        k = int(np.argmax(least_spread > MAX_OFFSET))
        moving = [joint for joint in path if joint.moves]
        joint = moving[k]
        refuse_robot(
            f"{tree.where}, line {joint.node.line}",
            f"this URDF does not describe the nominal robot '{nominal.name}': at "
            f"joint '{joint.name}' the link moves against the chain's frame by up to {least_spread[k]:.3g} "
            "(m or rad) over random postures; give the URDF of the same nominal robot, with the same base, joint "
            "signs and lengths",
        )
    return T_base_foot


def _origins(tree: UrdfTree, path: list[JointTag], goal: np.ndarray) -> dict[str, np.ndarray]:
    """Return the new origins (4, 4) of the moving joints, by name, from the wanted link frames.

    Args:
        tree: the URDF.
        path: joints of the path.
        goal: (moving, 4, 4) wanted frames of the links after the moving joints, at q = 0.
    """
    frame, origins, k = np.eye(4), {}, 0
    for joint in path:
        if not joint.moves:
            frame = frame @ joint.origin
            continue
        _, _, offset = drive(tree, joint)
        stance = _screw(joint.axis, np.asarray(offset), joint.kind == "prismatic")
        origins[joint.name] = invert(frame) @ goal[k] @ invert(stance)
        frame, k = goal[k], k + 1
    return origins


def _tip_origin(
    tree: UrdfTree, path: list[JointTag], nominal: Chain, calibrated: Chain, last: np.ndarray, goal: np.ndarray
) -> dict[str, np.ndarray]:
    """Return the new origin of the first fixed joint after the last moving one, by name.

    The mapping is empty if calibration did not change the chain after its last moving element.

    Args:
        tree: the URDF.
        path: joints of the path.
        nominal, calibrated: the two chains.
        last, goal: (4, 4) frame of the last moving link at q = 0 in the chain's base, before and after calibration.
    """
    zero = np.zeros((1, nominal.n))
    nominal_end = invert(moving_frames(nominal, zero)[-1, 0]) @ forward(nominal, zero)[0]
    calibrated_end = invert(moving_frames(calibrated, zero)[-1, 0]) @ forward(calibrated, zero)[0]
    if np.abs(nominal_end - calibrated_end).max() < UNCHANGED:
        return {}
    position = max(k for k, joint in enumerate(path) if joint.moves) + 1
    if position == len(path):
        refuse_robot(
            tree.where,
            "the calibrated chain differs after the last joint, but the URDF has no fixed joint to "
            f"'{nominal.tip}' for the difference; add one, or calibrate without elements of the tool",
        )
    # What follows the changed joint stays.
    T_joint_tip = np.eye(4)
    for joint in path[position + 1 :]:
        T_joint_tip = T_joint_tip @ joint.origin
    tip = last @ path[position].origin @ T_joint_tip
    offset = invert(forward(nominal, zero)[0]) @ tip
    origin = invert(goal) @ forward(calibrated, zero)[0] @ offset @ invert(T_joint_tip)
    return {path[position].name: origin}


def _change(source: str, joint: JointTag, origin: np.ndarray) -> list[tuple[int, int, str]]:
    """Return the changes that write a joint's new origin; values that are equal within 1e-12 are not rewritten.

    Args:
        source: text of the URDF.
        joint: the joint.
        origin: (4, 4) the new origin.
    """
    xyz, rpy = to_xyz_rpy(origin)
    values = {}
    if np.abs(xyz - joint.origin[:3, 3]).max() > UNCHANGED:
        values["xyz"] = numbers_text(xyz)
    if np.abs(origin[:3, :3] - joint.origin[:3, :3]).max() > UNCHANGED:
        values["rpy"] = numbers_text(rpy)
    return _child(source, joint.node, "origin", values) if values else []


def numbers_text(values: np.ndarray) -> str:
    """Return numbers as text in full precision, with 0 for absolute values below 1e-15."""
    numerals = []
    for value in values.tolist():
        numeral = "0" if abs(value) < MIN_NUMBER else repr(value)
        numerals.append(numeral)
    return " ".join(numerals)


def _link_name(chain: Chain, k: int, joint: int, main: bool) -> str:
    """Return the name of the link after element k, moved by `joint`.

    It is the chain's name of the link, unless base or tip has this name. The last link may have the tip's name if
    nothing follows it.

    Args:
        chain: the arm.
        k: index of the element.
        joint: index of the joint.
        main: whether the element is the first one that the joint moves.
    """
    if not main:
        return f"{chain.elements[k].name}_link"
    fallback = f"{chain.joint_names[joint]}_link"
    if not chain.links:
        return fallback
    name = chain.links[joint]
    ends_arm = k == len(chain.elements) - 1 and np.array_equal(chain.tail, np.eye(4))
    if name == chain.base or (name == chain.tip and not ends_arm):
        return fallback
    return name


def add_joint(root: ET.Element, name: str, kind: str, parent: str, child: str, origin: np.ndarray) -> ET.Element:
    """Add a <joint> with its links and its origin (4, 4) to a URDF, and return the new XML element.

    Args:
        root: the URDF's root element, to which the joint is added.
        name, kind: name and URDF type of the joint.
        parent, child: names of the two links.
        origin: (4, 4) pose of the joint's frame in the parent link.
    """
    xyz, rpy = to_xyz_rpy(origin)
    joint = ET.SubElement(root, "joint", name=name, type=kind)
    ET.SubElement(joint, "parent", link=parent)
    ET.SubElement(joint, "child", link=child)
    ET.SubElement(joint, "origin", xyz=numbers_text(xyz), rpy=numbers_text(rpy))
    return joint


def _add_moving_joint(
    root: ET.Element, chain: Chain, element: Element, main: bool, parent: str, child: str, origin: np.ndarray
) -> None:
    """Add a moving <joint> to a URDF; a joint's second element (`main` is False) becomes a mimic joint.

    Args:
        root: the URDF's root element, to which the joint is added.
        chain: the arm.
        element: the moving element.
        main: whether the element is the first one that its joint moves.
        parent, child: names of the two links.
        origin: (4, 4) pose of the joint's frame in the parent link.
    """
    joint = chain.joints[element.joint or 0]
    if element.axis[0] == "t":
        kind = "prismatic"
    elif np.isfinite([joint.lower, joint.upper]).any():
        kind = "revolute"
    else:
        kind = "continuous"
    name = joint.name if main else element.name
    node = add_joint(root, name, kind, parent, child, origin)
    axis = element.sign * np.eye(3)[AXES.index(element.axis) % 3]
    ET.SubElement(node, "axis", xyz=numbers_text(axis))
    limits: dict[str, str] = {}
    for key in LIMITS:
        if kind == "continuous" and key in ("lower", "upper"):
            continue
        limit = np.clip(getattr(joint, key), -UNLIMITED, UNLIMITED)
        limits[key] = repr(float(limit))
    ET.SubElement(node, "limit", limits)
    if not main:
        ET.SubElement(node, "mimic", joint=joint.name, multiplier=repr(element.ratio), offset="0")
