"""The report of a fleet: an arm that drifted is named, one of another description is no part of the distribution."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

import calib
from calib import cli
from calib.apps.fleet import fleet_report, visits
from calib.apps.monitoring.comparison.calibration_sources import Place
from calib.data.poses.measurements import Positions
from calib.robot.chain import random_joints
from calib.robot.kinematics import forward

pytestmark = pytest.mark.slow
NOMINAL = calib.load("ur5").chain


@pytest.fixture(scope="module")
def fits(tmp_path_factory) -> Path:
    """Four arms of a type; the last one's elbow is mounted half a turn off, as another description has it."""
    folder, random = tmp_path_factory.mktemp("arms"), np.random.default_rng(1)
    for name in ("one", "two", "three", "odd"):
        q, noise = random_joints(NOMINAL, 40, 1), 3e-5 * random.standard_normal((40, 3))
        arm = NOMINAL.with_values(NOMINAL.values + 1e-3 * random.standard_normal(len(NOMINAL.values)))
        q_read = q + (name == "odd") * 0.2 * (np.arange(6) == 2)
        seen = (forward(arm, q) @ [0.05, 0.02, 0.1, 1.0])[:, :3] + noise
        block = Positions(q_read, NOMINAL.joint_names, seen, file=f"{name}.csv", sigma=np.full((40, 3), 3e-5))
        calib.fit_geometry("ur5", block, calib.FitSettings(model="geometry")).save(folder / name, plots=False)
    return folder


def test_the_command_writes_report_and_prior(fits: Path, tmp_path: Path, capsys) -> None:
    given = [str(fits / name) for name in ("one", "two", "three", "odd")]
    assert cli.run(["fleet", *given, "--out", str(tmp_path / "fleet")]) == 0
    said = capsys.readouterr().out
    assert "verdict: marginal: 4 arms of 1 type" in said and "odd: theta3" in said
    found = json.loads((tmp_path / "fleet/metrics.json").read_text())["types"]["ur5"]
    assert found["odd"] == [given[3]] and {one["arms"] for one in found["parameters"]} == {3}
    assert {path.name for path in (tmp_path / "fleet/prior/ur5").iterdir()} == {"robot.toml", "options.toml"}
    assert cli.run(["fleet", *given, "--out", str(tmp_path / "fleet")]) == 0
    assert cli.run(["fleet", str(fits)]) == 2 and cli.run(["fleet", given[0], given[0]]) == 2


def test_an_arm_that_drifted_is_named(fits: Path, monkeypatch) -> None:
    """Two calibrations with one serial number are of one arm, and count once in the distribution."""
    read = visits.read_fit

    def with_serial(place: Place):
        found = read(place)
        object.__setattr__(found, "serial", {"one": "R7", "two": "R7"}.get(Path(place.name).name, ""))
        return found

    monkeypatch.setattr(visits, "read_fit", with_serial)
    found = fleet_report.report_fleet([fits / "one", fits / "two", fits / "three"])
    ((arm, change),) = found.changes
    assert arm == "R7" and change.verdict.level == "marginal" and "R7 drifts" in found.verdict.reason
    assert [len(one.arms) for one in found.types] == [2] and found.types[0].parameters[0].arms == 2
    (current,) = [one for one in found.noticed if one.code == "current-calibration"]
    assert current.values["current"] == str(fits / "two") and current.values["how"] == "the order given"


def test_failed_fit_is_not_in_distribution(fits: Path, tmp_path: Path) -> None:
    """It is named with its reason, and the verdict is marginal; fail where no other is left. A marginal one stays."""
    for name in ("one", "two", "three", "odd"):
        shutil.copytree(fits / name, tmp_path / name)
    for name, level in (("one", "marginal"), ("two", "fail"), ("odd", "fail")):
        path = tmp_path / name / "metrics.json"
        path.write_text(json.dumps(json.loads(path.read_text()) | {"verdict": level, "reason": f"{name}'s reason"}))
    found = fleet_report.report_fleet([tmp_path / name for name in ("one", "two", "three", "odd")])
    (only,) = found.types
    assert only.failed == (str(tmp_path / "two"), str(tmp_path / "odd")) and not only.odd
    assert found.verdict == "marginal" and {one.arms for one in only.parameters} == {2}
    assert [Path(one.name).name for one in only.plausible] == ["one", "three"]
    named = {(one.code, one.values["reason"]) for one in found.noticed if "reason" in one.values}
    assert {("arm-failed", "two's reason"), ("arm-failed", "odd's reason"), ("arm-marginal", "one's reason")} <= named
    assert "arms-without-serial" in [one.code for one in found.noticed] and "2 failed" in found.verdict.reason
    five = fleet_report.report_fleet([fits / "two", *(tmp_path / name for name in ("one", "two", "three", "odd"))])
    (unnamed,) = [one for one in five.noticed if one.code == "tools-unnamed"]
    assert unnamed.values["tool"] == "tool" and unnamed.values["away"] < 5e-3
    alone = fleet_report.report_fleet(tmp_path / "two")
    assert alone.verdict == "fail" and not alone.types[0].parameters
    alone.save(tmp_path / "out")
    assert not (tmp_path / "out/prior").exists()
