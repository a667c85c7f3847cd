"""Motions for a robot whose fit found joint corrections are designed on its best rigid geometry, however it comes."""

from pathlib import Path

import numpy as np
import pytest

from calib.procedure.excitation import planning
from calib.procedure.excitation.inputs import read_inputs
from calib.procedure.excitation.settings import ExcitationSettings
from calib.robot import calibrated
from calib.robot.calibrated import CalibratedChain, CorrectedChain, Deflection, Term
from calib.robot.library import load, resolve


@pytest.fixture
def robot() -> CalibratedChain:
    nominal = load("ur5")
    moved = np.random.default_rng(0).normal(0.0, 1e-2, (2, len(nominal.elements)))
    rigid, corrected = (nominal.with_values(nominal.values + each) for each in moved)
    turning = nominal.elements[int(nominal.moving[1])].name
    terms = Deflection((Term(turning, "sin", 1, 1),), np.array([1e-3]), nominal)
    return CalibratedChain(rigid, nominal, None, CorrectedChain(corrected, terms), str(resolve("ur5")))


@pytest.fixture
def folder(robot: CalibratedChain, tmp_path: Path) -> Path:
    calibrated.write(tmp_path, robot)
    return tmp_path


def test_excitation_has_rigid_geometry(robot: CalibratedChain, folder: Path) -> None:
    """An excitation has the rigid geometry."""
    settings = ExcitationSettings(period=5.0)
    one, two, three = (read_inputs(each, settings) for each in (robot, folder, folder / "robot.toml"))
    rng = np.random.default_rng(1)
    states = rng.uniform(-1.0, 1.0, (3, 20, robot.chain.n))
    for each in (one, two, three):
        np.testing.assert_array_equal(each.chain.values, robot.chain.values)
        np.testing.assert_array_equal(each.model.exact.regressor(*states), one.model.exact.regressor(*states))


def test_a_plan_has_the_rigid_geometry(robot: CalibratedChain, folder: Path) -> None:
    way = folder / "way.csv"
    way.write_text("x [m],y [m],z [m]\n0.4,0.2,0.4\n0.3,-0.3,0.5\n")
    limits = folder / "limits.toml"
    limits.write_text("[acceleration]\nall = 5.0\n")
    one, two = (planning.plan(each, way, limits=limits) for each in (robot, folder))
    np.testing.assert_array_equal(one.track.q, two.track.q)
    for found in (one, two):
        np.testing.assert_array_equal(found.chain.values, robot.chain.values)
