"""Claims on the observability indices."""

import library_arm
import numpy as np
import pytest

from calib.poses.errors import BadInput
from calib.poses.indices import gradient, observability

INDICES = ("O1", "O2", "O3", "O4", "O5", "cond")


@pytest.fixture
def W():
    return np.random.default_rng(3).normal(size=(5, 3, 6))


def test_formulas_by_hand():
    W = np.diag([4.0, 2.0, 1.0])[None]
    expected = {"O1": 2.0, "O2": 0.25, "O3": 1.0, "O4": 0.25, "O5": 1 / 1.75, "cond": 4.0}
    for index, value in expected.items():
        assert observability(W, index) == pytest.approx(value, rel=1e-13)
    assert observability(W[0], "O1", m=4) == pytest.approx(1.0)


@pytest.mark.parametrize("index", INDICES)
def test_gradient_is_the_central_difference(W, index):
    value, slope = gradient(W, index)
    assert value == pytest.approx(observability(W, index), rel=1e-13)
    for direction in np.random.default_rng(4).normal(size=(5, *W.shape)):
        step = 1e-6 * direction
        difference = (observability(W + step, index) - observability(W - step, index)) / 2e-6
        assert (slope * direction).sum() == pytest.approx(difference, rel=1e-6, abs=1e-8)


def test_only_o1_ignores_units():
    """Only O1 ranks sets alike in other units."""
    sets = library_arm.jacobian(library_arm.random_poses(40 * 17, 5)).reshape(40, 17, 6, -1)
    scale = 10.0 ** np.random.default_rng(6).uniform(-2, 2, sets.shape[-1])
    orders = {i: [np.argsort([observability(W * c, i) for W in sets]) for c in (1.0, scale)] for i in INDICES}
    assert (orders["O1"][0] == orders["O1"][1]).all()
    for index in INDICES[1:]:
        assert (orders[index][0] != orders[index][1]).any(), index


def test_rank_deficient_sets_are_worthless(W):
    for index in INDICES:
        worth = observability(W[:1], index)
        assert worth == (np.inf if index == "cond" else 0.0)
        assert (observability(W, index) < worth) == (index == "cond")


def test_bad_input_is_named(W):
    with pytest.raises(BadInput, match="O7"):
        observability(W, "O7")  # pyright: ignore
    with pytest.raises(BadInput, match="number of poses"):
        observability(W.reshape(15, 6))
    W[2, 1, 0] = np.nan
    with pytest.raises(BadInput, match="not finite"):
        observability(W)
