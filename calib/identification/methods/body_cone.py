"""Base parameters of physically consistent bodies, i.e. of standard parameters with pseudo-inertias P_i >= 0.

    { β : β = T χ,  P_i(χ) ⪰ 0,  drive terms >= 0 }       unidentified parts of χ are free

(Sousa & Cortesão 2014, with the pseudo-inertia of Wensing, Kim & Slotine 2018). If the unconstrained optimum is outside
this convex cone, a semidefinite program (Clarabel) finds the optimum in the cone, and the cone is replaced by its
tangent plane at this optimum β*, νᵀ β >= νᵀ β*. This gives the same optimum with one multiplier, and a covariance that
treats the plane as an equality (our choice; the cone is curved).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag

from calib.dynamics import pseudo_inertia
from calib.dynamics.base import Base
from calib.dynamics.regressor_model import RegressorModel
from calib.estimation.cone_program import minimise
from calib.estimation.convex_sets import ConvexSet
from calib.records import Frozen


@dataclass(frozen=True, eq=False)
class Touching:
    """Optimum β* (p,) on the cone, and the planes νᵀ β >= νᵀ β* that give it in place of the cone and of convex sets.

    Attributes:
        values: β*.
        normal: ν (p,) of the cone; None where it is inactive.
        bodies: labels of the bodies on the border.
        planes: ν (p,) of each convex set; None where it is inactive.
    """

    values: np.ndarray
    normal: np.ndarray | None
    bodies: tuple[str, ...]
    planes: tuple[np.ndarray | None, ...]


@dataclass(frozen=True, eq=False)
class BodyCone(Frozen):
    """Convex cone of the base parameters of all physically consistent bodies and drives.

    Attributes:
        transform: T (b, P), from the standard parameters (ten per body, then the drive terms) to base parameters.
        labels: names of the bodies.
        positive: (P - 10 B,) whether each drive term must not be negative.
    """

    transform: np.ndarray
    labels: tuple[str, ...]
    positive: np.ndarray

    def touching(
        self,
        factor: np.ndarray,
        matrix: np.ndarray,
        lower: np.ndarray,
        upper: np.ndarray,
        sets: Sequence[ConvexSet] = (),
    ) -> Touching:
        """Return tangent planes at argmin ½ ‖R β - z‖² under lower <= A β <= upper, the cone and convex sets.

        β (p,) are the parameters of the columns, base parameters first.

        Args:
            factor: (p + 1, p + 1) upper triangle [R z; 0 ρ] of the least-squares problem in β; base columns first.
            matrix: A (c, p).
            lower, upper: (c,) bounds, -inf and inf allowed.
            sets: convex sets of β.

        Raises:
            NotConverged: if no bodies satisfy the bounds and sets.
        """
        p = len(factor) - 1
        count = len(self.labels)
        base = len(self.transform)
        unit = np.linalg.norm(factor[:p, :p], axis=0)
        size = max(1.0, float(np.linalg.norm(factor[:p, p])))
        # β = size · b / unit
        R = factor[:p, :p] / unit
        z = factor[:p, p] / size
        # [m] of a body of one kilogram, in whose units the program is written
        unit_length = 0.1
        root = np.diag([unit_length, unit_length, unit_length, 1.0])
        # of the unknowns' pseudo-inertia
        block = pseudo_inertia.to_standard(root @ pseudo_inertia.UNITS @ root).T
        # b of bodies and terms, and of columns that are none of theirs
        standard = block_diag(*[block] * count, np.eye(len(self.positive)))
        columns = unit[:base, None] / size * self.transform @ standard
        columns = np.asarray(block_diag(columns, np.eye(p - base)))
        bodies = pseudo_inertia.unknown_bodies(count, columns.shape[1] - 10 * count)
        # of a body in those units: keeps finite what the data do not tell
        max_trace = 1e4
        rows = [-np.einsum("irrj->ij", bodies) / max_trace]
        first = 10 * count
        unit_rows = np.eye(columns.shape[1])
        terms = unit_rows[first : first + len(self.positive)]
        rows.append(terms[self.positive])
        low = np.isfinite(lower)
        high = np.isfinite(upper)
        sides = np.vstack([matrix[low], -matrix[high]]) / unit * size
        lengths = np.linalg.norm(sides, axis=1, keepdims=True)
        edges = np.concatenate([lower[low], -upper[high]]) / lengths[:, 0]
        sides = sides / lengths
        positive_count = int(self.positive.sum())
        limits = np.repeat([1.0, 0.0], [count, positive_count])
        offset = np.concatenate([limits, -edges])
        conditions = np.vstack([*rows, sides @ columns])
        scaled_sets: list[ConvexSet] = []
        sets_of_unknowns: list[ConvexSet] = []
        for convex in sets:
            scaled = convex.of(np.diag(size / unit))
            scaled_sets.append(scaled)
            sets_of_unknowns.append(scaled.of(columns))
        solution = minimise(R @ columns, z, conditions, offset, bodies, sets=sets_of_unknowns)
        b = columns @ solution.values
        # of the gradient, from which on the cone or a set holds the optimum
        min_multiplier = 1e-6 * max(float(np.abs(R.T @ z).max()), 1e-300)
        planes: list[np.ndarray | None] = []
        # the gradient's part that the cone balances
        forces = solution.rows[len(offset) - len(edges) :]
        gradient = R.T @ (R @ b - z) - sides.T @ forces
        for convex, multipliers in zip(scaled_sets, solution.sets):
            push = convex.normal(multipliers)
            gradient = gradient - push
            binds = np.abs(push).max() >= min_multiplier
            planes.append(push * unit / size if binds else None)
        values = b * size / unit
        if np.abs(gradient[:base]).max() < min_multiplier:
            return Touching(values, None, (), tuple(planes))
        normal = np.zeros(p)
        normal[:base] = gradient[:base]
        eigenvalues = np.linalg.eigvalsh(bodies @ solution.values)
        # of a body's largest moment in those units, below which it counts as on the border
        max_on_border = 1e-4
        border = eigenvalues[:, 0] < max_on_border * np.maximum(eigenvalues[:, -1], max_on_border)
        labels = tuple(label for label, touches in zip(self.labels, border) if touches)
        return Touching(values, normal * unit / size, labels, tuple(planes))


def cone_of(model: RegressorModel, base: Base) -> BodyCone:
    """Return the cone of physically consistent base parameters of a model.

    Args:
        model: model of standard parameters.
        base: its base parameters.
    """
    labels = tuple(name.removeprefix("XX") for name in model.names[: model.inertial : 10])
    positive = [column.nonnegative for column in model.columns]
    return BodyCone(np.asarray(base.transform), labels, np.array(positive, dtype=bool))
