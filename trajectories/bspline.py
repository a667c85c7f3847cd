"""Periodic B-splines, with the same interface as the Fourier series of `calib.trajectories.fourier`.

    q_j(t) = Σ_{i=1}^{C} c_ji B_i(t)

The knots are uniform over one period, and the basis functions B_i are periodic and of a given degree (5: smooth jerk).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import BSpline as ScipyBSpline

from .basis import Basis, Freedom, aligned_period, assemble, counts_of_joints, freedom, holding, joined, projected
from .errors import BadInput, require


@dataclass(frozen=True, eq=False)
class BSpline:
    """Family of joint motions as periodic splines.

    Attributes:
        period: T0 [s].
        counts: (n,) number C of control points of each joint; 1 locks the joint at a constant value.
        degree: degree of the polynomial pieces.
        freedoms: for each joint, the control points that satisfy the equations of rest and start value.
    """

    period: float
    counts: tuple[int, ...]
    degree: int
    freedoms: tuple[Freedom, ...]

    @property
    def n(self) -> int:
        return len(self.counts)

    def basis(self, times: np.ndarray) -> Basis:
        """Return the linear map from the family's free variables to the motion at times (N,) [s]."""
        tables = [_table(times, self.period, count, self.degree) for count in self.counts]
        return assemble(times, tables, self.freedoms)

    def coefficients(self, x: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return the control points (C,) of every joint [rad or m] for the family's free variables x (p,)."""
        return joined(self.freedoms, x)

    def variables(self, coefficients: Sequence[np.ndarray]) -> np.ndarray:
        """Return the free variables (p,) that approximate given control points best, by least squares.

        Args:
            coefficients: control points (C,) of every joint [rad or m].
        """
        return projected(self.freedoms, coefficients)

    def evaluate(self, x: np.ndarray, times: np.ndarray, order: int) -> np.ndarray:
        """Return d^r q / dt^r (N, n), by de Boor's recursion from the control points instead of by tables.

        Args:
            x: (p,) free variables of the family.
            times: (N,) [s].
            order: r, 0 for position.
        """
        result = np.zeros((len(times), self.n))
        for j, (count, points) in enumerate(zip(self.counts, self.coefficients(x))):
            if count == 1:
                if order == 0:
                    result[:, j] = points[0]
                continue
            knot_numbers = np.arange(-self.degree, count + self.degree + 1)
            knots = self.period / count * knot_numbers
            periodic_points = np.concatenate([points, points[: self.degree]])
            spline = ScipyBSpline(knots, periodic_points, self.degree)
            phases = np.mod(times, self.period)
            result[:, j] = spline(phases, nu=order)
        return result

    def largest(self, x: np.ndarray, order: int) -> np.ndarray:
        """Return a bound (n,) on abs(d^r q / dt^r): the largest control point of the r-th derivative, r = `order`.

        The derivative of a uniform spline is a spline one degree lower with control points Δc / h (differences of
        neighbouring control points by the knot spacing; de Boor 1978), and a
        spline lies in the convex hull of its control points.

        Args:
            x: (p,) free variables of the family.
            order: r, 0 or more.
        """
        bounds = []
        for count, points in zip(self.counts, self.coefficients(x)):
            for _ in range(order):
                difference = points - np.roll(points, 1)
                points = difference * count / self.period
            bounds.append(np.abs(points).max())
        return np.array(bounds)

    def random(self, rng: np.random.Generator, centre: np.ndarray, amplitude: np.ndarray) -> np.ndarray:
        """Return the free variables (p,) of a random motion about the pose `centre` (n,).

        The control points are drawn from a normal distribution with standard deviations `amplitude` (n,) [rad or m].

        Args:
            rng: generator of the random numbers.
            centre: (n,) [rad or m].
            amplitude: (n,) [rad or m].
        """
        points = []
        for count, middle, size in zip(self.counts, centre, amplitude):
            points.append(middle + size * rng.normal(size=count))
        return self.variables(points)


def bspline_family(
    points: int | Sequence[int],
    period: float,
    joints: int | None = None,
    *,
    degree: int = 5,
    rest: bool = True,
    start: np.ndarray | None = None,
    held: Mapping[int, float] | None = None,
    rate: float | None = None,
) -> BSpline:
    """Return the family of periodic splines with the given numbers of control points.

    Args:
        points: number of control points, one number for all joints or (n,); more than the degree, or 1 to lock a joint.
        period, joints, rest, start, held, rate: as for `calib.trajectories.fourier.fourier_family`.
        degree: 5 or more, so that the jerk has no kinks.

    Raises:
        BadInput: too few control points, a degree below 5, or a period that is not positive and finite.
    """
    counts = counts_of_joints(points, joints)
    if not counts or any(c != 1 and c <= degree for c in counts) or max(counts) == 1:
        raise BadInput(
            f"control points {points} for {joints} joints: expected more than the degree {degree}, or 1 to lock a joint"
        )
    require(degree >= 5, f"degree {degree}: expected 5 or more (below, the jerk is not bounded between samples)")
    require(np.isfinite(period) and period > 0, f"period {period} s: expected a positive number")
    if rate is not None:
        aligned_period(period, rate)
    freedoms = []
    counts, begin = holding(counts, 1, start, held)
    for count, first in zip(counts, begin):
        orders: list[int] = []
        values: list[float] = []
        if first is not None:
            orders.append(0)
            values.append(first)
        if rest and count > 1:
            orders += [1, 2]
            values += [0.0, 0.0]
        start_table = _table(np.zeros(1), period, count, degree)
        at_start = start_table[:, 0]
        equations = at_start[orders]
        freedoms.append(freedom(equations, np.array(values)))
    return BSpline(float(period), counts, degree, tuple(freedoms))


def _table(times: np.ndarray, period: float, count: int, degree: int) -> np.ndarray:
    """Return the derivatives (4, N, count) of a joint's q, v, a, jerk at times (N,) by its control points.

    Args:
        times: (N,) [s].
        period: [s].
        count: number of control points.
        degree: degree of the spline.
    """
    result = np.zeros((4, len(times), count))
    if count == 1:
        result[0] = 1.0
        return result
    knots = period / count * np.arange(-degree, count + degree + 1)
    phases = np.mod(times, period)
    splines = ScipyBSpline(knots, np.eye(count + degree), degree)
    for order in range(4):
        spline = splines
        if order:
            spline = splines.derivative(order)
        values = spline(phases)
        columns = np.arange(count + degree) % count
        np.add.at(result[order].T, columns, values.T)
    return result
