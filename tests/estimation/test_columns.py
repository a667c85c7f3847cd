"""Which columns are independent: rank, coefficients, order of preference, columns without effect."""

import numpy as np
import pytest

from calib.estimation.base_columns import split_columns


def dependent(seed: int, rows: int = 60, rank: int = 8, p: int = 13) -> np.ndarray:
    """Return (rows, p) of known rank, columns in units that differ by six decades, in random order."""
    rng = np.random.default_rng(seed)
    matrix = rng.normal(size=(rows, rank)) @ np.hstack([np.eye(rank), rng.normal(size=(rank, p - rank))])
    return (matrix * 10.0 ** rng.uniform(-3, 3, p))[:, rng.permutation(p)]


@pytest.mark.parametrize("seed", range(5))
def test_rank_and_coefficients_are_planted(seed):
    """The rank is the planted one, and coefficients reproduce what was dropped."""
    matrix = dependent(seed)
    split = split_columns(matrix)
    assert (
        split.rank == 8 == np.linalg.matrix_rank(matrix[:, split.kept] / np.linalg.norm(matrix[:, split.kept], axis=0))
    )
    assert sorted([*split.kept, *split.dropped]) == list(range(13))
    lost = matrix[:, split.dropped] - matrix[:, split.kept] @ split.coefficients
    assert np.linalg.norm(lost, axis=0) == pytest.approx(0, abs=1e-10 * np.abs(matrix).max())
    assert np.all(np.linalg.norm(lost, axis=0) < 1e-10 * np.linalg.norm(matrix[:, split.dropped], axis=0))
    assert split.gap > 1e8


def test_full_rank_has_an_infinite_gap():
    """Full rank keeps all, and the gap is infinite."""
    split = split_columns(np.random.default_rng(0).normal(size=(30, 6)))
    assert split.rank == 6 and len(split.dropped) == 0 and split.gap == float("inf")


def test_fewer_rows_than_columns():
    split = split_columns(np.random.default_rng(0).normal(size=(4, 9)))
    assert split.rank == 4 and split.coefficients.shape == (4, 5)


@pytest.mark.parametrize("seed", range(10))
def test_later_group_adds_only_the_remainder(seed):
    """A later group adds only what the earlier ones leave."""
    matrix = dependent(seed)
    order = np.random.default_rng(100 + seed).permutation(13)
    groups = [order[:5], order[5:9]]  # the last four are named by none and come last
    kept = split_columns(matrix, groups).kept
    scaled = matrix / np.linalg.norm(matrix, axis=0)
    for stop in (5, 9, 13):
        assert np.isin(kept, order[:stop]).sum() == np.linalg.matrix_rank(scaled[:, order[:stop]], tol=1e-8)


def test_preferred_of_equal_columns_stays():
    """Of two equal columns the preferred one is kept, whichever comes first."""
    rng = np.random.default_rng(1)
    matrix = rng.normal(size=(20, 3))
    matrix = np.column_stack([matrix, 2.0 * matrix[:, 0]])
    assert 3 in split_columns(matrix, [np.array([3]), np.array([0, 1, 2])]).kept
    assert 0 in split_columns(matrix, [np.array([0]), np.array([1, 2, 3])]).kept


@pytest.mark.parametrize("size", [0.0, 1e-17])
def test_a_column_of_rounding_has_no_effect(size):
    rng = np.random.default_rng(2)
    matrix = dependent(3)
    matrix /= np.linalg.norm(matrix, axis=0)
    grown = np.insert(matrix, 5, size * rng.normal(size=60), axis=1)
    split, without = split_columns(grown), split_columns(matrix)
    assert list(split.without_effect) == [5]
    assert 5 in split.dropped
    assert split.rank == without.rank
    assert list(split.kept) == [k + (k >= 5) for k in without.kept]
    assert np.abs(split.coefficients[:, list(split.dropped).index(5)]).max() < 1e-15


def test_units_of_the_columns_do_not_matter():
    matrix = dependent(4)
    factors = 10.0 ** np.random.default_rng(5).uniform(-2, 2, 13)
    single = [np.array([k]) for k in range(13)]  # one by one: at unit norm the first pivot of a group is a tie
    one, other = split_columns(matrix, single), split_columns(matrix * factors, single)
    assert list(one.kept) == list(other.kept)
    regrouped = one.coefficients * factors[one.dropped] / factors[one.kept][:, None]
    assert np.allclose(other.coefficients, regrouped, rtol=1e-8, atol=1e-10 * np.abs(regrouped).max())


def test_tolerance_decides_near_dependence():
    """The tolerance decides on a nearly dependent column."""
    rng = np.random.default_rng(6)
    matrix = rng.normal(size=(50, 4))
    matrix = np.column_stack([matrix, matrix @ rng.normal(size=4) + 1e-4 * rng.normal(size=50)])
    assert split_columns(matrix, tolerance=1e-6).rank == 5
    assert split_columns(matrix, tolerance=1e-2).rank == 4
