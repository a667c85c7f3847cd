"""Claims of output and input error: their sigma covers, each is best where its signal is clean, failures are named."""

from dataclasses import replace

import numpy as np
import pytest
from small_arm import LOOP, problem, truth

from calib.errors import UsageError
from calib.identification.methods.method import EstimateStatus
from calib.identification.registry import METHODS


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "noise"),
    [("clie", (0.0, 0.1)), ("cloe", (2e-5, 0.0)), pytest.param("clie", (2e-5, 0.05), marks=pytest.mark.slow)],
)
def test_the_stated_sigma_covers(name, noise):
    """Noise of the torque sensor, or of encoders in the loop, which makes the residuals anything but white."""
    found = [METHODS[name].estimate(problem(seed, *noise)) for seed in range(4)]
    assert all(one.found and one.simulations >= one.iterations > 0 for one in found)
    away = np.array([(one.estimate.values - truth()) / one.estimate.sigma for one in found])
    assert 0.6 < np.sqrt(np.mean(away**2)) < 1.4
    assert np.mean(np.abs(away) < 2.0) > 0.85


@pytest.mark.slow
def test_each_is_better_on_its_clean_signal():
    """The method of torques and that of positions are each better where their signal is clean."""
    heard, seen = problem(0, 0.0, 0.1), problem(0, 2e-5, 0.0)
    error = {
        (name, where): np.linalg.norm(METHODS[name].estimate(one).estimate.values - truth())
        for name in ("cloe", "clie") for where, one in (("heard", heard), ("seen", seen))
    }  # fmt: skip
    assert error["cloe", "heard"] < 0.1 * error["clie", "heard"]  # positions know nothing of the torque sensor
    assert error["cloe", "seen"] < error["clie", "seen"]


@pytest.mark.slow
def test_unfollowable_loop_is_a_status():
    """A loop that cannot be followed is a status, not an exception."""
    one = problem(0)
    wild = replace(one, loop=replace(LOOP, kp=(9e6, 6e6), kd=(4e5, 3e5)), start=truth())
    for name in ("cloe", "clie"):
        found = METHODS[name].estimate(wild)
        assert found.status is EstimateStatus.DIVERGED and not found.found
        assert "diverged" in str(found.failure)


@pytest.mark.slow
def test_impossible_start_is_a_status():
    """A start that no robot has is a status."""
    one = problem(0)
    found = METHODS["clie"].estimate(replace(one, start=-truth()))
    assert found.status is EstimateStatus.CANNOT_BE_SIMULATED and "not positive definite" in str(found.failure)
    near = METHODS["clie"].estimate(replace(one, start=1.2 * truth()))
    plain = METHODS["clie"].estimate(one)
    assert np.abs((near.estimate.values - plain.estimate.values) / plain.estimate.sigma).max() < 0.3


def test_nothing_is_compared_without_a_loop():
    """Without a loop nothing can be compared."""
    with pytest.raises(UsageError, match="needs a"):
        METHODS["cloe"].estimate(replace(problem(0), loop=None))
