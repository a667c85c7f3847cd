"""Robot tables in TOML: names and placements with clear complaints, exact writing.

A number may be a TOML number or a text: an expression of numbers, ``pi`` and ``+ - * / ( )``, with an optional unit
behind it: ``"-pi/2"``, ``"90 deg"``, ``"110 deg/s"``, ``"-313 mm"`` (`calib.config_types.number`, `calib.units`).
"""

import math
from collections.abc import Mapping
from functools import partial

import numpy as np
import rtoml

from calib import config, config_types
from calib.config_types import shown
from calib.errors import RobotError, refuse_robot
from calib.records import FieldValues
from calib.robot.chain import Chain
from calib.transforms import from_xyz_rpy, to_xyz_rpy

_PI = {math.pi: "pi", -math.pi: "-pi", math.pi / 2: "pi/2", -math.pi / 2: "-pi/2"}

LIMITS = ("lower", "upper", "velocity", "effort")

load = partial(config.read_toml, error=RobotError)
check_keys = partial(config.check_keys, error=RobotError)
number = partial(config_types.number, error=RobotError)


def word(table: Mapping[str, object], key: str, where: str, default: str | None = None) -> str:
    """Return a non-empty text from a table.

    Raises:
        RobotError: where it is something else, or missing without a default.
    """
    value = table.get(key, default)
    if value is None:
        refuse_robot(where, f"'{key}' is missing")
    if not isinstance(value, str) or not value:
        refuse_robot(where, f"'{key}' must be text, found {shown(value)}")
    return value


def vector(value: object, count: int, where: str, quantity: str = "") -> np.ndarray:
    """Return (count,) numbers in SI units from a TOML list."""
    return np.array(config_types.numbers(value, count, where, quantity, RobotError))


def placement(table: object, where: str) -> np.ndarray:
    """Return a transform (4, 4) from a table ``{xyz, rpy}`` [m, rad] or ``{matrix}`` (three or four rows)."""
    if not isinstance(table, Mapping):
        refuse_robot(where, f"expected xyz and rpy, or matrix; found {shown(table)}")
    check_keys(table, ("xyz", "rpy", "matrix"), where)
    if "matrix" not in table:
        zero = [0.0, 0.0, 0.0]
        xyz = vector(table.get("xyz", zero), 3, f"{where}, xyz", "length")
        return from_xyz_rpy(xyz, vector(table.get("rpy", zero), 3, f"{where}, rpy", "angle"))
    rows = table["matrix"]
    if not isinstance(rows, (list, tuple)) or len(rows) not in (3, 4):
        refuse_robot(where, "matrix needs three or four rows")
    result = np.eye(4)
    result[: len(rows)] = [vector(row, 4, f"{where}, matrix") for row in rows]
    error = np.abs(result[:3, :3].T @ result[:3, :3] - np.eye(3)).max()
    if not error < 1e-6 or np.linalg.det(result[:3, :3]) < 0:
        refuse_robot(where, f"the upper left 3 x 3 of matrix is not a rotation (R'R - 1 = {error:.2g})")
    return result


def placement_table(transform: np.ndarray) -> dict[str, list]:
    """Return the table that `placement` reads back exactly: xyz and rpy where they are exact, else the matrix."""
    xyz, rpy = to_xyz_rpy(transform)
    if np.array_equal(from_xyz_rpy(xyz, rpy), transform):
        table = {"xyz": xyz.tolist()}
        if rpy.any():
            table["rpy"] = [spelled(angle) for angle in rpy.tolist()]
        return table
    return {"matrix": transform[:3].tolist()}


def spelled(angle: float) -> float | str:
    """Return an angle as text if it is ±pi or ±pi/2, else unchanged."""
    return _PI.get(angle, angle)


def chain_head(table: Mapping[str, object], where: str) -> FieldValues:
    """Return the fields of a `Chain` in a robot's table except its joints: name, ends, tail, gravity, floor."""
    head: FieldValues = {"name": word(table, "name", where)}
    for key in ("base", "tip"):
        if key in table:
            head[key] = word(table, key, where)
    if "tail" in table:
        head["tail"] = placement(table["tail"], f"{where}, [tail]")
    if "gravity" in table:
        head["gravity"] = vector(table["gravity"], 3, f"{where}, gravity")
    head["floor"] = number(table.get("floor", 0.0), f"{where}, floor", "length")
    return head


def chain_table(chain: Chain, **rows: object) -> dict[str, object]:
    """Return the table of a chain that `chain_head` reads back exactly; `rows` stand before its tail."""
    table: dict[str, object] = {"name": chain.name, "base": chain.base, "tip": chain.tip}
    table["gravity"] = chain.gravity.tolist()
    if chain.floor:
        table["floor"] = chain.floor
    table |= rows
    if not np.array_equal(chain.tail, np.eye(4)):
        table["tail"] = placement_table(chain.tail)
    return table


def finite_limits(joint: object) -> dict[str, float]:
    """Return the known (finite) limits of a joint or MDH row, by name."""
    limits = {key: getattr(joint, key) for key in LIMITS}
    return {key: limit for key, limit in limits.items() if np.isfinite(limit)}


def dumps(table: Mapping[str, object]) -> str:
    """Return a table as TOML text, with floats in full precision; None is left out."""
    return rtoml.dumps(config.plain_values(table), none_value=None)
