"""Parallel work: results as they come, whoever dies; the same for this process, processes, and a real Dask cluster."""

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from itertools import islice
from pathlib import Path

import dask_cluster
import pytest
from worker_tasks import (
    SECONDS,
    Awkward,
    complain,
    complain_awkwardly,
    die_at_first,
    die_of_two,
    late_first,
    pid_a_little_later,
    pid_once_both_began,
    square,
    threads,
    wait_or_square,
)

from calib.errors import CalibError, MeasurementError, TaskLost, UsageError
from calib.workers import Workers, finishing, workers


@pytest.fixture(scope="module")
def crews(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Workers]]:
    with pytest.MonkeyPatch.context() as patch, ExitStack() as ends:

        class Crews(dict[str, Workers]):
            """Crews by where they work; a cluster takes seconds to start, and is started once it is asked for."""

            def __missing__(self, where: str) -> Workers:
                cluster = ends.enter_context(dask_cluster.running(tmp_path_factory.mktemp(where), workers=2))
                self[where] = ends.enter_context(workers(cluster.address))
                return self[where]

        here, processes = ends.enter_context(workers()), ends.enter_context(workers(2))
        patch.setenv("OPENBLAS_NUM_THREADS", "2")  # of this process: its workers get one, see below
        yield Crews(here=here, processes=processes)


DASK = pytest.param("dask", marks=pytest.mark.slow)
EVERYWHERE = pytest.mark.parametrize("where", ["here", "processes", DASK])
IN_PARALLEL = pytest.mark.parametrize("where", ["processes", DASK])


@EVERYWHERE
def test_results_in_order_or_each_once(crews: dict[str, Workers], where: str) -> None:
    assert list(crews[where].map(pow, [2, 3, 5], [1, 2, 3])) == [2, 9, 125]
    assert sorted(crews[where].completed(square, range(20))) == [(i, i * i) for i in range(20)]
    assert list(crews[where].completed(square, [])) == []


@EVERYWHERE
def test_what_a_task_raises_is_raised_here(crews: dict[str, Workers], where: str) -> None:
    for run in (crews[where].map, crews[where].completed):
        with pytest.raises(MeasurementError) as caught:
            list(run(complain, [7, 7]))
        assert (caught.value.row, caught.value.file) == (7, "log.csv")
        with pytest.raises((Awkward, RuntimeError), match="1 and 1"):
            list(run(complain_awkwardly, [1]))
    assert list(crews[where].map(square, [3])) == [9]


@IN_PARALLEL
def test_results_come_as_tasks_complete(crews: dict[str, Workers], where: str, tmp_path: Path) -> None:
    """The first task ends only once the results of all others are here."""
    seen = []
    for number, _ in crews[where].completed(wait_or_square, [(tmp_path / "go", x) for x in range(6)]):
        seen.append(number)
        if len(seen) == 5:
            (tmp_path / "go").touch()
    assert seen == [1, 2, 3, 4, 5, 0]


@IN_PARALLEL
def test_one_run_at_a_time(crews: dict[str, Workers], where: str) -> None:
    results = crews[where].completed(square, range(9))
    assert next(results)
    with pytest.raises(RuntimeError, match="busy"):
        list(crews[where].map(square, [1]))
    assert len(list(results)) == 8


@EVERYWHERE
def test_few_of_many_tasks_are_begun_at_once(crews: dict[str, Workers], where: str) -> None:
    """Of a million tasks few are taken at once."""
    taken = []
    tasks = (taken.append(x) or x for x in range(1_000_000))
    assert len(list(islice(crews[where].completed(square, tasks), 5))) == 5
    assert len(taken) <= 5 + 2 * 2


@IN_PARALLEL
def test_few_results_wait_for_their_turn(crews: dict[str, Workers], where: str) -> None:
    """256 of them, and two that are begun."""
    taken = []
    results = crews[where].map(late_first, (taken.append(x) or x for x in range(600)))
    assert next(results) == 0 and len(taken) <= 256 + 2
    assert list(results) == list(range(1, 600))


@IN_PARALLEL
def test_workers_use_one_thread_each(crews: dict[str, Workers], where: str) -> None:
    found = list(crews[where].map(threads, range(2)))
    assert all(len(counts) > 1 and set(counts) == {1} for counts in found)
    assert os.environ["OPENBLAS_NUM_THREADS"] == "2"


@pytest.mark.slow
def test_task_of_killed_process_runs_again(crews: dict[str, Workers], tmp_path: Path) -> None:
    """A task whose process is killed is tried again."""
    tasks = [tmp_path / f"{x}" for x in range(3)]
    assert sorted(crews["processes"].completed(die_at_first, tasks)) == [(x, f"{x}") for x in range(3)]


@pytest.mark.slow
def test_lost_task_costs_no_other_result(crews: dict[str, Workers]) -> None:
    """A task lost for good costs no other result."""
    found = dict(crews["processes"].completed(die_of_two, range(5)))
    lost = found.pop(2)
    assert found == {0: 0, 1: 1, 3: 3, 4: 4}
    assert isinstance(lost, TaskLost) and (lost.number, lost.task) == (2, 2)
    assert "task 3 (2) is lost: 3 processes died running it, the last by signal 9" in str(lost)


def crew_of(*answers: tuple[int, int | None, TaskLost | None]) -> Workers:
    """Return workers that give these answers: number of the task, result, loss."""
    return Workers(lambda function, tasks, near: (answer for answer, _ in zip(answers, tasks)))  # type: ignore[arg-type]


def test_lost_task_is_raised_or_left_out() -> None:
    """In order, a lost task is raised in its place, and a search leaves it out."""
    crew = crew_of((1, None, TaskLost("task 2 is lost", 1)), (2, 4, None), (0, 0, None))
    results = crew.map(square, range(3))
    assert next(results) == 0
    with pytest.raises(TaskLost, match="task 2"):
        next(results)
    lost = list[TaskLost]()
    assert list(crew.map_without(lost)(square, range(3))) == [0, 4]
    assert [one.number for one in lost] == [1]


def test_search_losing_every_task_says_so() -> None:
    """A search that loses every task says so."""
    crew = crew_of(*((number, None, TaskLost(f"task {number + 1} is lost")) for number in range(3)))
    with pytest.raises(TaskLost, match="task 3"):
        list(crew.map_without([])(square, range(3)))
    assert list(crew.map_without([])(square, [])) == []


@pytest.mark.slow
def test_cluster_loses_workers_and_no_result(tmp_path: Path) -> None:
    """Of two workers one is killed in the middle; then a task kills whoever runs it, twice; then the scheduler goes."""
    with dask_cluster.running(tmp_path, workers=2, failures=1) as cluster, workers(cluster.address) as crew:
        pids = {worker.pid: worker for worker in cluster.workers}
        seen = list[tuple[int, int]]()
        # the first two tasks end once both workers have begun one: neither can do all alone, however busy the machine
        for number, pid in crew.completed(pid_once_both_began, [(tmp_path, k) for k in range(16)]):
            seen.append((number, pid))
            if len(seen) == 1:
                pids.pop(pid).kill()
        (survivor,) = pids
        # a result that was on its way from the killed worker counts
        assert {pid for _, pid in seen[3:]} == {survivor}
        assert sorted(number for number, _ in seen) == list(range(16))
        cluster.add(2)
        found = dict(crew.completed(die_of_two, range(5)))
        lost = found.pop(2)
        assert found == {0: 0, 1: 1, 3: 3, 4: 4}
        assert isinstance(lost, TaskLost) and (lost.number, lost.task) == (2, 2)
        assert "it ended 2 of the cluster's workers" in str(lost)
        results = crew.completed(pid_a_little_later, range(100))
        assert next(results)[0] == 0
        cluster.scheduler.kill()
        started = time.monotonic()
        with pytest.raises(CalibError, match="is gone"):
            list(results)
        with pytest.raises(CalibError, match="is gone"):
            list(crew.map(square, [1]))
    assert time.monotonic() - started < SECONDS


@pytest.mark.slow
def test_empty_cluster_is_not_awaited_long(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A cluster without workers is not waited for long."""
    monkeypatch.setattr("calib.workers.cluster.NO_WORKERS", 1.0)
    alone = dask_cluster.running(tmp_path, workers=0)
    complaint = pytest.raises(CalibError, match="has had no workers for 1 s")
    with alone as cluster, workers(cluster.address) as crew, complaint:
        list(crew.completed(square, range(3)))


def test_where_nothing_answers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("calib.workers.cluster.ANSWER", 0.3)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        port = silent.getsockname()[1]
        for wrong in (f"tcp://127.0.0.1:{port}", "tcp://127.0.0.1:1", "tcp://127.0.0.1", "smoke://127.0.0.1:8786"):
            with pytest.raises(UsageError, match="no Dask scheduler answers at"), workers(wrong):
                pass


@pytest.mark.parametrize("wrong", ["many", "0", "-1", "1.5", ""])
def test_workers_are_a_number_or_an_address(wrong: str) -> None:
    with pytest.raises(UsageError, match="expected a number of processes or an address"), workers(wrong):
        pass


def test_this_process_takes_one_task_at_once() -> None:
    """This process takes one task at a time."""
    taken = []
    with workers("1") as crew:
        results = crew.map(square, (taken.append(x) or x for x in (2, 3)))
        assert (next(results), taken) == (4, [2])


SCRIPT = """
import sys
from pathlib import Path
from calib.workers import processes, workers
from worker_tasks import {task}
if {guard}:
    processes.GRACE, processes.ATTEMPTS = 0.5, 1
    with workers(2) as crew:
        for result in crew.{run}({task}, [Path(sys.argv[1])] * 9):
            print(result, flush=True)
"""


def script(
    folder: Path, run: str = "map", guard: str = "__name__ == '__main__'", task: str = "until_told"
) -> subprocess.Popen:
    (folder / "script.py").write_text(SCRIPT.format(run=run, guard=guard, task=task))
    return subprocess.Popen(
        [sys.executable, str(folder / "script.py"), str(folder)], text=True, start_new_session=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
    )  # fmt: skip


def pids_in(folder: Path) -> list[int]:
    """Return the processes at work, once there are two."""
    until = time.monotonic() + SECONDS
    while len(found := list(folder.glob("*.pid"))) < 2:
        assert time.monotonic() < until
        time.sleep(0.02)
    return [int(path.stem) for path in found]


def assert_gone(pids: list[int]) -> None:
    until = time.monotonic() + SECONDS
    for pid in pids:
        with suppress(ProcessLookupError):
            while time.monotonic() < until:
                os.kill(pid, 0)
                time.sleep(0.02)
            raise AssertionError(f"process {pid} is still there")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("run", "hit"), [("map", "group"), pytest.param("completed", "parent", marks=pytest.mark.slow), ("map", "workers")]
)
def test_ctrl_c_hands_back_tasks_under_way(tmp_path: Path, run: str, hit: str) -> None:
    """Whether the terminal's group gets it, this process alone, or its workers before it; no further task begins."""
    running = script(tmp_path, run)
    pids = pids_in(tmp_path)
    for pid in pids if hit == "workers" else [running.pid]:
        (os.killpg if hit == "group" else os.kill)(pid, signal.SIGINT)
    out, err = running.communicate(timeout=SECONDS)
    assert out.count("so far") == 2 and "KeyboardInterrupt" in err and running.returncode != 0
    assert len(list(tmp_path.glob("*.pid"))) == 2
    assert_gone(pids)


@pytest.mark.slow
def test_second_signal_hides_worker_output(tmp_path: Path) -> None:
    """A terminal sends its own beside the parent's."""
    running = script(tmp_path, task="slow_to_say")
    for pid in pids_in(tmp_path):
        os.kill(pid, signal.SIGINT)
        time.sleep(0.3)
        os.kill(pid, signal.SIGINT)
    _, err = running.communicate(timeout=SECONDS)
    assert "_serve" not in err and err.count("Traceback") - err.count("in a worker process:") == 1, err
    assert running.returncode != 0


@pytest.mark.slow
def test_no_process_outlives_its_parent(tmp_path: Path) -> None:
    running = script(tmp_path)
    pids = pids_in(tmp_path)
    running.kill()
    assert_gone(pids)
    running.communicate(timeout=SECONDS)


@pytest.mark.slow
def test_self_starting_script_is_told(tmp_path: Path) -> None:
    """A script that starts itself again is told."""
    running = script(tmp_path, guard="True")
    _, err = running.communicate(timeout=SECONDS)
    assert "CalibError: worker processes die at start" in err and "lack if __name__" in err


def test_nearly_done_survives_one_interrupt() -> None:
    """What is nearly done survives one interrupt, and not two."""
    before = signal.getsignal(signal.SIGINT)
    with finishing():
        os.kill(os.getpid(), signal.SIGINT)
        done = sum(range(1000))
    assert done == 499500 and signal.getsignal(signal.SIGINT) is before
    with pytest.raises(KeyboardInterrupt), finishing():
        for _ in range(2):
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(0.01)
    assert signal.getsignal(signal.SIGINT) is before
