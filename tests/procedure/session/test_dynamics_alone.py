"""A session for dynamics alone: the description is taken as calibrated, and a share of the recording judges."""

import csv
import json
import re
from pathlib import Path

import numpy as np
import pinocchio as pin
import planted_motion as planted
import pytest
from sessions import begin, go_on
from without_figures import run

from calib.data.csv_table import read_table
from calib.errors import NotConverged
from calib.procedure.export import identified
from calib.procedure.findings import PREDICTION_ONLY
from calib.procedure.session import steps
from calib.procedure.session.folder import Session
from calib.robot import description

GAINS = {"tau": np.ones(3), "i": np.array([10.0, 12.0, 8.0])}
MOTION = {"plan": False, "holdout": 0.5, "friction": "standard"}


def recorded(folder: Path, what: str) -> Session:
    """Return a finished session of the planted arm, by torques (tau) or currents (i) of two motions in one file.

    The second one is held out.
    """
    robot = description.write(folder / "planted.toml", planted.arm())
    session = begin(folder / "cell", str(robot), "none", **MOTION)
    one, two = planted.motion(0), planted.motion(1)
    t = np.concatenate([one[0], one[0][-1] + 1.0 + two[0]])
    q, v, a = (np.concatenate(pair) for pair in zip(one[1:], two[1:]))
    tau = planted.torques(q, v, a) + 0.02 * np.random.default_rng(0).normal(size=q.shape)
    np.savez(session.path("7-recorded/run.npz"), t=t, q=q, **{what: tau / GAINS[what]})
    assert go_on(session) is None
    return session


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Session:
    return recorded(tmp_path_factory.mktemp("alone"), "tau")


def test_certificate_judges_exported_robot(session: Session) -> None:
    """A session of dynamics alone ends in a certificate, and says how well the exported robot predicts."""
    assert [state.step.name for state in steps.states(session)] == [
        "describe", "excite", "record", "identify", "predict", "export", "certificate",
    ]  # fmt: skip
    whole = json.loads(session.path("verdict.json").read_text())
    assert "geometry" not in whole and whole["verdict"] == whole["files"]["robot.urdf"]["verdict"]
    assert "on run.npz@" in whole["dynamics"]["reason"] and "unseen" in whole["dynamics"]["reason"]
    assert whole["dynamics"]["reason"][1:] in session.path("certificate.html").read_text()
    measured, q, v, a = (_numbers(session.path("8-dynamics/unseen/torques_1.csv"), x) for x in ("measured", *"qva"))
    model = pin.buildModelFromUrdf(str(session.path("9-export/robot.urdf")))
    data = model.createData()
    torque = np.array([pin.rnea(model, data, *state) for state in zip(q, v, a)])
    with session.path("9-export/drives.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    drives = np.array([[float(row[key]) for key in ("armature", "damping", "friction", "offset")] for row in rows])
    terms = json.loads(session.path("8-dynamics/dynamics.json").read_text())["terms"]
    smooth = np.array([one["settings"][0] for one in terms if one["shape"] == "sign"])
    torque += drives[:, 0] * a + drives[:, 1] * v + drives[:, 2] * np.tanh(v / smooth) + drives[:, 3]
    left = 100.0 * np.linalg.norm(measured - torque) / np.linalg.norm(measured)
    said = whole["exported_prediction"]["exported"]
    assert said == pytest.approx(left, rel=1e-3)
    assert f"leaves {said:.2f} %" in session.path("9-export/README.txt").read_text()


@pytest.mark.slow
def test_ampere_torques_only_predict(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Torques in amperes are good for prediction only."""
    session = recorded(tmp_path, "i")
    whole = json.loads(session.path("verdict.json").read_text())
    assert whole["verdict"] == PREDICTION_ONLY and "scaled to joint" in whole["dynamics"]["reason"]
    assert not session.path("9-export/robot.urdf").exists()
    assert "PASS (prediction only)" in session.path("certificate.html").read_text()
    assert run("next", session.folder) == 0 and "no robot was exported" in capsys.readouterr().out


@pytest.mark.slow
def test_files_say_the_delivered_verdict(session: Session) -> None:
    """No file says another verdict than that of what is delivered."""
    for tolerance, exports, verdict, why in (
        (1e-6, True, "fail", "the exported robot has an error"), (0.0, False, PREDICTION_ONLY, "no such robot"),
    ):  # fmt: skip
        path = session.path("session.toml")
        path.write_text(re.sub("tolerance_percent = [^ ]+", f"tolerance_percent = {tolerance}", path.read_text()))
        with pytest.MonkeyPatch.context() as patch:
            if not exports:
                patch.setattr(identified, "read", refuse)
            assert go_on(session) is None
        whole = json.loads(session.path("verdict.json").read_text())["dynamics"]
        report = json.loads(session.path("8-dynamics/unseen/report.json").read_text())
        assert whole["verdict"] == report["verdict"] == verdict and why in report["reason"] == whole["reason"]
        assert json.loads(session.path("8-dynamics/metrics.json").read_text())["verdict"] == ""


def refuse(*arguments: object) -> None:
    raise NotConverged("no such robot")


def test_a_session_has_something_to_do(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for others, said in (
        (("--instrument", "cmm"), "needs no instrument"),
        (("--geometry-only",), "neither geometry nor dynamics"),
    ):
        assert run("new", tmp_path / "cell", "--robot", "ur5", "--dynamics-only", *others) == 2
        assert said in capsys.readouterr().err
    assert not (tmp_path / "cell").exists()


def _numbers(path: Path, head: str) -> np.ndarray:
    found = read_table(path).block(head)
    assert found is not None
    return found
