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
    model = ridge.chosen(urdf, joints)
    logs = [ridge.Log(model, path, cutoff) for path in train]
    inner = [(log.t > log.t[0] + BORDER) & (log.t < log.t[-1] - BORDER) for log in logs]
    rows = np.concatenate([log.rows[used] for log, used in zip(logs, inner)])
    tau = np.concatenate([log.tau[used] for log, used in zip(logs, inner)])
    weight = np.ones(tau.shape[1])
    for _ in range(2):
        stacked = (rows * weight[:, None]).reshape(-1, rows.shape[2])
        norms = np.linalg.norm(stacked, axis=0)
        scale = np.where(norms > 0.0, norms, 1.0)
        values = np.linalg.lstsq(stacked / scale, (tau * weight).ravel(), rcond=RANK)[0] / scale
        weight = 1.0 / np.maximum(np.std(tau - rows @ values, axis=0), 1e-9)
    unseen = [ridge.Log(model, path, cutoff, payload) for path in test]
    return [(log.t, log.rows @ values + log.carried) for log in unseen]
