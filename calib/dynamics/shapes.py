"""What a drive's torque can depend on: one function of the joint's motion per shape, with its exact slopes.

A shape sees x, v, a [rad or m, per s, per s²] of one joint (or of a sum of joints, where a gear couples them), the
torque the joint transmits, and its settings; it says by how much the torque changes per unit of its parameter.

The Coulomb sign is smoothed as s(v) = tanh(v / v0) (v0 = 0: the exact sign; BIRDy's choice is v0 = 0.01 rad/s). It is
a dead-zone sign where the shape is called ``dead``: 0 where abs(v) <= v0.

Shapes that bend keep their value beyond an ``edge`` [rad/s or m/s], the fastest that was learnt from (infinite where
it is not given): beyond it, friction goes on linearly.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

V0 = 0.01  # [rad/s or m/s], default smoothing of the Coulomb sign


@dataclass(frozen=True)
class Joined:
    """The motion one term sees, each (N,); `load` [N m or N] and `state` None where no term asks for them."""

    x: np.ndarray
    v: np.ndarray
    a: np.ndarray
    load: np.ndarray | None = None
    state: np.ndarray | None = None


Values = Callable[[Joined, tuple[float, ...]], np.ndarray]
Slopes = Callable[[Joined, tuple[float, ...]], tuple[np.ndarray | float, np.ndarray | float, np.ndarray | float]]


@dataclass(frozen=True)
class Shape:
    """One shape.

    Attributes:
        values: (N,) of a `Joined` and the settings.
        slopes: by x, v and a, each (N,) or 0; None where the shape has none (it depends on the past or on torques).
        unit: of the parameter for a revolute joint, and `unit_linear` for a prismatic one.
        settings: names of the numbers it needs, with units.
        loaded, remembers: whether it needs `Joined.load`, `Joined.state`.
        dissipative: friction, which takes energy out of the joint where its parameter is above zero.
        of_velocity: whether it is a function of v alone (a constant is one).
        nonnegative: whether its parameter is above zero in every robot: inertia, viscous and Coulomb friction.
        exact: whether its columns are free of the noise of q, v and a: ones, and signs but for reversals.
    """

    values: Values
    slopes: Slopes | None
    unit: str
    unit_linear: str
    settings: tuple[str, ...] = ()
    loaded: bool = False
    remembers: bool = False
    dissipative: bool = False
    of_velocity: bool = False
    nonnegative: bool = False
    exact: bool = False


def _smooth_sign(v: np.ndarray, v0: float) -> np.ndarray:
    """Return tanh(v / v0), the exact sign for v0 = 0."""
    return np.tanh(v / v0) if v0 > 0 else np.sign(v)


def _sign_slope(v: np.ndarray, v0: float) -> np.ndarray | float:
    return (1.0 - np.tanh(v / v0) ** 2) / v0 if v0 > 0 else 0.0


def _held(v: np.ndarray, edge: float) -> np.ndarray:
    """Return the velocity up to the edge of what was learnt: there a shape that bends keeps its value."""
    return np.clip(v, -edge, edge)


def _stribeck(m: Joined, s: tuple[float, ...]) -> np.ndarray:
    return _smooth_sign(m.v, s[2]) * np.exp(-((np.abs(m.v) / s[0]) ** s[1]))


def _stribeck_slopes(m: Joined, s: tuple[float, ...]):
    ratio = np.abs(m.v) / s[0]
    inner = s[1] / s[0] * ratio ** (s[1] - 1.0) * np.sign(m.v)
    return 0.0, np.exp(-(ratio ** s[1])) * (_sign_slope(m.v, s[2]) - _smooth_sign(m.v, s[2]) * inner), 0.0


def _fading(v: np.ndarray, speed: float) -> np.ndarray:
    return 1.0 / (1.0 + (v / speed) ** 2)


def _ripple_slopes(wave: np.ndarray, by_x: np.ndarray, m: Joined, s: tuple[float, ...]):
    gain = _fading(m.v, s[1])
    return s[0] * by_x * gain, -2.0 * m.v / s[1] ** 2 * gain**2 * wave, 0.0


def banded(m: Joined, s: tuple[float, ...]) -> np.ndarray:
    """Return the gain of ripple in one band and one direction: a hat over the frequency order · |v| / 2π [Hz].

    It fades over 0.1 rad beyond the positions it was learnt at, lower … upper: its phase does not carry further.
    """
    order, left, middle, right, way, lower, upper = s
    frequency = np.abs(m.v) * order / (2.0 * np.pi)
    falls = np.ones_like(m.v) if np.isinf(right) else (right - frequency) / (right - middle)
    gain = np.clip(np.minimum((frequency - left) / (middle - left), falls), 0.0, 1.0) * (way * m.v > 0.0)
    beyond = np.maximum(np.maximum(lower - m.x, m.x - upper), 0.0)
    return gain * np.clip(1.0 - beyond / 0.1, 0.0, 1.0)


BANDED = ("order", "left", "middle", "right", "way", "lower", "upper")


def _given(array: np.ndarray | None) -> np.ndarray:
    assert array is not None  # the caller checks `Shape.loaded` and `Shape.remembers`
    return array


VISCOUS, VISCOUS_LINEAR = "N m s/rad", "N s/m"
SHAPES: dict[str, Shape] = {
    "acceleration": Shape(
        lambda m, s: m.a, lambda m, s: (0.0, 0.0, np.ones_like(m.a)), "kg m²", "kg", nonnegative=True
    ),
    "velocity": Shape(
        lambda m, s: m.v, lambda m, s: (0.0, np.ones_like(m.v), 0.0), VISCOUS, VISCOUS_LINEAR,
        dissipative=True, of_velocity=True, nonnegative=True,
    ),
    "one": Shape(
        lambda m, s: np.ones_like(m.v), lambda m, s: (0.0, 0.0, 0.0), "N m", "N", of_velocity=True, exact=True
    ),
    "position": Shape(lambda m, s: m.x, lambda m, s: (np.ones_like(m.x), 0.0, 0.0), "N m/rad", "N/m"),
    "sign": Shape(
        lambda m, s: _smooth_sign(m.v, s[0]), lambda m, s: (0.0, _sign_slope(m.v, s[0]), 0.0), "N m", "N", ("v0",),
        dissipative=True, of_velocity=True, nonnegative=True, exact=True,
    ),
    "dead": Shape(
        lambda m, s: np.sign(m.v) * (np.abs(m.v) > s[0]), lambda m, s: (0.0, 0.0, 0.0), "N m", "N", ("v0",),
        dissipative=True,
    ),
    "speed": Shape(
        lambda m, s: np.abs(_held(m.v, s[0])), lambda m, s: (0.0, np.sign(m.v) * (np.abs(m.v) < s[0]), 0.0),
        VISCOUS, VISCOUS_LINEAR, ("edge",), dissipative=True, of_velocity=True,
    ),
    "cubic": Shape(
        lambda m, s: _held(m.v, s[0]) ** 3, lambda m, s: (0.0, 3.0 * m.v**2 * (np.abs(m.v) < s[0]), 0.0),
        "N m s³/rad³", "N s³/m³", ("edge",), dissipative=True, of_velocity=True,
    ),
    "root": Shape(
        lambda m, s: _held(m.v, s[0]) / np.sqrt(np.abs(_held(m.v, s[0])) + s[1]),
        lambda m, s: (0.0, (0.5 * np.abs(m.v) + s[1]) / (np.abs(m.v) + s[1]) ** 1.5 * (np.abs(m.v) < s[0]), 0.0),
        "N m (s/rad)^½", "N (s/m)^½", ("edge", "v0"), dissipative=True, of_velocity=True,
    ),
    "stribeck": Shape(
        _stribeck, _stribeck_slopes, "N m", "N", ("vs", "exponent", "v0"), dissipative=True, of_velocity=True
    ),
    "load": Shape(
        lambda m, s: np.abs(_given(m.load)) * _smooth_sign(m.v, s[0]), None, "", "", ("v0",),
        loaded=True, dissipative=True,
    ),
    "load_velocity": Shape(
        lambda m, s: np.abs(_given(m.load)) * _held(m.v, s[0]), None, "s/rad", "s/m", ("edge",),
        loaded=True, dissipative=True,
    ),
    "stop": Shape(lambda m, s: _given(m.state), None, "N m", "N", ("width",), remembers=True, dissipative=True),
    "presliding": Shape(
        lambda m, s: _given(m.state) - _smooth_sign(m.v, s[1]), None, "N m", "N", ("width", "v0"), remembers=True
    ),
    "sine": Shape(
        lambda m, s: np.sin(s[0] * m.x) * _fading(m.v, s[1]),
        lambda m, s: _ripple_slopes(np.sin(s[0] * m.x), np.cos(s[0] * m.x), m, s),
        "N m", "N", ("order", "speed"),
    ),
    "cosine": Shape(
        lambda m, s: np.cos(s[0] * m.x) * _fading(m.v, s[1]),
        lambda m, s: _ripple_slopes(np.cos(s[0] * m.x), -np.sin(s[0] * m.x), m, s),
        "N m", "N", ("order", "speed"),
    ),
    "sine_band": Shape(lambda m, s: np.sin(s[0] * m.x) * banded(m, s), None, "N m", "N", BANDED),
    "cosine_band": Shape(lambda m, s: np.cos(s[0] * m.x) * banded(m, s), None, "N m", "N", BANDED),
}  # fmt: skip
