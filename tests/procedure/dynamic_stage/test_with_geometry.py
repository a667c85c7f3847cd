"""``calib identify --with-geometry``: what it writes, when it leaves the geometry alone, and what it refuses."""

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import planted_motion as planted
import pytest
import without_figures

from calib.errors import UsageError
from calib.folders import read_covariance
from calib.identification.uncertainty.joint_estimate import JointEstimate
from calib.procedure.dynamic_stage.with_geometry import GeometryFromTorques, _objections
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


def objections(joint: JointEstimate, unseen: float | None = None, fitted: bool = True) -> list:
    covariance = np.diag(np.full(6, 1e-6)) if fitted else None
    robot = CalibratedChain(planted.arm(), covariance=covariance)
    return list(_objections(GeometryFromTorques(joint, True, (), unseen), robot))


def test_torques_far_from_the_fit_contradict_it():
    contradicted = objections(estimate(change=0.02))
    assert [item.code for item in contradicted] == ["geometry-contradicted"]
    assert "shoulder would move by 20 mrad" in lines_of(contradicted)[0]
    assert not objections(estimate(change=0.002))
    assert not objections(estimate(change=0.02), fitted=False), "nobody measured this geometry before"


def test_a_geometry_that_predicts_worse_is_not_delivered():
    assert [item.code for item in objections(estimate(held_out=1.01))] == ["geometry-not-better"]
    assert [item.code for item in objections(estimate(held_out=0.9), unseen=1.02)] == ["geometry-not-better"]
    assert not objections(estimate(held_out=1.01), unseen=0.99), "other recordings count more than held-out time"


def test_what_torques_do_not_show_rests_on_the_prior():
    joint = estimate(sigma=1.9e-3)
    assert not joint.identified.any() and joint.identified_combinations == 0
    assert joint.p_value == 1.0


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
    assert abs(float(offset["after"]) - 0.01) < 3.5 * float(offset["sigma_after"]) and offset["identified"] == "yes"
    after = calibrated.read(out)
    k = after.chain.names.index("shoulder")
    assert after.chain.values[k] == pytest.approx(float(offset["after"]))
    assert after.covariance is not None
    assert np.sqrt(after.covariance[k, k]) == pytest.approx(float(offset["sigma_after"]), rel=1e-6)

    names, covariance = read_covariance(out / "joint_covariance.csv")
    own, marginal = read_covariance(out / "covariance.csv")
    index = [names.index(name) for name in own]
    assert np.allclose(covariance[np.ix_(index, index)], marginal)
    assert np.linalg.eigvalsh(covariance / np.sqrt(np.outer(np.diag(covariance), np.diag(covariance)))).min() > -1e-9


def test_methods_without_rows_are_refused(robot, tmp_path, capsys):
    log = write_log(tmp_path, "free.npz", 0)
    arguments = ("identify", robot, log, "--method", "pc-wls", "--with-geometry", "--out", tmp_path / "out")
    assert without_figures.run(*arguments) != 0
    assert "with_geometry" in capsys.readouterr().err
