"""A small measurement file that is right, to be spoilt in one place per test."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest


@pytest.fixture
def write(tmp_path: Path) -> Callable[..., Path]:
    """Write text, or a header and rows, to a file."""

    def _write(header: str, rows: Sequence[Sequence[object]] | str = "", name: str = "poses.csv") -> Path:
        path = tmp_path / name
        body = rows if isinstance(rows, str) else "\n".join(",".join(str(cell) for cell in row) for row in rows)
        path.write_text(header + "\n" + body + "\n", encoding="utf-8")
        return path

    return _write


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
