"""Base parameters of bodies that can exist: those for which some standard parameters have pseudo-inertias P_i >= 0.

    { β : β = T χ,  P_i(χ) ⪰ 0,  drives' terms >= 0 }       what the motion does not tell of χ is free

(Sousa & Cortesão 2014, with the pseudo-inertia of Wensing, Kim & Slotine 2018). Where the data want to leave that
convex cone, the optimum on it is found as a semidefinite program (cvxpy, Clarabel), and the cone is replaced by the
plane that touches it there, νᵀ β >= νᵀ β*: the same optimum, with one multiplier, and a covariance that takes the plane
as an equality (our choice; the cone is bent beyond it).
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np

from calib.arrays import frozen
from calib.dynamics import pseudo_inertia
from calib.dynamics.base import Base
from calib.dynamics.regressor_model import RegressorModel
from calib.errors import NotConverged

SIZE = 0.1  # [m] of a body of one kilogram, in whose units the program is written
LARGEST = 1e4  # of a body in those units: keeps finite what the data do not tell
BORDER = 1e-4  # of a body's largest moment in those units, below which it counts as on the border
TOUCHES = 1e-6  # of the gradient, from which on the cone holds the optimum


@dataclass(frozen=True, eq=False)
class _Plane:
    """Where the cone holds an optimum: normal (p,) ν and bound νᵀ β*, with the labels of bodies on the border."""

    normal: np.ndarray
    bound: float
    bodies: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class BodyCone:
    """What bodies and drives of a robot can make of its base parameters.

    Attributes:
        transform: T (b, P) of the standard parameters, ten by body, then the drives' terms.
        labels: of the bodies.
        positive: (P - 10 B,) terms that are not negative.
    """

    transform: np.ndarray
    labels: tuple[str, ...]
    positive: np.ndarray

    def __post_init__(self) -> None:
        object.__setattr__(self, "transform", frozen(self.transform))
        object.__setattr__(self, "positive", frozen(self.positive, bool))

    def touching(self, factor: np.ndarray, matrix: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> _Plane | None:
        """Return the plane that holds argmin ½ ‖R β - z‖² on the cone and lower <= A β <= upper; None where none does.

        Args:
            factor: (p + 1, p + 1) triangle [R z; 0 ρ]; base columns first.

        Raises:
            NotConverged: where no bodies satisfy the bounds.
        """
        import cvxpy

        cp: Any = cvxpy
        p, B = len(factor) - 1, len(self.labels)
        unit = np.linalg.norm(factor[:p, :p], axis=0)
        size = max(1.0, float(np.linalg.norm(factor[:p, p])))
        R, z = factor[:p, :p] / unit, factor[:p, p] / size  # β = size · b / unit
        root = np.diag([SIZE, SIZE, SIZE, 1.0])
        units = root @ np.eye(16).reshape(16, 4, 4) @ root
        block = pseudo_inertia.to_standard(0.5 * (units + units.transpose(0, 2, 1))).T
        b, bodies = cp.Variable(p), [cp.Variable((4, 4), PSD=True) for _ in range(B)]
        terms = cp.Variable(len(self.positive))
        base = len(self.transform)
        scale = unit[:base, None] / size
        made = scale * self.transform[:, 10 * B :] @ terms
        for i, body in enumerate(bodies):
            made = made + (scale * self.transform[:, 10 * i : 10 * i + 10] @ block) @ cp.vec(body, order="C")
        same = b[:base] == made
        bounds: list[Any] = [same, *(cp.trace(body) <= LARGEST for body in bodies)]
        bounds += [terms[k] >= 0.0 for k in np.flatnonzero(self.positive)]
        rows = matrix / unit * size
        for known, sign in ((np.isfinite(lower), 1.0), (np.isfinite(upper), -1.0)):
            if known.any():
                edge = (lower if sign > 0 else upper)[known]
                length = np.linalg.norm(rows[known], axis=1)
                bounds.append(sign * (rows[known] / length[:, None]) @ b >= sign * edge / length)
        task = cp.Problem(cp.Minimize(cp.sum_squares(R @ b - z)), bounds)
        try:
            with warnings.catch_warnings():
                warnings.filterwarnings("ignore", message="Solution may be inaccurate")
                task.solve(solver=cp.CLARABEL)
        except cp.SolverError as error:
            raise NotConverged(f"bodies that can exist: Clarabel found no optimum ({error})") from error
        if b.value is None:
            raise NotConverged(f"bodies that can exist: Clarabel says '{task.status}'")
        held = -0.5 * np.asarray(same.dual_value)  # the gradient's part that the cone balances
        if np.abs(held).max() < TOUCHES * max(float(np.abs(R.T @ z).max()), 1e-300):
            return None
        normal = np.zeros(p)
        normal[:base] = held
        border = [
            label
            for label, body in zip(self.labels, bodies)
            if (eigen := np.linalg.eigvalsh(body.value))[0] < BORDER * max(eigen[-1], BORDER)
        ]
        return _Plane(normal * unit / size, float(normal @ b.value), tuple(border))


def cone_of(model: RegressorModel, base: Base) -> BodyCone:
    """Return the cone of a model's base parameters."""
    labels = tuple(name.removeprefix("XX") for name in model.names[: model.inertial : 10])
    return BodyCone(
        np.asarray(base.transform), labels, np.array([one.nonnegative for one in model.columns], dtype=bool)
    )
