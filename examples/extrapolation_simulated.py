"""Simulated recordings for `extrapolation.py`: arms of the library, friction that no model of this toolkit holds.

Torques are exact inverse dynamics of a true arm, whose masses differ from its description's, plus drives and friction;
motors see all of it, sensors behind the gears a twentieth of the friction and no rotor inertia. Noise by seed.
"""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pinocchio as pin
from scipy.interpolate import make_interp_spline

import calib

LIBRARY = Path(calib.__file__).parent / "robot/library"
FINE = 1000.0  # of the simulation [Hz]
SENSORS, MOTORS, ENCODER = 0.001, 0.003, 2e-5  # noise of torques as a share of their limits, of positions [rad]
BEHIND = 0.05  # share of the friction that sensors behind the gears see
MASS, SHIFT = 0.06, 8e-3  # by how much the description's masses and centres are off, 1 sigma [1, m]
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
    mdh = np.array([[_number(row.get(key, 0.0)) for key in ("alpha", "d", "theta", "r")] for row in rows])
    limits = np.array([[_number(row[key]) for row in rows] for key in ("lower", "upper", "velocity", "effort")])
    limits[:2] = np.clip(limits[:2], -2.8, 2.8)
    inertias = [row["inertia"] for row in rows] if "inertia" in rows[0] else _rods(mdh)
    return Arm(mdh, np.array(inertias), *limits)


def _rods(mdh: np.ndarray) -> list[list[float]]:
    """Return standard parameters (n, 10) of bodies that reach half-way to the next joint; heavy ones first."""
    rows = []
    for mass, (alpha, d, _, r) in zip(np.linspace(6.0, 0.8, len(mdh)), [*mdh[1:], (0.0, 0.0, 0.0, 0.1)]):
        half = 0.5 * np.array([d, -np.sin(alpha) * r, np.cos(alpha) * r]) + [0.0, 0.01, 0.02]
        turn = mass * (1.3 * (half @ half * np.eye(3) - np.outer(half, half)) + 0.004 * np.eye(3))
        rows.append([*turn[np.triu_indices(3)], *(mass * half), mass])
    return rows


def wrong(inertias: np.ndarray, seed: int) -> np.ndarray:
    """Return bodies (n, 10) with random errors of mass and centre; each stays physically consistent."""
    rng, rows = np.random.default_rng([seed, 5]), []
    for row in inertias:
        mass, first = row[9], row[6:9]
        turn = np.zeros((3, 3))
        turn[np.triu_indices(3)] = row[:6]
        turn = turn + np.triu(turn, 1).T
        centre = first / mass
        shifted = centre + SHIFT * rng.standard_normal(3)
        turn = turn + mass * ((shifted @ shifted - centre @ centre) * np.eye(3))
        turn -= mass * (np.outer(shifted, shifted) - np.outer(centre, centre))
        factor = np.exp(MASS * rng.standard_normal())
        rows.append(factor * np.r_[turn[np.triu_indices(3)], mass * shifted, mass])
    return np.array(rows)


def write_urdf(robot: Arm, inertias: np.ndarray | None, path: Path) -> Path:
    """Write an arm, with bodies (n, 10) or without any; its tip is a link ``flange`` 0.1 m beyond the last joint."""
    text = ['<robot name="arm">', '<link name="link_0"/>']
    for k, (alpha, d, theta, r) in enumerate(robot.mdh):
        turn = pin.utils.rotate("x", alpha) @ pin.utils.rotate("z", theta)
        xyz, rpy = (d, -np.sin(alpha) * r, np.cos(alpha) * r), pin.rpy.matrixToRpy(turn)
        body = "" if inertias is None else _inertial(inertias[k])
        text += [
            f'<link name="link_{k + 1}">{body}</link>',
            f'<joint name="joint_{k + 1}" type="revolute"><parent link="link_{k}"/><child link="link_{k + 1}"/>',
            f'<origin xyz="{_texts(xyz)}" rpy="{_texts(rpy)}"/><axis xyz="0 0 1"/><limit lower="{robot.lower[k]}" '
            f'upper="{robot.upper[k]}" velocity="{robot.velocity[k]}" effort="{robot.effort[k]}"/></joint>',
        ]
    n = len(robot.mdh)
    text += [
        f'<link name="flange"/><joint name="flange_joint" type="fixed"><parent link="link_{n}"/>',
        '<child link="flange"/><origin xyz="0 0 0.1" rpy="0 0 0"/></joint></robot>',
    ]
    path.write_text("\n".join(text))
    return path


def _inertial(row: np.ndarray) -> str:
    mass, centre = row[9], row[6:9] / row[9]
    turn = np.zeros((3, 3))
    turn[np.triu_indices(3)] = row[:6]
    turn = turn - mass * np.triu(centre @ centre * np.eye(3) - np.outer(centre, centre))
    names = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    about = " ".join(f'{key}="{value:.12g}"' for key, value in zip(names, turn[np.triu_indices(3)]))
    return f'<inertial><origin xyz="{_texts(centre)}"/><mass value="{mass:.12g}"/><inertia {about}/></inertial>'


def _texts(values) -> str:
    return " ".join(f"{float(x):.15g}" for x in values)


# motions: (N, n) positions at FINE, inside shares of the limits


def fourier(
    robot: Arm, seconds: float, seed: int, reach: float = 0.7, speed: float = 0.5, period: float = 10.0
) -> np.ndarray:
    """Return a sum of five harmonics per joint, inside shares of the joints' ranges and speeds."""
    rng, n = np.random.default_rng([seed, 1]), len(robot.mdh)
    t, order = np.arange(round(seconds * FINE)) / FINE, np.arange(1, 6)
    size = rng.normal(size=(2, n, 5)) / order
    angle = 2 * np.pi / period * np.outer(np.arange(round(period * FINE)) / FINE, order)
    raw = np.sin(angle) @ size[0].T + np.cos(angle) @ size[1].T
    fast = np.abs(np.gradient(raw, 1 / FINE, axis=0)).max(axis=0)
    scale = np.minimum(reach * (robot.upper - robot.lower) / np.ptp(raw, axis=0), speed * robot.velocity / fast)
    room = 0.5 * (1.0 - reach) * (robot.upper - robot.lower)
    centre = 0.5 * (robot.lower + robot.upper) + 0.5 * room * rng.uniform(-1, 1, n) - scale * raw.mean(axis=0)
    angle = 2 * np.pi / period * np.outer(t, order)
    return centre + scale * (np.sin(angle) @ size[0].T + np.cos(angle) @ size[1].T)


def sine(robot: Arm, seconds: float, seed: int, reach: float = 0.4, frequency: float = 0.08) -> np.ndarray:
    """Return a motion where all joints follow one slow sinusoid, some a quarter of a period later."""
    rng, n = np.random.default_rng([seed, 2]), len(robot.mdh)
    phase = 0.5 * np.pi * rng.integers(0, 2, n)
    size = 0.5 * reach * (robot.upper - robot.lower) * rng.uniform(0.6, 1.0, n) * rng.choice([-1, 1], n)
    t = np.arange(round(seconds * FINE)) / FINE
    return 0.5 * (robot.lower + robot.upper) + size * np.sin(2 * np.pi * frequency * t[:, None] + phase)


def points(robot: Arm, seconds: float, seed: int, reach: float = 0.7, speed: float = 0.5) -> np.ndarray:
    """Return smooth moves from point to point with pauses of 0.3 s."""
    rng = np.random.default_rng([seed, 3])
    half = 0.5 * reach * (robot.upper - robot.lower)
    here, parts, length = 0.5 * (robot.lower + robot.upper), [], 0
    while length < seconds * FINE:
        there = 0.5 * (robot.lower + robot.upper) + half * rng.uniform(-1, 1, len(half))
        count = round(FINE * 1.875 * np.max(np.abs(there - here) / (speed * robot.velocity)))
        s = np.linspace(0.0, 1.0, max(count, 200))[:, None]
        parts += [here + (there - here) * (10 * s**3 - 15 * s**4 + 6 * s**5), np.tile(there, (300, 1))]
        here, length = there, length + len(s) + 300
    return np.concatenate(parts)[: round(seconds * FINE)]


def each_alone(robot: Arm, seconds: float, seed: int, reach: float = 0.7, speed: float = 0.5) -> np.ndarray:
    """Return a motion where one joint after the other moves and all others stand still."""
    n = len(robot.mdh)
    whole = fourier(robot, seconds, seed, reach, speed, period=seconds / n)
    middle, own = 0.5 * (robot.lower + robot.upper), round(seconds / n * FINE)
    q = np.tile(middle + 0.2 * np.random.default_rng([seed, 4]).standard_normal(n), (len(whole), 1))
    rise = np.clip(np.minimum(np.arange(own), np.arange(own)[::-1]) / (0.4 * FINE), 0, 1)
    rise = rise**3 * (10 - 15 * rise + 6 * rise**2)
    for j in range(n):
        part = slice(j * own, (j + 1) * own)
        q[part, j] += rise * (whole[part, j] - q[part, j])
    return q


# friction: torques (N, n) of speeds v at positions q and times t; none is a model of calib/identification


def friction(
    family: str, robot: Arm, t: np.ndarray, q: np.ndarray, v: np.ndarray, rng: np.random.Generator, cold: float
) -> np.ndarray:
    """Return the friction torques (N, n) [N m] along a motion.

    Args:
        family: one of `FAMILIES`.
        cold: since when the arm has moved [s].
    """
    n = len(robot.mdh)
    coulomb = 0.06 * robot.effort * np.exp(0.3 * rng.standard_normal(n))
    viscous = 0.05 * robot.effort / robot.velocity * np.exp(0.3 * rng.standard_normal(n))
    slow = np.exp(-(np.abs(v / 0.05) ** 0.7))  # Stribeck's exponent is neither 1 nor 2
    steady = coulomb * np.tanh(v / 2e-3) + viscous * v
    match family:
        case "simple":
            return steady
        case "stribeck":
            return coulomb * np.tanh(v / 2e-3) * (1 + 0.6 * slow) + viscous * np.sign(v) * np.abs(v) ** 0.6
        case "lugre":
            return _lugre(v, coulomb * (1 + 0.5 * slow), coulomb / 3e-3) + viscous * v
        case "warming":
            return (1 + 0.5 * np.exp(-(cold + t[:, None]) / 60.0)) * steady
        case "asymmetric":
            return np.where(v > 0, 1.25, 0.8) * steady + 0.15 * coulomb * np.cos(q)
        case "position":
            phase = rng.uniform(0, 2 * np.pi, (2, n))
            return (1 + 0.3 * np.sin(q + phase[0]) + 0.15 * np.sin(3 * q + phase[1])) * steady
    raise ValueError(f"'{family}' is none of {', '.join(FAMILIES)}")


FAMILIES = ("simple", "stribeck", "lugre", "warming", "asymmetric", "position")


def _lugre(v: np.ndarray, level: np.ndarray, stiffness: np.ndarray) -> np.ndarray:
    """Return σ z of z' = v - σ |v| z / g(v), implicit in z (Canudas de Wit et al. 1995, without σ1)."""
    z, force = np.zeros(v.shape[1]), np.empty_like(v)
    for k in range(len(v)):
        z = (z + v[k] / FINE) / (1 + np.abs(v[k]) * stiffness / level[k] / FINE)
        force[k] = stiffness * z
    return force


def record(
    robot: Arm, true: Path, q: np.ndarray, path: Path, *, seed: int, arm_seed: int, family: str, rate: float = 200.0,
    behind: bool = False, coupled: bool = False, payload: dict | None = None, cold: float = 1e9,
) -> Path:  # fmt: skip
    """Write a recording (npz: t, q, tau) of a motion q (N, n) at FINE.

    Args:
        true: the URDF of the true arm.
        seed, arm_seed: of the noise; of drives and friction, the same in all recordings of an arm.
        behind: sensors behind the gears in place of the motors' torques.
        coupled: the last motor turns with the sum of the last two joints.
        payload: mass [kg] and com [m] in the flange's frame.
        cold: since when the arm has moved [s].
    """
    rng, own = np.random.default_rng([seed, 6]), np.random.default_rng([arm_seed, 7])
    n, t = q.shape[1], np.arange(len(q)) / FINE
    curve = make_interp_spline(t, q, k=5)
    v, a = curve(t, 1), curve(t, 2)
    taken = friction(family, robot, t, q, v, own, cold)
    rotor = 0.4 * robot.effort / robot.velocity / 20 * np.exp(0.3 * own.standard_normal(n))
    cable, offset = 0.004 * robot.effort * own.standard_normal((2, n))
    drives = (BEHIND if behind else 1.0) * taken + offset + cable * np.tanh(q / 0.5)
    if not behind:
        drives += rotor * a
    if coupled:
        both = friction("stribeck", robot, t, q, v[:, -2:].sum(axis=1, keepdims=True) + 0 * v, own, cold)[:, -1]
        drives[:, -2] += both + rotor[-1] * a[:, -1]
        drives[:, -1] += both - taken[:, -1] + rotor[-1] * a[:, -2]
    every = round(FINE / rate)
    model = pin.buildModelFromUrdf(str(true))
    if payload is not None:
        body = pin.Inertia(payload["mass"], np.array(payload["com"]), np.zeros((3, 3)))
        model.appendBodyToJoint(n, body, next(x for x in model.frames if x.name == "flange").placement)
    data = model.createData()
    bodies = np.array([pin.rnea(model, data, *x) for x in zip(q[::every], v[::every], a[::every])])
    noise = (SENSORS if behind else MOTORS) * robot.effort * rng.standard_normal(bodies.shape)
    tau = bodies + drives[::every] + noise
    np.savez(path, t=t[::every], q=q[::every] + ENCODER * rng.standard_normal(bodies.shape), tau=tau)
    return path
