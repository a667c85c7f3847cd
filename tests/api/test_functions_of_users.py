"""What a script adds of its own: candidate poses and a loss, given to one call."""

from pathlib import Path

import numpy as np
import pytest

import calib
from calib.data.poses.measurements import PoseMeasurements
from calib.errors import UsageError

GEOMETRY = calib.FitSettings(model="geometry")


@pytest.fixture(scope="module")
def robot() -> calib.CalibratedChain:
    return calib.load("ur5")


@pytest.fixture(scope="module")
def candidates() -> np.ndarray:
    return np.random.default_rng(1).uniform(-2.0, 2.0, (200, 6))


@pytest.fixture(scope="module")
def chosen(robot, candidates) -> calib.PoseSelection:
    return calib.select_poses(robot, 12, candidates=candidates)


@pytest.mark.slow
def test_poses_are_chosen_of_the_candidates_given(robot, candidates, chosen, tmp_path: Path):
    """Of an array, a function and a file; those that break the constraints are left out, and said."""
    np.testing.assert_allclose(candidates[chosen.selection.indices], chosen.q, atol=1e-12)
    assert any("of the 200 candidates break the constraints" in note for note in chosen.notes)
    made = calib.select_poses(robot, 12, candidates=lambda count: candidates)
    np.testing.assert_array_equal(made.q, chosen.q)
    header = ",".join(f"{name} [rad]" for name in robot.chain.joint_names)
    np.savetxt(tmp_path / "own.csv", candidates, delimiter=",", header=header, comments="", fmt="%.17g")
    read = calib.select_poses(robot, 12, candidates=tmp_path / "own.csv")
    np.testing.assert_allclose(read.q, chosen.q, atol=1e-12)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (np.zeros((30, 5)), r"candidates: joint values: expected an array of shape \(any, 6\), found \(30, 5\)"),
        (np.full((30, 6), 100.0), "candidates: 0 of 30 keep the constraints.*30 exceed the joint limits"),
        (np.full((30, 6), np.nan), "candidates: joint values: .*not finite"),
        ("missing.csv", "candidates: missing.csv: cannot be read"),
        (lambda count: None, "candidates: joint values: expected an array"),
    ],
)
def test_wrong_candidates_are_refused(robot, wrong, message):
    with pytest.raises(UsageError, match=message):
        calib.select_poses(robot, 12, candidates=wrong)


def test_methods_that_leave_the_candidates_are_refused(robot, candidates):
    settings = calib.SelectionSettings(method="polish")
    with pytest.raises(UsageError, match="'polish' moves poses away from the candidates: give method = detmax"):
        calib.select_poses(robot, 12, settings, candidates=candidates)


def soft_l1(z: np.ndarray) -> np.ndarray:
    """Return rho, rho', rho'' of scipy's soft_l1."""
    root = np.sqrt(1.0 + z)
    return np.array([2.0 * (root - 1.0), 1.0 / root, -0.5 / root**3])


@pytest.mark.slow
def test_a_loss_of_scipy_withstands_gross_rows(robot):
    """Three rows off by 35 mm; the result names the loss, and can be judged on further rows."""
    rng = np.random.default_rng(2)
    q = rng.uniform(-2.0, 2.0, (40, 6))
    position = robot.forward(q)[:, :3, 3] + rng.normal(0.0, 1e-4, (40, 3))
    position[:3] += 0.02
    measured = PoseMeasurements.of(q, position)
    fit = calib.fit_geometry(robot, measured, GEOMETRY, loss=soft_l1)
    assert fit.selection.loss == "soft_l1()"
    other = rng.uniform(-2.0, 2.0, (50, 6))
    errors = (fit.predict(other).pose - robot.forward(other))[:, :3, 3]
    assert np.sqrt(np.mean(errors**2)) < 3e-4
    unseen = PoseMeasurements.of(other, robot.forward(other)[:, :3, 3])
    assert calib.validate(fit, unseen).validation


@pytest.mark.parametrize(
    ("loss", "message"),
    [
        (lambda: 1.0, r"loss: function\(\) must take one argument, z = \(r/σ\)²"),
        (lambda z: z, r"loss: expected rows rho, rho', rho''"),
        (lambda z: np.array([z**2, z, z]), "row 1 is not the derivative of row 0: at z = 0.0001 it is 0.0001"),
        (lambda z: np.array([-z, 0.0 * z - 1.0]), "rho' is -1 .*must not be negative"),
        (lambda z: np.array([np.full_like(z, np.nan), z]), "not finite"),
        (3.0, "loss: expected a function or None, found 3.0"),
    ],
)
def test_functions_that_are_no_loss_are_refused(robot, loss, message):
    measured = PoseMeasurements.of(np.zeros((1, 6)), np.zeros((1, 3)))
    with pytest.raises(UsageError, match=message):
        calib.fit_geometry(robot, measured, loss=loss)


def test_a_loss_is_given_once(robot):
    measured = PoseMeasurements.of(np.zeros((1, 6)), np.zeros((1, 3)))
    with pytest.raises(UsageError, match="given both as a function and by name"):
        calib.fit_geometry(robot, measured, calib.FitSettings(loss="huber"), loss=soft_l1)
