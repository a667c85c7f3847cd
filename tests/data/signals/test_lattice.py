"""Steps of an even clock from stamps that jitter, with samples lost: recovered, or not claimed."""

import numpy as np
import pytest

from calib.data.recordings.recording import Recording
from calib.data.recordings.row_order import in_order
from calib.data.signals.lattice import find_lattice
from calib.data.signals.resampling import find_clock

PERIOD = 0.002  # [s]


def stamps(seed: int, dropped: float, jitter: float, count: int = 4000) -> tuple[np.ndarray, np.ndarray]:
    """Return the true steps (N,) and stamps (N,) [s] of a log; jitter in steps."""
    rng = np.random.default_rng(seed)
    steps = np.flatnonzero(rng.random(count) > dropped)
    t = PERIOD * (1.0 + 3e-5) * steps + jitter * PERIOD * rng.normal(size=len(steps))
    return steps, np.sort(t)


@pytest.mark.parametrize(("dropped", "jitter"), [(0.0, 0.1), (0.03, 0.1), (0.2, 0.05), (0.03, 0.0)])
def test_steps_counted_through_jitter(dropped, jitter):
    """Steps are counted through jitter and holes."""
    for seed in range(5):
        steps, t = stamps(seed, dropped, jitter)
        lattice = find_lattice(t, 101)
        assert lattice is not None
        assert (np.diff(lattice.steps) == np.diff(steps)).mean() > 0.999
        assert lattice.period == pytest.approx(PERIOD * (1.0 + 3e-5), rel=2e-5)


def test_irregular_stamps_are_no_lattice():
    """Stamps that are no lattice are not called one."""
    _steps, t = stamps(0, 0.0, 0.5)
    assert find_lattice(t, 101) is None
    assert find_lattice(np.cumsum(np.random.default_rng(1).exponential(PERIOD, 4000)), 101) is None


def moving(t: np.ndarray) -> np.ndarray:
    return np.column_stack([np.sin(3.0 * t), np.cos(2.0 * t)])


def test_rows_are_sorted_by_their_stamps():
    """Rows in another order are sorted by their stamps."""
    t = PERIOD * np.arange(1000)
    order = np.arange(1000)
    order[[200, 201, 600, 601]] = [201, 200, 601, 600]
    sorted_log = in_order(Recording.of(t[order], moving(t)[order], moving(t)[order]))
    np.testing.assert_array_equal(sorted_log.t, t)
    np.testing.assert_array_equal(sorted_log.q, moving(t))
    assert "sorted by their stamps" in sorted_log.notes[0]


def test_jitter_leaves_rows_in_order():
    """Stamps that jitter past each other leave the rows in order."""
    t = PERIOD * np.arange(1000)
    late = t + 0.6 * PERIOD * np.random.default_rng(0).normal(size=1000)
    ordered = in_order(Recording.of(late, moving(t), moving(t)))
    np.testing.assert_array_equal(ordered.q, moving(t))
    assert (np.diff(ordered.t) >= 0.0).all() and "rows are in order" in ordered.notes[0]


def test_two_logs_are_not_interleaved():
    """Two logs in one file are not interleaved."""
    t = np.concatenate([PERIOD * np.arange(500), PERIOD * np.arange(500)])
    log = Recording.of(t, moving(t), moving(t))
    assert in_order(log) is log


def test_samples_read_twice_are_left_out():
    """Samples read twice are left out while the robot moves."""
    t = PERIOD * np.arange(1000)
    q = moving(t)
    again = [300, 500, 501]
    q[again] = q[[299, 499, 499]]
    clock = find_clock(Recording.of(t, q, q))
    assert np.flatnonzero(~clock.keep).tolist() == again
    standing = np.repeat(q[:1], 1000, axis=0)
    standing[700:] = moving(t[700:])
    assert find_clock(Recording.of(t, standing, standing)).keep.all()
