"""Where parallel work runs: this process, local processes, or a Dask scheduler by its address.

`Workers.completed` hands results back as they come, `Workers.map` in order; ``poses`` and ``trajectories`` take the
latter as a plain callable. Functions, tasks and results must pickle. A task whose process dies is tried again, here or
by the scheduler: it may therefore run twice, yet its result counts once. One lost for good is a `TaskLost`, and costs
no other result. Few tasks are under way at once (one a process, or a thread of the cluster), so that millions may be
asked for; each should take a tenth of a second or more.

Processes are spawned, not forked, so that threads of numerical libraries do no harm; a script that uses them needs
``if __name__ == "__main__"``. BLAS, OpenMP and numba get one thread in every worker: the tasks are what runs in
parallel.
"""

from __future__ import annotations

import asyncio
import logging
import os
import pickle
import signal
import sys
import time
import traceback
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, closing, contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from multiprocessing import connection, get_context, parent_process, resource_tracker
from queue import Empty, SimpleQueue
from reprlib import repr as shortened
from threading import Thread
from typing import Any, Protocol

from calib.errors import CalibError, TaskLost, UsageError

GRACE = 3.0  # [s] that tasks have to hand back what they found after Ctrl-C (our choice)
ATTEMPTS = 3  # processes that a task may take along before it is given up (our choice)
AHEAD = 256  # tasks that may be ahead of the one whose turn it is, where results are wanted in order (our choice)
ANSWER = 10.0  # [s] that a Dask scheduler has to answer (our choice)
NO_WORKERS = 60.0  # [s] without any worker at a scheduler (our choice)
THREADS = ("OPENBLAS", "OMP", "MKL", "BLIS", "NUMBA")  # ..._NUM_THREADS

_Answer = tuple[int, Any, BaseException | None]  # task, result, or what the task raised
_Stream = Callable[[Callable, Iterable[tuple], Callable[[int], bool]], Generator[_Answer]]


@dataclass(frozen=True)
class Workers:
    """Run many tasks; made by `workers`.

    Attributes:
        here: they work in this process's current folder.
    """

    _stream: _Stream
    here: bool = True

    def completed(self, function: Callable[[Any], Any], tasks: Iterable[Any]) -> Iterator[tuple[int, Any]]:
        """Yield (number of the task, its result) as tasks complete; tasks are taken as they are needed.

        The result of a task lost for good is a `TaskLost`, yielded as the others are. What a task raises is raised.
        """
        with closing(self._stream(function, ((task,) for task in tasks), lambda number: True)) as answers:
            for number, result, error in answers:
                if error is not None and not isinstance(error, TaskLost):
                    raise error
                yield number, result if error is None else error

    def map(self, function: Callable, *items: Iterable[Any]) -> Iterator[Any]:
        """Yield results in order, as the builtin does; after Ctrl-C what could still be had, then KeyboardInterrupt.

        Raises:
            TaskLost: in the place of a result that is lost for good.
        """
        early, turn = dict[int, tuple[Any, BaseException | None]](), 0
        with closing(self._stream(function, zip(*items), lambda number: number < turn + AHEAD)) as answers:
            try:
                for number, *answer in answers:
                    early[number] = answer[0], answer[1]
                    while turn in early:
                        result, error = early.pop(turn)
                        turn += 1
                        if error is not None:
                            raise error
                        yield result
            except KeyboardInterrupt:
                yield from (result for _, (result, error) in sorted(early.items()) if error is None)
                raise


@contextmanager
def workers(where: str | int | None = None) -> Iterator[Workers]:
    """Yield workers, and end them and what they still run when the block ends.

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
    made: AbstractContextManager[_Crew] = _dask(text) if "://" in text else closing(_Processes(int(text)))
    with made as crew:
        yield Workers(partial(_streamed, crew), here="://" not in text)


class _Died(Exception):
    """What stands for the result of a task whose process died."""


class _NotBegun(Exception):
    """What stands for the result of a task whose process died before it got it."""


class _Crew(Protocol):
    """What runs tasks, each a pickled function with its arguments, under a number."""

    attempts: int

    def free(self) -> int:
        """Return how many more tasks may begin."""
        ...

    def pickled(self, call: tuple[Callable, tuple]) -> bytes: ...

    def begin(self, number: int, call: bytes) -> None: ...

    def ended(self) -> Iterable[_Answer]:
        """Wait for tasks to end."""
        ...

    def settled(self) -> Iterable[_Answer]:
        """Return what the tasks under way hand back after Ctrl-C."""
        ...

    def drop(self) -> None:
        """Give up the tasks under way."""
        ...


@dataclass
class _Task:
    arguments: tuple
    call: bytes
    deaths: int = 0


def _streamed(
    crew: _Crew, function: Callable, tasks: Iterable[tuple], near: Callable[[int], bool]
) -> Generator[_Answer]:
    """Yield answers as they come; a task begins when there is room for it and its number is near enough."""
    upcoming, begun = enumerate(tasks), 0
    under_way, again, found = dict[int, _Task](), deque[int](), deque[_Answer]()
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
                task.deaths += isinstance(error, _Died)
                if isinstance(error, _NotBegun) or (isinstance(error, _Died) and task.deaths < crew.attempts):
                    again.append(number)
                    continue
                del under_way[number]
                if isinstance(error, KeyboardInterrupt):
                    raise error
                found.append((number, result, _lost(number, task, error) if isinstance(error, _Died) else error))
    except KeyboardInterrupt:
        yield from found
        yield from (answer for answer in crew.settled() if answer[2] is None)
        raise
    finally:
        crew.drop()


def _lost(number: int, task: _Task, error: _Died) -> TaskLost:
    given = task.arguments[0] if len(task.arguments) == 1 else task.arguments
    return TaskLost(
        f"task {number + 1} ({shortened(given)}) is lost: {error}. Usually memory ran out; give each task less, or run "
        "fewer at once",
        number, given,
    )  # fmt: skip


class _Process:
    """A spawned process that runs one task at a time: where it dies, it is known with which."""

    def __init__(self) -> None:
        context = get_context("spawn")
        self.pipe, theirs = context.Pipe()
        self.process = context.Process(target=_serve, args=(theirs,))
        resource_tracker.ensure_running()  # else `start` does, and lets Ctrl-C through
        before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])  # inherited until `_serve` can deal with it
        try:
            with _one_thread_to_inherit():
                self.process.start()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
            theirs.close()
        self.ready, self.number, self.call = False, -1, b""

    def run(self, number: int, call: bytes) -> None:
        self.number, self.call = number, call
        if self.ready:
            self.send()

    def send(self) -> None:
        with suppress(OSError):  # it died: the pipe's end says so
            self.pipe.send_bytes(self.call)
        self.call = b""

    def interrupt(self) -> None:
        if self.process.is_alive() and self.process.pid is not None:
            os.kill(self.process.pid, signal.SIGINT)


class _Processes:
    """Local processes, started when there are tasks for them."""

    attempts = ATTEMPTS

    def __init__(self, count: int) -> None:
        self.count, self.stillborn, self.stopping = count, 0, False
        self.idle, self.leaving = list[_Process](), list[_Process]()
        self.busy = dict[connection.Connection, _Process]()

    def free(self) -> int:
        return self.count - len(self.busy)

    def pickled(self, call: tuple[Callable, tuple]) -> bytes:
        return pickle.dumps(call)

    def begin(self, number: int, call: bytes) -> None:
        process = self.idle.pop() if self.idle else _Process()
        if not process.process.is_alive() and process.ready:
            self._dismiss(process)
            return self.begin(number, call)
        self.busy[process.pipe] = process
        process.run(number, call)

    def ended(self, timeout: float | None = None) -> Iterator[_Answer]:
        for pipe in connection.wait(list(self.busy), timeout):
            process = self.busy[pipe]  # pyright: ignore[reportArgumentType]
            try:
                answer = process.pipe.recv_bytes()
            except (EOFError, OSError):
                yield process.number, None, self._died(process)
                continue
            if not process.ready and not self.stopping:
                process.ready, self.stillborn = True, 0
                process.send()
            else:
                del self.busy[process.pipe]
                self.idle.append(process)
                if process.ready:
                    yield process.number, *pickle.loads(answer)

    def _died(self, process: _Process) -> Exception:
        del self.busy[process.pipe]
        self._dismiss(process)
        process.process.join(GRACE)
        code = process.process.exitcode
        how = f"signal {-code}" if code and code < 0 else f"exit code {code}"
        if process.ready:
            return _Died(f"{self.attempts} processes died of it, the last by {how}")
        self.stillborn += 1
        if self.stillborn < ATTEMPTS or self.stopping:
            return _NotBegun()
        raise CalibError(
            f"worker processes end as they start ({how}): memory ran out, or a script that uses them lacks "
            'if __name__ == "__main__"'
        )

    def _dismiss(self, process: _Process) -> None:
        process.pipe.close()
        self.leaving.append(process)

    def settled(self) -> Iterator[_Answer]:
        """Return what tasks hand back that Ctrl-C ended; where only this process got it, pass it on."""
        self.stopping = True
        for patience in (GRACE, 2 * GRACE):
            until = time.monotonic() + patience
            while self.busy and (left := until - time.monotonic()) > 0:
                yield from self.ended(left)
            for process in self.busy.values():
                process.interrupt()

    def drop(self) -> None:
        for process in self.busy.values():
            process.interrupt()
            self._dismiss(process)
        self.busy.clear()
        self.stopping = False

    def close(self) -> None:
        self.drop()
        for process in self.idle:
            self._dismiss(process)  # a closed pipe ends it
        until = time.monotonic() + GRACE
        for process in self.leaving:
            process.process.join(max(0.0, until - time.monotonic()))
            process.process.kill()
            process.process.join()


@contextmanager
def _one_thread_to_inherit() -> Iterator[None]:
    """Let processes started meanwhile bound their threads: the libraries read these when they are loaded."""
    names = [f"{name}_NUM_THREADS" for name in THREADS]
    before = {name: os.environ.pop(name, None) for name in names}
    os.environ.update(dict.fromkeys(names, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            del os.environ[name]
            if value is not None:
                os.environ[name] = value


def _serve(pipe: connection.Connection) -> None:
    """Run in a process: answer calls until the other end is closed. Only while a task runs, Ctrl-C is heard."""
    hear = partial(signal.signal, signal.SIGINT, signal.default_int_handler)
    Thread(target=_end_with_parent, daemon=True).start()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGINT])
    with suppress(EOFError, OSError):
        pipe.send_bytes(b"ready")
        while True:
            try:
                answer = _answer(pipe.recv_bytes(), hear, pickle.dumps)
            finally:
                signal.signal(signal.SIGINT, signal.SIG_IGN)
            pipe.send_bytes(answer)


def _end_with_parent() -> None:
    if parent := parent_process():
        parent.join()
        os._exit(1)


def _answer(call: bytes, hear: Callable[[], Any], dumps: Callable[[Any], bytes]) -> bytes:
    """Return (result, what was raised), pickled."""
    try:
        hear()
        function, arguments = pickle.loads(call)
        return dumps((function(*arguments), None))
    except BaseException as error:
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


class _Cluster:
    """A Dask scheduler's workers: it tries lost tasks again itself, as often as it is configured to."""

    attempts = 1

    def __init__(self, address: str, client: Any) -> None:
        self.address, self.client, self.done = address, client, SimpleQueue[Any]()
        self.under_way = dict[str, tuple[int, Any]]()
        self.threads, self.asked, self.manned = 1, -1.0, time.monotonic()

    def free(self) -> int:
        return self._threads() - len(self.under_way)

    def _threads(self) -> int:
        """Return the threads of all workers, asked for once a second at most; 1 while there are none."""
        now = time.monotonic()
        if now > self.asked + 1.0:
            threads = self._said(lambda: sum(self.client.nthreads(callback_timeout=ANSWER).values()))
            self.threads, self.asked = max(1, threads), now
            if threads:
                self.manned = now
            elif now > self.manned + NO_WORKERS:
                raise CalibError(f"the Dask scheduler at {self.address} has had no workers for {NO_WORKERS:g} s")
        return self.threads

    def _said(self, ask: Callable[[], Any]) -> Any:
        """Return what a scheduler that is there answers."""
        error = None
        try:
            if self.client.status == "running":
                return ask()
        except Exception as found:  # one of many of Dask, Tornado and asyncio
            error = found
        raise CalibError(
            f"the Dask scheduler at {self.address} is gone, with {len(self.under_way)} tasks under way; results that "
            "were handed back are good"
        ) from error

    def pickled(self, call: tuple[Callable, tuple]) -> bytes:
        return _cloudpickled(call)

    def begin(self, number: int, call: bytes) -> None:
        future = self._said(lambda: self.client.submit(_on_cluster, call, pure=False))
        self.under_way[future.key] = number, future
        future.add_done_callback(self.done.put)

    def ended(self) -> Iterator[_Answer]:
        try:
            future = self.done.get(timeout=1.0)
        except Empty:
            self._threads()
            return
        if future.key not in self.under_way:  # given up
            return
        if future.status == "cancelled":  # not by us: the connection was lost
            self._said(future.result)
        try:
            result, raised = pickle.loads(future.result(timeout=NO_WORKERS))
        except TimeoutError:  # its worker died with the result, and it is run again
            self.done.put(future)
            self._threads()
            return
        except Exception as error:
            result, raised = None, self._failed(error)
        yield self.under_way.pop(future.key)[0], result, raised

    def _failed(self, error: Exception) -> Exception:
        """Return what stands for the result where Dask, not the task, raised."""
        from distributed import KilledWorker  # pyright: ignore[reportMissingImports]

        if isinstance(error, KilledWorker):
            return _Died(f"{error.allowed_failures + 1} workers died of it")
        self._said(lambda: None)
        failed = CalibError(f"a Dask worker could not run its task: {error}; workers need this toolkit, same version")
        failed.__cause__ = error
        return failed

    def settled(self) -> Iterator[_Answer]:
        return iter(())

    def drop(self) -> None:
        if self.under_way and self.client.status == "running":
            with suppress(Exception):  # closing the client does the same
                self.client.cancel([future for _, future in self.under_way.values()])
        self.under_way.clear()


def _cloudpickled(value: Any) -> bytes:
    import cloudpickle  # comes with Dask; a script's own functions are not on the workers

    return cloudpickle.dumps(value)


def _on_cluster(call: bytes) -> bytes:
    """Run on a Dask worker."""
    return _answer(call, _use_one_thread, _cloudpickled)


def _use_one_thread() -> None:
    """Bound threads of libraries in a process that another one started: of those loaded, and of those to come."""
    from threadpoolctl import threadpool_limits  # pyright: ignore[reportMissingImports]

    numba = sys.modules.get("numba")
    later = [name for name in THREADS if numba is None or name != "NUMBA"]  # it refuses a change once it runs
    os.environ.update({f"{name}_NUM_THREADS": "1" for name in later})
    threadpool_limits(1)
    if numba is not None:
        numba.set_num_threads(1)


async def _answers(address: str) -> None:
    """Shake hands, in bounded time: a client waits for ever on a port that listens and says nothing."""
    from distributed.comm.core import connect  # pyright: ignore[reportMissingImports]

    try:
        comm = await asyncio.wait_for(connect(address, timeout=ANSWER), ANSWER + 1.0)
    except TimeoutError:
        raise OSError(f"nothing that Dask would say came in {ANSWER:g} s") from None
    await comm.close()


@contextmanager
def _dask(address: str) -> Iterator[_Cluster]:
    try:
        from distributed import Client  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise UsageError("a Dask scheduler needs Dask: pip install 'armature-calib[cluster]'") from error
    try:
        with ThreadPoolExecutor(1) as aside:  # a notebook has a loop of its own
            aside.submit(asyncio.run, _answers(address)).result()
        client: Any = Client(address, timeout=ANSWER, set_as_default=False)
    except (OSError, ValueError) as error:
        raise UsageError(f"no Dask scheduler answers at {address}: {error}") from error
    log = logging.getLogger("distributed.client")
    before = log.level
    log.setLevel(logging.CRITICAL)  # what goes wrong is said here, once
    try:
        yield _Cluster(address, client)
    finally:
        client.close(timeout=GRACE)
        log.setLevel(before)
