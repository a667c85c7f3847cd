"""Sampled joint controllers: PD and PID with feed-forward, cascade P-PI, computed torque.

    tau = clip(kp e + kd (share v_r - v_m) + ki ∫ e + ahead),    e = q_r - q_m,

v_m the backward difference of measured positions at the control rate (BIRDy's choice), through a first-order low-pass
where one is given. A cascade P-PI is the same law with other names. Computed torque puts a model around it:
tau = M(q_m) (a_r + kp e + …) + c(q_m, v_m) + g(q_m) + ahead, so its gains are 1/s² and 1/s.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from calib.errors import CalibError, require
from calib.records import Array, Unbounded, frozen, shaped
from calib.simulation.loop.references import Reference


@dataclass(frozen=True, eq=False)
class Controller:
    """A sampled controller for n joints.

    Attributes:
        kp, kd, ki: (n,) [N m/rad, N m s/rad, N m/(rad s)], or the like for a prismatic joint; for computed torque
            [1/s², 1/s, 1/s³].
        share: (n,) share of the reference velocity in the velocity loop: 1 in a PD, less in some cascades.
        limit: (n,) torque limit.
        windup: (n,) limit of the error's integral [rad s].
        ahead: (N, n) feedforward torque at the reference's instants; None for none.
        model: (10 B,) standard parameters of the controller's own model (computed torque); None for none.
        delay: control periods from measurement to torque.
        cutoff: cut-off of the low-pass on the measured velocity [Hz]; None for none.
    """

    kp: Array
    kd: Array
    ki: Array
    share: Array
    limit: Unbounded
    windup: Unbounded
    ahead: Array | None = None
    model: Array | None = None
    delay: int = 0
    cutoff: float | None = None

    def __post_init__(self) -> None:
        n = len(np.atleast_1d(self.kp))
        for name in ("kp", "kd", "ki", "share", "limit", "windup"):
            value = np.broadcast_to(np.asarray(getattr(self, name), dtype=float), (n,))
            object.__setattr__(self, name, frozen(np.array(value)))
        require(self.delay >= 0, f"a delay of {self.delay} control periods is invalid")

    @property
    def rows(self) -> np.ndarray:
        """Controller values (6, n) in the layout of the kernel."""
        return np.array([self.kp, self.kd, self.ki, self.share, self.limit, self.windup])

    def smoothing(self, period: float) -> float:
        """Return the weight of a new velocity sample in the low-pass."""
        return 1.0 if self.cutoff is None else float(1.0 - np.exp(-2.0 * np.pi * self.cutoff * period))

    def sampled(self, reference: Reference) -> np.ndarray:
        """Return position, velocity, feedforward torque and feedforward acceleration, (4, N, n)."""
        ahead = np.zeros_like(reference.q) if self.ahead is None else self.ahead
        return np.array([reference.q, reference.v, shaped(ahead, reference.q.shape, "torque ahead"), reference.a])

    def scaled(self, factor: np.ndarray | float) -> Controller:
        """Return the controller with all gains times `factor`, one or (n,): the same bandwidth at another inertia."""
        return replace(self, kp=self.kp * factor, kd=self.kd * factor, ki=self.ki * factor)

    def slower(self, factor: float) -> Controller:
        """Return the controller with its bandwidth divided by `factor`: kp by factor², kd by factor, ki by factor³."""
        return replace(self, kp=self.kp / factor**2, kd=self.kd / factor, ki=self.ki / factor**3)

    def with_feedforward(self, ahead: np.ndarray) -> Controller:
        """Return the controller with a feedforward torque (N, n) added."""
        return replace(self, ahead=frozen(ahead))


def pd(kp: np.ndarray, kd: np.ndarray, limit: np.ndarray | float = np.inf, ki: np.ndarray | float = 0.0) -> Controller:
    """Return a PD (or PID) controller."""
    return Controller(kp, kd, np.asarray(ki), np.asarray(1.0), np.asarray(limit), np.asarray(np.inf))


def cascade(
    position: np.ndarray, velocity: np.ndarray, reset: np.ndarray | float = np.inf, limit: np.ndarray | float = np.inf,
    share: float = 1.0,
) -> Controller:  # fmt: skip
    """Return a cascade P-PI: v_c = share v_r + P e, tau = K [(v_c - v) + ∫ (v_c - v) / Ti], as a single law.

    (v_c - v) integrates to share q_r - q + P ∫ e (start aside): with share = 1 that is kp = K (P + 1/Ti), kd = K,
    ki = K P / Ti. Another share with an integral part is not of this form.

    Args:
        position: P (n,) [1/s].
        velocity: K (n,) [N m s/rad].
        reset: Ti (n,) [s]; infinite for a plain P-P cascade.
    """
    if share != 1.0 and np.isfinite(reset).any():
        raise CalibError("a cascade with an integral requires the whole reference velocity: share = 1")
    position, velocity = np.asarray(position, dtype=float), np.asarray(velocity, dtype=float)
    ki = velocity * position / np.asarray(reset, dtype=float)
    kp = velocity * (position + 1.0 / np.asarray(reset, dtype=float))
    return Controller(kp, velocity, ki, np.asarray(share), np.asarray(limit), np.asarray(np.inf))


def computed_torque(
    model: np.ndarray, frequency: float, damping: float, n: int, limit: np.ndarray | float = np.inf
) -> Controller:
    """Return a computed-torque controller with error dynamics ë + 2 ζ ω ė + ω² e = 0 for an exact model.

    Args:
        model: (10 B,) standard parameters; the drives' inertias and friction are those of the plant.
        frequency: ω [rad/s].
    """
    kp, kd = np.full(n, frequency**2), np.full(n, 2 * damping * frequency)
    return Controller(kp, kd, np.zeros(n), np.ones(n), np.asarray(limit), np.asarray(np.inf), model=frozen(model))
