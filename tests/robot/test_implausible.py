"""Robots that cannot be: refused where a chain is made, whatever file they come from."""

from dataclasses import replace

import numpy as np
import pytest

from calib.errors import RobotError
from calib.robot.chain import Joint
from calib.robot.description import impossible_bodies, remarks
from calib.robot.library import load


@pytest.mark.parametrize("change", [{"velocity": -1.0}, {"effort": -5.0}, {"velocity": np.nan}])
def test_limits_below_zero_are_none(change):
    with pytest.raises(RobotError, match="expected 0 or more"):
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


def _links(**change: float):
    """Return the LWR4+ with the fourth body's parameters changed: their names' values, or times what is given."""
    chain = load("lwr4plus")
    bodies = np.array(chain.inertias)
    names = ("XX", "XY", "XZ", "YY", "YZ", "ZZ", "MX", "MY", "MZ", "M")
    for name, value in change.items():
        bodies[3, names.index(name)] = value
    return replace(chain, inertias=bodies)


@pytest.mark.parametrize("name", ["lwr4plus", "tx40", "rv2sq"])
def test_bodies_of_sound_robots_are_possible(name):
    assert remarks(load(name)) == ()


@pytest.mark.parametrize(
    "change, said",
    [
        ({"M": 0.0}, "no mass"),
        ({"M": -2.0}, "negative mass"),
        ({"M": 2000.0}, "bodies weigh"),
        ({"MX": 100.0}, "centre of mass beyond the arm"),
        ({"XX": 1e4}, "radius of gyration"),
        ({"ZZ": -0.1}, "negative moment"),
        ({"XX": 0.3}, "an impossible inertia"),
    ],
)
def test_impossible_bodies_are_named(change, said):
    (found,) = impossible_bodies(_links(**change))
    assert said in found


@pytest.mark.parametrize(
    ("limits", "words"),
    [
        ({"velocity": 0.0}, "a: velocity 0 in the robot's description is not a limit; ignored"),
        ({"lower": -360.0, "upper": 360.0}, "a: limits up to 360 rad in the robot's description; are they degrees?"),
    ],
)
def test_limits_of_zero_or_turns_are_remarks(limits, words):
    """Limits of zero or of many turns are remarks."""
    chain = load("ur5")
    joint = Joint("a", **limits)
    assert joint.velocity == np.inf and remarks(replace(chain, joints=(joint, *chain.joints[1:]))) == (words,)
