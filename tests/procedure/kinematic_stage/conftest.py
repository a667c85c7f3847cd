"""Fits of real measurements, made once for all tests that look at them."""

from collections.abc import Callable
from functools import cache
from pathlib import Path

import pytest
from without_figures import run


@pytest.fixture(scope="session")
def real_fit(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Callable[[str, str, str, float], Path]:
    """Return a function that fits a robot to a file but a share held out, by `calib fit`: the folder of the result."""

    @cache
    def fitted(folder: str, robot: str, file: str, share: float) -> Path:
        out = tmp_path_factory.mktemp(folder) / "done"
        assert run("fit", data / folder / robot, data / folder / file, "--holdout", share, "--out", out) == 0
        return out

    return fitted
