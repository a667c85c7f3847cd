"""Paths q = Φ(s): geometry of a motion without timing, at least twice continuously differentiable.

Splines through joint waypoints are parametrised by chord length (the knots s_k have the distances |q_k - q_{k-1}|). Φ'
then has a norm near one, and the spline does not overshoot where waypoints are unevenly spaced (de Boor 1978; Lee 1989
compares parametrisations).
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline, make_interp_spline

from ..errors import BadInput

SAME = 1e-9  # waypoints nearer than this [rad or m] are one


@dataclass(frozen=True, eq=False)
class Path:
    """A path q = Φ(s) of n joints as a spline, with the path parameter s.

    Attributes:
        derivative: (s (N,), order) to (N, n), d^order Φ / ds^order [rad or m per s^order], order 0 to 2.
        knots: (K,) path parameters from 0 to the length; Φ is smooth between neighbouring knots.
    """

    derivative: Callable[[np.ndarray, int], np.ndarray]
    knots: np.ndarray

    def __call__(self, s: np.ndarray, order: int = 0) -> np.ndarray:
        return self.derivative(np.asarray(s, dtype=float), order)

    @property
    def length(self) -> float:
        return float(self.knots[-1])

    @property
    def n(self) -> int:
        return self(self.knots[:1]).shape[1]

    # what toppra asks of a path
    @property
    def dof(self) -> int:
        return self.n

    @property
    def path_interval(self) -> np.ndarray:
        return np.array([0.0, self.length])


def spline(waypoints: np.ndarray, spacing: np.ndarray | None = None, scale: np.ndarray | None = None) -> Path:
    """Return the natural cubic spline (C²) through waypoints; for two waypoints this is the straight line.

    Args:
        waypoints: (m, n) joint values [rad or m], two or more.
        spacing: (m - 1,) factors on the distances between knots (the chord lengths in joint space), which change the
            shape of the path; None: ones.
        scale: (n,) length of each joint that enters the chord length as 1 [rad or m]; None: ones.

    Raises:
        BadInput: fewer than two waypoints, equal neighbours, or values that are not numbers.
    """
    points = checked(waypoints)
    steps = np.diff(points, axis=0)
    if scale is not None:
        steps = steps / scale
    chords = np.linalg.norm(steps, axis=1)
    if spacing is None:
        factors = np.ones(len(chords))
    else:
        factors = np.asarray(spacing, dtype=float)
    if factors.shape != chords.shape or not (np.isfinite(factors) & (factors > 0)).all():
        raise BadInput(f"spacing of the knots: expected {len(chords)} numbers above zero, found {spacing}")
    knot_spacing = np.cumsum(chords * factors)
    knots = np.append(0.0, knot_spacing)
    return Path(CubicSpline(knots, points, bc_type="natural"), knots)


def through(samples: np.ndarray, s: np.ndarray) -> Path:
    """Return the quintic spline (C⁴) through dense samples (N, n) of a curve, at parameters s (N,) rising from 0."""
    points = checked(samples)
    degree = min(5, len(points) - 1 - len(points) % 2)
    curve = make_interp_spline(s, points, k=degree)
    return Path(curve, np.asarray(s, dtype=float))


def checked(waypoints: np.ndarray) -> np.ndarray:
    """Return the waypoints (m, n) as floats.

    Raises:
        BadInput: fewer than two waypoints, equal neighbours, or values that are not numbers.
    """
    points = np.asarray(waypoints, dtype=float)
    if points.ndim != 2 or not points.shape[1]:
        raise BadInput(f"waypoints: expected an (m, n) array of joint values, found shape {points.shape}")
    if not np.isfinite(points).all():
        bad_rows, bad_joints = np.nonzero(~np.isfinite(points))
        row = int(bad_rows[0])
        joint = int(bad_joints[0])
        raise BadInput(f"waypoint {row + 1}, joint {joint + 1} is not a number ({points[row, joint]})")
    if len(points) < 2:
        raise BadInput(f"{len(points)} waypoint: a path needs two or more (the first is the start)")
    steps = np.abs(np.diff(points, axis=0)).max(axis=1)
    if (steps <= SAME).any():
        k = int(np.argmax(steps <= SAME))
        raise BadInput(f"waypoints {k + 1} and {k + 2} are the same; remove one (a motion stops only at its end)")
    return points


def check_within(path: Path, lower: np.ndarray, upper: np.ndarray, waypoints: np.ndarray | None = None) -> np.ndarray:
    """Return the path's smallest distance (n,) from the nearer joint limit [rad or m].

    Args:
        path: the path.
        lower, upper: (n,) joint limits [rad or m].
        waypoints: (m, n) waypoints, to be named in the message; None where the path has no waypoints.

    Raises:
        BadInput: the path exceeds a limit; the message names the waypoint or the part of the path, the joint and the
            excess.
    """
    for k, point in enumerate(() if waypoints is None else waypoints):
        excess = np.maximum(point - upper, lower - point)
        if (excess > 0).any():
            j = int(np.argmax(excess))
            raise BadInput(
                f"waypoint {k + 1}: joint {j + 1} at {point[j]:.4g} is {excess[j]:.3g} beyond its limits "
                f"{lower[j]:.4g} to {upper[j]:.4g}"
            )
    places, values = extremes(path)
    excess = np.maximum(values - upper, lower - values)
    if (excess > 0).any():
        k, j = np.unravel_index(np.argmax(excess), excess.shape)
        before = max(int(np.searchsorted(path.knots, places[k, j])), 1)
        hint = f" between waypoints {before} and {before + 1}" if waypoints is not None else ""
        raise BadInput(
            f"the path overshoots{hint} to {values[k, j]:.4g} at joint {j + 1}, {excess[k, j]:.3g} beyond its limits "
            f"{lower[j]:.4g} to {upper[j]:.4g}: add a waypoint there, or move the waypoints away from the limit"
        )
    return -excess.max(axis=0)


def extremes(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return the path parameters of each joint's minimum and maximum, and the joint values there, two arrays (2, n)."""
    spans = len(path.knots) - 1
    samples = 40  # samples per knot interval where extremes are looked for
    positions = np.linspace(0, spans, samples * spans + 1)
    s = np.interp(positions, np.arange(spans + 1), path.knots)
    s = np.concatenate([s, reversals(path, s)])
    q = path(s)
    peaks = np.array([q.argmin(axis=0), q.argmax(axis=0)])
    return s[peaks], q[peaks, np.arange(path.n)]


def reversals(path: Path, s: np.ndarray) -> np.ndarray:
    """Return the path parameters at which a joint reverses (zeros of Φ'_j = dΦ_j/ds), found by bisection.

    Args:
        path: the path q = Φ(s).
        s: (N,) samples; one reversal of each joint is found between neighbours with opposite signs of Φ'_j.
    """
    slope = path(s, 1)
    k, j = np.nonzero(slope[:-1] * slope[1:] < 0)
    low = s[k]
    high = s[k + 1]
    rising = slope[k + 1, j] > 0
    rows = np.arange(len(k))
    for _ in range(50 if len(k) else 0):
        middle = (low + high) / 2
        beyond = (path(middle, 1)[rows, j] > 0) == rising
        low = np.where(beyond, low, middle)
        high = np.where(beyond, middle, high)
    return (low + high) / 2
