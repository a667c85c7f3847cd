"""Claim: a further kind of measurement is a type and one residual function; the fit and its errors follow."""

from dataclasses import KW_ONLY, dataclass, replace
from typing import ClassVar

import numpy as np
import planted
import pytest

from calib.data.poses.measurements import PoseMeasurements, take
from calib.errors import MeasurementError
from calib.geometry.accuracy import errors
from calib.geometry.fit import fit
from calib.geometry.installation import Installation, Seen, see
from calib.geometry.observation import layout
from calib.geometry.residuals import ResidualPart, parts
from calib.robot.chain import random_joints
from calib.robot.library import load


@dataclass(frozen=True, eq=False)
class Heights(PoseMeasurements):
    """Height of p over the station's xy plane: what a dial gauge on a surface plate reads."""

    height: np.ndarray
    _: KW_ONLY
    sigma: np.ndarray | None = None

    kind: ClassVar[str] = "height"
    has_instrument: ClassVar[bool] = True


@parts.register
def _heights(measured: Heights, seen: Seen, jacobian: np.ndarray) -> list[ResidualPart]:
    value = measured.height[None] - seen.point[2:]
    sigma = None if measured.sigma is None else measured.sigma[None]
    return [ResidualPart("distance", value, jacobian[:, 2:3], sigma, 0, np.arange(len(measured)))]


@dataclass(frozen=True, eq=False)
class Unheard(PoseMeasurements):
    """A kind that no residual function is registered for."""

    kind: ClassVar[str] = "unheard"


def heights(truth: Installation, count: int, seed: int) -> Heights:
    q = random_joints(truth.chain, count, seed)
    noise = 1e-5 * np.random.default_rng(seed).normal(size=count)
    return Heights(q, truth.chain.joint_names, see(truth, q).point[2] + noise, sigma=np.full(count, 1e-5))


def test_dial_gauge_is_fitted_like_any_kind():
    """A dial gauge is fitted like any other kind."""
    nominal = load("ur5")
    truth = planted.cell(planted.perturb(nominal, 2), 2)
    start = replace(truth, chain=nominal)
    table = layout(start)
    candidates = np.setdiff1d(np.arange(len(table.names)), table.frame_index)
    found = fit(start, [heights(truth, 300, 0)], candidates)
    unseen = heights(truth, 100, 1)
    before, after = (float(np.sqrt(np.mean(errors(cell, [unseen]).main ** 2))) for cell in (start, found.cell))
    assert before > 1e-3 and after < 2e-5
    assert found.estimate.residual_std == pytest.approx(1.0, abs=0.2)


def test_rows_are_taken_with_their_parts():
    """Rows are taken with all that belongs to them."""
    block = heights(planted.cell(load("ur5")), 10, 0)
    some = take(block, [7, 2])
    assert isinstance(some, Heights) and some.rows.tolist() == [8, 3]
    assert np.array_equal(some.height, block.height[[7, 2]]) and some.sigma is not None and len(some.sigma) == 2
    with pytest.raises(MeasurementError, match="height has 3 rows, but q has 10"):
        replace(block, height=np.zeros(3))


def test_a_kind_without_a_residual_is_named():
    q = random_joints(load("ur5"), 10, 0)
    cell = planted.cell(load("ur5"))
    with pytest.raises(MeasurementError, match="no residual is registered for measurements of kind 'unheard'"):
        errors(cell, [Unheard(q, cell.chain.joint_names)])
