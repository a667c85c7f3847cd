"""Held-out poses of a fit judge another geometry by the residuals in its folder."""

import csv
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import planted_motion as planted
import pytest

from calib.files import write_table
from calib.geometry import installation
from calib.geometry.installation import Installation
from calib.procedure.dynamic_stage.held_out_poses import held_out_errors, standard_errors
from calib.procedure.kinematic_stage.fit_tables import TO_CALIBRATED
from calib.procedure.kinematic_stage.folder import IN_SESSION, VALIDATED, ValidationFolder
from calib.robot import calibrated
from calib.robot.calibrated import CalibratedChain
from calib.robot.chain import Chain
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
    assert errors.is_worse


def test_a_change_that_only_moves_the_base_changes_nothing(fit: Path):
    chain = planted.arm()
    values = dict(zip(chain.names, chain.values)) | {"turn": 1e-3}
    errors = held_out_errors(fit, chain, chain.with_values(values))
    assert errors is not None and errors.after == pytest.approx(errors.before, rel=1e-2)


@pytest.mark.parametrize("after", [true_arm(), planted.arm()])
def test_the_validation_of_a_session_judges_as_held_out_rows(fit: Path, tmp_path: Path, after: Chain):
    """Errors in the base frame, predicted minus measured; a row without all of x, y, z does not count."""
    folder = shutil.copytree(fit, tmp_path / IN_SESSION)
    with (folder / "residuals.csv").open(newline="") as file:
        header, *rows = list(csv.reader(file))
    write_table(folder / "residuals.csv", header, [row for row in rows if row[0] == "fit"])
    to_station = STATION[:3, :3]
    session = []
    for row in [row for row in rows if row[0] != "fit"]:
        in_base = -to_station.T @ np.array(row[6:9], dtype=float)
        session.append([*row[3:6], *in_base])
    session.append([*rows[0][3:6], np.nan, 1.0, 1.0])
    validated = tmp_path / VALIDATED
    validated.mkdir()
    write_table(ValidationFolder(validated).errors, (*header[3:6], *TO_CALIBRATED), session)
    errors, direct = (held_out_errors(place, planted.arm(), after) for place in (folder, fit))
    assert errors is not None and direct is not None
    assert errors.poses == direct.poses
    assert (errors.before, errors.after) == pytest.approx((direct.before, direct.after), rel=1e-4)


def test_a_rise_counts_by_its_scatter():
    noise = np.random.default_rng(0).normal(0.0, 1.0, (2000, 20))
    noise[:, 0] += 50.0  # a gross pose
    passed = np.mean([standard_errors(differences) > 2.0 for differences in noise])
    assert passed < 0.12
    assert standard_errors(noise[0] + 3.0) > 5.0
    assert standard_errors(np.array([1.0])) == standard_errors(np.zeros(9)) == 0.0


def test_a_robot_without_held_out_poses_is_not_judged(fit: Path, tmp_path: Path):
    assert held_out_errors(tmp_path / "arm.urdf", planted.arm(), true_arm()) is None
