"""Every kind of measurement through the command: a planted arm comes out better on poses that were kept aside."""

import json
from pathlib import Path

import numpy as np
import pytest

from calib.robot.kinematics import forward
from calib.transforms import from_xyz_rpy

NOISE = 2e-5
JOINTS = [f"q{j + 1}" for j in range(6)]
REFLECTORS = ([0.05, 0.02, 0.1], [-0.05, 0.03, 0.1], [0.0, -0.06, 0.12])


def points(cell, q: np.ndarray, tool: list[float]) -> np.ndarray:
    """Return where the target is in the arm's base (m, 3)."""
    return (forward(cell.truth, q) @ from_xyz_rpy(tool, [0, 0, 0]))[:, :3, 3]


def distances(cell, q, generator) -> list[dict]:
    p = points(cell, q, REFLECTORS[0])
    known = np.linalg.norm(p[0::2] - p[1::2], axis=1) + NOISE * generator.standard_normal(len(q) // 2)
    return [dict(zip(JOINTS, row)) | {"distance": known[k // 2], "pair": k // 2} for k, row in enumerate(q)]


def bars(cell, q, generator) -> list[dict]:
    p = points(cell, q, REFLECTORS[0])
    known = np.linalg.norm(p - [0.6, 0.2, 0.3], axis=1) + NOISE * generator.standard_normal(len(q))
    return [dict(zip(JOINTS, row)) | {"distance": d, "bar": "a"} for row, d in zip(q, known)]


def reflectors(cell, q, generator) -> list[dict]:
    station = from_xyz_rpy([1.5, -0.8, 0.4], [0.1, -0.2, 2.0])
    rows = [dict(zip(JOINTS, row)) for row in q]
    for number, tool in enumerate(REFLECTORS, 1):
        seen = points(cell, q, tool) @ station[:3, :3].T + station[:3, 3]
        for row, place in zip(rows, seen + NOISE * generator.standard_normal(seen.shape)):
            row |= {f"{axis}{number}": value for axis, value in zip("xyz", place)}
    return rows


@pytest.mark.parametrize(
    ("measure", "count", "nature", "poses"),
    [(distances, 240, "distance_mm", 192), (bars, 160, "distance_mm", 128), (reflectors, 60, "position_mm", 48)],
)
def test_a_kind_calibrates(cell, calib, measure, count, nature, poses):
    generator = np.random.default_rng(3)
    q = generator.uniform(-2.5, 2.5, (count, 6))
    rows = measure(cell, q, generator)
    file = cell.write("a.csv", rows, list(rows[0]))
    code, _, err = calib("fit", "ur5", file, "--model", "geometry", "--holdout", "0.2", "--out", "done")
    assert code == 0, err
    metrics = json.loads(Path("done/metrics.json").read_text())
    unseen = metrics["validation"]["a.csv"]
    assert metrics["fit"]["poses"] == poses
    assert unseen["nominal"][nature]["rms"] > 0.4
    assert unseen["calibrated"][nature]["rms"] < 0.06
    if nature == "distance_mm":
        assert unseen["calibrated"]["position_mm"] is None
    else:
        assert unseen["calibrated"]["distance_mm"] is None
