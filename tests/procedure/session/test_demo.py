"""The demonstration passes with errors of a real arm's size, says one number a line, and ends with five files."""

import json
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import demo_picture
import numpy as np
import pytest
from without_figures import run

from calib.apps.cell_demo import demo
from calib.apps.cell_demo.step_lines import SECONDS, Telling
from calib.procedure.session import steps
from calib.procedure.session.folder import open_session
from calib.robot.formats import urdf
from calib.robot.kinematics import forward
from calib.robot.library import load
from calib.simulation.virtual_arm import sensed

MAX_LINES, MAX_WIDTH = 25, 60
# of the picture's figures, relative: where linear algebra rounds otherwise the short search for motions ends elsewhere
BOUNDS = {"nominal_mm": 0.01, "calibrated_mm": 0.01, "unexplained_percent": 0.05, "within_two_sigma_percent": 0.12}


def errors(out: Path) -> dict[str, float]:
    """Return the true position errors [mm] of a demonstration, rms over the whole joint range."""
    return json.loads((out / "truth.json").read_text())["position_mm"]


@pytest.mark.slow
def test_both_halves_pass_with_short_console(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """Both halves pass, the console is short, and the README's picture is of such a run."""
    out = tmp_path / "d"
    assert run("demo", "--out", out, "--plots", "png") == 0
    said = capsys.readouterr().out.splitlines()
    verdicts = json.loads((out / "verdict.json").read_text())
    assert verdicts["geometry"]["verdict"] == verdicts["dynamics"]["verdict"] == "pass"
    assert len(said) <= MAX_LINES and all(line.isascii() for line in said)
    told, (blank, *files) = said[:-6], said[-6:]
    assert all(len(re.findall(r"\d+(?:\.\d+)?", line.replace("tx40", ""))) == 1 for line in told)
    assert max(map(len, told)) <= MAX_WIDTH and not blank
    assert all(Path(line.split(maxsplit=1)[1]).exists() for line in files)
    assert 0.3 < errors(out)["nominal"] < 3.0 and 0.05 < errors(out)["urdf_alone"] < 0.3  # as real arms: see the cell
    session, drawn = open_session(out), demo_picture.picture_figures()
    assert {state.kind for state in steps.states(session)} == {steps.DONE}
    fresh = demo_picture.figures(session)
    assert {name: drawn[name] for name in BOUNDS} == {
        name: pytest.approx(fresh[name], rel=bound) for name, bound in BOUNDS.items()
    }
    assert run("demo", "--out", out) == 2


@pytest.mark.slow
def test_hard_arm_says_what_marginal_means(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """The hard arm says what marginal means."""
    out = tmp_path / "d"
    assert run("demo", "--hard", "--geometry-only", "--out", out) == 0
    said = capsys.readouterr().out
    assert "geometry: marginal; why: calib explain rigid-misfit" in said and "read the reasons before" in said
    assert errors(out)["calibrated"] < errors(out)["nominal"] / 8
    found = json.loads((out / "5-validation/metrics.json").read_text())["validation"]["validation_measured.csv"]
    assert found["calibrated"]["position_mm"]["rms"] == pytest.approx(errors(out)["calibrated"], rel=0.25)  # 20 poses
    chain, read = load(out / "6-export"), urdf.read(out / "6-export/robot_for_corrections.urdf")
    q = np.random.default_rng(0).uniform(-1.5, 1.5, (5, 7))
    np.testing.assert_allclose(forward(read, q), forward(chain, q), atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("robot", ["ur10e", "rv2sq"])
def test_demo_of_other_robots(robot: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(demo.MOTION, "evaluations", 50)
    monkeypatch.setitem(demo.MOTION, "period", 6.0)
    assert run("demo", "--out", tmp_path / "demo", "--plots", "png", "--robot", robot, "--seed", "3") == 0


@pytest.mark.slow
def test_demo_by_camera_is_shown(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """To the end, and again by `calib view`: validation images measure no positions, which are empty cells."""
    monkeypatch.setattr(demo, "FIT", 16)
    monkeypatch.setattr(demo, "VALIDATION", 6)
    out = tmp_path / "cell"
    assert run("demo", "--instrument", "camera", "--geometry-only", "--plots", "png", "--out", out) == 0
    truth = errors(out)
    assert truth["urdf_alone"] < truth["nominal"] / 5.0
    pytest.importorskip("rerun")
    assert run("view", out, "--save", tmp_path / "cell.rrd") == 0
    assert (tmp_path / "cell.rrd").stat().st_size > 1e5


def test_hard_names_the_robot(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    assert run("demo", "--hard", "--robot", "tx40", "--out", tmp_path / "d") == 2
    assert "--hard both name a robot" in capsys.readouterr().err


def test_progress_tells_stage_and_time() -> None:
    """Progress tells stage, share and time left."""
    shown: list[str] = []
    session: Any = SimpleNamespace(geometric=True, dynamic=True, needs=False)
    told = Telling(session, print, shown.append)
    for step in steps.steps_of(session):
        told.progress(step.purpose)
        told.progress("some words of its own")
    shares = [int(re.findall(r"^(\d+)% done, \d+ s left: ", words)[0]) for words in shown]
    assert shares == sorted(shares) and shares[0] == 0 and 70 < shares[-1] < 100
    assert all(step.purpose in words for step, words in zip(steps.steps_of(session), shown[::2], strict=True))
    assert set(SECONDS) < {step.name for step in steps.steps_of(session)}


def test_only_torque_sensor_arms_log_torques() -> None:
    """Only arms with torque sensors log them."""
    assert [sensed(robot) for robot in ("lwr4plus", "tx40", "ur10e")] == [True, False, False]
