"""Output and input error with joint torque sensors and a payload stack: derivatives, recovery, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest
from small_arm import sensed

from calib.dynamics.torque_rows import BOTH, DRIVE, LINK, MOTOR, POWER
from calib.errors import UsageError
from calib.identification.closed_loop.loop_recordings import close_loops
from calib.identification.loop import LoopSettings
from calib.identification.methods.method import IdentificationProblem
from calib.identification.registry import METHODS
from calib.identification.settings import IdentificationSettings, require_usable
from calib.identification.survey.output_error import _Comparison
from calib.identification.survey.simulated_robot import believed_robot


def comparison(problem: IdentificationProblem, method: str) -> _Comparison:
    loops = close_loops(problem.model, problem.cases, problem.decimator, problem.loop)
    return _Comparison(problem, believed_robot(problem, METHODS[method]), loops, method == "clie")


@pytest.mark.slow  # the kernel takes 14 s to compile
@pytest.mark.parametrize(("method", "rows"), [("cloe", LINK), ("clie", BOTH)])
def test_sensor_jacobian_is_of_differences(method, rows):
    """The Jacobian of sensor rows is that of differences."""
    problem, truth = sensed(rows, 0, 0.0)
    task = comparison(problem, method)
    start = task.whole(truth, np.array([0.2, 0.1]))
    residual, slopes = task.linearised(start)
    assert residual.shape[1] == 4 and slopes.shape[2] == len(start)
    assert (len(start) > len(truth)) == (rows is LINK)  # inertia, friction and offset of each motor
    for k in range(0, len(start), 5):
        step = 1e-5 * max(abs(start[k]), 0.1)
        ahead, behind = (task.linearised(start + sign * step * np.eye(len(start))[k])[0] for sign in (1.0, -1.0))
        away = np.abs((behind - ahead) / (2.0 * step) - slopes[:, :, k])
        assert np.median(away) < 1e-6 * np.abs(slopes[:, :, k]).max()  # at the others the steps' number changes


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "rows"), [("cloe", LINK), ("cloe", BOTH), ("clie", BOTH), ("iv", BOTH), ("didim", LINK)]
)
def test_payload_with_sensors_within_sigma(method, rows):
    """A stack of recordings with payload and sensors is recovered within sigma."""
    away = []
    for seed in range(3):
        problem, truth = sensed(rows, seed, 1e-4)
        found = METHODS[method].estimate(problem)
        assert found.found
        away.append((found.estimate.values - truth) / found.estimate.sigma)
    assert np.mean(np.abs(away) < 2.0) > 0.85 and np.abs(away).max() < 6.0


LOOP = LoopSettings(controller="pd", kp=(1.0,), kd=(1.0,))


@pytest.mark.parametrize(
    ("method", "rows", "works", "fails"),
    [
        ("clie", LINK, "wls iv didim pc-iv cloe", "clie ml ekf"),
        ("cloe", POWER, "wls irls", "iv didim clie"),
        ("ekf", BOTH, "wls iv cloe clie", "ml ukf"),
        ("didim", DRIVE, "wls pc-wls tls", "iv pc-didim"),
    ],
)
def test_foreign_torque_rows_are_refused(method, rows, works, fails):
    """Torque rows that a method does not take are refused with all that do."""
    settings = IdentificationSettings(method=method, torque_rows=rows, loop=LOOP)
    with pytest.raises(UsageError, match=f"rows = '{rows.name}' is not supported; methods that support it: ") as caught:
        require_usable(settings, METHODS[method])
    named = str(caught.value).split(": ")[-1].split(", ")
    assert set(works.split()) <= set(named) and not set(fails.split()) & set(named)
    assert all(METHODS[name].takes(rows) for name in named)


def test_friction_is_what_the_method_takes():
    auto = IdentificationSettings(torque_rows=MOTOR, loop=LOOP)
    assert [require_usable(auto, METHODS[name]).friction for name in ("iv", "didim", "cloe", "ekf", "wls")] == [
        "auto", "auto", "standard", "standard", "auto",
    ]  # fmt: skip
    assert require_usable(replace(auto, friction="stribeck"), METHODS["clie"]).friction == "stribeck"
    with pytest.raises(UsageError, match=r"standard friction only.* methods that support it: .*iv"):
        require_usable(replace(auto, friction="stribeck"), METHODS["ukf"])


def test_friction_without_slopes_is_refused():
    """Friction without derivatives is refused by name."""
    from calib.dynamics import drives
    from calib.dynamics.shapes import RecordedRange

    problem, _ = sensed(BOTH, 0, 0.0)
    terms = drives.offered("presliding", 0, RecordedRange(0.2, 2.0, 3.0, 3.0))
    rows = tuple(one.extend(terms, np.ones((*one.target.shape, len(terms)))) for one in problem.rows)
    found = replace(problem, rows=rows, terms=(*problem.terms, *terms))
    with pytest.raises(Exception, match=r"no derivatives .* iv and didim support it"):
        comparison(found, "cloe").linearised(np.zeros(len(found.terms)))
