"""Errors above the identification band, where the motion explains nothing, do not count against a model."""

from dataclasses import replace

import numpy as np
import planted_motion as planted
import pytest

from calib.identification.prediction import PASSING_SHARE, Score, score
from calib.procedure.findings import limit


def scored(noise: float, scale: float = 1.0, band: float = 10.0) -> Score:
    """Return the score of the true torques, times `scale`, on a recording with white torque noise [N m]."""
    case = planted.case("log", 0, noise=noise, band=band)
    motion = case.motion
    return score(case, scale * planted.torques(motion.q, motion.v, motion.a))


def test_noise_above_the_band_does_not_count() -> None:
    """The true model leaves half of a noisy torque unexplained, and is judged by what it leaves in the band."""
    result = scored(noise=5.0)
    assert result.raw.total > 30.0
    assert result.noisy and result.judged.total < result.raw.total / 2.0
    assert result.judged.total == result.filtered.total
    assert result.band == 10.0 and result.above_band == f"{result.raw.total:.2f} %"
    assert np.hypot(result.filtered.total, result.floor_percent) == pytest.approx(result.raw.total, rel=0.02)


def test_wrong_model_fails_in_the_band_too() -> None:
    """A model whose torques are a third too small is judged so in the noise, too."""
    right, wrong = scored(noise=5.0), scored(noise=5.0, scale=0.67)
    assert wrong.judged.total > 30.0 > 2.0 * right.judged.total


def test_quiet_recordings_are_judged_whole() -> None:
    result = scored(noise=0.5)
    assert not result.noisy and result.judged.total == result.raw.total and result.above_band == ""


def test_noise_that_passes_does_not_matter() -> None:
    """A raw error that passes is stated as it is, whatever its frequencies; the limit is that of the catalogue."""
    result = scored(noise=0.9)
    assert 2.0 * result.floor_percent**2 > result.raw.total**2 and result.raw.total < PASSING_SHARE
    assert not result.noisy and result.judged.total == result.raw.total
    assert limit("torque-unexplained", "share", "marginal") == PASSING_SHARE


def test_band_below_the_motion_is_no_excuse() -> None:
    """Where the model itself predicts torque above the band, a wrong model is judged by all of its error."""
    result = scored(noise=0.5, scale=0.5, band=0.4)
    assert result.floor_percent == 0.0 and result.judged.total == result.raw.total > 40.0


def test_earlier_scores_are_judged_as_then() -> None:
    """Scores of earlier versions state no floor."""
    result = replace(scored(noise=5.0), floor_percent=0.0, moving_in_band=None, band=np.nan)
    assert result.judged.total == result.raw.total
