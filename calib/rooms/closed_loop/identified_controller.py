"""A joint controller identified from its log: an ARX model from position error to torque, converted to a PID.

    tau_k = Σ a_i tau_{k-i} + Σ b_i e_{k-i} + c,    C(ω) = B(e^{jωT}) / A(e^{jωT}) ≈ kp + kd jω + ki / (jω)

("An ARMA model is generally enough", Janot's slides on the TX40.) Both series are low-passed alike first: what is above
the band is noise, and the controller's own rate, often a multiple of the log's, does not matter below it. Noise that is
in the logged positions but was not in the controller's would shrink the gains; the error is therefore replaced by its
projection on functions of the reference, which knows nothing of noise (two-stage least squares; our choice).
"""

from dataclasses import dataclass

import numpy as np

from calib.data.signals.filtering import border, low_pass
from calib.errors import MeasurementError
from calib.identification.loop import Controller
from calib.records import frozen, shaped
from calib.rooms.closed_loop.controllers import Reference, pd

BAND = 20.0  # [Hz] the usual bandwidth of an industrial position loop
ORDERS = (0, 1)  # of a PD; more for a controller with memory, at the price of noise


@dataclass(frozen=True, eq=False)
class IdentifiedController:
    """A controller identified from a log.

    Attributes:
        controller: PD or PID with the identified gains.
        explained: (n,) share of the low-passed torque by the PID's feedback, 100 (1 - ‖tau - τ̂‖ / ‖tau - mean‖) [%].
    """

    controller: Controller
    explained: np.ndarray


def identify_controller(
    reference: Reference, measured: np.ndarray, tau: np.ndarray, rate: float, band: float = BAND,
    orders: tuple[int, int] = ORDERS, integral: bool = False,
) -> IdentifiedController:  # fmt: skip
    """Return the controller identified from a log.

    Args:
        reference: at any multiple of the log's rate; its first instant is the log's.
        measured, tau: (N, n) positions and torques as logged.
        rate: of the log [Hz].
        band: of the low-pass, and the highest frequency at which the gains are read [Hz].
        orders: na, nb.
        integral: whether to look for ki.

    Raises:
        MeasurementError: where reference and log do not fit together, or the error is zero.
    """
    error, tau = _error(reference, measured, rate), shaped(tau, np.shape(measured), "torques")
    error, tau = low_pass(error, rate, band), low_pass(tau, rate, band)
    edge = border(rate, band)
    basis = np.linalg.qr(_instruments(reference, len(error), rate, band)[edge:-edge])[0]
    found = [_joint(error[edge:-edge, j], tau[edge:-edge, j], basis, orders) for j in range(error.shape[1])]
    gains = np.array([_read(past, errors, rate, band, integral) for past, errors in found])
    controller = pd(gains[:, 0], gains[:, 1], ki=gains[:, 2])
    explained = [_explained(error[:, j], tau[:, j], gains[j], rate, band) for j in range(len(gains))]
    return IdentifiedController(controller, frozen(explained))


def _error(reference: Reference, measured: np.ndarray, rate: float) -> np.ndarray:
    tick = _ticks(reference, rate, len(measured))
    if rate * reference.period > 1.0 + 1e-3 or tick[-1] > len(reference.t) - 1:
        raise MeasurementError(
            f"a log of {len(measured)} samples at {rate:g} Hz does not fit a reference of {len(reference.t)} instants "
            f"at {1 / reference.period:g} Hz"
        )
    return reference.at(tick)[0] - shaped(measured, (None, reference.q.shape[1]), "measured positions")


def _ticks(reference: Reference, rate: float, count: int) -> np.ndarray:
    """Return the control periods (count,) of a log's samples, whole numbers if they are within 0.1 %."""
    every = 1.0 / (rate * reference.period)
    return np.arange(count) * (round(every) if abs(every / max(round(every), 1) - 1.0) < 1e-3 else every)


def _instruments(reference: Reference, count: int, rate: float, band: float) -> np.ndarray:
    """Return the instruments (count, k), functions of the reference: friction, inertia and gravity, low-passed."""
    q, v, a = reference.at(_ticks(reference, rate, count))
    jerk = np.gradient(a, 1.0 / rate, axis=0)
    slow = np.tanh(v / (0.01 * np.abs(v).max(axis=0, initial=1e-9)))
    parts = [v, a, jerk, slow, np.gradient(slow, 1.0 / rate, axis=0), np.sin(q), np.cos(q)]
    series = low_pass(np.hstack(parts), rate, band)
    return np.column_stack([series / np.maximum(np.linalg.norm(series, axis=0), 1e-12), np.ones(count)])


def _joint(
    error: np.ndarray, tau: np.ndarray, basis: np.ndarray, orders: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the ARX coefficients a, b of one joint by two-stage least squares with an orthonormal instrument basis."""
    if not np.ptp(error) > 0.0:
        raise MeasurementError("the position error is zero throughout: log encoder positions, not the reference")
    na, nb = orders
    first, count = max(orders), len(error)
    own = basis[first:]
    columns = [tau[first - i : count - i] for i in range(1, na + 1)]
    columns += [error[first - i : count - i] for i in range(nb + 1)]
    matrix = np.column_stack([own @ (own.T @ np.column_stack(columns)), np.ones(count - first)])
    size = np.linalg.norm(matrix, axis=0)
    values = np.linalg.lstsq(matrix / size, own @ (own.T @ tau[first:]), rcond=None)[0] / size
    return values[:na], values[na:-1]


def _read(past: np.ndarray, errors: np.ndarray, rate: float, band: float, integral: bool) -> np.ndarray:
    """Return kp, kd, ki with the best relative fit to C(ω) from 1/40 to 1/2 of the band."""
    omega = 2.0 * np.pi * np.geomspace(band / 40.0, band / 2.0, 60)
    shift = np.exp(-1j * omega / rate)
    response = np.polyval(errors[::-1], shift) / (1.0 - shift * np.polyval(past[::-1], shift))
    columns = np.column_stack([np.ones_like(omega), 1j * omega] + ([1.0 / (1j * omega)] if integral else []))
    matrix = columns / np.abs(response)[:, None]
    target = response / np.abs(response)
    stacked = np.vstack([matrix.real, matrix.imag])
    gains = np.linalg.lstsq(stacked, np.concatenate([target.real, target.imag]), rcond=None)[0]
    return np.append(gains, np.zeros(3 - len(gains)))


def _explained(error: np.ndarray, tau: np.ndarray, gains: np.ndarray, rate: float, band: float) -> float:
    """Return the share of the low-passed torque explained by the gains (n,) [%]."""
    own = gains[0] * error + gains[1] * np.gradient(error, 1.0 / rate) + gains[2] * np.cumsum(error) / rate
    edge = border(rate, band)
    rest, whole = (x[edge:-edge] - x[edge:-edge].mean() for x in (tau - own, tau))
    return float(100.0 * (1.0 - np.linalg.norm(rest) / np.linalg.norm(whole)))
