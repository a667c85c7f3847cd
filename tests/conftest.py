"""Where the real recordings are.

They live outside the repository: ``CALIB_DATA``, default ``../shared/data``. Tests that need them are skipped, with the
reason, where the folder is absent.
"""

import gc
import signal
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import produced
import pytest
from hypothesis import HealthCheck, settings
from recordings import DATA

from calib.cli import GARBAGE
from calib.workers.threads import one_blas_thread

# a shell's job in the background inherits that Ctrl-C is ignored; tests send it to themselves and to their processes
signal.signal(signal.SIGINT, signal.default_int_handler)

# as the command line does: thousands of tests and what they import are no garbage, and walked over at every collection
gc.set_threshold(*GARBAGE)

# the same inputs in every run; `pytest --hypothesis-profile=search` looks for new ones
settings.register_profile(
    "fixed", deadline=None, max_examples=25, derandomize=True, suppress_health_check=[HealthCheck.too_slow]
)
settings.register_profile("search", deadline=None, max_examples=2000)
settings.load_profile("fixed")


@pytest.fixture
def write(tmp_path: Path) -> Callable[..., Path]:
    """Write text, or a header and rows, to a file."""

    def _write(header: str, rows: Sequence[Sequence[object]] | str = "", name: str = "poses.csv") -> Path:
        path = tmp_path / name
        body = rows if isinstance(rows, str) else "\n".join(",".join(str(cell) for cell in row) for row in rows)
        path.write_text(header + "\n" + body + "\n", encoding="utf-8")
        return path

    return _write


def pytest_addoption(parser: pytest.Parser) -> None:
    words = "note the findings that tests make the sources say, or compare what was noted with the catalogue"
    parser.addoption("--findings", choices=("note", "compare"), help=words)


def compiling_lock(config: pytest.Config) -> Path | None:
    """Return the lock file of a test run's workers; None in a process that is no worker, and on Windows."""
    worker = getattr(config, "workerinput", None)
    if worker is None or sys.platform == "win32":
        return None
    return Path(tempfile.gettempdir()) / f"calib-compiling-{worker['testrunuid']}.lock"


def pytest_configure(config: pytest.Config) -> None:
    # two workers that want a kernel at the same time would both compile it, for up to ten seconds
    if lock := compiling_lock(config):
        # it imports Numba, which the process that only starts the workers does not need
        import compiling

        compiling.take_turns(lock)
    if config.getoption("findings") == "note":
        produced.note()


def pytest_sessionfinish(session: pytest.Session) -> None:
    if lock := compiling_lock(session.config):
        lock.unlink(missing_ok=True)
    if session.config.getoption("findings") == "note":
        produced.keep(session.config)


@pytest.fixture(scope="session", autouse=True)
def _one_blas_thread() -> Iterator[None]:
    """Limit BLAS for tests that call what stands behind the API, as the API does."""
    with one_blas_thread():
        yield


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put long tests first: one that begins last keeps the other workers waiting."""
    items.sort(key=lambda item: item.get_closest_marker("long") is None)


def pytest_collection_finish() -> None:
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="session")
def loaded(tmp_path_factory: pytest.TempPathFactory) -> dict[str, set[str]]:
    """Return the modules that one process has loaded at each of its stages."""
    # with what it simulates, for which the process that only starts the workers would wait
    import loaded as processes

    return processes.stages(tmp_path_factory.mktemp("loaded"))


@pytest.fixture(scope="session")
def data() -> Path:
    """Return the folder of real recordings, or skip."""
    if not DATA.is_dir():
        pytest.skip(f"no folder of real recordings at {DATA} (set CALIB_DATA)")
    return DATA
