"""Tours are as short as the shortest of all orders; ways go around what is in between."""

from itertools import pairwise, permutations

import numpy as np
import pytest

from calib.trajectories.errors import BadInput
from calib.trajectories.tour import move_times, tour
from calib.trajectories.ways import Room, straight_is_clear, way


@pytest.mark.parametrize("first", [None, 3])
def test_small_tours_are_the_shortest(first):
    for seed in range(5):
        x = np.random.default_rng(seed).uniform(size=(7, 2))
        cost = np.linalg.norm(x[:, None] - x, axis=2)
        orders = [p for p in permutations(range(7)) if first is None or p[0] == first]
        best = min(sum(cost[a, b] for a, b in pairwise(p)) for p in orders)
        found = tour(cost, first)
        assert sorted(found) == list(range(7)) and (first is None or found[0] == first)
        assert cost[found[:-1], found[1:]].sum() == pytest.approx(best)


def test_no_matrix_of_times():
    for wrong in (np.ones((2, 3)), np.array([[0.0, 1.0], [2.0, 0.0]]), np.full((3, 3), np.nan)):
        with pytest.raises(BadInput, match="symmetric"):
            tour(wrong)


def test_moves_last_as_their_slowest_joint():
    """Moves last as long as their slowest joint."""
    v, a = np.array([1.0, 0.5]), np.array([2.0, 1.0])
    assert move_times(np.zeros(2), np.array([2.0, 0.0]), v, a) == pytest.approx(2.0 + 0.5)
    assert move_times(np.zeros(2), np.array([0.02, 0.09]), v, a) == pytest.approx(2 * np.sqrt(0.09))


def test_way_leads_around_a_wall():
    """A way leads around a wall with a gap."""

    def clear(q: np.ndarray) -> np.ndarray:
        return (np.abs(q[:, 0]) > 0.1) | (q[:, 1] > 0.7)

    room = Room(-np.ones(2), np.ones(2), clear, np.full(2, 0.02), np.full(2, 0.4))
    start, goal = np.array([-0.5, -0.5]), np.array([0.5, -0.5])
    assert not straight_is_clear(room, start, goal)
    found = way(room, start, goal)
    assert found is not None and np.array_equal(found[[0, -1]], [start, goal]) and 2 < len(found) < 8
    assert all(straight_is_clear(room, one, two) for one, two in pairwise(found))
    shut = Room(room.lower, room.upper, lambda q: np.abs(q[:, 0]) > 0.1, room.spacing, room.unit)
    assert way(shut, start, goal, most=100) is None
