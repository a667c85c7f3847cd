"""The geometry's uncertainty in the dynamics of a parallel robot: derivative, spread of fits, and files."""

from dataclasses import replace

import numpy as np
import pytest
from platform_sines import fitted, recorded

from calib.folders import read_covariance
from calib.identification.identify import common_decimator
from calib.identification.identify_options import parse_options
from calib.identification.rows import make_case, observe
from calib.identification.uncertainty.geometry_uncertainty import estimate, estimator
from calib.parallel.identification import ParallelDynamics, identify_parallel
from calib.parallel.mechanism.closure import ClosedRobot, closed
from calib.parallel.mechanism.geometric_fit import changed, visible_directions
from calib.parallel.mechanism.parallel_model import rows_named
from calib.parallel.robots import find

LOADED = {"payload": {"5": {}}, "files": {"load1.csv": {"payload": ["5"]}}, "essential": "none"}


def refitted(found: ParallelDynamics, known: ClosedRobot) -> np.ndarray:
    """Return the estimate of an identification from the same torques and weights on another geometry."""
    own, cases = found.found, found.inputs.cases
    model = replace(own.dynamics.model, mechanism=known, torque_rows=rows_named(known, own.settings.torque_rows.name))
    decimator, rows = common_decimator(cases, own.settings), []
    for k, (part, case) in enumerate(zip(own.rows, cases)):
        again = make_case(case.name, case.motion, model.torque_rows, carried=case.carried)
        seen = observe(model, own.base.kept, again, decimator)
        seen = seen.by_recording(k, len(cases)) if model.torque_rows.name == "power" else seen
        rows.append(replace(part, matrix=seen.matrix, target=seen.target))
    return estimate(estimator(own), rows)[0]


@pytest.mark.parametrize(
    ("name", "rows"),
    [pytest.param("fivebar", "motor", marks=pytest.mark.slow), *(pytest.param(*each, marks=pytest.mark.slow)
      for each in (("dualv", "motor"), ("dualv", "power"), ("stewart", "motor")))],
)  # fmt: skip
def test_sensitivities_match_other_geometry(name, rows):
    """On platform, motor and power rows, with a prior; constants that are choices of frames have none."""
    robot = fitted(find(name).mechanism)
    logs = [recorded(robot.mechanism, load, seed=k, samples=200) for k, load in enumerate(((), ("5",)))]
    found = identify_parallel(robot, logs, options=parse_options(LOADED | {"rows": rows}))
    carried, parameters = found.carried, robot.covariance.of(robot.mechanism)
    directions = visible_directions(robot.mechanism, parameters)
    direction = directions @ np.random.default_rng(1).normal(size=directions.shape[1])
    step = 2e-5 * direction / np.linalg.norm(direction)
    ends = [refitted(found, closed(changed(robot.chain, parameters, own))) for own in (step, -step)]
    by_hand, ours = (ends[0] - ends[1]) / 2.0, carried.sensitivity[:, : len(parameters)] @ step
    assert (np.abs(by_hand - ours) < 1e-4 * np.abs(carried.sensitivity).max(axis=1) * 2e-5).all()
    np.testing.assert_allclose(found.estimate.sigma, np.hypot(carried.sigma_torque, carried.sigma_geometry))
    assert (carried.sigma_geometry > 0.0).all()


@pytest.mark.slow
def test_fitted_geometries_move_dynamics(tmp_path):
    """Twelve fits of a DualV from other noise, the same torques: shifts of its 27 parameters, in sigma_geometry."""
    known = find("dualv").mechanism
    logs = [recorded(known, load, seed=k) for k, load in enumerate(((), ("5",)))]
    robot = fitted(known)
    found = identify_parallel(robot, logs, options=parse_options(LOADED))
    fits = [refitted(found, fitted(known, seed).mechanism) for seed in range(12)]
    shifts = (np.array(fits) - refitted(found, known)) / found.carried.sigma_geometry
    assert 0.75 < np.sqrt(np.mean(shifts**2)) < 1.3
    out = found.save(tmp_path / "id", plots=False)
    names, matrix = read_covariance(out / "chain_covariance.csv")
    assert names == robot.covariance.names and np.allclose(matrix, robot.covariance.matrix)
    assert "sigma_geometry" in (out / "estimate.csv").read_text() and (out / "sensitivity.csv").exists()
    again = find(out)
    assert again is not None and again.covariance is not None
