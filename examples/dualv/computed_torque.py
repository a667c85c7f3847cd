"""A simulated parallel robot under computed torque, sample by sample.

    w = M̂(x_r) [a_r + ω² J⁺ (q_r - q) + 2 ζ ω J⁺ (q̇_r - q̇)] + ĥ(x_r, v_r)
    τ = J⁺ᵀ w + N c,    within ±τ_max, held over a period

M̂, ĥ and J⁺ = (J_p^inv)⁺ are the controller's, along the reference x_r; c is its preload; q̇ is the backward difference
of the encoders. The robot is integrated by the midpoint rule in the coordinates of its platform, the legs following.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
import run_kernels

from calib.dynamics import rigid_body
from calib.errors import CannotSimulate, UsageError
from calib.records import frozen
from calib.rooms.closed_loop.simulation import added_inertia
from calib.rooms.parallel.mechanism.closure import compiled
from calib.rooms.parallel.mechanism.parallel_model import ParallelModel, along, wrench_regressor
from calib.rooms.parallel.mechanism.velocities import LoopMotion, preload_directions

FAR = 0.3  # [rad or m] between encoders and reference at which a run is given up


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
        CannotSimulate: for a run that leaves its reference.
        UsageError: for other drive terms.
    """
    known, robot = model.known, model.known.robot
    motion = along(known, x, v, a)
    plan = (
        motion.posture.q[:, robot.actuated],
        model.platform_force(controller.values, motion, carried),
        _platform_inertia(model, controller.values, motion, carried),
        np.linalg.pinv(motion.jacobians.readings),
        preload_directions(known, motion.jacobians).sum(axis=2) * controller.preload,
    )
    rng = np.random.default_rng(seed)
    noise, spread = rng.normal(size=(2, len(x), robot.n))
    read, held = np.empty((2, len(x), robot.n))
    omega = 2.0 * np.pi * controller.frequency
    state = (np.array(motion.posture.q[0]), np.array(motion.posture.pose[0]))
    left = run_kernels.run(
        _compiled(model), _parameters(model, values, carried), *state, np.array(motion.rate[0]),
        tuple(np.ascontiguousarray(part) for part in plan), controller.encoder * noise,
        np.array([joint.effort for joint in robot.joints]), np.array([omega**2, 2.0 * controller.damping * omega]),
        1.0 / controller.rate, FAR, read, held,
    )  # fmt: skip
    if left >= 0:
        raise CannotSimulate(
            f"after {left / controller.rate:.3g} s the encoders are more than {FAR:g} away from the reference: too "
            "fast a motion for these torque limits, or too fast a loop for this rate"
        )
    held[1:] = 0.5 * (held[1:] + held[:-1])
    return ParallelRun(np.arange(len(x)) / controller.rate, read, held + controller.torque * spread, plan[0])


def _compiled(model: ParallelModel) -> tuple:
    """Return the arrays that describe the robot to `run_kernels.accelerate`."""
    robot = model.known.robot
    legs = [compiled(leg) for leg in robot.legs]
    kinds = [bodies.links for bodies, _ in legs], [bodies.constants for bodies, _ in legs], [tail for _, tail in legs]
    links, constants, tails, attachments = map(_stacked, (*kinds, [leg.attachment for leg in robot.legs]))
    return (
        frozen(links, np.int64), frozen(constants), frozen(tails), frozen(attachments), robot.starts,
        np.array([leg.held for leg in robot.legs]), robot.selected, robot.actuated, robot.gravity, model.known.fixed,
    )  # fmt: skip


def _stacked(arrays: list[np.ndarray]) -> np.ndarray:
    """Return arrays stacked along a new first axis, each padded with zeros to the largest shape."""
    result = np.zeros((len(arrays), *np.max([array.shape for array in arrays], axis=0)))
    for k, array in enumerate(arrays):
        result[(k, *map(slice, array.shape))] = array
    return result


def _parameters(model: ParallelModel, values: np.ndarray, carried: Collection[str] | None) -> tuple:
    """Return the arrays that describe the parameters to `run_kernels.accelerate`."""
    drives = np.zeros((int(model.known.robot.starts[-1]), 5))
    drives[:, 4] = 1.0
    for one, value in zip(model.terms, values[model.inertial :]):
        joint = one.joint
        if one.shape not in _SIMULATED or joint is None:
            raise UsageError(f"term '{one.name}' ({one.shape}) cannot be simulated on a parallel robot")
        drives[joint, _SIMULATED[one.shape]] += value
        if one.shape == "sign":
            drives[joint, 4] = max(one.settings[0], 1e-9)
    legs = zip(model.legs, model.leg_parameters(values))
    own = [rigid_body.kernel_parameters(bodies, parameters) for (bodies, *_), parameters in legs]
    return _stacked(own), model.platform_parameters(values, carried), drives


_SIMULATED = {"acceleration": 0, "velocity": 1, "sign": 2, "one": 3}


def _platform_inertia(
    model: ParallelModel, values: np.ndarray, motion: LoopMotion, carried: Collection[str] | None = None
) -> np.ndarray:
    """Return M (N, r, r) = Σ J_kᵀ M_k J_k + Dᵀ M_platform D, the inertia that the platform's coordinates feel."""
    robot, J = model.known.robot, motion.jacobians
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
