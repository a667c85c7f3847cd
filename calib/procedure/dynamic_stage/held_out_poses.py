"""Errors of a fit's held-out poses with another geometry, by the residuals in the fit's folder.

The residual of a row changes by the shift of its predicted position, r - (p_after - p_before), to first order. Base and
tool placement are fitted anew to the fitted rows before and after. This approximates the fit: by plain least squares,
its rows not weighted, and with the same correction of the base for all stations.

The squared errors of each pose before and after are compared by their differences: their mean, beside its standard
error. Gross rows are moved to the edge of the others (winsorised). The scatter of the placement itself, common to all
poses, is not in the standard error.
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from calib.geometry import installation
from calib.geometry.installation import Installation
from calib.records import shielded
from calib.robot.chain import Chain
from calib.robot.kinematics import forward
from calib.transforms import invert

if TYPE_CHECKING:
    from calib.procedure.kinematic_stage.folder import FitFolder, ValidationFolder

MIN_POSES = 8
"""Poses from which on errors are compared: 2 standard errors of so few are passed in 4 % by chance (Student's t)."""
MAX_STANDARD_ERRORS = 2.0
"""Standard errors by which squared errors may rise; more is no chance, with a probability of some 2 % (our choice)."""
MAX_SCATTER = 3.0
"""Robust standard deviations from the median at which differences are winsorised (our choice)."""
NORMAL = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""
METRES = 1e-3
"""Unit of the tables' position residuals [m]."""


@dataclass(frozen=True)
class HeldOutErrors:
    """Errors of held-out poses before and after a change of the geometry.

    Attributes:
        poses: number of poses.
        before, after: rms position error [m].
        rise: mean rise of the squared errors in its standard errors, gross poses winsorised.
    """

    poses: int
    before: float
    after: float
    rise: float

    @property
    def is_worse(self) -> bool:
        """Whether the errors rise by more than chance explains, on enough poses."""
        return self.poses >= MIN_POSES and self.rise > MAX_STANDARD_ERRORS


class _Rows(NamedTuple):
    """Positions of a fit's rows: joint values (m, n), residual (m, 3) [m] in the base frame, tool (m,)."""

    q: np.ndarray
    residual: np.ndarray
    tool: np.ndarray


def held_out_errors(source: Path, before: Chain, after: Chain) -> HeldOutErrors | None:
    """Return the errors of a fit's held-out poses with its geometry and with another one.

    None without held-out positions: they are in the fit's folder, or in the validation of the session.

    Args:
        source: the fit's folder, or a file in it.
        before, after: the arm of the fit, and the same arm with other values.
    """
    # slow to load, and only needed where the geometry is identified, too
    from calib.procedure.kinematic_stage.folder import IN_SESSION, VALIDATED, FitFolder, ValidationFolder

    folder = FitFolder(source if source.is_dir() else source.parent)
    if not folder.residuals.is_file() or not folder.robot.is_file():
        return None
    cell = installation.read(folder.path)
    fitted = _residual_rows(folder, cell, ("fit",))
    unseen = _residual_rows(folder, cell, ("validation", "held out"))
    if not len(unseen.q) and folder.path.name == IN_SESSION:
        unseen = _session_rows(ValidationFolder(folder.path.with_name(VALIDATED)), cell)
    copies = (unseen.q[:, None] == fitted.q).all(axis=2).any(axis=1)
    unseen = _Rows(*(column[~copies] for column in unseen))
    if not len(unseen.q) or not len(fitted.q):
        return None
    unmoved = _squares_after_placement(fitted, unseen, before, cell)
    moved_fitted = _shifted(fitted, before, after, cell)
    moved_unseen = _shifted(unseen, before, after, cell)
    moved = _squares_after_placement(moved_fitted, moved_unseen, before, cell)
    rise = standard_errors(moved - unmoved)
    return HeldOutErrors(len(unseen.q), float(np.sqrt(unmoved.mean())), float(np.sqrt(moved.mean())), rise)


def standard_errors(differences: np.ndarray) -> float:
    """Return the mean of differences (m,) over its standard error, both winsorised; 0 where they do not scatter."""
    median = np.median(differences)
    scatter = NORMAL * np.median(np.abs(differences - median))
    limit = MAX_SCATTER * scatter
    bounded = np.clip(differences, median - limit, median + limit)
    if len(bounded) < 2 or not np.ptp(bounded):
        return 0.0
    return float(bounded.mean() / (bounded.std(ddof=1) / np.sqrt(len(bounded))))


def _shifted(rows: _Rows, before: Chain, after: Chain, cell: Installation) -> _Rows:
    """Return rows with the residuals of a changed arm."""
    shift = _targets(after, cell, rows) - _targets(before, cell, rows)
    return rows._replace(residual=rows.residual - shift)


def _squares_after_placement(fitted: _Rows, unseen: _Rows, chain: Chain, cell: Installation) -> np.ndarray:
    """Return the squared errors (m,) [m²] of unseen rows with base and targets placed by the fitted rows."""
    slopes = _placement_slopes(chain, cell, fitted)
    parameters = slopes.shape[2]
    change, *_ = np.linalg.lstsq(slopes.reshape(-1, parameters), fitted.residual.ravel(), rcond=None)
    errors = unseen.residual - _placement_slopes(chain, cell, unseen) @ change
    return np.sum(errors**2, axis=1)


def _residual_rows(folder: FitFolder, cell: Installation, sets: tuple[str, ...]) -> _Rows:
    """Return the rows of ``residuals.csv`` that have positions from a station and a tool of the fit.

    Args:
        folder: folder of the fit.
        cell: its arm, stations and tools.
        sets: names of the sets of rows; outliers are left out.
    """
    from calib.procedure.kinematic_stage.fit_tables import COMPONENTS

    q, residual, tool = [], [], []
    with folder.residuals.open(encoding="utf-8", newline="") as file:
        for row in csv.DictReader(file):
            error = _vector(row, COMPONENTS["position"])
            usable = row["set"] in sets and row["outlier"] != "1" and np.isfinite(error).all()
            if not usable or row["station"] not in cell.station_names or row["tool"] not in cell.tool_names:
                continue
            rotation = invert(cell.stations[cell.station_names.index(row["station"])])[:3, :3]
            q.append(_joint_values(cell.chain, row))
            residual.append(rotation @ error)
            tool.append(cell.tool_names.index(row["tool"]))
    return _Rows(np.reshape(q, (-1, cell.chain.n)), np.reshape(residual, (-1, 3)), np.array(tool, dtype=int))


def _session_rows(folder: ValidationFolder, cell: Installation) -> _Rows:
    """Return the rows of a session's validation; none where several tools were measured.

    The table has predicted minus measured positions, in the base frame.
    """
    from calib.procedure.kinematic_stage.fit_tables import TO_CALIBRATED

    q, residual = [], []
    if folder.errors.is_file() and len(cell.tools) == 1:
        with folder.errors.open(encoding="utf-8", newline="") as file:
            for row in csv.DictReader(file):
                error = _vector(row, TO_CALIBRATED)
                if not np.isfinite(error).all():
                    continue
                q.append(_joint_values(cell.chain, row))
                residual.append(-error)
    return _Rows(np.reshape(q, (-1, cell.chain.n)), np.reshape(residual, (-1, 3)), np.zeros(len(q), dtype=int))


def _vector(row: dict[str, str], columns: Sequence[str]) -> np.ndarray:
    """Return the vector (3,) [m] in three columns of a row [mm]; NaN for empty cells."""
    return METRES * np.array([float(row[column] or "nan") for column in columns])


def _joint_values(chain: Chain, row: dict[str, str]) -> list[float]:
    return [float(row[shielded(f"{joint.name} [{joint.unit}]")]) for joint in chain.joints]


def _targets(chain: Chain, cell: Installation, rows: _Rows) -> np.ndarray:
    """Return the predicted positions (m, 3) [m] of the targets in the base frame."""
    tip = forward(chain, rows.q)
    return np.einsum("mij,mj->mi", tip[:, :3, :3], cell.tools[rows.tool, :3, 3]) + tip[:, :3, 3]


def _placement_slopes(chain: Chain, cell: Installation, rows: _Rows) -> np.ndarray:
    """Return the derivatives (m, 3, 6 + 3 k) of positions by placement of the base and position of the k targets."""
    count = len(rows.q)
    tip = forward(chain, rows.q)
    slopes = np.zeros((count, 3, 6 + 3 * len(cell.tools)))
    slopes[:, :, :3] = np.eye(3)
    targets = _targets(chain, cell, rows)
    for axis, unit in enumerate(np.eye(3)):
        slopes[:, :, 3 + axis] = np.cross(unit, targets)
    for number in range(len(cell.tools)):
        measured = rows.tool == number
        slopes[measured, :, 6 + 3 * number : 9 + 3 * number] = tip[measured, :3, :3]
    return slopes
