"""Points measured while an arm moves, joined with the log of its controller, and thinned to independent rows.

The joint values are those of the log at the points' times (`calib.apps.joining.clocks`). Points far from the prediction
of the fitted arm are left out. So are points at which the speed times the uncertainty of the time exceeds the noise:
there, residuals along the motion are larger than across the motion. Residuals of neighbouring rows are correlated (air,
vibration, effects that no model describes). N rows are worth N / τ independent ones
(`calib.estimation.whiteness.inflation`), and a fit to all of them would report sigmas that are √τ times too small. At a
distance of 1 + 1.5 (τ - 1) steps, an exponentially decaying correlation has fallen to 0.05. Thresholds are our choice.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple, NoReturn

import numpy as np

from calib.apps.joining.clock_fit import begin, fitted
from calib.apps.joining.clock_steps import Step, find_step
from calib.apps.joining.clocks import Clock, Run, residuals, velocities
from calib.apps.joining.joined import Joined
from calib.apps.joining.mapping import clock_names
from calib.apps.joining.stream_files import Kind, Stream, read_stream
from calib.errors import Finding, finding, refuse_data
from calib.records import evenly
from calib.toolkit.chains import Chain, joint_kinds
from calib.toolkit.installations import Installation
from calib.toolkit.pose_data import (
    BOUNDS,
    LATE,
    POSITION,
    QUATERNION,
    FileOptions,
    FitOptions,
    PoseMeasurements,
    Sheet,
    Table,
    check_joints,
    max_travel,
    outside,
    unit_quaternions,
)
from calib.toolkit.result_folders import joints_of, lines_of
from calib.toolkit.statistics import autocorrelation, inflation, spread
from calib.units import JOINT

# smallest time between the rows in memory, of the instrument and of the log [s]
RESOLUTION, LOG_RESOLUTION = 0.004, 0.008
# smallest travel of some joint [rad or m], and of the points [m]
MIN_MOTION = 1e-3
# number of rows to which clock and geometry are fitted first
FITTED = 1500
# number of robust sigmas from which on a residual is an outlier
OUTLIER = 6.0
# smallest and largest number of rows of the table
MIN_ROWS, MAX_ROWS = 20, 20_000
# number of rows that are searched at once for the next row at which the arm has moved
PIECE = 64
# smallest motion of some joint between two rows of the table [rad or m]
MOVED = 1e-3
# largest deviation of a clock from a line of offset and drift [s]
MAX_WANDER = 5e-3
# factor by which σ of a fit to all rows would be too small, from which on it is reported
WORTH_SAYING = 1.05


@dataclass(frozen=True, eq=False)
class Streamed(Joined):
    """Points of a stream with the joint values at their times, thinned; the table also has the instrument's time.

    Attributes:
        clock: the instrument's clock.
        sigma: robust standard deviation of the position residuals, per axis [m].
        correlation: correlation time τ of the residuals before thinning [s].
        factor: √(τ / time between rows), the factor by which sigmas would be too small if all rows were fitted.
        left: correlation of neighbouring residuals after thinning.
    """

    clock: Clock
    sigma: float
    correlation: float
    factor: float
    left: float


class _Thinning(NamedTuple):
    """Rows of a stream whose residuals are independent.

    Attributes:
        rows: (r,) rows of the stream.
        sigma: robust standard deviation of the position residuals, per axis [m].
        correlation_time: τ of the residuals before thinning [s].
        factor: √(τ / time between rows).
        neighbour_correlation: correlation of neighbouring residuals after thinning.
        finding: what was done, for the user.
    """

    rows: np.ndarray
    sigma: float
    correlation_time: float
    factor: float
    neighbour_correlation: float
    finding: Finding


def join_streams(log_file: Path, file: Path, chain: Chain, options: FitOptions) -> Streamed:
    """Return the points of an instrument's stream with the joint values of a controller's log, thinned.

    Thinning keeps rows whose errors are independent.

    Args:
        log_file: file with times and joint values, by the controller's clock.
        file: file with times and positions, with or without quaternions, by the instrument's clock.
        chain: the nominal arm.
        options: how the files are read, where their headers do not say it.

    Raises:
        MeasurementError: the files are no streams, the arm moves too little, or the files are not of the same motion.
    """
    run = _read_run(log_file, file, chain, options)
    stream = run.stream

    # clock and arm are first fitted to rows whose residuals are correlated
    nominal, clock, rivals = begin(chain, run)
    cell, clock, equations = fitted(nominal, run, run.known(clock, FITTED), clock)
    step, wander = find_step(equations)
    if step or wander > MAX_WANDER:
        _refuse(step, wander, run, clock)
    usable, errors, velocity, findings = _usable(cell, run, clock)
    thinning = _thin(run, clock, usable, errors)
    rows = thinning.rows
    if len(rows) < MIN_ROWS:
        notes = "; ".join([*run.lines(), *lines_of([thinning.finding])])
        message = (
            "too few rows are independent: did a clock jump, or did instrument or target move? Else measure for longer"
        )
        refuse_data(file, f"{message}, over more of the workspace ({notes})")

    # then to independent ones
    clock = _clock_by_rows(nominal, run, clock, thinning)
    rms_speed = float(np.sqrt(np.mean(np.sum(velocity**2, axis=0))))
    position_error = clock.sigma * rms_speed
    if not position_error < thinning.sigma:
        refuse_data(
            file,
            f"the offset of its clock is known to {1e3 * clock.sigma:.2g} ms only, in which the target moves by "
            f"{1e3 * position_error:.2g} mm (noise {1e3 * thinning.sigma:.2g} mm): measure for longer, each way forth "
            "and back",
        )

    if rivals:
        findings.append(finding("stream-repeats", offsets=rivals))
    if wander:
        findings.append(finding("stream-wanders", away=wander))
    findings.append(_clock_finding(clock, stream))
    notes = (*run.lines(), *lines_of([*findings, thinning.finding]))
    row_velocities = velocities(cell, run, rows, clock)[:3]
    table = _table(chain, run.joints(clock, rows), stream, rows, row_velocities)
    return Streamed(
        table,
        stream.rows[rows] - 1,
        notes,
        clock,
        sigma=thinning.sigma,
        correlation=thinning.correlation_time,
        factor=thinning.factor,
        left=thinning.neighbour_correlation,
    )


def _read_run(log_file: Path, file: Path, chain: Chain, options: FitOptions) -> Run:
    """Return the recordings of a motion by controller and instrument; arguments as in `join_streams`.

    Raises:
        MeasurementError: the files are no streams, or the arm moves too little.
    """
    clocks = clock_names(options.columns)
    log = read_stream(log_file, _joints(chain, options.for_file(log_file)), clocks)
    stream = _fresh(read_stream(file, _target(options.for_file(file)), clocks))
    _check_motion(log, chain.n, "")
    _check_motion(stream, 3, " m")
    positions = stream.values[:, :3]
    turns = stream.values[:, 3:] if stream.values.shape[1] > 3 else None
    no_joints = np.zeros((len(stream.t), chain.n))
    points = PoseMeasurements.of(no_joints, positions, turns, joint_names=chain.joint_names, file=str(file))
    return Run(log, stream, points)


def _thin(run: Run, clock: Clock, usable: np.ndarray, errors: np.ndarray) -> _Thinning:
    """Return rows of the stream that are far enough apart for their residuals to be independent.

    Args:
        run: the recordings of controller and instrument.
        clock: the fitted clock.
        usable: (m,) rows of the stream from which they are taken.
        errors: (3 or 6, m) their residuals.
    """
    stream = run.stream
    tau = max(inflation(row) for row in errors)
    sigma = spread(errors[:3])
    min_interval = stream.step * (1.0 + 1.5 * (tau - 1.0))
    chosen, spacing = _thinned(stream.t[usable], run.joints(clock, usable), min_interval)
    neighbour_correlation = max(float(autocorrelation(row, 1)[0]) for row in errors[:, chosen])
    correlation_time = tau * stream.step
    factor = float(np.sqrt(tau))
    remark = finding(
        "stream-thinned",
        taken=len(chosen),
        of=len(usable),
        step=stream.step,
        **spacing,
        sigma=sigma,
        correlation=correlation_time,
        factor=factor if factor > WORTH_SAYING else None,
        left=neighbour_correlation,
    )
    return _Thinning(usable[chosen], sigma, correlation_time, factor, neighbour_correlation, remark)


def _clock_by_rows(nominal: Installation, run: Run, clock: Clock, thinning: _Thinning) -> Clock:
    """Return the clock fitted to thinned rows, its σ widened by the correlation that is left between neighbours.

    Neighbours are alike in what changes slowly.

    Args:
        nominal: the nominal arm with station and tool.
        run: the recordings of controller and instrument.
        clock: where the fit begins.
        thinning: the rows.
    """
    few = thinning.rows[evenly(len(thinning.rows), FITTED)]
    _, clock, _ = fitted(nominal, run, few, clock, backlash=True)
    correlation = max(thinning.neighbour_correlation, 0.0)
    widening = float(np.sqrt((1.0 + correlation) / (1.0 - correlation)))
    return replace(clock, sigma=widening * clock.sigma, drift_sigma=widening * clock.drift_sigma)


def _clock_finding(clock: Clock, stream: Stream) -> Finding:
    """Return the finding that states an instrument's clock beside the controller's."""
    first_time = stream.t[:1]
    first = stream.t[0] - float(clock.controller(first_time)[0])
    return finding(
        "stream-clock",
        first=first,
        offset=clock.offset,
        sigma=clock.sigma,
        drift=clock.drift,
        drift_sigma=clock.drift_sigma,
        middle=clock.middle,
        ppm=1e6 * clock.drift,
        ppm_sigma=1e6 * clock.drift_sigma,
    )


def _check_motion(recording: Stream, count: int, unit: str) -> None:
    """Raise MeasurementError for a recording in which no quantity changes by more than `MIN_MOTION`.

    Args:
        recording: the recording.
        count: number of columns to check, from the first one on.
        unit: unit of the columns, for the message.
    """
    travel = float(np.ptp(recording.values[:, :count], axis=0).max())
    if not travel > MIN_MOTION:
        message = f"moves by only {travel:.2g}{unit}, too little to identify the clocks' offset: is the unit right?"
        refuse_data(recording.file, message)


def _refuse(step: Step | None, wander: float, run: Run, clock: Clock) -> NoReturn:
    """Raise MeasurementError for recordings in which a clock steps or wanders.

    Args:
        step: the step; None for a clock that wanders.
        wander: largest deviation from a line of offset and drift [s].
        run: the recordings.
        clock: the fitted clock.
    """
    file = run.stream.file
    if step is None:
        message = f"the clocks' offset deviates from a line of offset and drift by {1e3 * wander:.2g} ms"
        refuse_data(file, f"{message}: cut the file into shorter parts, and join each part on its own")
    size = f"{1e3 * step.size:+.3g} ± {1e3 * step.sigma:.2g} ms"
    log_time = float(clock.controller(np.array(step.time)))
    location = step.place(run.log, run.stream, log_time)
    message = f"the instrument's clock steps by {size} against the controller's"
    refuse_data(file, f"{message} ({location}): cut the file there, and join each part on its own")


def _usable(cell: Installation, run: Run, clock: Clock) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[Finding]]:
    """Return the usable rows (m,), their residuals (3 or 6, m) and velocities (3, m), and findings.

    Unusable rows are counted in the stream. Residuals are taken to have the variance σ² across the motion, and σ² + v²
    σ_t² along the motion at speed v, with σ_t the uncertainty of the time.

    Args:
        cell: the fitted arm with station and tool.
        run: the recordings of controller and instrument.
        clock: the fitted clock.
    """
    stream = run.stream
    usable = run.known(clock)
    stream.dropped["outside the log or in its gaps"] = len(stream.t) - len(usable)

    errors = residuals(cell, run, usable, clock)
    bounds = OUTLIER * np.array([[spread(row)] for row in errors])
    consistent = (np.abs(errors) < bounds).all(axis=0)
    stream.dropped["far from the arm's path"] = int((~consistent).sum())
    usable, errors = usable[consistent], errors[:, consistent]

    velocity = np.gradient(stream.values[usable, :3], stream.t[usable], axis=0).T
    speed = np.linalg.norm(velocity, axis=0)
    along = (errors[:3] * velocity).sum(axis=0) / np.maximum(speed, 1e-9)
    across_variance = (np.sum(errors[:3] ** 2, axis=0) - along**2) / 2.0
    excess = np.sum(speed**2 * (along**2 - across_variance))
    time_sigma = np.sqrt(max(float(excess / np.sum(speed**4)), 1e-24))
    sigma = float(np.sqrt(across_variance.mean()))
    slow = speed * time_sigma <= sigma
    stream.dropped["too fast"] = int((~slow).sum())
    findings = list[Finding]()
    if not slow.all():
        findings.append(finding("stream-fast", speed=sigma / time_sigma, late=time_sigma, sigma=sigma))
    return usable[slow], errors[:, slow], velocity[:, slow], findings


def _joints(chain: Chain, options: FileOptions) -> Kind:
    """Return how a log's joint values are read and checked for an arm: columns, units and joint limits.

    Args:
        chain: the arm.
        options: how the log is read.
    """
    robot = joints_of(chain)
    # limits, and for a joint without any a bound of the right unit
    travel = max_travel(robot.kinds)
    low = np.where(np.isfinite(robot.lower), robot.lower, -1 * travel)
    high = np.where(np.isfinite(robot.upper), robot.upper, travel)

    def names(table: Table) -> tuple[str, ...]:
        return Sheet(table, options).find_joints(robot)

    def values(table: Table) -> np.ndarray:
        q, *_ = Sheet(table, options).joints(robot)
        return q

    def sound(q: np.ndarray) -> np.ndarray:
        return np.all(~outside(q, low, high), axis=1)

    def refuse(table: Table, q: np.ndarray) -> None:
        check_joints(q, Sheet(table, options), names(table), robot)

    return Kind(names, values, sound, refuse, LOG_RESOLUTION)


def _target(options: FileOptions) -> Kind:
    """Return how an instrument's positions [m] are read and checked, with quaternions where the file has them.

    Args:
        options: how the file is read.
    """

    def names(table: Table) -> tuple[str, ...]:
        sheet = Sheet(table, options)
        position_columns = sheet.family(POSITION.names)
        if not position_columns:
            refuse_data(table.file, f"has no x, y, z; found {', '.join(table.header)}")
        return (*position_columns, *sheet.family(QUATERNION.names))

    def values(table: Table) -> np.ndarray:
        sheet = Sheet(table, options)
        position_columns = names(table)[:3]
        columns = [table.numbers(name, "length", sheet.unit(name, POSITION.family)) for name in position_columns]
        columns += [table.numbers(name, "") for name in names(table)[3:]]
        return np.column_stack(columns)

    def sound(values: np.ndarray) -> np.ndarray:
        position, turn = values[:, :3], values[:, 3:]
        within_bounds = (np.abs(position) <= BOUNDS.max_length).all(axis=1)
        unit = np.ones(len(values), dtype=bool)
        if turn.size:
            norm_error = np.abs(np.linalg.norm(turn, axis=1) - 1.0)
            unit = norm_error <= BOUNDS.max_norm_error
        return np.asarray(within_bounds & position.any(axis=1) & unit)

    def refuse(table: Table, values: np.ndarray) -> None:
        POSITION.check(values[:, :3], table, names(table)[:3])
        if values.shape[1] > 3:
            unit_quaternions(values[:, 3:], table, names(table)[3:])

    return Kind(names, values, sound, refuse, RESOLUTION)


def _fresh(stream: Stream) -> Stream:
    """Return the stream without rows equal to the row before, in which the instrument only repeated a reading."""
    changed = np.diff(stream.values, axis=0).any(axis=1)
    fresh = np.concatenate([[True], changed])
    stream.dropped["repeating the reading before"] = int((~fresh).sum())
    return replace(stream, t=stream.t[fresh], values=stream.values[fresh], rows=stream.rows[fresh])


def _thinned(t: np.ndarray, q: np.ndarray, min_interval: float) -> tuple[np.ndarray, dict[str, float | None]]:
    """Return indices of rows at least `min_interval` [s] apart between which some joint moves.

    Also returns the values for a finding: `apart`, the median time between these rows [s]; `most`, the largest number
    of rows, if it was the limit; `moved`, the smallest motion of a joint, if it was the limit; else None.

    Args:
        t: (m,) times [s].
        q: (m, n) joint values at these times [rad or m].
        min_interval: shortest time between two rows.
    """
    step = float(np.median(np.diff(t)))
    full = float(t[-1] - t[0]) / MAX_ROWS
    # stamps are rounded: an interval may be a little shorter
    min_interval = 0.999 * min_interval
    capped = full > min_interval
    min_interval = max(min_interval, full)
    chosen = [0]
    after = 0
    while True:
        earliest = int(np.searchsorted(t, t[chosen[-1]] + min_interval))
        after = max(after, earliest)
        if after >= len(t):
            break
        travel = np.abs(q[after : after + PIECE] - q[chosen[-1]]).max(axis=1)
        moving = np.flatnonzero(travel > MOVED)
        if len(moving):
            chosen.append(after + int(moving[0]))
        else:
            after += PIECE
    rows = np.array(chosen)
    interval = min_interval
    if len(rows) > 1:
        interval = float(np.median(np.diff(t[rows])))
    still = interval > min_interval + 1.5 * step
    max_rows = MAX_ROWS if capped and not still else None
    min_travel = 1e3 * MOVED if still else None
    return rows, {"apart": interval, "most": max_rows, "moved": min_travel}


def _table(chain: Chain, q: np.ndarray, stream: Stream, rows: np.ndarray, velocity: np.ndarray) -> Table:
    """Return rows of a stream as a table of measured poses.

    Args:
        chain: the nominal arm.
        q: (m, n) joint values [rad or m] at the rows.
        stream: the instrument's stream.
        rows: (m,) indices of the rows.
        velocity: (3, m) velocities of the target [m/s].
    """
    header, units, cells = ["time"], ["s"], [stream.t[rows]]
    for name, kind, series in zip(chain.joint_names, joint_kinds(chain), q.T):
        factor, unit = JOINT["prismatic" if kind == "prismatic" else "revolute"]
        header.append(name)
        units.append(unit)
        cells.append(series * factor)
    header += POSITION.names
    units += ["mm"] * 3
    cells += list(1e3 * stream.values[rows, :3].T)
    turns = stream.values[rows, 3:].T
    if len(turns):
        header += QUATERNION.names
        units += [""] * len(turns)
        cells += list(turns)
    header += LATE.names
    units += ["mm/s"] * 3
    cells += list(1e3 * velocity)
    return Table(stream.file, tuple(header), tuple(units), tuple(cells), stream.rows[rows])
