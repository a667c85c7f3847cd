"""Least-squares methods: ordinary, weighted, robust and total, on the observed rows."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np
import scipy.linalg

from calib.dynamics.idim import IdentificationModel
from calib.estimation.linear import LinearFit, ols, ridge, settled_std, wls
from calib.estimation.samples import SampleFit, Samples, irls, stack
from calib.estimation.total import tls
from calib.estimation.triangles import Triangles, combine, retriangulate
from calib.identification.friction.passivity import braking, driving
from calib.identification.methods.method import EstimateStatus, IdentificationProblem, Method, MethodEstimate, attempted
from calib.identification.methods.parameter_constraints import Constraints, hold
from calib.identification.prediction import Dynamics
from calib.identification.prior import Prior, bounded, residual_inflation, weighing
from calib.identification.time_folds import estimate

CONSISTENT, CONSTRAINED = "; parameters satisfy [constraints]", " under constraints on its parameters"
COLUMN_NOISE = 0.01  # of a column's rms: what filtered derivatives miss (our choice)


class _Solve(Protocol):
    def __call__(self, problem: IdentificationProblem, std: np.ndarray, tau: np.ndarray, /) -> LinearFit: ...


@dataclass(frozen=True)
class _LeastSquares(Method):
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


def scaled_tls(pooled: Triangles, std: np.ndarray, exact: np.ndarray, inflation: np.ndarray | None = None) -> LinearFit:
    """Return the scaled TLS fit: moving columns have noise of `COLUMN_NOISE` times their rms, y that of its residuals.

    The common level is the smallest singular value's; the ratio of the noises, which no single recording identifies, is
    our choice.

    Args:
        pooled: triangles, one group per torque row.
        std: (rows,) of the residuals.
        exact: (p,) bool, columns without noise: ones (offsets) and signs.
        inflation: (rows,) of the residuals; None: every row counts.
    """
    p = pooled.parameters
    stacked = np.sum((pooled.factors / std[:, None, None]) ** 2, axis=(0, 1))
    size = np.sqrt(stacked / max(float(pooled.rows.sum()), 1.0))
    noise = np.append(np.where(exact, 0.0, COLUMN_NOISE * size[:p]), 1.0)
    return tls(pooled, noise, std, inflation)


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


@dataclass(frozen=True)
class _ConstrainedLeastSquares(Method):
    """A method that solves the rows directly, under constraints: physically consistent least squares.

    Weights are those that come from the residuals of the free estimate; only IRLS weighs by those of the constrained
    one, as there a sample's weight hangs on it.

    Attributes:
        free: the method without constraints.
    """

    takes_constraints: bool = field(default=True, kw_only=True)
    free: _LeastSquares

    def estimate(self, problem: IdentificationProblem) -> MethodEstimate:
        """Return the estimate under the problem's constraints; its covariance takes binding ones as equalities.

        Raises:
            UsageError: for constraints that contradict each other.
        """
        constraints = problem.constrained
        return attempted(self.name, problem, lambda: self._estimate(problem, constraints))

    def _estimate(self, problem: IdentificationProblem, constraints: Constraints) -> MethodEstimate:
        std, tau = weighed(problem)
        pooled, free = problem.pooled, self.free.solve(problem, std, tau)
        weights = std if self.free.weighted else np.ones(len(std))
        factor = combine(pooled, weights)
        if self.free is IRLS:
            factor = _reweighted(problem, tau, lambda triangle: constraints.solve(triangle).values).factor
        fit, held = hold(free, factor, pooled, weights, constraints, stated=self.free.weighted)
        return MethodEstimate(
            self.name, EstimateStatus.FOUND, fit, pooled, std, tau, self.free.weighted, held=held
        )  # fmt: skip


def _reweighted(
    problem: IdentificationProblem, tau: np.ndarray, solve: Callable[[np.ndarray], np.ndarray] | None = None
) -> SampleFit:
    """Return the IRLS fit over whole samples, with the variance inflation of the most correlated row."""
    return irls(samples_of(problem), inflation=float(np.max(tau)), solve=solve)


def samples_of(problem: IdentificationProblem) -> Samples:
    """Return the rows of all recordings, grouped by sample."""
    rows = problem.rows
    parts = ([getattr(part, key) for part in rows] for key in ("matrix", "target", "present"))
    matrix, target, present = (np.concatenate(part) for part in parts)
    return stack(matrix, target, present, rows[0].names, rows[0].units)


OLS = _LeastSquares(
    "ols", "the torques of all joints are equally noisy; q, v and a are exact",
    lambda problem, std, tau: ols(problem.pooled, tau), weighted=False,
    description="least squares, equal weights", source="Gauss; Atkeson, An & Hollerbach 1986",
)  # fmt: skip
WLS = _LeastSquares(
    "wls", "each joint's torque noise is that of its residuals; q, v and a are exact",
    lambda problem, std, tau: wls(problem.pooled, std, tau), takes_prior=True,
    description="least squares, each joint weighted by its residuals", source="Gautier & Poignet 2001",
)  # fmt: skip
IRLS = _LeastSquares(
    "irls", "torque noise is correlated across joints, outlier samples are rejected; q, v, a are exact",
    lambda problem, std, tau: _reweighted(problem, tau).fit,
    description="least squares, weighted across joints, outliers rejected", source="Han, Wu, Liu & Xiong 2020",
    tunes=("gate of 3 sigma",), version=2,
)  # fmt: skip
TLS = _LeastSquares(
    "tls",
    f"W has noise of {COLUMN_NOISE:.0%} of each column's rms, each joint's torque that of its "
    "residuals, both up to a common estimated factor, independently in each row; offsets and signs are exact",
    lambda problem, std, tau: scaled_tls(problem.pooled, std, problem.exact, tau),
    description="total least squares with scaled columns", version=2,
    source="Golub & Van Loan 1980; Van Huffel & Vandewalle 1991",
    tunes=("ratio of the columns' noise to the torques'",),
)  # fmt: skip
PC_OLS, PC_WLS, PC_IRLS = (
    _ConstrainedLeastSquares(
        f"pc-{one.name}", one.assumes + CONSISTENT, one, tunes=one.tunes, version=one.version,
        description=one.name + CONSTRAINED, source="Sousa & Cortesão 2014; Wensing et al. 2018",
    )
    for one in (OLS, WLS, IRLS)
)  # fmt: skip
