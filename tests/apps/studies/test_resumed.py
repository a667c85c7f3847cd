"""A study that loses a worker, its process, or its patience: no trial is lost, none counts twice."""

import os
import signal
import subprocess
import sys
import time
from dataclasses import asdict, replace
from pathlib import Path

import dask_cluster
import pytest
from study_rows import ROW

from calib.apps.studies.conditions import read_study
from calib.apps.studies.report import run_study
from calib.apps.studies.store import ROWS, opened, read_rows
from calib.apps.studies.trial import TrialRow
from calib.errors import UsageError
from calib.identification.registry import VERSIONS

FILE = """
name = "small"
robot = "rv2sq"
methods = ["ols", "wls"]
runs = 12
duration = 2.0
resimulated = 0
[[noise]]
name = "1"
sigma_q = "1e-4 deg"
sigma_tau = 0.05
"""


@pytest.fixture
def study(tmp_path: Path) -> Path:
    path = tmp_path / "small.toml"
    path.write_text(FILE)
    return path


def timeless(rows: list[TrialRow]) -> list[str]:
    return sorted(str({k: v for k, v in asdict(row).items() if k not in ("seconds", "cpu")}) for row in rows)


@pytest.mark.slow
def test_existing_rows_are_not_run_again(study: Path, tmp_path: Path):
    """More runs are added; a file edited half-way keeps what its new conditions share with the old."""
    first = run_study([study], tmp_path / "out", runs=1, plots=False)
    second = run_study([study], tmp_path / "out", runs=2, plots=False)
    assert (first.progress.done, second.progress.done) == (2, 2)
    study.write_text(FILE.replace("0.05", "0.06"))
    third = run_study([study], tmp_path / "out", runs=1, plots=False)
    assert third.progress.done == 2
    assert "4 rows belong to conditions outside this study" in " ".join(third.notes)
    assert third.conditions[0].methods[0].trials == 1
    study.write_text(FILE)
    assert run_study([study], tmp_path / "out", runs=2, plots=False).progress.done == 0


@pytest.mark.slow
def test_only_changed_method_is_run_again(study: Path, tmp_path: Path, monkeypatch):
    """Its old rows do not count, in a report alone neither; a row of today states the change."""
    run_study([study], tmp_path / "out", runs=2, plots=False)
    before = {row.key: row for row in read_rows(tmp_path / "out")}
    (version,) = {row.version for row in before.values()}
    assert "method" not in version
    monkeypatch.setitem(VERSIONS, "wls", 2)
    looked = run_study([study], tmp_path / "out", report_only=True, plots=False)
    assert [(one.method, one.trials) for one in looked.conditions[0].methods] == [("ols", 2)]
    assert "run again: 2 of wls" in " ".join(looked.notes)
    found = run_study([study], tmp_path / "out", runs=2, plots=False)
    assert found.progress.done == 2 and not any("run again" in note for note in found.notes)
    assert {one.method: one.trials for one in found.conditions[0].methods} == {"ols": 2, "wls": 2}
    after = {row.key: row for row in read_rows(tmp_path / "out")}
    assert [row.version for row in after.values() if row.method == "wls"] == [f"{version} method 2"] * 2
    assert after.keys() == before.keys()
    assert timeless([row for row in after.values() if row.method == "ols"]) == timeless(
        [row for row in before.values() if row.method == "ols"]
    )


def test_a_study_that_runs_may_be_looked_at(study: Path, tmp_path: Path):
    """A report alone takes no lock and leaves the rows; where there are none it makes no folder."""
    with pytest.raises(UsageError, match="nothing to report"):
        run_study([study], tmp_path / "out", report_only=True)
    assert not (tmp_path / "out").exists()
    row = replace(ROW, digest=read_study([study]).conditions[0].digest)
    with opened(tmp_path / "out") as store:
        store.append([row])
        before = (tmp_path / "out" / ROWS).read_bytes()
        found = run_study([study], tmp_path / "out", report_only=True)
        assert (tmp_path / "out" / ROWS).read_bytes() == before
    assert [one.trials for one in found.conditions[0].methods] == [1]
    assert "fewer than" in " ".join(found.notes)


@pytest.mark.slow
def test_lost_worker_loses_no_trial(study: Path, tmp_path: Path):
    """A cluster that loses a worker loses no trial."""
    with dask_cluster.running(tmp_path, workers=2) as cluster:
        killed = []

        def say(words: str) -> None:
            if " of 24 trials" in words and not killed:
                killed.append(words)
                cluster.workers[0].kill()

        found = run_study([study], tmp_path / "out", where=cluster.address, plots=False, say=say)
    assert killed and not killed[0].startswith("24 of")
    assert (found.progress.done, found.progress.lost) == (24, 0)
    run_study([study], tmp_path / "here", plots=False)
    rows = read_rows(tmp_path / "out")
    assert len({row.key for row in rows}) == len(rows) == 24
    assert timeless(rows) == timeless(read_rows(tmp_path / "here"))


@pytest.mark.slow
@pytest.mark.parametrize(("how", "code"), [(signal.SIGKILL, -9), (signal.SIGINT, 130)])
def test_a_study_that_was_stopped_goes_on(study: Path, tmp_path: Path, how: int, code: int):
    out = tmp_path / "out"
    words = [sys.executable, "-m", "calib", "study", str(study), "--out", str(out), "--runs", "6", "--no-plots"]
    process = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    for _ in range(1200):
        if (out / ROWS).exists() and (out / ROWS).stat().st_size and len(read_rows(out)) >= 4:
            break
        time.sleep(0.05)
    os.kill(process.pid, how)
    _, said = process.communicate()
    assert process.returncode == code
    assert code != 130 or "the same command goes on from here" in said
    kept = read_rows(out)
    assert 4 <= len(kept) < 12
    found = run_study([study], out, runs=6, plots=False)
    assert found.progress.done == 12 - len(kept)
    assert len({row.key for row in read_rows(out)}) == len(read_rows(out)) == 12
