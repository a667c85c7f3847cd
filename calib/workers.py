"""Where parallel work runs: this process, local processes, or a Dask scheduler by its address.

``poses`` and ``trajectories`` take a `map` callable; here it is made. What it maps must pickle. Processes are spawned,
not forked, so that threads of numerical libraries do no harm; a script that uses them needs ``if __name__ ==
"__main__"``.
"""

from __future__ import annotations

import os
import signal
from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import contextmanager
from itertools import islice
from multiprocessing import active_children
from typing import Any

from calib.errors import UsageError

Map = Callable[..., Iterable[Any]]
GRACE = 3.0  # [s] that tasks have to hand back what they found (our choice)


@contextmanager
def workers(where: str | int | None = None) -> Iterator[Map]:
    """Yield a `map` callable and close what stands behind it at the end.

    Args:
        where: None, 1 or "1" for this process; a number of local processes; or the address of a Dask scheduler, e.g.
            ``tcp://host:8786`` (needs the extra ``cluster``).

    Raises:
        UsageError: for anything else, a scheduler that does not answer, or Dask missing.
    """
    text = str(where if where is not None else 1)
    if "://" in text:
        with _dask(text) as mapped:
            yield mapped
    elif not text.isdigit() or int(text) < 1:
        raise UsageError(f"workers '{where}': expected a number of processes or an address such as tcp://host:8786")
    elif int(text) == 1:
        yield map
    else:
        with _processes(int(text)) as mapped:
            yield mapped


@contextmanager
def _processes(count: int) -> Iterator[Map]:
    from concurrent.futures import ProcessPoolExecutor
    from multiprocessing import get_context

    with ProcessPoolExecutor(count, mp_context=get_context("spawn"), initializer=_deaf) as pool:
        try:
            yield lambda function, *items: _results(pool, count, function, zip(*items))
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _results(pool: Any, count: int, function: Callable, tasks: Iterator[tuple]) -> Iterator[Any]:
    """Yield results in order, with `count` tasks under way.

    On Ctrl-C no further task begins; those under way, which see it too, may hand back what they have.
    """
    from concurrent.futures import FIRST_COMPLETED, wait

    begun: deque[Any] = deque(pool.submit(_hearing, function, task) for task in islice(tasks, count))
    try:
        while begun:
            first = begun[0]
            while not first.done():
                busy = [future for future in begun if not future.done()]
                wait(busy, return_when=FIRST_COMPLETED)
                free = count - sum(not future.done() for future in begun)
                begun.extend(pool.submit(_hearing, function, task) for task in islice(tasks, free))
            begun.popleft()
            free = count - sum(not future.done() for future in begun)
            begun.extend(pool.submit(_hearing, function, task) for task in islice(tasks, free))
            yield first.result()
    except KeyboardInterrupt:
        for future in _settled(begun):
            if future.done() and future.exception() is None:
                yield future.result()
        raise


def _settled(begun: Collection[Any]) -> Collection[Any]:
    """Wait for tasks that a Ctrl-C ended; where only this process got it, pass it on."""
    from concurrent.futures import wait

    if wait(begun, timeout=GRACE).not_done:
        for child in active_children():
            if child.pid is not None:
                os.kill(child.pid, signal.SIGINT)
        wait(begun, timeout=2 * GRACE)
    return begun


def _deaf() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # an idle worker that dies of Ctrl-C breaks the pool


def _hearing(function: Callable, task: tuple) -> Any:
    """Run a task that sees Ctrl-C."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        return function(*task)
    finally:
        _deaf()


@contextmanager
def _dask(address: str) -> Iterator[Map]:
    try:
        from distributed import Client  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise UsageError("a Dask scheduler needs Dask: pip install 'armature-calib[cluster]'") from error
    try:
        client = Client(address, timeout="10s")
    except (OSError, ValueError) as error:
        raise UsageError(f"no Dask scheduler answers at {address}: {error}") from error
    scheduler: Any = client
    with client:
        yield lambda function, *items: scheduler.gather(scheduler.map(function, *map(list, items), pure=False))
