"""Test for a step or a wandering of a clock within a stream, which a fit of offset and drift would take for drift.

At a time T, the clocks' offset may change by an unknown size. The size is estimated by least squares, linearised about
the fit of clock and arm (`calib.apps.joining.clock_fit.fitted`), together with all fitted parameters and the joints'
backlash. The size divided by its σ is largest at the true T. A clock that wanders smoothly (temperature) gives sizes at
many T. A step is therefore accepted only if it explains more than a piecewise linear offset with `KNOTS` knots does, or
if it is significant in addition to that. Where the time stamps of a file's rows are uneven by the size of the step, the
file and the row of the step are known. The thresholds are our choice.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calib.apps.joining.stream_files import Stream

# prior standard deviation of the backlash by which a joint stops short of its commanded value, from either side
# [rad or m]
BACKLASH = 1e-4
# number of knots of the polygon, ends included
KNOTS = 6
# number of times at which a step is tried: first evenly spaced, then between the neighbours of the best of these
COARSE_TIMES, FINE_TIMES = 120, 40
# smallest step of the clock that is reported [s]
MIN_STEP = 3e-3
# smallest size of a reported step in σ: without, and in addition to, the polygon
CERTAIN_ALONE, CERTAIN_BESIDE_POLYGON = 5.0, 7.0
# share of a step's size by which the jump of a file's time stamps may differ from it, for the file to show the step
STAMPED = 0.5


@dataclass(frozen=True, eq=False)
class Equations:
    """Whitened linear least-squares equations about a fit of clock and arm.

    Attributes:
        matrix: (rows + priors, p) derivatives by the parameters, in any units.
        target: (rows + priors,) right-hand side.
        offset_slope: (rows,) derivative by the clock's offset [1/s].
        backlash_slopes: (rows, joints) derivative by each joint's backlash [1/rad or 1/m].
        t: (rows,) the instrument's times [s].
    """

    matrix: np.ndarray
    target: np.ndarray
    offset_slope: np.ndarray
    backlash_slopes: np.ndarray
    t: np.ndarray


@dataclass(frozen=True)
class Step:
    """Step of the instrument's clock against the controller's.

    Attributes:
        time: time of the step by the instrument's clock [s].
        size, sigma: the step and its standard deviation [s].
    """

    time: float
    size: float
    sigma: float

    def place(self, log: Stream, stream: Stream, log_time: float) -> str:
        """Return as text where the step is: the file whose time stamps show it, with time and row.

        Where the stamps of neither file show the step, the text has its times by both clocks.

        Args:
            log: the controller's log.
            stream: the instrument's stream.
            log_time: approximate time of the step by the controller's clock [s].
        """
        stream_misfit, stream_row = self._stamp(stream, self.size, self.time)
        log_misfit, log_row = self._stamp(log, -self.size, log_time)
        if min(stream_misfit, log_misfit) >= STAMPED:
            times = f"{Path(stream.file).name}: t = {self.time:.2f} s, {Path(log.file).name}: t = {log_time:.2f} s"
            return f"{times}, about"
        if log_misfit < stream_misfit:
            return log_row
        return stream_row

    def _stamp(self, file: Stream, size: float, time: float) -> tuple[float, str]:
        """Return how badly a file's time stamps match a step of `size` [s] near `time` [s], and where they match best.

        The first number is the difference between the best matching interval of the stamps and the step, divided by
        `size`. The place is a text with row and time.

        Args:
            file: the file with its time stamps.
            size: size of the step [s].
            time: approximate time of the step by the file's clock [s].
        """
        intervals = np.diff(file.t)
        row_counts = np.diff(file.rows)
        even_step = np.median(intervals / row_counts)
        misfit = np.abs(intervals - row_counts * even_step - size) / abs(size)
        reach = abs(self.size) + (file.t[-1] - file.t[0]) / COARSE_TIMES
        misfit[np.abs(file.t[1:] - time) > reach] = np.inf
        k = int(np.argmin(misfit))
        row = file.rows[k + 1]
        if size <= 0.0:
            # rows that go back were left out
            row = file.rows[k] + 1
        return float(misfit[k]), f"{Path(file.file).name}: row {row}, t = {file.t[k + 1]:.3f} s"


def find_step(equations: Equations) -> tuple[Step | None, float]:
    """Return the most significant step, and the clock's largest deviation from a line of offset and drift [s].

    The step is None where no step is significant. The deviation is 0 where a piecewise linear offset explains the data
    no better than a line.

    Args:
        equations: least-squares equations of the fit of clock and arm.
    """
    begin, end = float(equations.t.min()), float(equations.t.max())
    # the polygon: offsets at the inner knots, each with a hat function of the time
    knots = np.linspace(begin, end, KNOTS)
    inner_knots = np.eye(KNOTS)[1:-1]
    hats = np.array([np.interp(equations.t, knots, height) for height in inner_knots])
    errors, *columns = _projected(equations, list(hats))
    bends, _, _, _ = np.linalg.lstsq(np.array(columns).T, errors)
    remainder = float(np.sum((errors - bends @ columns) ** 2))
    smooth = float(errors @ errors) - remainder

    # its distance from a line
    corners = np.array([0.0, *bends, 0.0])
    line = np.polyfit(knots - begin, corners, 1)
    away = float(np.abs(corners - np.polyval(line, knots - begin)).max())

    step, explained = _search(equations, hats[:0])
    if abs(step.size) > max(MIN_STEP, CERTAIN_ALONE * step.sigma) and explained > smooth:
        return step, away
    step, _ = _search(equations, hats)
    if abs(step.size) > max(MIN_STEP, CERTAIN_BESIDE_POLYGON * step.sigma):
        return step, away
    degrees_of_freedom = len(equations.offset_slope) - equations.matrix.shape[1]
    if smooth > CERTAIN_BESIDE_POLYGON**2 * remainder / degrees_of_freedom:
        return None, away
    return None, 0.0


def _search(equations: Equations, beside: np.ndarray) -> tuple[Step, float]:
    """Return the most significant step at any time, and the decrease of the sum of squared residuals that it achieves.

    Times are searched on a coarse grid, then on a fine one.

    Args:
        equations: least-squares equations of the fit of clock and arm.
        beside: (n, rows) other changes of the offset [s], whose sizes are estimated too.
    """
    begin, end = float(equations.t.min()), float(equations.t.max())
    times, spacing = np.linspace(begin, end, COARSE_TIMES + 2, retstep=True)
    coarse, _ = _best(equations, times[1:-1], beside)
    fine_times = np.linspace(coarse.time - spacing, coarse.time + spacing, FINE_TIMES)
    return _best(equations, fine_times, beside)


def _best(equations: Equations, times: np.ndarray, beside: np.ndarray) -> tuple[Step, float]:
    """Return the most significant of the steps at `times` (k,), and the decrease of the sum of squares by it.

    Args:
        equations: least-squares equations of the fit of clock and arm.
        times: candidate times by the instrument's clock [s].
        beside: (n, rows) other changes of the offset [s], whose sizes are estimated too.
    """
    steps = equations.t > times[:, None]
    errors, *columns = _projected(equations, [*beside, *steps])
    step_columns = np.array(columns[len(beside) :])
    if len(beside):
        beside_columns = np.array(columns[: len(beside)])
        base, _ = np.linalg.qr(beside_columns.T)
        errors = errors - base @ (base.T @ errors)
        step_columns = step_columns - (step_columns @ base) @ base.T
    power = np.maximum(np.sum(step_columns**2, axis=1), 1e-300)
    size = step_columns @ errors / power
    explained = size**2 * power
    k = int(np.argmax(explained))
    parameters = equations.matrix.shape[1] + equations.backlash_slopes.shape[1] + len(beside) + 1
    degrees_of_freedom = len(equations.offset_slope) - parameters
    variance = float(errors @ errors - explained[k]) / max(degrees_of_freedom, 1)
    sigma = float(np.sqrt(variance / power[k]))
    return Step(float(times[k]), float(size[k]), sigma), float(explained[k])


def _projected(equations: Equations, changes: list[np.ndarray]) -> np.ndarray:
    """Return the residuals (1 + k, rows) that remain after all fitted parameters and backlash are projected out.

    The first row is the residual of the right-hand side; each further row is that of one change of the offset.

    Args:
        equations: least-squares equations of the fit of clock and arm.
        changes: k changes (rows,) of the clock's offset [s].
    """
    rows, joints = equations.backlash_slopes.shape
    count = len(equations.target)
    # the fit's own equations, and backlash of each joint with its prior
    fit_columns = np.pad(equations.matrix, ((0, joints), (0, 0)))
    no_slope = np.zeros((count - rows, joints))
    prior = np.eye(joints) / BACKLASH
    backlash_columns = np.concatenate([equations.backlash_slopes, no_slope, prior])
    matrix = np.column_stack([fit_columns, backlash_columns])
    matrix /= np.maximum(np.linalg.norm(matrix, axis=0), 1e-300)

    series = np.zeros((1 + len(changes), len(matrix)))
    series[0, :count] = equations.target
    series[1:, :rows] = np.array(changes) * equations.offset_slope
    inverse = np.linalg.pinv(matrix.T @ matrix, 1e-13, hermitian=True)
    return series - series @ matrix @ inverse @ matrix.T
