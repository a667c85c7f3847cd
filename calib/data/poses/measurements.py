"""What was measured at poses: one frozen block per file, kind and station; knows no robot."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from calib.arrays import frozen
from calib.errors import MeasurementError

KINDS = ("pose", "position", "distance", "bar", "sockets", "plane")


@dataclass(frozen=True, eq=False)
class PoseMeasurements:
    """m measured rows of one kind from one file.

    Attributes:
        kind: what a row says of the tool point p (and frame R) that the robot carries:
            ``pose``: p and R in the station's frame; ``position``: p in the station's frame; ``distance``: |p_a - p_b|
            of the two rows of a group; ``bar``: |p - c| with one unknown point c per group; ``sockets``: p is one
            unknown fixed point per group; ``plane``: p lies on one unknown plane per group.
        q: (m, n) joint values [rad or m], columns as in ``joint_names``.
        position: (m, 3) [m], for ``pose`` and ``position``.
        quaternion: (m, 4) x y z w of unit norm, for ``pose``.
        sigma: (m, 3) standard deviation of the position [m]; None where not stated.
        sigma_rotation: (m, 3) of the orientation, about the station's axes [rad]; None where not stated.
        distance: (m,) [m], for ``distance`` (the same in both rows of a pair) and ``bar``.
        group: (m,) index of the socket, plane, pair or bar centre; zeros for ``pose`` and ``position``.
        group_names: one per group.
        links: known distances between sockets, each (group, group, distance [m]).
        tool: (m,) index into ``tool_names``: which reflector or target of the tool was seen.
        station: name of the instrument placement that these rows share (unused for the kinds without an instrument).
        file, rows: where they came from; rows count data rows from 1.
        joint_names: as in the file's header.
        ignored: header names that were not used, for the message.
        notes: what is odd but was accepted, for the message.
    """

    kind: str
    q: np.ndarray
    joint_names: tuple[str, ...]
    position: np.ndarray | None = None
    quaternion: np.ndarray | None = None
    sigma: np.ndarray | None = None
    sigma_rotation: np.ndarray | None = None
    distance: np.ndarray | None = None
    group: np.ndarray = None  # type: ignore[assignment]  # set below
    group_names: tuple[str, ...] = ()
    links: tuple[tuple[int, int, float], ...] = ()
    tool: np.ndarray = None  # type: ignore[assignment]  # set below
    tool_names: tuple[str, ...] = ("tool",)
    station: str = "station"
    file: str = ""
    rows: np.ndarray = None  # type: ignore[assignment]  # set below
    ignored: tuple[str, ...] = field(default=())
    notes: tuple[str, ...] = field(default=())

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise MeasurementError(f"kind '{self.kind}' is none of {', '.join(KINDS)}", self.file)
        m = len(self.q)
        object.__setattr__(self, "q", frozen(self.q))
        for name in ("position", "quaternion", "sigma", "sigma_rotation", "distance"):
            if (value := getattr(self, name)) is not None:
                object.__setattr__(self, name, frozen(value))
        for name, default in (("group", np.zeros(m)), ("tool", np.zeros(m)), ("rows", np.arange(1, m + 1))):
            value = getattr(self, name)
            object.__setattr__(self, name, frozen(default if value is None else value, int))
        needed = {"pose": ("position", "quaternion"), "position": ("position",), "distance": ("distance",)}
        needed["bar"] = ("distance",)
        for name in needed.get(self.kind, ()):
            if getattr(self, name) is None:
                raise MeasurementError(f"kind '{self.kind}' needs {name}", self.file)
        for name in ("position", "quaternion", "sigma", "sigma_rotation", "distance", "group", "tool", "rows"):
            value = getattr(self, name)
            if value is not None and len(value) != m:
                raise MeasurementError(f"{name} has {len(value)} rows where q has {m}", self.file)

    def __len__(self) -> int:
        return len(self.q)


def take(measured: PoseMeasurements, index: Sequence[int] | np.ndarray) -> PoseMeasurements:
    """Return the rows at `index`; groups keep their numbers, so that links stay valid."""
    index = np.asarray(index)
    names = ("q", "position", "quaternion", "sigma", "sigma_rotation", "distance", "group", "tool", "rows")
    picked = {name: None if (value := getattr(measured, name)) is None else value[index] for name in names}
    return replace(measured, **picked)
