"""Convex sets of parameters as rows of a cone program: what a user's convex constraints become.

    C = { b : e - A b - B x ∈ K for some x }

with K a product of Clarabel's cones and x unknowns of the set alone. At an optimum of a cone program with multipliers z
the plane νᵀ b >= νᵀ b*, ν = -Aᵀ z, touches the set: it holds for each b of the set, since zᵀ s >= 0 on K, and it gives
the same optimum in place of the set (Boyd & Vandenberghe 2004, section 5.9).
"""

from dataclasses import dataclass, replace

import numpy as np

from calib.records import Frozen


@dataclass(frozen=True, eq=False)
class ConvexSet(Frozen):
    """Convex set of p parameters.

    Attributes:
        name: name of the constraint, for messages.
        matrix: A (k, p).
        further: B (k, a) of unknowns that occur in this set alone.
        sides: e (k,).
        cones: Clarabel's cones, k rows in all.
    """

    name: str
    matrix: np.ndarray
    further: np.ndarray
    sides: np.ndarray
    cones: tuple[object, ...]

    def of(self, columns: np.ndarray) -> "ConvexSet":
        """Return the set of all u (q,) whose b = columns u are in this set."""
        return replace(self, matrix=self.matrix @ columns)

    def normal(self, multipliers: np.ndarray) -> np.ndarray:
        """Return ν (p,) of the plane that touches the set, from the multipliers z (k,) of its rows."""
        return -np.asarray(self.matrix.T @ multipliers)
