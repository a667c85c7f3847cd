"""The scripted excitation study runs, and says what it says."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

STUDIES = Path(__file__).parents[2] / "examples/lwr4plus"


@pytest.mark.slow
def test_designs_are_better_conditioned_and_the_decomposition_holds(tmp_path: Path) -> None:
    script = STUDIES / "excitation.py"
    subprocess.run([sys.executable, script, "--out", tmp_path], check=True, capture_output=True)
    found = json.loads((tmp_path / "metrics.json").read_text())
    rows = found["motions"]
    a, b, d, *others = rows.values()
    for row in (a, b):
        assert row["condition_number"]["raw"] < 50 < min(other["condition_number"]["raw"] for other in others)
    assert min(b["torque_share"][5:]) >= 0.1
    assert d["size_ratio"] > max(a["size_ratio"], b["size_ratio"])  # log det asks for large columns, cond does not
    for row in rows.values():
        assert row["sigma_ratio"] * row["size_ratio"] * row["separation_ratio"] == pytest.approx(1.0)
        white, rsd = np.array(row["error"]["white"]), np.array(list(row["rsd"].values()))
        assert abs(np.median(white / rsd) - 1.0) < 0.2  # errors over noise seeds are what the RSD says
        assert row["median_error"]["coloured"] > row["median_error"]["white"]
    assert {path.name for path in tmp_path.glob("*.png")} == {"plot_paths.png", "plot_estimates.png"}


@pytest.mark.slow
def test_exact_gradients_beat_differences_and_chance_in_the_same_time(tmp_path: Path) -> None:
    script = STUDIES / "excitation_peers.py"
    words = [sys.executable, script, "--out", tmp_path, "--seconds", "1", "--alone"]
    subprocess.run(words, check=True, capture_output=True)
    found = json.loads((tmp_path / "metrics.json").read_text())
    best = {name: curve[-1][1] if curve else np.inf for name, curve in found["curves"].items()}
    assert best["ours"] < min(best["differences"], best["random"], best["scipy, 2-point"])
    assert (tmp_path / "plot_peers.png").stat().st_size > 5000
