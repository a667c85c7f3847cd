"""A measuring run: poses in the fastest order, collision-free paths between them, and the duration.

Moves are straight in joint space, like a controller's joint moves. Each move is sampled so densely that no point of the
arm moves further than the clearance between two samples; each sample is checked for collisions with the arm itself, the
floor and obstacles. If a straight move collides, a path through via-points replaces it; the arm is assumed to stop at
each via-point.

The file of a run has one row per stop, in time order::

    t [s], pose, joint1 [deg], …  pose: number of the pose in its list, counted from 1; 0 for a via-point

If no collision-free path leads to a pose, a reachable candidate replaces it. First, the same pose with joints turned by
360° is tried. Then the candidates are tried in the order of their observability index, best first: a larger number by
straight moves, and if none is reached, the best few by moves with via-points.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import pairwise, product
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import numpy as np

from calib import files
from calib.data.poses.pose_lists import joint_columns
from calib.poses.by_index import merits
from calib.poses.indices import Index, observability
from calib.poses.scaled_jacobians import log_det
from calib.procedure.measuring import DEFAULT_RUN, RunSettings
from calib.robot.chain import Chain
from calib.trajectories.tour import move_times, tour
from calib.trajectories.ways import Room, way

if TYPE_CHECKING:
    from calib.robot.collision import DistanceModel

Progress = Callable[[str], None]
# by the numbers of two poses, the smaller one first
Ways = dict[tuple[int, int], np.ndarray]

# full speed of a joint whose limit nobody knows [rad/s, m/s] (our choice)
LEISURE = {"revolute": 1.0, "prismatic": 0.25}
# [1/s] acceleration over the speed: half a second to get there (our choice)
RISE = 2.0
# times that a straight move which does not keep clear is taken to last (our choice)
BLOCKED = 3.0
# postures of a straight move at which is guessed whether it keeps clear
PLACES = 8
# orders tried, and random postures per way in them and in the last (our choice)
ROUNDS = 4
WAY_TRIES = 250
LAST_WAY_TRIES = 1000
# turns of a pose, and poses to come from, that are tried to tell whether there is any way (our choice)
MAX_NEIGHBOURS = 8
# of a joint's range that the search for a way goes at once, however slow the joint is (our choice)
MIN_STEP = 0.01
# [rad] a gap between angles in which the range of a joint may be cut
MIN_GAP = np.radians(30.0)
# turns of a joint to either side that are considered
MAX_TURNS = 3
# [s] a move for which no way was found
FORBIDDEN = 1e4
# parts in which places are checked for collisions, for memory
CLEARANCE_BLOCKS = 16
# times that poses are replaced, and the run is planned again (our choice)
EXCHANGES = 3
# candidates tried in the place of one pose, by straight moves, by via-points (our choice)
MAX_STRAIGHT_TRIES = 200
MAX_VIA_TRIES = 4
# [rad or m] a candidate that differs by less from a pose of the list is that pose
SAME_POSE = 1e-9


class MoveLimits(Protocol):
    """Limits that moves must respect; `calib.procedure.measuring.pose_limits.Limits` implements this protocol."""

    @property
    def lower(self) -> np.ndarray:
        """Lower joint limits (n,) [rad or m]."""
        ...

    @property
    def upper(self) -> np.ndarray:
        """Upper joint limits (n,) [rad or m]."""
        ...

    @property
    def collision(self) -> DistanceModel | None:
        """Collision model; None: collisions are not checked."""
        ...

    @property
    def clearance(self) -> float:
        """Smallest allowed distance between links, and from obstacles [m]."""
        ...


def _silent(stage: str) -> None:
    """Ignore a progress text, `stage`."""


@dataclass(frozen=True, eq=False)
class MeasuringRun:
    """A run through m poses: order, paths between poses, and durations.

    Attributes:
        order: (m,) indices of the poses in the order in which they are visited.
        ways: m - 1 paths (k, n) from each pose to the next, with start and end pose included [rad or m].
        times: (m - 1,) duration of each path [s].
        dwell: time at each pose [s].
        found: duration of a run in the input order of the poses with straight moves, collisions ignored [s].
        around: number of paths with via-points.
        blocked: indices of the paths that are straight because no collision-free path was found.
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
        """The collision-free paths: indices of two poses, the smaller one first -> path between these poses.

        The path leads from the pose with the smaller index to the other pose.
        """
        clear_ways = {}
        for k, (start, end) in enumerate(pairwise(self.order)):
            if k in self.blocked:
                continue
            path = self.ways[k]
            clear_ways[_pair(start, end)] = path if start < end else path[::-1]
        return clear_ways

    @property
    def cut_off(self) -> tuple[int, ...]:
        """Input indices of the poses that no collision-free path connects to the largest group of connected poses."""
        groups = np.split(self.order, np.array(self.blocked, dtype=int) + 1)
        largest = max(groups, key=len)
        separate: list[int] = []
        for group in groups:
            if group is not largest:
                separate += group.tolist()
        return tuple(sorted(separate))

    @property
    def seconds(self) -> float:
        """Duration of the run: paths and dwell times [s]."""
        return float(self.times.sum()) + self.dwell * len(self.order)


def plan_run(
    chain: Chain,
    q: np.ndarray,
    limits: MoveLimits,
    settings: RunSettings = DEFAULT_RUN,
    seed: int = 0,
    progress: Progress | None = None,
    clear: Ways | None = None,
) -> MeasuringRun:
    """Return the run through poses q (m, n) [rad or m]: the order of the poses and the paths between them.

    If no collision-free path is found between consecutive poses, the path leads through other poses of the list.

    Args:
        chain: the arm, whose joint speeds determine the durations.
        q: the poses.
        limits: joint limits, collision model and clearance (`calib.procedure.measuring.pose_limits.Limits`).
        settings: speed and dwell time.
        seed: seed of the search for via-points.
        progress: called with a text on the progress; None: silent.
        clear: collision-free paths of an earlier run (`MeasuringRun.found_ways`); a path whose ends differ from the
            poses with these indices is ignored; None: no known paths.
    """
    show = progress or _silent
    velocity, acceleration = _speeds(chain, settings.speed)
    seconds = partial(move_times, velocity=velocity, acceleration=acceleration)
    room = _room(chain, limits, velocity)

    def duration(path: np.ndarray) -> float:
        return seconds(path[:-1], path[1:]).sum()

    show("checking moves for collisions")
    cost = np.where(_clear_at_places(room, q), 1.0, BLOCKED) * seconds(q[:, None], q)
    # a pair of poses -> its clear way; None where none was found
    clear_ways_of: dict[tuple[int, int], np.ndarray | None] = {}

    def enter(pair: tuple[int, int], path: np.ndarray | None) -> None:
        clear_ways_of[pair] = path
        cost[pair] = cost[pair[::-1]] = FORBIDDEN if path is None else duration(path)

    for (start, end), path in (clear or {}).items():
        if np.array_equal(path[[0, -1]], q[[start, end]]):
            enter((start, end), path)
    for tries in (*[WAY_TRIES] * ROUNDS, LAST_WAY_TRIES):
        order = tour(cost)
        pairs = [_pair(start, end) for start, end in pairwise(order)]
        searched = [pair for pair in pairs if clear_ways_of.get(pair) is None]
        for number, (start, end) in enumerate(searched, 1):
            show(f"path {number} of {len(searched)}")
            enter((start, end), way(room, q[start], q[end], seed=seed + number, most=tries))
        if all(clear_ways_of[pair] is not None for pair in pairs):
            break
    else:
        # no order has clear ways alone: go by way of third poses
        clear_ways = {pair: path for pair, path in clear_ways_of.items() if path is not None}
        order, joined_ways = _joined(clear_ways, cost)
        clear_ways_of = dict.fromkeys(clear_ways_of) | joined_ways

    paths: list[np.ndarray] = []
    blocked = []
    around = 0
    for number, (start, end) in enumerate(pairwise(order)):
        path = clear_ways_of.get(_pair(start, end))
        if path is None:
            blocked.append(number)
            path = q[[start, end]]
        elif start > end:
            path = path[::-1]
        paths.append(path)
        if len(path) > 2:
            around += 1
    return MeasuringRun(
        order=order,
        ways=tuple(paths),
        times=np.array([duration(path) for path in paths]),
        dwell=settings.dwell,
        found=float(duration(q)) + settings.dwell * len(q),
        around=around,
        blocked=tuple(blocked),
    )


def same_turn(chain: Chain, q: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Return the poses (m, n) with each revolute joint's angles moved by whole turns into one interval of 360°.

    Joints with a range of up to 360° are not changed. Other joints reach some angles at several joint values. To keep
    moves short, the interval begins in the middle of the largest gap between the poses' angles if this gap exceeds 30°;
    otherwise half a turn below the middle of the joint's range. An angle that would leave the joint limits remains
    unchanged.

    Args:
        chain: the arm.
        q: the poses [rad or m].
        lower, upper: (n,) joint limits [rad or m].
    """
    full = 2 * np.pi
    result = q.copy()
    for j, joint in enumerate(chain.joints):
        if joint.kind != "revolute" or upper[j] - lower[j] <= full:
            continue
        middle = (lower[j] + upper[j]) / 2
        angles = np.sort(np.mod(q[:, j], full))
        gaps = np.diff(np.append(angles, angles[0] + full))
        k = int(gaps.argmax())
        cut = middle - np.pi
        if gaps[k] > MIN_GAP:
            cut = angles[k] + gaps[k] / 2
        cut += full * np.round((middle - np.pi - cut) / full)
        turned = cut + np.mod(q[:, j] - cut, full)
        within = (turned >= lower[j]) & (turned <= upper[j])
        result[:, j] = np.where(within, turned, q[:, j])
    return result


def _joined(clear: Ways, cost: np.ndarray) -> tuple[np.ndarray, Ways]:
    """Return the fastest order of the poses and the paths between consecutive poses.

    A path may lead through other poses.

    Args:
        clear: collision-free paths: indices of two poses -> path between them.
        cost: (m, m) durations of the moves between the poses [s].
    """
    from scipy.sparse.csgraph import shortest_path  # slow to load

    direct = np.full(cost.shape, np.inf)
    for start, end in clear:
        direct[start, end] = direct[end, start] = cost[start, end]
    total, before = shortest_path(direct, directed=False, return_predecessors=True)
    order = tour(np.where(np.isfinite(total), total, FORBIDDEN))
    joined_ways: Ways = {}
    for start, end in (_pair(*pair) for pair in pairwise(order)):
        if not np.isfinite(total[start, end]):
            continue
        # from the end back to the start
        stops = [end]
        while stops[-1] != start:
            stops.append(int(before[start, stops[-1]]))
        stops.reverse()
        path = []
        for leg_start, leg_end in pairwise(stops):
            leg = clear[_pair(leg_start, leg_end)]
            if leg_start > leg_end:
                leg = leg[::-1]
            path.append(leg if not path else leg[1:])
        joined_ways[start, end] = np.concatenate(path)
    return order, joined_ways


def turns(chain: Chain, q: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Return all postures (k, n) within joint limits that differ from q (n,) by whole turns of revolute joints.

    Args:
        chain: the arm.
        q: the posture [rad or m].
        lower, upper: (n,) joint limits [rad or m].
    """
    values = []
    for j, joint in enumerate(chain.joints):
        positions = q[j : j + 1]
        if joint.kind == "revolute":
            positions = q[j] + 2 * np.pi * np.arange(-MAX_TURNS, MAX_TURNS + 1)
        values.append(positions[(positions >= lower[j]) & (positions <= upper[j])])
    return np.array(list(product(*values)))


def way_to(
    chain: Chain,
    limits: MoveLimits,
    settings: RunSettings,
    postures: np.ndarray,
    starts: np.ndarray,
    *,
    straight: bool,
    seed: int = 0,
) -> tuple[int, np.ndarray] | None:
    """Return the index of a start posture and a collision-free path (k, n) from it to one of the goal postures.

    The goals nearest to a start are tried in the order of move duration, at most `MAX_NEIGHBOURS` of them. For each
    goal, straight moves from the `MAX_NEIGHBOURS` nearest starts are tried or, without `straight`, moves with
    via-points from the nearest start. None: no collision-free path was found.

    Args:
        chain: the arm.
        limits: joint limits, collision model and clearance.
        settings: speed of the moves.
        postures: (p, n) goal postures [rad or m].
        starts: (m, n) start postures [rad or m].
        straight: whether only straight moves are tried.
        seed: seed of the search for via-points.
    """
    velocity, acceleration = _speeds(chain, settings.speed)
    room = _room(chain, limits, velocity)
    times = move_times(postures[:, None], starts, velocity, acceleration)
    start_count, tries = (MAX_NEIGHBOURS, 0) if straight else (1, WAY_TRIES)
    for end in np.argsort(times.min(axis=1))[:MAX_NEIGHBOURS]:
        for start in np.argsort(times[end])[:start_count]:
            path = way(room, starts[start], postures[end], seed=seed, most=tries)
            if path is not None:
                return int(start), path
    return None


def _pair(start: int, end: int) -> tuple[int, int]:
    return (int(min(start, end)), int(max(start, end)))


def _clear_at_places(room: Room, q: np.ndarray) -> np.ndarray:
    """Return (m, m) flags: whether the straight move between two poses is collision-free at `PLACES` samples.

    The flags are an estimate that is used only to order the poses.

    Args:
        room: joint limits and the test for collision.
        q: (m, n) poses [rad or m].
    """
    start, end = np.triu_indices(len(q), 1)
    share = ((np.arange(PLACES) + 0.5) / PLACES)[:, None, None]
    postures = (q[start] + share * (q[end] - q[start])).reshape(-1, q.shape[1])
    free = np.concatenate([room.clear(block) for block in np.array_split(postures, CLEARANCE_BLOCKS)])
    clear = np.ones((len(q), len(q)), dtype=bool)
    clear[start, end] = clear[end, start] = free.reshape(PLACES, -1).all(axis=0)
    return clear


def lines(run: MeasuringRun, settings: RunSettings) -> list[str]:
    """Return lines of text on a run: duration, paths with via-points, and moves without a collision-free path.

    Args:
        run: the run.
        settings: its speed and dwell time.
    """
    minutes, before = run.seconds / 60, run.found / 60
    result = [
        f"run: {len(run.order)} poses in {minutes:.1f} min at {settings.speed:.0%} of the joints' speed, "
        f"{settings.dwell:g} s at each pose ({before:.1f} min in their original order with straight moves)"
    ]
    if run.around:
        result.append(f"{run.around} of {len(run.ways)} paths lead around an obstacle: also drive their via-points")
    if run.blocked:
        pairs = ", ".join(f"{k + 1} to {k + 2}" for k in run.blocked)
        result.append(f"NO clear path was found from pose {pairs}: drive there by hand, or omit the pose")
    return result


def write_run(path: Path, run: MeasuringRun, chain: Chain) -> Path:
    """Write a run as a CSV file with poses numbered in the order of the visits.

    The module's docstring states the columns.

    Args:
        path: path of the file.
        run: the run.
        chain: the arm, which names the joints.

    Returns:
        Path of the file.
    """
    header, factors = joint_columns(chain.joint_names, [joint.kind for joint in chain.joints])
    velocity, acceleration = _speeds(chain, 1.0)
    rows = []
    clock = 0.0

    def add(pose: int, posture: np.ndarray) -> None:
        rows.append([round(clock, 3), pose, *(posture * factors)])

    for k in range(len(run.order)):
        if k:
            # the parts of a way last in proportion to their times at full speed
            way_postures = run.ways[k - 1]
            parts = move_times(way_postures[:-1], way_postures[1:], velocity, acceleration)
            parts = parts * (run.times[k - 1] / parts.sum())
            for via_point, seconds in zip(way_postures[1:-1], parts[:-1]):
                clock += float(seconds)
                add(0, via_point)
            clock += float(parts[-1])
        if k < len(run.ways):
            posture = run.ways[k][0]
        else:
            posture = run.ways[-1][-1]
        add(k + 1, posture)
        clock += run.dwell
        add(k + 1, posture)
    return files.write_table(path, ["t [s]", "pose", *header], rows)


def _speeds(chain: Chain, share: float) -> tuple[np.ndarray, np.ndarray]:
    joints = chain.joints
    speeds = [joint.velocity if np.isfinite(joint.velocity) else LEISURE[joint.kind] for joint in joints]
    velocity = share * np.array(speeds)
    return velocity, RISE * velocity


def _room(chain: Chain, limits: MoveLimits, velocity: np.ndarray) -> Room:
    """Return the collision test of paths.

    A path is free if the distance between parts is at least half the clearance at samples that are at most one
    clearance apart. Without a collision model, every posture is free.

    Args:
        chain: the arm.
        limits: joint limits, collision model and clearance.
        velocity: (n,) joint speeds of the run [rad/s or m/s], by which distances in joint space are measured.
    """
    model, clearance = limits.collision, limits.clearance
    reach = np.array([chain.stretched_length() if joint.kind == "revolute" else 1.0 for joint in chain.joints])

    def clear(q: np.ndarray) -> np.ndarray:
        if model is None:
            return np.ones(len(q), dtype=bool)
        return model.free(q, 0.5 * clearance)

    unit = np.maximum(velocity, MIN_STEP * (limits.upper - limits.lower))
    return Room(limits.lower, limits.upper, clear, max(clearance, 1e-3) / reach, unit)


@dataclass(frozen=True, eq=False)
class Exchange:
    """Candidate poses that may replace unreachable ones, and the observability index that ranks the candidates.

    Attributes:
        jacobian: function q (m, n) -> whitened observation Jacobians (m, rows, p): derivatives of the measured
            quantities by p parameters, divided by the noise.
        candidates: (N, n) feasible poses [rad or m].
        before: (k, rows, p) Jacobians of poses measured earlier; None: no earlier poses.
        index: name of the observability index that ranks the candidates.
    """

    jacobian: Callable[[np.ndarray], np.ndarray]
    candidates: np.ndarray
    before: np.ndarray | None
    index: Index

    def value(self, q: np.ndarray) -> tuple[float, float]:
        """Return the observability index and log det(WᵀW) / p of poses q (m, n) and the poses measured earlier.

        W is the observation matrix that stacks the Jacobians of all these poses, p the number of parameters.
        """
        rows = self._rows(q)
        flat = rows.reshape(-1, rows.shape[2])
        return observability(rows, self.index), float(log_det(flat.T @ flat)) / rows.shape[2]

    def ranked(self, q: np.ndarray) -> np.ndarray:
        """Return the indices (N,) of the candidates, best first.

        A candidate is ranked by the observability index of the poses q (m, n) together with this candidate.
        """
        rows = self._rows(q)
        flat = rows.reshape(-1, rows.shape[2])
        matrices = flat.T @ flat + self._information
        if self.index == "O1":
            values = log_det(matrices)
        else:
            values = merits(matrices, self.index)
        return np.argsort(-values, kind="stable")

    @cached_property
    def _information(self) -> np.ndarray:
        """Information matrices WᵀW (N, p, p) of the candidates, with W the observation Jacobian of one candidate."""
        jacobians = self.jacobian(self.candidates)
        return jacobians.transpose(0, 2, 1) @ jacobians

    def _rows(self, q: np.ndarray) -> np.ndarray:
        rows = np.asarray(self.jacobian(q))
        if self.before is None:
            return rows
        return np.concatenate([rows, self.before])


@dataclass(frozen=True, eq=False)
class Drivable:
    """Reachable poses, and the run through them.

    Attributes:
        q: (m, n) poses in input order [rad or m], with revolute joints at the whole turns that the run uses.
        run: run through the poses.
        replaced: index of a pose that no collision-free path reached -> index of the candidate that replaces it.
        value: observability index before and after the replacements.
        gain: change, by the replacements, of log det(WᵀW) / p, with W the observation matrix of the poses.
    """

    q: np.ndarray
    run: MeasuringRun
    replaced: Mapping[int, int]
    value: tuple[float, float]
    gain: float

    @property
    def words(self) -> str:
        """Sentence for the user on the replaced poses, numbered from 1 in the order of the run.

        Empty without replacements.
        """
        if not self.replaced:
            return ""
        numbers = [f"{k}" for k, index in enumerate(self.run.order, 1) if index in self.replaced]
        noun = "pose"
        if len(self.replaced) > 1:
            noun = "poses"
        before, after = self.value
        return (
            f"{noun} {', '.join(numbers)} replaced, since no clear path led to the original "
            f"(index {before:.5g} → {after:.5g})"
        )


def drivable(
    chain: Chain,
    q: np.ndarray,
    exchange: Exchange,
    limits: MoveLimits,
    settings: RunSettings,
    seed: int = 0,
    progress: Progress | None = None,
) -> Drivable:
    """Return a run through poses q (m, n) in which candidates replace the poses without a collision-free path.

    Args:
        chain, limits, settings, seed, progress: as for `plan_run`.
        q: the poses [rad or m].
        exchange: candidate poses that may replace unreachable ones.
    """
    show = progress or _silent
    replaced: dict[int, int] = {}
    clear_ways: Ways = {}
    original = same_turn(chain, q, limits.lower, limits.upper)
    q = original
    run = plan_run(chain, q, limits, settings, seed, show, clear_ways)
    for _ in range(EXCHANGES):
        if not run.cut_off:
            break
        show(f"{len(run.cut_off)} poses without a clear path")
        q, replacements, clear_ways = _rejoined(chain, q, run, exchange, limits, settings, seed)
        replaced |= replacements
        run = plan_run(chain, q, limits, settings, seed, show, clear_ways)
    value_before, log_before = exchange.value(original)
    value_after, log_after = exchange.value(q)
    return Drivable(q, run, replaced, (value_before, value_after), log_after - log_before)


def _rejoined(
    chain: Chain,
    q: np.ndarray,
    run: MeasuringRun,
    exchange: Exchange,
    limits: MoveLimits,
    settings: RunSettings,
    seed: int,
) -> tuple[np.ndarray, dict[int, int], Ways]:
    """Return poses with unreachable ones replaced, the replacements, and all collision-free paths.

    Args:
        chain, limits, settings, seed: as for `plan_run`.
        q: (m, n) the poses [rad or m].
        run: run through the poses, which leaves out unreachable ones.
        exchange: candidate poses that may replace unreachable ones.

    Returns:
        Poses (m, n) in input order, pose index -> index of the replacing candidate, and paths by pair of pose indices.
    """
    q = q.copy()
    replacements: dict[int, int] = {}
    clear_ways = run.found_ways
    joined = [k for k in range(len(q)) if k not in run.cut_off]
    for index in run.cut_off:
        # the pose itself on another turn, then candidates that are not in the list, best first
        distance = np.abs(q - exchange.candidates[:, None]).max(axis=2).min(axis=1)
        ranked = exchange.ranked(np.delete(q, index, axis=0)).tolist()
        fresh = [candidate for candidate in ranked if distance[candidate] > SAME_POSE]
        trials: list[tuple[int | None, bool]] = [(None, True), (None, False)]
        trials += [(candidate, True) for candidate in fresh[:MAX_STRAIGHT_TRIES]]
        trials += [(candidate, False) for candidate in fresh[:MAX_VIA_TRIES]]
        for candidate, straight in trials:
            posture = q[index]
            if candidate is not None:
                posture = exchange.candidates[candidate]
            postures = turns(chain, posture, limits.lower, limits.upper)
            result = way_to(chain, limits, settings, postures, q[joined], straight=straight, seed=seed)
            if result is None:
                continue
            start, path = joined[result[0]], result[1]
            q[index] = path[-1]
            clear_ways[_pair(start, index)] = path if start < index else path[::-1]
            if candidate is not None:
                replacements[index] = candidate
            joined.append(index)
            break
    return q, replacements, clear_ways
