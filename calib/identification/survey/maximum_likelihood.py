"""Maximum likelihood with noisy positions (errors in variables): each sample is weighted by its propagated noise.

The residual of a sample, r_k = y_k - W(x_k) β with x = (q, v, a) as measured, has to first order the covariance

    S_k(β) = Σ_τ + B_k G B_kᵀ,    B_k = ∂(W β)/∂x at sample k,

where G is the covariance of the filtered q, v, a of a joint. G follows from the level σ_q of the white position noise
and the impulse responses of low-pass, differences and decimation. The true states are nuisance parameters. After their
elimination, minus twice the logarithm of the likelihood is Σ_k r_kᵀ S_k(β)⁻¹ r_k, whose gradient by β vanishes for

    Σ_k W(x̂_k)ᵀ S_k⁻¹ (y_k - W(x_k) β) = 0,    x̂_k = x_k + G B_kᵀ S_k⁻¹ r_k    (Fuller 1987, section 3.2),

where x̂ are the states as corrected by the fit. (Weighted least squares uses W(x_k) instead, and so underestimates
parameters of noisy columns.) The method is that of Leboutet et al. 2021, section 4.2, after Olsen, Swevers & Verdonck
2002, who assume known noise. Here σ_q is estimated from each log's spectrum, and the diagonal Σ_τ from Σ S_k⁻¹ r_k r_kᵀ
S_k⁻¹ = Σ S_k⁻¹ on the diagonal, which is its likelihood equation.
"""

from dataclasses import dataclass, replace

import numpy as np

from calib.data.signals.filtering import Decimator, curvature, kept, low_pass, slope
from calib.data.signals.motion import Motion
from calib.dynamics.idim import IdentificationModel
from calib.dynamics.torque_rows import TorqueRows
from calib.errors import Diverged, NotConverged
from calib.estimation.linear import LinearFit, wls
from calib.estimation.triangles import condition_numbers
from calib.identification.methods.estimators import samples_of
from calib.identification.methods.least_squares import weighed
from calib.identification.methods.method import EstimateStatus, IdentificationProblem, Method, MethodEstimate, attempted
from calib.identification.prior import residual_inflation
from calib.identification.survey.score_covariance import scatter
from calib.identification.survey.simulated_robot import serial_arm, with_friction

# samples at a time
BLOCK = 1000


@dataclass(frozen=True)
class _MaximumLikelihood(Method):
    """Identification by maximum likelihood with errors in variables."""

    def takes(self, rows: TorqueRows) -> bool:
        """Return whether the method supports these torque rows: only motor torques are supported."""
        return rows.motors_alone

    def estimate(self, problem: IdentificationProblem) -> MethodEstimate:
        """Return the estimate of the problem's columns, with the estimated torque noise as row weights.

        Raises:
            UsageError: for a model whose rows have no derivatives by q, v and a.
        """
        model = serial_arm(problem, self)
        return attempted(self.name, problem, lambda: self._estimate(problem, model))

    def _estimate(self, problem: IdentificationProblem, model: IdentificationModel) -> MethodEstimate:
        std, _ = weighed(problem)
        task = noisy_states(problem, model)
        values = wls(problem.pooled, std).estimate.values
        noise = std**2
        steps: list[float] = []
        # of the residuals' standard deviation: torques are not free of noise
        min_noise = 1e-4
        max_steps = 40
        # standard deviations of the estimate
        tolerance = 0.01
        for count in range(1, max_steps + 1):
            minimum = (min_noise * std) ** 2
            noise = _torque_noise(task, values, noise, minimum)
            iteration = _step(task, values, noise)
            relative_steps = np.abs(iteration.values - values) / iteration.sigma
            steps.append(float(np.max(relative_steps)))
            values = iteration.values
            if not np.all(np.isfinite(values)) or (count > 5 and steps[-1] > 10.0 * steps[0]):
                raise Diverged(
                    "maximum likelihood diverged: too much position noise for a linear model; use another method",
                    values,
                )
            if steps[-1] < tolerance:
                break
        else:
            raise NotConverged(
                f"maximum likelihood still changes by {steps[-1]:.2g} standard deviations after {max_steps} rounds; "
                "use another method",
                values,
            )
        solution = _packed(problem, iteration, noise)
        inflation = residual_inflation(problem.rows, values)
        return MethodEstimate(
            self.name,
            EstimateStatus.FOUND,
            solution,
            problem.pooled,
            np.sqrt(noise),
            inflation,
            iterations=count,
            alone=True,
        )


@dataclass(frozen=True, eq=False)
class _Recording:
    """States of one recording at its decimated samples, with their noise.

    Attributes:
        own: slice of the recording's samples among all samples.
        q, v, a: (M, n) states, not filtered by the decimation.
        noise: (n, 3, 3) covariance G of q, v, a of each joint.
        carried: labels of the attached payloads.
        present: (p,) factors of the columns: 0 for payloads that are not attached, otherwise 1.
    """

    own: slice
    q: np.ndarray
    v: np.ndarray
    a: np.ndarray
    noise: np.ndarray
    carried: tuple[str, ...]
    present: np.ndarray


@dataclass(frozen=True, eq=False)
class NoisyStates:
    """All samples of a problem with noisy states.

    Attributes:
        model: model with all friction terms.
        columns: (p,) indices of the model's columns.
        smooth: (p,) mask of columns that can be differentiated by q, v and a.
        matrix: (M, n, p) observation matrix.
        target: (M, n) torques [N m or N].
        present: (M, n) mask of rows in use.
        parts: states of each recording.
    """

    model: IdentificationModel
    columns: np.ndarray
    smooth: np.ndarray
    matrix: np.ndarray
    target: np.ndarray
    present: np.ndarray
    parts: tuple[_Recording, ...]


def noisy_states(problem: IdentificationProblem, model: IdentificationModel) -> NoisyStates:
    """Return all samples of a problem, with the covariance of the noise in q, v and a of each recording.

    Args:
        problem: data and settings.
        model: model with all friction terms.
    """
    samples, (model, columns) = samples_of(problem), with_friction(problem, model)
    is_smooth = [term is None or term.form.slopes for term in problem.terms]
    smooth = np.array(is_smooth, dtype=bool)
    parts = []
    first = 0
    for case in problem.cases:
        motion = case.motion
        index = kept(motion.segment, problem.decimator)
        drive_columns = np.ones(model.p - model.inertial)
        carried = np.append(model.carried_columns(case.carried), drive_columns)
        noise = noise_of_states(motion, problem.decimator)
        part = slice(first, first + len(index))
        q = motion.q[index]
        v = motion.v[index]
        a = motion.a[index]
        parts.append(_Recording(part, q, v, a, noise, case.carried, carried[columns]))
        first += len(index)
    return NoisyStates(model, columns, smooth, samples.matrix, samples.target, samples.present, tuple(parts))


def noise_of_states(motion: Motion, decimator: Decimator) -> np.ndarray:
    """Return the covariance (n, 3, 3) of q, v, a of each joint, propagated from white position noise.

    It is computed from the impulse responses of low-pass, differences and decimation; the noise level is that of the
    log's spectrum.

    Args:
        motion: motion of one recording, with its filters.
        decimator: filter and decimation of the rows.
    """
    result = np.empty((motion.n, 3, 3))
    cutoffs = np.stack([motion.cutoff, motion.velocity_cutoff], axis=1)
    for cutoff, faster in np.unique(cutoffs, axis=0):
        reach = int(np.ceil(6.0 * motion.rate / cutoff)) + decimator.reach + 16
        impulse = np.zeros(2 * reach + 1)
        impulse[reach] = 1.0
        q = low_pass(impulse, motion.rate, float(cutoff))
        less = low_pass(impulse, motion.rate, float(faster))
        v = slope(less, motion.rate)
        a = curvature(q, motion.rate)
        states = np.stack([q, v, a])
        responses = [np.convolve(state, decimator.taps) for state in np.nan_to_num(states)]
        response = np.array(responses)
        result[np.all(cutoffs == (cutoff, faster), axis=1)] = response @ response.T
    return result * (motion.cutoffs.noise**2)[:, None, None]


def _slopes(task: NoisyStates, part: _Recording, values: np.ndarray) -> np.ndarray:
    """Return B (M, n, 3, n): the derivatives of the torques W β (first n) by q, v and a of each joint (3, n).

    Args:
        task: all samples.
        part: states of one recording, with M samples.
        values: β (p,), parameters.
    """
    differentiable = task.smooth & (part.present > 0.0)
    order = np.argsort(task.columns[differentiable])
    columns = task.columns[differentiable][order]
    column_values = values[differentiable][order]
    n = task.model.n
    out = np.empty((len(part.q), n, 3, n))
    for start in range(0, len(part.q), BLOCK):
        block = slice(start, start + BLOCK)
        q = np.ascontiguousarray(part.q[block])
        v = np.ascontiguousarray(part.v[block])
        a = np.ascontiguousarray(part.a[block])
        for row in range(n):
            weights = np.zeros((len(q), n, len(columns)))
            weights[:, row] = column_values
            gradient = task.model.regressor_gradient(q, v, a, weights, columns)
            out[block, row] = np.stack(gradient, axis=1)
    return out


def _residuals(task: NoisyStates, part: _Recording, values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the residuals r (M, n) of a recording, with G Bᵀ (M, 3, n, n) and B G Bᵀ (M, n, n).

    Args:
        task: all samples.
        part: states of one recording, with M samples.
        values: (p,) parameters; B are the derivatives of the torques by q, v, a, and G is the covariance of these.
    """
    by_state = _slopes(task, part, values)
    spread = np.einsum("kxj,mrxj->mkjr", part.noise.transpose(1, 2, 0), by_state)
    residual = task.target[part.own] - task.matrix[part.own] @ values
    residual = np.where(task.present[part.own], residual, 0.0)
    return residual, spread, np.einsum("mrkj,mkjs->mrs", by_state, spread)


def _inverse(position_part: np.ndarray, noise: np.ndarray, in_use: np.ndarray) -> np.ndarray:
    """Return the inverse (M, n, n) of S = Σ_τ + B G Bᵀ for the rows in use; zero for other rows.

    Args:
        position_part: B G Bᵀ (M, n, n).
        noise: (n,) diagonal of Σ_τ.
        in_use: (M, n) mask of rows in use.
    """
    pairs = in_use[:, :, None] & in_use[:, None, :]
    full = position_part + np.diag(noise)
    covariance = np.where(pairs, full, np.eye(len(noise)))
    return np.where(pairs, np.linalg.inv(covariance), 0.0)


def _torque_noise(task: NoisyStates, values: np.ndarray, noise: np.ndarray, minimum: np.ndarray) -> np.ndarray:
    """Return the most likely torque noise, the diagonal of Σ_τ (n,), for fixed parameters and position noise.

    Args:
        task: all samples.
        values: (p,) parameters.
        noise: (n,) first values.
        minimum: (n,) lower bounds.
    """
    residuals = []
    position_parts = []
    for part in task.parts:
        part_residual, _, part_covariance = _residuals(task, part, values)
        residuals.append(part_residual)
        position_parts.append(part_covariance)
    residual = np.concatenate(residuals)
    position_part = np.concatenate(position_parts)
    # of the residuals, after the fit
    share = max(1.0 - len(values) / task.present.sum(), 0.1)
    observed = task.present.any(axis=0)
    for _ in range(50):
        inverse = _inverse(position_part, noise, task.present)
        score = np.sum(np.einsum("mij,mj->mi", inverse, residual) ** 2, axis=0) / share
        diagonal = np.maximum(np.einsum("mii->i", inverse), 1e-300)
        ratio = np.clip(score / diagonal, 0.1, 10.0)
        before = noise
        noise = np.where(observed, np.maximum(noise * ratio, minimum), noise)
        if np.max(np.abs(noise / before - 1.0)) < 1e-3:
            break
    return noise


@dataclass(frozen=True, eq=False)
class _Round:
    """Result of one iteration.

    Attributes:
        values: (p,) parameters.
        bread: (p, p) inverse of Σ W(x̂)ᵀ S⁻¹ W.
        white, residual: for each recording, S^(-½) times W(x̂) (M, n, p), and S^(-½) times r (M, n).
    """

    values: np.ndarray
    bread: np.ndarray
    white: tuple[np.ndarray, ...]
    residual: tuple[np.ndarray, ...]

    @property
    def sigma(self) -> np.ndarray:
        """Standard deviations (p,) of the parameters, as for white residuals."""
        squares = [np.sum((white @ self.bread.T) ** 2, axis=(0, 1)) for white in self.white]
        return np.sqrt(sum(squares))


def _step(task: NoisyStates, values: np.ndarray, noise: np.ndarray) -> _Round:
    """Return the next iteration's result, from parameters (p,) and torque noise (n,).

    Args:
        task: all samples.
        values: (p,) parameters.
        noise: (n,) variance of the torque noise.
    """
    p = len(values)
    cross = np.zeros((p, p))
    score = np.zeros(p)
    white = []
    white_residuals = []
    for part in task.parts:
        residual, spread, position_part = _residuals(task, part, values)
        in_use = task.present[part.own]
        inverse = _inverse(position_part, noise, in_use)
        error = np.einsum("mkjr,mrs,ms->mkj", spread, inverse, residual)
        corrected = task.matrix[part.own] + changed(task, part, error)
        rows = np.where(in_use[:, :, None], corrected, 0.0)
        identity = np.eye(len(noise))
        weights = np.where(in_use[:, :, None], inverse, identity)
        root = np.linalg.cholesky(weights).transpose(0, 2, 1)
        white.append(root @ rows)
        white_residuals.append((root @ residual[:, :, None])[:, :, 0])
        cross += np.einsum("mip,miq->pq", inverse @ rows, task.matrix[part.own], optimize=True)
        score += np.einsum("mip,mi->p", white[-1], white_residuals[-1])
    size = np.sqrt(np.abs(np.diag(cross)))
    scale = np.outer(size, size)
    bread = np.linalg.inv(cross / scale) / scale
    return _Round(values + bread @ score, bread, tuple(white), tuple(white_residuals))


def changed(task: NoisyStates, part: _Recording, error: np.ndarray) -> np.ndarray:
    """Return the change W(x + error) - W(x) (M, n, p) of the regressor W for errors of the states x.

    It is zero in columns without derivative.

    Args:
        task: all samples.
        part: states x of one recording, with M samples.
        error: (M, 3, n) errors of q, v and a.
    """
    out = np.zeros_like(task.matrix[part.own])
    smooth = np.flatnonzero(task.smooth)
    for start in range(0, len(part.q), BLOCK):
        block = slice(start, start + BLOCK)
        state = np.stack([part.q[block], part.v[block], part.a[block]])
        shifted = state + error[block].transpose(1, 0, 2)
        if task.smooth.all():
            load = None
        else:
            load = np.zeros_like(state[0])
        q, v, a = state
        before = task.model.regressor(q, v, a, load, part.carried)
        shifted_q, shifted_v, shifted_a = shifted
        after = task.model.regressor(shifted_q, shifted_v, shifted_a, load, part.carried)
        difference = after - before
        out[block][:, :, smooth] = difference[:, :, task.columns[smooth]]
    return out


def _packed(problem: IdentificationProblem, iteration: _Round, noise: np.ndarray) -> LinearFit:
    """Return the fit of the last iteration; its covariance accounts for autocorrelated residuals.

    Args:
        problem: data and settings.
        iteration: result of the last iteration.
        noise: (n,) variance of the torque noise.
    """
    std = np.sqrt(noise)
    plain = wls(problem.pooled, std)
    p = len(iteration.values)
    rows = int(problem.pooled.rows.sum())
    meat = sum(scatter(white, residual) for white, residual in zip(iteration.white, iteration.residual))
    covariance = rows / (rows - p) * iteration.bread @ meat @ iteration.bread.T
    estimate = replace(plain.estimate, values=iteration.values, covariance=covariance, residual_std=1.0)
    whitened = np.concatenate(iteration.white).reshape(-1, p)
    return LinearFit(estimate, np.sqrt(noise), *condition_numbers(whitened))


ML = _MaximumLikelihood(
    "ml",
    "positions have white noise (level from each log's spectrum), so have torques (level from the residuals); both are "
    "small enough to linearise the torque",
    description="maximum likelihood with noisy positions, noise levels estimated",
    source="Olsen, Swevers & Verdonck 2002; Leboutet et al. 2021",
    tunes=("tolerance 0.01 sigma", "40 rounds"),
)
