"""Simulated recordings for `extrapolation.py`: arms of the library, friction that no model of this toolkit holds.

Torques are exact inverse dynamics of a true arm, whose masses differ from its description's, plus drives and friction;
motors see all of it, sensors behind the gears a twentieth of the friction and no rotor inertia. Noise by seed.
"""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pinocchio as pin
from scipy.interpolate import make_interp_spline

import calib

LIBRARY = Path(calib.__file__).parent / "robot/library"
FINE = 1000.0  # of the simulation [Hz]
SENSOR_NOISE = 0.001  # of torque sensors, as a share of the joint's limit
MOTOR_NOISE = 0.003  # of motor torques, as a share of the joint's limit
ENCODER_NOISE = 2e-5  # [rad]
SENSED_FRICTION = 0.05  # share of the friction that sensors behind the gears see
MASS_ERROR = 0.06  # of the description, relative, 1 sigma
CENTRE_ERROR = 8e-3  # of the description's centres of mass, 1 sigma [m]
MAX_JOINT = 2.8  # positions in use [rad]
UPPER_TRIANGLE = np.triu_indices(3)  # XX XY XZ YY YZ ZZ of an inertia tensor
WARM = 1e9  # seconds in motion after which friction has its warm level
PAYLOAD = {"mass": 2.0, "com": [0.02, -0.03, 0.08]}


@dataclass(frozen=True)
class Arm:
    """A library arm: MDH rows alpha, d, theta, r (n, 4), standard parameters (n, 10), limits (n,)."""

    mdh: np.ndarray
    inertias: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    velocity: np.ndarray
    effort: np.ndarray


def _number(text: str | float) -> float:
    """Return a library's number: ``1.2``, ``pi/2``, ``-pi``, ``85 deg/s``."""
    value, _, unit = str(text).partition(" ")
    scale = np.deg2rad(1.0) if unit.startswith("deg") else 1.0
    if "pi" in value:
        sign, _, divisor = value.partition("pi")
        return np.pi * float(f"{sign}1") / float(divisor.removeprefix("/") or 1.0)
    return scale * float(value)


def arm(name: str) -> Arm:
    """Return an arm of the library; without known masses its bodies are rods."""
    rows = tomllib.loads((LIBRARY / f"{name}.toml").read_text())["joint"]

    def column(key: str) -> np.ndarray:
        return np.array([_number(row[key]) for row in rows])

    mdh = np.zeros((len(rows), 4))
    for k, row in enumerate(rows):
        mdh[k] = [_number(row.get(key, 0.0)) for key in ("alpha", "d", "theta", "r")]
    if "inertia" in rows[0]:
        inertias = np.array([row["inertia"] for row in rows])
    else:
        inertias = _rods(mdh)
    lower = np.clip(column("lower"), -MAX_JOINT, MAX_JOINT)
    upper = np.clip(column("upper"), -MAX_JOINT, MAX_JOINT)
    return Arm(mdh, inertias, lower, upper, column("velocity"), column("effort"))


def _rods(mdh: np.ndarray) -> np.ndarray:
    """Return standard parameters (n, 10) of bodies that reach half-way to the next joint; heavy ones first."""
    masses = np.linspace(6.0, 0.8, len(mdh))
    next_rows = [*mdh[1:], (0.0, 0.0, 0.0, 0.1)]
    rods = []
    for mass, (alpha, d, _, r) in zip(masses, next_rows):
        next_joint = np.array([d, -np.sin(alpha) * r, np.cos(alpha) * r])
        centre = 0.5 * next_joint + [0.0, 0.01, 0.02]
        inertia = mass * (1.3 * _parallel_axes(centre) + 0.004 * np.eye(3))
        rods.append([*inertia[UPPER_TRIANGLE], *(mass * centre), mass])
    return np.array(rods)


def _parallel_axes(centre: np.ndarray) -> np.ndarray:
    """Return the inertia (3, 3) [m²] of a unit point mass at a centre (3,) [m]."""
    return centre @ centre * np.eye(3) - np.outer(centre, centre)


def _tensor(row: np.ndarray) -> np.ndarray:
    """Return the inertia tensor (3, 3) of a body's standard parameters (10,)."""
    upper = np.zeros((3, 3))
    upper[UPPER_TRIANGLE] = row[:6]
    return upper + np.triu(upper, 1).T


def wrong(inertias: np.ndarray, seed: int) -> np.ndarray:
    """Return bodies (n, 10) with random errors of mass and centre; each stays physically consistent."""
    rng = np.random.default_rng([seed, 5])
    rows = []
    for row in inertias:
        mass = row[9]
        centre = row[6:9] / mass
        shifted = centre + CENTRE_ERROR * rng.standard_normal(3)
        tensor = _tensor(row) + mass * ((shifted @ shifted - centre @ centre) * np.eye(3))
        tensor -= mass * (np.outer(shifted, shifted) - np.outer(centre, centre))
        factor = np.exp(MASS_ERROR * rng.standard_normal())
        rows.append(factor * np.r_[tensor[UPPER_TRIANGLE], mass * shifted, mass])
    return np.array(rows)


def write_urdf(robot: Arm, inertias: np.ndarray | None, path: Path) -> Path:
    """Write an arm, with bodies (n, 10) or without any; its tip is a link ``flange`` 0.1 m beyond the last joint."""
    text = ['<robot name="arm">', '<link name="link_0"/>']
    for k in range(len(robot.mdh)):
        body = "" if inertias is None else _inertial(inertias[k])
        text.append(f'<link name="link_{k + 1}">{body}</link>')
        text.append(_joint(robot, k))
    n = len(robot.mdh)
    text += [
        f'<link name="flange"/><joint name="flange_joint" type="fixed"><parent link="link_{n}"/>',
        '<child link="flange"/><origin xyz="0 0 0.1" rpy="0 0 0"/></joint></robot>',
    ]
    path.write_text("\n".join(text))
    return path


def _joint(robot: Arm, k: int) -> str:
    """Return the joint of MDH row k, from 0, as two lines of URDF."""
    alpha, d, theta, r = robot.mdh[k]
    rotation = pin.utils.rotate("x", alpha) @ pin.utils.rotate("z", theta)
    xyz = (d, -np.sin(alpha) * r, np.cos(alpha) * r)
    rpy = pin.rpy.matrixToRpy(rotation)
    limits = (
        f'lower="{robot.lower[k]}" upper="{robot.upper[k]}" velocity="{robot.velocity[k]}" effort="{robot.effort[k]}"'
    )
    return (
        f'<joint name="joint_{k + 1}" type="revolute"><parent link="link_{k}"/><child link="link_{k + 1}"/>\n'
        f'<origin xyz="{_numbers(xyz)}" rpy="{_numbers(rpy)}"/><axis xyz="0 0 1"/><limit {limits}/></joint>'
    )


def _inertial(row: np.ndarray) -> str:
    """Return a body's standard parameters (10,) as URDF, its tensor about the centre of mass."""
    mass = row[9]
    centre = row[6:9] / row[9]
    tensor = _tensor(row) - mass * _parallel_axes(centre)
    names = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    moments = " ".join(f'{name}="{value:.12g}"' for name, value in zip(names, tensor[UPPER_TRIANGLE]))
    return f'<inertial><origin xyz="{_numbers(centre)}"/><mass value="{mass:.12g}"/><inertia {moments}/></inertial>'


def _numbers(values: Sequence[float] | np.ndarray) -> str:
    return " ".join(f"{float(value):.15g}" for value in values)


# motions: (N, n) positions at FINE, inside shares of the limits


def fourier(
    robot: Arm, seconds: float, seed: int, reach: float = 0.7, speed: float = 0.5, period: float = 10.0
) -> np.ndarray:
    """Return a sum of five harmonics per joint, inside shares of the joints' ranges and speeds."""
    rng = np.random.default_rng([seed, 1])
    n = len(robot.mdh)
    harmonics = np.arange(1, 6)
    sines, cosines = rng.normal(size=(2, n, 5)) / harmonics

    def series(seconds: float) -> np.ndarray:
        t = np.arange(round(seconds * FINE)) / FINE
        angle = 2 * np.pi / period * np.outer(t, harmonics)
        return np.sin(angle) @ sines.T + np.cos(angle) @ cosines.T

    # one period, unscaled, tells range and speed
    raw = series(period)
    raw_speed = np.abs(np.gradient(raw, 1 / FINE, axis=0)).max(axis=0)
    scale = np.minimum(reach * (robot.upper - robot.lower) / np.ptp(raw, axis=0), speed * robot.velocity / raw_speed)
    margin = 0.5 * (1.0 - reach) * (robot.upper - robot.lower)
    middle = 0.5 * (robot.lower + robot.upper)
    centre = middle + 0.5 * margin * rng.uniform(-1, 1, n) - scale * raw.mean(axis=0)
    return centre + scale * series(seconds)


def sine(robot: Arm, seconds: float, seed: int, reach: float = 0.4, frequency: float = 0.08) -> np.ndarray:
    """Return a motion where all joints follow one slow sinusoid, some a quarter of a period later."""
    rng = np.random.default_rng([seed, 2])
    n = len(robot.mdh)
    phase = 0.5 * np.pi * rng.integers(0, 2, n)
    amplitude = 0.5 * reach * (robot.upper - robot.lower) * rng.uniform(0.6, 1.0, n) * rng.choice([-1, 1], n)
    t = np.arange(round(seconds * FINE)) / FINE
    middle = 0.5 * (robot.lower + robot.upper)
    return middle + amplitude * np.sin(2 * np.pi * frequency * t[:, None] + phase)


def points(robot: Arm, seconds: float, seed: int, reach: float = 0.7, speed: float = 0.5) -> np.ndarray:
    """Return smooth moves from point to point with pauses of 0.3 s."""
    rng = np.random.default_rng([seed, 3])
    half_range = 0.5 * reach * (robot.upper - robot.lower)
    middle = 0.5 * (robot.lower + robot.upper)
    start = middle
    parts = []
    length = 0
    while length < seconds * FINE:
        goal = middle + half_range * rng.uniform(-1, 1, len(half_range))
        duration = 1.875 * np.max(np.abs(goal - start) / (speed * robot.velocity))
        s = np.linspace(0.0, 1.0, max(round(FINE * duration), 200))[:, None]
        move = start + (goal - start) * _smooth_step(s)
        pause = np.tile(goal, (300, 1))
        parts += [move, pause]
        start = goal
        length += len(move) + len(pause)
    return np.concatenate(parts)[: round(seconds * FINE)]


def _smooth_step(s: np.ndarray) -> np.ndarray:
    """Return the polynomial from 0 to 1 that starts and ends without velocity and acceleration."""
    return 10 * s**3 - 15 * s**4 + 6 * s**5


def each_alone(robot: Arm, seconds: float, seed: int, reach: float = 0.7, speed: float = 0.5) -> np.ndarray:
    """Return a motion where one joint after the other moves and all others stand still."""
    n = len(robot.mdh)
    motion = fourier(robot, seconds, seed, reach, speed, period=seconds / n)
    middle = 0.5 * (robot.lower + robot.upper)
    posture = middle + 0.2 * np.random.default_rng([seed, 4]).standard_normal(n)
    q = np.tile(posture, (len(motion), 1))
    # each joint's share of the time, begun and ended smoothly
    length = round(seconds / n * FINE)
    from_ends = np.minimum(np.arange(length), np.arange(length)[::-1])
    rise = np.clip(from_ends / (0.4 * FINE), 0, 1)
    rise = rise**3 * (10 - 15 * rise + 6 * rise**2)
    for j in range(n):
        part = slice(j * length, (j + 1) * length)
        q[part, j] += rise * (motion[part, j] - q[part, j])
    return q


# friction: torques (N, n) of speeds v at positions q and times t; none is a model of calib/identification


def friction(
    family: str, robot: Arm, t: np.ndarray, q: np.ndarray, v: np.ndarray, rng: np.random.Generator, cold: float
) -> np.ndarray:
    """Return the friction torques (N, n) [N m] along a motion.

    Args:
        family: one of `FAMILIES`.
        robot: the arm, its limits.
        t: (N,) instants [s].
        q, v: (N, n) positions [rad] and velocities [rad/s].
        rng: draws the arm's coefficients.
        cold: since when the arm has moved [s].
    """
    n = len(robot.mdh)
    coulomb = 0.06 * robot.effort * np.exp(0.3 * rng.standard_normal(n))
    viscous = 0.05 * robot.effort / robot.velocity * np.exp(0.3 * rng.standard_normal(n))
    sign = np.tanh(v / 2e-3)
    steady = coulomb * sign + viscous * v
    slow = np.exp(-(np.abs(v / 0.05) ** 0.7))  # Stribeck's exponent is neither 1 nor 2
    match family:
        case "simple":
            return steady
        case "stribeck":
            viscous_torque = viscous * np.sign(v) * np.abs(v) ** 0.6
            return coulomb * sign * (1 + 0.6 * slow) + viscous_torque
        case "lugre":
            return _lugre(v, coulomb * (1 + 0.5 * slow), coulomb / 3e-3) + viscous * v
        case "warming":
            cooling = np.exp(-(cold + t[:, None]) / 60.0)
            return (1 + 0.5 * cooling) * steady
        case "asymmetric":
            return np.where(v > 0, 1.25, 0.8) * steady + 0.15 * coulomb * np.cos(q)
        case "position":
            phase = rng.uniform(0, 2 * np.pi, (2, n))
            ripple = 1 + 0.3 * np.sin(q + phase[0]) + 0.15 * np.sin(3 * q + phase[1])
            return ripple * steady
    raise ValueError(f"'{family}' is none of {', '.join(FAMILIES)}")


FAMILIES = ("simple", "stribeck", "lugre", "warming", "asymmetric", "position")


def _lugre(v: np.ndarray, level: np.ndarray, stiffness: np.ndarray) -> np.ndarray:
    """Return σ z of z' = v - σ |v| z / g(v), implicit in z (Canudas de Wit et al. 1995, without σ1)."""
    z = np.zeros(v.shape[1])
    force = np.empty_like(v)
    for k in range(len(v)):
        z = (z + v[k] / FINE) / (1 + np.abs(v[k]) * stiffness / level[k] / FINE)
        force[k] = stiffness * z
    return force


def record(
    robot: Arm,
    true: Path,
    q: np.ndarray,
    path: Path,
    *,
    seed: int,
    arm_seed: int,
    family: str,
    rate: float = 200.0,
    behind: bool = False,
    coupled: bool = False,
    payload: dict | None = None,
    cold: float = WARM,
) -> Path:
    """Write a recording (npz: t, q, tau) of a motion q (N, n) at FINE.

    Args:
        robot: the arm, its limits.
        true: the URDF of the true arm.
        q: positions (N, n) [rad].
        path: file to write.
        seed, arm_seed: of the noise; of drives and friction, the same in all recordings of an arm.
        family: of friction.
        rate: of the recording [Hz].
        behind: sensors behind the gears in place of the motors' torques.
        coupled: the last motor turns with the sum of the last two joints.
        payload: mass [kg] and com [m] in the flange's frame.
        cold: since when the arm has moved [s].
    """
    rng = np.random.default_rng([seed, 6])
    arm_rng = np.random.default_rng([arm_seed, 7])
    n = q.shape[1]
    t = np.arange(len(q)) / FINE
    spline = make_interp_spline(t, q, k=5)
    v = spline(t, 1)
    a = spline(t, 2)

    joint_friction = friction(family, robot, t, q, v, arm_rng, cold)
    rotor = 0.4 * robot.effort / robot.velocity / 20 * np.exp(0.3 * arm_rng.standard_normal(n))
    cable, offset = 0.004 * robot.effort * arm_rng.standard_normal((2, n))
    sensed_share = SENSED_FRICTION if behind else 1.0
    drives = sensed_share * joint_friction + offset + cable * np.tanh(q / 0.5)
    if not behind:
        drives += rotor * a
    if coupled:
        v_coupled = v[:, -2:].sum(axis=1, keepdims=True) + 0 * v
        coupled_friction = friction("stribeck", robot, t, q, v_coupled, arm_rng, cold)[:, -1]
        drives[:, -2] += coupled_friction + rotor[-1] * a[:, -1]
        drives[:, -1] += coupled_friction - joint_friction[:, -1] + rotor[-1] * a[:, -2]

    recorded = slice(None, None, round(FINE / rate))
    model = pin.buildModelFromUrdf(str(true))
    if payload is not None:
        body = pin.Inertia(payload["mass"], np.array(payload["com"]), np.zeros((3, 3)))
        flange = next(frame for frame in model.frames if frame.name == "flange")
        model.appendBodyToJoint(n, body, flange.placement)
    data = model.createData()
    bodies = np.array([pin.rnea(model, data, *state) for state in zip(q[recorded], v[recorded], a[recorded])])
    noise_share = SENSOR_NOISE if behind else MOTOR_NOISE
    noise = noise_share * robot.effort * rng.standard_normal(bodies.shape)
    encoder_noise = ENCODER_NOISE * rng.standard_normal(bodies.shape)
    np.savez(path, t=t[recorded], q=q[recorded] + encoder_noise, tau=bodies + drives[recorded] + noise)
    return path
