"""The nearest possible robot: how far an estimate is from the parameters of bodies that can exist.

    min ‖R T χ - z‖   over   P_i(χ) ⪰ 0,  Ia, Fv, Fc >= 0

(Sousa & Cortesão 2014; Wensing, Kim & Slotine 2018): a semidefinite program, written in cvxpy and solved by Clarabel.
Its optimum lies on the border wherever the estimate itself is impossible; it says what consistency costs and no more.
With a pull γ towards the prior bodies P_i⁰ = L Lᵀ it is the Euclidean counterpart of the entropic prior of
`calib.identification.possible.solve`, whose second order it is: + ½ γ Σ ½ ‖L⁻¹ P_i L⁻ᵀ - 1‖², the drives' likewise. In
these coordinates no weight between kg and kg m² is needed; unlike the entropic one it does not keep off the border.
"""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import scipy.linalg

from calib.dynamics import pseudo_inertia
from calib.errors import NotConverged
from calib.estimation.triangles import retriangulate
from calib.identification.possible.information import Information
from calib.identification.possible.problem import DRIVE, BodyCost

LARGEST = 1e3  # of tr(P⁰⁻¹ P) / 4: keeps what the data do not see finite


def nearest(problem: BodyCost, spared: int | None = None, pull: float = 0.0) -> np.ndarray:
    """Return the standard parameters (p,) of the possible robot nearest to the data.

    Args:
        spared: a body (counted from 0, or from B on a term) that may be impossible.
        pull: γ of the Euclidean prior; 0: none.

    Raises:
        NotConverged: where Clarabel finds no optimum.
    """
    import cvxpy

    cp: Any = cvxpy
    matrix = _coordinates(problem)
    columns = problem.factor[:, :-1] @ matrix
    fixed = ~problem.free
    given = np.where(fixed[10 * problem.bodies :], problem.fixed, 0.0)
    target = problem.factor[:, -1] - problem.factor[:, 10 * problem.bodies : -1] @ given
    triangle = retriangulate(np.column_stack([columns, target]))
    scale = max(1.0, float(np.linalg.norm(triangle[:-1, -1])))
    bodies = [
        cp.Variable((4, 4), symmetric=True) if i == spared else cp.Variable((4, 4), PSD=True)
        for i in range(problem.bodies)
    ]
    terms = cp.Variable(len(problem.sizes))
    unknowns = cp.hstack([*(cp.vec(body, order="C") for body in bodies), terms])
    bound = [cp.trace(body) <= 4.0 * LARGEST for body in bodies]
    bound += [terms[k] >= 0.0 for k in np.flatnonzero(problem.positive) if problem.bodies + k != spared]
    rows = triangle[:-1] / scale
    goal = cp.sum_squares(rows[:, :-1] @ unknowns - rows[:, -1])
    if pull > 0.0:
        drawn = [0.5 * w * cp.sum_squares(body - np.eye(4)) for w, body in zip(problem.weights(pull), bodies)]
        drawn += [
            0.5 * DRIVE * cp.square(terms[k] - 1.0) if problem.positive[k] else cp.square(terms[k])
            for k in np.flatnonzero(problem.sizes > 0.0)
        ]
        goal = goal + cp.sum(cp.hstack(drawn)) / scale**2
    task = cp.Problem(cp.Minimize(goal), bound)
    try:
        with warnings.catch_warnings():  # a reduced accuracy (1e-5) does for a distance in sigmas
            warnings.filterwarnings("ignore", message="Solution may be inaccurate")
            task.solve(solver=cp.CLARABEL)
    except cp.SolverError as error:
        raise NotConverged(f"the nearest possible robot was not found: {error}") from error
    if unknowns.value is None:
        raise NotConverged(f"the nearest possible robot was not found: Clarabel says '{task.status}'")
    result = np.asarray(matrix @ unknowns.value)
    result[10 * problem.bodies :] += given
    return result


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
    """Return χ (p,) as a matrix times [vec Q_1; …; u], P_i = L Q_i Lᵀ, P_i⁰ = L Lᵀ, u in the terms' sizes."""
    blocks = []
    for known in problem.references:
        root = np.linalg.cholesky(known)
        units = root @ np.eye(16).reshape(16, 4, 4) @ root.T
        blocks.append(pseudo_inertia.to_standard(0.5 * (units + units.transpose(0, 2, 1))).T)
    return np.asarray(scipy.linalg.block_diag(*blocks, np.diag(problem.sizes)))
