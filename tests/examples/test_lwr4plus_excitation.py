"""The search for exciting motions stands beside its peers as the study says; its motions: `test_lwr4plus_tables`."""

import json
from pathlib import Path

import numpy as np
import pytest
from scripts import run_here

STUDIES = Path(__file__).parents[2] / "examples/lwr4plus"


@pytest.mark.long
@pytest.mark.slow
def test_exact_gradients_beat_differences(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Exact gradients beat differences and chance in the same time."""
    run_here(STUDIES / "excitation_peers.py", "--out", tmp_path, "--quick", capsys=capsys)
    found = json.loads((tmp_path / "metrics.json").read_text())
    best = {
        name: one["curve"][-1][1] if one["curve"] else np.inf
        for name, one in found.items()
        if " seed " in name and "curve" in one
    }
    exact, blind = best["slsqp, seed 0"], [best["slsqp, differences, seed 0"], best["random, seed 0"]]
    assert exact < min(blind)
    assert found["default, 10 s, seed 0"]["raw"] < 33 and found["default, 10 s, seed 0"]["normalised"] < 4.8
    assert (tmp_path / "plot_peers.png").stat().st_size > 5000
