"""A calibrated installation as tables of ``robot.toml``, and back.

Beside the robot itself (`calib.robot.description`)::

    [[station]]                      # pose of the arm's base in the instrument's frame
    name = "day1"
    xyz = [1.0, 0.0, 0.3]            # and rpy; or matrix
    [[tool]]                         # pose of the target in the tip's frame
    name = "tool"
    [deflection]                     # what q does not say; formula in `calib.geometry.deflection`
    reference = [0.0, 0.1, ...]      # element values of the chain that levers are taken from (the nominal one)
    [[deflection.term]]
    element = "q3.offset"            # the element it moves
    basis = "sin"                    # torque, lever, joint, cos, sin
    joint = "q4"                     # the joint (or the body behind it) it comes from
    order = 2                        # k of sin and cos; axis of a lever (0 x, 1 y, 2 z)
    coefficient = 1.2e-5

``chain_covariance.csv`` beside it: the covariance [m, rad] of the element values of the best geometry without
deflections (``provenance.rigid``, where there are any), by name; elements that are not in it were not fitted.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from calib import files
from calib.errors import RobotError
from calib.geometry.deflection import Deflection, Term
from calib.geometry.installation import Installation, merged
from calib.geometry.result import GeometricFit
from calib.robot import description
from calib.robot.chain import Chain, element_index
from calib.robot.tables import check_keys, number, placement, placement_table, vector

COVARIANCE = "chain_covariance.csv"
"""Covariance of the element values of the rigid geometry, by name; elements that were not fitted are not in it."""


def tables(cell: Installation) -> dict[str, Any]:
    """Return the tables ``station``, ``tool`` and, where there are terms, ``deflection`` of an installation."""
    cell = merged(cell)
    result: dict[str, Any] = {
        "station": [{"name": n, **placement_table(t)} for n, t in zip(cell.station_names, cell.stations)],
        "tool": [{"name": n, **placement_table(t)} for n, t in zip(cell.tool_names, cell.tools)],
    }
    if cell.deflection.terms:
        result["deflection"] = _deflection_table(cell)
    return result


def _deflection_table(cell: Installation) -> dict[str, Any]:
    table: dict[str, Any] = {}
    if cell.deflection.reference is not None:
        table["reference"] = cell.deflection.reference.values.tolist()
    table["term"] = [
        {
            "element": term.element,
            "basis": term.basis,
            "joint": cell.chain.joint_names[term.source],
            "order": term.order,
            "coefficient": float(value),
        }
        for term, value in zip(cell.deflection.terms, np.asarray(cell.deflection.coefficients))
    ]
    return table


def read(path: str | Path) -> Installation:
    """Read the installation that a fit has written, deflections included.

    Args:
        path: the folder of a fit, or its ``robot.toml``; any other robot file gives identity frames.
    """
    path = Path(path) / "robot.toml" if Path(path).is_dir() else Path(path)
    chain, extra, where = description.read(path), description.read_extra(path), str(path)
    cell = _placed(chain, extra.get("station", []), extra.get("tool", []), where)
    return replace(cell, deflection=_deflection(extra["deflection"], chain, where)) if "deflection" in extra else cell


def _placed(chain: Chain, station: Any, tool: Any, where: str) -> Installation:
    """Return a chain with stations and tools as their tables say; identity frames where a list is empty."""
    stations, tools = _frames(station, f"{where}, station"), _frames(tool, f"{where}, tool")
    given: dict[str, Any] = {}
    if stations:
        given |= {"station_names": tuple(stations), "stations": np.array(list(stations.values()))}
    if tools:
        given |= {"tool_names": tuple(tools), "tools": np.array(list(tools.values()))}
    return Installation(chain, **given)


def nominal(path: str | Path) -> Installation:
    """Return the nominal arm of a fit, with the frames that let it fit the same measurements best.

    A fit that started from an earlier fit's folder has none: then there are no stations and no tools.

    Raises:
        RobotError: where the file does not say which arm that was.
    """
    path = Path(path) / "robot.toml" if Path(path).is_dir() else Path(path)
    chain, known = description.read(path), description.read_extra(path).get("provenance", {})
    if "nominal" not in known:
        raise RobotError(f"{path} does not say which nominal robot it was calibrated from; fit again")
    values = vector(known["nominal"], len(chain.elements), f"{path}, provenance.nominal")
    station, tool = (known.get(f"nominal_{kind}", []) for kind in ("station", "tool"))
    cell = _placed(chain.with_values(values), station, tool, f"{path}, provenance")
    none: dict[str, Any] = {"stations": np.zeros((0, 4, 4)), "station_names": ()}
    none |= {"tools": np.zeros((0, 4, 4)), "tool_names": ()}
    return cell if station and tool else replace(cell, **none)


def rigid_chain(path: str | Path) -> Chain:
    """Return the geometry of a fit that is best without its deflections: what a URDF of it holds."""
    path = Path(path) / "robot.toml" if Path(path).is_dir() else Path(path)
    chain, values = description.read(path), description.read_extra(path).get("provenance", {}).get("rigid")
    if values is None:
        return chain
    return chain.with_values(vector(values, len(chain.elements), f"{path}, provenance.rigid"))


def write_covariance(rigid: GeometricFit, folder: Path) -> None:
    """Write the covariance of the arm's elements of a rigid fit; nothing where it moved none of them."""
    own = np.flatnonzero(rigid.free < len(rigid.cell.chain.elements))
    names = [rigid.estimate.names[k] for k in own]
    write_chain_covariance(names, rigid.estimate.covariance[np.ix_(own, own)], folder)


def write_chain_covariance(names: Sequence[str], covariance: np.ndarray, folder: Path) -> None:
    """Write the covariance of elements by name; nothing for none."""
    if len(names):
        rows = ([name, *map(float, row)] for name, row in zip(names, covariance))
        files.write_table(folder / COVARIANCE, ("name", *names), rows)


def chain_covariance(path: str | Path, chain: Chain) -> np.ndarray | None:
    """Return the covariance (K, K) of a calibrated chain's element values; None where no fit has left one.

    Args:
        path: the folder of a fit, or its ``robot.toml``.
        chain: `rigid_chain` of it; elements that were not fitted get zeros.

    Raises:
        RobotError: for a table that is not one of this chain's.
    """
    path = Path(path) / COVARIANCE if Path(path).is_dir() else Path(path).parent / COVARIANCE
    if not path.is_file():
        return None
    with path.open(newline="", encoding="utf-8") as file:
        header, *rows = list(csv.reader(file))
    index = element_index(chain, header[1:])
    try:
        values = np.array([row[1:] for row in rows], dtype=float)
    except ValueError as error:
        raise RobotError(f"{path}: not a table of numbers ({error}); fit again") from None
    if values.shape != (len(index), len(index)) or [row[0] for row in rows] != header[1:]:
        raise RobotError(f"{path}: rows and columns do not name the same elements; fit again")
    result = np.zeros((len(chain.elements), len(chain.elements)))
    result[np.ix_(index, index)] = values
    return result


def _frames(entries: Any, where: str) -> dict[str, np.ndarray]:
    if not isinstance(entries, list) or not all(isinstance(entry, Mapping) for entry in entries):
        raise RobotError(f"{where}: expected [[...]] tables, each with a name, xyz and rpy")
    return {
        str(entry.get("name", f"{k + 1}")): placement({key: v for key, v in entry.items() if key != "name"}, where)
        for k, entry in enumerate(entries)
    }


def _deflection(table: Any, chain: Chain, where: str) -> Deflection:
    where = f"{where}, deflection"
    check_keys(table, ("reference", "term"), where)
    terms, coefficients = [], []
    for entry in table.get("term", []):
        check_keys(entry, ("element", "basis", "joint", "order", "coefficient"), where)
        for key, known in (("element", chain.names), ("joint", chain.joint_names)):
            if entry.get(key) not in known:
                raise RobotError(f"{where}: {key} {entry.get(key)!r} is none of the robot's")
        source = chain.joint_names.index(entry["joint"])
        terms.append(Term(entry["element"], entry.get("basis", ""), source, int(entry.get("order", 0))))
        coefficients.append(number(entry.get("coefficient"), f"{where}, coefficient"))
    reference = chain
    if "reference" in table:
        reference = chain.with_values(vector(table["reference"], len(chain.elements), f"{where}, reference"))
    return Deflection(tuple(terms), np.array(coefficients), reference)
