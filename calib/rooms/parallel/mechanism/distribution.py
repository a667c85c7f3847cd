"""Torques of redundant actuators: their share of the work, and the overconstraint that does none.

    τ = (J_p^invᵀ)⁺ w + N c,    J_p^invᵀ N = 0,    c = Nᵀ τ

w is what the platform's coordinates need, c is free: an internal preload, which takes the play out of the gears (Müller
2005; eqs 19-20 of Briot, Gautier & Krut 2013).
"""

from __future__ import annotations

import numpy as np

from calib.arrays import shaped
from calib.rooms.parallel.mechanism.closure import ClosedRobot
from calib.rooms.parallel.mechanism.velocities import LoopJacobians, loop_jacobians


def preload_directions(known: ClosedRobot, jacobians: LoopJacobians) -> np.ndarray:
    """Return N (N, n, n - r), orthonormal torques without effect on the platform.

    Their signs are those of home carried along, so that a constant preload does not jump; with more than one redundant
    actuator the basis is the one nearest to home's (Procrustes).
    """
    robot = known.robot
    found = _left_null(jacobians.readings, robot.r)
    home = _left_null(loop_jacobians(known, known.home).readings, robot.r)[0]
    if home.shape[1] and home[np.argmax(np.abs(home[:, 0])), 0] < 0:
        home = -home
    u, _, vt = np.linalg.svd(found.transpose(0, 2, 1) @ home)
    return found @ (u @ vt)


def overconstraint(known: ClosedRobot, jacobians: LoopJacobians, torques: np.ndarray) -> np.ndarray:
    """Return c (N, n - r) [N m or N] of actuator torques (N, n): what of them does no work."""
    torques = shaped(torques, (len(jacobians.readings), known.robot.n), "torques of the actuators")
    return np.einsum("nac,na->nc", preload_directions(known, jacobians), torques)


def distributed(
    known: ClosedRobot, jacobians: LoopJacobians, forces: np.ndarray, preload: np.ndarray | float = 0.0
) -> np.ndarray:
    """Return actuator torques (N, n) that give forces (N, r) on the platform's coordinates, with overconstraint c.

    Args:
        preload: c, (N, n - r) or one for all [N m or N]; 0: the torques of least norm.
    """
    least = np.einsum("nar,nr->na", np.linalg.pinv(jacobians.readings).transpose(0, 2, 1), forces)
    if not known.robot.redundant:
        return least
    N = preload_directions(known, jacobians)
    return least + np.einsum("nac,nc->na", N, np.broadcast_to(preload, (len(N), N.shape[2])))


def _left_null(A: np.ndarray, rank: int) -> np.ndarray:
    """Return an orthonormal basis (N, n, n - r) of the left null space of A (N, n, r)."""
    return np.linalg.svd(A)[0][:, :, rank:]
