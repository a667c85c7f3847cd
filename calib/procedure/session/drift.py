"""Drift of instrument, base or tool during a measurement, computed from poses that were measured more than once.

Two figures are computed. The first is the rms distance between repeated measurements of a pose; the part that differing
joint values explain by the nominal arm is subtracted by magnitude. The second, if the file has a column of time or
temperature x, is the trend of the target's position with x. Let p be the measured points minus the points predicted by
the placed nominal arm; p̃ and x̃ are p and x minus their means over the visits of each pose. Then

    p̃ = s x̃ + noise,   s = Σ x̃ p̃ / Σ x̃²,   σ² = Σ |p̃ - s x̃|² / dof,   dof = 3 (visits - poses - 1)

with equal noise σ per axis. The F distribution of Σ x̃² |s|² / 3 σ² determines whether s differs from 0. A moving base
or tracker translates the target equally at all poses. A warming arm also grows, which affects each pose differently;
the trend is the average over the poses.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from itertools import pairwise
from pathlib import Path

import numpy as np
from scipy.spatial import KDTree
from scipy.special import fdtrc, ndtri

from calib.data.csv_table import Table, read_table
from calib.data.poses.measurements import PoseMeasurements, Positions
from calib.errors import CalibError, Finding, finding
from calib.geometry.first_guess import install
from calib.geometry.observation import positions, prepare
from calib.procedure.session.folder import Session
from calib.robot.chain import Chain
from calib.robot.kinematics import forward

SAME_POSE = 1e-3
"""Joint values of a pose that is visited again differ by less [rad or m] (our choice)."""
MIN_DRIFT_SIGMAS = 3.0
"""Standard errors by which repeated poses have to be off to be called drift (our choice)."""
MIN_NOISE = 1e-12
"""Lower bound of the noise [m], for measurements that repeat exactly."""
MIN_SPREAD = 1e-12
"""Smallest sum of squares of the visits' times, relative to the square of the file's range, that shows a trend."""
SECONDS = {"": 1.0, "s": 1.0, "ms": 1e-3, "min": 60.0, "h": 3600.0}
"""Unit of a column of time -> seconds."""
HOURS = "h"
CELSIUS = "°C"
TIME_COLUMN = re.compile(r"t|time|date|timestamp|date.?time", re.I)
TEMPERATURE_COLUMN = re.compile(r"temp.*", re.I)


@dataclass(frozen=True)
class Drift:
    """Differences between two measurements of the same poses.

    Attributes:
        poses: number of pairs of measurements.
        rms: rms distance of the two measured points, minus the displacement by differing joint values [m].
    """

    poses: int
    rms: float

    def exceeds(self, sigma: float) -> bool:
        """Return whether the differences are larger than measurement noise explains.

        Args:
            sigma: σ of a measured position, per axis [m].
        """
        return self.rms > (MIN_DRIFT_SIGMAS / np.sqrt(self.poses) + 1.0) * noise_of_difference(sigma)


@dataclass(frozen=True, eq=False)
class Trend:
    """Motion of the target with time or temperature.

    Attributes:
        column: name of the column.
        unit: unit of the column's values: h or °C.
        x: (m,) time from the start, or temperature, at the measurements of repeated poses [unit].
        displacement: (m, 3) measured points minus the arm's prediction and minus the mean of each pose [m], in the
            instrument's frame.
        poses: number of repeated poses.
        span: range of the column over all rows [unit].
        slope: (3,) rate of the target's motion [m per unit].
        sigma: standard deviation of the rate, per axis [m per unit].
        sigmas: significance of the slope, as the deviation of a normal variable with the same probability.
    """

    column: str
    unit: str
    x: np.ndarray
    displacement: np.ndarray
    poses: int
    span: float
    slope: np.ndarray
    sigma: float
    sigmas: float

    @property
    def size(self) -> float:
        """Length of the slope vector [m per unit]."""
        return float(np.linalg.norm(self.slope))

    @property
    def total(self) -> float:
        """Distance that the target moves over the column's range [m]."""
        return self.size * self.span

    def finding(self, need: float) -> Finding:
        """Return a finding on this trend.

        Args:
            need: smallest distance that matters [m]; 0: unknown.
        """
        rate = f"{1e3 * self.size:.2g} ± {1e3 * self.sigma:.1g} mm/{self.unit}"
        times = self.total / need if need else 0.0
        return finding(
            "target-drifts", sigmas=self.sigmas, times=times, rate=rate, total=self.total, column=self.column
        )


def noise_of_difference(sigma: float) -> float:
    """Return the expected rms distance [m] of two measurements of one point, each with `sigma` per axis [m]."""
    return float(np.sqrt(6.0) * sigma)


def of_session(
    session: Session, chain: Chain, blocks: Sequence[PoseMeasurements], again: Sequence[PoseMeasurements]
) -> list[Finding]:
    """Return findings on drift in the measurements of a session.

    Args:
        session: the session.
        chain: the nominal arm.
        blocks: measurements for the fit.
        again: measurements repeated at the end.
    """
    instrument = session.settings.instrument
    tolerance = 1e-3 * session.settings.fit.tolerance_mm
    sigma = instrument.sigma_position
    if instrument.reference and sigma:
        sigma = _stated_sigma(blocks) or sigma
    findings = repeats(chain, blocks, again, sigma)
    for trend in trends(chain, blocks, again, sigma):
        findings.append(trend.finding(tolerance or noise_of_difference(sigma)))
    return findings


def _stated_sigma(blocks: Sequence[PoseMeasurements]) -> float:
    """Return the rms of the positions' stated σ per axis [m], which seen from a base frame grow with the distance.

    0 without stated σ.
    """
    measured = [block for block in blocks if isinstance(block, Positions)]
    sigmas = [block.sigma.ravel() for block in measured if block.sigma is not None]
    if not sigmas:
        return 0.0
    return float(np.sqrt(np.mean(np.concatenate(sigmas) ** 2)))


def repeats(
    chain: Chain, blocks: Sequence[PoseMeasurements], again: Sequence[PoseMeasurements], sigma: float
) -> list[Finding]:
    """Return findings on drift, from poses measured again at the end, and from poses repeated within a file.

    Args:
        chain: the nominal arm.
        blocks: measurements for the fit.
        again: measurements from files whose names start with drift.
        sigma: σ of one position, per axis [m]; 0: unknown, so that the drift is stated but not judged.
    """
    drifts = [(later.file, "again at the end", drift_of(chain, later, blocks)) for later in again]
    drifts += [(block.file, "more than once", drift_of(chain, block)) for block in blocks]
    noise = None
    if sigma:
        noise = noise_of_difference(sigma)
    findings = []
    for file, when, drift in drifts:
        if drift is None:
            continue
        beyond_noise = bool(sigma) and drift.exceeds(sigma)
        drift_finding = finding(
            "poses-moved" if beyond_noise else "poses-repeat",
            file=Path(file).name,
            when=when,
            poses=drift.poses,
            rms=drift.rms,
            noise=noise,
        )
        findings.append(drift_finding)
    return findings


def drift_of(chain: Chain, later: PoseMeasurements, first: Sequence[PoseMeasurements] | None = None) -> Drift | None:
    """Return the drift between measurements and earlier measurements of the same poses; None without common poses.

    Displacements by differing joint values (nominal arm) are subtracted by magnitude, since the instrument's frame is
    unknown.

    Args:
        chain: the nominal arm.
        later: measured poses or positions; for other kinds of measurement, the result is None.
        first: the earlier measurements; None: each row of `later` is compared with the earlier rows of `later`.
    """
    if not isinstance(later, Positions):
        return None
    blocks = [later]
    if first is not None:
        blocks = [block for block in first if isinstance(block, Positions)]
    if not any(len(block) for block in blocks):
        return None
    q = np.concatenate([block.q for block in blocks])
    position = np.concatenate([block.position for block in blocks])
    tool = np.concatenate([block.tool for block in blocks])

    squares = []
    for k in range(len(later)):
        same_pose = np.abs(q - later.q[k]).max(axis=1) < SAME_POSE
        visits = np.flatnonzero(same_pose & (tool == later.tool[k]))
        if first is None:
            # of the rows of one file, the earlier ones
            visits = visits[visits < k]
        if not len(visits):
            continue
        visit = visits[0]
        tip = forward(chain, np.array([q[visit], later.q[k]]))[:, :3, 3]
        by_joints = tip[1] - tip[0]
        shift = later.position[k] - position[visit]
        squares.append(max(float(shift @ shift - by_joints @ by_joints), 0.0))
    if not squares:
        return None
    return Drift(len(squares), float(np.sqrt(np.mean(squares))))


def trends(
    chain: Chain, blocks: Sequence[PoseMeasurements], again: Sequence[PoseMeasurements] = (), sigma: float = 0.0
) -> list[Trend]:
    """Return the target's motion with time and with each temperature in the files; empty without repeated poses.

    Args:
        chain: the nominal arm.
        blocks: measured poses or positions; other kinds are ignored. Times are used only if all files have a common
            clock, that is, if their time ranges do not overlap.
        again: measurements at the end, from the station of the first block.
        sigma: σ of one position, per axis [m], a lower bound for the noise; 0: unknown.
    """
    measured = [block for block in blocks if isinstance(block, Positions)]
    if not measured:
        return []
    for block in again:
        if isinstance(block, Positions):
            measured.append(replace(block, station=measured[0].station))
    try:
        cell = install(chain, measured)
    except CalibError:  # too few rows to place the instrument
        return []
    displacements, keys = [], []
    for block, prepared in zip(measured, prepare(cell, measured)):
        displacements.append(block.position - positions(cell, prepared).T)
        # rows of another target or station are never the same pose
        station = np.full(len(block), 1e3 * prepared.station)
        keys.append(np.column_stack([block.q, 1e3 * block.tool, station]))
    displacement = np.concatenate(displacements)
    pose = _first_visits(np.concatenate(keys))

    tables = [_columns(Path(block.file), block.rows) for block in measured]
    result = []
    for column, (unit, _) in tables[0].items():
        if not all(column in table for table in tables):
            continue
        values = [table[column][1] for table in tables]
        if unit == HOURS and not _one_clock(values):
            continue
        trend = _trend(column, unit, np.concatenate(values), displacement, pose, sigma)
        if trend is not None:
            result.append(trend)
    return result


def _first_visits(keys: np.ndarray) -> np.ndarray:
    """Return for each row the index (m,) of the first row with the same pose, up to a difference of `SAME_POSE`.

    Args:
        keys: (m, k) joint values, and scaled indices of target and station.
    """
    neighbours = KDTree(keys).query_ball_point(keys, SAME_POSE, p=np.inf)
    return np.array([min(rows) for rows in neighbours])


def _one_clock(times: Sequence[np.ndarray]) -> bool:
    """Return whether the time ranges of files do not overlap, so that the files can have one clock.

    They overlap if each file counts from its own start.

    Args:
        times: times of the rows of each file [h].
    """
    spans = sorted((values.min(), values.max()) for values in times)
    return all(earlier[1] <= later[0] for earlier, later in pairwise(spans))


def _trend(
    column: str, unit: str, x: np.ndarray, displacement: np.ndarray, pose: np.ndarray, sigma: float
) -> Trend | None:
    """Return the trend of repeated poses with a column; None if too few are repeated, or the column does not vary.

    Args:
        column: name of the column.
        unit: its unit.
        x: (m,) its values [unit].
        displacement: (m, 3) measured points minus the arm's prediction [m].
        pose: (m,) index of the pose of each row.
        sigma: lower bound of the noise, per axis [m].
    """
    _, index, counts = np.unique(pose, return_inverse=True, return_counts=True)
    repeated = counts[index] > 1
    poses = int(np.sum(counts > 1))
    visits = int(repeated.sum())
    dof = 3 * (visits - poses - 1)
    x_centred = _minus_pose_means(x[:, None], index, counts)[repeated, 0]
    displacement = _minus_pose_means(displacement, index, counts)[repeated]
    span = float(np.ptp(x))
    squares = float(x_centred @ x_centred)
    if dof < 1 or span == 0.0 or squares <= MIN_SPREAD * span**2:
        return None

    slope = x_centred @ displacement / squares
    residual = displacement - np.outer(x_centred, slope)
    noise = max(float(np.sqrt(np.sum(residual**2) / dof)), sigma, MIN_NOISE)
    statistic = squares * float(slope @ slope) / (3.0 * noise**2)
    # the probability that noise alone gives such a slope; its logarithm must exist
    probability = max(float(fdtrc(3, dof, statistic)), 1e-300)
    sigmas = -float(ndtri(probability / 2.0))
    return Trend(column, unit, x[repeated], displacement, poses, span, slope, noise / np.sqrt(squares), sigmas)


def _minus_pose_means(values: np.ndarray, index: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Return values (m, k) minus their means over the visits of each pose.

    Args:
        values: (m, k).
        index: (m,) number of the pose of each row.
        counts: rows of each pose.
    """
    sums = np.zeros((len(counts), values.shape[1]))
    np.add.at(sums, index, values)
    means = sums / counts[:, None]
    return values - means[index]


def _columns(path: Path, rows: np.ndarray) -> dict[str, tuple[str, np.ndarray]]:
    """Return time [h] and temperatures [°C] of a file's rows: column name -> unit and values (m,).

    Args:
        path: the file.
        rows: (m,) row numbers, counted from 1.
    """
    if not path.is_file():
        return {}
    columns = {}
    for name, unit, values in _covariates(read_table(path)):
        if len(values) >= rows.max():
            columns[name] = unit, values[rows - 1]
    return columns


def _covariates(table: Table) -> Iterator[tuple[str, str, np.ndarray]]:
    """Yield name, unit and values (m,) of a table's columns of time [h] and temperature [°C]."""
    for name, unit, cells in zip(table.header, table.units, table.cells):
        if TEMPERATURE_COLUMN.fullmatch(name):
            if cells.dtype == float and np.isfinite(cells).all():
                yield name, CELSIUS, cells
        elif TIME_COLUMN.fullmatch(name):
            seconds = _seconds(cells, unit)
            if seconds is not None:
                yield name, HOURS, seconds / 3600.0


def _seconds(cells: np.ndarray, unit: str) -> np.ndarray | None:
    """Return the times [s] in a column: numbers in a unit of `SECONDS`, or dates in ISO 8601; None for other columns.

    Args:
        cells: (m,) cells of the column.
        unit: unit in the column's header.
    """
    if cells.dtype == float:
        readable = unit in SECONDS and np.isfinite(cells).all()
        return SECONDS[unit] * cells if readable else None
    try:
        return np.array([datetime.fromisoformat(str(cell)).timestamp() for cell in cells])
    except ValueError:
        return None
