"""The verdict's rules, one by one."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from calib.errors import finding
from calib.geometry.accuracy import Errors
from calib.geometry.checks.joint_range import JointRange
from calib.procedure.kinematic_stage.metrics import Findings
from calib.procedure.kinematic_stage.settings import FitSettings
from calib.procedure.kinematic_stage.verdict.comparison import Comparison
from calib.procedure.kinematic_stage.verdict.validation import judge, judge_deliverables


def rows(nominal, calibrated, proves=True, turned=None, alone=None, shares_frames=True) -> Comparison:
    """Return a comparison with errors of these sizes [mm] on 50 poses; orientations are off by `turned` [deg]."""
    angles = None if turned is None else np.radians(np.full(50, turned))
    sizes = [Errors(np.full(50, 1e-3 * size), angles, None) for size in (nominal, calibrated)]
    bare = None if alone is None else Errors(np.full(50, 1e-3 * alone), None, None)
    nothing = (np.zeros(0), np.zeros(0))
    return Comparison(
        (), (None, None), (sizes[0], sizes[1]), nothing, 50, "", proves, bare, shares_frames  # type: ignore[arg-type]
    )  # fmt: skip


def few_rows(nominal, calibrated) -> Comparison:
    """Return a comparison with errors of these sizes [mm] on too few poses."""
    return replace(rows(nominal, calibrated), few=7)


def placed_rows(nominal, calibrated) -> Comparison:
    """Return a comparison with errors of these sizes [mm] that a placement fitted to few numbers left."""
    return replace(rows(nominal, calibrated, proves=False), placed_by=(24, 9))


def with_row_off(nominal, calibrated, nominal_off, calibrated_off) -> Comparison:
    """Return the comparison with other errors [mm] of row 7."""
    found = rows(nominal, calibrated)
    for each, off in zip(found.errors, (nominal_off, calibrated_off)):
        each.main[7] = 1e-3 * off
    return replace(found, blocks=(SimpleNamespace(rows=np.arange(50), load=None, file="unseen.csv"),))


FITTED = Findings("geometry", 1e-4, None, 0.0, np.inf)
MISFIT = finding("rigid-misfit", rms=1e-3, folds=2e-3, reach=1.0, healthy=4e-4, left=2.0)
LIGHT = finding("rigid-misfit", rms=1e-3, folds=2e-3, reach=1.0, healthy=4e-4, left=0.5)
ASKED = {"model": "frames", "requested_model": "frames"}
SCALE = finding("lengths-grew", factor=1.01, sigma=1e-4, explained=0.9, off=0.01, sigmas=100.0)


@pytest.mark.parametrize(
    ("unseen", "changes", "level", "code"),
    [
        ({"a": rows(1.0, 0.1)}, {}, "pass", ""),
        ({"a": rows(1.0, 0.1), "b": rows(1.0, 1.1)}, {}, "fail", "worse-than-nominal"),
        ({"a": rows(0.100, 0.1005)}, {}, "marginal", "small-gain"),
        ({"a": rows(1.0, 0.5)}, {}, "marginal", "no-transfer"),
        ({"a": rows(3.3, 3.1)}, {}, "fail", "refuted"),
        ({"a": rows(3.3, 3.1)}, {"cross_validated": 1e-3}, "marginal", "no-transfer"),
        ({"a": rows(1.0, 0.1)}, {"noticed": (MISFIT,)}, "marginal", "rigid-misfit"),
        ({"a": rows(3.3, 3.1)}, {"noticed": (MISFIT,), "cross_validated": 5e-4}, "marginal", "rigid-misfit"),
        # ten times the cross-validated error contradicts a fit, however much was gained
        ({"a": rows(1.0, 0.5)}, {"cross_validated": 4.9e-5}, "fail", "contradicted"),
        ({"a": rows(1.0, 0.5)}, {"cross_validated": 5.1e-5}, "marginal", "no-transfer"),
        ({"a": rows(3.3, 2.0)}, {"noticed": (MISFIT,)}, "fail", "contradicted"),
        ({"a": rows(9.0, 2.0), "b": rows(9.0, 0.1)}, {}, "fail", "contradicted"),
        ({"a": rows(1.0, 0.1)}, {"noticed": (LIGHT,)}, "pass", ""),
        ({"a": rows(1.0, 0.1)}, {"noticed": (SCALE,)}, "marginal", "lengths-grew"),
        ({"a": rows(1.0, 1.1)}, {"noticed": (SCALE,)}, "fail", "worse-than-nominal"),
        ({"a": rows(1.0, 0.1)}, {"outlier_share": 0.1}, "marginal", "many-outliers"),
        ({}, {}, "pass", ""),
        ({}, {"cross_validated": None}, "marginal", "no-unseen-poses"),
        ({}, {"cross_validated": 2e-3}, "fail", "worse-than-nominal"),
        ({"a": rows(1.0, 0.01, proves=False)}, {"cross_validated": None}, "marginal", "no-unseen-poses"),
        # few poses decide nothing, not even beside others that do, but withhold a pass that they contradict
        ({"a": few_rows(1.0, 0.01)}, {"cross_validated": None}, "marginal", "no-unseen-poses"),
        ({"a": few_rows(1.0, 0.1)}, {}, "pass", ""),
        ({"a": few_rows(1.0, 0.5)}, {}, "marginal", "few-unseen-poses"),
        ({"a": few_rows(1.0, 0.5), "b": rows(1.0, 0.1)}, {}, "marginal", "few-unseen-poses"),
        # or refute the fit
        ({"a": few_rows(1.0, 2.0)}, {}, "fail", "contradicted"),
        ({"a": few_rows(1.0, 2.0), "b": rows(1.0, 0.1)}, {}, "fail", "contradicted"),
        # what a placement fitted to few numbers leaves is a lower bound of the error
        ({"a": placed_rows(1.0, 0.1)}, {}, "pass", ""),
        ({"a": placed_rows(1.0, 0.1)}, {"cross_validated": None}, "marginal", "no-unseen-poses"),
        ({"a": placed_rows(1.0, 0.5)}, {}, "marginal", "placement-takes-all"),
        ({"a": placed_rows(3.3, 2.0)}, {}, "fail", "contradicted"),
        ({"a": placed_rows(3.3, 2.0), "b": rows(1.0, 0.1)}, {}, "fail", "contradicted"),
        (
            {"a": replace(with_row_off(1.0, 0.1, 30.0, 30.0), proves=False, placed_by=(24, 9))},
            {},
            "marginal",
            "gross-unseen-rows",
        ),
        ({"a": few_rows(1.0, 0.1), "b": rows(1.0, 1.1)}, {}, "fail", "worse-than-nominal"),
        ({"a": replace(rows(1.0, 0.1, turned=6.0), few=7)}, {}, "fail", "orientations-off"),
        # a row that is far off with both arms is named, as among many
        ({"a": replace(with_row_off(1.0, 0.1, 30.0, 30.0), few=7)}, {}, "marginal", "gross-unseen-rows"),
        ({"a": rows(1.0, 0.99)}, {"reach": 1.0}, "fail", "no-better-model"),
        # only frames were asked for: the tolerance decides, without one nothing does
        ({"a": rows(1.0, 1.0)}, ASKED, "not judged", ""),
        ({"a": rows(1.0, 1.0)}, ASKED | {"tolerance": 2e-3}, "pass", ""),
        ({"a": rows(1.0, 1.0)}, ASKED | {"tolerance": 9e-4}, "fail", "above-tolerance"),
        ({"a": rows(1.0, 1.0)}, ASKED | {"noticed": (SCALE,)}, "marginal", "lengths-grew"),
        # orientations count
        ({"a": rows(1.0, 0.1, turned=4.0)}, {}, "pass", ""),
        ({"a": rows(1.0, 0.1, turned=6.0)}, {}, "fail", "orientations-off"),
        # both arms far off say where the instrument stood, not what the arm is
        ({"a": rows(150.0, 149.0)}, {"reach": 1.0}, "fail", "placed-elsewhere"),
        ({"a": rows(150.0, 149.0, shares_frames=False)}, {"reach": 1.0}, "fail", "far-off"),
        ({"a": rows(150.0, 0.1)}, {"reach": 1.0}, "pass", ""),
        # a row that is far off with both arms was measured wrongly; with one of them it is the arm's
        ({"a": with_row_off(1.0, 0.1, 30.0, 30.0)}, {}, "marginal", "gross-unseen-rows"),
        ({"a": with_row_off(1.0, 0.1, 3e3, 3e3)}, {"reach": 1.0}, "fail", "gross-unseen-rows"),
        ({"a": with_row_off(1.0, 0.1, 30.0, 30.0)}, {"tolerance": 1e-3}, "fail", "above-tolerance"),
        ({"a": with_row_off(1.0, 0.1, 1.0, 30.0)}, {}, "fail", "worse-than-nominal"),
        ({"a": with_row_off(1.0, 0.1, 30.0, 0.1)}, {}, "pass", ""),
        # rows that determine themselves, such as three points of a plane, have no error to compare others with
        ({"a": with_row_off(0.0, 0.0, 30.0, 30.0)}, {}, "fail", "refuted"),
        # nothing to gain, like beside like
        ({"a": rows(0.3, 0.299)}, {"reach": 1.0}, "pass", ""),
        ({"a": rows(0.3, 0.299)}, {"reach": 1.0, "blind": ("b",)}, "marginal", "transfer-untested"),
        ({"a": rows(0.5, 0.499)}, {"reach": 1.0}, "fail", "no-better-model"),
        ({}, {"nominal_cross_validated": 3e-4, "cross_validated": 3e-4, "reach": 1.0}, "pass", ""),
        ({}, {"nominal_cross_validated": 5e-3, "cross_validated": 2e-3}, "marginal", "no-transfer"),
        ({}, {"nominal_cross_validated": 1e-4, "cross_validated": 2e-4, "reach": 1.0}, "marginal", "keep-nominal"),
        # a tolerance is held against unseen rows
        ({"a": rows(1.0, 0.1)}, {"tolerance": 2e-4}, "pass", ""),
        ({"a": rows(1.0, 0.1)}, {"tolerance": 5e-5}, "fail", "above-tolerance"),
        ({}, {"tolerance": 5e-5}, "fail", "above-tolerance"),
        ({"a": rows(0.3, 0.299)}, {"reach": 1.0, "tolerance": 2e-4}, "fail", "above-tolerance"),
    ],
)
def test_rules(unseen, changes, level, code):
    asked = {name: changes[name] for name in ("requested_model", "tolerance") if name in changes}
    findings = replace(FITTED, **{name: value for name, value in changes.items() if name not in asked})
    found = judge(rows(1.0, 0.1, False), unseen, findings, cross_validated=findings.cross_validated, **asked)
    assert (found.level, found.code) == (level, code), found
    assert len(found.reason.split()) <= 25


def at(comparison, q, mass=0.0) -> Comparison:
    """Return the comparison with the joint values q (50, n), measured with a load of this mass [kg]."""
    return replace(comparison, blocks=(Poses(q, np.tile([0.0, 0.0, 0.0, mass], (50, 1))),))


class Poses(SimpleNamespace):
    """A block of measurements, of which only the joint values and the load are read."""

    def __init__(self, q, load):
        super().__init__(q=q, rows=np.arange(len(q)), load=load, file="a.csv")

    def __len__(self):
        return len(self.q)


@pytest.mark.parametrize("few", [None, 7])
def test_extrapolation_is_no_contradiction(few):
    """Large errors contradict a fit only on poses whose joints are within the fitted range, or little outside."""
    fitted = np.random.default_rng(0).uniform(-1.0, 1.0, (50, 6))
    fit = at(rows(1.0, 0.1, False), fitted)
    levels = {}
    for scale in (0.5, 1.1, 3.0):
        unseen = replace(at(rows(9.0, 2.0), scale * np.sign(fitted)), few=few)
        levels[scale] = judge(fit, {"a": unseen}, FITTED, cross_validated=1e-4).level
    assert levels == {0.5: "fail", 1.1: "fail", 3.0: "marginal"}
    loaded = replace(at(rows(9.0, 2.0), fitted, mass=5.0), few=few)
    assert judge(fit, {"a": loaded}, FITTED, cross_validated=1e-4).level == "marginal", "under another load"
    # one wrong pose in three is within the range: the others neither hide nor add to it
    far = np.where(np.arange(50)[:, None] % 3 == 0, 0.5, 3.0) * np.sign(fitted)
    verdict = judge(fit, {"a": replace(at(rows(9.0, 2.0), far), few=few)}, FITTED, cross_validated=1e-4)
    assert verdict.level == "fail" and "within the fitted range" in verdict.reason


@pytest.mark.parametrize(("sigma", "code"), [(0.2e-3, "no-better-known"), (0.05e-3, "")])
def test_a_geometry_that_is_no_better_known_than_nominal_is_marginal_without_unseen_poses(sigma, code):
    span = JointRange(("q1",), ("rad",), (-1.0,), (1.0,), (0.4,), sigma=sigma, nominal=0.1e-3, left=0.0)
    findings = replace(FITTED, joint_range=span)
    fit = rows(1.0, 0.1, False)
    verdict = judge(fit, {}, findings, cross_validated=1e-4)
    assert (verdict.level, verdict.code) == ("marginal" if code else "pass", code)
    assert judge(fit, {"a": rows(1.0, 0.1)}, findings, cross_validated=1e-4).level == "pass"


def test_the_reason_names_what_its_errors_are_of():
    """A verdict by cross-validation says so, and names the files that are too small to decide it."""
    small = {"g3.csv": replace(few_rows(1.0, 0.1), few=3), "g7.csv": few_rows(1.0, 0.1)}
    fit = rows(1.0, 0.01, False)
    verdict = judge(fit, small, FITTED, cross_validated=1e-4)
    assert "(too few unseen poses: g3.csv 3 of 8, g7.csv 7 of 8)" in verdict.reason
    assert "error by cross-validation 10.0 times" in verdict.reason
    many = judge(fit, {"a": rows(1.0, 0.1)}, FITTED, cross_validated=1e-4)
    assert "error on unseen poses 10.0 times" in many.reason


def test_deliverables_have_separate_verdicts():
    """Each deliverable has a verdict of its own."""
    findings = Findings("geometry + harmonics", 1e-4, None, 0.0, 1.0, rigid_cross_validated=2e-4)
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


@pytest.mark.parametrize(("alone", "level"), [(0.085, "marginal"), (0.095, "pass"), (0.15, "pass")])
def test_corrections_that_are_worse_than_the_rigid_arm_do_not_pass(alone, level):
    """Corrections, chosen by cross-validation on few poses, may be refuted by unseen ones: robot.urdf is not."""
    findings = Findings("geometry + wobble", 1e-4, None, 0.0, 1.0, rigid_cross_validated=1e-4)
    fit, unseen = rows(1.0, 0.05, False, alone=0.06), {"a": rows(1.0, 0.1, alone=alone)}
    verdicts = judge_deliverables(fit, unseen, findings, FitSettings())
    assert {name: verdict.level for name, verdict in verdicts.items()} == {"urdf": "pass", "corrections": level}
    assert (verdicts["corrections"].code == "corrections-worse") is (level == "marginal")
