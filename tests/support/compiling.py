"""Each kernel compiled by one process of a test run: the others wait, and load what it has written to numba's cache."""

from pathlib import Path
from threading import RLock

from numba.core.event import Event, Listener, register


class OneProcess(Listener):
    """Holds a lock file while numba compiles or looks for a compiled kernel.

    Attributes:
        file: the lock file, open.
        depth: number of compilations that this process is in, one within the other.
        threads: held by the thread that compiles.
    """

    def __init__(self, path: Path) -> None:
        self.file = path.open("w")
        self.depth = 0
        self.threads = RLock()

    def on_start(self, event: Event) -> None:
        import fcntl  # not on Windows, where workers compile each for itself

        self.threads.acquire()
        if self.depth == 0:
            fcntl.flock(self.file, fcntl.LOCK_EX)
        self.depth += 1

    def on_end(self, event: Event) -> None:
        import fcntl

        self.depth -= 1
        if self.depth == 0:
            fcntl.flock(self.file, fcntl.LOCK_UN)
        self.threads.release()


def take_turns(path: Path) -> None:
    """Let this process and all others that call this with the same lock file compile one after the other."""
    register("numba:compiler_lock", OneProcess(path))
