"""Description of a parallel robot: a platform and its legs, each a serial chain from base to platform.

    closure of leg k:   tip_k(q_k) = P · attachment_k        (six equations where the leg is rigid with the platform,
                                                              three where a spherical joint ends it)

Nothing is planar or symmetric by construction: a planar robot is one whose loops leave x, y and rz. The virtual tree of
the papers (Khalil & Ibrahim 2007; Briot, Gautier & Krut 2013) is all legs side by side, and the free platform.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NoReturn

import numpy as np

from calib.errors import refuse_robot
from calib.records import Frozen
from calib.robot.chain import GRAVITY, Chain, Joint

COORDINATES = ("x", "y", "z", "rx", "ry", "rz")
FORCES = ("N", "N", "N", "N m", "N m", "N m")
ENDS = ("rigid", "spherical")


@dataclass(frozen=True, eq=False)
class Leg(Frozen):
    """One serial chain from the base to the platform.

    Attributes:
        name: of the leg.
        chain: its joints, from the robot's base to its end; the first element holds its place in the base.
        actuated: which of its joints have a motor and an encoder.
        home: (n,) joint values near those that close its loop at the platform's home: they choose the branch.
        attachment: (4, 4) where the platform holds its end, in the platform's frame.
        end: ``rigid``: the last link is the platform, all passive joints are in the chain; ``spherical``: a joint of
            three freedoms ends it, which the chain leaves out.
    """

    name: str
    chain: Chain
    actuated: tuple[int, ...]
    home: np.ndarray
    attachment: np.ndarray
    end: str = "rigid"

    def __post_init__(self) -> None:
        super().__post_init__()
        place, n = f"leg '{self.name}'", self.chain.n
        if self.end not in ENDS:
            refuse_robot(place, f"its end '{self.end}' is neither {' nor '.join(ENDS)}")
        if self.home.shape != (n,):
            refuse_robot(place, f"home has {self.home.size} values for its {n} joints")
        if n > self.held:
            refuse_robot(
                place,
                f"{n} joints behind a {self.end} end leave motions that no loop determines; at most {self.held} can be "
                "solved for",
            )

    @property
    def held(self) -> int:
        """Number of closure equations of the leg."""
        return 6 if self.end == "rigid" else 3

    @property
    def bodies(self) -> int:
        """Number of the leg's links that are separate bodies: the last one of a rigid end is the platform."""
        return self.chain.n - (self.end == "rigid")


@dataclass(frozen=True, eq=False)
class ParallelRobot(Frozen):
    """A parallel robot: its legs and platform.

    Attributes:
        name: of the robot.
        legs: in the order of the file; actuated joints are numbered through them.
        freedom: the platform's independent coordinates, of `COORDINATES`: position of its frame's origin [m] and
            roll-pitch-yaw from the base's axes [rad], both from `home`; v and forces along them are parts of its twist
            and wrench, in the base's axes.
        home: (4, 4) the platform's home in the base.
        lower, upper: (r,) box of platform coordinates in which states are drawn and motions designed.
        platform: (10,) its standard parameters about its frame; None where unknown.
        gravity: (3,) in the base frame [m/s²].
    """

    name: str
    legs: tuple[Leg, ...]
    freedom: tuple[str, ...]
    home: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    platform: np.ndarray | None = None
    gravity: np.ndarray = field(default_factory=lambda: np.array(GRAVITY))
    links = ()  # names of a URDF's, which there is none of

    def __post_init__(self) -> None:
        super().__post_init__()
        freedom = ", ".join(self.freedom)
        names = [leg.name for leg in self.legs]
        if twice := sorted({name for name in names if names.count(name) > 1}):
            self.refuse(f"two legs are called '{twice[0]}'")
        if not freedom or not set(self.freedom) <= set(COORDINATES) or len(set(self.freedom)) < self.r:
            self.refuse(
                f"freedom {freedom or 'is empty'}; it names the platform's independent coordinates, each once, of "
                f"{', '.join(COORDINATES)}"
            )
        if self.n < self.r:
            self.refuse(f"{self.n} actuated joints cannot hold a platform of {self.r} freedoms ({freedom})")
        if self.lower.shape != (self.r,) or self.upper.shape != (self.r,) or not (self.lower < self.upper).all():
            self.refuse(
                f"the platform's limits need one lower and one higher upper value per coordinate ({freedom}); found "
                f"{self.lower.tolist()} and {self.upper.tolist()}"
            )

    def refuse(self, words: str) -> NoReturn:
        """Refuse the robot for the reason `words`."""
        refuse_robot(f"robot '{self.name}'", words)

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
        """Whether it has more actuators than freedoms."""
        return self.n > self.r

    @cached_property
    def selected(self) -> np.ndarray:
        """Indices (r,) of the independent components of the platform's twist."""
        return np.array([COORDINATES.index(name) for name in self.freedom])

    @cached_property
    def starts(self) -> np.ndarray:
        """Index (L + 1,) of each leg's first joint among all joints of the tree; the last entry is their number."""
        return np.concatenate([[0], np.cumsum([leg.chain.n for leg in self.legs])]).astype(int)

    @cached_property
    def actuated(self) -> np.ndarray:
        """Indices (n,) of the actuated joints among all joints of the tree."""
        return np.array([self.starts[k] + j for k, leg in enumerate(self.legs) for j in leg.actuated], dtype=int)

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
        return tuple(
            f"{j + 1}.{k + 1}" if wide else f"{j + 1}{k + 1}"
            for k, leg in enumerate(self.legs)
            for j in range(leg.chain.n)
        )

    @property
    def platform_label(self) -> str:
        """Label of the platform's parameters: the number after the legs' last joints."""
        return str(max(leg.chain.n for leg in self.legs) + 1)

    def with_legs(self, legs: tuple[Leg, ...]) -> ParallelRobot:
        """Return the robot with other legs: another geometry."""
        return replace(self, legs=legs)
