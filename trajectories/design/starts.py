"""Start motions of searches: random motions inside the joint limits.

A search also begins again from smaller motions about a pose inside the limits (`shrunk`).
"""

import numpy as np

from ..basis import Basis, SampledMotion
from ..constraints import BoxLimit
from ..design.problem import ExcitationProblem, stretched


def random_start(problem: ExcitationProblem, basis: Basis, rng: np.random.Generator) -> np.ndarray:
    """Return variables (and the factor on the period, where free) of a random motion inside the joint limits.

    The motion fills a random part of the joint limits. The centre of the motion is the best of 200 random poses by the
    constraints that a constant pose can violate. The amplitude is scaled down to the limits of position, velocity,
    acceleration and jerk.

    Args:
        problem: the excitation problem, whose joint limits are satisfied.
        basis: linear map from variables to motion of the problem.
        rng: generator of the random numbers.
    """
    n = basis.n
    boxes = [constraint for constraint in problem.constraints if isinstance(constraint, BoxLimit)]
    lower = np.full(n, -np.pi)
    upper = np.full(n, np.pi)
    for box in boxes:
        if box.order == 0:
            lower = np.maximum(lower, box.lower)
            upper = np.minimum(upper, box.upper)
    middle = (lower + upper) / 2
    half = (upper - lower) / 2
    shares = rng.uniform(-0.6, 0.6, (200, n))
    poses = middle + half * shares
    fixed = ~basis.used.any(axis=1)
    poses[:, fixed] = basis.offsets[0, 0, fixed]
    still = np.zeros((200, n))
    resting = SampledMotion(np.arange(200.0), poses, still, still, still)
    excess = np.zeros(200)
    for constraint in problem.constraints:
        if isinstance(constraint, BoxLimit):
            continue
        scaled = constraint.values(resting) / constraint.scale
        excess = np.maximum(excess, scaled.max(axis=1))
    furthest_inside = np.argmin(np.maximum(excess, -0.1))
    centre = poses[furthest_inside]
    x = problem.family.random(rng, centre, 0.5 * half)
    constant = problem.family.random(rng, centre, np.zeros(n))
    factor = float(np.mean(problem.stretch))
    still_motion = stretched(basis.motion(constant), factor)
    random_motion = stretched(basis.motion(x), factor)
    fill = _fitting(boxes, still_motion, random_motion)
    part = rng.uniform(0.5, 0.9) * fill
    x = constant + part * (x - constant)
    if problem.free_period:
        return np.append(x, factor)
    return x


def shrunk(problem: ExcitationProblem, y: np.ndarray, share: float) -> np.ndarray:
    """Return the point of a motion scaled by `share` about one of its poses.

    The pose is the one that lies furthest inside the limits.

    Args:
        problem: the excitation problem with its limits.
        y: point of the motion: variables (p,), with the factor on the period where the period is free.
        share: factor on the motion's amplitude, 0 to 1.
    """
    basis = problem.basis()
    path = basis.motion(y[: basis.p])
    still = np.zeros(path.q.shape)
    resting = SampledMotion(path.times, path.q, still, still, still)
    scaled = [constraint.values(resting) / constraint.scale for constraint in problem.constraints]
    excess = np.max([values.max(axis=1) for values in scaled], axis=0)
    pose = path.q[np.argmin(excess)]
    centre = basis.nearest(np.broadcast_to(pose, path.q.shape))
    x = y[: basis.p]
    smaller = centre + share * (x - centre)
    return np.append(smaller, y[basis.p :])


def _fitting(boxes: list[BoxLimit], still: SampledMotion, moving: SampledMotion) -> float:
    """Return the largest factor (at most 1) by which a motion about a pose satisfies the box limits.

    The factor multiplies the deviation of the motion from the pose.

    Args:
        boxes: limits of position, velocity, acceleration and jerk.
        still: the constant pose, as a motion.
        moving: the motion.
    """
    share = 1.0
    for box in boxes:
        at = still.orders[box.order]
        move = moving.orders[box.order] - at
        with np.errstate(divide="ignore", invalid="ignore"):
            to_upper = (box.upper - at) / move
            to_lower = (box.lower - at) / move
            falling = np.where(move < 0, to_lower, np.inf)
            room = np.where(move > 0, to_upper, falling)
        fitting = float(np.nanmin(np.maximum(room, 0.02)))
        share = min(share, fitting)
    return share
