"""Candidate poses: a low-discrepancy sequence within joint limits, filtered by constraints and predicate."""

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from .errors import BadInput, NothingFeasible, require


def draw_candidates(
    lower: ArrayLike,
    upper: ArrayLike,
    count: int,
    feasible: Callable[[np.ndarray], np.ndarray] | None = None,
    *,
    seed: int | np.random.Generator = 0,
    max_draws: int | None = None,
    block: int = 2048,
) -> np.ndarray:
    """Return feasible poses of a scrambled Sobol sequence (Sobol 1967; Owen 1998), drawn block by block.

    Args:
        lower, upper: (n,) joint limits [rad or m].
        count: N, the number of feasible poses to return.
        feasible: predicate (m, n) -> (m,) bool; None accepts all.
        seed: integer or generator; the same seed gives the same poses.
        max_draws: largest number of poses drawn; None for 200 N, at least 100 000.
        block: poses per call of the predicate.

    Returns:
        (N, n) joint values, in the order of the sequence.

    Raises:
        BadInput: limits that are not two (n,) arrays with lower < upper, or a count below 1.
        NothingFeasible: fewer than N of `max_draws` poses are feasible; the message gives the share of feasible poses.
    """
    # slow to load
    from scipy.stats import qmc

    low = np.asarray(lower, dtype=float)
    high = np.asarray(upper, dtype=float)
    if low.ndim != 1 or low.shape != high.shape or not (low < high).all():
        raise BadInput(f"limits: expected two (n,) arrays with lower < upper, found {low} and {high}")
    require(count >= 1, f"count = {count}: ask for at least one candidate")
    if max_draws is None:
        max_draws = max(200 * count, 100_000)
    else:
        max_draws = max_draws
    block = 1 << max(int(block - 1).bit_length(), 0)  # Sobol points keep their balance in powers of two
    sequence = qmc.Sobol(len(low), scramble=True, rng=np.random.default_rng(seed))
    blocks = list[np.ndarray]()
    count_found = 0
    drawn = 0
    while count_found < count and drawn < max_draws:
        fractions = sequence.random(block)
        q = low + (high - low) * fractions
        drawn += block
        if feasible is not None:
            is_allowed = np.asarray(feasible(q), dtype=bool)
            q = q[is_allowed]
        blocks.append(q)
        count_found += len(q)
    if count_found < count:
        share = 100 * count_found / drawn
        raise NothingFeasible(
            f"{count_found} of {drawn} random poses are feasible ({share:.3g} %), {count} are needed: "
            "loosen the narrowest constraint, check its frames, or ask for fewer",
            count_found,
            drawn,
        )
    return np.concatenate(blocks)[:count]
