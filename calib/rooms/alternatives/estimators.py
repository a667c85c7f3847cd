"""Methods other than ordinary and weighted least squares: robust, total, and under constraints on parameters."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from calib.estimation.linear import LinearFit
from calib.estimation.triangles import Triangles, combine
from calib.identification.methods.least_squares import OLS, WLS, LeastSquares, weighed
from calib.identification.methods.method import EstimateStatus, IdentificationProblem, Method, MethodEstimate, attempted
from calib.rooms.alternatives.parameter_constraints import Constraints, constraints_of, hold
from calib.rooms.alternatives.samples import SampleFit, Samples, irls, stack
from calib.rooms.alternatives.total import tls

CONSISTENT, CONSTRAINED = "; parameters satisfy [constraints]", " under constraints on its parameters"
COLUMN_NOISE = 0.01  # of a column's rms: what filtered derivatives miss (our choice)


def scaled_tls(pooled: Triangles, std: np.ndarray, exact: np.ndarray, inflation: np.ndarray | None = None) -> LinearFit:
    """Return the scaled TLS fit: noise of moving columns: `COLUMN_NOISE` times their rms; of y: its residuals.

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


@dataclass(frozen=True)
class _ConstrainedLeastSquares(Method):
    """A method that solves the rows directly, under constraints: physically consistent least squares.

    Weights are those that come from the residuals of the free estimate; only IRLS weighs by those of the constrained
    one, as there a sample's weight hangs on it.

    Attributes:
        free: the method without constraints.
    """

    takes_constraints: bool = field(default=True, kw_only=True)
    free: LeastSquares

    def estimate(self, problem: IdentificationProblem) -> MethodEstimate:
        """Return the estimate under the problem's constraints; its covariance treats active constraints as equalities.

        Raises:
            UsageError: for constraints that contradict each other.
        """
        constraints = constraints_of(problem)
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


IRLS = LeastSquares(
    "irls", "torque noise is correlated across joints, outlier samples are rejected; q, v, a are exact",
    lambda problem, std, tau: _reweighted(problem, tau).fit,
    description="least squares, weighted across joints, outliers rejected", source="Han, Wu, Liu & Xiong 2020",
    tunes=("gate of 3 sigma",), version=2,
)  # fmt: skip
TLS = LeastSquares(
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
METHODS = (IRLS, TLS, PC_OLS, PC_WLS, PC_IRLS)
