"""``calib identify --with-geometry``: what it writes, when it leaves the geometry alone, and what it refuses."""

import csv
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import planted_motion as planted
import pytest
import without_figures

from calib.folders import read_covariance
from calib.identification.identify_options import IdentifyOptions
from calib.identification.settings import IdentificationSettings
from calib.identification.uncertainty import joint_estimate
from calib.identification.uncertainty.joint_estimate import JointEstimate, JointIdentification
from calib.procedure.dynamic_stage import with_geometry
from calib.procedure.dynamic_stage.held_out_poses import HeldOutErrors
from calib.procedure.dynamic_stage.inputs import IdentificationInputs
from calib.procedure.dynamic_stage.recorded_gains import FoundGains
from calib.procedure.dynamic_stage.with_geometry import contradictions
from calib.procedure.findings import lines_of
from calib.robot import calibrated
from calib.robot.calibrated import CalibratedChain

OPTIONS = """
friction = "standard"
essential = "none"
with_geometry = true
[payload.load]
mass = 2.0
com = [0.05, 0.025, 0.1]
[files."loaded.npz"]
payload = ["load"]
"""


def write_log(folder: Path, name: str, seed: int, payload: bool = False, offset: float = 0.01) -> Path:
    """Write a recording of an arm whose second joint shows `offset` less than its angle."""
    log = planted.series(seed, payload=payload, duration=12.0)
    np.savez(folder / name, **{**log, "q": log["q"] - np.array([0.0, offset, 0.0])})
    return folder / name


FIT = CalibratedChain(planted.arm(), covariance=np.diag([0.0, 0.0, 1e-6, 0.0, 0.0, 0.0]))


def estimate(change: float = 0.0, sigma: float = 1e-3, held_out: float = 0.9) -> JointEstimate:
    """Return a joint estimate of one offset, whose prior has a standard deviation of 2 mrad."""
    return JointEstimate(
        elements=("shoulder",),
        units=("rad",),
        index=(2,),
        before=np.zeros(1),
        after=np.array([change]),
        prior=np.array([[4e-6]]),
        covariance=np.array([[sigma**2]]),
        widening=1.0,
        held_out=held_out,
        rounds=2,
        gains=np.ones(3),
        gain_sigma=np.full(3, 0.01),
    )


def test_torques_far_from_the_fit_contradict_it():
    (contradicted,) = contradictions(estimate(change=0.02), FIT)
    assert contradicted.code == "geometry-contradicted"
    assert "shoulder off by 20 mrad, 14.1 σ" in lines_of([contradicted])[0]
    assert not contradictions(estimate(change=0.004), FIT)


def test_what_torques_do_not_show_rests_on_the_prior_and_contradicts_nothing():
    joint = estimate(change=0.02, sigma=1.9e-3)
    assert not joint.identified.any() and joint.identified_combinations == 0
    assert not contradictions(joint, FIT)


def test_a_geometry_that_predicts_worse_is_not_delivered(monkeypatch):
    worse = estimate(held_out=1.01)
    inputs = SimpleNamespace(
        robot=CalibratedChain(planted.arm()),
        source=Path("planted.toml"),
        cases=(),
        unseen=(),
        unit="N m",
        options=SimpleNamespace(settings=IdentificationSettings()),
    )
    plain = SimpleNamespace(friction=SimpleNamespace(chosen="standard"))
    monkeypatch.setattr(with_geometry, "identify", lambda *arguments: plain)
    monkeypatch.setattr(with_geometry, "_doubted_payloads", lambda *arguments: ())
    answer = JointIdentification(worse, inputs.robot, plain)
    monkeypatch.setattr(joint_estimate, "identify_jointly", lambda *arguments, **names: answer)
    used, found, result = with_geometry.run_jointly(inputs, print)
    assert used is inputs and found is plain and not result.delivered
    assert [item.code for item in result.noticed] == ["geometry-not-better"]


@pytest.mark.slow
def test_the_command_writes_the_robot_with_its_covariance(robot, tmp_path, capsys):
    options = tmp_path / "options.toml"
    options.write_text(OPTIONS)
    logs = write_log(tmp_path, "free.npz", 0), write_log(tmp_path, "loaded.npz", 1, payload=True)
    out = tmp_path / "out"
    assert without_figures.run("identify", robot, *logs, "--options", options, "--out", out) == 0
    said = capsys.readouterr().out
    assert "offsets of the first and the last joint are not identifiable" in said

    rows = {row["element"]: row for row in csv.DictReader((out / "geometry_from_torques.csv").open())}
    offset = rows["shoulder"]
    assert abs(float(offset["change"]) - 0.01) < 3.5 * float(offset["sigma_after"]) and offset["identified"] == "yes"
    after = calibrated.read(out)
    k = after.chain.names.index("shoulder")
    assert after.chain.values[k] == pytest.approx(float(offset["change"]))
    assert after.covariance is not None
    assert np.sqrt(after.covariance[k, k]) == pytest.approx(float(offset["sigma_after"]), rel=1e-6)

    names, covariance = read_covariance(out / "joint_covariance.csv")
    own, marginal = read_covariance(out / "covariance.csv")
    index = [names.index(name) for name in own]
    assert np.allclose(covariance[np.ix_(index, index)], marginal)
    assert np.linalg.eigvalsh(covariance / np.sqrt(np.outer(np.diag(covariance), np.diag(covariance)))).min() > -1e-9


@pytest.mark.slow
def test_methods_without_rows_are_refused(robot, tmp_path, capsys):
    log = write_log(tmp_path, "free.npz", 0)
    arguments = ("identify", robot, log, "--method", "pc-wls", "--with-geometry", "--out", tmp_path / "out")
    assert without_figures.run(*arguments) != 0
    assert "--with-geometry: method 'pc-wls'" in capsys.readouterr().err


@pytest.mark.parametrize(
    "poses, code, delivered",
    [
        (HeldOutErrors(20, 1e-4, 1.1e-4, 2.5), "geometry-worse-on-poses", False),
        (HeldOutErrors(20, 1e-4, 1.1e-4, 1.5), None, True),
        (HeldOutErrors(1, 1e-4, 1.1e-4, 2.5), None, True),
        (HeldOutErrors(20, 1e-4, 0.9e-4, -1.0), None, True),
        (None, "geometry-without-poses", True),
    ],
)
def test_held_out_poses_of_the_fit_judge_the_geometry(monkeypatch, poses, code, delivered):
    robot = CalibratedChain(planted.arm())
    gains = FoundGains(IdentifyOptions(), None, None, "N m", ())
    inputs = IdentificationInputs(robot, Path("planted.toml"), (), (), IdentifyOptions(), (), gains)
    identification = SimpleNamespace(
        friction=SimpleNamespace(chosen="standard"), settings=SimpleNamespace(gravity=None)
    )
    monkeypatch.setattr(with_geometry, "identify", lambda *arguments: identification)
    monkeypatch.setattr(with_geometry, "_doubted_payloads", lambda *arguments: ())
    monkeypatch.setattr(with_geometry, "held_out_errors", lambda *arguments: poses)
    answer = JointIdentification(estimate(), robot, identification)
    monkeypatch.setattr(joint_estimate, "identify_jointly", lambda *arguments, **names: answer)
    monkeypatch.setattr(JointEstimate, "regrouped", lambda joint, chain: joint)
    *_, result = with_geometry.run_jointly(inputs, print)
    assert result.delivered == delivered and result.poses == poses
    assert [item.code for item in result.noticed] == ([code] if code else [])
