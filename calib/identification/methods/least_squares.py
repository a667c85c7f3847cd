"""The estimators of the LS family by name, on rows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.errors import UsageError
from calib.estimation.estimate import Estimate
from calib.estimation.linear import LinearFit, ols, settled_std, wls
from calib.estimation.samples import irls, stack
from calib.estimation.total import tls
from calib.estimation.triangles import Triangles, residual_squares
from calib.estimation.whiteness import inflation
from calib.identification.friction.time_folds import estimate
from calib.identification.rows import ObservationRows, pool

METHODS = ("ols", "wls", "irls", "tls", "iv")
COLUMN_NOISE = 0.01  # of a column's rms: what filtered derivatives miss (our choice)
ASSUMES = {
    "ols": "the torques of all joints are equally noisy, q, v and a exact",
    "wls": "each joint's torque is as noisy as its own residuals say, q, v and a exact",
    "irls": "torques are noisy together across joints, and samples that do not fit at all are gated out; q, v, a exact",
    "tls": (
        f"columns of W are noisy too: each by {COLUMN_NOISE:.0%} of its rms where a joint's torque is noisy by its "
        "residuals, all up to one factor that the data tell, independently from row to row; offsets and signs are exact"
    ),
    "iv": "the controller and its reference are those of the loop, the model's friction that of the robot",
}
"""What an estimate rests on, for the user."""


@dataclass(frozen=True, eq=False)
class MethodEstimate:
    """A fit of base parameters.

    Attributes:
        fit: the estimate and what it rests on.
        pooled: triangles of all rows, one group per row.
        std: (rows,) standard deviation that each row is weighed with: that of its residuals, unless stated.
        inflation: (rows,) how many rows count as one, from the residuals' autocorrelation.
        method: one of `METHODS`.
    """

    fit: LinearFit
    pooled: Triangles
    std: np.ndarray
    inflation: np.ndarray
    method: str

    @property
    def estimate(self) -> Estimate:
        return self.fit.estimate


def fit_rows(
    all_rows: Sequence[ObservationRows],
    data: Triangles,
    method: str = "wls",
    exact: bool = True,
    noise: np.ndarray | None = None,
) -> MethodEstimate:
    """Estimate the columns' parameters, with a covariance that knows that residuals are correlated in time.

    Args:
        all_rows: of all cases.
        data: their triangles (`rows.triangulate`).
        exact: False where a prior will decide on what the data leave open.
        method: ``ols``, ``wls``, ``irls`` (across joints, with a gate) or ``tls`` (noise in the columns
            in proportion to their size).
        noise: (rows,) where it is known from elsewhere, up to a common factor (`scaled`); None: from the residuals.
    """
    if method not in METHODS:
        raise UsageError(f"method '{method}' is none of {', '.join(METHODS)}")
    rows = all_rows[0].target.shape[1]
    pooled = pool(data, rows)
    if not exact:
        return _least_norm(all_rows, pooled, method, noise)
    std = settled_std(pooled) if noise is None else noise * wls(pooled, noise).estimate.residual_std
    first = wls(pooled, std)
    tau = residual_inflation(all_rows, first.estimate.values)
    if method == "ols":
        fit = ols(pooled, tau)
    elif method == "irls":
        fit = _irls(all_rows, float(np.median(tau)))
    elif method == "tls":
        fit = _tls(pooled, std)
    else:
        fit = wls(pooled, std, tau)
    return MethodEstimate(fit, pooled, std, tau, method)


def scaled(noise: np.ndarray | None, std: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Return the rows' noise times one factor, that of the residuals' `std` (rows,) of `counts` samples; None: `std`.

    Relative between joints, with a common scale (our choice): the variance over repeats does not see what every period
    has alike, so as it stands it would promise too much; and the decimation filter's gain for white noise, one number
    for all joints, drops out.
    """
    return std if noise is None else noise * np.sqrt(np.average((std / noise) ** 2, weights=np.maximum(counts, 1)))


def _least_norm(
    all_rows: Sequence[ObservationRows], pooled: Triangles, method: str, noise: np.ndarray | None
) -> MethodEstimate:
    """Return a fit whose values serve for its residuals alone: a prior will decide what the data leave open."""
    std, tau = np.ones(pooled.groups), np.ones(pooled.groups)
    values = np.zeros(pooled.parameters)
    for _ in range(4):
        values = estimate(pooled, std, tau, np.full(pooled.parameters, -1))[0]
        std = np.sqrt(residual_squares(pooled, values) / np.maximum(pooled.rows, 1))
        std = scaled(noise, np.maximum(std, 1e-9 * max(float(std.max()), 1e-300)), pooled.rows)
    covariance = np.zeros((pooled.parameters, pooled.parameters))
    holder = Estimate(pooled.names, pooled.units, values, covariance, 1.0, int(pooled.rows.sum()))
    tau = residual_inflation(all_rows, values)
    return MethodEstimate(LinearFit(holder, std, np.inf, np.inf), pooled, std, tau, method)


def residual_inflation(all_rows: Sequence[ObservationRows], values: np.ndarray) -> np.ndarray:
    """Return the integrated autocorrelation of each row's residuals (rows,), averaged over cases by length."""
    rows = all_rows[0].target.shape[1]
    total, weight = np.zeros(rows), 0.0
    for part in all_rows:
        residual = part.target - part.matrix @ values
        total += len(residual) * np.array([inflation(residual[:, row]) for row in range(rows)])
        weight += len(residual)
    return np.maximum(total / max(weight, 1.0), 1.0)


def _irls(all_rows: Sequence[ObservationRows], inflated: float) -> LinearFit:
    matrix = np.concatenate([part.matrix for part in all_rows])
    target = np.concatenate([part.target for part in all_rows])
    present = np.concatenate([part.present for part in all_rows])
    samples = stack(matrix, target, present, all_rows[0].names, all_rows[0].units)
    return irls(samples, inflation=inflated).fit


def _tls(pooled: Triangles, std: np.ndarray) -> LinearFit:
    """Return the scaled TLS fit: columns that move have noise of `COLUMN_NOISE` of their size, y that of its residuals.

    Columns of ones (offsets) and of signs are exact. The common level is the smallest singular value's; the ratio of
    the noises, which no single recording tells, is our choice.
    """
    p = pooled.parameters
    stacked = np.sum((pooled.factors / std[:, None, None]) ** 2, axis=(0, 1))
    size = np.sqrt(stacked / max(float(pooled.rows.sum()), 1.0))
    exact = np.array([name.startswith(("off", "Fc")) for name in pooled.names])
    noise = np.append(np.where(exact, 0.0, COLUMN_NOISE * size[:p]), 1.0)
    return tls(pooled, noise, std)
