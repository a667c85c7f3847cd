"""Obstacles in an arm's base frame: boxes, spheres, cylinders and walls, with signed distances.

A negative distance is the depth inside an obstacle. The signed distance from a convex body is a convex function of the
point. Golden-section search therefore finds the point of a line that is nearest to the body, inside as well as outside.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import reduce

import numpy as np

from calib.errors import refuse_robot

# Number of sizes by kind of obstacle.
SIZES = {"box": 3, "sphere": 1, "cylinder": 2}
# Least length [m] of a vector that is divided by its length.
TINY = 1e-12
_GOLDEN = (np.sqrt(5.0) - 1.0) / 2.0
# Steps of the golden section: 0.618^44 is 6e-10 of the line.
GOLDEN_STEPS = 44


@dataclass(frozen=True, eq=False)
class Obstacle:
    """Fixed obstacle in the arm's base frame: box, sphere or cylinder.

    Attributes:
        name: name of the obstacle.
        kind: "box", "sphere" or "cylinder".
        size: three edges of a box, radius of a sphere, or radius and length (along z) of a cylinder [m].
        placement: (4, 4) pose of the obstacle's centre.
    """

    name: str
    kind: str
    size: tuple[float, ...]
    placement: np.ndarray

    def __post_init__(self) -> None:
        if self.kind not in SIZES:
            refuse_robot(f"obstacle '{self.name}'", f"kind '{self.kind}' is not one of {', '.join(SIZES)}")
        count = SIZES[self.kind]
        if len(self.size) != count or min(self.size) <= 0:
            refuse_robot(f"obstacle '{self.name}'", f"a {self.kind} has {count} positive sizes, not {tuple(self.size)}")


@dataclass(frozen=True, eq=False)
class Wall:
    """Wall: the arm must stay in the half-space normal · x ≥ offset.

    Attributes:
        name: name of the wall.
        normal: (3,) unit normal in the base frame.
        offset: distance of the wall's plane from the base's origin along the normal [m].
    """

    name: str
    normal: np.ndarray
    offset: float


def signed_distance(obstacle: Obstacle, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the signed distances (...) [m] of points (..., 3) from an obstacle, and the outward normals (..., 3).

    Args:
        obstacle: the obstacle.
        points: positions in the arm's base frame [m].
    """
    rotation = obstacle.placement[:3, :3]
    local = _in_obstacle_frame(obstacle, points)
    if obstacle.kind == "sphere":
        length = np.linalg.norm(local, axis=-1, keepdims=True)
        normal = local / np.maximum(length, TINY)
        return length[..., 0] - obstacle.size[0], normal @ rotation.T

    face_distances = _face_distances(obstacle, local)
    if obstacle.kind == "box":
        face_normals = np.sign(local)
    else:
        radial_distance = np.linalg.norm(local[..., :2], axis=-1)
        radial = local[..., :2] / np.maximum(radial_distance, TINY)[..., None]
        axial = np.sign(local[..., 2:])
        face_normals = np.concatenate([radial, axial], axis=-1)

    # Outside, the distance is that of an edge or corner; inside, the depth below the nearest face.
    excess = np.maximum(face_distances, 0.0)
    length = np.linalg.norm(excess, axis=-1)
    deepest = face_distances.max(axis=-1)
    is_outside = deepest > 0.0
    nearest_face = face_distances == deepest[..., None]
    weights = np.where(is_outside[..., None], excess / np.maximum(length, TINY)[..., None], nearest_face)
    if obstacle.kind == "cylinder":
        weights = np.repeat(weights, (2, 1), axis=-1)
    return np.where(is_outside, length, deepest), (weights * face_normals) @ rotation.T


def _in_obstacle_frame(obstacle: Obstacle, points: np.ndarray) -> np.ndarray:
    return (points - obstacle.placement[:3, 3]) @ obstacle.placement[:3, :3]


def _face_distances(obstacle: Obstacle, local: np.ndarray) -> np.ndarray:
    """Return the signed distances (..., k) [m] of points (..., 3) in the obstacle's frame from its k faces.

    Args:
        obstacle: the obstacle; k depends on its kind.
        local: the points.
    """
    if obstacle.kind == "box":
        return np.abs(local) - np.array(obstacle.size) / 2
    radius, length = obstacle.size
    from_shell = np.linalg.norm(local[..., :2], axis=-1) - radius
    from_ends = np.abs(local[..., 2]) - length / 2
    return np.stack([from_shell, from_ends], axis=-1)


def _distance(obstacle: Obstacle, points: np.ndarray) -> np.ndarray:
    """Return the signed distances (...) [m] of points (..., 3) from an obstacle, without normals.

    Args:
        obstacle: the obstacle.
        points: positions in the arm's base frame [m].
    """
    local = _in_obstacle_frame(obstacle, points)
    if obstacle.kind == "sphere":
        return np.linalg.norm(local, axis=-1) - obstacle.size[0]
    face_distances = np.moveaxis(_face_distances(obstacle, local), -1, 0)
    deepest = reduce(np.maximum, face_distances)
    squared_distance = np.zeros(deepest.shape)
    for excess in np.maximum(face_distances, 0.0):
        squared_distance += excess * excess
    return np.where(deepest > 0.0, np.sqrt(squared_distance), deepest)


def nearest_on_lines(obstacle: Obstacle, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Return the position (...), from 0 to 1, of the point nearest to an obstacle on each line from `start` to `end`.

    Both ends are (..., 3) [m].
    """
    low = np.zeros(start.shape[:-1])
    high = np.ones(start.shape[:-1])
    direction = end - start

    def distance_at(position: np.ndarray) -> np.ndarray:
        return _distance(obstacle, start + position[..., None] * direction)

    lower = high - _GOLDEN * (high - low)
    upper = low + _GOLDEN * (high - low)
    lower_distance = distance_at(lower)
    upper_distance = distance_at(upper)
    for _ in range(GOLDEN_STEPS):
        # Each line keeps the side of its nearer trial point; that point serves again, and a new one joins it.
        keep_low = lower_distance < upper_distance
        low = np.where(keep_low, low, lower)
        high = np.where(keep_low, upper, high)
        trial = np.where(keep_low, high - _GOLDEN * (high - low), low + _GOLDEN * (high - low))
        trial_distance = distance_at(trial)
        next_upper = np.where(keep_low, lower, trial)
        next_upper_distance = np.where(keep_low, lower_distance, trial_distance)
        lower = np.where(keep_low, trial, upper)
        lower_distance = np.where(keep_low, trial_distance, upper_distance)
        upper = next_upper
        upper_distance = next_upper_distance
    return (low + high) / 2
