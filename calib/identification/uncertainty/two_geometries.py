"""One identification on two geometries, the nominal and the calibrated one, from the same torques."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.arrays import frozen
from calib.identification.cases import Case
from calib.identification.identify import Identification
from calib.identification.reweighted import cut, estimate, estimator, rows_on, stacked, weights
from calib.identification.uncertainty.geometry_uncertainty import GeometryUncertainty
from calib.robot.chain import Chain


@dataclass(frozen=True, eq=False)
class GeometryComparison:
    """Two estimates from the same torques, on two geometries.

    Attributes:
        names, units: of the p parameters.
        values: (2, p) on the nominal (CAD) and on the calibrated geometry.
        sigma: (2, p) of each: of torque noise alone on the nominal, total on the calibrated one.
        difference: (p,) standard deviation of the difference: the geometry's part, and what little of the torque noise
            the two do not share.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    values: np.ndarray
    sigma: np.ndarray
    difference: np.ndarray

    @property
    def relative(self) -> np.ndarray:
        """(p,) 100 (nominal - calibrated) / |calibrated| [%]; NaN at zero."""
        with np.errstate(divide="ignore", invalid="ignore"):
            found = 100.0 * (self.values[0] - self.values[1]) / np.abs(self.values[1])
        return np.where(self.values[1] == 0.0, np.nan, found)


def compare(
    found: Identification, carried: GeometryUncertainty, nominal: Chain, cases: Sequence[Case]
) -> GeometryComparison:
    """Estimate the same columns from the same torques on the nominal geometry, and say how far apart the two are.

    Both by weighted least squares with the same weights; the difference is added to the estimate that there is.
    """
    how, noise = estimator(found), np.array(found.fitted.std) * np.sqrt(found.fitted.inflation)
    both = (rows_on(found, nominal, cases), found.rows)
    (first, inverse), (second, own) = (estimate(how, rows) for rows in both)
    values = np.asarray(found.fitted.estimate.values)
    alone, apart = np.zeros(len(values)), np.array(carried.sigma_geometry**2)
    chunk = 2000  # thinned samples at a time, where each needs its own line of a matrix
    for one, other in zip(*both):
        for start in range(0, len(one.target), chunk):
            part = slice(start, start + chunk)
            gain, ours = (
                matrix @ (stacked(cut(rows, part)) * weights(how, cut(rows, part), how.deviation**2)[:, None]).T
                for matrix, rows in ((inverse, one), (own, other))
            )
            spread_of = np.tile(noise, len(one.target[part]))
            alone += np.sum((gain * spread_of) ** 2, axis=1)
            apart += np.sum(((gain - ours) * spread_of) ** 2, axis=1)
    return GeometryComparison(
        found.names, found.fitted.estimate.units, frozen(np.stack([values + first - second, values])),
        frozen(np.stack([np.sqrt(alone), carried.sigma])), frozen(np.sqrt(apart)),
    )  # fmt: skip
