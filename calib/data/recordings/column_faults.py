"""Columns of a recording that are constant although the measured quantity changes: clipped torques, frozen encoders.

A fault is reported only where columns contradict each other. A value that is repeated exactly is no measurement of a
changing quantity. A joint at rest is no fault, and neither is a torque whose largest values differ.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

MIN_ROWS = 10  # that repeat a value exactly (all below: our choice; open recordings: at most 5 at an extreme torque)
MIN_SHARE = 0.01  # of the rows in motion, at a torque's extremes (open recordings: at most 0.001)
REACH = 5  # rows before and behind, between which a speed is taken
MIN_LEVELS = 20  # values of a torque, below which it is too coarse to tell a clipped one
CROWDED = 5.0  # rows at the extreme over those at each of the values next to it
NEXT_LEVELS = 5  # values that the extreme is compared with
MOVING = 0.05  # of a joint's peak speed, from which on it moves
MIN_SPEED_RANGE = 0.1  # of the peak speed, that clipped rows spread over: at one speed a torque may well be one value
MIN_TRAVEL = 0.02  # between a standing column and the motion beside it [rad]
MAX_WANDER = 5.0  # standard deviations of the sum of a velocity's noise
MIN_STEPS = 3.0  # of a column's own resolution in that
MAX_STANDING = 0.9  # of the rows with one velocity: then it was not logged, which is another finding
JUMP = 5.0  # step behind a standing position over those at the joint's speed
MAX_TARED_MEAN = 1e-3  # of a torque's standard deviation: a mean that is smaller was subtracted
MAX_TARED_START = 0.03  # the same of the mean over the start
TARED_KINDS = ("mean", "start")  # kinds of faults that make torques tared
MIN_TARED = 0.8  # least share of the joints whose torques are zeroed alike
START = 0.1  # time over which the start of a log is averaged [s]
ABOUT = 3.0  # factor between that step and the motion expected meanwhile


@dataclass(frozen=True)
class ColumnFault:
    """A column of one joint that is constant although the measured quantity changes.

    Attributes:
        kind: ``clipped`` (torque), ``mean`` or ``start`` (torque whose mean, or start, is zero), or ``position`` or
            ``velocity`` (constant column).
        joint: index of the joint.
        share: share of the moving rows in which a torque is clipped, or of all rows in which a column is constant.
        values: the extreme values at which a torque is clipped [N m or N; A].
        start, stop: times at which the longest constant part begins and ends [s].
        missed: motion that the column does not show [rad or m].
    """

    kind: str
    joint: int
    share: float
    values: tuple[float, ...] = ()
    start: float = 0.0
    stop: float = 0.0
    missed: float = 0.0


def column_faults(
    t: np.ndarray, q: np.ndarray, effort: np.ndarray, v: np.ndarray | None = None
) -> tuple[ColumnFault, ...]:
    """Return the columns of a recording that are constant although the measured quantity changes; () without any.

    Torques whose mean or start is zero count where those of most joints are.

    Args:
        t: (N,) time stamps as logged [s].
        q: (N, n) positions [rad or m].
        effort: (N, n) torques [N m or N] or currents [A].
        v: (N, n) measured velocities [rad/s or m/s]; None if not recorded.
    """
    faults = []
    for joint, position in enumerate(q.T):
        candidates = [_clipped(joint, t, position, effort[:, joint]), _zeroed(joint, t, effort[:, joint])]
        if v is None:
            candidates.append(_jumping(joint, t, position))
        else:
            candidates.append(_standing_position(joint, t, position, v[:, joint]))
            candidates.append(_standing_velocity(joint, t, position, v[:, joint]))
        faults += filter(None, candidates)
    for kind in TARED_KINDS:
        zeroed = [fault for fault in faults if fault.kind == kind]
        if len(zeroed) < MIN_TARED * q.shape[1]:
            faults = [fault for fault in faults if fault.kind != kind]
    return tuple(faults)


def _clipped(joint: int, t: np.ndarray, q: np.ndarray, torque: np.ndarray) -> ColumnFault | None:
    """Return the fault of a torque that repeats its extreme value exactly while its joint moves; None without it.

    The joint has to move at various speeds, at which friction would change the torque.

    Args:
        joint: index of the joint.
        t: (N,) time stamps [s].
        q: (N, n) positions [rad or m].
        torque: (N,) torque or current of the joint.
    """
    speed = np.abs(_speed(t, q))
    peak = float(speed.max())
    moves = speed > MOVING * peak
    if np.ptp(q) < MIN_TRAVEL or not moves.any():
        return None
    levels, counts = np.unique(torque[moves], return_counts=True)
    if len(levels) < MIN_LEVELS:
        return None
    values = []
    rows = np.zeros(len(torque), dtype=bool)
    for extreme, nearby in ((0, counts[1 : NEXT_LEVELS + 1]), (-1, counts[-NEXT_LEVELS - 1 : -1])):
        is_crowded = counts[extreme] >= max(MIN_ROWS, CROWDED * float(nearby.max()))
        at_extreme = moves & (torque == levels[extreme])
        if not is_crowded:
            continue
        slow, fast = np.quantile(speed[at_extreme], (0.1, 0.9))
        if fast - slow > MIN_SPEED_RANGE * peak:
            values.append(float(levels[extreme]))
            rows |= at_extreme
    share = float(rows.sum() / moves.sum())
    return ColumnFault("clipped", joint, share, tuple(values)) if share >= MIN_SHARE else None


def _zeroed(joint: int, t: np.ndarray, torque: np.ndarray) -> ColumnFault | None:
    """Return the fault of a torque whose mean or start is zero, as if it had been tared; None if neither is.

    Args:
        joint: index of the joint.
        t: (N,) time stamps [s].
        torque: (N,) torque or current of the joint.
    """
    spread = float(torque.std())
    if spread == 0.0:
        return None
    if abs(float(torque.mean())) < MAX_TARED_MEAN * spread:
        return ColumnFault("mean", joint, 1.0)
    start = torque[t - t[0] <= START]
    if abs(float(start.mean())) < MAX_TARED_START * spread:
        return ColumnFault("start", joint, len(start) / len(torque))
    return None


def _standing_position(joint: int, t: np.ndarray, q: np.ndarray, v: np.ndarray) -> ColumnFault | None:
    """Return the fault of a position that is constant while the measured velocity integrates to a motion; or None.

    Args:
        joint: index of the joint.
        t: (N,) time stamps [s].
        q: (N,) positions of the joint [rad or m].
        v: (N,) measured velocities of the joint [rad/s or m/s].
    """
    min_travel = max(MIN_TRAVEL, MIN_STEPS * _resolution(q))
    parts = []
    for first, last in _constant(q):
        rows = slice(first, last)
        travel = _moved(t[rows], v[rows])
        fast = np.sqrt(np.mean(v[rows] ** 2)) > MOVING * np.abs(v).max()
        if fast and np.ptp(v[rows]) > 0.0 and travel > min_travel + _wander(t[rows], v[rows]):
            parts.append((first, last, travel))
    return _of_parts("position", joint, t, parts)


def _standing_velocity(joint: int, t: np.ndarray, q: np.ndarray, v: np.ndarray) -> ColumnFault | None:
    """Return the fault of a velocity that is constant while the position moves at another speed; or None.

    Args:
        joint: index of the joint.
        t: (N,) time stamps [s].
        q: (N,) positions of the joint [rad or m].
        v: (N,) measured velocities of the joint [rad/s or m/s].
    """
    parts = []
    for first, last in _constant(v):
        time = t[first:last] - t[first]
        deviation = float(np.ptp(q[first:last] - v[first] * time))
        if deviation > max(MIN_TRAVEL, MIN_STEPS * _resolution(v) * float(time[-1])):
            parts.append((first, last, deviation))
    fault = _of_parts("velocity", joint, t, parts)
    return fault if fault is not None and fault.share < MAX_STANDING else None


def _jumping(joint: int, t: np.ndarray, q: np.ndarray) -> ColumnFault | None:
    """Return the fault of a position that is constant during motion, then jumps by about the missed motion; or None.

    Args:
        joint: index of the joint.
        t: (N,) time stamps [s].
        q: (N,) positions of the joint [rad or m].
    """
    parts = []
    for first, last in _constant(q):
        if first < REACH or last + REACH >= len(q):
            continue
        speed_before = abs(q[first] - q[first - REACH]) / (t[first] - t[first - REACH])
        speed_behind = abs(q[last + REACH] - q[last]) / (t[last + REACH] - t[last])
        speed = float(speed_before + speed_behind) / 2.0
        jump = abs(float(q[last] - q[last - 1]))
        expected = speed * float(t[last] - t[first])
        is_sudden = jump > max(MIN_TRAVEL, JUMP * speed * float(t[last] - t[last - 1]))
        moves = min(speed_before, speed_behind) > 0.0
        if is_sudden and moves and expected / ABOUT < jump < expected * ABOUT:
            parts.append((first, last, jump))
    return _of_parts("position", joint, t, parts)


def _of_parts(kind: str, joint: int, t: np.ndarray, parts: list[tuple[int, int, float]]) -> ColumnFault | None:
    """Return the fault of a column from its constant parts; None without parts.

    Args:
        kind, joint: kind of the fault and index of the joint.
        t: (N,) time stamps [s].
        parts: for each part the first row, the row after the last one, and the missed motion [rad or m].
    """
    if not parts:
        return None
    rows = sum(last - first for first, last, _ in parts)
    first, last, missed = max(parts, key=lambda part: part[1] - part[0])
    return ColumnFault(kind, joint, rows / len(t), (), float(t[first]), float(t[last - 1]), missed)


def _constant(values: np.ndarray) -> Iterator[tuple[int, int]]:
    """Yield the parts of `MIN_ROWS` or more exactly equal values (N,): first row, and the row after the last one."""
    edges = np.flatnonzero(np.concatenate([[True], np.diff(values) != 0.0, [True]]))
    for first, last in zip(edges[:-1].tolist(), edges[1:].tolist()):
        if last - first >= MIN_ROWS:
            yield first, last


def _resolution(values: np.ndarray) -> float:
    """Return the smallest difference between values (N,), rounding errors ignored; 0 if all values are equal."""
    steps = np.diff(np.unique(values))
    steps = steps[steps > 1e-9 * np.abs(values).max(initial=0.0)]
    return float(steps.min(initial=np.inf)) if len(steps) else 0.0


def _moved(t: np.ndarray, v: np.ndarray) -> float:
    """Return the range of the integral of velocities v (N,) [rad or m].

    Gaps in the time stamps count as short steps.

    Args:
        t: (N,) time stamps [s].
        v: (N,) velocities of one joint [rad/s or m/s].
    """
    step = np.diff(t)
    step = np.minimum(step, 3.0 * np.median(step))
    mean_velocity = 0.5 * (v[1:] + v[:-1])
    position = np.concatenate([[0.0], np.cumsum(mean_velocity * step)])
    return float(np.ptp(position))


def _wander(t: np.ndarray, v: np.ndarray) -> float:
    """Return the largest plausible drift [rad or m] that white noise causes in the integral of velocities v (N,).

    Args:
        t: (N,) time stamps [s].
        v: (N,) velocities of one joint [rad/s or m/s].
    """
    noise = float(np.std(np.diff(v))) / np.sqrt(2.0)
    return MAX_WANDER * noise * float(np.median(np.diff(t))) * float(np.sqrt(len(t)))


def _speed(t: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Return the slope (N,) of positions q (N,), from the row `REACH` rows before to the row `REACH` rows after.

    Args:
        t: (N,) time stamps [s].
        q: (N,) positions of one joint [rad or m].
    """
    rows = np.arange(len(t))
    behind = np.minimum(rows + REACH, len(t) - 1)
    before = np.maximum(rows - REACH, 0)
    return np.asarray((q[behind] - q[before]) / (t[behind] - t[before]))
