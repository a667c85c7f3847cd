"""Update of identified dynamics by further logs: pieces equal a batch, changes are named, drift is followed."""

from dataclasses import replace

import numpy as np
import planted_motion as planted
import pytest

from calib.identification.identify import identify
from calib.identification.learning.production import (
    Cause,
    LogRows,
    WorkingModel,
    absorbed,
    judge,
    log_rows,
    torque_shares,
)
from calib.identification.settings import IdentificationSettings
from calib.identification.uncertainty.learned_torque_errors import learn_torque_errors
from calib.identification.uncertainty.torque_errors import estimated_columns

ROWS = ("1", "2", "3")
Working = tuple[WorkingModel, np.ndarray]


@pytest.fixture(scope="module")
def working() -> Working:
    """Return the planted arm's model, identified from 20 s, and the covariance of its parameters."""
    cases = [planted.case("first", 0)]
    found = identify(planted.arm(), cases, IdentificationSettings(friction="standard"))
    errors = learn_torque_errors(found, cases)
    assert errors is not None
    columns = estimated_columns(found.dynamics, found.names)
    count = sum(len(rows.target) for rows in found.rows)
    density = found.fitted.std**2 * found.fitted.inflation * cases[0].duration / count
    names = (*found.names, *(f"gain {row}" for row in ROWS))
    values = found.dynamics.values[columns]
    units = ("",) * len(names)
    model = WorkingModel(found.dynamics, names, units, columns, values, density, errors.discrepancy, ROWS)
    return model, found.fitted.estimate.covariance


def rows_of(model: WorkingModel, seed: int, **how) -> LogRows:
    """Return the rows of a log of 10 s of other motion."""
    case = planted.case(f"log {seed}", seed, duration=10.0, **how)
    return log_rows(model, case, case.motion.decimator)


def test_a_log_in_pieces_gives_the_state_of_the_log_at_once(working: Working):
    model, covariance = working
    state = model.first_state(covariance)
    rows = rows_of(model, 1)
    whitened = rows.whitened
    batch = state.absorb(whitened, 100.0)
    pieces = state
    for part in np.array_split(whitened, 7):
        pieces = pieces.later(0.0).absorb(part, 100.0 / 7)
    scale = np.sqrt(np.diag(batch.posterior()[1]))
    difference = (pieces.posterior()[0] - batch.posterior()[0]) / scale
    assert np.abs(difference).max() < 1e-6
    assert pieces.factors.shape == state.factors.shape


def test_further_logs_improve_the_estimate_and_its_sigmas_hold(working: Working):
    model, covariance = working
    state = model.first_state(covariance)
    truth = planted.truth()
    held_out = rows_of(model, 99)
    errors = []
    for seed in range(1, 5):
        rows = rows_of(model, seed)
        judgement = judge(model, state, rows)
        assert judgement.cause is Cause.NONE
        state = absorbed(state, rows, judgement)
        errors.append(np.std(held_out.target - held_out.matrix @ state.posterior()[0]))
    first = np.std(held_out.target)
    assert errors[-1] <= first
    mean, after = state.posterior()
    drives = [k for k in range(model.k) if model.term(k) is not None]
    relative = (model.values[drives] + mean[drives] - truth[model.columns[drives]]) / np.sqrt(np.diag(after)[drives])
    assert np.sqrt(np.mean(relative**2)) < 2.0
    assert (
        torque_shares(held_out, after)[: model.k]
        < torque_shares(held_out, state.later(30.0).posterior()[1])[: model.k] + 1e-12
    ).all()


@pytest.mark.parametrize(
    ("cause", "row", "size"),
    [(Cause.LOAD, None, 1.0), (Cause.FRICTION, 1, 2.0), (Cause.GAIN, 1, 0.5), (Cause.UNIT, None, 9.0)],
)
def test_a_change_is_named_with_its_size(working: Working, cause: Cause, row: int | None, size: float):
    model, covariance = working
    state = model.first_state(covariance)
    rows = rows_of(model, 3)
    change = np.zeros(len(model.names))
    load = np.zeros(10)
    if cause is Cause.LOAD:
        load[6:] = 0.0, 0.0, 0.1 * size, size
    elif cause is Cause.FRICTION:
        friction = [k for k in range(model.k) if model.names[k] == "Fc2"]
        change[friction] = size
    elif cause is Cause.GAIN:
        change[model.k + 1] = size
    else:
        change[model.k :] = size
    changed = replace(rows, target=rows.target + rows.matrix @ change + rows.load @ load)
    judgement = judge(model, state, changed)
    assert judgement.cause is cause
    assert judgement.row == row
    assert judgement.accepted == (cause in (Cause.FRICTION, Cause.GAIN))
    assert judgement.change == pytest.approx(size, rel=0.1, abs=3.0 * judgement.sigma)
