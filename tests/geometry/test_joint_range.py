"""σ over the whole range of the joints, by a fit to poses of a part of it."""

import numpy as np
import pytest
from planted import cell, load, perturb, position_error, random_joints

from calib.data.poses.measurements import PoseMeasurements
from calib.geometry.checks.joint_range import JointRange, joint_range, sigma_at
from calib.geometry.first_guess import install
from calib.geometry.fit import fit, polish_frames
from calib.geometry.installation import see
from calib.geometry.observation import layout
from calib.procedure.findings import level_of
from calib.procedure.kinematic_stage.verdict.plausibility import of_range

MIDDLE = np.array([0.2, -1.0, 1.4, -0.7, 0.9, 0.3])
NOISE = 2e-5


def fitted(wide: float, seed: int, rows: int = 60):
    """Return the fit to poses within ±`wide` [rad] of one posture, the placed nominal arm, and the truth."""
    truth = cell(perturb(load("ur5"), seed, 0.5e-3, 1e-3), seed)
    rng = np.random.default_rng(seed)
    q = MIDDLE + rng.uniform(-wide, wide, (rows, 6))
    position = see(truth, q).point.T + NOISE * rng.standard_normal((rows, 3))
    block = PoseMeasurements.of(q, position, joint_names=truth.chain.joint_names)
    start = polish_frames(install(load("ur5"), [block]), [block]).cell
    return fit(start, [block], layout(start).rigid_index), start, truth


@pytest.mark.parametrize(
    "wide",
    [
        0.25,
        pytest.param(0.5, marks=pytest.mark.slow),
        pytest.param(1.0, marks=pytest.mark.slow),
        pytest.param(3.0, marks=pytest.mark.slow),
    ],
)
def test_sigma_over_range_is_the_error(wide):
    """Rms over seeds: one arm's error varies."""
    q = random_joints(load("ur5"), 300, 1)
    errors, sigmas = [], []
    for seed in range(4):
        found, _, truth = fitted(wide, seed)
        errors.append(np.sqrt(np.mean(position_error(found.cell, truth, q) ** 2)))
        sigmas.append(np.sqrt(np.mean(sigma_at(found.cell, found, q) ** 2)))
    assert 0.4 < np.sqrt(np.mean(np.square(errors)) / np.mean(np.square(sigmas))) < 2.5


def levels(held: JointRange, tolerance: float | None) -> dict[str, str]:
    return {one.code: level_of(one) for one in of_range(held, tolerance)}


@pytest.mark.parametrize("tolerance", [None, 3e-4])
def test_one_corner_is_marginal(tolerance):
    """One corner is marginal, and the whole range is not."""
    small, wide = (joint_range(*fitted(each, 5)[:2]) for each in (0.1, 3.0))
    assert levels(small, tolerance) == {"measured-range": "note", "small-range": "marginal"}
    assert levels(wide, tolerance) == {"measured-range": "note", "small-range": ""}
    assert max(small.shares) < 0.04 and min(wide.shares) > 0.8
    np.testing.assert_allclose([small.lower, small.upper], [MIDDLE - 0.1, MIDDLE + 0.1], atol=0.02)


def test_still_joint_counts_where_it_stood():
    """Locked axes of redundant arms and external axes that are not used."""
    found, start, _ = fitted(3.0, 6)
    (block,) = (each.measured for each in found.blocks)
    q = block.q.copy()
    q[:, 0] = 0.3
    still = PoseMeasurements.of(q, see(found.cell, q).point.T, joint_names=block.joint_names)
    held = joint_range(fit(start, [still], layout(start).rigid_index), start)
    assert held.moved == [1, 2, 3, 4, 5] and held.sigma is not None and held.sigma < 1e-3
