"""Poses and loads chosen together: what they are predicted to tell of compliance, and that the plan can be measured."""

import csv
import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from loaded_arm import HEAD, GivingArm, urdf

import calib
from calib.data.poses.pose_lists import filled_in, read_poses
from calib.errors import UsageError
from calib.geometry.observability import observation, targets_of
from calib.procedure.kinematic_stage import selection
from calib.procedure.kinematic_stage.loads import compliant
from calib.procedure.kinematic_stage.settings import SelectionSettings
from calib.robot.formats import urdf as urdf_format

WITHOUT = ("self-collision", "floor")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("loads")
    for name, masses in (("weighed", True), ("unweighed", False)):
        (path / f"{name}.urdf").write_text(urdf(masses))
    return path


@pytest.fixture(scope="module")
def chosen(folder):
    @cache
    def choose(name="weighed", m=14, loads=(0.0, 2.5, 5.0), **settings):
        given = SelectionSettings("position", candidates=60, loads=loads, without=WITHOUT)
        return selection.choose(folder / f"{name}.urdf", m, replace(given, **settings))

    return choose


@pytest.mark.slow
def test_compliance_is_told_better_with_loads_than_without(chosen):
    loads = chosen().loads
    assert loads.share < 0.9 * loads.unloaded_share < 0.9
    assert loads.loaded.rms < loads.unloaded.rms
    record = selection.record(chosen())["loads"]
    assert len(record["sigma"]) == len(record["compliances"])
    assert np.all(np.array(record["sigma"]) <= 1.001 * np.array(record["prior"]))


@pytest.mark.slow
def test_each_load_is_attached_once(chosen):
    masses = chosen().loads.masses
    assert set(masses) <= {0.0, 2.5, 5.0} and len(set(masses)) > 1
    assert np.count_nonzero(np.diff(masses)) == len(set(masses)) - 1
    assert len(chosen().run.ways) == 13


@pytest.mark.slow
def test_a_single_load_is_carried_in_all_poses(chosen):
    assert chosen(loads=(2.5,)).loads.masses.tolist() == [2.5] * 14


@pytest.mark.slow
def test_the_csv_states_the_load_of_each_pose_and_is_no_measurement(chosen, tmp_path):
    path = selection.write(chosen(), tmp_path / "poses.csv")
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [float(row["payload [kg]"]) for row in rows] == chosen().loads.masses.tolist()
    assert not filled_in(path, 7)
    assert np.allclose(read_poses(path, chosen().chain.joint_names), chosen().selection.q)
    path.write_text(
        path.read_text().replace("payload [kg]", "payload [kg],x", 1).replace("\n", ",1.0\n").replace("x,1.0", "x")
    )
    assert filled_in(path, 7)


@pytest.mark.slow
def test_a_load_that_the_joints_cannot_hold_is_left_out_or_refused(chosen):
    assert chosen(loads=(0.0, 25.0)).loads.excluded > 0
    with pytest.raises(UsageError, match="500 kg: more than such an arm carries"):
        chosen(loads=(0.0, 500.0))


@pytest.mark.slow
def test_an_arm_without_masses_is_said_to_need_torques(chosen):
    assert any("has no masses" in note for note in chosen("unweighed").notes)
    assert not any("has no masses" in note for note in chosen().notes)


@pytest.mark.parametrize(("key", "value"), [("method", "polish")])
def test_methods_that_move_poses_choose_no_loads(chosen, key, value):
    with pytest.raises(UsageError, match="--loads: give --method detmax"):
        chosen(**{key: value})


def test_columns_of_compliance_are_derivatives_of_the_predicted_position():
    chain = urdf_format.parse(urdf(True), "giving.urdf")
    rigid = observation(targets_of(chain), "position")
    loaded = compliant(rigid, 3.0)
    deflection = loaded.cell.deflection
    q = np.random.default_rng(1).uniform(-1.5, 1.5, (4, 7))
    step = 1e-6
    jacobian = loaded.position(q)[1]
    first = len(rigid.free)
    for column in (1, 3, 8, 12):
        moved = []
        for sign in (-1.0, 1.0):
            coefficients = np.zeros(len(deflection.terms))
            coefficients[column] = sign * step
            cell = replace(loaded.cell, deflection=deflection.with_coefficients(coefficients))
            moved.append(replace(loaded, cell=cell).position(q)[0])
        slope = (moved[1] - moved[0]) / (2.0 * step)
        assert np.allclose(jacobian[:, :, first + column], slope, rtol=1e-4, atol=1e-4)


@pytest.mark.slow
def test_the_command_takes_loads_and_says_what_they_tell(folder, calib, cell):
    arguments = ("-m", "12", "--candidates", "40", "--without", "self-collision", "--no-plots", "--out", "p.csv")
    code, out, err = calib("select", str(folder / "weighed.urdf"), *arguments, "--loads", "0,5")
    assert code == 0, err
    for words in ("predicted σ of compliance", "predicted σ of the tool with 5 kg", "loads at the tip: poses 1 to"):
        assert words in out
    code, _, err = calib("select", str(folder / "weighed.urdf"), *arguments, "--loads", "-1")
    assert code == 2 and "loads" in err


@pytest.mark.slow
def test_predicted_errors_under_a_load_are_reached(folder, tmp_path):
    """Masses described 30 % wrong: 0.11 mm with loads predicted, 0.13 reached; 0.31 and 0.29 without."""
    random = np.random.default_rng(2)
    wrong = re.sub(
        r'mass value="([\d.]+)"',
        lambda mass: f'mass value="{float(mass[1]) * np.exp(0.3 * random.normal()):.4f}"',
        urdf(True),
    )
    (tmp_path / "arm.urdf").write_text(wrong)
    arm = GivingArm(seed=2)
    head = [*HEAD[:10], "payload [kg]"]
    truth = replace(arm, noise=0.0).table(60, 999, 5.0, (0.0, 0.0, 0.0))[:, :10]
    unseen = arm.write(tmp_path / "unseen.csv", np.column_stack([truth, np.full(60, 5.0)]), head)
    reached, predicted = [], []
    for loads in ((0.0, 5.0), (0.0,)):
        settings = SelectionSettings("position", candidates=150, tools=((0, 0, 0.1),), loads=loads, without=WITHOUT)
        plan = selection.choose(tmp_path / "arm.urdf", 40, settings)
        rows = []
        for number, (q, mass) in enumerate(zip(plan.selection.q, plan.loads.masses)):
            row = arm.table(1, 200 + number, mass, (0.0, 0.0, 0.0), poses=q[None])[0, :10]
            rows.append([*row, mass])
        measured = arm.write(tmp_path / "measured.csv", np.array(rows), head)
        fit = calib.fit_geometry(tmp_path / "arm.urdf", measured, validate=unseen)
        (errors,) = (rows.errors[1].rms for rows in fit.validation.values())
        reached.append(errors)
        if not predicted:
            predicted = [plan.loads.loaded.rms, plan.loads.unloaded.rms]
    assert np.all(np.array(reached) < 1.5 * np.array(predicted))
    assert np.all(np.array(reached) > 0.6 * np.array(predicted))
    assert reached[0] < 0.6 * reached[1]
