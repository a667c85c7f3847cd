"""Studies run with one BLAS thread, as the commands do."""

from collections.abc import Iterator

import pytest


@pytest.fixture(scope="module", autouse=True)
def _one_blas_thread_of_scripts() -> Iterator[None]:
    """Limit BLAS in processes of scripts: the matrices are small, and threads that wait take the other tests' time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("OPENBLAS_NUM_THREADS", "1")
        yield
