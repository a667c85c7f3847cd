"""Checked contents of a URDF: a tree of links and joints, with their line numbers for messages.

Reads what the kinematics and the inertias need and nothing else; pictures, transmissions and simulator tags stay in the
text, where `calib.robot.formats.urdf_write` leaves them untouched.

The XML tree knows where each element stands in the text, for messages by line and for edits in place. Python's
ElementTree keeps no positions, and yourdfpy (our first choice for URDF) reads broken XML by skipping what it cannot
parse, gives links without inertia the identity, and fails without a line number. Expat gives byte positions.
"""

from __future__ import annotations

import codecs
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol
from xml.parsers import expat

import numpy as np

from calib.errors import RobotError, listing, refuse_robot, refused_as, require, suggestion
from calib.extensions import Point
from calib.robot.chain import MIN_LIMIT, Joint
from calib.transforms import from_xyz_rpy


class DescriptionReader(Protocol):
    """Protocol of readers that convert another program's robot descriptions to URDF."""

    def takes(self, path: str) -> bool:
        """Return whether this reader can convert the file at `path`."""
        ...

    def urdf(self, path: str) -> str:
        """Return the URDF text for the file at `path`."""
        ...


DESCRIPTIONS: Point[DescriptionReader] = Point("descriptions", "readers of robots' descriptions that are no URDF")

XACRO = "this is a xacro file; rename it to end in .xacro (robot.urdf.xacro)"
_LATE_DECLARATION = re.compile(r"(?P<blank>\s+)(?P<declaration><\?xml[^>]*\?>)")
_DECLARED = re.compile(rb"""^\s*<\?xml[^>]*?encoding\s*=\s*["']([A-Za-z0-9._-]+)["']""")

_ATTRIBUTE = re.compile(rb"""\s+([^\s=/>]+)\s*=\s*("[^"]*"|'[^']*')""")
_BLANK = re.compile(rb"\s*")


@dataclass(frozen=True)
class Node:
    """XML element with its position in the text.

    Attributes:
        tag: tag of the element.
        attributes: names to values of its attributes.
        line: line in the text, from 1.
        start: byte position of its ``<`` in the UTF-8 text.
        children: the direct child elements.
    """

    tag: str
    attributes: dict[str, str]
    line: int
    start: int
    children: list[Node] = field(default_factory=list)

    def all(self, tag: str) -> Iterator[Node]:
        """Yield the direct children with this tag."""
        return (child for child in self.children if child.tag == tag)

    def first(self, tag: str) -> Node | None:
        """Return the first direct child with this tag; None if there is none."""
        return next(self.all(tag), None)


def converter(path: str | Path) -> DescriptionReader | None:
    """Return the reader that converts the file at `path` to a URDF; None if there is none."""
    for reader in DESCRIPTIONS.all():
        if reader.takes(str(path)):
            return reader
    return None


def is_urdf(path: Path) -> bool:
    """Return whether a file is a URDF, or can be converted to one, so that `text` returns its URDF text.

    Args:
        path: the file.
    """
    return path.suffix == ".urdf" or converter(path) is not None


def text(path: str | Path) -> tuple[str, str]:
    """Return the text of a URDF file, with unchanged line ends, and its declared encoding (default UTF-8).

    Other descriptions are converted first; the encoding is then UTF-8.

    Args:
        path: the file; arguments for a converter may follow.

    Raises:
        RobotError: the file cannot be read, decoded or converted.
    """
    room = converter(path)
    if room is not None:
        return declaration_first(room.urdf(str(path))), "utf-8"
    with refused_as(RobotError, OSError, f"cannot read {path}: {{}}"):
        data = Path(path).read_bytes()
    declaration = _DECLARED.match(data)
    if declaration:
        encoding = declaration[1].decode()
    elif data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        encoding = "utf-16"
    else:
        encoding = "utf-8"
    if encoding.lower() in ("utf-8", "utf8"):
        return declaration_first(decoded(data)), encoding
    with refused_as(RobotError, (LookupError, UnicodeError), f"{path}: not readable as {encoding}: {{}}"):
        content = data.decode(encoding)
        # Python knows encodings that it cannot write.
        content.encode("utf-8")
        content.encode(encoding)
        return declaration_first(content), encoding


def decoded(data: bytes) -> str:
    """Return text that should be UTF-8; bytes that are not are taken as Latin-1, as CAD programs write undeclared.

    Args:
        data: bytes of the file.
    """
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError:
        return data.decode("latin-1")


def declaration_first(content: str) -> str:
    """Return an XML text with its declaration before the blank lines with which the file begins.

    XML allows nothing before the declaration. The numbers of all other lines stay.

    Args:
        content: text of the file.
    """
    match = _LATE_DECLARATION.match(content)
    if match is None:
        return content
    return match["declaration"] + match["blank"] + content[match.end() :]


def parse(source: str, where: str) -> Node:
    """Return the root element of an XML text; `where` names the text in messages.

    Args:
        source: the XML text.
        where: name of the text in messages.

    Raises:
        RobotError: the text is not well-formed; the message has line and column.
    """
    parser = expat.ParserCreate()
    root: list[Node] = []
    stack: list[Node] = []

    def start(tag: str, attributes: dict[str, str]) -> None:
        node = Node(tag, attributes, parser.CurrentLineNumber, parser.CurrentByteIndex)
        siblings = stack[-1].children if stack else root
        siblings.append(node)
        stack.append(node)

    def end(tag: str) -> None:
        stack.pop()

    parser.StartElementHandler = start
    parser.EndElementHandler = end
    try:
        parser.Parse(source, True)
    except expat.ExpatError as error:
        reason = expat.ErrorString(error.code)
        raise RobotError(f"{where}, line {error.lineno}, column {error.offset + 1}: not XML ({reason})") from None
    return root[0]


def edited(source: str, changes: Iterable[tuple[int, int, str]]) -> str:
    """Return the text after replacing byte ranges of its UTF-8 form.

    Args:
        source: the text.
        changes: (start, end, replacement) of each range; ranges must not overlap.
    """
    data = source.encode("utf-8")
    for start, end, replacement in sorted(changes, reverse=True):
        data = data[:start] + replacement.encode("utf-8") + data[end:]
    return data.decode("utf-8")


def set_attributes(source: str, node: Node, values: dict[str, str]) -> list[tuple[int, int, str]]:
    """Return the changes (for `edited`) that set attributes of a node.

    Existing attributes are changed in place; new ones are added after the last attribute.

    Args:
        source: the text that contains the node.
        node: the XML element.
        values: attribute name to new value.
    """
    data = source.encode("utf-8")
    end = node.start + 1 + len(node.tag.encode())
    matches: dict[str, re.Match[bytes]] = {}
    for match in _attributes(data, node):
        matches[match[1].decode()] = match
        end = max(end, match.end())
    changes: list[tuple[int, int, str]] = []
    added = ""
    for key, value in values.items():
        match = matches.get(key)
        if match is None:
            added += f' {key}="{value}"'
        else:
            changes.append((match.start(2) + 1, match.end(2) - 1, value))
    if added:
        changes.append((end, end, added))
    return changes


def insert_child(source: str, node: Node, child: str) -> list[tuple[int, int, str]]:
    """Return the change (for `edited`) that inserts a first child into a node, indented like the next child.

    Args:
        source: the text that contains the node.
        node: the parent element.
        child: text of the child element.
    """
    data = source.encode("utf-8")
    attributes_end = max([match.end() for match in _attributes(data, node)], default=node.start)
    tag_end = data.index(b">", attributes_end) + 1
    if data[tag_end - 2 : tag_end] == b"/>":
        return [(tag_end - 2, tag_end, f">{child}</{node.tag}>")]
    blank = _BLANK.match(data, tag_end)
    indent = blank[0].decode() if blank else ""
    return [(tag_end, tag_end, indent + child)]


def _attributes(data: bytes, node: Node) -> Iterator[re.Match[bytes]]:
    """Yield a regular-expression match (name, quoted value) for each attribute of a node.

    Args:
        data: UTF-8 bytes of the text.
        node: the XML element.
    """
    position = node.start + 1 + len(node.tag.encode())
    while match := _ATTRIBUTE.match(data, position):
        yield match
        position = match.end()


def with_comment(content: bytes, remark: str) -> bytes:
    """Return an XML file's bytes with the ASCII comment `remark` inserted after the XML declaration.

    A file in UTF-16 is returned unchanged.

    Args:
        content: bytes of the file.
        remark: text of the comment, in ASCII.
    """
    if b"\0" in content[:4]:
        return content
    comment = f"<!-- {re.sub('-(?=-)', '- ', remark)} -->".encode("ascii", "xmlcharrefreplace")
    bom = len(codecs.BOM_UTF8) if content.startswith(codecs.BOM_UTF8) else 0
    if not content[bom:].startswith(b"<?xml"):
        return content[:bom] + comment + b"\n" + content[bom:]
    start = content.index(b"?>") + 2
    return content[:start] + b"\n" + comment + content[start:]


MOVING = ("revolute", "continuous", "prismatic")
KINDS = (*MOVING, "fixed", "floating", "planar")
UNLIMITED = 1e9
TURN = 2 * np.pi + 1e-3  # [rad]


@dataclass(frozen=True)
class Mimic:
    """Mimic joint: q = multiplier · q_leader + offset [rad or m]; `leader` is the name of the leading joint."""

    leader: str
    multiplier: float
    offset: float


@dataclass(frozen=True, eq=False)
class JointTag:
    """Joint of a URDF.

    Attributes:
        name, kind: name and URDF type of the joint.
        parent, child: names of the two links.
        origin: (4, 4) pose of the joint's frame in the parent link.
        axis: (3,) unit axis in the joint's frame.
        mimic: the mimic relation; None for an independent joint.
        limits: limits as `_limits` returns them.
        node: the XML element.
        fault: description of an error in the limits, which is raised only if the joint is part of the arm; else empty.
    """

    name: str
    kind: str
    parent: str
    child: str
    origin: np.ndarray
    axis: np.ndarray
    mimic: Mimic | None
    limits: tuple[float, float, float, float, tuple[str, ...]]
    node: Node
    fault: str = ""

    @property
    def moves(self) -> bool:
        return self.kind in MOVING

    @property
    def actuated(self) -> bool:
        return self.moves and self.mimic is None

    def as_joint(self) -> Joint:
        """Return this joint as a `Joint` of a chain.

        Raises:
            RobotError: invalid limits.
        """
        require(not self.fault, self.fault, RobotError)
        return Joint(self.name, "prismatic" if self.kind == "prismatic" else "revolute", *self.limits)


@dataclass(frozen=True, eq=False)
class UrdfTree:
    """A checked URDF, in which every link has at most one parent joint.

    Attributes:
        name: name of the robot.
        where: name of the URDF in messages.
        bodies: link name to (10,) standard parameters XX XY XZ YY YZ ZZ MX MY MZ M about the link frame; None if the
            link has no inertial.
        joints: joint name to joint, in the order of the file.
        above: link name to its parent joint.
        below: link name to its child joints.
        remarks: remarks on suspicious values.
    """

    name: str
    where: str
    bodies: dict[str, np.ndarray | None]
    joints: dict[str, JointTag]
    above: dict[str, JointTag]
    below: dict[str, list[JointTag]]
    remarks: tuple[str, ...] = ()

    @property
    def roots(self) -> list[str]:
        return [link for link in self.bodies if link not in self.above]

    def link(self, name: str, role: str) -> str:
        """Return `name` if a link has this name.

        Args:
            name: name of the link.
            role: ``base`` or ``tip``, for the message.

        Raises:
            RobotError: there is no such link; the message suggests the most similar name.
        """
        if name not in self.bodies:
            known = ", ".join(self.bodies)
            refuse_robot(self.where, f"no link '{name}' for the {role}{suggestion(name, self.bodies)} (links: {known})")
        return name

    def ancestry(self, link: str) -> list[JointTag]:
        """Return the joints on the path from the root to `link`."""
        result: list[JointTag] = []
        while link in self.above:
            result.append(self.above[link])
            link = result[-1].parent
        return result[::-1]

    def path(self, base: str, tip: str) -> list[JointTag]:
        """Return the joints on the path from `base` to `tip`.

        Raises:
            RobotError: `tip` is not a descendant of `base`.
        """
        joints = self.ancestry(tip)
        links = [*(joint.parent for joint in joints), tip]
        if base not in links:
            refuse_robot(self.where, f"link '{tip}' does not follow '{base}'; choose another base or tip")
        return joints[links.index(base) :]

    def rigid(self, link: str) -> list[tuple[str, np.ndarray]]:
        """Return the links fixed to `link`, first `link` itself, each with its pose (4, 4) in the frame of `link`."""
        result, todo = [], [(link, np.eye(4))]
        while todo:
            name, pose = todo.pop(0)
            result.append((name, pose))
            todo += [(joint.child, pose @ joint.origin) for joint in self.below[name] if joint.kind == "fixed"]
        return result


def read(source: str, where: str) -> UrdfTree:
    """Return the checked tree of a URDF text; `where` names the text in messages.

    Args:
        source: text of the URDF.
        where: name of the text in messages.

    Raises:
        RobotError: broken XML, xacro commands, unknown joint types, missing parts, loops, links with two parents, or
            several angles larger than a full turn. The message has the line.
    """
    root = parse(source, where)
    if root.tag != "robot":
        refuse_robot(f"{where}, line {root.line}", f"the root element is <{root.tag}>, a URDF has <robot>")
    for node in root.children:
        if _is_macro(node):
            refuse_robot(f"{where}, line {node.line}", f"found <{node.tag}>: {XACRO}")
    bodies: dict[str, np.ndarray | None] = {}
    for node in root.all("link"):
        name = _fresh(node, bodies, where)
        bodies[name] = _body(node, where)
    joints: dict[str, JointTag] = {}
    for node in root.all("joint"):
        name = _fresh(node, joints, where)
        joints[name] = _joint(node, bodies, where)
    above: dict[str, JointTag] = {}
    below: dict[str, list[JointTag]] = {link: [] for link in bodies}
    for joint in joints.values():
        if joint.child in above:
            parents = f"'{above[joint.child].name}' and '{joint.name}'"
            refuse_robot(
                f"{where}, line {joint.node.line}",
                f"link '{joint.child}' has two parents, joints {parents}; a URDF must be a tree",
            )
        above[joint.child] = joint
        below[joint.parent].append(joint)
    name, remarks = root.attributes.get("name", "robot"), _large_angles(joints, where)
    tree = UrdfTree(name, where, bodies, joints, above, below, remarks)
    _check_loops(tree)
    return tree


def _large_angles(joints: dict[str, JointTag], where: str) -> tuple[str, ...]:
    """Return a remark on a joint origin that is rotated by more than a full turn; () without one.

    Args:
        joints: joint name to joint.
        where: name of the URDF in messages.

    Raises:
        RobotError: several such joints, whose angles are probably in degrees.
    """
    origins = []
    for joint in joints.values():
        node = joint.node.first("origin")
        if node is not None and (np.abs(numbers(node, "rpy", where, "0 0 0")) > TURN).any():
            origins.append(f"joint '{joint.name}' (line {node.line}): rpy=\"{node.attributes['rpy']}\"")
    if not origins:
        return ()
    if len(origins) > 1:
        refuse_robot(
            where,
            f"{listing(origins, 3)}: beyond a full turn: are these degrees? A URDF's angles are radians; convert them",
        )
    return (f"{origins[0]} is beyond a full turn: are these degrees? A URDF's angles are radians",)


def transform_body(body: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Return standard parameters (10,) transformed to another frame.

    With R, p of the pose, M the mass, mc = (MX, MY, MZ), I the inertia about the frame's origin, S(·) the skew matrix
    of a vector, and a prime for the other frame: mc' = R mc + M p, and I' = R I R' + S(p)'S(R mc) + S(R mc)'S(p) + M
    S(p)'S(p)  (Khalil and Dombre, 2002, eq. 9.25, signs of the matrix).

    Args:
        body: standard parameters about the body's frame.
        pose: (4, 4) pose of the body's frame in the other frame.
    """
    xx, xy, xz, yy, yz, zz = body[:6]
    rotation, lever, mass = pose[:3, :3], pose[:3, 3], body[9]
    moment = rotation @ body[6:9]
    inertia = rotation @ np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ rotation.T
    lever_cross, moment_cross = _skew(lever), _skew(moment)
    inertia = inertia + lever_cross.T @ moment_cross + moment_cross.T @ lever_cross + mass * lever_cross.T @ lever_cross
    moment = moment + mass * lever
    return np.array([*inertia[0], *inertia[1, 1:], inertia[2, 2], *moment, mass])


def _skew(v: np.ndarray) -> np.ndarray:
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def _is_macro(node: Node) -> bool:
    """Return whether a node is a xacro call or include; leftover xacro properties and arguments do not count."""
    return node.tag.startswith("xacro:") and node.tag not in ("xacro:property", "xacro:arg")


def _fresh(node: Node, names: Iterable[str], where: str) -> str:
    """Return the name of a link or joint; raise RobotError for a missing name or one of `names`.

    Args:
        node: the XML element <link> or <joint>.
        names: names that are already used.
        where: text for messages.
    """
    name = node.attributes.get("name", "")
    require(name, f"{where}, line {node.line}: a <{node.tag}> without a name: add one", RobotError)
    require(name not in names, f"{where}, line {node.line}: a second {node.tag} named '{name}': rename one", RobotError)
    return name


def _joint(node: Node, links: Iterable[str], where: str) -> JointTag:
    name, kind = node.attributes["name"], node.attributes.get("type", "")
    where = f"{where}, line {node.line}, joint '{name}'"
    if kind not in KINDS:
        refuse_robot(where, f"type '{kind}' is not one of {', '.join(KINDS)}{suggestion(kind, KINDS)}")
    parent = _end(node, "parent", links, where)
    child = _end(node, "child", links, where)
    axis = _axis(node, kind, where)
    mimic = _mimic(node, where)
    fault = ""
    try:
        limits = _limits(node, kind, where)
    except RobotError as error:
        limits, fault = (-np.inf, np.inf, np.inf, np.inf, ()), str(error)
    return JointTag(name, kind, parent, child, origin(node, where), axis, mimic, limits, node, fault)


def _end(node: Node, role: str, links: Iterable[str], where: str) -> str:
    """Return the name of a joint's parent or child link; raise RobotError if it is missing or unknown.

    Args:
        node: the joint's XML element.
        role: ``parent`` or ``child``.
        links: names of the links.
        where: text for messages.
    """
    child = node.first(role)
    link = "" if child is None else child.attributes.get("link")
    if not link:
        refuse_robot(where, f"no <{role} link=.../>")
    if link not in links:
        refuse_robot(where, f"its {role} '{link}' is not a link of this file{suggestion(link, list(links))}")
    return link


def origin(node: Node, where: str) -> np.ndarray:
    """Return the transform (4, 4) in a node's first <origin>; the identity if there is none.

    Args:
        node: the XML element that contains <origin>.
        where: text for messages.
    """
    tag = node.first("origin")
    if tag is None:
        return np.eye(4)
    return from_xyz_rpy(numbers(tag, "xyz", where, "0 0 0"), numbers(tag, "rpy", where, "0 0 0"))


def _axis(node: Node, kind: str, where: str) -> np.ndarray:
    tag = node.first("axis")
    if kind not in MOVING or tag is None:
        return np.array([1.0, 0.0, 0.0])
    axis = numbers(tag, "xyz", where, "1 0 0")
    length = np.linalg.norm(axis)
    require(length > 1e-9, f'{where}: its axis is zero; give a direction such as xyz="0 0 1"', RobotError)
    return axis / length


def _mimic(node: Node, where: str) -> Mimic | None:
    tag = node.first("mimic")
    if tag is None:
        return None
    leader = tag.attributes.get("joint")
    if not leader:
        refuse_robot(where, "<mimic> has no attribute joint: name the joint to follow")
    multiplier = _number(tag, "multiplier", 1.0, where)
    offset = _number(tag, "offset", 0.0, where)
    return Mimic(leader, multiplier, offset)


def _limits(node: Node, kind: str, where: str) -> tuple[float, float, float, float, tuple[str, ...]]:
    """Return a joint's limits (lower, upper, velocity, effort), and as texts those below `MIN_LIMIT`.

    Limits that are missing or beyond 1e9 are infinite; so are velocity and effort below `MIN_LIMIT`. The reason is that
    URDF requires velocity and effort, and files contain 0 for unknown values, and those of this toolkit 1e9.

    Args:
        node: the XML element <joint>.
        kind: URDF type of the joint.
        where: text for messages.
    """
    lower, upper, velocity, effort = -np.inf, np.inf, np.inf, np.inf
    tag = node.first("limit")
    if tag is None:
        return lower, upper, velocity, effort, ()

    if kind in ("revolute", "prismatic") and ("lower" in tag.attributes or "upper" in tag.attributes):
        lower = _number(tag, "lower", 0.0, where)
        upper = _number(tag, "upper", 0.0, where)
        if not lower < upper:
            fault = f"lower limit {lower:g} is not below the upper {upper:g}"
            refuse_robot(where, f"{fault}; correct them, or make the joint fixed or continuous")
    if not lower > -UNLIMITED:
        lower = -np.inf
    if not upper < UNLIMITED:
        upper = np.inf

    velocity = _number(tag, "velocity", np.inf, where)
    effort = _number(tag, "effort", np.inf, where)
    unstated: list[str] = []
    if velocity < MIN_LIMIT:
        unstated.append(f"velocity {velocity:g}")
    if effort < MIN_LIMIT:
        unstated.append(f"effort {effort:g}")
    if not MIN_LIMIT <= velocity < UNLIMITED:
        velocity = np.inf
    if not MIN_LIMIT <= effort < UNLIMITED:
        effort = np.inf
    return lower, upper, velocity, effort, tuple(unstated)


def _body(node: Node, where: str) -> np.ndarray | None:
    """Return the standard parameters (10,) of a link about the link's frame; None for a link without mass.

    Args:
        node: the XML element <link>.
        where: text for messages.
    """
    link_where = f"{where}, line {node.line}, link '{node.attributes.get('name')}'"
    inertial = node.first("inertial")
    if inertial is None:
        return None
    mass_node, inertia_node = inertial.first("mass"), inertial.first("inertia")
    mass = 0.0
    if mass_node is not None:
        mass = _number(mass_node, "value", 0.0, link_where)
    moments = [0.0] * 6
    if inertia_node is not None:
        moments = [_number(inertia_node, key, 0.0, link_where) for key in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")]
    if mass == 0.0 and not any(moments):
        return None
    return transform_body(np.array([*moments, 0.0, 0.0, 0.0, mass]), origin(inertial, link_where))


def numbers(node: Node, key: str, where: str, default: str = "", count: int = 3, infinite: bool = False) -> np.ndarray:
    """Return the numbers (count,) in an attribute; raise RobotError for other texts.

    Args:
        node: the XML element.
        key: name of the attribute.
        where: text for messages.
        default: value of a missing attribute.
        count: number of numbers.
        infinite: whether infinite numbers are accepted.
    """
    attribute = node.attributes.get(key)
    numerals = default if attribute is None else attribute
    try:
        values = np.array([float(numeral) for numeral in numerals.split()])
    except ValueError:
        values = np.empty(0)
    if len(values) != count or np.isnan(values).any() or not (infinite or np.isfinite(values).all()):
        expected = "a number" if count == 1 else f"{count} finite numbers"
        hint = f"; {XACRO}" if attribute and "${" in attribute else ""
        refuse_robot(where, f'{key}="{attribute}" of <{node.tag}> in line {node.line} is not {expected}{hint}')
    return values


def _number(node: Node, key: str, default: float, where: str) -> float:
    return float(numbers(node, key, where, str(default), 1, infinite=True)[0])


def _check_loops(tree: UrdfTree) -> None:
    """Raise RobotError for a tree without links, or whose links form a loop."""
    reached: set[str] = set()
    todo = tree.roots
    while todo:
        link = todo.pop()
        reached.add(link)
        todo += [joint.child for joint in tree.below[link]]
    looped = [link for link in tree.bodies if link not in reached]
    if looped:
        refuse_robot(tree.where, f"links {', '.join(looped)} form a loop; a URDF must be a tree")
    require(tree.bodies, f"{tree.where}: no <link> found", RobotError)
