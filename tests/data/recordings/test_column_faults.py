"""Columns that stand while what they measure moves are found, and sound ones are not."""

from collections.abc import Callable

import numpy as np
import pytest
from recordings import DATA

from calib.data.recordings.column_faults import column_faults

RATE = 100.0
JOINT = 1
Log = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def sound(seed: int = 0) -> Log:
    """Return t, q, torque and v of three joints that move in sines, read with the noise and resolution of a log."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, 20.0, 1.0 / RATE)
    turn = np.outer(t, [1.0, 1.7, 2.3]) + rng.uniform(0.0, 6.0, 3)
    q, v = np.sin(turn), np.array([1.0, 1.7, 2.3]) * np.cos(turn)
    torque = -10.0 * q + 3.0 * np.sign(v) + 0.2 * rng.normal(size=q.shape)
    return t, np.round(q, 4), np.round(torque, 2), v + 0.01 * rng.normal(size=q.shape)


def clipped(log: Log) -> Log:
    t, q, torque, v = log
    bounds = np.array([np.inf, 8.0, np.inf])
    return t, q, np.clip(torque, -bounds, bounds), v


def frozen_position(log: Log) -> Log:
    """Return the log with half a second, from the fastest row on, of one position."""
    t, q, torque, v = log
    first = int(np.argmax(np.abs(v[:-100, JOINT])))
    q[first : first + 50, JOINT] = q[first, JOINT]
    return t, q, torque, v


def frozen_throughout(log: Log) -> Log:
    t, q, torque, v = log
    q[:, JOINT] = 0.3
    return t, q, torque, v


def frozen_velocity(log: Log) -> Log:
    """Return the log with half a second, from the slowest row on, of one velocity."""
    t, q, torque, v = log
    first = int(np.argmin(np.abs(v[:-100, JOINT])))
    v[first : first + 50, JOINT] = v[first, JOINT]
    return t, q, torque, v


def held(log: Log) -> Log:
    """Return the log of a joint that stands for some time: its brake is on, its torque free, its velocity noise."""
    t, q, torque, v = log
    q[:, JOINT] = np.where(t < 8.0, q[0, JOINT], q[0, JOINT] + 0.5 * np.sin(1.5 * (t - 8.0)))
    v[:, JOINT] = np.where(t < 8.0, 0.01 * v[:, 0], 0.75 * np.cos(1.5 * (t - 8.0)))
    return t, q, torque, v


def two_speeds(log: Log) -> Log:
    """Return the log of a joint that turns at one speed and back: pure friction is one value at each."""
    t, q, torque, v = log
    back = (t // 2.0) % 2.0
    q[:, JOINT] = np.where(back == 0.0, t % 2.0, 2.0 - t % 2.0)
    v[:, JOINT] = 1.0 - 2.0 * back
    torque[:, JOINT] = 5.0 * v[:, JOINT] + 0.01 * np.round(100.0 * np.where(t % 2.0 < 0.3, t % 2.0 - 0.3, 0.0))
    return t, q, torque, v


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("changed", [None, held, two_speeds])
def test_sound_columns_are_not_remarked_upon(changed: Callable[[Log], Log] | None, seed: int):
    log = sound(seed)
    t, q, torque, v = log if changed is None else changed(log)
    assert column_faults(t, q, torque, v) == () == column_faults(t, q, torque)


def test_clipped_torque_is_found():
    """A clipped torque is found with both values."""
    t, q, torque, v = clipped(sound())
    (fault,) = column_faults(t, q, torque, v)
    assert (fault.kind, fault.joint, fault.values) == ("clipped", JOINT, (-8.0, 8.0))
    assert 0.2 < fault.share < 0.9


@pytest.mark.parametrize(("freeze", "share"), [(frozen_position, 0.025), (frozen_throughout, 1.0)])
def test_frozen_position_shows_by_velocity(freeze: Callable[[Log], Log], share: float):
    """A position that stands still beside a velocity that does not is found."""
    t, q, torque, v = freeze(sound())
    (fault,) = column_faults(t, q, torque, v)
    assert (fault.kind, fault.joint) == ("position", JOINT)
    assert fault.share == pytest.approx(share, abs=0.002) and fault.missed > 0.25


def test_frozen_position_shows_by_its_jump():
    """A position that stands still and then jumps is found without velocities."""
    t, q, torque, v = frozen_position(sound())
    first = t[np.argmax(np.abs(v[:-100, JOINT]))]
    (fault,) = column_faults(t, q, torque)
    assert (fault.kind, fault.joint) == ("position", JOINT)
    assert (fault.start, fault.stop) == (pytest.approx(first, abs=0.02), pytest.approx(first + 0.49, abs=0.02))


def test_a_velocity_that_stands_is_found():
    t, q, torque, v = frozen_velocity(sound())
    (fault,) = column_faults(t, q, torque, v)
    assert (fault.kind, fault.joint) == ("velocity", JOINT)


@pytest.mark.slow
@pytest.mark.skipif(not DATA.is_dir(), reason=f"no recordings at {DATA}")
def test_only_clipped_recordings_are_found():
    """Open recordings are sound, and clipped ones are found."""
    for path in sorted(DATA.glob("*/*.npz")):
        with np.load(path) as log:
            series = {name: log[name] for name in log.files}
        q = series["q"]
        torque = series["tau"] if "tau" in series else series["i"]
        t = series.get("t", np.arange(len(q)) / RATE)
        assert column_faults(t, q, torque, series.get("dq")) == (), path.name
        if "harm" in path.name:
            bound = 0.7 * np.abs(torque).max(axis=0)
            faults = column_faults(t, q, np.clip(torque, -bound, bound), series.get("dq"))
            assert len({fault.joint for fault in faults if fault.kind == "clipped"}) >= q.shape[1] - 1, path.name
