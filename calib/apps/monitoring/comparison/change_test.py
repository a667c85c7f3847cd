"""Test of whether two estimates of a robot's parameters differ, in the combinations that data can show.

With δ the difference of the combinations and Σ the sum of both covariances, V what each of p parameters does to them,

    χ² = δᵀ Σ⁻¹ δ

has as many degrees of freedom as combinations were estimated. If parameter k alone changed, by the size x, then
δ = x v_k with v_k the column of V: x = v_kᵀ Σ⁻¹ δ / v_kᵀ Σ⁻¹ v_k, σ² = 1 / v_kᵀ Σ⁻¹ v_k, and χ² falls by (x/σ)² (Baarda
1968, data snooping); for several parameters together, by what their columns explain. The difference is tested as a
whole, and for the parameter that explains most. A combination that only one of two estimates has is taken out by
conditioning: that one is as if it had kept it at the value that the other has.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.stats import chi2, norm

from calib.toolkit.result_folders import limit

SPAN = 1e-5  # sine of an angle below which two combinations are one
CHANCE = 0.01  # probability below which a χ² is no chance, as 2.6 σ
AS_WELL = 4.0  # χ² by which a second explanation may be worse: 2 σ


class ParameterChange(NamedTuple):
    """Change of one parameter.

    Attributes:
        name, unit: of the parameter.
        before, after: its values; one that was not fitted has its nominal value.
        sigma: of the difference, from both covariances; 0 where it was fitted in neither.
        alone, alone_sigma: its change if nothing else had changed; NaN where no data show it.
        explained: by how much that lowers χ².
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
    """The test's result.

    Attributes:
        chi2, freedom: of the test that nothing changed, and its degrees of freedom.
        parameters: the one that explains most first.
        extra: how many combinations only the earlier, and only the later one estimated.
    """

    chi2: float
    freedom: int
    parameters: tuple[ParameterChange, ...]
    extra: tuple[int, int]

    @property
    def probability(self) -> float:
        """Of so large a χ², or of one parameter that explains so much of it, where nothing changed (Bonferroni).

        1 where nothing was estimated that could have changed.
        """
        if self.freedom == 0:
            return 1.0
        explained = [parameter.explained for parameter in self.parameters if parameter.explained]
        single = max(len(explained), 1) * chi2.sf(max(explained, default=0.0), 1)
        return min(2.0 * float(min(chi2.sf(self.chi2, self.freedom), single)), 1.0)

    @property
    def sigmas(self) -> float:
        """The deviation of a single normal variable that is as unlikely, at most 37."""
        return float(norm.isf(max(self.probability, 1e-300) / 2.0))

    @property
    def changed(self) -> bool:
        """Whether the test says that something changed."""
        return self.sigmas > limit("arm-changed", "sigmas", "marginal")

    @property
    def unexplained(self) -> float:
        """χ² that is left where only the first parameter changed."""
        return max(self.chi2 - self.parameters[0].explained, 0.0) if self.parameters else self.chi2

    @property
    def alone(self) -> bool:
        """Whether the change of the first parameter alone explains the whole difference."""
        return self.suffices(self.chi2 - self.unexplained, 1)

    @property
    def rivals(self) -> tuple[str, ...]:
        """The parameters whose change explains the difference about as well as that of the first one."""
        best = self.parameters[0].explained
        return tuple(parameter.name for parameter in self.parameters[1:] if parameter.explained > best - AS_WELL)

    def suffices(self, explained: float, count: int) -> bool:
        """Return whether what `count` parameters explain of χ² leaves no more than chance."""
        return bool(chi2.sf(max(self.chi2 - explained, 0.0), max(self.freedom - count, 1)) > CHANCE)


@dataclass(frozen=True, eq=False)
class Tested:
    """What is tested, whitened by its covariance: the difference (k,) and what p parameters do to it (k, p).

    Attributes:
        extra: see `ChangeTest`.
    """

    difference: np.ndarray
    columns: np.ndarray
    extra: tuple[int, int]

    @property
    def chi2(self) -> float:
        return float(self.difference @ self.difference)

    def alone(self, k: int, identifiable: bool = True) -> tuple[float, float, float]:
        """Return change, σ and explained χ² of parameter k if it changed alone; NaN, NaN, 0 if not `identifiable`."""
        size = float(np.linalg.norm(self.columns[:, k]))
        if not identifiable or not size:
            return np.nan, np.nan, 0.0
        along = float(self.columns[:, k] @ self.difference)
        return along / size**2, 1.0 / size, (along / size) ** 2

    def together(self, chosen: np.ndarray) -> tuple[np.ndarray, float, int]:
        """Return the steps (p,) of several parameters that explain most, the χ² that they explain, and their number."""
        columns, steps = self.columns[:, chosen], np.zeros(self.columns.shape[1])
        size = np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
        scaled_steps, _, rank, _ = np.linalg.lstsq(columns / size, self.difference, rcond=SPAN)
        steps[chosen] = scaled_steps / size
        return steps, float(np.sum((columns / size @ scaled_steps) ** 2)), int(rank)


def tested(
    change: np.ndarray, covariances: list[np.ndarray], spans: list[np.ndarray], columns: np.ndarray
) -> tuple[Tested, np.ndarray]:
    """Return what can be tested of two estimates, and the columns (k, p) before they are whitened.

    Args:
        change: (s,) later minus earlier, of combinations of a size near 1.
        covariances: (s, s) of either.
        spans: (s, any) orthonormal columns: what either has estimated.
        columns: (s, p) what each parameter does to the combinations.
    """
    extra = [np.zeros((len(change), 0))] * 2
    fitted = [basis for basis in spans if basis.shape[1]]
    if len(fitted) == 2:
        extra = [span(basis_ - other_basis @ (other_basis.T @ basis_)) for basis_, other_basis in (spans, spans[::-1])]
        for index, surplus in enumerate(extra):
            gain = np.linalg.lstsq(surplus.T @ covariances[index] @ surplus, surplus.T @ covariances[index])[0].T
            change = change - gain @ (surplus.T @ change)
            covariances[index] = covariances[index] - gain @ surplus.T @ covariances[index]
    nothing = np.zeros((len(change), 0))
    together, surplus = span(np.hstack([nothing, *fitted])), np.hstack(extra)
    common = span(together - surplus @ (surplus.T @ together))
    values, vectors = np.linalg.eigh(common.T @ np.add(*covariances) @ common)
    whiten = (vectors / np.sqrt(np.maximum(values, 1e-14 * values.max(initial=0.0)))).T @ common.T
    counts = extra[0].shape[1], extra[1].shape[1]
    return Tested(whiten @ change, whiten @ columns, counts), common.T @ columns


def span(columns: np.ndarray) -> np.ndarray:
    """Return an orthonormal basis (k, r) of the space of columns (k, any), each of a size near 1 or none."""
    basis, size, _ = np.linalg.svd(columns, full_matrices=False)
    return basis[:, size > SPAN]
