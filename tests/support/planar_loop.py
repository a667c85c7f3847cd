"""A planar arm of three joints in a closed loop, simulated by its textbook equations: no code of the toolkit.

Absolute angles φ = cumsum(q), links of length l with mass m at c from the joint and inertia i about it:

    μ_jk = Σ_i m_i a_ij a_ik,  a_ij = l_j (j < i), c_i (j = i);   M_jk = μ_jk cos(φ_j - φ_k) + δ_jk i_j
    h_j = Σ_k μ_jk sin(φ_j - φ_k) φ̇_k² + g cos φ_j Σ_i m_i a_ij

A PD controller at 1 kHz acts on measured positions and their backward difference, its torque is held over the period;
classical Runge–Kutta steps of 0.25 ms. Torque sensors read the mean over a period, centred: the accelerations at the
instants alone are not those of the motion in between.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np
from numba import njit

LENGTHS, CENTRES = np.array([0.5, 0.4, 0.2]), np.array([0.25, 0.18, 0.1])  # [m]
MASSES, INERTIAS = np.array([5.0, 3.5, 1.5]), np.array([0.12, 0.06, 0.01])  # [kg], [kg m²]
MOTORS, VISCOUS, COULOMB = np.array([1.2, 0.6, 0.15]), np.array([6.0, 4.0, 1.0]), np.array([8.0, 5.0, 1.5])
WIDTH, GRAVITY, RATE, STEPS = 0.01, 9.81, 1000.0, 4  # of the sign [rad/s]; [m/s²]; [Hz]; per period
FREQUENCY, SECONDS = 3.0, 20.0  # of the loop [Hz], of the motion [s]
TORQUE_NOISE, SENSOR_NOISE = 0.05, 0.02  # [N m]


@dataclass(frozen=True)
class PlanarLog:
    """Log at 1 kHz: t (N,) and reference, measured positions, torques of motors and sensors (N, 3)."""

    t: np.ndarray
    q_ref: np.ndarray
    q: np.ndarray
    tau: np.ndarray
    tau_link: np.ndarray


@njit(cache=True)
def lever_products(arm):
    """Return μ (3, 3) and the weights Σ_i m_i a_ij (3,)."""
    lengths, centres, masses, _ = arm
    reach = np.zeros((3, 3))
    for i in range(3):
        reach[i, i] = centres[i]
        for j in range(i):
            reach[i, j] = lengths[j]
    products, weights = np.zeros((3, 3)), np.zeros(3)
    for j in range(3):
        for i in range(3):
            weights[j] += masses[i] * reach[i, j]
            for k in range(3):
                products[j, k] += masses[i] * reach[i, j] * reach[i, k]
    return products, weights


@njit(cache=True)
def rigid(q, v, levers, inertias):
    """Return the links' inertia matrix (3, 3), and the torques (3,) of their speeds and weights, by joints."""
    products, weights = levers
    angle, rate = q.copy(), v.copy()
    for j in range(1, 3):
        angle[j] += angle[j - 1]
        rate[j] += rate[j - 1]
    matrix, torque = np.zeros((3, 3)), np.zeros(3)
    for j in range(3):
        matrix[j, j] = inertias[j]
        torque[j] = GRAVITY * np.cos(angle[j]) * weights[j]
        for k in range(3):
            matrix[j, k] += products[j, k] * np.cos(angle[j] - angle[k])
            torque[j] += products[j, k] * np.sin(angle[j] - angle[k]) * rate[k] ** 2
    # a joint turns its link and all behind it
    for j in (1, 0):
        torque[j] += torque[j + 1]
        for k in range(3):
            matrix[j, k] += matrix[j + 1, k]
    for k in (1, 0):
        for j in range(3):
            matrix[j, k] += matrix[j, k + 1]
    return matrix, torque


@njit(cache=True)
def solve(matrix, right):
    """Return the solution (3,) of a symmetric system by Cramer's rule."""
    minors = np.zeros((3, 3))
    for k in range(3):
        one, two = (k + 1) % 3, (k + 2) % 3
        for j in range(3):
            left, right_of = (j + 1) % 3, (j + 2) % 3
            minors[k, j] = matrix[one, left] * matrix[two, right_of] - matrix[one, right_of] * matrix[two, left]
    determinant = 0.0
    for j in range(3):
        determinant += matrix[0, j] * minors[0, j]
    out = np.zeros(3)
    for j in range(3):
        for k in range(3):
            out[j] += minors[k, j] * right[k] / determinant
    return out


@njit(cache=True)
def accelerations(q, v, tau, levers, inertias, drives):
    """Return the joints' accelerations (3,) under motor torques, and the torques (3,) that the links take."""
    matrix, torque = rigid(q, v, levers, inertias)
    motors, viscous, coulomb = drives
    left = tau.copy()
    driven = matrix.copy()
    for j in range(3):
        left[j] -= torque[j] + viscous[j] * v[j] + coulomb[j] * np.tanh(v[j] / WIDTH)
        driven[j, j] += motors[j]
    a = solve(driven, left)
    for j in range(3):
        for k in range(3):
            torque[j] += matrix[j, k] * a[k]
    return a, torque


# in loops: numba compiles every expression of arrays for itself
@njit(cache=True)
def moved(x, step, rate):
    """Return x + step · rate (3,)."""
    out = x.copy()
    for j in range(3):
        out[j] += step * rate[j]
    return out


@njit(cache=True)
def stepped(x, step, rates):
    """Return x (3,) after a Runge–Kutta step with its four rates."""
    out = x.copy()
    first, second, third, fourth = rates
    for j in range(3):
        out[j] += step / 6.0 * (first[j] + 2.0 * second[j] + 2.0 * third[j] + fourth[j])
    return out


@njit(cache=True)
def run(q_ref, v_ref, kp, kd, noise, arm, drives):
    """Return true positions, commanded torques and torques behind the drives, each (N, 3)."""
    period, levers, inertias = 1.0 / RATE, lever_products(arm), arm[3]
    q, v, step = q_ref[0].copy(), v_ref[0].copy(), period / STEPS
    before = moved(moved(q, 1.0, noise[0]), -period, v)
    out = np.zeros((3, len(q_ref), 3))
    behind = np.zeros((STEPS + 1, 3))
    tau = np.zeros(3)
    for k in range(len(q_ref)):
        seen = moved(q, 1.0, noise[k])
        for j in range(3):
            tau[j] = kp[j] * (q_ref[k, j] - seen[j]) + kd[j] * (v_ref[k, j] - (seen[j] - before[j]) / period)
            out[0, k, j], out[1, k, j] = q[j], tau[j]
        before = seen
        for part in range(STEPS + 1):
            a1, passed = accelerations(q, v, tau, levers, inertias, drives)
            for j in range(3):
                behind[part, j] = passed[j]
            if part == STEPS:
                break
            v2 = moved(v, 0.5 * step, a1)
            a2, _ = accelerations(moved(q, 0.5 * step, v), v2, tau, levers, inertias, drives)
            v3 = moved(v, 0.5 * step, a2)
            a3, _ = accelerations(moved(q, 0.5 * step, v2), v3, tau, levers, inertias, drives)
            v4 = moved(v, step, a3)
            a4, _ = accelerations(moved(q, step, v3), v4, tau, levers, inertias, drives)
            q = stepped(q, step, (v, v2, v3, v4))
            v = stepped(v, step, (a1, a2, a3, a4))
        # the mean from half a period before an instant to half a period after it
        for j in range(3):
            out[2, k, j] += (behind[0, j] + 4.0 * behind[1, j] + behind[2, j]) / 12.0
            if k + 1 < len(q_ref):
                out[2, k + 1, j] += (behind[2, j] + 4.0 * behind[3, j] + behind[4, j]) / 12.0
    return out


@cache
def reference() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return t (N,), positions and velocities (N, 3): twenty harmonics, from rest, at most 1.5, 2 and 2.5 rad/s."""
    rng = np.random.default_rng(3)
    t = np.arange(int(SECONDS * RATE) + 1) / RATE
    omega = 2.0 * np.pi / SECONDS * np.arange(1, 21)
    q = np.zeros((len(t), 3))
    for joint, speed in enumerate((1.5, 2.0, 2.5)):
        a, b = rng.normal(size=(2, len(omega))) / np.sqrt(omega)
        rates = np.cos(np.outer(t, omega)) @ a + np.sin(np.outer(t, omega)) @ b
        waves = np.sin(np.outer(t, omega)) @ (a / omega) - np.cos(np.outer(t, omega)) @ (b / omega)
        q[:, joint] = speed / np.abs(rates).max() * (1.0 - np.exp(-((t / 0.5) ** 3))) * waves
    return t, q + np.array([0.8, -0.5, 0.3]), np.gradient(q, 1.0 / RATE, axis=0)


@cache
def gains() -> tuple[np.ndarray, np.ndarray]:
    """Return kp and kd (3,) by the mean inertia of the joints."""
    postures = np.random.default_rng(0).uniform(-1.0, 1.0, (100, 3))
    levers = lever_products(np.array([LENGTHS, CENTRES, MASSES, INERTIAS]))
    matrices = np.array([rigid(q, np.zeros(3), levers, INERTIAS)[0] for q in postures])
    inertia = np.einsum("kjj->j", matrices) / len(matrices) + MOTORS
    omega = 2.0 * np.pi * FREQUENCY
    return omega**2 * inertia, 1.4 * omega * inertia


def _moved(noise: np.ndarray) -> np.ndarray:
    """Return what `run` returns for noise (N, 3) of the positions that the controller sees."""
    _, q_ref, v_ref = reference()
    arm, drives = np.array([LENGTHS, CENTRES, MASSES, INERTIAS]), np.array([MOTORS, VISCOUS, COULOMB])
    return run(q_ref, v_ref, *gains(), noise, arm, drives)


@cache
def _undisturbed() -> np.ndarray:
    return _moved(np.zeros_like(reference()[1]))


def planar_log(noise: float, in_loop: bool, seed: int) -> PlanarLog:
    """Return a log with white noise of the positions [rad], which the controller sees or the log alone has."""
    rng = np.random.default_rng([seed, 7])
    t, q_ref, _ = reference()
    error = noise * rng.normal(size=q_ref.shape)
    q, tau, tau_link = _moved(error) if in_loop else _undisturbed()
    tau = tau + TORQUE_NOISE * rng.normal(size=tau.shape)
    tau_link = tau_link + SENSOR_NOISE * rng.normal(size=tau.shape)
    return PlanarLog(t, q_ref, q + error, tau, tau_link)


def standard_parameters() -> np.ndarray:
    """Return the links' parameters (30,): XX XY XZ YY YZ ZZ about the joint, MX MY MZ, M; XX and YY act on nothing."""
    rows = []
    for centre, mass, inertia in zip(CENTRES, MASSES, INERTIAS):
        about_joint = inertia + mass * centre**2
        rows.append([0.01, 0.0, 0.0, about_joint, 0.0, about_joint, mass * centre, 0.0, 0.0, mass])
    return np.concatenate(rows)
