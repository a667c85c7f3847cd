"""The prior whose sizes the evidence tells: rich motion does not feel it, poor motion is held by it."""

from dataclasses import replace

import numpy as np
import planted_motion as planted
import pytest

from calib.errors import UsageError
from calib.identification.identify import identify
from calib.identification.prediction import predict
from calib.identification.settings import IdentificationSettings

PLAIN = IdentificationSettings(friction="standard", essential="none")


def error(found, case) -> float:
    rest = predict(found.dynamics, case) - case.target
    return float(np.linalg.norm(rest) / np.linalg.norm(case.target))


def test_rich_motion_does_not_feel_the_prior():
    case = planted.case("a", 0, noise=0.02)
    drawn, bare = (identify(planted.arm(), [case], replace(PLAIN, prior=one)) for one in ("auto", "none"))
    sigma = bare.fitted.estimate.sigma
    told = drawn.prior is not None and sigma < 0.3 * drawn.prior.deviation
    assert np.sum(told) > 10
    away = (drawn.fitted.estimate.values - bare.fitted.estimate.values) / sigma
    assert np.abs(away[told]).max() < 1.0


def test_a_second_of_motion_is_held_by_it():
    short, other = planted.case("a", 0, noise=0.2, duration=2.0), planted.case("b", 7, noise=0.0)
    arm = planted.arm()
    blind = replace(arm, inertias=None)
    drawn, bare = (error(identify(blind, [short], replace(PLAIN, prior=one)), other) for one in ("auto", "none"))
    assert drawn < bare and drawn < 0.3


def test_requested_cad_has_to_be_there():
    """A CAD that is asked for has to be there."""
    blind = replace(planted.arm(), inertias=None)
    with pytest.raises(UsageError, match="no masses"):
        identify(blind, [planted.case("a", 0)], replace(PLAIN, prior="cad"))
