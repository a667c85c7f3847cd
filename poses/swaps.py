"""Swaps of one member of a design for one candidate, compared for many members at once.

Without a member with the Jacobian z (rows, p), the inverse C of a design's information becomes C + hᵀh with
h = S^(-1/2) z C and S = I − z C zᵀ (Woodbury; `poses.design`). The scores of all candidates without each of many
members are then one product. It is taken in single precision, since it only tells which candidates may gain; their
gains are computed in double precision.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from .design import Design, Pool, best_addition, with_added, with_removed
from .scaled_jacobians import log_det

# largest number of gains computed at once; where more candidates may gain, they are compared for fewer members
MAX_GAINS = 500
# relative error [1] of a sum of the squares of two products of Jacobians, in single precision and their score in double
# precision: at most 37 roundings of 6e-8 for blocks of six rows, with room for a nearly singular design (our choice)
ROUNDING = 1e-4
# largest relative step of single precision [1], twice its rounding: p + 2 roundings of a sum of p products are below p
# steps for two parameters or more (Higham 2002, equation 3.5)
EPSILON = float(np.finfo(np.float32).eps)


class Swap(NamedTuple):
    """A member that leaves a design, and the design with a candidate in its place."""

    leaving: int
    design: Design


def first_swap(pool: Pool, design: Design, members: Sequence[int], min_gain: float) -> Swap | None:
    """Return the best swap of the first member that has one; None if no swap raises log det by more than `min_gain`.

    Args:
        pool: the candidates.
        design: the design, which is not changed.
        members: indices of members of the design.
        min_gain: smallest gain of log det.
    """
    if len(members) == 1:
        return _swap(pool, design, members[0], min_gain)
    rows = pool.z.shape[1]
    factors, losses = _removed(design, pool.z[list(members)])
    scores = design.scores + _largest_squares(pool, factors)
    scores[:, design.taken] = -np.inf
    # no smaller score gains, see `best_addition`
    min_scores = rows * np.expm1((min_gain + losses) / rows)
    is_promising = scores * (1.0 + ROUNDING) > min_scores[:, None]
    number, candidate = np.nonzero(is_promising)
    if len(number) > MAX_GAINS:
        middle = len(members) // 2
        swap = first_swap(pool, design, members[:middle], min_gain)
        if swap is not None:
            return swap
        return first_swap(pool, design, members[middle:], min_gain)
    gains = _gains(design, pool.z[candidate], factors[number]) - losses[number]
    gaining = number[gains > min_gain]
    if not len(gaining):
        return None
    first = gaining[0]
    gains[number != first] = -np.inf
    coming = int(candidate[gains.argmax()])
    leaving = members[first]
    thinned = with_removed(pool, design, leaving)
    return Swap(leaving, with_added(pool, thinned, coming))


def _largest_squares(pool: Pool, factors: np.ndarray) -> np.ndarray:
    """Return sums of squares (K, N) of h zᵀ in single precision, enlarged by the largest rounding error of h zᵀ.

    The products of h and z may cancel. Their error is then no share of the result, but up to p ε |h| |z|.

    Args:
        pool: the candidates.
        factors: (K, rows, p) h of the members.
    """
    sizes = np.linalg.norm(factors, axis=(1, 2))
    errors = EPSILON * pool.z.shape[2] * np.outer(sizes, pool.sizes)
    return (np.sqrt(pool.coarse_squares(factors)) + errors.astype(np.float32)) ** 2


def _swap(pool: Pool, design: Design, member: int, min_gain: float) -> Swap | None:
    """Return the best swap of one member of a design; None if none raises log det by more than `min_gain`."""
    thinned = with_removed(pool, design, member)
    loss = design.logdet - thinned.logdet
    candidate, gain = best_addition(pool, thinned, above=loss + min_gain)
    if candidate < 0 or gain - loss <= min_gain:
        return None
    return Swap(member, with_added(pool, thinned, candidate))


def _removed(design: Design, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return h (K, rows, p) of each of K members, and the loss (K,) of log det without it.

    Args:
        design: the design.
        z: (K, rows, p) Jacobians of the members.
    """
    zc = z @ design.inverse
    leverage = zc @ z.transpose(0, 2, 1)
    symmetric = (leverage + leverage.transpose(0, 2, 1)) / 2
    identity = np.eye(z.shape[1])
    root = np.linalg.cholesky(identity - symmetric)
    diagonal = np.diagonal(root, axis1=1, axis2=2)
    losses = -2.0 * np.log(diagonal).sum(axis=1)
    return np.linalg.solve(root, zc), losses


def _gains(design: Design, z: np.ndarray, factors: np.ndarray) -> np.ndarray:
    """Return the gain of log det (k,) by adding a candidate to a design without a member, for k such pairs.

    Args:
        design: the design with all members.
        z: (k, rows, p) Jacobians of the candidates.
        factors: (k, rows, p) h of the members.
    """
    transposed = z.transpose(0, 2, 1)
    by_members = factors @ transposed
    blocks = z @ design.inverse @ transposed
    blocks += by_members.transpose(0, 2, 1) @ by_members
    identity = np.eye(z.shape[1])
    return log_det(identity + blocks)
