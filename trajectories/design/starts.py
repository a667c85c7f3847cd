"""Start motions of searches: random, inside the joint limits, about a pose that breaks the other limits least.

Also where they start again: smaller motions about a pose that keeps the limits.
"""

import numpy as np

from ..basis import Basis, SampledMotion
from ..constraints import BoxLimit
from ..design.problem import ExcitationProblem, stretched


def random_start(problem: ExcitationProblem, basis: Basis, rng: np.random.Generator) -> np.ndarray:
    """Return variables of a random motion about a random pose, within a random part of the joint limits.

    The centre is the best of 200 poses by the constraints that a constant pose can break; the amplitude is scaled down
    to the limits of position, velocity, acceleration and jerk.
    """
    n = basis.n
    boxes = [c for c in problem.constraints if isinstance(c, BoxLimit)]
    lower, upper = np.full(n, -np.pi), np.full(n, np.pi)
    for box in (box for box in boxes if box.order == 0):
        lower, upper = np.maximum(lower, box.lower), np.minimum(upper, box.upper)
    middle, half = (lower + upper) / 2, (upper - lower) / 2
    poses = middle + half * rng.uniform(-0.6, 0.6, (200, n))
    fixed = ~basis.used.any(axis=1)
    poses[:, fixed] = basis.offsets[0, 0, fixed]
    still = np.zeros((200, n))
    resting = SampledMotion(np.arange(200.0), poses, still, still, still)
    excess = np.zeros(200)
    for constraint in (c for c in problem.constraints if not isinstance(c, BoxLimit)):
        excess = np.maximum(excess, (constraint.values(resting) / constraint.scale).max(axis=1))
    centre = poses[np.argmin(np.maximum(excess, -0.1))]
    x = problem.family.random(rng, centre, 0.5 * half)
    constant = problem.family.random(rng, centre, np.zeros(n))
    factor = float(np.mean(problem.stretch))
    fill = _fitting(boxes, stretched(basis.motion(constant), factor), stretched(basis.motion(x), factor))
    x = constant + rng.uniform(0.5, 0.9) * fill * (x - constant)
    return np.append(x, factor) if problem.free_period else x


def shrunk(problem: ExcitationProblem, y: np.ndarray, share: float) -> np.ndarray:
    """Return a motion scaled down by a share about its pose furthest inside the limits."""
    basis = problem.basis()
    path = basis.motion(y[: basis.p])
    still = np.zeros(path.q.shape)
    resting = SampledMotion(path.times, path.q, still, still, still)
    excess = np.max(
        [(constraint.values(resting) / constraint.scale).max(axis=1) for constraint in problem.constraints], axis=0
    )
    centre = basis.nearest(np.broadcast_to(path.q[np.argmin(excess)], path.q.shape))
    return np.append(centre + share * (y[: basis.p] - centre), y[basis.p :])


def _fitting(boxes: list[BoxLimit], still: SampledMotion, moving: SampledMotion) -> float:
    """Return the largest share (at most 1) of a motion about a pose inside the box limits."""
    share = 1.0
    for box in boxes:
        at, move = still.orders[box.order], moving.orders[box.order] - still.orders[box.order]
        with np.errstate(divide="ignore", invalid="ignore"):
            room = np.where(move > 0, (box.upper - at) / move, np.where(move < 0, (box.lower - at) / move, np.inf))
        share = min(share, float(np.nanmin(np.maximum(room, 0.02))))
    return share
