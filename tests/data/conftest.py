"""A small measurement file and a recording that are right, to be spoilt in one place per test."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from calib.data.recordings.recording import Recording


@pytest.fixture
def good() -> list[list[object]]:
    """Ten rows q1 q2 q3 x y z qx qy qz qw."""
    random = np.random.default_rng(5)
    rows = []
    for _ in range(10):
        quaternion = random.normal(size=4)
        values = (*random.uniform(-2.5, 2.5, 3), *random.uniform(-1, 1, 3), *quaternion / np.linalg.norm(quaternion))
        rows.append([round(float(value), 9) for value in values])
    return rows


@pytest.fixture
def series() -> dict[str, np.ndarray]:
    """Return 12 s at 200 Hz of three joints: sums of sines up to 1.3 Hz, torques that follow the motion."""
    t = np.arange(2400) / 200
    waves = np.array([[0.4, 0.9, 1.3], [0.3, 0.7, 1.1], [0.5, 0.6, 1.2]])
    q = np.stack([sum(0.4 / f * np.sin(2 * np.pi * f * t + 7 * f) for f in wave) for wave in waves], axis=1)
    v = np.stack([sum(0.8 * np.pi * np.cos(2 * np.pi * f * t + 7 * f) for f in wave) for wave in waves], axis=1)
    tau = 20 * np.cos(q) + 3 * v + np.random.default_rng(1).normal(0, 0.05, q.shape)
    return {"t": t, "q": q, "dq": v, "tau": tau}


@pytest.fixture
def recording(series) -> Recording:
    return Recording(series["t"], series["q"], series["tau"], "torque", ("a", "b", "c"), v=series["dq"], file="log.npz")


@pytest.fixture
def archive(tmp_path: Path, series) -> Callable[..., Path]:
    """Write the series to an archive, some of them replaced; None leaves one out."""

    def _archive(name: str = "log.npz", **changed: np.ndarray | None) -> Path:
        path = tmp_path / name
        kept = {key: value for key, value in (series | changed).items() if value is not None}
        np.savez_compressed(path, **kept)
        return path

    return _archive
