"""The commands on parallel robots: identify, excite, fit; what they refuse, and what is for serial arms."""

from __future__ import annotations

import json

import numpy as np
import pytest

from calib.cli import run
from calib.mechanism import library as parallel
from calib.mechanism import parallel_files
from calib.mechanism.closure import closed, place
from calib.mechanism.computed_torque import ComputedTorque, simulate
from calib.mechanism.geometric_fit import changed, loop_parameters
from calib.mechanism.parallel_model import make_parallel_model
from calib.robot import library

HEAD = "t,q1,q2,q3,q4,tau1,tau2,tau3,tau4"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return a folder with logs of a DualV without and with payload, and measured poses of another geometry."""
    path = tmp_path_factory.mktemp("dualv")
    known = closed(parallel_files.read(parallel.path("dualv")))
    model = make_parallel_model(known, ["Fv Fc"], v0=0.05, payloads=["5"])
    values = np.concatenate([model.known_parameters(), np.tile([0.05, 0.3], 4)])
    values[model.names.index("M5")] = 5.37
    t, rng = np.arange(2500)[:, None] / 1000.0, np.random.default_rng(0)
    for name, carried in (("empty", ()), ("load", ("5",)), ("other", ("5",))):
        x, v, a = np.zeros((3, len(t), 3))
        for frequency in (1.5, 2.5, 4.0, 5.5):
            w, size, phase = 2 * np.pi * frequency, np.array([0.02, 0.02, 0.12]), rng.uniform(0, 6, 3)
            x, v = x + size * np.sin(w * t + phase), v + size * w * np.cos(w * t + phase)
            a = a - size * w**2 * np.sin(w * t + phase)
        controller = ComputedTorque(values, preload=10.0, encoder=1e-5, torque=0.5)
        log = simulate(model, values, controller, x, v, a, carried)
        table = np.column_stack([log.t, log.q, log.tau])
        np.savetxt(path / f"{name}.csv", table, delimiter=",", header=HEAD, comments="")
        if name == "empty":
            table[:, [1, 2]] = table[:, [2, 1]]
            np.savetxt(path / "swapped.csv", table, delimiter=",", header=HEAD, comments="")
            table = np.column_stack([log.t, log.q[:, :3], log.tau[:, :3]])
            np.savetxt(path / "three.csv", table, delimiter=",", header="t,q1,q2,q3,tau1,tau2,tau3", comments="")
    files = '[payload.5]\n[files."load.csv"]\npayload = ["5"]\n[files."other.csv"]\npayload = ["5"]\n'
    (path / "options.toml").write_text(files)
    (path / "power.toml").write_text('rows = "power"\n' + files)
    parameters = loop_parameters(known)
    true = closed(changed(known.robot, parameters, 1e-3 * rng.normal(size=len(parameters))))
    x = 0.9 * rng.uniform(known.robot.lower, known.robot.upper, (60, 3))
    q = place(true, x).q[:, known.robot.actuated] + 1e-5 * rng.normal(size=(60, 4))
    motors = "motor1 [deg],motor2 [deg],motor3 [deg],motor4 [deg]"
    table = np.column_stack([np.degrees(q), 1e3 * x[:, :2], np.degrees(x[:, 2])])
    np.savetxt(path / "poses.csv", table, delimiter=",", header=motors + ",x [mm],y [mm],rz [deg]", comments="")
    np.savetxt(path / "readings.csv", table[:, :4], delimiter=",", header=motors, comments="")
    np.savetxt(path / "passive.csv", table[:, :5], delimiter=",", header=motors + ",elbow1 [deg]", comments="")
    return path


def calib(*words) -> int:
    return run([str(word) for word in words])


@pytest.mark.parametrize("options", ["options", pytest.param("power", marks=pytest.mark.slow)])
def test_identify_finds_the_payload_and_predicts_other_motion(folder, tmp_path, options):
    out = tmp_path / "id"
    files = [folder / name for name in ("empty.csv", "load.csv")]
    words = ["--validate", folder / "other.csv", "--options", folder / f"{options}.toml", "--out", out, "--no-plots"]
    assert calib("identify", "dualv", *files, *words) == 0
    table = json.loads((out / "dynamics.json").read_text())
    assert abs(table["values"]["M5"] / 5.37 - 1.0) < 0.02
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["validation"]["other.csv"]["filtered"]["relative_error_percent"]["total"] < 5.0
    assert metrics["rows"] == (["power"] if options == "power" else ["x", "y", "rz"])
    assert (
        calib("identify", out, *files, "--options", folder / "options.toml", "--out", tmp_path / "again", "--no-plots")
        == 0
    )


@pytest.mark.slow
def test_fit_then_identify_on_the_calibrated_geometry(folder, tmp_path, capsys):
    fitted = tmp_path / "fit"
    assert calib("fit", "dualv", folder / "poses.csv", "--out", fitted) == 0
    metrics = json.loads((fitted / "metrics.json").read_text())
    assert metrics["platform_rms"]["calibrated"]["rz"] < 0.02 * metrics["platform_rms"]["nominal"]["rz"]
    assert calib("identify", fitted, folder / "empty.csv", "--out", tmp_path / "id", "--no-plots") == 0
    assert calib("fit", "dualv", folder / "readings.csv", "--out", tmp_path / "alone") == 0
    assert "scale and place" in capsys.readouterr().out


@pytest.mark.slow
def test_excite_writes_a_motion_within_the_limits(tmp_path):
    out = tmp_path / "motion"
    words = ("--period", 1, "--harmonics", 3, "--starts", 1, "--evaluations", 8, "--drives", "Fv Fc", "--out", out)
    assert calib("excite", "dualv", *words) == 0
    metrics = json.loads((out / "metrics.json").read_text())
    assert max(metrics["peak_torque"]) < 127.0 and min(one["margin"] for one in metrics["margins"]) > -1e-9
    rows = np.loadtxt(out / "motion.csv", delimiter=",", skiprows=1)
    assert rows.shape == (1001, 1 + 3 + 3 * 4) and np.abs(rows[:, 1:3]).max() <= 0.08


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("identify", "dualv", "three.csv"), "3 joints"),
        (("identify", "dualv", "swapped.csv"), "swapped.csv: sample 1: the loops"),
        (("identify", "dualv", "load.csv", "--method", "didim"), "simulates a serial arm"),
        (("identify", "dualv", "load.csv", "--friction", "stribeck"), "standard friction only"),
        (("fit", "dualv", "passive.csv"), "passive joint"),
        (("fit", "dualv", "three.csv"), "'motor1' is missing"),
        (("excite", "dualv", "--lock", "motor1"), "--lock is for serial arms"),
        (("plan", "dualv", "--waypoints", "poses.csv"), "calib plan is for serial arms"),
        (("select", "dualv"), "calib select is for serial arms"),
        (("new", "--robot", "dualv", "--instrument", "cmm"), "calib new is for serial arms"),
    ],
)
def test_what_is_wrong_is_said(folder, tmp_path, capsys, words, said):
    command, *rest = [folder / word if word.endswith(".csv") else word for word in words]
    out = tmp_path / "out"
    given = [out, *rest] if command == "new" else [*rest, "--out", out]
    assert calib(command, *given) == 2
    assert said in capsys.readouterr().err


@pytest.mark.slow
def test_a_payload_on_board_of_every_run_is_told(folder, tmp_path, capsys):
    words = ("--options", folder / "options.toml", "--out", tmp_path / "id", "--no-plots")
    assert calib("identify", "dualv", folder / "load.csv", *words) == 0
    assert "a run without it tells them apart" in capsys.readouterr().out


def test_parallel_robots_are_in_no_list_of_serial_arms():
    assert not set(parallel.names()) & set(library.names()) and "dualv" in parallel.names()
