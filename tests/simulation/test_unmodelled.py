"""What the virtual cells hide is outside every model, and behaves as gears, backlash, heat and friction do."""

from dataclasses import replace

import numpy as np
import pytest

from calib.geometry.model_choice.ladder import EFFECTS
from calib.robot.calibrated import Deflection, evaluate
from calib.robot.chain import random_joints
from calib.robot.kinematics import gravity_torques
from calib.simulation.cell import true_poses
from calib.simulation.unmodelled import PositionErrors, TorqueErrors, displacements, gear_torques, memory
from calib.simulation.virtual_cells import lwr4plus_cell, virtual_cell

CELL = virtual_cell("lwr4plus", 0)
ARM = CELL.truth.chain


def test_ladder_holds_little_of_gear_errors() -> None:
    """Effects of the ladder hold no more than a third of the gear errors."""
    q = random_joints(ARM, 2500, 3)
    torque = gravity_torques(ARM, q)
    moved = displacements(PositionErrors(gear=1e-3), ARM, q, torque, np.inf)[ARM.moving]
    found = [one for terms_of in EFFECTS.values() for one in terms_of(ARM, True)]
    terms = [one for one in found if one.basis not in ("lever", "moment") and one.order <= 6]
    known = np.vstack([np.ones(len(q)), evaluate(Deflection(tuple(dict.fromkeys(terms)), (), ARM), q, torque)])
    known = np.unique(np.round(known, 12), axis=0).T
    fitted = known @ np.linalg.lstsq(known, moved.T, rcond=None)[0]
    assert known.shape[1] > 60
    assert np.all(np.var(moved.T - fitted, axis=0) > 0.65 * np.var(moved.T, axis=0))


def test_position_errors_are_realistic() -> None:
    """Position errors are those of a real arm."""
    q = np.repeat(random_joints(ARM, 2, 1), 2, axis=0)[[0, 2, 1, 3]]  # there and back: every pose from both sides
    torque = gravity_torques(ARM, q)
    slack = displacements(PositionErrors(backlash=1e-4), ARM, q[[0, 1, 2, 1]], torque, np.inf)[ARM.moving]
    np.testing.assert_allclose(slack[:, 1], -slack[:, 2])
    np.testing.assert_allclose(np.abs(slack[:, 1]), 1e-4)
    still = replace(CELL, unmodelled=PositionErrors(growth=1e-4))
    cold, warm = (true_poses(still, q[:1], warm=poses)[0, :3, 3] for poses in (0.0, np.inf))
    reach = np.linalg.norm(cold - still.truth.stations[0][:3, 3])
    assert 0.2e-4 * reach < np.linalg.norm(warm - cold) < 2e-4 * reach
    bent = replace(CELL, unmodelled=PositionErrors(droop=1e-4))
    rigid = replace(CELL, unmodelled=PositionErrors())
    droop = true_poses(bent, q)[:, :3, 3] - true_poses(rigid, q)[:, :3, 3]
    down = still.truth.stations[0][:3, :3] @ [0.0, 0.0, -1.0]
    assert np.all(droop @ down > 0.19e-4) and np.all(np.linalg.norm(droop, axis=1) < 1.01e-4)


def test_nothing_hidden_adds_nothing() -> None:
    """Nothing is added where nothing is hidden."""
    q = random_joints(ARM, 20, 4)
    plain = lwr4plus_cell()
    assert not displacements(plain.unmodelled, ARM, q, gravity_torques(ARM, q), 0.0).any()
    assert plain.unmodelled.note == "" and "backlash" in CELL.note


def test_friction_depends_on_the_way() -> None:
    """Friction with memory depends on the way and takes energy."""
    angle = 0.05 * np.sin(np.linspace(0.0, 6.0 * np.pi, 6001))[:, None]
    torque = memory(angle, np.array([2.0]))[:, 0]
    assert np.abs(torque).max() <= 2.0 + 1e-12
    at_zero = torque[[2000, 3000, 4000, 5000]]  # q = 0, forwards and backwards in turn
    assert np.all(at_zero[::2] > 1.0) and np.all(at_zero[1::2] < -1.0)
    last = slice(4000, 6001)
    assert np.trapezoid(torque[last], angle[last, 0]) > 0.2  # J per turn


@pytest.mark.parametrize(("warming", "t", "share"), [(0.2, 0.0, 0.0), (0.2, 1e9, -0.2), (0.2, 120.0, -0.1264)])
def test_friction_falls_as_the_gears_warm_up(warming: float, t: float, share: float) -> None:
    one = np.ones((1, 3))
    found = gear_torques(TorqueErrors(warming=warming), one, one, np.ones(3), 5.0 * one, np.array([t]))
    np.testing.assert_allclose(found, 5.0 * share, atol=1e-3)
