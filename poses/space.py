"""Search space of the continuous searches: joint limits, constraints, predicate, and observation Jacobian."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from .errors import BadInput

STEP = 1e-5
"""Step of central differences [rad or m]: our choice; truncation and rounding both cost about 1e-10 of the values."""


@dataclass(frozen=True)
class PoseConstraint:
    """Inequality constraints on a pose.

    Attributes:
        name: the constraint's name in messages.
        function: (m, n) -> (m, k), satisfied where ≤ 0; each pose's values depend on that pose only.
        gradient: (m, n) -> (m, k, n); None computes central differences of `function` in one batch.
    """

    name: str
    function: Callable[[np.ndarray], np.ndarray]
    gradient: Callable[[np.ndarray], np.ndarray] | None = None


@dataclass(frozen=True)
class SearchSpace:
    """The continuous search space of poses.

    Attributes:
        jacobian: (m, n) -> (m, rows, p) whitened observation Jacobians by the base parameters.
        lower, upper: (n,) joint limits [rad or m].
        jacobian_product: (q: (m, n), G: (m, rows, p)) -> (m, n), Σ_rp G[i,r,p] ∂J[i,r,p]/∂q[i,k]; None computes central
            differences of `jacobian` in one batch of 2 m n poses.
        constraints: inequalities that candidates and search results must satisfy.
        feasible: (m, n) -> (m,) bool, a predicate for conditions without gradient (collision, visibility by ray
            casting); None accepts all.

    Raises:
        BadInput: limits that are not two finite (n,) arrays with lower < upper.
    """

    jacobian: Callable[[np.ndarray], np.ndarray]
    lower: np.ndarray
    upper: np.ndarray
    jacobian_product: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None
    constraints: tuple[PoseConstraint, ...] = ()
    feasible: Callable[[np.ndarray], np.ndarray] | None = None

    def __post_init__(self):
        lower = np.asarray(self.lower, dtype=float)
        upper = np.asarray(self.upper, dtype=float)
        if lower.ndim != 1 or lower.shape != upper.shape or not np.isfinite([lower, upper]).all():
            raise BadInput(f"limits: expected two finite (n,) arrays, found shapes {lower.shape} and {upper.shape}")
        if not (lower < upper).all():
            joint = int(np.argmax(lower >= upper))
            raise BadInput(f"limits of joint {joint}: lower {lower[joint]} is not below upper {upper[joint]}")
        object.__setattr__(self, "lower", lower)
        object.__setattr__(self, "upper", upper)


def is_feasible(space: SearchSpace, q: np.ndarray, tolerance: float = 1e-8) -> np.ndarray:
    """Return whether each pose q (m, n) satisfies joint limits, constraints and predicate, (m,) bool.

    Args:
        space: joint limits, constraints and predicate.
        q: (m, n) joint values [rad or m].
        tolerance: excess of a joint limit [rad or m] or a constraint's value that still counts as satisfied.
    """
    above_lower = q >= space.lower - tolerance
    below_upper = q <= space.upper + tolerance
    good = np.all(above_lower & below_upper, axis=1)
    good = np.asarray(good, dtype=bool)
    for constraint in space.constraints:
        if good.any():
            values = np.asarray(constraint.function(q[good]))
            good[good] = (values <= tolerance).all(1)
    if space.feasible is not None and good.any():
        allowed = np.asarray(space.feasible(q[good]), dtype=bool)
        good[good] = allowed
    return good


def product(space: SearchSpace, q: np.ndarray, G: np.ndarray) -> np.ndarray:
    """Return Σ_rp G[i,r,p] ∂J[i,r,p]/∂q[i,k] (m, n), by `space.jacobian_product`, else by central differences.

    Args:
        q: (m, n) joint values [rad or m].
        G: (m, rows, p) weights of the entries of the Jacobians J (m, rows, p) at q.
    """
    if space.jacobian_product is not None:
        return np.asarray(space.jacobian_product(q, G), dtype=float)
    slopes = central_difference(space.jacobian, q)
    return np.einsum("mrp,mkrp->mk", G, slopes)


def constraint_values(space: SearchSpace, q: np.ndarray) -> np.ndarray:
    """Return the values (m, k) of all constraints of `space` at poses q (m, n); a constraint is satisfied where ≤ 0."""
    empty = np.zeros((len(q), 0))
    values = [np.asarray(constraint.function(q)) for constraint in space.constraints]
    return np.concatenate([empty, *values], axis=1)


def constraint_gradients(space: SearchSpace, q: np.ndarray) -> np.ndarray:
    """Return the derivatives of `constraint_values` of `space` with respect to q, (m, k, n), at poses q (m, n)."""
    empty = np.zeros((len(q), 0, q.shape[1]))
    gradients = [constraint_gradient(constraint, q) for constraint in space.constraints]
    return np.concatenate([empty, *gradients], axis=1)


def constraint_gradient(constraint: PoseConstraint, q: np.ndarray) -> np.ndarray:
    """Return the gradient ∂c/∂q (m, k, n) of the values c of `constraint` at poses q (m, n).

    Without `PoseConstraint.gradient` it is computed by central differences.
    """
    if constraint.gradient is not None:
        return np.asarray(constraint.gradient(q), dtype=float)
    slopes = central_difference(constraint.function, q)
    return slopes.transpose(0, 2, 1)


def central_difference(function: Callable[[np.ndarray], np.ndarray], q: np.ndarray) -> np.ndarray:
    """Return ∂f_i/∂q_ik (m, n, ...) of a function f: (m, n) -> (m, ...), evaluated in one batch.

    Each row of f depends on the same row of q only.
    """
    m, n = q.shape
    steps = STEP * np.eye(n)
    forwards = q[:, None] + steps
    backwards = q[:, None] - steps
    displaced = np.concatenate([forwards, backwards], axis=1).reshape(-1, n)
    values = np.asarray(function(displaced), dtype=float)
    values = values.reshape(m, 2, n, *values.shape[1:])
    difference = values[:, 0] - values[:, 1]
    return difference / (2 * STEP)
