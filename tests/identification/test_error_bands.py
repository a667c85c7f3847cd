"""Densities of torque errors in wider bands: white errors keep theirs, blue errors grow, slow errors keep theirs."""

from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from calib.data.recordings.recording import Recording
from calib.data.signals.filtering import design_decimator, kept
from calib.data.signals.motion import FilterOptions, make_motion
from calib.identification.rows import ObservationRows, make_case
from calib.identification.uncertainty.error_bands import ErrorBands, error_bands

RATE = 500.0
FACTOR = 20
COUNT = 12_000


def _bands(errors: np.ndarray, standing: bool = False) -> ErrorBands | None:
    """Return the densities of errors (COUNT, rows) of a swinging arm, whose rows are decimated by FACTOR."""
    t = np.arange(len(errors)) / RATE
    q = 0.5 * np.sin(2.0 * np.pi * 0.5 * t)[:, None] * np.ones(errors.shape[1])
    names = tuple(f"joint_{row + 1}" for row in range(errors.shape[1]))
    motion = make_motion(Recording(t, q, errors, "torque", names), FilterOptions(cutoff=30.0, band=10.0))
    case = make_case("log", motion)
    decimator = design_decimator(RATE, FACTOR)
    stands = np.full((len(kept(motion.segment, decimator)), errors.shape[1]), float(standing))
    rows = cast(ObservationRows, SimpleNamespace(target=np.zeros_like(stands), standing=stands))
    return error_bands([case], {"log": np.zeros_like(case.target)}, [rows], decimator)


def test_densities_follow_the_colour_of_the_errors():
    rng = np.random.default_rng(0)
    white = rng.normal(size=COUNT + 1)
    slow = np.convolve(rng.normal(size=COUNT + 49), np.ones(50), "valid")
    bands = _bands(np.column_stack([white[1:], np.diff(white), slow]))
    assert bands is not None
    assert bands.rows_per_second[0] == RATE / FACTOR
    assert bands.rows_per_second[-1] == RATE
    # but for the ends that the filters take
    assert 0.95 * COUNT / RATE < bands.seconds <= COUNT / RATE
    assert bands.density[0] == pytest.approx(1.0)
    white_factor, blue_factor, slow_factor = bands.factor(4.0 * RATE / FACTOR)
    assert white_factor == pytest.approx(1.0, abs=0.2)
    # the density of differences grows with the square of the frequency
    assert blue_factor == pytest.approx(16.0, rel=0.25)
    assert 0.5 < slow_factor < 2.0


def test_a_narrower_band_changes_nothing():
    bands = ErrorBands(np.array([10.0, 40.0]), np.array([[1.0, 1.0], [1.0, 4.0]]), seconds=20.0)
    assert bands.factor(2.0) == pytest.approx([1.0, 1.0])
    assert bands.factor(20.0) == pytest.approx([1.0, 2.0])
    assert bands.factor(1e3) == pytest.approx([1.0, 4.0])


def test_a_row_without_errors_keeps_its_density():
    blue = np.diff(np.random.default_rng(0).normal(size=COUNT + 1))
    bands = _bands(np.column_stack([blue, np.zeros(COUNT)]))
    assert bands is not None
    blue_factor, quiet_factor = bands.factor(4.0 * RATE / FACTOR)
    assert blue_factor > 10.0 and quiet_factor == 1.0


def test_without_errors_in_motion_nothing_is_stated():
    assert _bands(np.random.default_rng(0).normal(size=(4000, 1)), standing=True) is None
