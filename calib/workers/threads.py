"""Threads of BLAS: one for all computations of calib, since more threads slow down small matrices.

Idle threads wait in loops that take processors from others: a fit on two idle cores took twice as long, beside one busy
process eighteen times. The API, the command, the workers and the tests all limit them here. A caller's own choice wins:
one of `VARIABLES` in the environment, or fewer threads than the library had before, as threadpoolctl sets them.
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
    """Limit BLAS to one thread in the block; restore the previous number after the last such block."""
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
    """Yield a generator's values, with one BLAS thread inside the generator and the caller's number outside."""
    ended = object()
    with closing(steps):
        while True:
            with one_blas_thread():
                step = next(steps, ended)
            if step is ended:
                return
            yield step


def limit_process() -> None:
    """Limit BLAS to one thread in this process permanently, unless the user set a number."""
    if not _chosen():
        _limit_for_good()


def limit_worker() -> None:
    """Give BLAS and numba one thread in this process permanently: the tasks themselves run in parallel."""
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
    """Set the thread numbers of libraries, from any thread.

    threadpoolctl 3.8 accepts settings from the controlling thread only, until this thread is cleared.
    """
    for library, number in threads.items():
        clear = getattr(library, "clear_controlling_thread", lambda force: None)
        clear(force=True)
        library.set_num_threads(number)
        clear(force=True)


@cache
def _libraries() -> list["LibController"]:
    """Return all loaded BLAS libraries; cached, since their search takes milliseconds, setting threads microseconds."""
    from threadpoolctl import ThreadpoolController

    controllers = ThreadpoolController().select(user_api="blas").lib_controllers
    return [library for library in controllers if library.num_threads]
