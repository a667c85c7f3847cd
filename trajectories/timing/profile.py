"""Speed along a path: profiles s(t) with s̈ constant between grid points, where x = ṡ² is therefore linear in s."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..setpoints import Setpoints
from ..timing.path import Path

MIN_SPEED_SHARE = 1e-9  # share of a speed that stands for "just after rest", where friction has its direction already
TorqueLaw = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]


@dataclass(frozen=True, eq=False)
class Profile:
    """A speed profile along a path with the parameter s: ṡ² at grid points, linear in s between them.

    Attributes:
        s: (K + 1,) grid of path parameters, rising from 0.
        x: (K + 1,) ṡ² at the grid points [square of the unit of s, per s²]; zero at rest.
    """

    s: np.ndarray
    x: np.ndarray

    @property
    def u(self) -> np.ndarray:
        """Path acceleration s̈ (K,) on each interval: Δx / (2 Δs)."""
        steps = np.diff(self.s)
        return np.diff(self.x) / (2 * steps)

    @property
    def times(self) -> np.ndarray:
        """Times (K + 1,) [s] at which the motion passes the grid points: Δt = 2 Δs / (ṡ_k + ṡ_{k+1})."""
        speed = np.sqrt(self.x)
        summed_speeds = speed[:-1] + speed[1:]
        durations = 2 * np.diff(self.s) / summed_speeds
        return np.append(0.0, np.cumsum(durations))

    @property
    def duration(self) -> float:
        return float(self.times[-1])

    def slower(self, factor: float) -> Profile:
        """Return the profile slowed down to `factor` times the duration."""
        return Profile(self.s, self.x / factor**2)

    def at(self, times: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return path parameter s, speed ṡ and path acceleration s̈, each (N,), at times (N,) [s]."""
        starts = self.times
        interval = np.searchsorted(starts, times, side="right") - 1
        k = np.clip(interval, 0, len(self.s) - 2)
        since = times - starts[k]
        speed = np.sqrt(self.x[k])
        u = self.u[k]
        travelled = since * (speed + since * u / 2)
        s = np.minimum(self.s[k] + travelled, self.s[k + 1])
        reached_speed = np.maximum(speed + since * u, 0.0)
        return s, reached_speed, u


@dataclass(frozen=True, eq=False)
class Sampled:
    """A motion along a path, sampled densely.

    Attributes:
        s: (N,) path parameters of the samples.
        weights: (N,) duration that each sample represents [s]; they sum to the duration of the motion.
        q, v, a, tau: (N, n) joint values [rad or m], velocities, accelerations, torques [N m or N]; tau is None where
            no torque law is given.
    """

    s: np.ndarray
    weights: np.ndarray
    q: np.ndarray
    v: np.ndarray
    a: np.ndarray
    tau: np.ndarray | None


def dense(path: Path, profile: Profile, torque: TorqueLaw | None, per_interval: int = 8) -> Sampled:
    """Return the motion along a path with a given speed profile, sampled densely on each interval of the profile.

    Both ends of an interval are samples, since s̈ and friction jump between intervals. At rest, friction has the
    direction of the motion that begins or ends at this instant, which gives the larger torque.

    Args:
        path: the path.
        profile: the speed profile along it.
        torque: (q, v, a) to torques, each (N, n); None computes no torques.
        per_interval: number of samples on each interval.
    """
    share = np.linspace(1e-6, 1 - 1e-6, per_interval)
    steps = np.diff(profile.s)[:, None]
    s = profile.s[:-1, None] + share * steps
    changes = np.diff(profile.x)[:, None]
    x = profile.x[:-1, None] + share * changes
    min_x = MIN_SPEED_SHARE**2 * profile.x.max()
    speed = np.sqrt(np.maximum(x, min_x))
    trapezoid = np.ones(per_interval)
    trapezoid[[0, -1]] = 0.5
    durations = np.diff(profile.times)[:, None]
    weights = durations * trapezoid / (per_interval - 1)
    u = np.repeat(profile.u, per_interval)
    q, v, a = moved(path, s.ravel(), speed.ravel(), u)
    tau = None
    if torque is not None:
        tau = torque(q, v, a)
    return Sampled(s.ravel(), weights.ravel(), q, v, a, tau)


def moved(path: Path, s: np.ndarray, speed: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return joint values, velocities and accelerations q = Φ, v = Φ' ṡ, a = Φ' s̈ + Φ'' ṡ², each (N, n).

    Args:
        path: the path Φ(s), with Φ' = dΦ/ds.
        s: (N,) path parameters s.
        speed: (N,) ṡ [unit of s per second].
        u: (N,) s̈ [unit of s per second²].
    """
    slope = path(s, 1)
    velocity = slope * speed[:, None]
    acceleration = slope * u[:, None] + path(s, 2) * (speed**2)[:, None]
    return path(s), velocity, acceleration


def track(path: Path, profile: Profile, rate: float, torque: TorqueLaw | None = None) -> Setpoints:
    """Return the motion along a path as setpoints at a controller's rate.

    The duration must be a whole number of samples. Torques at rest are those just after the start and just before the
    end.

    Args:
        path: the path.
        profile: the speed profile along it.
        rate: sampling rate of the controller [Hz].
        torque: (q, v, a) to torques, each (N, n); None leaves the torques of the setpoints None.
    """
    count = round(profile.duration * rate)
    times = np.arange(count + 1) / rate
    s, speed, u = profile.at(np.minimum(times, profile.duration))
    speed[[0, -1]] = np.sqrt(profile.x[[0, -1]])
    q, v, a = moved(path, s, speed, u)
    if torque is None:
        return Setpoints(rate, q, v, a)
    barely = np.maximum(speed, MIN_SPEED_SHARE * speed.max())
    along = path(s, 1) * barely[:, None]
    tau = torque(q, along, a)
    return Setpoints(rate, q, v, a, tau)
