"""Clock of an instrument against a controller's, from points measured while the arm moves.

A point at the instrument's time t belongs to the joints q(t - offset - drift (t - middle)) of the log. Where to begin
is found without any frame: the speed of the nominal arm's tip against that of the points, at every offset
(cross-correlation); the best few are tried by placing instrument and target. Then offset, drift, both placements and
the arm's geometry are fitted together (Gauss-Newton), since the errors of an arm would else pass for those of a clock.
How large the terms of an effect may be is found from the data (`calib.estimation.relevance`): by a size that is given,
σ of the clock is too large for arms with less of it, and too small for arms with more. Thresholds are our choice.
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
from calib.data.poses.measurements import Positions, take
from calib.errors import refuse_data
from calib.estimation import robust
from calib.estimation.relevance import gram, relevance
from calib.geometry.first_guess import install
from calib.geometry.fit import plausible_deviation
from calib.geometry.installation import Installation
from calib.geometry.model_choice.cross_validation import term_sizes
from calib.geometry.model_choice.ladder import EFFECTS
from calib.geometry.observability import base_columns
from calib.geometry.observation import layout, observe, parameter_values, prepare, step
from calib.records import evenly
from calib.robot.calibrated import Deflection
from calib.robot.chain import Chain
from calib.robot.kinematics import forward
from calib.transforms import invert, rotation_vector

GRID = 0.05  # of the offsets that are tried first [s]
LEVERS = (0.0, 0.15, 0.4)  # by which the tip's turning counts as speed: the target's own is not known [m]
PEAKS, APART = 3, 1.0  # offsets that are tried for each lever, and their least distance [s]
OVERLAP = 0.5  # share of the shorter file that the longer one has, at least
TRIMMED = 90  # percent of the residuals that an offset is judged by
PLACED = 300  # rows that placements are guessed from
MAX_RATIO = 0.15  # of the points' spread that a log of the same motion leaves with the nominal arm
RIVAL = 1.3  # times the residual of the best offset, up to which another one is as good
MAX_DRIFT = 1e-3  # prior standard deviation of a clock's drift
BESIDE = 1e-3  # difference of times by which speeds are computed [s]
ORDERS = 6  # of the harmonics that are fitted
ROUNDS = 12  # of Gauss-Newton
SETTLED = 1e-6  # change of the offset after which it ends [s]
TERM_SIZES = (1e-3, 5.0)  # times their guessed size that terms are, at least and at most
_NONE = np.array([], dtype=int)


@dataclass(frozen=True)
class Clock:
    """Clock of an instrument against the controller's.

    Attributes:
        offset, sigma: the instrument's time minus the controller's at `middle`, and its standard deviation [s].
        drift, drift_sigma: change of the offset with time [s/s].
        middle: time of the instrument [s].
    """

    offset: float
    sigma: float = np.inf
    drift: float = 0.0
    drift_sigma: float = np.inf
    middle: float = 0.0

    def controller(self, t: np.ndarray) -> np.ndarray:
        """Return the controller's times of the instrument's times t (m,) [s]."""
        return t - self.offset - self.drift * (t - self.middle)


@dataclass(frozen=True, eq=False)
class Run:
    """A motion as both recordings have it.

    Attributes:
        log: the controller's joints.
        stream: the instrument's rows; `points` are these as measurements, without their joints.
    """

    log: Stream
    stream: Stream
    points: Positions

    @cached_property
    def _path(self) -> CubicSpline:
        return CubicSpline(self.log.t, self.log.values)

    def joints(self, clock: Clock, rows: np.ndarray, order: int = 0) -> np.ndarray:
        """Return the log's joints (m, n) at the times of rows, or a derivative; outside the log those of its ends."""
        return self._path(np.clip(clock.controller(self.stream.t[rows]), *self.log.t[[0, -1]]), order)

    def known(self, clock: Clock, count: int | None = None) -> np.ndarray:
        """Return the rows, or as many of them evenly, whose times are between two of the log that are no gap apart."""
        t, log = clock.controller(self.stream.t), self.log
        after = np.clip(np.searchsorted(log.t, t), 1, len(log.t) - 1)
        bridged = log.t[after] - log.t[after - 1] <= log.gap
        rows = np.flatnonzero(bridged & (t >= log.t[0]) & (t <= log.t[-1]))
        return rows[evenly(len(rows), count)] if count else rows

    def lines(self) -> list[str]:
        """Return what is to be said of both files."""
        return [*self.log.lines(), *self.stream.lines()]

    def at(self, clock: Clock, rows: np.ndarray) -> Positions:
        """Return rows as measurements with their joints."""
        return replace(take(self.points, rows), q=self.joints(clock, rows))


def begin(chain: Chain, run: Run) -> tuple[Installation, Clock, tuple[float, ...]]:
    """Return the nominal arm placed, the clock to begin with, and other offsets that are as good [s].

    Raises:
        MeasurementError: where no offset brings the points onto the nominal arm's path.
    """
    starts, middle = list[tuple[float, Clock, Installation]](), float(run.stream.t[[0, -1]].mean())
    for offset in _offsets(chain, run):
        clock = Clock(offset, middle=middle)
        if len(rows := run.known(clock, PLACED)) < PLACED / 3:
            continue
        cell, clock, _ = fitted(install(chain, [run.at(clock, rows)]), run, rows, clock, arm=False)
        sizes = np.sort(np.linalg.norm(residuals(cell, run, rows, clock)[:3], axis=0))
        starts.append((float(np.sqrt(np.mean(sizes[: TRIMMED * len(rows) // 100] ** 2))), clock, cell))
    best_misfit = min((start[0] for start in starts), default=np.inf)
    spread = float(np.linalg.norm(run.points.position.std(axis=0)))
    if best_misfit > min(MAX_RATIO * spread, MAX_MISFIT * chain.stretched_length()):
        refuse_data(
            run.stream.file,
            f"at no offset of the clocks its points are on the path of the nominal arm by {run.log.file} (the best "
            f"leaves {1e3 * best_misfit:.3g} mm of a motion of {1e3 * spread:.3g} mm): is it the log of this "
            "motion, and of this robot, did instrument and target stay in place, and did no clock jump? "
            f"({'; '.join(run.lines())})",
        )
    alike = [start for start in starts if start[0] < RIVAL * best_misfit]
    _, clock, cell = max(alike, key=lambda start: len(run.known(start[1])))
    rivals = {round(rival.offset, 2) for _, rival, _ in alike if abs(rival.offset - clock.offset) > APART}
    return cell, Clock(clock.offset, middle=middle), tuple(sorted(rivals))


def _offsets(chain: Chain, run: Run) -> list[float]:
    """Return offsets of the clocks [s] at which the speeds of the arm and of the points go together."""
    arm = forward(chain, _even(run.log))
    turns = np.linalg.norm(rotation_vector(invert(arm[:-1])[:, :3, :3] @ arm[1:, :3, :3]), axis=1)
    arm_steps, point_steps = (
        np.linalg.norm(np.diff(p, axis=0), axis=1) for p in (arm[:, :3, 3], _even(run.stream)[:, :3])
    )
    lags = GRID * correlation_lags(len(point_steps), len(arm_steps)) + run.stream.t[0] - run.log.t[0]
    shared = np.round(correlate(np.ones(len(point_steps)), np.ones(len(arm_steps))))
    possible, offsets = shared > OVERLAP * min(len(point_steps), len(arm_steps)), list[float]()
    for lever in LEVERS:
        alike = _alike(_cut(point_steps), _cut(np.hypot(arm_steps, lever * turns))) * np.sqrt(shared / shared.max())
        alike[~possible] = -np.inf
        for _ in range(PEAKS):
            best = float(lags[int(np.argmax(alike))])
            alike[np.abs(lags - best) < APART] = -np.inf
            offsets.append(best)
    return [
        offset for k, offset in enumerate(offsets) if all(abs(offset - earlier) > APART / 2 for earlier in offsets[:k])
    ]


def _even(stream: Stream) -> np.ndarray:
    """Return a stream's values (m, k) on the grid of the offsets."""
    t = np.arange(stream.t[0], stream.t[-1], GRID)
    return np.column_stack([np.interp(t, stream.t, column) for column in stream.values.T])


def _cut(speed: np.ndarray) -> np.ndarray:
    """Return speeds (m,) about their median, jumps cut."""
    return np.minimum(speed, 2.0 * np.quantile(speed, 0.95)) - np.median(speed)


def _alike(series_a: np.ndarray, series_b: np.ndarray) -> np.ndarray:
    """Return the correlation coefficient of two series where they overlap, at every lag."""
    ones_a, ones_b = np.ones(len(series_a)), np.ones(len(series_b))
    count = np.maximum(np.round(correlate(ones_a, ones_b)), 1.0)
    mean, mean_b = correlate(series_a, ones_b) / count, correlate(ones_a, series_b) / count
    power = (correlate(series_a**2, ones_b) / count - mean**2) * (correlate(ones_a, series_b**2) / count - mean_b**2)
    return (correlate(series_a, series_b) / count - mean * mean_b) / np.sqrt(np.maximum(power, 1e-6 * power.max()))


def residuals(cell: Installation, run: Run, rows: np.ndarray, clock: Clock) -> np.ndarray:
    """Return the residuals (3 or 6, m) of rows: of positions [m], then of orientations [rad]."""
    (block,) = prepare(cell, [run.at(clock, rows)])
    return np.concatenate([part.value for part in observe(cell, block, _NONE)])


def velocities(cell: Installation, run: Run, rows: np.ndarray, clock: Clock) -> np.ndarray:
    """Return the velocities (3 or 6, m) [m/s, then rad/s] of the target at rows, as the installation's arm moves it."""
    later, sooner = (residuals(cell, run, rows, replace(clock, offset=clock.offset + s)) for s in (BESIDE, -BESIDE))
    return (later - sooner) / (2.0 * BESIDE)


def fitted(
    cell: Installation, run: Run, rows: np.ndarray, clock: Clock, arm: bool = True, play: bool = False
) -> tuple[Installation, Clock, Equations]:
    """Return the installation and the clock that fit some rows best, and the last equations; σ is of independent rows.

    Args:
        cell, clock: where to start: the nominal arm, about which its parameters have a wide prior.
        arm: whether the arm, with all effects that a model of `calib fit` may have, is fitted, too, not placements,
            offset and drift alone.
        play: whether the backlash of its joints is, too, which else passes for a clock that is late; rows are then
            taken to have no outliers.
    """
    families = [[t for t in effect(cell.chain, False) if t.order <= ORDERS] for effect in EFFECTS.values() if arm]
    terms = tuple(term for family in families for term in family)
    cell = replace(cell, deflection=Deflection(terms, np.zeros(len(terms)), cell.chain)) if arm else cell
    start, table, t = cell, layout(cell), run.stream.t[rows] - clock.middle
    free = table.rigid_index if arm else table.frame_index
    free = free[base_columns(cell, prepare(cell, [run.at(clock, rows)]), free).kept]
    moving, loss = cell.chain.moving, "none" if play else "huber"
    played = len(moving) if play else 0
    sizes = (plausible_deviation(cell, free), term_sizes(terms), np.full(played, BACKLASH), [np.inf, MAX_DRIFT])
    guess = np.concatenate(sizes)
    group = np.repeat([-1, *range(len(families) + 1), -1], [len(free), *map(len, families), played, 2])
    free = np.concatenate([free, table.index("deflection")])
    has_prior, spread = np.isfinite(guess), np.full(len(guess), np.inf)
    for _ in range(ROUNDS):
        (block,) = prepare(cell, [run.at(clock, rows)])
        parts, turned = observe(cell, block, free), observe(cell, block, moving)
        pulled = np.zeros(len(guess))
        pulled[: len(free)], pulled[-1] = (parameter_values(start) - parameter_values(cell))[free], -clock.drift
        side = np.sign(run.joints(clock, rows, 1).T)[:, None]
        weighted, slopes, plays, lates = list[np.ndarray](), list[np.ndarray](), list[np.ndarray](), list[np.ndarray]()
        for part, joints, speed in zip(parts, turned, np.split(velocities(cell, run, rows, clock), len(parts))):
            sigma = max(robust.spread(part.value), 1e-9)
            weight = np.sqrt(robust.weights(np.sqrt(np.mean(part.value**2, axis=0)) / sigma, loss)) / sigma
            weighted.append((weight * part.value).ravel())
            plays.append((weight * side * joints.jacobian).reshape(len(moving), -1).T)
            lates.append((weight * -speed).ravel())
            columns = np.concatenate([part.jacobian, [-speed, -t * speed]])
            columns = (weight * columns).reshape(len(columns), -1).T
            slopes.append(np.hstack([columns[:, :-2], plays[-1][:, :played], columns[:, -2:]]))
        prior = _sized(np.concatenate(slopes), np.concatenate(weighted), pulled, guess, group) if arm else guess
        matrix = np.concatenate([*slopes, np.diag(1.0 / prior)[has_prior]])
        target = np.concatenate([*weighted, (pulled / prior)[has_prior]])
        size = np.maximum(np.linalg.norm(matrix, axis=0), 1e-300)
        matrix /= size
        inverse = np.linalg.pinv(matrix.T @ matrix, 1e-13, hermitian=True)
        change = inverse @ (matrix.T @ target)
        variance = float(np.sum((target - matrix @ change) ** 2)) / max(len(target) - len(guess), 1)
        spread = np.sqrt(variance * np.diag(inverse)) / size
        change /= size
        cell = step(cell, free, change[: len(free)])
        clock = replace(clock, offset=clock.offset + change[-2], drift=clock.drift + change[-1])
        if abs(change[-2]) < SETTLED:
            break
    offset_slope = np.concatenate(lates)
    times = np.tile(run.stream.t[rows], len(offset_slope) // len(rows))
    equations = Equations(matrix, target, offset_slope, np.concatenate(plays), times)
    return cell, replace(clock, sigma=float(spread[-2]), drift_sigma=float(spread[-1])), equations


def _sized(
    matrix: np.ndarray, target: np.ndarray, pulled: np.ndarray, guess: np.ndarray, group: np.ndarray
) -> np.ndarray:
    """Return the prior standard deviations (p,), those of a family of terms by the factor that is most probable.

    Args:
        matrix, target: whitened rows of the data, (rows, p) and (rows,).
        pulled: (p,) the prior's mean minus the present values.
        guess: (p,) prior standard deviations as they were guessed.
        group: (p,) number of a term's family; -1 for other columns.
    """
    ungrouped = group < 0
    prior_rows = ungrouped & np.isfinite(guess)
    rows = np.concatenate([matrix, np.diag(1.0 / guess)[prior_rows]])
    data = np.concatenate([target - matrix @ np.where(ungrouped, 0.0, pulled), (pulled / guess)[prior_rows]])
    unit = np.where(ungrouped, 1.0 / np.maximum(np.linalg.norm(rows, axis=0), 1e-300), guess)
    evidence = relevance(gram(data, rows * unit), group, np.ones(len(unit)))
    return np.where(ungrouped, guess, np.clip(evidence.ridge, *TERM_SIZES) * guess)
