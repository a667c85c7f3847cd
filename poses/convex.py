"""The D-optimal relaxation: an upper bound for any choice of poses.

Choosing m of N poses is relaxed to weights x in [0, 1] with Σ x = m (a pose at most once; without the cap, x ≤ m: poses
may be repeated),

    maximise  log det M(x),   M(x) = M_known + Σ x_i J_iᵀJ_i .

**Certificate.** log det is concave, so for any M ≻ 0 and any feasible x

    det M(x)^(1/p)  ≤  det M^(1/p) · T/p,   T = tr(M⁻¹ M_known) + Σ (m largest d_i),   d_i = tr(J_i M⁻¹ J_iᵀ)

(without the cap: m · max d_i), the linearisation at the best multiple of M. At the optimum T = p: the general
equivalence theorem (Kiefer & Wolfowitz 1960; Pukelsheim 1993, ch. 7; the capped form Wynn 1982). The bound holds for
any weights whatsoever; good weights make it tight.

**Method.** A few multiplicative steps x ← x d (Titterington 1976) show where the weight goes; then a primal-dual
interior-point method (Boyd & Vandenberghe 2004, ch. 11) on the candidates with the largest d_i, and pricing: whatever
candidate violates the certificate joins, until it is tight. Working on a few hundred candidates plays the part of the
Harman & Pronzato (2007) deletion rule, which needs repeats to be allowed. The set and its growth are our choice.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from .information import Candidates, log_det, prepared


@dataclass(frozen=True)
class Bound:
    """Upper bound on det(WᵀW)^(1/p) over all choices of m poses, with the weights that certify it.

    Attributes:
        weights: (N,) relaxed choice, Σ = m.
        logdet: log det M(weights), in the caller's parameters.
        upper: certified upper bound on det(M)^(1/p) of any m poses (with the poses already measured).
        log_upper: its logarithm, times p: an upper bound on log det M.
        gap: upper / det M(weights)^(1/p) − 1; what the bound may at most be loose against the relaxed optimum.
        iterations: interior-point steps.
        capped: True where no pose may be taken twice.
        scores: (N,) d_i at the weights the bound was certified with; large ones are the promising candidates.
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
    """Feasible weights x with the bound certified at M(x), in transformed coordinates."""

    x: np.ndarray
    scores: np.ndarray
    logdet: float
    log_upper: float


def bound(
    jacobians: ArrayLike, m: int, *, existing: ArrayLike | None = None, capped: bool = True, tolerance: float = 1e-3
) -> Bound:
    """Return an upper bound on det(WᵀW)^(1/p) over all choices of m candidates.

    Args:
        jacobians: (N, rows, p) whitened Jacobians of the candidates.
        m: number of poses.
        existing: (k, rows, p) Jacobians of poses already measured; they count in full. None without such poses.
        capped: False allows a pose to be repeated, which makes the bound looser.
        tolerance: relative gap at which the search for a tighter bound ends.

    Raises:
        BadInput, TooFewCandidates, NotIdentifiable: as `calib.poses.information.prepared`.
    """
    return relaxed(prepared(jacobians, m, existing), m, capped=capped, tolerance=tolerance)


def relaxed(candidates: Candidates, m: int, *, capped: bool = True, tolerance: float = 1e-3, rounds: int = 12) -> Bound:
    """Return the bound of the relaxation solved over prepared candidates; see `bound`."""
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
    """Return the upper bound on log det M that weights x (N,) certify, whichever they are (+inf if M is singular)."""
    certified = _certify(candidates.z, candidates.known, x, m, capped)
    return certified.log_upper + candidates.shift


def information_of(z: np.ndarray, known_information: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Return M = M_known + Σ x_i z_iᵀz_i (p, p) from z (N, rows, p) and weights x (N,)."""
    chosen = np.flatnonzero(x)
    rows = z[chosen].reshape(-1, z.shape[2])
    row_weights = np.repeat(x[chosen], z.shape[1])
    return known_information + rows.T @ (rows * row_weights[:, None])


def scores_of(z: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Return the scores d_i = tr(z_i M⁻¹ z_iᵀ) (N,) of candidates."""
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
    """Return the weights of larger log det of the two, with the tighter bound of the two."""
    upper = min(first.log_upper, second.log_upper)
    if second.logdet >= first.logdet:
        better = second
    else:
        better = first
    return _Certified(better.x, better.scores, better.logdet, upper)


def _warm(
    z: np.ndarray, known_information: np.ndarray, m: int, cap: float, steps: int = 6
) -> tuple[np.ndarray, np.ndarray]:
    """Return initial weights (N,) by a few multiplicative steps, and the candidates' scores (N,) at these weights."""
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
    """Return the sorted indices of the `count` largest values."""
    order = np.argpartition(values, len(values) - count)
    return np.sort(order[-count:])


def _priced(scores: np.ndarray, x: np.ndarray, active: np.ndarray, price: float, max_count: int) -> np.ndarray:
    """Return the next active set: active candidates with weight or scores near the price, and the worst violators."""
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
    """Return optimal weights (K,) over few candidates, the price λ of the constraint Σ x = m, and the steps taken.

    With duals u of x ≥ 0 and v of x ≤ cap, Newton's step of the perturbed optimality conditions is

        (Q + u/x + v/(cap−x)) dx + λ = d + τ/x − τ/(cap−x),  Σ dx = m − Σ x,   Q_ij = ‖z_i M⁻¹ z_jᵀ‖² .
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
    """Return gradient d (K,) and matrix Q (K, K) of the Newton step for a few candidates."""
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
    """Return the largest t with value + t step ≥ 0; infinite where no step is negative."""
    falling = step < 0
    if not falling.any():
        return np.inf
    lengths = -value[falling] / step[falling]
    return float(lengths.min())
