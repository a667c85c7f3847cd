"""Reversed joints are found, and looked for only where no placement could make up for them."""

from dataclasses import replace

import numpy as np
import pytest

from calib.column_changes import coupling
from calib.data.poses.measurements import take
from calib.data.poses.pose_files import read_measurements
from calib.geometry import diagnosis
from calib.geometry.first_guess import install
from calib.robot.chain import random_joints
from calib.robot.library import load
from calib.rooms.cells.cell import measure
from calib.rooms.cells.virtual_cells import perturbed_cell


@pytest.mark.parametrize(("turned", "most"), [((), 1), ((1,), 8), ((2, 5), 9)])
def test_a_reversal_that_no_placement_makes_good_is_not_searched_for(monkeypatch, turned, most):
    """Trying every joint fits placements 7, 12 and 16 times."""
    cell, placed = perturbed_cell(load("ur5"), seed=1), []
    block = measure(cell, random_joints(cell.nominal, 60, 0), 1)
    q = block.q.copy()
    q[:, list(turned)] *= -1.0
    block = replace(block, q=q)
    polish = diagnosis.polish_frames
    monkeypatch.setattr(diagnosis, "polish_frames", lambda *given: placed.append(given) or polish(*given))
    found = diagnosis.wrong_columns(install(cell.nominal, [block]), [block])
    assert (found.joints if found else ()) == turned
    assert len(placed) <= most


REAL = {
    "ur5_gts3800": ("model.urdf", "grid_800.csv"),
    "ur10_ipa": ("model.urdf", "A_grid_2500.csv"),
    "motoman_leica": ("model_right.urdf", "right_wide_386.csv"),
}


@pytest.mark.parametrize("folder", REAL)
@pytest.mark.parametrize("way", [0.0, 1.0])
def test_real_poses_are_sound_unless_a_joint_counts_from_the_one_before(data, folder, way):
    robot, file = (data / folder / name for name in REAL[folder])
    arm = load(robot)
    (block,) = read_measurements(file, arm.joint_names)
    block = take(block, np.arange(0, len(block), max(1, len(block) // 100)))
    changed = replace(block, q=block.q @ coupling(arm.n, 2, 1, -way).T)
    found = diagnosis.wrong_columns(install(arm, [changed]), [changed], mirrored=True)
    assert (found and (found.code, found.joints)) == (("joint-coupled", (2, 1)) if way else None)
