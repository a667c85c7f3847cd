"""Fit of an instrument's clock, of the placements and of the arm, to points measured while the arm moves.

Start values of the offset need no frames: the speed of the nominal arm's tip is correlated with that of the points at
every offset. For the offsets with the highest correlation, instrument and target are placed by least squares, and the
best is taken. Then offset, drift, both placements and the arm's geometry are fitted together (Gauss-Newton), since
errors of the arm would otherwise be taken for errors of the clock. The prior standard deviation of an effect's terms is
estimated from the data (`calib.estimation.relevance`): with a fixed one, σ of the clock is too large for arms with
smaller effects, and too small for arms with larger ones. Thresholds are our choice.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.signal import correlate, correlation_lags

from calib.apps.joining.clock_steps import BACKLASH, Equations
from calib.apps.joining.clocks import Clock, Run, residuals, velocities
from calib.apps.joining.order import MAX_MISFIT
from calib.apps.joining.stream_files import Stream
from calib.errors import refuse_data
from calib.records import interpolated
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
# highest order of the harmonics that are fitted
ORDERS = 6
# largest number of Gauss-Newton iterations
ROUNDS = 12
# change of the offset below which the iteration ends [s]
SETTLED = 1e-6
# smallest and largest ratio of the terms' prior standard deviations to their first guesses
TERM_SIZES = (1e-3, 5.0)


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
    arm = forward(chain, _resampled(run.log))
    arm_steps = _step_lengths(arm[:, :3, 3])
    rotations = invert(arm[:-1])[:, :3, :3] @ arm[1:, :3, :3]
    turns = np.linalg.norm(rotation_vector(rotations), axis=1)
    point_steps = _step_lengths(_resampled(run.stream)[:, :3])

    arm_count, point_count = len(arm_steps), len(point_steps)
    lags = GRID * correlation_lags(point_count, arm_count) + run.stream.t[0] - run.log.t[0]
    shared = np.round(correlate(np.ones(point_count), np.ones(arm_count)))
    possible = shared > OVERLAP * min(point_count, arm_count)
    offsets = list[float]()
    for lever in LEVERS:
        arm_speed = _clipped(np.hypot(arm_steps, lever * turns))
        # a correlation over a longer overlap counts more
        score = _correlation(_clipped(point_steps), arm_speed) * np.sqrt(shared / shared.max())
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


def _resampled(stream: Stream) -> np.ndarray:
    """Return a stream's values (m, k) interpolated at times `GRID` [s] apart."""
    t = np.arange(stream.t[0], stream.t[-1], GRID)
    return interpolated(t, stream.t, stream.values)


def _clipped(speed: np.ndarray) -> np.ndarray:
    """Return speeds (m,) minus their median, with outliers clipped."""
    return np.minimum(speed, 2.0 * np.quantile(speed, 0.95)) - np.median(speed)


def _correlation(series_a: np.ndarray, series_b: np.ndarray) -> np.ndarray:
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


@dataclass(frozen=True, eq=False)
class _Unknowns:
    """What is fitted. Columns of the equations: rigid parameters, terms of effects, backlash, offset, drift.

    Attributes:
        free: indices of the rigid parameters and of the effects' terms in the cell's parameter vector.
        backlash: number of joints whose backlash is fitted.
        guess: (p,) first guess of the prior standard deviations; infinite without a prior.
        group: (p,) number of each column's family of terms; -1 for columns that are not terms of an effect.
    """

    free: np.ndarray
    backlash: int
    guess: np.ndarray
    group: np.ndarray


@dataclass(frozen=True, eq=False)
class _Rows:
    """Whitened equations of the data, linearised about a cell and a clock.

    Attributes:
        matrix, target: (rows, p) derivatives by the unknowns, and right-hand side (rows,).
        offset_slope: (rows,) derivative by the clock's offset [1/s].
        backlash_slopes: (rows, joints) derivative by each joint's backlash [1/rad or 1/m].
    """

    matrix: np.ndarray
    target: np.ndarray
    offset_slope: np.ndarray
    backlash_slopes: np.ndarray


@dataclass(frozen=True, eq=False)
class _Step:
    """Gauss-Newton step.

    Attributes:
        change, sigma: (p,) step of the unknowns, and their standard deviations.
        matrix, target: equations of data and prior, (rows + priors, p) with columns of unit length, and right-hand
            side.
    """

    change: np.ndarray
    sigma: np.ndarray
    matrix: np.ndarray
    target: np.ndarray


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
    if arm:
        families = _families(cell.chain)
        terms = tuple(term for family in families for term in family)
        cell = replace(cell, deflection=Deflection(terms, np.zeros(len(terms)), cell.chain))
    start = cell
    unknowns = _unknowns(cell, run, rows, clock, families, backlash)
    loss = "none" if backlash else "huber"
    for _ in range(ROUNDS):
        # the prior's mean minus the present values
        pulled = np.zeros(len(unknowns.guess))
        pulled[: len(unknowns.free)] = (parameter_values(start) - parameter_values(cell))[unknowns.free]
        pulled[-1] = -clock.drift

        linear = _linearised(cell, run, rows, clock, unknowns, loss)
        prior = unknowns.guess
        if arm:
            prior = _prior_deviations(linear, pulled, unknowns)
        solution = _solved(linear, pulled, prior)
        offset_change, drift_change = solution.change[-2:]
        cell = step(cell, unknowns.free, solution.change[: len(unknowns.free)])
        clock = replace(clock, offset=clock.offset + offset_change, drift=clock.drift + drift_change)
        if abs(offset_change) < SETTLED:
            break

    clock = replace(clock, sigma=float(solution.sigma[-2]), drift_sigma=float(solution.sigma[-1]))
    times = np.tile(run.stream.t[rows], len(linear.offset_slope) // len(rows))
    equations = Equations(solution.matrix, solution.target, linear.offset_slope, linear.backlash_slopes, times)
    return cell, clock, equations


def _families(chain: Chain) -> list[list[Term]]:
    """Return the terms of each effect that a model of `calib fit` may have, without torques."""
    return [[term for term in effect(chain, False) if term.order <= ORDERS] for effect in EFFECTS.values()]


def _unknowns(
    cell: Installation, run: Run, rows: np.ndarray, clock: Clock, families: list[list[Term]], backlash: bool
) -> _Unknowns:
    """Return what is fitted.

    Args:
        cell: the arm with stations and tools, and with the terms of all families.
        run: the recordings.
        rows: (m,) indices of the stream's rows to fit.
        clock: the clock as the start value.
        families: the terms of each effect; empty if only placements, offset and drift are fitted.
        backlash: whether backlash of the joints is fitted.
    """
    table = layout(cell)
    candidates = table.rigid_index if families else table.frame_index
    determined = base_columns(cell, prepare(cell, [run.at(clock, rows)]), candidates).kept
    rigid = candidates[determined]
    backlash_count = len(cell.chain.moving) if backlash else 0
    terms = tuple(term for family in families for term in family)
    backlash_guess = np.full(backlash_count, BACKLASH)
    guess = np.concatenate([plausible_deviation(cell, rigid), term_sizes(terms), backlash_guess, [np.inf, MAX_DRIFT]])
    # the joints' backlash is a family, too
    counts = [len(rigid), *(len(family) for family in families), backlash_count, 2]
    group = np.repeat([-1, *range(len(families) + 1), -1], counts)
    return _Unknowns(np.concatenate([rigid, table.index("deflection")]), backlash_count, guess, group)


def _linearised(cell: Installation, run: Run, rows: np.ndarray, clock: Clock, unknowns: _Unknowns, loss: str) -> _Rows:
    """Return the whitened equations of the data.

    Args:
        cell, clock: where they are linearised.
        run: the recordings.
        rows: (m,) indices of the stream's rows to fit.
        unknowns: what is fitted.
        loss: loss function of the robust weights.
    """
    moving = cell.chain.moving
    (block,) = prepare(cell, [run.at(clock, rows)])
    parts = observe(cell, block, unknowns.free)
    joint_parts = observe(cell, block, moving)
    speeds = np.split(velocities(cell, run, rows, clock), len(parts))
    middle_time = run.stream.t[rows] - clock.middle
    # the side from which each joint comes
    side = np.sign(run.joints(clock, rows, 1).T)[:, None]

    matrices, targets = list[np.ndarray](), list[np.ndarray]()
    offset_slopes, backlash_slopes = list[np.ndarray](), list[np.ndarray]()
    for part, joint_part, speed in zip(parts, joint_parts, speeds):
        sigma = max(spread(part.value), 1e-9)
        size = np.sqrt(np.mean(part.value**2, axis=0))
        weight = np.sqrt(robust_weights(size / sigma, loss)) / sigma
        parameter_slopes = (weight * part.jacobian).reshape(len(part.jacobian), -1).T
        backlash_slope = (weight * side * joint_part.jacobian).reshape(len(moving), -1).T
        offset_slope = (weight * -speed).ravel()
        drift_slope = (weight * -middle_time * speed).ravel()
        columns = [parameter_slopes, backlash_slope[:, : unknowns.backlash], offset_slope[:, None]]
        matrices.append(np.hstack([*columns, drift_slope[:, None]]))
        targets.append((weight * part.value).ravel())
        offset_slopes.append(offset_slope)
        backlash_slopes.append(backlash_slope)
    return _Rows(
        np.concatenate(matrices),
        np.concatenate(targets),
        np.concatenate(offset_slopes),
        np.concatenate(backlash_slopes),
    )


def _solved(linear: _Rows, pulled: np.ndarray, prior: np.ndarray) -> _Step:
    """Return the step that data and prior determine; its sigmas are scaled by the residuals' variance.

    Args:
        linear: equations of the data.
        pulled: (p,) the prior's mean minus the current values.
        prior: (p,) prior standard deviations; infinite without a prior.
    """
    has_prior = np.isfinite(prior)
    matrix = np.concatenate([linear.matrix, np.diag(1.0 / prior)[has_prior]])
    target = np.concatenate([linear.target, (pulled / prior)[has_prior]])
    scale = np.maximum(np.linalg.norm(matrix, axis=0), 1e-300)
    matrix /= scale
    inverse = np.linalg.pinv(matrix.T @ matrix, 1e-13, hermitian=True)
    change = inverse @ (matrix.T @ target)
    squares = float(np.sum((target - matrix @ change) ** 2))
    variance = squares / max(len(target) - len(prior), 1)
    sigma = np.sqrt(variance * np.diag(inverse)) / scale
    return _Step(change / scale, sigma, matrix, target)


def _prior_deviations(linear: _Rows, pulled: np.ndarray, unknowns: _Unknowns) -> np.ndarray:
    """Return the prior standard deviations (p,), with those of each family of terms scaled by the most probable factor.

    Args:
        linear: equations of the data.
        pulled: (p,) the prior's mean minus the current values.
        unknowns: what is fitted, with the first guess of the prior standard deviations.
    """
    guess, group = unknowns.guess, unknowns.group
    ungrouped = group < 0
    prior_rows = ungrouped & np.isfinite(guess)
    rows = np.concatenate([linear.matrix, np.diag(1.0 / guess)[prior_rows]])
    unexplained = linear.target - linear.matrix @ np.where(ungrouped, 0.0, pulled)
    data = np.concatenate([unexplained, (pulled / guess)[prior_rows]])
    size = np.maximum(np.linalg.norm(rows, axis=0), 1e-300)
    unit = np.where(ungrouped, 1.0 / size, guess)
    evidence = relevance(gram(data, rows * unit), group, np.ones(len(unit)))
    factor = np.clip(evidence.ridge, *TERM_SIZES)
    return np.where(ungrouped, guess, factor * guess)
