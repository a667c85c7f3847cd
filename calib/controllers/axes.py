"""Which joints of a robot are the axes of a controller's arm, and which are external axes.

A controller's arm has six turning axes, or the four of a SCARA, the third of which slides. Further joints of a
description are external axes, such as the rail that carries the arm, or a positioner: E1 to E6 in KRL, extax in RAPID,
E1 of the arm's group or a second group in TP, base axes and stations in INFORM. A description has them before or
behind the arm's joints, a program behind the arm's axes. Sliding axes are in millimetres where turning ones are in
degrees, and in metres where these are in radians.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from calib.controllers.table import Controller, controller_named
from calib.errors import UsageError, counted, one_of, require
from calib.units import ANGLES, LENGTHS, NamedJoint

TURNING = ("revolute", "continuous")
SCARA = (True, True, False, True)
"""Whether each of a SCARA's axes turns."""
SLIDING_UNITS = {"deg": "mm", "rad": "m"}
"""Unit of turning joints -> unit of sliding joints in the same program."""


@dataclass(frozen=True)
class PlainJoint:
    """A joint by its name and kind, ``revolute`` or ``prismatic``."""

    name: str
    kind: str = "revolute"


@dataclass(frozen=True)
class Axes:
    """A robot's joints as the axes of a controller.

    Attributes:
        joints: the n joints, in the description's order.
        arm, external: indices of the joints that are axes of the arm, and external axes.
    """

    joints: tuple[NamedJoint, ...]
    arm: tuple[int, ...]
    external: tuple[int, ...] = ()

    @classmethod
    def plain(cls, joints: Sequence[NamedJoint]) -> Self:
        """Return axes all of which are the arm's."""
        return cls(tuple(joints), tuple(range(len(joints))))

    @property
    def order(self) -> list[int]:
        """Indices of the joints in a program's order: those of the arm, then the external ones."""
        return [*self.arm, *self.external]

    @property
    def turning(self) -> list[bool]:
        """Whether each joint turns, in the description's order."""
        return [joint.kind in TURNING for joint in self.joints]

    @property
    def scara(self) -> bool:
        """Whether the arm is a SCARA: four axes, the third of which slides."""
        return tuple(self.turning[index] for index in self.arm) == SCARA

    def units(self, unit: str) -> list[str]:
        """Return the units of the axes in a program's order, for a controller whose turning joints are in `unit`."""
        turning = self.turning
        units = []
        for index in self.order:
            if turning[index]:
                units.append(unit)
            else:
                units.append(SLIDING_UNITS[unit])
        return units

    def labels(self) -> list[str]:
        """Return the axes' labels in a program's order: ``axis 1`` … of the arm, ``E1`` … of the external axes."""
        arm = [f"axis {number}" for number in range(1, len(self.arm) + 1)]
        external = [f"E{number}" for number in range(1, len(self.external) + 1)]
        return arm + external

    def shown(self, controller: Controller, q: np.ndarray) -> np.ndarray:
        """Return a description's joint values q (…, n) [rad or m] as the controller displays them.

        The result is in a program's order and in the controller's units.
        """
        return self._coupled(controller, q[..., self.order]) / self._sizes(controller)

    def described(self, controller: Controller, values: np.ndarray) -> np.ndarray:
        """Return a description's joint values (…, n) [rad or m] for values (…, n) that `shown` returns."""
        q = np.empty(values.shape)
        q[..., self.order] = self._uncoupled(controller, values * self._sizes(controller))
        return q

    def uncoupled(self, controller: Controller, values: np.ndarray) -> np.ndarray:
        """Return a description's joint values (…, n) for displayed ones, both in the description's order and unit."""
        q = np.empty(values.shape)
        q[..., self.order] = self._uncoupled(controller, values[..., self.order])
        return q

    def _sizes(self, controller: Controller) -> np.ndarray:
        sizes = ANGLES | LENGTHS
        units = self.units(controller.unit)
        return np.array([sizes[unit] for unit in units])

    def _matrix(self, controller: Controller) -> np.ndarray:
        """Return the matrix (n, n) from a description's values to displayed ones, both in a program's order."""
        matrix = np.eye(len(self.joints))
        count = len(self.arm)
        # axes of a SCARA are not coupled, nor are external ones
        if not self.scara:
            matrix[:count, :count] = controller.matrix(count)
        return matrix

    def _coupled(self, controller: Controller, values: np.ndarray) -> np.ndarray:
        return values @ self._matrix(controller).T

    def _uncoupled(self, controller: Controller, values: np.ndarray) -> np.ndarray:
        return values @ np.linalg.inv(self._matrix(controller)).T


def axes_of(controller: Controller, joints: Sequence[NamedJoint], external: Sequence[str] = ()) -> Axes:
    """Return which joints are a controller's axes of the arm, and which are external axes.

    External axes are those stated. Where none is stated, they are the joints beside the only six consecutive turning
    joints (or the only four of a SCARA), or beside the only six whose names are numbered from 0 or 1 on.

    Args:
        controller: the controller.
        joints: the robot's joints, in the description's order.
        external: names of the external axes, in the controller's order; a unit in brackets is ignored.

    Raises:
        UsageError: joints that the controller does not have, or external axes that have to be stated.
    """
    joints = tuple(joints)
    if not controller.axes:
        return Axes.plain(joints)
    names = [joint.name for joint in joints]
    indices = []
    for text in external:
        name, _ = named_axis(text)
        indices.append(names.index(one_of(name, names, "joint", UsageError)))
    candidates = [tuple(indices)]
    if not indices:
        candidates = _candidates(controller, joints)
    if len(candidates) == 1:
        axes = _beside(joints, candidates[0])
        if _accepted(controller, axes):
            return axes
    raise UsageError(_refusal(controller, joints, bool(indices)))


def named_axis(text: str) -> tuple[str, str]:
    """Return name and unit of an axis that is written as in a header, ``rail [mm]``; the unit is empty without one."""
    match = re.fullmatch(r"\s*(.*?)\s*(?:\[\s*([^\]]+?)\s*\])?\s*", text)
    assert match is not None
    return match[1], match[2] or ""


def named_joints(names: Sequence[str], kinds: Sequence[str]) -> list[PlainJoint]:
    """Return joints by their names and kinds."""
    return [PlainJoint(name, kind) for name, kind in zip(names, kinds, strict=True)]


def plain_axes(count: int) -> Axes:
    """Return the axes q1 … of an arm of `count` turning joints without external axes."""
    joints = [PlainJoint(f"q{number}") for number in range(1, count + 1)]
    return Axes.plain(joints)


def as_described(
    name: str, values: np.ndarray, joints: Sequence[NamedJoint] | None = None, external: Sequence[str] = ()
) -> np.ndarray:
    """Return a description's joint values or velocities (…, n) for those that a controller displays, in the same unit.

    Args:
        name: name of the controller.
        values: (…, n) displayed values, in the order of the joints.
        joints: the robot's joints; None: all turn, and are axes of the arm.
        external: names of the external axes, where the joints do not show them.

    Raises:
        UsageError: joints of which it is not clear which are coupled.
    """
    controller = controller_named(name)
    if joints is None:
        return plain_axes(values.shape[-1]).uncoupled(controller, values)
    # without coupled axes it does not matter which are external
    if not controller.coupled and not controller.signs:
        return values
    return axes_of(controller, joints, external).uncoupled(controller, values)


def check_controller(
    name: str, joints: int | Sequence[NamedJoint], pulses: Sequence[float] = (), external: Sequence[str] = ()
) -> None:
    """Check that a controller supports a robot.

    Args:
        name: name of the controller.
        joints: the robot's joints, or the number of an arm's turning joints.
        pulses: encoder pulses per degree or millimetre of each axis, the arm's first; empty: not stated.
        external: names of the external axes, where the joints do not show them.

    Raises:
        UsageError: for an unknown name, unsupported joints, or missing pulses.
    """
    controller = controller_named(name)
    if isinstance(joints, int):
        joints = plain_axes(joints).joints
    check_pulses(controller, axes_of(controller, joints, external), pulses)


def _candidates(controller: Controller, joints: tuple[NamedJoint, ...]) -> list[tuple[int, ...]]:
    """Return the sets of joints that may be the external axes; only the named one where names tell it."""
    candidates, numbered = [], []
    for count in controller.axes:
        for first in range(len(joints) - count + 1):
            external = (*range(first), *range(first + count, len(joints)))
            axes = _beside(joints, external)
            if not _accepted(controller, axes):
                continue
            candidates.append(external)
            if _is_numbered(axes):
                numbered.append(external)
    return numbered or candidates


def _beside(joints: tuple[NamedJoint, ...], external: tuple[int, ...]) -> Axes:
    """Return axes with these external ones, and all other joints as the arm's."""
    arm = [index for index in range(len(joints)) if index not in external]
    return Axes(joints, tuple(arm), external)


def _accepted(controller: Controller, axes: Axes) -> bool:
    """Return whether a controller has an arm of these axes, and as many external ones."""
    count = len(axes.arm)
    if count not in controller.axes or len(axes.external) > controller.external:
        return False
    if controller.scara and count == len(SCARA):
        return axes.scara
    return all(axes.turning[index] for index in axes.arm)


def _is_numbered(axes: Axes) -> bool:
    """Return whether the arm's joints have one name, numbered from 0 or 1 on, and no other joint has that name."""
    arm_stems, external_stems = set(), set()
    numbers = []
    for index, joint in enumerate(axes.joints):
        stem = re.sub(r"\d+", "", joint.name)
        if index in axes.external:
            external_stems.add(stem)
            continue
        arm_stems.add(stem)
        numbers.append(re.sub(r"\D+", "", joint.name))
    if len(arm_stems) != 1 or arm_stems & external_stems:
        return False
    count = len(numbers)
    return numbers in (list(map(str, range(count))), list(map(str, range(1, count + 1))))


def _refusal(controller: Controller, joints: tuple[NamedJoint, ...], is_stated: bool) -> str:
    """Return why a controller cannot have these joints, and what to state.

    Args:
        controller: the controller.
        joints: the robot's joints.
        is_stated: whether external axes were stated.
    """
    summary = f"{len(joints)} joints ({', '.join(joint.name for joint in joints)})"
    sliding = [joint.name for joint in joints if joint.kind not in TURNING]
    if sliding:
        summary += f", of which {', '.join(sliding)} slide"
    counts = list(controller.axes)
    if controller.scara and len(SCARA) in counts:
        counts.remove(len(SCARA))
    takes = " or ".join(map(str, counts))
    expected = f"{controller.title} takes {takes} turning joints"
    if controller.scara:
        expected += " or the four of a SCARA (the third slides)"
    if not controller.external:
        return f"{summary}; {expected}, and no external axes in its programs"
    expected += f", and up to {counted(controller.external, 'external axis', 'external axes')}"
    if is_stated:
        return f"{summary}; {expected}: the joints beside the stated external axes are not such an arm"
    return f"{summary}; {expected}: state which joints are external, --external NAME (session: external of [robot])"


def check_pulses(controller: Controller, axes: Axes, pulses: Sequence[float]) -> None:
    """Raise UsageError if a controller needs pulses per degree or millimetre, and not one number per axis is given."""
    count = len(axes.joints)
    message = (
        f"{controller.title} needs the pulses per degree of each of {count} axes (per mm where an axis slides), the "
        "arm's first: give them by --pulse"
    )
    require(not controller.pulses or (len(pulses) == count and all(pulses)), message, UsageError)
