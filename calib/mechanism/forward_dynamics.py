"""Forward dynamics of a parallel robot in the coordinates of its platform.

M(x) v̇ = J_p^invᵀ τ - h(x, v),    M = Σ J_kᵀ M_k J_k + Dᵀ M_platform D
"""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from calib.dynamics import rigid_body
from calib.dynamics.drives import added_inertia
from calib.errors import CalibError
from calib.mechanism.leg_links import Posture
from calib.mechanism.parallel_model import ParallelModel
from calib.mechanism.platform_body import wrench_regressor
from calib.mechanism.velocities import LoopMotion, of_platform


def platform_inertia(
    model: ParallelModel, values: np.ndarray, motion: LoopMotion, carried: Collection[str] | None = None
) -> np.ndarray:
    """Return M (N, r, r), the inertia that the platform's coordinates feel."""
    robot, J = model.known.robot, motion.jacobians
    drives = added_inertia(model.terms, values[model.inertial :], int(robot.starts[-1]))
    result = J.joints.transpose(0, 2, 1) @ drives @ J.joints
    parts = zip(model.leg_bodies, model.leg_parameters(values), robot.starts, robot.starts[1:])
    for bodies, parameters, a, b in parts:
        own = J.joints[:, a:b]
        result += own.transpose(0, 2, 1) @ rigid_body.mass_matrix(bodies, parameters, motion.posture.q[:, a:b]) @ own
    fixed, still = model.platform_parameters(values, carried), np.zeros_like(motion.twist)
    for i in range(robot.r):
        need = wrench_regressor(motion.posture.pose, still, J.platform[:, :, i], np.zeros(3)) @ fixed
        result[:, :, i] += np.einsum("nkr,nk->nr", J.platform, need)
    return result


def platform_acceleration(
    model: ParallelModel, values: np.ndarray, posture: Posture, rate: np.ndarray, torques: np.ndarray,
    carried: Collection[str] | None = None,
) -> tuple[np.ndarray, LoopMotion]:  # fmt: skip
    """Return v̇ (N, r) under actuator torques (N, n) at v = `rate` (N, r), and the motion at v̇ = 0.

    Raises:
        CalibError: for parameters of no possible robot, whose inertia is not positive.
    """
    motion = of_platform(model.known, posture, rate, np.zeros_like(rate))
    M = platform_inertia(model, values, motion, carried)
    if not (np.linalg.eigvalsh(M)[:, 0] > 0.0).all():
        raise CalibError("the platform's inertia is not positive: these parameters belong to no possible robot")
    forces = np.einsum("nar,na->nr", motion.jacobians.readings, torques)
    forces -= model.platform_force(values, motion, carried)
    return np.linalg.solve(M, forces[:, :, None])[:, :, 0], motion
