"""Simulated robots with known dynamics and controllers, from the library.

Motions for simulated robots: random Fourier series within limits, and moves with trapezoidal velocities.
"""

from dataclasses import replace
from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np

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
        sines, cosines: (n, h) a and b.
        base: ω [rad/s].
        duration, rate: [s], [Hz].
    """
    t = np.arange(round(duration * rate) + 1) / rate
    speed = base * np.arange(1, sines.shape[1] + 1)
    sin, cos = np.sin(np.outer(t, speed)), np.cos(np.outer(t, speed))
    q = np.asarray(centre) + sin @ sines.T + cos @ cosines.T
    v = (cos * speed) @ sines.T - (sin * speed) @ cosines.T
    return Reference(t, q, v, -(sin * speed**2) @ sines.T - (cos * speed**2) @ cosines.T)


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
        acceleration: largest in any joint.
    """
    lower, upper, velocity = (np.asarray(x, dtype=float) for x in (lower, upper, velocity))
    rng, n = np.random.default_rng(seed), len(lower)
    order = np.arange(1, harmonics + 1)
    sines, cosines = rng.normal(size=(2, n, harmonics)) / order
    for rows, across in ((sines, order), (cosines, order**2)):
        rows -= np.outer(rows @ across, across) / (across @ across)
    base = 2 * np.pi / duration
    raw = _fourier(np.zeros(n), sines, cosines, base, duration, rate)
    low, high = raw.q.min(axis=0), raw.q.max(axis=0)
    shares = [
        (upper - lower) / (high - low),
        velocity / np.abs(raw.v).max(axis=0),
        acceleration / np.abs(raw.a).max(axis=0),
    ]
    scale = np.min(shares, axis=0)
    centre = 0.5 * (lower + upper) - 0.5 * scale * (low + high)
    return _fourier(centre, scale[:, None] * sines, scale[:, None] * cosines, base, duration, rate)


def trapezoidal(
    points: np.ndarray, velocity: np.ndarray, acceleration: np.ndarray, rate: float, pause: float = 0.1
) -> Reference:
    """Return point-to-point moves with trapezoidal velocities, synchronised joints and pauses.

    The slowest joint sets the duration of a move; the others accelerate for the same share of it.

    Args:
        points: (P, n).
        velocity, acceleration: (n,) limits.
        pause: at rest after every move and before the first [s].
    """
    points = shaped(points, (None, None), "points")
    velocity, acceleration = (
        np.broadcast_to(np.asarray(x, dtype=float), points.shape[1]) for x in (velocity, acceleration)
    )
    still = np.zeros((round(pause * rate), points.shape[1]))
    parts = [(still + points[0], still, still)]
    for start, stop in pairwise(points):
        parts += [_move(start, stop, velocity, acceleration, rate), (still + stop, still, still)]
    q, v, a = (np.concatenate(series) for series in zip(*parts))
    return Reference(np.arange(len(q)) / rate, q, v, a)


def _move(start, stop, velocity, acceleration, rate) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return one move with s(t) from 0 to 1: ramps of r seconds, T seconds in all, peak velocity 1 / (T - r)."""
    distance = np.abs(stop - start)
    ramp = float(np.max(velocity / acceleration, where=distance > 0, initial=1.0 / rate))
    cruise = max(float(np.max(distance / velocity)), float(np.max(distance / acceleration)) / ramp)
    ramp = max(ramp, 2.0 / rate)
    total = max(cruise, ramp) + ramp
    t = np.arange(1, int(np.ceil(total * rate)) + 1) / rate
    peak, remaining = 1.0 / (total - ramp), np.maximum(total - t, 0.0)
    s = np.where(
        t < ramp,
        0.5 * peak * t**2 / ramp,
        np.where(remaining < ramp, 1 - 0.5 * peak * remaining**2 / ramp, peak * (t - ramp / 2)),
    )
    speed = np.where(t < ramp, peak * t / ramp, np.where(remaining < ramp, peak * remaining / ramp, peak))
    change = np.where(t < ramp, peak / ramp, np.where((remaining < ramp) & (remaining > 0), -peak / ramp, 0.0))
    return start + np.outer(s, stop - start), np.outer(speed, stop - start), np.outer(change, stop - start)


SIDED = ("Ia", "Fvl", "Fcl", "offl", "Fvm", "Fcm", "offm")  # drive terms of a joint with a torque sensor


@cache
def truth(name: str) -> dict[str, Any]:
    """Return the true parameters of ``tx40``, ``rv2sq`` or ``lwr4plus``."""
    return description.read_extra(library.path(f"{name}_truth"))["truth"]


def plant(name: str, coupled: bool = False, offset: np.ndarray | None = None) -> Plant:
    """Return the simulated TX40 or RV-2SQ with motor inertia Ia, friction Fv and Fc of each joint.

    Args:
        coupled: with the TX40's wrist coupling: Ia6 on both rows, Fvm6, Fcm6.
        offset: (n,) torque offsets, terms ``off1`` …; None for none.
    """
    chain, true_values = description.read(library.path(name)), truth(name)
    drive_terms = "Ia Fv Fc" if offset is None else "Ia Fv Fc off"
    values = {key: true_values["drives"][key] for key in ("Ia", "Fv", "Fc")}
    values["off"] = np.zeros(chain.n) if offset is None else offset
    terms = list(drives.standard([drive_terms] * chain.n, true_values["drives"]["v0"]))
    amounts = [values[key][joint] for joint in range(chain.n) for key in drive_terms.split()]
    if coupled:
        link = true_values["coupling"]
        first, second = (joint - 1 for joint in link["joints"])
        gear = drives.coupled(first, second, true_values["drives"]["v0"])
        coupled_index = next(k for k, term in enumerate(terms) if term.shape == "acceleration" and term.joint == second)
        # one motor inertia: Iam6 is Ia6, which acts on row 5 by a6 and on row 6 by a5 + a6
        both_rows = ((first, ((second, 1.0),)), (second, ((first, 1.0), (second, 1.0))))
        terms[coupled_index] = replace(terms[coupled_index], acts=both_rows)
        terms += gear[1:]
        amounts += [link["Fvm"], link["Fcm"]]
    return Plant(bodies_of(chain), tuple(terms), np.concatenate([standard_parameters(chain), amounts]))


def controller(name: str) -> LoopController:
    """Return the published PD controller of the TX40 or RV-2SQ."""
    gains = truth(name)["control"]
    return pd(np.array(gains["kp"]), np.array(gains["kd"]), np.array(gains.get("limit", np.inf)))


def model(plant: Plant) -> IdentificationModel:
    """Return the identification model whose parameters are those of the plant."""
    return IdentificationModel(plant.bodies, plant.terms)
