"""How strong what is known beforehand should be: as strong as regimes left out of the motion ask for."""

from collections.abc import Callable, Sequence

import numpy as np

from calib.identification.left_out.regimes import Regimes
from calib.identification.left_out.time_folds import CrossValidation
from calib.identification.prior import TEMPERING, Prior
from calib.identification.rows import ObservationRows, triangulate

STEPS = (TEMPERING, 2.0 * TEMPERING, 4.0 * TEMPERING)


def tempered_prior(
    find: Callable[[float, Prior | None], Prior], rows: Sequence[ObservationRows], regimes: Regimes
) -> Prior:
    """Return the prior of the tempering with which the regimes are predicted best by what the rest identifies.

    Errors are squares of all rows, each in units of its residuals, and their geometric mean over the regimes: where
    one kind of extreme is hard for every prior it decides no more than the others. A stronger prior has to be better by
    `min_gain`.

    Args:
        find: tempering and a prior to start from to the prior whose sizes the evidence chose with it.
        rows: in the base columns.
        regimes: of these rows.
    """
    data, columns, best = triangulate(rows), np.arange(len(rows[0].names)), None
    found = find(STEPS[0], None)
    std = found.first.std
    min_gain = 0.08  # in the logarithm of squared errors, by which a stronger prior has to be better (our choice)
    for tempering in STEPS:
        own = found if tempering == STEPS[0] else find(tempering, found)
        inflation = tempering * own.first.inflation
        validation = CrossValidation(
            data, len(std), 1, own.first.std, inflation, np.full(len(columns), -1), own.rows, regimes
        )
        squares = (validation.extrapolated(columns) / std**2).sum(axis=1)
        error = float(np.log(np.maximum(squares, 1e-300)).mean())
        if best is None or error < best[0] - min_gain:
            best = error, own
    assert best is not None
    return best[1]
