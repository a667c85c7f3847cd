"""Number of BLAS threads: one for all computations of this package, since more threads slow down small matrices.

Idle threads wait in loops that take processor time from others: a fit on two idle cores took twice as long, and
eighteen times as long beside one busy process. API, commands, workers and tests limit the number of threads by this
module. A choice of the caller has priority: one of `VARIABLES` in the environment, or a number of threads below the
library's earlier number, as set by threadpoolctl.
"""

import os
import sys
from collections.abc import Generator, Iterator
from contextlib import closing, contextmanager
from functools import cache
from threading import Lock
from typing import TYPE_CHECKING, Never

if TYPE_CHECKING:
    from threadpoolctl import LibController

VARIABLES = tuple(f"{name}_NUM_THREADS" for name in ("OPENBLAS", "OMP", "MKL", "BLIS"))

_changing, _before, _largest = Lock(), dict["LibController", int](), dict["LibController", int]()
_calls = 0


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Limit BLAS to one thread within the block, and restore the earlier number of threads afterwards.

    Of nested or parallel blocks, the last one to end restores the number.
    """
    global _calls
    with _changing:
        if not _calls:
            _limit()
        _calls += 1
    try:
        yield
    finally:
        with _changing:
            _calls -= 1
            if not _calls:
                _set(_before)
                _before.clear()


def limited_steps(steps: Generator[object, Never, object]) -> Iterator[object]:
    """Yield the values of a generator, with one BLAS thread inside the generator and the caller's number outside.

    Args:
        steps: the generator.
    """
    ended = object()
    with closing(steps):
        while True:
            with one_blas_thread():
                step = next(steps, ended)
            if step is ended:
                return
            yield step


def limit_process() -> None:
    """Limit BLAS to one thread for the rest of this process, unless the user has chosen a number."""
    if not _chosen():
        _limit_for_good()


def limit_worker() -> None:
    """Limit BLAS and numba to one thread for the rest of this worker process, since the tasks run in parallel."""
    _limit_for_good()
    if numba := sys.modules.get("numba"):
        numba.set_num_threads(1)
    else:
        os.environ["NUMBA_NUM_THREADS"] = "1"


def _chosen() -> bool:
    return any(os.environ.get(name) for name in VARIABLES)


def _limit() -> None:
    if _chosen():
        return
    import scipy.linalg  # noqa: F401  (with numpy's, the BLAS of all that calib computes)

    for library in _libraries():
        threads = library.num_threads or 1
        _largest[library] = max(threads, _largest.get(library, 1))
        if threads == _largest[library]:
            _before[library] = threads
    _set(dict.fromkeys(_before, 1))


def _limit_for_good() -> None:
    os.environ.update(dict.fromkeys(VARIABLES, "1"))
    if "numpy" in sys.modules:
        _set(dict.fromkeys(_libraries(), 1))


def _set(threads: dict["LibController", int]) -> None:
    """Set the number of threads of each BLAS library to the given value; this works from any thread.

    threadpoolctl 3.8 accepts settings only from its controlling thread, unless this thread is cleared before.
    """
    for library, number in threads.items():
        clear = getattr(library, "clear_controlling_thread", lambda force: None)
        clear(force=True)
        library.set_num_threads(number)
        clear(force=True)


@cache
def _libraries() -> list["LibController"]:
    """Return all loaded BLAS libraries.

    The result is cached, since the search takes milliseconds, and setting the number of threads only microseconds.
    """
    from threadpoolctl import ThreadpoolController

    controllers = ThreadpoolController().select(user_api="blas").lib_controllers
    return [library for library in controllers if library.num_threads]
