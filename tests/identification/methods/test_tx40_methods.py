"""Claims on six joints: the survey's TX40 at its lowest noise, encoders in the loop; slow."""

import numpy as np
import pytest

from calib.apps.studies.conditions import Condition
from calib.apps.studies.experiment import make_experiment
from calib.identification.registry import METHODS

# torque error [%] on unseen motion, size of the errors in stated standard deviations (None: biased by more than their
# sigma, since filtered positions round off friction's reversals), and duration of the motion [s], which methods that
# simulate the loop over and over need less of
EXPECTED = {
    "ml": (0.4, None, 10.0), "adaline": (10.0, 1.5, 10.0), "hopfield": (3.0, 1.5, 10.0), "srekf": (1.0, None, 10.0),
    "cloe": (0.05, 1.6, 4.0), "clie": (0.4, 1.4, 4.0),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", EXPECTED)
def test_a_tx40_is_recovered(name: str) -> None:
    percent, sigmas, duration = EXPECTED[name]
    data = make_experiment(Condition("lowest noise", "tx40", np.deg2rad(1e-4), 0.05, duration=duration), 0)
    found = METHODS[name].estimate(data.problem)
    assert found.found
    assert name != "cloe" or found.iterations <= 10  # slopes pass the low-pass of the positions; 18 where they did not
    wrong = data.matrix @ found.estimate.values - data.torque
    assert 100.0 * np.linalg.norm(wrong) / np.linalg.norm(data.torque) < percent
    away = (found.estimate.values - data.truth) / found.estimate.sigma
    assert sigmas is None or np.sqrt(np.mean(away**2)) < sigmas
