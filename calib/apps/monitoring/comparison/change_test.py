"""Test of whether two estimates of a robot's parameters differ, in combinations of parameters that data identify.

Let δ be the difference of the combinations between both estimates, Σ the sum of both covariances, and V the derivative
of the combinations by each of p parameters. Then

    χ² = δᵀ Σ⁻¹ δ

has as many degrees of freedom as combinations were estimated. If only parameter k changed, by x, then δ = x v_k with
v_k column k of V. Its least-squares estimate is x = v_kᵀ Σ⁻¹ δ / v_kᵀ Σ⁻¹ v_k with σ² = 1 / v_kᵀ Σ⁻¹ v_k, and it lowers
χ² by (x/σ)² (Baarda 1968, data snooping). Several parameters together lower χ² by the least-squares fit of their
columns. Two hypotheses are tested: that nothing changed, and that the parameter with the largest decrease of χ² did not
change. A combination that only one of the two estimates has is removed by conditioning: this estimate is treated as if
the combination had been fixed at the value of the other estimate.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import chdtrc, ndtri

from calib.toolkit.result_folders import limit

# sine of an angle below which two combinations are one
SPAN = 1e-5
# probability below which a χ² is no chance, as 2.6 σ
CHANCE = 0.01
# χ² by which a second explanation may be worse: 2 σ
AS_WELL = 4.0


class ParameterChange(NamedTuple):
    """Change of one parameter.

    Attributes:
        name, unit: name and unit of the parameter.
        before, after: values of the parameter; where it was not fitted, the nominal value.
        sigma: σ of the difference, from both covariances; 0 where neither estimate fitted the parameter.
        alone, alone_sigma: estimated change of the parameter if no other parameter changed, and its σ; NaN where the
            data do not identify it.
        explained: decrease, by that change, of the χ² statistic of the hypothesis that nothing changed.
    """

    name: str
    unit: str
    before: float
    after: float
    sigma: float
    alone: float
    alone_sigma: float
    explained: float


@dataclass(frozen=True)
class ChangeTest:
    """Result of the test for a change between two estimates.

    Attributes:
        chi2, freedom: χ² of the hypothesis that nothing changed, and its degrees of freedom.
        parameters: changes of the parameters, in descending order of the decrease of χ².
        extra: number of parameter combinations that only the earlier estimate has, and that only the later one has.
    """

    chi2: float
    freedom: int
    parameters: tuple[ParameterChange, ...]
    extra: tuple[int, int]

    @property
    def probability(self) -> float:
        """p value of the hypothesis that nothing changed.

        It is twice the smaller of two p values (Bonferroni). The first is that of the χ² statistic of the difference
        between both estimates, the second that of the largest decrease of χ² by a change of one parameter. 1 where no
        estimated combination of parameters could have changed.
        """
        if self.freedom == 0:
            return 1.0
        explained = [parameter.explained for parameter in self.parameters if parameter.explained]
        of_one = max(len(explained), 1) * chdtrc(1, max(explained, default=0.0))
        of_all = chdtrc(self.freedom, max(self.chi2, 0.0))
        # two tests, of which the less likely one counts
        return min(2.0 * float(min(of_all, of_one)), 1.0)

    @property
    def sigmas(self) -> float:
        """Significance of the change: the deviation, in σ, of a normal variable with the same p value, at most 37."""
        return -float(ndtri(max(self.probability, 1e-300) / 2.0))

    @property
    def changed(self) -> bool:
        """Whether the change is significant."""
        return self.sigmas > limit("arm-changed", "sigmas", "marginal")

    @property
    def unexplained(self) -> float:
        """The χ² statistic of the remaining difference if only the first of `parameters` changed."""
        if not self.parameters:
            return self.chi2
        return max(self.chi2 - self.parameters[0].explained, 0.0)

    @property
    def alone(self) -> bool:
        """Whether a change of the first of `parameters` alone explains the whole difference."""
        return self.suffices(self.chi2 - self.unexplained, 1)

    @property
    def rivals(self) -> tuple[str, ...]:
        """Names of further parameters whose change alone would explain the difference nearly as well as the first's.

        Their decrease of the χ² statistic is less than `AS_WELL` below that of the first of `parameters`.
        """
        best = self.parameters[0].explained
        return tuple(parameter.name for parameter in self.parameters[1:] if parameter.explained > best - AS_WELL)

    def suffices(self, explained: float, count: int) -> bool:
        """Return whether the remaining difference between both estimates may be chance.

        Args:
            explained: decrease of the χ² statistic by changes of some parameters.
            count: number of these parameters.
        """
        residual = max(self.chi2 - explained, 0.0)
        freedom = max(self.freedom - count, 1)
        return bool(chdtrc(freedom, residual) > CHANCE)


@dataclass(frozen=True, eq=False)
class Tested:
    """The tested combinations of parameters, whitened by their covariance.

    Attributes:
        difference: (k,) difference of the combinations between both estimates.
        columns: (k, p) derivative of the combinations by each of p parameters.
        extra: number of combinations that only the earlier estimate has, and that only the later one has.
    """

    difference: np.ndarray
    columns: np.ndarray
    extra: tuple[int, int]

    @property
    def chi2(self) -> float:
        return float(self.difference @ self.difference)

    def alone(self, k: int, identifiable: bool = True) -> tuple[float, float, float]:
        """Return change, σ and decrease of the χ² statistic of a parameter if only this parameter changed.

        Args:
            k: index (from 0) of the parameter among the p parameters.
            identifiable: whether the parameter is identifiable; if not, NaN, NaN and 0 are returned.
        """
        size = float(np.linalg.norm(self.columns[:, k]))
        if not identifiable or not size:
            return np.nan, np.nan, 0.0
        along = float(self.columns[:, k] @ self.difference)
        return along / size**2, 1.0 / size, (along / size) ** 2

    def together(self, chosen: np.ndarray) -> tuple[np.ndarray, float, int]:
        """Return the changes of several parameters that lower the χ² statistic most together.

        Args:
            chosen: indices of the parameters that may have changed; the change of all others is 0.

        Returns:
            The changes (p,), the decrease of χ², and the rank of the chosen parameters' derivatives.
        """
        columns = self.columns[:, chosen]
        size = np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
        unit_columns = columns / size
        scaled_steps, _, rank, _ = np.linalg.lstsq(unit_columns, self.difference, rcond=SPAN)
        explained = float(np.sum((unit_columns @ scaled_steps) ** 2))
        steps = np.zeros(self.columns.shape[1])
        steps[chosen] = scaled_steps / size
        return steps, explained, int(rank)


def tested(
    change: np.ndarray, covariances: list[np.ndarray], spans: list[np.ndarray], columns: np.ndarray
) -> tuple[Tested, np.ndarray]:
    """Return the combinations that can be compared between two estimates, and their derivatives before whitening.

    Args:
        change: (s,) later minus earlier values of combinations, each of a size near 1.
        covariances: (s, s) covariance of each estimate.
        spans: (s, any) orthonormal columns that span the combinations of each estimate.
        columns: (s, p) derivative of the combinations by each parameter.

    Returns:
        The k combinations, and their derivatives (k, p) by each parameter.
    """
    no_combination = np.zeros((len(change), 0))
    extra = [no_combination, no_combination]
    fitted = [basis for basis in spans if basis.shape[1]]
    if len(fitted) == 2:
        first, second = spans
        extra = [span(first - second @ (second.T @ first)), span(second - first @ (first.T @ second))]
        # A combination of only one estimate is conditioned on the value that the other one has.
        for index, surplus in enumerate(extra):
            covariance = covariances[index]
            gain = np.linalg.lstsq(surplus.T @ covariance @ surplus, surplus.T @ covariance)[0].T
            change = change - gain @ (surplus.T @ change)
            covariances[index] = covariance - gain @ surplus.T @ covariance
    together = span(np.hstack([no_combination, *fitted]))
    surplus = np.hstack(extra)
    common = span(together - surplus @ (surplus.T @ together))
    values, vectors = np.linalg.eigh(common.T @ np.add(*covariances) @ common)
    scales = np.sqrt(np.maximum(values, 1e-14 * values.max(initial=0.0)))
    whiten = (vectors / scales).T @ common.T
    counts = extra[0].shape[1], extra[1].shape[1]
    return Tested(whiten @ change, whiten @ columns, counts), common.T @ columns


def span(columns: np.ndarray) -> np.ndarray:
    """Return an orthonormal basis (k, r) of the column space of a matrix of rank r.

    Args:
        columns: the matrix (k, any), with columns of norm near 1 or zero.
    """
    basis, size, _ = np.linalg.svd(columns, full_matrices=False)
    return basis[:, size > SPAN]
