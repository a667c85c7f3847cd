"""Cost function of physically consistent standard parameters, as arrays: data, prior bodies, drive terms.

Consistent parameters are regularised towards prior bodies: those of the CAD, or else rods between the joints. `nearest`
computes how far an estimate is from the parameters of physically consistent bodies:

    min ‖R T χ - z‖   over   P_i(χ) ⪰ 0,  Ia, Fv, Fc >= 0

(Sousa & Cortesão 2014; Wensing, Kim & Slotine 2018), a semidefinite program (Clarabel). If the estimate itself is
inconsistent, the optimum is at the limit of consistency, and the minimum is the cost of consistency alone. With a
regularisation of weight γ towards prior bodies P_i⁰ = L Lᵀ,

    + ½ γ Σ ½ ‖L⁻¹ P_i L⁻ᵀ - 1‖², and likewise for the drives,

it is the Euclidean counterpart of the entropic prior of `calib.identification.physical_consistency.solve`: its
expansion to second order. In these coordinates no weight between kg and kg m² is needed. Unlike the entropic prior, it
does not keep bodies away from the limit of consistency.
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

THIN = 5e-3
"""Standard deviation of the mass of an arm's body in any direction, at least [m] (our choice)."""
LIGHT = 0.02
"""Mass of a body whose CAD has none, in units of the heaviest body's."""
TOTALS = tuple(float(10.0 ** (k / 2)) for k in range(0, 7))
"""Masses of an arm without CAD that are tried, 1 kg to 1 t [kg]."""
DRIVE = 1.0
"""Weight of the prior of Ia, Fv, Fc."""
WEAK = 2.0
"""γ of payloads: nothing is known of them but the order of size."""
MAX_TRACE = 1e3
"""Largest tr(P⁰⁻¹ P) / 4 of a body: keeps what the data do not show finite."""


@dataclass(frozen=True, eq=False)
class PriorBodies(Frozen):
    """Prior inertial parameters of each body of a model.

    Attributes:
        parameters: (B, 10) standard parameters, all physically consistent.
        drawn: (B,) whether a body is regularised with the common weight; False if only the order of magnitude is known.
        cad: whether the parameters are CAD values.
        source: text on the source.
        notes: texts on corrected bodies.
    """

    parameters: np.ndarray
    drawn: np.ndarray
    cad: bool
    source: str
    notes: tuple[str, ...] = ()


def find_prior_bodies(chain: Chain, model: IdentificationModel) -> Iterator[PriorBodies]:
    """Yield the candidate priors, among which the evidence selects.

    They are the CAD values alone, or without these, rods between the joints with several total masses.

    Args:
        chain: the arm, with its inertias if it has any.
        model: its model, whose bodies get a prior.
    """
    is_payload = model.bodies.coordinates < 0
    if chain.inertias is not None and chain.inertias[:, 9].max() > 0.0:
        yield _cad(chain, model, is_payload)
        return
    for total in TOTALS:
        source = (
            f"rods between the joints (the description has no masses), of the most probable total mass, {total:.3g} kg"
        )
        yield PriorBodies(rods(chain, model, total), ~is_payload, False, source)


def _cad(chain: Chain, model: IdentificationModel, is_payload: np.ndarray) -> PriorBodies:
    """Return the prior of a description's inertias, with missing and inconsistent ones replaced.

    Args:
        chain: the arm with its inertias.
        model: its model.
        is_payload: (B,) mask of the bodies that are payloads.
    """
    described = standard_parameters(chain).reshape(-1, 10)
    bodies = np.zeros((model.bodies.count, 10))
    bodies[: len(described)] = described
    light_mass = LIGHT * float(described[:, 9].max())
    drawn = ~is_payload
    notes = []
    for i, label in enumerate(model.bodies.labels):
        if is_payload[i]:
            bodies[i] = pseudo_inertia.ball(*PAYLOAD)
        elif not described[i, 9] > 0.0:
            bodies[i] = pseudo_inertia.ball(light_mass, RADIUS / 2)
            drawn[i] = False
            notes.append(f"body {label} has no mass in the CAD: weakly regularised towards {light_mass:.2g} kg")
        elif pseudo_inertia.margin(described[i]) < THIN:
            body = described[i]
            bodies[i] = _thickened(body)
            if pseudo_inertia.margin(described[i]) < 0.0:
                notes.append(
                    f"CAD inertia of body {label} is physically inconsistent: the nearest consistent one is used"
                )
    return PriorBodies(bodies, drawn, True, "the inertias of the robot's description", tuple(notes))


def _thickened(body: np.ndarray) -> np.ndarray:
    """Return a body's parameters with its mass spread increased to at least `THIN` in every direction."""
    pseudo = pseudo_inertia.from_standard(body)
    mass = pseudo[3, 3]
    centre = pseudo[:3, 3] / mass
    centre_square = np.outer(centre, centre)
    variances, axes = np.linalg.eigh(pseudo[:3, :3] / mass - centre_square)
    thickened = (axes * np.maximum(variances, THIN**2)) @ axes.T
    pseudo[:3, :3] = mass * (thickened + centre_square)
    return pseudo_inertia.to_standard(pseudo)


@dataclass(frozen=True, eq=False)
class BodyCost:
    """The cost function as arrays; parameters with neither data nor prior are fixed beforehand.

    Attributes:
        factor: (k, p + 1) [R T, z].
        bodies: number B of bodies, with ten parameters each, before the drive terms.
        references: (B, 4, 4) prior pseudo-inertias P⁰.
        drawn: (B,) whether the common weight γ applies to a body; otherwise the weight is `WEAK`.
        sizes: (p - 10 B,) prior values x⁰ of positive drive terms; standard deviations of other drive terms; 0 for
            fixed terms.
        positive: (p - 10 B,) whether each drive term must be positive.
        fixed: (p - 10 B,) values of fixed drive terms.
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
        """Mask (p,) of the parameters that are estimated."""
        return np.concatenate([np.ones(10 * self.bodies, bool), self.sizes > 0.0])

    def weights(self, gamma: float) -> np.ndarray:
        """Return the prior weight of each body (B,) for the common weight γ.

        Args:
            gamma: γ, weight of the divergence between a body and its prior.
        """
        return self.lift * np.where(self.drawn, gamma, WEAK)


def make_problem(information: Information, references: PriorBodies) -> BodyCost:
    """Return the cost function of an identified model; the recorded torque gives prior sizes of drive terms.

    Args:
        information: identified model with the information of its data.
        references: the prior bodies.
    """
    model = information.dynamics.model
    inertial = 10 * model.bodies.count
    matrix = information.factor[:, :-1]
    target = information.factor[:, -1]
    columns = matrix @ information.transform
    norms = np.linalg.norm(columns, axis=0)
    # The median, not the largest: a term that was switched off is pinned to zero.
    median = np.median(norms[norms > 0.0])
    term_norms = norms[inertial:]
    identified = term_norms > 1e-8 * median
    # Values that would explain all of the torque.
    explaining = np.linalg.norm(target) / np.where(identified, term_norms, 1.0)
    positive = np.array([term.nonnegative for term in model.columns], dtype=bool)
    sizes = np.where(positive, 0.1 * explaining, DRIVES * explaining)
    mass = float(references.parameters[:, 9].sum())
    for k, term in enumerate(model.columns):
        if term.shape == "acceleration" and positive[k]:
            sizes[k] = min(sizes[k], mass * ROTOR**2)
    factor = np.column_stack([columns, target])
    fixed = information.dynamics.values[inertial:]
    reference_bodies = pseudo_inertia.from_standard(references.parameters)
    unidentified_sizes = np.where(identified, sizes, 0.0)
    return BodyCost(
        factor=factor,
        bodies=model.bodies.count,
        references=reference_bodies,
        drawn=references.drawn,
        sizes=unidentified_sizes,
        positive=positive,
        fixed=fixed,
    )


def nearest(problem: BodyCost, spared: int | None = None, pull: float = 0.0) -> np.ndarray:
    """Return the physically consistent standard parameters (p,) nearest to the data's optimum.

    Args:
        problem: data, prior bodies and drive terms.
        spared: index of a body (or the number of bodies plus the index of a drive term) that may be inconsistent; None:
            none may.
        pull: weight γ of the Euclidean prior towards the prior bodies; 0: no prior.

    Raises:
        NotConverged: if Clarabel finds no optimum.
    """
    count = problem.bodies
    inertial = 10 * count
    coordinates = _coordinates(problem)
    fixed_values = np.where(problem.free[inertial:], 0.0, problem.fixed)
    columns = problem.factor[:, :-1] @ coordinates
    target = problem.factor[:, -1] - problem.factor[:, inertial:-1] @ fixed_values
    goal = retriangulate(np.column_stack([columns, target]))[:-1]
    if pull > 0.0:
        goal = np.vstack([goal, _euclidean_prior(problem, pull)])
    target_norm = float(np.linalg.norm(goal[:, -1]))
    goal = goal / max(1.0, target_norm)

    # Bounds: the trace of each body, except of the spared one, and positive terms.
    bodies = pseudo_inertia.unknown_bodies(count, len(problem.sizes))
    positive = [k for k in np.flatnonzero(problem.positive) if count + k != spared]
    traces = -np.einsum("irrj->ij", bodies) / (4.0 * MAX_TRACE)
    term_rows = np.eye(len(coordinates))[inertial:]
    rows = np.vstack([traces, term_rows[positive]])
    offset = np.repeat([1.0, 0.0], [count, len(positive)])
    lower = np.where(np.arange(count) == spared, -4.0 * MAX_TRACE, 0.0)
    upper = goal[:, :-1]
    solution = minimise(upper, goal[:, -1], rows, offset, bodies, lower)
    parameters = coordinates @ solution.values
    parameters[inertial:] += fixed_values
    return np.asarray(parameters)


def _euclidean_prior(problem: BodyCost, pull: float) -> np.ndarray:
    """Return the Euclidean prior of weight `pull` as rows of [W y], in the coordinates of `_coordinates`.

    Args:
        problem: data, prior bodies and drive terms.
        pull: weight γ.
    """
    basis = pseudo_inertia.UNITS.reshape(10, 16).T
    identity = np.eye(4).ravel()
    blocks, targets = [], []
    for weight in problem.weights(pull):
        root = np.sqrt(0.5 * weight)
        blocks.append(root * basis)
        targets.append(root * identity)
    weights = np.sqrt(np.where(problem.positive, 0.5 * DRIVE, 1.0))
    terms = weights * (problem.sizes > 0.0)
    blocks.append(np.diag(terms))
    targets.append(terms * problem.positive)
    matrix = np.asarray(scipy.linalg.block_diag(*blocks))
    return np.column_stack([matrix, np.concatenate(targets)])


def blame(problem: BodyCost, information: Information, count: int = 3) -> tuple[tuple[str, float], ...]:
    """Return the `count` bodies and terms whose constraints cost most, each with the distance without its constraint.

    The first entry of a pair is the name; distances are Mahalanobis distances from the data's optimum.

    Args:
        problem: data, prior bodies and drive terms.
        information: identified model, which provides the names.
        count: number of entries.
    """
    model = information.dynamics.model
    constraints = [(f"body {label}", i) for i, label in enumerate(model.bodies.labels)]
    for k, term in enumerate(model.columns):
        if problem.positive[k] and problem.sizes[k] > 0.0:
            constraints.append((term.name, problem.bodies + k))
    distances = []
    for name, number in constraints:
        without_constraint = nearest(problem, number)
        distances.append((information.distance(without_constraint), name))
    distances.sort()
    return tuple((name, distance) for distance, name in distances[:count])


def _coordinates(problem: BodyCost) -> np.ndarray:
    """Return the matrix that maps coordinates [ξ_1; …; u] to standard parameters χ (p,).

    ξ_i are the entries of Q_i in an orthonormal basis, with P_i = L Q_i Lᵀ and P_i⁰ = L Lᵀ; u are the drive terms in
    units of their prior sizes.

    Args:
        problem: data, prior bodies P_i⁰ and drive terms.
    """
    roots = np.linalg.cholesky(problem.references)[:, None]
    pseudo = roots @ pseudo_inertia.UNITS @ roots.transpose(0, 1, 3, 2)
    blocks = pseudo_inertia.to_standard(pseudo).transpose(0, 2, 1)
    return np.asarray(scipy.linalg.block_diag(*blocks, np.diag(problem.sizes)))
