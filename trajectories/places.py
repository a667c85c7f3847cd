"""Constraints on the arm's place: positions of the tool and of named points, and distances between bodies.

Places and distances come from callables with derivative products; see `calib.trajectories.constraints` for what a
constraint
has.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from calib.trajectories.basis import SampledMotion


@dataclass(frozen=True, eq=False)
class Workspace:
    """Limits on points' distance from the base's z axis and height: d_xy ≥ least_radius, lowest ≤ z ≤ highest.

    Written least² - x² - y² ≤ 0 over 2 · least, which is smooth on the axis too and a length near the limit.

    Attributes:
        points: q (N, n) -> (N, k, 3) [m].
        product: (q, G (N, k, 3)) -> (N, n), the slopes of Σ G · points.
        names: (k,).
        radius, lowest, highest: [m]; None: no such limit.
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
        kinds = (("distance from the axis", self.radius), ("lowest", self.lowest), ("highest", self.highest))
        return tuple(kind for kind, bound in kinds if bound is not None)

    @property
    def labels(self) -> tuple[str, ...]:
        return tuple(f"{name} {kind}" for kind in self._kinds for name in self.names)

    @property
    def scale(self) -> np.ndarray:
        return np.full(len(self.labels), 1.0)

    @property
    def groups(self) -> np.ndarray:
        return np.arange(len(self.labels))

    def values(self, motion: SampledMotion) -> np.ndarray:
        x = self.points(motion.q)
        found = []
        if self.radius is not None:
            found.append((self.radius**2 - (x[..., :2] ** 2).sum(-1)) / (2 * max(self.radius, 1e-3)))
        found += [self.lowest - x[..., 2]] if self.lowest is not None else []
        found += [x[..., 2] - self.highest] if self.highest is not None else []
        return np.concatenate(found, axis=1)

    def slopes(self, motion: SampledMotion, weights: np.ndarray) -> np.ndarray:
        x, k = self.points(motion.q), len(self.names)
        G = np.zeros_like(x)
        parts = dict(zip(self._kinds, np.split(weights, len(self._kinds), axis=1)))
        if self.radius is not None:
            G[..., :2] -= parts["distance from the axis"][..., None] * x[..., :2] / max(self.radius, 1e-3)
        G[..., 2] += parts.get("highest", np.zeros(k)) - parts.get("lowest", np.zeros(k))
        result = np.zeros((4, *motion.q.shape))
        result[0] = self.product(motion.q, G)
        return result


@dataclass(frozen=True, eq=False)
class Clearance:
    """Minimum distance `least` [m] between bodies.

    Attributes:
        distances: q (N, n) -> (N, k) [m], negative inside.
        gradients: q (N, n) -> (N, k, n), their derivatives.
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
        _, rows, back = np.unique(motion.times, return_index=True, return_inverse=True)  # each pair asks for its own
        result[0] = -np.einsum("mk,mkn->mn", weights, self.gradients(motion.q[rows])[back])
        return result
