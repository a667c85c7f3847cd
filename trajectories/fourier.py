"""Finite Fourier series (Swevers et al. 1997), as in Kolyubin, Shiriaev, Jubien 2019, eq. 23:

    q_j(t) = q_j0 + Σ_{k=1}^{n_f,j} a_jk sin(k ω0 t) + b_jk cos(k ω0 t),      ω0 = 2π / T0

The motion is at rest at the start, and by periodicity at the end, where Σ k a_jk = 0 and Σ k² b_jk = 0.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from .basis import Basis, Freedom, aligned_period, assemble, counts_of_joints, freedom, holding, joined, projected
from .errors import BadInput, require


@dataclass(frozen=True, eq=False)
class Fourier:
    """Family of joint motions as finite Fourier series.

    Attributes:
        period: T0 [s].
        harmonics: (n,) number n_f of harmonics of each joint; 0 locks the joint at a constant value.
        freedoms: for each joint, the coefficients that satisfy the equations of rest and start value, ordered q0, a_1 …
            a_nf, b_1 … b_nf.
    """

    period: float
    harmonics: tuple[int, ...]
    freedoms: tuple[Freedom, ...]

    @property
    def n(self) -> int:
        return len(self.harmonics)

    def basis(self, times: np.ndarray) -> Basis:
        """Return the linear map from the family's free variables to the motion at times (N,) [s]."""
        tables = [_table(times, self.period, count) for count in self.harmonics]
        return assemble(times, tables, self.freedoms)

    def coefficients(self, x: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return the coefficients q0, a, b (1 + 2 n_f,) of every joint [rad or m] for free variables x (p,)."""
        return joined(self.freedoms, x)

    def variables(self, coefficients: Sequence[np.ndarray]) -> np.ndarray:
        """Return the free variables (p,) that approximate given Fourier coefficients best, by least squares.

        Args:
            coefficients: q0, a, b (1 + 2 n_f,) of every joint [rad or m].
        """
        return projected(self.freedoms, coefficients)

    def evaluate(self, x: np.ndarray, times: np.ndarray, order: int) -> np.ndarray:
        """Return the derivative d^r q / dt^r (N, n), by the series term by term instead of the tables of `basis`.

        Args:
            x: (p,) free variables of the family.
            times: (N,) [s].
            order: r, 0 for position.
        """
        return evaluate(self.coefficients(x), self.period, times, order)

    def largest(self, x: np.ndarray, order: int) -> np.ndarray:
        """Return a bound (n,) on abs(d^r q / dt^r) over all times: Σ_k (k ω0)^r √(a_k² + b_k²).

        Args:
            x: (p,) free variables of the family, which give the Fourier coefficients a_k, b_k.
            order: r, 1 or more.
        """
        bounds = []
        for count, c in zip(self.harmonics, self.coefficients(x)):
            rates = 2 * np.pi / self.period * np.arange(1, count + 1)
            sizes = np.hypot(c[1 : 1 + count], c[1 + count :])
            bound = (rates**order * sizes).sum()
            bounds.append(bound)
        return np.array(bounds)

    def random(self, rng: np.random.Generator, centre: np.ndarray, amplitude: np.ndarray) -> np.ndarray:
        """Return the free variables (p,) of a random motion about the pose `centre` (n,).

        The amplitudes (n,) [rad or m] are distributed over the harmonics k in proportion to 1/k.

        Args:
            rng: generator of the random numbers.
            centre: (n,) [rad or m].
            amplitude: (n,) [rad or m].
        """
        coefficients = []
        for count, middle, size in zip(self.harmonics, centre, amplitude):
            fall = 1.0 / np.arange(1, count + 1)
            norm = np.sqrt((fall**2).sum())
            fall = fall / max(norm, 1.0)
            scale = size * np.tile(fall, 2)
            coefficients.append(np.concatenate([[middle], scale * rng.normal(size=2 * count)]))
        return self.variables(coefficients)


def fourier_family(
    harmonics: int | Sequence[int],
    period: float,
    joints: int | None = None,
    *,
    rest: bool = True,
    start: np.ndarray | None = None,
    held: Mapping[int, float] | None = None,
    resonance: float | None = None,
    rate: float | None = None,
) -> Fourier:
    """Return the family of Fourier series with a given period.

    Args:
        harmonics: number n_f of harmonics, one number for all joints or (n,); 0 locks a joint.
        period: T0 [s].
        joints: number n of joints, needed where `harmonics` is one number.
        rest: True: velocity and acceleration are zero at t = 0 and T0 for every motion of the family.
        start: (n,) pose at the start [rad or m]; None leaves it free.
        held: indices (from 0) of locked joints, with their values [rad or m]; None locks no joint.
        resonance: smallest resonance frequency ω_r [rad/s]; n_f ω0 must be below it (Kolyubin et al. 2019, section
            4.3). None: not checked.
        rate: sampling rate of the controller [Hz]; a period must be a whole number of samples. None: not checked.

    Raises:
        BadInput: a period that is not positive, frequencies above the resonance, or a period that is not a whole number
            of samples.
    """
    counts = counts_of_joints(harmonics, joints)
    if not counts or min(counts) < 0 or max(counts) < 1:
        raise BadInput(f"harmonics {harmonics} for {joints} joints: expected whole numbers, one of them above 0")
    if rest and 1 in counts:
        raise BadInput("one harmonic cannot start at rest: take 2 or more, or 0 to lock the joint")
    _check_frequencies(counts, period, resonance)
    if rate is not None:
        aligned_period(period, rate)
    if start is not None:
        start = np.asarray(start, dtype=float)
        if start.shape != (len(counts),) or not np.isfinite(start).all():
            raise BadInput(f"start: expected {len(counts)} finite joint values, found {start}")
    counts, begin = holding(counts, 0, start, held)
    freedoms = [_freedom(count, period, rest, first) for count, first in zip(counts, begin)]
    return Fourier(float(period), counts, tuple(freedoms))


def _table(times: np.ndarray, period: float, count: int) -> np.ndarray:
    """Return the derivatives (4, N, 1 + 2 count) of a joint's q, v, a, jerk by its coefficients q0, a, b.

    Args:
        times: (N,) [s].
        period: T0 [s].
        count: number of harmonics.
    """
    rates = 2 * np.pi / period * np.arange(1, count + 1)
    angle = np.outer(times, rates)
    sine = np.sin(angle)
    cosine = np.cos(angle)
    result = np.zeros((4, len(times), 1 + 2 * count))
    result[0, :, 0] = 1.0
    derivatives = ((sine, cosine), (cosine, -sine), (-sine, -cosine), (-cosine, sine))
    for order, (by_a, by_b) in enumerate(derivatives):
        result[order, :, 1 : 1 + count] = by_a * rates**order
        result[order, :, 1 + count :] = by_b * rates**order
    return result


def evaluate(coefficients: Sequence[np.ndarray], period: float, times: np.ndarray, order: int = 0) -> np.ndarray:
    """Return the derivative d^r q / dt^r (N, n) of order r by the Fourier series, term by term.

    Args:
        coefficients: for each joint, q0, a_1 … a_nf, b_1 … b_nf [rad or m].
        period: T0 [s].
        times: (N,) [s].
        order: r, 0 for position.
    """
    max_order = max(len(c) // 2 for c in coefficients)
    rates = 2 * np.pi / period * np.arange(1, max_order + 1)
    # each derivative turns sine and cosine by π/2
    angle = np.outer(times, rates) + order * np.pi / 2
    sine = rates**order * np.sin(angle)
    cosine = rates**order * np.cos(angle)
    result = np.zeros((len(times), len(coefficients)))
    for j, c in enumerate(coefficients):
        count = len(c) // 2
        by_sine = sine[:, :count] @ c[1 : 1 + count]
        by_cosine = cosine[:, :count] @ c[1 + count :]
        result[:, j] = by_sine + by_cosine
        if order == 0:
            result[:, j] += c[0]
    return result


def _freedom(count: int, period: float, rest: bool, start: float | None) -> Freedom:
    k = np.arange(1, count + 1)
    rows = list[np.ndarray]()
    values = list[float]()
    if rest and count:
        zeros = np.zeros(count)
        velocity = np.r_[0.0, k, zeros]
        acceleration = np.r_[0.0, zeros, k**2]
        rows += [velocity, acceleration]
        values += [0.0, 0.0]
    if start is not None:
        position = np.r_[1.0, np.zeros(count), np.ones(count)]
        rows.append(position)
        values.append(start)
    equations = np.array(rows).reshape(len(rows), 1 + 2 * count)
    return freedom(equations, np.array(values))


def _check_frequencies(counts: Sequence[int], period: float, resonance: float | None) -> None:
    require(np.isfinite(period) and period > 0, f"period {period} s: expected a positive number")
    top = max(counts) * 2 * np.pi / period
    if resonance is not None and not top < resonance:
        min_period = 2 * np.pi * max(counts) / resonance
        raise BadInput(
            f"the highest frequency, {max(counts)} · 2π/{period:g} s = {top:.4g} rad/s, is not below the resonance at "
            f"{resonance:.4g} rad/s: it would excite unmodelled dynamics; take fewer harmonics or a period "
            f"above {min_period:.4g} s"
        )
