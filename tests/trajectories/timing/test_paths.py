"""Paths: C², through their waypoints, derivatives right, extremes found, bad waypoints named."""

import numpy as np
import pytest
from planned import CHAIN, WAYPOINTS

from calib.trajectories.errors import BadInput
from calib.trajectories.timing.path import check_within, extremes, reversals, spline, through

EVEN = np.linspace(0, 4, 60)


@pytest.mark.parametrize("path", [spline(WAYPOINTS), through(np.sin(EVEN[:, None] + [0, 1]), EVEN)], ids=["C2", "C4"])
def test_derivatives_are_of_differences(path):
    """Derivatives are those of differences, and the second is continuous."""
    h = 1e-5
    s = np.random.default_rng(0).uniform(h, path.length - h, 50)
    for order in (1, 2):
        slope = (path(s + h, order - 1) - path(s - h, order - 1)) / (2 * h)
        np.testing.assert_allclose(path(s, order), slope, atol=1e-5)
    inner = path.knots[1:-1]
    np.testing.assert_allclose(path(inner - 1e-9, 2), path(inner + 1e-9, 2), atol=1e-5)


def test_spline_meets_its_waypoints():
    """A spline meets its waypoints, and two make a straight line."""
    path = spline(WAYPOINTS)
    np.testing.assert_allclose(path(path.knots), WAYPOINTS, atol=1e-12)
    np.testing.assert_allclose(np.diff(path.knots), np.linalg.norm(np.diff(WAYPOINTS, axis=0), axis=1))
    line = spline(WAYPOINTS[:2])
    np.testing.assert_allclose(line(np.linspace(0, line.length, 9), 2), 0.0, atol=1e-12)
    assert np.linalg.norm(line(np.array([0.3]), 1)) == pytest.approx(1.0)


def test_extremes_have_zero_slope():
    """Extremes lie where the slope is zero."""
    path = spline(np.array([[0.0, 1.0], [1.0, -1.0], [0.2, 0.7]]))
    s = np.linspace(0, path.length, 200001)
    _, values = extremes(path)
    np.testing.assert_allclose(values, [path(s).min(axis=0), path(s).max(axis=0)], atol=1e-9)
    turns = reversals(path, s[::1000])
    assert len(turns) and np.abs(path(turns, 1)).min(axis=1).max() < 1e-9


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (WAYPOINTS[:1], "1 waypoint"),
        (WAYPOINTS[[0, 1, 1, 2]], "waypoints 2 and 3 are the same"),
        (np.where(WAYPOINTS == 0.3, np.nan, WAYPOINTS), "waypoint 2, joint 3 is not a number"),
        (np.zeros(7), "expected an"),
    ],
)
def test_bad_waypoints_are_named(points, message):
    with pytest.raises(BadInput, match=message):
        spline(points)


def test_swings_beyond_limits_are_named():
    """Waypoints and swings beyond the limits are named."""
    lower, upper = CHAIN.lower, CHAIN.upper
    out = WAYPOINTS.copy()
    out[1, 3] = -2.2
    with pytest.raises(BadInput, match=r"waypoint 2: joint 4 at -2.2 is 0.10\d beyond"):
        check_within(spline(out), lower, upper, out)
    swinging = np.zeros((4, 7))
    swinging[:, 0] = [0.0, 2.96, 2.96, 0.0]
    swinging[:, 1] = [0.0, 0.0, 0.5, 0.5]
    with pytest.raises(BadInput, match=r"overshoots between waypoints 2 and 3 to .* joint 1"):
        check_within(spline(swinging), lower, upper, swinging)
    margin = check_within(spline(WAYPOINTS), lower, upper, WAYPOINTS)
    assert (margin > 0).all()
