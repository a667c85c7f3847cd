"""A load in one of several recordings is found with its mass; recordings alike, or unlike otherwise, tell of none."""

from dataclasses import replace

import numpy as np
import planted_motion as planted
import pytest

from calib.dynamics.bodies import bodies_of
from calib.identification.checks.recorded_motion import MotionSamples, take_samples
from calib.identification.checks.unstated_load import unstated_load

MASS = planted.PAYLOAD[9]


def samples(seed: int, loaded: bool = False, friction: float = 0.0) -> MotionSamples:
    """Return a recording of the planted arm, with `friction` [N m] more at every joint."""
    taken = take_samples(planted.case(f"{seed}", seed, ("load",) * loaded), bodies_of(planted.arm()), 500)
    assert taken is not None
    return replace(taken, effort=taken.effort + friction * np.tanh(taken.velocity / 0.05))


@pytest.mark.parametrize("count", [2, pytest.param(3, marks=pytest.mark.slow)])
@pytest.mark.parametrize("place", [0, 1])
def test_loaded_recording_is_named_with_mass(count: int, place: int):
    """The loaded recording is named with its mass."""
    load = unstated_load({f"{seed}": samples(seed, loaded=seed == place) for seed in range(count)})
    assert load is not None and load.name == f"{place}"
    assert load.mass == pytest.approx(MASS, abs=4.0 * load.sigma) and load.sigma < 0.1 * MASS
    assert load.after < 0.5 * load.before


@pytest.mark.parametrize("loaded", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_recordings_alike_tell_of_no_load(loaded: bool):
    for seed in range(3):
        assert unstated_load({f"{k}": samples(k, loaded) for k in (seed, seed + 1)}) is None
    assert unstated_load({"one": samples(0, True)}) is None


def test_friction_of_another_day_is_no_load():
    assert unstated_load({"cold": samples(0, friction=3.0), "warm": samples(1)}) is None


def test_scaled_torques_are_no_load():
    """Torques scaled in one recording are no load."""
    scaled = samples(1)
    assert unstated_load({"0": samples(0), "1": replace(scaled, effort=1.3 * scaled.effort)}) is None


def test_unseen_mass_is_not_stated():
    """A mass that the motion does not tell is not stated."""
    still = []
    for taken in (samples(0), samples(1, loaded=True)):
        q, v, a = np.array(taken.q), np.array(taken.v), np.array(taken.a)
        q[:, 1:], v[:, 1:], a[:, 1:] = 0.0, 0.0, 0.0
        still.append(replace(taken, q=q, v=v, a=a))
    assert unstated_load({"0": still[0], "1": still[1]}) is None
