"""Search for a collision-free path between two poses in joint space: a straight move, or one with via-points.

The search is RRT-Connect (Kuffner & LaValle 2000): two trees, one from either end, grow towards random poses and
towards each other. Then detours are replaced by straight moves wherever these are free of collision. The caller's
function checks poses for collision, in batches.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

Clear = Callable[[np.ndarray], np.ndarray]

# largest step of a tree in one joint, as a share of the joint's unit in `Room` (our choice)
MAX_STEP = 0.5
# share of random poses that are drawn near the middle between the ends (our choice)
MIDDLE_SHARE = 0.1
# number of attempts to remove a detour, and largest length of a straight move relative to the detour it replaces
SHORTENINGS = 60
MAX_SHORTENED = 0.98


@dataclass(frozen=True, eq=False)
class Room:
    """Search space of collision-free paths.

    Attributes:
        lower, upper: (n,) joint limits [rad or m].
        clear: function of poses (N, n) that returns (N,) True where a pose is free of collision.
        spacing: (n,) distance between checked poses in each joint [rad or m]; a straight move by Δq is divided into Σ
            |Δq_j| / spacing_j parts.
        unit: (n,) length of each joint that counts as 1 in distances [rad or m].
    """

    lower: np.ndarray
    upper: np.ndarray
    clear: Clear
    spacing: np.ndarray
    unit: np.ndarray


def straight_is_clear(room: Room, start: np.ndarray, end: np.ndarray) -> bool:
    """Return whether the straight move in joint space between two poses `start` and `end` (n,) is free of collision.

    About eight poses spread over the move are checked first, to end early on a collision. `room` gives the check for
    collision and the spacing of checked poses.
    """
    steps = np.abs(end - start) / room.spacing
    count = max(int(np.ceil(steps.sum())), 1)
    share = np.arange(1, count) / count
    if not len(share):
        return True
    coarse = share[len(share) // 16 :: max(len(share) // 8, 1)]
    for part in (coarse, share):
        places = start + part[:, None] * (end - start)
        if not room.clear(places).all():
            return False
    return True


def way(room: Room, start: np.ndarray, goal: np.ndarray, seed: int = 0, most: int = 4000) -> np.ndarray | None:
    """Return a collision-free path (k, n) from start to goal, both included; None if none was found.

    If the straight move is free of collision, the path has only these two poses.

    Args:
        room: joint limits and the check for collision.
        start, goal: (n,) poses free of collision [rad or m].
        seed: seed of the random poses.
        most: largest number of random poses.
    """
    if straight_is_clear(room, start, goal):
        return np.array([start, goal])
    generator = np.random.default_rng(seed)
    trees = [([start], [-1]), ([goal], [-1])]
    for number in range(most):
        if generator.random() < MIDDLE_SHARE:
            spread = generator.normal(size=len(start)) * room.unit
            aim = (start + goal) / 2 + spread
        else:
            aim = generator.uniform(room.lower, room.upper)
        tree = trees[number % 2]
        opposite = trees[1 - number % 2]
        place = np.clip(aim, room.lower, room.upper)
        leaf = _grown(room, tree, place)
        if leaf is None:
            continue
        node = tree[0][leaf]
        opposite_leaf = _grown(room, opposite, node)
        while opposite_leaf is not None:
            if np.array_equal(opposite[0][opposite_leaf], node):
                branches = [_branch(*tree, leaf), _branch(*opposite, opposite_leaf)]
                if number % 2:
                    branches.reverse()
                places = np.array(branches[0][::-1] + branches[1][1:])
                return _shortened(room, places, generator)
            opposite_leaf = _grown(room, opposite, node)
    return None


def _grown(room: Room, tree: tuple[list[np.ndarray], list[int]], aim: np.ndarray) -> int | None:
    """Extend a tree by one step towards the pose `aim`; return the new node's index, None if the step collides.

    Args:
        room: joint limits and the check for collision.
        tree: poses of the nodes, and the index of each node's parent.
        aim: (n,) pose [rad or m].
    """
    nodes, parents = tree
    steps = (aim - np.array(nodes)) / room.unit
    nearest = int(np.linalg.norm(steps, axis=1).argmin())
    largest = float(np.abs(steps[nearest]).max())
    node = aim
    if largest > MAX_STEP:
        node = nodes[nearest] + (aim - nodes[nearest]) * (MAX_STEP / largest)
    if not room.clear(node[None])[0] or not straight_is_clear(room, nodes[nearest], node):
        return None
    nodes.append(node)
    parents.append(nearest)
    return len(nodes) - 1


def _branch(nodes: list[np.ndarray], parents: list[int], leaf: int) -> list[np.ndarray]:
    """Return the poses of a tree from a leaf to the root.

    Args:
        nodes: (n,) pose of each node.
        parents: index of each node's parent.
        leaf: index of the leaf.
    """
    branch = []
    while leaf >= 0:
        branch.append(nodes[leaf])
        leaf = parents[leaf]
    return branch


def _shortened(room: Room, places: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """Return a path with detours replaced by straight moves between its poses, or between points on its lines.

    Args:
        room: joint limits and the check for collision.
        places: (k, n) poses of the path.
        generator: generator of the random numbers.
    """
    for _ in range(SHORTENINGS):
        if len(places) < 3:
            break
        i, j = np.sort(generator.choice(len(places), 2, replace=False))
        if j - i > 1 and straight_is_clear(room, places[i], places[j]):
            places = np.concatenate([places[: i + 1], places[j:]])
            continue
        i, j = np.sort(generator.choice(len(places) - 1, 2, replace=False))
        step = places[i + 1] - places[i]
        start = places[i] + generator.random() * step
        step = places[j + 1] - places[j]
        end = places[j] + generator.random() * step
        if not straight_is_clear(room, start, end):
            continue
        between = places[i + 1 : j + 1]
        detour = _length(room, start, *between, end)
        if _length(room, start, end) < MAX_SHORTENED * detour:
            places = np.concatenate([places[: i + 1], [start, end], places[j + 1 :]])
    return places


def _length(room: Room, *places: np.ndarray) -> float:
    steps = np.abs(np.diff(np.array(places), axis=0)) / room.unit
    return float(steps.max(axis=1).sum())
