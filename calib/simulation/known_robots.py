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
    """Return q_i = q_i0 + Σ_k [a_ik sin(k ω t) + b_ik cos(k ω t)] (Swevers et al. 1997; Kolyubin et al. 2019, eq. 23).

    Args:
        centre: (n,) q_i0.
        sines, cosines: (n, h) coefficients a and b.
        base: ω [rad/s].
        duration, rate: [s], [Hz].
    """
    t = np.arange(round(duration * rate) + 1) / rate
    harmonics = np.arange(1, sines.shape[1] + 1)
    speed = base * harmonics
    phase = np.outer(t, speed)
    sin = np.sin(phase)
    cos = np.cos(phase)
    q = np.asarray(centre) + sin @ sines.T + cos @ cosines.T
    v = (cos * speed) @ sines.T - (sin * speed) @ cosines.T
    a = -(sin * speed**2) @ sines.T - (cos * speed**2) @ cosines.T
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

    Coefficients fall with the harmonic's number and are projected to rest (Σ k a_k = Σ k² b_k = 0); each joint is
    scaled until its first limit is met, then centred. A stand-in for designed excitation, not a replacement.

    Args:
        lower, upper, velocity: (n,) limits, kept everywhere on the grid of `rate`.
        acceleration: largest acceleration of any joint [rad/s² or m/s²].
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
    centre = 0.5 * (lower + upper) - 0.5 * scale * (low + high)
    amplitude = scale[:, None]
    return _fourier(centre, amplitude * sines, amplitude * cosines, base, duration, rate)


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
    velocity = np.broadcast_to(np.asarray(velocity, dtype=float), n)
    acceleration = np.broadcast_to(np.asarray(acceleration, dtype=float), n)
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
    return Reference(t, q, np.concatenate(velocities), np.concatenate(accelerations))


def _move(
    start: np.ndarray, stop: np.ndarray, velocity: np.ndarray, acceleration: np.ndarray, rate: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return one move with s(t) from 0 to 1: ramps of r seconds, T seconds in all, peak velocity 1 / (T - r)."""
    distance = np.abs(stop - start)
    ramp_times = velocity / acceleration
    ramp = float(np.max(ramp_times, where=distance > 0, initial=1.0 / rate))
    cruise_at_velocity = float(np.max(distance / velocity))
    cruise_at_acceleration = float(np.max(distance / acceleration)) / ramp
    cruise = max(cruise_at_velocity, cruise_at_acceleration)
    ramp = max(ramp, 2.0 / rate)
    total = max(cruise, ramp) + ramp
    t = np.arange(1, int(np.ceil(total * rate)) + 1) / rate
    peak = 1.0 / (total - ramp)
    remaining = np.maximum(total - t, 0.0)
    starting = t < ramp
    stopping = remaining < ramp
    # share of the way, its speed and its acceleration: without the ramp at the start, then with it
    share = np.where(stopping, 1 - 0.5 * peak * remaining**2 / ramp, peak * (t - ramp / 2))
    share = np.where(starting, 0.5 * peak * t**2 / ramp, share)
    speed = np.where(stopping, peak * remaining / ramp, peak)
    speed = np.where(starting, peak * t / ramp, speed)
    change = np.where(stopping & (remaining > 0), -peak / ramp, 0.0)
    change = np.where(starting, peak / ramp, change)
    distances = stop - start
    return start + np.outer(share, distances), np.outer(speed, distances), np.outer(change, distances)


SIDED = ("Ia", "Fvl", "Fcl", "offl", "Fvm", "Fcm", "offm")  # drive terms of a joint with a torque sensor


@cache
def truth(name: str) -> ParsedTable:
    """Return the true parameters of ``tx40``, ``rv2sq`` or ``lwr4plus``."""
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
        amounts += [rows[shape][joint] for shape in shapes]
    terms = list(drives.standard([" ".join(shapes)] * chain.n, drive_rows["v0"]))
    if coupled:
        coupling = true_values["coupling"]
        first, second = (joint - 1 for joint in coupling["joints"])
        # one motor inertia: Iam6 is Ia6, which acts on row 5 by a6 and on row 6 by a5 + a6
        both_rows = ((first, ((second, 1.0),)), (second, ((first, 1.0), (second, 1.0))))
        for k, term in enumerate(terms):
            if term.shape == "acceleration" and term.joint == second:
                terms[k] = replace(term, acts=both_rows)
        gear = drives.coupled(first, second, drive_rows["v0"])
        terms += gear[1:]
        amounts += [coupling["Fvm"], coupling["Fcm"]]
    parameters = np.concatenate([standard_parameters(chain), amounts])
    return Plant(bodies_of(chain), tuple(terms), parameters)


def controller(name: str) -> LoopController:
    """Return the published PD controller of the TX40 or RV-2SQ."""
    gains = truth(name)["control"]
    limit = np.array(gains.get("limit", np.inf))
    return pd(np.array(gains["kp"]), np.array(gains["kd"]), limit)


def model(plant: Plant) -> IdentificationModel:
    """Return the identification model whose parameters are those of the plant."""
    return IdentificationModel(plant.bodies, plant.terms)
