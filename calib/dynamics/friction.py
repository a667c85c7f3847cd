"""Richer friction as more columns: the rungs that identification climbs by cross-validation.

Every builder returns terms of one joint to add to the standard ones (`calib.dynamics.drives`); what enters nonlinearly
(a width, a speed, an order) is a stated setting, to be given or searched by the caller. Joints count from 0.
"""

from __future__ import annotations

from collections.abc import Sequence

from calib.dynamics.drives import DriveTerm, term
from calib.dynamics.shapes import V0


def asymmetric(joint: int) -> tuple[DriveTerm, ...]:
    """Return ``Fva``: viscous friction that differs by direction, tau += Fva abs(v).

    Fv ± Fva are the coefficients of the two directions; a Coulomb torque that differs is Fc and off already.
    """
    return (term(f"Fva{joint + 1}", "speed", joint),)


def cubic(joint: int) -> tuple[DriveTerm, ...]:
    """Return ``Fvc``: tau += Fvc v³, viscous friction that bends with speed."""
    return (term(f"Fvc{joint + 1}", "cubic", joint),)


def root(joint: int, v0: float = V0) -> tuple[DriveTerm, ...]:
    """Return ``Fvr``: tau += Fvr v / sqrt(abs(v) + v0), the root of the speed, regular at rest."""
    return (term(f"Fvr{joint + 1}", "root", joint, v0),)


def stribeck(joint: int, vs: float, exponent: float = 1.0, v0: float = V0) -> tuple[DriveTerm, ...]:
    """Return ``Fs``: tau += Fs sign(v) exp(-(abs(v) / vs)^exponent) (Stribeck; exponents 1 and 2 are in use)."""
    return (term(f"Fs{joint + 1}", "stribeck", joint, vs, exponent, v0),)


def load_dependent(joint: int, v0: float = V0, viscous: bool = False) -> tuple[DriveTerm, ...]:
    """Return ``Ft`` (and ``Fvt``): tau += Ft abs(load) sign(v) + Fvt abs(load) v.

    The load is the torque the gear transmits (Hamon, Gautier, Garrec 2010); measured or predicted, the caller's choice.
    """
    first = term(f"Ft{joint + 1}", "load", joint, v0)
    return (first, term(f"Fvt{joint + 1}", "load_velocity", joint)) if viscous else (first,)


def presliding(joint: int, widths: Sequence[float], v0: float = V0) -> tuple[DriveTerm, ...]:
    """Return ``Fp3.1 Fp3.2 …``: friction at rest that depends on the past, one stop operator z per width [rad or m].

    tau += Fp (z - sign(v)): z is sign(v) in steady sliding, so that Fc stays the Coulomb friction of steady sliding
    (our choice; columns z would span the same torques, and share Fc out among themselves).
    """
    return tuple(term(f"Fp{joint + 1}.{k + 1}", "presliding", joint, width, v0) for k, width in enumerate(widths))


def ripple(joint: int, orders: Sequence[float], speed: float = float("inf")) -> tuple[DriveTerm, ...]:
    """Return sine and cosine of k · q per order k [per rad], ``Rs3.241 Rc3.241``, fading as 1 / (1 + (v / speed)²)."""
    found: list[DriveTerm] = []
    for order in orders:
        for name, shape in (("Rs", "sine"), ("Rc", "cosine")):
            found.append(term(f"{name}{joint + 1}.{order:g}", shape, joint, order, speed))
    return tuple(found)
