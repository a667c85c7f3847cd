"""An arm installed in the cell: chain, instrument placements, tool placements and joint deflections.

In ``robot.toml``, besides the calibrated robot itself (`calib.robot.description`, `calib.robot.calibrated`)::

    [[station]]                      # pose of the arm's base in the instrument's frame
    name = "day1"
    xyz = [1.0, 0.0, 0.3]            # and rpy; or matrix
    [[tool]]                         # pose of the target in the tip's frame
    name = "tool"
    [[camera]]                       # and [[board]], of images: see `calib.data.images.optics`
    [provenance]
    nominal_station = [...]          # and nominal_tool: the frames that let the nominal arm fit best
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from calib.data.poses.measurements import PoseMeasurements
from calib.errors import CalibError, RobotError, refused_as
from calib.records import frozen, read_record
from calib.robot import calibrated
from calib.robot.calibrated import Deflection, extra_displacements, nominal_of
from calib.robot.chain import Chain
from calib.robot.kinematics import Sweep, sweep
from calib.robot.tables import placement, placement_table

if TYPE_CHECKING:
    from calib.data.images.optics import View

FRAME_AXES = ("x", "y", "z", "rx", "ry", "rz")


class NoOptics:
    """Optics of an installation without cameras: an empty set of parameters."""

    names: tuple[str, ...] = ()
    units: tuple[str, ...] = ()
    values = frozen(np.zeros(0))
    moving = frozen(np.zeros(0), int)

    def __len__(self) -> int:
        return 0

    def like(self, optics: object) -> NoOptics:
        """Return these optics with the parameter values of `optics`; without cameras, the object itself."""
        return self

    def view(self, measured: PoseMeasurements, free: np.ndarray) -> View | None:
        """Return what the optics add to the prediction of a block; None without cameras.

        Args:
            measured: the block of measurements.
            free: indices of fitted parameters, counted from the first parameter of the optics.
        """
        return None

    def tables(self) -> Mapping[str, object]:
        """Return the tables of ``robot.toml`` that contain these parameters; empty without cameras."""
        return {}


@dataclass(frozen=True, eq=False)
class Installation:
    """An arm in a cell, with target poses T_i = station_{s(i)} · arm(q_i + deflection) · tool_{t(i)}.

    Attributes:
        chain: the arm, base to tip.
        stations: (S, 4, 4) poses of the arm's base in each instrument's frame.
        tools: (T, 4, 4) poses of each target in the tip's frame.
        station_names, tool_names: names of the S stations and T tools.
        deflection: joint corrections as functions of q, to be fitted.
        known: deflections of an earlier fit, which are not changed.
        optics: parameters of cameras and boards for images, with the interface of `NoOptics`.
    """

    chain: Chain
    stations: np.ndarray = field(default_factory=lambda: np.eye(4)[None])
    tools: np.ndarray = field(default_factory=lambda: np.eye(4)[None])
    station_names: tuple[str, ...] = ("station",)
    tool_names: tuple[str, ...] = ("tool",)
    deflection: Deflection = field(default_factory=Deflection)
    known: Deflection = field(default_factory=Deflection)
    optics: Any = field(default_factory=NoOptics)

    def __post_init__(self) -> None:
        object.__setattr__(self, "stations", frozen(self.stations))
        object.__setattr__(self, "tools", frozen(self.tools))

    @property
    def reach(self) -> float:
        """Largest distance of a target from the base with the arm stretched [m]; prismatic joints are taken at zero."""
        tool_lengths = np.linalg.norm(self.tools[:, :3, 3], axis=1)
        return self.chain.stretched_length() + float(tool_lengths.max(initial=0.0))

    def merged(self) -> Installation:
        """Return the installation with the known deflections of an earlier fit and the fitted ones in one field,
        `deflection`.
        """
        if not self.known.terms:
            return self
        terms = (*self.known.terms, *self.deflection.terms)
        known_values = np.asarray(self.known.coefficients)
        values = np.concatenate([known_values, np.asarray(self.deflection.coefficients)])
        earlier = self.known.reference
        reference = self.deflection.reference or earlier
        # masses that the known compliance was fitted with stay with it
        if reference is not None and reference.inertias is None and earlier is not None:
            reference = replace(reference, inertias=earlier.inertias)
        return replace(self, deflection=Deflection(terms, values, reference), known=Deflection())


@dataclass(frozen=True, eq=False)
class Seen:
    """Predicted targets in the instrument's frame, for m rows.

    Attributes:
        walked: frames along the chain, in the station's frame.
        point: (3, m) target positions [m].
        rotation: (3, 3, m) target rotations, ``rotation[c]`` being column c.
        view: camera and board by which images are predicted; None for other instruments.
    """

    walked: Sweep
    point: np.ndarray
    rotation: np.ndarray
    view: View | None = None

    def poses(self) -> np.ndarray:
        """Return the target poses (m, 4, 4) in the station's frame."""
        return replace(self.walked, rotation=self.rotation, position=self.point).poses()


def see(
    cell: Installation,
    q: np.ndarray,
    station: int = 0,
    tool: np.ndarray | int = 0,
    bases: np.ndarray | None = None,
    displacements: np.ndarray | None = None,
) -> Seen:
    """Return the predicted targets in an instrument's frame at joint values q (m, n).

    Args:
        cell: the installation.
        q: (m, n) [rad or m].
        station: index of the station; -1 for the arm's base frame.
        tool: index of the target, one or (m,).
        bases: (E, m) basis functions of the deflection's E terms at q; None computes them.
        displacements: (K, m) displacements of the K elements by the known deflections; None computes them.
    """
    fitted = extra_displacements(cell.chain, cell.deflection, q, bases)
    if displacements is None:
        displacements = extra_displacements(cell.chain, cell.known, q)
    if fitted is not None:
        displacements = fitted if displacements is None else fitted + displacements
    placement = None if station < 0 else cell.stations[station]
    walked = sweep(cell.chain, q, placement, displacements)
    if len(cell.tools) == 1 or np.ndim(tool) == 0:
        number = 0 if len(cell.tools) == 1 else int(np.asarray(tool))
        mounting = cell.tools[number]
        flat = walked.rotation.reshape(3, -1)
        point = walked.position + (mounting[:3, 3] @ flat).reshape(walked.position.shape)
        rotation = (mounting[:3, :3].T @ flat).reshape(walked.rotation.shape)
    else:
        mountings = cell.tools[np.asarray(tool)]
        point = walked.position + np.einsum("cdm,mc->dm", walked.rotation, mountings[:, :3, 3])
        rotation = np.einsum("cdm,mce->edm", walked.rotation, mountings[:, :3, :3])
    return Seen(walked, point, rotation)


@dataclass(frozen=True)
class _Frames:
    """Tables of stations, tools, cameras and boards in ``robot.toml``; each entry has a name and a placement."""

    station: tuple[Mapping[str, object], ...] = ()
    tool: tuple[Mapping[str, object], ...] = ()
    camera: tuple[Mapping[str, object], ...] = ()
    board: tuple[Mapping[str, object], ...] = ()


def frame_tables(cell: Installation) -> dict[str, object]:
    """Return the tables ``station`` and ``tool`` of an installation, and the tables of its cameras and boards.

    Args:
        cell: the installation of arm, stations, tools and optics.
    """
    stations = [{"name": name, **placement_table(pose)} for name, pose in zip(cell.station_names, cell.stations)]
    tools = [{"name": name, **placement_table(pose)} for name, pose in zip(cell.tool_names, cell.tools)]
    return {**cell.optics.tables(), "station": stations, "tool": tools}


def read(path: str | Path) -> Installation:
    """Return the installation written by a fit, deflections included.

    Args:
        path: the folder of a fit, or its ``robot.toml``. In any other robot file, stations and tools are missing and
            are set to identity.
    """
    robot, extra = calibrated.read_whole(path)
    return _placed(robot.complete, extra, str(path), robot.deflection)


def read_arms(path: str | Path) -> tuple[Installation, Installation]:
    """Return the calibrated arm of a fit, as `read` does, and the nominal arm from which the fit started.

    The nominal arm has the placements with which it fits the same measurements best. It has no stations and no tools if
    the file does not contain these placements (a file of an earlier version whose fit started from another fit).

    Args:
        path: the folder of a fit, or its ``robot.toml``.

    Raises:
        RobotError: the file does not name the nominal arm.
    """
    robot, extra = calibrated.read_whole(path)
    provenance = extra.get("provenance", {})
    frames = {kind: provenance.get(f"nominal_{kind}", ()) for kind in ("station", "tool")}
    nominal = _placed(nominal_of(robot), {**extra, **frames}, f"{path}, provenance")
    if not all(frames.values()):
        none = np.zeros((0, 4, 4))
        nominal = replace(nominal, stations=none, station_names=(), tools=none, tool_names=())
    return _placed(robot.complete, extra, str(path), robot.deflection), nominal


def _placed(
    chain: Chain, tables: Mapping[str, object], source: str, deflection: Deflection | None = None
) -> Installation:
    """Return a chain with the stations and tools of the tables; without entries, one station and tool at identity.

    Args:
        chain: the arm.
        tables: tables of ``robot.toml``.
        source: name of the file, for messages.
        deflection: deflections of the arm; None for a rigid arm.
    """
    with refused_as(RobotError, ValueError, f"{source}: {{}}; expected [[...]] tables, each with a name, xyz and rpy"):
        frames = read_record(_Frames, tables)
    cell = Installation(chain, deflection=deflection or Deflection())
    if frames.station:
        names, placements = _placements(frames.station, f"{source}, station")
        cell = replace(cell, stations=placements, station_names=names)
    if frames.tool:
        names, placements = _placements(frames.tool, f"{source}, tool")
        cell = replace(cell, tools=placements, tool_names=names)
    if frames.camera:
        with refused_as(RobotError, (CalibError, ValueError), f"{source}: {{}}"):
            from calib.data.images.optics import read_optics

            cell = replace(cell, optics=read_optics(frames.camera, frames.board))
    return cell


def _placements(entries: tuple[Mapping[str, object], ...], source: str) -> tuple[tuple[str, ...], np.ndarray]:
    """Return the names and placements (k, 4, 4) of the k entries of a table.

    An entry without name is named by its number.

    Args:
        entries: the tables, each with a placement.
        source: name of the file, for messages.
    """
    names = []
    placements = []
    for number, entry in enumerate(entries, 1):
        names.append(str(entry.get("name", f"{number}")))
        numbers = {key: value for key, value in entry.items() if key != "name"}
        placements.append(placement(numbers, source))
    return tuple(names), np.array(placements)
