"""A method's failure is a status that says which; the error that says what to do is kept for who wants it raised."""

from dataclasses import replace

import numpy as np
import planted_motion as planted
import pytest

from calib.errors import CannotSimulate, Diverged, NotConverged, Unidentifiable, UsageError
from calib.identification.methods.method import EstimateStatus, Method, attempted
from calib.identification.registry import METHODS, method_named


@pytest.mark.parametrize("name", ["ols", "wls", "irls", "tls"])
def test_an_estimate_says_how_it_came_about(problem, name):
    method: Method = METHODS[name]
    found = method.estimate(problem)
    assert found.found and found.status is EstimateStatus.FOUND and found.failure is None and found.method == name
    assert found.iterations == 1 and found.simulations == 0 and found.seconds > 0.0
    truth = problem.base.transform @ planted.truth()
    assert np.sqrt(np.mean(((found.estimate.values - truth) / found.estimate.sigma) ** 2)) < 2.0


@pytest.mark.parametrize("name", ["ols", "wls", "irls", "tls"])
def test_dependent_columns_are_a_status(problem, name):
    twice = tuple(
        replace(part, matrix=part.matrix[:, :, [0, 0, *range(2, part.matrix.shape[2])]]) for part in problem.rows
    )
    found = METHODS[name].estimate(replace(problem, rows=twice))
    assert found.status is EstimateStatus.RANK_DEFICIENT and not found.found and found.solution is None
    with pytest.raises(Unidentifiable):
        _ = found.fit


@pytest.mark.parametrize(
    ("error", "status"),
    [
        (Unidentifiable("x"), EstimateStatus.RANK_DEFICIENT),
        (CannotSimulate("x"), EstimateStatus.CANNOT_BE_SIMULATED),
        (Diverged("x"), EstimateStatus.DIVERGED),
        (NotConverged("x"), EstimateStatus.NOT_CONVERGED),
    ],
)
def test_every_way_to_fail_has_its_name(problem, error, status):
    def fails():
        raise error

    found = attempted("some", problem, fails)
    assert found.status is status and found.failure is error
    with pytest.raises(type(error)):
        _ = found.estimate


def test_bad_input_is_no_status(problem):
    with pytest.raises(UsageError, match="loop"):
        METHODS["iv"].estimate(problem)
    with pytest.raises(UsageError, match="'lms' is not one of"):
        method_named("lms")
