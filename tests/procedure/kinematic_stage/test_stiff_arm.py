"""The bound of a deflection that a fit does not show is learnt from poses under several loads that agree."""

import json
from pathlib import Path

import numpy as np
import pytest


@pytest.mark.parametrize(("loads", "least", "most"), [((0.0, 5.0, 10.0), 0.0, 0.3), ((5.0,), 1.0, np.inf)])
def test_intervals_of_a_stiff_arm_under_an_unseen_load(cell, calib, loads, least, most):
    """Three loads without any deflection bound that of a fourth one between them; one load bounds none."""

    def carrying(name, count, seed, masses):
        rows = cell.measure(count, seed)
        return cell.write(name, [row | {"payload [kg]": masses[k % len(masses)]} for k, row in enumerate(rows)])

    given = ("ur5", carrying("m.csv", 60, 0, loads), "--validate", carrying("v.csv", 40, 1, (7.5,)))
    _, _, err = calib("fit", *given, "--out", "o")
    intervals = json.loads(Path("o/metrics.json").read_text())["validation"]["v.csv"]["interval95"]
    assert least < intervals["median_mm"] < most, err
    assert intervals["coverage_percent"] >= 90.0
