"""Throughput of workers: the number of tasks that each worker completed, and the time per task."""

import os
import socket
import time
from collections.abc import Callable, Iterable, Iterator
from functools import partial

from calib.errors import TaskLost
from calib.workers import Workers


class Throughput:
    """Durations [s] of completed tasks, by worker (host and process), since this object was created."""

    def __init__(self) -> None:
        self.began, self.spent = time.monotonic(), dict[str, list[float]]()

    def completed(self, crew: Workers, function: Callable[..., object], tasks: Iterable[object]) -> Iterator[tuple]:
        """Yield (index of the task, result) as tasks are completed, and record the worker and the duration of each.

        Args:
            crew: the workers.
            function: the function to call for each task.
            tasks: the arguments, one per task.
        """
        for number, answer in crew.completed(partial(_signed, function), tasks):
            if isinstance(answer, TaskLost):
                yield number, answer
                continue
            result, worker, seconds = answer
            self.spent.setdefault(worker, []).append(seconds)
            yield number, result

    def lines(self, limit: int = 8) -> list[str]:
        """Return one line per worker, the slowest first, at most `limit` lines; an empty list for a single worker."""
        minutes = max((time.monotonic() - self.began) / 60.0, 1e-9)
        ranked = sorted(self.spent.items(), key=lambda item: len(item[1]))
        if len(ranked) < 2:
            return []
        lines = []
        for name, seconds in ranked[:limit]:
            count = len(seconds)
            pace = count / minutes
            mean = sum(seconds) / count
            lines.append(f"worker {name}: {count} tasks, {pace:.3g} a minute, {mean:.2g} s each")
        omitted = len(ranked) - limit
        if omitted > 0:
            lines.append(f"{omitted} more workers, faster than these")
        return lines


def _signed(function: Callable[..., object], task: object) -> tuple[object, str, float]:
    """Run function(task); return its result, the worker (host and process), and the wall-clock time [s]."""
    started = time.monotonic()
    result = function(task)
    return result, f"{socket.gethostname()}:{os.getpid()}", time.monotonic() - started
