"""The scripted planning study runs: with a margin a plan on the identified model can be followed, one on CAD cannot."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[2] / "examples/lwr4plus/planning.py"


@pytest.mark.slow
def test_planned_motion_can_be_followed(tmp_path):
    """The identified model plans what the robot can follow."""
    words = [sys.executable, SCRIPT, "--out", tmp_path, "--paths", "3"]
    done = subprocess.run(words, capture_output=True, text=True, check=True)
    assert "true peak" in done.stdout
    found = json.loads((tmp_path / "metrics.json").read_text())["summary"]
    assert found["CAD"]["peak"] > found["identified"]["peak"] and found["CAD"]["worst_peak"] > 1.05
    assert 1.0 < found["identified"]["worst_peak"] < 1.2  # noise: its own limits are not quite the robot's
    assert found["with margin"]["worst_peak"] <= 1.0
    assert found["truth"]["worst_peak"] <= 1.0 + 1e-9
    assert found["with margin"]["seconds"] < 1.05 * found["truth"]["seconds"]
