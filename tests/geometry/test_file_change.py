"""A part of the set-up that changed between the fit and a validation file is named with its size, no other is."""

from dataclasses import replace

import numpy as np
import pytest
from planted import cell, load, perturb, random_joints

from calib.data.poses.measurements import PoseMeasurements, Positions
from calib.geometry.checks.file_change import changed_since_fit
from calib.geometry.installation import Installation, see
from calib.transforms import from_xyz_rpy

NOISE = 2e-5


def measured(truth: Installation, seed: int, growth: float = 1.0, slip: float = 0.0) -> Positions:
    q = random_joints(truth.chain, 30, seed)
    moved = q + slip * np.eye(truth.chain.n)[2]
    position = growth * see(truth, moved).poses()[:, :3, 3]
    position = position + NOISE * np.random.default_rng(seed).standard_normal(position.shape)
    block = PoseMeasurements.of(q, position, None, joint_names=truth.chain.joint_names, file="b.csv")
    assert isinstance(block, Positions)
    return block


def texts(block: Positions, fitted: Installation) -> list[str]:
    return [found.values["change"] for found in changed_since_fit(fitted, [block], NOISE * np.sqrt(3.0))]


@pytest.mark.parametrize("robot", ["ur5", "iiwa14", "tx40"])
def test_changed_part_is_named(robot):
    fitted = cell(perturb(load(robot), 1, 0.5e-3, 1e-3), 1)
    shift = from_xyz_rpy([8e-4, 0.0, 5e-4], [0.0, 1e-3, 0.0])
    moved = replace(fitted, stations=np.array([shift @ fitted.stations[0]]))
    assert texts(measured(moved, 2), fitted)[0].startswith("the station")
    slipped = replace(fitted, tools=np.array([fitted.tools[0] @ from_xyz_rpy([5e-4, 0.0, -3e-4], [0.0, 0.0, 0.0])]))
    (text,) = texts(measured(slipped, 3), fitted)
    assert text.startswith("the target") and float(text.split()[4]) == pytest.approx(0.583, abs=0.02)
    (text,) = texts(measured(fitted, 4, slip=1.2e-3), fitted)
    assert text.startswith(f"the zero of {fitted.chain.joint_names[2]} changed by +1.")


def test_sound_file_changed_nowhere():
    for seed in range(5):
        fitted = cell(perturb(load("ur5"), seed, 0.5e-3, 1e-3), seed)
        assert texts(measured(fitted, seed), fitted) == []


def test_unlike_arm_names_no_change():
    """Errors all over the arm are no moved station."""
    fitted = cell(perturb(load("ur5"), 1, 0.5e-3, 1e-3), 1)
    other = replace(fitted, chain=perturb(fitted.chain, 2, 0.5e-3, 1e-3))
    assert texts(measured(other, 5), fitted) == []
