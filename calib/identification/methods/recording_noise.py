"""Torque errors of each recording: how large they are in one recording compared with all.

A fast motion leaves larger residuals than a slow one (filters round off what turns quickly, friction changes its sign
more often), so that one σ per joint weighs the rows of several recordings wrongly and states a covariance that is too
large for one and too small for the other. With d = σ² τ, the variance of a joint's residuals times the number of them
that count as one, the logarithms x of a joint j in recordings r are taken as

    x_rj ~ N(m_j, B + s²_rj),

s² from the residuals' own fourth moments and autocorrelation, and B, the variance between recordings, from those of all
joints by moments (DerSimonian & Laird 1986, eq. 8). Each logarithm is moved towards its joint's mean as far as this
asks, B / (B + s²): recordings alike, or too short to tell, have equal weights.

How errors grow from one motion to another is seen within the recordings: a filter that rounds off, a friction that
changes its sign a little late err in time, and leave residuals where the torque y changes quickly. A joint's variance
is

    V = v [1 - θ + θ ẏ² / mean ẏ²],

θ by likelihood, or zero where a constant variance is as probable (Schwarz 1978). The bands of filters follow the
motion, and so this share of the variance follows that of the torque, θ var y; the remaining share is noise, and stays.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from calib.estimation.robust import variance_weights
from calib.estimation.whiteness import inflation
from calib.identification.rows import ObservationRows, pool, triangulate
from calib.identification.time_folds import covariance_root, estimate
from calib.records import frozen

WINDOW_VARIANCE = 20.0
"""Variance of log τ times rows per τ: a window of 5 τ lags, whose sum has four times its length in it (Sokal 1997)."""
MIN_ROWS = 8
"""Rows in motion below which nothing is said of a recording's errors."""
MIN_FREEDOM_SHARE = 0.1
"""Share of the rows that parameters leave for the errors, at least."""
ROUNDS = 3
"""Rounds of weights and estimates."""


class ErrorGrowth(NamedTuple):
    """How the variance of torque errors grows with the motion, by torque row.

    Attributes:
        share: (rows,) θ, share of the variance that follows the torque's.
        torque_variance: (rows,) variance of the torques from which it was estimated [N² m² or N²].
    """

    share: np.ndarray
    torque_variance: np.ndarray

    def factor(self, torque_variance: np.ndarray) -> np.ndarray:
        """Return the factor (rows,) of the errors' variance on a motion whose torques have these variances (rows,)."""
        ratio = torque_variance / np.maximum(self.torque_variance, 1e-300)
        return 1.0 - self.share + self.share * ratio


class ErrorSizes(NamedTuple):
    """Logarithms (recordings, rows) of the residuals' variance times τ, and their variances; infinite: unknown."""

    logs: np.ndarray
    variances: np.ndarray


def error_sizes(all_rows: Sequence[ObservationRows], values: np.ndarray, parameters: np.ndarray) -> ErrorSizes:
    """Return the sizes of the torque errors by recording and torque row.

    Args:
        all_rows: rows by recording.
        values: (p,) parameters.
        parameters: (recordings, rows) how many parameters each recording's rows determine.
    """
    row_count = all_rows[0].target.shape[1]
    logs = np.zeros((len(all_rows), row_count))
    variances = np.full((len(all_rows), row_count), np.inf)
    for recording, rows in enumerate(all_rows):
        residual = rows.target - rows.matrix @ values
        in_motion = rows.present & (rows.standing == 0.0)
        for row in range(row_count):
            errors = residual[in_motion[:, row], row]
            if len(errors) < MIN_ROWS or not errors.any():
                continue
            logs[recording, row], variances[recording, row] = _error_size(errors, parameters[recording, row])
    return ErrorSizes(logs, variances)


def _error_size(errors: np.ndarray, parameters: float) -> tuple[float, float]:
    """Return the logarithm of the variance of errors (N,) times τ, and that logarithm's variance."""
    count = len(errors)
    squares = errors**2
    correlated = inflation(errors)
    freedom = max(count - correlated * parameters, MIN_FREEDOM_SHARE * count)
    size = squares.sum() / freedom * correlated
    spread = squares.var() / squares.mean() ** 2 * inflation(squares)
    return float(np.log(size)), float((spread + WINDOW_VARIANCE * (correlated - 1.0)) / freedom)


def drawn_together(sizes: ErrorSizes) -> np.ndarray:
    """Return the deviations (recordings, rows) of the logarithms from each row's mean, as far as they are significant.

    They are zero where recordings do not differ, and where a size is unknown.
    """
    finite = np.isfinite(sizes.variances)
    weight = 1.0 / sizes.variances
    total = np.maximum(weight.sum(axis=0), 1e-300)
    mean = (weight * sizes.logs).sum(axis=0) / total
    excess = float(np.sum(weight * (sizes.logs - mean) ** 2))
    excess -= float(np.maximum(finite.sum(axis=0) - 1, 0).sum())
    scale = float(np.sum(total - (weight**2).sum(axis=0) / total))
    if excess <= 0.0 or scale <= 0.0:
        return np.zeros(sizes.logs.shape)
    between = excess / scale
    weight = 1.0 / (between + sizes.variances)
    total = np.maximum(weight.sum(axis=0), 1e-300)
    mean = (weight * sizes.logs).sum(axis=0) / total
    return np.where(finite, between * weight * (sizes.logs - mean), 0.0)


def with_precision(
    all_rows: Sequence[ObservationRows],
    std: np.ndarray,
    inflations: np.ndarray,
    groups: np.ndarray | None = None,
    prior: np.ndarray | None = None,
) -> list[ObservationRows]:
    """Return rows weighted by the errors of their recordings; equal weights where these do not differ.

    Args:
        all_rows: rows by recording.
        std, inflations: (rows,) standard deviation and variance inflation of the residuals of all recordings.
        groups: (p,) ridge group of each column, -1 for none; None: no ridges.
        prior: (k, p + 1) whitened rows of [W y] of a prior; None without one.
    """
    if len(all_rows) == 1:
        return list(all_rows)
    row_count = len(std)
    equal = np.ones(row_count)
    parts = [pool(triangulate([replace(rows, precision=equal)]), row_count) for rows in all_rows]
    counts = np.array([part.rows for part in parts], dtype=float)
    if groups is None:
        groups = np.full(parts[0].parameters, -1)
    noise = std * np.sqrt(inflations)
    precision = np.ones((len(parts), row_count))
    for _ in range(ROUNDS):
        factors = np.stack([part.factors for part in parts], axis=1) * precision.T[:, :, None, None]
        size = factors.shape[-1]
        joined = replace(parts[0], factors=factors.reshape(row_count, -1, size), rows=counts.sum(axis=0))
        values, ridges = estimate(joined, std, inflations, groups, prior)
        root = covariance_root(joined, std, inflations, ridges, prior)
        explained = factors[:, :, :, :-1] @ root
        parameters = np.sum(explained**2, axis=(2, 3)).T / noise**2
        precision = _precision(drawn_together(error_sizes(all_rows, values, parameters)), counts)
    result = []
    for rows, factor in zip(all_rows, precision):
        result.append(replace(rows, precision=frozen(factor)))
    return result


def _precision(logs: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Return the factors of the rows (recordings, rows): √(mean variance / variance), the mean over all rows.

    Args:
        logs: (recordings, rows) logarithms of the variances.
        counts: (recordings, rows) number of rows.
    """
    variances = np.exp(logs)
    total = np.maximum(counts.sum(axis=0), 1.0)
    mean = np.maximum((counts * variances).sum(axis=0) / total, 1e-300)
    return np.where(counts.sum(axis=0) > 0.0, np.sqrt(mean / variances), 1.0)


def error_growth(all_rows: Sequence[ObservationRows], values: np.ndarray) -> ErrorGrowth:
    """Return how the errors of an identification with parameters (p,) grow with the torques' variance."""
    row_count = all_rows[0].target.shape[1]
    shares = np.zeros(row_count)
    variances = np.zeros(row_count)
    for row in range(row_count):
        errors = []
        rates = []
        torque_squares = []
        for rows in all_rows:
            in_motion = rows.present[:, row] & (rows.standing[:, row] == 0.0) & (rows.block >= 0)
            if in_motion.sum() < MIN_ROWS:
                continue
            torque = rows.target[:, row]
            residual = torque - rows.matrix[:, row] @ values
            variance = torque[in_motion].var()
            rate_squares = np.gradient(torque)[in_motion] ** 2
            mean_rate = max(float(rate_squares.mean()), 1e-300)
            errors.append(residual[in_motion])
            rates.append(rate_squares / mean_rate * variance)
            torque_squares.append(np.full(len(rate_squares), variance))
        if errors:
            variances[row] = np.concatenate(torque_squares).mean()
            shares[row] = _growing_share(np.concatenate(errors), np.concatenate(rates))
    return ErrorGrowth(shares, variances)


def _growing_share(errors: np.ndarray, rates: np.ndarray) -> float:
    """Return the share θ of the errors' variance that is proportional to the rates (N,); 0 if that is not probable."""
    mean_square = float(np.mean(errors**2))
    if not mean_square > 0.0 or not rates.any():
        return 0.0
    squares = errors**2 / mean_square
    shapes = np.column_stack([np.ones(len(rates)), rates / rates.mean()])
    weights = variance_weights(squares, shapes, np.full(2, 0.5))
    variance = shapes @ weights
    independent = 1.0 / inflation(errors)
    gain = 0.5 * independent * float(np.sum(squares - np.log(variance) - squares / variance))
    if gain < 0.5 * np.log(len(errors) * independent):
        return 0.0
    return float(weights[1] / weights.sum())
