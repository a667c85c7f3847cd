"""Cost function of physically consistent standard parameters, as arrays: data, prior bodies, drive terms.

Prior bodies, towards which consistent parameters are regularised, are the CAD's, else rods between the joints.

`nearest` says how far an estimate is from the parameters of bodies that can exist:

    min ‖R T χ - z‖   over   P_i(χ) ⪰ 0,  Ia, Fv, Fc >= 0

(Sousa & Cortesão 2014; Wensing, Kim & Slotine 2018): a semidefinite program (Clarabel).
Its optimum lies on the border wherever the estimate itself is impossible; it says what consistency costs and no more.
With a pull γ towards the prior bodies P_i⁰ = L Lᵀ it is the Euclidean counterpart of the entropic prior of
`calib.identification.physical_consistency.solve`, whose second order it is: + ½ γ Σ ½ ‖L⁻¹ P_i L⁻ᵀ - 1‖², the drives'
likewise. In
these coordinates no weight between kg and kg m² is needed; unlike the entropic one it does not keep off the border.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import scipy.linalg

from calib.dynamics import pseudo_inertia
from calib.dynamics.bodies import standard_parameters
from calib.dynamics.idim import IdentificationModel
from calib.estimation.cone_program import minimise
from calib.estimation.triangles import retriangulate
from calib.identification.physical_consistency.information import Information
from calib.identification.prior import DRIVES, PAYLOAD, RADIUS, ROTOR, rods
from calib.records import Frozen
from calib.robot.chain import Chain

THIN = 5e-3  # [m]: no body of a robot's arm has its mass within less, as a standard deviation (our choice)
LIGHT = 0.02  # of the heaviest body: the mass of one whose CAD has none
TOTALS = tuple(float(10.0 ** (k / 2)) for k in range(0, 7))  # [kg] of an arm without CAD, 1 kg to 1 t


@dataclass(frozen=True, eq=False)
class PriorBodies(Frozen):
    """Prior inertial parameters of each body of a model.

    Attributes:
        parameters: (B, 10) standard parameters, all physically consistent.
        drawn: (B,) False where only the order of magnitude is known.
        cad: whether they are CAD values.
        source: text on the source.
        notes: texts on corrected bodies.
    """

    parameters: np.ndarray
    drawn: np.ndarray
    cad: bool
    source: str
    notes: tuple[str, ...] = ()


def find_prior_bodies(chain: Chain, model: IdentificationModel) -> Iterator[PriorBodies]:
    """Yield the candidate priors, to be selected by evidence: CAD values alone, or rods with several total masses."""
    carried = model.bodies.coordinates < 0
    if chain.inertias is not None and chain.inertias[:, 9].max() > 0.0:
        yield _cad(chain, model, carried)
        return
    for total in TOTALS:
        bodies = rods(chain, model, total)
        words = f"rods between the joints (the description has no masses), {total:.3g} kg in all by evidence"
        yield PriorBodies(bodies, ~carried, False, words)


def _cad(chain: Chain, model: IdentificationModel, carried: np.ndarray) -> PriorBodies:
    bodies = np.zeros((model.bodies.count, 10))
    own = standard_parameters(chain).reshape(-1, 10)
    bodies[: len(own)] = own
    heaviest, notes, drawn = float(own[:, 9].max()), [], ~carried
    for i, label in enumerate(model.bodies.labels):
        if carried[i]:
            bodies[i] = pseudo_inertia.ball(*PAYLOAD)
        elif not own[i, 9] > 0.0:
            bodies[i], drawn[i] = pseudo_inertia.ball(LIGHT * heaviest, RADIUS / 2), False
            notes.append(f"body {label} has no mass in the CAD: weakly regularised towards {LIGHT * heaviest:.2g} kg")
        elif pseudo_inertia.margin(own[i]) < THIN:
            bodies[i] = _thickened(own[i])
            if pseudo_inertia.margin(own[i]) < 0.0:
                notes.append(
                    f"CAD inertia of body {label} is physically inconsistent: the nearest consistent one is used"
                )
    return PriorBodies(bodies, drawn, True, "the inertias of the robot's description", tuple(notes))


def _thickened(body: np.ndarray) -> np.ndarray:
    """Return a body's parameters with its mass spread by at least `THIN` in every direction about its centre."""
    pseudo = pseudo_inertia.from_standard(body)
    mass, centre = pseudo[3, 3], pseudo[:3, 3] / pseudo[3, 3]
    size, axes = np.linalg.eigh(pseudo[:3, :3] / mass - np.outer(centre, centre))
    pseudo[:3, :3] = mass * ((axes * np.maximum(size, THIN**2)) @ axes.T + np.outer(centre, centre))
    return pseudo_inertia.to_standard(pseudo)


DRIVE = 1.0  # weight of the prior of Ia, Fv, Fc
WEAK = 2.0  # γ of payloads: nothing is known of them but the order of size


@dataclass(frozen=True, eq=False)
class BodyCost:
    """The cost function as arrays; parameters without data and prior are fixed beforehand.

    Attributes:
        factor: (k, p + 1) [R T, z].
        bodies: number of bodies, with ten parameters each, before all other parameters.
        references: (B, 4, 4) P⁰.
        drawn: (B,) whether the common weight γ applies to a body; `WEAK` otherwise.
        sizes: (p - 10 B,) x⁰ of positive drive terms; standard deviation of the free ones; 0 where fixed.
        positive: (p - 10 B,) which terms must be positive.
        fixed: (p - 10 B,) their values where fixed.
        lift: factor of all priors; 1 except during the search for the optimum.
    """

    factor: np.ndarray
    bodies: int
    references: np.ndarray
    drawn: np.ndarray
    sizes: np.ndarray
    positive: np.ndarray
    fixed: np.ndarray
    lift: float = 1.0

    @property
    def free(self) -> np.ndarray:
        """Which parameters are estimated (p,) bool."""
        return np.concatenate([np.ones(10 * self.bodies, bool), self.sizes > 0.0])

    def weights(self, gamma: float) -> np.ndarray:
        """Return the prior weight of each body (B,)."""
        return self.lift * np.where(self.drawn, gamma, WEAK)


def make_problem(information: Information, references: PriorBodies) -> BodyCost:
    """Return the cost function of an identified model; prior sizes of drive terms come from the recorded torque."""
    model = information.dynamics.model
    bodies = model.bodies.count
    columns = information.factor[:, :-1] @ information.transform
    norms, target = np.linalg.norm(columns, axis=0), np.linalg.norm(information.factor[:, -1])
    usual = np.median(norms[norms > 0.0])  # not the largest: a term that was switched off is pinned to zero
    norms = norms[10 * bodies :]
    seen = norms > 1e-8 * usual
    whole = target / np.where(seen, norms, 1.0)  # would explain all of the torque
    positive = np.array([one.nonnegative for one in model.columns], dtype=bool)
    sizes = np.where(positive, 0.1 * whole, DRIVES * whole)
    mass = float(references.parameters[:, 9].sum())
    for k, one in enumerate(model.columns):
        if one.shape == "acceleration" and positive[k]:
            sizes[k] = min(sizes[k], mass * ROTOR**2)
    return BodyCost(
        np.column_stack([columns, information.factor[:, -1]]),
        bodies,
        pseudo_inertia.from_standard(references.parameters),
        references.drawn,
        np.where(seen, sizes, 0.0),
        positive,
        information.dynamics.values[10 * bodies :],
    )


def nearest(problem: BodyCost, spared: int | None = None, pull: float = 0.0) -> np.ndarray:
    """Return the physically consistent standard parameters (p,) nearest to the data's optimum.

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
    """Return the bodies and terms whose constraint costs most: name, and the distance without this constraint."""
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
    """Return the matrix from [ξ_1; …; u] to χ (p,), with P_i = L Q_i Lᵀ, P_i⁰ = L Lᵀ, u in units of the terms' sizes.

    ξ_i are the entries of Q_i by an orthonormal basis.
    """
    roots = np.linalg.cholesky(problem.references)[:, None]
    blocks = pseudo_inertia.to_standard(roots @ pseudo_inertia.UNITS @ roots.transpose(0, 1, 3, 2))
    return np.asarray(scipy.linalg.block_diag(*blocks.transpose(0, 2, 1), np.diag(problem.sizes)))
