"""The nearest possible robot: how far an estimate is from the parameters of bodies that can exist.

    min ‖R T χ - z‖   over   P_i(χ) ⪰ 0,  Ia, Fv, Fc >= 0

(Sousa & Cortesão 2014; Wensing, Kim & Slotine 2018): a semidefinite program (Clarabel).
Its optimum lies on the border wherever the estimate itself is impossible; it says what consistency costs and no more.
With a pull γ towards the prior bodies P_i⁰ = L Lᵀ it is the Euclidean counterpart of the entropic prior of
`calib.identification.possible.solve`, whose second order it is: + ½ γ Σ ½ ‖L⁻¹ P_i L⁻ᵀ - 1‖², the drives' likewise. In
these coordinates no weight between kg and kg m² is needed; unlike the entropic one it does not keep off the border.
"""

import numpy as np
import scipy.linalg

from calib.dynamics import pseudo_inertia
from calib.estimation.convex.cone_program import minimise
from calib.estimation.triangles import retriangulate
from calib.identification.possible.information import Information
from calib.identification.possible.problem import DRIVE, BodyCost


def nearest(problem: BodyCost, spared: int | None = None, pull: float = 0.0) -> np.ndarray:
    """Return the standard parameters (p,) of the possible robot nearest to the data.

    Args:
        spared: a body (counted from 0, or from B on a term) that may be impossible.
        pull: γ of the Euclidean prior; 0: none.

    Raises:
        NotConverged: where Clarabel finds no optimum.
    """
    matrix, count = _coordinates(problem), problem.bodies
    columns = problem.factor[:, :-1] @ matrix
    fixed = ~problem.free
    given = np.where(fixed[10 * count :], problem.fixed, 0.0)
    target = problem.factor[:, -1] - problem.factor[:, 10 * count : -1] @ given
    goal = retriangulate(np.column_stack([columns, target]))[:-1]
    if pull > 0.0:
        goal = np.vstack([goal, _pulling(problem, pull)])
    goal = goal / max(1.0, float(np.linalg.norm(goal[:, -1])))
    bodies = pseudo_inertia.unknown_bodies(count, len(problem.sizes))
    positive = [k for k in np.flatnonzero(problem.positive) if count + k != spared]
    max_trace = 1e3  # of tr(P⁰⁻¹ P) / 4: keeps what the data do not see finite
    rows = np.vstack([-np.einsum("irrj->ij", bodies) / (4.0 * max_trace), np.eye(len(matrix))[10 * count :][positive]])
    offset = np.repeat([1.0, 0.0], [count, len(positive)])
    least = np.where(np.arange(count) == spared, -4.0 * max_trace, 0.0)
    result = matrix @ minimise(goal[:, :-1], goal[:, -1], rows, offset, bodies, least).values
    result[10 * count :] += given
    return np.asarray(result)


def _pulling(problem: BodyCost, pull: float) -> np.ndarray:
    """Return the Euclidean prior as rows of [W y] in the coordinates of `_coordinates`."""
    flat = pseudo_inertia.UNITS.reshape(10, 16).T
    bodies = [np.sqrt(0.5 * weight) * np.column_stack([flat, np.eye(4).ravel()]) for weight in problem.weights(pull)]
    terms = np.sqrt(np.where(problem.positive, 0.5 * DRIVE, 1.0)) * (problem.sizes > 0.0)
    unknowns = np.asarray(scipy.linalg.block_diag(*(one[:, :-1] for one in bodies), np.diag(terms)))
    return np.column_stack([unknowns, np.concatenate([*(one[:, -1] for one in bodies), terms * problem.positive])])


def blame(problem: BodyCost, information: Information, most: int = 3) -> tuple[tuple[str, float], ...]:
    """Return whose possibility costs most: label or name, and the distance left without the demand on it."""
    model = information.dynamics.model
    found = [(f"body {label}", i) for i, label in enumerate(model.bodies.labels)]
    found += [
        (one.name, problem.bodies + k)
        for k, one in enumerate(model.columns)
        if problem.positive[k] and problem.sizes[k] > 0.0
    ]
    left = sorted((information.distance(nearest(problem, place)), name) for name, place in found)
    return tuple((name, distance) for distance, name in left[:most])


def _coordinates(problem: BodyCost) -> np.ndarray:
    """Return χ (p,) as a matrix times [ξ_1; …; u], P_i = L Q_i Lᵀ, P_i⁰ = L Lᵀ, u in the terms' sizes.

    ξ_i are the entries of Q_i by an orthonormal basis.
    """
    roots = np.linalg.cholesky(problem.references)[:, None]
    blocks = pseudo_inertia.to_standard(roots @ pseudo_inertia.UNITS @ roots.transpose(0, 1, 3, 2))
    return np.asarray(scipy.linalg.block_diag(*blocks.transpose(0, 2, 1), np.diag(problem.sizes)))
