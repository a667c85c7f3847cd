"""Search for a collision-free way between two places in joint space: straight, else with via-points.

RRT-Connect (Kuffner & LaValle 2000): two trees, from either end, grow towards random places and towards each other;
then detours are cut short wherever a straight move is clear. What is clear is asked of the caller, in batches.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

Clear = Callable[[np.ndarray], np.ndarray]

"""Largest step of a tree in one joint, as a share of its unit (see `Room`). Our choice."""
"""Share of random places near the middle between the ends. Our choice."""


@dataclass(frozen=True, eq=False)
class Room:
    """Search space of collision-free ways.

    Attributes:
        lower, upper: (n,) [rad or m].
        clear: places (N, n) -> (N,) whether they are clear.
        spacing: (n,) weights: of a straight move as many places are looked at as Σ |Δq_j| / spacing_j says.
        unit: (n,) what counts as one step of each joint [rad or m].
    """

    lower: np.ndarray
    upper: np.ndarray
    clear: Clear
    spacing: np.ndarray
    unit: np.ndarray


def straight_is_clear(room: Room, one: np.ndarray, two: np.ndarray) -> bool:
    """Return whether the straight move between two places (n,) is clear; eight places on it are checked first."""
    count = max(int(np.ceil((np.abs(two - one) / room.spacing).sum())), 1)
    share = np.arange(1, count) / count
    if not len(share):
        return True
    for part in (share[len(share) // 16 :: max(len(share) // 8, 1)], share):
        if not room.clear(one + part[:, None] * (two - one)).all():
            return False
    return True


def way(room: Room, start: np.ndarray, goal: np.ndarray, seed: int = 0, most: int = 4000) -> np.ndarray | None:
    """Return a clear way (k, n) from start to goal, both included: two places if the straight move is clear.

    Args:
        room: limits and what is clear.
        start, goal: (n,) [rad or m], clear.
        seed: of the random places.
        most: random places tried; None is returned where they do not suffice.
    """
    if straight_is_clear(room, start, goal):
        return np.array([start, goal])
    generator = np.random.default_rng(seed)
    trees = [([start], [-1]), ([goal], [-1])]
    goal_share = 0.1
    for number in range(most):
        if generator.random() < goal_share:
            aim = (start + goal) / 2 + generator.normal(size=len(start)) * room.unit
        else:
            aim = generator.uniform(room.lower, room.upper)
        one, two = trees[number % 2], trees[1 - number % 2]
        new = _grown(room, one, np.clip(aim, room.lower, room.upper))
        if new is None:
            continue
        while (other := _grown(room, two, one[0][new])) is not None:
            if np.array_equal(two[0][other], one[0][new]):
                parts = [_branch(*one, new), _branch(*two, other)]
                if number % 2:
                    parts.reverse()
                return _shortened(room, np.array(parts[0][::-1] + parts[1][1:]), generator)
    return None


def _grown(room: Room, tree: tuple[list[np.ndarray], list[int]], aim: np.ndarray, max_step: float = 0.5) -> int | None:
    """Extend a tree by one step towards a place; return the new node's number, None if the step is not clear."""
    nodes, parents = tree
    away = (aim - np.array(nodes)) / room.unit
    near = int(np.linalg.norm(away, axis=1).argmin())
    largest = float(np.abs(away[near]).max())
    new = aim if largest <= max_step else nodes[near] + (aim - nodes[near]) * (max_step / largest)
    if not room.clear(new[None])[0] or not straight_is_clear(room, nodes[near], new):
        return None
    nodes.append(new)
    parents.append(near)
    return len(nodes) - 1


def _branch(nodes: list[np.ndarray], parents: list[int], leaf: int) -> list[np.ndarray]:
    """Return the nodes from a leaf to the root."""
    found = []
    while leaf >= 0:
        found.append(nodes[leaf])
        leaf = parents[leaf]
    return found


def _shortened(room: Room, places: np.ndarray, generator: np.random.Generator, tries: int = 60) -> np.ndarray:
    """Return a way with detours removed by straight moves between its places and points on its lines."""
    for _ in range(tries):
        if len(places) < 3:
            break
        i, j = np.sort(generator.choice(len(places), 2, replace=False))
        if j - i > 1 and straight_is_clear(room, places[i], places[j]):
            places = np.concatenate([places[: i + 1], places[j:]])
            continue
        i, j = np.sort(generator.choice(len(places) - 1, 2, replace=False)) if len(places) > 2 else (0, 0)
        if i == j:
            continue
        one, two = (places[k] + generator.random() * (places[k + 1] - places[k]) for k in (i, j))
        if straight_is_clear(room, one, two) and _length(room, one, two) < 0.98 * (
            _length(room, one, *places[i + 1 : j + 1], two)
        ):
            places = np.concatenate([places[: i + 1], [one, two], places[j + 1 :]])
    return places


def _length(room: Room, *places: np.ndarray) -> float:
    return float((np.abs(np.diff(np.array(places), axis=0)) / room.unit).max(axis=1).sum())
