"""Compliance of joints from recordings with two encoders, as prior of a fit to few poses; the arm is Pinocchio's."""

import csv

import numpy as np
import pytest
from loaded_arm import HEAD, GivingArm, urdf

import calib
from calib.errors import MeasurementError, UsageError
from calib.folders import JOINT_COMPLIANCE
from calib.geometry.model_choice.stated_compliance import read_compliance
from calib.procedure.dynamic_stage.folder import COMPLIANCE_HEADER
from calib.robot import calibrated
from calib.robot.formats import urdf as urdf_format

STATED_JOINTS = (2, 4)
SHARE = 0.03


@pytest.fixture(scope="module")
def arm():
    planted = GivingArm(seed=3)
    planted.across[:] = 0.0
    return planted


@pytest.fixture(scope="module")
def folder(arm, tmp_path_factory):
    path = tmp_path_factory.mktemp("stated")
    (path / "arm.urdf").write_text(urdf(masses=True))
    (path / "light.urdf").write_text(urdf())
    arm.write(path / "few.csv", arm.table(16, 1)[:, :10], HEAD[:10])
    arm.write(path / "more.csv", arm.table(40, 1)[:, :10], HEAD[:10])
    arm.write(path / "unseen.csv", arm.table(100, 2)[:, :10], HEAD[:10])
    write_compliance(path / JOINT_COMPLIANCE, arm, 1.0)
    write_compliance(path / "wrong.csv", arm, 4.0)
    return path


def write_compliance(path, arm, factor, identified="yes"):
    """Write planted compliances times a factor, and joint 6 as not identified, in the form of an identification."""
    rows = []
    for joint in (*STATED_JOINTS, 6):
        compliance = -factor * arm.about[joint - 1]
        answer = identified if joint in STATED_JOINTS else "no"
        rows.append((f"joint{joint}", compliance, SHARE * abs(compliance), answer, 0.1, 0.1, 0.05))
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([COMPLIANCE_HEADER, *rows])


def fitted(folder, measured, compliance="", robot="arm.urdf"):
    settings = calib.FitSettings(compliance=compliance and str(folder / compliance))
    return calib.fit_geometry(folder / robot, folder / measured, settings, validate=folder / "unseen.csv")


@pytest.fixture(scope="module")
def stated(folder):
    """A fit of the few poses with the table."""
    return fitted(folder, "few.csv", JOINT_COMPLIANCE)


def unseen_rms(fit):
    (comparison,) = fit.outcome.assessment.validation.values()
    return float(np.sqrt(np.mean(comparison.errors[1].position ** 2)))


def contradicted(fit):
    return [note for note in fit.outcome.findings.noticed if note.code == "compliance-contradicted"]


@pytest.mark.slow
def test_few_poses_and_the_table_predict_better_than_the_poses_alone(folder, arm, stated):
    alone = fitted(folder, "few.csv")
    assert unseen_rms(stated) < 0.7 * unseen_rms(alone)
    assert contradicted(stated) == []
    deflection = stated.outcome.selection.fit.cell.deflection
    assert [term.source + 1 for term in deflection.terms[:2]] == list(STATED_JOINTS)
    planted = -arm.about[np.array(STATED_JOINTS) - 1]
    assert np.abs(deflection.coefficients[:2] / planted - 1.0).max() < 4.0 * SHARE
    rigid = stated.outcome.rigid.cell
    assert not rigid.deflection.terms and not rigid.known.terms


@pytest.mark.slow
def test_poses_contradict_a_wrong_table(folder, arm):
    notes = contradicted(fitted(folder, "more.csv", "wrong.csv"))
    by_joint = {note.values["joint"]: note.values for note in notes}
    values = by_joint["joint2"]
    assert values["sigmas"] > 4.0
    assert values["stated"] == pytest.approx(-4.0 * arm.about[1])
    assert contradicted(fitted(folder, "more.csv", JOINT_COMPLIANCE)) == []


@pytest.mark.slow
def test_a_table_that_is_too_stiff_is_told_from_what_bearings_would_give(folder, arm):
    write_compliance(folder / "stiff.csv", arm, 0.3)
    fit = fitted(folder, "more.csv", "stiff.csv")
    exceeded = [note for note in fit.outcome.findings.noticed if note.code == "compliance-exceeded"]
    assert [note.values["joint"] for note in exceeded] == ["joint2", "joint4"]
    for note in exceeded:
        assert 2.0 < note.values["times"] < 5.0


@pytest.mark.slow
def test_a_saved_fit_predicts_with_the_compliance(folder, stated, tmp_path):
    terms = calibrated.read(stated.save(tmp_path / "fit", plots=False)).deflection.terms
    assert [term.basis for term in terms[:2]] == ["torque", "torque"]
    with pytest.raises(UsageError, match="joint corrections of an earlier fit"):
        fitted(folder, "few.csv", JOINT_COMPLIANCE, robot=tmp_path / "fit")


def test_compliance_without_torques_is_refused(folder):
    with pytest.raises(UsageError, match="has no torques for it; describe the robot's masses"):
        fitted(folder, "few.csv", JOINT_COMPLIANCE, robot="light.urdf")


def test_tables_that_state_nothing_are_refused(folder, arm, tmp_path):
    chain = urdf_format.parse(urdf(masses=True), "giving.urdf")
    path = tmp_path / JOINT_COMPLIANCE
    write_compliance(path, arm, 1.0, identified="no")
    with pytest.raises(UsageError, match="no revolute joint's compliance is identified"):
        read_compliance(tmp_path, chain)
    write_compliance(path, arm, -1.0)
    with pytest.raises(MeasurementError, match="expected a negative number"):
        read_compliance(path, chain)
    path.write_text(path.read_text().replace("joint2", "shoulder"))
    with pytest.raises(UsageError, match="'shoulder' is not one of"):
        read_compliance(path, chain)
