"""Where parallel work runs: this process, local processes, or a Dask scheduler by its address.

``poses`` and ``trajectories`` take a `map` callable; here it is made. What it maps must pickle. Processes are spawned,
not forked, so that threads of numerical libraries do no harm; a script that uses them needs ``if __name__ ==
"__main__"``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any

from calib.errors import UsageError

Map = Callable[..., Iterable[Any]]


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

    with ProcessPoolExecutor(count, mp_context=get_context("spawn")) as pool:
        try:
            yield pool.map
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


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
