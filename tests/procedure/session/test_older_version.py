"""Folders that an older version wrote (``older/``, of commit a217159) open, go on, and give what they gave then."""

import csv
import json
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from both_ways import same
from sessions import go_on, kinds
from without_figures import run

from calib.procedure.session import steps
from calib.procedure.session.folder import Session, locked, open_session

OLDER = Path(__file__).parent / "older"
EXPECTED = OLDER / "expected"


@pytest.fixture
def cell(tmp_path: Path) -> Path:
    shutil.copytree(OLDER / "cell", tmp_path / "cell")
    return tmp_path / "cell"


def test_older_session_goes_on(cell: Path) -> None:
    """An older session stands where it stood, and goes on."""
    standing = kinds(open_session(cell))
    assert set(list(standing.values())[:-2]) == {steps.DONE}, "nothing is made again"
    assert list(standing)[-2:] == ["export", "certificate"]
    before = (cell / "8-dynamics/metrics.json").read_bytes()
    session = open_session(cell)
    assert go_on(session) is None
    assert set(kinds(open_session(cell)).values()) == {steps.DONE}
    assert (cell / "8-dynamics/metrics.json").read_bytes() == before
    assert "0.038 mm" in (cell / "certificate.html").read_text().replace("\N{NO-BREAK SPACE}", " ")
    assert {half: one.level for half, one in session.verdicts().stages.items()} == {
        "geometry": "pass",
        "dynamics": "pass",
    }
    written = (EXPECTED, cell / "9-export")
    joints = [re.findall(r"(?m)^ *<origin.*", (place / "robot.urdf").read_text()) for place in written]
    assert len(joints[0]) == 3 and joints[0] == joints[1]


def _redone(cell: Path, name: str) -> Session:
    """Make one step again, and none after it."""
    session = open_session(cell)
    step = steps.find(session, name)
    with locked(session, lambda words: None):
        step.make(session, lambda words: None)
    return session


def test_older_fit_validates_to_its_verdict(cell: Path) -> None:
    """Validating an older fit again gives its verdict and figures."""
    old = json.loads((cell / "5-validation/metrics.json").read_text())
    _redone(cell, "validate")
    new = json.loads((cell / "5-validation/metrics.json").read_text())
    assert new["verdict"] == old["verdict"]
    errors = old["validation"]["validation.csv"]
    same(errors, _narrowed(new["validation"]["validation.csv"], errors))


def test_older_fit_exports_and_compensates(cell: Path, tmp_path: Path) -> None:
    """An older fit is exported, and compensates as it did."""
    # its offsets were those of the full geometry, and of no use alone
    assert run("export", cell / "4-fit", "--offsets", tmp_path / "joint_offsets.csv") == 2
    where = ("--tool", "0.3,0.05,0.02", "--dof", 3, "--tolerance", "2,100")
    assert not run("compensate", cell / "4-fit", OLDER / "targets.csv", *where, "--out", tmp_path / "q.csv")
    for column in ("shoulder [deg]", "elbow [deg]", "left [mm]", "sigma [mm]"):
        now, then = (_column(place, column) for place in (tmp_path / "q.csv", EXPECTED / "commands.csv"))
        np.testing.assert_allclose(now, then, 1e-6)


@pytest.mark.slow
def test_dynamics_on_an_older_fit_stay(cell: Path, tmp_path: Path) -> None:
    """Dynamics identified on an older fit are those it gave."""
    logs = cell / "7-recorded"
    found, old = tmp_path / "model", json.loads((EXPECTED / "identified.json").read_text())
    plain = tmp_path / "options.toml"
    plain.write_text('prior = "none"\n')  # of a217159, which drew nothing where the motion told all
    assert not run(
        "identify", cell / "4-fit", logs / "training.csv", "--validate", logs / "validation.csv", "--friction",
        "standard", "--options", plain, "--out", found,
    )  # fmt: skip
    metrics = json.loads((found / "metrics.json").read_text())
    assert metrics["verdict"] == old["verdict"]
    errors = metrics["validation"]["validation.csv"]["raw"]["relative_error_percent"]
    assert errors["total"] == pytest.approx(old["unseen_percent"]["total"], rel=0.02)
    values, sigma = (_column(EXPECTED / "estimate.csv", name) for name in ("value", "sigma"))
    assert (np.abs(_column(found / "estimate.csv", "value") - values) < 0.1 * sigma).all()


def _narrowed(new: Any, old: Any) -> Any:
    """Return of `new` what `old` has: a version may write more."""
    return {key: _narrowed(new[key], old[key]) for key in old} if isinstance(old, dict) else new


def _column(path: Path, name: str) -> np.ndarray:
    with path.open(newline="") as file:
        return np.array([float(row[name]) for row in csv.DictReader(file)])
