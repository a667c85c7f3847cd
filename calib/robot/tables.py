"""Robot tables in TOML: names and placements with clear complaints, exact writing.

A number may be a TOML number or a text: an expression of numbers, ``pi`` and ``+ - * / ( )``, with an optional unit
behind it: ``"-pi/2"``, ``"90 deg"``, ``"110 deg/s"``, ``"-313 mm"`` (`calib.config_types.number`, `calib.units`).
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Annotated

import numpy as np
import rtoml

from calib import config, config_types
from calib.config_types import Angle, Checked, Length, Name, Real, Text, shown
from calib.errors import RobotError, refuse_robot
from calib.records import FieldValues
from calib.robot.chain import Chain
from calib.transforms import from_xyz_rpy, to_xyz_rpy

_PI = {math.pi: "pi", -math.pi: "-pi", math.pi / 2: "pi/2", -math.pi / 2: "-pi/2"}

LIMITS = ("lower", "upper", "velocity", "effort")
# Tables of a robot file that belong to other readers: `calib.geometry.installation`, `calib.robot.calibrated`.
EXTRA = ("station", "tool", "camera", "board", "deflection", "truth", "provenance")

# A number without unit, and one that may be infinite.
Plain = Annotated[float, Real(quantity="1")]
Unlimited = Annotated[float, Real(quantity="1", infinite=True)]
Vector = tuple[Plain, Plain, Plain]
# XX XY XZ YY YZ ZZ MX MY MZ M about the joint's frame [kg m², kg m, kg]
Inertia = tuple[Plain, Plain, Plain, Plain, Plain, Plain, Plain, Plain, Plain, Plain]


def _placement_table(value: object) -> object:
    if not isinstance(value, Mapping):
        raise ValueError(f"expected xyz and rpy, or matrix; found {shown(value)}")
    return value


def _foreign(value: object) -> object:
    return value


@config.strict
@dataclass(frozen=True)
class PlacementTable:
    """Where a frame stands in another one.

    Attributes:
        xyz: position [m].
        rpy: roll, pitch and yaw [rad].
        matrix: in place of both: three or four rows of the homogeneous transform.
    """

    xyz: tuple[Length, Length, Length] = (0.0, 0.0, 0.0)
    rpy: tuple[Angle, Angle, Angle] = (0.0, 0.0, 0.0)
    matrix: tuple[tuple[Plain, Plain, Plain, Plain], ...] | None = None

    def transform(self, where: str) -> np.ndarray:
        """Return the transform (4, 4); `where` names the table in messages."""
        if self.matrix is None:
            return from_xyz_rpy(np.array(self.xyz), np.array(self.rpy))
        if len(self.matrix) not in (3, 4):
            refuse_robot(where, "matrix needs three or four rows")
        result = np.eye(4)
        result[: len(self.matrix)] = self.matrix
        rotation = result[:3, :3]
        error = np.abs(rotation.T @ rotation - np.eye(3)).max()
        if not error < 1e-6 or np.linalg.det(rotation) < 0:
            refuse_robot(where, f"the upper left 3 x 3 of matrix is not a rotation (R'R - 1 = {error:.2g}): correct it")
        return result


Placement = Annotated[PlacementTable, Checked(_placement_table)]
# Table, or list of tables, that another reader takes.
Foreign = Annotated[object, Checked(_foreign, {"type": ["object", "array"]})]


@config.strict
@dataclass(frozen=True, kw_only=True)
class RobotTable:
    """Keys that the robot files of serial arms share.

    Attributes:
        name: of the robot.
        base, tip: names of its two ends.
        gravity: in the base frame [m/s²].
        floor: height of what it stands on, in the base frame [m].
        source: where the numbers come from.
        tail: what follows the last joint or row.
        station, tool, camera, board, deflection, truth, provenance: of a fit.
    """

    name: Name
    base: Name | None = None
    tip: Name | None = None
    gravity: Vector | None = None
    floor: Length = 0.0
    source: Text = ""
    tail: Placement | None = None
    station: Foreign = None
    tool: Foreign = None
    camera: Foreign = None
    board: Foreign = None
    deflection: Foreign = None
    truth: Foreign = None
    provenance: Foreign = None

    def chain_fields(self, where: str) -> FieldValues:
        """Return the fields of a `Chain` that these keys define, by name; `where` names the file in messages."""
        result: FieldValues = {"name": self.name, "floor": self.floor}
        if self.base is not None:
            result["base"] = self.base
        if self.tip is not None:
            result["tip"] = self.tip
        if self.tail is not None:
            result["tail"] = self.tail.transform(f"{where}: tail")
        if self.gravity is not None:
            result["gravity"] = np.array(self.gravity)
        return result


load = partial(config.read_toml, error=RobotError)
check_keys = partial(config.check_keys, error=RobotError)
number = partial(config_types.number, error=RobotError)


def word(table: Mapping[str, object], key: str, where: str, default: str | None = None) -> str:
    """Return a non-empty text from a table.

    Args:
        table: the table.
        key: key of the text.
        where: name of the table in messages.
        default: text for a missing key; None: the key is required.

    Raises:
        RobotError: the value is not a text or is empty, or the required key is missing.
    """
    value = table.get(key, default)
    if value is None:
        refuse_robot(where, f"'{key}' is missing")
    if not isinstance(value, str) or not value:
        refuse_robot(where, f"'{key}' must be text, found {shown(value)}")
    return value


def vector(value: object, count: int, where: str, quantity: str = "") -> np.ndarray:
    """Return `count` numbers (count,) in SI from a TOML list.

    Args:
        value: the list.
        count: number of numbers.
        where: name of the list in messages.
        quantity: quantity whose units are accepted, such as ``length``; empty for plain numbers.
    """
    return np.array(config_types.numbers(value, count, where, quantity, RobotError))


def placement(table: object, where: str) -> np.ndarray:
    """Return a transform (4, 4) from a table ``{xyz, rpy}`` [m, rad] or ``{matrix}`` (three or four rows).

    Args:
        table: the parsed TOML table.
        where: name of the table in messages.
    """
    if not isinstance(table, Mapping):
        refuse_robot(where, f"expected xyz and rpy, or matrix; found {shown(table)}")
    return config.parse(PlacementTable, table, where, RobotError).transform(where)


def placement_table(transform: np.ndarray) -> dict[str, list]:
    """Return a table that `placement` reads back exactly as `transform` (4, 4) [m].

    It has xyz [m] and rpy [rad] if these are exact, else the matrix.
    """
    xyz, rpy = to_xyz_rpy(transform)
    if np.array_equal(from_xyz_rpy(xyz, rpy), transform):
        table = {"xyz": xyz.tolist()}
        if rpy.any():
            table["rpy"] = [spelled(angle) for angle in rpy.tolist()]
        return table
    return {"matrix": transform[:3].tolist()}


def spelled(angle: float) -> float | str:
    """Return an angle as text (such as ``pi/2``) if it is ±pi or ±pi/2, else unchanged."""
    return _PI.get(angle, angle)


def chain_table(chain: Chain, **rows: object) -> dict[str, object]:
    """Return the table of a chain that `RobotTable` reads back exactly; the tables `rows` precede the chain's tail."""
    table: dict[str, object] = {"name": chain.name, "base": chain.base, "tip": chain.tip}
    table["gravity"] = chain.gravity.tolist()
    if chain.floor:
        table["floor"] = chain.floor
    table |= rows
    if not np.array_equal(chain.tail, np.eye(4)):
        table["tail"] = placement_table(chain.tail)
    return table


def finite_limits(joint: object) -> dict[str, float]:
    """Return the known (finite) limits of a joint or an MDH row, by name."""
    limits = {key: getattr(joint, key) for key in LIMITS}
    return {key: limit for key, limit in limits.items() if np.isfinite(limit)}


def dumps(table: Mapping[str, object]) -> str:
    """Return a table as TOML text, with floats in full precision; keys with the value None are omitted."""
    return rtoml.dumps(config.plain_values(table), none_value=None)
