"""Order of poses for the shortest total time: an open tour, and durations of joint moves."""

import numpy as np

from .errors import BadInput

# approximate number of starts tried for a tour that may begin at any pose (our choice)
STARTS = 12


def move_times(start: np.ndarray, end: np.ndarray, velocity: np.ndarray, acceleration: np.ndarray) -> np.ndarray:
    """Return the durations (...) [s] of straight joint moves from rest to rest with trapezoidal speed profiles.

    All joints move in proportion. A joint that moves by d takes d/v + v/a where it reaches its speed (d ≥ v²/a), else 2
    √(d/a); the slowest joint determines the duration.

    Args:
        start, end: (..., n) joint values [rad or m].
        velocity, acceleration: (n,) largest absolute values [rad or m per s, s²], above zero.
    """
    distance = np.abs(end - start)
    full = distance >= velocity**2 / acceleration
    trapezoid = distance / velocity + velocity / acceleration
    triangle = 2.0 * np.sqrt(distance / acceleration)
    times = np.where(full, trapezoid, triangle)
    return times.max(axis=-1)


def tour(times: np.ndarray, first: int | None = None) -> np.ndarray:
    """Return an order (m,) of m poses with nearly the shortest total time; the tour may end at any pose.

    Tours by nearest neighbours from several starts are each improved by reversing parts (2-opt, Croes 1958) and by
    moving up to three successive poses elsewhere (Or 1976), until neither helps. The best tour is returned.

    Args:
        times: (m, m) symmetric, durations of the moves between all poses [s].
        first: index of the pose at which to begin; None: any.

    Raises:
        BadInput: `times` is not a symmetric matrix of finite numbers.
    """
    cost = np.asarray(times, dtype=float)
    if cost.ndim != 2 or cost.shape[0] != cost.shape[1] or not np.isfinite(cost).all() or not np.allclose(cost, cost.T):
        raise BadInput(f"times: expected a symmetric (m, m) matrix of finite numbers, found shape {cost.shape}")
    count = len(cost)
    if count < 3:
        order = np.arange(count)
        return order[::-1] if first else order
    # A place that costs nothing to go to closes the tour, so that its two neighbours are the free ends.
    closed = np.zeros((count + 1, count + 1))
    closed[:count, :count] = cost
    starts = list(range(0, count, max(1, count // STARTS)))
    if first is not None:
        starts = [first]
        closed[count, :count] = closed[:count, count] = cost.sum() + 1.0
        closed[count, first] = closed[first, count] = 0.0
        closed[count, :count] = np.minimum(closed[count, :count], cost.sum() + 1.0)
    best = None
    shortest = np.inf
    for start in starts:
        order = np.array([*_nearest_first(cost, start), count])
        order = _improved(order, closed)
        length = closed[order, np.roll(order, -1)].sum()
        if length < shortest:
            best = order
            shortest = length
    assert best is not None
    stop_index = int(np.argmax(best == count))
    order = np.roll(best, -stop_index)[1:]
    if first is not None and order[0] != first:
        return order[::-1]
    return order


def _nearest_first(cost: np.ndarray, start: int) -> list[int]:
    """Return the tour that goes from each pose to the nearest pose not yet visited.

    Args:
        cost: (m, m) durations of the moves between the poses [s].
        start: index (from 0) of the first pose.
    """
    order = [start]
    unvisited = set(range(len(cost))) - {start}
    while unvisited:
        last = order[-1]
        nearest = min(unvisited, key=lambda stop: (cost[last, stop], stop))
        order.append(nearest)
        unvisited.remove(nearest)
    return order


def _improved(order: np.ndarray, cost: np.ndarray) -> np.ndarray:
    """Return a closed tour that no reversal or relocation shortens, by repeating the change that saves most.

    Args:
        order: (m,) indices of the poses in the order of the tour.
        cost: (m, m) durations of the moves between the poses [s].
    """
    while True:
        shorter = _reversed(order, cost)
        if shorter is None:
            shorter = _relocated(order, cost)
        if shorter is None:
            return order
        order = shorter


def _reversed(order: np.ndarray, cost: np.ndarray) -> np.ndarray | None:
    """Return the tour after the reversal that saves most; None if none saves time.

    A reversal replaces the edges a-b and c-d by a-c and b-d.

    Args:
        order: (m,) indices of the poses in the order of the closed tour.
        cost: (m, m) durations of the moves between the poses [s].
    """
    after = np.roll(order, -1)
    edge = cost[order, after]
    between_starts = cost[order[:, None], order]
    between_ends = cost[after[:, None], after]
    gains = np.triu(edge[:, None] + edge - between_starts - between_ends, 2)
    i, k = divmod(int(gains.argmax()), len(order))
    if gains[i, k] <= 1e-9:
        return None
    return np.concatenate([order[: i + 1], order[k:i:-1], order[k + 1 :]])


def _relocated(order: np.ndarray, cost: np.ndarray) -> np.ndarray | None:
    """Return the tour after moving up to three successive poses, reversed or not, elsewhere; None if none saves time.

    The move with the largest saving is made.

    Args:
        order: (m,) indices of the poses in the order of the closed tour.
        cost: (m, m) durations of the moves between the poses [s].
    """
    count = len(order)
    best = (1e-9, 0, 0, 0, False)
    after = np.roll(order, -1)
    edge = cost[order, after]
    for size in range(1, min(3, count - 2) + 1):
        before = np.roll(order, 1)
        last = np.roll(order, 1 - size)
        behind = np.roll(order, -size)
        saved = cost[before, order] + cost[last, behind] - cost[before, behind]
        positions = np.arange(count)
        # edges at the part itself
        part_edges = (positions - positions[:, None] + 1) % count <= size
        for turned, (first, second) in enumerate(((order, last), (last, order))):
            first_edges = cost[first[:, None], order]
            second_edges = cost[second[:, None], after]
            gains = saved[:, None] + edge - first_edges - second_edges
            gains[part_edges] = 0.0
            i, k = divmod(int(gains.argmax()), count)
            move = (float(gains[i, k]), size, i, (k - i - size) % count, bool(turned))
            best = max(best, move)
    _, size, i, k, turned = best
    if not size:
        return None
    rotated = np.roll(order, -i)
    part = rotated[:size]
    remaining = rotated[size:]
    if turned:
        part = part[::-1]
    return np.concatenate([remaining[: k + 1], part, remaining[k + 1 :]])
