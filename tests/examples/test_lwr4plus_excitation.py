"""The scripted excitation study runs, and says what it says."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]


def test_optimised_motions_are_feasible_and_better_conditioned(tmp_path: Path) -> None:
    script = ROOT / "examples/lwr4plus/excitation.py"
    subprocess.run([sys.executable, script, "--out", tmp_path, "--quick"], check=True, capture_output=True)
    rows = json.loads((tmp_path / "metrics.json").read_text())["motions"]
    a, b, *others = rows.values()
    for row in (a, b):
        assert row["search"]["feasible"] and min(row["search"]["margins"].values()) >= 0
        assert row["condition_number"]["raw"] < 45 < min(other["condition_number"]["raw"] for other in others)
        ratio = row["calibrated"]["condition_number"]["raw"] / row["condition_number"]["raw"]
        assert 0.9 < ratio < 1.1
    assert min(b["torque_share"][5:]) >= 0.1
    assert all(abs(row["error_median_20_seeds"] / row["rsd_median"] - 1) < 0.3 for row in rows.values())
