"""The demonstration ends in a certificate, a robot other programs read, and errors near the instrument's."""

import json
from pathlib import Path

import numpy as np
import pytest
from without_figures import run

from calib import cli
from calib.procedure.session import steps
from calib.procedure.session.folder import open_session
from calib.robot.formats import urdf
from calib.robot.kinematics import forward
from calib.robot.library import load


@pytest.mark.slow
def test_demo_of_the_lwr4plus(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    out = tmp_path / "demo"
    assert run("demo", "--geometry-only", "--out", out) == 0
    said = capsys.readouterr().out
    for name in ("certificate.html", "4-fit", "6-export/robot.urdf"):
        assert str(out / name) in said.replace("\n", "") and (out / name).exists()
    assert "hidden truth" in said
    assert {state.kind for state in steps.states(open_session(out))} == {steps.DONE}
    truth = json.loads((out / "truth.json").read_text())["position_mm"]
    nominal, calibrated = truth["nominal"], truth["calibrated"]
    assert calibrated < nominal / 8
    found = json.loads((out / "5-validation/metrics.json").read_text())["validation"]["validation_measured.csv"]
    assert found["calibrated"]["position_mm"]["rms"] < found["urdf_alone"]["position_mm"]["rms"] < nominal
    assert found["calibrated"]["position_mm"]["rms"] == pytest.approx(calibrated, rel=0.25)  # 20 poses against 2000
    chain, read = load(out / "6-export"), urdf.read(out / "6-export/robot_for_corrections.urdf")
    q = np.random.default_rng(0).uniform(-1.5, 1.5, (5, 7))
    np.testing.assert_allclose(forward(read, q), forward(chain, q), atol=1e-9)
    assert run("demo", "--out", out) == 2


@pytest.mark.slow
@pytest.mark.parametrize("robot", ["ur10e", "rv2sq"])
def test_demo_of_other_robots(robot: str, tmp_path: Path) -> None:
    assert cli.run(["demo", "--out", str(tmp_path / "demo"), "--robot", robot, "--seed", "3"]) == 0
