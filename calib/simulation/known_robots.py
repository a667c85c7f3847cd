"""Simulated robots with known dynamics and controllers, from the library.

Motions for simulated robots: random Fourier series within limits, and moves with trapezoidal velocities.
"""

from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np

from calib.config_types import ParsedTable
from calib.dynamics import drives
from calib.dynamics.bodies import bodies_of, standard_parameters
from calib.dynamics.idim import IdentificationModel
from calib.identification.closed_loop.controllers import Reference, pd
from calib.identification.closed_loop.simulation import Plant
from calib.identification.loop import LoopController
from calib.records import shaped
from calib.robot import description, library


def _fourier(
    centre: np.ndarray, sines: np.ndarray, cosines: np.ndarray, base: float, duration: float, rate: float
) -> Reference:
    """Return the sampled motion q_i(t) = q_i0 + Σ_k [a_ik sin(k ω t) + b_ik cos(k ω t)] of n joints.

    Source: Swevers et al. (1997); Kolyubin et al. (2019), eq. 23.

    Args:
        centre: (n,) centres q_i0 [rad or m].
        sines, cosines: (n, h) coefficients a and b of h harmonics [rad or m].
        base: angular frequency ω of the first harmonic [rad/s].
        duration: duration of the motion [s].
        rate: samples per second [Hz].
    """
    intervals = round(duration * rate)
    t = np.arange(intervals + 1) / rate
    harmonics = np.arange(1, sines.shape[1] + 1)
    speed = base * harmonics
    phase = np.outer(t, speed)
    sin = np.sin(phase)
    cos = np.cos(phase)
    sin_rate = sin * speed
    cos_rate = cos * speed
    sin_change = sin * speed**2
    cos_change = cos * speed**2
    q = np.asarray(centre) + sin @ sines.T + cos @ cosines.T
    v = cos_rate @ sines.T - sin_rate @ cosines.T
    a = -sin_change @ sines.T - cos_change @ cosines.T
    return Reference(t, q, v, a)


def random_fourier(
    lower: np.ndarray,
    upper: np.ndarray,
    velocity: np.ndarray,
    duration: float,
    rate: float,
    harmonics: int = 5,
    acceleration: float = np.inf,
    seed: int | np.random.Generator = 0,
) -> Reference:
    """Return one period of a random Fourier motion inside the limits, at rest at both ends.

    The amplitude of a harmonic is inversely proportional to its number. Conditions Σ k a_k = Σ k² b_k = 0 put both ends
    at rest. Each joint's motion is scaled up until it meets one of the limits, then centred. The motion is not
    optimised for identification.

    Args:
        lower, upper: (n,) position limits [rad or m], met at all samples.
        velocity: (n,) speed limits [rad/s or m/s], met at all samples.
        duration: duration of the period [s].
        rate: samples per second [Hz].
        harmonics: number of harmonics.
        acceleration: largest acceleration of any joint [rad/s² or m/s²].
        seed: seed of the coefficients.
    """
    lower = np.asarray(lower, dtype=float)
    upper = np.asarray(upper, dtype=float)
    velocity = np.asarray(velocity, dtype=float)
    rng = np.random.default_rng(seed)
    n = len(lower)
    order = np.arange(1, harmonics + 1)
    sines, cosines = rng.normal(size=(2, n, harmonics)) / order
    # at rest at both ends
    _project_out(sines, order)
    _project_out(cosines, order**2)
    base = 2 * np.pi / duration
    raw = _fourier(np.zeros(n), sines, cosines, base, duration, rate)
    low = raw.q.min(axis=0)
    high = raw.q.max(axis=0)
    # how far each joint may be scaled up before it meets each of its limits
    travel_share = (upper - lower) / (high - low)
    velocity_share = velocity / np.abs(raw.v).max(axis=0)
    acceleration_share = acceleration / np.abs(raw.a).max(axis=0)
    scale = np.min([travel_share, velocity_share, acceleration_share], axis=0)
    middle = 0.5 * (lower + upper)
    centre = middle - 0.5 * scale * (low + high)
    return Reference(raw.t, centre + scale * raw.q, scale * raw.v, scale * raw.a)


def _project_out(coefficients: np.ndarray, direction: np.ndarray) -> None:
    """Remove the part along `direction` (h,) from each row of `coefficients` (n, h), in place."""
    along = coefficients @ direction
    coefficients -= np.outer(along, direction) / (direction @ direction)


def trapezoidal(
    points: np.ndarray, velocity: np.ndarray, acceleration: np.ndarray, rate: float, pause: float = 0.1
) -> Reference:
    """Return point-to-point moves with trapezoidal velocities, synchronised joints and pauses.

    The slowest joint sets the duration of a move; the others accelerate for the same share of it.

    Args:
        points: (P, n) joint values [rad or m].
        velocity, acceleration: (n,) limits.
        pause: time at rest after every move and before the first [s].
    """
    points = shaped(points, (None, None), "points")
    n = points.shape[1]
    velocity_limits = np.asarray(velocity, dtype=float)
    acceleration_limits = np.asarray(acceleration, dtype=float)
    velocity = np.broadcast_to(velocity_limits, n)
    acceleration = np.broadcast_to(acceleration_limits, n)
    still = np.zeros((round(pause * rate), n))
    positions = [still + points[0]]
    velocities = [still]
    accelerations = [still]
    for start, stop in pairwise(points):
        q, v, a = _move(start, stop, velocity, acceleration, rate)
        positions += [q, still + stop]
        velocities += [v, still]
        accelerations += [a, still]
    q = np.concatenate(positions)
    t = np.arange(len(q)) / rate
    v = np.concatenate(velocities)
    a = np.concatenate(accelerations)
    return Reference(t, q, v, a)


def _move(
    start: np.ndarray, stop: np.ndarray, velocity: np.ndarray, acceleration: np.ndarray, rate: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return positions, velocities and accelerations (N, n) of a move between two points, without its first sample.

    The share of the way s(t) goes from 0 to 1 in T seconds, with ramps of r seconds and the peak velocity 1 / (T - r).
    """
    distance = np.abs(stop - start)
    ramp_times = velocity / acceleration
    ramp = float(np.max(ramp_times, where=distance > 0, initial=1.0 / rate))
    cruise_at_velocity = float(np.max(distance / velocity))
    cruise_at_acceleration = float(np.max(distance / acceleration)) / ramp
    cruise = max(cruise_at_velocity, cruise_at_acceleration)
    ramp = max(ramp, 2.0 / rate)
    total = max(cruise, ramp) + ramp
    intervals = int(np.ceil(total * rate))
    t = np.arange(1, intervals + 1) / rate
    peak = 1.0 / (total - ramp)
    remaining = np.maximum(total - t, 0.0)
    starting = t < ramp
    stopping = remaining < ramp
    # share of the way: ramp at the start, constant speed, ramp at the end
    share_at_start = 0.5 * peak * t**2 / ramp
    share_between = peak * (t - ramp / 2)
    share_at_end = 1 - 0.5 * peak * remaining**2 / ramp
    share = np.where(stopping, share_at_end, share_between)
    share = np.where(starting, share_at_start, share)
    # its speed
    speed = np.where(stopping, peak * remaining / ramp, peak)
    speed = np.where(starting, peak * t / ramp, speed)
    # its acceleration, zero at the end
    braking = stopping & (remaining > 0)
    change = np.where(braking, -peak / ramp, 0.0)
    change = np.where(starting, peak / ramp, change)
    distances = stop - start
    q = start + np.outer(share, distances)
    v = np.outer(speed, distances)
    a = np.outer(change, distances)
    return q, v, a


# Drive terms of a joint with a torque sensor: motor inertia, then friction and offset on the link's and motor's side.
SIDED = ("Ia", "Fvl", "Fcl", "offl", "Fvm", "Fcm", "offm")


@cache
def truth(name: str) -> ParsedTable:
    """Return the true parameters of ``tx40``, ``rv2sq`` or ``lwr4plus``, as a table read from the library's file."""
    return description.read_extra(library.path(f"{name}_truth"))["truth"]


def plant(name: str, coupled: bool = False, offset: np.ndarray | None = None) -> Plant:
    """Return the simulated TX40 or RV-2SQ with motor inertia Ia, friction Fv and Fc of each joint.

    Args:
        coupled: with the TX40's wrist coupling: Ia6 on both rows, Fvm6, Fcm6.
        offset: (n,) torque offsets, terms ``off1`` …; None for none.
    """
    chain = description.read(library.path(name))
    true_values = truth(name)
    drive_rows = true_values["drives"]
    shapes = ["Ia", "Fv", "Fc"]
    if offset is not None:
        shapes.append("off")
    rows = {**drive_rows, "off": offset}
    amounts = []
    for joint in range(chain.n):
        amounts += [rows[shape][joint] for shape in shapes]  # ty: ignore[not-subscriptable]
    joint_terms = " ".join(shapes)
    terms = list(drives.standard([joint_terms] * chain.n, drive_rows["v0"]))
    if coupled:
        coupling = true_values["coupling"]
        first_number, second_number = coupling["joints"]
        first = first_number - 1
        second = second_number - 1
        # one motor inertia: Iam6 is Ia6, which acts on row 5 by a6 and on row 6 by a5 + a6
        on_first = (first, ((second, 1.0),))
        on_second = (second, ((first, 1.0), (second, 1.0)))
        both_rows = (on_first, on_second)
        for k, term in enumerate(terms):
            if term.shape == "acceleration" and term.joint == second:
                terms[k] = replace(term, acts=both_rows)
        gear = drives.coupled(first, second, drive_rows["v0"])
        terms += gear[1:]
        amounts += [coupling["Fvm"], coupling["Fcm"]]
    inertial = standard_parameters(chain)
    parameters = np.concatenate([inertial, amounts])
    return Plant(bodies_of(chain), tuple(terms), parameters)


def controller(name: str) -> LoopController:
    """Return the published PD controller of the TX40 or RV-2SQ."""
    gains = truth(name)["control"]
    kp = np.array(gains["kp"])
    kd = np.array(gains["kd"])
    limit = np.array(gains.get("limit", np.inf))
    return pd(kp, kd, limit)


def model(plant: Plant) -> IdentificationModel:
    """Return the identification model whose parameters are those of the plant."""
    return IdentificationModel(plant.bodies, plant.terms)
