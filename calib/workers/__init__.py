"""Parallel execution of tasks: in this process, in local processes, or on a Dask scheduler with a known address.

`Workers.completed` yields results as they complete, `Workers.map` in the order of the tasks; the packages ``poses`` and
``trajectories`` take `Workers.map` as a plain callable. Functions, tasks and results must be picklable. If a process
dies, its task is repeated, by this module or by the scheduler: a task may run twice, but yields one result. A task that
fails repeatedly yields a `TaskLost` and does not affect the other tasks. Only a few tasks are in progress at a time
(one per process, or per thread of the cluster), so that there may be millions of tasks; each should take a tenth of a
second or more.

Processes are spawned, not forked, since forked threads of numerical libraries may block; scripts that use workers need
``if __name__ == "__main__"``. BLAS, OpenMP and numba use one thread in every worker, since the tasks run in parallel.
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
    """Runner of many parallel tasks, created by the function `workers`.

    Attributes:
        here: whether tasks run on this computer, with the current folder of this process.
    """

    _stream: Stream
    here: bool = True

    def completed(self, function: Callable[..., Any], tasks: Iterable[object]) -> Iterator[tuple[int, Any]]:
        """Yield the number (from 0) of each task and its result, in the order of completion.

        Tasks are read from the iterable as needed. The result of a task that was lost repeatedly is a `TaskLost`. An
        exception in a task is raised.

        Args:
            function: function of one task; must be picklable.
            tasks: the tasks.
        """
        with closing(self._stream(function, ((task,) for task in tasks), lambda number: True)) as answers:
            for number, result, error in answers:
                if error is not None and not isinstance(error, TaskLost):
                    raise error
                yield number, result if error is None else error

    def map(self, function: Callable, *items: Iterable[object]) -> Iterator[Any]:
        """Yield function(*item) for the items in their order, like the builtin `map`.

        After Ctrl-C, the available results are yielded, and then KeyboardInterrupt is raised.

        Args:
            function: the function; must be picklable.
            *items: one iterable for each argument of the function.

        Raises:
            TaskLost: instead of a lost result.
        """
        return self._in_order(None, function, *items)

    def map_without(self, lost: list[TaskLost]) -> Callable[..., Iterator[Any]]:
        """Return a function like `map` that omits lost tasks, for searches that need only the best result.

        If all tasks are lost, the last `TaskLost` is raised.

        Args:
            lost: list to which lost tasks are appended.
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
    """Yield workers for parallel tasks; at the end of the block, workers and running tasks are stopped.

    Args:
        where: None, 1 or "1" for this process; a number of local processes; or the address of a Dask scheduler, such as
            ``tcp://host:8786`` (requires the extra ``cluster``, and this toolkit on the cluster's workers).

    Raises:
        UsageError: for any other value, a scheduler that does not answer, or missing Dask.
        CalibError: while tasks run, if the scheduler stops, or has had no workers for a minute.
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
def finishing() -> Iterator[list[int]]:
    """Run the block to its end even after Ctrl-C: the first Ctrl-C is ignored, a second one stops the block at once.

    Yields the list of ignored signals, which grows when Ctrl-C is pressed.
    """
    heard: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield heard
        return
    before = signal.getsignal(signal.SIGINT)

    def note(number: int, frame: object) -> None:
        if heard:
            raise KeyboardInterrupt
        heard.append(number)

    signal.signal(signal.SIGINT, note)
    try:
        yield heard
    finally:
        signal.signal(signal.SIGINT, before)
