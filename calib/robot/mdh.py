"""Modified Denavit-Hartenberg tables (Khalil and Kleinfinger, 1986), converted to and from a `Chain`.

    row of a revolute joint:   Rot_x(alpha) Trans_x(d) [Rot_y(beta)] Trans_z(r) Rot_z(theta + q)
    row of a prismatic joint:  Rot_x(alpha) Trans_x(d) [Rot_y(beta)] Rot_z(theta) Trans_z(r + q)
    fixed row:                 as the revolute one, without q

Khalil's ``alpha d theta r`` are Craig's ``alpha a theta d`` of the same row: Craig's a is our d, Craig's d is our r.
The elements of row k are named ``alpha3 d3 beta3 r3 theta3`` and stand in the order of the product.

Where an axis is nearly parallel to the moving axis before it (sine of the angle below 0.05), the common normal is ill
defined and the row gets a rotation ``beta`` about y, zero at first (Hayati, 1983; that it stands behind Trans_x(d) is
our choice). The first moving axis and fixed rows get none unless the row states one.

The file, in TOML (numbers as in `calib.robot.tables`; angles in rad, lengths in m unless a unit is written)::

    name = "myrobot"                 # required
    base = "base"                    # names of the two ends, optional
    tip = "flange"
    gravity = [0, 0, -9.81]          # in the base frame [m/s²], optional
    floor = 0                        # height of what it stands on, in the base frame [m], optional
    source = "where the numbers come from"
    propose_beta = false             # keep the rows as they are written; default true, see above

    [[joint]]                        # one table per row, base to tip
    name = "shoulder"                # default: joint<index>
    kind = "revolute"                # or "prismatic", "fixed"; default "revolute"
    index = 1                        # number in the elements' names; default: the row before plus one, from 1
    alpha = "pi/2"                   # alpha, d, theta, r default to 0; beta: see above
    d = 0.0
    theta = 0.0
    r = 0.4
    lower = "-170 deg"               # limits; infinite where not given
    upper = "170 deg"
    velocity = "110 deg/s"
    effort = 176                     # [N m] or [N]
    inertia = [XX, XY, XZ, YY, YZ, ZZ, MX, MY, MZ, M]   # about the row's frame [kg m², kg m, kg]

    [tail]                           # what follows the last row, optional
    xyz = [0, 0, 0.1]
    rpy = [0, 0, 0]
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any

import numpy as np
from scipy.spatial.transform import Rotation

from calib.config import parse, strict
from calib.config_types import Angle, Flag, Length, Name, Numeric, OneOf, Whole
from calib.errors import RobotError, one_of, refuse_robot, require
from calib.records import FieldValues
from calib.robot import tables
from calib.robot.chain import Chain, Element, Joint

AXES = {"alpha": "rx", "d": "tx", "beta": "ry", "r": "tz", "theta": "rz"}
KINDS = ("revolute", "prismatic", "fixed")
MAX_SINE = 0.05  # of the angle between two axes that are nearly parallel
_ELEMENT = re.compile(r"(alpha|d|beta|r|theta)(\d+)")


@dataclass(frozen=True)
class Row:
    """Row of an MDH table.

    Attributes:
        name: name of the joint.
        index: number in the elements' names.
        kind: ``revolute``, ``prismatic`` or ``fixed``.
        alpha, theta: angles [rad].
        d, r: lengths [m].
        beta: rotation about y [rad]; None for a row without this element.
        lower, upper: position limits [rad or m]; infinite if unknown.
        velocity, effort: limits [rad/s or m/s], [N m or N]; infinite if unknown.
        inertia: (10,) standard parameters of the body, about the row's frame; None if unknown.
    """

    name: str
    index: int
    kind: str = "revolute"
    alpha: float = 0.0
    d: float = 0.0
    theta: float = 0.0
    r: float = 0.0
    beta: float | None = None
    lower: float = -np.inf
    upper: float = np.inf
    velocity: float = np.inf
    effort: float = np.inf
    inertia: tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        one_of(self.kind, KINDS, f"row '{self.name}': kind", RobotError)


@strict
@dataclass(frozen=True)
class RowTable:
    """Table ``[[joint]]`` of an MDH file.

    Attributes:
        name: of the joint; default joint1, joint2 …
        kind: of the joint.
        index: number in the elements' names; default: the row before plus one, from 1.
        alpha, theta: angles of the row [rad].
        d, r: lengths of the row [m].
        beta: rotation about y between nearly parallel axes [rad].
        lower, upper: limits of the joint [rad or m].
        velocity: limit [rad/s or m/s].
        effort: limit [N m or N].
        inertia: XX XY XZ YY YZ ZZ MX MY MZ M about the row's frame [kg m², kg m, kg].
    """

    name: Name | None = None
    kind: Annotated[str, OneOf(KINDS)] = "revolute"
    index: Annotated[int, Whole(0)] | None = None
    alpha: Angle = 0.0
    d: Length = 0.0
    beta: Angle | None = None
    theta: Angle = 0.0
    r: Length = 0.0
    lower: Numeric | None = None
    upper: Numeric | None = None
    velocity: Numeric | None = None
    effort: Numeric | None = None
    inertia: tables.Inertia | None = None


@strict
@dataclass(frozen=True, kw_only=True)
class MdhFile(tables.RobotTable):
    """Robot file of an MDH table.

    Attributes:
        propose_beta: add a rotation beta to rows whose axis is nearly parallel to the one before.
        joint: one table per row, base to tip.
    """

    propose_beta: Flag = True
    joint: tuple[RowTable, ...]


def from_table(table: Mapping[str, object], where: str, propose_beta: bool = True) -> Chain:
    """Return the chain for a parsed TOML table; `where` names the table in messages.

    Args:
        table: the parsed table.
        where: name of the table in messages.
        propose_beta: whether rotations beta are added to rows with nearly parallel axes; the table may switch this off.
    """
    file = parse(MdhFile, table, where, RobotError)
    if not file.joint:
        refuse_robot(where, "no [[joint]] rows found; an MDH table needs one per axis")
    rows: list[Row] = []
    for number, entry in enumerate(file.joint, 1):
        next_index = 1
        if rows:
            next_index = rows[-1].index + 1
        rows.append(_row(entry, next_index, f"{where}: [[joint]] number {number}"))
    return chain(rows=rows, propose_beta=propose_beta and file.propose_beta, **file.chain_fields(where))


def chain(name: str, rows: Sequence[Row], propose_beta: bool = True, **fields: Any) -> Chain:
    """Return the chain for MDH rows.

    Args:
        name: name of the robot.
        rows: the rows, base to tip.
        propose_beta: add ``beta`` to moving rows whose axis is nearly parallel to the axis of the moving row before.
        fields: other fields of `Chain`: base, tip, tail, gravity, floor.
    """
    moving = [row for row in rows if row.kind != "fixed"]
    require(moving, f"robot '{name}': every row is fixed; at least one has to be revolute or prismatic", RobotError)
    parallel = _parallel(rows) if propose_beta else set()
    elements: list[Element] = []
    owner = 0
    for row in rows:
        beta = row.beta
        if beta is None and row.index in parallel:
            beta = 0.0
        elements += _elements(row, beta, owner)
        owner += row.kind != "fixed"
    massless = [row.name for row in moving if row.inertia is None]
    if massless and len(massless) < len(moving):
        refuse_robot(f"robot '{name}'", f"row '{massless[0]}' has no inertia while others have: state all, or none")
    inertias = None
    if not massless:
        inertias = np.array([row.inertia for row in moving], dtype=float)
    joints = tuple(Joint(row.name, row.kind, row.lower, row.upper, row.velocity, row.effort) for row in moving)
    return Chain(name, joints, tuple(elements), inertias=inertias, **fields)


def rows(chain: Chain) -> tuple[Row, ...]:
    """Return the MDH rows of a chain that has the form of an MDH table.

    Raises:
        RobotError: an element is not one of an MDH table, or is not in the right order.
    """
    groups: dict[int, list[Element]] = {}
    for element in chain.elements:
        match = _ELEMENT.fullmatch(element.name)
        plain = element.placement is None and element.sign == 1.0 and element.ratio == 1.0
        if not match or not plain or AXES[match[1]] != element.axis:
            raise RobotError(
                f"robot '{chain.name}' is not an MDH table: element '{element.name}' does not fit; export it as a URDF"
            )
        groups.setdefault(int(match[2]), []).append(element)
    result = tuple(_regroup(chain, index, group) for index, group in groups.items())
    owner = 0
    expected: list[Element] = []
    for row in result:
        expected += _elements(row, row.beta, owner)
        owner += row.kind != "fixed"
    if tuple(expected) != chain.elements:
        raise RobotError(
            f"robot '{chain.name}' is not an MDH table: its elements do not form complete rows in order; export it "
            "as a URDF"
        )
    return result


def is_table(chain: Chain) -> bool:
    """Return whether a chain has the form of an MDH table."""
    try:
        return bool(rows(chain))
    except RobotError:
        return False


def to_table(chain: Chain) -> dict[str, object]:
    """Return a chain as a TOML table (schema in the module's docstring), which `from_table` reads back exactly."""
    entries = [_entry(row, index + 1) for index, row in enumerate(rows(chain))]
    return tables.chain_table(chain, propose_beta=False, joint=entries)


def _elements(row: Row, beta: float | None, owner: int) -> list[Element]:
    """Return the elements of one row, in the order of the product of transforms.

    Args:
        row: the row.
        beta: rotation about y [rad]; None: no such element.
        owner: index of the joint whose frame the elements place.
    """
    values = {"alpha": row.alpha, "d": row.d}
    if beta is not None:
        values["beta"] = beta
    if row.kind == "prismatic":
        values |= {"theta": row.theta, "r": row.r}
    else:
        values |= {"r": row.r, "theta": row.theta}
    elements = [Element(f"{name}{row.index}", AXES[name], value, owner) for name, value in values.items()]
    if row.kind != "fixed":
        elements[-1] = replace(elements[-1], joint=owner)
    return elements


def _parallel(rows: Iterable[Row]) -> set[int]:
    """Return the indices of moving rows whose axis is nearly parallel to the previous moving axis, at q = 0."""
    indices: set[int] = set()
    # Rotation since the last moving row.
    rotation: Rotation | None = None
    for row in rows:
        if rotation is not None:
            rotation = rotation * Rotation.from_euler("XY", [row.alpha, row.beta or 0.0])
            if row.kind != "fixed" and np.hypot(*rotation.as_matrix()[:2, 2]) < MAX_SINE:
                indices.add(row.index)
        if row.kind != "fixed":
            rotation = Rotation.identity()
        elif rotation is not None:
            rotation = rotation * Rotation.from_euler("Z", row.theta)
    return indices


def _row(entry: RowTable, next_index: int, where: str) -> Row:
    """Return the row for one [[joint]] table, with limits converted to SI by the kind of joint.

    Args:
        entry: the table.
        next_index: number of the row if the table has none.
        where: name of the file in messages.
    """
    index = next_index if entry.index is None else entry.index
    name = f"joint{index}" if entry.name is None else entry.name
    where = f"{where} ('{name}')"
    quantities = {"lower": "angle", "upper": "angle", "velocity": "angular speed", "effort": "torque"}
    if entry.kind == "prismatic":
        quantities = {"lower": "length", "upper": "length", "velocity": "speed", "effort": "force"}
    limits: dict[str, float] = {}
    for key, quantity in quantities.items():
        value = getattr(entry, key)
        if value is not None:
            limits[key] = tables.number(value, f"{where}, {key}", quantity)
    if entry.kind == "fixed":
        surplus = [*limits]
        if entry.inertia is not None:
            surplus.append("inertia")
        if surplus:
            refuse_robot(where, f"a fixed row cannot have '{surplus[0]}': remove the key")
    return Row(
        name=name,
        index=index,
        kind=entry.kind,
        alpha=entry.alpha,
        d=entry.d,
        theta=entry.theta,
        r=entry.r,
        beta=entry.beta,
        inertia=entry.inertia,
        **limits,
    )


def _regroup(chain: Chain, index: int, group: list[Element]) -> Row:
    """Return the MDH row for the elements `group` that share one number; the caller checks order and completeness.

    Args:
        chain: the arm.
        index: number in the elements' names.
        group: the elements, in order.
    """
    values: FieldValues = {element.name.removesuffix(str(index)): element.value for element in group}
    moving = [element for element in group if element.joint is not None]
    if not moving:
        return Row(name=f"joint{index}", index=index, kind="fixed", **values)
    position = moving[0].joint or 0
    joint = chain.joints[position]
    inertia = None if chain.inertias is None else tuple(chain.inertias[position].tolist())
    limits = {key: getattr(joint, key) for key in tables.LIMITS}
    return Row(name=joint.name, index=index, kind=joint.kind, inertia=inertia, **values, **limits)


def _entry(row: Row, expected: int) -> dict[str, object]:
    """Return the [[joint]] table for a row, without default values; the four MDH parameters are always included.

    Args:
        row: the row.
        expected: number that the row has by default.
    """
    entry: dict[str, object] = {"name": row.name}
    if row.kind != "revolute":
        entry["kind"] = row.kind
    if row.index != expected:
        entry["index"] = row.index
    for key in ("alpha", "d", "beta", "theta", "r"):
        value = getattr(row, key)
        if value is not None:
            entry[key] = tables.spelled(value) if AXES[key][0] == "r" else value
    entry |= tables.finite_limits(row)
    if row.inertia is not None:
        entry["inertia"] = list(row.inertia)
    return entry
