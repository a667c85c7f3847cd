"""Robots that cannot be: refused where a chain is made, whatever file they come from."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib.errors import RobotError
from calib.robot.chain import Joint
from calib.robot.load import load


@pytest.mark.parametrize("change", [{"velocity": -1.0}, {"effort": -5.0}, {"velocity": np.nan}])
def test_limits_below_zero_are_none(change):
    with pytest.raises(RobotError, match="is no limit"):
        Joint("a", **change)


@pytest.mark.parametrize(
    "change, said",
    [
        ({"gravity": np.array([0.0, 0.0, 1e300])}, "gravity"),
        ({"gravity": np.array([0.0, np.nan, 0.0])}, "gravity"),
        ({"tail": np.full((4, 4), np.inf)}, "tail"),
        ({"inertias": np.full((6, 10), np.inf)}, "inertias"),
    ],
)
def test_what_is_not_finite_is_refused(change, said):
    with pytest.raises(RobotError, match=said):
        replace(load("ur5"), **change)
