"""Constraints on positions of the tool and of named points, and on distances between bodies of robot and surroundings.

Positions and distances are computed by callables with derivative products. The interface of a constraint is
`calib.trajectories.constraints.MotionConstraint`.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from .basis import SampledMotion

# smallest radius by which the limit on the distance from the axis is divided [m]
MIN_RADIUS = 1e-3


@dataclass(frozen=True, eq=False)
class Workspace:
    """Limits on points' distance d_xy from the base's z axis and on their height: d_xy ≥ radius, lowest ≤ z ≤ highest.

    The limit on the distance is evaluated as (radius² - x² - y²) / (2 · radius) ≤ 0. This value is smooth on the axis
    too, and near the limit equals the missing distance [m].

    Attributes:
        points: q (N, n) -> (N, k, 3) positions in the base frame [m].
        product: (q, G (N, k, 3)) -> (N, n), the gradient of Σ G · points by q.
        names: (k,) names of the points.
        radius, lowest, highest: limits [m]; None for no limit.
    """

    points: Callable[[np.ndarray], np.ndarray]
    product: Callable[[np.ndarray, np.ndarray], np.ndarray]
    names: tuple[str, ...] = ("tool",)
    radius: float | None = None
    lowest: float | None = None
    highest: float | None = None
    name: str = "workspace"
    unit: str = "m"

    @property
    def _kinds(self) -> tuple[str, ...]:
        kinds = []
        if self.radius is not None:
            kinds.append("distance from the axis")
        if self.lowest is not None:
            kinds.append("lowest")
        if self.highest is not None:
            kinds.append("highest")
        return tuple(kinds)

    @property
    def labels(self) -> tuple[str, ...]:
        labels = []
        for kind in self._kinds:
            labels += [f"{name} {kind}" for name in self.names]
        return tuple(labels)

    @property
    def scale(self) -> np.ndarray:
        return np.full(len(self.labels), 1.0)

    @property
    def groups(self) -> np.ndarray:
        return np.arange(len(self.labels))

    def values(self, motion: SampledMotion) -> np.ndarray:
        x = self.points(motion.q)
        height = x[..., 2]
        values = []
        if self.radius is not None:
            squared_radius = (x[..., :2] ** 2).sum(-1)
            shortfall = self.radius**2 - squared_radius
            values.append(shortfall / (2 * max(self.radius, MIN_RADIUS)))
        if self.lowest is not None:
            values.append(self.lowest - height)
        if self.highest is not None:
            values.append(height - self.highest)
        return np.concatenate(values, axis=1)

    def slopes(self, motion: SampledMotion, weights: np.ndarray) -> np.ndarray:
        x = self.points(motion.q)
        G = np.zeros_like(x)
        none = np.zeros(len(self.names))
        weights_by_kind = np.split(weights, len(self._kinds), axis=1)
        parts = dict(zip(self._kinds, weights_by_kind))
        if self.radius is not None:
            by_radius = parts["distance from the axis"][..., None]
            by_position = by_radius * x[..., :2] / max(self.radius, MIN_RADIUS)
            G[..., :2] -= by_position
        G[..., 2] += parts.get("highest", none) - parts.get("lowest", none)
        result = np.zeros((4, *motion.q.shape))
        result[0] = self.product(motion.q, G)
        return result


@dataclass(frozen=True, eq=False)
class Clearance:
    """Constraint on the smallest distance between two bodies: at least `least` [m] for every given pair.

    Attributes:
        distances: q (N, n) -> (N, k) distances of the k pairs [m], negative where bodies overlap.
        gradients: q (N, n) -> (N, k, n), the derivatives of the distances by q.
        labels: (k,) names of the pairs.
    """

    distances: Callable[[np.ndarray], np.ndarray]
    gradients: Callable[[np.ndarray], np.ndarray]
    labels: tuple[str, ...]
    least: float = 0.0
    name: str = "clearance"
    unit: str = "m"

    @property
    def scale(self) -> np.ndarray:
        return np.full(len(self.labels), 0.3)

    @property
    def groups(self) -> np.ndarray:
        return np.arange(len(self.labels))

    def values(self, motion: SampledMotion) -> np.ndarray:
        return self.least - self.distances(motion.q)

    def slopes(self, motion: SampledMotion, weights: np.ndarray) -> np.ndarray:
        result = np.zeros((4, *motion.q.shape))
        # each time once, however many pairs are asked for there
        _, rows, row_of_time = np.unique(motion.times, return_index=True, return_inverse=True)
        gradients = self.gradients(motion.q[rows])[row_of_time]
        result[0] = -np.einsum("mk,mkn->mn", weights, gradients)
        return result
