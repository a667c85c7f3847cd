"""Claim: geometry and dynamics meet in memory as they do through files, the geometry's covariance included."""

from pathlib import Path

import numpy as np
import planted_motion as planted
import pytest

from calib.data.poses.measurements import PoseMeasurements
from calib.errors import UsageError
from calib.geometry.weighing import calibrated_chain
from calib.identification.identify import identify
from calib.identification.uncertainty.geometry_uncertainty import propagate
from calib.procedure.dynamic_stage import folder as identified
from calib.procedure.dynamic_stage import identify as dynamic
from calib.procedure.dynamic_stage.inputs import gather
from calib.procedure.kinematic_stage import fit as kinematic
from calib.procedure.kinematic_stage import folder as fitted
from calib.procedure.kinematic_stage.inputs import Inputs
from calib.procedure.kinematic_stage.settings import FitSettings
from calib.robot import calibrated
from calib.robot.chain import random_joints
from calib.robot.library import load_calibrated
from calib.simulation.cell import measure
from calib.simulation.virtual_cells import perturbed_cell


def geometry(model: str) -> kinematic.Outcome:
    """Return a fit of the planted arm, whose joints deflect."""
    cell = perturbed_cell(planted.arm(), 1, hidden=1.0)
    block: PoseMeasurements = measure(cell, random_joints(cell.nominal, 60, 1), 2)
    return kinematic.run(Inputs(cell.nominal, Path("planted.toml"), (block,)), settings=FitSettings(model=model))


@pytest.mark.slow
@pytest.mark.parametrize("model", ["geometry", pytest.param("harmonics", marks=pytest.mark.slow)])
def test_one_process_equals_way_by_files(model, tmp_path):
    """Fit and identification in one process equal the way through files."""
    outcome = geometry(model)
    robot = outcome.robot
    log = planted.write(tmp_path, "log.npz", 0)
    given = gather(robot, [str(log)])
    found = identify(robot, given.cases, given.options.settings)
    carried = propagate(found, robot, given.cases)

    fitted.write_folder(outcome, tmp_path / "fit")
    through = dynamic.run(gather(tmp_path / "fit", [str(log)]))
    assert through.carried is not None and robot.covariance is not None
    close = {"rtol": 1e-10, "atol": 0.0}  # tables hold twelve digits
    np.testing.assert_allclose(found.fitted.estimate.values, through.found.fitted.estimate.values, **close)
    np.testing.assert_allclose(carried.sigma_geometry, through.carried.sigma_geometry, **close)
    np.testing.assert_allclose(carried.sigma, through.carried.sigma, **close)
    scale = np.outer(carried.sigma, carried.sigma)
    np.testing.assert_allclose(carried.covariance / scale, through.carried.covariance / scale, atol=1e-10)
    assert (carried.sigma_geometry > 0.0).any(), "the geometry's part is there to be carried"

    kept = calibrated.read(identified.write_folder(through, tmp_path / "model"))
    np.testing.assert_allclose(kept.covariance, robot.covariance, **close)
    assert (kept.corrections is None) == (robot.corrections is None) and np.array_equal(
        kept.chain.values, robot.chain.values
    )


@pytest.mark.slow
def test_calibrated_robot_reads_back(tmp_path):
    """A calibrated robot reads back as it was written."""
    robot = geometry("harmonics").robot
    assert robot.corrections is not None and robot.nominal is not None and robot.moved
    calibrated.write(tmp_path, robot)
    again = load_calibrated(tmp_path)
    assert again.source == robot.source == "planted.toml" and again.nominal is not None
    for one, other in ((again.chain, robot.chain), (again.complete, robot.complete), (again.nominal, robot.nominal)):
        assert np.array_equal(one.values, other.values)
    assert not np.array_equal(again.chain.values, again.complete.values)
    assert again.deflection.terms == robot.deflection.terms
    assert np.array_equal(again.deflection.coefficients, robot.deflection.coefficients)
    np.testing.assert_allclose(again.covariance, robot.covariance, rtol=1e-11)


@pytest.mark.slow
def test_corrected_geometry_is_no_robot():
    """A geometry good only with its corrections is not taken for a robot."""
    found = geometry("harmonics").selection.fit
    with pytest.raises(UsageError, match="needs the best fit without corrections"):
        calibrated_chain(found)
