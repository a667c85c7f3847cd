"""Robot tables in TOML: reading with clear complaints, numbers with pi and units, exact writing.

A number may be a TOML number or a string: an expression of numbers, ``pi`` and ``+ - * / ( )``, with an optional unit
behind it: ``"-pi/2"``, ``"90 deg"``, ``"110 deg/s"``, ``"-313 mm"``.
"""

from __future__ import annotations

import ast
import difflib
import math
import operator
import tomllib
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import tomlkit

from calib.errors import RobotError
from calib.transforms import from_xyz_rpy, to_xyz_rpy

UNITS = {
    "angle": {"rad": 1.0, "deg": math.pi / 180},
    "length": {"m": 1.0, "mm": 1e-3},
    "angular speed": {"rad/s": 1.0, "deg/s": math.pi / 180},
    "speed": {"m/s": 1.0, "mm/s": 1e-3},
    "torque": {"Nm": 1.0, "N m": 1.0},
    "force": {"N": 1.0},
}
_BINARY = {ast.Add: operator.add, ast.Sub: operator.sub, ast.Mult: operator.mul, ast.Div: operator.truediv}
_PI = {math.pi: "pi", -math.pi: "-pi", math.pi / 2: "pi/2", -math.pi / 2: "-pi/2"}


def nearest(word: str, words: Collection[str]) -> str:
    """Return ``; did you mean 'x'?`` for the nearest of `words`, or an empty string."""
    found = difflib.get_close_matches(word, list(words), n=1, cutoff=0.5)
    return f"; did you mean '{found[0]}'?" if found else ""


def check_keys(table: Mapping[str, Any], allowed: Collection[str], where: str) -> None:
    """Refuse keys that mean nothing here, naming the nearest that does.

    Raises:
        RobotError: for the first unknown key.
    """
    for key in table:
        if key not in allowed:
            raise RobotError(f"{where}: unknown key '{key}'{nearest(key, allowed)} (known: {', '.join(allowed)})")


def load(path: str | Path) -> dict[str, Any]:
    """Read a TOML file into a dictionary.

    Raises:
        RobotError: where it is missing or is not TOML, with the line.
    """
    try:
        return tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise RobotError(f"cannot read {path}: {error.strerror or error}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise RobotError(f"{path} is not TOML: {error}") from error


def number(value: Any, where: str, quantity: str | None = None) -> float:
    """Return a number in SI units, from a TOML number or a string with pi and a unit.

    Args:
        value: e.g. ``0.4``, ``"-pi/2"``, ``"90 deg"``.
        where: names the place, for the message.
        quantity: a key of `UNITS`, which says the units it may carry; None for a bare number.

    Raises:
        RobotError: where it is no number, or carries a unit of something else.
    """
    if isinstance(value, bool) or not isinstance(value, (int, float, str)):
        raise RobotError(f"{where}: {value!r} is not a number")
    if not isinstance(value, str):
        return _real(float(value), value, where)
    text, factor = value.strip(), 1.0
    for unit, size in sorted(UNITS.get(quantity or "", {}).items(), key=lambda item: -len(item[0])):
        if text.endswith(unit):
            text, factor = text.removesuffix(unit).strip(), size
            break
    try:
        return _real(_evaluate(ast.parse(text, mode="eval").body) * factor, value, where)
    except (SyntaxError, ValueError, ZeroDivisionError, RecursionError):
        units = ", ".join(UNITS.get(quantity or "", {}))
        hint = f" (here an optional unit may follow: {units})" if units else ""
        raise RobotError(f"{where}: cannot read {value!r} as a number{hint}; try 0.4, 'pi/2' or '90 deg'") from None


def _real(result: float, value: Any, where: str) -> float:
    if math.isnan(result):
        raise RobotError(f"{where}: {value!r} is not a number")
    return result


def _evaluate(node: ast.expr) -> float:
    """Evaluate numbers, pi, signs and the four operations; anything else is a ValueError."""
    match node:
        case ast.Constant(value=int() | float() as value) if not isinstance(value, bool):
            return float(value)
        case ast.Name(id="pi"):
            return math.pi
        case ast.Name(id="inf"):
            return math.inf
        case ast.UnaryOp(op=ast.USub(), operand=operand):
            return -_evaluate(operand)
        case ast.UnaryOp(op=ast.UAdd(), operand=operand):
            return _evaluate(operand)
        case ast.BinOp(left=left, op=sign, right=right) if type(sign) in _BINARY:
            return _BINARY[type(sign)](_evaluate(left), _evaluate(right))
    raise ValueError(ast.dump(node))


def word(table: Mapping[str, Any], key: str, where: str, default: str | None = None) -> str:
    """Return a non-empty text from a table.

    Raises:
        RobotError: where it is something else, or missing without a default.
    """
    value = table.get(key, default)
    if value is None:
        raise RobotError(f"{where}: '{key}' is missing")
    if not isinstance(value, str) or not value:
        raise RobotError(f"{where}: '{key}' has to be text, found {value!r}")
    return value


def vector(value: Any, count: int, where: str, quantity: str | None = None) -> np.ndarray:
    """Return (count,) numbers in SI units from a TOML list."""
    if not isinstance(value, (list, tuple)) or len(value) != count:
        raise RobotError(f"{where}: expected a list of {count} numbers, found {value!r}")
    return np.array([number(entry, where, quantity) for entry in value])


def placement(table: Any, where: str) -> np.ndarray:
    """Return a transform (4, 4) from a table ``{xyz, rpy}`` [m, rad] or ``{matrix}`` (three or four rows)."""
    if not isinstance(table, Mapping):
        raise RobotError(f"{where}: expected xyz and rpy, or matrix; found {table!r}")
    check_keys(table, ("xyz", "rpy", "matrix"), where)
    if "matrix" not in table:
        zero = [0.0, 0.0, 0.0]
        xyz = vector(table.get("xyz", zero), 3, f"{where}, xyz", "length")
        return from_xyz_rpy(xyz, vector(table.get("rpy", zero), 3, f"{where}, rpy", "angle"))
    rows = table["matrix"]
    if not isinstance(rows, list) or len(rows) not in (3, 4):
        raise RobotError(f"{where}: matrix needs three or four rows")
    result = np.eye(4)
    result[: len(rows)] = [vector(row, 4, f"{where}, matrix") for row in rows]
    error = np.abs(result[:3, :3].T @ result[:3, :3] - np.eye(3)).max()
    if not error < 1e-6 or np.linalg.det(result[:3, :3]) < 0:
        raise RobotError(f"{where}: the rotation in matrix is no rotation (R'R - 1 = {error:.2g})")
    return result


def placement_table(transform: np.ndarray) -> dict[str, list]:
    """Return the table that `placement` reads back exactly: xyz and rpy where they are exact, else the matrix."""
    xyz, rpy = to_xyz_rpy(transform)
    if np.array_equal(from_xyz_rpy(xyz, rpy), transform):
        table = {"xyz": xyz.tolist()}
        return table if not rpy.any() else {**table, "rpy": [spelled(angle) for angle in rpy.tolist()]}
    return {"matrix": transform[:3].tolist()}


def spelled(angle: float) -> float | str:
    """Return pi and pi/2 as a person writes them, and any other number as it is."""
    return _PI.get(angle, angle)


def plain(value: Any) -> Any:
    """Return `value` with arrays, tuples and numpy numbers as lists and Python numbers, Nones left out of tables."""
    if isinstance(value, Mapping):
        return {str(key): plain(entry) for key, entry in value.items() if entry is not None}
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, (list, tuple)):
        return [plain(entry) for entry in value]
    return value.item() if isinstance(value, np.generic) else value


def dumps(table: Mapping[str, Any]) -> str:
    """Return TOML text; floats in full (repr), so that reading them back is exact."""
    return tomlkit.dumps(plain(table))
