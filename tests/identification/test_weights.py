"""Weights from repeats: the file's variances say how the joints are weighed, not what the model cannot explain."""

from dataclasses import replace

import numpy as np
import planted_motion as planted
import pytest

from calib import cli
from calib.data.recordings.recording_files import read_recording
from calib.data.signals.motion import FilterOptions, make_motion
from calib.estimation.linear import wls
from calib.identification.identify import identify
from calib.identification.identify_options import parse_options
from calib.identification.rows import make_case
from calib.identification.settings import IdentificationSettings

SINGLE = np.array([0.2, 4.0, 0.1])  # standard deviations of one sample over the periods [N m]
PERIODS = 4


def averaged(**more: np.ndarray) -> dict[str, np.ndarray]:
    """Return what `calib recall` writes: variances of one sample, and how many periods were averaged."""
    count = len(planted.motion(0)[0])
    return {"variance_tau": np.tile(SINGLE**2, (count, 1)), "periods": np.array(PERIODS), **more}


def test_reader_carries_variance_of_mean(tmp_path):
    """The reader carries the variance of the mean."""
    path = planted.write(tmp_path, "avg.npz", 0, **averaged())
    recording = read_recording(path)
    np.testing.assert_allclose(recording.effort_variance, SINGLE**2 / PERIODS)
    assert not any("periods" in note for note in recording.notes)
    np.testing.assert_allclose(read_recording(f"{path}@2:9").effort_variance, SINGLE**2 / PERIODS)


def test_weights_come_from_repeats_alone():
    """Joint 3's torque has a share the model lacks: its residuals grow, what the repeats say of it does not."""
    case = planted.case("a", 0, noise=0.05)
    wrong = np.array(case.target)
    wrong[:, 2] += 3.0 * np.sin(5.0 * case.motion.q[:, 2])
    case = replace(case, target=wrong, noise=SINGLE)
    settings = IdentificationSettings(friction="standard", essential="none", prior="none")
    plain, repeats = (identify(planted.arm(), [case], replace(settings, weights=w)) for w in ("residuals", "repeats"))
    assert plain.fitted.std[2] > 5 * plain.fitted.std[1]
    np.testing.assert_allclose(repeats.fitted.std / repeats.fitted.std[0], SINGLE / SINGLE[0])
    fitted = repeats.fitted
    assert wls(fitted.pooled, fitted.std).estimate.residual_std == pytest.approx(1.0), "residuals tell the scale"
    louder = identify(planted.arm(), [replace(case, noise=10 * SINGLE)], replace(settings, weights="repeats"))
    np.testing.assert_allclose(louder.fitted.std, fitted.std, rtol=1e-6)


@pytest.mark.parametrize("prior", ["none", "cad"])
def test_file_and_option_reach_the_weights(tmp_path, prior):
    """The file and the option reach the weights."""
    recording = read_recording(planted.write(tmp_path, "avg.npz", 0, **averaged()))
    case = make_case("avg", make_motion(recording, FilterOptions(cutoff=30.0, band=10.0)), gains=np.array([1.0, -1, 2]))
    np.testing.assert_allclose(case.noise, SINGLE / np.sqrt(PERIODS) * [1.0, 1.0, 2.0])
    settings = parse_options({"weights": "repeats", "friction": "standard", "prior": prior}).settings
    found = identify(planted.arm(), [case], settings)
    assert (found.prior is not None) == (prior == "cad")
    np.testing.assert_allclose(found.fitted.std / found.fitted.std[0], case.noise / case.noise[0])


@pytest.mark.parametrize(
    ("content", "method", "said"), [({}, "wls", "has no variances"), (averaged(), "ols", "needs method wls")]
)
def test_unsuited_recordings_are_refused(robot, tmp_path, capsys, content, method, said):
    """Recordings that cannot be weighed by their repeats are refused."""
    path, options = planted.write(tmp_path, "avg.npz", 0, **content), tmp_path / "options.toml"
    options.write_text('weights = "repeats"\nfriction = "standard"\n')
    out = tmp_path / "out"
    arguments = (robot, path, "--options", options, "--method", method, "--out", out)
    assert cli.run(["identify", *map(str, arguments)]) == 2
    assert said in capsys.readouterr().err and not out.exists()
