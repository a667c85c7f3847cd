"""How torque errors grow from one motion to another, as seen within the recordings of an identification.

Filters round off what changes quickly, and friction that changes its sign a little late is wrong for that moment: such
errors of time leave residuals where the torque y changes quickly. The variance of a joint's residuals is taken as

    V = v [1 - θ + θ ẏ² / mean ẏ²],

with the share θ by likelihood, or zero where a constant variance is as probable (Schwarz 1978). The cut-offs of filters
follow the motion, and so do the errors of time: on another motion, the share θ of the variance is scaled by the
variance of the torque. The remaining share is noise, and stays.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from calib.estimation.robust import variance_weights
from calib.estimation.whiteness import inflation
from calib.identification.rows import ObservationRows

MIN_ROWS = 8
"""Rows in motion of a recording, below which it is not used."""
MIN_FACTOR = 0.01
"""Factor of the errors' variance on a motion without torque, at least: some noise is in every log (our choice)."""


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
        return np.maximum(1.0 - self.share + self.share * ratio, MIN_FACTOR)


def error_growth(all_rows: Sequence[ObservationRows], values: np.ndarray) -> ErrorGrowth:
    """Return how the errors of an identification grow with the variance of the torques.

    Args:
        all_rows: rows of all recordings.
        values: (p,) identified parameters.
    """
    row_count = all_rows[0].target.shape[1]
    shares = np.zeros(row_count)
    variances = np.zeros(row_count)
    for row in range(row_count):
        errors = []
        expected_squares = []
        for rows in all_rows:
            in_motion = rows.present[:, row] & (rows.standing[:, row] == 0.0) & (rows.block >= 0)
            if in_motion.sum() < MIN_ROWS:
                continue
            torque = rows.target[:, row]
            residual = torque - rows.matrix[:, row] @ values
            rate_squares = np.gradient(torque)[in_motion] ** 2
            scale = torque[in_motion].var() / max(rate_squares.mean(), 1e-300)
            errors.append(residual[in_motion])
            expected_squares.append(scale * rate_squares)
        if errors:
            squares = np.concatenate(expected_squares)
            variances[row] = squares.mean()
            shares[row] = _growing_share(np.concatenate(errors), squares)
    return ErrorGrowth(shares, variances)


def _growing_share(errors: np.ndarray, rates: np.ndarray) -> float:
    """Return the share θ of the variance of errors (N,) that is proportional to squared rates (N,) of the torque."""
    if not errors.any() or not rates.any():
        return 0.0
    squares = errors**2 / np.mean(errors**2)
    shapes = np.column_stack([np.ones(len(rates)), rates / rates.mean()])
    weights = variance_weights(squares, shapes, np.full(2, 0.5))
    variance = shapes @ weights
    independent = 1.0 / inflation(errors)
    gain = 0.5 * independent * float(np.sum(squares - np.log(variance) - squares / variance))
    if gain < 0.5 * np.log(len(errors) * independent):
        return 0.0
    return float(weights[1] / weights.sum())
