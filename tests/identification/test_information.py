"""Information of an identification's data."""

import numpy as np
import planted_motion as planted

from calib.dynamics import drives
from calib.estimation.triangles import combine
from calib.identification.identify import identify
from calib.identification.physical_consistency import information
from calib.identification.settings import IdentificationSettings


def test_information_of_the_data_has_no_prior():
    """The rows alone, with the ridges of additional friction once: a prior would be used twice."""
    stribeck = (drives.term("Fs1", "stribeck", 0, 0.3, 1.0, 0.01),)
    case = planted.case("a", 0, noise=0.2, duration=6.0, terms=stribeck, values={"Fs1": 4.0})
    identification = identify(planted.arm(), [case], IdentificationSettings(essential="none"))
    fitted, b = identification.fitted, identification.base.b
    assert identification.prior is not None and len(identification.names) > b
    factor = information.of(identification, planted.arm()).factor[:, :-1]
    rows = combine(fitted.pooled, fitted.std * np.sqrt(fitted.inflation))[:, :-1]
    ridges = fitted.beforehand[:, b:]
    expected = rows.T @ rows
    expected[b:, b:] += ridges.T @ ridges
    size = np.sqrt(np.diag(expected))
    assert np.allclose(factor.T @ factor / np.outer(size, size), expected / np.outer(size, size), atol=1e-9)
