"""The verdict's rules, one by one."""

from __future__ import annotations

import numpy as np
import pytest

from calib.geometry.accuracy import Errors
from calib.procedure.kinematic_stage.comparison import Comparison
from calib.procedure.kinematic_stage.metrics import Findings
from calib.procedure.kinematic_stage.settings import FitSettings
from calib.procedure.kinematic_stage.validation import judge_deliverables
from calib.procedure.kinematic_stage.verdict import judge


def rows(
    nominal: float,
    calibrated: float,
    proves: bool = True,
    turned: float | None = None,
    alone: float | None = None,
    shares_frames: bool = True,
) -> Comparison:
    """Return a comparison with errors of these sizes [mm] on 50 poses; orientations are off by `turned` [deg]."""
    angles = None if turned is None else np.radians(np.full(50, turned))
    sizes = [Errors(np.full(50, 1e-3 * size), angles, None) for size in (nominal, calibrated)]
    bare = None if alone is None else Errors(np.full(50, 1e-3 * alone), None, None)
    nothing = (np.zeros(0), np.zeros(0))
    return Comparison(
        (), [], (None, None), (sizes[0], sizes[1]), nothing, 50, "", proves, bare, shares_frames  # type: ignore[arg-type]
    )  # fmt: skip


DEFAULTS = {"model": "geometry", "asked": "auto", "cross_validated": 1e-4, "outlier_share": 0.0}


@pytest.mark.parametrize(
    ("unseen", "changes", "level", "words"),
    [
        ({"a": rows(1.0, 0.1)}, {}, "pass", "on a, unseen: rms 1.000 mm nominal, 0.100 mm calibrated"),
        ({"a": rows(1.0, 0.1), "b": rows(1.0, 1.1)}, {}, "fail", "on b, unseen, the calibrated arm is worse"),
        ({"a": rows(0.100, 0.1005)}, {}, "marginal", "gain is small"),
        ({"a": rows(1.0, 0.5)}, {}, "marginal", "5.0 times those on the fitted"),
        ({"a": rows(3.3, 3.1)}, {}, "fail", "hardly any gain, and errors are 31.0 times those on the fitted"),
        ({"a": rows(3.3, 3.1)}, {"cross_validated": 1e-3}, "marginal", "31.0 times those on the fitted"),
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
        # orientations count
        ({"a": rows(1.0, 0.1, turned=4.0)}, {}, "pass", "on a, unseen"),
        ({"a": rows(1.0, 0.1, turned=6.0)}, {}, "fail", "off by 6° rms"),
        # both arms far off say where the instrument stood, not what the arm is
        ({"a": rows(150.0, 149.0)}, {"reach": 1.0}, "fail", "stood elsewhere; refit their frames"),
        ({"a": rows(150.0, 149.0, shares_frames=False)}, {"reach": 1.0}, "fail", "is it this robot"),
        ({"a": rows(150.0, 0.1)}, {"reach": 1.0}, "pass", "on a, unseen"),
        # nothing to gain, like beside like
        ({"a": rows(0.3, 0.3)}, {"model": "frames", "reach": 1.0}, "pass", "nothing to gain"),
        ({"a": rows(0.5, 0.5)}, {"model": "frames", "reach": 1.0}, "fail", "no model of the arm"),
        (
            {},
            {"model": "frames", "nominal_cross_validated": 3e-4, "cross_validated": 3e-4, "reach": 1.0},
            "pass",
            "nothing to gain",
        ),
        ({}, {"nominal_cross_validated": 5e-3, "cross_validated": 2e-3}, "marginal", "20.0 times"),
        ({}, {"nominal_cross_validated": 1e-4, "cross_validated": 2e-4, "reach": 1.0}, "marginal", "nothing to gain"),
        # a tolerance is held against unseen rows
        ({"a": rows(1.0, 0.1)}, {"tolerance": 2e-4}, "pass", "within the tolerance of 0.2 mm"),
        ({"a": rows(1.0, 0.1)}, {"tolerance": 5e-5}, "fail", "above the tolerance of 0.05 mm"),
        ({}, {"tolerance": 5e-5}, "fail", "above the tolerance"),
        ({"a": rows(0.3, 0.3)}, {"model": "frames", "reach": 1.0, "tolerance": 2e-4}, "fail", "above the tolerance"),
    ],
)
def test_rules(unseen, changes, level, words):
    found = judge(rows(1.0, 0.1, False), unseen, **(DEFAULTS | changes))
    assert (found.level, words in found.reason) == (level, True), found


def test_each_deliverable_has_a_verdict_of_its_own():
    findings = Findings("geometry + harmonics", 1e-4, None, 0.0, "", 1.0, rigid_cross_validated=2e-4)
    fit, unseen = rows(1.0, 0.05, False, alone=0.1), {"a": rows(1.0, 0.06, alone=0.107)}

    def levels(fit, unseen, **wanted):
        found = judge_deliverables(fit, unseen, findings, FitSettings(**wanted))
        return {name: one.level for name, one in found.items()}

    assert levels(fit, unseen, tolerance=1e-4) == {"urdf": "fail", "corrections": "pass"}
    assert levels(fit, unseen, tolerance=1.1e-4) == {"urdf": "pass", "corrections": "pass"}
    assert levels(fit, {}, tolerance=1.5e-4) == {"urdf": "fail", "corrections": "pass"}, "by cross-validation"
    worse = {"a": rows(1.0, 0.06, alone=1.2)}
    assert levels(fit, worse) == {"urdf": "fail", "corrections": "pass"}, "worse than the nominal arm"
    assert levels(rows(1.0, 0.05, False), {"a": rows(1.0, 0.06)}) == {"urdf": "pass"}, "without corrections"
