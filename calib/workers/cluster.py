"""Execution of tasks on a Dask cluster; the only module that imports Dask."""

import asyncio
import logging
import pickle
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from queue import Empty, SimpleQueue
from threading import Lock
from typing import TYPE_CHECKING, Any, TypeVar

from calib.errors import CalibError, UsageError, refused_as
from calib.workers.extras import needing
from calib.workers.processes import Answer, Died, run_call

if TYPE_CHECKING:
    from distributed import Future

T = TypeVar("T")
ANSWER = 10.0  # [s] that a Dask scheduler has to answer (our choice)
NO_WORKERS = 60.0  # [s] without any worker at a scheduler (our choice)


class _Cluster:
    """Workers of a Dask scheduler; Dask repeats lost tasks as often as its configuration states."""

    attempts = 1

    def __init__(self, address: str, client: Any) -> None:
        self.address, self.client, self.done, self.busy = address, client, SimpleQueue["Future"](), Lock()
        self.under_way = dict[object, tuple[int, "Future"]]()
        self.threads, self.asked, self.manned = 1, -1.0, time.monotonic()

    def free(self) -> int:
        return self._threads() - len(self.under_way)

    def _threads(self) -> int:
        """Return the number of threads of all workers (1 without workers).

        The scheduler is asked at most once per second.

        Raises:
            CalibError: if there have been no workers for `NO_WORKERS` seconds.
        """
        time_now = time.monotonic()
        if time_now > self.asked + 1.0:
            threads = self._said(lambda: sum(self.client.nthreads(callback_timeout=ANSWER).values()))
            self.threads, self.asked = max(1, threads), time_now
            if threads:
                self.manned = time_now
            elif time_now > self.manned + NO_WORKERS:
                raise CalibError(
                    f"the Dask scheduler at {self.address} has had no workers for {NO_WORKERS:g} s: start workers, "
                    "then repeat the command"
                )
        return self.threads

    def _said(self, ask: Callable[[], T]) -> T:
        """Return the result of `ask`, a function without arguments that asks the scheduler.

        Raises:
            CalibError: if the scheduler does not answer.
        """
        error = None
        try:
            if self.client.status == "running":
                return ask()
        except Exception as cause:  # one of many of Dask, Tornado and asyncio
            error = cause
        raise CalibError(
            f"the Dask scheduler at {self.address} is gone, with {len(self.under_way)} tasks running; the results "
            "returned so far are valid: restart it, and repeat the command"
        ) from error

    def pickled(self, call: tuple[Callable, tuple]) -> bytes:
        return _cloudpickled(call)

    def begin(self, number: int, call: bytes) -> None:
        future = self._said(lambda: self.client.submit(_on_cluster, call, pure=False))
        self.under_way[future.key] = number, future
        future.add_done_callback(self.done.put)

    def ended(self) -> Iterator[Answer]:
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
        """Return the exception to report as the result of a task that Dask could not run.

        Exceptions of the task itself are results and are not passed to this function.

        Args:
            error: exception that Dask raised.
        """
        from distributed import KilledWorker

        if isinstance(error, KilledWorker):
            return Died(f"it ended {error.allowed_failures + 1} of the cluster's workers, the largest number allowed")
        self._said(lambda: None)
        failed = CalibError(f"a Dask worker could not run its task ({error}); install this toolkit's version there")
        failed.__cause__ = error
        return failed

    def settled(self) -> Iterator[Answer]:
        with suppress(CalibError):
            while not self.done.empty():
                yield from self.ended()

    def drop(self) -> None:
        if self.under_way and self.client.status == "running":
            with suppress(Exception):  # closing the client does the same
                self.client.cancel([future for _, future in self.under_way.values()])
        self.under_way.clear()


def _cloudpickled(value: object) -> bytes:
    import cloudpickle  # comes with Dask; a script's own functions are not on the workers

    return cloudpickle.dumps(value)


def _on_cluster(call: bytes) -> bytes:
    """Run a pickled function call on a Dask worker, and return the pickled result or exception."""
    return run_call(call, lambda: None, _cloudpickled)


async def _answers(address: str) -> None:
    """Check that a Dask scheduler answers at `address` within `ANSWER` seconds.

    Dask's client would wait forever for a port that accepts connections but does not answer.

    Raises:
        OSError: without an answer.
    """
    from distributed.comm.core import connect

    try:
        comm = await asyncio.wait_for(connect(address, timeout=ANSWER), ANSWER + 1.0)
    except TimeoutError:
        raise OSError(f"no answer from Dask within {ANSWER:g} s") from None
    await comm.close()


@contextmanager
def dask(address: str) -> Iterator[_Cluster]:
    with needing("distributed"):
        from distributed import Client
    with refused_as(UsageError, (OSError, ValueError), f"no Dask scheduler answers at {address}: {{}}; is it running?"):
        with ThreadPoolExecutor(1) as executor:  # a notebook has a loop of its own
            executor.submit(asyncio.run, _answers(address)).result()
        client = Client(address, timeout=ANSWER, set_as_default=False)
    log = logging.getLogger("distributed.client")
    before = log.level
    log.setLevel(logging.CRITICAL)  # what goes wrong is said here, once
    closing_time = 3.0  # [s] for leaving it (our choice)
    try:
        yield _Cluster(address, client)
    finally:
        client.close(timeout=closing_time)
        log.setLevel(before)
