"""The LWR4+ with a target off its flange: what measured poses, or positions, tell of it, for pose selection."""

import numpy as np

from calib.geometry.observability import observation, targets_of
from calib.robot.library import load

CHAIN = load("lwr4plus")
LOWER, UPPER = (np.array([getattr(joint, end) for joint in CHAIN.joints]) for end in ("lower", "upper"))
jacobian, point_jacobian = (
    observation(targets_of(CHAIN, [(0.05, 0.02, 0.11)]), kind, (5e-5, 2e-4)) for kind in ("pose", "position")
)


def random_poses(count: int, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform(LOWER, UPPER, (count, len(LOWER)))
