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
ROUNDS, MAX_ROWS_AS_ONE = 60, 10.0
SCALES = [1, 0.3, 0.3, 0.3, 0.1, 0.1, 0.1, 0.1, 0.1, 0.1]  # of a body's parameters: m, m c, inertias


class Log:
    """Observation matrices (N, n, 14 n) and torques (N, n) [N m or N] of a file, at instants t (N,) [s]."""

    def __init__(self, model: pin.Model, path: Path, cutoff: float, payload: dict | None = None):
        log = np.load(path)
        rate = 1.0 / np.median(np.diff(log["t"]))
        grid = np.arange(log["t"][0], log["t"][-1], 1.0 / rate)
        q, tau = (np.column_stack([np.interp(grid, log["t"], c) for c in log[key].T]) for key in ("q", "tau"))
        smooth = filtfilt(*butter(4, cutoff / (rate / 2)), q, axis=0)
        v = np.gradient(smooth, 1 / rate, axis=0)
        a = np.gradient(v, 1 / rate, axis=0)
        every = slice(None, None, max(1, round(rate / RATE)))
        self.t, self.tau, data = grid[every], tau[every], model.createData()
        bodies = [pin.computeJointTorqueRegressor(model, data, *x) for x in zip(smooth[every], v[every], a[every])]
        drives = [np.hstack([np.diag(np.tanh(x / 0.01)), np.diag(x), np.diag(y), np.eye(len(x))]) for x, y in zip(
            v[every], a[every])]  # fmt: skip
        self.rows = np.concatenate([bodies, drives], axis=2)
        self.carried = np.zeros_like(self.tau)
        if payload is not None:
            flange = next(frame for frame in reversed(model.frames) if frame.type == pin.FrameType.BODY)
            body = flange.placement.act(pin.Inertia(payload["mass"], np.array(payload["com"]), np.zeros((3, 3))))
            last = slice(10 * (model.njoints - 2), 10 * (model.njoints - 1))
            self.carried = self.rows[:, :, last] @ body.toDynamicParameters()


def _evidence(rows: np.ndarray, tau: np.ndarray, mean: np.ndarray, scale: np.ndarray, groups: np.ndarray) -> np.ndarray:
    """Return the parameters (p,) of rows (N, n, p) and torques (N, n) around a prior mean."""
    samples, n, _ = rows.shape
    rest = tau - rows @ mean
    b = [rows[:, j] * scale for j in range(n)]
    h, g, c = [x.T @ x for x in b], [x.T @ rest[:, j] for j, x in enumerate(b)], (rest**2).sum(axis=0)
    precision, as_one, noise = np.full(groups.max() + 1, 1e-2), np.full(n, 10.0), 0.01 * rest.var(axis=0) + 1e-6
    for _ in range(ROUNDS):
        weighted = sum(h[j] / (noise[j] * as_one[j]) for j in range(n))
        covariance = np.linalg.inv(weighted + np.diag(precision[groups]))
        x = covariance @ sum(g[j] / (noise[j] * as_one[j]) for j in range(n))
        gamma = 1 - precision[groups] * np.diag(covariance)
        for k in range(len(precision)):
            own = groups == k
            precision[k] = np.clip(max(gamma[own].sum(), 0.1) / max((x[own] ** 2).sum(), 1e-12), 1e-6, 1e8)
        for j in range(n):
            left = c[j] - 2 * x @ g[j] + x @ h[j] @ x
            free = samples - np.trace(covariance @ h[j]) / as_one[j]
            noise[j] = max(left / max(free, samples * 0.05), 1e-8)
            error = rest[:, j] - b[j] @ x
            rho = np.clip(np.corrcoef(error[1:], error[:-1])[0, 1], 0, 0.99)
            as_one[j] = min((1 + rho) / (1 - rho), MAX_ROWS_AS_ONE)
    return mean + scale * x


def chosen(urdf: Path, joints: Sequence[str] = ()) -> pin.Model:
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
    model = chosen(urdf, joints)
    logs, unseen = [Log(model, x, cutoff) for x in train], [Log(model, x, cutoff, payload) for x in test]
    n = model.nv
    scale = np.r_[np.tile(SCALES, n), np.ones(n), np.ones(n), np.full(n, 0.3), np.ones(n)]
    groups = np.r_[np.tile([0, 1, 1, 1, 2, 2, 2, 2, 2, 2], n), np.repeat([3, 4, 5, 6], n)]
    rows, tau = (np.concatenate([getattr(log, key) for log in logs]) for key in ("rows", "tau"))
    result = {}
    for name, share in (("zero", 0.0), ("cad", 1.0)):
        mean = np.zeros(len(scale))
        mean[: 10 * n] = share * np.concatenate([inertia.toDynamicParameters() for inertia in model.inertias[1:]])
        found = _evidence(rows, tau, mean, scale, groups)
        result[name] = [(log.t, log.rows @ found + log.carried) for log in unseen]
    return result
