"""Execution of tasks by local processes or a cluster: start tasks, collect results, repeat lost tasks."""

import pickle
import traceback
from collections import deque
from collections.abc import Callable, Generator, Iterable
from dataclasses import dataclass
from reprlib import repr as shortened
from threading import Lock
from typing import Any, Protocol

from calib.errors import TaskLost, quiet
from calib.workers.threads import limit_worker

Answer = tuple[int, Any, BaseException | None]  # task, result, or what the task raised
Stream = Callable[[Callable, Iterable[tuple], Callable[[int], bool]], Generator[Answer]]


class Died(Exception):
    """Placeholder for the result of a task whose process died."""


class NotBegun(Exception):
    """Placeholder for the result of a task whose process died before it received the task."""


class Crew(Protocol):
    """Runner of numbered tasks, each a pickled function with its arguments."""

    attempts: int
    busy: Lock

    def free(self) -> int:
        """Return the number of tasks that can be started now."""
        ...

    def pickled(self, call: tuple[Callable, tuple]) -> bytes: ...

    def begin(self, number: int, call: bytes) -> None: ...

    def ended(self) -> Iterable[Answer]:
        """Wait for tasks to end, and return their answers."""
        ...

    def settled(self) -> Iterable[Answer]:
        """Return the answers of the running tasks after Ctrl-C."""
        ...

    def drop(self) -> None:
        """Cancel the running tasks."""
        ...


@dataclass
class _Task:
    arguments: tuple
    call: bytes
    deaths: int = 0


def streamed(crew: Crew, function: Callable, tasks: Iterable[tuple], near: Callable[[int], bool]) -> Generator[Answer]:
    """Yield answers as they arrive; a task starts when a worker is free and `near` accepts its number."""
    if not crew.busy.acquire(blocking=False):
        raise RuntimeError("these workers are busy: end one `map` or `completed` before the next")
    upcoming, begun = enumerate(tasks), 0
    under_way, again, found = dict[int, _Task](), deque[int](), deque[Answer]()
    try:
        while True:
            while crew.free() > 0:
                if again:
                    number = again.popleft()
                elif near(begun) and (following := next(upcoming, None)) is not None:
                    number, arguments = following
                    begun, under_way[number] = number + 1, _Task(arguments, crew.pickled((function, arguments)))
                else:
                    break
                crew.begin(number, under_way[number].call)
            if found:
                yield found.popleft()
                continue
            if not under_way:
                return
            for number, result, error in crew.ended():
                task = under_way[number]
                task.deaths += isinstance(error, Died)
                if isinstance(error, NotBegun) or (isinstance(error, Died) and task.deaths < crew.attempts):
                    again.append(number)
                    continue
                del under_way[number]
                if isinstance(error, KeyboardInterrupt):
                    raise error
                found.append((number, result, _lost(number, task, error) if isinstance(error, Died) else error))
    except (Exception, KeyboardInterrupt) as error:
        yield from found
        if isinstance(error, KeyboardInterrupt):
            yield from (answer for answer in crew.settled() if answer[2] is None)
        raise
    finally:
        crew.drop()
        crew.busy.release()


def _lost(number: int, task: _Task, error: Died) -> TaskLost:
    given = task.arguments[0] if len(task.arguments) == 1 else task.arguments
    return TaskLost(
        f"task {number + 1} ({shortened(given)}) is lost: {error}. The usual cause is too little memory: run "
        "fewer tasks at once",
        number, given,
    )  # fmt: skip


def run_call(
    call: bytes, hear: Callable[[], Any], dumps: Callable[[Any], bytes], hush: Callable[[], Any] = lambda: None
) -> bytes:
    """Run a pickled call in a worker; return (result, raised exception), pickled.

    Args:
        hear: called before it, to hear of Ctrl-C.
        dumps: what pickles.
        hush: called as it raised, to hear of no other Ctrl-C: a terminal's comes beside the parent's own.
    """
    try:
        hear()
        limit_worker()
        function, arguments = pickle.loads(call)
        with quiet():
            return dumps((function(*arguments), None))
    except BaseException as error:
        hush()
        where = f"in a worker process:\n{traceback.format_exc()}"
        try:
            error.add_note(where)
            answer = dumps((None, error))
            pickle.loads(answer)  # some go in and do not come out
        except Exception:
            stand_in = RuntimeError(f"{type(error).__name__}: {error}")
            stand_in.add_note(where)
            answer = dumps((None, stand_in))
        return answer
