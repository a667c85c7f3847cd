"""What a URDF says, checked: links and joints as a tree, with the line of each for messages.

Reads what the kinematics and the inertias need and nothing else; pictures, transmissions and simulator tags stay in the
text, where `calib.robot.formats.urdf_write` leaves them untouched.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from calib.errors import RobotError, refuse_robot, require, suggestion
from calib.robot.chain import MIN_LIMIT, Joint
from calib.robot.formats.markup import Node, parse
from calib.transforms import from_xyz_rpy
from calib.words import listing

MOVING = ("revolute", "continuous", "prismatic")
KINDS = (*MOVING, "fixed", "floating", "planar")
UNLIMITED = 1e9
TURN = 2 * np.pi + 1e-3  # [rad]
XACRO = "expand it first: xacro file.xacro > robot.urdf"


@dataclass(frozen=True)
class Mimic:
    """q = multiplier · q_leader + offset [rad or m]."""

    leader: str
    multiplier: float
    offset: float


@dataclass(frozen=True, eq=False)
class JointTag:
    """One <joint>: origin (4, 4) in its parent link, unit axis (3,) in its own frame; limits as of `_limits`."""

    name: str
    kind: str
    parent: str
    child: str
    origin: np.ndarray
    axis: np.ndarray
    mimic: Mimic | None
    limits: tuple[float, float, float, float, tuple[str, ...]]
    node: Node

    @property
    def moves(self) -> bool:
        return self.kind in MOVING

    @property
    def actuated(self) -> bool:
        return self.moves and self.mimic is None

    def as_joint(self) -> Joint:
        """Return what the chain keeps of it."""
        return Joint(self.name, "prismatic" if self.kind == "prismatic" else "revolute", *self.limits)


@dataclass(frozen=True, eq=False)
class UrdfTree:
    """A checked URDF: every link has one parent joint or none.

    Attributes:
        bodies: link name to (10,) standard parameters XX XY XZ YY YZ ZZ MX MY MZ M about the link frame; None where
            the link has no inertial.
        joints: by name, in the order of the file.
        above: link name to the joint that carries it.
        below: link name to the joints it carries.
        remarks: what looks wrong in it.
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
        """Return `name` where such a link exists.

        Raises:
            RobotError: naming the nearest link that does.
        """
        if name not in self.bodies:
            known = ", ".join(self.bodies)
            refuse_robot(self.where, f"no link '{name}' for the {role}{suggestion(name, self.bodies)} (links: {known})")
        return name

    def ancestry(self, link: str) -> list[JointTag]:
        """Return the joints from the root to `link`."""
        result: list[JointTag] = []
        while link in self.above:
            result.append(self.above[link])
            link = result[-1].parent
        return result[::-1]

    def path(self, base: str, tip: str) -> list[JointTag]:
        """Return the joints from `base` down to `tip`.

        Raises:
            RobotError: where `tip` does not hang on `base`.
        """
        joints = self.ancestry(tip)
        links = [*(joint.parent for joint in joints), tip]
        if base not in links:
            refuse_robot(self.where, f"link '{tip}' does not hang on '{base}'; choose another base or tip")
        return joints[links.index(base) :]

    def rigid(self, link: str) -> list[tuple[str, np.ndarray]]:
        """Return the links fixed to `link`, itself first, each with its pose (4, 4) in the frame of `link`."""
        result, todo = [], [(link, np.eye(4))]
        while todo:
            name, pose = todo.pop(0)
            result.append((name, pose))
            todo += [(joint.child, pose @ joint.origin) for joint in self.below[name] if joint.kind == "fixed"]
        return result


def read(source: str, where: str) -> UrdfTree:
    """Read the text of a URDF; `where` names it in messages.

    Raises:
        RobotError: with the line, for broken XML, xacro, unknown kinds, missing parts, loops, second parents, and
            several angles beyond a full turn.
    """
    root = parse(source, where)
    if root.tag != "robot":
        refuse_robot(f"{where}, line {root.line}", f"the root element is <{root.tag}>, a URDF has <robot>")
    if macro := next((node for node in root.children if _is_macro(node)), None):
        refuse_robot(f"{where}, line {macro.line}", f"found <{macro.tag}>: this is a xacro file; {XACRO}")
    bodies = {}
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
            both = f"'{above[joint.child].name}' and '{joint.name}'"
            place = f"{where}, line {joint.node.line}"
            refuse_robot(place, f"link '{joint.child}' has two parents, joints {both}; a URDF is a tree")
        above[joint.child] = joint
        below[joint.parent].append(joint)
    name, remarks = root.attributes.get("name", "robot"), _large_angles(joints, where)
    tree = UrdfTree(name, where, bodies, joints, above, below, remarks)
    _check_loops(tree)
    return tree


def _large_angles(joints: dict[str, JointTag], where: str) -> tuple[str, ...]:
    """Return in words a joint whose origin is turned by more than a full turn; several of them are degrees.

    Raises:
        RobotError: for several joints.
    """
    found = []
    for joint in joints.values():
        node = joint.node.first("origin")
        if node is not None and (np.abs(numbers(node, "rpy", where, "0 0 0")) > TURN).any():
            found.append(f"joint '{joint.name}' (line {node.line}): rpy=\"{node.attributes['rpy']}\"")
    if len(found) > 1:
        refuse_robot(
            where, f"{listing(found, 3)}: beyond a full turn: degrees? A URDF's angles are radians; convert them"
        )
    return tuple(f"{one} is beyond a full turn: degrees? A URDF's angles are radians" for one in found)


def transform_body(body: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Return standard parameters (10,) about the frame in which the body's frame has this pose (4, 4).

    With R, p of the pose and mc = (MX, MY, MZ): mc' = R mc + M p, and
    I' = R I R' + S(p)'S(R mc) + S(R mc)'S(p) + M S(p)'S(p)  (Khalil and Dombre, 2002, eq. 9.25, signs of the matrix).
    """
    xx, xy, xz, yy, yz, zz = body[:6]
    rotation, lever, mass = pose[:3, :3], pose[:3, 3], body[9]
    moment = rotation @ body[6:9]
    inertia = rotation @ np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ rotation.T
    cross, first = _skew(lever), _skew(moment)
    inertia = inertia + cross.T @ first + first.T @ cross + mass * cross.T @ cross
    return np.array([*inertia[0], *inertia[1, 1:], inertia[2, 2], *(moment + mass * lever), mass])


def _skew(v: np.ndarray) -> np.ndarray:
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def _is_macro(node: Node) -> bool:
    """Return whether a node is a xacro call or include; properties and arguments that xacro leaves are harmless."""
    return node.tag.startswith("xacro:") and node.tag not in ("xacro:property", "xacro:arg")


def _fresh(node: Node, known: Iterable[str], where: str) -> str:
    """Return the name of a link or joint, which has to be there and new."""
    name = node.attributes.get("name", "")
    require(name, f"{where}, line {node.line}: a <{node.tag}> without a name", RobotError)
    require(name not in known, f"{where}, line {node.line}: a second {node.tag} named '{name}'", RobotError)
    return name


def _joint(node: Node, links: Iterable[str], where: str) -> JointTag:
    name, kind = node.attributes["name"], node.attributes.get("type", "")
    place = f"{where}, line {node.line}, joint '{name}'"
    if kind not in KINDS:
        refuse_robot(place, f"type '{kind}' is none of {', '.join(KINDS)}{suggestion(kind, KINDS)}")
    ends = [_end(node, role, links, place) for role in ("parent", "child")]
    return JointTag(
        name=name,
        kind=kind,
        parent=ends[0],
        child=ends[1],
        origin=origin(node, place),
        axis=_axis(node, kind, place),
        mimic=_mimic(node, place),
        limits=_limits(node, kind, place),
        node=node,
    )


def _end(node: Node, role: str, links: Iterable[str], place: str) -> str:
    """Return the parent or child link of a joint."""
    child = node.first(role)
    if child is None or not (link := child.attributes.get("link")):
        refuse_robot(place, f"no <{role} link=.../>")
    if link not in links:
        refuse_robot(place, f"its {role} '{link}' is no link of this file{suggestion(link, list(links))}")
    return link


def origin(node: Node, place: str) -> np.ndarray:
    """Return the (4, 4) of a node's first <origin>; the identity where it has none."""
    found = node.first("origin")
    if found is None:
        return np.eye(4)
    return from_xyz_rpy(numbers(found, "xyz", place, "0 0 0"), numbers(found, "rpy", place, "0 0 0"))


def _axis(node: Node, kind: str, place: str) -> np.ndarray:
    found = node.first("axis")
    if kind not in MOVING:
        return np.array([1.0, 0.0, 0.0])
    axis = np.array([1.0, 0.0, 0.0]) if found is None else numbers(found, "xyz", place, "1 0 0")
    length = np.linalg.norm(axis)
    require(length > 1e-9, f'{place}: its axis is zero; give a direction such as xyz="0 0 1"', RobotError)
    return axis / length


def _mimic(node: Node, place: str) -> Mimic | None:
    found = node.first("mimic")
    if found is None:
        return None
    if not (leader := found.attributes.get("joint")):
        refuse_robot(place, "<mimic> without a joint to follow")
    return Mimic(leader, _number(found, "multiplier", 1.0, place), _number(found, "offset", 0.0, place))


def _limits(node: Node, kind: str, place: str) -> tuple[float, float, float, float, tuple[str, ...]]:
    """Return lower, upper, velocity, effort, and which of the last two are below `MIN_LIMIT`, as written.

    Infinite where not given or beyond 1e9, the last two also below `MIN_LIMIT`: URDF demands velocity and effort, so 0
    is what people write who do not know them, and 1e9 is what we write.
    """
    found = node.first("limit")
    lower, upper, velocity, effort = -np.inf, np.inf, np.inf, np.inf
    unstated: list[str] = []
    if found is not None:
        if kind in ("revolute", "prismatic") and ("lower" in found.attributes or "upper" in found.attributes):
            lower, upper = _number(found, "lower", 0.0, place), _number(found, "upper", 0.0, place)
            if not lower < upper:
                found_limits = f"lower limit {lower:g} is not below the upper {upper:g}"
                refuse_robot(place, f"{found_limits}; correct them, or make the joint fixed or continuous")
        velocity, effort = _number(found, "velocity", np.inf, place), _number(found, "effort", np.inf, place)
        sizes = {"velocity": velocity, "effort": effort}
        unstated = [f"{what} {size:g}" for what, size in sizes.items() if size < MIN_LIMIT]
    lower, upper = lower if lower > -UNLIMITED else -np.inf, upper if upper < UNLIMITED else np.inf
    velocity, effort = (size if MIN_LIMIT <= size < UNLIMITED else np.inf for size in (velocity, effort))
    return lower, upper, velocity, effort, tuple(unstated)


def _body(node: Node, where: str) -> np.ndarray | None:
    """Return the standard parameters (10,) of a link about its frame; None where it has no mass."""
    place = f"{where}, line {node.line}, link '{node.attributes.get('name')}'"
    inertial = node.first("inertial")
    if inertial is None:
        return None
    mass_node, inertia_node = inertial.first("mass"), inertial.first("inertia")
    mass = 0.0 if mass_node is None else _number(mass_node, "value", 0.0, place)
    moments = [0.0] * 6
    if inertia_node is not None:
        moments = [_number(inertia_node, key, 0.0, place) for key in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")]
    if mass == 0.0 and not any(moments):
        return None
    return transform_body(np.array([*moments, 0.0, 0.0, 0.0, mass]), origin(inertial, place))


def numbers(node: Node, key: str, place: str, default: str = "", count: int = 3, infinite: bool = False) -> np.ndarray:
    """Return the numbers (count,) of an attribute, finite unless they may be `infinite`; `default` where absent."""
    found = node.attributes.get(key)
    try:
        values = np.array([float(word) for word in (default if found is None else found).split()])
    except ValueError:
        values = np.empty(0)
    if len(values) != count or np.isnan(values).any() or not (infinite or np.isfinite(values).all()):
        expected = "a number" if count == 1 else f"{count} finite numbers"
        hint = f"; this is a xacro file, {XACRO}" if found and "${" in found else ""
        refuse_robot(place, f'{key}="{found}" of <{node.tag}> in line {node.line} is not {expected}{hint}')
    return values


def _number(node: Node, key: str, default: float, place: str) -> float:
    return float(numbers(node, key, place, str(default), 1, infinite=True)[0])


def _check_loops(tree: UrdfTree) -> None:
    """Refuse links that hang on themselves."""
    reached: set[str] = set()
    todo = tree.roots
    while todo:
        link = todo.pop()
        reached.add(link)
        todo += [joint.child for joint in tree.below[link]]
    if lost := [link for link in tree.bodies if link not in reached]:
        refuse_robot(tree.where, f"links {', '.join(lost)} hang on each other in a loop; a URDF is a tree")
    require(tree.bodies, f"{tree.where}: no <link> found", RobotError)
