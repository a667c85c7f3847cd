"""Result folders: whose files may be replaced, and what a killed run leaves."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from calib import estimate_files
from calib.errors import RobotError, UsageError
from calib.folders import METRICS, check_target, write_staged


def test_nothing_is_written_over_what_is_read_or_not_ours(tmp_path: Path) -> None:
    out = tmp_path / "out"
    check_target(out, (METRICS, "a.csv"), (METRICS,), "fit", [tmp_path / "log.npz"])
    out.mkdir()
    (out / "a.csv").write_text("mine")
    with pytest.raises(UsageError, match="no earlier fit"):
        check_target(out, (METRICS, "a.csv"), (METRICS,), "fit")
    (out / METRICS).write_text("{}")
    check_target(out, (METRICS, "a.csv"), (METRICS,), "fit")
    with pytest.raises(UsageError, match=r"a\.csv is read"):
        check_target(out, (METRICS, "a.csv"), (METRICS,), "fit", [f"{out / 'a.csv'}@0:9"])


def test_leftovers_of_killed_runs_go_and_those_of_living_ones_stay(tmp_path: Path) -> None:
    gone = subprocess.run([sys.executable, "-c", "import os; print(os.getpid())"], capture_output=True, text=True)
    dead, living, other = (
        tmp_path / name
        for name in (f".out.{gone.stdout.strip()}.x1.part", f".out.{os.getpid()}.x2.part", ".out.b.7.x3.part")
    )
    for folder in (dead, living, other):
        folder.mkdir()
    write_staged(tmp_path / "out", (METRICS,), lambda folder: (folder / METRICS).touch())
    assert not dead.exists() and living.exists() and other.exists() and (tmp_path / "out" / METRICS).exists()


def test_a_covariance_comes_back_by_names_of_any_kind(tmp_path: Path) -> None:
    names = ("plain", 'day1, "left"\nof it', "ü")
    matrix = np.diag([1.0, 2.0, 3.0])
    path = tmp_path / estimate_files.COVARIANCE
    estimate_files.write_covariance(path, names, matrix)
    found = estimate_files.read_covariance(tmp_path)
    assert found[0] == names and np.array_equal(found[1], matrix)
    path.write_text(path.read_text().replace("ü,", "u,", 1))
    with pytest.raises(RobotError, match="do not name the same parameters"):
        estimate_files.read_covariance(tmp_path)
