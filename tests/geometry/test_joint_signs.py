"""Reversed joints are found, and looked for only where no placement could make up for them."""

from __future__ import annotations

from dataclasses import replace

import pytest

from calib.geometry.checks import joint_signs
from calib.geometry.first_guess import install
from calib.robot.chain import random_joints
from calib.robot.load import load
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
    polish = joint_signs.polish_frames
    monkeypatch.setattr(joint_signs, "polish_frames", lambda *given: placed.append(given) or polish(*given))
    found = joint_signs.reversed_joints(install(cell.nominal, [block]), [block], [None])
    assert (found.joints if found else ()) == turned
    assert len(placed) <= most
