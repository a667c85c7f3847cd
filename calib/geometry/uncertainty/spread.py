"""How well a fit knows where the tool is: the covariance of its parameters, propagated to poses."""

import numpy as np

from calib.data.poses.measurements import PoseMeasurements
from calib.geometry.installation import Installation
from calib.geometry.observation import Block, predict, target_jacobian
from calib.robot.calibrated import evaluate, extra_displacements


def pose_sigmas(
    cell: Installation,
    q: np.ndarray,
    free: np.ndarray,
    covariance: np.ndarray,
    torque: np.ndarray | None = None,
    station: int = 0,
    tool: np.ndarray | int = 0,
) -> np.ndarray:
    """Return sigmas (m, 2) of a tool's position [m] and orientation [rad]: sqrt(trace J Σ Jᵀ) of each.

    Args:
        cell: the fitted installation.
        q: (m, n) [rad or m].
        free: (f,) positions in the parameter vector (`calib.geometry.parameters`).
        covariance: (f, f) of steps along them.
        torque: (m, n) gravity torques [N m], for compliance terms.
        station: seen from which station; -1 for the arm's base.
        tool: which of its tools, one or (m,).
    """
    values, vectors = np.linalg.eigh(covariance)
    root = vectors * np.sqrt(np.clip(values, 0.0, None))
    parts = [np.zeros((0, 2))]
    chunk = 500  # poses at once: the Jacobian has a column per parameter
    for first in range(0, len(q), chunk):
        rows = slice(first, first + chunk)
        some = None if torque is None else torque[rows]
        parts.append(_sigmas(cell, q[rows], free, root, some, station, np.broadcast_to(tool, len(q))[rows]))
    return np.concatenate(parts)


def _sigmas(
    cell: Installation,
    q: np.ndarray,
    free: np.ndarray,
    root: np.ndarray,
    torque: np.ndarray | None,
    station: int,
    tool: np.ndarray,
) -> np.ndarray:
    m = len(q)
    rows = PoseMeasurements(q, cell.chain.joint_names)
    known = evaluate(cell.known, q, torque) if cell.known.terms else None
    given = extra_displacements(cell.chain, cell.known, q, known)
    block = Block(rows, station, tool, torque, evaluate(cell.deflection, q, torque), given)
    jacobian = target_jacobian(cell, predict(cell, block), free, block.station, block.tool, block.bases)
    spread = (root.T @ jacobian.reshape(len(free), 6 * m)).reshape(-1, 6, m)
    return np.sqrt(np.stack([np.sum(spread[:, :3] ** 2, axis=(0, 1)), np.sum(spread[:, 3:] ** 2, axis=(0, 1))], axis=1))
