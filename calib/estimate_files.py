"""An estimate on disk: ``estimate.csv``, a row per parameter, and ``covariance.csv``, a matrix by parameters' names.

Whatever was estimated, geometry or dynamics, its files have these two forms; nothing else reads or writes them.
"""

import csv
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from calib import files
from calib.errors import RobotError, refuse_robot, refused_as, require
from calib.records import plain_text

ESTIMATE, COVARIANCE = "estimate.csv", "covariance.csv"
AGAIN = "fit, or identify, again"


@dataclass(frozen=True, eq=False)
class StoredEstimate:
    """Stored estimate, the rows of ``estimate.csv``.

    Attributes:
        names, units: p texts each.
        values: (p,).
        sigma: (p,), NaN where none is stated.
        rows: p mappings from a column's name to its cell, as texts.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    values: np.ndarray
    sigma: np.ndarray
    rows: tuple[Mapping[str, str], ...]


def write_estimate(folder: Path, header: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    """Write the rows of an estimate; `header` includes ``name``, ``unit``, ``value`` and ``sigma``."""
    files.write_table(folder / ESTIMATE, header, rows)


def read_estimate(folder: Path) -> StoredEstimate:
    """Return the rows of ``estimate.csv`` in a folder.

    Raises:
        RobotError: where it is missing or damaged.
    """
    path = folder / ESTIMATE
    with refused_as(
        RobotError,
        (OSError, UnicodeDecodeError, KeyError, TypeError, ValueError),
        f"{path} cannot be read ({{}}); {AGAIN}",
    ):
        with path.open(encoding="utf-8", newline="") as file:
            rows = tuple(csv.DictReader(file))
        values, sigma = (np.array([float(row.get(key) or "nan") for row in rows]) for key in ("value", "sigma"))
        names, units = (tuple(plain_text(row[key]) for row in rows) for key in ("name", "unit"))
    return StoredEstimate(names, units, values, sigma, rows)


def write_covariance(path: Path, names: Sequence[str], covariance: np.ndarray) -> None:
    """Write the covariance (p, p) of p names as a table with a header and a first column of names."""
    files.write_numbers(path, ("name", *names), covariance, names)


def read_covariance(path: Path) -> tuple[tuple[str, ...], np.ndarray]:
    """Return p parameter names and their covariance (p, p).

    Args:
        path: of the table, or of the folder that holds ``covariance.csv``.

    Raises:
        RobotError: where it is missing or damaged.
    """
    path = path / COVARIANCE if path.is_dir() else path
    with refused_as(RobotError, (OSError, UnicodeDecodeError, ValueError), f"{path} cannot be read ({{}}); {AGAIN}"):
        with path.open(encoding="utf-8", newline="") as file:
            header, *rows = list(csv.reader(file)) or [[]]
        matrix = np.array([row[1:] for row in rows], dtype=float)
    names = tuple(map(plain_text, header[1:]))
    if tuple(plain_text(row[0]) for row in rows if row) != names or matrix.shape != (len(names), len(names)):
        refuse_robot(path, f"parameter names of rows and columns differ; {AGAIN}")
    require(np.isfinite(matrix).all(), f"{path}: not a table of finite numbers; {AGAIN}", RobotError)
    return names, matrix
