"""Clock of an instrument relative to a controller's, from points measured while the arm moves.

A point at the instrument's time t was measured at the joint values q(t - offset - drift (t - middle)) of the log. Start
values of the offset need no frames: the speed of the nominal arm's tip is correlated with that of the points at every
offset. For the offsets with the highest correlation, instrument and target are placed by least squares, and the best is
taken. Then offset, drift, both placements and the arm's geometry are fitted together (Gauss-Newton), since errors of
the arm would otherwise be taken for errors of the clock. The prior standard deviation of an effect's terms is estimated
from the data (`calib.estimation.relevance`): with a fixed one, σ of the clock is too large for arms with smaller
effects, and too small for arms with larger ones. Thresholds are our choice.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.signal import correlate, correlation_lags

from calib.apps.joining.clock_steps import BACKLASH, Equations
from calib.apps.joining.order import MAX_MISFIT
from calib.apps.joining.stream_files import Stream
from calib.errors import refuse_data
from calib.records import evenly, interpolated
from calib.toolkit.chains import Chain, Deflection, Term, forward
from calib.toolkit.installations import (
    EFFECTS,
    Installation,
    base_columns,
    install,
    layout,
    observe,
    parameter_values,
    plausible_deviation,
    prepare,
    step,
    term_sizes,
)
from calib.toolkit.pose_data import Positions, take
from calib.toolkit.statistics import gram, relevance, robust_weights, spread
from calib.transforms import invert, rotation_vector

# spacing of the offsets that are tried first [s]
GRID = 0.05
# lever arms [m] that are tried to convert the tip's rotation to speed, since the target's position on the tip is
# unknown
LEVERS = (0.0, 0.15, 0.4)
# number of offsets that are tried for each lever arm, and the smallest distance between them [s]
PEAKS, PEAK_DISTANCE = 3, 1.0
# smallest share of the shorter file that has to overlap in time with the longer one
OVERLAP = 0.5
# percentage of the residuals, smallest first, whose rms is the misfit of an offset
TRIMMED = 90
# number of rows from which placements are guessed
PLACED = 300
# largest ratio of the nominal arm's residual to the spread of the points for a log of the same motion
MAX_RATIO = 0.15
# an offset is as good as the best one if its residual is less than this factor times the best residual
RIVAL = 1.3
# prior standard deviation of a clock's drift [s/s]
MAX_DRIFT = 1e-3
# step of the central differences by which velocities are computed [s]
TIME_STEP = 1e-3
# highest order of the harmonics that are fitted
ORDERS = 6
# largest number of Gauss-Newton iterations
ROUNDS = 12
# change of the offset below which the iteration ends [s]
SETTLED = 1e-6
# smallest and largest ratio of the terms' prior standard deviations to their first guesses
TERM_SIZES = (1e-3, 5.0)
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


@dataclass(frozen=True, eq=False)
class _Start:
    """Nominal arm with the placements that fit one offset of the clocks.

    Attributes:
        misfit: rms of the smallest residuals [m].
        clock: the clock with this offset.
        cell: the nominal arm with placed station and tool.
    """

    misfit: float
    clock: Clock
    cell: Installation


def begin(chain: Chain, run: Run) -> tuple[Installation, Clock, tuple[float, ...]]:
    """Return start values: the nominal arm with stations and tools placed, the clock, and other possible offsets [s].

    With the other offsets, the rms residual is at most `RIVAL` times the smallest one.

    Args:
        chain: the nominal arm.
        run: the recordings of controller and instrument.

    Raises:
        MeasurementError: no offset brings the points onto the nominal arm's path.
    """
    middle = float(run.stream.t[[0, -1]].mean())
    starts = list[_Start]()
    for offset in _offsets(chain, run):
        clock = Clock(offset, middle=middle)
        rows = run.known(clock, PLACED)
        if len(rows) < PLACED / 3:
            continue
        guess = install(chain, [run.at(clock, rows)])
        cell, clock, _ = fitted(guess, run, rows, clock, arm=False)
        position_residuals = residuals(cell, run, rows, clock)[:3]
        distances = np.sort(np.linalg.norm(position_residuals, axis=0))
        smallest = distances[: TRIMMED * len(rows) // 100]
        starts.append(_Start(float(np.sqrt(np.mean(smallest**2))), clock, cell))

    best_misfit = min((start.misfit for start in starts), default=np.inf)
    extent = float(np.linalg.norm(run.points.position.std(axis=0)))
    if best_misfit > min(MAX_RATIO * extent, MAX_MISFIT * chain.stretched_length()):
        refuse_data(
            run.stream.file,
            f"no offset of the clocks puts its points on the nominal arm's path of {run.log.file} (the best "
            f"leaves {1e3 * best_misfit:.3g} mm of a motion of {1e3 * extent:.3g} mm): is it the log of this "
            "motion and of this robot, did instrument and target stay in place, and did no clock jump? "
            f"({'; '.join(run.lines())})",
        )
    alike = [start for start in starts if start.misfit < RIVAL * best_misfit]
    best = max(alike, key=lambda start: len(run.known(start.clock)))
    offset = best.clock.offset
    rivals = set[float]()
    for start in alike:
        if abs(start.clock.offset - offset) > PEAK_DISTANCE:
            rivals.add(round(start.clock.offset, 2))
    return best.cell, Clock(offset, middle=middle), tuple(sorted(rivals))


def _offsets(chain: Chain, run: Run) -> list[float]:
    """Return offsets of the clocks [s] at which the speeds of the arm's tip and of the points correlate best.

    Args:
        chain: the nominal arm.
        run: the recordings of controller and instrument.
    """
    arm = forward(chain, _even(run.log))
    arm_steps = _step_lengths(arm[:, :3, 3])
    rotations = invert(arm[:-1])[:, :3, :3] @ arm[1:, :3, :3]
    turns = np.linalg.norm(rotation_vector(rotations), axis=1)
    point_steps = _step_lengths(_even(run.stream)[:, :3])

    arm_count, point_count = len(arm_steps), len(point_steps)
    lags = GRID * correlation_lags(point_count, arm_count) + run.stream.t[0] - run.log.t[0]
    shared = np.round(correlate(np.ones(point_count), np.ones(arm_count)))
    possible = shared > OVERLAP * min(point_count, arm_count)
    offsets = list[float]()
    for lever in LEVERS:
        arm_speed = _cut(np.hypot(arm_steps, lever * turns))
        # a correlation over a longer overlap counts more
        score = _alike(_cut(point_steps), arm_speed) * np.sqrt(shared / shared.max())
        score[~possible] = -np.inf
        for _ in range(PEAKS):
            best = float(lags[int(np.argmax(score))])
            score[np.abs(lags - best) < PEAK_DISTANCE] = -np.inf
            offsets.append(best)

    distinct = list[float]()
    for k, offset in enumerate(offsets):
        if all(abs(offset - earlier) > PEAK_DISTANCE / 2 for earlier in offsets[:k]):
            distinct.append(offset)
    return distinct


def _step_lengths(positions: np.ndarray) -> np.ndarray:
    return np.linalg.norm(np.diff(positions, axis=0), axis=1)


def _even(stream: Stream) -> np.ndarray:
    """Return a stream's values (m, k) interpolated at times `GRID` [s] apart."""
    t = np.arange(stream.t[0], stream.t[-1], GRID)
    return interpolated(t, stream.t, stream.values)


def _cut(speed: np.ndarray) -> np.ndarray:
    """Return speeds (m,) minus their median, with outliers clipped."""
    return np.minimum(speed, 2.0 * np.quantile(speed, 0.95)) - np.median(speed)


def _alike(series_a: np.ndarray, series_b: np.ndarray) -> np.ndarray:
    """Return the correlation coefficient of two time series at every lag, over the samples where they overlap.

    Args:
        series_a, series_b: (a,) and (b,) samples at equal time steps.
    """
    ones_a, ones_b = np.ones(len(series_a)), np.ones(len(series_b))
    count = np.maximum(np.round(correlate(ones_a, ones_b)), 1.0)
    mean_a = correlate(series_a, ones_b) / count
    mean_b = correlate(ones_a, series_b) / count
    variance_a = correlate(series_a**2, ones_b) / count - mean_a**2
    variance_b = correlate(ones_a, series_b**2) / count - mean_b**2
    power = variance_a * variance_b
    covariance = correlate(series_a, series_b) / count - mean_a * mean_b
    return covariance / np.sqrt(np.maximum(power, 1e-6 * power.max()))


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


def fitted(
    cell: Installation, run: Run, rows: np.ndarray, clock: Clock, arm: bool = True, backlash: bool = False
) -> tuple[Installation, Clock, Equations]:
    """Return the installation and the clock that fit the given rows best, and the equations linearised about them.

    σ of the clock is computed for independent rows.

    Args:
        cell: the arm with stations and tools, as the start value. The arm is nominal; its parameters get a wide prior.
        run: the recordings.
        rows: (m,) indices of the stream's rows to fit.
        clock: the clock as the start value.
        arm: whether the arm's geometry is fitted, with all effects that a model of `calib fit` may have; otherwise only
            placements, offset and drift are fitted.
        backlash: whether backlash of the joints is fitted, which otherwise looks like a delay of the clock. Rows are
            then assumed to have no outliers.
    """
    families = list[list[Term]]()
    terms = list[Term]()
    if arm:
        for effect in EFFECTS.values():
            family = [term for term in effect(cell.chain, False) if term.order <= ORDERS]
            families.append(family)
            terms += family
        cell = replace(cell, deflection=Deflection(tuple(terms), np.zeros(len(terms)), cell.chain))
    start = cell

    # columns: rigid parameters, terms of the effects, backlash, offset and drift
    table = layout(cell)
    free = table.rigid_index if arm else table.frame_index
    determined = base_columns(cell, prepare(cell, [run.at(clock, rows)]), free).kept
    rigid = free[determined]
    free = np.concatenate([rigid, table.index("deflection")])
    moving = cell.chain.moving
    backlash_count = len(moving) if backlash else 0
    rigid_guess = plausible_deviation(cell, rigid)
    backlash_guess = np.full(backlash_count, BACKLASH)
    guess = np.concatenate([rigid_guess, term_sizes(tuple(terms)), backlash_guess, [np.inf, MAX_DRIFT]])
    family_sizes = [len(family) for family in families]
    counts = [len(rigid), *family_sizes, backlash_count, 2]
    group = np.repeat([-1, *range(len(families) + 1), -1], counts)
    has_prior = np.isfinite(guess)

    loss = "none" if backlash else "huber"
    middle_time = run.stream.t[rows] - clock.middle
    rounds = 0
    while True:
        # the prior's mean minus the present values
        pulled = np.zeros(len(guess))
        pulled[: len(free)] = (parameter_values(start) - parameter_values(cell))[free]
        pulled[-1] = -clock.drift

        (block,) = prepare(cell, [run.at(clock, rows)])
        parts = observe(cell, block, free)
        joint_parts = observe(cell, block, moving)
        speeds = np.split(velocities(cell, run, rows, clock), len(parts))
        # the side from which each joint comes
        side = np.sign(run.joints(clock, rows, 1).T)[:, None]
        targets, slopes = list[np.ndarray](), list[np.ndarray]()
        backlash_slopes, offset_slopes = list[np.ndarray](), list[np.ndarray]()
        for part, joint_part, speed in zip(parts, joint_parts, speeds):
            sigma = max(spread(part.value), 1e-9)
            size = np.sqrt(np.mean(part.value**2, axis=0))
            weight = np.sqrt(robust_weights(size / sigma, loss)) / sigma
            targets.append((weight * part.value).ravel())
            offset_slopes.append((weight * -speed).ravel())
            backlash_slope = weight * side * joint_part.jacobian
            backlash_slopes.append(backlash_slope.reshape(len(moving), -1).T)
            columns = np.concatenate([part.jacobian, [-speed, -middle_time * speed]])
            columns = (weight * columns).reshape(len(columns), -1).T
            before, clock_columns = columns[:, :-2], columns[:, -2:]
            slopes.append(np.hstack([before, backlash_slopes[-1][:, :backlash_count], clock_columns]))

        prior = guess
        if arm:
            prior = _sized(np.concatenate(slopes), np.concatenate(targets), pulled, guess, group)
        prior_rows = np.diag(1.0 / prior)[has_prior]
        matrix = np.concatenate([*slopes, prior_rows])
        target = np.concatenate([*targets, (pulled / prior)[has_prior]])
        scale = np.maximum(np.linalg.norm(matrix, axis=0), 1e-300)
        matrix /= scale
        inverse = np.linalg.pinv(matrix.T @ matrix, 1e-13, hermitian=True)
        change = inverse @ (matrix.T @ target)
        squares = float(np.sum((target - matrix @ change) ** 2))
        variance = squares / max(len(target) - len(guess), 1)
        column_sigma = np.sqrt(variance * np.diag(inverse)) / scale
        change /= scale
        cell = step(cell, free, change[: len(free)])
        clock = replace(clock, offset=clock.offset + change[-2], drift=clock.drift + change[-1])
        rounds += 1
        if abs(change[-2]) < SETTLED or rounds == ROUNDS:
            break

    clock = replace(clock, sigma=float(column_sigma[-2]), drift_sigma=float(column_sigma[-1]))
    offset_slope = np.concatenate(offset_slopes)
    times = np.tile(run.stream.t[rows], len(offset_slope) // len(rows))
    equations = Equations(matrix, target, offset_slope, np.concatenate(backlash_slopes), times)
    return cell, clock, equations


def _sized(
    matrix: np.ndarray, target: np.ndarray, pulled: np.ndarray, guess: np.ndarray, group: np.ndarray
) -> np.ndarray:
    """Return the prior standard deviations (p,), with those of each family of terms scaled by the most probable factor.

    Args:
        matrix, target: whitened equations matrix · step = target of the data, (rows, p) and (rows,).
        pulled: (p,) the prior's mean minus the current values.
        guess: (p,) prior standard deviations before scaling.
        group: (p,) number of each parameter's family; -1 for parameters that are not terms of an effect.
    """
    ungrouped = group < 0
    prior_rows = ungrouped & np.isfinite(guess)
    rows = np.concatenate([matrix, np.diag(1.0 / guess)[prior_rows]])
    unexplained = target - matrix @ np.where(ungrouped, 0.0, pulled)
    data = np.concatenate([unexplained, (pulled / guess)[prior_rows]])
    size = np.maximum(np.linalg.norm(rows, axis=0), 1e-300)
    unit = np.where(ungrouped, 1.0 / size, guess)
    evidence = relevance(gram(data, rows * unit), group, np.ones(len(unit)))
    factor = np.clip(evidence.ridge, *TERM_SIZES)
    return np.where(ungrouped, guess, factor * guess)
