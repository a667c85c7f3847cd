"""Held-out poses of a fit judge another geometry by the residuals in its folder."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import planted_motion as planted
import pytest

from calib.files import write_table
from calib.geometry import installation
from calib.geometry.installation import Installation
from calib.procedure.dynamic_stage.held_out_poses import held_out_errors
from calib.robot import calibrated
from calib.robot.calibrated import CalibratedChain
from calib.robot.kinematics import forward
from calib.transforms import pose

STATION = pose(np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), [1.0, -2.0, 0.5])
TOOL = pose(position=[0.05, 0.02, 0.1])
ERROR = {"shoulder": 2e-3, "upper": 1e-3}  # of the fit [rad, m]
COUNT = 40


def positions(chain, cell: Installation, q: np.ndarray) -> np.ndarray:
    """Return the target's positions (m, 3) in the station."""
    return (cell.stations[0] @ forward(chain, q) @ cell.tools[0])[:, :3, 3]


@pytest.fixture(scope="module")
def fit(tmp_path_factory):
    """A fit whose arm is wrong by `ERROR`, and whose station and tool are not where they were."""
    folder = tmp_path_factory.mktemp("fit")
    chain = planted.arm()
    cell = Installation(chain, STATION[None], TOOL[None], ("bench",), ("ball",))
    frames = installation.frame_tables(cell)
    calibrated.write(folder, CalibratedChain(chain), frames)
    moved = replace(cell, stations=(STATION @ pose(position=[1e-3, 0.0, 2e-3]))[None])
    random = np.random.default_rng(0)
    q = random.uniform(-1.5, 1.5, (COUNT, 3))
    measured = positions(true_arm(), moved, q) + random.normal(0.0, 1e-5, (COUNT, 3))
    residual_mm = 1e3 * (measured - positions(chain, cell, q))
    rows = []
    for number in range(COUNT):
        label = "fit" if number < 25 else "validation"
        rows.append([label, "bench", "ball", *q[number], *residual_mm[number], 0])
    joints = [f"joint{number} [rad]" for number in (1, 2, 3)]
    header = ("set", "station", "tool", *joints, "dx [mm]", "dy [mm]", "dz [mm]", "outlier")
    write_table(folder / "residuals.csv", header, rows)
    return folder


def true_arm():
    chain = planted.arm()
    return chain.with_values({name: value + ERROR.get(name, 0.0) for name, value in zip(chain.names, chain.values)})


def test_the_true_arm_leaves_the_noise_of_held_out_poses(fit: Path):
    errors = held_out_errors(fit / "robot.toml", planted.arm(), true_arm())
    assert errors is not None and errors.poses == COUNT - 25
    assert errors.before > 3e-4
    assert errors.after < 3e-5


def test_another_arm_is_worse(fit: Path):
    chain = planted.arm()
    values = {name: value - ERROR.get(name, 0.0) for name, value in zip(chain.names, chain.values)}
    errors = held_out_errors(fit, chain, chain.with_values(values))
    assert errors is not None
    assert errors.after == pytest.approx(2.0 * errors.before, rel=0.05)


def test_a_change_that_only_moves_the_base_changes_nothing(fit: Path):
    chain = planted.arm()
    values = dict(zip(chain.names, chain.values)) | {"turn": 1e-3}
    errors = held_out_errors(fit, chain, chain.with_values(values))
    assert errors is not None and errors.after == pytest.approx(errors.before, rel=1e-2)


def test_a_robot_without_held_out_poses_is_not_judged(fit: Path, tmp_path: Path):
    assert held_out_errors(tmp_path / "arm.urdf", planted.arm(), true_arm()) is None
