"""Least squares by two neural networks: Widrow's adaptive linear neuron, and Hopfield and Tank's recurrent one.

Both come to rest at the minimum of ‖R⁻¹ (y - W x)‖²; what they add to it is that data are seen sample by sample, or
that parameters stay within stated bounds. Their noise of training is in the covariance.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from calib.errors import NotConverged
from calib.estimation.linear import LinearFit, wls
from calib.estimation.triangles import Triangles, combine, solve_triangle
from calib.identification.methods.least_squares import weighed
from calib.identification.methods.method import EstimateStatus, IdentificationProblem, Method, MethodEstimate, attempted
from calib.rooms.alternatives.estimators import samples_of
from calib.rooms.alternatives.samples import Samples

EPOCHS = 60  # at most


def adaline(
    data: Samples, triangles: Triangles, std: np.ndarray, inflation: np.ndarray | None = None, seed: int = 0
) -> tuple[LinearFit, int]:
    """Return the estimate of an adaptive linear neuron, trained in random order, and the number of epochs.

        w ← w + μ_k Z_kᵀ (y_k - Z_k w),    Z_k = R⁻¹ W_k T,    x = T w

    with T such that the inputs are uncorrelated and of unit power, and μ_k = 1 / (epoch² mean ‖Z‖²), at most
    1 / ‖Z_k‖²: LMS with Newton's direction (Widrow & Hoff 1960; Widrow & Stearns 1985, chapter 8). The estimate is the
    mean of the last epoch's weights (Polyak & Juditsky 1992); its distance from the minimum is added to the covariance.

    Args:
        data: samples.
        triangles: of the same rows, one group per row of a sample.
        std, inflation: (n,) of the rows, see `linear.wls`.

    Raises:
        NotConverged: with the last `LinearFit`.
    """
    fit, factor, p = wls(triangles, std, inflation), combine(triangles, std), triangles.parameters
    rows, size = np.where(data.present, 1.0 / std, 0.0), np.sqrt(data.present.sum())
    inverse = size * solve_triangle(factor, data.names)[1]
    inputs, target = (rows[:, :, None] * data.matrix) @ inverse, rows * data.target
    power = np.maximum(np.sum(inputs**2, axis=(1, 2)), 1e-300)
    rng, weights = np.random.default_rng(seed), np.zeros(p)
    max_away = 0.1  # standard deviations from the minimum, rms over parameters, at which training may end
    for epoch in range(1, EPOCHS + 1):
        mean, steps = np.zeros(p), np.minimum(1.0 / power, 1.0 / (epoch**2 * power.mean()))
        for k in rng.permutation(len(target)):
            own = inputs[k]
            weights = weights + steps[k] * ((target[k] - own @ weights) @ own)
            mean += weights
        values = inverse @ mean / len(target)
        away = float(np.sqrt(np.mean((factor[:p, :p] @ values - factor[:p, p]) ** 2)))
        trained = replace(fit.estimate, values=values)
        if away < max_away:
            excess = fit.estimate.covariance + (away / size) ** 2 * inverse @ inverse.T
            return replace(fit, estimate=replace(trained, covariance=excess)), epoch
    raise NotConverged(
        f"the neuron is {away:.2g} standard deviations from rest after {EPOCHS} epochs: few samples for so many "
        "parameters, or samples that do not fit",
        replace(fit, estimate=trained),
    )


def hopfield(
    triangles: Triangles, std: np.ndarray, inflation: np.ndarray | None = None, bound: np.ndarray | None = None
) -> tuple[LinearFit, int]:
    """Return the estimate of a Hopfield-Tank network of p neurons in equilibrium, and the number of steps.

        u̇ = -∂E/∂x = -(Wᵀ R⁻¹ W x - Wᵀ R⁻¹ y),    x_i = α_i tanh(u_i / α_i),    E = ½ ‖R^(-½) (y - W x)‖²

    (Tank & Hopfield 1986; Atencia, Joya & Sandoval 2004), E falling all the way. The equation is stiff by the square
    of the condition number; it is integrated by the linearly implicit Euler form with steps that grow as E settles, in
    units in which the columns have unit norm.

    Args:
        triangles: of the rows, one group per standard deviation.
        std, inflation: (g,), see `linear.wls`.
        bound: α (p,), what no parameter exceeds; None: `box` times what one column needs to explain all torques.

    Raises:
        NotConverged: where a neuron saturates, so that x is a bound and no estimate, or after `max_steps`.
    """
    fit = wls(triangles, std, inflation)
    factor = combine(triangles, std)
    p = triangles.parameters
    norms = np.linalg.norm(factor[:p, :p], axis=0)
    upper, target = factor[:p, :p] / norms, factor[:p, p]
    box = 30.0  # times the parameter that explains all torques by one column: no estimate is near it
    reach = np.full(p, box * np.linalg.norm(target)) if bound is None else np.asarray(bound, dtype=float) * norms
    inner, step = np.zeros(p), 1.0
    max_rest = 1e-3  # standard deviations from the equilibrium
    max_steps = 200
    for count in range(1, max_steps + 1):
        outer = reach * np.tanh(inner / reach)
        rest = upper @ outer - target
        if np.linalg.norm(rest) < max_rest:
            return replace(fit, estimate=replace(fit.estimate, values=outer / norms)), count
        while True:
            gain = 1.0 - (outer / reach) ** 2
            moved = inner - np.linalg.solve(np.eye(p) / step + (upper.T @ upper) * gain, upper.T @ rest)
            energy = np.linalg.norm(upper @ (reach * np.tanh(moved / reach)) - target)
            if energy < np.linalg.norm(rest) or step < 1e-12:
                break
            step *= 0.25
        if step < 1e-12:
            break
        inner, step = moved, 4.0 * step
    saturation = 0.9  # of the box
    saturated = [name for name, x, most in zip(triangles.names, outer, reach) if abs(x) > saturation * most]
    cause = f"neurons saturate: {', '.join(saturated[:5])}; widen their bounds" if saturated else "it has not settled"
    raise NotConverged(f"the network after {count} steps: {cause}", outer / norms)


Train = Callable[[IdentificationProblem, np.ndarray, np.ndarray], tuple[LinearFit, int]]


@dataclass(frozen=True)
class _Network(Method):
    """Identification by a neural network that converges to weighted least squares.

    Attributes:
        train: the problem, (rows,) standard deviations and inflation to the fit, and the number of rounds.
    """

    train: Train

    def estimate(self, problem: IdentificationProblem) -> MethodEstimate:
        """Return the estimate of the trained network; its covariance includes the noise of training."""
        return attempted(self.name, problem, lambda: self._estimate(problem))

    def _estimate(self, problem: IdentificationProblem) -> MethodEstimate:
        std, tau = weighed(problem)
        fit, rounds = self.train(problem, std, tau)
        return MethodEstimate(self.name, EstimateStatus.FOUND, fit, problem.pooled, std, tau, iterations=rounds)


_LIKE_WLS = "torque noise of each joint from its residuals; q, v and a exact"
ADALINE = _Network(
    "adaline", f"{_LIKE_WLS}; samples in random order",
    lambda problem, std, tau: adaline(samples_of(problem), problem.pooled, std, tau),
    description="adaptive linear neuron, trained sample by sample",
    source="Widrow & Hoff 1960; Widrow & Stearns 1985", tunes=("decay of the learning rate", "60 epochs"),
)  # fmt: skip
HOPFIELD = _Network(
    "hopfield", f"{_LIKE_WLS}; no parameter is near the bound of its neuron",
    lambda problem, std, tau: hopfield(problem.pooled, std, tau),
    description="Hopfield-Tank network at rest", source="Tank & Hopfield 1986; Atencia, Joya & Sandoval 2004",
    tunes=("bounds of its neurons", "200 steps"),
)  # fmt: skip
