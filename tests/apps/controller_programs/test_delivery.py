"""`calib deliver`: frames and offsets in a controller's words are those that fit the measurements."""

import re
from pathlib import Path

import numpy as np
import pytest

from calib import cli
from calib.apps.controller_programs.delivery import delivery_text
from calib.controllers.axes import as_described
from calib.controllers.table import controller_named, controllers
from calib.procedure.kinematic_stage.folder import FitFolder
from calib.robot.kinematics import forward
from calib.robot.library import load
from calib.simulation.cell import SimulatedInstrument, measure, write_measured
from calib.simulation.virtual_cells import perturbed_cell
from calib.transforms import from_xyz_rpy, invert, pose

NUMBER = r"(-?\d+\.\d+)"


@pytest.fixture(scope="module")
def fit(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, np.ndarray, np.ndarray]:
    """A fit of joint offsets to 40 poses of a UR5 with errors in every element; joints and measured positions."""
    folder = tmp_path_factory.mktemp("delivery")
    cell = perturbed_cell(load("ur5"), 4, SimulatedInstrument(position_sigma=2e-5, orientation_sigma=5e-5))
    seen = measure(cell, np.random.default_rng(1).uniform(-2.0, 2.0, (40, 6)), 1)
    write_measured(seen, folder / "seen.csv")
    words = ["fit", "ur5", folder / "seen.csv", "--model", "offsets", "--out", folder / "fit", "--no-plots"]
    assert cli.run([str(word) for word in words]) == 0
    return folder / "fit", seen.q, seen.position


def test_nominal_frames_fit_as_metrics_say(fit):
    """The frames of the nominal arm fit as its metrics say."""
    folder, q, seen = fit
    out = delivery_text(folder, controller_named("ros2"))
    assert "Users cannot master the axes" in out and "Mastering of a fit" not in out
    form = " ".join(["xyz", *[NUMBER] * 3]) + ", rpy " + " ".join([NUMBER] * 3)
    found = [from_xyz_rpy(v[:3], v[3:]) for v in np.array(re.findall(form, out), float)]
    points = (invert(found[1]) @ forward(load("ur5"), q) @ found[0])[:, :3, 3]
    rms = 1e3 * np.sqrt(np.mean(np.sum((points - seen) ** 2, axis=1)))
    assert rms == pytest.approx(FitFolder(folder).metrics().fit.nominal.main.rms, rel=1e-4)


def test_offsets_and_frames_fit_better(fit):
    """Offsets, and the frames beside them, fit better."""
    folder, q, seen = fit
    out = delivery_text(folder, controller_named("krl"))
    mastered = out.partition("Mastering of a fit of joint offsets alone: ")[2]
    offsets = np.radians(np.array(re.findall(r"shown angle ([-+]\d+\.\d+) deg", mastered), float))
    names = "".join(rf"{name} {NUMBER}[,}}]" for name in "XYZABC")
    frames = np.array(re.findall("{" + names, mastered), float)
    tool, base = (pose(from_xyz_rpy([0, 0, 0], np.radians(v[[5, 4, 3]]))[:3, :3], 1e-3 * v[:3]) for v in frames)
    points = (invert(base) @ forward(load("ur5"), q + offsets) @ tool)[:, :3, 3]
    rms = 1e3 * np.sqrt(np.mean(np.sum((points - seen) ** 2, axis=1)))
    whole = FitFolder(folder).metrics().fit
    assert rms == pytest.approx(whole.calibrated.main.rms, rel=1e-3) and rms < 0.9 * whole.nominal.main.rms


def test_controllers_say_what_they_take(fit):
    """Every controller says what it takes and what is closed."""
    for name, each in controllers().items():
        out = delivery_text(fit[0], each)
        assert "The controller accepts: " in out and "It does not accept: " in out and "instrument seen: " in out, name


def test_signs_and_coupled_axes_are_undone():
    shown = np.array([0.1, 0.2, 0.3, 0.4, 0.5, 0.6])
    np.testing.assert_allclose(as_described("fanuc", shown), shown + np.array([0, 0, 0.2, 0, 0, 0]), atol=1e-15)
    np.testing.assert_allclose(
        as_described("rapid-parallelogram", shown), shown - np.array([0, 0, 0.2, 0, 0, 0]), atol=1e-15
    )
