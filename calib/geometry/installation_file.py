"""A calibrated installation as tables of ``robot.toml``, and back.

Beside the calibrated robot itself (`calib.robot.description`, `calib.robot.calibrated`)::

    [[station]]                      # pose of the arm's base in the instrument's frame
    name = "day1"
    xyz = [1.0, 0.0, 0.3]            # and rpy; or matrix
    [[tool]]                         # pose of the target in the tip's frame
    name = "tool"
    [[camera]]                       # and [[board]], of images: see `calib.rooms.camera.optics`
    [provenance]
    nominal_station = [...]          # and nominal_tool: the frames that let the nominal arm fit best
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from calib.errors import CalibError, RobotError, refused_as
from calib.extensions import needed
from calib.geometry.installation import Installation
from calib.records import read_record
from calib.robot import calibrated
from calib.robot.calibrated import CalibratedChain, nominal_of
from calib.robot.chain import Chain
from calib.robot.tables import placement, placement_table

T = TypeVar("T")


@dataclass(frozen=True)
class _Frames:
    """The tables of stations and tools, each entry with a name and a placement."""

    station: tuple[Mapping[str, Any], ...] = ()
    tool: tuple[Mapping[str, Any], ...] = ()
    camera: tuple[Mapping[str, Any], ...] = ()
    board: tuple[Mapping[str, Any], ...] = ()


@dataclass(frozen=True)
class _NominalFrames:
    """Those in ``provenance``."""

    nominal_station: tuple[Mapping[str, Any], ...] = ()
    nominal_tool: tuple[Mapping[str, Any], ...] = ()


def frame_tables(cell: Installation) -> dict[str, Any]:
    """Return the tables ``station`` and ``tool`` of an installation, and those of its cameras and boards."""
    return {
        **cell.optics.tables(),
        "station": [{"name": n, **placement_table(t)} for n, t in zip(cell.station_names, cell.stations)],
        "tool": [{"name": n, **placement_table(t)} for n, t in zip(cell.tool_names, cell.tools)],
    }


def read(path: str | Path) -> Installation:
    """Read the installation that a fit has written, deflections included.

    Args:
        path: the folder of a fit, or its ``robot.toml``; any other robot file gives identity frames.
    """
    path = _file(path)
    return _calibrated(*calibrated.read_whole(path), str(path))


def read_arms(path: str | Path) -> tuple[Installation, Installation]:
    """Return the calibrated arm of a fit as `read` does, and the nominal one.

    The nominal one has the frames that let it fit the same measurements best; of a fit that started from an earlier
    fit's folder they are not known: then it has no stations and no tools.

    Raises:
        RobotError: where the file does not say which arm that was.
    """
    path = _file(path)
    robot, extra = calibrated.read_whole(path)
    return _calibrated(robot, extra, str(path)), _nominal(robot, extra, str(path))


def _calibrated(robot: CalibratedChain, extra: Mapping[str, Any], where: str) -> Installation:
    cell = _placed(robot.complete, _typed(_Frames, extra, where), where)
    return replace(cell, deflection=robot.deflection)


def _file(path: str | Path) -> Path:
    return Path(path) / calibrated.ROBOT if Path(path).is_dir() else Path(path)


def _typed(kind: type[T], content: Any, where: str) -> T:
    """Return the tables as a value of `kind`; complains as `RobotError`."""
    with refused_as(RobotError, ValueError, f"{where}: {{}}; expected [[...]] tables, each with a name, xyz and rpy"):
        return read_record(kind, content)


def _placed(chain: Chain, found: _Frames, where: str) -> Installation:
    """Return a chain with stations and tools as their tables say; identity frames where a list is empty."""
    stations, tools = _frames(found.station, f"{where}, station"), _frames(found.tool, f"{where}, tool")
    given: dict[str, Any] = {}
    if stations:
        given |= {"station_names": tuple(stations), "stations": np.array(list(stations.values()))}
    if tools:
        given |= {"tool_names": tuple(tools), "tools": np.array(list(tools.values()))}
    if found.camera:
        with refused_as(RobotError, (CalibError, ValueError), f"{where}: {{}}"):
            given["optics"] = needed("read_optics")(found.camera, found.board)
    return Installation(chain, **given)


def _nominal(robot: CalibratedChain, extra: Mapping[str, Any], path: str) -> Installation:
    chain, where = nominal_of(robot), f"{path}, provenance"
    known = _typed(_NominalFrames, extra.get("provenance", {}), where)
    seen = _typed(_Frames, extra, path)
    found = _Frames(known.nominal_station, known.nominal_tool, seen.camera, seen.board)
    cell = _placed(chain, found, where)
    none: dict[str, Any] = {"stations": np.zeros((0, 4, 4)), "station_names": ()}
    none |= {"tools": np.zeros((0, 4, 4)), "tool_names": ()}
    return cell if found.station and found.tool else replace(cell, **none)


def _frames(entries: tuple[Mapping[str, Any], ...], where: str) -> dict[str, np.ndarray]:
    return {
        str(entry.get("name", f"{k + 1}")): placement({key: v for key, v in entry.items() if key != "name"}, where)
        for k, entry in enumerate(entries)
    }
