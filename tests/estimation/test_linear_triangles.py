"""Triangles carry all of the data: block by block, merged, selected and reweighted they equal the whole matrix."""

import numpy as np
import pytest
from linear_problems import noisy

from calib.errors import CalibError
from calib.estimation.linear import wls
from calib.estimation.triangles import absorb, collect, combine, empty

STD = np.array([0.1, 1.0, 5.0])


def gram(data, std=None):
    factor = combine(data, std)
    return factor.T @ factor


@pytest.mark.parametrize("size", [1, 7, 100, 600])
def test_blocks_of_any_size_equal_the_whole(size):
    matrix, target, group = noisy(0, STD)
    data = empty(["a", "b", "c", "d", "e"], groups=3)
    for start in range(0, 600, size):
        stop = start + size
        data = absorb(data, matrix[start:stop], target[start:stop], group[start:stop])
    whole = np.column_stack([matrix, target]) / STD[group][:, None]
    assert gram(data, STD) == pytest.approx(whole.T @ whole, rel=1e-11)
    assert data.rows.tolist() == [200, 200, 200]
    direct = wls(collect(matrix, target, group), STD).estimate
    blocks = wls(data, STD).estimate
    assert blocks.values == pytest.approx(direct.values, rel=1e-11)
    assert blocks.covariance == pytest.approx(direct.covariance, rel=1e-10)


def test_factors_are_upper_triangular():
    """Factors are upper triangular even where a group misses columns."""
    matrix, target, group = noisy(1, STD)
    matrix[group == 1, 2:4] = 0.0
    for factor in collect(matrix, target, group).factors:
        assert np.array_equal(factor, np.triu(factor))


def test_chunks_of_rows_equal_the_whole():
    """More rows than one chunk equal the whole."""
    rng = np.random.default_rng(2)
    matrix, target = rng.normal(size=(45_000, 3)), rng.normal(size=45_000)
    whole = np.column_stack([matrix, target])
    assert gram(collect(matrix, target)) == pytest.approx(whole.T @ whole, rel=1e-11, abs=1e-8)


def test_selected_columns_equal_their_model():
    """Selected columns equal a model without the others."""
    matrix, target, group = noisy(4, STD)
    chosen = collect(matrix, target, group, names=list("abcde")).select(np.array([4, 0, 2]))
    assert chosen.names == ("e", "a", "c")
    assert gram(chosen, STD) == pytest.approx(gram(collect(matrix[:, [4, 0, 2]], target, group), STD), rel=1e-11)


def test_triangles_hold_residuals_by_group():
    """Residuals of every group are read from the triangles."""
    matrix, target, group = noisy(5, STD)
    x = np.array([1.0, -2.0, 0.0, 0.5, 9.0])
    squares = collect(matrix, target, group).residual_squares(x)
    assert squares == pytest.approx([np.sum((target - matrix @ x)[group == g] ** 2) for g in range(3)], rel=1e-11)


def test_absorbed_block_leaves_earlier_value():
    """An absorbed block leaves the value before it as it was."""
    matrix, target, _ = noisy(6, STD)
    before = collect(matrix[:300], target[:300])
    kept = before.factors.copy()
    absorb(before, matrix[300:], target[300:])
    assert np.array_equal(before.factors, kept)
    with pytest.raises(ValueError):
        before.factors[0, 0, 0] = 1.0


def test_wrong_group_or_units_are_refused():
    """A group out of range and units that do not fit are refused."""
    matrix, target, _ = noisy(7, STD)
    with pytest.raises(CalibError, match="1 groups"):
        absorb(empty(list("abcde")), matrix, target, 3)
    with pytest.raises(CalibError, match="5 parameter names but 1 units"):
        empty(list("abcde"), ["kg"])
