"""A fleet of sessions: each goes as far as it can, one that fails stops none, and the table says how they stand."""

import pickle
import shutil
from collections.abc import Callable, Generator, Iterable
from contextlib import nullcontext
from functools import partial
from pathlib import Path

import dask_cluster
import pytest
from sessions import edit
from without_figures import run

from calib.apps.fleet import fleet
from calib.errors import MeasurementError, NotConverged, TaskLost, Unidentifiable, UsageError, exit_code
from calib.procedure.session import steps
from calib.procedure.session.folder import locked, open_session
from calib.workers import Workers


@pytest.fixture
def cells(finished_folder: Path, planned_folder: Path, tmp_path: Path) -> Path:
    """Four folders: done, with a damaged file, waiting, and no session."""
    for name, source in (("a", finished_folder), ("b", finished_folder), ("c", planned_folder)):
        shutil.copytree(source, tmp_path / "cells" / name)
    edit(tmp_path / "cells/b/3-measured/measured.csv", "joint1 [deg]", "joint1 [rad]")
    (tmp_path / "cells/d").mkdir()
    return tmp_path / "cells"


def test_one_that_fails_stops_none(cells: Path, capsys: pytest.CaptureFixture) -> None:
    assert run("run", *sorted(cells.iterdir())) == 2
    said = capsys.readouterr().out
    assert "[red]" not in said and "[/]" not in said
    assert "1 of 4 done" in said and "1 waiting, 2 failed" in said
    assert f"{cells / 'b'} failed" in said and "looks like" in said and f"{cells / 'c'} waits for a file" in said
    assert "looks like" in (cells / "b/run.log").read_text() and "Provide " in (cells / "c/run.log").read_text()
    assert not list((cells / "d").iterdir())
    assert run("run", cells / "a/session.toml") == 0
    assert run("run", cells / "a", cells / "a/session.toml") == 2


def test_session_in_use_is_busy(cells: Path, capsys: pytest.CaptureFixture) -> None:
    """It has not failed, and its log is left to that command."""
    with locked(open_session(cells / "c"), lambda words: None):
        assert run("run", cells / "a", cells / "c") == 2
    said = capsys.readouterr().out
    assert "1 of 2 done" in said and "1 busy" in said and "failed" not in said
    assert f"\n{cells / 'c'} is busy: process" in said and not (cells / "c/run.log").exists()


def test_a_failing_verdict_is_code_1(cells: Path) -> None:
    path = cells / "a/5-validation/metrics.json"
    path.write_text(path.read_text().replace('"verdict": "', '"verdict": "fail", "was": "'))
    assert [one.code for one in fleet.run_sessions([cells / "a", cells / "c"], command="test")] == [1, 0]


def test_unforeseen_error_stops_no_session(cells: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An unforeseen error stops no session, either."""
    monkeypatch.setattr(steps, "run_next", lambda *given: 1 / 0)
    one = fleet.run_session(cells / "a")
    assert one.state == fleet.FAILED and one.code == 4 and "ZeroDivisionError" in one.words
    (report,) = (cells / "a").glob("calib-bug-*.txt")
    assert "Traceback" in report.read_text() and report.name in (cells / "a/run.log").read_text()
    assert not (cells / "a/session.lock").exists()


def test_robot_of_a_dead_process_has_failed(cells: Path) -> None:
    """A robot whose process dies is one that failed."""

    def stream(function: Callable, tasks: Iterable[tuple], near: Callable[[int], bool]) -> Generator:
        _, given = tasks
        yield 1, function(*given), None
        yield 0, None, TaskLost("task 1 is lost: 3 processes died of it")

    found = list(fleet.run([cells / "c", cells / "d"], nullcontext(Workers(stream)), "test"))
    assert [(one.folder, one.state, one.code) for one in found] == [(str(cells / x), "failed", 2) for x in "dc"]
    assert "3 processes died" in found[1].words and "is lost" not in found[0].words


@pytest.mark.slow
def test_a_fleet_on_a_cluster(cells: Path, tmp_path: Path, monkeypatch, capsys: pytest.CaptureFixture) -> None:
    """Folders named from here are found there; each robot is said when it is done, the table in the order given."""
    monkeypatch.chdir(cells)
    with dask_cluster.running(tmp_path, workers=2) as cluster:
        assert run("run", "d", "c", "a", "--workers", cluster.address) == 2
    said = capsys.readouterr().out
    assert "1 of 3 done" in said and "a: done, " in said and " mm, " in said and "d failed: " in said
    table = said[said.index("session ") :].splitlines()
    assert [line.split()[0] for line in table[1:4]] == ["d", "c", "a"]
    assert "Provide " in (cells / "c/run.log").read_text()


def test_a_session_runs_at_its_address(cells: Path, capsys: pytest.CaptureFixture) -> None:
    """As in its folder; wildcards name sessions alone, and one that is named twice is refused."""
    address = f"file://{cells}"
    assert run("run", f"{address}/[ac]") == 0
    said = capsys.readouterr().out
    assert "1 of 2 done" in said and "1 waiting" in said
    assert "Provide " in (cells / "c/run.log").read_text() and not list(cells.glob("*/calib.claim"))
    assert run("run", f"{address}/*", f"{address}/a") == 2
    assert "is given twice" in capsys.readouterr().err


def test_what_workers_get_pickles(cells: Path) -> None:
    task = pickle.loads(pickle.dumps(partial(fleet.run_session, command="test")))
    outcome = task(cells / "d")
    assert pickle.loads(pickle.dumps(outcome)) == outcome


def test_exit_codes_by_error() -> None:
    from calib.poses.errors import NotIdentifiable

    assert [exit_code(error) for error in (UsageError("x"), MeasurementError("x", "f"))] == [2, 2]
    assert [exit_code(error) for error in (Unidentifiable("x"), NotConverged("x"))] == [3, 3]
    assert exit_code(KeyError("x")) is None and exit_code(NotIdentifiable.__new__(NotIdentifiable)) == 3
