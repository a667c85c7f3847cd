"""Parallel execution of tasks: in this process, in local processes, or on a Dask scheduler by address.

`Workers.completed` yields results as they complete, `Workers.map` in order; ``poses`` and ``trajectories`` use
`Workers.map` as a plain callable. Functions, tasks and results must pickle. If the process of a task dies, the task is
repeated, here or by the scheduler: it may run twice, but yields one result. A task that fails repeatedly yields a
`TaskLost` and does not affect the others. Few tasks are in progress at a time (one per process, or per thread of the
cluster), so that there may be millions; each should take a tenth of a second or more.

Processes are spawned, not forked, since forked threads of numerical libraries may block; scripts that use workers need
``if __name__ == "__main__"``. BLAS, OpenMP and numba get one thread in every worker, since the tasks run in parallel.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, closing, contextmanager
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

from calib.errors import TaskLost, UsageError

if TYPE_CHECKING:
    from calib.workers.processes import Crew, Stream


# Tasks that may be ahead of the one whose turn it is, where results are wanted in order (our choice).
MAX_AHEAD = 256


@dataclass(frozen=True)
class Workers:
    """Runs many tasks in parallel, created by `workers`.

    Attributes:
        here: whether tasks run in this process's current folder.
    """

    _stream: Stream
    here: bool = True

    def completed(self, function: Callable[..., Any], tasks: Iterable[object]) -> Iterator[tuple[int, Any]]:
        """Yield (number of the task, its result) as tasks complete; tasks are read from the iterable as needed.

        A task that was lost repeatedly has a `TaskLost` as its result. An exception of a task is raised.
        """
        with closing(self._stream(function, ((task,) for task in tasks), lambda number: True)) as answers:
            for number, result, error in answers:
                if error is not None and not isinstance(error, TaskLost):
                    raise error
                yield number, result if error is None else error

    def map(self, function: Callable, *items: Iterable[object]) -> Iterator[Any]:
        """Yield results in the order of the tasks, like the builtin `map`; after Ctrl-C, the available results, then
        raise.

        Raises:
            TaskLost: instead of a lost result.
        """
        return self._in_order(None, function, *items)

    def map_without(self, lost: list[TaskLost]) -> Callable[..., Iterator[Any]]:
        """Return a `map` for searches that need only the best result: lost tasks are appended to `lost`.

        If all tasks are lost, it raises the last `TaskLost`.
        """
        return partial(self._in_order, lost)

    def _in_order(self, lost: list[TaskLost] | None, function: Callable, *items: Iterable[object]) -> Iterator[object]:
        early: dict[int, tuple[object, BaseException | None]] = {}
        turn = 0
        missing = 0

        def is_near(number: int) -> bool:
            return number < turn + MAX_AHEAD

        with closing(self._stream(function, zip(*items), is_near)) as answers:
            try:
                for number, result, error in answers:
                    early[number] = result, error
                    while turn in early:
                        result, error = early.pop(turn)
                        turn += 1
                        if error is None:
                            yield result
                        elif lost is not None and isinstance(error, TaskLost):
                            lost.append(error)
                            missing += 1
                        else:
                            raise error
            except KeyboardInterrupt:
                for number in sorted(early):
                    result, error = early[number]
                    if error is None:
                        yield result
                raise
        if lost and missing == turn > 0:
            raise lost[-1]


@contextmanager
def workers(where: str | int | None = None) -> Iterator[Workers]:
    """Yield workers for parallel tasks; at the end of the block they are stopped, with their running tasks.

    Args:
        where: None, 1 or "1" for this process; a number of local processes; or the address of a Dask scheduler, e.g.
            ``tcp://host:8786`` (needs the extra ``cluster``, and this toolkit on its workers).

    Raises:
        UsageError: for anything else, a scheduler that does not answer, or Dask missing.
        CalibError: while tasks run: the scheduler went away, or has had no workers for a minute.
    """
    text = str(where if where is not None else 1)
    if "://" not in text and (not text.isdigit() or int(text) < 1):
        raise UsageError(f"workers '{where}': expected a number of processes or an address such as tcp://host:8786")
    if text.isdigit() and int(text) == 1:
        yield Workers(lambda function, tasks, near: ((n, function(*task), None) for n, task in enumerate(tasks)))
        return
    from calib.workers import cluster, processes

    crew_context: AbstractContextManager[Crew] = (
        cluster.dask(text) if "://" in text else closing(processes.Processes(int(text)))
    )
    with crew_context as crew:
        yield Workers(partial(processes.streamed, crew), here="://" not in text)


@contextmanager
def finishing() -> Iterator[None]:
    """Run the block to its end: the first Ctrl-C is ignored, a second one stops it at once."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before, heard = signal.getsignal(signal.SIGINT), []

    def note(number: int, frame: object) -> None:
        if heard:
            raise KeyboardInterrupt
        heard.append(number)

    signal.signal(signal.SIGINT, note)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
