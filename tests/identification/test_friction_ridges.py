"""Ridges of richer friction: one per group, of parameters whose columns differ in size."""

import numpy as np
import pytest

from calib.estimation.triangles import absorb, empty
from calib.identification.time_folds import estimate

SEEN, SHARE = 2.0, 0.3  # the parameter that the motion shows, and of the noise, what looks like the other column
HARDLY = 1e-6


def values(units: tuple[str, str]) -> np.ndarray:
    """Return the estimate where the noise looks like a column that the motion shows a million times less."""
    rng = np.random.default_rng(0)
    first, second, white = rng.standard_normal((3, 400))
    data = absorb(
        empty(("Fs1", "Fs1.2"), units),
        np.stack([first, HARDLY * second], axis=1),
        SEEN * first + SHARE * second + white,
    )
    return estimate(data, np.ones(1), np.ones(1), np.zeros(2, dtype=int))[0]


def test_hardly_shown_terms_do_not_grow():
    """What the motion hardly shows is not the larger for it."""
    seen, hardly = values(("N*m", "N*m"))
    assert seen == pytest.approx(SEEN, abs=0.2) and abs(hardly) < 10.0 * SEEN


def test_other_units_have_their_own_size():
    """A parameter of another unit has a size of its own."""
    assert values(("N*m", "N*m*s/rad"))[1] * HARDLY == pytest.approx(SHARE, abs=0.15)
