"""The consistency study of the LWR4+ runs, and says what it claims to say."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLE = Path(__file__).parents[2] / "examples/lwr4plus/consistency.py"


@pytest.mark.slow
def test_calibrated_geometry_removes_bias(tmp_path):
    """Calibrated geometry takes the bias away, and propagation fills the intervals."""
    command = [sys.executable, str(EXAMPLE), "--runs", "3", "--out", str(tmp_path)]
    subprocess.run(command, check=True, capture_output=True, text=True)
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    found = metrics["geometries"]
    best, cad = found["calibrated, fine instrument, many poses"], found["CAD"]
    assert best["bias_in_sigma"]["rms"] < 0.2 < 2.0 < cad["bias_in_sigma"]["rms"]
    assert 3.0 * best["torque_error_percent"] < cad["torque_error_percent"] < 1.0
    assert found["CAD, 10 times as far off"]["torque_error_percent"] > 5.0 * cad["torque_error_percent"]
    fine, coarse = metrics["coverage"].values()
    assert fine["geometry_exceeds_torque"]["parameters"] == [] and len(fine["unchanged"]["parameters"]) > 70
    assert coarse["geometry_exceeds_torque"]["parameters"]
    assert 0.8 < coarse["rms_error_in_sigma"]["with"] < 1.2
    assert coarse["rms_error_in_sigma"]["without"] > 1.05 * coarse["rms_error_in_sigma"]["with"]
