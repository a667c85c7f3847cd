"""Result of an estimation: parameter values with their covariance."""

from dataclasses import dataclass

import numpy as np

from calib.records import Frozen


@dataclass(frozen=True, eq=False)
class Estimate(Frozen):
    """Estimates of p parameters with their covariance.

    Attributes:
        names, units: p strings each.
        values: (p,) values, in `units`.
        covariance: (p, p) covariance of the values.
        residual_std: standard deviation of the residuals divided by their stated sigmas; 1 if these sigmas are correct.
        dof: degrees of freedom, number of rows minus number of parameters.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    values: np.ndarray
    covariance: np.ndarray
    residual_std: float
    dof: int

    @property
    def sigma(self) -> np.ndarray:
        """Standard deviations of the values (p,), in `units`."""
        return np.sqrt(np.clip(np.diag(self.covariance), 0.0, None))

    @property
    def rsd(self) -> np.ndarray:
        """Relative standard deviations (p,), 100 σ / |value| [%]; infinite for a value of zero."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(self.values == 0.0, np.inf, 100.0 * self.sigma / np.abs(self.values))

    def strong_correlations(self, threshold: float = 0.95) -> list[tuple[str, str, float]]:
        """Return the pairs of parameters with |correlation| above `threshold`, strongest first."""
        sigma = np.where(self.sigma > 0, self.sigma, 1.0)
        correlation = self.covariance / np.outer(sigma, sigma)
        rows, columns = np.triu_indices(len(sigma), 1)
        strong = np.abs(correlation[rows, columns]) > threshold
        pairs = []
        for i, j in zip(rows[strong], columns[strong]):
            pair = (self.names[i], self.names[j], float(correlation[i, j]))
            pairs.append(pair)
        return sorted(pairs, key=lambda pair: -abs(pair[2]))


def whitened(values: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Return [R z] (p, p + 1) with RᵀR = Σ⁻¹ and z = R x, for values x (p,) with covariance Σ (p, p).

    Then ‖R b - z‖² is the squared Mahalanobis distance of b from x. Variances of zero are replaced by 1.
    """
    sigma = np.sqrt(np.clip(np.diag(covariance), 0.0, None))
    sigma = np.where(sigma > 0.0, sigma, 1.0)
    correlation = covariance / np.outer(sigma, sigma)
    size, axes = np.linalg.eigh(correlation)
    # rounding may leave an eigenvalue negative
    size = np.maximum(size, 1e-13 * size[-1])
    root = (axes / np.sqrt(size)).T / sigma
    return np.column_stack([root, root @ values])
