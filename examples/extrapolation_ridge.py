"""A plain baseline for dynamic identification: ridge regression with one precision per group of parameters by evidence.

Parameters: each body's ten standard ones, tanh(v / 0.01), v, a and 1 per joint. One ridge precision per group (mass,
first moments, inertias, Coulomb, viscous, rotor, offset) and one noise per joint by MacKay's updates (1992); samples
count by the residuals' lag-one correlation. What a user would write in an afternoon.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pinocchio as pin
from scipy.signal import butter, filtfilt

RATE = 100.0  # of the rows [Hz]
ROUNDS = 60  # of MacKay's updates
MAX_ROWS_AS_ONE = 10.0  # correlated samples that count as one, at most
SIGN_WIDTH = 0.01  # velocity within which Coulomb friction changes its sign [rad/s or m/s]
# the groups of parameters that share a precision, and typical sizes of a body's: m, m c, inertias
BODY_GROUPS = [0, 1, 1, 1, 2, 2, 2, 2, 2, 2]
BODY_SCALES = [1, 0.3, 0.3, 0.3, 0.1, 0.1, 0.1, 0.1, 0.1, 0.1]
DRIVE_GROUPS = [3, 4, 5, 6]  # Coulomb, viscous, rotor, offset
DRIVE_SCALES = [1, 1, 0.3, 1]


class Log:
    """Regressor and torques of a recording.

    Attributes:
        t: (N,) instants [s].
        rows: (N, n, 14 n) regressor: of each body ten parameters, then Coulomb, viscous, rotor and offset by joint.
        tau: (N, n) torques [N m or N].
        payload_torque: (N, n) torques of the payload [N m or N]; zero without one.
    """

    def __init__(self, model: pin.Model, path: Path, cutoff: float, payload: dict | None = None):
        log = np.load(path)
        rate = 1.0 / np.median(np.diff(log["t"]))
        grid = np.arange(log["t"][0], log["t"][-1], 1.0 / rate)
        numerator, denominator = butter(4, cutoff / (rate / 2))
        q = filtfilt(numerator, denominator, _resampled(grid, log["t"], log["q"]), axis=0)
        v = np.gradient(q, 1 / rate, axis=0)
        a = np.gradient(v, 1 / rate, axis=0)
        decimated = slice(None, None, max(1, round(rate / RATE)))
        self.t = grid[decimated]
        self.tau = _resampled(grid, log["t"], log["tau"])[decimated]
        self.rows = _regressor(model, q[decimated], v[decimated], a[decimated])
        self.payload_torque = np.zeros_like(self.tau)
        if payload is not None:
            last_body = slice(10 * (model.njoints - 2), 10 * (model.njoints - 1))
            self.payload_torque = self.rows[:, :, last_body] @ _payload_parameters(model, payload)


def _resampled(grid: np.ndarray, t: np.ndarray, series: np.ndarray) -> np.ndarray:
    """Return series (N, n) at instants t (N,) [s], interpolated at the instants of a grid."""
    return np.column_stack([np.interp(grid, t, column) for column in series.T])


def _regressor(model: pin.Model, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
    """Return the regressor (N, n, 14 n) of a motion: positions, velocities and accelerations (N, n)."""
    data = model.createData()
    rows = []
    for position, velocity, acceleration in zip(q, v, a):
        bodies = pin.computeJointTorqueRegressor(model, data, position, velocity, acceleration)
        coulomb = np.diag(np.tanh(velocity / SIGN_WIDTH))
        viscous = np.diag(velocity)
        rotor = np.diag(acceleration)
        offset = np.eye(len(velocity))
        rows.append(np.hstack([bodies, coulomb, viscous, rotor, offset]))
    return np.array(rows)


def _payload_parameters(model: pin.Model, payload: dict) -> np.ndarray:
    """Return the standard parameters (10,) of a payload at the last joint: mass [kg], com [m] in the tip's frame."""
    flange = next(frame for frame in reversed(model.frames) if frame.type == pin.FrameType.BODY)
    body = pin.Inertia(payload["mass"], np.array(payload["com"]), np.zeros((3, 3)))
    return flange.placement.act(body).toDynamicParameters()


def _evidence(rows: np.ndarray, tau: np.ndarray, mean: np.ndarray, scale: np.ndarray, groups: np.ndarray) -> np.ndarray:
    """Return the parameters (p,) of a ridge regression whose precisions and noise are chosen by evidence.

    Args:
        rows: (N, n, p) regressor.
        tau: (N, n) torques.
        mean: (p,) of the prior.
        scale: (p,) typical sizes of the parameters.
        groups: (p,) number of the group that a parameter shares its precision with.
    """
    samples, n, _ = rows.shape
    target = tau - rows @ mean
    scaled = [rows[:, j] * scale for j in range(n)]
    # joint by joint: Hessian, gradient and constant of the sum of squares
    hessian = [matrix.T @ matrix for matrix in scaled]
    gradient = [matrix.T @ target[:, j] for j, matrix in enumerate(scaled)]
    squares = (target**2).sum(axis=0)
    precision = np.full(groups.max() + 1, 1e-2)
    rows_as_one = np.full(n, 10.0)
    noise = 0.01 * target.var(axis=0) + 1e-6
    for _ in range(ROUNDS):
        variance = noise * rows_as_one
        information = sum(hessian[j] / variance[j] for j in range(n))
        covariance = np.linalg.inv(information + np.diag(precision[groups]))
        x = covariance @ sum(gradient[j] / variance[j] for j in range(n))
        determined = 1 - precision[groups] * np.diag(covariance)
        for k in range(len(precision)):
            members = groups == k
            number = max(determined[members].sum(), 0.1)
            size = max((x[members] ** 2).sum(), 1e-12)
            precision[k] = np.clip(number / size, 1e-6, 1e8)
        for j in range(n):
            residual_squares = squares[j] - 2 * x @ gradient[j] + x @ hessian[j] @ x
            freedom = samples - np.trace(covariance @ hessian[j]) / rows_as_one[j]
            noise[j] = max(residual_squares / max(freedom, samples * 0.05), 1e-8)
            rows_as_one[j] = _correlated_rows(target[:, j] - scaled[j] @ x)
    return mean + scale * x


def _correlated_rows(residual: np.ndarray) -> float:
    """Return how many rows count as one, by the lag-one correlation ρ of residuals (N,): (1 + ρ) / (1 - ρ)."""
    correlation = np.corrcoef(residual[1:], residual[:-1])[0, 1]
    rho = np.clip(correlation, 0, 0.99)
    return min((1 + rho) / (1 - rho), MAX_ROWS_AS_ONE)


def recorded_model(urdf: Path, joints: Sequence[str] = ()) -> pin.Model:
    """Return the model of a description, of these joints alone where any are named."""
    model = pin.buildModelFromUrdf(str(urdf))
    if not joints:
        return model
    locked = [model.getJointId(name) for name in list(model.names)[1:] if name not in joints]
    return pin.buildReducedModel(model, locked, pin.neutral(model))


def predict(
    urdf: Path,
    train: Sequence[Path],
    test: Sequence[Path],
    cutoff: float = 6.0,
    payload: dict | None = None,
    joints: Sequence[str] = (),
) -> dict[str, list[tuple[np.ndarray, np.ndarray]]]:
    """Return instants (N,) and torques (N, n) predicted on each test file, regularised towards ``zero`` and ``cad``.

    Args:
        cutoff: of the positions' low-pass [Hz].
        payload: mass [kg] and com [m] in the tip's frame, of the body carried in the tests.
        joints: that were recorded, where the description has others.
    """
    model = recorded_model(urdf, joints)
    logs = [Log(model, path, cutoff) for path in train]
    unseen = [Log(model, path, cutoff, payload) for path in test]
    rows = np.concatenate([log.rows for log in logs])
    tau = np.concatenate([log.tau for log in logs])
    n = model.nv
    scale = np.concatenate([np.tile(BODY_SCALES, n), np.repeat(DRIVE_SCALES, n)])
    groups = np.concatenate([np.tile(BODY_GROUPS, n), np.repeat(DRIVE_GROUPS, n)])
    described = [inertia.toDynamicParameters() for inertia in model.inertias[1:]]
    means = {"zero": np.zeros(len(scale)), "cad": np.zeros(len(scale))}
    means["cad"][: 10 * n] = np.concatenate(described)
    predictions = {}
    for name, mean in means.items():
        values = _evidence(rows, tau, mean, scale, groups)
        predictions[name] = [(log.t, log.rows @ values + log.payload_torque) for log in unseen]
    return predictions
