"""Threads of BLAS: one while calib computes, the caller's own number before and after, and wherever one was chosen."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import blas_threads
import pytest

ROOT = Path(__file__).parents[1]
COMMAND = """
import sys
from calib.cli import main
try:
    main()
except SystemExit:
    import scipy.linalg
    from blas_threads import threads
    print(threads())
"""


def python(*words: str, **chosen: str) -> str:
    """Return what a Python process prints last that has of the variables of threads only those chosen here."""
    own = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")}
    environment = own | {"PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "tests/support")])} | chosen
    done = subprocess.run([sys.executable, *words], capture_output=True, text=True, env=environment, check=True)
    return done.stdout.splitlines()[-1]


@pytest.fixture(scope="module")
def found() -> dict[str, Any]:
    return json.loads(python(blas_threads.__file__))


@pytest.mark.parametrize(
    ("when", "threads"),
    [
        ("before", [3]), ("call", [1]), ("after", [3]), ("nested", [[1], [1]]), ("after an exception", [3]),
        ("at the end", [3]), ("steps", [[1], [3], [1]]), ("after steps", [3]), ("overlapping", [[1], [1], [1], [3]]),
        ("caller's limit", [[2], [2]]),
    ],
)  # fmt: skip
def test_call_has_one_thread_and_restores(found, when, threads):
    """Calls that overlap have one until the last ends; a caller's own limit counts."""
    assert found[when] == threads


@pytest.mark.slow
@pytest.mark.parametrize("name", ["OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"])
def test_environment_variable_counts(name):
    """A variable of the environment that asks for threads counts."""
    chosen = json.loads(python(blas_threads.__file__, **{name: "3"}))
    assert chosen["call"] == [3] and chosen["steps"] == [[3]] * 3


@pytest.mark.slow
def test_command_has_one_unless_told_more():
    """A command has one thread unless the environment says more."""
    assert python("-c", COMMAND, "formats") == "[1]"
    assert python("-c", COMMAND, "formats", OPENBLAS_NUM_THREADS="2") == "[2]"
