"""The verdict's rules, one by one."""

from __future__ import annotations

import numpy as np
import pytest

from calib.geometry.accuracy import Errors
from calib.procedure.comparing import Comparison
from calib.procedure.verdict import judge


def rows(nominal: float, calibrated: float, proves: bool = True) -> Comparison:
    """Return a comparison with errors of these sizes [mm] on 50 poses."""
    sizes = [Errors(np.full(50, 1e-3 * size), None, None) for size in (nominal, calibrated)]
    return Comparison((), [], (None, None), (sizes[0], sizes[1]), (np.zeros(0), np.zeros(0)), 50, "", proves)  # type: ignore[arg-type]


DEFAULTS = {"model": "geometry", "asked": "auto", "cross_validated": 1e-4, "outlier_share": 0.0}


@pytest.mark.parametrize(
    ("unseen", "changes", "level", "words"),
    [
        ({"a": rows(1.0, 0.1)}, {}, "pass", "on a, unseen: rms 1.000 mm nominal, 0.100 mm calibrated"),
        ({"a": rows(1.0, 0.1), "b": rows(1.0, 1.1)}, {}, "fail", "on b the calibrated arm is worse"),
        ({"a": rows(0.100, 0.1005)}, {}, "marginal", "gain is small"),
        ({"a": rows(1.0, 0.5)}, {}, "marginal", "5.0 times those on the fitted"),
        (
            {"a": rows(1.0, 0.1)},
            {"unexplained": "no rigid geometry explains"},
            "marginal",
            "no rigid geometry explains",
        ),
        ({"a": rows(1.0, 0.1)}, {"outlier_share": 0.1}, "marginal", "10 % of the fitted rows"),
        ({}, {}, "pass", "cross-validation only"),
        ({}, {"cross_validated": None}, "marginal", "no unseen poses"),
        ({}, {"cross_validated": 2e-3}, "fail", "worse"),
        ({"a": rows(1.0, 0.01, proves=False)}, {"cross_validated": None}, "marginal", "no unseen poses"),
        ({"a": rows(1.0, 1.0)}, {"model": "frames"}, "fail", "no model of the arm"),
        ({"a": rows(1.0, 1.0)}, {"model": "frames", "asked": "frames"}, "pass", "the arm is as it was"),
    ],
)
def test_rules(unseen, changes, level, words):
    found = judge(rows(1.0, 0.1, False), unseen, **(DEFAULTS | changes))
    assert (found.level, words in found.reason) == (level, True), found
