"""The D-optimal relaxation: an upper bound on det(WᵀW) for any choice of poses.

Choosing m of N poses is relaxed to weights x in [0, 1] with Σ x = m, each pose at most once. Without this cap x ≤ m,
and poses may be repeated. The problem is

    maximise  log det M(x),   M(x) = M_known + Σ x_i J_iᵀJ_i .

**Certificate.** log det is concave, so for any M ≻ 0 and any feasible x

    det M(x)^(1/p)  ≤  det M^(1/p) · T/p,   T = tr(M⁻¹ M_known) + Σ (m largest d_i),   d_i = tr(J_i M⁻¹ J_iᵀ)

(without the cap: m · max d_i), by linearisation at the best multiple of M. At the optimum T = p: the general
equivalence theorem (Kiefer & Wolfowitz 1960; Pukelsheim 1993, ch. 7; the capped form Wynn 1982). The bound is valid for
any weights; good weights make it tight.

**Method.** A few multiplicative steps x ← x d (Titterington 1976) find the candidates with large weights. A primal-dual
interior-point method (Boyd & Vandenberghe 2004, ch. 11) then solves the problem for the candidates with the largest
d_i. Candidates that violate the certificate are added and the problem is solved again, until the bound is tight.
Restricting the problem to a few hundred candidates replaces the deletion rule of Harman & Pronzato (2007), which is
valid only where poses may be repeated. The choice of these candidates is ours.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from .scaled_jacobians import Candidates, log_det, prepared


@dataclass(frozen=True)
class Bound:
    """Upper bound on det(WᵀW)^(1/p) over all choices of m poses, with the weights that prove it.

    Attributes:
        weights: (N,) relaxed choice, Σ = m.
        logdet: log det M(weights), in the caller's parameters.
        upper: proved upper bound on det(M)^(1/p) of any m poses together with the poses already measured.
        log_upper: p · log(upper), an upper bound on log det M.
        gap: upper / det M(weights)^(1/p) − 1, the most by which the bound may exceed the relaxed optimum, relative.
        iterations: interior-point steps.
        capped: True where no pose may be taken twice.
        scores: (N,) d_i at the weights that prove the bound; candidates with large scores are promising.
    """

    weights: np.ndarray
    logdet: float
    upper: float
    log_upper: float
    gap: float
    iterations: int
    capped: bool
    scores: np.ndarray


@dataclass(frozen=True)
class _Certified:
    """Feasible weights x and the bound proved at M(x), in the scaled coordinates of `Candidates`."""

    x: np.ndarray
    scores: np.ndarray
    logdet: float
    log_upper: float


def bound(
    jacobians: ArrayLike, m: int, *, existing: ArrayLike | None = None, capped: bool = True, tolerance: float = 1e-3
) -> Bound:
    """Return an upper bound on det(WᵀW)^(1/p) over all choices of m candidates.

    W (rows of all poses, p) is the stack of the Jacobians of the chosen poses and of those already measured.

    Args:
        jacobians: (N, rows, p) Jacobians of the candidates, each row divided by its standard deviation.
        m: number of poses.
        existing: (k, rows, p) Jacobians of poses already measured, whose information is added with weight 1; None for
            no such poses.
        capped: False allows a pose to be repeated, which makes the bound looser.
        tolerance: relative gap (`Bound.gap`) at which the search for a tighter bound ends.

    Raises:
        BadInput, TooFewCandidates, NotIdentifiable: under the conditions of `calib.poses.scaled_jacobians.prepared`.
    """
    return relaxed(prepared(jacobians, m, existing), m, capped=capped, tolerance=tolerance)


def relaxed(candidates: Candidates, m: int, *, capped: bool = True, tolerance: float = 1e-3, rounds: int = 12) -> Bound:
    """Return the upper bound for prepared candidates; arguments as for `bound`.

    Args:
        candidates: the scaled candidates.
        m, capped, tolerance: as for `bound`.
        rounds: largest number of times that candidates are added and the problem is solved again.
    """
    z = candidates.z
    known_information = candidates.known
    count, _, p = z.shape
    if capped:
        cap = 1.0
    else:
        cap = float(m)
    x, scores = _warm(z, known_information, m, cap)
    best = _certify(z, known_information, x, m, capped)
    active_count = min(count, max(2 * m, 3 * p) + p)
    active = _largest(scores, active_count)
    iterations = 0
    for _ in range(rounds):
        if best.log_upper - best.logdet <= p * np.log1p(tolerance):
            break
        weights, price, steps = _interior(z[active], known_information, x[active], m, cap, tolerance)
        iterations += steps
        x = np.zeros(count)
        x[active] = weights
        certified = _certify(z, known_information, x, m, capped)
        best = _tighter(best, certified)
        active = _priced(certified.scores, x, active, price, 2 * p)
    excess = (best.log_upper - best.logdet) / p
    gap = float(np.expm1(excess))
    log_upper = best.log_upper + candidates.shift
    logdet = best.logdet + candidates.shift
    upper = float(np.exp(log_upper / p))
    return Bound(best.x, logdet, upper, log_upper, gap, iterations, capped, best.scores)


def certificate(candidates: Candidates, x: np.ndarray, m: int, capped: bool = True) -> float:
    """Return the upper bound on log det M proved by any feasible weights x (N,); +inf if M(x) is singular.

    Args:
        candidates: the scaled candidates; M(x) is the information of the weighted candidates and the poses already
            measured.
        x: (N,) weights ≥ 0 with Σ x = m (and ≤ 1 if `capped`).
        m: number of poses to choose.
        capped: whether each candidate may be chosen once only; False gives the looser bound for repeated poses.
    """
    certified = _certify(candidates.z, candidates.known, x, m, capped)
    return certified.log_upper + candidates.shift


def information_of(z: np.ndarray, known_information: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Return M = M_known + Σ x_i z_iᵀz_i (p, p) from Jacobians z (N, rows, p) and weights x (N,).

    Args:
        z: (N, rows, p) Jacobians z_i of the candidates, in scaled coordinates.
        known_information: M_known (p, p), information of the poses already measured.
        x: (N,) weights of the candidates.
    """
    chosen = np.flatnonzero(x)
    rows = z[chosen].reshape(-1, z.shape[2])
    row_weights = np.repeat(x[chosen], z.shape[1])
    return known_information + rows.T @ (rows * row_weights[:, None])


def scores_of(z: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Return the scores d_i = tr(z_i M⁻¹ z_iᵀ) (N,) of candidates z (N, rows, p) for the information M (p, p)."""
    root = np.linalg.inv(np.linalg.cholesky(matrix))
    spread = z.reshape(-1, z.shape[2]) @ root.T
    spread = spread.reshape(len(z), -1)
    return np.einsum("ij,ij->i", spread, spread)


def _certify(z: np.ndarray, known_information: np.ndarray, x: np.ndarray, m: int, capped: bool) -> _Certified:
    matrix = information_of(z, known_information, x)
    logdet = float(log_det(matrix))
    p = len(matrix)
    if not np.isfinite(logdet) or np.linalg.eigvalsh(matrix)[0] <= 1e-12 * np.trace(matrix):
        scores = np.einsum("nrp,nrp->n", z, z)
        return _Certified(x, scores, -np.inf, np.inf)
    scores = scores_of(z, matrix)
    top = m * scores.max()
    if capped:
        top = np.partition(scores, len(scores) - m)[-m:].sum()
    known_trace = np.trace(np.linalg.solve(matrix, known_information))
    total = float(known_trace + top)
    log_upper = logdet + p * float(np.log(total / p))
    return _Certified(x, scores, logdet, log_upper)


def _tighter(first: _Certified, second: _Certified) -> _Certified:
    """Return the weights with the larger log det of the two, combined with the smaller of the two bounds.

    Args:
        first, second: weights with their proved bounds, for the same candidates and number of poses.
    """
    upper = min(first.log_upper, second.log_upper)
    if second.logdet >= first.logdet:
        better = second
    else:
        better = first
    return _Certified(better.x, better.scores, better.logdet, upper)


def _warm(
    z: np.ndarray, known_information: np.ndarray, m: int, cap: float, steps: int = 6
) -> tuple[np.ndarray, np.ndarray]:
    """Return initial weights (N,) by a few multiplicative steps, and the candidates' scores (N,) at these weights.

    Args:
        z: (N, rows, p) scaled Jacobians of the candidates.
        known_information: (p, p) information of the poses already measured.
        m: sum of the weights.
        cap: largest weight of a candidate.
        steps: number of multiplicative steps.
    """
    x = np.full(len(z), m / len(z))
    matrix = information_of(z, known_information, x)
    scores = scores_of(z, matrix)
    if len(z) * cap <= m:
        # with no choice left x = 1 is the answer
        return x, scores
    for _ in range(steps):
        x = x * scores**1.5
        for _ in range(3):
            scale = m / x.sum()
            x = np.minimum(x * scale, cap)
        matrix = information_of(z, known_information, x)
        scores = scores_of(z, matrix)
    return x, scores


def _largest(values: np.ndarray, count: int) -> np.ndarray:
    """Return the indices of the `count` largest values, in rising order."""
    order = np.argpartition(values, len(values) - count)
    return np.sort(order[-count:])


def _priced(scores: np.ndarray, x: np.ndarray, active: np.ndarray, price: float, max_count: int) -> np.ndarray:
    """Return the indices of the candidates for the next interior-point problem.

    Kept are active candidates with a weight, or with a score near `price` or above; added are at most `max_count` other
    candidates, those whose scores exceed `price` most.

    Args:
        scores: (N,) scores d_i of all candidates.
        x: (N,) present weights.
        active: indices of the candidates of the last problem.
        price: multiplier λ of the constraint Σ x = m in that problem; the score of a candidate with a weight between
            the bounds.
        max_count: largest number of candidates to add.
    """
    has_weight = x[active] > 1e-4
    near_price = scores[active] > 0.9 * price
    keep = active[has_weight | near_price]
    if len(keep) < x.sum() + 2:
        # all at the cap: leave the interior point room to move
        keep = active
    candidates = scores.copy()
    candidates[keep] = -np.inf
    violators = int((candidates > price).sum())
    count = min(max_count, violators)
    if not count:
        return keep
    return np.sort(np.concatenate([keep, _largest(candidates, count)]))


def _interior(
    z: np.ndarray,
    known_information: np.ndarray,
    x: np.ndarray,
    m: int,
    cap: float,
    tolerance: float,
    max_steps: int = 30,
) -> tuple[np.ndarray, float, int]:
    """Return optimal weights (K,) for K candidates, the multiplier λ of the constraint Σ x = m, and the step count.

    λ is called the price. With duals u of x ≥ 0 and v of x ≤ cap, Newton's step of the perturbed optimality conditions
    is

        (Q + u/x + v/(cap−x)) dx + λ = d + τ/x − τ/(cap−x),  Σ dx = m − Σ x,   Q_ij = ‖z_i M⁻¹ z_jᵀ‖² .

    Args:
        z: (K, rows, p) scaled Jacobians of the candidates.
        known_information: (p, p) information of the poses that are not varied.
        x: (K,) first weights.
        m: sum of the weights.
        cap: largest weight of a candidate.
        tolerance: relative gap of det(M)^(1/p) to its optimum at which the iteration ends.
        max_steps: largest number of Newton steps.
    """
    count, _, p = z.shape
    mean = m / count
    scale = m / max(x.sum(), 1e-12)
    scaled = np.clip(x * scale, 0.0, cap)
    x = 0.9 * scaled + 0.1 * mean
    x = np.minimum(x, 0.95 * cap + 0.05 * m / count)
    tau = 0.1 * p / count
    u = tau / x
    v = tau / (cap - x)
    price = 0.0
    for step in range(1, max_steps + 1):
        matrix = information_of(z, known_information, x)
        scores, curvature = _newton_terms(z, matrix)
        slack = cap - x
        hessian = curvature + np.diag(u / x + v / slack)
        right = scores + tau / x - tau / slack
        right_sides = np.stack([right, np.ones(count)], axis=1)
        solution = np.linalg.solve(hessian, right_sides)
        by_scores = solution[:, 0]
        by_sum = solution[:, 1]
        missing = m - x.sum()
        price = float((by_scores.sum() - missing) / by_sum.sum())
        dx = by_scores - price * by_sum
        du = tau / x - u - u / x * dx
        dv = tau / slack - v + v / slack * dx
        primal = min(1.0, 0.99 * _longest(x, dx), 0.99 * _longest(slack, -dx))
        dual = min(1.0, 0.99 * _longest(u, du), 0.99 * _longest(v, dv))
        x = x + primal * dx
        u = u + dual * du
        v = v + dual * dv
        complementarity = float(x @ u + (cap - x) @ v)
        sum_error = abs(x.sum() - m)
        if complementarity < 0.3 * p * tolerance and sum_error < 1e-9 * m and primal > 0.5:
            return x, price, step
        if min(primal, dual) > 0.5:
            factor = 0.1
        else:
            factor = 0.5
        tau = factor * complementarity / (2 * count)
    return x * (m / x.sum()), price, max_steps


def _newton_terms(z: np.ndarray, matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the gradient d (K,) and the matrix Q (K, K) of the Newton step for K candidates.

    Args:
        z: (K, rows, p) scaled Jacobians of the candidates.
        matrix: (p, p) information M at the present weights.
    """
    count, rows, p = z.shape
    root = np.linalg.inv(np.linalg.cholesky(matrix))
    rows_spread = z.reshape(-1, p) @ root.T
    spread = rows_spread.reshape(count, rows, p)
    inner = np.einsum("nrp,nrq->npq", spread, spread, optimize=True)
    squares = inner.reshape(count, -1).reshape(count, p, p)
    i, j = np.triu_indices(p)
    weights = np.where(i == j, 1.0, np.sqrt(2.0))
    packed = squares[:, i, j] * weights
    scores = np.einsum("nrp,nrp->n", spread, spread)
    return scores, packed @ packed.T


def _longest(value: np.ndarray, step: np.ndarray) -> float:
    """Return the largest t with value + t · step ≥ 0 in every component; infinite where no step is negative."""
    falling = step < 0
    if not falling.any():
        return np.inf
    lengths = -value[falling] / step[falling]
    return float(lengths.min())
