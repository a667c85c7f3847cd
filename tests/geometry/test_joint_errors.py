"""A joint with a factor, and random errors of joints, are named; other effects and sound files are not."""

import numpy as np
import pytest
from planted import cell, load, perturb, random_joints

from calib.data.poses.measurements import PoseMeasurements, Positions
from calib.geometry.checks.joint_errors import joint_factors, joint_scatter, scatter_finding
from calib.geometry.first_guess import install
from calib.geometry.fit import polish_frames
from calib.geometry.installation import see
from calib.geometry.weighing import GeometricFit

NOISE = 2e-5
ROWS = 60


def fitted(read: np.ndarray, moved: np.ndarray, seed: int, robot: str = "ur5", noise: float = NOISE) -> GeometricFit:
    """Return the fit of rows whose joints are read as `read` (m, n), but stood at `moved` (m, n)."""
    truth = cell(perturb(load(robot), seed, 0.5e-3, 1e-3), seed)
    position = see(truth, moved).poses()[:, :3, 3]
    position = position + noise * np.random.default_rng(seed).standard_normal(position.shape)
    block = PoseMeasurements.of(read, position, None, joint_names=truth.chain.joint_names, file="day.csv")
    assert isinstance(block, Positions)
    return polish_frames(install(load(robot), [block]), [block])


def joints(seed: int, robot: str = "ur5", rows: int = ROWS) -> np.ndarray:
    return random_joints(load(robot), rows, seed)


@pytest.mark.parametrize(("robot", "joint", "factor"), [("ur5", 4, 1.01), ("ur5", 0, 1.0005), ("iiwa14", 3, 0.995)])
def test_wrong_gear_ratio_is_named_with_its_factor(robot, joint, factor):
    q = joints(1, robot)
    read = q.copy()
    read[:, joint] /= factor
    (found,) = joint_factors(fitted(read, q, 1, robot))
    assert found.code == "joint-factor" and found.values["joint"] == load(robot).joint_names[joint]
    assert found.values["factor"] == pytest.approx(factor, abs=0.02 * abs(factor - 1.0) + 4 * found.values["sigma"])
    assert found.values["after"] < 5 * NOISE


@pytest.mark.parametrize("effect", ["harmonic", "coupling", "nothing"])
def test_other_effects_are_no_factor(effect):
    """An eccentric encoder and a coupled joint are no gear ratio."""
    q = joints(2)
    moved = q.copy()
    if effect == "harmonic":
        moved[:, 2] += 2e-3 * np.sin(q[:, 2])
    if effect == "coupling":
        moved[:, 4] += 1e-3 * q[:, 3]
    assert joint_factors(fitted(q, moved, 2)) == []


def test_small_range_is_no_factor():
    """Within a few degrees a factor cannot be told from a harmonic."""
    q = 0.5 + 0.05 * joints(3)
    read = q.copy()
    read[:, 4] /= 1.05
    assert joint_factors(fitted(read, q, 3)) == []


@pytest.mark.parametrize("degrees", [0.05, 0.3])
def test_random_joint_errors_are_named(degrees):
    q = joints(4)
    read = q + np.radians(degrees) * np.random.default_rng(4).standard_normal(q.shape)
    scatter = joint_scatter(fitted(read, q, 4))
    assert scatter is not None and not scatter.step
    assert scatter.sigma == pytest.approx(np.radians(degrees), rel=0.5)
    assert scatter_finding(scatter).values["step"] is None


def test_rounded_joints_are_named_with_their_step():
    q = joints(5)
    step = np.radians(0.1)
    scatter = joint_scatter(fitted(step * np.round(q / step), q, 5))
    assert scatter is not None and scatter.step == pytest.approx(step)


@pytest.mark.parametrize("seeds", [range(3), pytest.param(range(3, 30), marks=pytest.mark.slow)])
def test_noise_of_an_instrument_is_no_joint_error(seeds):
    for seed in seeds:
        q = joints(seed)
        fit = fitted(q, q, seed, noise=1e-3)
        assert joint_scatter(fit) is None and joint_factors(fit) == []
