"""The convex step of timing: the fastest speed profile within limits on rows a u + b x + c, with u = s̈ and x = ṡ².

Controllable speeds are computed by toppra (Pham & Pham 2018), imported at the first call. The forward pass is our own:
with x given, the largest u is the smallest of a few quotients, whereas the forward pass of toppra loses 1e-4 of x at
every step.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..errors import BadInput, NothingFeasible
from ..timing.path import Path
from ..timing.path_limits import Law, TimingLimits
from ..timing.profile import Profile


@dataclass(frozen=True, eq=False)
class _Bounded:
    """Limits as inequalities |a u + b x + c| ≤ 1 and 0 ≤ x ≤ top, with u = s̈ and x = ṡ² along a path parameter s.

    The path is divided into K intervals; the inequalities apply at both ends of each.

    Attributes:
        a, b, c: (2, K, m) coefficients of m inequalities at the left and the right end. In those of the right end, x is
            the value there, x_left + 2 Δ u with the length Δ of the interval.
        top: (K + 1,) largest x at the grid points.
    """

    a: np.ndarray
    b: np.ndarray
    c: np.ndarray
    top: np.ndarray


@dataclass(frozen=True, eq=False)
class ConstraintRows:
    """Geometry, dynamics and limits on a grid along a path q = Φ(s), which do not change between the iterations.

    Attributes:
        s: (K + 1,) the grid of path parameters.
        q, slope, curvature: (2, K, n) Φ and its derivatives Φ', Φ'' by s, at both ends of the intervals.
        A, B, G: (2, K, n) torque per s̈, torque per ṡ², and gravity torque at both ends; zero without dynamics.
        limits: limits of velocity, acceleration and torque.
    """

    s: np.ndarray
    q: np.ndarray
    slope: np.ndarray
    curvature: np.ndarray
    A: np.ndarray
    B: np.ndarray
    G: np.ndarray
    limits: TimingLimits

    @classmethod
    def of(cls, path: Path, s: np.ndarray, limits: TimingLimits, law: Law | None) -> ConstraintRows:
        steps = np.diff(s)
        inset = 1e-6  # of an interval: rows of an end are taken just inside it
        inset_steps = inset * steps
        starts_inside = s[:-1] + inset_steps
        ends_inside = s[1:] - inset_steps
        ends = np.concatenate([starts_inside, ends_inside])
        shape = (2, len(steps), path.n)
        geometry = [path(ends, order) for order in range(3)]
        dynamics = [np.zeros_like(geometry[0])] * 3
        if law is not None:
            dynamics = list(law.along(*geometry))
        both_ends = [values.reshape(shape) for values in (*geometry, *dynamics)]
        q, slope, curvature, A, B, G = both_ends
        return cls(s, q, slope, curvature, A, B, G, limits)

    def speed(self, fastest_joint: float) -> float:
        """Return the largest x = ṡ² at which no joint exceeds the speed `fastest_joint` [rad/s or m/s]."""
        steepest = np.abs(self.slope).max()
        return (fastest_joint / steepest) ** 2

    def top(self, tight: np.ndarray) -> np.ndarray:
        """Return the largest x = ṡ² (K + 1,) that the velocity limits allow at the grid points, min_j (v_max / Φ')².

        Args:
            tight: share of each limit that may be used, for each interval and joint (K, n).
        """
        with np.errstate(divide="ignore"):
            max_speeds = self.limits.velocity * tight / np.abs(self.slope)
            ends = (max_speeds**2).min(axis=2)
        max_speed = 100.0  # [rad/s or m/s] of the fastest joint: a bound where no joint has a velocity limit
        by_left = np.append(ends[0], np.inf)
        by_right = np.append(np.inf, ends[1])
        return np.minimum(np.minimum(by_left, by_right), self.speed(max_speed))

    def bounded(self, friction: tuple[np.ndarray, np.ndarray], tight: Mapping[str, np.ndarray]) -> _Bounded:
        """Return the limits of acceleration and torque as inequalities in u = s̈ and x = ṡ², and the largest x.

        Args:
            friction: slope and value (2, K, n) of friction as a linear function of x.
            tight: for each kind of limit, the share (K, n) of the limit that may be used on each interval.
        """
        pushing = np.isfinite(self.limits.torque)
        turning = np.isfinite(self.limits.acceleration)
        torque = (self.limits.torque * tight["torque"])[:, pushing]
        bend = (self.limits.acceleration * tight["acceleration"])[:, turning]
        friction_slope, friction_value = friction
        by_x = self.B + friction_slope
        constant = self.G + friction_value
        parts = ((self.A, self.slope), (by_x, self.curvature), (constant, np.zeros_like(self.q)))
        a, b, c = (
            np.concatenate([torque_part[..., pushing] / torque, bend_part[..., turning] / bend], axis=2)
            for torque_part, bend_part in parts
        )
        return _Bounded(a, b, c, self.top(tight["velocity"]))

    def friction(
        self, law: Law | None, x: np.ndarray | None, before: np.ndarray | None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return friction torque linearised in x = ṡ²: slope and value at x = 0, each (2, K, n).

        Args:
            law: the robot's dynamics; None for no dynamics, which returns zeros.
            x: (K + 1,) the profile x of the last round; None takes friction at a very low (creeping) speed.
            before: the profile x of the round before the last. Where both profiles agree, the tangent at x is used;
                elsewhere, and for None, the secant from creeping speed to x, which at rest never exceeds friction.
        """
        if law is None:
            return np.zeros_like(self.q), np.zeros_like(self.q)
        creep_speed = 1e-3  # [rad/s or m/s] of the fastest joint: a speed at which friction is Coulomb's alone
        creep = np.full(2 * len(self.s) - 2, self.speed(creep_speed))
        if x is None:
            value = self._rubbing(law, creep, 0.0)
            return np.zeros_like(self.q), value.reshape(self.q.shape)
        both_steps = 2 * np.diff(self.s)
        u = np.tile(np.diff(x) / both_steps, 2)
        max_change = 0.1  # relative, of x in two rounds, from where on the tangent is taken
        settled = np.zeros(len(x), dtype=bool)
        if before is not None:
            settled = np.abs(x - before) <= max_change * x
        tangent = np.concatenate([settled[:-1], settled[1:]])
        speeds_at_ends = np.concatenate([x[:-1], x[1:]])
        speeds = np.maximum(speeds_at_ends, 2 * creep)
        difference = 1e-3  # relative, of the difference that gives a tangent
        low = np.where(tangent, (1 - difference) * speeds, creep)
        high = np.where(tangent, (1 + difference) * speeds, speeds)
        below = self._rubbing(law, low, u)
        above = self._rubbing(law, high, u)
        slope = (above - below) / (high - low)[:, None]
        value = below - slope * low[:, None]
        return slope.reshape(self.q.shape), value.reshape(self.q.shape)

    def _rubbing(self, law: Law, x: np.ndarray, u: np.ndarray | float) -> np.ndarray:
        n = self.q.shape[2]
        q = self.q.reshape(-1, n)
        slope = self.slope.reshape(-1, n)
        curvature = self.curvature.reshape(-1, n)
        pull = np.broadcast_to(u, x.shape)[:, None]
        velocity = slope * np.sqrt(x)[:, None]
        acceleration = slope * pull + curvature * x[:, None]
        return law.friction(q, velocity, acceleration)


def fastest(rows: _Bounded, s: np.ndarray) -> Profile:
    """Return the fastest speed profile from rest to rest that satisfies the inequalities |a u + b x + c| ≤ 1.

    Args:
        rows: the inequalities, with u = s̈ and x = ṡ².
        s: (K + 1,) grid of path parameters.

    Raises:
        NothingFeasible: at some grid point no speed satisfies the limits, or the motion comes to rest before the end.
    """
    controllable = _controllable(rows, s)
    if not np.isfinite(controllable).all():
        k = int(np.flatnonzero(~np.isfinite(controllable)).max())
        raise NothingFeasible(
            f"no motion: no speed at {s[k] / s[-1]:.0%} of the path allows a stop at its end within the limits: use "
            "other waypoints or larger limits",
            "torque",
            float("nan"),
            "N m",
        )
    x = _forward(rows, s, controllable)
    if (x[1:-1] <= 0).any():
        k = int(np.argmax(x[1:-1] <= 0)) + 1
        raise NothingFeasible(
            f"no motion: it comes to a stop at {s[k] / s[-1]:.0%} of the path, within these limits: use other "
            "waypoints or larger limits",
            "torque",
            float("nan"),
            "N m",
        )
    return Profile(s, x)


def _forward(rows: _Bounded, s: np.ndarray, controllable: np.ndarray) -> np.ndarray:
    """Return x = ṡ² (K + 1,) from rest to rest, with the largest path acceleration u on each interval in turn.

    Args:
        rows: limits as inequalities |a u + b x + c| ≤ 1, with u = s̈.
        s: (K + 1,) grid of path parameters.
        controllable: (K + 1,) largest x from which the end can be reached at rest.
    """
    steps = np.diff(s)
    right = rows.a[1] + 2 * steps[:, None] * rows.b[1]
    a = np.concatenate([rows.a[0], right], axis=1)
    b = np.concatenate([rows.b[0], rows.b[1]], axis=1)
    c = np.concatenate([rows.c[0], rows.c[1]], axis=1)
    # the upper limits of u are linear in x: at_rest - per_x x
    with np.errstate(divide="ignore", invalid="ignore"):
        at_rest = np.where(a == 0, np.inf, (np.sign(a) - c) / a)
        per_x = np.where(a == 0, 0.0, b / a)
    x = np.zeros(len(s))
    present = 0.0
    for k, step in enumerate(steps.tolist()):
        upper = at_rest[k] - per_x[k] * present
        to_top = (rows.top[k + 1] - present) / (2 * step)
        u = min(upper.min(initial=np.inf), to_top)
        reached = max(present + 2 * step * u, 0.0)
        present = min(reached, controllable[k + 1])
        x[k + 1] = present
    x[-1] = 0.0
    return x


def _controllable(rows: _Bounded, s: np.ndarray) -> np.ndarray:
    """Return, for each grid point, the largest x = ṡ² (K + 1,) from which the path's end can be reached at rest.

    NaN where there is no such x. u = s̈ and x are passed to toppra in units of a typical x; otherwise its linear
    programs fail where speeds are large.

    Args:
        rows: limits as inequalities |a u + b x + c| ≤ 1.
        s: (K + 1,) grid of path parameters.
    """
    try:
        from toppra.algorithm import TOPPRA
    except ImportError as error:
        raise BadInput(
            "timing needs toppra: pip install 'armature-calib[timing]' (on macOS and Windows: pip install toppra, from "
            "source)"
        ) from error
    sizes = np.abs(rows.b)
    size = sizes.max(axis=(0, 2), initial=1e-12)
    typical = np.minimum(rows.top[1:], 2.0 / size)
    unit = float(np.median(typical))
    scaled = _Bounded(unit * rows.a, unit * rows.b, rows.c, rows.top / unit)
    quiet = logging.getLogger("toppra")
    level = quiet.level
    quiet.setLevel(logging.CRITICAL)
    try:
        solver = TOPPRA([_constraint(scaled, s)], _Interval(s), gridpoints=s, solver_wrapper="seidel")
        ranges: Any = solver.compute_controllable_sets(0.0, 0.0)
    finally:
        quiet.setLevel(level)
    lowest = ranges[:, 0]
    highest = ranges[:, 1]
    return unit * np.where(lowest > highest, np.nan, highest)


class _Interval:
    """The interval of path parameters, in the form of a path that toppra accepts."""

    dof = 1

    def __init__(self, s: np.ndarray):
        self.path_interval = np.array([s[0], s[-1]])
        self.duration = float(s[-1])


def _constraint(rows: _Bounded, s: np.ndarray) -> Any:
    """Return the inequalities `rows`, |a u + b x + c| ≤ 1, on the grid s (K + 1,) in the form that toppra uses."""
    from toppra.constraint import LinearConstraint

    steps = np.diff(s)[:, None]
    right = rows.a[1] + 2 * steps * rows.b[1]
    a = np.concatenate([rows.a[0], right], axis=1)
    b = np.concatenate([rows.b[0], rows.b[1]], axis=1)
    c = np.concatenate([rows.c[0], rows.c[1]], axis=1)
    m = a.shape[1]
    signs = np.concatenate([np.eye(m), -np.eye(m)])
    limit = np.ones(2 * m)
    speeds = np.column_stack([np.zeros(len(s)), rows.top])
    last = [np.vstack([x, x[-1:]]) for x in (a, b, c)]

    class Given(LinearConstraint):
        def __init__(self) -> None:
            super().__init__()
            self.identical = True

        def compute_constraint_params(self, path: object, gridpoints: object, *args: object, **kwargs: Any) -> Any:
            rows_given = (*last, signs, limit) if m else (None,) * 5
            return (*rows_given, None, speeds)

    return Given()
