"""A fleet of 1,000 arms on a Dask scheduler: where do more workers stop to help? Arms are simulated by waiting.

python tests/benchmarks/fleet_cluster.py [--arms 1000] [--seconds 1]

Each arm's task waits as long as a session would compute and returns its row; client, scheduler and the protocol between
them are the real ones. The workers' threads share this machine with both.
"""

import argparse
import sys
import tempfile
import time
from functools import partial
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))

import dask_cluster

from calib.apps.fleet.fleet import DONE, FleetRow
from calib.apps.fleet.throughput import Throughput
from calib.workers import workers

THREADS = 8, 32, 128, 512
PROCESSES = 4


def wait(arm: int, seconds: float) -> FleetRow:
    time.sleep(seconds)
    return FleetRow(f"cells/{arm:04d}", DONE, "pass", "", 1.2, 0.1, None, seconds)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--arms", type=int, default=1000)
    parser.add_argument("--seconds", type=float, default=1.0)
    given = parser.parse_args()
    for threads in THREADS:
        with tempfile.TemporaryDirectory() as folder, dask_cluster.running(Path(folder), 0) as cluster:
            each = str(max(1, threads // PROCESSES))
            options = ("--no-nanny", "--nthreads", each, "--lifetime", dask_cluster.LIFE)
            cluster.workers += [cluster._start("worker", cluster.address, *options) for _ in range(PROCESSES)]
            time.sleep(8.0)  # until all have joined
            with workers(cluster.address) as crew:
                pace, started = Throughput(), time.monotonic()
                found = dict(pace.completed(crew, partial(wait, seconds=given.seconds), range(given.arms)))
                spent = time.monotonic() - started
        assert len(found) == given.arms
        rate, most = given.arms / spent, threads / given.seconds
        print(
            f"{threads:4d} threads: {spent:6.1f} s, {rate:6.1f} arms a second, {100 * rate / most:3.0f} % of {most:g}"
        )


if __name__ == "__main__":
    main()
