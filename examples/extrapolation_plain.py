"""A plainer baseline: weighted least squares of all parameters, truncated at the rank of the data.

Rows are those of `extrapolation_ridge.Log` (Pinocchio, positions low-passed at 6 Hz). No prior, no selection: what a
user has after an hour. Joints are weighed by the residuals of the first solution; the ends of a log, where the filter
has not settled, are left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import extrapolation_ridge as ridge
import numpy as np

BORDER = 0.2  # at both ends of a log [s]
RANK = 1e-2  # singular values of unit-norm columns below this share of the largest are not identified


def predict(
    urdf: Path,
    train: Sequence[Path],
    test: Sequence[Path],
    cutoff: float = 6.0,
    payload: dict | None = None,
    joints: Sequence[str] = (),
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return instants (N,) and torques (N, n) predicted on each test file; see `extrapolation_ridge.predict`."""
    model = ridge.recorded_model(urdf, joints)
    regressors = []
    torques = []
    for path in train:
        log = ridge.Log(model, path, cutoff)
        settled = (log.t > log.t[0] + BORDER) & (log.t < log.t[-1] - BORDER)
        regressors.append(log.rows[settled])
        torques.append(log.tau[settled])
    rows = np.concatenate(regressors)
    tau = np.concatenate(torques)
    weight = np.ones(tau.shape[1])
    for _ in range(2):
        stacked = (rows * weight[:, None]).reshape(-1, rows.shape[2])
        norms = np.linalg.norm(stacked, axis=0)
        scale = np.where(norms > 0.0, norms, 1.0)
        target = (tau * weight).ravel()
        solution = np.linalg.lstsq(stacked / scale, target, rcond=RANK)[0]
        values = solution / scale
        residual_std = np.std(tau - rows @ values, axis=0)
        weight = 1.0 / np.maximum(residual_std, 1e-9)
    predictions = []
    for path in test:
        log = ridge.Log(model, path, cutoff, payload)
        predictions.append((log.t, log.rows @ values + log.payload_torque))
    return predictions
