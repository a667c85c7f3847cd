"""Claims on the search for rows that are paired with the joint values of other rows."""

from dataclasses import replace

import numpy as np
import pytest
from planted import cell, perturb

from calib.data.poses.measurements import Positions, take
from calib.geometry.checks.wrong_rows import MIN_SHIFTED, SHIFTS, _best_first, _CutErrors, _shifted, least_error
from calib.geometry.first_guess import install
from calib.geometry.installation import see
from calib.robot.calibrated import evaluate
from calib.robot.chain import random_joints
from calib.robot.library import load


def measured(count):
    """Return an arm, and positions of a target in another arm's cell."""
    arm = load("ur5")
    truth = cell(perturb(arm, 1, 0.5e-3, 1e-3), 1)
    q = random_joints(arm, count, np.random.default_rng(1))
    seen = see(truth, q, 0, np.zeros(count, dtype=int), evaluate(truth.deflection, q, None))
    return arm, Positions(q, arm.joint_names, seen.point.T, file="measured.csv")


@pytest.mark.parametrize("variant", ["whole", "shifted", "held out", "two tools", "other order"])
def test_best_first_row_as_by_a_fit_for_each(variant):
    """The row from which a shift explains most is the same as by a fit for every row."""
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
        first = np.unique(block.rows)[: -MIN_SHIFTED - abs(shift)]
        errors = [least_error(nominal, [_shifted(block, int(row), shift)])[0] for row in first]
        assert _best_first(nominal, block, shift) == first[np.argmin(errors)]


def test_no_rows_have_no_error():
    """Without a row there is no error to divide by."""
    arm, block = measured(40)
    nominal = install(arm, [block])
    np.testing.assert_array_equal(least_error(nominal, [take(block, np.arange(0))]), [0.0])
    assert _CutErrors.of(nominal, block, -1).at(np.array([0])) >= 0.0
