"""Recursive estimate of parameters of which some drift: a bank of square-root information filters.

The state is the R factor [R z; 0 ρ] of all rows absorbed so far, those of the prior included. Rows are absorbed by one
QR, so that an estimate in pieces equals that of all rows at once, and memory does not grow (Bierman 1977, ch. IV).
Drifting parameters walk at random, d(t + Δ) = d(t) + w with w ~ N(0, r² s² Δ), where s is a parameter's size and r the
rate of its group. Eliminating d(t) is another QR (Bierman 1977, ch. VI).

Rates are not chosen: one filter runs for each combination of `RATES`, weighted by the likelihood of all rows (Magill
1965), and mean and covariance are those of the mixture. The common factor of all variances is estimated, too, as the
inverse gamma law that is conjugate to the rows:

    p(rows | rates) ∝ Π det R_before / det R_after · (ν₀ + ρ²)^(-(ν₀ + N)/2),

with N whitened rows and ν₀ rows that the stated noise counts as.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import numpy as np
import scipy.linalg

from calib.errors import require
from calib.estimation.estimate import whitened
from calib.estimation.triangles import continued, retriangulate
from calib.records import frozen, shaped

RATES = (0.0, 1e-3, 3e-3, 1e-2, 3e-2, 0.1, 0.3)
"""Random walk rates that are compared, in sizes of the parameter per square root of a day (our choice)."""
NEGLIGIBLE = 1e-5
"""Probability of a filter below which its part in mean and covariance is not computed."""
STILL = -1
"""Group of the parameters that do not drift."""
ROUNDING = 1e-12
"""Rounding of a sum of probabilities."""


@dataclass(frozen=True, eq=False)
class DriftBank:
    """Information filters of p parameters, one for each of h combinations of the groups' drift rates.

    Attributes:
        group: (p,) drift group of each parameter, 0 … g - 1; `STILL` for those that do not drift.
        size: (p,) sizes of the parameters, in whose units rates are.
        rates: (h, g) rates of each filter [1/√day].
        factors: (h, p + 1, p + 1) R factors [R z; 0 ρ] of prior and rows.
        log_ratio: (h,) Σ log det R_before - log det R_after.
        count: N, number of independent rows absorbed.
        prior_count: ν₀, number of rows that the stated noise counts as.
    """

    group: np.ndarray
    size: np.ndarray
    rates: np.ndarray
    factors: np.ndarray
    log_ratio: np.ndarray
    count: float
    prior_count: float

    @property
    def parameters(self) -> int:
        """Number p of the parameters."""
        return len(self.group)

    @property
    def variance_factors(self) -> np.ndarray:
        """Estimated factors (h,) of all variances, one for each filter, at least 1.

        Smaller ones would lower the variance of parameters of which the rows say nothing.
        """
        squares = self.factors[:, -1, -1] ** 2
        factors = (self.prior_count + squares) / (self.prior_count + self.count)
        return np.maximum(factors, 1.0)

    @property
    def weights(self) -> np.ndarray:
        """Probabilities (h,) of the filters, by the likelihood of all rows."""
        squares = self.factors[:, -1, -1] ** 2
        degrees = self.prior_count + self.count
        log_likelihood = self.log_ratio - 0.5 * degrees * np.log(self.prior_count + squares)
        likelihood = np.exp(log_likelihood - log_likelihood.max())
        return likelihood / likelihood.sum()

    def posterior(self) -> tuple[np.ndarray, np.ndarray]:
        """Return mean (p,) and covariance (p, p) of the parameters, over all filters."""
        return self._posterior

    @cached_property
    def _posterior(self) -> tuple[np.ndarray, np.ndarray]:
        weights = self.weights
        weights = np.where(weights > NEGLIGIBLE, weights, 0.0)
        weights = weights / weights.sum()
        means = np.zeros((len(weights), self.parameters))
        covariance = np.zeros((self.parameters, self.parameters))
        for k in np.flatnonzero(weights):
            factor = self.factors[k]
            inverse = scipy.linalg.solve_triangular(factor[:-1, :-1], np.eye(self.parameters))
            means[k] = inverse @ factor[:-1, -1]
            covariance += weights[k] * self.variance_factors[k] * (inverse @ inverse.T)
        mean = weights @ means
        deviations = means - mean
        covariance += (deviations * weights[:, None]).T @ deviations
        return frozen(mean), frozen(covariance)

    def rate_quantiles(self, group: int, levels: tuple[float, ...] = (0.025, 0.5, 0.975)) -> tuple[float, ...]:
        """Return quantiles of the drift rate of a group [1/√day], by the filters' probabilities."""
        order = np.argsort(self.rates[:, group], kind="stable")
        cumulated = np.cumsum(self.weights[order])
        index = np.searchsorted(cumulated, np.array(levels) - ROUNDING)
        rates = self.rates[order, group]
        return tuple(float(rates[min(k, len(rates) - 1)]) for k in index)

    def later(self, days: float) -> DriftBank:
        """Return the filters after `days` without rows, in which parameters have drifted."""
        factors = np.array(self.factors)
        for k, rates in enumerate(self.rates):
            rate = np.append(rates, 0.0)[self.group]
            deviations = rate * self.size * np.sqrt(max(days, 0.0))
            factors[k] = widened(self.factors[k], deviations)
        return replace(self, factors=frozen(factors))

    def absorb(self, rows: np.ndarray, count: float) -> DriftBank:
        """Return the filters with further rows.

        Args:
            rows: (N, p + 1) whitened rows [W y], or their R factor.
            count: number of independent rows among them.
        """
        rows = shaped(rows, (None, self.parameters + 1), "rows [W y]")
        triangle = rows
        if len(rows) > self.parameters + 1:
            triangle = retriangulate(rows)
        factors = np.empty_like(self.factors)
        log_ratio = np.array(self.log_ratio)
        for k, factor in enumerate(self.factors):
            factors[k] = continued(factor, np.array(triangle))
            log_ratio[k] += _log_determinant(factor) - _log_determinant(factors[k])
        return replace(self, factors=frozen(factors), log_ratio=frozen(log_ratio), count=self.count + count)

    def freed(self, deviations: np.ndarray) -> DriftBank:
        """Return the filters after a step of the parameters, normally distributed with `deviations` (p,)."""
        factors = np.stack([widened(factor, deviations) for factor in self.factors])
        return replace(self, factors=frozen(factors))


def start(
    values: np.ndarray,
    covariance: np.ndarray,
    group: np.ndarray,
    size: np.ndarray,
    prior_count: float,
    rates: tuple[float, ...] = RATES,
) -> DriftBank:
    """Return the filters that start from an estimate.

    Args:
        values, covariance: (p,), (p, p) the estimate, with positive variances.
        group: (p,) drift group of each parameter, `STILL` for those that do not drift.
        size: (p,) sizes of the parameters, in whose units rates are.
        prior_count: number of rows that the stated noise counts as.
        rates: rates of each group that are compared [1/√day].

    Raises:
        CalibError: for a variance that is not positive.
    """
    require(bool((np.diag(covariance) > 0.0).all()), "every parameter of a recursive estimate needs a variance")
    group = np.asarray(group, dtype=int)
    p = len(group)
    group_count = int(group.max(initial=STILL)) + 1
    listed = list(product(rates, repeat=group_count))
    combinations = np.array(listed, dtype=float).reshape(len(listed), group_count)
    factor = np.zeros((p + 1, p + 1))
    factor[:p] = retriangulate(whitened(values, covariance))[:p]
    factors = np.repeat(factor[None], len(combinations), axis=0)
    return DriftBank(
        group=frozen(group, int),
        size=frozen(size),
        rates=frozen(combinations),
        factors=frozen(factors),
        log_ratio=frozen(np.zeros(len(combinations))),
        count=0.0,
        prior_count=prior_count,
    )


def widened(factor: np.ndarray, deviations: np.ndarray) -> np.ndarray:
    """Return the R factor (p + 1, p + 1) of x + w with w ~ N(0, diag deviations²), from the R factor of x.

    The rows of w and x_old = x - w are triangulated with w in front, whose rows are then dropped (Bierman 1977,
    eq. VI.2.27).

    Args:
        factor: (p + 1, p + 1) R factor [R z; 0 ρ].
        deviations: (p,) standard deviations of w; zero where x does not change.
    """
    steps = np.flatnonzero(deviations > 0.0)
    count = len(steps)
    if not count:
        return factor
    size = len(factor)
    stacked = np.zeros((count + size, count + size))
    stacked[:count, :count] = np.diag(1.0 / deviations[steps])
    stacked[count:, :count] = -factor[:, steps]
    stacked[count:, count:] = factor
    return retriangulate(stacked)[count:, count:]


def _log_determinant(factor: np.ndarray) -> float:
    """Return log |det R| of an R factor [R z; 0 ρ]."""
    return float(np.sum(np.log(np.abs(np.diag(factor)[:-1]))))
