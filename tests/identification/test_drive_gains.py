"""Gains relative to one joint: which the currents tell, and what stands for those that they do not."""

import numpy as np
import pytest

from calib.errors import NotConverged
from calib.identification import gains
from calib.identification.gains import DriveGains, GainRecord
from calib.records import plain


def found(values: list[float], sigma: list[float], own: tuple[int, ...] = ()) -> DriveGains:
    n = len(values)
    return DriveGains(np.array(values), np.diag(np.square(sigma)), (), np.zeros(0), np.ones(n), "", own)


def test_a_gain_that_is_not_told_is_empty():
    table = plain(GainRecord.of(found([1.2, 1.0, 1.0], [0.1, 1e-16, 0.0], (2,)), "A of joint 2"))
    assert (table["values"], table["told"]) == ([1.2, 1.0, None], ["told", "reference", "not told"])
    assert table["sigma"] == [pytest.approx(0.1), None, None]


def test_only_the_runaway_gain_is_withheld(monkeypatch):
    """A gain that runs away is not told, and the others are."""

    def identify(data, known, inflation, start=None, reference=None, own=()):
        if 2 not in own:
            raise NotConverged("the gains do not settle", np.array([1.1, 1.0, 9e4]))
        return found([1.1, 1.0, 1.0], [0.01, 0.0, 0.0], tuple(own))

    class Pieces:
        groups, rows = 9, np.ones(9)

    monkeypatch.setattr(gains, "identify_gains", identify)
    monkeypatch.setattr(gains, "pool", lambda data, joints, blocks: data)
    told = gains.identify_relative_gains(Pieces(), 3, np.ones(3), 1)
    assert told.own == (2,) and told.told == ("told", "reference", "not told")
    np.testing.assert_allclose(told.sigma, [0.01 * gains.LEFT, 0.0, 0.0])
