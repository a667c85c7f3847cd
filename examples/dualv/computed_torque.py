"""A simulated parallel robot under computed torque.

    w = M̂(x_r) [ω² J⁺ (q_r - q) + 2 ζ ω J⁺ (q̇_r - q̇)] + ŵ(x_r, v_r, a_r)
    τ = J⁺ᵀ w + N c,    within ±τ_max, held over a period

M̂, ŵ and J⁺ = (J_p^inv)⁺ are the controller's, along the reference x_r; c is its preload; q̇ and q̇_r are backward
differences. The robot is simulated by `calib.parallel.mechanism.mechanism_simulation`.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace

import numpy as np

from calib.dynamics import rigid_body
from calib.identification.closed_loop.simulation import added_inertia
from calib.parallel.mechanism.mechanism_simulation import ParallelPlant
from calib.parallel.mechanism.parallel_model import ParallelModel, along
from calib.parallel.mechanism.platform_columns import wrench_regressor
from calib.parallel.mechanism.velocities import LoopMotion
from calib.toolkit.simulations import LoopController, Reference, Sensing


@dataclass(frozen=True, eq=False)
class ComputedTorque:
    """A computed-torque controller and its sensors.

    Attributes:
        values: (p,) parameters of its model.
        frequency: ω / 2π of the closed loop [Hz]; damping: ζ.
        preload: c, overconstraint of the actuators [N m or N].
        rate: of control and of the log [Hz].
        encoder, torque: standard deviations of white noise, of a reading [rad or m] (the controller sees it) and of a
            logged torque [N m or N].
    """

    values: np.ndarray
    frequency: float = 15.0
    damping: float = 0.8
    preload: float = 0.0
    rate: float = 1000.0
    encoder: float = 0.0
    torque: float = 0.0


@dataclass(frozen=True, eq=False)
class ParallelRun:
    """Log of a simulated run; each series is (N, n).

    Attributes:
        t: (N,) [s].
        q, tau: readings and torques as measured; a torque is the mean of those held before and after its instant.
        reference: what the encoders should have read.
    """

    t: np.ndarray
    q: np.ndarray
    tau: np.ndarray
    reference: np.ndarray


def simulate(
    model: ParallelModel, values: np.ndarray, controller: ComputedTorque, x: np.ndarray, v: np.ndarray, a: np.ndarray,
    carried: Collection[str] | None = None, seed: int = 0,
) -> ParallelRun:  # fmt: skip
    """Return the log of a simulated robot that follows a reference motion.

    Args:
        model, values: the robot's, (p,); Ia, Fv, Fc, off are the drive terms it may have.
        x, v, a: (N, r) reference of the platform's coordinates at the controller's rate.
        carried: payloads on board; the controller knows of them what its `values` say.
        seed: of the noise.

    Raises:
        NotConverged: for a run that leaves its reference.
    """
    robot, motion = model.mechanism.robot, along(model.mechanism, x, v, a)
    q, t = motion.posture.q[:, robot.actuated], np.arange(len(x)) / controller.rate
    speed = np.vstack([motion.v[:1, robot.actuated], np.diff(q, axis=0) * controller.rate])
    preload = replace(model, preload=(controller.preload,) * (robot.n - robot.r))
    ahead = preload.actuator_torques(controller.values, motion, carried)
    back = np.linalg.pinv(motion.jacobians.readings)
    inertia = _platform_inertia(model, controller.values, motion, carried)
    omega, ones = 2.0 * np.pi * controller.frequency, np.ones(robot.n)
    law = LoopController(
        omega**2 * ones, 2.0 * controller.damping * omega * ones, 0.0 * ones, ones,
        np.array([joint.effort for joint in robot.joints]), np.inf * ones, ahead=ahead,
    )  # fmt: skip
    plant = ParallelPlant(model, values, carried)
    sensing = Sensing(controller.encoder, sigma_tau=controller.torque)
    reference = Reference(t, q, speed, np.zeros_like(q))
    run = plant.run(law, reference, sensing, seed, back.transpose(0, 2, 1) @ inertia @ back)
    between = np.vstack([run.torque[:1], 0.5 * (run.torque[1:] + run.torque[:-1])])
    return ParallelRun(t, run.measured, between + run.tau - run.torque, q)


def _platform_inertia(
    model: ParallelModel, values: np.ndarray, motion: LoopMotion, carried: Collection[str] | None = None
) -> np.ndarray:
    """Return M (N, r, r) = Σ J_kᵀ M_k J_k + Dᵀ M_platform D, the inertia that the platform's coordinates feel."""
    robot, J = model.mechanism.robot, motion.jacobians
    drives = added_inertia(model.terms, values[model.inertial :], int(robot.starts[-1]))
    result = J.joints.transpose(0, 2, 1) @ drives @ J.joints
    for (bodies, joints, _), parameters in zip(model.legs, model.leg_parameters(values)):
        own, q = J.joints[:, joints], motion.posture.q[:, joints]
        result += own.transpose(0, 2, 1) @ rigid_body.mass_matrix(bodies, parameters, q) @ own
    fixed, still = model.platform_parameters(values, carried), np.zeros_like(motion.twist)
    for i in range(robot.r):
        need = wrench_regressor(motion.posture.pose, still, J.platform[:, :, i], np.zeros(3)) @ fixed
        result[:, :, i] += np.einsum("nkr,nk->nr", J.platform, need)
    return result
