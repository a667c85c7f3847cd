"""A pose that no clear way leads to is driven on another turn of its joints, or a candidate takes its place."""

from types import SimpleNamespace

import numpy as np
import pytest

from calib.geometry.observability import observation, targets_of
from calib.procedure.measuring import run as measuring
from calib.procedure.measuring.run import Exchange, RunSettings, drivable, plan_run, turns
from calib.robot.library import load

CHAIN = load("ur5")
FULL = 2 * np.pi


class Barrier:
    """A wall through the axis of the first joint, at one of its angles."""

    def free(self, q: np.ndarray, clearance: float) -> np.ndarray:
        return np.abs(np.angle(np.exp(1j * q[:, 0]))) > 0.1


def limits(most: float) -> SimpleNamespace:
    top = np.array([most, 2.0, 2.0, 2.0, 2.0, 2.0])
    return SimpleNamespace(lower=-top, upper=top, collision=Barrier(), clearance=0.05)


def poses(count: int, seed: int, side: float) -> np.ndarray:
    q = np.random.default_rng(seed).uniform(-1.5, 1.5, (count, 6))
    q[:, 0] = side * np.random.default_rng(seed + 1).uniform(0.2, 2.5, count)
    return q


@pytest.mark.parametrize("index", ["O1", pytest.param("O3", marks=pytest.mark.slow)])
def test_poses_behind_a_wall_are_replaced_by_those_that_cost_least(index):
    room, seen = limits(2.8), observation(targets_of(CHAIN))
    q = np.concatenate([poses(9, 1, 1.0), poses(2, 2, -1.0)])
    candidates = np.concatenate([poses(60, 3, 1.0), poses(60, 4, -1.0)])
    assert plan_run(CHAIN, q, room).cut_off == (9, 10)
    exchange = Exchange(seen, candidates, None, index)
    found = drivable(CHAIN, q, exchange, room, RunSettings())
    assert set(found.replaced) == {9, 10} and not found.run.blocked and np.array_equal(found.q[:9], q[:9])
    assert all(number < 60 for number in found.replaced.values())  # on the side where the others are
    trials = [exchange.value(np.concatenate([found.q[:10], one[None]]))[0] for one in candidates[:60]]
    assert found.value[1] == pytest.approx(max(trials), rel=1e-9)
    assert found.value == pytest.approx((exchange.value(q)[0], exchange.value(found.q)[0]))
    named = [number for number, place in enumerate(found.run.order, 1) if place > 8]
    assert found.words.startswith(f"poses {named[0]}, {named[1]} replaced")


def test_the_same_pose_on_another_turn_is_kept():
    room, seen = limits(6.0), observation(targets_of(CHAIN))
    q = np.concatenate([poses(9, 1, 1.0), poses(2, 2, -1.0)])
    found = drivable(CHAIN, q, Exchange(seen, poses(60, 3, 1.0), None, "O1"), room, RunSettings())
    assert not found.replaced and not found.words and not found.run.blocked
    assert np.abs(np.sin((found.q - q) / 2)).max() < 1e-9
    assert found.value[0] == pytest.approx(found.value[1], rel=1e-9)


def test_what_cannot_be_replaced_is_told():
    room, seen = limits(2.8), observation(targets_of(CHAIN))
    q = np.concatenate([poses(5, 1, 1.0), poses(1, 2, -1.0)])
    found = drivable(CHAIN, q, Exchange(seen, poses(60, 4, -1.0), None, "O1"), room, RunSettings())
    assert found.run.cut_off == (5,) and len(found.run.blocked) == 1 and not found.replaced


def test_turns_are_the_same_posture_within_the_limits():
    top = np.array([6.2, 2.0, 2.0, 2.0, 2.0, 9.0])
    found = turns(CHAIN, np.full(6, 1.0), -top, top)
    assert len(found) == 2 * 3 and (np.abs(found) <= top).all()
    assert np.abs(np.sin((found - 1.0) / 2)).max() < 1e-12


def test_ways_found_lead_by_third_poses_where_no_other_way_is_found(monkeypatch):
    """Of a star only the middle is joined with each: the run comes back to it, and leaves nothing out."""
    room, q = limits(2.8), poses(5, 1, 1.0)

    def only_the_middle(room, start, goal, **_):
        ends = [start, goal]
        return np.array(ends) if any(np.array_equal(end, q[0]) for end in ends) else None

    monkeypatch.setattr(measuring, "way", only_the_middle)
    found = drivable(CHAIN, q, Exchange(observation(targets_of(CHAIN)), q, None, "O1"), room, RunSettings())
    run = found.run
    assert not found.replaced and np.array_equal(found.q, q)
    assert not run.blocked and not run.cut_off and sorted(run.order) == list(range(5)) and run.around >= 2
    for (one, two), way in run.found_ways.items():
        assert np.array_equal(way[[0, -1]], q[[one, two]])
        assert len(way) == 2 or np.array_equal(way[1], q[0])
