"""Two identifications of one robot: nothing changed, or what changed is found and named."""

import json
import shutil
from types import SimpleNamespace

import numpy as np
import planted_motion as planted
import pytest
from recordings import DATA

import calib
from calib import cli
from calib.apps.monitoring.comparison import change_test
from calib.apps.monitoring.comparison.robot_change import RobotChange
from calib.apps.monitoring.settings import DiffSettings
from calib.errors import RobotError, UsageError
from calib.procedure.findings import Verdict
from calib.robot import description

UR10E = DATA / "ur10e_innopolis"


@pytest.fixture(scope="module")
def models(tmp_path_factory):
    """Folders of identifications: twice the same arm, with a payload, and the second with friction of joint 2 added."""
    folder = tmp_path_factory.mktemp("models")
    robot = description.write(folder / "planted.toml", planted.arm())
    for seed, (name, payload) in enumerate({"first": False, "again": False, "loaded": True}.items()):
        for kind, number in (("train", 2 * seed), ("other", 2 * seed + 1)):
            np.savez(folder / f"{name}_{kind}.npz", **planted.series(number, noise=0.1, payload=payload))
        calib.identify_dynamics(
            robot, folder / f"{name}_train.npz", validate=folder / f"{name}_other.npz", friction="standard"
        ).save(folder / name, plots=False)
    for name, added in {"dry": {"Fc2": 0.3}, "rubs": {"Fc2": 0.5, "Fv2": 0.4}}.items():
        shutil.copytree(folder / "again", folder / name)
        table = json.loads((folder / name / "dynamics.json").read_text())
        for term in table["terms"]:
            term["value"] += added.get(term["name"], 0.0)
        (folder / name / "dynamics.json").write_text(json.dumps(table))
    return folder


@pytest.mark.slow
def test_unchanged_robot_does_not_differ(models):
    """Two identifications of an unchanged robot do not differ."""
    found = calib.diff(models / "first", models / "again", DiffSettings(torque_tolerance=5.0))
    assert found.geometry is None and found.dynamics.probability > 0.01
    assert found.verdict == "pass" and "still within the tolerance of 5 %" in found.verdict.reason
    for one in found.dynamics.torques:
        assert one.rms < 2.0 * np.sqrt(np.mean(one.expected**2))


@pytest.mark.slow
def test_planted_friction_is_named_with_size(models):
    """A planted friction is found and named with its size."""
    found = calib.diff(models / "first", models / "dry")
    first = found.dynamics.parameters[0]
    assert found.dynamics.alone and first.name == "Fc2" and abs(first.alone - 0.3) < 3.0 * first.alone_sigma < 0.06
    assert found.verdict == "marginal" and "a change of Fc2 alone (" in str(found)


@pytest.mark.slow
def test_friction_terms_are_one_part(models):
    """Several terms of a joint's friction are named as one part."""
    found = calib.diff(models / "first", models / "rubs")
    assert not found.dynamics.alone and found.dynamics.part.name == "the friction of joint 2"
    assert found.dynamics.part.rms == pytest.approx(found.dynamics.torques[0].rms, rel=0.1)


@pytest.mark.slow
def test_payload_changes_last_body(models):
    """A payload is a change of the last body."""
    found = calib.diff(models / "first", models / "loaded")
    assert found.dynamics.part.name == "the body of link 3"
    assert found.dynamics.torques[0].unexplained[0] > 5.0 * found.dynamics.torques[0].unexplained[1]


@pytest.mark.slow
def test_command_writes_folder_and_exits_1(models, tmp_path, capsys):
    """The command writes a folder and exits with 1 beyond the tolerance."""
    pair, motion = [str(models / "first"), str(models / "loaded")], str(models / "again" / "torques_1.csv")
    assert cli.run(["diff", *pair, "--torque-tolerance", "10", "--motion", motion, "--out", str(tmp_path / "out")]) == 1
    said = capsys.readouterr().out
    assert "not within the tolerance of 10 %" in said and f"{motion}: the torque changed by" in said
    assert {"report.html", "torque_changes.csv", "metrics.json"} == {each.name for each in (tmp_path / "out").iterdir()}
    assert json.loads((tmp_path / "out/metrics.json").read_text())["dynamics"]["verdict"] == "fail"


@pytest.mark.slow
def test_what_cannot_be_compared_is_refused(models, tmp_path):
    with pytest.raises(UsageError, match=r"nothing to compare: .* contains dynamics, panda contains the nominal robot"):
        calib.diff(models / "first", "panda")
    other = tmp_path / "other"
    robot = description.write(tmp_path / "ur5.toml", calib.load("ur5").chain)
    q = np.random.default_rng(0).uniform(-1.0, 1.0, (5, 6))
    other.mkdir()
    for name in ("dynamics.json", "metrics.json", "covariance.csv", "report.json", "torques_1.csv", "estimate.csv"):
        (other / name).write_text((models / "first" / name).read_text())
    (other / "robot.toml").write_text(robot.read_text())
    with pytest.raises(RobotError):
        calib.diff(models / "first", other)
    header = ",".join(f"{letter}_joint{k} [rad]" for letter in "qva" for k in range(1, 7))
    np.savetxt(tmp_path / "six.csv", np.hstack([q, q, q]), delimiter=",", header=header, comments="")
    with pytest.raises(UsageError, match="of 3 joints each are needed"):
        calib.diff(models / "first", models / "again", DiffSettings(motions=(str(tmp_path / "six.csv"),)))


def test_lone_combination_is_conditioned_out():
    """The estimate that has it is then as if it had been made without it."""
    rng = np.random.default_rng(0)
    rows, truth = rng.normal(size=(200, 3)), np.array([1.0, -2.0, 0.5])
    y = rows @ truth + rng.normal(size=200)
    whole, less = np.linalg.inv(rows.T @ rows), np.linalg.inv(rows[:, :2].T @ rows[:, :2])
    full = np.linalg.lstsq(rows, y)[0]
    short = np.append(np.linalg.lstsq(rows[:, :2], y)[0], 0.0)
    covariance = np.zeros((3, 3))
    covariance[:2, :2] = less
    found, _ = change_test.tested(
        short - full, [whole, covariance], [np.eye(3), change_test.span(np.eye(3)[:, :2])], np.eye(3)
    )
    assert found.chi2 < 1e-9 and found.extra == (1, 0) and len(found.difference) == 2


def test_worst_of_both_is_the_verdict():
    """The worst of geometry and dynamics is the verdict."""
    parts = [
        SimpleNamespace(kind=kind, verdict=Verdict(level, "moved"))
        for kind, level in (("geometry", "pass"), ("dynamics", "fail"))
    ]
    assert RobotChange(tuple(parts)).verdict == Verdict("fail", "dynamics: moved")


@pytest.mark.slow
@pytest.mark.skipif(not UR10E.is_dir(), reason=f"no recording of a UR10e at {UR10E} (set CALIB_DATA)")
def test_real_payload_is_body_of_last_link(tmp_path):
    """Mamedov and Mikhel's UR10e, 2.8 kg at its flange in the second recording only."""
    gains = calib.IdentifySettings(gains=(14.87, 13.26, 11.13, 10.62, 11.03, 11.47), friction="standard")
    for name in ("14harm50sec", "14harm50secLoad"):
        log = UR10E / f"ur-20_02_19_{name}.npz"
        calib.identify_dynamics(UR10E / "model.urdf", f"{log}@0:14", gains, validate=f"{log}@14:22").save(
            tmp_path / name, plots=False
        )
    found = calib.diff(tmp_path / "14harm50sec", tmp_path / "14harm50secLoad")
    assert found.verdict == "marginal" and found.dynamics.part.name == "the body of link 6"
