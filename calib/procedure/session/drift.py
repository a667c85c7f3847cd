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

SAME = 1e-3  # joints of a pose that is visited again differ by less [rad or m]; our choice
MIN_DRIFT_SIGMAS = 3.0  # standard errors that repeated poses have to be off to be called drift
TIMES = {"": 1.0, "s": 1.0, "ms": 1e-3, "min": 60.0, "h": 3600.0}
COVARIATES = {"time": re.compile(r"t|time|date|timestamp|date.?time", re.I), "temperature": re.compile(r"temp.*", re.I)}


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
        what: name of the column.
        unit: unit of the column's values: h or °C.
        x: (m,) time from the start, or temperature, at the measurements of repeated poses [unit].
        moved: (m, 3) measured points minus the arm's prediction and minus the mean of each pose [m], in the
            instrument's frame.
        poses: number of repeated poses.
        span: range of the column over all rows [unit].
        slope: (3,) rate of the target's motion [m per unit].
        sigma: standard deviation of the rate, per axis [m per unit].
        sigmas: significance of the slope, as the deviation of a normal variable with the same probability.
    """

    what: str
    unit: str
    x: np.ndarray
    moved: np.ndarray
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
        return finding("target-drifts", sigmas=self.sigmas, times=times, rate=rate, total=self.total, column=self.what)


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
    instrument, tolerance = session.settings.instrument, 1e-3 * session.settings.fit.tolerance_mm
    sigma = instrument.sigma_position
    if instrument.reference and sigma:
        sigma = _stated_sigma(blocks) or sigma
    trended = [one.finding(tolerance or noise_of_difference(sigma)) for one in trends(chain, blocks, again, sigma)]
    return [*repeats(chain, blocks, again, sigma), *trended]


def _stated_sigma(blocks: Sequence[PoseMeasurements]) -> float:
    """Return the rms of the positions' stated σ per axis [m], which seen from a base frame grow with the distance.

    0 without stated σ.
    """
    squares = [block.sigma.ravel() ** 2 for block in blocks if isinstance(block, Positions) and block.sigma is not None]
    if not squares:
        return 0.0
    return float(np.sqrt(np.mean(np.concatenate(squares))))


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
    before = [later] if first is None else first
    earlier = [(block, k) for block in before if isinstance(block, Positions) for k in range(len(block))]
    if not earlier or not isinstance(later, Positions):
        return None
    q, squares = np.array([block.q[k] for block, k in earlier]), []
    tool = np.array([block.tool[k] for block, k in earlier])
    for k in range(len(later)):
        same = (np.abs(q - later.q[k]).max(axis=1) < SAME) & (tool == later.tool[k])
        near = np.flatnonzero(same if first is not None else same[:k])
        if len(near):
            other, row = earlier[near[0]]
            was, now = forward(chain, np.array([other.q[row], later.q[k]]))[:, :3, 3]
            shift, joints = later.position[k] - other.position[row], now - was
            squares.append(max(float(shift @ shift) - float(joints @ joints), 0.0))
    return Drift(len(squares), float(np.sqrt(np.mean(squares)))) if squares else None


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
    seen = [block for block in blocks if isinstance(block, Positions)]
    seen += [replace(block, station=seen[0].station) for block in again if seen and isinstance(block, Positions)]
    try:
        cell = install(chain, seen) if seen else None
    except CalibError:  # too few rows to place the instrument
        cell = None
    if cell is None:
        return []
    ready = prepare(cell, seen)
    off = [block.position - positions(cell, one).T for block, one in zip(seen, ready)]
    key = [
        np.column_stack([block.q, 1e3 * block.tool, np.full(len(block), 1e3 * k.station)])
        for block, k in zip(seen, ready)
    ]
    pose = _poses(np.concatenate(key))
    tables = [_columns(Path(block.file), block.rows) for block in seen]
    shared = [name for name in tables[0] if all(name in each for each in tables)]
    columns = [(name, tables[0][name][0], [each[name][1] for each in tables]) for name in shared]
    found = (
        _trend(name, unit, np.concatenate(values), np.concatenate(off), pose, sigma)
        for name, unit, values in columns
        if unit != "h" or _one_clock(values)
    )
    return [one for one in found if one is not None]


def _poses(key: np.ndarray) -> np.ndarray:
    """Return for each row the index (m,) of the first row with the same pose, up to a difference of `SAME`.

    Args:
        key: (m, k) joint values, and scaled indices of target and station.
    """
    return np.array([min(near) for near in KDTree(key).query_ball_point(key, SAME, p=np.inf)])


def _one_clock(times: Sequence[np.ndarray]) -> bool:
    """Return whether the time ranges of files do not overlap, so that the files can have one clock.

    They overlap if each file counts from its own start.

    Args:
        times: times of the rows of each file [s].
    """
    spans = sorted((each.min(), each.max()) for each in times)
    return all(one[1] <= two[0] for one, two in pairwise(spans))


def _trend(what: str, unit: str, x: np.ndarray, off: np.ndarray, pose: np.ndarray, sigma: float) -> Trend | None:
    _, place, count = np.unique(pose, return_inverse=True, return_counts=True)
    again = count[place] > 1
    poses, visits = int((count > 1).sum()), int(again.sum())
    dof = 3 * (visits - poses - 1)
    means = [np.bincount(place, one) / count for one in (x, *off.T)]
    centred, moved = (x - means[0][place])[again], (off - np.transpose(means[1:])[place])[again]
    spread = float(centred @ centred)
    if dof < 1 or spread <= 1e-12 * max(float(np.ptp(x)) ** 2, 1e-300) or not np.ptp(x):
        return None
    slope = centred @ moved / spread
    left = max(float(np.sqrt(np.sum((moved - np.outer(centred, slope)) ** 2) / dof)), sigma, 1e-12)
    chance = fdtrc(3, dof, spread * float(slope @ slope) / (3.0 * left**2))
    sigmas = -float(ndtri(max(float(chance), 1e-300) / 2.0))
    return Trend(what, unit, x[again], moved, poses, float(np.ptp(x)), slope, left / np.sqrt(spread), sigmas)


def _columns(path: Path, rows: np.ndarray) -> dict[str, tuple[str, np.ndarray]]:
    """Return time [h] and temperatures [°C] of a file's rows: column name -> unit and values (m,).

    Args:
        path: the file.
        rows: (m,) row numbers, counted from 1.
    """
    if not path.is_file():
        return {}
    table = read_table(path)
    return {name: (unit, values[rows - 1]) for name, unit, values in _covariates(table) if len(values) >= rows.max()}


def _covariates(table: Table) -> Iterator[tuple[str, str, np.ndarray]]:
    for name, unit, cells in zip(table.header, table.units, table.cells):
        if COVARIATES["temperature"].fullmatch(name) and cells.dtype == float and np.isfinite(cells).all():
            yield name, "°C", cells
        elif COVARIATES["time"].fullmatch(name) and (seconds := _seconds(cells, unit)) is not None:
            yield name, "h", seconds / 3600.0


def _seconds(cells: np.ndarray, unit: str) -> np.ndarray | None:
    """Return the times [s] in a column: numbers in a unit of `TIMES`, or dates in ISO 8601; None for other columns.

    Args:
        cells: (m,) cells of the column.
        unit: unit in the column's header.
    """
    if cells.dtype == float:
        return TIMES[unit] * cells if unit in TIMES and np.isfinite(cells).all() else None
    try:
        return np.array([datetime.fromisoformat(str(cell)).timestamp() for cell in cells])
    except ValueError:
        return None
