"""Torque rows that a model explains: a linear map of joint torques, for regressors and measured torques.

With torque sensors in the joints (Kolyubin, Shiriaev, Jubien 2019, section 6.2) there are four kinds of rows, where tau
are the motor torques and tau_l the torques of the sensors on the link side of the gears:

    MOTOR   tau             bodies and all drive terms (a robot without such sensors)
    LINK    tau_l           Model 1: bodies and link-side terms
    BOTH    [tau_l; tau]    Model 2: bodies and link-side terms in both halves, motor-side terms in the second
    DRIVE   tau - tau_l     Model 3: motor-side terms alone

`projected` makes further kinds of rows from these: torques on the actuated or platform coordinates of a closed chain,
Gᵀ tau, or the power alone, vᵀ tau (`power`).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from itertools import groupby

import numpy as np

from calib.errors import CalibError, one_of

BODIES = "bodies"
"""The side of a column that is a body's parameter."""

Map = Callable[[np.ndarray, np.ndarray], np.ndarray]


@dataclass(frozen=True)
class _JointBlock:
    """Block of torque rows with one row per joint.

    Attributes:
        prefix: prefix of the rows' labels.
        sides: kinds of columns that affect the rows: ``bodies``, drive terms of the ``link`` side, drive terms of the
            ``motor`` side.
        motor, sensor: factors of the measured torques in a row: motor · tau + sensor · tau_l.
        suffix: suffix of the rows' full names, after the joint's name.
    """

    prefix: str
    sides: frozenset[str]
    motor: float = 0.0
    sensor: float = 0.0
    suffix: str = ""


@dataclass(frozen=True)
class Projection:
    """A linear map of joint torque rows to other rows, which may depend on the state.

    Attributes:
        labels, units: labels and units of the projected rows.
        torques: function of q, v (N, n) that returns the map (N, rows, k) for the k joint rows of a regressor.
        measured: function of q, v (N, n) that returns the map (N, rows, k) for the k measured torques; None: `torques`.
    """

    labels: tuple[str, ...]
    units: tuple[str, ...]
    torques: Map
    measured: Map | None = None


@dataclass(frozen=True)
class TorqueRows:
    """Definition of the torques that a model explains, for any number of joints.

    Attributes:
        name: name in options and files.
        blocks: blocks of rows, each with one row per joint.
        drives: names of the standard drive terms of a joint that these rows can identify
            (`calib.dynamics.drives.standard`).
        projection: linear map applied to the rows of the blocks; None: the rows are those of the blocks.
    """

    name: str
    blocks: tuple[_JointBlock, ...]
    drives: str
    projection: Projection | None = None

    @property
    def sides(self) -> frozenset[str]:
        """Kinds of columns that affect any row: ``bodies``, ``link``, ``motor``."""
        return frozenset().union(*(block.sides for block in self.blocks))

    @property
    def has_bodies(self) -> bool:
        """Whether the rows depend on the parameters of the bodies."""
        return BODIES in self.sides

    @property
    def sensed(self) -> bool:
        """Whether the rows need torques of sensors on the link side of the gears."""
        return any(block.sensor for block in self.blocks)

    @property
    def driven(self) -> bool:
        """Whether the rows need the motors' torques."""
        return any(block.motor for block in self.blocks)

    @property
    def motors_alone(self) -> bool:
        """Whether the rows are exactly the motor torques, one per joint."""
        return self.projection is None and self.with_motors and len(self.blocks) == 1

    @property
    def with_motors(self) -> bool:
        """Whether the last n rows are the complete motor torques (bodies and all drive terms), one per joint."""
        block = self.blocks[-1]
        return self.projection is None and block.motor == 1.0 and block.sensor == 0.0 and BODIES in block.sides

    def count(self, n: int) -> int:
        """Return the number of rows per sample for n joints."""
        if self.projection is not None:
            return len(self.projection.labels)
        return n * len(self.blocks)

    def of_side(self, side: str, joint: int, n: int) -> list[int]:
        """Return the indices of the rows that a drive term of `joint` affects.

        Args:
            side: ``link`` or ``motor`` side of the term.
            joint: joint, from 0.
            n: number of joints.
        """
        return [k * n + joint for k, block in enumerate(self.blocks) if side in block.sides]

    def labels(self, joints: Sequence[str]) -> tuple[str, ...]:
        """Return the labels of the rows for tables, from the labels of the joints."""
        if self.projection is not None:
            return self.projection.labels
        return tuple(block.prefix + joint for block in self.blocks for joint in joints)

    def numbered(self, n: int) -> tuple[str, ...]:
        """Return the labels of the rows for joints that are numbered 1 to n."""
        return self.labels([str(number) for number in range(1, n + 1)])

    def titles(self, joints: Sequence[str]) -> tuple[str, ...]:
        """Return the full names of the rows, from the names of the joints."""
        if self.projection is not None:
            return self.projection.labels
        return tuple(joint + block.suffix for block in self.blocks for joint in joints)

    def units(self, prismatic: Sequence[bool]) -> tuple[str, ...]:
        """Return the unit of each row: N m or N, or the projection's units.

        Args:
            prismatic: (n,) whether each joint is prismatic.
        """
        if self.projection is not None:
            return self.projection.units
        joint_units = ["N" if linear else "N m" for linear in prismatic]
        return tuple(joint_units * len(self.blocks))

    def of_joints(self, mask: np.ndarray) -> np.ndarray:
        """Return flags of rows (N, rows) from `mask`, flags of joints (N, n).

        A projected row is flagged if all joints are.
        """
        if self.projection is not None:
            of_sample = mask.all(axis=1, keepdims=True)
            return np.repeat(of_sample, len(self.projection.labels), axis=1)
        return np.tile(mask, (1, len(self.blocks)))

    def observe(self, torques: np.ndarray, sides: Sequence[str], q: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Return the torque rows (N, rows, p) for columns of joint torques (N, n, p), with the columns' memory order.

        Args:
            torques: regressor of the n joint torques, or joint torques themselves as columns.
            sides: (p,) side of each column: ``bodies``, ``link`` or ``motor``.
            q, v: (N, n) the motion [rad or m, and per s].
        """
        if len(self.blocks) == 1 and set(sides) <= self.sides:
            return self._projected(torques, q, v)
        samples, n, p = torques.shape
        columns = np.zeros((p, len(self.blocks) * n, samples))
        columns[:, :n] = torques.transpose(2, 1, 0)
        return self.observe_in_place(columns, sides, q, v)

    def observe_in_place(self, columns: np.ndarray, sides: Sequence[str], q: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Return the torque rows (N, rows, p) as `observe` does, but overwrite the columns, which saves a copy.

        Args:
            columns: (p, n per block, N) regressor columns: joint torques in the first n rows, zero in the rows of other
                blocks.
            sides: (p,) side of each column: ``bodies``, ``link`` or ``motor``.
            q, v: (N, n) the motion [rad or m, and per s].
        """
        n = columns.shape[1] // len(self.blocks)
        # Backwards: the first block holds the joint torques that the others copy.
        for k in reversed(range(len(self.blocks))):
            start = 0
            for acts, run in groupby(side in self.blocks[k].sides for side in sides):
                part = slice(start, start + len(list(run)))
                start = part.stop
                if k and acts:
                    columns[part, k * n : (k + 1) * n] = columns[part, :n]
                elif not k and not acts:
                    columns[part, :n] = 0.0
        return self._projected(columns.transpose(2, 1, 0), q, v)

    def _projected(self, torques: np.ndarray, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Return the rows of the blocks `torques` (N, k, p), multiplied by the projection at q, v (N, n), if any."""
        if self.projection is None:
            return torques
        return self.projection.torques(q, v) @ torques

    def fold(self, weights: np.ndarray, sides: Sequence[str]) -> np.ndarray:
        """Return weights of joint torques (N, n, p) from weights of rows (N, rows, p): the adjoint map of `observe`.

        Args:
            weights: (N, rows, p) weight of each entry of the rows.
            sides: (p,) side of each column: ``bodies``, ``link`` or ``motor``.

        Raises:
            CalibError: for rows with a projection, whose derivative with respect to the state is not implemented.
        """
        if self.projection is not None:
            raise CalibError(
                f"rows '{self.name}' use a projection that depends on the state and have no derivatives: use other rows"
            )
        acting = []
        for block in self.blocks:
            acts = [side in block.sides for side in sides]
            acting.append(np.array(acts, dtype=bool))
        if len(acting) == 1 and acting[0].all():
            return weights
        n = weights.shape[1] // len(self.blocks)
        parts = [weights[:, k * n : (k + 1) * n] * mask for k, mask in enumerate(acting)]
        # Added backwards, in the weights' memory order.
        return reduce(np.add, parts[::-1])

    def target(self, motor: np.ndarray, sensor: np.ndarray | None, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Return the measured torques of the rows (N, rows).

        Args:
            motor: (N, n) the motors' torques [N m or N].
            sensor: (N, n) torques of sensors on the link side of the gears; None without sensors.
            q, v: (N, n) the motion [rad or m, and per s].

        Raises:
            CalibError: if the rows need sensor torques and there are none.
        """
        if sensor is None and self.sensed:
            raise CalibError(f"rows '{self.name}' need torques of sensors behind the gears")
        parts = []
        for block in self.blocks:
            part = np.zeros_like(motor)
            if block.motor:
                part = block.motor * motor
            if block.sensor and sensor is not None:
                part = part + block.sensor * sensor
            parts.append(part)
        stacked = np.hstack(parts)
        if self.projection is None:
            return stacked
        projection = self.projection.measured or self.projection.torques
        return np.einsum("nrk,nk->nr", projection(q, v), stacked)

    def repeated(self, n: int) -> np.ndarray:
        """Return for each row (rows,) the index of a row from which its entries can be copied, or its own index.

        For several blocks it is the joint's row in the last block; a copied entry is one that both rows have.
        """
        rows = np.arange(self.count(n))
        if self.projection is not None:
            return rows
        return rows % n + n * (len(self.blocks) - 1)


def projected(name: str, projection: Projection, of: TorqueRows | None = None) -> TorqueRows:
    """Return torque rows that project other rows onto fewer coordinates.

    Args:
        name: name of the new rows in options and files.
        projection: the linear map.
        of: rows that are projected; None: the motor torques.
    """
    return replace(of or MOTOR, name=name, projection=projection)


def torque_rows(name: str) -> TorqueRows:
    """Return the torque rows with this name in options and files.

    Raises:
        CalibError: for a name that is not a key of `ROWS`.
    """
    one_of(name, ROWS, "model kind")
    return ROWS[name]


_LINK = frozenset({BODIES, "link"})
_MOTOR = frozenset({"motor"})
MOTOR = TorqueRows("motor", (_JointBlock("", _LINK | _MOTOR, motor=1.0),), "Ia Fv Fc off")
LINK = TorqueRows("link", (_JointBlock("", _LINK, sensor=1.0, suffix=" sensor"),), "Fvl Fcl offl")
BOTH = TorqueRows(
    "both",
    (
        _JointBlock("l", _LINK, sensor=1.0, suffix=" sensor"),
        _JointBlock("m", _LINK | _MOTOR, motor=1.0, suffix=" motor"),
    ),
    "Ia Fvl Fcl offl Fvm Fcm offm",
)
DRIVE = TorqueRows("drive", (_JointBlock("", _MOTOR, motor=1.0, sensor=-1.0),), "Ia Fvm Fcm offm")
MODELS = {1: LINK, 2: BOTH, 3: DRIVE}
"""Torque rows as the 2019 paper numbers them."""


def _power_of(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Return the map (N, 1, n) from joint torques to their power, for velocities v (N, n)."""
    return v[:, None, :]


POWER = projected("power", Projection(("power",), ("W",), _power_of))
"""One row: the power of all torques, vᵀ tau (the power identification model, Gautier 1997)."""
ROWS = {rows.name: rows for rows in (MOTOR, LINK, BOTH, DRIVE, POWER)}
