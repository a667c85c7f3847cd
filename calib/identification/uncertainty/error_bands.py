"""How the spectral density of torque errors depends on the identification band, as seen in an identification's errors.

Faster and shorter motion is identified in a wider band, and all recordings together in the widest one. The variance of
white errors is proportional to the band, so that their density stays. Errors of a control loop, and of filters, are
larger at higher frequencies; model errors at lower ones. The density in a band with r rows per second is

    D(r) = V(r) τ(r) / r,

where V is the variance of the errors, filtered and decimated to r rows per second, and τ their integrated
autocorrelation, as in the weights of an identification (`calib.identification.prior.weighing`), and at most
`MAX_INFLATION` as there: beyond it the density of slow errors is stated too low in wide bands.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from calib.data.signals.filtering import Decimator, decimate, design_decimator, kept
from calib.estimation.whiteness import inflation
from calib.identification.prior import MAX_INFLATION
from calib.identification.rows import Case, ObservationRows
from calib.records import Array

FACTOR_STEP = 1.4
"""Ratio of successive decimation factors, about: densities between them are interpolated (our choice)."""
MIN_ROWS = 8
"""Rows in motion of a recording, below which it is not used."""


@dataclass(frozen=True, eq=False)
class ErrorBands:
    """Densities of torque errors in wider bands, relative to that in the identification's own band.

    Attributes:
        rows_per_second: (K,) increasing; the first one is that of the identification.
        density: (K, rows) relative densities; 1 in the first row.
        seconds: duration of the recordings [s]; 0 in files that do not state it.
    """

    rows_per_second: Array
    density: Array
    seconds: float = 0.0

    def factor(self, rows_per_second: float) -> np.ndarray:
        """Return the factor (rows,) of the density if all recordings have this number of rows per second.

        The band of the identification is the narrowest one, since it does not get narrower by further recordings.
        """
        at = np.log(max(rows_per_second, self.rows_per_second[0]))
        rates = np.log(self.rows_per_second)
        logarithms = np.log(self.density)
        return np.exp([np.interp(at, rates, column) for column in logarithms.T])


def error_bands(
    cases: Sequence[Case],
    predictions: Mapping[str, np.ndarray],
    all_rows: Sequence[ObservationRows],
    decimator: Decimator,
) -> ErrorBands | None:
    """Return how the density of an identification's errors depends on the band.

    None if the rows of the identification are not those of the model, or none has errors in motion. The density of a
    row without errors in motion is taken to stay.

    Args:
        cases: training recordings.
        predictions: name of a recording -> predicted torques (N, rows) at the full rate.
        all_rows: rows of all recordings.
        decimator: filter and decimation of the rows.
    """
    row_count = all_rows[0].target.shape[1]
    if any(predictions[case.name].shape[1] != row_count for case in cases):
        return None
    count = max(1, round(np.log(decimator.factor) / np.log(FACTOR_STEP)))
    steps = np.arange(count + 1) / count
    factors = np.unique(np.rint(decimator.factor ** (1.0 - steps)).astype(int))[::-1]
    rates = cases[0].motion.rate / factors
    densities = []
    for factor, rate in zip(factors.tolist(), rates):
        wider = design_decimator(cases[0].motion.rate, factor)
        densities.append(_power(cases, predictions, all_rows, decimator, wider) / rate)
    density = np.array(densities)
    # a row without errors in motion, as of a locked joint, keeps its density
    has_errors = (density > 0.0).all(axis=0)
    if not has_errors.any():
        return None
    relative = np.where(has_errors, density / np.where(has_errors, density[0], 1.0), 1.0)
    return ErrorBands(rates, relative, sum(case.duration for case in cases))


def _power(
    cases: Sequence[Case],
    predictions: Mapping[str, np.ndarray],
    all_rows: Sequence[ObservationRows],
    decimator: Decimator,
    wider: Decimator,
) -> np.ndarray:
    """Return the product (rows,) of variance and inflation of the errors in motion, in the band of a decimator.

    Args:
        cases: training recordings.
        predictions: name of a recording -> predicted torques (N, rows) at the full rate.
        all_rows: rows of all recordings.
        decimator: filter and decimation of these rows.
        wider: filter and decimation of the errors.
    """
    row_count = all_rows[0].target.shape[1]
    squares = np.zeros(row_count)
    inflated = np.zeros(row_count)
    counts = np.zeros(row_count)
    for case, rows in zip(cases, all_rows):
        segment = case.motion.segment
        errors = decimate(np.asarray(case.target) - predictions[case.name], wider, segment)
        samples = kept(segment, wider)
        row_samples = kept(segment, decimator)
        if not len(row_samples):
            continue
        next_row = np.searchsorted(row_samples, samples).clip(max=len(row_samples) - 1)
        in_motion = (rows.standing[next_row] == 0.0) & np.asarray(case.present)[samples]
        for row in range(row_count):
            row_errors = errors[in_motion[:, row], row]
            count = len(row_errors)
            if count >= MIN_ROWS:
                squares[row] += np.sum(row_errors**2)
                inflated[row] += count * inflation(row_errors)
                counts[row] += count
    counts = np.maximum(counts, 1.0)
    return squares / counts * np.clip(inflated / counts, 1.0, MAX_INFLATION)
