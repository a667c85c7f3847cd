"""Measurements at poses: one frozen dataclass per kind of measurement, independent of the robot.

Each kind measures the tool point p (or also the tool frame R) that the robot moves. `calib.geometry.residuals` has one
residual function for each kind.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass, fields, replace
from typing import Any, ClassVar, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from calib.errors import MeasurementError, require
from calib.records import frozen
from calib.transforms import from_quaternion, invert, to_quaternion


@dataclass(frozen=True, eq=False)
class PoseMeasurements:
    """Measurements of one kind from one file, m rows: the fields that all kinds have in common.

    Attributes:
        q: (m, n) joint values [rad or m], columns as in ``joint_names``.
        joint_names: joint names as in the file's header.
        tool: (m,) index into ``tool_names``: which reflector or target of the tool was measured.
        station: name of the instrument placement, common to all rows (unused by kinds without an instrument).
        file, rows: path of the file, and number (m,) of each row in it, data rows counted from 1.
        torque: (m, n) gravity torques of the arm at these rows [N m], for compliance terms; None if not known.
        load: (m, 4) first moments [kg m] and mass [kg] of what the arm carries beyond its masses, in the last body's
            frame; None if not known.
        measured_torque: (m, n) joint torques that the arm measured at rest [N m]; NaN where none was read; None without
            columns of torques.
        torque_fault: why torques in the file are not read, and what to do; None where they are read, or there are none.
        payload: (m, 4) stated mass [kg] and centre of mass [m] of what the tip carries, in the tip's frame; NaN where
            not stated; None if the file states none.
        ignored: names of columns that were not read, for messages.
        notes: remarks on unusual values that were accepted, for messages.

    Class attributes of each kind:
        kind: name of the kind in files.
        has_instrument: whether rows are measured from a station whose placement has to be fitted.
        placing: rank of the kind by how well it determines the placements of instrument and target; 0 is the best.
    """

    q: np.ndarray
    joint_names: tuple[str, ...]
    _: KW_ONLY
    tool: np.ndarray = None  # ty: ignore[invalid-assignment]  # set below
    tool_names: tuple[str, ...] = ("tool",)
    station: str = "station"
    file: str = ""
    rows: np.ndarray = None  # ty: ignore[invalid-assignment]  # set below
    torque: np.ndarray | None = None
    load: np.ndarray | None = None
    measured_torque: np.ndarray | None = None
    torque_fault: tuple[str, str] | None = None
    payload: np.ndarray | None = None
    ignored: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    kind: ClassVar[str] = ""
    has_instrument: ClassVar[bool] = False
    placing: ClassVar[int] = 4

    @property
    def measures_length(self) -> bool:
        """Whether the rows contain measured lengths, which determine the arm's scale.

        False for sockets: the known distances between them are short compared with the arm, and noise would bias its
        scale.
        """
        return self.has_instrument

    def __post_init__(self) -> None:
        m = len(self.q)
        for name, default in _COUNTS.items():
            if name in self.per_row and getattr(self, name) is None:
                numbers = np.arange(default, m + default) if default else np.zeros(m)
                object.__setattr__(self, name, numbers)
        for name in self.per_row:
            value = getattr(self, name)
            if value is None:
                continue
            require(
                len(value) == m,
                f"{name} has {len(value)} rows, but q has {m}: one row per pose is needed",
                MeasurementError,
                self.file,
            )
            object.__setattr__(self, name, frozen(value, int if name in _COUNTS else float))

    @staticmethod
    def of(
        q: ArrayLike,
        position: ArrayLike,
        quaternion: ArrayLike | None = None,
        *,
        joint_names: Sequence[str] = (),
        **fields: Any,
    ) -> Positions:
        """Return measurements from arrays: poses if `quaternion` is given, else positions.

        Args:
            q: (m, n) joint values [rad or m].
            position: (m, 3) positions of the target in the instrument's frame [m].
            quaternion: (m, 4) orientations x y z w, of unit norm; None for positions only.
            joint_names: n names; q1 to qn by default.
            fields: other fields of `Positions` and `Poses`: ``sigma``, ``station``, ``tool_names``, ….

        Raises:
            MeasurementError: an array has another number of rows than q.
        """
        values = np.atleast_2d(np.asarray(q, dtype=float))
        names = tuple(joint_names) or tuple(f"q{j + 1}" for j in range(values.shape[1]))
        if quaternion is None:
            return Positions(values, names, np.asarray(position), **fields)
        return Poses(values, names, np.asarray(position), np.asarray(quaternion), **fields)

    def __len__(self) -> int:
        return len(self.q)

    @property
    def per_row(self) -> list[str]:
        """Names of the array fields with one entry per row; those in `_COUNTS` contain integers."""
        return [field.name for field in fields(self) if "ndarray" in str(field.type)]

    @property
    def together(self) -> np.ndarray:
        """Number (m,) of each row's robot pose (or pair of poses).

        Cross-validation keeps rows with equal numbers in one fold.
        """
        return self.rows

    @property
    def measured(self) -> np.ndarray:
        """Measured numbers (m, k), by which rows that were recorded twice are recognised."""
        return np.zeros((len(self), 0))

    @property
    def carried(self) -> tuple[str, object]:
        """What the flange carries (``tool``, the instrument or its target), with a key that distinguishes it."""
        return "tool", None

    @property
    def states_sigma(self) -> bool:
        """Whether the measurements have sigmas."""
        return getattr(self, "sigma", None) is not None


_COUNTS = {"tool": 0, "group": 0, "rows": 1}  # whole numbers, and what they count from


@dataclass(frozen=True, eq=False)
class Positions(PoseMeasurements):
    """Positions of the tool point, measured in the station's frame.

    Attributes:
        position: (m, 3) positions [m].
        sigma: (m, 3) standard deviations of the position [m]; None if not known.
        late: (m, k, 3) derivatives of the positions by k unknown errors common to all rows, such as offset [m/s] and
            drift [m] of a clock; None without such errors.
        base: (m, 7) position [m] and orientation x y z w of a frame on the robot's base, as the instrument measured it
            with each row, to which the other fields are relative; None: they are in the instrument's frame.
        base_sigma: (m, 6) standard deviations of its position [m] and of its orientation about the instrument's axes
            [rad]; NaN where not known.
    """

    position: np.ndarray
    _: KW_ONLY
    sigma: np.ndarray | None = None
    late: np.ndarray | None = None
    base: np.ndarray | None = None
    base_sigma: np.ndarray | None = None

    kind: ClassVar[str] = "position"
    has_instrument: ClassVar[bool] = True
    placing: ClassVar[int] = 2

    @property
    def measured(self) -> np.ndarray:
        return self.position


@dataclass(frozen=True, eq=False)
class Poses(Positions):
    """Poses of the tool frame, measured in the station's frame.

    Attributes:
        quaternion: (m, 4) orientations x y z w, of unit norm.
        sigma_rotation: (m, 3) standard deviations of the orientation, about the station's axes [rad]; None if not
            known.
        euler: convention of the three angles from which `quaternion` was computed, as in the options; empty for other
            columns.
        lever: (m, 3) point in the tool frame whose position was measured [m], and to which `sigma` refers; None: the
            frame's origin. Of poses read as their inverse it is the origin of the station's frame as the tool saw it.
        mounting: ``in hand`` (the arm carries the camera) or ``to hand`` (the arm carries the board); empty where not
            known, or without a camera.
    """

    quaternion: np.ndarray
    _: KW_ONLY
    sigma_rotation: np.ndarray | None = None
    euler: str = ""
    lever: np.ndarray | None = None
    mounting: str = ""

    kind: ClassVar[str] = "pose"
    placing: ClassVar[int] = 0

    @property
    def measured(self) -> np.ndarray:
        return np.hstack([self.position, self.quaternion])

    def inverted(self) -> Poses:
        """Return the poses of the tool frame in the station's frame, if these are those of the station in the tool.

        A camera on the arm measures the pose of the board (the station) in its own frame (the tool).
        """
        inverse = invert(from_quaternion(self.position, self.quaternion))
        return replace(
            self,
            position=inverse[:, :3, 3],
            quaternion=to_quaternion(inverse),
            sigma=_about_other_axes(self.sigma, inverse),
            sigma_rotation=_about_other_axes(self.sigma_rotation, inverse),
            euler="",
            lever=self.position,
        )


def _about_other_axes(sigma: np.ndarray | None, frames: np.ndarray) -> np.ndarray | None:
    """Return standard deviations (m, 3) along the axes of the frames' (m, 4, 4) reference, of those along their own."""
    if sigma is None:
        return None
    variance = np.einsum("mij,mj->mi", frames[:, :3, :3] ** 2, sigma**2)
    return np.sqrt(variance)


@dataclass(frozen=True, eq=False)
class GroupedMeasurements(PoseMeasurements):
    """Measurements within groups of rows, which need no instrument placement.

    Attributes:
        group: (m,) index of each row's socket, plane, pair or bar centre.
        group_names: names of the groups.
        sigma: standard deviations [m], of a shape that each kind defines; None if not known.
    """

    _: KW_ONLY
    group: np.ndarray = None  # ty: ignore[invalid-assignment]  # set in the base class
    group_names: tuple[str, ...] = ()
    sigma: np.ndarray | None = None

    @property
    def measured(self) -> np.ndarray:
        return self.group[:, None].astype(float)


@dataclass(frozen=True, eq=False)
class Distances(GroupedMeasurements):
    """Distances |p_a - p_b| between the tool points of the two rows of a group.

    Attributes:
        distance: (m,) distances [m], equal in both rows of a pair; so are the sigmas (m,).
    """

    distance: np.ndarray

    kind: ClassVar[str] = "distance"

    @property
    def measures_length(self) -> bool:
        return bool(np.any(self.distance > 0.0))

    @property
    def together(self) -> np.ndarray:
        return self.group

    @property
    def measured(self) -> np.ndarray:
        return np.column_stack([self.distance, self.group])


@dataclass(frozen=True, eq=False)
class Bars(GroupedMeasurements):
    """Distances |p - c| between the tool point and one unknown point c per group (the other end of a ball bar).

    Attributes:
        distance: (m,) distances [m]; the sigmas are (m,).
    """

    distance: np.ndarray

    kind: ClassVar[str] = "bar"

    @property
    def measures_length(self) -> bool:
        return bool(np.any(self.distance > 0.0))

    @property
    def measured(self) -> np.ndarray:
        return self.distance[:, None]


@dataclass(frozen=True, eq=False)
class Sockets(GroupedMeasurements):
    """Rows whose tool points coincide within each group, in a socket of unknown position; the sigmas are (m, 3).

    Attributes:
        links: known distances between sockets, each (group, group, distance [m]).
    """

    _: KW_ONLY
    links: tuple[tuple[int, int, float], ...] = ()

    kind: ClassVar[str] = "sockets"
    placing: ClassVar[int] = 3


@dataclass(frozen=True, eq=False)
class Planes(GroupedMeasurements):
    """Rows whose tool points lie on one unknown plane per group; the sigmas (m,) are along the plane's normal."""

    kind: ClassVar[str] = "plane"


# Measurement types by their names in files and options.
KINDS: dict[str, type[PoseMeasurements]] = {
    block_type.kind: block_type for block_type in (Poses, Positions, Distances, Bars, Sockets, Planes)
}

Block = TypeVar("Block", bound=PoseMeasurements)


def take(block: Block, index: Sequence[int] | np.ndarray) -> Block:
    """Return the rows at the indices `index`; groups keep their numbers, so that links stay valid.

    Args:
        block: measurements of one kind.
        index: row indices, or a mask (m,).
    """
    index = np.asarray(index)
    rows: dict[str, object] = {}
    for name in block.per_row:
        values = getattr(block, name)
        rows[name] = None if values is None else values[index]
    return replace(block, **rows)


def reunited(block: Block, remainder: Block) -> Block:
    """Return a block with further rows of the same file, in the order of their numbers.

    Args:
        block: measurements of one kind.
        remainder: other rows of them; what only some rows have is left out.
    """
    order = np.argsort(np.concatenate([block.rows, remainder.rows]), kind="stable")
    rows: dict[str, object] = {}
    for name in block.per_row:
        values = getattr(block, name)
        further = getattr(remainder, name)
        rows[name] = None
        if values is not None and further is not None:
            rows[name] = np.concatenate([values, further])[order]
    return replace(block, **rows)
