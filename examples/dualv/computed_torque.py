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
        frequency: ω / 2π of the closed loop [Hz].
        damping: ζ of the closed loop.
        preload: c, overconstraint of the actuators [N m or N].
        rate: of control and of the log [Hz].
        encoder: standard deviation of a reading's white noise [rad or m], which the controller sees.
        torque: standard deviation of a logged torque's white noise [N m or N].
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
    model: ParallelModel,
    values: np.ndarray,
    controller: ComputedTorque,
    x: np.ndarray,
    v: np.ndarray,
    a: np.ndarray,
    carried: Collection[str] | None = None,
    seed: int = 0,
) -> ParallelRun:
    """Return the log of a simulated robot that follows a reference motion.

    Args:
        model: the robot; Ia, Fv, Fc, off are the drive terms it may have.
        values: (p,) its parameters.
        controller: the controller and its sensors.
        x, v, a: (N, r) reference of the platform's coordinates at the controller's rate.
        carried: payloads on board; the controller knows of them what its `values` say.
        seed: of the noise.

    Raises:
        NotConverged: for a run that leaves its reference.
    """
    motion = along(model.mechanism, x, v, a)
    reference = _actuator_reference(model, motion, controller.rate)
    law = _control_law(model, controller, motion, carried)
    gains = _actuator_inertia(model, controller.values, motion, carried)
    plant = ParallelPlant(model, values, carried)
    sensing = Sensing(controller.encoder, sigma_tau=controller.torque)
    run = plant.run(law, reference, sensing, seed, gains)
    # A logged torque is the mean of those held before and after its instant.
    mean = 0.5 * (run.torque[1:] + run.torque[:-1])
    torque = np.vstack([run.torque[:1], mean])
    noise = run.tau - run.torque
    return ParallelRun(reference.t, run.measured, torque + noise, reference.q)


def _actuator_reference(model: ParallelModel, motion: LoopMotion, rate: float) -> Reference:
    """Return the reference of the actuators, with backward differences as velocities.

    Args:
        model: the robot.
        motion: the reference motion of the mechanism, at the controller's rate.
        rate: rate of the controller [Hz].
    """
    actuated = model.mechanism.robot.actuated
    q = motion.posture.q[:, actuated]
    differences = np.diff(q, axis=0) * rate
    v = np.vstack([motion.v[:1, actuated], differences])
    t = np.arange(len(q)) / rate
    return Reference(t, q, v, np.zeros_like(q))


def _control_law(
    model: ParallelModel, controller: ComputedTorque, motion: LoopMotion, carried: Collection[str] | None
) -> LoopController:
    """Return feedback as accelerations, and feed-forward by the controller's model along the reference.

    Args:
        model: the robot.
        controller: the controller.
        motion: the reference motion of the mechanism.
        carried: payloads on board.
    """
    robot = model.mechanism.robot
    preloaded = replace(model, preload=(controller.preload,) * (robot.n - robot.r))
    ahead = preloaded.actuator_torques(controller.values, motion, carried)
    omega = 2.0 * np.pi * controller.frequency
    ones = np.ones(robot.n)
    kp = omega**2 * ones
    kd = 2.0 * controller.damping * omega * ones
    effort = np.array([joint.effort for joint in robot.joints])
    return LoopController(kp, kd, 0.0 * ones, ones, effort, np.inf * ones, ahead=ahead)


def _actuator_inertia(
    model: ParallelModel, values: np.ndarray, motion: LoopMotion, carried: Collection[str] | None
) -> np.ndarray:
    """Return J⁺ᵀ M̂ J⁺ (N, n, n), from the actuators' accelerations to their torques."""
    inverse = np.linalg.pinv(motion.jacobians.readings)
    inertia = _platform_inertia(model, values, motion, carried)
    return inverse.transpose(0, 2, 1) @ inertia @ inverse


def _platform_inertia(
    model: ParallelModel, values: np.ndarray, motion: LoopMotion, carried: Collection[str] | None = None
) -> np.ndarray:
    """Return M (N, r, r) = Σ J_kᵀ M_k J_k + Dᵀ M_platform D, the inertia that the platform's coordinates feel."""
    robot = model.mechanism.robot
    J = motion.jacobians
    drives = added_inertia(model.terms, values[model.inertial :], int(robot.starts[-1]))
    inertia = J.joints.transpose(0, 2, 1) @ drives @ J.joints
    for (bodies, joints, _), parameters in zip(model.legs, model.leg_parameters(values)):
        leg_jacobian = J.joints[:, joints]
        mass_matrix = rigid_body.mass_matrix(bodies, parameters, motion.posture.q[:, joints])
        inertia += leg_jacobian.transpose(0, 2, 1) @ mass_matrix @ leg_jacobian
    # The platform's wrench at rest, without gravity, under a unit acceleration of each coordinate.
    parameters = model.platform_parameters(values, carried)
    at_rest = np.zeros_like(motion.twist)
    no_gravity = np.zeros(3)
    for i in range(robot.r):
        regressor = wrench_regressor(motion.posture.pose, at_rest, J.platform[:, :, i], no_gravity)
        inertia[:, :, i] += np.einsum("nkr,nk->nr", J.platform, regressor @ parameters)
    return inertia
