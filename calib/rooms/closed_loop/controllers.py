"""Reference motions sampled at the controller's rate, and joint controllers (PD, PID, cascade P-PI, computed torque).

    tau = clip(kp e + kd (share v_r - v_m) + ki ∫ e + ahead),    e = q_r - q_m,

v_m the backward difference of measured positions at the control rate (BIRDy's choice), through a first-order low-pass
where one is given. A cascade P-PI is the same law with other names. Computed torque puts a model around it:
tau = M(q_m) (a_r + kp e + …) + c(q_m, v_m) + g(q_m) + ahead, so its gains are 1/s² and 1/s.
"""

from dataclasses import dataclass

import numpy as np

from calib.errors import CalibError
from calib.identification.loop import Controller, LoopSettings
from calib.records import frozen, shaped


@dataclass(frozen=True, eq=False)
class Reference:
    """A reference motion at N equally spaced times.

    Attributes:
        t: (N,) times [s].
        q, v, a: (N, n) [rad or m, and per s, per s²].
    """

    t: np.ndarray
    q: np.ndarray
    v: np.ndarray
    a: np.ndarray

    def __post_init__(self) -> None:
        object.__setattr__(self, "t", frozen(self.t))
        for name in ("q", "v", "a"):
            object.__setattr__(self, name, frozen(shaped(getattr(self, name), np.shape(self.q), name)))
        if len(self.t) != len(self.q) or len(self.t) < 2:
            raise CalibError(
                f"a reference needs at least two times, one per position; found {len(self.t)}, {len(self.q)}"
            )

    @property
    def period(self) -> float:
        """The control period [s]."""
        return float(self.t[-1] - self.t[0]) / (len(self.t) - 1)

    def sampled(self, ahead: np.ndarray | None) -> np.ndarray:
        """Return position, velocity, feedforward torque `ahead` (N, n) and acceleration, (4, N, n)."""
        torque = np.zeros_like(self.q) if ahead is None else shaped(ahead, self.q.shape, "torque ahead")
        return np.array([self.q, self.v, torque, self.a])

    def at(self, tick: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return q, v, a (M, n) at control periods `tick` (M,), interpolated by cubic splines between integers."""
        whole = tick.astype(int)
        if np.all(tick == whole):
            return self.q[whole], self.v[whole], self.a[whole]
        from scipy.interpolate import CubicSpline

        q, v, a = (CubicSpline(np.arange(len(self.t)), x)(tick) for x in (self.q, self.v, self.a))
        return q, v, a


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


def completed(controller: Controller, loop: LoopSettings, n: int) -> Controller:
    """Return the controller with saturation, delay and filter of the settings added to its gains."""
    return Controller(
        controller.kp, controller.kd, controller.ki, np.full(n, loop.share), loop.per_joint("limit", n),
        loop.per_joint("windup", n), delay=loop.delay, cutoff=loop.velocity_cutoff,
    )  # fmt: skip


def stated_controller(loop: LoopSettings, n: int) -> Controller:
    """Return the controller with the stated gains, for n joints.

    Raises:
        UsageError: where the length of a list is not the number of joints.
    """
    if loop.controller == "cascade":
        first, second, third = (loop.per_joint(key, n) for key in ("position", "velocity", "reset"))
        return completed(cascade(first, second, third, share=loop.share), loop, n)
    return completed(pd(loop.per_joint("kp", n), loop.per_joint("kd", n), ki=loop.per_joint("ki", n)), loop, n)
