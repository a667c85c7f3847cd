"""Least squares by two neural networks of the survey: an adaptive linear neuron, and a Hopfield-Tank network.

Both approach the minimum of ‖y - W x‖² (ordinary least squares) by unscaled gradients for a set number of steps. If W
is ill-conditioned they do not reach it: slowly converging directions remain near the start. Both begin with the
problem's start values, or with zero without any. Their difference from ordinary least squares, d = x - x_ols, is the
training error. The covariance is that of x_ols plus d dᵀ (an efficient estimate is uncorrelated with the difference of
another estimate from it: Hausman 1978).
"""

from dataclasses import dataclass, field, replace

import numpy as np

from calib.errors import NotConverged, require
from calib.estimation.linear import LinearFit, ols
from calib.estimation.triangles import combine
from calib.identification.methods.estimators import samples_of
from calib.identification.methods.least_squares import weighed
from calib.identification.methods.method import EstimateStatus, IdentificationProblem, Method, MethodEstimate, attempted
from calib.identification.methods.samples import Samples

# of either network, as the survey's
STEPS = 10_000


def adaline(data: Samples, start: np.ndarray, rate: float = 1.0, steps: int = STEPS, seed: int = 0) -> np.ndarray:
    """Return the weights x (p,) of an adaptive linear neuron after `steps` samples in random order.

        x ← x + η (rᵀ r) / ‖W_k r‖² r,    r = W_kᵀ (y_k - W_k x)

    These are stochastic gradients with a line search for each sample (Widrow & Hoff 1960; Leboutet et al. 2021). The
    last samples have most influence, and the weights keep changing with the noise.

    Args:
        data: N samples.
        start: (p,) first weights.
        rate: η; 1 minimises a sample's residual along its gradient.
        steps: number of samples used; each is used once before any is used again.
        seed: seed of the random order.
    """
    matrix = np.where(data.present[:, :, None], data.matrix, 0.0)
    target = np.where(data.present, data.target, 0.0)
    rng = np.random.default_rng(seed)
    x = np.array(start, dtype=float)
    rounds = -(-steps // len(target))
    # of a rate that diverges
    with np.errstate(over="ignore", invalid="ignore"):
        for k in np.concatenate([rng.permutation(len(target)) for _ in range(rounds)])[:steps]:
            slope = (target[k] - matrix[k] @ x) @ matrix[k]
            change = matrix[k] @ slope
            size = change @ change
            if size:
                x += rate * (slope @ slope) / size * slope
    return x


def hopfield(
    factor: np.ndarray, start: np.ndarray, bound: float, rate: float = 1.0, steps: int = STEPS
) -> tuple[np.ndarray, int]:
    """Return the outputs x (p,) of a Hopfield-Tank network, and the number of steps until it is at rest.

        u̇ = -Wᵀ W x + Wᵀ y,    x = α tanh(u / 5)

    by Euler steps, with W (r, p) the observation matrix and y (r,) the torques (Tank & Hopfield 1986; Atencia, Joya &
    Sandoval 2004; Leboutet et al. 2021). At rest x is the ordinary least-squares estimate, if no neuron is saturated.
    The survey tunes the step for each robot, 3e-8 to 1e-6; here it is half of the largest stable step, times `rate`
    (our choice).

    Args:
        factor: (p + 1, p + 1) upper triangle [R z; 0 ρ] of [W y], not weighted.
        start: (p,) first x.
        bound: α, larger than all |x|.
        rate: factor of the step.
        steps: largest number of steps.

    Raises:
        NotConverged: if a neuron is saturated; x is then at the bound and no estimate.
    """
    p = len(start)
    weights = factor[:p, :p].T @ factor[:p, :p]
    bias = factor[:p, :p].T @ factor[:p, p]
    # of the sigmoid, as the survey's
    width = 5.0
    largest = np.linalg.norm(factor[:p, :p], 2)
    step = rate * width / bound / largest**2
    u = width * np.arctanh(np.asarray(start) / bound)
    x = np.asarray(start, dtype=float)
    count = 0
    # of the first slope
    max_rest = 1e-9
    slope = first = bias - weights @ x
    while np.linalg.norm(slope) > max_rest * np.linalg.norm(first) and count < steps:
        u += step * slope
        x = bound * np.tanh(u / width)
        slope = bias - weights @ x
        count = count + 1
    # of α
    saturation = 0.95
    full = np.flatnonzero(np.abs(x) > saturation * bound)
    numbers = ", ".join(str(k + 1) for k in full[:5])
    require(not len(full), f"neurons saturate at {bound:.3g}: parameters {numbers}", NotConverged)
    return x, count


@dataclass(frozen=True)
class _Network(Method):
    """Identification by a network that is trained towards ordinary least squares.

    Attributes:
        rate: factor of the step: of the survey's step (adaline), or of half the largest stable one (hopfield).
        steps: largest number of steps.
    """

    tunes: tuple[str, ...] = field(default=("learning rate", f"{STEPS:,} steps"), kw_only=True)
    version: int = field(default=2, kw_only=True)
    takes_start: bool = field(default=True, kw_only=True)
    rate: float = 1.0
    steps: int = STEPS

    def estimate(self, problem: IdentificationProblem) -> MethodEstimate:
        """Return the estimate of the trained network; its covariance includes the training error.

        Args:
            problem: data and settings.
        """
        return attempted(self.name, problem, lambda: self._estimate(problem))

    def _estimate(self, problem: IdentificationProblem) -> MethodEstimate:
        pooled = problem.pooled
        std, tau = weighed(problem)
        fit = ols(pooled, tau)
        if problem.start is None:
            start = np.zeros(pooled.parameters)
        else:
            start = problem.start
        values, count = self.trained(problem, start)
        require(
            np.isfinite(values).all(), f"the network diverges: take a smaller rate than {self.rate:g}", NotConverged
        )
        trained_fit = _off(fit, values, np.sqrt(pooled.residual_squares(values) / pooled.rows))
        return MethodEstimate(
            self.name, EstimateStatus.FOUND, trained_fit, pooled, std, tau, False, iterations=count, alone=True
        )

    def trained(self, problem: IdentificationProblem, start: np.ndarray) -> tuple[np.ndarray, int]:
        """Return the network's weights (p,) after training from start values (p,), and the number of steps.

        Args:
            problem: data and settings.
            start: (p,) first weights.
        """
        raise NotImplementedError


class _Adaline(_Network):
    def trained(self, problem: IdentificationProblem, start: np.ndarray) -> tuple[np.ndarray, int]:
        return adaline(samples_of(problem), start, self.rate, self.steps), self.steps


class _Hopfield(_Network):
    def trained(self, problem: IdentificationProblem, start: np.ndarray) -> tuple[np.ndarray, int]:
        factor = combine(problem.pooled)
        largest = float(np.abs(start).max())
        # without start values: what the weakest column needs to explain all torques
        if not largest:
            target_norm = np.linalg.norm(factor[:-1, -1])
            column_norms = np.linalg.norm(factor[:-1, :-1], axis=0)
            needed = target_norm / column_norms
            largest = float(needed.max())
        return hopfield(factor, start, 1.5 * largest, self.rate, self.steps)


def _off(fit: LinearFit, values: np.ndarray, group_std: np.ndarray) -> LinearFit:
    """Return a fit with other values (p,), with the outer product of their differences added to its covariance.

    Args:
        fit: the fit of ordinary least squares.
        values: (p,) other values.
        group_std: standard deviations of their residuals, by torque row.
    """
    away = values - fit.estimate.values
    covariance = fit.estimate.covariance + np.outer(away, away)
    estimate = replace(fit.estimate, values=values, covariance=covariance)
    return replace(fit, estimate=estimate, group_std=group_std)


_LIKE_OLS = "the torques of all joints are equally noisy; q, v and a exact; enough steps"
ADALINE = _Adaline(
    "adaline",
    f"{_LIKE_OLS}; samples in random order",
    description="adaptive linear neuron: stochastic gradients",
    source="Widrow & Hoff 1960; Leboutet et al. 2021",
)
HOPFIELD = _Hopfield(
    "hopfield",
    f"{_LIKE_OLS}; no parameter is above 1.5 times the largest start value",
    description="Hopfield-Tank network, Euler steps",
    source="Tank & Hopfield 1986; Atencia, Joya & Sandoval 2004",
)
