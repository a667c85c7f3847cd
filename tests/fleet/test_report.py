"""The report of a fleet: an arm that drifted is named, one of another description is no part of the distribution."""

import json
from pathlib import Path

import numpy as np
import pytest

import calib
from calib import cli
from calib.data.poses.measurements import Positions
from calib.robot.chain import random_joints
from calib.robot.kinematics import forward
from calib.rooms.fleet import report
from calib.rooms.over_time.comparison.places import Place

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
    read = report.read_fit

    def with_serial(place: Place):
        found = read(place)
        object.__setattr__(found, "serial", {"one": "R7", "two": "R7"}.get(Path(place.name).name, ""))
        return found

    monkeypatch.setattr(report, "read_fit", with_serial)
    found = report.report_fleet([fits / "one", fits / "two", fits / "three"])
    ((arm, change),) = found.changes
    assert arm == "R7" and change.verdict.level == "marginal" and "R7 drifts" in found.verdict.reason
    assert [len(one.arms) for one in found.types] == [2] and found.types[0].parameters[0].arms == 2
