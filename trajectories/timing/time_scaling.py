"""Time-optimal timing of a path under velocity, acceleration and torque limits, viscous friction included.

    |Φ' ṡ| ≤ v_max,    |Φ' s̈ + Φ'' ṡ²| ≤ a_max,    |A s̈ + B ṡ² + Γ + f(Φ, Φ' ṡ)| ≤ τ_max

With u = s̈, x = ṡ² all terms except friction f are affine (Bobrow, Dubowsky, Gibson 1985). In each round, friction is
replaced by a linear function of x that equals f at the profile x_k of the round before. Where the last rounds differ
much, this is the secant from rest, which is feasible from any x_k and, for viscous friction, halves the error of log x.
Otherwise it is the tangent (Newton's step). A plain fixed-point iteration, with f constant in a round, diverges where
friction itself limits the speed. Each round is solved by reachability analysis (Pham & Pham 2018, toppra): controllable
speeds backwards from the end, then the largest acceleration forwards. The constraints of an interval are imposed at
both of its ends (interpolation scheme), with the direction of friction inside the interval.

The result is checked by the full inverse dynamics between the grid points. Where it exceeds a limit, that limit is
tightened on that interval by the excess and the path is timed again, until no limit is exceeded.
"""

from dataclasses import dataclass, field, replace

import numpy as np

from ..errors import BadInput, NothingFeasible
from ..timing.path import Path, reversals
from ..timing.path_limits import Law, TimingLimits
from ..timing.profile import Profile, Sampled, dense, moved
from ..timing.reachability import ConstraintRows, fastest

# number of grid intervals: smallest in all, for each interval between two knots, and largest in all
GRID = 400
PER_SPAN = 200
MAX_INTERVALS = 2400
# a limit is active where the motion is nearer to it than this share of it
ACTIVE = 0.01
# largest number of rounds of reachability, and mean relative change of x below which friction has converged
MAX_ROUNDS = 25
MAX_CHANGE = 1e-4


@dataclass(frozen=True, eq=False)
class Timing:
    """A timed path with its torques and limits.

    Attributes:
        path: the path.
        profile: the speed along it.
        limits: the limits of velocity, acceleration and torque.
        sampled: dense samples of the motion, also between the grid points, with torques by the full inverse dynamics.
        iterations: number of rounds of reachability.
        tightened: largest share by which a limit was tightened so that the motion satisfies it between the grid points.
        history: durations of the rounds [s].
    """

    path: Path
    profile: Profile
    limits: TimingLimits
    sampled: Sampled
    iterations: int
    tightened: float
    history: tuple[float, ...] = field(default=())

    @property
    def duration(self) -> float:
        return self.profile.duration

    @property
    def used(self) -> dict[str, np.ndarray]:
        """Share of each limit in use, (N, n) for each kind of limit; 1 is the limit."""
        return _shares(self.sampled, self.limits)

    @property
    def margins(self) -> dict[str, np.ndarray]:
        """Smallest margin (n,) to each kind of limit, as a share of the limit; 1 for a joint without that limit."""
        return {name: 1.0 - values.max(axis=0) for name, values in self.used.items()}

    @property
    def active_share(self) -> float:
        """Share of the time in which at least one limit is reached to within `ACTIVE`."""
        largest_by_kind = [values.max(axis=1) for values in self.used.values()]
        largest = np.max(largest_by_kind, axis=0)
        weights = self.sampled.weights
        is_active = largest >= 1 - ACTIVE
        return float(weights @ is_active / weights.sum())


def time_optimal(
    path: Path, limits: TimingLimits, law: Law | None = None, *, rate: float | None = None, grid: int | None = None
) -> Timing:
    """Return the fastest motion from rest to rest along a path.

    Args:
        path: the path.
        limits: limits of velocity, acceleration and torque.
        law: the robot's dynamics; None takes only the kinematic limits.
        rate: sampling rate of a controller [Hz]; the duration is rounded up to a whole number of samples. None: no
            rounding.
        grid: number of intervals on the path; None chooses the number by the path's knots.

    Raises:
        BadInput: torque limits without dynamics.
        NothingFeasible: the torque limits do not suffice to hold the robot or to move it slowly (the message gives
            joint, position on the path and excess), or the timing does not converge.
    """
    if law is None and np.isfinite(limits.torque).any():
        raise BadInput("torque limits need the robot's dynamics; leave them infinite, or give a model")
    s = _grid_points(path, grid)
    intervals = len(s) - 1
    if law is not None:
        _check_holding(path, limits, law, s)
    rows = ConstraintRows.of(path, s, limits, law)
    tight = {name: np.ones((intervals, path.n)) for name in ("velocity", "acceleration", "torque")}
    history: list[float] = []
    best = last = x = before = None
    excess: dict[str, np.ndarray] = {}
    for _ in range(MAX_ROUNDS):
        profile = _round(rows, law, x, before, tight)
        last = _timed(path, limits, law, _on_samples(profile, rate))
        excess = {}
        for name, values in _shares(last.sampled, limits).items():
            excess[name] = _per_interval(values, intervals) - 1
        within_limits = all(values.max() <= 0 for values in excess.values())
        settled = x is not None and np.abs(profile.x - x).mean() <= MAX_CHANGE * x.mean()
        history.append(profile.duration)
        before = x
        x = profile.x
        if within_limits and (best is None or last.profile.duration < best.profile.duration):
            best = last
        if settled and within_limits:
            break
        if settled or len(history) > MAX_ROUNDS // 2:
            for name, values in excess.items():
                narrower = 1 - 1.1 * np.clip(values, 1e-6, 0.2)
                tight[name] = tight[name] * np.where(values > 0, narrower, 1.0)
    if best is None and last is not None:
        best = _slowed_down(last, law, rate)
    if best is None:
        raise _not_settled(excess)
    narrowed = 1 - min(float(values.min()) for values in tight.values())
    return replace(best, iterations=len(history), tightened=narrowed, history=tuple(history))


def _timed(path: Path, limits: TimingLimits, law: Law | None, profile: Profile) -> Timing:
    """Return the timing of a path with a given speed profile, with its dense samples.

    Args:
        path: the path.
        limits: the limits of velocity, acceleration and torque, to be recorded.
        law: the robot's dynamics; None computes no torques.
        profile: the speed profile.
    """
    torque = None
    if law is not None:
        torque = law.torque
    return Timing(path, profile, limits, dense(path, profile, torque), 0, 0.0)


def _on_samples(profile: Profile, rate: float | None) -> Profile:
    """Return the profile slowed down to a whole number of samples at a rate [Hz]; unchanged where `rate` is None."""
    if rate is None:
        return profile
    return profile.slower(_whole(profile.duration, rate))


def _slowed_down(timing: Timing, law: Law | None, rate: float | None) -> Timing | None:
    """Return the timing slowed down by up to 1 % to satisfy the limits; None if 1 % does not suffice.

    Args:
        timing: a timing that exceeds its limits slightly.
        law: the robot's dynamics; None for none.
        rate: sampling rate of a controller [Hz], to whose samples the duration is rounded up; None does not round.
    """
    for factor in 1 + 1e-5 * 2.0 ** np.arange(11):
        profile = _on_samples(timing.profile.slower(factor), rate)
        slower = _timed(timing.path, timing.limits, law, profile)
        if all(margin.min() >= 0 for margin in slower.margins.values()):
            return slower
    return None


def _per_interval(values: np.ndarray, count: int) -> np.ndarray:
    """Return the maximum of `values` (N, n) on each of `count` intervals (count, n), for the samples of `dense`."""
    return values.reshape(count, -1, values.shape[1]).max(axis=1)


def _round(
    rows: ConstraintRows, law: Law | None, x: np.ndarray | None, before: np.ndarray | None, tight: dict
) -> Profile:
    """Return the fastest profile with friction linearised at the profiles of the last two rounds.

    Tangents to friction are replaced by secants where tangents make the problem infeasible.

    Args:
        rows: geometry, dynamics and limits on the grid.
        law: the robot's dynamics; None for no dynamics.
        x, before: (K + 1,) ṡ² of the last profile and of the profile before it; None in the first rounds.
        tight: for each kind of limit, the share (K, n) of the limit that may be used on each interval.
    """
    try:
        bounded = rows.bounded(rows.friction(law, x, before), tight)
        return fastest(bounded, rows.s)
    except NothingFeasible:
        bounded = rows.bounded(rows.friction(law, x, None), tight)
        return fastest(bounded, rows.s)


def _shares(sampled: Sampled, limits: TimingLimits) -> dict[str, np.ndarray]:
    """Return the shares of the limits in use, (N, n) for each kind of limit that some joint has.

    Args:
        sampled: dense samples of a motion.
    """
    kinds = (
        ("velocity", sampled.v, limits.velocity),
        ("acceleration", sampled.a, limits.acceleration),
        ("torque", sampled.tau, limits.torque),
    )
    shares = {}
    for name, values, sizes in kinds:
        if values is not None and np.isfinite(sizes).any():
            shares[name] = np.abs(values) / sizes
    return shares


def _check_holding(path: Path, limits: TimingLimits, law: Law, s: np.ndarray) -> None:
    """Raise NothingFeasible where the torque limits do not suffice to hold the robot on the path or to move it slowly.

    A fast motion could still pass such a pose. It could neither be stopped there nor be rehearsed at low speed, so it
    is refused (our choice).

    Args:
        law: the robot's dynamics.
        s: (N,) path parameters to check.
    """
    slow_speed = np.full(len(s), 1e-9)
    no_acceleration = np.zeros(len(s))
    q, v, _ = moved(path, s, slow_speed, no_acceleration)
    still = np.zeros_like(q)
    gravity = law.torque(q, still, still)
    slow = gravity + law.friction(q, v, still)
    for torque, doing in ((gravity, "hold still"), (slow, "move slowly")):
        excess = np.abs(torque) - limits.torque
        if excess.max() > 0:
            k, j = np.unravel_index(np.argmax(excess), excess.shape)
            raise NothingFeasible(
                f"no motion: to {doing} at {s[k] / path.length:.0%} of the path, joint {j + 1} needs "
                f"{abs(torque[k, j]):.4g} N m, its limit is {limits.torque[j]:.4g} ({excess[k, j]:.3g} short); "
                "take another path, a smaller payload, or check the limits",
                f"torque of joint {j + 1}",
                float(excess[k, j]),
                "N m",
            )


def _grid_points(path: Path, count: int | None = None) -> np.ndarray:
    """Return grid points on the path, evenly spaced in time near start and end, with its knots and reversal points.

    Args:
        path: the path.
        count: number of intervals; None takes `GRID`, or `PER_SPAN` intervals per knot span if this is more.
    """
    if not count:
        intervals = PER_SPAN * (len(path.knots) - 1)
        count = int(np.clip(intervals, GRID, MAX_INTERVALS))
    even = np.linspace(0, 1, count + 1)
    s = path.length * (1 - np.cos(np.pi * even)) / 2
    extra = reversals(path, s)
    if len(path.knots) < count / 4:
        extra = np.concatenate([extra, path.knots])
    interior = (extra > 0) & (extra < path.length)
    s = np.unique(np.concatenate([s, extra[interior]]))
    # without intervals of rounding
    is_wide = np.append(True, np.diff(s) > 1e-7 * path.length)
    s = s[is_wide]
    return np.append(s[:-1], path.length)


def _whole(duration: float, rate: float) -> float:
    """Return the factor ≥ 1 by which a duration [s] becomes a whole number of samples at a rate [Hz]."""
    samples = duration * rate
    return np.ceil(samples - 1e-9) / samples


def _not_settled(excess: dict[str, np.ndarray]) -> NothingFeasible:
    """Return the error that the timing did not converge, which names the limit exceeded most.

    Args:
        excess: for each kind of limit, the excess (K, n) as a share of the limit.
    """
    name = max(excess, key=lambda key: float(excess[key].max()))
    worst = float(excess[name].max())
    by_joint = excess[name].max(axis=0)
    j = int(by_joint.argmax())
    return NothingFeasible(
        f"the timing did not converge: the {name} of joint {j + 1} exceeds its limit by {worst:.2g} of it between grid "
        "points; try a path with gentler bends, or more grid points",
        f"{name} of joint {j + 1}",
        worst,
        "of the limit",
    )
