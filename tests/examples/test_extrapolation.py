"""The table of errors away from the training motion is what the command makes, and its parts are what they say."""

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from recordings import DATA
from scripts import require_same_package

ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "examples/real_recordings.md").read_text().partition("## Away from the training motion")[2]
PARTS = ROOT / "examples"
NEAR = 0.1  # relative: what another processor's rounding may change where friction steps are chosen on few seconds
# a recorded pair and a simulated one; the other simulated pairs are made by the same class
CHOSEN = ("KR300, A → B", "sim. Panda sensors, one sinusoid → faster")


@pytest.fixture(autouse=True)
def parts(monkeypatch) -> None:
    monkeypatch.syspath_prepend(str(PARTS))


def told(text: str) -> dict[str, list[float]]:
    """Return pair → its percentages, in the table's order: ridge, plain, best ridge, before or not, toolkit, …."""
    rows = re.findall(r"^\| ([^|]+?) \| (?:same|across) \| (.+)$", text, re.MULTILINE)
    return {name: [float(x) for x in re.findall(r"(\d+\.\d) %", cells)] for name, cells in rows}


def test_every_pair_stands_in_the_document() -> None:
    from extrapolation_pairs import PAIRS

    assert list(told(TEXT)) == [pair.name for pair in PAIRS]
    assert len(PAIRS) >= 60 and sum(pair.across for pair in PAIRS) >= 30


def test_motors_see_dynamics_and_friction(tmp_path) -> None:
    """At rest in one posture the torque is gravity's of the true arm, offset and cable aside."""
    import extrapolation_simulated as simulated
    import pinocchio as pin

    robot = simulated.arm("ur10e")
    true = simulated.write_urdf(robot, simulated.wrong(robot.inertias, 0), tmp_path / "true.urdf")
    q = np.tile(np.linspace(-0.5, 0.5, 6), (500, 1))
    path = simulated.record(robot, true, q, tmp_path / "still.npz", seed=1, arm_seed=1, family="simple")
    model = pin.buildModelFromUrdf(str(true))
    gravity = pin.computeGeneralizedGravity(model, model.createData(), q[0])
    off = np.abs(np.load(path)["tau"].mean(axis=0) - gravity)
    assert (off < 0.03 * robot.effort).all() and off.max() > 0.0
    assert np.abs(gravity).max() > 0.1 * robot.effort.max()


def test_plain_references_find_simple_arm(tmp_path) -> None:
    """Rich motion of an arm with plain friction is predicted within 5 %."""
    import extrapolation
    import extrapolation_plain as plain
    import extrapolation_ridge as ridge
    from extrapolation_pairs import Simulated, rich

    pair = Simulated("plain", "rv2sq", "simple", rich(10), rich(10), across=False)
    files = pair.prepare(tmp_path)
    least = plain.predict(files.robot, files.train, files.test, 15.0)
    for name, predicted in {**ridge.predict(files.robot, files.train, files.test, 15.0), "plain": least}.items():
        left, size = extrapolation.squared_errors(files.test, predicted)
        assert np.sqrt(left.sum() / size.sum()) < 0.05, name


@pytest.mark.slow
def test_document_states_fresh_results(data, tmp_path) -> None:
    """The document states what a fresh run gives."""
    require_same_package()
    environment = os.environ | {"OPENBLAS_NUM_THREADS": "1", "CALIB_DATA": str(DATA)}
    command = [sys.executable, str(PARTS / "extrapolation.py"), "--out", str(tmp_path), "--only", *CHOSEN]
    said = subprocess.run(command, capture_output=True, text=True, env=environment, check=True).stdout
    found, stated = told(said), told(TEXT)
    assert set(CHOSEN) <= set(found)
    for name, values in found.items():
        before = len(stated[name]) - len(values)  # the other version's column
        assert [*stated[name][:3], stated[name][3 + before]] == pytest.approx(values[:4], rel=NEAR, abs=0.05), name
