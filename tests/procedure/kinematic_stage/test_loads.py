"""A fit of poses with torques holds under loads with which no pose was fitted; the arm is Pinocchio's."""

from dataclasses import replace

import numpy as np
import pytest
from loaded_arm import HEAD, GivingArm, urdf

import calib
from calib.data.poses.fit_options import parse_options
from calib.errors import UsageError
from calib.geometry.static_torques.load_check import suspected_load
from calib.geometry.static_torques.sources import MODELLED, gravity_of
from calib.procedure.kinematic_stage.folder import FitFolder
from calib.procedure.kinematic_stage.inputs import gather
from calib.robot.kinematics import forward

CENTRE = (0.02, -0.03, 0.12)
STATED = {"payload": {"mass": 5.0, "centre": list(CENTRE)}}
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def arm():
    return GivingArm(seed=5)


@pytest.fixture(scope="module")
def folder(arm, tmp_path_factory):
    path = tmp_path_factory.mktemp("loads")
    (path / "arm.urdf").write_text(urdf())
    arm.write(path / "train.csv", arm.table(150, 1))
    arm.write(path / "loaded.csv", arm.table(60, 2, 2.5, CENTRE))
    np.savetxt(path / "stated.csv", arm.table(60, 3, 5.0, CENTRE)[:, :10], delimiter=",", header=",".join(HEAD[:10]),
               comments="")  # fmt: skip
    return path


@pytest.fixture(scope="module")
def fit(folder):
    return calib.fit_geometry(
        folder / "arm.urdf",
        folder / "train.csv",
        calib.FitSettings(refit_frames=True),
        validate=[folder / "loaded.csv", folder / "stated.csv"],
        options=parse_options({"files": {"stated.csv": STATED}}),
    )


def test_errors_and_intervals_hold_under_loads_that_were_not_fitted(fit):
    """Measured torques, or a stated payload alone: 0.17 mm are the instrument's noise."""
    for rows in fit.validation.values():
        assert rows.errors[1].rms < 2.3e-4
        assert rows.alone.rms > 6e-4
        assert rows.intervals.covered >= 0.9
    codes = {finding.code: finding.values for finding in fit.assessment.noticed}
    assert codes["payload-found"]["mass"] == pytest.approx(2.5, abs=0.1)
    assert codes["load-changed"]["fitted"] == 0.0
    assert codes["torques-used"]["source"].startswith("as measured")


def test_predicted_deflection_by_a_payload_is_that_of_the_arm(arm, fit):
    still = replace(arm, noise=0.0)
    empty, loaded = (still.table(40, 9, mass, CENTRE) for mass in (0.0, 2.5))
    true_shift = np.linalg.norm(loaded[:, 7:10] - empty[:, 7:10], axis=1)
    q = empty[:, :7]
    before = fit.predict(q)
    after = fit.predict(q, payload=(2.5, *CENTRE))
    shift = np.linalg.norm((after.pose - before.pose)[:, :3, 3], axis=1)
    assert true_shift.mean() > 2e-4
    assert np.abs(shift - true_shift).mean() < 0.15 * true_shift.mean()
    assert after.sigma[:, 0].mean() > before.sigma[:, 0].mean()


def test_commands_for_a_payload_are_those_of_the_loaded_arm(fit):
    q = GivingArm(seed=5).table(5, 11)[:, :7]
    commands = calib.compensate(fit, q, payload=(2.5, *CENTRE))
    flange = fit.predict(commands.q, payload=(2.5, *CENTRE)).pose @ np.linalg.inv(fit.selection.fit.cell.tools[0])
    assert np.allclose(flange, forward(fit.inputs.chain, q), atol=1e-8)
    assert not np.allclose(commands.q, calib.compensate(fit, q).q, atol=1e-6)
    with pytest.raises(UsageError, match="expected a mass"):
        calib.compensate(fit, q, payload=(2.5, 0.1))


def test_a_load_that_nobody_stated_is_suspected_from_the_errors(folder, fit):
    """Neither torques nor payload: the errors of a file tell a mass at the tip; those of an empty arm tell none."""
    (silent,) = calib.read_poses(folder / "stated.csv", folder / "arm.urdf")
    cell = fit.selection.fit.cell
    cell = replace(cell, station_names=(silent.station,), tool_names=silent.tool_names)
    suspected = suspected_load(cell, silent)
    assert suspected.code == "load-suspected"
    assert suspected.values["mass"] == pytest.approx(5.0, rel=0.25)
    assert suspected.values["after"] < 0.5 * suspected.values["before"]
    empty = replace(fit.inputs.fit[0], measured_torque=None)
    assert suspected_load(fit.selection.fit.cell, empty) is None


def test_without_compliance_a_payload_widens_the_expected_error(folder):
    train = np.loadtxt(folder / "train.csv", delimiter=",", skiprows=1)[:, :10]
    np.savetxt(folder / "silent.csv", train, delimiter=",", header=",".join(HEAD[:10]), comments="")
    silent = calib.fit_geometry(folder / "arm.urdf", folder / "silent.csv", calib.FitSettings(model="geometry"))
    q = train[:20, :7]
    assert np.mean(silent.position_sigma(q, payload=5.0) / silent.position_sigma(q)) > 1.5
    assert "widens the expected errors only" in str(calib.compensate(silent, q[:3], payload=2.5).notes)


def plain_options(masses):
    files = {name: {"payload": {"mass": mass, "centre": list(CENTRE)}} for name, mass in masses.items()}
    return parse_options({"files": files})


@pytest.fixture(scope="module")
def several(tmp_path_factory):
    """Files of one arm: a and b to fit without and with 2.5 kg, v to validate with 5 kg, c with the rows of a and b."""
    path = tmp_path_factory.mktemp("several")
    (path / "arm.urdf").write_text(urdf(True))
    arm = GivingArm(seed=3)
    tables = {"a": arm.table(50, 1), "b": arm.table(40, 2, 2.5, CENTRE), "v": arm.table(60, 3, 5.0, CENTRE)}
    for name, table in tables.items():
        arm.write(path / f"{name}.csv", table)
        arm.write(path / f"{name}_silent.csv", table[:, :10], HEAD[:10])
    loads = np.repeat([0.0, 2.5], [50, 40])
    rows = np.column_stack([np.concatenate([tables["a"], tables["b"]]), loads])
    arm.write(path / "c.csv", np.random.default_rng(0).permutation(rows), [*HEAD, "payload [kg]"])
    return path


@pytest.mark.parametrize(
    ("fitted", "unseen"),
    [(("a", "b"), "v"), (("a_silent", "b_silent"), "v_silent"), (("a_silent", "b"), "v_silent"), (("c",), "v")],
)
def test_poses_under_several_loads_are_fitted_together(several, fitted, unseen):
    """Torques measured in all files, in none, in one, and loads by row of one file: 5 kg are predicted by all."""
    masses = dict.fromkeys(("a.csv", "a_silent.csv"), 0.0)
    masses |= dict.fromkeys(("b.csv", "b_silent.csv"), 2.5) | dict.fromkeys(("v.csv", "v_silent.csv"), 5.0)
    masses = {name: mass for name, mass in masses.items() if name[:-4] in (*fitted, unseen)}
    options = replace(plain_options(masses), payload=parse_options({"payload": {"centre": list(CENTRE)}}).payload)
    files = [several / f"{name}.csv" for name in fitted]
    result = calib.fit_geometry(several / "arm.urdf", files, validate=several / f"{unseen}.csv", options=options)
    assert "stiffness" in result.selection.chosen
    (rows,) = result.validation.values()
    assert rows.errors[1].rms < 2.4e-4
    assert rows.intervals.covered >= 0.9
    assert result.findings.discrepancy.loads == pytest.approx((0.0, 2.5), abs=0.1)
    assert rows.record().loads_kg == pytest.approx((5.0,), abs=0.2)
    codes = {finding.code: finding.values for finding in result.assessment.noticed}
    assert codes["load-changed"]["fitted"] == pytest.approx(2.5, abs=0.1)
    assert not {"payload-differs", "payload-found"} & set(codes)


def test_held_out_rows_of_a_file_whose_torques_contradict_have_none_either(several, tmp_path):
    table = np.loadtxt(several / "a.csv", delimiter=",", skiprows=1)
    table[:, 10:] *= -1.0
    odd = GivingArm(seed=3).write(tmp_path / "odd.csv", table[:30])
    inputs = gather(several / "arm.urdf", [several / "b.csv", odd], settings=calib.FitSettings(holdout=0.3))
    (unused,) = [finding for finding in inputs.noticed if finding.code == "torques-unused"]
    assert unused.values["files"] == (str(odd),)
    assert inputs.unseen["b.csv"].block.measured_torque is not None
    silent = inputs.unseen["odd.csv"].block
    assert silent.measured_torque is None and silent.load is None
    assert np.allclose(silent.torque, gravity_of(inputs.gravity.chain, silent.q))


def test_the_certificate_states_the_loads(several, tmp_path):
    options = plain_options({"a.csv": 0.0, "v.csv": 5.0})
    result = calib.fit_geometry(several / "arm.urdf", several / "a.csv", validate=several / "v.csv", options=options)
    result.save(tmp_path / "fit", plots=False)
    page = (tmp_path / "fit" / "report.html").read_text()
    assert "0 kg fitted; validated with 4.9" in page or "0 kg fitted; validated with 5" in page
    assert "load" in " ".join(result.warnings)


def test_what_drove_the_compliance_is_stored_and_drives_it_in_later_validations(tmp_path):
    """Torques of motors with friction at rest: masses predict better, and are taken for unseen poses, too."""
    arm = GivingArm(seed=3, friction=0.08, noise=2e-5)
    (tmp_path / "arm.urdf").write_text(urdf(True))
    fitted = arm.write(tmp_path / "fitted.csv", arm.table(100, 1))
    unseen = arm.write(tmp_path / "unseen.csv", arm.table(30, 2))
    result = calib.fit_geometry(tmp_path / "arm.urdf", fitted)
    assert result.inputs.torques == MODELLED
    result.save(tmp_path / "fit", plots=False)
    assert FitFolder(tmp_path / "fit").findings().torques == MODELLED
    (rows,) = calib.validate(result, unseen).inputs.unseen.values()
    assert np.allclose(rows.block.torque, gravity_of(result.inputs.weighed, rows.block.q, rows.block.load))
