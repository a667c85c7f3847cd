"""Least-squares methods: ordinary and weighted, on the observed rows."""

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
import scipy.linalg

from calib.dynamics.drives import DriveTerm
from calib.dynamics.idim import IdentificationModel
from calib.estimation.cone_program import bounded
from calib.estimation.linear import LinearFit, ols, ridge, settled_std, wls
from calib.estimation.triangles import combine, retriangulate
from calib.identification.friction.passivity import braking, driving
from calib.identification.methods.method import EstimateStatus, IdentificationProblem, Method, MethodEstimate, attempted
from calib.identification.prediction import Dynamics
from calib.identification.prior import Prior, residual_inflation, weighing
from calib.identification.time_folds import estimate

SETTLING_ROUNDS = 2
"""Rounds of weighing rows by the residuals that richer friction leaves."""
MAX_COST = 1.2
"""Factor on a joint's squared residuals above which braking friction is not what was recorded (our choice)."""


class _Solve(Protocol):
    def __call__(self, problem: IdentificationProblem, std: np.ndarray, inflation: np.ndarray, /) -> LinearFit: ...


@dataclass(frozen=True)
class LeastSquares(Method):
    """A method that solves the rows directly.

    Attributes:
        solve: function of the problem, standard deviations (rows,) and variance inflations (rows,) that returns the
            fit.
        weighted: whether rows are weighted with their standard deviations.
    """

    solve: _Solve
    weighted: bool = True

    def estimate(self, problem: IdentificationProblem) -> MethodEstimate:
        """Return the estimate of the problem's columns, with a covariance that accounts for autocorrelated residuals.

        If the method takes a prior, the prior of base parameters and the ridges of additional friction are used.
        """
        return attempted(self.name, problem, lambda: self._estimate(problem))

    def _estimate(self, problem: IdentificationProblem) -> MethodEstimate:
        prior = problem.prior if self.takes_prior else None
        prior_rows = None
        if prior is None:
            std, inflation = weighed(problem)
            fit = self.solve(problem, std, inflation)
            if self.takes_prior and bool((problem.groups >= 0).any()):
                fit, _, prior_rows = _regularised(problem, None, std, inflation)
        else:
            fit, prior_rows, std, inflation = _settled(problem, prior)
        return MethodEstimate(
            self.name, EstimateStatus.FOUND, fit, problem.pooled, std, inflation, self.weighted, prior_rows
        )


def weighed(problem: IdentificationProblem) -> tuple[np.ndarray, np.ndarray]:
    """Return standard deviation and variance inflation (rows,) of a problem's residuals after WLS without prior."""
    pooled, noise = problem.pooled, problem.noise
    if noise is None:
        std = settled_std(pooled)
    else:
        std = noise * wls(pooled, noise).estimate.residual_std
    return std, residual_inflation(problem.rows, wls(pooled, std).estimate.values)


def _regularised(
    problem: IdentificationProblem, prior: Prior | None, std: np.ndarray, inflation: np.ndarray, tempering: float = 1.0
) -> tuple[LinearFit, np.ndarray, np.ndarray]:
    """Return the WLS fit with a prior of the base parameters, and ridges of additional friction chosen by evidence.

    Args:
        problem: data and settings.
        prior: prior of the base parameters; None: no prior.
        std, inflation: (rows,) noise standard deviation [N m or N] and variance inflation of each torque row.
        tempering: factor by which the prior's weight is increased.

    Returns:
        the fit; the covariance (p, p) of prior and ridges, infinite where there is neither; their whitened rows (k, p).
    """
    pooled, group = problem.pooled, problem.groups
    base_count = problem.base.b
    prior_rows = None
    if prior is not None:
        prior_rows = np.sqrt(tempering) * prior.widened(pooled.parameters - base_count)
    _, ridges = estimate(pooled, std, inflation, group, prior_rows)
    if problem.ridges is not None:
        ridges = np.where(np.isnan(problem.ridges), ridges, problem.ridges)
    ridge_variances = np.maximum(ridges, 1e-12) ** 2
    variances = np.where(group < 0, np.inf, ridge_variances)
    covariance = np.diag(variances)
    if prior is not None:
        covariance[:base_count, :base_count] = prior.covariance / tempering
    weighted_std = std * np.sqrt(inflation)
    mean = np.zeros(len(ridges))
    fit = ridge(pooled, mean, covariance, weighted_std)
    finite = np.isfinite(np.diag(covariance))
    root = np.linalg.cholesky(covariance[np.ix_(finite, finite)])
    whitened = np.zeros((len(root), len(ridges)))
    inverse = scipy.linalg.solve_triangular(root, np.eye(len(root)), lower=True)
    whitened[:, np.flatnonzero(finite)] = inverse
    return fit, covariance, whitened


def _settled(problem: IdentificationProblem, prior: Prior) -> tuple[LinearFit, np.ndarray, np.ndarray, np.ndarray]:
    """Return the fit with a prior, the prior's rows (k, p), and std and variance inflation of its residuals (rows,).

    For the values, the prior has `Prior.tempering` times the weight that it has for their covariance. Motor inertia is
    constrained to be positive and friction to be dissipative; the covariance ignores this. Friction is not constrained
    at joints whose data contradict dissipative friction, so that the error in the data remains visible.

    Args:
        problem: data and settings.
        prior: prior of the base parameters.
    """
    pooled = problem.pooled
    base_count = problem.base.b
    std = prior.first.std
    inflation = prior.first.inflation
    tempering = prior.tempering
    fit, covariance, prior_rows = _regularised(problem, prior, std, inflation, tempering)
    for _ in range(SETTLING_ROUNDS):
        estimated = fit.estimate
        std, inflation = weighing(
            problem.rows, pooled, estimated.values, estimated.covariance, std, inflation, problem.noise
        )
        fit, covariance, prior_rows = _regularised(problem, prior, std, inflation, tempering)
    values = _braking(problem, fit.estimate.values, std * np.sqrt(inflation), prior_rows)
    covariance[:base_count, :base_count] *= tempering
    weighted_std = std * np.sqrt(inflation)
    mean = np.zeros(len(values))
    untempered = ridge(pooled, mean, covariance, weighted_std)
    fit = replace(untempered, estimate=replace(untempered.estimate, values=values))
    return fit, prior_rows, std, inflation


def _braking(problem: IdentificationProblem, free: np.ndarray, std: np.ndarray, prior_rows: np.ndarray) -> np.ndarray:
    """Return the estimate (p,) with dissipative friction, except at joints where the data contradict it.

    Args:
        problem: data and settings.
        free: (p,) unconstrained estimate.
        std: (rows,) noise standard deviation of each torque row [N m or N], times the root of its variance inflation.
        prior_rows: (k, p) whitened rows of prior and ridges.
    """
    terms, pooled = problem.terms, problem.pooled
    speeds = [np.abs(case.motion.v).max(axis=0) for case in problem.cases]
    fastest = np.max(speeds, axis=0)
    augmented_prior = np.pad(prior_rows, ((0, 0), (0, 1)))
    stacked = np.vstack([combine(pooled, std), augmented_prior])
    factor = retriangulate(stacked)
    rows = braking(terms, fastest)
    values = bounded(factor, rows)
    contradicted = _driving(problem, free)
    if contradicted.any():
        n = len(contradicted)
        braking_squares = pooled.residual_squares(values)[-n:]
        free_squares = pooled.residual_squares(free)[-n:]
        contradicted &= braking_squares > MAX_COST * free_squares
    if not contradicted.any():
        return values
    constrained: list[DriveTerm | None] = []
    for term in terms:
        if term is not None and term.form.dissipative and any(contradicted[row] for row, _ in term.acts):
            constrained.append(None)
        else:
            constrained.append(term)
    return bounded(factor, braking(constrained, fastest))


def _driving(problem: IdentificationProblem, values: np.ndarray) -> np.ndarray:
    """Return the mask (n,) of joints at which the friction of an unconstrained estimate adds energy.

    Args:
        problem: data and settings.
        values: (p,) unconstrained estimate.
    """
    model, base = problem.model, problem.base
    if not isinstance(model, IdentificationModel) or not model.torque_rows.motors_alone:
        return np.zeros(0, dtype=bool)
    richer_terms = [term for term in problem.terms[base.b :] if term is not None]
    richer_model = model.with_terms(*richer_terms)
    base_standard = base.to_standard(values[: base.b])
    standard = np.concatenate([base_standard, values[base.b :]])
    dynamics = Dynamics(richer_model, standard)
    return driving(dynamics, problem.cases)


OLS = LeastSquares(
    "ols",
    "the torques of all joints are equally noisy; q, v and a are exact",
    lambda problem, std, inflation: ols(problem.pooled, inflation),
    weighted=False,
    description="least squares, equal weights",
    source="Gauss; Atkeson, An & Hollerbach 1986",
)
WLS = LeastSquares(
    "wls",
    "each joint's torque noise is that of its residuals; q, v and a are exact",
    lambda problem, std, inflation: wls(problem.pooled, std, inflation),
    takes_prior=True,
    description="least squares, each joint weighted by its residuals",
    source="Gautier & Poignet 2001",
)
