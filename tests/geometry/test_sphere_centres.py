"""Centres of a ball bar's groups are the least-squares ones, all fitted together."""

import numpy as np
import pytest
from scipy.optimize import least_squares

from calib.geometry.residuals import sphere_centres


@pytest.mark.parametrize("noise", [0.0, 1e-4, 0.01])
def test_centres_of_groups_of_any_size_are_those_of_a_general_solver(noise):
    random = np.random.default_rng(3)
    groups, lengths, expected = [], [], []
    for size in (5, 30, 7, 12):
        centre = random.normal(size=3)
        direction = random.normal(size=(3, size))
        direction /= np.linalg.norm(direction, axis=0)
        length = random.uniform(0.3, 0.8, size)
        points = centre[:, None] + direction * length + noise * random.normal(size=(3, size))
        groups.append(points)
        lengths.append(length)

        def residual(c, points=points, length=length):
            return length - np.linalg.norm(points - c[:, None], axis=0)

        expected.append(least_squares(residual, centre, xtol=1e-15, ftol=1e-15, gtol=1e-15).x)
    assert np.allclose(sphere_centres(groups, lengths), expected, atol=1e-7)


def test_a_group_without_any_direction_leaves_the_others_as_they_are():
    """All its points are in the centre."""
    random = np.random.default_rng(0)
    direction = random.normal(size=(3, 6))
    sphere = np.array([[0.5], [0.1], [0.2]]) + 0.3 * direction / np.linalg.norm(direction, axis=0)
    centres = sphere_centres([np.zeros((3, 4)), sphere], [np.zeros(4), np.full(6, 0.3)])
    assert np.allclose(centres, [[0.0, 0.0, 0.0], [0.5, 0.1, 0.2]], atol=1e-12)


def test_a_direction_that_lengths_do_not_determine_does_not_move_the_centre():
    """Points on a line determine no side: the centre stays on the line, at its best place there."""
    points = np.zeros((3, 10))
    points[0] = np.linspace(0.1, 1.0, 10)
    lengths = np.hypot(points[0] - 0.4, 0.3)
    (centre,) = sphere_centres([points], [lengths])
    on_line = np.linspace(-1.0, 2.0, 3001)
    squares = np.sum((np.abs(points[0] - on_line[:, None]) - lengths) ** 2, axis=1)
    assert np.abs(centre[1:]).max() < 1e-9
    assert centre[0] == pytest.approx(on_line[np.argmin(squares)], abs=1e-3)
