"""Points measured while an arm moves, joined with the log of its controller, and thinned to independent rows.

The joints are those of the log at the points' times (`calib.rooms.instruments.clocks`). Left out are points far from
what the arm, fitted to them, predicts, and those where the speed times the uncertainty of a time exceeds the noise:
there residuals along the motion are larger than those across it. Residuals of neighbours are correlated (air,
vibration, what no model holds): N rows count as N / τ (`calib.estimation.whiteness.inflation`), and a fit to all of
them would state sigmas √τ times too small. At distances of 1 + 1.5 (τ - 1) steps the correlation is 0.05 where it dies
away exponentially. Thresholds are our choice.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from calib.data.csv_table import Table
from calib.data.poses.columns import POSITION, QUATERNION, Sheet
from calib.data.poses.measurements import PoseMeasurements, Positions
from calib.data.poses.plausible import check_joints, outside, unit_quaternions
from calib.data.schema import BOUNDS, max_travel
from calib.errors import MeasurementError, refuse_data, require
from calib.estimation import robust
from calib.estimation.whiteness import autocorrelation, inflation
from calib.geometry.installation import Installation
from calib.procedure.robot_kinds import joints_of
from calib.robot.chain import Chain, joint_kinds
from calib.rooms.instruments.clocks import Clock, Motion, begin, fitted, residuals
from calib.rooms.instruments.joined import Joined
from calib.rooms.instruments.stream_files import Kind, Stream, read_stream
from calib.units import JOINT

RESOLUTION, LOG_RESOLUTION = 0.004, 0.008  # time between the rows that are held, of instrument and log [s]
MIN_MOTION = 1e-3  # travel of a joint [rad or m] and of the points [m]
FITTED = 2000  # rows that clock and geometry are fitted to first
OUTLIER = 6.0  # robust sigmas
MIN_ROWS, MAX_ROWS = 20, 20_000  # of the table
MOVED = 1e-3  # by which a joint moves at least between two rows of the table [rad or m]


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
    for each, k, unit in ((log, chain.n, ""), (stream, 3, " m")):
        most = float(np.ptp(each.values[:, :k], axis=0).max())
        words = f"hardly moves (by {most:.2g}{unit}), and without motion no clock is found: is the unit right?"
        require(most > MIN_MOTION, words, MeasurementError, each.file)
    turn = stream.values[:, 3:] if stream.values.shape[1] > 3 else None
    points = PoseMeasurements.of(
        np.zeros((len(stream.t), chain.n)), stream.values[:, :3], turn, joint_names=chain.joint_names, file=str(file)
    )
    motion = Motion(log)
    cell, clock, notes = begin(chain, motion, stream, points)
    known = np.flatnonzero(motion.knows(clock.controller(stream.t)))
    some = known[np.unique(np.linspace(0, len(known) - 1, FITTED).astype(int))]
    cell, clock = fitted(cell, motion, stream, points, some, clock)
    kept, left, said = _usable(cell, motion, stream, points, clock)
    tau, sigma = max(inflation(row) for row in left), robust.spread(left[:3])
    chosen = _thinned(motion, clock, stream.t[kept], stream.step * (1.0 + 1.5 * (tau - 1.0)))
    lines = [*log.lines(), *stream.lines()]
    scatter = f"residuals of {1e3 * sigma:.2g} mm per axis are correlated over {tau * stream.step:.2g} s"
    if len(chosen) < MIN_ROWS:
        advice = "did a clock jump, or instrument or target move? Else measure for longer, over more of the workspace"
        refuse_data(file, f"only {len(chosen)} rows are independent, since {scatter}: {advice} ({'; '.join(lines)})")
    rows, rest = kept[chosen], max(float(autocorrelation(row, 1)[0]) for row in left[:, chosen])
    _, clock = fitted(cell, motion, stream, points, rows, clock, loss="none")
    ways = np.linalg.norm(np.diff(stream.values[kept, :3], axis=0), axis=1) / np.diff(stream.t[kept])
    late = clock.sigma * float(np.sqrt(np.mean(ways**2)))
    words = (
        f"the offset of its clock is known to {1e3 * clock.sigma:.2g} ms only, in which the target moves by "
        f"{1e3 * late:.2g} mm (noise {1e3 * sigma:.2g} mm): measure for longer, each way forth and back"
    )
    require(late < sigma, words, MeasurementError, file)
    thinned = (
        f"{len(rows)} rows are taken, of {len(kept)} in steps of {stream.step:.2g} s: {scatter}, so that {tau:.3g} "
        f"steps count as one and σ from all would be {np.sqrt(tau):.2g} times too small; neighbours taken are "
        f"correlated by {rest:.2f}"
    )
    table = _table(chain, motion.at(clock.controller(stream.t[rows])), stream, rows)
    notes = (*lines, *notes, str(clock), *said, thinned)
    return Streamed(table, stream.rows[rows] - 1, notes, clock, sigma, tau * stream.step, float(np.sqrt(tau)), rest)


def _usable(
    cell: Installation, motion: Motion, stream: Stream, points: Positions, clock: Clock
) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Return the indices of usable rows, their residuals (3 or 6, m), and notes; count in the stream what is not."""
    kept = np.flatnonzero(motion.knows(clock.controller(stream.t)))
    left = residuals(cell, motion, stream, points, kept, clock)
    near = (np.abs(left) < OUTLIER * np.array([[robust.spread(row)] for row in left])).all(axis=0)
    slow, said = _slow(points.position[kept[near]], stream.t[kept[near]], left[:3, near])
    stream.dropped["outside the log or in its gaps"] = len(stream.t) - len(kept)
    stream.dropped["far from the arm's path"] = int((~near).sum())
    stream.dropped["too fast"] = int((~slow).sum())
    return kept[near][slow], left[:, near][:, slow], said


def _joints(chain: Chain) -> Kind:
    """Return how a log's joints are read."""
    robot = joints_of(chain)
    travel = max_travel(robot.kinds)
    low, high = (np.where(np.isfinite(own), own, side * travel) for own, side in ((robot.lower, -1), (robot.upper, 1)))

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
        found = Sheet(table).family(POSITION.names)
        require(found, f"has no x, y, z; found {', '.join(table.header)}", MeasurementError, table.file)
        return (*found, *Sheet(table).family(QUATERNION.names))

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


def _slow(position: np.ndarray, t: np.ndarray, left: np.ndarray) -> tuple[np.ndarray, list[str]]:
    """Return which rows (m,) are slow enough for the uncertainty of their times, and a note where some are not.

    Residuals (3, m) have the variance σ² across the motion, and σ² + v² σ_t² along it.
    """
    velocity = np.gradient(position, t, axis=0).T
    speed = np.linalg.norm(velocity, axis=0)
    along = (left * velocity).sum(axis=0) / np.maximum(speed, 1e-9)
    across = ((left**2).sum(axis=0) - along**2) / 2.0
    late = np.sqrt(max(float(np.sum(speed**2 * (along**2 - across)) / np.sum(speed**4)), 0.0))
    sigma = float(np.sqrt(across.mean()))
    slow = speed * late <= sigma
    words = (
        f"faster than {1e3 * sigma / max(late, 1e-12):.3g} mm/s, left out: times are uncertain by {1e3 * late:.2g} ms, "
        f"which costs more there than the noise of {1e3 * sigma:.2g} mm"
    )
    return slow, [] if slow.all() else [words]


def _thinned(motion: Motion, clock: Clock, t: np.ndarray, apart: float) -> np.ndarray:
    """Return the indices of times t (m,) that are at least `apart` [s], and between which a joint moves."""
    apart = max(0.999 * apart, (t[-1] - t[0]) / MAX_ROWS)
    found, after, q, ahead = [0], 0, motion.at(clock.controller(t)), 64
    while (after := max(after, int(np.searchsorted(t, t[found[-1]] + apart)))) < len(t):
        moved = np.flatnonzero(np.abs(q[after : after + ahead] - q[found[-1]]).max(axis=1) > MOVED)
        found += (after + moved[:1]).tolist()
        after += 0 if len(moved) else ahead
    return np.array(found)


def _table(chain: Chain, q: np.ndarray, stream: Stream, rows: np.ndarray) -> Table:
    """Return rows of a stream with their joints q (m, n) as a table of measured poses."""
    units = [JOINT["prismatic" if kind == "prismatic" else "revolute"] for kind in joint_kinds(chain)]
    turn = QUATERNION.names if stream.values.shape[1] > 3 else ()
    header = ("time", *chain.joint_names, *POSITION.names, *turn)
    cells = (stream.t[rows], *(q * [factor for factor, _ in units]).T, *(1e3 * stream.values[rows, :3]).T)
    cells += tuple(stream.values[rows, 3:].T)
    named = ("s", *(unit for _, unit in units), *("mm",) * 3, *("",) * len(turn))
    return Table(stream.file, header, named, cells, stream.rows[rows])
