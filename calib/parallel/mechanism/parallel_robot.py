"""A parallel robot and its TOML file: legs as MDH tables, platform, and attachment of each leg.

kind = "parallel"                # required: distinguishes it from a serial arm
name = "dualv"
gravity = [0, 0, -9.81]          # in the base frame [m/s²]
source = "where the numbers come from"

[platform]
freedom = ["x", "y", "rz"]       # its independent coordinates: of x y z (position) rx ry rz (about the base's axes)
lower = [-0.1, -0.1, "-30 deg"]  # box of them around home in which states are drawn and motions designed
upper = [0.1, 0.1, "30 deg"]
home = {xyz = [0, 0, 0], rpy = [0, 0, 0]}   # in the base; default the identity
inertia = [XX, XY, XZ, YY, YZ, ZZ, MX, MY, MZ, M]   # about its frame, optional

[[leg]]                          # one table per leg
name = "leg1"                    # default leg1 leg2 ...
base = {xyz = [0.4, 0.1, 0], rpy = [0, 0, 0]}       # where its first row stands in the base; default the identity
attachment = {xyz = [0, 0.11, 0]}                   # where the platform holds its end, in the platform's frame
end = "rigid"                    # the last row's link is the platform; or "spherical": a ball joint behind it
actuated = ["motor1"]            # names of its joints with a motor and an encoder
home = ["130 deg", "-90 deg", 0] # joint values that close its loop at home; Newton's start, so a degree is enough
tail = {xyz = [0, 0, 0.1]}       # what follows its last row, optional

[[leg.joint]]                    # its rows: keys of an MDH table (calib.robot.mdh), limits and inertia included
name = "motor1"
d = 0.28
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import NoReturn

import numpy as np
from scipy.spatial.transform import Rotation

from calib import files
from calib.config_types import shown
from calib.errors import refuse_robot, suggestion
from calib.records import Frozen, frozen
from calib.robot import mdh
from calib.robot.chain import GRAVITY, Chain, Joint
from calib.robot.tables import check_keys, dumps, load, number, placement, placement_table, spelled, vector, word

COORDINATES = ("x", "y", "z", "rx", "ry", "rz")
FORCES = ("N", "N", "N", "N m", "N m", "N m")
ENDS = ("rigid", "spherical")


@dataclass(frozen=True, eq=False)
class Leg(Frozen):
    """A serial chain from the base to the platform.

    Attributes:
        name: name of the leg.
        chain: the leg's joints from the robot's base to the leg's end; the first element contains the leg's pose in the
            base.
        actuated: indices of the joints with a motor and an encoder.
        home: (n,) joint values near those that close the loop with the platform at home; they select the branch.
        attachment: (4, 4) pose of the leg's end in the platform's frame.
        end: ``rigid``: the chain contains all joints, and its last link is the platform; ``spherical``: a ball joint,
            which is not part of the chain, connects the chain's last link to the platform.
    """

    name: str
    chain: Chain
    actuated: tuple[int, ...]
    home: np.ndarray
    attachment: np.ndarray
    end: str = "rigid"

    def __post_init__(self) -> None:
        super().__post_init__()
        location = f"leg '{self.name}'"
        n = self.chain.n
        if self.end not in ENDS:
            refuse_robot(location, f"its end '{self.end}' is neither {' nor '.join(ENDS)}")
        if self.home.shape != (n,):
            refuse_robot(location, f"home has {self.home.size} values for its {n} joints: state one per joint")
        if n > self.held:
            refuse_robot(
                location,
                f"{n} joints behind a {self.end} end leave motions that no loop determines; at most {self.held} can be "
                "solved for",
            )

    @property
    def held(self) -> int:
        """Number of closure equations of the leg."""
        return 6 if self.end == "rigid" else 3

    @property
    def bodies(self) -> int:
        """Number of the leg's links that are separate bodies; the last link of a rigid end is the platform."""
        return self.chain.n - (self.end == "rigid")


@dataclass(frozen=True, eq=False)
class ParallelRobot(Frozen):
    """A parallel robot: its legs and platform.

        closure of leg k:   tip_k(q_k) = P · attachment_k    (six equations where the leg is rigid with the platform,
                                                              three where a spherical joint ends it)

    Robots need not be planar or symmetric; in a planar robot the loops allow motions in x, y and rz only. All legs
    without the loops' closures, and the platform as a free body, are called the tree (Khalil & Ibrahim 2007; Briot,
    Gautier & Krut 2013).

    Attributes:
        name: name of the robot.
        legs: the legs in the order of the file; actuated joints are numbered in this order.
        freedom: names, out of `COORDINATES`, of the platform's independent coordinates: position of its frame's origin
            [m] and roll-pitch-yaw angles about the base's axes [rad], both relative to `home`. The platform's velocity
            and force along these coordinates are components of its twist and wrench in the base's axes.
        home: (4, 4) pose of the platform at home, in the base.
        lower, upper: (r,) box of platform coordinates in which random states are drawn and motions designed.
        platform: (10,) standard parameters of the platform about its frame; None where unknown.
        gravity: (3,) gravity in the base's frame [m/s²].
    """

    name: str
    legs: tuple[Leg, ...]
    freedom: tuple[str, ...]
    home: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    platform: np.ndarray | None = None
    gravity: np.ndarray = field(default_factory=lambda: np.array(GRAVITY))
    # Names of a URDF's links; a parallel robot has no URDF.
    links = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        freedom = ", ".join(self.freedom)
        names = [leg.name for leg in self.legs]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            self.refuse(f"two legs are called '{twice[0]}': rename one")
        if not freedom or not set(self.freedom) <= set(COORDINATES) or len(set(self.freedom)) < self.r:
            self.refuse(
                f"freedom {freedom or 'is empty'}; it names the platform's independent coordinates, each once, of "
                f"{', '.join(COORDINATES)}"
            )
        if self.n < self.r:
            self.refuse(
                f"{self.n} actuated joints cannot hold a platform of {self.r} freedoms ({freedom}): actuate more joints"
            )
        if self.lower.shape != (self.r,) or self.upper.shape != (self.r,) or not (self.lower < self.upper).all():
            self.refuse(
                f"the platform's limits need one lower and one higher upper value per coordinate ({freedom}); found "
                f"{self.lower.tolist()} and {self.upper.tolist()}"
            )

    def refuse(self, message: str) -> NoReturn:
        """Raise RobotError about the robot, with the given message."""
        refuse_robot(f"robot '{self.name}'", message)

    @property
    def r(self) -> int:
        """Number of the platform's freedoms."""
        return len(self.freedom)

    @property
    def n(self) -> int:
        """Number of actuated joints."""
        return sum(len(leg.actuated) for leg in self.legs)

    @property
    def redundant(self) -> bool:
        """Whether the robot has more actuators than freedoms."""
        return self.n > self.r

    @cached_property
    def selected(self) -> np.ndarray:
        """Indices (r,) of the independent components of the platform's twist."""
        return np.array([COORDINATES.index(name) for name in self.freedom])

    @cached_property
    def starts(self) -> np.ndarray:
        """Index (L + 1,) of each leg's first joint among all joints of the tree; the last entry is their number."""
        counts = [leg.chain.n for leg in self.legs]
        return np.concatenate([[0], np.cumsum(counts)]).astype(int)

    @cached_property
    def actuated(self) -> np.ndarray:
        """Indices (n,) of the actuated joints among all joints of the tree."""
        indices: list[int] = []
        for start, leg in zip(self.starts, self.legs):
            indices += [start + joint for joint in leg.actuated]
        return np.array(indices, dtype=int)

    @property
    def joints(self) -> tuple[Joint, ...]:
        """The actuated joints."""
        return tuple(leg.chain.joints[j] for leg in self.legs for j in leg.actuated)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the actuated joints."""
        return tuple(joint.name for joint in self.joints)

    @property
    def labels(self) -> tuple[str, ...]:
        """Labels of the tree's joints: joint j of leg k is ``jk``, as in the papers (``j.k`` above 9)."""
        wide = len(self.legs) > 9 or max(leg.chain.n for leg in self.legs) > 9
        separator = "." if wide else ""
        labels: list[str] = []
        for count, leg in enumerate(self.legs, 1):
            labels += [f"{joint}{separator}{count}" for joint in range(1, leg.chain.n + 1)]
        return tuple(labels)

    @property
    def platform_label(self) -> str:
        """Label of the platform's parameters: the number after the legs' last joints."""
        return str(max(leg.chain.n for leg in self.legs) + 1)

    def with_legs(self, legs: tuple[Leg, ...]) -> ParallelRobot:
        """Return the robot with its legs replaced, e.g. by calibrated ones."""
        return replace(self, legs=legs)

    def tilted(self, turn: np.ndarray) -> ParallelRobot:
        """Return the robot with gravity turned by a rotation vector (3,) [rad] in the base's axes."""
        gravity = Rotation.from_rotvec(turn).apply(np.array(self.gravity))
        legs = tuple(replace(leg, chain=replace(leg.chain, gravity=gravity)) for leg in self.legs)
        return replace(self, legs=legs, gravity=gravity)


KIND = "parallel"
TOP = ("kind", "name", "gravity", "source", "platform", "leg", "provenance")
_PLATFORM = ("freedom", "lower", "upper", "home", "inertia")
_LEG = ("name", "base", "attachment", "end", "actuated", "home", "tail", "joint")


def library() -> dict[str, Path]:
    """Return the files of the shipped parallel robots, by name."""
    return {path.stem: path for path in sorted(Path(__file__).with_name("library").glob("*.toml"))}


def is_parallel(path: str | Path) -> bool:
    """Return whether a TOML file contains ``kind = "parallel"`` or ``[[leg]]`` tables."""
    table = load(path)
    return table.get("kind") == KIND or "leg" in table


def read(path: str | Path) -> ParallelRobot:
    """Return the parallel robot of a TOML file (schema above), without solving its loops (`closure.closed`).

    Raises:
        RobotError: naming the table, the key and what is wrong with it.
    """
    return _from_table(load(path), str(path))


def _from_table(table: Mapping[str, object], where: str) -> ParallelRobot:
    """Return the robot of a parsed table; `where` names it in messages."""
    check_keys(table, TOP, where)
    if table.get("kind") != KIND:
        refuse_robot(
            where, f'kind is {shown(table.get("kind"))}; for a robot with legs and a platform state kind = "parallel"'
        )
    gravity = vector(table.get("gravity", list(GRAVITY)), 3, f"{where}, gravity")
    platform = table.get("platform")
    location = f"{where}, [platform]"
    if not isinstance(platform, Mapping):
        refuse_robot(where, "no [platform] table found")
    check_keys(platform, _PLATFORM, location)
    freedom = _words(platform.get("freedom"), f"{location}, freedom")
    turns = [name in COORDINATES[3:] for name in freedom]
    legs = table.get("leg")
    if not isinstance(legs, list) or not legs or not all(isinstance(leg, Mapping) for leg in legs):
        refuse_robot(where, "no [[leg]] tables found; a parallel robot needs one per leg")
    name = word(table, "name", where)
    parsed_legs = [_leg(leg, k, gravity, where) for k, leg in enumerate(legs)]
    home = placement(platform.get("home", {}), f"{location}, home")
    lower = _values(platform.get("lower"), turns, f"{location}, lower", "coordinate of freedom")
    upper = _values(platform.get("upper"), turns, f"{location}, upper", "coordinate of freedom")
    inertia = None
    if "inertia" in platform:
        inertia = frozen(vector(platform["inertia"], 10, f"{location}, inertia"))
    return ParallelRobot(
        name=name,
        legs=tuple(parsed_legs),
        freedom=freedom,
        home=home,
        lower=lower,
        upper=upper,
        platform=inertia,
        gravity=gravity,
    )


def write(
    path: str | Path, robot: ParallelRobot, source: str = "", provenance: Mapping[str, object] | None = None
) -> Path:
    """Write a parallel robot as a TOML file that `read` reproduces to the last bit."""
    table = to_table(robot, source)
    if provenance:
        table["provenance"] = provenance
    return files.write(path, dumps(table))


def to_table(robot: ParallelRobot, source: str = "") -> dict[str, object]:
    """Return the table of a robot's TOML file (schema above); reading it gives exactly the same robot."""
    table: dict[str, object] = {"kind": KIND, "name": robot.name, "gravity": robot.gravity.tolist()}
    if source:
        table["source"] = source
    table["platform"] = {
        "freedom": list(robot.freedom),
        "lower": robot.lower.tolist(),
        "upper": robot.upper.tolist(),
        "home": placement_table(robot.home),
    }
    if robot.platform is not None:
        table["platform"]["inertia"] = robot.platform.tolist()
    table["leg"] = [_leg_table(leg) for leg in robot.legs]
    return table


def _leg(entry: Mapping[str, object], number_: int, gravity: np.ndarray, where: str) -> Leg:
    location = f"{where}, [[leg]] number {number_ + 1}"
    check_keys(entry, _LEG, location)
    name = word(entry, "name", location, f"leg{number_ + 1}")
    location = f"{location} ('{name}')"
    rows = {"name": name, "joint": entry.get("joint"), "gravity": gravity.tolist(), "propose_beta": False}
    if "tail" in entry:
        rows["tail"] = entry["tail"]
    chain = _based(mdh.from_table(rows, location), placement(entry.get("base", {}), f"{location}, base"))
    turns = [joint.kind == "revolute" for joint in chain.joints]
    actuated = _actuated(entry, chain, location)
    home = _values(entry.get("home", [0.0] * chain.n), turns, f"{location}, home", "joint")
    attachment = placement(entry.get("attachment", {}), f"{location}, attachment")
    end = word(entry, "end", location, "rigid")
    return Leg(name, chain, actuated, home, attachment, end)


def _based(chain: Chain, base: np.ndarray) -> Chain:
    """Return the chain with a placement before its first element."""
    first = replace(chain.elements[0], placement=None if np.array_equal(base, np.eye(4)) else base)
    return replace(chain, elements=(first, *chain.elements[1:]))


def _actuated(entry: Mapping[str, object], chain: Chain, location: str) -> tuple[int, ...]:
    names = _words(entry.get("actuated", []), f"{location}, actuated")
    for name in names:
        if name not in chain.joint_names:
            advice = suggestion(name, chain.joint_names)
            refuse_robot(
                location, f"actuated '{name}' is not one of its joints{advice}: {', '.join(chain.joint_names)}"
            )
    return tuple(sorted({chain.joint_names.index(name) for name in names}))


def _words(value: object, where: str) -> tuple[str, ...]:
    if not isinstance(value, list) or not all(isinstance(item, str) for item in value):
        refuse_robot(where, f"expected a list of names, found {shown(value)}")
    return tuple(value)


def _values(values: object, turns: Sequence[bool], location: str, quantity: str) -> np.ndarray:
    """Return parsed values (k,) of a list in a TOML file.

    Args:
        values: the list: numbers, or texts with a unit.
        turns: (k,) whether each value is an angle [rad] instead of a length [m].
        location: place in the file, for messages.
        quantity: what each value belongs to (joint, coordinate), for messages.
    """
    if not isinstance(values, list) or len(values) != len(turns):
        refuse_robot(location, f"expected one value per {quantity}, {len(turns)}; found {shown(values)}")
    parsed = []
    for value, turn in zip(values, turns):
        unit = "angle" if turn else "length"
        parsed.append(number(value, location, unit))
    return np.array(parsed)


def _leg_table(leg: Leg) -> dict[str, object]:
    base = leg.chain.elements[0].placement
    chain_table = mdh.to_table(_based(leg.chain, np.eye(4)))
    table: dict[str, object] = {"name": leg.name}
    if base is not None:
        table["base"] = placement_table(base)
    table |= {"attachment": placement_table(leg.attachment), "end": leg.end}
    table["actuated"] = [leg.chain.joint_names[j] for j in leg.actuated]
    table["home"] = [spelled(float(value)) for value in leg.home]
    if "tail" in chain_table:
        table["tail"] = chain_table["tail"]
    table["joint"] = chain_table["joint"]
    return table
