"""Steps to robots that cannot be simulated: halved, from either end."""

import numpy as np
import pytest

from calib.errors import CannotSimulate, UsageError
from calib.identification.closed_loop import simulated_runs
from calib.identification.closed_loop.simulation import Plant
from calib.simulation import known_robots


@pytest.mark.parametrize(("stable", "share"), [(0.6, 0.5), (0.3, 0.25), (0.02, 2.0**-6)])
def test_step_is_halved_until_stable(monkeypatch: pytest.MonkeyPatch, stable: float, share: float) -> None:
    """The step is halved until the loop is stable."""
    start, end = step(monkeypatch, stable)
    plant, runs = simulated_runs.nearer(start, end, [])
    assert runs == [] and plant.parameters[0] == share


def test_unstable_steps_are_the_error(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where no part of the step is stable, that is the error."""
    start, end = step(monkeypatch, 0.0)
    with pytest.raises(
        CannotSimulate, match="no parameters between the start and the estimate can be simulated: unstable"
    ):
        simulated_runs.nearer(start, end, [])


def step(monkeypatch: pytest.MonkeyPatch, stable: float) -> tuple[Plant, Plant]:
    """Return two plants with parameters 0 and 1; up to `stable` between them the loop can be simulated."""

    def runs(plant: Plant, cases: list) -> list:
        if plant.parameters[0] > stable:
            raise UsageError("unstable")
        return []

    monkeypatch.setattr(simulated_runs, "simulated_runs", runs)
    plant = known_robots.plant("tx40", coupled=True)
    zero, one = np.zeros_like(plant.parameters), np.ones_like(plant.parameters)
    return plant.with_parameters(zero), plant.with_parameters(one)
