"""A real Dask cluster on this machine: a scheduler and workers, each a process that can be killed."""

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

# a cluster's machines know nothing of this one's settings
ENVIRONMENT = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")}


LIFE = "300 s"  # of processes whose tests were killed before they could end them


class Cluster:
    """A scheduler; processes are killed when the block of `running` ends."""

    def __init__(self, folder: Path, failures: int) -> None:
        self.folder = folder
        self.workers: list[subprocess.Popen] = []
        self.environment = {
            **ENVIRONMENT,
            "PYTHONPATH": os.pathsep.join(sys.path),  # tests' own functions are found by the workers
            "DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": str(failures),
        }
        file = folder / "scheduler.json"
        self.scheduler = self._start("scheduler", "--scheduler-file", str(file), "--port", "0", "--idle-timeout", LIFE)
        for _ in range(600):
            if file.exists() and file.read_text().endswith("}"):
                break
            time.sleep(0.05)
        self.address = json.loads(file.read_text())["address"]

    def _start(self, role: str, *options: str) -> subprocess.Popen:
        module = f"distributed.cli.dask_{role}"
        command = [sys.executable, "-m", module, "--host", "127.0.0.1", "--no-dashboard", *options]
        with (self.folder / f"{role}.log").open("a") as log:
            return subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=log, stderr=log, env=self.environment, cwd=self.folder
            )

    def add(self, count: int) -> None:
        """Start workers of one thread; where one dies, no nanny starts it again."""
        options = ("--no-nanny", "--nthreads", "1", "--death-timeout", "30", "--lifetime", LIFE)
        self.workers += [self._start("worker", self.address, *options) for _ in range(count)]

    def close(self) -> None:
        for process in (*self.workers, self.scheduler):
            process.kill()
        for process in (*self.workers, self.scheduler):
            process.wait()


@contextmanager
def running(folder: Path, workers: int, failures: int = 3) -> Iterator[Cluster]:
    """Yield a cluster; `failures` workers may die of a task before it is lost."""
    cluster = Cluster(folder, failures)
    try:
        cluster.add(workers)
        yield cluster
    finally:
        cluster.close()
