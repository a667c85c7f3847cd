"""The toolkit's own robot file, ``robot.toml``: any `Chain`, calibrated ones included, read back exactly.

A chain with the form of an MDH table is written as one (schema in `calib.robot.mdh`), so that a person can read it. Any
other chain is written element by element::

    name = "ur10"
    base = "base_link"
    tip = "tool0"
    gravity = [0.0, 0.0, -9.81]
    floor = 0.0                      # height of what it stands on [m]; left out where 0

    [[joint]]                        # the actuated joints, in the order of q
    name = "shoulder_pan_joint"
    kind = "revolute"                # or "prismatic"
    lower = -6.28                    # and upper, velocity, effort; inertia = [XX .. M]; link = its URDF link

    [[element]]                      # base to tip: placement · exp(sign · axis · (value + ratio · q_joint))
    name = "shoulder_pan_joint.x"
    axis = "tx"                      # tx ty tz rx ry rz
    value = 0.0
    owner = 0                        # number of the joint it places, counted from 0
    joint = 0                        # number of the joint that moves it; left out where it is constant
    ratio = 1.0                      # left out where 1
    sign = -1.0                      # left out where 1
    placement = {xyz = [0, 0, 0.1273], rpy = [0, 0, 0]}   # or {matrix = [three rows of four]}; left out where none

    [tail]
    xyz = [0, 0, 0]
    rpy = [0, 0, 0]

Tables `station`, `tool` and `deflection` (and `truth`) may follow: they belong to the callers.

Implausible values of a description are reported: invalid limits, impossible bodies.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np

from calib import files
from calib.config import parse, strict
from calib.config_types import Name, Numeric, OneOf, ParsedTable, Whole
from calib.errors import RobotError, listing, refuse_robot, require
from calib.robot import mdh, tables
from calib.robot.chain import AXES, Chain, Element, Joint

EXTRA = tables.EXTRA

# Largest plausible limit [rad]: a continuous wrist may be given two turns (our choice).
MAX_TURN = 4.0 * np.pi + 0.01
# Largest mass of the arm by the cube of its stretched length [kg/m³]; known arms have 1 to 50 (our choice).
MAX_DENSITY = 1000.0
# Share of M L² below which a moment of inertia is rounding.
ROUNDING = 1e-6
# Share by which a moment may exceed the sum of the others: rounded sets do by up to 0.7 (our choice).
MAX_EXCESS = 1.0


@strict
@dataclass(frozen=True)
class JointTable:
    """Table ``[[joint]]`` of a robot file of elements.

    Attributes:
        name: of the joint.
        kind: of the joint.
        lower, upper: limits [rad or m].
        velocity: limit [rad/s or m/s].
        effort: limit [N m or N].
        link: its link in the URDF.
        inertia: XX XY XZ YY YZ ZZ MX MY MZ M about the joint's frame [kg m², kg m, kg].
    """

    name: Name
    kind: Annotated[str, OneOf(("revolute", "prismatic"))] = "revolute"
    lower: tables.Unlimited | None = None
    upper: tables.Unlimited | None = None
    velocity: tables.Unlimited | None = None
    effort: tables.Unlimited | None = None
    link: Name | None = None
    inertia: tables.Inertia | None = None


@strict
@dataclass(frozen=True)
class ElementTable:
    """Table ``[[element]]``: placement · exp(sign · axis · (value + ratio · q_joint)).

    Attributes:
        name: of the element.
        axis: along or about which it moves.
        value: constant part [m or rad].
        owner: number of the joint it places, counted from 0.
        joint: number of the joint that moves it; left out where it is constant.
        ratio: of its motion to the joint's.
        sign: 1 or -1.
        placement: of its axis.
    """

    name: Name
    axis: Annotated[str, OneOf(AXES)]
    value: Numeric = 0.0
    owner: Annotated[int, Whole(0)] = 0
    joint: Annotated[int, Whole(0)] | None = None
    ratio: tables.Plain = 1.0
    sign: tables.Plain = 1.0
    placement: tables.Placement | None = None


@strict
@dataclass(frozen=True, kw_only=True)
class ElementsFile(tables.RobotTable):
    """Robot file of a chain of elements.

    Attributes:
        joint: the actuated joints, in the order of q.
        element: the elements, base to tip.
    """

    joint: tuple[JointTable, ...]
    element: tuple[ElementTable, ...]


def remarks(chain: Chain, bodies: bool = True) -> tuple[str, ...]:
    """Return remarks on suspicious values in a chain's description, by joint; () if there are none.

    Args:
        chain: the arm.
        bodies: whether physically impossible bodies are included.
    """
    result = list(chain.remarks)
    unstated: dict[str, list[str]] = {}
    for joint in chain.joints:
        for limit in joint.unstated:
            unstated.setdefault(limit, []).append(joint.name)
    for limit, names in unstated.items():
        result.append(f"{', '.join(names)}: {limit} in the robot's description is not a limit; ignored")

    wide: dict[str, float] = {}
    for joint in chain.joints:
        angle = max(-joint.lower, joint.upper)
        if joint.unit != "m" and MAX_TURN < angle < np.inf:
            wide[joint.name] = angle
    if wide:
        largest = max(wide.values())
        result.append(f"{listing(wide, 4)}: limits up to {largest:g} rad in the robot's description; are they degrees?")

    if chain.inertias is not None:
        massless = [joint.name for joint, body in zip(chain.joints, chain.inertias) if not body.any()]
        if massless:
            result.append(f"body after {listing(massless, 4)}: mass not stated, taken as zero")
    if bodies:
        result += impossible_bodies(chain)
    return tuple(result)


def impossible_bodies(chain: Chain) -> tuple[str, ...]:
    """Return sentences on physically impossible bodies, one per kind of error, with the joints; () if there are none.

    A possible body has M > 0 and, about its centre of mass, positive principal moments of which none exceeds the sum of
    the others (triangle inequality; Wensing, Kim and Slotine, 2018, eq. 7). Its radius of gyration and the distance of
    its centre of mass are at most the stretched arm's length L. The whole arm weighs at most `MAX_DENSITY` L³.

    Args:
        chain: the arm, with the bodies' standard parameters; without them the result is ().
    """
    if chain.inertias is None:
        return ()
    length = chain.stretched_length()
    reasons: dict[str, str] = {}
    for joint, body in zip(chain.joints, chain.inertias):
        reason = _impossible(body, length) if body.any() else ""
        if reason:
            reasons[joint.name] = reason
    # One sentence for bodies with the same fault; the figures of the first stand in it.
    joints_by_fault: dict[str, list[str]] = {}
    for name, reason in reasons.items():
        fault = reason.partition(" (")[0]
        joints_by_fault.setdefault(fault, []).append(name)
    lines = [f"body after {listing(names, 4)}: {reasons[names[0]]}" for names in joints_by_fault.values()]

    total = float(chain.inertias[:, 9].sum())
    if total > MAX_DENSITY * length**3:
        lines.append(
            f"its bodies weigh {total:.4g} kg, the stretched arm is {length:.3g} m long: are the masses in grams?"
        )
    return tuple(lines)


def _impossible(body: np.ndarray, length: float) -> str:
    """Return why a body with standard parameters (10,) is physically impossible; "" if it is possible.

    Args:
        body: standard parameters XX XY XZ YY YZ ZZ MX MY MZ M about the joint's frame.
        length: length of the stretched arm [m].
    """
    mass = float(body[9])
    first_moment = body[6:9]
    if mass == 0.0:
        return f"no mass (M = {mass:g} kg)"
    if mass <= 0.0:
        return f"a negative mass (M = {mass:g} kg)"
    if np.linalg.norm(first_moment) > mass * length:
        distance = np.linalg.norm(first_moment) / mass
        return f"a centre of mass beyond the arm ({distance:.3g} m from its joint: in millimetres?)"
    xx, xy, xz, yy, yz, zz = body[:6]
    inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    shift = first_moment @ first_moment * np.eye(3) - np.outer(first_moment, first_moment)
    moments = np.linalg.eigvalsh(inertia - shift / mass)
    if moments[2] > mass * length**2:
        reach = np.sqrt(moments[2] / mass)
        return f"an inertia too large for the arm (radius of gyration {reach:.3g} m: is it in kg mm²?)"
    if moments[0] < -ROUNDING * mass * length**2:
        return f"a negative moment of inertia ({moments[0]:.3g} kg m² about its centre of mass)"
    if moments[2] > (1.0 + MAX_EXCESS) * (moments[0] + moments[1]) + ROUNDING * mass * length**2:
        return f"an impossible inertia (one moment exceeds the sum of the others: {moments[2]:.3g} kg m²)"
    return ""


def read(path: str | Path, propose_beta: bool = True) -> Chain:
    """Return the robot in a TOML file, which is an MDH table or a list of elements.

    Args:
        path: the file.
        propose_beta: whether `calib.robot.mdh` adds rotations beta; a file may switch this off itself.

    Raises:
        RobotError: an invalid file; the message names the table, the key and the error.
    """
    return read_whole(path, propose_beta)[0]


def read_whole(path: str | Path, propose_beta: bool = True) -> tuple[Chain, ParsedTable]:
    """Return the robot in a file, as `read` does, and the file's extra tables, as `read_extra` does.

    Args:
        path: the file.
        propose_beta: whether `calib.robot.mdh` adds rotations beta; a file may switch this off itself.
    """
    table = tables.load(path)
    if "leg" in table or table.get("kind") == "parallel":
        raise RobotError(
            f"{path} is a parallel robot (legs and a platform), only serial arms are supported here; use "
            "calib fit, excite, identify or plan"
        )
    robot: ParsedTable = {}
    extra: ParsedTable = {}
    for key, value in table.items():
        target = extra if key in EXTRA else robot
        target[key] = value
    if "element" in robot:
        return from_elements(robot, str(path)), extra
    return mdh.from_table(robot, str(path), propose_beta), extra


def read_extra(path: str | Path) -> ParsedTable:
    """Return the extra tables of a robot file (those named in `EXTRA`) as plain dictionaries.

    Args:
        path: the file.
    """
    return {key: value for key, value in tables.load(path).items() if key in EXTRA}


def write(path: str | Path, chain: Chain, extra: Mapping[str, object] | None = None, source: str = "") -> Path:
    """Write a chain to a file, from which `read` returns exactly the same chain; return the path.

    Args:
        path: the file.
        chain, extra, source: as of `content`.
    """
    return files.write(path, content(chain, extra, source))


def content(chain: Chain, extra: Mapping[str, object] | None = None, source: str = "") -> str:
    """Return the text of a file from which `read` returns exactly the same chain.

    Args:
        chain: any chain.
        extra: further tables by name (those named in `EXTRA`), written unchanged; None for no such tables.
        source: source of the numbers, written as a comment.
    """
    tables.check_keys(extra or {}, EXTRA, f"robot '{chain.name}', extra tables")
    if mdh.is_table(chain) and not chain.links:
        table = mdh.to_table(chain)
    else:
        table = _to_elements(chain)
    # TOML demands plain values before tables.
    head = {key: value for key, value in table.items() if key == "gravity" or not isinstance(value, (list, dict))}
    if source:
        head["source"] = source
    return tables.dumps(head | table | dict(extra or {}))


def from_elements(table: Mapping[str, object], where: str) -> Chain:
    """Return the chain for a parsed TOML table of elements; `where` names the table in messages."""
    file = parse(ElementsFile, table, where, RobotError)
    for key, entries in (("joint", file.joint), ("element", file.element)):
        if not entries:
            refuse_robot(where, f"no [[{key}]] tables found; a robot needs one per {key}")
    joints = []
    for entry in file.joint:
        limits = {key: getattr(entry, key) for key in tables.LIMITS}
        stated_limits = {key: limit for key, limit in limits.items() if limit is not None}
        joints.append(Joint(entry.name, entry.kind, **stated_limits))
    bodies = [entry.inertia for entry in file.joint if entry.inertia is not None]
    if bodies and len(bodies) < len(joints):
        refuse_robot(where, "some joints have an inertia and others have none: state all of them, or none")
    inertias = None
    if bodies:
        inertias = np.array(bodies)
    links = tuple(entry.link for entry in file.joint if entry.link is not None)
    if len(links) < len(joints):
        links = ()
    elements = []
    for number, entry in enumerate(file.element, 1):
        elements.append(_element(entry, len(joints), f"{where}: [[element]] number {number} ('{entry.name}')"))
    return Chain(
        joints=tuple(joints), elements=tuple(elements), inertias=inertias, links=links, **file.chain_fields(where)
    )


def _element(entry: ElementTable, n: int, where: str) -> Element:
    """Return the element for a parsed table; `n` is the robot's number of joints, and `where` is used in messages.

    Args:
        entry: the parsed table.
        n: number of the robot's joints.
        where: name of the table in messages.
    """
    if entry.owner > n:
        refuse_robot(where, f"owner {entry.owner} is not an integer from 0 to {n}")
    if entry.joint is not None and entry.joint >= n:
        refuse_robot(where, f"joint {entry.joint} is not an integer from 0 to {n - 1}")
    require(abs(entry.sign) == 1.0, f"{where}: sign {entry.sign:g} is neither 1 nor -1", RobotError)
    quantity = "length" if entry.axis[:1] == "t" else "angle"
    value = tables.number(entry.value, f"{where}, value", quantity)
    placement = None
    if entry.placement is not None:
        placement = entry.placement.transform(f"{where}, placement")
    return Element(entry.name, entry.axis, value, entry.owner, entry.joint, entry.ratio, entry.sign, placement)


def _to_elements(chain: Chain) -> dict[str, object]:
    joints, elements = [], []
    for index, joint in enumerate(chain.joints):
        entry: dict[str, object] = {"name": joint.name, "kind": joint.kind, **tables.finite_limits(joint)}
        if chain.links:
            entry["link"] = chain.links[index]
        if chain.inertias is not None:
            entry["inertia"] = chain.inertias[index]
        joints.append(entry)
    for element in chain.elements:
        entry = {key: getattr(element, key) for key in ("name", "axis", "value", "owner", "joint")}
        if element.ratio != 1.0:
            entry["ratio"] = element.ratio
        if element.sign != 1.0:
            entry["sign"] = element.sign
        if element.placement is not None:
            entry["placement"] = tables.placement_table(element.placement)
        elements.append(entry)
    return tables.chain_table(chain, joint=joints, element=elements)
