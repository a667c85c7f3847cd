"""Execution of tasks in local processes: each process is spawned and runs one task at a time, so that a crash loses
one.

`streamed` and `run_call` are used for local processes and for a cluster: they start tasks, collect results, and repeat
lost tasks.
"""

import os
import pickle
import signal
import sys
import time
import traceback
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from multiprocessing import connection, get_context, parent_process, resource_tracker
from reprlib import repr as shortened
from threading import Lock, Thread
from typing import Protocol

from calib.errors import CalibError, TaskLost, quiet
from calib.workers.threads import limit_worker

Answer = tuple[int, object, BaseException | None]  # task, result, or what the task raised
Stream = Callable[[Callable, Iterable[tuple], Callable[[int], bool]], Generator[Answer]]


class Died(Exception):
    """Result of a task whose process died while running it."""


class NotBegun(Exception):
    """Result of a task whose process died before it had received the task."""


class Crew(Protocol):
    """Runner of numbered tasks; each task is a pickled function with its arguments."""

    attempts: int
    busy: Lock

    def free(self) -> int:
        """Return the number of tasks that can be started without waiting."""
        ...

    def pickled(self, call: tuple[Callable, tuple]) -> bytes: ...

    def begin(self, number: int, call: bytes) -> None: ...

    def ended(self) -> Iterable[Answer]:
        """Return the answers of completed tasks; wait until there is at least one."""
        ...

    def settled(self) -> Iterable[Answer]:
        """Return the answers that running tasks still give after Ctrl-C."""
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
    """Run tasks and yield their answers as they arrive.

    Args:
        crew: runner of the tasks.
        function: function that each task calls.
        tasks: for each task, the tuple of the function's arguments.
        near: function of a task's number (from 0) that returns whether the task may be started already.

    Raises:
        RuntimeError: if the runner is in use.
    """
    if not crew.busy.acquire(blocking=False):
        raise RuntimeError("these workers are busy; let one `map` or `completed` end before the next")
    upcoming, begun = enumerate(tasks), 0
    under_way, retry, answers = dict[int, _Task](), deque[int](), deque[Answer]()
    try:
        while True:
            while crew.free() > 0:
                if retry:
                    number = retry.popleft()
                elif near(begun) and (next_task := next(upcoming, None)) is not None:
                    number, arguments = next_task
                    begun, under_way[number] = number + 1, _Task(arguments, crew.pickled((function, arguments)))
                else:
                    break
                crew.begin(number, under_way[number].call)
            if answers:
                yield answers.popleft()
                continue
            if not under_way:
                return
            for number, result, error in crew.ended():
                task = under_way[number]
                task.deaths += isinstance(error, Died)
                if isinstance(error, NotBegun) or (isinstance(error, Died) and task.deaths < crew.attempts):
                    retry.append(number)
                    continue
                del under_way[number]
                if isinstance(error, KeyboardInterrupt):
                    raise error
                answers.append((number, result, _lost(number, task, error) if isinstance(error, Died) else error))
    except (Exception, KeyboardInterrupt) as error:
        yield from answers
        if isinstance(error, KeyboardInterrupt):
            yield from (answer for answer in crew.settled() if answer[2] is None)
        raise
    finally:
        crew.drop()
        crew.busy.release()


def _lost(number: int, task: _Task, error: Died) -> TaskLost:
    arguments = task.arguments[0] if len(task.arguments) == 1 else task.arguments
    return TaskLost(
        f"task {number + 1} ({shortened(arguments)}) is lost: {error}. The usual cause is too little memory: run "
        "fewer tasks at once",
        number,
        arguments,
    )


def run_call(
    call: bytes, hear: Callable[[], object], dumps: Callable[[object], bytes], hush: Callable[[], object] = lambda: None
) -> bytes:
    """Run a pickled function call in a worker, and return the pickled pair of result and raised exception (or None).

    Args:
        call: the pickled call.
        hear: function called before the call, which enables Ctrl-C.
        dumps: function that pickles the answer.
        hush: function called after an exception, which disables further Ctrl-C, since terminal and parent process both
            send one.
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


GRACE = 3.0  # [s] that tasks have to hand back what they found after Ctrl-C (our choice)
ATTEMPTS = 3  # processes that a task may take along before it is given up (our choice)


@contextmanager
def _without_interrupt() -> Iterator[None]:
    """Hold Ctrl-C back within the block, also from processes that are started in it; Windows has no such mask."""
    if sys.platform == "win32":
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


class _Process:
    """A spawned process that runs one task at a time; if the process dies, it is known which task was lost."""

    def __init__(self) -> None:
        context = get_context("spawn")
        self.pipe, self.theirs = context.Pipe()
        self.process = context.Process(target=_serve, args=(self.theirs,))
        self.ready, self.number, self.call = False, -1, b""

    def start(self) -> None:
        if sys.platform != "win32":
            resource_tracker.ensure_running()  # else the process's start does, and lets Ctrl-C through
        try:
            with _without_interrupt():  # inherited until `_serve` can deal with it
                self.process.start()
        finally:
            self.theirs.close()

    def run(self, number: int, call: bytes) -> None:
        self.number, self.call = number, call
        if self.ready:
            self.send()

    def send(self) -> None:
        with suppress(OSError):  # it died: the pipe's end says so
            self.pipe.send_bytes(self.call)
        self.call = b""

    def interrupt(self) -> None:
        if self.process.is_alive() and self.process.pid is not None and sys.platform != "win32":
            os.kill(self.process.pid, signal.SIGINT)  # on Windows, Ctrl-C reaches all processes of a console by itself


class Processes:
    """Runner of tasks in local processes; a process is started when a task needs it."""

    attempts = ATTEMPTS

    def __init__(self, count: int) -> None:
        self.count, self.stillborn, self.stopping, self.busy = count, 0, False, Lock()
        self.all, self.idle, self.working = list[_Process](), list[_Process](), dict[object, _Process]()

    def free(self) -> int:
        return self.count - len(self.working)

    def pickled(self, call: tuple[Callable, tuple]) -> bytes:
        return pickle.dumps(call)

    def begin(self, number: int, call: bytes) -> None:
        self.idle = [process for process in self.idle if process.process.is_alive()]
        if self.idle:
            process = self.idle.pop()
        else:
            self.all.append(process := _Process())
            process.start()
        self.working[process.pipe] = process
        process.run(number, call)

    def ended(self, timeout: float | None = None) -> Iterator[Answer]:
        for pipe in connection.wait([process.pipe for process in self.working.values()], timeout):
            process = self.working[pipe]
            try:
                answer, interrupted = process.pipe.recv()
            except (EOFError, OSError):
                yield process.number, None, self._died(process)
                continue
            starting, process.ready = not process.ready, True
            if starting and not self.stopping:
                self.stillborn = 0
                process.send()
                continue
            self.idle.append(self.working.pop(pipe))
            if not starting:
                yield process.number, *pickle.loads(answer)
                if interrupted and not self.stopping:
                    raise KeyboardInterrupt  # a terminal's, which has not reached this process yet

    def _died(self, process: _Process) -> Exception:
        del self.working[process.pipe]
        process.pipe.close()
        process.process.join(GRACE)
        code = process.process.exitcode
        how = f"signal {-code}" if code and code < 0 else f"exit code {code}"
        if process.ready:
            return Died(f"{self.attempts} processes died running it, the last by {how}")
        self.stillborn += 1
        if self.stillborn < ATTEMPTS * self.count or self.stopping:
            return NotBegun()
        raise CalibError(
            f"worker processes die at start ({how}): is memory short, or does the calling script lack "
            'if __name__ == "__main__"?'
        )

    def settled(self) -> Iterator[Answer]:
        """Yield the answers of tasks that end after Ctrl-C.

        Worker processes that did not receive the Ctrl-C are interrupted.
        """
        self.stopping = True
        for patience in (GRACE, 2 * GRACE):
            deadline = time.monotonic() + patience
            while self.working and (remaining := deadline - time.monotonic()) > 0:
                yield from self.ended(remaining)
            for process in self.working.values():
                process.interrupt()

    def drop(self) -> None:
        for process in self.working.values():
            process.interrupt()
            process.pipe.close()
        self.working.clear()
        self.stopping = False

    def close(self) -> None:
        started = [process.process for process in self.all if process.process.pid is not None]
        try:
            self.drop()
            for process in self.all:
                process.pipe.close()  # this ends one that waits
            deadline = time.monotonic() + GRACE
            for process in started:
                process.join(max(0.0, deadline - time.monotonic()))
        finally:
            for process in started:
                process.kill()
                process.join()


def _serve(pipe: connection.Connection) -> None:
    """Run the calls that a worker process receives through `pipe`, until the pipe is closed.

    Ctrl-C has an effect only during a call.
    """
    heard = list[int]()

    def interrupt(number: int, frame: object) -> None:
        heard.append(number)
        raise KeyboardInterrupt

    hear = partial(signal.signal, signal.SIGINT, interrupt)
    hush = partial(signal.signal, signal.SIGINT, signal.SIG_IGN)
    Thread(target=end_with_parent, daemon=True).start()
    sys.unraisablehook = _unheard
    hush()
    if sys.platform != "win32":
        signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGINT])
    with suppress(EOFError, OSError, KeyboardInterrupt):  # the last where one more came before `hush`
        pipe.send((b"ready", False))
        while True:
            try:
                answer = run_call(pipe.recv_bytes(), hear, pickle.dumps, hush)
            finally:
                hush()
            pipe.send((answer, bool(heard)))
            heard.clear()


def _unheard(unraisable: "sys.UnraisableHookArgs") -> None:
    """Suppress the message of a Ctrl-C inside a library's callback, where Python cannot raise KeyboardInterrupt.

    Args:
        unraisable: Python's description of the exception; other exceptions are reported as usual.
    """
    if not isinstance(unraisable.exc_value, KeyboardInterrupt):
        sys.__unraisablehook__(unraisable)


def end_with_parent() -> None:
    """Wait until the parent process ends, then end this process."""
    if parent := parent_process():
        parent.join()
        os._exit(1)
