"""Unmodelled effects of real arms: errors of position and torque that no parameter of this toolkit describes.

Errors of position, of joint j at the i-th pose of a series,

    δ_j = a_j sin(2 q_j + q_{j+1} + φ_j)              the gear's error depends on the next joint, too
        + a_j τ_j / τ_max,j sin(3 q_j + ψ_j)          and on its load (gravity torque τ_j)
        - b_j sign(q_j,i - q_j,i-1),                  backlash: the side from which the joint came

all lengths grow by g (1 - exp(-i / i_0)) as the arm warms up, and the tool droops by d, turning with gravity.

Torques at the motor of joint j besides the drives that a model can have,

    τ_j = Σ_k f_k,j z_k,j / s_k                       friction with memory: elasto-plastic elements in parallel
        - w (1 - exp(-t / t_0)) (Fv_j v_j + Fc_j sign v_j)      friction falls as the gears warm up
        + r τ_j sin(N q_j)                            ripple of the gear that grows with the torque

with z_k' = v_j while |z_k| < s_k (Iwan 1966; the friction ladder's stops are of the same kind, their widths shares of
the travel), and on the link's side the spring of a cable, c_j tanh(q_j / 0.5 rad).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.robot.chain import Chain, random_joints
from calib.robot.kinematics import gravity_torques

WARM_POSES, WARM_TIME = 30.0, 120.0  # i_0 [poses], t_0 [s]
WIDTHS = (2e-3, 8e-3, 30e-3)  # s_k [rad or m]
TEETH = 100  # N
CABLE = 0.5  # [rad]


def _named(effects: Sequence[tuple[float, str]]) -> str:
    """Return the names of all effects with a size above 0, as the end of a sentence; empty without any."""
    names = ", ".join(description for size, description in effects if size)
    return f"; unmodelled: {names}" if names else ""


@dataclass(frozen=True)
class PositionErrors:
    """Sizes of the simulated position errors.

    Attributes:
        gear: a, of the two gear errors each [rad; 0.3 of it in m for a prismatic joint].
        backlash: b [rad].
        growth: g, of all lengths when warm.
        droop: d [m].
        seed: of the phases and of the direction in which the tool gives way.
    """

    gear: float = 0.0
    backlash: float = 0.0
    growth: float = 0.0
    droop: float = 0.0
    seed: int = 0

    @property
    def note(self) -> str:
        """What they are, as the end of a sentence; empty where there are none."""
        parts = [
            (self.gear, f"gear errors of {self.gear * 1e3:.2g} mrad that depend on load and on the next joint"),
            (self.backlash, f"backlash of ±{self.backlash * 1e3:.2g} mrad"),
            (self.growth, f"lengths growing by {self.growth * 1e6:.0f} ppm"),
            (self.droop, f"a tool drooping by up to {self.droop * 1e3:.2g} mm"),
        ]
        return _named(parts)


def displacements(
    errors: PositionErrors, chain: Chain, q: np.ndarray, torque: np.ndarray, warm: float = 0.0
) -> np.ndarray:
    """Return the error (K, m) [rad or m] that the effects add to each element of a chain.

    Args:
        errors: their sizes.
        chain: the true arm of n joints.
        q: (m, n) joint values of a series in its order [rad or m].
        torque: (m, n) gravity torques [N m or N].
        warm: how many poses the arm has moved to before; infinite for a warm arm.
    """
    rng = np.random.default_rng([errors.seed, 11])
    phases = rng.uniform(0.0, 2.0 * np.pi, (2, chain.n))
    joint_scale = np.array([1.0 if joint.kind == "revolute" else 0.3 for joint in chain.joints])
    next_joint = q[:, (np.arange(chain.n) + 1) % chain.n]
    load = torque / _largest_load(chain)
    side = np.sign(np.diff(q, axis=0, prepend=0.0))
    gear_error = errors.gear * (np.sin(2.0 * q + next_joint + phases[0]) + load * np.sin(3.0 * q + phases[1]))
    result = np.zeros((len(chain.elements), len(q)))
    result[chain.moving] = (joint_scale * (gear_error - errors.backlash * side)).T
    lengths = np.array([element.axis[0] == "t" for element in chain.elements])
    heat = 1.0 - np.exp(-(warm + np.arange(len(q))) / WARM_POSES)
    result[lengths] += errors.growth * np.outer(chain.values[lengths], heat)
    return result


def _largest_load(chain: Chain) -> np.ndarray:
    """Return the largest gravity torque (n,) [N m or N] of each joint; 1 for joints without gravity load."""
    if chain.inertias is None:
        return np.ones(chain.n)
    largest = np.abs(gravity_torques(chain, random_joints(chain, 200, 0))).max(axis=0)
    return np.where(largest > 1e-6, largest, 1.0)


def drooping(errors: PositionErrors, chain: Chain, poses: np.ndarray, base: np.ndarray) -> np.ndarray:
    """Return tool poses (m, 4, 4) shifted by the droop of the tool under gravity.

    Args:
        errors, chain: as for `displacements`.
        poses: (m, 4, 4) of the tool in the station's frame [m].
        base: (4, 4) of the arm's base in the station's frame.
    """
    droop_direction = np.random.default_rng([errors.seed, 13]).uniform(0.2, 1.0, 3)
    down = base[:3, :3] @ (chain.gravity / max(float(np.linalg.norm(chain.gravity)), 1e-9))
    result, turn = poses.copy(), poses[:, :3, :3]
    result[:, :3, 3] += errors.droop * np.einsum("mij,j,mkj,k->mi", turn, droop_direction, turn, down)
    return result


@dataclass(frozen=True)
class TorqueErrors:
    """Sizes of the simulated torque errors; zero by default.

    Attributes:
        memory: Σ_k f_k, of the Coulomb friction.
        warming: w.
        ripple: r.
        cable: c, of the torque limit.
        push: σ of a torque that acts and is not recorded, of the torque limit.
    """

    memory: float = 0.0
    warming: float = 0.0
    ripple: float = 0.0
    cable: float = 0.0
    push: float = 0.0

    @property
    def note(self) -> str:
        """What they are, as the end of a sentence; empty where there are none."""
        parts = [
            (self.memory, f"friction hysteresis (presliding), {self.memory:.0%} of Fc"),
            (self.warming, f"friction falling by {self.warming:.0%} as it warms up"),
            (self.ripple, f"ripple of {self.ripple:.1%} of the torque"),
            (self.cable, f"cables of {self.cable:.1%} of the limits"),
            (self.push, f"pushes of {self.push:.1%} of the limits"),
        ]
        return _named(parts)

    def cable_torques(self, q: np.ndarray, effort: np.ndarray) -> np.ndarray:
        """Return the torques (N, n) of the cables at joint values q (N, n); `effort` (n,) are the limits [N m or N]."""
        return self.cable * effort * np.tanh(q / CABLE)


def gear_torques(
    errors: TorqueErrors, q: np.ndarray, drive: np.ndarray, coulomb: np.ndarray, friction: np.ndarray, t: np.ndarray
) -> np.ndarray:
    """Return the unmodelled torques (N, n) of gears and motors [N m or N].

    Args:
        errors: their sizes.
        q: (N, n) in the order in which they are passed, finely sampled [rad or m].
        drive: (N, n) the motors' torques.
        coulomb: (n,) Fc.
        friction: (N, n) the model's friction Fv v + Fc sign(v).
        t: (N,) since the arm was cold [s].
    """
    heat = (1.0 - np.exp(-t / WARM_TIME))[:, None]
    slipping = memory(q, errors.memory * coulomb) if errors.memory else 0.0
    return slipping - errors.warming * heat * friction + errors.ripple * drive * np.sin(TEETH * q)


def memory(q: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """Return the torque (N, n) of elasto-plastic friction elements along a motion q (N, n) [rad or m] from rest.

    Args:
        q: finely sampled, since each step moves an element by the whole step.
        sizes: (n,) torque where all elements slip [N m or N].
    """
    widths = np.array(WIDTHS)[:, None]
    z, bent = np.zeros((len(WIDTHS), q.shape[1])), np.zeros_like(q)
    for k, step in enumerate(np.diff(q, axis=0), start=1):
        z = np.minimum(np.maximum(z + step, -widths), widths)
        bent[k] = (z / widths).mean(axis=0)
    return sizes * bent
