"""Claims on the search for rows that are paired with the joint values of other rows."""

from dataclasses import replace

import numpy as np
import pytest
from planted import cell, perturb
from scipy.spatial.transform import Rotation

from calib.data.poses.measurements import Poses, Positions, take
from calib.geometry.checks import row_lags
from calib.geometry.checks.readings import without_unseen
from calib.geometry.checks.wrong_rows import (
    MIN_SHIFTED,
    SHIFTS,
    TIED,
    _best_cut,
    _columns,
    _CutErrors,
    _independent,
    _shifted,
    least_error,
    row_shifts,
)
from calib.geometry.diagnosis import wrong_columns
from calib.geometry.first_guess import install
from calib.geometry.installation import see
from calib.robot.calibrated import evaluate
from calib.robot.chain import random_joints
from calib.robot.kinematics import forward
from calib.robot.library import load
from calib.transforms import to_quaternion


def measured(count, name="ur5", seed=1, errors=(0.5e-3, 1e-3), q=None):
    """Return an arm, and positions of a target in another arm's cell, whose geometry has errors [m, rad]."""
    arm = load(name)
    truth = cell(perturb(arm, seed, *errors), seed)
    if q is None:
        q = random_joints(arm, count, np.random.default_rng(seed))
    seen = see(truth, q, 0, np.zeros(count, dtype=int), evaluate(truth.deflection, q, None))
    return arm, Positions(q, arm.joint_names, seen.point.T, file="measured.csv")


def best_first(nominal, block, shift):
    """Return the row from which on a shift explains positions best."""
    return _best_cut(_independent(_columns(nominal, block)), block, shift).first


def measured_poses(count, name, seed):
    """Return an arm, and poses of the tip of an arm whose geometry has errors."""
    arm = load(name)
    q = random_joints(arm, count, np.random.default_rng(seed))
    tip = forward(perturb(arm, seed, 0.5e-3, 1e-3), q)
    return arm, Poses(q, arm.joint_names, tip[:, :3, 3], to_quaternion(tip), file="measured.csv")


@pytest.mark.parametrize(
    "variant",
    [
        pytest.param("whole", marks=pytest.mark.slow),
        "shifted",
        pytest.param("held out", marks=pytest.mark.slow),
        pytest.param("two tools", marks=pytest.mark.slow),
        "other order",
    ],
)
def test_best_first_row_as_by_a_fit_for_each(variant):
    """The last row from which on a shift explains as much as the best one is the same as by a fit for every row."""
    random = np.random.default_rng(0)
    arm, block = measured(40)
    match variant:
        case "shifted":
            block = _shifted(block, 20, 1)
        case "held out":
            block = take(block, np.sort(random.choice(40, 32, replace=False)))
        case "two tools":
            block = replace(block, tool=np.arange(40) % 2, tool_names=("a", "b"))
        case "other order":
            block = take(block, random.permutation(40))
    nominal = install(arm, [block])
    for shift in SHIFTS:
        first = np.unique(block.rows)[: 1 - MIN_SHIFTED - abs(shift)]
        errors = [least_error(nominal, [_shifted(block, int(row), shift)])[0] for row in first]
        best = int(np.argmin(errors))
        last = best
        while last + 1 < len(first) and len(block) * errors[last + 1] < (len(block) + TIED) * errors[best]:
            last += 1
        assert best_first(nominal, block, shift) == first[last]


@pytest.mark.parametrize("name", ["ur5", "tx40", "lwr4plus", "ur10"])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_slip_is_named_at_its_row_and_no_good_row_is_called_unseen(name, seed):
    """A reading or a joint row was stored twice: the first wrong row is named, exactly or taken anew with noise."""
    random = np.random.default_rng(seed)
    arm, block = measured(50, name, seed)
    nominal = install(arm, [block])
    slip = int(random.choice([random.integers(3, 38), 46]))
    source = np.where(np.arange(50) < slip, np.arange(50), np.arange(50) - 1)
    first = int(block.rows[slip])
    stored_twice = replace(block, position=block.position[source])
    read_twice = replace(stored_twice, position=stored_twice.position + 1e-5 * random.normal(size=(50, 3)))
    joints_twice = replace(block, q=block.q[source])
    for slipped, shift in ((stored_twice, -1), (read_twice, -1), (joints_twice, 1)):
        assert best_first(nominal, slipped, shift) == first
    visible, findings = without_unseen(arm, stored_twice)
    assert len(visible) == 50 and not findings


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_slip_in_simulated_positions_of_the_nominal_arm_is_named_at_its_row(seed):
    """Their least error is rounding, of which one row has many times that of another."""
    arm, block = measured(50, seed=seed, errors=(0.0, 0.0))
    source = np.where(np.arange(50) < 20, np.arange(50), np.arange(50) - 1)
    slipped = replace(block, position=block.position[source])
    assert best_first(install(arm, [block]), slipped, -1) == block.rows[20]


@pytest.mark.parametrize("seed", [0, 1, 2, 3])
def test_a_slip_of_poses_is_named_at_its_row(seed):
    random = np.random.default_rng(seed)
    arm = forward(load("ur5"), random_joints(load("ur5"), 50, random))
    noise = Rotation.from_rotvec(1e-4 * random.normal(size=(50, 3))).as_matrix()
    target = np.array(arm)
    target[:, :3, :3] = arm[:, :3, :3] @ noise
    slip = int(random.integers(8, 40))
    source = np.where(np.arange(50) < slip, np.arange(50), np.arange(50) - 1)
    for arm_rows, measured_rows, lag in ((arm, target[source], -1), (arm[source], target, 1)):
        assert row_lags.last_lag(arm_rows, measured_rows) == lag
        assert row_lags.first_of_lag(arm_rows, measured_rows, lag) == slip


@pytest.mark.parametrize("name", ["ur5", "lwr4plus"])
def test_a_repeated_reading_of_a_lost_target_is_still_left_out(name):
    arm, block = measured(50, name)
    position = np.array(block.position)
    position[21] = position[20]
    visible, findings = without_unseen(arm, replace(block, position=position))
    assert len(visible) == 48
    assert [finding.code for finding in findings] == ["reading-repeated"]


@pytest.mark.filterwarnings("error")
def test_a_row_is_missing_near_the_end_of_a_short_file():
    """A shift that leaves no row behind its first one with joint values is none."""
    arm, block = measured(12)
    gapped = take(block, np.flatnonzero(np.arange(12) != 10))
    changes = row_shifts(install(arm, [gapped]), [gapped], 0.3)
    assert all(change.values["first"] < gapped.rows[-1] for change in changes)


def test_no_rows_have_no_error():
    """Without a row there is no error to divide by."""
    arm, block = measured(40)
    nominal = install(arm, [block])
    np.testing.assert_array_equal(least_error(nominal, [take(block, np.arange(0))]), [0.0])
    assert _CutErrors.of(_independent(_columns(nominal, block)), block, -1).at(np.array([0])) >= 0.0


@pytest.mark.parametrize("name", ["ur5", "lwr4plus"])
@pytest.mark.parametrize("kind", [Positions, Poses])
@pytest.mark.parametrize("slip", [2, 10, 17])
def test_a_slip_in_a_short_file_is_named_at_its_row(name, kind, slip):
    """Of 20 rows, and where two rows only have the joint values of the rows behind them."""
    arm, target = measured_poses(21, name, seed=slip)
    source = np.where(np.arange(20) < slip, np.arange(20), np.arange(20) + 1)
    block = take(target, np.arange(20))
    block = replace(block, position=target.position[source], quaternion=target.quaternion[source])
    if kind is Positions:
        block = Positions(block.q, block.joint_names, block.position, file="measured.csv")
    explanation = wrong_columns(install(arm, [block]), [block])
    assert explanation is not None and explanation.code == "rows-shifted"
    values = explanation.changes[0].values
    assert (values["first"], values["by"], values["way"]) == (slip + 1, 1, "down")


@pytest.mark.parametrize("seed", [3, 4, 5])
@pytest.mark.parametrize("gross", [1, 2])
def test_gross_last_rows_are_no_slip(seed, gross):
    """Neighbouring poses are near each other, so that rows beside the gross ones nearly fit to both."""
    random = np.random.default_rng(seed)
    start, end = random_joints(load("ur5"), 2, random)
    path = start + np.linspace(0.0, 1.0, 40)[:, None] * (end - start) + 0.1 * np.sin(np.arange(40.0)[:, None])
    arm, block = measured(40, seed=seed, q=path)
    position = np.array(block.position)
    position[-gross:] += 0.3 * random.normal(size=(gross, 3))
    block = replace(block, position=position)
    explanation = wrong_columns(install(arm, [block]), [block])
    assert explanation is None or explanation.code != "rows-shifted"
