"""Motions that are linear in free variables: common base of the Fourier and B-spline families.

    d^r q_j / dt^r (t_i) = offset_j[r, i] + Σ_c table_j[r, i, c] · x_{j,c},      r = 0 … 3

Rest at start and end is a linear equation on the coefficients of a family. The equation is eliminated by c_j =
particular_j + null_j x_j, so that every x gives a motion that starts and ends at rest.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from scipy.linalg import null_space

from .errors import BadInput

ORDERS = ("position", "velocity", "acceleration", "jerk")


@dataclass(frozen=True, eq=False)
class SampledMotion:
    """Position, velocity, acceleration and jerk of a motion at N sample times.

    Attributes:
        times: (N,) [s].
        q, v, a, jerk: (N, n) [rad or m, and per s, s², s³].
    """

    times: np.ndarray
    q: np.ndarray
    v: np.ndarray
    a: np.ndarray
    jerk: np.ndarray
    _evaluated: dict[Callable, np.ndarray] = field(default_factory=dict, init=False, repr=False)

    def __len__(self) -> int:
        return len(self.times)

    def evaluated(self, regressor: Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]) -> np.ndarray:
        """Return regressor(q, v, a) (N, n, b) of the samples, which maps b dynamic parameters to torques.

        The result is stored at the first call, so that objectives and torque limits share it.
        """
        if regressor not in self._evaluated:
            self._evaluated[regressor] = regressor(self.q, self.v, self.a)
        return self._evaluated[regressor]

    @property
    def orders(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        return self.q, self.v, self.a, self.jerk

    def part(self, rows: np.ndarray) -> SampledMotion:
        """Return the samples at the indices `rows` (from 0), or where the mask `rows` (N,) is True."""
        return SampledMotion(self.times[rows], self.q[rows], self.v[rows], self.a[rows], self.jerk[rows])


@dataclass(frozen=True, eq=False)
class Basis:
    """A motion family evaluated at fixed times: the motion as a linear function of free variables x.

    The variables are the coefficients (Fourier coefficients, control points) that the equations of rest leave free.

    Attributes:
        times: (N,) [s].
        offsets: (4, N, n) position, velocity, acceleration and jerk of the motion whose variables are all zero.
        tables: (n, 4, N, c) derivatives of these four by the variables of each joint, zero where a joint has fewer than
            c variables; c is the largest number of variables of a joint.
        used: (n, c) True where a joint has that variable; x lists the variables joint after joint.
    """

    times: np.ndarray
    offsets: np.ndarray
    tables: np.ndarray
    used: np.ndarray

    @property
    def p(self) -> int:
        """Number of variables of all joints."""
        return int(self.used.sum())

    @property
    def n(self) -> int:
        return len(self.used)

    def motion(self, x: np.ndarray) -> SampledMotion:
        """Return the motion for variables x (p,)."""
        spread = np.zeros(self.used.shape)
        spread[self.used] = x
        n, _, count, c = self.tables.shape
        joint_tables = self.tables.reshape(n, 4 * count, c)
        by_joint = joint_tables @ spread[:, :, None]
        displacement = by_joint.reshape(n, 4, count)
        orders = self.offsets + displacement.transpose(1, 2, 0)
        return SampledMotion(self.times, *orders)

    def nearest(self, q: np.ndarray) -> np.ndarray:
        """Return the variables (p,) whose motion fits positions q (N, n) best, by least squares over the times."""
        variables = np.zeros(self.used.shape)
        for j, exists in enumerate(self.used):
            position_table = self.tables[j, 0][:, exists]
            displacement = q[:, j] - self.offsets[0, :, j]
            variables[j, exists] = np.linalg.lstsq(position_table, displacement, rcond=None)[0]
        return variables[self.used]

    def adjoint(self, slopes: np.ndarray) -> np.ndarray:
        """Return the gradients (m, p) of m functions by the free variables.

        Args:
            slopes: (m, 4, N, n) gradients of the m functions by position, velocity, acceleration and jerk at the N
                times.
        """
        m, _, count, n = slopes.shape
        by_joint = slopes.transpose(3, 0, 1, 2)
        flat = by_joint.reshape(n, m, 4 * count)
        joint_tables = self.tables.reshape(n, 4 * count, -1)
        gradients = flat @ joint_tables
        return gradients.transpose(1, 0, 2)[:, self.used]


class Family(Protocol):
    """Interface of a family of periodic motions for the optimiser.

    `calib.trajectories.fourier.Fourier` and `calib.trajectories.bspline.BSpline` implement it.
    """

    @property
    def period(self) -> float: ...
    @property
    def n(self) -> int: ...
    def basis(self, times: np.ndarray) -> Basis: ...
    def coefficients(self, x: np.ndarray) -> tuple[np.ndarray, ...]: ...
    def variables(self, coefficients: Sequence[np.ndarray]) -> np.ndarray: ...
    def evaluate(self, x: np.ndarray, times: np.ndarray, order: int) -> np.ndarray: ...
    def largest(self, x: np.ndarray, order: int) -> np.ndarray: ...
    def random(self, rng: np.random.Generator, centre: np.ndarray, amplitude: np.ndarray) -> np.ndarray: ...


@dataclass(frozen=True, eq=False)
class Freedom:
    """All solutions of a joint's linear equations on its C coefficients: particular + null · x for any x (c,).

    Attributes:
        particular: (C,) one solution.
        null: (C, c) basis of the null space of the equations.
    """

    particular: np.ndarray
    null: np.ndarray


def freedom(rows: np.ndarray, values: np.ndarray) -> Freedom:
    """Return all solutions of e linear equations on a joint's C coefficients.

    Args:
        rows, values: the equations rows (e, C) · coefficients = values (e,).

    Raises:
        BadInput: the equations have no solution.
    """
    if not len(rows):
        parameters = rows.shape[1]
        return Freedom(np.zeros(parameters), np.eye(parameters))
    particular = np.linalg.lstsq(rows, values, rcond=None)[0]
    if not np.allclose(rows @ particular, values, atol=1e-9):
        raise BadInput("a joint has too few coefficients to start at rest at the given pose: allow more harmonics")
    return Freedom(particular, null_space(rows))


def holding(
    counts: Sequence[int], none: int, start: np.ndarray | None, held: Mapping[int, float] | None
) -> tuple[tuple[int, ...], list[float | None]]:
    """Return coefficient counts and start values of the joints, where some joints are locked at a fixed value.

    Args:
        counts: number of coefficients (Fourier coefficients or control points) of each joint.
        none: the coefficient count that locks a joint.
        start: (n,) joint values at the start [rad or m]; None leaves them free.
        held: index (from 0) of each locked joint, with its value [rad or m]; None locks no joint.

    Returns:
        The counts, and the start value of each joint, None where it is free.

    Raises:
        BadInput: a joint that does not exist, a value that is not finite, or one that contradicts the start.
    """
    values = list(counts)
    first: list[float | None] = [None] * len(counts)
    if start is not None:
        first = [float(start[j]) for j in range(len(counts))]
    for j, value in (held or {}).items():
        if not 0 <= j < len(values) or not np.isfinite(value):
            raise BadInput(
                f"joint {j + 1} of {len(values)} cannot be held at {value:g}; choose a joint and a finite value"
            )
        if start is not None and start[j] != value:
            raise BadInput(f"joint {j + 1} is held at {value:g}, but the motion starts from {start[j]:g}")
        values[j] = none
        first[j] = float(value)
    return tuple(values), first


def assemble(times: np.ndarray, tables: Sequence[np.ndarray], freedoms: Sequence[Freedom]) -> Basis:
    """Return the basis at times (N,) [s].

    Args:
        times: (N,) [s].
        tables: for each joint, the derivatives (4, N, C_j) of position, velocity, acceleration and jerk by its C_j
            coefficients.
        freedoms: for each joint, the coefficients that satisfy its equations of rest and start value.
    """
    n = len(tables)
    widths = [free.null.shape[1] for free in freedoms]
    widest = max(1, *widths)
    offsets = np.zeros((4, len(times), n))
    stacked = np.zeros((n, 4, len(times), widest))
    used = np.zeros((n, widest), dtype=bool)
    for j, (table, free) in enumerate(zip(tables, freedoms, strict=True)):
        width = free.null.shape[1]
        offsets[:, :, j] = table @ free.particular
        stacked[j, :, :, :width] = table @ free.null
        used[j, :width] = True
    return Basis(np.asarray(times, dtype=float), offsets, stacked, used)


def counts_of_joints(counts: int | Sequence[int], joints: int | None) -> tuple[int, ...]:
    """Return the coefficient count of each joint, from one number for all joints or one number per joint.

    Args:
        counts: one number, or one number per joint.
        joints: number of joints, needed where `counts` is one number.
    """
    if isinstance(counts, Sequence | np.ndarray):
        return tuple(int(count) for count in counts)
    return (int(counts),) * (joints or 0)


def joined(freedoms: Sequence[Freedom], x: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return the coefficients (C_j,) of every joint for free variables x (p,), which are ordered joint after joint.

    Args:
        freedoms: for each joint, its coefficients as a linear function of its part of x.
        x: (p,) free variables of all joints.
    """
    widths = [free.null.shape[1] for free in freedoms]
    ends = np.cumsum(widths)[:-1]
    parts = np.split(x, ends)
    return tuple(free.particular + free.null @ part for free, part in zip(freedoms, parts))


def projected(freedoms: Sequence[Freedom], coefficients: Sequence[np.ndarray]) -> np.ndarray:
    """Return the variables (p,) whose coefficients are nearest to the given coefficients (C_j,) of every joint.

    Args:
        freedoms: for each joint, its coefficients as a linear function of its variables.
        coefficients: for each joint, the coefficients (C_j,) to approximate by least squares.
    """
    variables = []
    for free, values in zip(freedoms, coefficients):
        displacement = np.asarray(values) - free.particular
        variables.append(free.null.T @ displacement)
    return np.concatenate(variables)


def sample_times(period: float, count: int, shift: float = 0.0) -> np.ndarray:
    """Return `count` equidistant times [s] over one period, without its end, shifted by `shift` sampling steps."""
    return (np.arange(count) + shift) * (period / count)


def aligned_period(period: float, rate: float) -> int:
    """Return the number of samples at a controller's rate [Hz] in one period [s].

    Raises:
        BadInput: the number is not whole, so that averaging over periods would mix different instants of the motion.
    """
    count = period * rate
    if not np.isfinite(count) or count < 1 or abs(count - round(count)) > 1e-6:
        nearest = float("nan")
        if np.isfinite(count):
            nearest = max(1, round(count)) / rate
        raise BadInput(
            f"a period of {period:g} s is {count:g} samples at {rate:g} Hz, not a whole number: periods could not be "
            f"averaged sample by sample; take {nearest:.12g} s"
        )
    return round(count)
