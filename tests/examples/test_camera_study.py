"""The camera study runs on small rendered images, and says what it claims to say."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLE = Path(__file__).parents[2] / "examples/camera/accuracy.py"


@pytest.mark.slow
def test_reprojection_beats_two_steps_on_rendered_images(tmp_path):
    subprocess.run([sys.executable, str(EXAMPLE), "--quick", "--out", str(tmp_path)], check=True, capture_output=True)
    found = json.loads((tmp_path / "metrics.json").read_text())
    stiff = found["rigid arm, rendered images"]
    assert stiff["nominal_mm"] > 5.0
    for count in ("20", "24"):
        row = stiff[count]
        assert row["reprojection_mm"] < 0.75 * row["two_steps_mm"] < 0.3
        assert row["corner_px"] < 0.06
    assert found["hidden deflections, projected corners"]["24"]["reprojection_mm"] > 0.3  # no instrument helps there
