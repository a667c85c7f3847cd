"""Processor time of the API's verbs, as a caller's process has BLAS and with OPENBLAS_NUM_THREADS=1, in one run.

pytest tests/benchmarks/test_blas_threads.py -o addopts= --benchmark-group-by=group --benchmark-columns=min,median

Both are to be within a tenth of each other, alone and beside a busy process; the clock counts all threads of the
process that runs the verb, so that what else the machine does matters little.
"""

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import pytest
from verbs import VERBS, processor_time

spent = 0.0  # [s] by the processes that run the verbs


@pytest.fixture(scope="module", params=["default", "one thread"])
def timed(request: pytest.FixtureRequest, data: Path) -> Iterator[Callable[[str], None]]:
    """Yield what runs a verb in a process of its own, whose environment says one thread, or nothing."""
    with pytest.MonkeyPatch.context() as patch, ProcessPoolExecutor(1, mp_context=get_context("spawn")) as process:
        for name in [name for name in os.environ if name.endswith("_NUM_THREADS")]:
            patch.delenv(name)
        if request.param != "default":
            patch.setenv("OPENBLAS_NUM_THREADS", "1")

        def run(verb: str) -> None:
            global spent
            spent += process.submit(processor_time, verb).result()

        yield run


@pytest.fixture(scope="module", params=["alone", "beside a busy process"])
def beside(request: pytest.FixtureRequest) -> Iterator[str]:
    busy = subprocess.Popen([sys.executable, "-c", "while True: pass"]) if request.param != "alone" else None
    yield request.param
    if busy is not None:
        busy.kill()
        busy.wait()


@pytest.mark.parametrize("verb", [verb.__name__ for verb in VERBS])
@pytest.mark.benchmark(timer=lambda: spent)
def test_a_verb(benchmark, timed: Callable[[str], None], beside: str, verb: str) -> None:
    benchmark.group = f"{verb}, {beside}"
    benchmark.pedantic(timed, args=(verb,), rounds=3, warmup_rounds=1)
