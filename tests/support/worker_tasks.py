"""Tasks for the tests of `calib.workers`; other processes import them from here."""

import os
import signal
import time
from pathlib import Path

import calib
from calib.errors import MeasurementError

SECONDS = 30.0  # that a busy machine may take


def square(x: int) -> int:
    return x * x


def wait_for(path: Path) -> None:
    until = time.monotonic() + SECONDS
    while not path.exists():
        assert time.monotonic() < until, f"{path} did not come"
        time.sleep(0.01)


def complain(row: int) -> None:
    raise MeasurementError("cannot be", "log.csv", row)


def chosen_and_error(fit: calib.GeometryFit) -> dict[str, object]:
    return {"chosen": fit.selection.chosen, "rms": fit.selection.cross_validated}


class Awkward(Exception):
    """Cannot be pickled and read back."""

    def __init__(self, first: int, second: int) -> None:
        super().__init__(f"{first} and {second}")


def complain_awkwardly(x: int) -> None:
    raise Awkward(x, x)


def wait_or_square(task: tuple[Path, int]) -> int:
    path, x = task
    if x == 0:
        wait_for(path)
    return x * x


def late_first(x: int) -> int:
    time.sleep(1.0 if x == 0 else 0.0)
    return x


def threads(_: int) -> list[int]:
    import numba
    import numpy
    from threadpoolctl import threadpool_info

    assert numpy
    return [numba.get_num_threads(), *(pool["num_threads"] for pool in threadpool_info())]


def die_at_first(path: Path) -> str:
    if not path.exists():
        path.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return path.name


def die_of_two(x: int) -> int:
    if x == 2:
        os.kill(os.getpid(), signal.SIGKILL)
    return x


def pid_a_little_later(x: int) -> int:
    time.sleep(0.1)
    return os.getpid()


def pid_once_both_began(task: tuple[Path, int]) -> int:
    """Return this process's number, and for the first two tasks only when two processes have begun a task."""
    folder, number = task
    (folder / f"worker {os.getpid()}").touch()
    if number < 2:
        until = time.monotonic() + SECONDS
        while len(list(folder.glob("worker *"))) < 2:
            assert time.monotonic() < until, "the second worker did not begin"
            time.sleep(0.01)
    return pid_a_little_later(number)


def until_told(folder: Path) -> str:
    """Wait like a search that hands back the best so far after Ctrl-C."""
    try:
        (folder / f"{os.getpid()}.pid").touch()
        time.sleep(2 * SECONDS)
    except KeyboardInterrupt:
        return "so far"
    return "to the end"


class SlowlySaid(KeyboardInterrupt):
    """Takes a second to be pickled."""

    def __reduce__(self) -> tuple:
        time.sleep(1.0)
        return KeyboardInterrupt, ()


def slow_to_say(folder: Path) -> None:
    try:
        (folder / f"{os.getpid()}.pid").touch()
        time.sleep(2 * SECONDS)
    except KeyboardInterrupt:
        raise SlowlySaid from None


STEPS = ("select", "fit", "validate", "export")


def step_by_step(address: str) -> int:
    """Work on a folder at an address like a session: a line per step, each made where it is missing; return how many.

    Lines say who made them, so that a step made twice shows.
    """
    from calib.apps.fleet import stores

    with stores.held(address, lease=1.0) as folder:
        log = folder / "state.json"
        count = 0
        for step in STEPS:
            lines = log.read_text().splitlines() if log.exists() else []
            if not any(line.startswith(step) for line in lines):
                time.sleep(0.15)
                (folder / f"{step}.txt").write_text(step * 1000)
                log.write_text("\n".join([*lines, f"{step} {os.getpid()}"]))
                count += 1
    return count
