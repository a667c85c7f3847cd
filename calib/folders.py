"""Folders of results: written completely to a temporary folder, then moved to their final path.

The module also reads and writes the estimates in them, of geometry and dynamics alike: ``estimate.csv`` has one row per
parameter, ``covariance.csv`` is a matrix with parameter names.
"""

import csv
import os
import shutil
import tempfile
from collections.abc import Callable, Collection, Iterable, Sequence
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, NamedTuple, TypeVar, overload

import numpy as np

from calib import files
from calib.errors import CalibError, RobotError, UsageError, refuse_robot, refused_as, require
from calib.records import plain_text, read_rows

Row = TypeVar("Row")

GRAVITY_SUMMARY = "gravity_summary.txt"
"""File that identifies the gravity of standing poses."""

METRICS, SESSION, STATE = "metrics.json", "session.toml", "state.json"
"""Files that identify results and sessions; the metrics are written last and mark a folder as complete."""
REPORT, CERTIFICATE = "report.json", "certificate.html"
"""The certificate, and the data for it and its figures."""
PAGES = (CERTIFICATE, "certificate.pdf", "report.html")
"""The certificate as a page and as a document, and the report with all tables and figures."""
FIGURES = "figures.json"
"""Figures as data, where no page has them."""
JOINT_COMPLIANCE, COMPLIANCE = "joint_compliance.csv", "compliance [rad/(N m)]"
"""Table of the compliance of joints with two encoders, and the heading of its values."""
OFFSETS, PARAMETERS = "joint_offsets.csv", "parameters.json"
"""Files that identify an export, of a geometry and of dynamics."""


class InFolder:
    """Descriptor of a class for folders: the attribute's value is the path of a named file in the folder.

    The class must have an attribute ``path``, the folder.
    """

    def __init__(self, name: str):
        self.name = name

    def __get__(self, folder: Any, kind: type | None = None) -> Path:
        return folder.path / self.name


def figure_files(*names: str) -> tuple[str, ...]:
    """Return the names of all files that hold figures: their data, each as PNG and SVG, and its samples.

    Args:
        names: names of the figures, or patterns of names.
    """
    drawn = [f"plot_{name}{suffix}" for name in names for suffix in (".png", ".svg")]
    return (FIGURES, *drawn, *(f"figure_{name}.js" for name in names))


def check_target(
    out: Path, ours: Collection[str], marks: Collection[str], kind: str, inputs: Iterable[str | Path | None] = ()
) -> None:
    """Raise an error, before any work is done, for a folder that cannot be written or contains other files.

    Args:
        out: folder for the results.
        ours: names, or patterns of names (``plot_torque_*.png``), of all files that may be written into the folder.
        marks: names of files by which an earlier result of this kind is recognised.
        kind: name of this kind of result, for messages.
        inputs: input files and folders, which must not be overwritten. The name of a recording may have a time range
            appended (``log.npz@0:9``).

    Raises:
        UsageError: the folder is refused; the message names the file or folder concerned.
    """
    if os.path.isfile(out):  # False for names that no file can have
        raise UsageError(f"{out} is a file; results go into a folder (--out)")
    files.check_writable(out)
    files.check_not_input([out, *(out / name for name in ours)], inputs)
    foreign = files_of(out, {METRICS, SESSION} - set(ours))
    if foreign:
        raise UsageError(f"{out} contains {foreign[0]} of another result or session; choose another folder (--out)")
    present = files_of(out, ours)
    if present and not all((out / name).exists() for name in marks):
        raise UsageError(f"{out} contains {', '.join(present)}, not from an earlier {kind}; choose another (--out)")


def files_of(folder: Path, ours: Collection[str]) -> list[str]:
    """Return the file names in a folder that match `ours` (names or patterns); empty if the folder is missing."""
    if not folder.is_dir():
        return []

    def matches(name: str) -> bool:
        return any(fnmatchcase(name, pattern) for pattern in ours)

    return sorted(filter(matches, os.listdir(folder)))


def write_staged(out: Path, ours: Collection[str], write: Callable[[Path], object]) -> Path:
    """Call `write` with a temporary folder next to `out`, then move the files in it to `out`; return `out`.

    A new folder appears complete, by one rename. In a folder of an earlier run each file is replaced, other files that
    match `ours` (names or patterns) are removed, and all remaining files are kept.

    Raises:
        UsageError: the folder cannot be written.
    """
    requested = out
    try:
        # ``.`` and ``..`` have no name to stage under.
        out = out.resolve()
        out.parent.mkdir(parents=True, exist_ok=True)
        files.clear_leftovers(out)
        prefix, suffix = files.staged_name(out)
        staging = Path(tempfile.mkdtemp(suffix, prefix, out.parent))
    except (OSError, RuntimeError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise UsageError(f"cannot write next to {out}: {reason}; nothing was changed there") from error
    try:
        write(staging)
        os.chmod(staging, 0o777 & ~files.umask())
        if out.exists():
            _move_files(staging, out, ours)
        else:
            os.replace(staging, out)
    except CalibError as error:  # names the folder that was filled, not the one that was asked for
        error.args = tuple(str(argument).replace(str(staging), str(requested)) for argument in error.args)
        raise
    except OSError as error:
        raise UsageError(f"cannot write {requested}: {error.strerror or error}; nothing was changed there") from error
    finally:
        shutil.rmtree(staging, ignore_errors=True)
    return requested


def _move_files(staging: Path, out: Path, ours: Collection[str]) -> None:
    """Replace the files of an earlier run one by one.

    The metrics are replaced last, since their presence marks the folder as complete.
    """
    fresh = sorted(path.name for path in staging.iterdir())
    with refused_as(UsageError, OSError, f"cannot write to {out}: {{}}"):
        for name in sorted(fresh, key=lambda name: name == METRICS):
            if (staging / name).is_dir():
                shutil.rmtree(out / name, ignore_errors=True)
            os.replace(staging / name, out / name)
        for name in set(files_of(out, ours)) - set(fresh):
            if (out / name).is_dir():
                shutil.rmtree(out / name)
            else:
                (out / name).unlink(missing_ok=True)


ESTIMATE, COVARIANCE = "estimate.csv", "covariance.csv"
AGAIN = "fit, or identify, again"


class EstimateRow(NamedTuple):
    """A row of ``estimate.csv``; sigma is None where the cell is empty."""

    name: str
    unit: str
    value: float
    sigma: float | None


@overload
def read_estimate(folder: Path) -> tuple[EstimateRow, ...]: ...
@overload
def read_estimate(folder: Path, kind: type[Row]) -> tuple[Row, ...]: ...
def read_estimate(folder: Path, kind: type = EstimateRow) -> tuple[object, ...]:
    """Return the rows of ``estimate.csv`` in a folder as named tuples `kind`, whose fields are the columns.

    Raises:
        RobotError: the file is missing or damaged.
    """
    path = folder / ESTIMATE
    with refused_as(RobotError, (OSError, ValueError), f"{path} cannot be read ({{}}); {AGAIN}"):
        return read_rows(kind, path)


def write_covariance(path: Path, names: Sequence[str], covariance: np.ndarray) -> None:
    """Write the covariance (p, p) of p named parameters as a CSV table with the names as header and as first column."""
    files.write_numbers(path, ("name", *names), covariance, names)


def read_covariance(path: Path) -> tuple[tuple[str, ...], np.ndarray]:
    """Return p parameter names and their covariance (p, p).

    Args:
        path: path of the table, or of the folder that contains ``covariance.csv``.

    Raises:
        RobotError: the file is missing or damaged.
    """
    if path.is_dir():
        path = path / COVARIANCE
    with refused_as(RobotError, (OSError, UnicodeDecodeError, ValueError), f"{path} cannot be read ({{}}); {AGAIN}"):
        with path.open(encoding="utf-8", newline="") as file:
            header, *rows = list(csv.reader(file)) or [[]]
        matrix = np.array([row[1:] for row in rows], dtype=float)
    names = tuple(map(plain_text, header[1:]))
    row_names = tuple(plain_text(row[0]) for row in rows if row)
    if row_names != names or matrix.shape != (len(names), len(names)):
        refuse_robot(path, f"parameter names of rows and columns differ; {AGAIN}")
    require(np.isfinite(matrix).all(), f"{path}: not a table of finite numbers; {AGAIN}", RobotError)
    return names, matrix
