"""The order in which to visit places in least time: an open tour, and how long moves between joint values last."""

from __future__ import annotations

import numpy as np

from trajectories.errors import BadInput


def move_times(one: np.ndarray, two: np.ndarray, velocity: np.ndarray, acceleration: np.ndarray) -> np.ndarray:
    """Return how long straight joint moves from rest to rest last (...) [s]: trapezoids, all joints in proportion.

    A joint that goes by d takes d/v + v/a where it reaches its speed (d ≥ v²/a), else 2 √(d/a); the slowest one rules.

    Args:
        one, two: (..., n) joint values [rad or m].
        velocity, acceleration: (n,) largest moduli, above zero.
    """
    way = np.abs(two - one)
    full = way >= velocity**2 / acceleration
    times = np.where(full, way / velocity + velocity / acceleration, 2.0 * np.sqrt(way / acceleration))
    return times.max(axis=-1)


def tour(times: np.ndarray, first: int | None = None) -> np.ndarray:
    """Return the order (m,) in which to visit m places, near the least total time; it ends anywhere.

    Nearest neighbours from several starts, each improved by reversing parts (2-opt, Croes 1958) and by moving up to
    three places elsewhere (Or 1976) until neither helps; the best is returned.

    Args:
        times: (m, m) symmetric, from each place to each other.
        first: where it begins; None: anywhere.

    Raises:
        BadInput: where `times` is no symmetric matrix of finite numbers.
    """
    cost = np.asarray(times, dtype=float)
    if cost.ndim != 2 or cost.shape[0] != cost.shape[1] or not np.isfinite(cost).all() or not np.allclose(cost, cost.T):
        raise BadInput(f"times: expected a symmetric (m, m) matrix of finite numbers, found shape {cost.shape}")
    count = len(cost)
    if count < 3:
        return np.arange(count) if not first else np.arange(count)[::-1]
    # A place that costs nothing to go to closes the tour, so that its two neighbours are the free ends.
    closed = np.zeros((count + 1, count + 1))
    closed[:count, :count] = cost
    if first is not None:
        closed[count, :count] = closed[:count, count] = cost.sum() + 1.0
        closed[count, first] = closed[first, count] = 0.0
        closed[count, :count] = np.minimum(closed[count, :count], cost.sum() + 1.0)
    starts = [first] if first is not None else range(0, count, max(1, count // 12))
    tours = (_improved([*_nearest_first(cost, start), count], closed) for start in starts)
    best = min(tours, key=lambda order: _length(order, closed))
    cut = best.index(count)
    order = best[cut + 1 :] + best[:cut]
    return np.array(order if first is None or order[0] == first else order[::-1])


def _nearest_first(cost: np.ndarray, start: int) -> list[int]:
    left, order = set(range(len(cost))) - {start}, [start]
    while left:
        order.append(min(left, key=lambda place: (cost[order[-1], place], place)))
        left.remove(order[-1])
    return order


def _length(order: list[int], cost: np.ndarray) -> float:
    return float(cost[order, np.roll(order, -1)].sum())


def _improved(order: list[int], cost: np.ndarray) -> list[int]:
    """Return a closed tour that neither a reversal nor a relocation shortens."""
    count, improving = len(order), True
    while improving:
        improving = False
        for i in range(count - 1):
            a, b = order[i], order[i + 1]
            ends = np.array(order[i + 2 :] + order[:1])[: count - 2 - (i == 0)]
            if len(ends) < 2:
                continue
            c, d = ends[:-1], ends[1:]
            gains = cost[a, b] + cost[c, d] - cost[a, c] - cost[b, d]
            k = int(gains.argmax())
            if gains[k] > 1e-9:
                order[i + 1 : i + 3 + k] = order[i + 1 : i + 3 + k][::-1]
                improving = True
        for size in (1, 2, 3):
            for i in range(count - size):
                part, rest = order[i : i + size], order[:i] + order[i + size :]
                one, two = np.array(rest), np.roll(rest, -1)
                before = rest[i - 1]
                saved = cost[before, part[0]] + cost[part[-1], rest[i % len(rest)]] - cost[before, rest[i % len(rest)]]
                added = np.array([cost[one, ends[0]] + cost[ends[1], two] - cost[one, two]
                                  for ends in ((part[0], part[-1]), (part[-1], part[0]))])  # fmt: skip
                turned, k = np.unravel_index(added.argmin(), added.shape)
                if saved - added[turned, k] > 1e-9:
                    order[:] = rest[: k + 1] + (part[::-1] if turned else part) + rest[k + 1 :]
                    improving = True
    return order
