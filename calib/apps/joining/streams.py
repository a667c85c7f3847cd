"""Points measured while an arm moves, joined with the log of its controller, and thinned to independent rows.

The joints are those of the log at the points' times (`calib.apps.joining.clocks`). Left out are points far from
what the arm, fitted to them, predicts, and those where the speed times the uncertainty of a time exceeds the noise:
there residuals along the motion are larger than those across it. Residuals of neighbours are correlated (air,
vibration, what no model holds): N rows count as N / τ (`calib.estimation.whiteness.inflation`), and a fit to all of
them would state sigmas √τ times too small. At distances of 1 + 1.5 (τ - 1) steps the correlation is 0.05 where it dies
away exponentially. Thresholds are our choice.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from calib.apps.joining.clock_steps import Step, find_step
from calib.apps.joining.clocks import Clock, Run, begin, fitted, residuals, velocities
from calib.apps.joining.joined import Joined
from calib.apps.joining.stream_files import Kind, Stream, read_stream
from calib.data.csv_table import Table
from calib.data.poses.columns import LATE, POSITION, QUATERNION, Sheet
from calib.data.poses.measurements import PoseMeasurements
from calib.data.poses.plausible import check_joints, outside, unit_quaternions
from calib.data.schema import BOUNDS, max_travel
from calib.errors import Finding, MeasurementError, finding, refuse_data, require
from calib.estimation import robust
from calib.estimation.whiteness import autocorrelation, inflation
from calib.geometry.installation import Installation
from calib.procedure.findings import lines_of
from calib.procedure.robot_kinds import joints_of
from calib.records import evenly
from calib.robot.chain import Chain, joint_kinds
from calib.units import JOINT

RESOLUTION, LOG_RESOLUTION = 0.004, 0.008  # time between the rows that are held, of instrument and log [s]
MIN_MOTION = 1e-3  # travel of a joint [rad or m] and of the points [m]
FITTED = 1500  # rows that clock and geometry are fitted to first
OUTLIER = 6.0  # robust sigmas
MIN_ROWS, MAX_ROWS = 20, 20_000  # of the table
MOVED = 1e-3  # by which a joint moves at least between two rows of the table [rad or m]
MAX_WANDER = 5e-3  # by which a clock may leave a line of offset and drift [s]
WORTH_SAYING = 1.05  # times that σ of a fit to all rows would be too small


@dataclass(frozen=True, eq=False)
class Streamed(Joined):
    """Points of a stream with the joints at their times, thinned; the table has the instrument's time, too.

    Attributes:
        clock: the instrument's.
        sigma: robust standard deviation of the residuals of positions, per axis [m].
        correlation: τ of the residuals before thinning [s].
        factor: √ of how many steps count as one: by so much a fit to all of them would state too small sigmas.
        left: correlation of neighbours after thinning.
    """

    clock: Clock
    sigma: float
    correlation: float
    factor: float
    left: float


def join_streams(log_file: Path, file: Path, chain: Chain) -> Streamed:
    """Return the points of an instrument's stream with the joints of a controller's log, thinned to independent ones.

    Args:
        log_file: times and joint values, by the controller's clock.
        file: times and positions, with or without quaternions, by the instrument's clock.
        chain: the nominal arm.

    Raises:
        MeasurementError: where the files are no streams, the arm hardly moves, or the two do not belong together.
    """
    log, stream = read_stream(log_file, _joints(chain)), _fresh(read_stream(file, _target()))
    for recording, k, unit in ((log, chain.n, ""), (stream, 3, " m")):
        travel = float(np.ptp(recording.values[:, :k], axis=0).max())
        message = f"hardly moves (by {travel:.2g}{unit}), and without motion no clock is found: is the unit right?"
        require(travel > MIN_MOTION, message, MeasurementError, recording.file)
    turn = stream.values[:, 3:] if stream.values.shape[1] > 3 else None
    q, names = np.zeros((len(stream.t), chain.n)), chain.joint_names
    run = Run(log, stream, PoseMeasurements.of(q, stream.values[:, :3], turn, joint_names=names, file=str(file)))
    nominal, clock, rivals = begin(chain, run)
    cell, clock, equations = fitted(nominal, run, run.known(clock, FITTED), clock)
    step, wander = find_step(equations)
    if step or wander > MAX_WANDER:
        _refuse(step, wander, run, clock)
    usable, errors, velocity, findings = _usable(cell, run, clock)
    tau, sigma = max(inflation(row) for row in errors), robust.spread(errors[:3])
    chosen, spacing = _thinned(stream.t[usable], run.joints(clock, usable), stream.step * (1.0 + 1.5 * (tau - 1.0)))
    rows, neighbour_correlation = usable[chosen], max(float(autocorrelation(row, 1)[0]) for row in errors[:, chosen])
    figures: dict[str, Any] = {
        "sigma": sigma,
        "correlation": tau * stream.step,
        "factor": float(np.sqrt(tau)),
        "left": neighbour_correlation,
    }
    stated_figures = spacing | figures | {"factor": figures["factor"] if figures["factor"] > WORTH_SAYING else None}
    thinned = finding("stream-thinned", taken=len(rows), of=len(usable), step=stream.step, **stated_figures)
    if len(rows) < MIN_ROWS:
        message = (
            "too few rows are independent: did a clock jump, or instrument or target move? Else measure for longer"
        )
        refuse_data(file, f"{message}, over more of the workspace ({'; '.join([*run.lines(), *lines_of([thinned])])})")
    few = rows[evenly(len(rows), FITTED)]
    _, clock, _ = fitted(nominal, run, few, clock, play=True)
    alike = float(
        np.sqrt((1.0 + max(neighbour_correlation, 0.0)) / (1.0 - max(neighbour_correlation, 0.0)))
    )  # of neighbours, for what changes slowly
    clock = replace(clock, sigma=alike * clock.sigma, drift_sigma=alike * clock.drift_sigma)
    position_error = clock.sigma * float(np.sqrt(np.mean(np.sum(velocity**2, axis=0))))
    message = (
        f"the offset of its clock is known to {1e3 * clock.sigma:.2g} ms only, in which the target moves by "
        f"{1e3 * position_error:.2g} mm (noise {1e3 * sigma:.2g} mm): measure for longer, each way forth and back"
    )
    require(position_error < sigma, message, MeasurementError, file)
    findings += [finding("stream-repeats", offsets=rivals)] if rivals else []
    findings += [finding("stream-wanders", away=wander)] if wander else []
    first = stream.t[0] - float(clock.controller(stream.t[:1])[0])
    ppm = {"ppm": 1e6 * clock.drift, "ppm_sigma": 1e6 * clock.drift_sigma}
    findings += [finding("stream-clock", first=first, **vars(clock) | ppm)]
    notes = (*run.lines(), *lines_of([*findings, thinned]))
    table = _table(chain, run.joints(clock, rows), stream, rows, velocities(cell, run, rows, clock)[:3])
    return Streamed(table, stream.rows[rows] - 1, notes, clock, **figures)


def _refuse(step: Step | None, wander: float, run: Run, clock: Clock) -> NoReturn:
    """Refuse recordings in which a clock steps, or wanders."""
    if step is None:
        message = f"the clocks' offset leaves a line of offset and drift by {1e3 * wander:.2g} ms"
        refuse_data(run.stream.file, f"{message}: cut the file into shorter parts, and join each part on its own")
    size = f"{1e3 * step.size:+.3g} ± {1e3 * step.sigma:.2g} ms"
    message = f"the instrument's clock steps by {size} against the controller's"
    location = step.place(run.log, run.stream, float(clock.controller(np.array(step.time))))
    refuse_data(run.stream.file, f"{message} ({location}): cut the file there, and join each part on its own")


def _usable(cell: Installation, run: Run, clock: Clock) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[Finding]]:
    """Return usable rows, their residuals (3 or 6, m) and velocities (3, m), and findings; count what is not.

    Residuals have the variance σ² across the motion, and σ² + v² σ_t² along it.
    """
    stream, usable = run.stream, run.known(clock)
    errors = residuals(cell, run, usable, clock)
    consistent = (np.abs(errors) < OUTLIER * np.array([[robust.spread(row)] for row in errors])).all(axis=0)
    stream.dropped["outside the log or in its gaps"] = len(stream.t) - len(usable)
    stream.dropped["far from the arm's path"] = int((~consistent).sum())
    usable, errors = usable[consistent], errors[:, consistent]
    velocity = np.gradient(stream.values[usable, :3], stream.t[usable], axis=0).T
    speed = np.linalg.norm(velocity, axis=0)
    along = (errors[:3] * velocity).sum(axis=0) / np.maximum(speed, 1e-9)
    across = (np.sum(errors[:3] ** 2, axis=0) - along**2) / 2.0
    time_sigma = np.sqrt(max(float(np.sum(speed**2 * (along**2 - across)) / np.sum(speed**4)), 1e-24))
    sigma = float(np.sqrt(across.mean()))
    slow = speed * time_sigma <= sigma
    stream.dropped["too fast"] = int((~slow).sum())
    findings = [] if slow.all() else [finding("stream-fast", speed=sigma / time_sigma, late=time_sigma, sigma=sigma)]
    return usable[slow], errors[:, slow], velocity[:, slow], findings


def _joints(chain: Chain) -> Kind:
    """Return how a log's joints are read."""
    robot = joints_of(chain)
    travel = max_travel(robot.kinds)
    low, high = (
        np.where(np.isfinite(limit), limit, side * travel) for limit, side in ((robot.lower, -1), (robot.upper, 1))
    )

    def names(table: Table) -> tuple[str, ...]:
        return Sheet(table).find_joints(robot.names)

    def sound(q: np.ndarray) -> np.ndarray:
        return np.all(~outside(q, low, high), axis=1)

    def refuse(table: Table, q: np.ndarray) -> None:
        check_joints(q, Sheet(table), names(table), robot)

    return Kind(names, lambda table: Sheet(table).joints(robot.names)[0], sound, refuse, LOG_RESOLUTION)


def _target() -> Kind:
    """Return how an instrument's positions [m], and its quaternions where it has some, are read."""

    def names(table: Table) -> tuple[str, ...]:
        position_columns = Sheet(table).family(POSITION.names)
        require(position_columns, f"has no x, y, z; found {', '.join(table.header)}", MeasurementError, table.file)
        return (*position_columns, *Sheet(table).family(QUATERNION.names))

    def values(table: Table) -> np.ndarray:
        return np.column_stack([table.numbers(name, "" if k > 2 else "length") for k, name in enumerate(names(table))])

    def sound(values: np.ndarray) -> np.ndarray:
        position, turn = values[:, :3], values[:, 3:]
        unit = np.abs(np.linalg.norm(turn, axis=1) - 1.0) <= BOUNDS.max_norm_error
        return (np.abs(position) <= BOUNDS.max_length).all(axis=1) & position.any(axis=1) & (unit | (not turn.size))

    def refuse(table: Table, values: np.ndarray) -> None:
        POSITION.check(values[:, :3], table, names(table)[:3])
        if values.shape[1] > 3:
            unit_quaternions(values[:, 3:], table, names(table)[3:])

    return Kind(names, values, sound, refuse, RESOLUTION)


def _fresh(stream: Stream) -> Stream:
    """Return the stream without readings that repeat the one before: nothing new was seen."""
    new = np.concatenate([[True], np.diff(stream.values, axis=0).any(axis=1)])
    stream.dropped["repeating the reading before"] = int((~new).sum())
    return replace(stream, t=stream.t[new], values=stream.values[new], rows=stream.rows[new])


def _thinned(t: np.ndarray, q: np.ndarray, min_interval: float) -> tuple[np.ndarray, dict[str, float | None]]:
    """Return the indices of times t (m,) at least `min_interval` [s], between which one of the joints q (m, n) moves.

    Second: `apart`, the median time between them [s], and what made it longer: `most` rows, or that a joint `moved`.
    """
    step, full = float(np.median(np.diff(t))), float(t[-1] - t[0]) / MAX_ROWS
    capped, min_interval, chosen, after, ahead = (
        full > 0.999 * min_interval,
        max(0.999 * min_interval, full),
        [0],
        0,
        64,
    )
    while (after := max(after, int(np.searchsorted(t, t[chosen[-1]] + min_interval)))) < len(t):
        moving = np.flatnonzero(np.abs(q[after : after + ahead] - q[chosen[-1]]).max(axis=1) > MOVED)
        chosen += (after + moving[:1]).tolist()
        after += 0 if len(moving) else ahead
    rows = np.array(chosen)
    interval = float(np.median(np.diff(t[rows]))) if len(rows) > 1 else min_interval
    still = interval > min_interval + 1.5 * step
    max_rows, moving = MAX_ROWS if capped and not still else None, 1e3 * MOVED if still else None
    return rows, {"apart": interval, "most": max_rows, "moved": moving}


def _table(chain: Chain, q: np.ndarray, stream: Stream, rows: np.ndarray, velocity: np.ndarray) -> Table:
    """Return rows of a stream with their joints q (m, n) and velocities (3, m) as a table of measured poses."""
    units = [JOINT["prismatic" if kind == "prismatic" else "revolute"] for kind in joint_kinds(chain)]
    turn = QUATERNION.names if stream.values.shape[1] > 3 else ()
    header = ("time", *chain.joint_names, *POSITION.names, *turn, *LATE.names)
    cells = (stream.t[rows], *(q * [factor for factor, _ in units]).T, *(1e3 * stream.values[rows, :3]).T)
    cells += (*stream.values[rows, 3:].T, *(1e3 * velocity))
    column_units = ("s", *(unit for _, unit in units), *("mm",) * 3, *("",) * len(turn), *("mm/s",) * 3)
    return Table(stream.file, header, column_units, cells, stream.rows[rows])
