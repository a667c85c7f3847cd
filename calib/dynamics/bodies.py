"""The rigid bodies of a robot as plain arrays, the input of the compiled kernels.

A body's frame is located directly behind the element (elementary transform) that moves the body; `Chain.inertias` refer
to this frame, too:

    T_i = T_parent(i) · placement_i · exp(axis_i · scale_i · q_{coordinate_i})

with scale = sign · ratio, so that a joint that turns against its axis and the follower of a mimic joint need no special
treatment. A body without a coordinate is fixed to its parent (a payload).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, lru_cache

import numpy as np

from calib.errors import RobotError
from calib.records import frozen, shaped
from calib.robot.chain import AXES, Chain, check_gravity
from calib.transforms import pose

PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
"""Rows and columns of the moments of inertia in `STANDARD`."""
_TURNS = ((1, 2, 0), (2, 0, 1), (0, 1, 2))
"""Which axes of a body's frame are x, y, z of the kernels' frame, by moving axis."""


FIXED, REVOLUTE, PRISMATIC = 0, 1, 2
STANDARD = ("XX", "XY", "XZ", "YY", "YZ", "ZZ", "MX", "MY", "MZ", "M")
UNITS = ("kg m²",) * 6 + ("kg m",) * 3 + ("kg",)


@dataclass(frozen=True, eq=False)
class Bodies:
    """B rigid bodies with n coordinates, ordered with parents before children.

    Attributes:
        labels: (B,) suffix of a body's parameters: ``ZZ3`` is a parameter of body ``3``.
        parents: (B,) index of the parent body, -1 for the base.
        kinds: (B,) `FIXED`, `REVOLUTE` or `PRISMATIC`.
        axes: (B,) axis of the motion, 0, 1, 2 for x, y, z of the body's own frame.
        scales: (B,) sign of the joint times mimic ratio; 0 for a fixed body.
        coordinates: (B,) index of the coordinate that moves the body; -1 for a fixed body.
        placements: (B, 4, 4) pose of the body's frame in its parent's frame at q = 0.
        gravity: (3,) gravity vector in the base frame [m/s²].
        paths: (B, n) indices of all coordinates that move the body, from the base to the body, padded with -1.
        links: (B, 4 + n) parent, kind, coordinate, depth (length of the path) and path of every body, for the kernels.
        constants: (B + 1, 13) for the kernels: per body the first three rows of its placement and its scale, with
            frames turned so that each moving axis is z; the last row contains the gravity vector.
        order: (B, 10) for the kernels: indices in `STANDARD` of the parameters in the kernels' (turned) frames.
    """

    labels: tuple[str, ...]
    parents: np.ndarray
    kinds: np.ndarray
    axes: np.ndarray
    scales: np.ndarray
    coordinates: np.ndarray
    placements: np.ndarray
    gravity: np.ndarray
    paths: np.ndarray
    links: np.ndarray
    constants: np.ndarray
    order: np.ndarray

    @property
    def count(self) -> int:
        """Number of bodies."""
        return len(self.parents)

    @property
    def n(self) -> int:
        """Number of coordinates."""
        return self.paths.shape[1]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the 10·B standard parameters, body after body."""
        return tuple(name + label for label in self.labels for name in STANDARD)

    @property
    def units(self) -> tuple[str, ...]:
        """Units of the 10·B standard parameters."""
        return UNITS * self.count

    def with_gravity(self, gravity: np.ndarray) -> Bodies:
        """Return the bodies with another gravity vector (3,) in the base frame [m/s²]."""
        gravity = shaped(gravity, (3,), "gravity")
        check_gravity(gravity)
        constants = np.array(self.constants)
        constants[-1, :3] = gravity
        return replace(self, gravity=frozen(gravity), constants=frozen(constants))


def bodies_of(chain: Chain) -> Bodies:
    """Return the bodies of a chain: one body behind each moving element, including the followers of mimic joints.

    A body has the number of its joint, from 1, as label; the first follower of joint 2 is body ``2b``, the second
    ``2c``.
    """
    joint_elements = set(chain.moving.tolist())
    placement = np.eye(4)
    placements = []
    labels: list[str] = []
    for k, element in enumerate(chain.elements):
        if element.placement is not None:
            placement = placement @ element.placement
        placement = placement @ _elementary(element.axis, element.sign * element.value)
        if element.joint is not None:
            placements.append(placement)
            placement = np.eye(4)
            label = str(element.joint + 1)
            if k not in joint_elements:
                count = sum(previous.rstrip("bcdefgh") == label for previous in labels)
                label += "abcdefgh"[count]
            labels.append(label)
    kinds = []
    axes = []
    scales = []
    coordinates = []
    for k in chain.driven:
        element = chain.elements[k]
        kinds.append(REVOLUTE if element.axis[0] == "r" else PRISMATIC)
        axes.append(AXES.index(element.axis) % 3)
        scales.append(element.sign * element.ratio)
        coordinates.append(element.joint or 0)
    parents = range(-1, len(kinds) - 1)
    return _assemble(labels, parents, kinds, axes, scales, coordinates, placements, chain.gravity, chain.n)


def with_payload(bodies: Bodies, placement: np.ndarray, label: str | None = None, on: int = -1) -> Bodies:
    """Return the bodies with a payload added, which is fixed to body `on`.

    Args:
        bodies: the robot's bodies.
        placement: (4, 4) pose of the frame in which the payload's parameters are expressed, in the frame of body `on`;
            `Chain.tail` for the tip of a chain.
        label: suffix of the payload's parameters; None: the number after the last joint's, e.g. 8 on an arm of seven
            joints.
        on: index of the body that carries the payload; negative indices count from the last.

    Raises:
        RobotError: if a body with this label exists.
    """
    parent = range(bodies.count)[on]
    if label is None:
        label = str(bodies.n + 1)
    if label in bodies.labels:
        raise RobotError(f"a body '{label}' exists already; give the payload another label")
    placement = shaped(placement, (4, 4), "payload placement")
    return _assemble(
        labels=[*bodies.labels, label],
        parents=[*bodies.parents, parent],
        kinds=[*bodies.kinds, FIXED],
        axes=[*bodies.axes, 2],
        scales=[*bodies.scales, 0.0],
        coordinates=[*bodies.coordinates, -1],
        placements=[*bodies.placements, placement],
        gravity=bodies.gravity,
        n=bodies.n,
    )


def standard_parameters(chain: Chain) -> np.ndarray:
    """Return the 10·B standard parameters of `bodies_of(chain)` from the chain's inertias.

    The parameters of mimic followers are 0.

    Raises:
        RobotError: if the chain has no inertias.
    """
    if chain.inertias is None:
        raise RobotError(f"robot '{chain.name}' has no masses; add 'inertia' to its joints")
    bodies = bodies_of(chain)
    result = np.zeros((bodies.count, 10))
    for row, label in enumerate(bodies.labels):
        if label.isdigit():
            result[row] = chain.inertias[int(label) - 1]
    return result.ravel()


# Chains differ from their neighbours by one element.
@lru_cache(maxsize=1024)
def _elementary(axis: str, amount: float) -> np.ndarray:
    """Return the constant transform (4, 4) of an elementary transform, exp(axis · amount).

    Args:
        axis: "rx" to "rz" for a rotation, "tx" to "tz" for a translation.
        amount: angle [rad] or distance [m].
    """
    transform = np.eye(4)
    along = AXES.index(axis) % 3
    if axis[0] == "t":
        transform[along, 3] = amount
        return frozen(transform)
    first = (along + 1) % 3
    second = (along + 2) % 3
    transform[first, first] = np.cos(amount)
    transform[second, second] = np.cos(amount)
    transform[second, first] = np.sin(amount)
    transform[first, second] = -np.sin(amount)
    return frozen(transform)


def _assemble(
    labels: Sequence[str],
    parents: Sequence[int],
    kinds: Sequence[int],
    axes: Sequence[int],
    scales: Sequence[float],
    coordinates: Sequence[int],
    placements: Sequence[np.ndarray],
    gravity: np.ndarray,
    n: int,
) -> Bodies:
    """Return `Bodies` with read-only arrays; `paths`, `links`, `constants` and `order` are computed.

    Args:
        labels, parents, kinds, axes, scales, coordinates, placements: one entry per body, as in `Bodies`.
        gravity: (3,) gravity vector in the base frame [m/s²].
        n: number of coordinates.
    """
    count = len(labels)
    paths = np.full((count, n), -1)
    depths = np.zeros(count, dtype=int)
    for body, (parent, coordinate) in enumerate(zip(parents, coordinates)):
        path = []
        if parent >= 0:
            path = paths[parent, : depths[parent]].tolist()
        if coordinate >= 0 and coordinate not in path:
            path.append(coordinate)
        paths[body, : len(path)] = path
        depths[body] = len(path)

    # Placements between frames with axes relabelled so that the joint axis is z.
    constants = np.zeros((count + 1, 13))
    for body, (parent, axis) in enumerate(zip(parents, axes)):
        turn_before = np.eye(4)
        if parent >= 0:
            turn_before = upright_turn(axes[parent]).T
        upright = turn_before @ placements[body] @ upright_turn(axis)
        constants[body, :12] = upright[:3].ravel()
    constants[:-1, 12] = scales
    constants[-1, :3] = gravity
    links = np.column_stack([parents, kinds, coordinates, depths, paths])
    order = [_kernel_order(axis) for axis in axes]
    return Bodies(
        labels=tuple(labels),
        parents=frozen(parents, np.int64),
        kinds=frozen(kinds, np.int64),
        axes=frozen(axes, np.int64),
        scales=frozen(scales),
        coordinates=frozen(coordinates, np.int64),
        placements=frozen(placements),
        gravity=frozen(gravity),
        paths=frozen(paths, np.int64),
        links=frozen(links, np.int64),
        constants=frozen(constants),
        order=frozen(order, np.int64),
    )


@cache
def _kernel_order(axis: int) -> tuple[int, ...]:
    """Return the indices (10,) in `STANDARD` of a body's parameters in the kernels' frame, whose z is the joint axis.

    Args:
        axis: moving axis in the body's own frame, 0, 1, 2 for x, y, z.
    """
    turn = _TURNS[axis]
    order = []
    for row, column in PAIRS:
        first, second = sorted((turn[row], turn[column]))
        order.append(PAIRS.index((first, second)))
    order += [6 + turn[0], 6 + turn[1], 6 + turn[2], 9]
    return tuple(order)


@cache
def upright_turn(axis: int) -> np.ndarray:
    """Return the rotation (4, 4) from a body's frame to the kernels' frame, whose z axis is the joint axis.

    Args:
        axis: joint axis in the body's own frame, 0, 1, 2 for x, y, z.
    """
    return frozen(pose(np.eye(3)[:, _TURNS[axis]]))
