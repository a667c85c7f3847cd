"""To the robot and back: approaches keep their limits, messages read back, a motion is found again and averaged."""

import json

import numpy as np
import pytest
import yaml

from calib.trajectories.approach import straight_approach
from calib.trajectories.errors import BadInput
from calib.trajectories.messages import joint_trajectory, to_json, to_yaml
from calib.trajectories.recall import average, find_periods
from calib.trajectories.setpoints import Setpoints, joined, slowed

RATE, PERIOD = 500.0, 1000
V, A, J = (np.full(3, x) for x in (1.5, 4.0, 40.0))
T = np.arange(PERIOD + 1) / RATE
PHASE = 2 * np.pi * T[:, None] / T[-1] * [1, 2, 3]
LOOP = Setpoints(RATE, np.sin(PHASE), np.cos(PHASE) * [np.pi, 2 * np.pi, 3 * np.pi], np.zeros((PERIOD + 1, 3)))


def test_approach_reaches_one_of_its_limits():
    """An approach keeps its limits and reaches one of them."""
    found = straight_approach(np.array([0.3, -1.0, 0.5]), np.array([-1.2, 0.4, 0.6]), V, A, J, RATE)
    np.testing.assert_allclose(found.q[[0, -1]], [[0.3, -1.0, 0.5], [-1.2, 0.4, 0.6]], atol=1e-9)
    for values, bound in ((found.v, V), (found.a, A), (np.diff(found.a, axis=0) * RATE, J)):
        assert (np.abs(values) <= bound * (1 + 1e-9)).all()
    assert max((np.abs(found.v) / V).max(), (np.abs(found.a) / A).max()) > 0.99
    np.testing.assert_allclose(found.v[[0, -1]], 0.0, atol=1e-12)
    np.testing.assert_allclose(np.gradient(found.q, 1 / RATE, axis=0)[1:-1], found.v[1:-1], atol=1e-4)
    straight = (found.q - found.q[0]) / (found.q[-1] - found.q[0])
    np.testing.assert_allclose(straight, straight[:, :1] + np.zeros(3), atol=1e-9)
    assert straight_approach(V, V, V, A, J, RATE).duration == 0.0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"velocity": np.array([1.0, 0.0, 1.0])}, "velocity limits must be"),
        ({"jerk": np.full(3, np.inf)}, "jerk limits must be finite"),
        ({"start": np.array([0.0, np.nan, 0.0])}, "joint 2 of the start"),
        ({"goal": np.zeros(2)}, "one value per joint"),
    ],
)
def test_bad_approaches_are_named(change, message):
    given = {"start": np.zeros(3), "goal": np.ones(3), "velocity": V, "acceleration": A, "jerk": J, "rate": RATE}
    with pytest.raises(BadInput, match=message):
        straight_approach(**given | change)


def test_motions_join_only_where_they_meet():
    start = straight_approach(np.ones(3), LOOP.q[0], V, A, J, RATE)
    whole = LOOP.repeated(3)
    assert len(whole) == 3 * PERIOD + 1
    with pytest.raises(BadInput, match=r"begins .* away .*\(speed of joint 3\)"):
        joined([start, whole])
    with pytest.raises(BadInput, match="position of joint 1"):
        joined([start, Setpoints(RATE, LOOP.q + 0.1, LOOP.v * 0, LOOP.a)])


def test_a_rehearsal_is_the_same_path_slower():
    slow = slowed(LOOP, 2.5)
    assert slow.duration == pytest.approx(2.5 * LOOP.duration)
    phase = 2 * np.pi * slow.times[:, None] / slow.duration * [1, 2, 3]
    np.testing.assert_allclose(slow.q, np.sin(phase), atol=1e-7)
    np.testing.assert_allclose(slow.v, np.cos(phase) * np.array([np.pi, 2 * np.pi, 3 * np.pi]) / 2.5, atol=1e-4)
    with pytest.raises(BadInput, match="expected 1 or more"):
        slowed(LOOP, 0.5)


def test_messages_read_back_as_they_were():
    track = Setpoints(RATE, LOOP.q[:7], LOOP.v[:7] * 1e-6, LOOP.a[:7], LOOP.q[:7] * 3)
    message = joint_trajectory(track, ["a", "b", "c"], every=3)
    assert json.loads(to_json(message)) == message
    assert yaml.safe_load(to_yaml(message)) == message
    stamps = [p["time_from_start"]["sec"] + 1e-9 * p["time_from_start"]["nanosec"] for p in message["points"]]
    np.testing.assert_allclose(stamps, [0.0, 3 / RATE, 6 / RATE], atol=1e-12)
    np.testing.assert_allclose([p["positions"] for p in message["points"]], track.q[::3], atol=1e-9)
    with pytest.raises(BadInput, match="has 3 joints"):
        joint_trajectory(track, ["a", "a", "c"])


def recorded(sigma: float, periods: int = 5, seed: int = 0) -> tuple[np.ndarray, int]:
    """Return a noisy log: standing, an approach, the periods, part of another, standing elsewhere."""
    rng = np.random.default_rng(seed)
    start = straight_approach(np.array([2.0, -2.0, 1.0]), LOOP.q[0], V, A, J, RATE).q
    parts = [
        np.tile(start[0], (333, 1)),
        start,
        np.tile(LOOP.q[:-1], (periods, 1)),
        LOOP.q[:400],
        np.tile(LOOP.q[400], (700, 1)),
    ]
    log = np.vstack(parts)
    return log + sigma * rng.normal(size=log.shape), 333 + len(start)


def test_logged_motion_is_cut_to_periods():
    """A motion is found in a log, and cut to whole periods."""
    log, start = recorded(0.01)
    found = find_periods(log, LOOP.q[:-1])
    assert (found.start, found.periods, found.period) == (start, 5, PERIOD)
    assert min(found.likeness) > 0.99 and abs(found.lag) < 0.1
    assert find_periods(log, LOOP.q[:-1], skip=1).start == start + PERIOD


def test_period_variance_is_that_of_noise():
    """The variance over periods is that of the noise, and the mean is better."""
    sigma = np.array([0.01, 0.02, 0.03])
    log, start = recorded(0.0, periods=12)
    noisy = log + sigma * np.random.default_rng(1).normal(size=log.shape)
    result = average(noisy, find_periods(noisy, LOOP.q[:-1]))
    np.testing.assert_allclose(np.sqrt(result.pooled), sigma, rtol=0.03)
    error = (result.mean - LOOP.q[:-1]).std(axis=0)
    np.testing.assert_allclose(error, sigma / np.sqrt(12), rtol=0.08)
    assert start == find_periods(noisy, LOOP.q[:-1]).start


def test_what_is_not_there_is_not_found():
    log, start = recorded(0.0)
    with pytest.raises(BadInput, match="not in the recording"):
        find_periods(log, np.roll(LOOP.q[:-1], 1, axis=1))
    with pytest.raises(BadInput, match="less than one period"):
        find_periods(log[:500], LOOP.q[:-1])
    with pytest.raises(BadInput, match="record two or more"):
        average(log, find_periods(log[: start + 1700], LOOP.q[:-1]))
