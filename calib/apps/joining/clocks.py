"""Clock of an instrument relative to a controller's, and a motion that both recorded.

A point at the instrument's time t was measured at the joint values q(t - offset - drift (t - middle)) of the log.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.interpolate import CubicSpline

from calib.apps.joining.stream_files import Stream
from calib.records import evenly
from calib.toolkit.installations import Installation, observe, prepare
from calib.toolkit.pose_data import Positions, take

# step of the central differences by which velocities are computed [s]
TIME_STEP = 1e-3
_NONE = np.array([], dtype=int)


@dataclass(frozen=True)
class Clock:
    """Clock of an instrument relative to the controller's.

    Attributes:
        offset, sigma: the instrument's time minus the controller's at `middle`, and its standard deviation [s].
        drift, drift_sigma: rate of change of the offset, and its standard deviation [s/s].
        middle: the instrument's time at which the difference is `offset` [s].
    """

    offset: float
    sigma: float = np.inf
    drift: float = 0.0
    drift_sigma: float = np.inf
    middle: float = 0.0

    def controller(self, t: np.ndarray) -> np.ndarray:
        """Return the controller's times for the instrument's times t (m,) [s]."""
        return t - self.offset - self.drift * (t - self.middle)


@dataclass(frozen=True, eq=False)
class Run:
    """A motion that both the controller and the instrument recorded.

    Attributes:
        log: joint values over time from the controller.
        stream: rows over time from the instrument.
        points: the stream's rows as measurements, without joint values.
    """

    log: Stream
    stream: Stream
    points: Positions

    @cached_property
    def _path(self) -> CubicSpline:
        return CubicSpline(self.log.t, self.log.values)

    def joints(self, clock: Clock, rows: np.ndarray, order: int = 0) -> np.ndarray:
        """Return the log's joint values (m, n) at the times of the stream's rows, or their time derivative.

        Times outside the log are replaced by its first or last time.

        Args:
            clock: the instrument's clock.
            rows: (m,) indices of rows of the stream.
            order: order of the derivative; 0 for the joint values.
        """
        times = clock.controller(self.stream.t[rows])
        start, end = self.log.t[[0, -1]]
        return self._path(np.clip(times, start, end), order)

    def known(self, clock: Clock, count: int | None = None) -> np.ndarray:
        """Return the indices of the stream's rows whose times are within the log and outside the log's gaps.

        Args:
            clock: the instrument's clock.
            count: number of rows to return, evenly chosen; None for all.
        """
        log = self.log
        t = clock.controller(self.stream.t)
        after = np.clip(np.searchsorted(log.t, t), 1, len(log.t) - 1)
        bridged = log.t[after] - log.t[after - 1] <= log.gap
        in_log = (t >= log.t[0]) & (t <= log.t[-1])
        rows = np.flatnonzero(bridged & in_log)
        if count is None:
            return rows
        return rows[evenly(len(rows), count)]

    def lines(self) -> list[str]:
        """Return the remarks on the rows of both files."""
        return [*self.log.lines(), *self.stream.lines()]

    def at(self, clock: Clock, rows: np.ndarray) -> Positions:
        """Return rows of the stream as measurements with their joint values.

        Args:
            clock: the instrument's clock, which determines the joint values.
            rows: (m,) indices of the rows.
        """
        return replace(take(self.points, rows), q=self.joints(clock, rows))


def residuals(cell: Installation, run: Run, rows: np.ndarray, clock: Clock) -> np.ndarray:
    """Return the residuals (3 or 6, m) of the stream's rows: positions [m], then orientations [rad].

    Args:
        cell: the arm with station and tool.
        run: the recordings of controller and instrument.
        rows: (m,) indices of rows of the stream.
        clock: the instrument's clock, which determines the joint values of the rows.
    """
    (block,) = prepare(cell, [run.at(clock, rows)])
    parts = observe(cell, block, _NONE)
    return np.concatenate([part.value for part in parts])


def velocities(cell: Installation, run: Run, rows: np.ndarray, clock: Clock) -> np.ndarray:
    """Return velocities (3 or 6, m) [m/s, then rad/s] of the target at the stream's rows, from arm and log.

    Args:
        cell: the arm with station and tool.
        run: the recordings of controller and instrument.
        rows: (m,) indices of rows of the stream.
        clock: the instrument's clock.
    """
    later = replace(clock, offset=clock.offset + TIME_STEP)
    sooner = replace(clock, offset=clock.offset - TIME_STEP)
    difference = residuals(cell, run, rows, later) - residuals(cell, run, rows, sooner)
    return difference / (2.0 * TIME_STEP)
