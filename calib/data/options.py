"""How measurement files are to be read."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True)
class FileOptions:
    """How one measurement file is to be read; the defaults leave everything to its header.

    Attributes:
        kind: one of `KINDS`; "" where the header tells.
        format: ``csv``, ``robodk`` or ``three_smr``; "" where the header tells.
        columns: our column name → the file's, for columns that are named otherwise.
        units: our column name, or one of ``joints``, ``position``, ``orientation``, ``distance``, → the unit of columns
            whose header states none.
        sigma_position, sigma_orientation: standard deviation per axis [m], [rad]; where the file has columns of sigmas,
            those are taken.
        groups: columns that, together with the socket (plane), make one group.
        where: column → the values whose rows are kept.
        station, tool: names of the instrument placement (default: the file's name) and of the tool.
        socket_distance: known distance between two sockets of the same fixture position [m].
        socket_pairs: labels of the sockets that this distance joins; needed where there are more than two.
        check_limits: refuse joint values outside the robot's limits.
    """

    kind: str = ""
    format: str = ""
    columns: Mapping[str, str] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    sigma_position: tuple[float, float, float] | None = None
    sigma_orientation: tuple[float, float, float] | None = None
    groups: tuple[str, ...] = ()
    where: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    station: str = ""
    tool: str = "tool"
    socket_distance: float | None = None
    socket_pairs: tuple[tuple[str, str], ...] = ()
    check_limits: bool = True
