"""Reference motions sampled at the controller's rate, and joint controllers (PD, PID, cascade P-PI, computed torque).

    tau = clip(kp e + kd (share v_r - v_m) + ki ∫ e + ahead),    e = q_r - q_m,

where v_m is the backward difference of measured positions at the control rate (as in BIRDy), through a first-order
low-pass if one is set; share is the share of the reference velocity v_r that is used, and ahead the feedforward torque.
A cascade P-PI is this law with other gains. Computed torque applies a model to the law's output: tau = M(q_m) (a_r + kp
e + …) + c(q_m, v_m) + g(q_m) + ahead, so that its gains are in 1/s² and 1/s.
"""

from dataclasses import dataclass

import numpy as np

from calib.data.signals.filtering import border, low_pass
from calib.errors import CalibError, MeasurementError
from calib.identification.loop import LoopController, LoopSettings
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
            shape = np.shape(self.q)
            values = shaped(getattr(self, name), shape, name)
            object.__setattr__(self, name, frozen(values))
        if len(self.t) != len(self.q) or len(self.t) < 2:
            raise CalibError(
                f"{len(self.t)} times, {len(self.q)} positions: a reference needs equal numbers, at least 2"
            )

    @property
    def period(self) -> float:
        """Control period [s]."""
        seconds = float(self.t[-1] - self.t[0])
        return seconds / (len(self.t) - 1)

    def sampled(self, ahead: np.ndarray | None) -> np.ndarray:
        """Return position, velocity, feedforward torque and acceleration as one array (4, N, n).

        Args:
            ahead: (N, n) feedforward torques [N m or N]; None: zero.
        """
        if ahead is None:
            torque = np.zeros_like(self.q)
        else:
            torque = shaped(ahead, self.q.shape, "torque ahead")
        return np.array([self.q, self.v, torque, self.a])

    def at(self, tick: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return q, v, a (M, n) at times `tick` (M,) in control periods; cubic splines interpolate between integers."""
        index = tick.astype(int)
        if np.all(tick == index):
            return self.q[index], self.v[index], self.a[index]
        from scipy.interpolate import CubicSpline

        q = CubicSpline(np.arange(len(self.t)), self.q)(tick)
        v = CubicSpline(np.arange(len(self.t)), self.v)(tick)
        a = CubicSpline(np.arange(len(self.t)), self.a)(tick)
        return q, v, a


def pd(
    kp: np.ndarray, kd: np.ndarray, limit: np.ndarray | float = np.inf, ki: np.ndarray | float = 0.0
) -> LoopController:
    """Return a PD or PID controller.

    Args:
        kp, kd: (n,) gains of position error [N m/rad] and velocity error [N m s/rad]; N and m for a prismatic joint.
        limit: (n,) torque limit [N m or N], or one number.
        ki: (n,) integral gains, or one number; 0 for a PD controller.
    """
    share = np.asarray(1.0)
    windup = np.asarray(np.inf)
    return LoopController(kp, kd, np.asarray(ki), share, np.asarray(limit), windup)


def cascade(
    position: np.ndarray,
    velocity: np.ndarray,
    reset: np.ndarray | float = np.inf,
    limit: np.ndarray | float = np.inf,
    share: float = 1.0,
) -> LoopController:
    """Return a cascade P-PI controller as a PID: v_c = share v_r + P e, tau = K [(v_c - v) + ∫ (v_c - v) / Ti].

    Up to its initial value, ∫ (v_c - v) = share q_r - q + P ∫ e. For share = 1 the gains are therefore kp = K (P +
    1/Ti), kd = K, ki = K P / Ti; with an integral part, another share cannot be written in this form.

    Args:
        position: P (n,), gain of the position loop [1/s].
        velocity: K (n,), gain of the velocity loop [N m s/rad].
        reset: Ti (n,), reset time [s]; infinite for a P-P cascade.
        limit: (n,) torque limit [N m or N], or one number.
        share: share of the reference velocity in the velocity loop, 0 to 1.

    Raises:
        CalibError: for a share other than 1 with an integral part.
    """
    if share != 1.0 and np.isfinite(reset).any():
        raise CalibError("a cascade with integral action needs the full reference velocity: set share = 1")
    position = np.asarray(position, dtype=float)
    velocity = np.asarray(velocity, dtype=float)
    ki = velocity * position / np.asarray(reset, dtype=float)
    kp = velocity * (position + 1.0 / np.asarray(reset, dtype=float))
    windup = np.asarray(np.inf)
    return LoopController(kp, velocity, ki, np.asarray(share), np.asarray(limit), windup)


def computed_torque(
    model: np.ndarray, frequency: float, damping: float, n: int, limit: np.ndarray | float = np.inf
) -> LoopController:
    """Return a computed-torque controller with error dynamics ë + 2 ζ ω ė + ω² e = 0 if its model is exact.

    e is the position error.

    Args:
        model: (10 B,) standard parameters of the controller's model of B bodies; inertias and friction of the drives
            are not in it.
        frequency: ω of the error dynamics [rad/s].
        damping: damping ratio ζ.
        n: number of joints.
        limit: (n,) torque limit [N m or N], or one number.
    """
    kp = np.full(n, frequency**2)
    kd = np.full(n, 2 * damping * frequency)
    no_integral = np.zeros(n)
    share = np.ones(n)
    windup = np.asarray(np.inf)
    return LoopController(kp, kd, no_integral, share, np.asarray(limit), windup, model=frozen(model))


def completed(controller: LoopController, loop: LoopSettings, n: int) -> LoopController:
    """Return a controller of n joints with the limits, delay and velocity filter of the settings.

    Args:
        controller: the controller with its gains.
        loop: settings of the loop.
        n: number of joints.
    """
    share = np.full(n, loop.share)
    limit = loop.per_joint("limit", n)
    windup = loop.per_joint("windup", n)
    return LoopController(
        controller.kp, controller.kd, controller.ki, share, limit, windup, delay=loop.delay, cutoff=loop.velocity_cutoff
    )


def stated_controller(loop: LoopSettings, n: int) -> LoopController:
    """Return the controller of n joints that the table [loop] describes.

    Args:
        loop: the table [loop], in which a list has one value or n.
        n: number of joints.

    Raises:
        UsageError: if the length of a list is not the number of joints.
    """
    if loop.controller == "cascade":
        first = loop.per_joint("position", n)
        second = loop.per_joint("velocity", n)
        third = loop.per_joint("reset", n)
        return completed(cascade(first, second, third, share=loop.share), loop, n)
    kp = loop.per_joint("kp", n)
    kd = loop.per_joint("kd", n)
    ki = loop.per_joint("ki", n)
    controller = pd(kp, kd, ki=ki)
    return completed(controller, loop, n)


# [Hz] the usual bandwidth of an industrial position loop
BAND = 20.0
# of a PD; more for a controller with memory, at the price of noise
ORDERS = (0, 1)


@dataclass(frozen=True, eq=False)
class IdentifiedController:
    """A controller identified from a log.

    Attributes:
        controller: PD or PID controller with the identified gains.
        explained: (n,) share of each joint's low-passed torque that the feedback explains, 100 (1 - ‖tau - τ̂‖ / ‖tau -
            mean‖) [%].
    """

    controller: LoopController
    explained: np.ndarray


def identify_controller(
    reference: Reference,
    measured: np.ndarray,
    tau: np.ndarray,
    rate: float,
    band: float = BAND,
    orders: tuple[int, int] = ORDERS,
    integral: bool = False,
) -> IdentifiedController:
    """Return a PD or PID controller identified from logged positions, torques and their reference.

    An ARX model from position error to torque is estimated with instruments that are functions of the reference; the
    gains are then fitted to its frequency response.

    Args:
        reference: reference at any multiple of the log's rate; it starts with the log's first sample.
        measured, tau: (N, n) logged positions [rad or m] and torques [N m or N].
        rate: sampling rate of the log [Hz].
        band: cut-off of the low-pass, and highest frequency at which the gains are fitted [Hz].
        orders: na, nb: numbers of past torques and of past position errors in the ARX model.
        integral: whether to identify the integral gains, too.

    Raises:
        MeasurementError: if reference and log have different lengths or rates, or the error is zero.
    """
    error = _error(reference, measured, rate)
    shape = np.shape(measured)
    tau = shaped(tau, shape, "torques")
    error = low_pass(error, rate, band)
    tau = low_pass(tau, rate, band)
    edge = border(rate, band)
    instruments = _instruments(reference, len(error), rate, band)[edge:-edge]
    basis = np.linalg.qr(instruments)[0]
    joint_gains = []
    explained = []
    for joint_error, joint_tau in zip(error.T, tau.T):
        past, errors = _joint(joint_error[edge:-edge], joint_tau[edge:-edge], basis, orders)
        joint_gains.append(_read(past, errors, rate, band, integral))
        explained.append(_explained(joint_error, joint_tau, joint_gains[-1], rate, band))
    gains = np.array(joint_gains)
    ki = gains[:, 2]
    kp = gains[:, 0]
    kd = gains[:, 1]
    controller = pd(kp, kd, ki=ki)
    return IdentifiedController(controller, frozen(explained))


def _error(reference: Reference, measured: np.ndarray, rate: float) -> np.ndarray:
    count = len(measured)
    tick = _ticks(reference, rate, count)
    if rate * reference.period > 1.0 + 1e-3 or tick[-1] > len(reference.t) - 1:
        raise MeasurementError(
            f"a log of {len(measured)} samples at {rate:g} Hz does not match a reference of {len(reference.t)} samples "
            f"at {1 / reference.period:g} Hz"
        )
    desired, *_ = reference.at(tick)
    return desired - shaped(measured, (None, reference.q.shape[1]), "measured positions")


def _ticks(reference: Reference, rate: float, count: int) -> np.ndarray:
    """Return the times (count,) of a log's samples in control periods, as integers where these are within 0.1 %.

    Args:
        reference: reference at the controller's rate.
        rate: sampling rate of the log [Hz].
        count: number of the log's samples.
    """
    every = 1.0 / (rate * reference.period)
    if abs(every / max(round(every), 1) - 1.0) < 1e-3:
        every = round(every)
    return np.arange(count) * every


def _instruments(reference: Reference, count: int, rate: float, band: float) -> np.ndarray:
    """Return low-passed instruments (count, k): functions of the reference like friction, inertia and gravity.

    Args:
        reference: reference at the controller's rate.
        count: number of the log's samples.
        rate: sampling rate of the log [Hz].
        band: cut-off of the low-pass [Hz].
    """
    q, v, a = reference.at(_ticks(reference, rate, count))
    jerk = np.gradient(a, 1.0 / rate, axis=0)
    peak = np.abs(v).max(axis=0, initial=1e-9)
    slow = np.tanh(v / (0.01 * peak))
    jerk_of_slow = np.gradient(slow, 1.0 / rate, axis=0)
    parts = [v, a, jerk, slow, jerk_of_slow, np.sin(q), np.cos(q)]
    series = low_pass(np.hstack(parts), rate, band)
    size = np.maximum(np.linalg.norm(series, axis=0), 1e-12)
    return np.column_stack([series / size, np.ones(count)])


def _joint(
    error: np.ndarray, tau: np.ndarray, basis: np.ndarray, orders: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the ARX coefficients a (na,), b (nb + 1,) of one joint, by two-stage least squares.

    Args:
        error, tau: (N,) low-passed position error [rad or m] and torque [N m or N].
        basis: (N, k) orthonormal basis of the instruments.
        orders: na, nb of the ARX model.
    """
    if not np.ptp(error) > 0.0:
        raise MeasurementError("the position error is zero throughout: log measured positions, not the reference")
    na, nb = orders
    first = max(orders)
    count = len(error)
    rows = basis[first:]
    columns = [tau[first - i : count - i] for i in range(1, na + 1)]
    columns += [error[first - i : count - i] for i in range(nb + 1)]
    stacked = np.column_stack(columns)
    offset = np.ones(count - first)
    projected = rows @ (rows.T @ stacked)
    matrix = np.column_stack([projected, offset])
    size = np.linalg.norm(matrix, axis=0)
    projected_torque = rows @ (rows.T @ tau[first:])
    solution, *_ = np.linalg.lstsq(matrix / size, projected_torque, rcond=None)
    values = solution / size
    return values[:na], values[na:-1]


def _read(past: np.ndarray, errors: np.ndarray, rate: float, band: float, integral: bool) -> np.ndarray:
    """Return the gains kp, kd, ki (3,) that best fit the frequency response of an ARX model.

    The fit uses frequencies from 1/40 to 1/2 of the band.

    Args:
        past, errors: ARX coefficients a (na,), b (nb + 1,).
        rate: sampling rate [Hz].
        band: highest frequency of the identification [Hz].
        integral: whether to fit ki; otherwise it is 0.
    """
    omega = 2.0 * np.pi * np.geomspace(band / 40.0, band / 2.0, 60)
    shift = np.exp(-1j * omega / rate)
    numerator = np.polyval(errors[::-1], shift)
    denominator = 1.0 - shift * np.polyval(past[::-1], shift)
    response = numerator / denominator
    columns = [np.ones_like(omega), 1j * omega]
    if integral:
        columns.append(1.0 / (1j * omega))
    matrix = np.column_stack(columns) / np.abs(response)[:, None]
    target = response / np.abs(response)
    stacked = np.vstack([matrix.real, matrix.imag])
    stacked_target = np.concatenate([target.real, target.imag])
    gains = np.linalg.lstsq(stacked, stacked_target, rcond=None)[0]
    return np.append(gains, np.zeros(3 - len(gains)))


def _explained(error: np.ndarray, tau: np.ndarray, gains: np.ndarray, rate: float, band: float) -> float:
    """Return the share [%] of a joint's low-passed torque (N,) that the gains kp, kd, ki (3,) explain.

    Args:
        error, tau: (N,) low-passed position error [rad or m] and torque [N m or N] of the joint.
        gains: (3,) kp, kd, ki.
        rate: sampling rate [Hz].
        band: cut-off of the low-pass [Hz].
    """
    kp, kd, ki = gains
    rate_of_error = np.gradient(error, 1.0 / rate)
    integral = np.cumsum(error)
    feedback = kp * error + kd * rate_of_error + ki * integral / rate
    edge = border(rate, band)
    residual = (tau - feedback)[edge:-edge]
    residual = residual - residual.mean()
    torque = tau[edge:-edge]
    torque = torque - torque.mean()
    share = np.linalg.norm(residual) / np.linalg.norm(torque)
    return float(100.0 * (1.0 - share))
