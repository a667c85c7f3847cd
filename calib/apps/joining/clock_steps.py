"""A step of a clock inside a stream, or its wandering, which a line through the offsets would pass for drift.

About the fit of clock and arm (`calib.apps.joining.clocks.fitted`) the offset is let change at a time T by a size
that is free, with all that was fitted, and backlash, free beside it: what least squares then say of the size, in its σ,
is largest at the true T. A clock that wanders smoothly (temperature) makes sizes at many T: a step must explain more
than a polygon of `KNOTS` offsets does, or stand out beside the polygon. Where the rows' stamps depart from an even step
by that size, the file and the row are known. Thresholds are our choice.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calib.apps.joining.stream_files import Stream

BACKLASH = 1e-4  # by which a joint comes to rest before where it was sent, from either side [rad or m]
KNOTS = 6  # of the polygon, ends included
TRIED, CLOSER = 120, 40  # times at which a step is tried, evenly, then between the neighbours of the best
MIN_STEP = 3e-3  # size of a step that is said [s]
CERTAIN = 5.0, 7.0  # its size in σ, alone and beside the polygon
STAMPED = 0.5  # share of the size by which the stamps may differ from it


@dataclass(frozen=True, eq=False)
class Equations:
    """Whitened least squares about a fit of clock and arm.

    Attributes:
        matrix, wanted: (rows + priors, p) in any units, and (rows + priors,) what they are to explain.
        late: (rows,) change per second of the clock's offset.
        play: (rows, joints) change per rad or m of backlash.
        t: (rows,) the instrument's times [s].
    """

    matrix: np.ndarray
    wanted: np.ndarray
    late: np.ndarray
    play: np.ndarray
    t: np.ndarray


@dataclass(frozen=True)
class Step:
    """Change of the instrument's clock against the controller's by `size` ± `sigma` [s], at its `time` [s]."""

    time: float
    size: float
    sigma: float

    def place(self, log: Stream, stream: Stream, log_time: float) -> str:
        """Return the file whose stamps show the step, with time and row; or the times in both, where none does.

        Args:
            log_time: of the step by the controller's clock, about [s].
        """
        candidates = list[tuple[float, str]]()
        for file, size, about in ((stream, self.size, self.time), (log, -self.size, log_time)):
            reach = abs(self.size) + (file.t[-1] - file.t[0]) / TRIED
            count, intervals = np.diff(file.rows), np.diff(file.t)
            off = np.abs(intervals - count * np.median(intervals / count) - size) / abs(size)
            off[np.abs(file.t[1:] - about) > reach] = np.inf
            k = int(np.argmin(off))
            row = file.rows[k + 1] if size > 0.0 else file.rows[k] + 1  # rows that go back were left out
            candidates.append((float(off[k]), f"{Path(file.file).name}: row {row}, t = {file.t[k + 1]:.3f} s"))
        smallest, location = min(candidates)
        if smallest < STAMPED:
            return location
        return f"{Path(stream.file).name}: t = {self.time:.2f} s, {Path(log.file).name}: t = {log_time:.2f} s, about"


def find_step(equations: Equations) -> tuple[Step | None, float]:
    """Return the step that stands out most, None where there is none, and by how much the clock leaves its line [s].

    The second is 0 where a line is as good as a polygon.
    """
    begin, end = float(equations.t.min()), float(equations.t.max())
    knots = np.linspace(begin, end, KNOTS)
    hats = np.array([np.interp(equations.t, knots, row) for row in np.eye(KNOTS)[1:-1]])
    errors, *columns = _projected(equations, list(hats))
    bends, _, _, _ = np.linalg.lstsq(np.array(columns).T, errors)
    remainder = float(np.sum((errors - bends @ columns) ** 2))
    smooth, corners = float(errors @ errors) - remainder, np.array([0.0, *bends, 0.0])
    away = float(np.abs(corners - np.polyval(np.polyfit(knots - begin, corners, 1), knots - begin)).max())
    certain = smooth > CERTAIN[1] ** 2 * remainder / (len(equations.late) - equations.matrix.shape[1])
    for beside, sigmas in zip((hats[:0], hats), CERTAIN):
        times, spacing = np.linspace(begin, end, TRIED + 2, retstep=True)
        best = _best(equations, times[1:-1], beside)[0]
        step, explained = _best(equations, np.linspace(best.time - spacing, best.time + spacing, CLOSER), beside)
        if abs(step.size) > max(MIN_STEP, sigmas * step.sigma) and (len(beside) or explained > smooth):
            return step, away
    return None, away if certain else 0.0


def _best(equations: Equations, times: np.ndarray, beside: np.ndarray) -> tuple[Step, float]:
    """Return the most certain of steps at `times` (k,), and the sum of squares that it explains.

    Args:
        beside: (n, rows) other changes of the offset [s] that are free.
    """
    errors, *columns = _projected(equations, [*beside, *(equations.t > times[:, None])])
    other_columns, columns = np.array(columns[: len(beside)]), np.array(columns[len(beside) :])
    if len(beside):
        base = np.linalg.qr(other_columns.T)[0]
        errors, columns = errors - base @ (base.T @ errors), columns - (columns @ base) @ base.T
    power = np.maximum(np.sum(columns**2, axis=1), 1e-300)
    size = columns @ errors / power
    explained = size**2 * power
    k = int(np.argmax(explained))
    free = len(equations.late) - equations.matrix.shape[1] - equations.play.shape[1] - len(beside) - 1
    variance = float(errors @ errors - explained[k]) / max(free, 1)
    return Step(float(times[k]), float(size[k]), float(np.sqrt(variance / power[k]))), float(explained[k])


def _projected(equations: Equations, changes: list[np.ndarray]) -> np.ndarray:
    """Return what all that is free cannot explain of the data (first row), and of changes (rows,) of the offset."""
    rows, joints = equations.play.shape
    prior = np.eye(joints) / BACKLASH
    play = np.concatenate([equations.play, np.zeros((len(equations.wanted) - rows, joints)), prior])
    matrix = np.column_stack([np.pad(equations.matrix, ((0, joints), (0, 0))), play])
    matrix /= np.maximum(np.linalg.norm(matrix, axis=0), 1e-300)
    sought = np.zeros((1 + len(changes), len(matrix)))
    sought[0, : len(equations.wanted)] = equations.wanted
    sought[1:, :rows] = np.array(changes) * equations.late
    inverse = np.linalg.pinv(matrix.T @ matrix, 1e-13, hermitian=True)
    return sought - sought @ matrix @ inverse @ matrix.T
