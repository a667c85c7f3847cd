"""Robot model of this toolkit: a chain of elementary transforms, from an MDH table or a URDF.

    T(q) = Π_k  placement_k · exp(sign_k · axis_k · (value_k + ratio_k · q_{joint_k})) · tail

``axis_k`` is one of the six elementary motions tx ty tz rx ry rz. A calibrated robot is a chain, too.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from calib.errors import RobotError, refuse_robot, require
from calib.records import frozen

AXES = ("tx", "ty", "tz", "rx", "ry", "rz")
GRAVITY = (0.0, 0.0, -9.81)
# Least speed or effort [SI] that a description states; less is none (our choice).
MIN_LIMIT = 1e-6
# Largest plausible gravity [m/s²] (our choice).
MAX_GRAVITY = 100.0
# Largest plausible mass, moment or length [SI] (our choice).
MAX_NUMBER = 1e12
# Names of the joints of a robot that is only known by the poses of its tip: coordinates, and angles about z, y, x.
POSE_JOINTS = ("x", "y", "z", "c", "b", "a")
# Least length [m] that a stretched arm counts as.
MIN_STRETCHED_LENGTH = 0.1


def check_gravity(gravity: np.ndarray, where: str = "") -> None:
    """Raise RobotError for an implausible gravity vector (3,) [m/s²]; the message begins with the text `where`.

    Raises:
        RobotError: a vector longer than `MAX_GRAVITY`, or not finite.
    """
    if not math.hypot(*gravity) < MAX_GRAVITY:
        raise RobotError(f"{where}gravity {gravity.tolist()} is not plausible: expected about 9.81 m/s²")


@dataclass(frozen=True)
class Joint:
    """One actuated joint.

    Attributes:
        name: name of the joint.
        kind: ``revolute`` or ``prismatic``.
        lower, upper: position limits [rad or m]; infinite if unknown.
        velocity, effort: limits [rad/s or m/s], [N m or N]; infinite if unknown.
        unstated: texts of limits below `MIN_LIMIT` in the description (``velocity 0``), which count as unknown.
    """

    name: str
    kind: str = "revolute"
    lower: float = -np.inf
    upper: float = np.inf
    velocity: float = np.inf
    effort: float = np.inf
    unstated: tuple[str, ...] = field(default=(), compare=False)

    def __post_init__(self) -> None:
        if self.kind not in ("revolute", "prismatic"):
            refuse_robot(f"joint '{self.name}'", f"kind '{self.kind}' is neither 'revolute' nor 'prismatic'")
        if not self.lower < self.upper:
            refuse_robot(f"joint '{self.name}'", f"lower limit {self.lower:g} is not below the upper {self.upper:g}")
        for quantity in ("velocity", "effort"):
            limit = getattr(self, quantity)
            if not limit >= 0.0:
                refuse_robot(f"joint '{self.name}'", f"{quantity} {limit:g} is wrong: expected 0 or more")
            if limit < MIN_LIMIT:
                object.__setattr__(self, "unstated", (*self.unstated, f"{quantity} {limit:g}"))
                object.__setattr__(self, quantity, np.inf)

    @property
    def unit(self) -> str:
        return "rad" if self.kind == "revolute" else "m"

    @property
    def unlimited(self) -> bool:
        """Whether the joint is revolute without position limits."""
        return self.kind == "revolute" and not np.isfinite([self.lower, self.upper]).any()


@dataclass(frozen=True)
class Element:
    """One elementary transform ``placement · exp(sign · axis · (value + ratio · q))``.

    Attributes:
        name: name in tables, such as ``alpha3`` or ``elbow_joint.x``.
        axis: one of `AXES`.
        value: constant part of the displacement [m or rad].
        owner: index of the joint whose frame the element helps to place; n for elements after the last joint.
        joint: index of the joint that moves the element; None for a constant element.
        ratio: 1, or the multiplier of a mimic joint.
        sign: +1; -1 for a joint axis opposite to the elementary axis.
        placement: (4, 4) fixed transform before the element; None for the identity.
    """

    name: str
    axis: str
    value: float = 0.0
    owner: int = 0
    joint: int | None = None
    ratio: float = 1.0
    sign: float = 1.0
    placement: np.ndarray | None = None

    def __post_init__(self) -> None:
        if self.axis not in AXES:
            refuse_robot(f"element '{self.name}'", f"axis '{self.axis}' is not one of {', '.join(AXES)}")
        require(np.isfinite(self.value), f"element '{self.name}': value {self.value} is not finite", RobotError)
        if self.placement is not None:
            object.__setattr__(self, "placement", frozen(self.placement))

    @property
    def unit(self) -> str:
        return "m" if self.axis[0] == "t" else "rad"


@dataclass(frozen=True, eq=False)
class Chain:
    """Serial arm from ``base`` to ``tip``, without instrument and tool.

    Attributes:
        joints: the n actuated joints, in the order of q.
        elements: the K elementary transforms, base to tip.
        tail: (4, 4) constant transform after the last element.
        inertias: (n, 10) standard parameters XX XY XZ YY YZ ZZ MX MY MZ M of the body after each joint, about the frame
            right after the joint's moving element [kg m², kg m, kg]; None if unknown.
        gravity: (3,) gravity in the base frame [m/s²].
        links: names of the n links after the joints (URDF), for messages and export.
        floor: height of the floor under the arm, in the base frame [m]; the default for collision tests.
        remarks: remarks on suspicious values in the arm's description.
        ends: remarks on how the tip was chosen if the description (URDF) left the choice open, and on joints outside
            the arm.
    """

    name: str
    joints: tuple[Joint, ...]
    elements: tuple[Element, ...]
    base: str = "base"
    tip: str = "tip"
    tail: np.ndarray = field(default_factory=lambda: np.eye(4))
    inertias: np.ndarray | None = None
    gravity: np.ndarray = field(default_factory=lambda: np.array(GRAVITY))
    links: tuple[str, ...] = ()
    floor: float = 0.0
    remarks: tuple[str, ...] = ()
    ends: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "tail", frozen(self.tail))
        object.__setattr__(self, "gravity", frozen(self.gravity))
        check_gravity(self.gravity, f"'{self.name}': ")
        for field_name in ("tail", "inertias"):
            value = getattr(self, field_name)
            if value is not None and not (np.abs(value) < MAX_NUMBER).all():
                raise RobotError(
                    f"'{self.name}': {field_name} contains a number that is not finite or exceeds {MAX_NUMBER:g}"
                )
        if self.inertias is not None:
            object.__setattr__(self, "inertias", frozen(self.inertias))
        for kind, names in (("joint", self.joint_names), ("element", self.names)):
            doubled = {name for name in names if names.count(name) > 1}
            if doubled:
                refuse_robot(f"robot '{self.name}'", f"{kind} name '{sorted(doubled)[0]}' occurs twice")
        driven = {element.joint for element in self.elements if element.joint is not None}
        if driven != set(range(len(self.joints))):
            refuse_robot(f"robot '{self.name}'", "every joint must move at least one element")

    @property
    def n(self) -> int:
        """Number of actuated joints."""
        return len(self.joints)

    @property
    def joint_names(self) -> tuple[str, ...]:
        return tuple(joint.name for joint in self.joints)

    @property
    def is_free_flyer(self) -> bool:
        """Whether the joints are the coordinates of the tip's pose, since the real joints are not known."""
        return self.joint_names == POSE_JOINTS

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(element.name for element in self.elements)

    @property
    def units(self) -> tuple[str, ...]:
        return tuple(element.unit for element in self.elements)

    @property
    def values(self) -> np.ndarray:
        """Values of the K elements [m or rad]."""
        return np.array([element.value for element in self.elements])

    @property
    def lower(self) -> np.ndarray:
        return np.array([joint.lower for joint in self.joints])

    @property
    def upper(self) -> np.ndarray:
        return np.array([joint.upper for joint in self.joints])

    @cached_property
    def driven(self) -> np.ndarray:
        """Indices of the elements that joints move, including mimic followers."""
        indices = [k for k, element in enumerate(self.elements) if element.joint is not None]
        return np.array(indices, dtype=int)

    @cached_property
    def moving(self) -> np.ndarray:
        """Index (n,) of the first element that each joint moves (mimic followers are further elements)."""
        first: dict[int | None, int] = {}
        for k in self.driven.tolist():
            first.setdefault(self.elements[k].joint, k)
        return np.array([first[joint] for joint in range(self.n)], dtype=int)

    @cached_property
    def rates(self) -> np.ndarray:
        """Derivative (driven, n) of the displacement of each `driven` element by each joint value."""
        rates = np.zeros((len(self.driven), self.n))
        for row, k in zip(rates, self.driven):
            row[self.elements[k].joint] = self.elements[k].ratio
        return rates

    def with_values(self, values: np.ndarray | Mapping[str, float]) -> Chain:
        """Return the chain with new element values: an array of all K, or some by name."""
        if isinstance(values, Mapping):
            unknown = set(values) - set(self.names)
            if unknown:
                raise RobotError(
                    f"robot '{self.name}' has no element '{sorted(unknown)[0]}': give one of its element names"
                )
            values = np.array([values.get(element.name, element.value) for element in self.elements])
        elements = []
        for element, value in zip(self.elements, values, strict=True):
            elements.append(replace(element, value=float(value)))
        return replace(self, elements=tuple(elements))

    def stretched_length(self) -> float:
        """Return an upper bound of the stretched arm's length [m]: the sum of its constant translations."""
        translations = 0.0
        placements = 0.0
        for element in self.elements:
            if element.axis[0] == "t" and element.joint is None:
                translations += abs(element.value)
            if element.placement is not None:
                placements += float(np.linalg.norm(element.placement[:3, 3]))
        tail = float(np.linalg.norm(self.tail[:3, 3]))
        return max(translations + placements + tail, MIN_STRETCHED_LENGTH)

    def sampling_limits(self) -> tuple[np.ndarray, np.ndarray]:
        """Return finite lower and upper joint limits (n,); ±π or ±1 m for joints without limits."""
        reach = np.array([np.pi if joint.kind == "revolute" else 1.0 for joint in self.joints])
        lower = np.where(np.isfinite(self.lower), self.lower, -reach)
        upper = np.where(np.isfinite(self.upper), self.upper, reach)
        return lower, upper


def random_joints(chain: Chain, count: int, seed: int | np.random.Generator = 0) -> np.ndarray:
    """Return random joint values (count, n) [rad or m], uniformly distributed within the limits.

    Args:
        chain: the arm, which provides the limits (`Chain.sampling_limits`).
        count: number of poses.
        seed: seed, or generator of random numbers.
    """
    lower, upper = chain.sampling_limits()
    return np.random.default_rng(seed).uniform(lower, upper, (count, chain.n))


def element_length(chain: Chain, k: int) -> float:
    """Return the constant displacement along the translation element k [m], including its part of the placement.

    A URDF's joint origin is a placement followed by zero-valued elements, so that its lengths are in the placement. The
    result is zero for rotations and for elements that a joint moves.

    Args:
        chain: the arm.
        k: index of the element.
    """
    element = chain.elements[k]
    if element.axis[0] != "t" or element.joint is not None:
        return 0.0
    first = k
    while first > 0 and chain.elements[first].placement is None and chain.elements[first - 1].owner == element.owner:
        first -= 1
    placement = chain.elements[first].placement
    rotated = any(earlier.axis[0] == "r" for earlier in chain.elements[first:k])
    if placement is None or rotated:
        return element.value
    direction = placement[:3, AXES.index(element.axis) % 3]
    return element.value + float(direction @ placement[:3, 3])


def joint_kinds(chain: Chain) -> list[str]:
    """Return the URDF type of each joint of `chain`.

    In a chain from a URDF, a revolute joint without limits is continuous.
    """
    return ["continuous" if chain.links and joint.unlimited else joint.kind for joint in chain.joints]
