"""The computed-torque test compares rms torque errors on held-out motion with a tolerance of each joint."""

import numpy as np
import pytest

from calib.errors import UsageError
from calib.identification.prediction import PredictionErrors, RelativeErrors, Score
from calib.procedure.dynamic_stage.computed_torque import torque_tests

ROWS = ("1 sensor", "2 sensor", "1 motor", "2 motor")


def scored(rms: list[float]) -> Score:
    """Return a score with these rms errors."""
    part = PredictionErrors(RelativeErrors(1.0, np.ones(len(rms))), np.array(rms), 100)
    zero = np.zeros(len(rms))
    return Score(part, part, part, part, zero, zero, (None,) * len(rms), 20.0, 1.0)


PROOFS = {"a.csv": scored([0.1, 0.6, 0.3, 0.2]), "b.csv": scored([0.2, 0.4, 0.1, np.nan])}


def test_worst_recording_of_each_row_counts() -> None:
    tests = torque_tests([0.5], PROOFS, ROWS, 2)
    assert [(test.recording, test.rms, test.passed) for test in tests] == [
        ("b.csv", 0.2, True),
        ("a.csv", 0.6, False),
        ("a.csv", 0.3, True),
        ("a.csv", 0.2, True),
    ]


def test_each_joint_has_its_tolerance() -> None:
    """A joint's tolerance applies to its sensor and its motor; zero means no test."""
    tests = torque_tests([0.25, 0.0], PROOFS, ROWS, 2)
    assert [(test.row, test.tolerance, test.passed) for test in tests] == [
        ("1 sensor", 0.25, True),
        ("1 motor", 0.25, False),
    ]


def test_nothing_is_tested_without_tolerance() -> None:
    assert torque_tests([], PROOFS, ROWS, 2) == torque_tests([0.5], {}, ROWS, 2) == []


def test_tolerances_must_match_the_joints() -> None:
    six_rows = tuple(f"{number} motor" for number in range(1, 7))
    with pytest.raises(UsageError, match="3 numbers for 6 joints"):
        torque_tests([1.0, 1.0, 1.0], {"a.csv": scored([0.1] * 6)}, six_rows, 6)
    with pytest.raises(UsageError, match="are not torques of 3 joints"):
        torque_tests([1.0], PROOFS, ROWS, 3)


def test_joint_at_rest_is_not_tested() -> None:
    (test,) = torque_tests([1.0, 0.0], {"a.csv": scored([np.nan, 0.1])}, ("1 motor", "2 motor"), 2)
    assert test.passed is None
