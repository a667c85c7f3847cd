"""One motion under several loads: rows and exact derivatives of the stacked regressor."""

import numpy as np
import pytest
from differences import check

from calib.dynamics import base
from calib.dynamics.idim import from_chain
from calib.dynamics.load_cases import LoadCases
from calib.dynamics.torque_rows import BOTH, LINK, MOTOR
from calib.robot.library import load

RUNS = ((), ("8",))


def arm(rows):
    chain = load("lwr4plus")
    return from_chain(chain, rows.drives, np.asarray(chain.tail), rows)


@pytest.mark.parametrize("rows", [MOTOR, LINK, BOTH])
def test_rows_are_stacked_by_load(rows):
    """The rows of each load stand one after the other."""
    model = arm(rows)
    cases = LoadCases(model, base.find(model, loads=RUNS), RUNS)
    q, v, a = np.random.default_rng(0).uniform(-1, 1, (3, 5, 7))
    Y = cases.regressor(q, v, a)
    each = [model.regressor(q, v, a, carried=carried)[:, :, cases.base.kept] for carried in RUNS]
    assert np.array_equal(Y, np.concatenate(each, axis=1))
    assert Y.shape[1] == len(cases.joint_of_row) == len(cases.row_names) and cases.limited.shape == (2, 7)
    assert np.array_equal(cases.joint_of_row[cases.limited], np.tile(np.arange(7), (2, 1)))
    assert "joint 1 (8)" in cases.row_names and "joint 7 (no payload)" in cases.row_names
    values = np.random.default_rng(2).normal(size=len(cases.names))
    assert np.array_equal(
        np.abs(cases.largest_torques(values, q, v, a)), np.abs((Y @ values)[:, cases.limited]).max(axis=1)
    )
    marked = cases.of_rows(np.arange(7.0))
    assert np.isfinite(marked).sum() == 14 and (marked[cases.limited] == np.arange(7)).all()


@pytest.mark.parametrize("rows", [MOTOR, BOTH])
def test_derivatives_match_stacked_rows(rows):
    """Derivatives are those of the stacked rows."""
    model, rng = arm(rows), np.random.default_rng(1)
    cases = LoadCases(model, base.find(model, loads=RUNS), RUNS)
    state = rng.uniform(-1, 1, (3, 4, 7))
    weights = rng.normal(size=cases.regressor(*state).shape)
    values = rng.normal(size=len(cases.names))
    gradient = np.array(cases.regressor_gradient(*state, weights))
    check(lambda x: np.sum(weights * cases.regressor(*x.reshape(state.shape))), gradient.ravel(), state.ravel())
    of_torque = np.array(cases.torque_gradient(*state, values, weights[:, :, 0]))
    expected = np.array(cases.regressor_gradient(*state, weights[:, :, :1] * values))
    assert np.allclose(of_torque, expected, atol=1e-9 * np.abs(expected).max())
