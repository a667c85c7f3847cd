"""Shapes of drive torques: one row per shape; formulas and derivatives are in `calib.dynamics.shape_kernels`.

A shape is a function of the motion x, v, a [rad or m, per s, per s²] of one joint (or of a sum of joints that a gear
couples), of the torque that the joint transmits, and of the shape's settings; its value is the torque per unit of the
parameter. To add a shape, add a row here (and in `STEPS`, if the friction ladder is to try it), and a formula with a
code in `shape_kernels`. Arrays, simulator, tangents and option files use both.

The Coulomb sign is smoothed as s(v) = tanh(v / v0); v0 = 0 is the exact sign, and BIRDy uses v0 = 0.01 rad/s. The shape
``dead`` instead has a dead zone: 0 for abs(v) <= v0.

Shapes that are nonlinear in speed are constant beyond an ``edge`` [rad/s or m/s], the fastest speed of their
identification (infinite if not given). Beyond the edge, friction changes only by its linear terms.

The shapes ``velocity_table`` and ``position_table`` are any function of v or x, given by its value and slope at knots,
between which it is the cubic with these values and slopes (Hermite); beyond the knots it is constant. Their settings
are the knots, one after the other: place, value, slope. Friction functions of
scripts become such tables (`calib.identification.friction.function_tables`).
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

V0 = 0.01
"""Default smoothing of the Coulomb sign [rad/s or m/s]."""
PRESLIDING_SHARES = (0.0005, 0.002, 0.008, 0.03)
"""Widths of candidate stop operators in units of the joint's travel (our choice)."""
CABLE_HARMONICS = (1, 2, 3)
"""Candidate harmonics of a cable's torque (our choice)."""
STRIBECK_SHARES = {"": 0.05, ".2": 0.2}
"""Candidate Stribeck speeds in units of the joint's peak speed, by the end of the term's name."""


@dataclass(frozen=True)
class TermMotion:
    """Motion that one drive term depends on.

    Attributes:
        x, v, a: (N,) position, velocity, acceleration [rad or m, per s, per s²].
        load: (N,) transmitted torque [N m or N]; None if the term does not need it.
        state: (N,) state of the stop operator; None if the term does not need it.
    """

    x: np.ndarray
    v: np.ndarray
    a: np.ndarray
    load: np.ndarray | None = None
    state: np.ndarray | None = None


@dataclass(frozen=True)
class RecordedRange:
    """Ranges of a joint's recorded motion, which scale the settings of its candidate terms.

    Attributes:
        v0: smoothing of the joint's Coulomb sign [rad/s or m/s].
        peak, edge: speed that the joint rarely exceeds, and its fastest speed [rad/s or m/s].
        travel: distance between the extreme positions [rad or m].
    """

    v0: float
    peak: float
    edge: float
    travel: float


@dataclass(frozen=True)
class Shape:
    """One shape of drive torque and its properties.

    Attributes:
        unit, unit_linear: units of the parameter for a revolute and for a prismatic joint.
        settings: names of the shape's settings; ``v0`` smooths Coulomb's sign.
        slopes: whether the shape has derivatives (not if it depends on past motion or torques).
        loaded, remembers: whether the shape needs `TermMotion.load` and `TermMotion.state`.
        friction: whether the shape depends on speed; if not, its torque along a path is affine in s̈ and ṡ².
        dissipative: whether the shape dissipates energy for a positive parameter.
        of_velocity: whether the shape is a function of v alone (or constant).
        nonnegative: whether the parameter is positive in every robot: inertia, viscous and Coulomb friction.
        exact: whether the shape's columns are free of the noise of q, v and a: constants, and signs except at
            reversals.
        tabulated: whether the settings are knots of a table: any number of triples place, value, slope.
        undecided_at_rest: whether the shape depends on the sign of the speed, so that its value is unknown for a joint
            at rest.
    """

    unit: str
    unit_linear: str
    settings: tuple[str, ...] = ()
    slopes: bool = True
    loaded: bool = False
    remembers: bool = False
    friction: bool = True
    dissipative: bool = False
    of_velocity: bool = False
    nonnegative: bool = False
    exact: bool = False
    undecided_at_rest: bool = False
    tabulated: bool = False


BAND = ("order", "left", "middle", "right", "way", "lower", "upper")
KNOT = ("place", "value", "slope")
VISCOUS, VISCOUS_LINEAR = "N m s/rad", "N s/m"
SHAPES: dict[str, Shape] = {
    "acceleration": Shape("kg m²", "kg", friction=False, nonnegative=True),
    "velocity": Shape(VISCOUS, VISCOUS_LINEAR, dissipative=True, of_velocity=True, nonnegative=True),
    "one": Shape("N m", "N", friction=False, of_velocity=True, exact=True),
    "position": Shape("N m/rad", "N/m", friction=False),
    "sign": Shape(
        "N m", "N", ("v0",), dissipative=True, of_velocity=True, nonnegative=True, exact=True, undecided_at_rest=True
    ),
    "dead": Shape("N m", "N", ("v0",), dissipative=True, undecided_at_rest=True),
    "speed": Shape(VISCOUS, VISCOUS_LINEAR, ("edge",), dissipative=True, of_velocity=True),
    "cubic": Shape("N m s³/rad³", "N s³/m³", ("edge",), dissipative=True, of_velocity=True),
    "root": Shape("N m (s/rad)^½", "N (s/m)^½", ("edge", "rest"), dissipative=True, of_velocity=True),
    "stribeck": Shape("N m", "N", ("vs", "exponent", "v0"), dissipative=True, of_velocity=True, undecided_at_rest=True),
    "load": Shape("", "", ("v0",), slopes=False, loaded=True, dissipative=True, undecided_at_rest=True),
    "load_velocity": Shape("s/rad", "s/m", ("edge",), slopes=False, loaded=True, dissipative=True),
    "stop": Shape("N m", "N", ("width",), slopes=False, remembers=True, dissipative=True, undecided_at_rest=True),
    "presliding": Shape("N m", "N", ("width", "v0"), slopes=False, remembers=True, undecided_at_rest=True),
    "sine": Shape("N m", "N", ("order", "speed")),
    "cosine": Shape("N m", "N", ("order", "speed")),
    "sine_band": Shape("N m", "N", BAND, slopes=False),
    "cosine_band": Shape("N m", "N", BAND, slopes=False),
    "velocity_table": Shape(
        "N m", "N", KNOT, dissipative=True, of_velocity=True, undecided_at_rest=True, tabulated=True
    ),
    "position_table": Shape("N m", "N", KNOT, friction=False, tabulated=True),
}


class Offer(NamedTuple):
    """Candidate terms of a joint in one step of the friction ladder.

    Attributes:
        label: start of the terms' names; a name is ``label + joint number + ending``.
        shape: a key of `SHAPES`.
        settings: function of a joint's recorded range that returns the settings of each candidate, by the ending of its
            name.
        side: "link" or "motor" side of a joint torque sensor.
    """

    label: str
    shape: str
    settings: Callable[[RecordedRange], Mapping[str, tuple[float, ...]]]
    side: str = "motor"


def _presliding(joint: RecordedRange) -> dict[str, tuple[float, ...]]:
    """Return settings of candidate stop operators of several widths, by the ending of their names.

    Each shape is the stop operator's state minus sign(v), so that Fc remains the friction of sliding.

    Args:
        joint: recorded range of the joint's motion; the widths are shares of its travel.
    """
    return {f".{k}": (share * joint.travel, joint.v0) for k, share in enumerate(PRESLIDING_SHARES, 1)}


def _cable(joint: RecordedRange) -> dict[str, tuple[float, ...]]:
    """Return settings of candidate harmonics of the joint position, by the ending of their names.

    With the period 2 · travel they represent any smooth torque of cables and hoses.

    Args:
        joint: recorded range of the joint's motion.
    """
    return {f".{k}": (k * math.pi / joint.travel, math.inf) for k in CABLE_HARMONICS}


def _stribeck(joint: RecordedRange) -> dict[str, tuple[float, ...]]:
    """Return settings of candidate Stribeck terms with two Stribeck speeds, by the ending of their names.

    Args:
        joint: recorded range of the joint's motion; the Stribeck speeds are shares of its peak speed.
    """
    return {end: (share * joint.peak, 1.0, joint.v0) for end, share in STRIBECK_SHARES.items()}


def _smoothed(joint: RecordedRange) -> dict[str, tuple[float, ...]]:
    """Return settings of one candidate: the smoothing v0 of the Coulomb sign of `joint`."""
    return {"": (joint.v0,)}


def _up_to_edge(joint: RecordedRange) -> dict[str, tuple[float, ...]]:
    """Return settings of one candidate: the joint's fastest speed, beyond which its torque is constant."""
    return {"": (joint.edge,)}


def _root(joint: RecordedRange) -> dict[str, tuple[float, ...]]:
    """Return settings of one candidate: the joint's fastest speed (constant torque beyond it) and its smoothing."""
    return {"": (joint.edge, joint.v0)}


STEPS: dict[str, tuple[Offer, ...]] = {
    "load": (Offer("Ft", "load", _smoothed), Offer("Fvt", "load_velocity", _up_to_edge)),
    "presliding": (Offer("Fp", "presliding", _presliding),),
    "cable": (Offer("Cs", "sine", _cable, "link"), Offer("Cc", "cosine", _cable, "link")),
    "stribeck": (Offer("Fs", "stribeck", _stribeck),),
    "asymmetric": (Offer("Fva", "speed", _up_to_edge),),
    "root": (Offer("Fvr", "root", _root),),
    "cubic": (Offer("Fvc", "cubic", _up_to_edge),),
}
"""Steps of the ladder of friction, in its order, with their candidate terms."""
