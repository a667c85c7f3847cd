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

# Number of poses i_0 and time t_0 [s] after which the arm has warmed up by 63 %.
WARM_POSES = 30.0
WARM_TIME = 120.0
# Displacements s_k [rad or m] after which the friction elements slip.
WIDTHS = (2e-3, 8e-3, 30e-3)
# Number N of periods of a gear's ripple per radian.
TEETH = 100
# Angle [rad] at which the spring of a cable begins to saturate.
CABLE = 0.5
# Gear error of a prismatic joint [m] per radian of gear error of a revolute joint.
PRISMATIC_SHARE = 0.3


def _named(effects: Sequence[str]) -> str:
    """Return the names of effects as the end of a sentence; "" for no effects."""
    if not effects:
        return ""
    return f"; unmodelled: {', '.join(effects)}"


@dataclass(frozen=True)
class PositionErrors:
    """Sizes of the simulated position errors.

    Attributes:
        gear: a, amplitude of each of the two gear errors [rad; 0.3 times that value in m for a prismatic joint].
        backlash: b, half-width of the backlash [rad].
        growth: g, relative growth of all lengths when warm.
        droop: d, droop of the tool [m].
        seed: seed of the phases and of the direction of the droop.
    """

    gear: float = 0.0
    backlash: float = 0.0
    growth: float = 0.0
    droop: float = 0.0
    seed: int = 0

    @property
    def note(self) -> str:
        """The effects, as the end of a sentence; empty without effects."""
        effects = []
        if self.gear:
            effects.append(f"gear errors of {self.gear * 1e3:.2g} mrad that depend on load and on the next joint")
        if self.backlash:
            effects.append(f"backlash of ±{self.backlash * 1e3:.2g} mrad")
        if self.growth:
            effects.append(f"lengths growing by {self.growth * 1e6:.0f} ppm")
        if self.droop:
            effects.append(f"a tool drooping by up to {self.droop * 1e3:.2g} mm")
        return _named(effects)


def displacements(
    errors: PositionErrors, chain: Chain, q: np.ndarray, torque: np.ndarray, warm: float = 0.0
) -> np.ndarray:
    """Return the error (K, m) [rad or m] that the effects add to each element of a chain.

    Args:
        errors: sizes of the effects.
        chain: the true arm of n joints.
        q: (m, n) joint values of a series in its order [rad or m].
        torque: (m, n) gravity torques [N m or N].
        warm: number of poses to which the arm has moved before; infinite for a warm arm.
    """
    rng = np.random.default_rng([errors.seed, 11])
    phases = rng.uniform(0.0, 2.0 * np.pi, (2, chain.n))
    joint_scale = np.ones(chain.n)
    for j, joint in enumerate(chain.joints):
        if joint.kind != "revolute":
            joint_scale[j] = PRISMATIC_SHARE
    following = (np.arange(chain.n) + 1) % chain.n
    next_joint = q[:, following]
    load = torque / _largest_load(chain)
    of_next_joint = np.sin(2.0 * q + next_joint + phases[0])
    of_load = load * np.sin(3.0 * q + phases[1])
    gear_error = errors.gear * (of_next_joint + of_load)
    # the side from which a joint came
    side = np.sign(np.diff(q, axis=0, prepend=0.0))
    backlash = errors.backlash * side
    result = np.zeros((len(chain.elements), len(q)))
    result[chain.moving] = (joint_scale * (gear_error - backlash)).T
    translational = [element.axis[0] == "t" for element in chain.elements]
    lengths = np.array(translational)
    poses_before = warm + np.arange(len(q))
    heat = 1.0 - np.exp(-poses_before / WARM_POSES)
    expansion = np.outer(chain.values[lengths], heat)
    result[lengths] += errors.growth * expansion
    return result


def _largest_load(chain: Chain) -> np.ndarray:
    """Return the largest gravity torque (n,) [N m or N] of each joint; 1 for joints without gravity load."""
    if chain.inertias is None:
        return np.ones(chain.n)
    q = random_joints(chain, 200, 0)
    torques = gravity_torques(chain, q)
    largest = np.abs(torques).max(axis=0)
    return np.where(largest > 1e-6, largest, 1.0)


def drooping(errors: PositionErrors, chain: Chain, poses: np.ndarray, base: np.ndarray) -> np.ndarray:
    """Return tool poses (m, 4, 4) shifted by the droop of the tool under gravity.

    Args:
        errors, chain: as for `displacements`.
        poses: (m, 4, 4) of the tool in the station's frame [m].
        base: (4, 4) of the arm's base in the station's frame.
    """
    rng = np.random.default_rng([errors.seed, 13])
    droop_direction = rng.uniform(0.2, 1.0, 3)
    magnitude = float(np.linalg.norm(chain.gravity))
    gravity_direction = chain.gravity / max(magnitude, 1e-9)
    down = base[:3, :3] @ gravity_direction
    turn = poses[:, :3, :3]
    droop = np.einsum("mij,j,mkj,k->mi", turn, droop_direction, turn, down)
    result = poses.copy()
    result[:, :3, 3] += errors.droop * droop
    return result


@dataclass(frozen=True)
class TorqueErrors:
    """Sizes of the simulated torque errors; zero by default.

    Attributes:
        memory: Σ_k f_k, as a share of the Coulomb friction.
        warming: w, share of the friction that vanishes as the gears warm up.
        ripple: r, relative ripple of the gear torque.
        cable: c, as a share of the torque limit.
        push: σ of an unrecorded external torque, as a share of the torque limit.
    """

    memory: float = 0.0
    warming: float = 0.0
    ripple: float = 0.0
    cable: float = 0.0
    push: float = 0.0

    @property
    def note(self) -> str:
        """The effects, as the end of a sentence; empty without effects."""
        effects = []
        if self.memory:
            effects.append(f"friction hysteresis (presliding), {self.memory:.0%} of Fc")
        if self.warming:
            effects.append(f"friction falling by {self.warming:.0%} as it warms up")
        if self.ripple:
            effects.append(f"ripple of {self.ripple:.1%} of the torque")
        if self.cable:
            effects.append(f"cables of {self.cable:.1%} of the limits")
        if self.push:
            effects.append(f"pushes of {self.push:.1%} of the limits")
        return _named(effects)

    def cable_torques(self, q: np.ndarray, effort: np.ndarray) -> np.ndarray:
        """Return the torques (N, n) of the cables at joint values q (N, n); `effort` (n,) are the limits [N m or N]."""
        return self.cable * effort * np.tanh(q / CABLE)


def gear_torques(
    errors: TorqueErrors, q: np.ndarray, drive: np.ndarray, coulomb: np.ndarray, friction: np.ndarray, t: np.ndarray
) -> np.ndarray:
    """Return the unmodelled torques (N, n) of gears and motors [N m or N].

    Args:
        errors: sizes of the effects.
        q: (N, n) joint values of a motion in order of time, finely sampled [rad or m].
        drive: (N, n) torques of the motors [N m or N].
        coulomb: (n,) Coulomb friction Fc [N m or N].
        friction: (N, n) friction of the model, Fv v + Fc sign(v) [N m or N].
        t: (N,) times since the cold start of the arm [s].
    """
    heat = 1.0 - np.exp(-t / WARM_TIME)
    slipping = 0.0
    if errors.memory:
        slipping = memory(q, errors.memory * coulomb)
    warming = errors.warming * heat[:, None] * friction
    ripple = errors.ripple * drive * np.sin(TEETH * q)
    return slipping - warming + ripple


def memory(q: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """Return the torque (N, n) of elasto-plastic friction elements along a motion q (N, n) [rad or m] from rest.

    Args:
        q: joint values in order of time, finely sampled: an element is moved by whole steps between samples.
        sizes: (n,) torques while all elements slip [N m or N].
    """
    widths = np.array(WIDTHS)[:, None]
    z = np.zeros((len(WIDTHS), q.shape[1]))
    bent = np.zeros_like(q)
    steps = np.diff(q, axis=0)
    for k, step in enumerate(steps, start=1):
        stretched = np.maximum(z + step, -widths)
        z = np.minimum(stretched, widths)
        bent[k] = (z / widths).mean(axis=0)
    return sizes * bent
