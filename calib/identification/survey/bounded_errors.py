"""Methods for errors of known size: generalised TLS (noise in the columns of W), set membership (bounded errors)."""

from dataclasses import dataclass, replace

import numpy as np

from calib.dynamics.idim import IdentificationModel
from calib.errors import Unidentifiable
from calib.estimation.linear import wls
from calib.estimation.triangles import combine
from calib.identification.methods.estimators import samples_of
from calib.identification.methods.least_squares import weighed
from calib.identification.methods.method import EstimateStatus, IdentificationProblem, Method, MethodEstimate, attempted
from calib.identification.survey.maximum_likelihood import NoisyStates, changed, noisy_states
from calib.identification.survey.score_covariance import scatter
from calib.identification.survey.simulated_robot import serial_arm


@dataclass(frozen=True)
class _GeneralisedTLS(Method):
    """Generalised total least squares (TLS): each row's errors have the covariance that follows from encoder noise."""

    def estimate(self, problem: IdentificationProblem) -> MethodEstimate:
        """Return x of Σ_k (W_kᵀ Ω⁻¹ W_k - C_k) x = Σ_k W_kᵀ Ω⁻¹ y_k.

        W_k and y_k are regressor and torques of sample k, Ω is the covariance of the torque noise. C_k = E[ΔW_kᵀ Ω⁻¹
        ΔW_k] = Σ_i D_kiᵀ G D_ki / σ_i², where D_ki are the derivatives of row i of W by q, v, a, and G is the
        covariance of their noise (`maximum_likelihood.noise_of_states`). x is the smallest generalised singular vector
        of [W y] for the torque noise of the residuals (Van Huffel & Vandewalle 1989; Fuller 1987, section 2.2). The
        covariance is that of theorem 2.2.1 there, with autocorrelated residuals. The method `ml` weights each sample by
        its own noise and is more accurate if that noise is large.

        Args:
            problem: data and settings.

        Raises:
            UsageError: for a model whose rows have no derivatives by q, v and a.
        """
        model = serial_arm(problem, self)
        return attempted(self.name, problem, lambda: self._estimate(problem, model))

    def _estimate(self, problem: IdentificationProblem, model: IdentificationModel) -> MethodEstimate:
        std, tau = weighed(problem)
        states = noisy_states(problem, model)
        plain = wls(problem.pooled, std)
        factor = combine(problem.pooled, std)
        p = problem.pooled.parameters
        norms = np.linalg.norm(factor[:p, :p], axis=0)
        upper = factor[:p, :p] / norms
        noise = column_noise(states, std) / np.outer(norms, norms)
        gram = upper.T @ upper - noise
        eigenvalues, vectors = np.linalg.eigh(gram)
        if eigenvalues[0] <= 0.0:
            concerned = np.argsort(-np.abs(vectors[:, 0]))[:5]
            raise Unidentifiable(
                "the noise of the encoders alone explains some combination of columns; filter, or excite more",
                [problem.pooled.names[k] for k in concerned],
                eigenvalues,
            )
        values = np.linalg.solve(gram, upper.T @ factor[:p, p])
        predicted_noise = noise @ values
        row_count = max(float(problem.pooled.rows.sum()), 1.0)
        meat = np.outer(predicted_noise, predicted_noise) / row_count
        for part in states.parts:
            in_use = states.present[part.own]
            scaled = states.matrix[part.own] / std[:, None]
            weighted = np.where(in_use[:, :, None], scaled, 0.0)
            white = weighted / norms
            residual = np.where(in_use, states.target[part.own] / std, 0.0) - white @ values
            meat += scatter(white, residual)
        bread = np.linalg.inv(gram) / norms[:, None]
        covariance = bread @ meat @ bread.T
        estimate = replace(plain.estimate, values=values / norms, covariance=covariance, residual_std=1.0)
        group = np.sqrt(problem.pooled.residual_squares(estimate.values) / problem.pooled.rows)
        fit = replace(plain, estimate=estimate, group_std=group)
        return MethodEstimate(self.name, EstimateStatus.FOUND, fit, problem.pooled, std, tau, alone=True)


def column_noise(states: NoisyStates, std: np.ndarray) -> np.ndarray:
    """Return C = Σ_k E[ΔW_kᵀ Ω⁻¹ ΔW_k] (p, p) due to the noise in q, v and a, where Ω = diag(std²), std (rows,).

    Args:
        states: all samples with noisy states; ΔW_k is the error of the regressor of sample k.
        std: (rows,) standard deviations of the torques' noise [N m or N].
    """
    p = states.matrix.shape[2]
    total = np.zeros((p, p))
    for part in states.parts:
        weights = np.where(states.present[part.own], 1.0 / std, 0.0)
        scale = weights[:, :, None]
        for joint, covariance in enumerate(part.noise):
            sizes, axes = np.linalg.eigh(covariance)
            # of one standard deviation
            for direction in (np.sqrt(np.maximum(sizes, 0.0)) * axes).T:
                error = np.zeros((len(part.q), 3, states.model.n))
                error[:, :, joint] = direction
                change = (scale * changed(states, part, error)).reshape(-1, p)
                total += change.T @ change
    return total


# in which rows are added (our choice): fewer leave the intervals wider, and never wrong
ROUNDS = 4


@dataclass(frozen=True)
class _SetMembership(Method):
    """Set membership: parameter intervals for which no torque error exceeds a bound; estimates are the centres."""

    def estimate(self, problem: IdentificationProblem) -> MethodEstimate:
        """Return the centres of the parameters' intervals over {x : |y - W x| <= e}; σ is half an interval over √3.

        The bound e of each joint is the largest residual of weighted least squares, so that its estimate is in the set
        (our choice; Milanese & Belforte 1982 assume a given e). If no torque error is larger, the intervals certainly
        contain the true values; they are wide: 20 to 130 σ of weighted least squares in white noise.

        Args:
            problem: data and settings.
        """
        return attempted(self.name, problem, lambda: self._estimate(problem))

    def _estimate(self, problem: IdentificationProblem) -> MethodEstimate:
        std, tau = weighed(problem)
        plain = wls(problem.pooled, std)
        data = samples_of(problem)
        predicted = data.matrix @ plain.estimate.values
        residual = np.where(data.present, data.target - predicted, 0.0)
        bound = np.maximum(np.abs(residual).max(axis=0), 1e-9 * std)
        rows = (data.matrix / bound[:, None])[data.present]
        ends = (residual / bound)[data.present]
        lower, upper, count = intervals(rows, ends)
        values = plain.estimate.values + 0.5 * (lower + upper)
        covariance = np.diag((upper - lower) ** 2 / 12.0)
        estimate = replace(plain.estimate, values=values, covariance=covariance, residual_std=1.0)
        group = np.sqrt(problem.pooled.residual_squares(values) / problem.pooled.rows)
        fit = replace(plain, estimate=estimate, group_std=group)
        return MethodEstimate(
            self.name, EstimateStatus.FOUND, fit, problem.pooled, std, tau, iterations=count, alone=True
        )


def intervals(rows: np.ndarray, ends: np.ndarray) -> tuple[np.ndarray, np.ndarray, int]:
    """Return the ends of every parameter's interval over {x : |y - A x| <= 1}, and the number of iterations.

    There are two linear programs per parameter, with rows that the optima of the last iteration violate. Rows that are
    not used make the intervals wider, but never exclude a possible value.

    Args:
        rows: A (r, p), in units of the bound.
        ends: y (r,) with |y| <= 1, so that x = 0 is in the set.

    Returns:
        lower ends (p,), upper ends (p,), and number of iterations.
    """
    from scipy.optimize import linprog

    count, p = rows.shape
    q, upper = np.linalg.qr(rows)
    # x = goals u, with |u| <= 2 √r wherever all rows are within the bound
    goals = np.linalg.inv(upper)
    size = np.tile(np.linalg.norm(goals, axis=1), 2)
    goals = np.vstack([goals, -goals]) / size[:, None]
    active = np.argsort(-np.abs(ends))[: 2 * p]
    ahead = np.arange(2 * p)
    optima = np.zeros((2 * p, p))
    # of u; of the bound, by which rounding may miss it
    reach = 2.0 * np.sqrt(count)
    max_violation = 1e-6
    rounds = 0
    bounds = [(-reach, reach)] * p
    while len(ahead) and rounds < ROUNDS:
        system = np.vstack([q[active], -q[active]])
        limit = np.concatenate([1.0 + ends[active], 1.0 - ends[active]])
        for k in ahead:
            program = linprog(goals[k], system, limit, bounds=bounds, method="highs-ds")
            optima[k] = program.x
        violated = np.abs(q @ optima[ahead].T - ends[:, None])
        violating = violated.max(axis=0) > 1.0 + max_violation
        active = np.union1d(active, np.argmax(violated[:, violating], axis=0))
        ahead = ahead[violating]
        rounds = rounds + 1
    inverse = np.linalg.inv(upper)
    best = np.einsum("kp,kp->k", np.tile(inverse, (2, 1)), optima)
    return best[:p], best[p:], rounds


GTLS = _GeneralisedTLS(
    "gtls",
    "positions have white noise (level from each log's spectrum), which enters W by its mean covariance; torques have "
    "that of the residuals, independent of it; signs are exact",
    description="generalised total least squares, noise of the columns from the encoders'",
    source="Van Huffel & Vandewalle 1989; Fuller 1987",
)
SET_MEMBERSHIP = _SetMembership(
    "set-membership",
    "no torque error is larger than the largest residual of wls; q, v and a are exact",
    description="centres of the parameter intervals that agree with a bound on the torque errors",
    source="Milanese & Belforte 1982; Ramdani & Poignet 2005",
    tunes=("bound of the errors", f"{ROUNDS} rounds of linear programs"),
)
