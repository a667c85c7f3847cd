"""Claims of what takes a loop for granted: a loop stated wrongly is named, by recorded torques; a right one never."""

import re
from dataclasses import asdict, replace

import numpy as np
import pytest
from small_arm import LOOP, problem, robot

from calib.errors import UsageError
from calib.identification.closed_loop.simulated import LoopDisagreement, LoopTest, compare_with_loop, disagreement
from calib.identification.methods.constraint_settings import ConstraintSettings, CurvedConstraint
from calib.identification.registry import METHODS
from calib.procedure.dynamic_stage.plausibility import another_loop
from calib.procedure.findings import level_of
from calib.records import read_record


def judged(name: str, *noise: float, seed: int = 0, **loop) -> tuple[LoopDisagreement | None, LoopTest]:
    """Return what is said of an estimate of the small arm with a loop changed, and the test beside it."""
    one = replace(problem(seed, *noise), loop=replace(LOOP, **loop))
    found = METHODS[name].estimate(one)
    assert found.found
    test = compare_with_loop(one, found)
    return disagreement(one, found, test), test


def times(factor: float) -> dict:
    return {"kp": tuple(factor * np.array(LOOP.kp)), "kd": tuple(factor * np.array(LOOP.kd))}


@pytest.mark.slow  # the kernel of cloe takes 14 s to compile
def test_wrong_gains_are_named_with_factor():
    """Of cloe every parameter is off by it; what instruments say of least squares there is not said."""
    found, test = judged("cloe", 1e-5, 0.05, **times(2.0))
    assert found is not None and found.beside == "iv" and found.sigmas > 100.0
    np.testing.assert_allclose(found.factor, 2.0, rtol=0.02)
    (finding,) = another_loop(found)
    assert level_of(finding) == "fail" and finding.values["times"] == pytest.approx(2.0, rel=0.02)
    (loop,) = test.findings(is_estimate=False)
    assert (loop.code, loop.values["joints"]) == ("loop-gains-off", ("2 times at joint 1", "2 times at joint 2"))
    assert read_record(LoopDisagreement, asdict(found)) == found


@pytest.mark.slow  # as above
def test_velocity_formed_otherwise_is_named():
    """Half a period of it is inertia: the residuals of positions hold nothing of it."""
    found, test = judged("cloe", 1e-5, 0.02, reference_velocity="difference")
    assert found is not None and test.found is not None and not len(test.found.off)
    (finding,) = another_loop(found)
    assert level_of(finding) == "marginal" and finding.values["velocity"] == "reference_velocity"
    np.testing.assert_allclose(found.factor, 1.0, atol=0.1)


@pytest.mark.slow
def test_noise_beyond_smoothed_sign_is_borne():
    """Noise in the loop wider than the smoothed sign is told, and leaves IV right."""
    noisy = problem(0, 1e-3, v0=0.005)
    test = compare_with_loop(noisy, METHODS["iv"].estimate(noisy))
    assert test.found is not None and np.all(test.found.noise[0].share > 0.9)
    plant, _, base = robot(0.005)
    estimate = test.found.fit.estimate
    away = (estimate.values - base.transform @ plant.parameters) / estimate.sigma
    assert np.abs(away).max() < 2.5


@pytest.mark.slow
@pytest.mark.parametrize("name", ["cloe", "clie"])
@pytest.mark.parametrize("noise", [(0.0, 0.05), (2e-5, 0.02), (5e-4, 0.1), (1e-3, 0.05)])
def test_right_loop_is_not_remarked_upon(name: str, noise: tuple[float, float]):
    """Nothing is said of a loop that is right; with 2 mrad of noise clie says of one seed that it did not converge."""
    for seed in range(3):
        found, test = judged(name, *noise, seed=seed)
        assert found is None
        assert "loop-gains-off" not in [one.code for one in test.findings(is_estimate=False)]


@pytest.mark.parametrize("name", ["iv", pytest.param("didim", marks=pytest.mark.slow)])
def test_robust_estimates_get_a_note(name: str):
    """Estimates that bear another loop come with a note."""
    found, test = judged(name, 1e-5, 0.05, **times(0.5))
    assert found is None and "loop-gains-off" in [one.code for one in test.findings(is_estimate=True)]
    assert test.found is not None
    np.testing.assert_allclose(test.found.stray, 0.5, rtol=0.05)


@pytest.mark.slow
def test_loop_explaining_too_little_is_named():
    """0.8 of the reference's velocity, whose gains no tracking error tells: 4 for 2 %, and 6 for 0.8."""
    _, test = judged("iv", 1e-5, 0.05, share=0.8, timing="stated")
    (said,) = test.findings(is_estimate=True)
    assert said.code == "loop-unexplained"
    assert [row[-10:] for row in said.values["rows"]] == ["at joint 1", "at joint 2"]


@pytest.mark.slow
def test_weak_instruments_are_named():
    """Positions of 1.5 mrad noise: Cragg-Donald 8.8; of 2 mrad the estimate does not settle."""
    _, test = judged("iv", 1.5e-3, 0.05)
    (said,) = test.findings(is_estimate=True)
    assert said.code == "weak-instruments" and 5.0 < said.values["donald"] < 10.0
    failed = METHODS["iv"].estimate(problem(0, 2e-3, 0.05)).failure
    weak = re.search(r"The instruments are weak \(Cragg-Donald (\S+), sound above 10", str(failed))
    assert weak is not None and float(weak[1]) < 10.0


def test_wrong_derivative_is_refused_in_loop():
    """A wrong derivative of a curved constraint is refused in a simulated loop, too."""
    curved = CurvedConstraint(lambda Fv1, Fv2: 1.0 - Fv1 * Fv2, lambda Fv1, Fv2: (-Fv2, Fv1), "product")
    with pytest.raises(UsageError, match=r"'product': its derivative by Fv2 is stated as .* differences of h give -"):
        METHODS["pc-iv"].estimate(replace(problem(0, 1e-3, 0.05), constraints=ConstraintSettings(curved=(curved,))))
