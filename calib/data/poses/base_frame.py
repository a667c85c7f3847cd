"""A frame on the robot's base measured beside the target: what is relative to it does not care for the instrument.

The study (Kolyubin et al. 2019, section 3.5) marks the base with LEDs of its own, so that the camera may be moved
between series. Both measurements are noisy, and the base's orientation noise acts over the distance to the target.
"""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from calib.data.poses.measurements import Poses, Positions


def relative_to_base(block: Positions, position: np.ndarray, quaternion: np.ndarray) -> Positions:
    """Return the block as seen from the base frame that was measured with every row.

        p = R_bᵀ (p_t - p_b),   R = R_bᵀ R_t
        Σ_p = R_bᵀ (Σ_t + Σ_b + [l]× Σ_rb [l]×ᵀ) R_b,  l = p_t - p_b;   Σ_r = R_bᵀ (Σ_rt + Σ_rb) R_b

    The base is taken to be measured as well as the target: the same sigmas. Of the covariances the diagonals are kept.

    Args:
        block: positions or poses, in the instrument's frame.
        position: (m, 3) of the base frame [m].
        quaternion: (m, 4) of the base frame, x y z w, unit norm.
    """
    base = Rotation.from_quat(quaternion)
    lever = block.position - position
    turn = base.inv().as_matrix()
    changes: dict[str, np.ndarray] = {"position": base.inv().apply(lever)}
    stated = block.sigma_rotation if isinstance(block, Poses) else None
    if isinstance(block, Poses):
        changes["quaternion"] = (base.inv() * Rotation.from_quat(block.quaternion)).as_quat(canonical=True)
    if stated is not None:
        changes["sigma_rotation"] = _turned(turn, 2.0 * _diagonal(stated))
    if block.sigma is not None:
        covariance = 2.0 * _diagonal(block.sigma)
        if stated is not None:
            cross = _cross(lever)
            covariance = covariance + cross @ _diagonal(stated) @ np.swapaxes(cross, 1, 2)
        changes["sigma"] = _turned(turn, covariance)
    note = (
        "positions are relative to the base frame measured with each row; its noise is counted as large as the target's"
    )
    return replace(block, notes=(*block.notes, note), **changes)


def _diagonal(sigma: np.ndarray) -> np.ndarray:
    return np.einsum("mi,ij->mij", sigma**2, np.eye(3))


def _turned(turn: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Return the standard deviations (m, 3) of covariances (m, 3, 3) in turned axes."""
    return np.sqrt(np.einsum("mij,mjk,mik->mi", turn, covariance, turn))


def _cross(vectors: np.ndarray) -> np.ndarray:
    """Return [l]× (m, 3, 3) of vectors (m, 3)."""
    result = np.zeros((len(vectors), 3, 3))
    x, y, z = vectors.T
    result[:, 0, 1], result[:, 0, 2], result[:, 1, 2] = -z, y, -x
    return result - np.swapaxes(result, 1, 2)
