"""Filters do not shift, derivatives are derivatives, and decimation commutes with the model."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.signal

from calib.data.signals.filtering import (
    KINDS,
    border,
    curvature,
    decimate,
    decimate_blocks,
    design_decimator,
    factor_for,
    kept,
    low_pass,
    slope,
)
from calib.errors import CalibError, MeasurementError

RATE = 1000.0


def sine(f: float, n: int = 4000, phase: float = 0.3) -> np.ndarray:
    return np.sin(2 * np.pi * f * np.arange(n) / RATE + phase)


@pytest.mark.parametrize("f", [0.5, 3.0, 10.0])
def test_sine_in_band_passes_without_shift(f):
    """A sine in the band passes without shift."""
    x = sine(f)
    gain = 1 / (1 + (f / 50.0) ** 8)
    inner = slice(border(RATE, 50.0), -border(RATE, 50.0))
    np.testing.assert_allclose(low_pass(x, RATE, 50.0)[inner], gain * x[inner], atol=1e-4)


def test_the_gain_at_the_cutoff_is_one_half():
    x = sine(50.0)
    np.testing.assert_allclose(low_pass(x, RATE, 50.0)[1000:3000], x[1000:3000] / 2, atol=1e-4)


@pytest.mark.parametrize("cutoff", [500.0, 800.0, 0.0, -1.0])
def test_a_cutoff_beyond_nyquist_is_refused(cutoff):
    with pytest.raises(MeasurementError, match="Nyquist frequency 500 Hz"):
        low_pass(sine(1.0), RATE, cutoff)


@pytest.mark.parametrize(
    ("width", "first", "second"), [(1, 1 / 6, 1 / 12), (2, 1 / 30, 1 / 90), (4, 1 / 630, 1 / 3150)]
)
def test_central_differences_state_error(width, first, second):
    """Central differences have the error they state."""
    f = 40.0
    w = 2 * np.pi * f / RATE  # ω Δ
    x, inner = sine(f), slice(width, -width)
    exact = 2 * np.pi * f * np.cos(2 * np.pi * f * np.arange(4000) / RATE + 0.3)
    error = np.abs(slope(x, RATE, width) - exact)[inner].max() / (2 * np.pi * f)
    assert error == pytest.approx(first * w ** (2 * width), rel=0.1)
    error = np.abs(curvature(x, RATE, width) + (2 * np.pi * f) ** 2 * x)[inner].max() / (2 * np.pi * f) ** 2
    assert error == pytest.approx(second * w ** (2 * width), rel=0.1)


def test_ends_without_neighbours_are_nan():
    """Ends without neighbours are not numbers."""
    x = slope(sine(3.0)[:, None], RATE, 3)
    assert np.isnan(x[:3]).all() and np.isnan(x[-3:]).all() and np.isfinite(x[3:-3]).all()
    assert np.isnan(curvature(np.ones(5), RATE, 3)).all()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("factor", [1, 2, 7])
def test_decimation_commutes_with_the_model(kind, factor):
    random = np.random.default_rng(factor)
    w, x = random.normal(size=(2000, 3, 5)), random.normal(size=5)
    decimator = design_decimator(RATE, factor, kind)
    y = decimate(w @ x, decimator)
    np.testing.assert_allclose(y, decimate(w, decimator) @ x, atol=1e-12)
    assert len(y) == len(kept(np.zeros(2000, dtype=int), decimator)) > 0


@pytest.mark.parametrize("kind", KINDS)
def test_decimation_keeps_band_stops_aliases(kind):
    """Decimation keeps the band and stops what would fold into it."""
    decimator = design_decimator(RATE, 10, kind)
    index = kept(np.zeros(6000, dtype=int), decimator)
    assert decimator.band == 40.0 and set(np.diff(index)) == {10}
    low, folding = sine(20.0, 6000), sine(62.0, 6000)  # 62 Hz would come back as 38 Hz
    np.testing.assert_allclose(decimate(low, decimator), low[index], atol=1e-2)
    assert np.abs(decimate(folding, decimator)).max() < 2e-3
    np.testing.assert_allclose(decimate(np.ones(6000), decimator), 1.0, atol=1e-12)


def test_the_chebyshev_decimator_is_scipys():
    from scipy.signal import cheby1, sosfiltfilt

    x = np.random.default_rng(3).normal(size=8000)
    decimator = design_decimator(RATE, 5, "chebyshev")
    both = sosfiltfilt(cheby1(8, 0.05, 0.8 / 5, output="sos"), x) / 10 ** (-2 * 0.05 / 20)  # its ripple at 0 taken off
    own = decimate(x, decimator)
    assert np.abs(own - both[kept(np.zeros(8000, dtype=int), decimator)]).max() < 2e-3


@pytest.mark.parametrize("block", [1, 3, 50, 997, 5000])
def test_blocks_give_what_the_whole_gives(block):
    x = np.random.default_rng(4).normal(size=(3001, 2, 3))
    decimator = design_decimator(RATE, 8)
    blocks = (np.moveaxis(x[i : i + block], 0, -1) for i in range(0, len(x), block))
    joined = np.moveaxis(np.concatenate(list(decimate_blocks(blocks, decimator)), axis=-1), -1, 0)
    whole = np.apply_along_axis(np.convolve, 0, x, decimator.taps, "same")[kept(np.zeros(len(x), int), decimator)]
    np.testing.assert_allclose(joined, whole, atol=1e-13)
    np.testing.assert_allclose(decimate(x, decimator), whole, atol=1e-13)


@pytest.mark.parametrize(("factor", "sparse"), [(8, 5), (3, 40), (2, 19)])
def test_every_kth_row_has_same_band(factor, sparse):
    """The same band, of every k-th row alone."""
    x = np.random.default_rng(5).normal(size=2000)
    decimator = design_decimator(RATE, factor)
    few = replace(decimator, factor=sparse * factor)
    np.testing.assert_allclose(decimate(x, few), decimate(x, decimator)[::sparse], atol=1e-14)


def test_segments_do_not_mix():
    """Segments do not mix and are decimated in blocks."""
    whole, segment = np.random.default_rng(5).normal(size=(1500, 2, 3)), np.repeat([0, 1], [700, 800])
    decimator = design_decimator(RATE, 6)
    w = decimate(whole, decimator, segment)
    for own in (whole[:700], whole[700:]):
        np.testing.assert_allclose(w[: len(first := decimate(own, decimator))], first, atol=1e-12)
        blocks = (np.moveaxis(own[i : i + 128], 0, -1) for i in range(0, len(own), 128))
        joined = np.concatenate(list(decimate_blocks(blocks, decimator)), axis=-1)
        np.testing.assert_allclose(np.moveaxis(joined, -1, 0), first, atol=1e-12)
        w = w[len(first) :]
    index, reach = kept(segment, decimator), decimator.reach
    assert not len(w) and (segment[index - reach] == segment[index + reach]).all()


def test_factors_follow_gautiers_formula():
    assert factor_for(5000.0, 20.0) == 100  # the TX40's: 2π 0.8 f_m / (2 n_d)
    assert factor_for(100.0, 45.0) == 1
    with pytest.raises(CalibError, match="decimation by 0"):
        design_decimator(RATE, 0)


@pytest.mark.parametrize("factor", [2, 7, 12])
def test_the_kaiser_decimator_is_scipys(factor):
    taps = scipy.signal.firwin(18 * factor + 1, 1 / factor, window=("kaiser", scipy.signal.kaiser_beta(60.0)))
    assert design_decimator(1000.0, factor).taps == pytest.approx(taps / taps.sum(), abs=1e-15)
