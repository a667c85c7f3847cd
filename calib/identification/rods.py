"""Rods between the joints: what is known of the masses of a robot whose description holds none."""

import numpy as np

from calib.dynamics import pseudo_inertia
from calib.dynamics.idim import IdentificationModel
from calib.robot.chain import Chain

RADIUS = 0.1  # [m] of the balls that rods are made of
PAYLOAD = (2.0, 0.1)  # [kg, m]


def rods(chain: Chain, model: IdentificationModel, total: float = 1.0) -> np.ndarray:
    """Return rods (B, 10) from each body's frame to the next one's, mass by length and thickness; `total` [kg]."""
    arm = model.bodies
    ends = np.array([np.asarray(chain.tail)[:3, 3]] * arm.count)
    for i, parent in enumerate(arm.parents):
        if parent >= 0 and arm.coordinates[i] >= 0:
            ends[parent] = arm.placements[i][:3, 3]
    moving = arm.coordinates >= 0
    share = np.where(moving, np.linalg.norm(ends, axis=1) + 2 * RADIUS, 0.0)
    masses = total * share / share.sum()
    return np.array(
        [
            pseudo_inertia.rod(mass, end, RADIUS) if moves else pseudo_inertia.ball(*PAYLOAD)
            for mass, end, moves in zip(masses, ends, moving)
        ]
    )
