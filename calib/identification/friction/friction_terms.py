"""Friction terms of a script: any function of a joint's velocity or position, with its derivative.

    tau_j += parameter_j · f(v_j)        or        tau_j += parameter_j · f(q_j)

The parameter is identified with all others. The function is made a table over the joint's range
(`calib.identification.friction.function_tables`), so that the identified model is data: it is stored, simulated and
read back without the function. URDF and MJCF have no place for it; exports say so.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from numbers import Integral
from typing import cast

import numpy as np

from calib.dynamics.drives import LINK_SIDE, MOTOR_SIDE, STANDARD, DriveTerm, term
from calib.dynamics.shapes import STEPS
from calib.errors import UsageError, one_of, require
from calib.identification.friction.function_tables import Function, knots_of
from calib.robot.chain import Chain, Joint

# Speeds of the table as a multiple of the joint's limit, and for joints without one [rad/s, m/s] (our choice).
BEYOND_LIMIT = 2.0
FASTEST = {"revolute": 10.0, "prismatic": 5.0}
# Starts of the names of the drives' own parameters, also of those that the ladder of friction may add.
DRIVE_NAMES = {*STANDARD, *LINK_SIDE, *MOTOR_SIDE}
DRIVE_NAMES.update(offer.label for offer in itertools.chain(*STEPS.values()))
SHAPES = {"velocity": "velocity_table", "position": "position_table"}


@dataclass(frozen=True, eq=False)
class FrictionTerm:
    """A drive torque per unit of its parameter, as a function with its derivative, for `identify_dynamics`.

        arctan = calib.FrictionTerm("Fa", lambda v: np.arctan(20 * v), lambda v: 20 / (1 + (20 * v) ** 2))
        calib.identify_dynamics(robot, "log.csv", terms=[arctan])

    Attributes:
        name: start of the parameters' names; the joint's number follows, such as ``Fa3``.
        function: of velocities [rad/s or m/s], or positions [rad or m], (N,), that returns (N,) numbers. The unit of
            the parameter is N m (N for a prismatic joint) per unit of the function.
        slope: derivative of the function, of the same shapes.
        of: ``velocity`` or ``position`` of the joint.
        joints: numbers of the joints that have the term, from 1; None for all.

    Raises:
        UsageError: a name that is not an identifier or one of the drives' parameters, such as ``Fv``; joints that are
            none, repeated or no whole numbers; an argument of another kind.
    """

    name: str
    function: Function
    slope: Function
    of: str = "velocity"
    joints: Sequence[int] | None = None

    def __post_init__(self) -> None:
        require(
            isinstance(self.name, str) and self.name.isidentifier(),
            f"FrictionTerm: name {self.name!r}: expected letters, digits and _, such as 'Fa'",
            UsageError,
        )
        is_taken = self.name in DRIVE_NAMES
        message = f"FrictionTerm {self.name}: the name is already a parameter of the drives: choose another name"
        require(not is_taken, message, UsageError)
        if self.joints is not None:
            self._check_joints(self.joints)
        one_of(self.of, SHAPES, f"FrictionTerm {self.name}: of", UsageError)
        for role in ("function", "slope"):
            value = getattr(self, role)
            require(
                callable(value), f"FrictionTerm {self.name}: {role}: expected a function, found {value!r}", UsageError
            )

    def _check_joints(self, joints: object) -> None:
        """Raise a UsageError for joints other than several different whole numbers."""
        title = f"FrictionTerm {self.name}: joints"
        is_several = isinstance(joints, (Sequence, np.ndarray)) and not isinstance(joints, str) and np.ndim(joints) == 1
        require(is_several, f"{title}: expected several numbers, such as [3], found {joints!r}", UsageError)
        numbers = list(cast(Sequence[object], joints))
        require(len(numbers) > 0, f"{title}: found no joint; None stands for all", UsageError)
        for number in numbers:
            is_whole = isinstance(number, Integral) and not isinstance(number, bool)
            require(is_whole, f"{title}: expected whole numbers, found {number!r}", UsageError)
            require(numbers.count(number) == 1, f"{title}: {number} appears more than once", UsageError)

    @cached_property
    def _tables(self) -> dict[tuple[float, float], tuple[float, ...]]:
        """Tables by the ends of their range, as far as they were made."""
        return {}

    def drive_terms(self, chain: Chain) -> tuple[DriveTerm, ...]:
        """Return the term of each of its joints as a table.

        Velocities reach to twice the joint's limit, positions over its range. Beyond, the torque is constant.

        Args:
            chain: the arm, with the limits of its joints.

        Raises:
            UsageError: a joint that the arm does not have, or a function that is no friction term
                (`calib.identification.friction.function_tables.knots_of`).
        """
        numbers = self.joints
        if numbers is None:
            numbers = range(1, chain.n + 1)
        terms = []
        for number in numbers:
            if isinstance(number, bool) or number not in range(1, chain.n + 1):
                raise UsageError(f"FrictionTerm {self.name}: joint {number!r}: expected a number from 1 to {chain.n}")
            joint = chain.joints[number - 1]
            label = f"{self.name}{number}"
            table = self._table(*self._range(joint), f"FrictionTerm {self.name}, {joint.name}")
            linear = joint.kind == "prismatic"
            terms.append(term(label, SHAPES[self.of], number - 1, *table, linear=linear))
        return tuple(terms)

    def _range(self, joint: Joint) -> tuple[float, float]:
        """Return the ends of the table: of the joint's speeds, or of its positions."""
        if self.of == "velocity":
            fastest = BEYOND_LIMIT * joint.velocity
            if not math.isfinite(fastest):
                fastest = FASTEST[joint.kind]
            return -fastest, fastest
        lower, upper = joint.lower, joint.upper
        reach = 1.0
        if joint.kind == "revolute":
            reach = math.pi
        if not math.isfinite(lower):
            lower = -reach
        if not math.isfinite(upper):
            upper = reach
        return lower, upper

    def _table(self, lower: float, upper: float, title: str) -> tuple[float, ...]:
        """Return place, value and slope of each knot between lower and upper, one after the other."""
        if (lower, upper) not in self._tables:
            knots = knots_of(self.function, self.slope, lower, upper, title)
            self._tables[lower, upper] = tuple(knots.ravel().tolist())
        return self._tables[lower, upper]
