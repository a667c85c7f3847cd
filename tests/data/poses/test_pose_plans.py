"""Pose lists: written and read back; held against what was measured."""

import numpy as np
import pytest

from calib.data.poses.measurements import Planes
from calib.data.poses.pose_lists import check_against, read_poses, unmeasured, write_poses
from calib.data.schema import Joints
from calib.errors import CalibError, MeasurementError

NAMES = ("a", "b", "c", "d")


@pytest.fixture
def plan():
    return np.random.default_rng(3).uniform(-2, 2, (40, 4)) * [1.0, 0.8, 1.1, 0.6] + [0, 0.5, -0.4, 0.9]


def measured(q, rows=None):
    return Planes(q, ("q1", "q2", "q3", "q4"), file="m.csv", rows=rows)


def test_round_trip(tmp_path, plan):
    kinds = ("prismatic", "revolute", "revolute", "continuous")
    path = write_poses(tmp_path / "poses.csv", plan, NAMES, kinds)
    np.testing.assert_allclose(read_poses(path, Joints(NAMES, kinds)), plan, rtol=1e-11)
    assert path.read_text().splitlines()[0] == "a [mm],b [deg],c [deg],d [deg]"


def test_nothing_is_written_of_a_bad_list(tmp_path, plan):
    plan[3, 2] = np.nan
    with pytest.raises(CalibError, match=r"\(3, 2\) is not finite"):
        write_poses(tmp_path / "poses.csv", plan, NAMES)
    assert not list(tmp_path.iterdir())


def test_one_pose_is_a_list_too(tmp_path):
    path = write_poses(tmp_path / "home.csv", np.zeros((1, 4)), NAMES)
    assert read_poses(path, NAMES).shape == (1, 4)


def test_limits_hold_for_read_lists(tmp_path, plan):
    path = write_poses(tmp_path / "poses.csv", plan, NAMES)
    with pytest.raises(MeasurementError, match="outside the limits -1 to 1 rad of a"):
        read_poses(path, Joints(NAMES, (), [-1] * 4, [1] * 4))


def test_as_planned_in_any_order(plan):
    noise = 1e-4 * np.random.default_rng(0).normal(size=plan.shape)
    assert check_against(plan, measured((plan + noise)[::-1])) == ()


def test_missing_and_extra_poses_are_named(plan):
    q = np.vstack([plan[5:], plan[:1] + 0.5])
    assert check_against(plan, measured(q)) == ("1 rows were not planned: 36",)
    (remain,) = unmeasured(plan, [measured(q)])
    assert remain.startswith("5 of 40 planned poses remain to be measured: 1, 2, 3, 4, 5")
    assert not unmeasured(plan, [measured(q), measured(plan[4::-1])])


def test_targets_of_one_row_count_once(plan):
    """Several targets of one row count once."""
    found = measured(np.repeat(plan[:-1], 3, axis=0), np.repeat(np.arange(1, 40), 3))
    assert check_against(plan, found) == ()
    assert unmeasured(plan, [found])[0].startswith("1 of 40 planned poses remain to be measured: 40 (")


@pytest.mark.parametrize(
    ("spoil", "words", "column"),
    [
        (lambda q: np.rad2deg(q), "the values are degrees", "q1"),
        (lambda q: np.deg2rad(q), "the values are radians converted from degrees", "q1"),
        (lambda q: q[:, [0, 2, 1, 3]], "columns are swapped .q3 contains joint 2, q2 contains joint 3.", "q3"),
        (lambda q: q * [1, 1, -1, 1], "the sign is reversed .q3.", "q1"),
        (lambda q: np.rad2deg(q[:, [0, 2, 1, 3]]), "the values are degrees and columns are swapped", "q3"),
    ],
)
def test_the_cause_is_found(plan, spoil, words, column):
    partly = plan[np.random.default_rng(1).permutation(40)[:33]]
    with pytest.raises(MeasurementError, match=f"agree with the plan if.*{words}") as error:
        check_against(plan, measured(spoil(partly)))
    assert error.value.file == "m.csv" and error.value.column == column


def test_another_plan(plan):
    other = np.random.default_rng(9).uniform(-2, 2, (30, 4))
    with pytest.raises(MeasurementError, match=r"only 0 of 30 rows are planned poses.*right plan.*plan = f") as error:
        check_against(plan, measured(other))
    assert error.value.row is not None
