"""Where errors are larger is found from their squares alone, and what was not learnt is expected to be worse."""

import numpy as np

from calib.geometry.left_out import Unevenness, unevenness


def drawn(loud: float, count: int = 300) -> tuple[np.ndarray, np.ndarray]:
    """Return poses of two joints and a still one, and squared errors: `loud`² times as large beyond 1 rad of one."""
    rng = np.random.default_rng(4)
    q = np.column_stack([rng.uniform(-2.0, 2.0, (count, 2)), np.full(count, 0.3)])
    return q, np.where(q[:, 0] > 1.0, loud**2, 1.0) * rng.chisquare(3, count) / 3.0


def test_it_finds_the_joint_and_the_end_where_errors_are_ten_times_larger():
    q, squares = drawn(10.0)
    profile = Unevenness(q, squares).profile()
    s = unevenness(profile, np.array([[-1.0, 0.0, 0.3], [1.6, 0.0, 0.3]]))
    assert 40.0 < s[1] / s[0] < 250.0
    assert profile[1] == profile[2] == ((0.0,), (0.0,))


def test_even_errors_have_no_profile():
    q, squares = drawn(1.0)
    assert np.allclose(unevenness(Unevenness(q, squares).profile(), q), 1.0, atol=0.25)


def test_copies_of_few_poses_tell_nothing_impossible():
    q, squares = drawn(10.0)
    few = np.arange(40) % 4
    profile = Unevenness(q[few], squares[few]).profile(np.arange(40) < 8)
    assert np.isfinite(unevenness(profile, q)).all()
    assert np.allclose(unevenness(Unevenness(q, np.ones(len(q))).profile(), q), 1.0, atol=0.01)


def test_without_the_poses_of_an_end_more_is_expected_there_than_in_the_middle():
    """The loud end is not known then; that the joint is uneven is (its other end is loud, too)."""
    q, squares = drawn(1.0)
    squares = squares * np.where(np.abs(q[:, 0]) > 1.0, 25.0, 1.0)
    left_out = q[:, 0] > 1.0
    profile = Unevenness(q, squares).profile(left_out)
    s = unevenness(profile, np.array([[0.0, 0.0, 0.3], [1.8, 0.0, 0.3]]))
    assert s[1] > 2.0 * s[0]
