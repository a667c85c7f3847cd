"""With torque sensors behind the gears, richer friction and cables are found, and parameters keep what is stated."""

from dataclasses import replace

import numpy as np
import pytest

from calib.identification.identify import identify
from calib.identification.identify_options import parse_options
from calib.procedure.dynamic_stage.inputs import gather
from calib.robot.calibrated import as_calibrated
from calib.simulation.known_robots import random_fourier
from calib.simulation.truth import true_base
from calib.simulation.virtual_arm import moving_arm, record
from calib.simulation.virtual_cells import virtual_cell


@pytest.mark.slow
def test_friction_with_memory_and_cables() -> None:
    """Friction with memory, and cables, of a simulated arm are identified beside torque sensors."""
    cell = virtual_cell("lwr4plus")
    arm = moving_arm(cell, "lwr4plus")  # 30 % of Fc has memory, cables pull, gears are warm: see its note
    lower, upper = arm.chain.sampling_limits()
    speed = np.array([joint.velocity for joint in arm.chain.joints])
    motion = random_fourier(0.8 * lower, 0.8 * upper, 0.8 * speed, 10.0, 1000.0, seed=3)
    log = replace(record(arm, motion, 3), file="motion")
    given = gather(as_calibrated(arm.chain), [log], options=parse_options({"rows": "both"}))
    found = identify(given.robot, given.cases, given.options.settings)
    steps = {step.model: step for step in found.friction.steps}
    assert steps["+ presliding"].kept_at_joints == tuple(range(1, 8)) and len(steps["+ cable"].kept_at_joints) >= 4
    assert steps["+ cable"].cross_validated_percent < 0.4 * steps["standard"].cross_validated_percent
    estimate, true = found.fitted.estimate, true_base(found.dynamics.model, cell, arm, 0)
    rows = zip((name.removesuffix("R") for name in found.names), estimate.values, estimate.sigma)
    apart = [(value - true[name]) / sigma for name, value, sigma in rows if name in true and sigma > 1e-9]
    assert len(apart) > 80 and np.mean(np.abs(apart) < 1.96) > 0.9
