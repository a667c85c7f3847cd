"""Upper bound on det(WᵀW) over all poses within limits and constraints, not only over the candidates.

The relaxation of `calib.poses.convex`, with poses allowed to repeat, is extended to all feasible poses: a design is a
measure ξ of mass m. By the general equivalence theorem (Kiefer & Wolfowitz 1960), for any M = M_known + ∫ JᵀJ dξ ≻ 0
and any m poses

    det M(q_1 ... q_m)^(1/p)  ≤  det M^(1/p) · (tr(M⁻¹ M_known) + m max_q d(q)) / p,    d(q) = tr(J(q) M⁻¹ J(q)ᵀ),

where the maximum is over all feasible q. The candidates are the first support of ξ (the poses with positive weight).
Then local searches maximise d(q) over single poses under the constraints, with exact gradients. They start from the
support poses of largest d and from random poses. Their end poses are added to the support and the relaxation is solved
again, for several rounds. (Wynn 1970 added one pose per round; here all local maxima found are added.)

**What is certain.** The bound covers every pose at which d was evaluated: the candidates, the chosen poses, and the end
poses of all local searches. Random starts make it likely, but do not prove, that the local searches reached the global
maximum of d. `Ceiling.climbs` is the number of local searches that found no larger d.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from .candidates import draw_candidates
from .continuous.local import climb, restored
from .convex import information_of, relaxed, scores_of
from .scaled_jacobians import log_det, prepared
from .space import SearchSpace, is_feasible, product

# number of poses optimised together: few for a fast SLSQP, many for an efficient Jacobian (our choice)
BLOCK = 8
# poses that differ by less in all joints are treated as one start [rad or m] (our choice)
MIN_DIFFERENCE = 0.1


@dataclass(frozen=True)
class Ceiling:
    """Upper bound on det(WᵀW)^(1/p) of any m feasible poses together with the poses measured before.

    Attributes:
        upper: the bound.
        gap: upper / det M^(1/p) − 1, the most by which the bound may exceed the relaxed optimum, relative.
        climbs: number of local searches of the last round, none of which found a pose that exceeds the bound; 0: the
            bound covers the candidates and the chosen poses only.
        excess: relative amount by which the largest d found by these searches exceeds the largest d of the support; 0
            where it does not exceed it.
        support: (K, n) poses with positive weight in the relaxed design [rad or m].
        evaluations: evaluations of d in all local searches, counted per pose.
    """

    upper: float
    gap: float
    climbs: int
    excess: float
    support: np.ndarray
    evaluations: int


def bound_over_space(
    space: SearchSpace,
    q: np.ndarray,
    m: int,
    existing: np.ndarray | None = None,
    *,
    climbs: int = 32,
    rounds: int = 16,
    tolerance: float = 1e-2,
    seed: int = 0,
    report: Callable[[int, float], None] | None = None,
) -> Ceiling:
    """Return an upper bound on det(WᵀW)^(1/p) of any m feasible poses, as defined in the module's docstring.

    Args:
        space: limits, constraints, Jacobian.
        q: (N, n) feasible poses to begin with: the candidates and the chosen poses. The bound covers all of them.
        m: number of poses.
        existing: (k, rows, p) Jacobians of poses already measured; None without such poses.
        climbs: number of local searches of the last round, half of them from the poses of largest d, half from random
            poses; 0: none.
        rounds: largest number of rounds.
        tolerance: relative excess of d at which the rounds end.
        seed: seed of the random poses.
        report: called with each round's index (from 0) and the relative gap of the bound; None for no report.
    """
    generator = np.random.default_rng([seed, 5])
    jacobians = np.asarray(space.jacobian(q), dtype=float)
    climbs_of_round = 0
    excess = 0.0
    spent = 0
    p = jacobians.shape[2]
    for number in range(max(rounds, 1)):
        candidates = prepared(jacobians, m, existing)
        relaxation = relaxed(candidates, m, capped=False, tolerance=0.1 * tolerance)
        weights = relaxation.weights
        matrix = information_of(candidates.z, candidates.known, weights)
        scores = scores_of(candidates.z, matrix)
        known_share = np.linalg.solve(matrix, candidates.known)
        known_trace = float(np.trace(known_share))
        logdet = float(log_det(matrix)) + candidates.shift
        highest = float(scores.max())
        if not climbs:
            break
        inverse_root = np.linalg.inv(np.linalg.cholesky(matrix))
        root = candidates.transform @ inverse_root.T
        # few climbs while poses are still found that join the support, all of them in the end
        searching = number == 0 or excess > tolerance
        if number < rounds - 1 and climbs_of_round < climbs and searching:
            climbs_of_round = BLOCK
        else:
            climbs_of_round = climbs
        starts = _starts(space, q, scores, climbs_of_round, generator)
        maxima, steps = _climbed(space, starts, root)
        spent += steps
        heights = scores
        if len(maxima):
            maxima_jacobians = np.asarray(space.jacobian(maxima), dtype=float)
            heights = scores_of(maxima_jacobians @ root, np.eye(p))
        highest_end = float(heights.max())
        excess = max(highest_end / highest - 1.0, 0.0)
        highest = max(highest, highest_end)
        total = known_trace + m * highest
        if report:
            report(number, total / p - 1.0)
        if excess <= tolerance and climbs_of_round == climbs:
            break
        if len(maxima):
            threshold = float(scores.max()) * (1.0 + 0.1 * tolerance)
            better = maxima[heights > threshold]
            q = np.concatenate([q, _apart(better)])
            new_jacobians = np.asarray(space.jacobian(q[len(jacobians) :]), dtype=float)
            jacobians = np.concatenate([jacobians, new_jacobians])
    total = known_trace + m * highest
    scale = float(np.exp(logdet / p))
    upper = scale * total / p
    if not climbs:
        climbs_of_round = 0
    support = q[weights[: len(q)].nonzero()[0]]
    return Ceiling(upper, total / p - 1.0, climbs_of_round, excess, support, spent)


def _climbed(space: SearchSpace, starts: np.ndarray, root: np.ndarray) -> tuple[np.ndarray, int]:
    """Return feasible local maxima (K, n) of d(q) = ‖J(q) root‖² from start poses, and the number of evaluations.

    Args:
        space: limits, constraints, predicate, Jacobian J.
        starts: (K, n) poses [rad or m], each improved on its own.
        root: (p, p) root of M⁻¹ = root rootᵀ, the inverse of the present information.
    """

    def objective(q: np.ndarray) -> tuple[float, np.ndarray]:
        spread = np.asarray(space.jacobian(q), dtype=float) @ root
        height = (spread**2).sum((1, 2))
        relative = spread / height[:, None, None]
        by_jacobian = 2.0 * relative @ root.T
        slope = product(space, q, by_jacobian)
        return float(np.log(height).sum()), slope

    ends = []
    spent = 0
    blocks = -(-len(starts) // BLOCK)
    for block in np.array_split(starts, blocks):
        end, steps, interrupted = climb(space, block, objective, 100, 1e-3)
        if interrupted:
            raise KeyboardInterrupt
        ends.append(restored(space, end))
        spent += steps * len(block)
    maxima = np.concatenate(ends)
    feasible = is_feasible(space, maxima)
    return maxima[feasible], spent


def _starts(
    space: SearchSpace, q: np.ndarray, scores: np.ndarray, count: int, generator: np.random.Generator
) -> np.ndarray:
    """Return `count` start poses: half with the largest scores d, pairwise distinct, and half drawn at random.

    Args:
        space: limits, constraints and predicate of the random poses.
        q: (N, n) poses to choose from [rad or m].
        scores: (N,) d of these poses.
        count: number of start poses.
        generator: source of the random poses.
    """
    order = np.argsort(-scores, kind="stable")[: 20 * count]
    ranked_count = count - count // 2
    ranked = _apart(q[order])[:ranked_count]
    random_count = count - len(ranked)
    random_poses = draw_candidates(
        space.lower, space.upper, random_count, lambda poses: is_feasible(space, poses), seed=generator, block=256
    )
    return np.concatenate([ranked, random_poses])


def _apart(q: np.ndarray) -> np.ndarray:
    """Return those poses of q (N, n), in order, that differ pairwise by more than `MIN_DIFFERENCE` in some joint."""
    distinct = np.zeros((0, q.shape[1]))
    for pose in q:
        if not len(distinct) or (np.abs(distinct - pose).max(1) > MIN_DIFFERENCE).all():
            distinct = np.concatenate([distinct, pose[None]])
    return distinct
