"""Least-squares methods: ordinary and weighted, on the observed rows."""

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
import scipy.linalg

from calib.dynamics.idim import IdentificationModel
from calib.estimation.cone_program import bounded
from calib.estimation.linear import LinearFit, ols, ridge, settled_std, wls
from calib.estimation.triangles import combine, retriangulate
from calib.identification.friction.passivity import braking, driving
from calib.identification.methods.method import EstimateStatus, IdentificationProblem, Method, MethodEstimate, attempted
from calib.identification.prediction import Dynamics
from calib.identification.prior import Prior, residual_inflation, weighing
from calib.identification.time_folds import estimate


class _Solve(Protocol):
    def __call__(self, problem: IdentificationProblem, std: np.ndarray, tau: np.ndarray, /) -> LinearFit: ...


@dataclass(frozen=True)
class LeastSquares(Method):
    """A method that solves the rows directly.

    Attributes:
        solve: function of the problem, standard deviations (rows,) and inflation (rows,) to the fit.
        weighted: whether rows are weighted with their standard deviations.
    """

    solve: _Solve
    weighted: bool = True

    def estimate(self, problem: IdentificationProblem) -> MethodEstimate:
        """Return the estimate of the problem's columns, with a covariance for autocorrelated residuals.

        A prior of base parameters and the ridges of richer friction take part where the method takes them.
        """
        return attempted(self.name, problem, lambda: self._estimate(problem))

    def _estimate(self, problem: IdentificationProblem) -> MethodEstimate:
        prior = problem.prior if self.takes_prior else None
        if prior is None:
            std, tau = weighed(problem)
            fit = self.solve(problem, std, tau)
            ridges = self.takes_prior and bool((problem.groups >= 0).any())
            fit, _, known = _regularised(problem, None, std, tau) if ridges else (fit, None, None)
        else:
            fit, known, std, tau = _settled(problem, prior)
        return MethodEstimate(self.name, EstimateStatus.FOUND, fit, problem.pooled, std, tau, self.weighted, known)


def weighed(problem: IdentificationProblem) -> tuple[np.ndarray, np.ndarray]:
    """Return the standard deviation and variance inflation (rows,) of a problem's residuals by WLS without a prior."""
    pooled, noise = problem.pooled, problem.noise
    std = settled_std(pooled) if noise is None else noise * wls(pooled, noise).estimate.residual_std
    return std, residual_inflation(problem.rows, wls(pooled, std).estimate.values)


def _regularised(
    problem: IdentificationProblem, prior: Prior | None, std: np.ndarray, tau: np.ndarray, tempering: float = 1.0
) -> tuple[LinearFit, np.ndarray, np.ndarray]:
    """Return the WLS fit with a prior of the base columns and with ridges of richer friction chosen by evidence.

    Also returned: the covariance (p, p) of both, infinite without prior or ridge, and their whitened rows (k, p).
    The prior counts `tempering` times.
    """
    pooled, group = problem.pooled, problem.groups
    own = problem.base.b
    known = None
    if prior is not None:
        known = np.sqrt(tempering) * prior.widened(pooled.parameters - own)
    ridges = estimate(pooled, std, tau, group, known)[1]
    covariance = np.diag(np.where(group < 0, np.inf, np.maximum(ridges, 1e-12) ** 2))
    if prior is not None:
        covariance[:own, :own] = prior.covariance / tempering
    fit = ridge(pooled, np.zeros(len(ridges)), covariance, std * np.sqrt(tau))
    finite = np.isfinite(np.diag(covariance))
    rows = np.zeros((int(finite.sum()), len(ridges)))
    root = np.linalg.cholesky(covariance[np.ix_(finite, finite)])
    rows[:, np.flatnonzero(finite)] = scipy.linalg.solve_triangular(root, np.eye(len(root)), lower=True)
    return fit, covariance, rows


def _settled(problem: IdentificationProblem, prior: Prior) -> tuple[LinearFit, np.ndarray, np.ndarray, np.ndarray]:
    """Return the fit with a prior, the prior's rows (k, p), and its residuals' std and inflation (rows,).

    The prior counts `Prior.tempering` times more for the values than for their covariance; drives' inertia is positive
    and friction brakes, which the covariance does not know. Not so the friction of a joint that the data say it drives:
    that says that something is wrong, and is to be seen.
    """
    pooled, noise = problem.pooled, problem.noise
    std, tau, tempering = prior.first.std, prior.first.inflation, prior.tempering
    fit, covariance, known = _regularised(problem, prior, std, tau, tempering)
    rounds = 2  # of weighing rows by the residuals that richer friction leaves
    for _ in range(rounds):
        own = fit.estimate
        std, tau = weighing(problem.rows, pooled, own.values, own.covariance, std, tau, noise)
        fit, covariance, known = _regularised(problem, prior, std, tau, tempering)
    values = _braking(problem, fit.estimate.values, std * np.sqrt(tau), known)
    covariance[: problem.base.b, : problem.base.b] *= tempering
    stated = ridge(pooled, np.zeros(len(values)), covariance, std * np.sqrt(tau))
    return replace(stated, estimate=replace(stated.estimate, values=values)), known, std, tau


def _braking(problem: IdentificationProblem, free: np.ndarray, std: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Return the estimate (p,) with dissipative friction, except at joints where the data contradict it."""
    fastest = np.max([np.abs(case.motion.v).max(axis=0) for case in problem.cases], axis=0)
    terms, pooled = problem.terms, problem.pooled
    factor = retriangulate(np.vstack([combine(pooled, std), np.pad(known, ((0, 0), (0, 1)))]))
    values = bounded(factor, braking(terms, fastest))
    wrong = _driving(problem, free)
    max_cost = 1.2  # of a joint's squared residuals, above which braking friction is not what was recorded (our choice)
    if wrong.any():
        wrong &= (
            pooled.residual_squares(values)[-len(wrong) :] > max_cost * pooled.residual_squares(free)[-len(wrong) :]
        )
    if not wrong.any():
        return values
    reversed_ = [one is not None and one.form.dissipative and any(wrong[row] for row, _ in one.acts) for one in terms]
    kept = [None if skipped else one for one, skipped in zip(terms, reversed_)]
    return bounded(factor, braking(kept, fastest))


def _driving(problem: IdentificationProblem, values: np.ndarray) -> np.ndarray:
    """Return the mask (n,) of joints where friction of an unconstrained estimate adds energy."""
    model, own = problem.model, problem.base.b
    if not isinstance(model, IdentificationModel) or not model.torque_rows.motors_alone:
        return np.zeros(0, dtype=bool)
    richer = model.with_terms(*(one for one in problem.terms[own:] if one is not None))
    standard = np.concatenate([problem.base.to_standard(values[:own]), values[own:]])
    return driving(Dynamics(richer, standard), problem.cases)


OLS = LeastSquares(
    "ols",
    "the torques of all joints are equally noisy; q, v and a are exact",
    lambda problem, std, tau: ols(problem.pooled, tau),
    weighted=False,
    description="least squares, equal weights",
    source="Gauss; Atkeson, An & Hollerbach 1986",
)
WLS = LeastSquares(
    "wls",
    "each joint's torque noise is that of its residuals; q, v and a are exact",
    lambda problem, std, tau: wls(problem.pooled, std, tau),
    takes_prior=True,
    description="least squares, each joint weighted by its residuals",
    source="Gautier & Poignet 2001",
)
