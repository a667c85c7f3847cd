"""A measuring run: poses in the fastest order, collision-free paths between them, and the duration.

Moves are straight in joint space, as a controller's joint moves are, held against the arm, the floor and obstacles at
places so dense that no point of the arm goes further than the clearance between two of them. Where a straight move does
not keep clear, via-points lead around; the arm is taken to stop at each.

The file of a run has a row per stop, in time order::

    t [s], pose, joint1 [deg], …     pose: number of the pose in its list, counted from 1; 0 for a via-point

Where no clear way leads to a pose, a candidate takes its place that one leads to. The same pose on another turn of its
joints comes first. Of the candidates the one is taken that leaves most of the criterion among those that a straight
move reaches, or, where there are none, among the best few by via-points.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import pairwise, product
from pathlib import Path
from typing import Any

import numpy as np

from calib import files
from calib.data.poses.pose_lists import joint_columns
from calib.poses.by_index import merits
from calib.poses.indices import Index, observability
from calib.poses.information import log_det
from calib.procedure.measuring import DEFAULT_RUN, RunSettings
from calib.robot.chain import Chain
from calib.trajectories.tour import move_times, tour
from calib.trajectories.ways import Room, way

# full speed of a joint whose limit nobody knows [rad/s, m/s]; our choice
LEISURE = {"revolute": 1.0, "prismatic": 0.25}
RISE = 2.0  # acceleration [1/s] times the speed: half a second to get there; our choice
BLOCKED = 3.0  # times that a straight move which does not keep clear is taken to last; our choice
PLACES = 8  # of a straight move that are looked at to guess whether it keeps clear
# orders tried, and random places per way in them and in the last; our choice
ROUNDS, WAY_TRIES, LAST_WAY_TRIES = 4, 250, 1000
# turns of a pose, and poses to come from, that are tried to tell whether there is any way; our choice
MAX_NEIGHBOURS = 8
MIN_STEP = 0.01  # of a joint's range that the search for a way goes at once, however slow the joint is; our choice
FORBIDDEN = 1e4  # [s] a move for which no way was found
Progress = Callable[[str], None]
Ways = dict[tuple[int, int], np.ndarray]  # by the numbers of two poses, the smaller one first


@dataclass(frozen=True, eq=False)
class Run:
    """A run through m poses: order, paths between poses, and times.

    Attributes:
        order: (m,) the poses' numbers in the order they are visited.
        ways: m - 1 ways (k, n) from one to the next, both included [rad or m].
        times: (m - 1,) how long each lasts [s].
        dwell: at each pose [s].
        found: duration in the order the poses came in, by straight moves, clear or not [s].
        around: how many ways lead around something.
        blocked: numbers of the ways for which no clear one was found; they are straight.
    """

    order: np.ndarray
    ways: tuple[np.ndarray, ...]
    times: np.ndarray
    dwell: float
    found: float
    around: int
    blocked: tuple[int, ...]

    @property
    def found_ways(self) -> Ways:
        """The collision-free paths, keyed by the input numbers of start and end pose."""
        pairs = enumerate(pairwise(self.order))
        return {
            _pair(one, two): self.ways[k] if one < two else self.ways[k][::-1]
            for k, (one, two) in pairs
            if k not in self.blocked
        }

    @property
    def cut_off(self) -> tuple[int, ...]:
        """Indices of the poses (in input order) without a clear path from the largest connected group."""
        parts = np.split(self.order, np.array(self.blocked, dtype=int) + 1)
        most = max(parts, key=len)
        return tuple(sorted(int(k) for part in parts if part is not most for k in part))

    @property
    def seconds(self) -> float:
        """The run's duration [s]."""
        return float(self.times.sum()) + self.dwell * len(self.order)


def plan_run(
    chain: Chain,
    q: np.ndarray,
    limits: Any,
    settings: RunSettings = DEFAULT_RUN,
    seed: int = 0,
    progress: Progress | None = None,
    found: Ways | None = None,
) -> Run:
    """Return the run through poses q (m, n) [rad or m]: their order, and the paths between them.

    Where an order is left with a pair that no clear way was found for, the ways found so far serve: from one pose to
    another by way of third ones.

    Args:
        chain: the arm, for its speeds.
        limits: with lower, upper, collision and clearance (`calib.procedure.measuring.pose_limits.Limits`).
        settings: speed and dwell.
        seed: of the search for ways around.
        progress: called with a few words now and then.
        found: clear ways that are known already, see `Run.found_ways`; those between other places are left out.
    """
    say, (velocity, acceleration) = progress or (lambda words: None), _speeds(chain, settings.speed)
    seconds = partial(move_times, velocity=velocity, acceleration=acceleration)
    room = _room(chain, limits, velocity)
    say("checking moves for collisions")
    cost = np.where(_clear_at_places(room, q), 1.0, BLOCKED) * seconds(q[:, None], q)
    known = dict[tuple[int, int], np.ndarray | None]()
    for (one, two), own in (found or {}).items():
        if np.array_equal(own[[0, -1]], q[[one, two]]):
            known[one, two] = own
            cost[one, two] = cost[two, one] = seconds(own[:-1], own[1:]).sum()
    for tries in (*[WAY_TRIES] * ROUNDS, LAST_WAY_TRIES):
        order = tour(cost)
        fresh = [pair for pair in map(_pair, order[:-1], order[1:]) if known.get(pair) is None]
        for number, (one, two) in enumerate(fresh, 1):
            say(f"path {number} of {len(fresh)}")
            own = way(room, q[one], q[two], seed=seed + number, most=tries)
            known[one, two] = own
            cost[one, two] = cost[two, one] = FORBIDDEN if own is None else seconds(own[:-1], own[1:]).sum()
        if all(known[_pair(*pair)] is not None for pair in pairwise(order)):
            break
    else:
        order, through = _joined({pair: own for pair, own in known.items() if own is not None}, cost)
        known = dict.fromkeys(known) | through
    ways, blocked = [], []
    for number, (one, two) in enumerate(pairwise(order)):
        own = known.get(_pair(one, two))
        if own is None:
            blocked.append(number)
        ways.append(q[[one, two]] if own is None else own if one < two else own[::-1])
    times = np.array([seconds(each[:-1], each[1:]).sum() for each in ways])
    before = float(seconds(q[:-1], q[1:]).sum()) + settings.dwell * len(q)
    return Run(order, tuple(ways), times, settings.dwell, before, sum(len(w) > 2 for w in ways), tuple(blocked))


def same_turn(chain: Chain, q: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Return the poses (m, n) with each revolute joint within one turn, cut in the largest gap between its angles.

    A joint with more than one turn can stand everywhere on two; the cut is the middle of the largest gap between the
    poses' angles (where there is one of more than 30 degrees, else half a turn from the middle of the range), so that
    moves between them need not go the long way round.
    """
    result, full = q.copy(), 2 * np.pi
    for j, joint in enumerate(chain.joints):
        if joint.kind != "revolute" or upper[j] - lower[j] <= full:
            continue
        middle, angles = (lower[j] + upper[j]) / 2, np.sort(np.mod(q[:, j], full))
        gaps = np.diff(np.append(angles, angles[0] + full))
        k = int(gaps.argmax())
        cut = angles[k] + gaps[k] / 2 if gaps[k] > np.radians(30.0) else middle - np.pi
        cut += full * np.round((middle - np.pi - cut) / full)
        moved = cut + np.mod(q[:, j] - cut, full)
        result[:, j] = np.where((moved >= lower[j]) & (moved <= upper[j]), moved, q[:, j])
    return result


def _joined(clear: Ways, cost: np.ndarray) -> tuple[np.ndarray, Ways]:
    """Return the fastest order, in which moves may pass through other poses, and the paths between the poses."""
    direct = np.full(cost.shape, np.inf)
    for one, two in clear:
        direct[one, two] = direct[two, one] = cost[one, two]
    from scipy.sparse.csgraph import shortest_path  # slow to load

    total, before = shortest_path(direct, directed=False, return_predecessors=True)
    order, ways = tour(np.where(np.isfinite(total), total, FORBIDDEN)), Ways()
    for one, two in (_pair(*pair) for pair in pairwise(order)):
        if not np.isfinite(total[one, two]):
            continue
        stops = [two]
        while stops[-1] != one:
            stops.append(int(before[one, stops[-1]]))
        legs = [clear[_pair(*leg)][:: 1 if leg[0] < leg[1] else -1] for leg in pairwise(stops[::-1])]
        ways[one, two] = np.concatenate([legs[0][:1], *(leg[1:] for leg in legs)])
    return order, ways


def turns(chain: Chain, q: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Return the postures (k, n) within limits that differ from q (n,) by whole turns of revolute joints."""
    values = []
    for j, joint in enumerate(chain.joints):
        other = q[j] + 2 * np.pi * np.arange(-3, 4) if joint.kind == "revolute" else q[j : j + 1]
        values.append(other[(other >= lower[j]) & (other <= upper[j])])
    return np.array(list(product(*values)))


def way_to(
    chain: Chain,
    limits: Any,
    settings: RunSettings,
    postures: np.ndarray,
    others: np.ndarray,
    *,
    straight: bool,
    seed: int = 0,
) -> tuple[int, np.ndarray] | None:
    """Return a clear path (k, n) from one of m poses to one of p postures, and the start's index; None: not found.

    The moves of least time are tried, for each of the `MAX_NEIGHBOURS` nearest postures: straight ones from the
    `MAX_NEIGHBOURS` nearest of the others, or with via-points from the nearest.
    """
    velocity, acceleration = _speeds(chain, settings.speed)
    room, times = _room(chain, limits, velocity), move_times(postures[:, None], others, velocity, acceleration)
    for end in np.argsort(times.min(axis=1))[:MAX_NEIGHBOURS]:
        for start in np.argsort(times[end])[: MAX_NEIGHBOURS if straight else 1]:
            own = way(room, others[start], postures[end], seed=seed, most=0 if straight else WAY_TRIES)
            if own is not None:
                return int(start), own
    return None


def _pair(one: int, two: int) -> tuple[int, int]:
    return (int(min(one, two)), int(max(one, two)))


def _clear_at_places(room: Room, q: np.ndarray) -> np.ndarray:
    """Return (m, m) flags: straight moves clear at `PLACES` places (an estimate, used to order the poses)."""
    one, two = np.triu_indices(len(q), 1)
    share = ((np.arange(PLACES) + 0.5) / PLACES)[:, None, None]
    places = q[one] + share * (q[two] - q[one])
    good = np.concatenate([room.clear(block) for block in np.array_split(places.reshape(-1, q.shape[1]), 16)])
    clear = np.ones((len(q), len(q)), dtype=bool)
    clear[one, two] = clear[two, one] = good.reshape(PLACES, -1).all(axis=0)
    return clear


def lines(run: Run, settings: RunSettings) -> list[str]:
    """Return the lines on a run: duration, paths around obstacles, and poses without a clear path."""
    minutes, before = run.seconds / 60, run.found / 60
    found = [
        f"run: {len(run.order)} poses in {minutes:.1f} min at {settings.speed:.0%} of the joints' speed, "
        f"{settings.dwell:g} s at each pose ({before:.1f} min in their original order with straight moves)"
    ]
    if run.around:
        found.append(f"{run.around} of {len(run.ways)} paths lead around an obstacle: also drive their via-points")
    if run.blocked:
        pairs = ", ".join(f"{k + 1} to {k + 2}" for k in run.blocked)
        found.append(f"NO clear path was found from pose {pairs}: drive there by hand, or omit the pose")
    return found


def write_run(path: Path, run: Run, chain: Chain) -> Path:
    """Write the file of a run (format: see the module), its poses numbered in visiting order."""
    header, factors = joint_columns(chain.joint_names, [joint.kind for joint in chain.joints])
    velocity, acceleration = _speeds(chain, 1.0)
    rows, clock = [], 0.0
    for k in range(len(run.order)):
        if k:
            own = run.ways[k - 1]
            parts = move_times(own[:-1], own[1:], velocity, acceleration)
            parts = parts * (run.times[k - 1] / parts.sum())
            for place, spent in zip(own[1:-1], parts[:-1]):
                clock += float(spent)
                rows.append([round(clock, 3), 0, *(place * factors)])
            clock += float(parts[-1])
        place = run.ways[k][0] if k < len(run.ways) else run.ways[-1][-1]
        rows.append([round(clock, 3), k + 1, *(place * factors)])
        clock += run.dwell
        rows.append([round(clock, 3), k + 1, *(place * factors)])
    return files.write_table(path, ["t [s]", "pose", *header], rows)


def _speeds(chain: Chain, share: float) -> tuple[np.ndarray, np.ndarray]:
    limits = [j.velocity if np.isfinite(j.velocity) else LEISURE[j.kind] for j in chain.joints]
    velocity = share * np.array(limits)
    return velocity, RISE * velocity


def _room(chain: Chain, limits: Any, velocity: np.ndarray) -> Room:
    """Return the collision test of paths: it requires half the clearance at places at most one clearance apart."""
    model, clearance = limits.collision, limits.clearance
    reach = np.array([chain.stretched_length() if joint.kind == "revolute" else 1.0 for joint in chain.joints])

    def clear(q: np.ndarray) -> np.ndarray:
        return np.ones(len(q), dtype=bool) if model is None else model.free(q, 0.5 * clearance)

    unit = np.maximum(velocity, MIN_STEP * (limits.upper - limits.lower))
    return Room(limits.lower, limits.upper, clear, max(clearance, 1e-3) / reach, unit)


EXCHANGES = 3  # times that poses are replaced, and the run is planned again (our choice)
# candidates tried in the place of one pose, by straight moves, by via-points (our choice)
MAX_STRAIGHT_TRIES, MAX_VIA_TRIES = 200, 4


@dataclass(frozen=True, eq=False)
class Exchange:
    """Candidate poses that may replace unreachable ones, and the observability index that ranks the candidates.

    Attributes:
        jacobian: q (m, n) -> whitened observation Jacobians (m, rows, p).
        candidates: (N, n) feasible poses [rad or m].
        before: (k, rows, p) of poses measured before; None without them.
        index: that counts.
    """

    jacobian: Callable[[np.ndarray], np.ndarray]
    candidates: np.ndarray
    before: np.ndarray | None
    index: Index

    def value(self, q: np.ndarray) -> tuple[float, float]:
        """Return the index, and log det(WᵀW) / p, of poses (m, n) together with the poses measured before."""
        rows = self._rows(q)
        flat = rows.reshape(-1, rows.shape[2])
        return observability(rows, self.index), float(log_det(flat.T @ flat)) / rows.shape[2]

    def ranked(self, q: np.ndarray) -> np.ndarray:
        """Return the candidates' numbers (N,), best first, by the index of each together with poses (m, n)."""
        rows = self._rows(q)
        flat = rows.reshape(-1, rows.shape[2])
        matrices = flat.T @ flat + self._alone
        values = log_det(matrices) if self.index == "O1" else merits(matrices, self.index)
        return np.argsort(-values, kind="stable")

    @cached_property
    def _alone(self) -> np.ndarray:
        """Information matrices (N, p, p) of the candidates."""
        trials = self.jacobian(self.candidates)
        return trials.transpose(0, 2, 1) @ trials

    def _rows(self, q: np.ndarray) -> np.ndarray:
        rows = np.asarray(self.jacobian(q))
        return rows if self.before is None else np.concatenate([rows, self.before])


@dataclass(frozen=True, eq=False)
class Drivable:
    """Reachable poses, and the run through them.

    Attributes:
        q: (m, n) in the order they came, each revolute joint on the turn it is driven on [rad or m].
        run: through them.
        replaced: places in the list -> candidate that stands there, since no clear way led to what stood there.
        value: the index before and after.
        gain: in log det(WᵀW) / p.
    """

    q: np.ndarray
    run: Run
    replaced: Mapping[int, int]
    value: tuple[float, float]
    gain: float

    @property
    def words(self) -> str:
        """Sentence on the replaced poses, numbered from 1 in the order of the run; "" without replacements."""
        if not self.replaced:
            return ""
        numbers = ", ".join(f"{k}" for k, place in enumerate(self.run.order, 1) if place in self.replaced)
        poses = f"pose{'s' if len(self.replaced) > 1 else ''} {numbers}"
        before, after = self.value
        return f"{poses} replaced, since no clear path led to the original (index {before:.5g} → {after:.5g})"


def drivable(
    chain: Chain,
    q: np.ndarray,
    exchange: Exchange,
    limits: Any,
    settings: RunSettings,
    seed: int = 0,
    progress: Progress | None = None,
) -> Drivable:
    """Return the run through poses q (m, n), in which poses without a clear path are replaced by candidates.

    Args:
        chain, limits, settings, seed, progress: see `calib.procedure.measuring.run.plan_run`.
        exchange: what poses are replaced from.
    """
    say, replaced, ways = progress or (lambda words: None), dict[int, int](), Ways()
    first = q = same_turn(chain, q, limits.lower, limits.upper)
    for last in (*[False] * EXCHANGES, True):
        run = plan_run(chain, q, limits, settings, seed, say, ways)
        if last or not run.cut_off:
            break
        say(f"{len(run.cut_off)} poses without a clear path")
        q, fresh, ways = _rejoined(chain, q, run, exchange, limits, settings, seed)
        replaced |= fresh
    (before, log_before), (after, log_after) = exchange.value(first), exchange.value(q)
    return Drivable(q, run, replaced, (before, after), log_after - log_before)


def _rejoined(
    chain: Chain, q: np.ndarray, run: Run, exchange: Exchange, limits: Any, settings: RunSettings, seed: int
) -> tuple[np.ndarray, dict[int, int], Ways]:
    """Return the poses (m, n) with unreachable ones replaced, the replacements (place -> candidate), and all paths."""
    q, found, ways = q.copy(), dict[int, int](), run.found_ways
    joined = [k for k in range(len(q)) if k not in run.cut_off]
    for place in run.cut_off:
        apart = np.abs(q - exchange.candidates[:, None]).max(axis=2).min(axis=1)
        ranked = [int(k) for k in exchange.ranked(np.delete(q, place, axis=0)) if apart[k] > 1e-9]
        itself = [(None, straight) for straight in (True, False)]
        others = [(k, True) for k in ranked[:MAX_STRAIGHT_TRIES]] + [(k, False) for k in ranked[:MAX_VIA_TRIES]]
        for number, straight in itself + others:
            trial = q[place] if number is None else exchange.candidates[number]
            postures = turns(chain, trial, limits.lower, limits.upper)
            own = way_to(chain, limits, settings, postures, q[joined], straight=straight, seed=seed)
            if own is not None:
                start, path = joined[own[0]], own[1]
                q[place] = path[-1]
                ways[min(start, place), max(start, place)] = path if start < place else path[::-1]
                found |= {} if number is None else {place: number}
                joined.append(place)
                break
    return q, found, ways
