"""Torques that joints measured at rest: gravity, payloads and faults found by them; the arm is Pinocchio's."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from loaded_arm import HEAD, GivingArm, urdf

from calib.data.poses.fit_options import parse_options
from calib.data.poses.pose_files import read_measurements
from calib.errors import UsageError
from calib.geometry.static_torques.agreement import agreeing_torques, without_contradicting_torques
from calib.geometry.static_torques.column_faults import column_fault
from calib.geometry.static_torques.gravity_fit import (
    FACTOR_SIGMAS,
    MILLIMETRES,
    gravity_factor,
    gravity_fit,
    gravity_regressor,
    payload_load,
)
from calib.geometry.static_torques.load_errors import load_masses
from calib.geometry.static_torques.sources import MODELLED, driven, load_changes, load_findings
from calib.robot.formats import urdf as urdf_format

JOINTS = [f"joint{number}" for number in range(1, 8)]


@pytest.fixture(scope="module")
def arm():
    return GivingArm(seed=3)


@pytest.fixture(scope="module")
def chain():
    return urdf_format.parse(urdf(), "giving.urdf")


@pytest.fixture(scope="module")
def folder(arm, tmp_path_factory):
    path = tmp_path_factory.mktemp("loads")
    arm.write(path / "empty.csv", arm.table(80, 1))
    arm.write(path / "loaded.csv", arm.table(40, 2, 2.5, (0.02, -0.03, 0.12)))
    return path


def block(path, **options):
    return read_measurements(path, JOINTS, parse_options(options))[0]


@pytest.fixture(scope="module")
def gravity(chain, folder):
    fit, findings = gravity_fit(chain, [block(folder / "empty.csv")])
    assert findings == []
    return fit


def faulty(folder, change):
    measured = block(folder / "empty.csv")
    torque = np.array(measured.measured_torque)
    change(torque)
    return replace(measured, measured_torque=torque)


def test_gravity_without_described_masses_predicts_the_torques_of_other_poses(arm, gravity, tmp_path):
    other = block(arm.write(tmp_path / "other.csv", arm.table(60, 7)))
    residual = gravity.balancing(other) - driven(other, gravity, MODELLED).torque
    assert np.abs(residual.mean(axis=0)).max() < 0.1
    assert residual.std(axis=0).max() < 0.4  # 0.1 N·m of noise, 1 % of gain


def test_payload_is_found_with_its_mass(folder, gravity):
    loaded = block(folder / "loaded.csv")
    (found,) = load_findings(loaded, gravity)
    assert found.code == "payload-found"
    assert abs(found.values["mass"] - 2.5) < 3.0 * found.values["sigma"] < 0.3
    assert driven(loaded, gravity).load[0, 3] == pytest.approx(found.values["mass"])


def test_a_file_of_the_same_load_tells_no_payload(arm, gravity, tmp_path):
    other = block(arm.write(tmp_path / "other.csv", arm.table(60, 8)))
    assert load_findings(other, gravity) == []
    assert not driven(other, gravity).load.any()


def test_payload_stated_twice_as_heavy_is_named_and_the_torques_are_believed(folder, gravity):
    loaded = block(folder / "loaded.csv", payload={"mass": 5.0})
    (differs,) = load_findings(loaded, gravity)
    assert differs.code == "payload-differs" and differs.values["stated"] == 5.0
    assert driven(loaded, gravity).load[0, 3] == pytest.approx(2.5, abs=0.1)
    assert load_findings(block(folder / "loaded.csv", payload={"mass": 2.5}), gravity) == []


def test_stated_payload_drives_a_file_without_torques(folder, gravity):
    stated = replace(block(folder / "loaded.csv", payload={"mass": 2.5, "centre": [0.02, -0.03, 0.12]}))
    silent = driven(replace(stated, measured_torque=None), gravity)
    assert np.abs(silent.torque - driven(stated, gravity, MODELLED).torque).max() < 1.5
    assert silent.load[0, 3] == 2.5


def test_two_files_of_different_loads_are_fitted_together(chain, folder):
    blocks = [block(folder / "empty.csv"), block(folder / "loaded.csv")]
    fit, _ = gravity_fit(chain, blocks)
    assert fit.loads[1][3] == pytest.approx(2.5, abs=0.1) and not fit.loads[0].any()
    (changed,) = load_changes([driven(blocks[0], fit)], [driven(blocks[1], fit)])
    assert changed.code == "load-changed" and changed.values["fitted"] == 0.0


def test_torques_in_one_of_two_files_drive_both(chain, folder):
    silent = replace(block(folder / "loaded.csv"), measured_torque=None)
    fit, _ = gravity_fit(chain, [silent, block(folder / "empty.csv")])
    assert driven(silent, fit).torque.shape == (40, 7)
    assert load_findings(silent, fit) == []


def test_sensors_that_count_the_load_are_recognised(chain, folder, gravity):
    turned, _ = gravity_fit(chain, [faulty(folder, lambda torque: np.negative(torque, out=torque))])
    assert turned.sign == -gravity.sign
    assert np.allclose(turned.chain.inertias, gravity.chain.inertias, atol=1e-6)


def reverse(torque):
    torque[:, 1] *= -1.0


def exchange(torque):
    torque[:, [1, 3]] = torque[:, [3, 1]]


def shuffle(torque):
    np.random.default_rng(0).shuffle(torque)


@pytest.mark.parametrize(
    "change, says",
    [
        (reverse, "tau2 reversed"),
        (exchange, "tau2 and tau4 exchanged"),
        (lambda torque: torque.fill(0.0), "zero in every row"),
        (lambda torque: np.multiply(torque, 1e3, out=torque), "kg"),
        (shuffle, "of their variation only"),
    ],
)
def test_torques_that_contradict_gravity_are_not_used(chain, folder, change, says):
    fit, (unused,) = gravity_fit(chain, [faulty(folder, change)])
    assert fit is None
    assert unused.code == "torques-unused" and says in unused.values["reason"]


def test_exchanged_columns_are_named_however_different_their_torques(chain, folder):
    measured = block(folder / "empty.csv")
    regressor = gravity_regressor(chain, measured.q)
    for first, second in combinations(range(1, 7), 2):
        torque = np.array(measured.measured_torque)
        torque[:, [first, second]] = torque[:, [second, first]]
        reason, _ = column_fault(regressor, torque, np.isfinite(torque))
        assert f"tau{first + 1} and tau{second + 1} exchanged" in reason


def test_described_masses_tell_newton_millimetres(folder):
    chain = urdf_format.parse(urdf(masses=True), "giving.urdf")
    _, (unused,) = gravity_fit(chain, [faulty(folder, lambda torque: np.multiply(torque, 1e3, out=torque))])
    assert "N mm" in unused.values["cure"]


def test_rows_of_a_swinging_arm_are_named_and_replaced(chain, folder):
    def swing(torque):
        torque[[4, 9]] += 15.0
        torque[20:23] = np.nan

    measured = faulty(folder, swing)
    fit, _ = gravity_fit(chain, [measured])
    (moving,) = load_findings(measured, fit)
    assert moving.code == "torques-of-motion" and list(moving.values["rows"]) == [5, 10]
    torque = driven(measured, fit).torque
    assert np.isfinite(torque).all()
    assert np.abs(torque - driven(block(folder / "empty.csv"), fit).torque)[[4, 9, 20]].max() < 1.0


@pytest.mark.slow
def test_friction_at_rest_is_smoothed_by_the_masses(chain, tmp_path):
    """Torques of motors: friction of either sign is in each; those of the fitted masses are nearer to gravity."""
    arm = GivingArm(seed=3, friction=0.08)
    measured = block(arm.write(tmp_path / "motors.csv", arm.table(80, 1)))
    fit, findings = gravity_fit(chain, [measured])
    clean, _ = gravity_fit(
        chain, [block(GivingArm(seed=3).write(tmp_path / "clean.csv", GivingArm(seed=3).table(80, 1)))]
    )
    assert findings == []
    truth = driven(measured, clean, MODELLED).torque
    errors = [np.abs(driven(measured, fit, source).torque - truth).mean() for source in ("measured", MODELLED)]
    assert errors[1] < 0.5 * errors[0]


@pytest.mark.slow
def test_loads_by_row_of_one_file_are_those_of_several_files(arm, chain, folder, tmp_path):
    tables = arm.table(80, 1), arm.table(40, 2, 2.5, (0.02, -0.03, 0.12))
    rows = np.column_stack([np.concatenate(tables), np.repeat([0.0, 2.5], [80, 40])])
    mixed = block(arm.write(tmp_path / "mixed.csv", rows[::-1], [*HEAD, "payload [kg]"]))
    fit, _ = gravity_fit(chain, [mixed])
    torques = driven(mixed, fit)
    assert np.unique(torques.load[:, 3]).size == 2
    difference = torques.load[:40, 3].mean() - torques.load[40:, 3].mean()
    assert difference == pytest.approx(2.5, abs=0.1)
    assert load_findings(mixed, fit) == []
    assert len(load_masses([torques])) == 2


@pytest.mark.parametrize(
    "change, says",
    [
        pytest.param(
            lambda torque: np.negative(torque, out=torque), "the other one than in empty.csv", marks=pytest.mark.slow
        ),
        (lambda torque: np.multiply(torque, 1000.0, out=torque), "times the gravity of empty.csv"),
        (lambda torque: torque.fill(0.0), "zero in every row"),
        pytest.param(
            lambda torque: np.multiply(torque, 0.5, out=torque), "no load explains them", marks=pytest.mark.slow
        ),
        (lambda torque: np.negative(torque[:, 1], out=torque[:, 1]), "with tau2 reversed"),
    ],
)
def test_torques_of_an_unseen_file_that_contradict_the_fitted_gravity_are_not_used(folder, gravity, change, says):
    measured, findings = without_contradicting_torques(faulty(folder, change), gravity, [block(folder / "empty.csv")])
    assert measured.measured_torque is None
    (unused,) = findings
    assert unused.code == "torques-unused" and says in f"{unused.values['reason']}"
    assert load_findings(measured, gravity) == []


def test_a_loaded_unseen_file_does_not_contradict_the_fitted_gravity(folder, gravity):
    loaded = block(folder / "loaded.csv")
    measured, findings = without_contradicting_torques(loaded, gravity, [block(folder / "empty.csv")])
    assert measured is loaded
    assert findings == []


def test_a_file_lighter_than_the_first_one_tells_whose_payload_to_state(chain, folder):
    fit, _ = gravity_fit(chain, [block(folder / "loaded.csv")])
    (lighter,) = load_findings(block(folder / "empty.csv"), fit)
    assert lighter.code == "payload-missing"
    assert lighter.values["mass"] == pytest.approx(2.5, rel=0.05)


@pytest.mark.parametrize("payload", ["heavy", (2.5, (0.0, 0.0, 0.1)), -2.5, float("nan"), (2.5, 0.0)])
def test_a_payload_of_another_form_is_refused(chain, payload):
    with pytest.raises(UsageError, match="expected a mass"):
        payload_load(chain, payload)


def test_empty_torque_columns_are_called_empty(chain, folder):
    _, (unused,) = gravity_fit(chain, [faulty(folder, lambda torque: torque.fill(np.nan))])
    assert unused.values["reason"] == "their columns are empty"


@pytest.mark.parametrize(
    "payload, says",
    [
        ((2.5, 10.0, 20.0, 150.0), "the arm reaches"),
        ((2500.0,), "state it in kg"),
        ((1e6, 0.0, 0.0, 0.1), "state it in kg"),
    ],
)
def test_a_payload_in_another_unit_is_refused(chain, payload, says):
    with pytest.raises(UsageError, match=says):
        payload_load(chain, payload)


def test_a_gantry_without_masses_carries_by_the_travel_of_its_axes(tmp_path):
    """Its links have no length; a kilogram was refused as more than it carries."""
    tags = ['<robot name="gantry"><link name="l0"/>']
    for number, axis in enumerate(("1 0 0", "0 1 0", "0 0 1"), 1):
        tags.append(
            f'<link name="l{number}"/><joint name="j{number}" type="prismatic"><parent link="l{number - 1}"/>'
            f'<child link="l{number}"/><axis xyz="{axis}"/>'
            '<limit lower="0" upper="0.8" effort="500" velocity="1"/></joint>'
        )
    (tmp_path / "gantry.urdf").write_text("".join([*tags, "</robot>"]))
    gantry = urdf_format.read(tmp_path / "gantry.urdf")
    assert payload_load(gantry, 20.0)[3] == 20.0
    with pytest.raises(UsageError, match="state it in kg"):
        payload_load(gantry, 20e3)


def changed(measured, change):
    torque = np.array(measured.measured_torque)
    change(torque)
    return replace(measured, measured_torque=torque, file="changed.csv")


@pytest.mark.parametrize(
    "change, says",
    [
        pytest.param(
            lambda torque: np.negative(torque, out=torque), "the other one than in empty.csv", marks=pytest.mark.slow
        ),
        (lambda torque: np.multiply(torque, 1000.0, out=torque), "kg"),
        (exchange, "tau2 and tau4 exchanged"),
        (reverse, "tau2 reversed"),
        pytest.param(
            lambda torque: np.multiply(torque, 0.5, out=torque), "no load explains them", marks=pytest.mark.slow
        ),
    ],
)
def test_a_second_fitted_file_is_judged_by_the_first_one(chain, folder, gravity, change, says):
    blocks = [block(folder / "empty.csv"), changed(block(folder / "loaded.csv"), change)]
    fit, (first, second), (unused,) = agreeing_torques(chain, blocks)
    assert list(unused.values["files"]) == ["changed.csv"] and says in unused.values["reason"]
    assert first is blocks[0] and second.measured_torque is None
    assert np.array_equal(fit.chain.inertias, gravity.chain.inertias)


@pytest.mark.slow
def test_of_three_files_the_one_that_contradicts_two_is_named(arm, chain, folder, tmp_path):
    others = [block(arm.write(tmp_path / f"{seed}.csv", arm.table(30, seed))) for seed in (5, 6)]
    odd = changed(block(folder / "empty.csv"), lambda torque: np.negative(torque, out=torque))
    fit, blocks, (unused,) = agreeing_torques(chain, [odd, *others])
    assert list(unused.values["files"]) == ["changed.csv"] and "5.csv, 6.csv" in unused.values["reason"]
    assert [measured.measured_torque is None for measured in blocks] == [True, False, False]
    assert len(fit.loads) == 2


def rub(torque):
    random = np.random.default_rng(1)
    torque[:] = 20.0 * np.sign(random.normal(size=torque.shape)) + random.normal(size=torque.shape)


def turn_ten(torque):
    np.negative(torque, out=torque)
    torque[10:] = np.nan


def turn_few(torque):
    np.negative(torque, out=torque)
    torque[5:] = np.nan


@pytest.mark.parametrize(
    "change, count",
    [
        (rub, 40),
        pytest.param(rub, 80, marks=pytest.mark.slow),
        pytest.param(turn_ten, 80, marks=pytest.mark.slow),
        pytest.param(turn_few, 80, marks=pytest.mark.slow),
    ],
)
@pytest.mark.parametrize("files", [("odd", "good"), pytest.param(("good", "odd"), marks=pytest.mark.slow)])
def test_of_two_files_the_one_that_shows_gravity_stays(arm, chain, tmp_path, change, count, files):
    """The odd file has as many rows as the good one or more; it is motor friction, or turned where it has torques."""
    good = block(arm.write(tmp_path / "good.csv", arm.table(40, 5)))
    blocks = {"good": good, "odd": changed(block(arm.write(tmp_path / "odd.csv", arm.table(count, 6))), change)}
    fit, agreeing, (unused,) = agreeing_torques(chain, [blocks[name] for name in files])
    assert list(unused.values["files"]) == ["changed.csv"]
    assert agreeing[files.index("good")] is good and agreeing[files.index("odd")].measured_torque is None
    assert len(fit.loads) == 1


@pytest.mark.slow
def test_of_three_files_two_without_gravity_are_named(arm, chain, tmp_path):
    tables = [block(arm.write(tmp_path / f"{seed}.csv", arm.table(40, seed))) for seed in (5, 6, 7)]
    fit, agreeing, findings = agreeing_torques(chain, [changed(tables[0], rub), changed(tables[1], shuffle), tables[2]])
    assert fit is not None and len(findings) == 2
    assert [measured.measured_torque is None for measured in agreeing] == [True, True, False]


def test_empty_torques_of_an_unseen_file_are_called_empty(folder, gravity):
    empty = faulty(folder, lambda torque: torque.fill(np.nan))
    measured, (unused,) = without_contradicting_torques(empty, gravity, [])
    assert measured.measured_torque is None and unused.values["reason"] == "their columns are empty"


@pytest.mark.slow
def test_files_of_a_few_rows_each_or_of_a_single_pose_do_not_contradict_each_other(arm, chain, folder, tmp_path):
    rows = arm.table(24, 5)
    poses = np.tile(rows[:1, :7], (12, 1)) + 1e-4 * np.arange(12)[:, None]
    tables = [rows[:12], rows[12:], arm.table(12, 7, 2.5, poses=poses)]
    blocks = []
    for number, table in enumerate(tables):
        blocks.append(block(arm.write(tmp_path / f"{number}.csv", table)))
    for files in (blocks[::-1], [block(folder / "empty.csv"), blocks[2]]):
        fit, agreeing, findings = agreeing_torques(chain, files)
        assert findings == [] and list(agreeing) == files
        assert len(fit.loads) == len(files)


def test_torques_of_a_single_pose_are_not_called_too_large_by_their_noise(arm, gravity, tmp_path):
    """Over steps of 0.1 µrad gravity hardly varies: the noise is thousands of times its variation."""
    poses = np.tile(arm.table(1, 5)[:, :7], (12, 1)) + 1e-7 * np.arange(12)[:, None]
    still = block(arm.write(tmp_path / "still.csv", arm.table(12, 7, poses=poses)))
    expected = gravity.sign * driven(still, gravity, MODELLED).torque
    wrong = changed(still, lambda torque: np.multiply(torque, 0.2, out=torque))
    factor, sigma = gravity_factor(expected, np.asarray(wrong.measured_torque))
    assert abs(factor) > MILLIMETRES > abs(factor) - FACTOR_SIGMAS * sigma
    measured, (unused,) = without_contradicting_torques(wrong, gravity, [])
    assert measured.measured_torque is None and "times the gravity" not in unused.values["reason"]


@pytest.mark.parametrize(
    "heads, says",
    [
        (HEAD[:15], "those of joint6, joint7 are missing"),
        ([*HEAD[:10], *(f"{name} [A]" for name in HEAD[10:])], "their columns are in A"),
    ],
)
def test_torques_that_are_not_read_are_explained(arm, chain, tmp_path, heads, says):
    measured = block(arm.write(tmp_path / "some.csv", arm.table(10, 1)[:, : len(heads)], heads))
    fit, _, (unused,) = agreeing_torques(chain, [measured])
    assert fit is None and says in unused.values["reason"]


@pytest.mark.parametrize("unit", ["", " [A]"])
def test_torques_by_joint_are_read_beside_numbered_ones_of_some_joints_or_in_amperes(arm, tmp_path, unit):
    table = arm.table(10, 1)
    numbered = [f"tau{number}{unit}" for number in range(1, 8)]
    if not unit:
        numbered = numbered[:1]
    heads = [*HEAD[:10], *(f"tau_{name}" for name in JOINTS), *numbered]
    measured = block(arm.write(tmp_path / "both.csv", np.hstack([table, -table[:, 10 : 10 + len(numbered)]]), heads))
    assert measured.torque_fault is None
    assert np.allclose(measured.measured_torque, table[:, 10:])


def test_joints_without_a_sensor_have_empty_columns(chain, folder):
    def unread(torque):
        torque[:, 5:] = np.nan

    fit, _, findings = agreeing_torques(chain, [faulty(folder, unread)])
    assert findings == [] and np.isinf(fit.sigma[5:]).all()
    loaded = block(folder / "loaded.csv")
    _, contradicting = without_contradicting_torques(loaded, fit, [loaded])
    assert contradicting == []
    (payload,) = load_findings(loaded, fit)
    assert payload.values["mass"] == pytest.approx(2.5, abs=0.15)
    assert np.isfinite(driven(loaded, fit).torque).all()


def test_a_reversed_column_is_named_beside_joints_without_a_sensor(chain, folder):
    def unread(torque):
        torque[:, 5:] = np.nan
        reverse(torque)

    fit, _, (unused,) = agreeing_torques(chain, [faulty(folder, unread)])
    assert fit is None and "tau2 reversed" in unused.values["reason"]
