"""Torque rows as a linear map: one map for regressors and for measured torques, with its adjoint."""

import numpy as np
import pytest
from arms import motley

from calib.dynamics import drives
from calib.dynamics.bodies import bodies_of
from calib.dynamics.idim import IdentificationModel
from calib.dynamics.torque_rows import BOTH, LINK, MOTOR, POWER, ROWS, Projection, projected
from calib.errors import CalibError

N, SETS = 5, "Ia Fvl Fcl offl Fvm Fcm offm"


def model(rows):
    return IdentificationModel(bodies_of(motley()), drives.standard([SETS] * N, v0=0.5), rows)


def states(count=7):
    return np.random.default_rng(3).uniform(-1.0, 1.0, (3, count, N))


@pytest.mark.parametrize("rows", ROWS.values(), ids=lambda rows: rows.name)
def test_right_model_explains_row_targets(rows):
    """Of torques that motor and sensor would measure, whatever the rows: W chi = target."""
    q, v, a = states()
    chi = dict(zip(model(BOTH).names, np.random.default_rng(0).normal(size=model(BOTH).p)))
    motor, sensor = (
        model(one).regressor(q, v, a) @ np.array([chi[name] for name in model(one).names]) for one in (MOTOR, LINK)
    )
    explained = model(rows).regressor(q, v, a) @ np.array([chi[name] for name in model(rows).names])
    assert np.allclose(explained, rows.target(motor, sensor, q, v), rtol=0, atol=1e-11)


@pytest.mark.parametrize("rows", [one for one in ROWS.values() if one.projection is None], ids=lambda rows: rows.name)
def test_fold_is_the_adjoint_of_observe(rows):
    rng, sides = np.random.default_rng(1), model(BOTH).sides
    torques, (q, v, _) = rng.normal(size=(7, N, len(sides))), states()
    seen = rows.observe(torques, sides, q, v)
    weights = rng.normal(size=seen.shape)
    assert np.isclose(np.sum(seen * weights), np.sum(torques * rows.fold(weights, sides)), rtol=1e-12)


@pytest.mark.parametrize("rows", ROWS.values(), ids=lambda rows: rows.name)
def test_no_entry_is_without_its_row(rows):
    """What `acting` says to be zero is; a row that repeats another holds its entries, or zeros."""
    own, (q, v, a) = model(rows), states()
    full = own.regressor(q, v, a)
    assert not full.transpose(2, 1, 0)[~own.acting()].any()
    for row, source in enumerate(rows.repeated(N)):
        other = full[:, source]
        assert ((full[:, row] == other) | (full[:, row] == 0.0)).all()
    assert len(rows.numbered(N)) == len(rows.titles(tuple("abcde"))) == len(rows.units([False] * N)) == own.rows


def test_power_is_a_model_of_one_row():
    q, v, a = states()
    own, chi = model(POWER), np.random.default_rng(2).normal(size=model(MOTOR).p)
    torque = model(MOTOR).regressor(q, v, a) @ chi
    assert own.rows == 1 and own.names == model(MOTOR).names
    assert np.allclose((own.regressor(q, v, a) @ chi)[:, 0], np.sum(v * torque, axis=1), rtol=0, atol=1e-12)
    assert np.allclose(POWER.target(torque, None, q, v)[:, 0], np.sum(v * torque, axis=1), rtol=0, atol=1e-12)


def test_projected_rows_keep_labels():
    """A projection of stacked rows keeps labels and refuses slopes."""
    first = np.eye(2 * N)[:2]
    rows = projected(
        "two", Projection(("x", "y"), ("N", "N"), lambda q, v: np.broadcast_to(first, (len(q), 2, 10))), BOTH
    )
    q, v, a = states()
    assert np.array_equal(model(rows).regressor(q, v, a), model(BOTH).regressor(q, v, a)[:, :2])
    assert rows.numbered(N) == ("x", "y") and not rows.motors_alone and not rows.with_motors
    assert rows.of_joints(np.array([[True] * N, [True] * 4 + [False]])).tolist() == [[True, True], [False, False]]
    with pytest.raises(CalibError, match="no derivatives"):
        rows.fold(np.zeros((7, 2, 1)), ("bodies",))
    with pytest.raises(CalibError, match="sensors behind the gear"):
        rows.target(q, None, q, v)
