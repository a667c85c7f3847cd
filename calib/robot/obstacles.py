"""Fixed things around an arm, how far points and lines are from them, and which pairs always touch.

Distances are signed: negative is the depth inside. Those of convex bodies are convex functions of the point, so that
the nearest point of a line is found by golden sections, inside as outside.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce

import numpy as np

from calib.errors import RobotError, refuse_robot
from calib.words import listing

ALWAYS = 0.95
SAMPLES = 200
SIZES = {"box": 3, "sphere": 1, "cylinder": 2}
_GOLDEN = (np.sqrt(5.0) - 1.0) / 2.0


@dataclass(frozen=True, eq=False)
class Obstacle:
    """A fixed thing in the arm's base frame.

    Attributes:
        kind: "box" (size: three edges), "sphere" (radius) or "cylinder" (radius, length along its z) [m].
        placement: (4, 4), where its middle is.
    """

    name: str
    kind: str
    size: tuple[float, ...]
    placement: np.ndarray

    def __post_init__(self) -> None:
        if self.kind not in SIZES:
            refuse_robot(f"obstacle '{self.name}'", f"kind '{self.kind}' is none of {', '.join(SIZES)}")
        count = SIZES[self.kind]
        if len(self.size) != count or min(self.size) <= 0:
            refuse_robot(f"obstacle '{self.name}'", f"a {self.kind} has {count} positive sizes, not {tuple(self.size)}")


@dataclass(frozen=True, eq=False)
class Wall:
    """A half-space: what the arm keeps normal · x ≥ offset of, normal (3,) a unit vector in its base frame."""

    name: str
    normal: np.ndarray
    offset: float


def signed_distance(obstacle: Obstacle, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the distances (...) [m] of points (..., 3) from an obstacle, and the outward normals (..., 3)."""
    rotation, local = obstacle.placement[:3, :3], _seen_from(obstacle, points)
    if obstacle.kind == "sphere":
        length = np.linalg.norm(local, axis=-1, keepdims=True)
        return length[..., 0] - obstacle.size[0], (local / np.maximum(length, 1e-12)) @ rotation.T
    beyond = _beyond(obstacle, local)
    if obstacle.kind == "box":
        slopes = np.sign(local)
    else:
        across = np.linalg.norm(local[..., :2], axis=-1)
        slopes = np.concatenate(
            [local[..., :2] / np.maximum(across, 1e-12)[..., None], np.sign(local[..., 2:])], axis=-1
        )
    out = np.maximum(beyond, 0.0)
    length, deepest = np.linalg.norm(out, axis=-1), beyond.max(axis=-1)
    inside = beyond == deepest[..., None]
    share = np.where((deepest > 0.0)[..., None], out / np.maximum(length, 1e-12)[..., None], inside)
    if obstacle.kind == "cylinder":
        share = np.repeat(share, (2, 1), axis=-1)
    return np.where(deepest > 0.0, length, deepest), (share * slopes) @ rotation.T


def _seen_from(obstacle: Obstacle, points: np.ndarray) -> np.ndarray:
    return (points - obstacle.placement[:3, 3]) @ obstacle.placement[:3, :3]


def _beyond(obstacle: Obstacle, local: np.ndarray) -> np.ndarray:
    """Return how far points (..., 3) in its own frame are beyond the faces (..., k) of a box or a cylinder."""
    if obstacle.kind == "box":
        return np.abs(local) - np.array(obstacle.size) / 2
    across = np.linalg.norm(local[..., :2], axis=-1)
    return np.stack([across - obstacle.size[0], np.abs(local[..., 2]) - obstacle.size[1] / 2], axis=-1)


def _distance(obstacle: Obstacle, points: np.ndarray) -> np.ndarray:
    """Return `signed_distance` without its normals, in a third of the time."""
    local = _seen_from(obstacle, points)
    if obstacle.kind == "sphere":
        return np.linalg.norm(local, axis=-1) - obstacle.size[0]
    faces = np.moveaxis(_beyond(obstacle, local), -1, 0)
    deepest, outside = reduce(np.maximum, faces), np.maximum(faces, 0.0)
    return np.where(deepest > 0.0, np.sqrt(sum(one * one for one in outside)), deepest)


def nearest_on_lines(obstacle: Obstacle, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Return where (...), from 0 to 1, the lines from start to end (..., 3) are nearest to an obstacle."""
    low, high = np.zeros(start.shape[:-1]), np.ones(start.shape[:-1])
    along = end - start

    def far(place: np.ndarray) -> np.ndarray:
        return _distance(obstacle, start + place[..., None] * along)

    one, two = high - _GOLDEN * (high - low), low + _GOLDEN * (high - low)
    far_one, far_two = far(one), far(two)
    steps = 44  # of the golden section: 0.618^44 is 6e-10 of the line
    for _ in range(steps):
        left = far_one < far_two
        low, high = np.where(left, low, one), np.where(left, two, high)
        fresh = np.where(left, high - _GOLDEN * (high - low), low + _GOLDEN * (high - low))
        value = far(fresh)
        one, two = np.where(left, fresh, two), np.where(left, one, fresh)
        far_one, far_two = np.where(left, value, far_two), np.where(left, far_one, value)
    return (low + high) / 2


def inseparable(distances: np.ndarray, fixed: np.ndarray, margin: float, slack: float = 0.0) -> np.ndarray:
    """Return (pairs,) which shapes touch in nearly every posture, by their distances (N, pairs) [m] in random ones.

    Parts of an arm: those nearer than `margin` in at least 95 % of the postures (MoveIt's setup assistant: that touch),
    or never further apart than margin + slack: neighbours, whose shapes overlap by construction. Against what stands
    fixed in the world: only pairs that are nearer, at a distance that no joint changes; an obstacle that the arm nearly
    always hits is an obstacle.

    Args:
        distances: signed.
        fixed: (pairs,) whether the pair is one with the world.
        margin: the least distance that will be asked for [m].
        slack: distance that shapes as coarse as these cannot resolve [m].
    """
    near = (distances <= margin).mean(axis=0) >= ALWAYS
    highest = distances.max(axis=0)
    return np.where(fixed, (highest <= margin) & (np.ptp(distances, axis=0) < 1e-6), near | (highest <= margin + slack))


def check_reachable(
    pairs: Sequence[tuple[str, str]], distances: np.ndarray, fixed: np.ndarray, slack: float = 0.0
) -> None:
    """Refuse a floor or an obstacle that a link never leaves: a size or a place is wrong, no pose would be found.

    A link at a distance that no joint changes, the turret of an arm, may touch what it stands on: by as much as shapes
    this coarse cannot tell.

    Args:
        pairs: names of link and thing.
        distances: (N, pairs) [m] in random postures, signed.
        fixed: (pairs,) whether the pair is one with the world.
        slack: distance that shapes as coarse as these cannot resolve [m].

    Raises:
        RobotError: naming links and things.
    """
    highest, moves = distances.max(axis=0), np.ptp(distances, axis=0) >= 1e-6
    max_overlap = 0.01  # by which a turret may reach into what it stands on [m] (our choice)
    buried = np.flatnonzero(fixed & (highest <= np.where(moves, 0.0, -slack - max_overlap)))
    if not len(buried):
        return
    shown = listing((f"link '{pairs[k][0]}' in '{pairs[k][1]}'" for k in buried.tolist()), 3)
    raise RobotError(
        f"in each of {len(distances)} random postures there is {shown}: nothing keeps clear of that. Sizes and "
        "places are in m (or say \"20 mm\"), in the arm's base frame, which may lie above the floor; an obstacle's xyz "
        "is its middle; where capsules stand for the links, [collision] radius may be too large"
    )
