"""Sessions and studies at addresses: put back whole, by one at a time, and gone on with after whoever was killed."""

import subprocess
import sys
import time
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace

import dask_cluster
import fsspec
import pytest
from worker_tasks import SECONDS, STEPS, step_by_step

from calib.apps.fleet import stores
from calib.apps.fleet.throughput import Throughput
from calib.errors import Busy, CalibError, UsageError
from calib.workers import workers

QUICK = 0.08  # [s] lease of a claim


@pytest.fixture
def place(tmp_path: Path) -> str:
    (tmp_path / "cell").mkdir()
    (tmp_path / "cell/session.toml").write_text("robot")
    (tmp_path / "cell/state.json").write_text("before")
    (tmp_path / "cell/gone.txt").write_text("x")
    return f"file://{tmp_path / 'cell'}"


def test_only_changes_are_put_back(place: str, tmp_path: Path) -> None:
    """What changed is put back, and nothing else."""
    before = (tmp_path / "cell/session.toml").stat().st_mtime_ns
    with stores.held(place) as folder:
        assert (folder / "session.toml").read_text() == "robot"
        (folder / "4-fit").mkdir()
        (folder / "4-fit/new.csv").write_text("1")
        (folder / "state.json").write_text("after")
        (folder / "session.lock").write_text("ours")
        (folder / "gone.txt").unlink()
    found = {path.name: path.read_text() for path in (tmp_path / "cell").rglob("*") if path.is_file()}
    assert found == {"session.toml": "robot", "state.json": "after", "new.csv": "1"}
    assert (tmp_path / "cell/session.toml").stat().st_mtime_ns == before


def test_object_storage_without_folders() -> None:
    files = fsspec.filesystem("memory")
    files.pipe_file("/bucket/a/session.toml", b"robot")
    files.pipe_file("/bucket/b/session.toml", b"robot")
    assert stores.sessions("memory://bucket/*") == ["memory:///bucket/a", "memory:///bucket/b"]
    with stores.held("memory://bucket/a") as folder:
        (folder / "5-validation").mkdir()
        (folder / "5-validation/metrics.json").write_text("{}")
    assert sorted(files.find("/bucket/a")) == ["/bucket/a/5-validation/metrics.json", "/bucket/a/session.toml"]
    with pytest.raises(UsageError, match="no session"):
        stores.sessions("memory://bucket/nothing")
    with pytest.raises(UsageError, match="smoke"):
        stores.sessions("smoke://bucket/*")


def test_full_disk_leaves_earlier_state(place: str, tmp_path: Path, monkeypatch) -> None:
    """What says that a step is complete is written after what the step made, or not at all."""
    from fsspec.implementations.local import LocalFileSystem

    put = LocalFileSystem.put_file

    def full(files: LocalFileSystem, here: str, there: str, **more: object) -> None:
        if "big" in there:
            raise OSError(28, "No space left on device")
        put(files, here, there, **more)

    def work() -> None:
        with stores.held(place) as folder:
            (folder / "big.csv").write_text("1")
            (folder / "state.json").write_text("after")

    with monkeypatch.context() as disk:
        disk.setattr(LocalFileSystem, "put_file", full)
        with pytest.raises(CalibError, match="No space left on device; run the same command again"):
            work()
    assert (tmp_path / "cell/state.json").read_text() == "before"
    work()
    assert (tmp_path / "cell/state.json").read_text() == "after" and (tmp_path / "cell/big.csv").exists()


def waits_for_a_change(claim: Path) -> SimpleNamespace:
    """Return a clock that sleeps until a claim's holder has renewed it: a lease that is long enough on any machine."""

    def sleep(lease: float) -> None:
        before, until = claim.read_text(), time.monotonic() + SECONDS
        while claim.read_text() == before and time.monotonic() < until:
            time.sleep(0.01)

    return SimpleNamespace(sleep=sleep)


def test_two_clients_on_one_session(place: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as clock, stores.held(place, QUICK):
        clock.setattr(stores, "time", waits_for_a_change(tmp_path / "cell/calib.claim"))
        with pytest.raises(Busy, match="is busy: process"), stores.held(place, QUICK):
            pass
    with stores.held(place, QUICK):
        pass


@pytest.mark.parametrize(("text", "busy"), [("", True), (None, False)], ids=["being written", "released"])
def test_claim_without_text_is_being_renewed(
    place: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str | None, busy: bool
) -> None:
    """A claim without text is being renewed."""
    claim = tmp_path / "cell/calib.claim"
    claim.write_text("process 1 on elsewhere (0) 7")

    def sleep(lease: float) -> None:
        claim.unlink()
        if text is not None:
            claim.write_text(text)

    monkeypatch.setattr(stores, "time", SimpleNamespace(sleep=sleep))
    expected = pytest.raises(Busy, match="process 1 on elsewhere works on it") if busy else nullcontext()
    with expected, stores.held(place, QUICK):
        pass


def test_slow_worker_writes_nothing_late(place: str, tmp_path: Path) -> None:
    """Who was slow writes nothing once another took over."""
    late = stores.held(place, 1000.0)  # its claim does not change for long: as if it were gone
    folder = late.__enter__()
    with stores.held(place, QUICK) as mine:
        (mine / "state.json").write_text("mine")
        (folder / "state.json").write_text("too late")
        with pytest.raises(CalibError, match="was taken over by process"):
            late.__exit__(None, None, None)
    assert (tmp_path / "cell/state.json").read_text() == "mine" and not (tmp_path / "cell/calib.claim").exists()


def test_throughput_is_said_by_worker() -> None:
    pace = Throughput()
    assert pace.lines() == []
    pace.spent = {f"host:{k}": [0.5] * (k + 1) for k in range(10)}
    pace.began -= 60.0
    assert pace.lines()[0] == "worker host:0: 1 tasks, 1 a minute, 0.5 s each"
    assert pace.lines()[-1] == "2 more workers, faster than these" and len(pace.lines()) == 9


CLIENT = """
import sys
from calib.workers import workers
from worker_tasks import step_by_step
with workers(sys.argv[1]) as crew:
    for number, made in crew.completed(step_by_step, sys.argv[2:]):
        print(number, flush=True)
"""


@pytest.mark.slow
def test_scheduler_worker_or_client_killed(tmp_path: Path) -> None:
    """Each in turn, on 16 cells of four steps: nothing is lost, and no step counts twice."""
    places = [f"file://{tmp_path}/cells/{k:02d}" for k in range(16)]
    for one in ("first", "second"):
        (tmp_path / one).mkdir()
    with dask_cluster.running(tmp_path / "first", workers=3) as cluster:
        client = subprocess.Popen(
            [sys.executable, "-c", CLIENT, cluster.address, *places], stdout=subprocess.PIPE, text=True,
            env=cluster.environment,
        )  # fmt: skip
        assert client.stdout is not None and client.stdout.readline()
        client.kill()
        client.communicate()
        with pytest.raises(CalibError, match="is gone"), workers(cluster.address) as crew:
            for count, _ in enumerate(crew.completed(step_by_step, places)):
                if count == 3:
                    cluster.workers[0].kill()
                if count == 8:
                    cluster.scheduler.kill()
    pace, found = Throughput(), dict[int, int]()
    until = time.monotonic() + SECONDS
    with dask_cluster.running(tmp_path / "second", workers=2) as cluster, workers(cluster.address) as crew:
        found.update(pace.completed(crew, step_by_step, places))
    assert time.monotonic() < until and sorted(found) == list(range(16)) and 0 < sum(found.values()) < 16 * 4
    assert len(pace.lines()) == 2
    for k in range(16):
        cell = tmp_path / f"cells/{k:02d}"
        assert [line.split()[0] for line in (cell / "state.json").read_text().splitlines()] == list(STEPS)
        assert {path.name for path in cell.iterdir()} == {"state.json", *(f"{step}.txt" for step in STEPS)}
