"""Errors in figures: each nature of measurement by hand-made numbers, and what does not depend on frames."""

from dataclasses import replace

import numpy as np
import pytest

from calib.data.poses.measurements import KINDS, PoseMeasurements, Sockets
from calib.geometry.accuracy import ErrorStatistics, errors, pair_errors, statistics
from calib.geometry.installation import Installation, see
from calib.robot.library import load
from calib.transforms import from_xyz_rpy, to_quaternion

CELL = Installation(
    load("ur5"),
    from_xyz_rpy([[1.0, 2.0, 0.5]], [[0.3, 0.2, -1.0]]),
    from_xyz_rpy([[0.1, 0.0, 0.05]], [[0.1, 0.0, 0.4]]),
)
Q = np.random.default_rng(0).uniform(-2.0, 2.0, (24, 6))
EXACT = see(CELL, Q).poses()
IN_BASE = see(replace(CELL, stations=np.eye(4)[None]), Q).point.T


def block(kind: str, **values) -> PoseMeasurements:
    return KINDS[kind](Q[: len(next(iter(values.values())))], CELL.chain.joint_names, **values)


def test_errors_are_lengths_of_vectors():
    """Position and orientation are lengths of vectors."""
    shift = np.tile([3e-3, 0.0, 4e-3], (24, 1))
    turned = EXACT @ from_xyz_rpy([0, 0, 0], [np.radians(2.0), 0, 0])
    found = errors(CELL, [block("pose", position=EXACT[:, :3, 3] + shift, quaternion=to_quaternion(turned))]).summary()
    for name in ("mean", "rms", "p95", "max"):
        assert getattr(found.position_mm, name) == pytest.approx(5.0)
        assert getattr(found.orientation_deg, name) == pytest.approx(2.0)
    assert found.distance_mm is None


def test_rms_is_that_of_the_norm():
    found = statistics(np.array([3.0, 4.0]))
    assert found == ErrorStatistics(3.5, np.sqrt(12.5), pytest.approx(3.95), 4.0)
    assert statistics(None) is None


def test_positions_have_no_orientation():
    """Positions alone have no orientation, and distances no position."""
    found = errors(CELL, [block("position", position=EXACT[:, :3, 3])]).summary()
    assert found.orientation_deg is None and found.position_mm.max < 1e-9
    known = np.linalg.norm(IN_BASE[0::2] - IN_BASE[1::2], axis=1) + 2e-3
    found = errors(CELL, [block("distance", distance=np.repeat(known, 2), group=np.repeat(np.arange(12), 2))]).summary()
    assert found.position_mm is None
    assert found.distance_mm.mean == pytest.approx(2.0)


def test_sockets_scatter_about_their_mean():
    group = np.repeat([0, 1], 12)
    names, links = ("a/0", "a/1"), ((0, 1, 0.05),)
    linked = Sockets(Q, CELL.chain.joint_names, group=group, group_names=names, links=links)
    found = errors(CELL, [linked])
    means = np.array([IN_BASE[group == k].mean(axis=0) for k in (0, 1)])
    assert found.position == pytest.approx(np.linalg.norm(IN_BASE - means[group], axis=1))
    assert found.distance == pytest.approx([abs(np.linalg.norm(means[0] - means[1]) - 0.05)])


def test_sockets_compare_over_positions():
    """Sockets of unknown distance compare over the fixture's positions."""
    group = np.repeat(np.arange(4), 6)
    names = ("left/0", "left/1", "right/0", "right/1")
    found = errors(CELL, [Sockets(Q, CELL.chain.joint_names, group=group, group_names=names)])
    means = np.array([IN_BASE[group == k].mean(axis=0) for k in range(4)])
    left, right = np.linalg.norm(means[0] - means[1]), np.linalg.norm(means[2] - means[3])
    assert found.distance == pytest.approx([abs(left - right) / 2] * 2)
    alone = Sockets(Q[:12], CELL.chain.joint_names, group=group[:12], group_names=names[:2])
    assert errors(CELL, [alone]).distance is None


def test_pair_errors_ignore_the_station():
    """Pair errors do not know where the station stands."""
    seen = EXACT[:, :3, 3] + 1e-3 * np.random.default_rng(1).standard_normal((24, 3))
    measured = [block("position", position=seen)]
    moved = replace(CELL, stations=from_xyz_rpy([[5.0, 0.0, 0.0]], [[1.0, 1.0, 1.0]]))
    here, there = (pair_errors(cell, measured) for cell in (CELL, moved))
    assert len(here) == 24 * 23 // 2
    assert np.allclose(here, there, atol=1e-12)
    assert here.max() > 1e-4


def test_pairs_are_sampled_by_seed():
    """Pairs are sampled by seed, and never a row with itself."""
    measured = [block("position", position=EXACT[:, :3, 3] + 1.0 * np.random.default_rng(1).standard_normal((24, 3)))]
    some = pair_errors(CELL, measured, limit=50, seed=1)
    assert len(some) == 50
    assert np.array_equal(some, pair_errors(CELL, measured, limit=50, seed=1))
    assert not np.array_equal(some, pair_errors(CELL, measured, limit=50, seed=2))
    assert some.min() > 0.0
